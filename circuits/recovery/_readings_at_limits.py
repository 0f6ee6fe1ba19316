"""Readings at a limit, where a cell may be a short: which readings a fit leaves out, and the error this leaves.

At a limit no derivative describes the effect of a short on all other cells. On most coupled boards a frame with a
reading at a limit therefore determines no cell. With driven idle rows and no amplifiers, columns meet only in the leads
of the rows. The columns of such readings are then left out, and the uncertainty of the others includes the change that
the leads allow.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...errors import SolverError
from ._coupled_board import CoupledBoard, Frame
from ._gauss_newton import Convergence

_SHORT = 8.0  # half steps and noise: a cell this close to the reading of a short may be one
_SHORT_SHARE = 0.998  # of the reading of a short, likewise
_HEAVY_CELL = 0.8  # of a short's reading, from which on a line is left out if the last frame did not settle
_ONE_OF_SOME = 0.2  # the same if two frames did not, since several cells of a few ohm share a reading
_LEFT_OUT = 300  # frames until a line that has been left out is tried again
_SUDDEN = 2  # frames after which a noise that has begun is known
_LEAST_SIEMENS = 1e-200  # of a cell that conducts nothing, so that no ratio overflows
_BOUNDLESS = 1e50  # 1/V, where a lead without resistance leaves no bound
_MOST_SHARE = 1e100  # so that no multiple of it overflows
_BY_LEADS = 1.5  # largest change by the leads, over the share of a voltage that they lose


class Selection(NamedTuple):
    """Readings that a frame's fit leaves out. Arrays are (N, M) unless said otherwise."""

    tells: bool
    """whether the frame determines any cell"""
    at_limit: BoolArray
    """readings at a limit"""
    lost: BoolArray | None
    """(M,) columns that are left out; None: there are none"""
    beside: BoolArray
    """cells that the frame does not determine: those of lost lines and of columns that no amplifier holds"""
    lost_rows: BoolArray | None
    """(N,) rows that are left out; None: there are none"""
    ignored: BoolArray | None
    """(n,) readings that do not count; None: all of them count"""


