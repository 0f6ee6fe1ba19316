"""Systematic errors of the pressure beside the estimator's: unknown rest resistances, quantisation, shared noise.

An estimator measures the random noise, which averages out. Two errors stay the same from frame to frame, so that no
filter sees them:

* without a tare, the rest resistance of each cell differs from the data sheet by its manufacturing tolerance;
* a quiet reading always falls on the same side of its ADC step.

A third error is noise that the estimator hardly measures, since only pressed cells have it: on boards whose cells share
a current, a hard press lets the noise of all readings of the column count in each of its cells.

All three are relative errors of a resistance. The slope of the cell's equilibrium curve converts them to kPa.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from ..cell import Cell, ContactModel
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

LOOK_UP = 4096
"""evenly spaced pressures of the look-up table: interpolation would take as long as everything else together"""
STEEPEST = 20.0
"""largest slope over the usual one, where the curve is flat"""
MARGIN = 0.005
"""fraction of full scale, below which the slope is that of this pressure: contacts begin with a curve of their own"""


class SystematicError:
    """Variance of pressures by errors that averaging over time does not reduce."""

    def __init__(self, cell: Cell) -> None:
        """Tabulate the slope of the cell's equilibrium curve by resistance and by rest resistance."""
        full = cell.full_scale_kpa
        self._pressure = np.linspace(0.0, full, LOOK_UP)
        load = np.linspace(MARGIN, 1.0, LOOK_UP)
        ohm = cell.equilibrium_ohm(load)
        slope = np.abs(np.gradient(np.log(ohm), full * load))
        by_reading = 1.0 / np.maximum(slope, max(float(np.median(slope)) / STEEPEST, np.finfo(np.float64).tiny))
        by_rest = by_reading
        if isinstance(cell.model, ContactModel) and cell.estimators is None:  # their conductances add up
            by_rest = by_reading * ohm / cell.rest_resistance_ohm
        self._kpa_of_rest = float(by_rest[0])
        self._slopes_squared = np.square(
            [np.interp(self._pressure, full * load, each) for each in (by_reading, by_rest)]
        )
        """kPa^2 per squared relative error: row 0 of the reading, row 1 of the rest resistance"""
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
