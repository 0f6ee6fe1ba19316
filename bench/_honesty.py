"""Honesty of the stated standard deviation (calibration of uncertainty): errors over deviations, load by load.

``ohmskin bench --estimators`` prints the tables. An honest deviation has 95 % of all errors within two deviations, and
none much beyond three. The load of a cell is simulated in steps shorter than a frame, so that it may turn, begin and
end between two frames. No estimator is told of that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Literal

import numpy as np

from ..cell import (
    AsymmetricModel,
    Cell,
    ContactModel,
    M10Model,
    PaperModel,
    calibrate,
    checked_recording,
    protocol_load,
)
from ..common.arrays import BoolArray, FloatArray

CELLS = 8
RATE_HZ = 100.0
SECONDS = 16.0
VOLTS_AT_REST = 2.0
"""of an amplifier with 3.3 V and 12 bit"""
BEGUN_S = 0.5
"""time before which nothing is judged: the noise is not known yet"""
NOISES_MV = (0.1, 1.0, 10.0)
RATES_HZ = (50.0, 250.0, 1000.0)
MOST_FRAMES = 6000
"""of a scene: fast boards are judged for less time"""
BITS = 12
LEAST_ERROR = 1e-4
"""of full scale: no smaller error is what a width is stated over"""
CLEAR_STD_PERCENT = 1.0
"""median deviation, % of full scale, from which a load may be named as the one with the widest"""
SUBSTEPS = 4
"""in which a frame is simulated"""
Load = Literal[
    "rest",
    "hold",
    "edge",
    "press",
    "slow ramp",
    "fast ramp",
    "sine",
    "taps",
    "stairs",
    "quick taps",
    "short taps",
    "drumming",
    "vibration",
    "slip",
    "random",
    "finger",
]
Fault = Literal["", "sparks", "lost frames", "opens"]
Case = tuple[Load, Fault]


@dataclass(frozen=True)
class Honesty:
    """The default estimator under one load; all cells and samples of a run."""

    cell: str
    load: str
    noise_mv: float
    rate_hz: float
    bits: int
    rmse_percent: float
    """of full scale"""
    std_percent: float
    """median of the stated deviations, of full scale"""
    width: float
    """mean of the stated deviations over the root mean square of the errors: 1 where they are neither too small nor too
    wide. The least deviation of half a percent makes it large where hardly anything is wrong"""
    within_two: float
    """share of errors within two deviations"""
    beyond_three: float
    """share of errors beyond three"""
    worst: float
    """largest error over its deviation"""
    rest_kpa: float
    """largest load shown between the last two of twelve taps; NaN for other loads"""


_PRESS = [0.0, 1.0, 1.0, 0.0]
_RANDOM_S = 0.7 + np.cumsum(np.random.default_rng(5).exponential(0.5, 60))
_RANDOM = np.random.default_rng(6).choice([0.0, 0.0, 0.3, 0.6, 1.0], 60)
_RANDOM_RISE_S = 0.04


def _presses_at_random() -> tuple[FloatArray, FloatArray]:
    """Corners (120,) in s, in order, and loads there. A press that begins within the last one goes on from there."""
    ends_s = np.minimum(_RANDOM_S + _RANDOM_RISE_S, np.append(_RANDOM_S[1:], np.inf))
    load, loads = 0.0, []
    for start_s, end_s, level in zip(_RANDOM_S, ends_s, _RANDOM, strict=True):
        loads.append(load)
        share = (end_s - start_s) / _RANDOM_RISE_S
        load = level if share > 1 - 1e-9 else load + share * (level - load)  # a rounded load would be a turn
        loads.append(load)
    return np.stack([_RANDOM_S, ends_s], axis=1).ravel(), np.array(loads)


_RANDOM_PRESSES = _presses_at_random()


def _train(t: FloatArray, period_s: float, rise_s: float, hold_s: float) -> FloatArray:
    """Taps from 1 s to 8 s, one each period."""
    shape = np.interp((t - 1.0) % period_s, [0.0, rise_s, rise_s + hold_s, 2.0 * rise_s + hold_s], _PRESS)
    return np.asarray(shape * ((t > 1.0) & (t < 8.0)))


def _held(t: FloatArray) -> FloatArray:
    return np.asarray(np.interp(t, [1.0, 1.2, 9.0, 9.1], [0.0, 0.7, 0.7, 0.0]))


LOADS: dict[Load, Callable[[FloatArray, float], FloatArray]] = {
    "rest": lambda t, dt: 0.0 * t,
    "hold": lambda t, dt: np.interp(t, [0.5, 0.6], [0.0, 1.0]),
    "edge": lambda t, dt: np.interp(t, [2.0, 2.02], [0.0, 1.0]),
    "press": lambda t, dt: np.interp(t, [2.0, 2.2, 5.0, 5.2], _PRESS),
    "slow ramp": lambda t, dt: np.interp(t, [1.0, 7.0, 9.0, 13.0], _PRESS),
    "fast ramp": lambda t, dt: np.interp((t - 1.0) % 3.0, [0.0, 0.3, 1.5, 2.0], _PRESS) * (t > 1.0),
    "sine": lambda t, dt: 0.5 * (1.0 - np.cos(2.0 * np.pi * 0.7 * (t - 1.0))) * (t > 1.0),
    "taps": lambda t, dt: np.interp((t - 1.0) % 1.0, [0.0, 0.03, 0.5, 0.53], _PRESS) * ((t > 1.0) & (t < 13.0)),
    "stairs": lambda t, dt: np.interp(
        t, [1, 1.05, 3, 3.05, 5, 5.05, 7, 7.05, 9, 9.05], [0, 0.4, 0.4, 1, 1, 0.6, 0.6, 0.8, 0.8, 0]
    ),
    "quick taps": lambda t, dt: _train(t, 40 * dt, 1.2 * dt, 5 * dt),
    "short taps": lambda t, dt: _train(t, 20 * dt, 0.5 * dt, 2 * dt),
    "drumming": lambda t, dt: _train(t, 4 * dt, 0.5 * dt, 1.5 * dt) * ((t - 1.0) % 1.0 < 0.4),
    "vibration": lambda t, dt: _held(t) + 0.15 * np.sin(2.0 * np.pi * 0.28 / dt * t) * ((t > 3.0) & (t < 8.0)),
    "slip": lambda t, dt: _held(t) + 0.3 * (0.12 / dt * (t - 2.0) % 1.0) * ((t > 2.0) & (t < 6.0)),
    "random": lambda t, dt: np.interp(t, *_RANDOM_PRESSES),
}
"""share of the largest load at times in s, with the time between frames; the cells follow each other by up to 0.4 s, so
that edges are not in step. Quick and short taps last for six and three frames; drumming and vibration have about four
frames in a period, slip has eight"""


def pressures(load: Load, time_s: FloatArray, cells: int = CELLS, *, frame_s: float = 1.0 / RATE_HZ) -> FloatArray:
    """Normalised loads (n, cells): each cell another strength, every fourth one none; a finger rolls over all."""
    if load == "finger":
        place = -2.0 + (cells + 4.0) * (0.5 - 0.5 * np.cos(2.0 * np.pi * 0.15 * time_s))
        share: FloatArray = 0.8 * np.exp(-((place[:, None] - np.arange(cells)) ** 2) / 1.5)
        share[share < 0.005] = 0.0
        return share
    strength = np.linspace(0.25, 0.9, cells)
    strength[::4] = 0.0
    found: FloatArray = strength * LOADS[load](time_s[:, None] - np.linspace(0.0, 0.37, cells), frame_s)
    return found


def readings(
    cell: Cell,
    load: FloatArray,
    dt_s: float,
    noise_mv: float,
    random: np.random.Generator,
    bits: int = BITS,
    *,
    substeps: int = 1,
) -> FloatArray:
    """Ohm (n, cells) as a board reads normalised loads (n substeps, cells): white noise of volts, and an ADC.

    ``dt_s`` is the time between frames, of which each has so many ``substeps``.
    """
    ohm = cell.forward(load.shape[1:]).run(np.full(len(load), dt_s / substeps), load * cell.full_scale_kpa)
    ohm = ohm[substeps - 1 :: substeps]
    unit = _volts_per_siemens(cell, ohm)
    volts = unit / ohm + 1e-3 * noise_mv * random.standard_normal(ohm.shape)
    step = 3.3 / 2**bits
    read: FloatArray = unit / (np.maximum(np.round(volts / step), 1.0) * step)
    return read


def _volts_per_siemens(cell: Cell, ohm: FloatArray) -> float:
    """Of an amplifier that shows the least resistance as :data:`VOLTS_AT_REST`."""
    return VOLTS_AT_REST * min(cell.rest_resistance_ohm, float(ohm.min()))


def faulty(read: FloatArray, fault: Fault, dt_s: float) -> tuple[FloatArray, BoolArray]:
    """Readings with faults in them, and (n,) which frames arrive.

    A bad contact reads 2.5 times as much for 60 ms, every 2.9 s; three of ten frames are lost in the middle; cells open
    for half a second, and read some megohms as they do.
    """
    found, arrives = read.copy(), np.ones(len(read), dtype=np.bool_)
    seconds = len(read) * dt_s
    if fault == "sparks":
        for start in np.arange(2.6, seconds, 2.9):
            found[round(start / dt_s) : round((start + 0.06) / dt_s)] *= 2.5
    elif fault == "lost frames":
        middle = slice(round(0.3 * len(read)), round(0.6 * len(read)))
        arrives[middle] = np.random.default_rng(0).random(len(read[middle])) > 0.3
    elif fault == "opens":
        for cell, start in enumerate(seconds * np.linspace(0.19, 0.81, read.shape[1])):
            first, last = round(start / dt_s), round((start + 0.5) / dt_s)
            found[first, cell], found[first + 1 : last, cell] = 4e6, np.inf if cell % 2 else np.nan
    return found, arrives


def estimated(
    cell: Cell, read: FloatArray, arrives: BoolArray, dt_s: float, *, bits: int | None = None
) -> tuple[FloatArray, FloatArray]:
    """Pressure and standard deviation (n, cells) in kPa by the cell's default estimator; lost frames are NaN.

    ``bits``: tell the estimator of the converter's steps, as the driver does.
    """
    estimator = cell.estimator(read.shape[1:])
    estimator.compile()
    if bits is not None:
        step_std = 3.3 / 2**bits / np.sqrt(12) * read[0] / _volts_per_siemens(cell, read[read > 0])
        estimator.resolve(step_std, read[0])
    pressure, std = np.full((2, *read.shape), np.nan)
    last = -1
    for n in np.flatnonzero(arrives):
        pressure[n] = estimator.step((n - last) * dt_s, read[n])
        std[n] = estimator.std_kpa
        last = int(n)
    return pressure, std


def judged(
    cell: Cell,
    name: str,
    load: Load,
    noise_mv: float,
    *,
    fault: Fault = "",
    rate_hz: float = RATE_HZ,
    bits: int = BITS,
    seed: int = 0,
    believed: Cell | None = None,
) -> Honesty:
    """Errors of the default estimator over its deviations, under one load and one fault.

    ``believed`` is what calibration took the cell for; None: the cell itself.
    """
    (found,) = judged_together(
        cell, name, [(load, fault)], noise_mv, rate_hz=rate_hz, bits=bits, seed=seed, believed=believed
    )
    return found


def judged_together(
    cell: Cell,
    name: str,
    cases: Sequence[Case],
    noise_mv: float,
    *,
    rate_hz: float = RATE_HZ,
    bits: int = BITS,
    seed: int = 0,
    believed: Cell | None = None,
) -> list[Honesty]:
    """As :func:`judged`, of a skin with :data:`CELLS` cells for each of the cases, which are judged apart.

    Frames that are lost are lost for the whole skin, so that these cases have a skin of their own.
    """
    dt_s = 1.0 / rate_hz
    frames = min(round(SECONDS * rate_hz), MOST_FRAMES)
    fine_s, time_s = dt_s / SUBSTEPS * np.arange(1.0, frames * SUBSTEPS + 1), dt_s * np.arange(1.0, frames + 1)
    judged_s = time_s > max(BEGUN_S, 10.0 * dt_s)
    full = cell.full_scale_kpa
    found: dict[Case, Honesty] = {}
    for lost in (False, True):
        some = [case for case in cases if (case[1] == "lost frames") == lost]
        if not some:
            continue
        fine = np.concatenate([pressures(load, fine_s, frame_s=dt_s) for load, _ in some], axis=1)
        read = readings(cell, fine, dt_s, noise_mv, np.random.default_rng(seed), bits, substeps=SUBSTEPS)
        share = fine[SUBSTEPS - 1 :: SUBSTEPS]
        parts = [slice(first, first + CELLS) for first in range(0, share.shape[1], CELLS)]
        arrives = np.ones(frames, dtype=np.bool_)
        for (_, fault), part in zip(some, parts, strict=True):
            read[:, part], arrives = faulty(read[:, part], fault, dt_s)
        pressure, std = estimated(believed or cell, read, arrives, dt_s, bits=bits)
        kept = arrives & judged_s
        error = np.abs(pressure - full * share)
        over = error / std
        between = (time_s > 11.4) & (time_s < 12.37)
        for (load, fault), part in zip(some, parts, strict=True):
            shown = np.abs(pressure[between, part])[share[between, part] == 0.0] if load == "taps" else np.empty(0)
            found[load, fault] = Honesty(
                cell=name,
                load=load + (f", {fault}" if fault else ""),
                noise_mv=noise_mv,
                rate_hz=rate_hz,
                bits=bits,
                rmse_percent=100.0 * _rms(error[kept, part]) / full,
                std_percent=100.0 * float(np.median(std[kept, part])) / full,
                width=float(np.mean(std[kept, part])) / max(_rms(error[kept, part]), LEAST_ERROR * full),
                within_two=float(np.mean(over[kept, part] < 2.0)),
                beyond_three=float(np.mean(over[kept, part] > 3.0)),
                worst=float(over[kept, part].max()),
                rest_kpa=float(shown.max()) if shown.size else np.nan,
            )
    return [found[case] for case in cases]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def honesty(noises_mv: Iterable[float] = NOISES_MV) -> Iterator[Honesty]:
    """Every load, and every fault on a press, of the shipped example cell."""
    cell = Cell.example()
    for load, fault in _cases():
        for noise_mv in noises_mv:
            yield judged(cell, "example", load, noise_mv, fault=fault)


def _cases() -> list[Case]:
    faults: list[Fault] = ["sparks", "lost frames", "opens"]
    loads: list[Load] = [*LOADS, "finger"]
    return [(load, "") for load in loads] + [("press", fault) for fault in faults]


def uncalibrated() -> dict[str, Cell]:
    """Cells of every kind, other than the shipped one in R0, full scale and time constants."""
    own = PaperModel(
        eu1_kpa=100.0,
        etau2_kpa=500.0,
        eu2_kpa_per_s=250.0,
        e1_kpa=150.0,
        e2_kpa=400.0,
        e3_kpa=1200.0,
        eta2_kpa_s=2000.0,
        eta3_kpa_s=50000.0,
    )
    asymmetric = AsymmetricModel(e1_kpa=90.0, e2_kpa=200.0, e3_kpa=900.0, eta2_kpa_s=700.0, eta3_kpa_s=40000.0)
    m10 = M10Model(a=0.5, b=-0.1, alpha1=0.3, rise1_s=0.3, fall1_s=4.0, alpha2=0.1, fall2_s=90.0, k=0.1, tau_s=20.0)
    falling = ContactModel(exponent=1.1, full_scale_resistance_ohm=900.0)
    return {
        "paper": Cell(rest_resistance_ohm=2200.0, full_scale_kpa=60.0, model=own),
        "asymmetric": Cell(rest_resistance_ohm=47e3, full_scale_kpa=35.0, model=asymmetric),
        "m10": Cell(rest_resistance_ohm=5600.0, full_scale_kpa=150.0, model=m10),
        "contact": Cell(rest_resistance_ohm=3300.0, full_scale_kpa=20.0, model=falling),
    }


def specimens() -> dict[str, tuple[Cell, Cell]]:
    """Cells as they are and as they are believed to be: the same, or what the calibration protocol makes of them."""
    cells = uncalibrated()
    learned = {f"{name}, calibrated": (cells[name], calibrated(cells[name])) for name in ("paper", "m10")}
    return {name: (cell, cell) for name, cell in cells.items()} | learned


def calibrated(cell: Cell, noise: float = 1e-3, dt_s: float = 0.05) -> Cell:
    """What the calibration protocol makes of a cell; ``noise`` is relative, of a reading."""
    time_s, share = protocol_load(dt_s)
    kpa = cell.full_scale_kpa * share
    ohm = cell.forward(()).run(np.full(len(kpa), dt_s), kpa)
    ohm = ohm * (1.0 + noise * np.random.default_rng(1).standard_normal(len(ohm)))
    recording = checked_recording(time_s, kpa, ohm, name="protocol")
    return calibrate(recording, full_scale_kpa=cell.full_scale_kpa).cell


def elsewhere() -> Iterator[Honesty]:
    """Every load and fault on other cells; the example cell at other frame rates, and with a converter of 8 bits.

    All loads are on one skin. It therefore measures its noise on most of its cells, unlike those of :func:`honesty`.
    """
    cases = _cases()
    for name, (cell, believed) in specimens().items():
        for noise_mv in NOISES_MV:
            yield from judged_together(cell, name, cases, noise_mv, believed=believed)
    example = Cell.example()
    for rate_hz in RATES_HZ:
        yield from judged_together(example, "example", cases, 1.0, rate_hz=rate_hz)
    yield from judged_together(example, "example", cases, 0.1, bits=8)


def table(rows: Iterable[Honesty]) -> str:
    """The rows as text."""
    head = (
        f"default estimator at {RATE_HZ:g} frames per second; errors over stated standard deviations (sd)\n"
        f"{'cell':<18}{'load':<22}{'noise, mV':>10}{'RMSE, % FS':>12}{'sd, % FS':>10}{'sd/error':>10}"
        f"{'within 2 sd':>13}{'beyond 3':>10}{'worst':>8}"
    )
    lines = (
        f"{row.cell:<18}{row.load:<22}{row.noise_mv:>10g}{row.rmse_percent:>12.2f}{row.std_percent:>10.2f}"
        f"{row.width:>10.1f}{100 * row.within_two:>11.1f} %{100 * row.beyond_three:>8.2f} %{row.worst:>8.1f}"
        for row in rows
    )
    return "\n".join([head, *lines])


def summary(rows: Iterable[Honesty]) -> str:
    """One line for the loads and faults of each cell, noise, frame rate and converter: the least honest of them."""
    lines = [
        "default estimator, all loads and faults: the median, and the load that it is worst at\n"
        f"{'cell':<20}{'mV':>5}{'Hz':>6}{'bits':>5}{'RMSE, % FS':>12}{'sd, % FS':>10}  {'widest sd/error':<21}"
        f"{'within 2 sd':<27}"
        f"{'beyond 3':<26}{'worst':<22}{'rest, kPa':>9}"
    ]
    for (cell, noise_mv, rate_hz, bits), group in groupby(
        rows, key=lambda row: (row.cell, row.noise_mv, row.rate_hz, row.bits)
    ):
        some = list(group)
        least, beyond = min(some, key=lambda row: row.within_two), max(some, key=lambda row: row.beyond_three)
        worst = max(some, key=lambda row: row.worst)
        wide = max(some, key=lambda row: row.width if row.std_percent > CLEAR_STD_PERCENT else 0.0)
        lines.append(
            f"{cell:<20}{noise_mv:>5g}{rate_hz:>6g}{bits:>5}{np.median([row.rmse_percent for row in some]):>12.2f}"
            f"{np.median([row.std_percent for row in some]):>10.2f}{wide.width:>7.1f} {wide.load:<15}"
            f"{100 * least.within_two:>7.1f} % {least.load:<19}{100 * beyond.beyond_three:>6.2f} % {beyond.load:<18}"
            f"{worst.worst:>5.1f} {worst.load:<17}{_rest(some):>8.2f}"
        )
    return "\n".join(lines)


def _rest(rows: list[Honesty]) -> float:
    """Load in kPa that was shown before the last of twelve taps; NaN where no taps were judged for so long."""
    found = [row.rest_kpa for row in rows if np.isfinite(row.rest_kpa)]
    return max(found, default=np.nan)
