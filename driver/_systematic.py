"""Systematic errors of the pressure: rest resistances that nobody measured, and quantisation.

An estimator measures noise, which averages out. Two errors stay the same from frame to frame, so no filter sees them:

* without a tare, each cell's rest resistance differs from that of the data sheet, by manufacture;
* a quiet reading always falls on the same side of its ADC step.

Both are relative errors of a resistance. The static curve of the cell says how many kPa they make.
"""

from __future__ import annotations

import math

import numpy as np

from ..arrays import FloatArray
from ..cell import Cell
from ._reading import Reading

LOOK_EVERY = 8
"""frames from one look at the spread of the cells to the next"""
LEAST_CELLS = 4
"""with fewer readings no spread is measured"""
NORMAL = 1.4826
"""standard deviation over the median of absolute deviations, of normally distributed numbers"""
STEP = 5e-4
"""relative change of a resistance that the slope of the static curve is taken over"""
RANGE, POINTS = math.log(300.0), 4001
"""the table of slopes reaches from rest to this factor (as a logarithm) up and down, with so many points"""
MARGIN = 0.005
"""of full scale: pressures nearer to its ends are left out of the table, since the static curve is cut off there"""


class SystematicError:
    """Variance of pressures by errors that no average over time lessens."""

    def __init__(self, cell: Cell) -> None:
        """Tabulate the slope of the cell's static curve by resistance and by rest resistance."""
        self._rest_ohm = cell.rest_resistance_ohm
        ohms = self._rest_ohm * np.exp(np.linspace(-RANGE, RANGE, POINTS))
        pressure = _static(cell, ohms, self._rest_ohm)
        by_reading = np.abs(_static(cell, ohms * (1 + STEP), self._rest_ohm) - pressure) / STEP
        by_rest = np.abs(_static(cell, ohms, self._rest_ohm * (1 + STEP)) - pressure) / STEP
        full = cell.full_scale_kpa
        inside = np.flatnonzero((pressure > MARGIN * full) & (pressure < (1 - MARGIN) * full))
        order = inside[np.argsort(pressure[inside])]
        self._pressure, self._by_reading, self._by_rest = pressure[order], by_reading[order], by_rest[order]
        self.rest_spread: float | None = None
        """relative, of the cells' rest resistances about that of the data sheet: the least that was seen"""
        self._before: FloatArray | None = None
        self._frames = 0
        self._uncertainty: FloatArray | None = None

    def forget(self) -> None:
        """Drop what is remembered of the last frames; the spread stays."""
        self._before, self._frames, self._uncertainty = None, 0, None

    def kpa_of_rest(self, relative: float) -> float:
        """The pressure that an unloaded cell shows when its rest resistance is off by ``relative``."""
        return relative * float(self._by_rest[0]) if self._by_rest.size else 0.0

    def variance(self, reading: Reading, pressure_kpa: FloatArray, *, rest_known: bool) -> FloatArray:
        """The variance in kPa^2 (rows, columns) of pressures estimated from this reading and earlier ones.

        Args:
            reading: of the frame.
            pressure_kpa: (rows, columns) estimated from it; NaN where there is none yet.
            rest_known: the rest resistances were measured, by a tare or a calibration.

        """
        if not self._pressure.size:
            return np.zeros_like(pressure_kpa)
        error = np.interp(pressure_kpa, self._pressure, self._by_reading) * self._of_steps(reading)
        variance = error * error
        if not rest_known:
            self._look(reading.resistance)
            if self.rest_spread:
                variance += (np.interp(pressure_kpa, self._pressure, self._by_rest) * self.rest_spread) ** 2
        return variance

    def _of_steps(self, reading: Reading) -> FloatArray:
        """Relative standard deviation of each resistance by ADC steps; of a cell not valid now, when it last was."""
        # An error that is evenly distributed over an interval has the half-width over the root of three.
        share, uncertainty = reading.steps_share / math.sqrt(3.0), reading.uncertainty
        if reading.valid.all():
            known = uncertainty * share
        else:
            known = np.zeros_like(uncertainty) if self._uncertainty is None else self._uncertainty.copy()
            known[reading.valid] = uncertainty[reading.valid] * share
        self._uncertainty = known
        return known

    def _look(self, resistance_ohm: FloatArray) -> None:
        """Measure the spread of the cells every few frames, and keep the least: loads only add to it."""
        self._frames += 1
        if (self._frames - 1) % LOOK_EVERY:
            return
        deviation = np.log(resistance_ohm / self._rest_ohm)
        present = deviation[np.isfinite(deviation)]
        before, self._before = self._before, deviation
        if present.size < LEAST_CELLS:
            return
        variance = (NORMAL * float(np.median(np.abs(present)))) ** 2
        if before is not None:
            change = deviation - before
            change = change[np.isfinite(change)]
            if change.size >= LEAST_CELLS:
                variance -= (NORMAL * float(np.median(np.abs(change)))) ** 2 / 2
        spread = math.sqrt(max(variance, 0.0))
        self.rest_spread = spread if self.rest_spread is None else min(spread, self.rest_spread)


def _static(cell: Cell, ohms: FloatArray, rest_ohm: float) -> FloatArray:
    """The pressures of a cell that has had each of these resistances for long."""
    return cell.estimator(ohms.shape, "static", rest_resistance_ohm=rest_ohm, noise=0.0).step(1.0, ohms)
