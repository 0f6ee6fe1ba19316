"""Estimates of one skin: a measurement becomes pressures and their standard deviations, with all known errors."""

from __future__ import annotations

import numpy as np

from ..cell import Cell, Estimator
from ..circuits import Reason
from ..common.arrays import FloatArray
from ..common.measurement import CONDUCTANCE, Measurement
from ._calibration import Calibration
from ._column_steps import ColumnSteps
from ._rest import Rest

_NO_CURRENT = int(Reason.NO_CURRENT)


class Estimate:
    """The estimator of one skin with certain rest resistances, from its start on."""

    def __init__(
        self, cell: Cell, shape: tuple[int, int], name: str | None, rest: Rest, calibration: Calibration | None
    ) -> None:
        """Start without a memory of loads, with the rest resistances that are in use now."""
        self.estimator: Estimator = cell.estimator(shape, name, rest_resistance_ohm=rest.ohm, rest_error=rest.error)
        self._rest, self._calibration = rest, calibration
        self._column_steps = ColumnSteps(self.estimator.rest_ohm, self.estimator.side, rest_known=rest.known)
        self._open_at_rest, self._known = cell.open_at_rest, rest.known

    def take(self, elapsed_s: float, measured: Measurement) -> tuple[FloatArray, FloatArray]:
        """Pressures (rows, columns) in kPa of the next frame, and their standard deviations.

        Args:
            elapsed_s: s since the frame before.
            measured: of the frame.

        """
        estimator = self.estimator
        if not self._known:
            estimator.rest_error = self._rest.spread
        conductance = self._column_steps.without(measured)
        if self._open_at_rest:
            conductance = np.where(measured.reason == _NO_CURRENT, 0.0, conductance)
        seen = measured
        if conductance.base is not measured.block:
            seen = Measurement(measured.block.copy(), measured.reason)
            seen.block[CONDUCTANCE] = conductance
        pressure, std = estimator.estimate(elapsed_s, seen)
        if self._calibration is not None:
            pressure, std = self._calibration.applied(pressure), self._calibration.applied_std(pressure, std)
        return pressure, std
