"""Stress tests of the estimators: taps, noise and contact sparks on the shipped example cell, uncalibrated.

``ohmskin bench --estimators`` prints the table below that of speed against error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..cell import Cell
from ..common.arrays import FloatArray
from ..errors import InputError

DT_S = 0.02
SECONDS = 30.0
CELLS = 8
TAP_KPA = 9.0
VOLTS_AT_REST = 2.0
"""of an amplifier with 3.3 V and 12 bit"""


@dataclass(frozen=True)
class HardCase:
    """One estimator under one disturbance."""

    case: str
    estimator: str
    rest_kpa: float
    """largest pressure shown before the last of twelve taps, at rest"""
    rmse_kpa: float
    worst_kpa: float
    within_two_std: float
    """share of estimates within two stated standard deviations; NaN where none is stated"""
    is_default: bool


def hard_cases(*, seed: int = 0) -> list[HardCase]:
    """Twelve taps of 9 kPa at 1 Hz, with noise of 0.1 to 10 mV, and with sparks of 60 ms that read 2.5 times R."""
    cell = Cell.example()
    time_s = np.arange(0, SECONDS, DT_S)
    phase = (time_s - 1.0) % 1.0
    shape = np.interp(phase, [0, 0.03, 0.5, 0.53], [0, 1, 1, 0])
    load = TAP_KPA * shape * ((time_s >= 1) & (time_s < 13))
    rows = []
    for case, volts, spark in (
        ("0.1 mV of noise", 1e-4, 1.0),
        ("1 mV", 1e-3, 1.0),
        ("10 mV", 1e-2, 1.0),
        ("0.1 mV and sparks", 1e-4, 2.5),
    ):
        read = _read(cell, load, volts, spark, np.random.default_rng(seed))
        for name in ("static", "paper", "inverse"):
            try:
                rows.append(_judged(cell, case, name, time_s, load, read))
            except InputError:
                continue  # not for this kind of cell
    return rows


def hard_table(rows: list[HardCase]) -> str:
    """The rows as text."""
    lines = [
        f"{'twelve taps of 9 kPa':<24}{'estimator':<12}{'rest, kPa':>10}{'RMSE, kPa':>11}{'worst, kPa':>12}"
        f"{'within 2 sd':>13}"
    ]
    lines += [
        f"{row.case:<24}{row.estimator:<12}{row.rest_kpa:>10.2f}{row.rmse_kpa:>11.2f}{row.worst_kpa:>12.2f}"
        + (f"{100 * row.within_two_std:>11.1f} %" if np.isfinite(row.within_two_std) else f"{'-':>13}")
        + ("  default" if row.is_default else "")
        for row in rows
    ]
    return "\n".join(lines)


def _read(cell: Cell, load: FloatArray, volts_rms: float, spark: float, random: np.random.Generator) -> FloatArray:
    """Ohm (n, CELLS) of pressed cells as a board reads them, with a spark of 60 ms every 2.9 s."""
    forward = cell.forward((CELLS,))
    ohm = np.stack([forward.step(DT_S, np.full(CELLS, kpa)) for kpa in load.tolist()])
    unit = VOLTS_AT_REST * cell.rest_resistance_ohm
    volts = unit / ohm + volts_rms * random.standard_normal(ohm.shape)
    step = 3.3 / 4096
    read: FloatArray = unit / (np.round(volts / step) * step)
    for start in np.arange(2.6, SECONDS, 2.9):
        first = round(start / DT_S)
        read[first : first + 3] *= spark
    return read


def _judged(cell: Cell, case: str, name: str, time_s: FloatArray, load: FloatArray, read: FloatArray) -> HardCase:
    estimator = cell.estimator((CELLS,), name)
    estimator.compile()
    pressure, std = np.empty((2, *read.shape))
    for n, frame in enumerate(read):
        pressure[n] = estimator.step(DT_S, frame)
        std[n] = estimator.std_kpa
    error = pressure - load[:, None]
    before_last = (time_s > 11.7) & (time_s < 12.0)
    stated = np.isfinite(std)
    return HardCase(
        case=case,
        estimator=name,
        rest_kpa=float(np.abs(pressure[before_last]).max()),
        rmse_kpa=float(np.sqrt(np.mean(error**2))),
        worst_kpa=float(np.abs(error).max()),
        within_two_std=float(np.mean(np.abs(error[stated]) < 2 * std[stated])) if stated.any() else np.nan,
        is_default=name == cell.default_estimator,
    )
