"""The live path: bytes to ohms to kPa, frames per second of processor time, worst frame, and error.

A scene of fingers that wander over a skin is turned into packets beforehand, with the board's own noise and ADC. A
reader of a :class:`ohmskin.driver.Skin` then takes every frame with its validity, pressure and standard deviation, from
a port in memory, and waits for each. The processor time of that is what frames per second are stated from.

The same packets go through the stages alone: packets (:mod:`ohmskin.wire`), counts to ohms
(:class:`ohmskin.driver.CountReader`), ohms to kPa (an estimator of the cell). Standard deviations and contacts are
computed when the reader asks for them. The rest is the skin's: numbering and timing of frames, and hand-over between
threads.

:func:`driver` goes through the boards, with the default estimator; :func:`live_estimators` through the estimators, on
one kind of board. :func:`freshness` states the age of the newest frame.
"""

from __future__ import annotations

import contextlib
import gc
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from math import inf
from time import process_time
from types import MappingProxyType
from typing import Any

import numpy as np

from ..cell import ESTIMATORS, Cell, Estimator, rehearsed
from ..circuits import Design, adc_codes, scan_batch
from ..common import compiled
from ..common.arrays import BoolArray, CodeArray, FloatArray
from ..driver import CountReader, Frame, Skin
from ..errors import InputError
from ..wire import FramePacket, host_protocol
from ._paced_port import PacedPort, frame_packets
from .harness import column

FRAMES = 400
FRAME_RATE_HZ = 200.0
NOISE_STEPS = 0.5
"""standard deviation of the outputs' noise in ADC steps"""
LARGEST_SIDE = 256
"""side of the largest array that is driven"""
HARD_OHM = 5.0
"""of cells that are held at a short, so that their outputs saturate"""
CASES: tuple[tuple[str, str, int, int], ...] = (
    ("inverting-amplifier", "ground", 12, 0),
    ("inverting-amplifier", "ground", 12, 7),
    ("inverting-amplifier", "ground", 8, 0),
    ("row-amplifier", "ground", 12, 0),
    ("voltage-feedback", "ground", 12, 0),
    ("voltage-feedback", "ground", 12, 7),
    ("voltage-divider", "ground", 8, 0),
    ("voltage-divider", "ground", 10, 0),
    ("voltage-divider", "ground", 10, 7),
    ("voltage-divider", "float", 10, 0),
    ("inverting-amplifier", "float", 12, 0),
)
"""circuit, idle rows, ADC bits, saturated cells"""
APART_S = 1.0 / FRAME_RATE_HZ  # from packet to packet on the port's own clock, as on the board's
FRESH_HZ, WORK_S, CYCLES = 1000.0, 0.0104, 150
"""of the board whose newest frame is wanted; work of its reader in each cycle, no multiple of the period; cycles"""
FRESH_FRAMES, SPARE = 200, 4
"""different frames, which repeat; times as many packets as the work alone needs, for slow machines"""
LARGEST_FLOATING = 32  # side beyond which boards with floating rows are left out: minutes


HEAD = (
    "frames per second of processor time on one core that a reader of a skin gets, bytes to kPa with standard "
    "deviations; worst frame in medians; errors of valid cells"
)


@dataclass(frozen=True)
class OnBoard:
    """Which board was measured."""

    size: int = field(metadata=column("cells", "{0} x {0}"))
    """of the N x N array"""
    circuit: str = field(metadata=column("circuit", "{}", width=18))
    idle_rows: str = field(metadata=column("idle", "{}", width=6))
    bits: int = field(metadata=column("bits", "{}"))


