"""ADC steps that scale whole columns, taken out of the readings of coarse dividers (set-membership estimation).

On a divider whose idle rows are driven, a conductance is s / (1 - S): s is the cell's share of the supply, S the sum
over its column. Of many cells S is nearly 1, and equal cells are rounded alike. So half a step of each reading scales
all conductances of the column: by a fourth on 16 equal cells and 8 bits. As a finger lowers the shares of some cells,
those of the others rise, and their rounding changes with them: the whole column would seem pressed.

The readings leave the scale open within an interval, and by themselves prefer no place in it. Rest does: where a tare
found equal cells, the scale is taken that brings the cells of the column nearest to rest, within what two roundings
make, that of now and that of rest. A load on all cells of a column is seen as far as it exceeds this, and what may have
been taken from it is a deviation. The lower third of the cells speaks for the column: a press may cover most of it.
"""

from __future__ import annotations

import math

import numpy as np

from ..arrays import FloatArray
from ..compiled import Row, Rows, loop
from ._reading import Reading

LEAST = 0.1
"""relative, by half a step of all other readings: what is less is not taken out"""
FINE_FOR, NEVER = 15, 2**62
"""frames for which steps that were small are taken to be so"""
ROUNDINGS = 2.0
"""of which the scale's error is the difference: of the reading now, and of that at rest"""
ALIKE, MOST = 0.01, 0.8
"""relative, by which cells may differ at rest that are rounded alike; and what share of a column's cells these are.
Cells that differ by more than a step have errors of their own, which hardly add up"""
SPEAKS = 3
"""one of so many cells of a column lies below the one that speaks for it"""

EVENLY = 1.0 / math.sqrt(3.0)
"""standard deviation over the largest error, of what lies evenly between none and all of it"""


class ColumnSteps:
    """Resistances of one skin without the steps that its columns share."""

    def __init__(self, rest_ohm: FloatArray, side: float, *, rest_known: bool) -> None:
        """Begin.

        Args:
            rest_ohm: (rows, columns) rest resistances.
            side: sign that a load gives to their change.
            rest_known: they were measured, by a tare or a calibration.

        """
        self._per_ohm, self._side = 1.0 / rest_ohm, side
        apart = np.abs(rest_ohm / np.median(rest_ohm, axis=0) - 1.0)
        alike = np.count_nonzero(apart < ALIKE, axis=0) >= MOST * len(rest_ohm)
        self._roundings = np.where(alike & rest_known, ROUNDINGS, 0.0)
        self._scale_each = scale_each.machine_code()
        self._idle = 0 if self._roundings.any() else NEVER  # frames until the steps are looked at

    def without(self, reading: Reading) -> tuple[FloatArray, FloatArray | None]:
        """Resistances for estimation, and what a load on whole columns may have lost by that.

        Returns:
            (rows, columns) ohm, NaN where unknown; (columns,) relative standard deviation of these by what has been
            taken out, None where nothing has.

        """
        resistance = reading.for_estimation
        if self._idle:
            self._idle -= 1
            return resistance, None
        shared = reading.column_steps
        if shared is None or shared.max() < LEAST:
            self._idle = FINE_FOR
            return resistance, None
        limits = np.exp(self._roundings * shared)
        if self._scale_each is not None:
            scaled, scale = np.array(resistance), np.ones(limits.size)
            self._scale_each(scaled, self._per_ohm, self._side, limits, scale)
            return scaled, np.abs(np.log(scale)) * EVENLY
        ratio = resistance * self._per_ohm
        ordered = np.sort(ratio if self._side > 0.0 else -ratio, axis=0)  # NaN comes last
        known = np.count_nonzero(np.isfinite(ordered), axis=0)
        speaking = np.abs(ordered[known // SPEAKS * (known > 0), np.arange(known.size)])
        scale = np.minimum(np.maximum(speaking, 1.0 / limits), limits)
        scale[known == 0] = 1.0
        return resistance / scale, np.abs(np.log(scale)) * EVENLY


@loop
def scale_each(resistance: Rows, per_ohm: Rows, side: float, limits: Row, scales: Row) -> None:
    """As :meth:`ColumnSteps.without`, column by column.

    Args:
        resistance: (N, M) ohm, changed.
        per_ohm: (N, M) 1 / ohm, at rest.
        side: sign of what a load makes of them.
        limits: (M,) of the scales.
        scales: (M,) found, where any cell of the column is known.
    """
    rows, columns = resistance.shape
    ordered = np.empty(rows)
    for j in range(columns):
        known = 0
        for i in range(rows):
            ratio = resistance[i, j] * per_ohm[i, j]
            if not math.isnan(ratio):
                place = known
                while place > 0 and side * ordered[place - 1] > side * ratio:
                    ordered[place] = ordered[place - 1]
                    place -= 1
                ordered[place] = ratio
                known += 1
        if known:
            scale = min(max(ordered[known // SPEAKS], 1.0 / limits[j]), limits[j])
            scales[j] = scale
            for i in range(rows):
                resistance[i, j] /= scale
