"""Honesty of the stated standard deviation (calibration of uncertainty): errors over deviations, load by load.

``ohmskin bench --estimators`` prints the table. An honest deviation has 95 % of all errors within two deviations. On a
steady load it is about as large as the error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..arrays import BoolArray, FloatArray
from ..cell import Cell

CELLS = 8
RATE_HZ = 100.0
SECONDS = 16.0
VOLTS_AT_REST = 2.0
"""of an amplifier with 3.3 V and 12 bit"""
BEGUN_S = 0.5
"""time before which nothing is judged: the noise is not known yet"""
NOISES_MV = (0.1, 1.0, 10.0)
Load = Literal["rest", "hold", "edge", "press", "slow ramp", "fast ramp", "sine", "taps", "finger"]
Fault = Literal["", "sparks", "lost frames", "opens"]


@dataclass(frozen=True)
class Honesty:
    """The default estimator under one load; all cells and samples of a run."""

    cell: str
    load: str
    noise_mv: float
    rmse_percent: float
    """of full scale"""
    std_percent: float
    """median of the stated deviations, of full scale"""
    within_two: float
    """share of errors within two deviations"""
    beyond_three: float
    """share of errors beyond three"""
    worst: float
    """largest error over its deviation"""


_PRESS = [0.0, 1.0, 1.0, 0.0]
LOADS: dict[Load, Callable[[FloatArray], FloatArray]] = {
    "rest": lambda t: 0.0 * t,
    "hold": lambda t: np.interp(t, [0.5, 0.6], [0.0, 1.0]),
    "edge": lambda t: np.interp(t, [2.0, 2.02], [0.0, 1.0]),
    "press": lambda t: np.interp(t, [2.0, 2.2, 5.0, 5.2], _PRESS),
    "slow ramp": lambda t: np.interp(t, [1.0, 7.0, 9.0, 13.0], _PRESS),
    "fast ramp": lambda t: np.interp((t - 1.0) % 3.0, [0.0, 0.3, 1.5, 2.0], _PRESS) * (t > 1.0),
    "sine": lambda t: 0.5 * (1.0 - np.cos(2.0 * np.pi * 0.7 * (t - 1.0))) * (t > 1.0),
    "taps": lambda t: np.interp((t - 1.0) % 1.0, [0.0, 0.03, 0.5, 0.53], _PRESS) * ((t > 1.0) & (t < 13.0)),
}
"""share of the largest load at times in s; the cells follow each other by up to 0.4 s, so that edges are not in step"""


def pressures(load: Load, time_s: FloatArray, cells: int = CELLS) -> FloatArray:
    """Normalised loads (n, cells): each cell another strength, every fourth one none; a finger rolls over all."""
    if load == "finger":
        place = -2.0 + (cells + 4.0) * (0.5 - 0.5 * np.cos(2.0 * np.pi * 0.15 * time_s))
        share: FloatArray = 0.8 * np.exp(-((place[:, None] - np.arange(cells)) ** 2) / 1.5)
        share[share < 0.005] = 0.0
        return share
    strength = np.linspace(0.25, 0.9, cells)
    strength[::4] = 0.0
    found: FloatArray = strength * LOADS[load](time_s[:, None] - np.linspace(0.0, 0.37, cells))
    return found


def readings(
    cell: Cell, load: FloatArray, dt_s: float, noise_mv: float, random: np.random.Generator, bits: int = 12
) -> FloatArray:
    """Ohm (n, cells) as a board reads normalised loads (n, cells): white noise of volts, and an ADC."""
    ohm = cell.forward(load.shape[1:]).run(np.full(len(load), dt_s), load * cell.full_scale_kpa)
    unit = VOLTS_AT_REST * cell.rest_resistance_ohm
    volts = unit / ohm + 1e-3 * noise_mv * random.standard_normal(ohm.shape)
    step = 3.3 / 2**bits
    read: FloatArray = unit / (np.maximum(np.round(volts / step), 1.0) * step)
    return read


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
        for cell, start in enumerate(np.linspace(3.0, seconds - 3.0, read.shape[1])):
            first, last = round(start / dt_s), round((start + 0.5) / dt_s)
            found[first, cell], found[first + 1 : last, cell] = 4e6, np.inf if cell % 2 else np.nan
    return found, arrives


def estimated(cell: Cell, read: FloatArray, arrives: BoolArray, dt_s: float) -> tuple[FloatArray, FloatArray]:
    """Pressure and standard deviation (n, cells) in kPa by the cell's default estimator; lost frames are NaN."""
    estimator = cell.estimator(read.shape[1:])
    pressure, std = np.full((2, *read.shape), np.nan)
    last = -1
    for n in np.flatnonzero(arrives):
        pressure[n] = estimator.step((n - last) * dt_s, read[n])
        std[n] = estimator.std_kpa
        last = int(n)
    return pressure, std


def judged(
    cell: Cell, name: str, load: Load, noise_mv: float, *, fault: Fault = "", rate_hz: float = RATE_HZ, seed: int = 0
) -> Honesty:
    """Errors of the default estimator over its deviations, under one load and one fault."""
    dt_s = 1.0 / rate_hz
    time_s = np.arange(0.0, SECONDS, dt_s)
    share = pressures(load, time_s)
    read = readings(cell, share, dt_s, noise_mv, np.random.default_rng(seed))
    read, arrives = faulty(read, fault, dt_s)
    pressure, std = estimated(cell, read, arrives, dt_s)
    kept = arrives & (time_s > max(BEGUN_S, 10.0 * dt_s))
    full = cell.full_scale_kpa
    error = np.abs(pressure - full * share)[kept]
    over = error / std[kept]
    return Honesty(
        cell=name,
        load=load + (f", {fault}" if fault else ""),
        noise_mv=noise_mv,
        rmse_percent=100.0 * float(np.sqrt(np.mean(error**2))) / full,
        std_percent=100.0 * float(np.median(std[kept])) / full,
        within_two=float(np.mean(over < 2.0)),
        beyond_three=float(np.mean(over > 3.0)),
        worst=float(over.max()),
    )


def honesty(cells: dict[str, Cell] | None = None, noises_mv: Iterable[float] = NOISES_MV) -> Iterator[Honesty]:
    """Every load, and every fault on taps and on a finger, of the shipped example cell or of others."""
    loads: list[Load] = ["rest", *(load for load in LOADS if load != "rest"), "finger"]
    faults: list[Fault] = ["sparks", "lost frames", "opens"]
    cases: list[tuple[Load, Fault]] = [(load, "") for load in loads] + [("press", fault) for fault in faults]
    noises = list(noises_mv)
    for name, cell in (cells or {"example": Cell.example()}).items():
        for load, fault in cases:
            for noise_mv in noises:
                yield judged(cell, name, load, noise_mv, fault=fault)


def table(rows: Iterable[Honesty]) -> str:
    """The rows as text."""
    head = (
        f"default estimator at {RATE_HZ:g} frames per second; errors over stated standard deviations (sd)\n"
        f"{'cell':<14}{'load':<22}{'noise, mV':>10}{'RMSE, % FS':>12}{'sd, % FS':>10}{'within 2 sd':>13}"
        f"{'beyond 3':>10}{'worst':>8}"
    )
    lines = (
        f"{row.cell:<14}{row.load:<22}{row.noise_mv:>10g}{row.rmse_percent:>12.2f}{row.std_percent:>10.2f}"
        f"{100 * row.within_two:>11.1f} %{100 * row.beyond_three:>8.2f} %{row.worst:>8.1f}"
        for row in rows
    )
    return "\n".join([head, *lines])