@dataclass(frozen=True)
class Row(OnBoard):
    """One board."""

    saturated_cells: int = field(metadata=column("saturated", "{}"))
    estimator: str = field(metadata=column("estimator", "{}", width=9))
    is_default: bool = field(metadata=column("default"))
    """the estimator that a skin of this cell takes by itself"""
    frames_per_second: float = field(metadata=column("frames/s", "{:.0f}"))
    """per second of processor time: what a reader of a skin gets who takes every frame and its standard deviations"""
    decode_us: float = field(metadata=column("decode", "{:.0f}"))
    """median per frame"""
    ohms_us: float = field(metadata=column("ohms", "{:.0f}"))
    kpa_us: float = field(metadata=column("kPa", "{:.0f}"))
    std_us: float = field(metadata=column("std", "{:.0f}"))
    """standard deviations, which are computed when the reader asks for them"""
    skin_us: float = field(metadata=column("skin us", "{:.0f}"))
    """the rest of what the reader waits for"""
    contacts_us: float = field(metadata=column("contacts", "{:.0f}"))
    """besides, of a reader who asks for contacts"""
    worst_frame: float = field(metadata=column("worst", "{:.1f}"))
    """processor time of the slowest frame through the skin, in medians; the first ten frames are left out"""
    valid_percent: float = field(metadata=column("valid, %", "{:.1f}"))
    """of the cells"""
    worst_ohm_error_percent: float = field(metadata=column("ohm error, %", "{:.2f}"))
    """of a valid cell, relative to its own resistance"""
    rmse_kpa: float = field(metadata=column("RMSE", "{:.3f}"))
    """of valid cells"""
    worst_kpa: float = field(metadata=column("worst kPa", "{:.2f}"))
    """of a valid cell in any frame"""

    @property
    def shares(self) -> tuple[float, ...]:
        """Of a usual frame's time: packets, counts to ohms, ohms to kPa, standard deviations, the rest of the skin."""
        stages = self.decode_us, self.ohms_us, self.kpa_us, self.std_us, self.skin_us
        return tuple(part / sum(stages) for part in stages)


def driver(sizes: Iterable[int], *, frames: int = FRAMES) -> Iterator[Row]:
    """Measure boards of every size in :data:`CASES`."""
    for size in sizes:
        for circuit, idle_rows, bits, saturated in CASES:
            if saturated > size * size:
                continue
            if size <= LARGEST_FLOATING or idle_rows == "ground":
                yield _measured(design(size, circuit, idle_rows, bits), Cell.example(), None, saturated, frames)


def live_estimators(sizes: Iterable[int], *, learned: bool = True, frames: int = FRAMES) -> Iterator[Row]:
    """Measure every estimator that the cell has at every size, on boards with inverting amplifiers and 12 bits.

    Args:
        sizes: of the N x N arrays.
        learned: calibrate the example cell first by the 272 s protocol with noise, for the estimators that learn. This
            takes about 15 s. False: those that follow from the data sheet.
        frames: that are measured.

    """
    cell = rehearsed(Cell.example()) if learned else Cell.example()
    for size in sizes:
        for name in ESTIMATORS:
            try:
                cell.estimator((1, 1), name)
            except InputError:
                continue  # not for this cell
            yield _measured(design(size, "inverting-amplifier", "ground", 12), cell, name, 0, frames)


def design(
    size: int,
    circuit: str,
    idle_rows: str,
    bits: int,
    *,
    columns: int | None = None,
    array: Mapping[str, float] = MappingProxyType({}),
    readout: Mapping[str, Any] = MappingProxyType({}),
) -> Design:
    """A board for the shipped example cell, which rises from 10 kohm when pressed.

    Args:
        size: rows.
        circuit: of the readout.
        idle_rows: as in a design.
        bits: of the converter.
        columns: as many as rows unless given.
        array: keys of the array beside 5 ohm of each lead.
        readout: keys of the readout that are not as usual.

    Raises:
        InputError: the size is no array's, or too large.

    """
    if not 1 <= size <= LARGEST_SIDE:
        raise InputError(f"size is {size}; expected 1 to {LARGEST_SIDE}")
    amplified = circuit.endswith("amplifier")
    parts: dict[str, Any] = {"circuit": circuit, "reference_resistance": 20e3 if amplified else 5e3}
    if circuit != "voltage-divider":
        parts |= {"open_loop_gain": 1e5, "supply": [-0.1, 3.3]}
    return Design.model_validate(
        {
            "array": {"rows": size, "columns": columns or size, "row_lead": 5.0, "column_lead": 5.0, **array},
            "drive": {"voltage": -1.0 if amplified else 3.3, "idle_rows": idle_rows},
            "readout": {**parts, **readout},
            "adc": {"bits": bits, "range": [0.0, 3.3]},
        }
    )


def described(board: Design) -> tuple[int, str, str, int]:
    """The fields of :class:`OnBoard`."""
    return board.array.rows, board.readout.circuit, board.drive.idle_rows, board.adc.bits if board.adc else 0


