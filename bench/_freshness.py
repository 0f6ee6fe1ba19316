"""Age of the newest frame for a slow reader of a skin.

The skin reads a port in memory, whose clock is the processor time of this process plus the time that the reader works.
So the ages are those of a core that has nothing else to do, however loaded this machine is; what an operating system
and a line add is left out (``examples/link_latency.py`` measures a real port).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from math import inf

import numpy as np

from ..cell import Cell
from ..driver import Skin
from ._driver import design, packets_of, pressed
from ._paced_port import PacedPort
from .harness import column

RATE_HZ = 1000.0
WORK_S = 0.0104
"""the reader's work in each cycle: 10 ms, and not a multiple of the board's period"""
CYCLES = 150
_FRAMES = 200  # different ones; they repeat
_ROOM = 4  # times as many packets as the work alone needs, for slow machines


HEAD = f"age in frames of the newest one of a skin at {RATE_HZ:g} Hz, for a reader with 10 ms of work per cycle"


@dataclass(frozen=True)
class Freshness:
    """One size, on a board with inverting amplifiers and 12 bits."""

    size: int = field(metadata=column("cells", "{0} x {0}"))
    """of the N x N array"""
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
        cells = pressed(board.array.shape, _FRAMES)[1]
        packets = packets_of(board, cells, frames=int(_ROOM * cycles * WORK_S * RATE_HZ), rate_hz=RATE_HZ)
        port = PacedPort(packets, 1.0 / RATE_HZ, board)
        ages, skipped, known, sequence = [], 0, 0, -1
        with Skin(port, design=board, cell=Cell.example(), timeout=60.0) as skin:
            for _ in range(cycles):
                port.work(WORK_S)
                frame = skin.latest(inf)
                ages.append(frame.age)
                skipped += frame.skipped_before
                known += frame.skipped_before + (frame.lost_before or 0) + (not frame.repeated)
                sequence = frame.sequence or 0
        in_frames = RATE_HZ * np.array(ages[10:])
        yield Freshness(size, float(np.median(in_frames)), float(in_frames.max()), skipped, sequence + 1 - known)
