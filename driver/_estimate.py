"""Estimates of one skin: a measurement becomes pressures and their standard deviations, with all known errors."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from ..cell import Cell, Estimator
from ..circuits import Reason
from ..common.arrays import FloatArray
from ..common.measurement import CONDUCTANCE, Measurement
from ._calibration import Calibration
from ._column_steps import ColumnSteps
from ._lazy import Lazy
from ._rest import Rest
from ._systematic import SystematicError

_NO_CURRENT = int(Reason.NO_CURRENT)


class Estimate:
    """The estimator of one skin with certain rest resistances, from its start on."""

    def __init__(
        self,
        cell: Cell,
        shape: tuple[int, int],
        name: str | None,
        rest: Rest,
        systematic: SystematicError,
        calibration: Calibration | None,
    ) -> None:
        """Start without a memory of loads, with the rest resistances that are in use now."""
        self.estimator: Estimator = cell.estimator(shape, name, rest_resistance_ohm=rest.ohm, rest_error=rest.error)
        self._rest, self._systematic, self._calibration = rest, systematic, calibration
        self._column_steps = ColumnSteps(self.estimator.rest_ohm, self.estimator.side, rest_known=rest.known)
        self._open_at_rest = cell.open_at_rest

    def take(
        self,
        elapsed_s: float,
        measured: Measurement,
        resolution: tuple[FloatArray, FloatArray, FloatArray, bool] | None,
    ) -> tuple[FloatArray, Lazy]:
        """Pressures (rows, columns) in kPa of the next frame, and their standard deviations.

        Args:
            elapsed_s: s since the frame before.
            measured: of the frame.
            resolution: of the readings; None: not known.

        """
        estimator = self.estimator
        if resolution is not None and not estimator.resolved:
            estimator.resolve(*resolution)
        conductance, taken_out = self._column_steps.without(measured)
        if self._open_at_rest:
            conductance = np.where(measured.reason == _NO_CURRENT, 0.0, conductance)
        seen = measured
        if conductance.base is not measured.block:
            seen = Measurement(measured.block.copy(), measured.reason)
            seen.block[CONDUCTANCE] = conductance
        common = estimator.step_readings(elapsed_s, seen)
        systematic = self._systematic.take(measured, taken_out, self._rest.spread)
        std = Lazy(partial(_std, estimator.variance_of_last_step(), systematic, common, self._calibration))
        return common if self._calibration is None else self._calibration.applied(common), std


def _std(
    of_estimate: Callable[[], FloatArray],
    systematic: Callable[[FloatArray, FloatArray], FloatArray],
    pressure_kpa: FloatArray,
    calibration: Calibration | None,
) -> FloatArray:
    """The estimator's standard deviation, with errors it cannot see: unknown rest resistances and ADC steps."""
    std = systematic(pressure_kpa, of_estimate())
    return std if calibration is None else calibration.applied_std(pressure_kpa, std)