def _measured(board: Design, cell: Cell, name: str | None, saturated: int, frames: int) -> Row:
    pressure, cells = pressed(board.array.shape, frames)
    if saturated:
        places = np.random.default_rng(1).choice(cells[0].size, saturated, replace=False)
        cells.reshape(frames, -1)[:, places] = HARD_OHM
    packets = packets_of(board, cells)
    decode_s, ohms_s, kpa_s = np.median(_stages(packets, board, cell.estimator(board.array.shape, name)), axis=0)
    read: list[tuple[FloatArray, BoolArray, FloatArray]] = []
    times = np.empty((frames, 2))
    for number, (frame, *spent) in enumerate(taken(packets, board, cell, name)):
        read.append((frame.resistance, frame.valid, frame.pressure))
        times[number] = spent
    asking = taken(packets, board, cell, name, ask=lambda frame: (frame.pressure_std, frame.contacts))
    with_contacts = np.array([sum(spent) for _, *spent in asking])
    whole, std_s = times.sum(axis=1), float(np.median(times[:, 1]))
    usual = float(np.median(whole))
    found_ohm, valid, found_kpa = (np.array(part) for part in zip(*read, strict=True))
    off_ohm = np.abs(found_ohm / cells - 1.0)[valid]
    off_kpa = (found_kpa - pressure)[valid]
    return Row(
        *described(board),
        saturated_cells=saturated,
        estimator=name or cell.default_estimator,
        is_default=name in (None, cell.default_estimator),
        frames_per_second=frames / float(whole.sum()),
        decode_us=1e6 * decode_s,
        ohms_us=1e6 * ohms_s,
        kpa_us=1e6 * kpa_s,
        std_us=1e6 * std_s,
        skin_us=1e6 * max(usual - decode_s - ohms_s - kpa_s - std_s, 0.0),
        contacts_us=1e6 * max(float(np.median(with_contacts)) - usual, 0.0),
        worst_frame=float(whole[10:].max()) / usual,
        valid_percent=100.0 * float(valid.mean()),
        worst_ohm_error_percent=100.0 * float(off_ohm.max(initial=0.0)),
        rmse_kpa=float(np.sqrt(np.mean(off_kpa**2))) if off_kpa.size else np.nan,
        worst_kpa=float(np.abs(off_kpa).max(initial=0.0)),
    )


def _stages(packets: list[bytes], board: Design, estimator: Estimator) -> FloatArray:
    """(frames, 3) processor time in s of each frame's packet, counts to ohms, and ohms to kPa."""
    decode, read, times = host_protocol("ohmskin"), CountReader(board), np.empty((len(packets), 3))
    with _old_objects_kept():
        for number, packet in enumerate(packets):
            start = process_time()
            (event,) = decode.feed(packet, number / FRAME_RATE_HZ)
            assert isinstance(event, FramePacket)
            decoded = process_time()
            reading = read(event.counts)
            solved = process_time()
            estimator.update(1.0 / FRAME_RATE_HZ if number else 0.0, reading)
            times[number] = decoded - start, solved - decoded, process_time() - solved
    return times


def taken(
    packets: list[bytes],
    board: Design,
    cell: Cell,
    name: str | None = None,
    *,
    ask: Callable[[Frame], object] = lambda frame: frame.pressure_std,
) -> Iterator[tuple[Frame, float, float]]:
    """Every frame that a reader of a skin gets of these packets, with two processor times in s.

    The first is that of taking it, the second that of what ``ask`` wants to know of it.
    """
    port = port_of(packets, board)
    with every_frame(port, board, cell, name) as skin, _old_objects_kept():
        for _ in packets:
            port.work(APART_S)  # the next frame comes
            start = process_time()
            frame = skin.read(0.0)
            came = process_time()
            ask(frame)
            yield frame, came - start, process_time() - came


@contextlib.contextmanager
def _old_objects_kept() -> Iterator[None]:
    """Keep Python's garbage collector from what is there already, as ``docs/notes/latency.md`` advises.

    A look at all that Numba and SciPy have loaded takes as long as a thousand frames, and falls into one by chance.
    A program that has kept objects from it before keeps them: they cannot be told from those that are kept here.
    """
    kept_before = gc.get_freeze_count() > 0
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        if not kept_before:
            gc.unfreeze()


def port_of(packets: list[bytes], board: Design) -> PacedPort:
    """A port whose clock stands while a frame is worked on, so that its packets come as regularly as they were sent."""
    return PacedPort(packets, (1.0 - 1e-9) * APART_S, board, clock=float)


