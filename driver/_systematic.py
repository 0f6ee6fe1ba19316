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
from typing import NamedTuple

import numpy as np

from ..cell import Cell
from ..common.arrays import BoolArray, FloatArray, scatter
from ..common.compiled import FixedRows, Row, Rows, loop
from ..common.measurement import STEP_STD, Measurement

LOOK_EVERY, LOOK_AT = 8, 3
"""interval in frames between two measurements of the cells' spread, and the frame of each interval that has it.
Estimators look back at their readings in every fourth frame, from the first on; both in one frame would make it long"""
LEAST_CELLS = 4
"""least number of readings for a spread"""
CAUTION = 1.17
"""relative standard deviation, times the root of n, of a scale estimate from the median of n absolute deviations
(normal distribution; its asymptotic efficiency is 37 %)"""
MOST = 0.95
"""largest relative error of a conductance by half a step that counts"""
EXPLAINED = 0.95
"""share of cells within half an ADC step of the data sheet from which on the spread counts as zero"""
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
        self._tabulated = order.size > 0
        self._pressure = np.linspace(0.0, cell.full_scale_kpa, LOOK_UP)
        self._slopes_squared = np.zeros((2, LOOK_UP))
        """kPa^2 per squared relative error: row 0 of the reading, row 1 of the rest resistance"""
        if self._tabulated:
            for row, slope in enumerate((by_reading, by_rest)):
                self._slopes_squared[row] = np.interp(self._pressure, pressure[order], slope[order]) ** 2
        self.rest_spread: float | None = None
        """relative standard deviation of the cells' rest resistances about the data sheet: the least value seen,
        enlarged by the sampling error of so few cells"""
        self._before: FloatArray | None = None
        self._frames = 0
        self._steps: _Steps | None = None

    def kpa_of_rest(self, relative: float) -> float:
        """The pressure that an unloaded cell shows when its rest resistance is off by ``relative``."""
        return relative * self._kpa_of_rest

    def take(
        self, reading: Measurement, taken_out: FloatArray | None = None, *, rest_known: bool
    ) -> Callable[[FloatArray, FloatArray], FloatArray]:
        """Take the next frame.

        Args:
            reading: of the frame.
            taken_out: (columns,) relative standard deviation of all resistances of a column by the correction of column
                steps (:mod:`._column_steps`); None: nothing was corrected.
            rest_known: the rest resistances were measured, by a tare or a calibration.

        Returns:
            A function that gives the standard deviation in kPa by systematic errors and the estimator together. Its
            arguments are the pressures in kPa (rows, columns) estimated from this reading and earlier ones, NaN where
            there is none yet, and the estimator's variances in kPa^2, a contiguous array that the function overwrites.
            It may be called at any time, in any thread.

        """
        self._steps = _Steps.of(reading, self._steps, taken_out)
        spread = 0.0
        if not rest_known and self._tabulated:
            self._look(reading)
            spread = self.rest_spread or 0.0
        return partial(self._std, self._steps, spread)

    def _std(self, steps: _Steps, spread: float, pressure_kpa: FloatArray, variance_kpa2: FloatArray) -> FloatArray:
        relative, pressure = _whole(steps.relative_variance()), np.ascontiguousarray(pressure_kpa)
        add_variances.unchecked(
            relative, pressure, self._pressure, self._slopes_squared, spread * spread, variance_kpa2
        )
        return variance_kpa2

    def _look(self, reading: Measurement) -> None:
        """Measure the spread of the cells every few frames, and keep the least value, since loads only add to it."""
        self._frames += 1
        if self.rest_spread == 0.0:
            return
        if self._frames == 1 or self._frames % LOOK_EVERY == LOOK_AT:
            half_steps = np.minimum(np.nan_to_num(reading.steps_std) / STEP_STD, MOST)
            self._measure(reading.resistance, -np.log1p(-half_steps))

    def _measure(self, resistance_ohm: FloatArray, half_steps: FloatArray) -> None:
        """Measure the spread of resistances whose relative errors by half an ADC step are ``half_steps``."""
        deviation = np.log(resistance_ohm / self._rest_ohm)
        before, self._before = self._before, deviation
        away = np.abs(deviation)
        sizes = _finite(away)
        if sizes.size < LEAST_CELLS:
            return
        cells = sizes.size
        if np.count_nonzero(away <= half_steps) >= EXPLAINED * cells:
            # Equal cells would read so, too: ADC steps, which are counted separately, explain the differences.
            self.rest_spread = 0.0
            return
        variance = scatter(sizes) ** 2
        if before is not None:
            changes = _finite(np.abs(deviation - before))
            if changes.size >= LEAST_CELLS:
                variance -= scatter(changes) ** 2 / 2
        # Few cells may by chance be more alike than those of other skins.
        spread = math.sqrt(max(variance, 0.0)) * (1.0 + CAUTION / math.sqrt(cells))
        self.rest_spread = spread if self.rest_spread is None else min(spread, self.rest_spread)


class _Steps(NamedTuple):
    """Errors by ADC steps in one frame; immutable. Arrays are (rows, columns)."""

    reading: Measurement
    valid: BoolArray
    earlier: FloatArray | None
    """relative variance of cells that are not valid; None: all cells are valid"""
    taken_out: FloatArray | None
    """(columns,) relative standard deviation of resistances by the correction of column steps; None: none was made"""

    @classmethod
    def of(cls, reading: Measurement, before: _Steps | None, taken_out: FloatArray | None) -> _Steps:
        """The errors in a frame after ``before``."""
        valid = reading.valid
        if valid.all():
            return cls(reading, valid, None, taken_out)
        if before is None:
            earlier = np.zeros(valid.shape)
        elif before.earlier is not None and np.array_equal(before.valid, valid):
            earlier = before.earlier
        else:
            earlier = before.relative_variance()
        return cls(reading, valid, earlier, taken_out)

    def relative_variance(self) -> FloatArray:
        """Relative variance of each resistance by ADC steps and by the noise of other cells' readings.

        For a cell that is not valid now, the variance when it last was. The caller may change the array.
        """
        reading = self.reading
        own = np.sqrt(reading.noise_variance)
        others = np.hypot(own, reading.column_std) - own
        with np.errstate(invalid="ignore"):
            variance: FloatArray = np.nan_to_num(reading.steps_std**2 + (others / reading.conductance) ** 2)
        if self.earlier is not None:
            variance = np.where(self.valid, variance, self.earlier)
        if self.taken_out is not None:
            variance += self.taken_out * self.taken_out
        return variance


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


def _whole(values: FloatArray) -> FloatArray:
    """The values as a contiguous, writeable array, for which loops start fastest; a copy if they are not one."""
    return values if values.flags.carray else values.copy()


def _finite(sizes: FloatArray) -> FloatArray:
    """The finite ones among absolute values."""
    return sizes if math.isfinite(sizes.item(sizes.argmax())) else sizes[np.isfinite(sizes)]  # argmax finds NaN, too


def _static(cell: Cell, ohms: FloatArray, rest_ohm: float) -> FloatArray:
    """Pressures of a cell that has had each of these resistances for a long time (steady state)."""
    return cell.estimator(ohms.shape, "static", rest_resistance_ohm=rest_ohm, noise=0.0).step(1.0, ohms)
