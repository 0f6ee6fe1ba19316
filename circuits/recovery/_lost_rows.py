"""Interval bounds on what rows with readings at a limit do to other cells, where followers drive all idle lines.

A follower holds every idle line near the sensed column's potential. A row with a possible short is idle in the readings
of all other rows, and then joins lines that stand at nearly the same potential. Its cells, whatever they are, reach a
reading of another row in these ways only:

* the sensed column's current has a way past the column's lead, through the lost row to its idle terminal;
* the follower of finite gain is off by V / (1 + A) and its offset, which drives current through them;
* the selected row's current into an idle column lifts this column by the column's lead, and thereby the lost row, by
  whose cell in the sensed column current enters that column;
* this lift, where the lost row takes it away, changes what the selected row's own lead loses;
* the same currents pass known idle rows, which is smaller still and within a margin.

Each is bounded for all fillings of the lost rows that their readings allow: cells at a limit may be shorts, and
the others no more than their readings tell, times what their row's lead may lose to the shorts.
"""

from __future__ import annotations

from math import inf

import numpy as np

from ...arrays import BoolArray, FloatArray
from .._parts import LEAST_SHORT_OHM
from ._coupled_board import CoupledBoard, Frame

_MOST_DIVISION = 1.1  # of a column's readings by shorts of a row: further divided, shorts read like ordinary cells
_MARGIN = 1.5  # for what the first-order bounds leave out


class LostRows:
    """What rows that are left out may do to the other cells of one board."""

    def __init__(self, parts: CoupledBoard) -> None:
        """For a board."""
        board = parts.board
        self._board = board
        self._lead = parts.lines.to_driver[:, 0]  # ohm, of rows
        self._column_lead = np.broadcast_to(board.column_lead, parts.shape[1:])
        self._reference = np.broadcast_to(board.reference, parts.shape[1:])
        self._off_share = np.broadcast_to(board.inverse_gain, parts.shape[1:])  # of V, by which idle lines are off
        self._off = np.abs(
            np.broadcast_to(board.follower_lift, parts.shape[1:])
        )  # V, by which they are off whatever V is
        divided = 1.0 + self._reference * self._off_share / (self._column_lead + LEAST_SHORT_OHM)
        imitated = bool(self._lead.any()) and float(divided.max()) > _MOST_DIVISION
        plain = parts.quick.is_quick and not board.faults
        self.applies = board.circuit.drives_idle_lines and plain and not imitated
        """whether the bounds hold for the board, and its readings at limits show which cells may be shorts"""

    def change(self, frame: Frame, rows: BoolArray, at_limit: BoolArray, conductance: FloatArray) -> FloatArray:
        """Most relative change (n,) of the other cells' conductances; that of cells in lost rows means nothing.

        Args:
            frame: the readings.
            rows: (N,) lost ones.
            at_limit: (N, M) readings at a limit.
            conductance: (N, M) S of the cells as they are taken, those in lost rows with usual values.

        """
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            known = conductance[~rows].sum(axis=0)
            most = self._most_conductance(frame, rows, at_limit, conductance, known)
            # What is off in the lost rows' own readings by the followers' error depends on the lost rows in turn.
            idle = known + self._through(most, rows)
            most = self._most_conductance(frame, rows, at_limit, conductance, idle)
            changed = self._change(frame, most, conductance, rows)
        changed[np.isnan(changed)] = inf
        return _MARGIN * changed.ravel()

    def _most_conductance(
        self, frame: Frame, rows: BoolArray, at_limit: BoolArray, conductance: FloatArray, idle: FloatArray
    ) -> FloatArray:
        """S (P, M), the most that the cells of lost rows can be, with ``idle`` (M,) S from columns to idle lines."""
        board, lead, limited = self._board, self._lead[rows][:, None], at_limit[rows]
        signal = frame.signal[rows] + frame.error
        seen = board.circuit.apparent_conductance(board, signal)  # between the row's driver and the column's end
        # What its follower's error may have kept out of the reading.
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
        """S (M,), from a column to all idle lines by way of lost rows: no more than these rows' own ways on."""
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
