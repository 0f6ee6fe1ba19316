"""Estimates of one skin: a measurement becomes pressures and their standard deviations, with all known errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..cell import Cell, Estimator
from ..circuits import Reason
from ..common.arrays import FloatArray, IntArray
from ..common.measurement import CONDUCTANCE, Measurement
from ._calibration import Calibration
from ._column_steps import ColumnSteps
from ._rest import Rest

_NO_CURRENT = int(Reason.NO_CURRENT)


class Estimate:
    """The estimator of one skin with certain rest resistances, from its start on."""

    def __init__(
        self,
        cell: Cell,
        shape: tuple[int, int],
        name: str | None,
        rest: Rest,
        calibration: Calibration | None,
        beside: IntArray | None = None,
    ) -> None:
        """Start without a memory of loads, with the rest resistances that are in use now.

        ``beside``: see :meth:`ohmskin.cell.Cell.estimator`.
        """
        self.estimator: Estimator = cell.estimator(
            shape, name, rest_resistance_ohm=rest.ohm, rest_error=rest.error, beside=beside
        )
        self._rest, self._calibration = rest, calibration
        self._column_steps = ColumnSteps(self.estimator.rest_ohm, self.estimator.side, rest_known=rest.known)
        self._open_at_rest = cell.open_at_rest
        self._as_sent = not (cell.open_at_rest or self._column_steps.are_removed)
        """nothing is changed in measurements"""
        self.doubt_rest()

    def doubt_rest(self) -> None:
        """Take the present doubt of rest resistances into account."""
        if not self._rest.known:
            self.estimator.rest_error = self._rest.spread

    def take(self, elapsed_s: Sequence[float], measured: Sequence[Measurement]) -> tuple[FloatArray, FloatArray]:
        """Pressures (frames, rows, columns) in kPa of the next frames, and their standard deviations.

        Args:
            elapsed_s: s since the frame before each.
            measured: of each frame.

        """
        if len(measured) == 1:
            pressure, std = self.estimator.estimate(elapsed_s[0], self._seen(measured[0]))
            pressure, std = pressure[None], std[None]
        else:
            blocks = np.stack([self._seen(each).block for each in measured])
            pressure, std = self.estimator.run_measured(np.array(elapsed_s), blocks)
        if self._calibration is not None:
            pressure, std = self._calibration.applied(pressure), self._calibration.applied_std(pressure, std)
        return pressure, std

    def _seen(self, measured: Measurement) -> Measurement:
        """The measurement as the estimator is to see it: where a cell is open at rest, no current is no load."""
        if self._as_sent:
            return measured
        seen = Measurement(measured.block.copy(), measured.reason)
        seen.block[CONDUCTANCE] = self._column_steps.without(measured)
        if self._open_at_rest:
            seen.block[CONDUCTANCE][measured.reason == _NO_CURRENT] = 0.0
        return seen
