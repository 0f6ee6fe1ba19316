"""Systematic errors of the pressure beside the estimator's: unknown rest resistances, quantisation, shared noise.

An estimator measures the random noise, which averages out. Two errors stay the same from frame to frame, so that no
filter sees them:

* without a tare, the rest resistance of each cell differs from the data sheet by its manufacturing tolerance;
* a quiet reading always falls on the same side of its ADC step.

A third error is noise that the estimator hardly measures, since only pressed cells have it: on boards whose cells share
a current, a hard press lets the noise of all readings of the column count in each of its cells.

All three are relative errors of a resistance. The slope of the cell's static curve converts them to kPa.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from ..cell import Cell
from ..common.arrays import FloatArray
from ..common.compiled import Blocks, FixedRows, Row, Rows, loop
from ..common.measurement import (
    COLUMN_HALF_STEP,
    COLUMN_STD,
    CONDUCTANCE,
    HALF_STEP,
    NOISE_VARIANCE,
    STEP_STD,
    Measurement,
)

STEP = 5e-4
"""relative change of a resistance over which the slope of the static curve is taken"""
RANGE, POINTS = math.log(300.0), 4001
"""range of the slope table, from rest to this factor (as a logarithm) up and down, and its number of points"""
LOOK_UP = 4096
"""evenly spaced pressures of the look-up table: interpolation would take as long as everything else together"""
MARGIN = 0.005
"""fraction of full scale; pressures this near to the ends of the static curve, where it is cut off, are left out"""


class SystematicError:
    """Variance of pressures by errors that averaging over time does not reduce."""

    def __init__(self, cell: Cell) -> None:
        """Tabulate the slope of the cell's static curve by resistance and by rest resistance."""
        self._rest_ohm = cell.rest_resistance_ohm
        ohms = self._rest_ohm * np.exp(np.linspace(-RANGE, RANGE, POINTS))
        pressure = _static(cell, ohms, self._rest_ohm)
        by_reading = np.abs(_static(cell, ohms * (1 + STEP), self._rest_ohm) - pressure) / STEP
        by_rest = np.abs(_static(cell, ohms, self._rest_ohm * (1 + STEP)) - pressure) / STEP
        margin = MARGIN * cell.full_scale_kpa
        inside = np.flatnonzero((pressure > margin) & (pressure < pressure.max() - margin))
        order = inside[np.argsort(pressure[inside])]
        self._kpa_of_rest = float(by_rest[order[0]]) if order.size else 0.0
        self.tabulated = order.size > 0
        self._pressure = np.linspace(0.0, cell.full_scale_kpa, LOOK_UP)
        self._slopes_squared = np.zeros((2, LOOK_UP))
        """kPa^2 per squared relative error: row 0 of the reading, row 1 of the rest resistance"""
        if self.tabulated:
            for row, slope in enumerate((by_reading, by_rest)):
                self._slopes_squared[row] = np.interp(self._pressure, pressure[order], slope[order]) ** 2
        self._relative: FloatArray | None = None

    def kpa_of_rest(self, relative: float) -> float:
        """The pressure that an unloaded cell shows when its rest resistance is off by ``relative``."""
        return relative * self._kpa_of_rest

    def take(
        self, measured: Measurement, taken_out: FloatArray | None, spread: float
    ) -> Callable[[FloatArray, FloatArray], FloatArray]:
        """Take the next frame.

        Args:
            measured: of the frame.
            taken_out: (columns,) relative standard deviation of all resistances of a column by the correction of column
                steps (:mod:`._column_steps`); None: nothing was corrected.
            spread: relative standard deviation of rest resistances.

        Returns:
            A function that gives the standard deviation in kPa by systematic errors and the estimator together. Its
            arguments are the pressures in kPa (rows, columns) estimated from this reading and earlier ones, NaN where
            there is none yet, and the estimator's variances in kPa^2, a contiguous array that the function overwrites.
            It may be called at any time, in any thread.

        """
        shape = measured.reason.shape
        before = np.zeros(shape) if self._relative is None else self._relative
        self._relative = relative = np.empty(shape)
        relative_each.unchecked(measured.block, before, relative)
        if taken_out is not None:
            relative = relative + taken_out * taken_out
        return partial(self._std, relative, spread)

    def _std(
        self, relative: FloatArray, spread: float, pressure_kpa: FloatArray, variance_kpa2: FloatArray
    ) -> FloatArray:
        pressure = np.ascontiguousarray(pressure_kpa)
        add_variances.unchecked(
            relative, pressure, self._pressure, self._slopes_squared, spread * spread, variance_kpa2
        )
        return variance_kpa2


@loop
def relative_each(block: Blocks, before: Rows, relative: Rows) -> None:
    """Write the relative variance (N, M) of each conductance by ADC steps and by the noise of other cells' readings.

    For a cell without a conductance now, the variance when it last had one, of ``before``. ``block``: fields of a
    measurement. An estimator measures the noise that a cell has at rest; in a column of a divider under a hard press
    the noise of the other readings counts many times as much.
    """
    rows, columns = before.shape
    for i in range(rows):
        for j in range(columns):
            size = block[CONDUCTANCE, i, j]
            relative[i, j] = before[i, j]
            if size > 0.0:
                steps = STEP_STD * math.hypot(block[HALF_STEP, i, j], block[COLUMN_HALF_STEP, i, j])
                own = math.sqrt(block[NOISE_VARIANCE, i, j])
                others = math.hypot(own, block[COLUMN_STD, i, j]) - own
                relative[i, j] = (steps * steps + others * others) / (size * size)


@loop
def add_variances(
    relative_variance: Rows,
    pressure: FixedRows,
    table: Row,
    slopes_squared: Rows,
    rest_variance: float,
    variance: Rows,
) -> None:
    """Turn the estimator's ``variance`` (N, M) in kPa^2 into the standard deviation with systematic errors.

    The place in the ``table`` of evenly spaced pressures is first computed from the spacing, then corrected by
    comparison with the table.
    """
    rows, columns = relative_variance.shape
    last = table.size - 1
    per_kpa = last / table[last]
    for i in range(rows):
        for j in range(columns):
            kpa, place = pressure[i, j], last
            if kpa <= table[last]:  # False where it is NaN
                place = int(max(kpa * per_kpa, 0.0))
                while place > 0 and table[place - 1] >= kpa:
                    place -= 1
                while table[place] < kpa:
                    place += 1
            found = relative_variance[i, j] * slopes_squared[0, place]
            variance[i, j] = math.sqrt(variance[i, j] + (found + slopes_squared[1, place] * rest_variance))


def _static(cell: Cell, ohms: FloatArray, rest_ohm: float) -> FloatArray:
    """Pressures of a cell that has had each of these resistances for a long time (steady state)."""
    return cell.estimator(ohms.shape, "static", rest_resistance_ohm=rest_ohm, noise=0.0).step(1.0, ohms)
