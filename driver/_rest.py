"""Rest resistances in use, and the doubt about them, whose one owner is :class:`Rest`.

Without a tare or a calibration, the rest resistance of each cell differs from the data sheet by its manufacturing
tolerance. The spread of the cells shows how much: it is measured while frames come, and the least value counts, since
loads only add to it.
"""

from __future__ import annotations

import math

import numpy as np

from ..cell import Cell
from ..common.arrays import MEDIAN_OF_NORMAL, FloatArray, scatter
from ..common.measurement import STEP_STD, Measurement
from ._calibration import Calibration
from ._tuning import DRIFT, EXPLAINED, LEAST_CELLS, UPDATE_AT, UPDATE_EVERY

CAUTION = math.sqrt(math.pi / 8.0) * math.exp(MEDIAN_OF_NORMAL**2 / 2.0) / MEDIAN_OF_NORMAL
"""relative standard deviation, times the root of n, of a scale estimate from the median q of n absolute deviations
(normal distribution, 1 / (4 q times its density at q): an asymptotic efficiency of 37 %)"""


class Rest:
    """Rest resistances of one skin's cells."""

    def __init__(self, cell: Cell, calibration: Calibration | None) -> None:
        """Begin with the values of the ``calibration``, else of the data sheet of the ``cell``."""
        self._cell, self._calibration = cell, calibration
        self._kpa_at_rest = float(cell.rest_slope_kpa[0])
        """kPa per relative error of a rest resistance"""
        self.measured_spread: float | None = None
        """relative standard deviation of the cells about the data sheet: the least value seen, enlarged by the sampling
        error of so few cells; None: not measured yet"""
        self.known = calibration is not None
        """whether the rest resistances were measured, by a tare or a calibration"""
        self.spread = 0.0
        """relative standard deviation of the values in use, as far as it is known"""
        self._tared_ohm: FloatArray | None = None
        self._before: FloatArray | None = None
        self._frames = 0

    @property
    def tared_ohm(self) -> FloatArray | None:
        """(rows, columns) by a tare; None: there is none."""
        return self._tared_ohm

    @tared_ohm.setter
    def tared_ohm(self, ohm: FloatArray | None) -> None:
        self._tared_ohm = ohm
        self.known = ohm is not None or self._calibration is not None
        self.spread = 0.0 if self.known else self.measured_spread or 0.0

    @property
    def ohm(self) -> FloatArray | None:
        """(rows, columns) values in use; None: that of the data sheet for all cells."""
        if self.tared_ohm is None and self._calibration is not None:
            return self._calibration.rest_ohm
        return self.tared_ohm

    @property
    def error(self) -> float | None:
        """Relative standard deviation that an estimator is to assume; None: what it assumes by itself."""
        return DRIFT if self.tared_ohm is not None and self._cell.estimators is not None else None

    def kpa_of(self, relative: float) -> float:
        """The pressure that an unloaded cell shows when its rest resistance is off by ``relative``."""
        return relative * self._kpa_at_rest

    def take(self, reading: Measurement) -> None:
        """Measure the spread of the cells every few frames."""
        if self.known or self.measured_spread == 0.0:
            return
        self._frames += 1
        if self._frames == 1 or self._frames % UPDATE_EVERY == UPDATE_AT:
            half_steps = np.minimum(np.nan_to_num(reading.steps_std) / STEP_STD, EXPLAINED)
            self._measure(reading.resistance, -np.log1p(-half_steps))

    def _measure(self, resistance_ohm: FloatArray, half_steps: FloatArray) -> None:
        """Measure the spread of resistances whose relative errors by half an ADC step are ``half_steps``."""
        deviation = np.log(resistance_ohm / self._cell.rest_resistance_ohm)
        before, self._before = self._before, deviation
        away = np.abs(deviation)
        sizes = _finite(away)
        if sizes.size < LEAST_CELLS:
            return
        cells = sizes.size
        if np.count_nonzero(away <= half_steps) >= EXPLAINED * cells:
            # Equal cells would read so, too: ADC steps, which are counted separately, explain the differences.
            self.measured_spread = self.spread = 0.0
            return
        variance = scatter(sizes) ** 2
        if before is not None:
            changes = _finite(np.abs(deviation - before))
            if changes.size >= LEAST_CELLS:
                variance -= scatter(changes) ** 2 / 2
        # Few cells may by chance be more alike than those of other skins.
        spread = math.sqrt(max(variance, 0.0)) * (1.0 + CAUTION / math.sqrt(cells))
        self.measured_spread = self.spread = min(
            spread, math.inf if self.measured_spread is None else self.measured_spread
        )


def _finite(sizes: FloatArray) -> FloatArray:
    """The finite ones among absolute values."""
    return sizes if math.isfinite(sizes.item(sizes.argmax())) else sizes[np.isfinite(sizes)]  # argmax finds NaN, too
