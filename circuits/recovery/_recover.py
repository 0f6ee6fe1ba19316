"""Inverse problem of a scan: cell resistances from the readings, with an interval for each cell.

Methods
-------
Independent columns have a closed-form solution (:mod:`._independent_columns`). Columns are independent if the row
lines have no resistance and the column lines have none between their cells.

All other boards are solved by fixed-point iteration and Newton's method (:mod:`._inversion`).

Both methods bound the error of every cell. A cell counts as read if its relative error is at most 10,000 times the
requested accuracy.

Unknown cells
-------------
Two kinds of cells are unknown:

* A cell whose reading is at a limit. The reading bounds the conductance on one side only. The conductance lies between
  the value that just reaches the limit and a short, or between that value and zero.
* A cell behind a complete break of its line. No reading depends on this cell alone. Its conductance lies between zero
  and a short.

Unknown cells get a status and the resistance NaN. They also disturb the other cells: the solution for the known cells
depends on the conductances of the unknown ones. We solve for the known cells at several values of the unknown
conductances; the interval of each known cell is the envelope of those solutions. Outputs stay within their supply
limits in all of these solutions.

For independent columns the envelope is exact. An unknown cell enters only through the sum of its column, and all other
cells are linear in that sum.

For other boards the envelope comes from numerical continuation (:mod:`._envelope`).
"""

from __future__ import annotations

from math import inf

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import BoolArray, FloatArray
from ...errors import InputError, SolverError
from .._board import Board, broken_off, cell_alone
from .._design import Design
from ..solvers import siemens
from ._answers import Answers, are_one, several_answers
from ._determined import TYPICAL_CONDUCTANCE, insensitive, is_singular
from ._envelope import MARGIN, Envelope
from ._frame_model import Model
from ._independent_columns import Columns, columns_are_independent
from ._inversion import Found, Inverter
from ._known_board import KnownBoard
from ._recovered import Recovery, Status
from ._unknown import Unknown

_LEAST_SHARE = 1e-9  # smallest share of the current at a crosspoint that a cell in parallel with a short must carry
_SHORT = 1e-3  # ohm: upper limit of the resistance that stands for a short, see _short()
_IDEAL_LINES_SHORT = 1e-15  # ohm that stands for a short between ideal lines
_READ_TOLERANCE = 1e4  # largest relative error of a cell that counts as read, over the requested accuracy


def recover(
    design: Design,
    volts: ArrayLike,
    *,
    accuracy: float = 1e-11,
    clipped: ArrayLike | None = None,
    least_ohm: float = 0.0,
) -> Recovery:
    """Recover the cell resistances of one frame from its readings.

    For a stream of frames use a :class:`Recoverer`.

    Args:
        design: the board, with the lines, faults, gains, offsets and bias currents that it has.
        volts: (rows, columns) V, as :func:`.scan` returns them.
        accuracy: the iteration stops when measured and modelled apparent conductances differ by at most this relative
            amount. A cell counts as read if its relative error is at most 10,000 times this accuracy.
        clipped: (rows, columns) True where the reading is at a limit of the converter. The limit is the nearer end of
            the range. Without an [adc] in the design, the reading may be at either limit. Outputs at a supply limit
            are recognised without this argument.
        least_ohm: lower bound in ohm of all cells. With the default of 0 an unknown cell may be a short, and then the
            other cells of its column have wide intervals.

    Raises:
        InputError: wrong shape, or NaN.
        SolverError: no cell resistances reproduce these readings, or the design does not determine the cells.

    """
    return Recoverer(design, accuracy=accuracy, least_ohm=least_ohm)(volts, clipped=clipped)


