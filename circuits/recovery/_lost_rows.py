"""Interval bounds on the effect of rows with readings at a limit, on boards whose followers drive all idle lines.

A follower holds every idle line near the sensed column's potential. A row with a possible short is idle in the readings
of all other rows, and then connects lines of nearly the same potential. Its cells, whatever they are, affect a reading
of another row only in these ways:

* The sensed column's current can pass the column's lead, through the lost row to its idle terminal.
* The follower of finite gain is off by V / (1 + A) and its offset, which drives current through these cells.
* The selected row's current into an idle column lifts this column by the column's lead. The column lifts the lost row,
  whose cell in the sensed column then carries current into that column.
* Where the lost row reduces this lift, the loss in the selected row's own lead changes.
* The same currents pass known idle rows. This effect is smaller still, and within a margin.

Each effect is bounded for all cells of the lost rows that their readings allow. Cells at a limit may be shorts. The
others conduct at most what their readings say, times the factor by which the shorts may load their row's lead.
"""

from __future__ import annotations

from math import inf

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._parts import LEAST_SHORT_OHM
from ._coupled_board import CoupledBoard, Frame

_MOST_DIVISION = 1.1  # largest division of a column's readings by shorts of a row: with more, shorts read like cells
_MARGIN = 1.5  # for effects beyond the first-order bounds


class LostRows:
    """Effect of rows that are left out on the other cells of one board."""

    def __init__(self, parts: CoupledBoard) -> None:
        """For a board."""
        board = parts.board
        self._board = board
        self._lead = parts.lines.to_driver[:, 0]  # ohm, of rows
        self._column_lead = np.broadcast_to(board.column_lead, parts.shape[1:])
        self._reference = np.broadcast_to(board.reference, parts.shape[1:])
        self._off_share = np.broadcast_to(board.inverse_gain, parts.shape[1:])  # error of idle lines, as a share of V
        self._off = np.abs(
            np.broadcast_to(board.follower_lift, parts.shape[1:])
        )  # V, constant error of idle lines, whatever V is
        divided = 1.0 + self._reference * self._off_share / (self._column_lead + LEAST_SHORT_OHM)
        imitated = bool(self._lead.any()) and float(divided.max()) > _MOST_DIVISION
        plain = parts.quick.is_quick and not board.faults
        self.applies = board.circuit.drives_idle_lines and plain and not imitated
        """whether the bounds hold for the board, and its readings at limits show which cells may be shorts"""

    def change(self, frame: Frame, rows: BoolArray, at_limit: BoolArray, conductance: FloatArray) -> FloatArray:
        """Largest relative change (n,) of the other cells' conductances; values for cells in lost rows mean nothing.

        Args:
            frame: the readings.
            rows: (N,) lost ones.
            at_limit: (N, M) readings at a limit.
            conductance: (N, M) S, assumed for the cells, with usual values in lost rows.

        """
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            known = conductance[~rows].sum(axis=0)
            most = self._most_conductance(frame, rows, at_limit, conductance, known)
            # The followers' error in the lost rows' own readings depends on the lost rows in turn.
            idle = known + self._through(most, rows)
            most = self._most_conductance(frame, rows, at_limit, conductance, idle)
            changed = self._change(frame, most, conductance, rows)
        changed[np.isnan(changed)] = inf
        return _MARGIN * changed.ravel()

    def _most_conductance(
        self, frame: Frame, rows: BoolArray, at_limit: BoolArray, conductance: FloatArray, idle: FloatArray
    ) -> FloatArray:
        """Upper bounds in S (P, M) of the cells of lost rows, with ``idle`` (M,) S from columns to idle lines."""
        board, lead, limited = self._board, self._lead[rows][:, None], at_limit[rows]
        signal = frame.signal[rows] + frame.error
        seen = board.circuit.apparent_conductance(board, signal)  # between the row's driver and the column's end
        # Part of the current that the follower's error may have kept out of the reading.
        off = self._off_share * signal + self._off
        seen = np.where(limited, 0.0, seen + idle * off / np.maximum(abs(board.drive) - signal, frame.error))
        to_shorts = np.where(limited, 1.0 / (self._column_lead + LEAST_SHORT_OHM), 0.0).sum(axis=1, keepdims=True)
        total = seen.sum(axis=1, keepdims=True)
        load = (to_shorts + total) / np.maximum(1.0 - lead * total, 0.0)
        inner = seen * (1.0 + lead * load)
        # The column's other cells take a part of the current before the column's lead.
        inner = inner * (1.0 + self._column_lead * idle)
        most: FloatArray = inner / np.maximum(1.0 - self._column_lead * inner, 0.0)
        most[np.isnan(most)] = inf
        most = np.where(limited, 1.0 / LEAST_SHORT_OHM, np.minimum(most, 1.0 / LEAST_SHORT_OHM))
        return np.maximum(most, conductance[rows])

    def _through(self, most: FloatArray, rows: BoolArray) -> FloatArray:
        """S (M,) from a column to all idle lines through lost rows, limited by these rows' further connections."""
        ways = most / (1.0 + self._column_lead * most)
        onward = 1.0 / self._lead[rows][:, None] + ways.sum(axis=1, keepdims=True) - ways
        through: FloatArray = np.where(most > 0.0, 1.0 / (1.0 / most + 1.0 / onward), 0.0).sum(axis=0)
        return through

    def _change(self, frame: Frame, most: FloatArray, conductance: FloatArray, rows: BoolArray) -> FloatArray:
        """(N, M) relative changes by cells of at most ``most`` (P, M) in S in the lost rows."""
        lead, columns, through = self._lead[rows][:, None], self._column_lead, self._through(most, rows)
        left = np.maximum(abs(self._board.drive) - frame.signal - frame.error, frame.error)  # V over the cell
        followed = through * (self._off_share * self._reference + self._off / (conductance * left))
        # From an idle column, lifted by its lead, to the lost row, and from there into the sensed column.
        taken = columns * most / (1.0 + columns * most)
        entering = lead * most / (1.0 + lead * most)
        shared = taken.T @ entering
        np.fill_diagonal(shared, 0.0)
        entered = (conductance @ shared) / conductance
        lifted = conductance**2 * columns * taken.max(axis=0)
        lost = self._lead[:, None] * lifted.sum(axis=1, keepdims=True)
        diverted = columns * through  # of the current at the sensed column's last crosspoint, from its own lead
        changed: FloatArray = followed + entered + lost + diverted
        return changed