@contextlib.contextmanager
def every_frame(port: PacedPort, board: Design, cell: Cell, name: str | None) -> Iterator[Skin]:
    """A skin of whose frames the reader takes every one, with all kernels loaded, as of one that is opened by name."""
    compiled.load()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # that hardly a cell is valid is in the table
        with Skin(port, design=board, cell=cell, estimator=name, delivery="every", timeout=60.0) as skin:
            yield skin


def pressed(shape: tuple[int, int], frames: int) -> tuple[FloatArray, FloatArray]:
    """kPa and ohm (frames, rows, columns): five fingers that wander about the example cell and press more and less."""
    cell = Cell.example()
    random = np.random.default_rng(0)
    row, column = np.indices(shape)
    place, way = random.uniform(0.0, 1.0, (5, 2)) * shape, random.uniform(-1.0, 1.0, (5, 2))
    frequency_hz = random.uniform(0.3, 1.5, 5)
    time_s = np.arange(frames) / FRAME_RATE_HZ
    pressure = np.zeros((frames, *shape))
    for start, direction, frequency in zip(place, way, frequency_hz, strict=True):
        at = start + direction * time_s[:, None]
        away = (row - at[:, :1, None]) ** 2 + (column - at[:, 1:, None]) ** 2
        strength_kpa = 5.0 * (1.0 - np.cos(2.0 * np.pi * frequency * time_s))
        pressure += strength_kpa[:, None, None] * np.exp(-away / 2.0)
    pressure[pressure < 0.05] = 0.0
    forward = cell.forward(shape)
    cells = np.array([forward.step(1.0 / FRAME_RATE_HZ, kpa) for kpa in pressure])
    return pressure, cells


def packets_of(
    board: Design, cells: FloatArray, *, frames: int | None = None, rate_hz: float = FRAME_RATE_HZ
) -> list[bytes]:
    """The board's packets at so many frames a second.

    Args:
        board: with an ADC.
        cells: (frames, rows, columns) ohm.
        frames: number of packets; beyond ``cells``, these are repeated. None: one for each.
        rate_hz: of the packets.

    """
    codes = counts_of(board, cells)
    return frame_packets((codes[k % len(codes)] for k in range(len(codes) if frames is None else frames)), rate_hz)


def counts_of(board: Design, cells: FloatArray) -> CodeArray:
    """(frames, rows, columns) counts of such cells in ohm, with noise of :data:`NOISE_STEPS`."""
    assert board.adc is not None
    return quantised(board, cells, NOISE_STEPS * board.adc.step, np.random.default_rng(2))


def quantised(board: Design, cells: FloatArray, noise_v: float, random: np.random.Generator) -> CodeArray:
    """(frames, rows, columns) counts of such cells in ohm, with white noise of the outputs."""
    volts = scan_batch(board, cells).volts
    return adc_codes(board, volts + random.normal(scale=noise_v, size=volts.shape))


AGES = f"age in frames of the newest one of a skin at {FRESH_HZ:g} Hz, for a reader with 10 ms of work per cycle"


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
    """Age of the newest frame for a slow reader of a skin, at every size.

    The port's clock is the processor time of this process plus the time that the reader works: the ages are those of a
    core that has nothing else to do, however loaded this machine is. What an operating system and a line add is left
    out (``examples/link_latency.py`` measures a real port).
    """
    for size in sizes:
        board = design(size, "inverting-amplifier", "ground", 12)
        cells = pressed(board.array.shape, FRESH_FRAMES)[1]
        packets = packets_of(board, cells, frames=int(SPARE * cycles * WORK_S * FRESH_HZ), rate_hz=FRESH_HZ)
        port = PacedPort(packets, 1.0 / FRESH_HZ, board)
        ages, skipped, known, sequence = [], 0, 0, -1
        with Skin(port, design=board, cell=Cell.example(), timeout=60.0) as skin:
            for _ in range(cycles):
                port.work(WORK_S)
                frame = skin.latest(inf)
                ages.append(frame.age)
                skipped += frame.skipped_before
                known += frame.skipped_before + (frame.lost_before or 0) + (not frame.repeated)
                sequence = frame.sequence or 0
        in_frames = FRESH_HZ * np.array(ages[10:])
        yield Freshness(size, float(np.median(in_frames)), float(in_frames.max()), skipped, sequence + 1 - known)