class Recoverer:
    """:func:`recover` for a stream of frames.

    Each frame starts from the solution of the previous frame and reuses its factored Jacobian.
    """

    def __init__(self, design: Design, *, accuracy: float = 1e-11, least_ohm: float = 0.0) -> None:
        """As :func:`recover`."""
        if not least_ohm >= 0:
            raise InputError(f"least_ohm is {least_ohm}; expected ohm >= 0")
        if why := design.board.circuit.ambiguity(design.board):
            raise SolverError(f"the cells cannot be recovered from readings: {why}")
        self._design, self._accuracy = design, accuracy
        self._board = board = design.board
        self._independent_columns = columns_are_independent(board)
        self._least_ohm, self._short = least_ohm, _IDEAL_LINES_SHORT if self._independent_columns else _short(board)
        self._series, self._cut_off = board.series_ohms, broken_off(board)
        # Faults in series or in parallel with a cell are left out of the model: we recover the combination and subtract
        # the fault in _result(). Two cases stay in the model. A complete short hides its cell, and in a continuous
        # sheet the current in parallel with a short is not the current of one cell.
        self._shunts = [fault for fault in board.shorts if fault.ohms > 0 and not board.continuous]
        kept = [
            fault
            for fault in design.fault
            if fault.kind != "open-cell" and (fault.kind != "shorted-cell" or fault.ohms == 0 or board.continuous)
        ]
        if any(fault.ohms == 0 for fault in board.shorts + board.bridges):
            # Parts of 0 ohm can hide further cells. The test has a threshold, because a cell at the end of a long
            # divider may change its own reading very little without being hidden.
            self._cut_off |= insensitive(board, np.full(board.shape, TYPICAL_CONDUCTANCE))
        self._undetermined = any(fault.ohms == 0 for fault in board.bridges) and is_singular(board, ~self._cut_off)
        self._unread = self._cut_off.copy()
        for fault in board.shorts:
            self._unread[fault.place] |= fault.ohms == 0
            self._cut_off[fault.place] &= fault.ohms > 0
        self._model = Model(design.replace(fault=tuple(kept)))
        # A follower leaves other answers only beside shorts; of columns in groups no bounds are known.
        several = several_answers(board) and board.shared_by >= board.shape[1]
        several = several and not (board.circuit.drives_idle_lines or board.floating)
        self._answers = Answers(KnownBoard(board), least_ohm) if several else None
        self._inverter = Inverter(self._model, self._unread, accuracy)
        self._envelope = Envelope(self._model, self._unread, accuracy, self._most)

    def __call__(self, volts: ArrayLike, *, clipped: ArrayLike | None = None) -> Recovery:
        """As :func:`recover`."""
        if self._undetermined:
            raise SolverError("the readings do not determine the cells: lines joined by 0 ohm read as one")
        board = self._board
        measured = board.transpose(_checked(self._design, volts))
        limits = self._limits(
            measured, None if clipped is None else board.transpose(np.asarray(clipped, dtype=np.bool_))
        )
        columns = Columns.of(board, measured) if self._independent_columns else None
        found = self._inverter(measured) if columns is None else columns.found(limits.any)
        lost = np.isnan(found.conductance)
        found.conductance[lost] = 0.0
        # A shorted cell pulls its column to the drive potential and hides the other cells of the column.
        shorted = np.zeros_like(lost)
        if columns is not None:
            shorted = lost & (np.abs(columns.potential - board.drive) <= 1e-6 * abs(board.drive))
        # If the reference is a supply limit, the output of an open cell is at this limit with no signal at all. Such a
        # cell is not limited.
        signal = np.abs(measured - board.level) > 1e-9 * abs(board.drive)
        conducting = signal | (found.conductance > 0)
        limited = Unknown(limits.at_least & conducting, limits.at_most & conducting)
        # An offset can leave a reading that would need a negative conductance. The gain of the offset depends on all
        # cells of the column, so the cell is unknown if another cell of its column is.
        offset = found.clamped & (limited.any | self._cut_off).any(axis=0)
        unknown = Unknown(limited.at_least | self._cut_off | offset, limited.at_most & (found.conductance > 0))
        low, high = np.maximum(found.conductance - found.error, 0.0), found.conductance + found.error
        if columns is None and found.conductance.max(initial=0.0) >= 1.0 / self._short:
            # A shorted cell can fix the potentials of its lines. The other cells of these lines then read as open,
            # whatever their resistances.
            silent = (found.conductance == 0) & ~unknown.any
            if silent.any():
                hidden = silent & insensitive(board, found.conductance)
                unknown = Unknown(unknown.at_least | hidden, unknown.at_most)
                lost = lost | hidden
        if self._answers is not None:
            least, greatest = self._answers(measured, self._accuracy * abs(board.drive))
            several = ~are_one(least, greatest)
            low, high = np.where(several, least, low), np.where(several, greatest, high)
        if unknown.any.any():
            down, up = (
                self._envelope.distance(measured, found, unknown)
                if columns is None
                else columns.spread(found, unknown, self._most(found.conductance))
            )
            low, high = np.maximum(low - MARGIN * down, 0.0), high + MARGIN * up
        behind_short = lost & shorted.any(axis=0) & ~shorted & ~limited.any
        return self._result(found, low, high, lost | limited.any, shorted & ~limited.any, behind_short)

    def _most(self, conductance: FloatArray) -> FloatArray:
        """Largest conductance in S (N, M) of unknown cells that conduct at least ``conductance``."""
        if self._least_ohm:
            return np.maximum(conductance, 1.0 / self._least_ohm)
        return np.maximum(conductance / _SHORT, 1.0 / self._short)

    def _limits(self, measured: FloatArray, at_limit: BoolArray | None) -> Unknown:
        """Readings at a limit, split by whether they give a lower or an upper bound of their conductance."""
        top = bottom = np.zeros(measured.shape, dtype=np.bool_)
        if at_limit is not None:
            adc = self._design.adc
            middle = sum(adc.range) / 2 if adc else None
            top = at_limit if middle is None else at_limit & (measured > middle)
            bottom = at_limit if middle is None else at_limit & (measured <= middle)
        if self._board.circuit.has_amplifiers:
            low, high = self._board.supply
            top, bottom = top | (measured >= high), bottom | (measured <= low)
        if (self._board.drive > 0) == self._board.circuit.inverts:
            top, bottom = bottom, top
        # A saturated cell loads its column and amplifies the offset there by an unknown gain. Other cells of this
        # column that are at the lower limit have therefore no upper bound.
        return Unknown(top | (bottom & top.any(axis=0)), bottom)

    def _result(
        self,
        found: Found,
        low: FloatArray,
        high: FloatArray,
        lost: BoolArray,
        shorted: BoolArray,
        behind_short: BoolArray,
    ) -> Recovery:
        """Remove the known faults, and decide the status of each cell.

        Args:
            found: the solution.
            low: S (N, M), lower bound of the conductance.
            high: S (N, M), upper bound.
            lost: (N, M), readings that do not determine their cells.
            shorted: (N, M), cells recognised as shorts.
            behind_short: (N, M), cells that such a short hides.

        """
        shunt = np.zeros_like(low)
        for fault in self._shunts:
            shunt[fault.place] += siemens(fault.ohms)
        least, own, most = (cell_alone(self._board, value, shunt) for value in (low, found.conductance, high))
        middle = np.where(np.isfinite(most), (least + most) / 2, own)
        worth = _READ_TOLERANCE * self._accuracy
        none = (own == 0) & (most <= worth * np.maximum(found.target, 1e-6 * found.target.max(initial=0.0)))
        with np.errstate(divide="ignore", invalid="ignore"):
            resistance = np.where(none, inf, 1.0 / middle)
            uncertainty = np.where(none, 0.0, np.where(np.isfinite(most), (most - least) / (most + least), inf))
        status = np.where(uncertainty > worth, Status.DISTURBED, np.where(none, Status.OPEN, Status.READ))
        # A cell is hidden if a known short in parallel carries nearly all of the current.
        hidden = np.isinf(self._series) | self._unread
        hidden |= (shunt > 0) & (found.conductance - shunt < _LEAST_SHARE * found.conductance)
        status[hidden] = Status.HIDDEN
        status[lost] = Status.SATURATED
        status[behind_short] = Status.HIDDEN
        gone = hidden | lost
        resistance[gone], uncertainty[gone] = np.nan, inf
        status[shorted], resistance[shorted], uncertainty[shorted] = Status.READ, 0.0, 0.0
        turn = self._board.transpose
        return Recovery(
            resistance=turn(resistance),
            status=turn(status.astype(np.int8)),
            uncertainty=turn(uncertainty),
            residual=found.residual,
            iterations=found.iterations,
            factored=found.factored,
        )


def _short(board: Board) -> float:
    """Resistance in ohm that stands for a short: at most 1 percent of the smallest part of a line."""
    ohms = np.concatenate([board.row_ohms.ravel(), board.column_ohms.ravel()])
    return min(_SHORT, 0.01 * float(np.min(ohms, where=ohms > 0, initial=inf)))


def _checked(design: Design, volts: ArrayLike) -> FloatArray:
    try:
        measured = np.asarray(volts, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"readings are not numbers: {error}") from error
    if measured.shape != design.array.shape:
        raise InputError(f"readings have shape {measured.shape}, expected {design.array.shape} (rows, columns)")
    if not np.isfinite(measured).all():
        row, column = np.argwhere(~np.isfinite(measured))[0]
        raise InputError(f"reading at row {row}, column {column} is {measured[row, column]}; expected finite volts")
    return measured
