"""Quantisation errors that scale whole columns, removed from readings of coarse dividers (set-membership estimation).

On a divider whose idle rows are driven, a conductance is s / (1 - S): s is the cell's share of the supply, S the sum of
the shares in its column. With many cells S is nearly 1, and equal cells are rounded alike. Half a step of each reading
then scales all conductances of the column: by a fourth with 16 equal cells and 8 bits. When a finger lowers the shares
of some cells, the shares of the others rise, and their rounding changes: the whole column would seem pressed.

The readings only confine the scale to an interval. The state at rest selects a value within it. Where a tare found
equal cells, we take the scale that brings the cells of the column nearest to rest, within two roundings: of the reading
now and of the reading at rest. A load on all cells of a column is thus seen as far as it exceeds this interval, and the
part that may have been removed from a load is stated as a standard deviation. The lower third of the cells represents
the column, since a press may cover most of it.
"""

from __future__ import annotations

import math

import numpy as np

from ..common.arrays import FloatArray
from ..common.compiled import Row, Rows, loop
from ..common.measurement import Measurement
from ._tuning import ALIKE_IN_STEPS, ALIKE_SHARE, DRIFT, FINE_FOR, LEAST_SCALE, SPEAKS

ROUNDINGS = 2.0
"""roundings in the scale's error: of the reading now, and of the reading at rest"""


class ColumnSteps:
    """Removes the scale errors of columns by ADC steps from the resistances of one skin."""

    def __init__(self, rest_ohm: FloatArray, side: float, *, rest_known: bool) -> None:
        """Begin.

        Args:
            rest_ohm: (rows, columns) rest resistances.
            side: sign of the change of resistance under a load.
            rest_known: the rest resistances were measured, by a tare or a calibration.

        """
        self._per_ohm, self._side = 1.0 / rest_ohm, side
        apart = np.abs(rest_ohm / np.median(rest_ohm, axis=0) - 1.0)
        alike = np.count_nonzero(apart < DRIFT, axis=0) >= ALIKE_SHARE * len(rest_ohm)
        self._roundings = np.where(alike & rest_known, ROUNDINGS, 0.0)
        self.are_removed = bool(self._roundings.any())
        """whether any column has such cells; otherwise :meth:`without` changes nothing"""
        self._idle = 0  # frames until the steps are looked at

    def without(self, measured: Measurement) -> FloatArray:
        """Conductances for estimation.

        Returns:
            (rows, columns) S, NaN where unknown.

        """
        conductance = measured.conductance
        if self._idle or not self.are_removed:
            self._idle = max(self._idle - 1, 0)
            return conductance
        rows = len(conductance)
        with np.errstate(invalid="ignore"):
            shared = np.abs(measured.column_half_step / conductance)
        # The other readings enter by their sum: all at once they make the root of their number of independent errors.
        shared = np.nan_to_num(np.fmin.reduce(shared, axis=0)) * (rows - 1) / math.sqrt(rows) / ALIKE_IN_STEPS
        if shared.max() < LEAST_SCALE:
            self._idle = FINE_FOR
            return conductance
        limits = np.exp(self._roundings * shared)
        scaled, scale = 1.0 / conductance, np.ones(limits.size)
        scale_each(scaled, self._per_ohm, self._side, limits, scale)
        return 1.0 / scaled


@loop
def scale_each(resistance: Rows, per_ohm: Rows, side: float, limits: Row, scales: Row) -> None:
    """Divide the resistances of each column by the scale that brings its representative cell nearest to rest.

    Args:
        resistance: (N, M) ohm, changed.
        per_ohm: (N, M) 1 / ohm, at rest.
        side: sign of the change of resistance under a load.
        limits: (M,) largest scales; the smallest are their inverses.
        scales: (M,) scales found; columns without a known cell are left alone.
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
