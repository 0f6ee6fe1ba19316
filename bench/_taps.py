"""Detection of short taps against false alarms: contacts of a skin that is tapped, and of one with bad contacts.

Two streams of frames are made of each board, and read through a whole :class:`ohmskin.driver.Skin`, which is tared:

* fingertips and a stylus tap at random places for 30 to 150 ms. A tap is found if a contact shows near it while it
  lasts, or within two frames after it;
* nothing touches the skin, but its electrical contacts fail at random: of one cell, of a line's connection, or several
  readings in a row in one frame, as a motor disturbs them. Each contact that shows is a false alarm.
"""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from ..cell import Cell
from ..circuits import Design
from ..common.arrays import FloatArray
from ..driver import Contact, Skin
from ..errors import InputError
from ._driver import OnBoard, described, design, quantised
from ._paced_port import PacedPort, frame_packets
from .harness import column

CASES: tuple[tuple[str, str, int, float], ...] = (
    ("inverting-amplifier", "ground", 12, 1.0),
    ("inverting-amplifier", "ground", 12, 10.0),
    ("inverting-amplifier", "ground", 8, 1.0),
    ("voltage-divider", "ground", 12, 1.0),
    ("voltage-divider", "ground", 8, 1.0),
    ("voltage-divider", "ground", 8, 4.0),
    ("voltage-divider", "float", 12, 1.0),
    ("voltage-divider", "float", 8, 4.0),
)
"""circuit, idle rows, ADC bits, mV of noise"""
SIZES = (8, 16)
RATES_HZ = (100.0, 1000.0)
DURATIONS_S = (0.03, 0.05, 0.08, 0.15)
WIDTHS_CELLS = (0.35, 0.6, 0.9)
"""standard deviations of the bells that press: a stylus, a small and a large fingertip"""
REST_S = 0.6
"""before the first event"""
TARE_FRAMES = 20
EVERY_S = 0.4
"""from one event to the next"""
RISE_S = 0.01
"""of a tap, and its fall; a third of the tap if that is less"""
SUBSTEPS = 4
"""in which a frame's load is simulated"""
CELL_VARIANCE = 1.0 / 12.0
"""of the width of a cell: the mean of a bell over a cell is nearly a bell that is wider by as much"""
NEAR_CELLS = 1.0
"""distance of a contact from its tap"""


@dataclass(frozen=True)
class Tap:
    """A bell of pressure that comes and goes."""

    start_s: float
    duration_s: float
    row: float
    column: float
    width_cells: float
    peak_kpa: float

    def kpa(self, time_s: FloatArray, shape: tuple[int, int]) -> FloatArray:
        """(n, rows, columns) pressure at times (n,)."""
        rise = min(RISE_S, self.duration_s / 3.0)
        corners = self.start_s + np.array([0.0, rise, self.duration_s - rise, self.duration_s])
        share = np.interp(time_s, corners, [0.0, 1.0, 1.0, 0.0])
        shape_of = bell(np.array([[self.row, self.column]]), self.width_cells**2 + CELL_VARIANCE, shape)
        return np.asarray(self.peak_kpa * share[:, None, None] * np.where(shape_of < 1e-3, 0.0, shape_of))


def bell(place: FloatArray, variance: float, shape: tuple[int, int]) -> FloatArray:
    """(n, rows, columns) share of its peak, of a pressure whose middle is at (n, 2) rows and columns."""
    row, column = np.indices(shape)
    away = (row - place[:, 0, None, None]) ** 2 + (column - place[:, 1, None, None]) ** 2
    return np.asarray(np.exp(-away / (2.0 * variance)))


def times_of(seconds: float, rate_hz: float, substeps: int = SUBSTEPS) -> FloatArray:
    """Times (n,) in s of the steps in which a load is simulated."""
    return np.arange(1.0, round(seconds * rate_hz) * substeps + 1) / (substeps * rate_hz)


def read(kpa: FloatArray, rate_hz: float, substeps: int = SUBSTEPS) -> FloatArray:
    """(frames, rows, columns) ohm of example cells, under loads at :func:`times_of`."""
    dt_s = np.full(len(kpa), 1.0 / (substeps * rate_hz))
    ohm: FloatArray = Cell.example().forward(kpa.shape[1:]).run(dt_s, kpa)[substeps - 1 :: substeps]
    return ohm


HEAD = (
    "contacts of taps, % found by duration and by width of the bell in cells; median force over the tap's, and "
    "median distance from its centre of pressure; contacts elsewhere; contacts that faults made without any touch, "
    "of so many faults"
)


