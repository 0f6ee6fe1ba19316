"""What a skin adds to the stages: processor time per frame, and the age of the newest frame for a slow reader.

The skin reads a port in memory, whose clock is the processor time of this process plus the time that the reader works.
So the ages are those of a core that has nothing else to do, however loaded this machine is; what an operating system
and a line add is left out (``examples/link_latency.py`` measures a real port).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from math import inf
from time import process_time

import numpy as np

from ..cell import Cell
from ..circuits import Design
from ..common.arrays import FloatArray
from ..driver import Skin
from ._driver import design, packets_of, pressed
from ._paced_port import PacedPort
from .harness import column

RATE_HZ = 1000.0
WORK_S = 0.0104
"""the reader's work in each cycle: 10 ms, and not a multiple of the board's period"""
CYCLES = 150
_BURST = 11  # frames that come at once, to tell their cost from that of the frame taken
_FRAMES = 200  # different ones; they repeat
_ROOM = 4  # times as many packets as the work alone needs, for slow machines


HEAD = (
    f"through a skin: processor time per frame, and the age in frames of the newest one at {RATE_HZ:g} Hz "
    "for a reader with 10 ms of work per cycle"
)


@dataclass(frozen=True)
class Freshness:
    """One size, on a board with inverting amplifiers and 12 bits."""

    size: int = field(metadata=column("cells", "{0} x {0}"))
    """of the N x N array"""
    come_us: float = field(metadata=column("us per frame that comes", "{:.0f}"))
    """processor time per frame that comes: packets, numbering and timing of the frame, counts to ohms to kPa"""
    taken_us: float = field(metadata=column("taken", "{:.0f}"))
    """besides, per frame that is taken: standard deviations, and handing over"""
    contacts_us: float = field(metadata=column("contacts besides", "{:.0f}"))
    """besides, per frame once contacts have been asked for, with about five fingers on the skin"""
    median_age: float = field(metadata=column("median age", "{:.2f}"))
    """of the newest frame, in frames of a board at 1 kHz, when a reader gets it who works for 10 ms in each cycle"""
    worst_age: float = field(metadata=column("worst", "{:.2f}"))
    skipped: int = field(metadata=column("skipped", "{}"))
    """frames that this reader did not take, as the frames say"""
    unaccounted: int
    """frames that the board sent and that are in no count; 0 unless the driver has a fault"""


def freshness(sizes: Iterable[int], *, cycles: int = CYCLES) -> Iterator[Freshness]:
    """Measure at every size."""
    for size in sizes:
        board = design(size, "inverting-amplifier", "ground", 12)
        _, cells = pressed(board.array.shape, _FRAMES)
        come_us, taken_us, contacts_us = _costs(board, cells, cycles)
        ages, skipped, unaccounted = _ages(board, cells, cycles)
        yield Freshness(
            size=size,
            come_us=come_us,
            taken_us=taken_us,
            contacts_us=contacts_us,
            median_age=float(np.median(ages)) * RATE_HZ,
            worst_age=float(max(ages)) * RATE_HZ,
            skipped=skipped,
            unaccounted=unaccounted,
        )


def _opened(
    board: Design, cells: FloatArray, frames: int, *, each: int = 1, clock: Callable[[], float] = process_time
) -> tuple[Skin, PacedPort]:
    """A skin whose frames with the same cells, ``each``, come within a millisecond."""
    rate_hz = each * RATE_HZ
    packets = packets_of(board, cells, frames=frames, each=each, rate_hz=rate_hz)
    port = PacedPort(packets, 1.0 / rate_hz, board, clock=clock)
    return Skin(port, design=board, cell=Cell.example(), timeout=60.0), port


def _costs(board: Design, cells: FloatArray, cycles: int) -> tuple[float, float, float]:
    """Processor time in us per frame that comes, per frame taken, and of contacts.

    The ports' time stands while the skins work, so the processor time of a cycle does not matter. Three skins take the
    same frames and take turns, since the load of the machine changes: one as they come, one with ten others that come
    before each, one with contacts.
    """
    times = np.empty((cycles, 3))
    kinds = [_opened(board, cells, step * (cycles + 2), each=step, clock=lambda: 0.0) for step in (1, _BURST, 1)]
    with kinds[0][0], kinds[1][0], kinds[2][0] as asked:
        kinds[2][1].work(1.0 / RATE_HZ)
        _ = asked.latest(inf).contacts  # from now on contacts are found in every frame
        for cycle in range(cycles):
            for kind, (skin, port) in enumerate(kinds):
                port.work(1.0 / RATE_HZ)
                began = process_time()
                _ = skin.latest(inf).pressure_std
                times[cycle, kind] = process_time() - began
    times[:, 1:] -= times[:, :1]
    one, ten_more, contacts = (max(float(part), 0.0) for part in 1e6 * np.median(times, axis=0))
    come = ten_more / (_BURST - 1)
    return come, one - come, contacts


def _ages(board: Design, cells: FloatArray, cycles: int) -> tuple[list[float], int, int]:
    """Ages in s, frames skipped, and frames in no count, of a reader who works between two frames."""
    ages, skipped, known = [], 0, 0
    sequence = -1
    skin, port = _opened(board, cells, int(_ROOM * cycles * WORK_S * RATE_HZ))
    with skin:
        for _ in range(cycles):
            port.work(WORK_S)
            frame = skin.latest(inf)
            ages.append(frame.age)
            skipped += frame.skipped_before
            known += frame.skipped_before + (frame.lost_before or 0) + (not frame.repeated)
            sequence = frame.sequence or 0
    return ages[10:], skipped, sequence + 1 - known