class ReadingLimits:
    """Finds the readings of one board that are at limits, and the lines that a fit leaves out."""

    def __init__(self, parts: CoupledBoard, *, nearly_independent: bool, loses_rows: bool) -> None:
        """For a board.

        Args:
            parts: the board.
            nearly_independent: whether its columns hardly load each other.
            loses_rows: whether other rows can be known without rows that have a reading at a limit.

        """
        self._loses_rows = loses_rows
        board = parts.board
        self._parts, self._board = parts, board
        self._gone = parts.gone.reshape(parts.shape)
        # V of a short alone, inf with ideal lines and amplifiers; and the largest voltage that any cells can give
        leads = np.broadcast_to(board.row_ohms[:, :1] + board.column_lead, parts.shape)
        self._short_signal = np.abs(board.circuit.ideal_volts(board, parts.leads) - board.level)
        most = np.abs(board.circuit.ideal_volts(board, leads) - board.level)
        self._most_signal = most + 2.0 * np.abs(board.offset)
        if board.circuit.drives_idle_lines:
            # Idle lines connected to a column by hardly more than leads lift it by the offset times the gain.
            with np.errstate(divide="ignore", invalid="ignore"):
                lifted = np.nan_to_num(np.abs(board.offset) / board.inverse_gain, nan=0.0, posinf=np.inf)
            self._most_signal = self._most_signal + lifted
        self._beyond = 0  # frames in a row with readings that no cells give
        self._loses_columns = (
            nearly_independent and parts.quick.is_quick and not board.circuit.has_amplifiers and not board.faults
        )
        self.nowhere = np.zeros(parts.shape, dtype=np.bool_)
        """(N, M) all False: a usual frame's selection leaves out nothing"""
        self._least_signals = float(np.min(self._short_signal)), float(np.min(self._most_signal))  # V
        self._along = 1 if loses_rows else 0  # axis along which lines are left out
        self._left_out = np.zeros(parts.shape[1 - self._along], dtype=np.bool_)  # columns or rows
        self._leaves_out = 0  # frames for which they stay left out

    def select(
        self, signal: FloatArray, limited: BoolArray | None, error: float, convergence: Convergence
    ) -> Selection:
        """Choose the readings that count.

        Args:
            signal: (N, M) V, distance of the readings from the reference voltage.
            limited: (N, M) where the converter or the output is at a limit; None: nowhere.
            error: V by which a reading may be off.
            convergence: how the fits of the last frames went.

        Raises:
            SolverError: no cells of this board give readings that large.

        """
        reported = self.nowhere if limited is None else limited
        if self._parts.mixes and self._parts.any_hidden:
            return _nothing(reported)
        if limited is None and self._is_usual(signal, error, convergence):
            ignored = self._parts.hidden if self._parts.any_hidden else None
            return Selection(True, self.nowhere, None, self.nowhere, lost_rows=None, ignored=ignored)
        at_limit = self._at_limit(signal, reported & ~self._gone, error)
        if self._loses_rows:
            return self._without_rows(signal, at_limit, convergence)
        lost = self._lost_columns(signal, at_limit, convergence)
        any_lost = bool(lost.any())
        if any_lost and not (self._loses_columns and not lost.all()):
            return _nothing(at_limit)
        expected = reported & self._gone
        beside = np.repeat(lost[None], len(at_limit), axis=0)
        if self._board.circuit.has_amplifiers:
            # A known short's amplifier at its limit does not hold its column; other columns then change.
            beside |= np.any(expected & self._parts.shorted, axis=1, keepdims=True)
            if self._board.floating and beside.any():
                return _nothing(reported)
        ignored = (expected | beside).ravel() | self._parts.hidden
        return Selection(
            tells=True,
            at_limit=at_limit,
            lost=lost if any_lost else None,
            beside=beside,
            lost_rows=None,
            ignored=ignored if ignored.any() else None,
        )

    def _without_rows(self, signal: FloatArray, at_limit: BoolArray, convergence: Convergence) -> Selection:
        """Select readings without rows that have one at a limit, and without rows that keep the others from settling.

        Args:
            signal: (N, M) V.
            at_limit: (N, M) readings at a limit.
            convergence: how the fits of the last frames went.

        """
        self._leave_out(signal, convergence)
        rows: BoolArray = np.logical_or.reduce(at_limit, axis=1)
        together = rows | self._left_out
        if not together.all():
            rows = together
        if rows.all():
            return _nothing(at_limit)
        if not rows.any():
            return Selection(True, at_limit, None, self.nowhere, lost_rows=None, ignored=None)
        beside = np.repeat(rows[:, None], at_limit.shape[1], axis=1)
        return Selection(True, at_limit, None, beside, lost_rows=rows, ignored=beside.ravel())

    def _is_usual(self, signal: FloatArray, error: float, convergence: Convergence) -> bool:
        """Whether no reading is near a limit, and no line is left out: a quick test, true in nearly all frames."""
        if (self._loses_columns or self._loses_rows) and (convergence.astray or np.count_nonzero(self._left_out)):
            return False
        short, most = self._least_signals
        largest = signal.item(signal.argmax())
        if largest < min(short - _SHORT * error, _SHORT_SHARE * short, most + _SHORT * error):
            return True
        below = np.minimum(self._as_a_short(error), self._most_signal + _SHORT * error)
        return not np.count_nonzero((signal >= below) & ~self._gone)  # several times as fast as any()

    def _at_limit(self, signal: FloatArray, limited: BoolArray, error: float) -> BoolArray:
        """(N, M) readings that are limited, or as large as a short's."""
        tells = ~self._gone
        beyond = ((signal > self._most_signal + _SHORT * error) & tells & ~limited).any()
        self._beyond = self._beyond + 1 if beyond else 0
        if self._beyond > _SUDDEN:
            raise SolverError("readings above that of a short; check that the design is that of the board")
        at_limit: BoolArray = limited | ((signal >= self._as_a_short(error)) & tells)
        return at_limit

    def _as_a_short(self, error: float) -> FloatArray:
        """V (N, M) from which on a reading with error ``error`` may be a short's."""
        return np.minimum(self._short_signal - _SHORT * error, _SHORT_SHARE * self._short_signal)

    def _lost_columns(self, signal: FloatArray, at_limit: BoolArray, convergence: Convergence) -> BoolArray:
        """Columns (M,) that are left out: with a reading at a limit, or keeping the others from settling."""
        lost: BoolArray = np.logical_or.reduce(at_limit, axis=0)
        if self._loses_columns:
            self._leave_out(signal, convergence)
            together = lost | self._left_out
            if not together.all():
                return together
        return lost

    def _leave_out(self, signal: FloatArray, convergence: Convergence) -> None:
        """If the board does not settle, choose lines to leave out: cells of a few ohm on them may be the reason.

        Args:
            signal: (N, M) V.
            convergence: how the fits of the last frames went.

        """
        share = (signal / self._short_signal).max(axis=self._along)
        self._left_out &= share >= _ONE_OF_SOME
        if not self._left_out.any():
            self._leaves_out = 0
        elif self._leaves_out <= 0:
            self._left_out[:] = False  # and try again
        self._leaves_out -= 1
        if convergence.restarted:  # the lines left out may be what keeps the others from settling
            self._left_out[:] = False
            return
        again = convergence.astray_since_start > 1
        if again or (convergence.astray and not convergence.fresh):
            found = share >= (_ONE_OF_SOME if again else _HEAVY_CELL)
            if found.any():
                self._left_out |= found
                self._leaves_out = _LEFT_OUT

    @np.errstate(over="ignore")  # infinite values stay infinite
    def by_lost_columns(self, frame: Frame, lost: BoolArray, conductance: FloatArray) -> FloatArray:
        """Relative change (n,) of other columns' cells if the lost columns are not the usual ones assumed here.

        With driven idle rows, columns meet only in the leads of the rows. The readings of a column have the ratios of
        its conductances D to the rows' drivers, and no D is larger than 1/lead. The product of a D of the column and a
        lead is therefore at most the reading over the largest reading, that of the cell at its limit. This bounds the
        share of a voltage that the leads lose to the column, or bring into other columns through it.

        Args:
            frame: the readings.
            lost: (M,) columns with cells at their limits.
            conductance: (N, M) S, assumed for the cells.

        """
        board, lead, columns = self._board, self._parts.lines.to_driver, np.flatnonzero(lost)
        most, off = float(lead.max()), frame.error
        readings = frame.signal[:, lost]
        row = readings.argmax(axis=0)  # of the cell at its limit, in each of the columns
        largest = np.maximum(readings.max(axis=0) - off, np.finfo(np.float64).tiny)
        with np.errstate(divide="ignore", invalid="ignore"):
            per_volt = np.nan_to_num(most / lead[row, columns] / largest, nan=0.0, posinf=_BOUNDLESS)
        steeper = 1.0 + conductance.max(axis=0) / conductance  # contributions of other rows over the cell's own
        # A selected row loses the current of its own cell to the column; it leaves by the cell at its limit.
        passed = (readings + off) * per_volt
        passed[row, np.arange(len(row))] = 0.0
        by_row = passed.sum(axis=1) + most * conductance[:, lost].sum(axis=1)
        share: FloatArray = by_row[:, None] * steeper
        # When the row of that cell is selected, the column is at the drive, and feeds all other rows.
        for place, each, column in zip(row, per_volt, columns, strict=True):
            fed = frame.signal[:, column] * each
            fed[place] = sqrt(len(fed)) * off * each
            if not board.circuit.columns_one_by_one(board):
                fed[place] += most / (board.reference[column] + board.column_lead[column])
            share[place] += fed.sum() + fed @ conductance / np.maximum(conductance[place], _LEAST_SIEMENS)
        changed: FloatArray = _BY_LEADS * np.minimum(share, _MOST_SHARE)
        return changed.ravel()


def _nothing(at_limit: BoolArray) -> Selection:
    """No reading determines a cell."""
    return Selection(False, at_limit, None, np.ones_like(at_limit), lost_rows=None, ignored=None)