@dataclass(frozen=True)
class Taps(OnBoard):
    """One board at one frame rate."""

    noise_mv: float = field(metadata=column("noise, mV", "{:g}"))
    rate_hz: float = field(metadata=column("frames/s", "{:.0f}"))
    found: dict[float, float] = field(metadata=column("{:g} s", "{:.0f}", unit=0.01))
    """share of the taps of each duration in s that a contact was found of"""
    found_by_width: dict[float, float] = field(metadata=column("{:g}", "{:.0f}", unit=0.01))
    """the same by the width of the bell in cells"""
    delay_ms: float = field(metadata=column("delay, ms", "{:.0f}"))
    """median time from the beginning of a tap to the first frame with its contact"""
    force_share: float = field(metadata=column("force", "{:.2f}"))
    """median force of a contact over that of its tap, while the tap is held"""
    off_cells: float = field(metadata=column("off, cells", "{:.2f}"))
    """median distance of a contact from its tap's centre of pressure"""
    beside: int = field(metadata=column("elsewhere", "{}"))
    """contacts at other places or times in the stream of taps"""
    false: dict[str, int] = field(metadata=column("{}", "{}"))
    """false contacts by kind of fault"""
    faults: dict[str, int] = field(metadata=column("of", "{}"))
    """number of faults of each kind"""


def random_taps(number: int, shape: tuple[int, int], rng: np.random.Generator) -> list[Tap]:
    """Taps of every duration and width in turn, at random places, with 20 to 80 % of the example cell's full scale."""
    full = Cell.example().full_scale_kpa
    kinds = list(product(DURATIONS_S, WIDTHS_CELLS))
    taps = []
    for k in range(number):
        duration, width = kinds[k % len(kinds)]
        row, column = rng.uniform(0.0, np.array(shape) - 1.0).tolist()
        start = REST_S + EVERY_S * k + rng.uniform(0.0, 0.02)
        taps.append(Tap(start, duration, row, column, width, full * rng.uniform(0.2, 0.8)))
    return taps


def resistances(taps: Iterable[Tap], shape: tuple[int, int], rate_hz: float, seconds: float) -> FloatArray:
    """(frames, rows, columns) ohm of example cells that are tapped."""
    fine = times_of(seconds, rate_hz)
    kpa = np.zeros((len(fine), *shape))
    for tap in taps:
        during = slice(*np.searchsorted(fine, [tap.start_s, tap.start_s + tap.duration_s]))
        kpa[during] += tap.kpa(fine[during], shape)
    return read(kpa, rate_hz)


FAULTS = ("cell", "line", "impulse")


