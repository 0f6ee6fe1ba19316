"""Columns of dividers whose readings tell ratios of conductances only, and what these columns make of other cells.

The readings of a divider's column are to each other as the conductances D between its rows' drivers and the column are.
How large these are follows from what the reference resistor takes, which a column of good conductors hides in an ADC
step or in the noise. Linear uncertainties then reach only so far: where D grows tenfold, the rows' leads lose ten times
as much to the column, or join rows by way of it, and the readings of quite other cells are the same. No D is larger
than that of a short with its lead, which bounds both effects.
"""

from __future__ import annotations

import numpy as np

from ...arrays import FloatArray, IntArray
from ._coupled_board import CoupledBoard, Frame, Known
from ._linearised import Base

_LINEAR = 0.5  # uncertainty of a logarithm up to which linear uncertainties suffice
_MOST = 50.0  # the same that is as good as boundless
_LEAST_LEFT = 1e-6  # share of the drive that a row's lead leaves


class LooseColumns:
    """The columns of one board; dividers whose idle rows are driven."""

    def __init__(self, parts: CoupledBoard) -> None:
        """For a board."""
        self._parts = parts
        to_driver = parts.lines.to_driver
        self._lead = np.where(np.isfinite(to_driver), to_driver, 0.0)  # (N, M) ohm
        self._per_volt = np.abs(parts.board.circuit.conductance_slope(parts.board, np.zeros(parts.shape)))  # S/V
        self._loosest: tuple[Base | None, float] = None, 0.0  # largest deviation of a column's best conductor

    def disturb(
        self, frame: Frame, known: Known, base: Base, sigmas: float, by_shifts: FloatArray | None
    ) -> FloatArray | None:
        """Relative change (n,) of cells by columns whose conductances may be many times as large as they seem.

        Args:
            frame: the readings.
            known: the cells that have been found for them.
            base: the linear model about these.
            sigmas: standard deviations that an uncertainty covers.
            by_shifts: (n,) change of the logarithms by errors that all readings share; None: by nothing.

        Returns:
            None where there are no such columns.

        """
        if self._loosest[0] is not base:
            log = base.log.reshape(self._parts.shape)
            best = log.argmax(axis=0), np.arange(log.shape[1])
            self._loosest = base, float(base.std.reshape(log.shape)[best].max())
        if by_shifts is None and sigmas * self._loosest[1] <= _LINEAR:
            return None
        best = frame.signal.argmax(axis=0), np.arange(frame.signal.shape[1])
        spread = sigmas * base.std.reshape(self._parts.shape)[best]
        if by_shifts is not None:
            spread = spread + by_shifts.reshape(self._parts.shape)[best]
        spread = np.minimum(spread, _MOST)
        loose = np.flatnonzero(spread > _LINEAR)
        if not loose.size:
            return None
        conductance = self._parts.board.cell_conductance(known.cells)
        share = self._share(frame, conductance, loose, np.expm1(spread[loose]) - spread[loose])
        return share.ravel()

    def _share(self, frame: Frame, conductance: FloatArray, loose: IntArray, grown: FloatArray) -> FloatArray:
        """Relative change (N, M) of the cells.

        Args:
            frame: the readings.
            conductance: (N, M) S of all cells.
            loose: (L,) numbers of the columns.
            grown: (L,) what their conductances may grow by, beyond the linear law and relative to their size.

        """
        signal, lead = frame.signal[:, loose], self._lead[:, loose]
        row, each = signal.argmax(axis=0), np.arange(len(loose))
        least = np.maximum(signal[row, each] - frame.error, np.finfo(np.float64).tiny)
        ratio = np.minimum((signal + frame.error) / least, 1.0)
        with np.errstate(divide="ignore", over="ignore"):
            most = np.minimum(conductance[row, loose] * grown, 1.0 / lead[row, each])
        with np.errstate(invalid="ignore", over="ignore"):
            # Of a row's voltage, what its lead takes of a current into the column; and out of it, by the other rows.
            into = np.nan_to_num(np.minimum(most * ratio * lead, 1.0), nan=0.0)
            out = np.nan_to_num(most * (ratio.sum(axis=0) - ratio) * lead, nan=0.0, posinf=1.0)
        lost = np.minimum(into, out).sum(axis=1)
        # A column at its share of the drive lifts the idle rows, whose cells feed all other columns.
        lifted = (ratio / ratio.sum(axis=0)) @ into.T
        np.fill_diagonal(lifted, 0.0)
        # Readings of a row whose lead loses nearly everything to the column tell next to nothing of its other cells.
        follows = np.maximum(signal - frame.error, 0.0) / (signal + frame.error).sum(axis=0)  # the row, by the column
        left = np.maximum(1.0 - into * (1.0 - follows), _LEAST_LEFT)
        more = 1.0 + (1.0 / left - 1.0).sum(axis=1)
        told = (conductance + frame.error * self._per_volt) * more[:, None]
        share: FloatArray = lost[:, None] + (lifted @ told) / np.maximum(conductance, np.finfo(np.float64).tiny)
        return share