def add_faults(ohm: FloatArray, rate_hz: float, rng: np.random.Generator) -> list[tuple[str, float]]:
    """Let electrical contacts fail, one every :data:`EVERY_S`; changes ``ohm`` (frames, rows, columns).

    Returns:
        Kind and time in s of each.

    """
    rows, columns = ohm.shape[1:]
    seconds = len(ohm) / rate_hz
    faults = []
    for k, start in enumerate(np.arange(REST_S, seconds - EVERY_S, EVERY_S).tolist()):
        kind = FAULTS[0] if k % 2 == 0 else FAULTS[1 + k // 2 % 2]
        first = round(start * rate_hz)
        last = max(round((start + rng.uniform(0.002, 0.09)) * rate_hz), first + 1)
        i, j = int(rng.integers(rows)), int(rng.integers(columns))
        factor = rng.uniform(1.1, 3.0)
        if kind == "cell":
            ohm[first:last, i, j] *= np.inf if rng.random() < 0.2 else factor
        elif kind == "line" and rng.random() < 0.5:
            ohm[first:last, i, :] *= factor
        elif kind == "line":
            ohm[first:last, :, j] *= factor
        else:
            ohm[first, i, j : j + 3] *= factor
        faults.append((kind, start))
    return faults


def contacts_of(
    board: Design, ohm: FloatArray, noise_mv: float, rate_hz: float, rng: np.random.Generator
) -> Iterator[tuple[float, tuple[Contact, ...]]]:
    """Time in s and contacts of each frame (frames, rows, columns) of a skin that is tared at the beginning."""
    packets = frame_packets(quantised(board, ohm, 1e-3 * noise_mv, rng), rate_hz)
    port = PacedPort(packets, 1e-3, board)
    port.work(10.0 + 1e-3 * len(packets))  # all frames have come
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # few valid cells
        with Skin(port, design=board, cell=Cell.example(), delivery="lossless", timeout=60.0) as skin:
            with contextlib.suppress(InputError):  # no cell is valid
                skin.tare(TARE_FRAMES)
            for n in range(TARE_FRAMES, len(packets)):
                yield n / rate_hz, skin.read(60.0).contacts


def taps_and_faults(
    sizes: Iterable[int] = SIZES,
    rates_hz: Iterable[float] = RATES_HZ,
    *,
    cases: Iterable[tuple[str, str, int, float]] = CASES,
    spread: float = 0.0,
    number: int = 24,
    seed: int = 0,
) -> Iterator[Taps]:
    """Measure boards, each with so many taps and faults.

    Args:
        sizes: of N x N arrays.
        rates_hz: frames per second.
        cases: boards as in :data:`CASES`.
        spread: standard deviation of the logarithm of the cells' rest resistances. Equal cells all stand at the same
            place within an ADC step, so that their roundings add up in a column of a divider.
        number: of taps, and of faults.
        seed: of taps, faults, noise and cells.

    """
    for size, rate_hz, (circuit, idle_rows, bits, noise_mv) in product(sizes, rates_hz, cases):
        board = design(size, circuit, idle_rows, bits)
        shape, rng = board.array.shape, np.random.default_rng(seed)
        taps = random_taps(number, shape, rng)
        seconds = REST_S + EVERY_S * (number + 1)
        factor = np.exp(spread * np.random.default_rng((seed, size)).standard_normal(shape))
        ohm = factor * resistances(taps, shape, rate_hz, seconds)
        seen = list(contacts_of(board, ohm, noise_mv, rate_hz, rng))
        first_s, beside = match(taps, seen, 1e3 * _pitch_m(board), 1.0 / rate_hz)
        quiet = factor * resistances([], shape, rate_hz, seconds)
        faults = add_faults(quiet, rate_hz, rng)
        false = false_alarms(faults, contacts_of(board, quiet, noise_mv, rate_hz, rng))
        force_share, off_cells = accuracy(taps, seen, shape, 1e3 * _pitch_m(board))
        delays = [first - tap.start_s for tap, first in zip(taps, first_s, strict=True) if first < np.inf]
        yield Taps(
            *described(board),
            noise_mv=noise_mv,
            rate_hz=rate_hz,
            found={one: _share(first_s, [tap.duration_s == one for tap in taps]) for one in DURATIONS_S},
            found_by_width={one: _share(first_s, [tap.width_cells == one for tap in taps]) for one in WIDTHS_CELLS},
            delay_ms=1e3 * float(np.median(delays)) if delays else np.nan,
            force_share=force_share,
            off_cells=off_cells,
            beside=beside,
            false=false,
            faults={kind: sum(kind == one for one, _ in faults) for kind in FAULTS},
        )


def _pitch_m(board: Design) -> float:
    return board.sheet.pitch if board.sheet.pitch else 1.0


def _share(first_s: list[float], which: list[bool]) -> float:
    found = [first < np.inf for first, one in zip(first_s, which, strict=True) if one]
    return float(np.mean(found)) if found else np.nan


def match(
    taps: list[Tap], seen: list[tuple[float, tuple[Contact, ...]]], pitch_mm: float, frame_s: float
) -> tuple[list[float], int]:
    """When the contact of each tap was seen first, in s, infinite if never; and the number of contacts elsewhere."""
    first_s = [np.inf] * len(taps)
    own, others = set[int](), set[int]()
    for time_s, contacts in seen:
        near = [
            k for k, tap in enumerate(taps) if tap.start_s <= time_s <= tap.start_s + tap.duration_s + 2.01 * frame_s
        ]
        for contact in contacts:
            row, column = contact.y_mm / pitch_mm, contact.x_mm / pitch_mm
            fits = [k for k in near if np.hypot(taps[k].row - row, taps[k].column - column) < NEAR_CELLS]
            for k in fits:
                first_s[k] = min(first_s[k], time_s)
            (own if fits else others).add(contact.id)
    return first_s, len(others - own)


def accuracy(
    taps: list[Tap], seen: list[tuple[float, tuple[Contact, ...]]], shape: tuple[int, int], pitch_mm: float
) -> tuple[float, float]:
    """Median force over that of the tap, and median distance from its centre of pressure in cells; NaN without any."""
    row, column = np.indices(shape)
    force_shares, off_cells = [], []
    for time_s, contacts in seen:
        for tap in taps:
            if not tap.start_s + RISE_S <= time_s <= tap.start_s + tap.duration_s - RISE_S:
                continue
            (kpa,) = tap.kpa(np.array([time_s]), shape)
            total = float(kpa.sum())
            centre = float((row * kpa).sum()) / total, float((column * kpa).sum()) / total
            off = [math.dist(centre, (one.y_mm / pitch_mm, one.x_mm / pitch_mm)) for one in contacts]
            if off and min(off) < NEAR_CELLS:
                force_n = contacts[int(np.argmin(off))].force_n
                force_shares.append(force_n / (1e3 * total * (1e-3 * pitch_mm) ** 2))
                off_cells.append(min(off))
    return (float(np.median(force_shares)), float(np.median(off_cells))) if off_cells else (np.nan, np.nan)


def false_alarms(faults: list[tuple[str, float]], seen: Iterable[tuple[float, tuple[Contact, ...]]]) -> dict[str, int]:
    """Number of contacts by the kind of the last fault before they began; "none": before any."""
    found, known = dict.fromkeys(("none", *FAULTS), 0), set[int]()
    for time_s, contacts in seen:
        kinds = [kind for kind, start_s in faults if start_s <= time_s + 1e-9]
        for contact in contacts:
            if contact.id not in known:
                known.add(contact.id)
                found[kinds[-1] if kinds else "none"] += 1
    return found
