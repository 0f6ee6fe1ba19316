"""Inverse problem of a scan: cell resistances from the readings, with an interval for each cell.

Methods
-------
Independent columns have a closed-form solution (:class:`_Columns`). Columns are independent if the row lines have no
resistance and the column lines have none between their cells. An output then fixes the potential at the cells of its
column, and the remaining equations are linear.

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

For other boards the envelope comes from numerical continuation: the unknown conductances move in steps from their
recovered values to the far end of their range. This envelope is supported by an argument and by tests, not by a proof.
If all known cells were fixed, every potential would be a Moebius function of one unknown conductance. A Moebius
function is monotone between its poles, so the two ends of the range would suffice. The known cells are not fixed,
because they have to keep reproducing their own readings. Their motion is a second-order effect of either sign. Four
measures allow for this effect:

1. Two intermediate points are solved as well (:data:`_CONTINUATION_FACTORS`).
2. A share of the product of the largest changes on a cell's two lines is added (:data:`_COUPLING_SHARE`).
3. All intervals are widened by a safety factor (:data:`_MARGIN`).
4. Several unknown cells can compensate each other. They therefore move together first, then one group of lines at a
   time. The changes from the groups are added with equal signs.

Sometimes no conductances of the known cells reproduce the readings at the far end. Cells that have moved before this
point then get an unbounded interval. The tests draw unknown cells at random and check that the known cells lie within
their intervals.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...arrays import BoolArray, FloatArray
from ...errors import InputError, SolverError
from .._board import Board, broken_off, cell_alone
from .._design import Design
from .._sensitivity import LARGEST, board_sensitivity
from ..solvers import ULP, siemens
from ._inversion import Factor, Found, Held, Inverter, Model

_LEAST_SHARE = 1e-9  # smallest share of the current at a crosspoint that a cell in parallel with a short must carry
_SHORT = 1e-3  # ohm: upper limit of the resistance that stands for a short, see _short()
_IDEAL_LINES_SHORT = 1e-15  # ohm that stands for a short between ideal lines
_MARGIN = 2.0  # safety factor on the interval of a known cell if other cells are unknown
_CONTINUATION_FACTORS = (6.0, 40.0, inf)  # unknown over recovered conductance at the points of the continuation
_RETRIES = 1  # smaller steps to try after a continuation step that failed
_EXTRAPOLATION = 4.0  # factor on the changes of the known cells if the continuation ends early
# Relative change above which a cell gets an unbounded interval if the continuation ends early:
_UNBOUNDED_CHANGE = 1e-3  # because the iteration did not converge
_UNBOUNDED_CHANGE_NEGATIVE = 1e-7  # because a cell would need a negative conductance
_COUPLING_SHARE = 0.25  # second-order change of a cell over the product of the largest changes on its two lines
LARGEST_MATRIX = 1024  # cells: above this size a singular value decomposition of the Jacobian takes too long
_TYPICAL_CONDUCTANCE = 1e-4  # S of every cell when the design alone is tested for determined cells
_INSENSITIVE = 1e-6  # sensitivity of a reading to its own cell over the ideal one, below which it is rounding
_NOISE = 1e-3  # cell over apparent conductance: smaller cells may appear and vanish with the noise of readings
_MOST_GROUPS = 3  # groups of unknown cells that move one after another
_READ_TOLERANCE = 1e4  # largest relative error of a cell that counts as read, over the requested accuracy


class Status(IntEnum):
    """How well a recovered cell is known."""

    READ = 0
    OPEN = 1
    """The cell carries no current; its resistance is inf."""
    SATURATED = 2
    """The output or the converter is at a limit; the resistance is unknown and NaN."""
    DISTURBED = 3
    """The error bound :attr:`Recovery.uncertainty` exceeds 10,000 times the requested accuracy."""
    HIDDEN = 4
    """A fault of the design hides the cell from all readings; the resistance is NaN."""


@dataclass(frozen=True)
class Recovery:
    """Cells recovered from one frame. Arrays are (rows, columns)."""

    resistance: FloatArray
    """ohm"""
    status: NDArray[np.int8]
    """:class:`Status` of each cell"""
    uncertainty: FloatArray
    """Relative half-width of the interval of each cell's conductance.

    ``resistance`` belongs to the middle of this interval. A value of 1 means that the cell may be open, and inf means
    that nothing is known about the cell.
    """
    residual: float
    """largest relative difference between measured and modelled readings, as apparent conductances"""
    iterations: int
    """number of model evaluations that led to the solution; 0 for the closed form"""
    factored: int
    """number of Jacobians that were computed and factored"""


@dataclass(frozen=True)
class Conditioning:
    """Error propagation from the readings to the recovered resistances, to first order."""

    inverse: FloatArray
    """(NM, NM): relative change of each cell's resistance per relative change of each apparent resistance"""
    volts_to_relative: FloatArray
    """(N, M) 1/V: magnitude of the relative change of an apparent resistance per volt of its reading"""
    resistance: FloatArray
    """(N, M) ohm of the cells at which the derivatives hold; cells that are NaN or inf were left out"""

    @property
    def amplification(self) -> FloatArray:
        """(N, M): standard deviation of each cell if all readings have independent errors of relative size 1.

        An ideal board has 1 everywhere. Cells that were left out are NaN.
        """
        total = np.sqrt((self.inverse**2).sum(axis=1)).reshape(self.resistance.shape)
        return np.where(np.isfinite(self.resistance), total, np.nan)

    def resistance_std(self, volts_std: ArrayLike) -> FloatArray:
        """Standard deviation (N, M) of the resistances in ohm.

        Args:
            volts_std: standard deviation of the readings in V, a number or (N, M). Errors are independent.

        """
        relative = self.volts_to_relative * np.asarray(volts_std, dtype=np.float64)
        variance = self.inverse**2 @ relative.ravel() ** 2
        std: FloatArray = self.resistance * np.sqrt(variance).reshape(self.resistance.shape)
        return std


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


class _Unknown(NamedTuple):
    """Masks (N, M) of cells whose recovered conductance is only a lower or only an upper bound."""

    at_least: BoolArray
    at_most: BoolArray

    @property
    def any(self) -> BoolArray:
        return self.at_least | self.at_most

    def groups(self) -> list[_Unknown]:
        """Split the unknown cells by lines and by kind of bound.

        The split is by rows or by columns, whichever of the two has fewer lines with unknown cells.
        """
        rows, columns = (np.flatnonzero(self.any.any(axis=axis)) for axis in (1, 0))
        by_row = len(rows) <= len(columns)
        parts = []
        for some in np.array_split(rows if by_row else columns, min(_MOST_GROUPS, len(rows), len(columns))):
            inside = np.zeros_like(self.at_least)
            inside[(some, slice(None)) if by_row else (slice(None), some)] = True
            parts += [one for one in (self._of(inside, True), self._of(inside, False)) if one.any.any()]
        return parts

    def _of(self, inside: BoolArray, up: bool) -> _Unknown:
        nowhere = np.zeros_like(inside)
        return _Unknown(self.at_least & inside if up else nowhere, nowhere if up else self.at_most & inside)

    def moved(self, conductance: FloatArray, times: float, most: FloatArray) -> FloatArray:
        """Conductances in S (N, M) with the unknown cells moved by the factor ``times``.

        Args:
            conductance: S (N, M), as recovered.
            times: factor above a lower bound, and divisor below an upper bound.
            most: S (N, M), largest conductance of each cell.

        """
        ordinary = np.median(conductance[conductance > 0]) if (conductance > 0).any() else np.min(most)
        up = np.minimum(np.maximum(conductance, ordinary) * times, np.maximum(conductance, most))
        return np.where(self.at_least, up, np.where(self.at_most, conductance / times, conductance))


class Recoverer:
    """:func:`recover` for a stream of frames.

    Each frame starts from the solution of the previous frame and reuses its factored Jacobian.
    """

    def __init__(self, design: Design, *, accuracy: float = 1e-11, least_ohm: float = 0.0) -> None:
        """As :func:`recover`."""
        if not least_ohm >= 0:
            raise InputError(f"least_ohm is {least_ohm}; expected ohm >= 0")
        self._design, self._accuracy = design, accuracy
        self._board = board = design.board
        self._independent_columns = _columns_are_independent(board)
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
            self._cut_off |= _insensitive(board, np.full(board.shape, _TYPICAL_CONDUCTANCE))
        self._undetermined = any(fault.ohms == 0 for fault in board.bridges) and _is_singular(board, ~self._cut_off)
        self._unread = self._cut_off.copy()
        for fault in board.shorts:
            self._unread[fault.place] |= fault.ohms == 0
            self._cut_off[fault.place] &= fault.ohms > 0
        self._model = Model(design.replace(fault=tuple(kept)))
        self._inverter = Inverter(self._model, self._unread, accuracy)
        self._continuations: dict[tuple[int, float], Inverter] = {}
        self._path_ends: dict[int, tuple[BoolArray, float]] = {}

    def __call__(self, volts: ArrayLike, *, clipped: ArrayLike | None = None) -> Recovery:
        """As :func:`recover`."""
        if self._undetermined:
            raise SolverError("the readings do not determine the cells: lines joined by 0 ohm read as one")
        board = self._board
        measured = board.turn(_checked(self._design, volts))
        limits = self._limits(measured, None if clipped is None else board.turn(np.asarray(clipped, dtype=np.bool_)))
        columns = _Columns.of(board, measured) if self._independent_columns else None
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
        limited = _Unknown(limits.at_least & conducting, limits.at_most & conducting)
        # An offset can leave a reading that would need a negative conductance. The gain of the offset depends on all
        # cells of the column, so the cell is unknown if another cell of its column is.
        offset = found.clamped & (limited.any | self._cut_off).any(axis=0)
        unknown = _Unknown(limited.at_least | self._cut_off | offset, limited.at_most & (found.conductance > 0))
        low, high = np.maximum(found.conductance - found.error, 0.0), found.conductance + found.error
        if columns is None and found.conductance.max(initial=0.0) >= 1.0 / self._short:
            # A shorted cell can fix the potentials of its lines. The other cells of these lines then read as open,
            # whatever their resistances.
            silent = (found.conductance == 0) & ~unknown.any
            if silent.any():
                hidden = silent & _insensitive(board, found.conductance)
                unknown = _Unknown(unknown.at_least | hidden, unknown.at_most)
                lost = lost | hidden
        if unknown.any.any():
            down, up = (
                self._envelope_distance(measured, found, unknown)
                if columns is None
                else columns.spread(found, unknown, self._most(found.conductance))
            )
            low, high = np.maximum(low - _MARGIN * down, 0.0), high + _MARGIN * up
        behind_short = lost & shorted.any(axis=0) & ~shorted & ~limited.any
        return self._result(found, low, high, lost | limited.any, shorted & ~limited.any, behind_short)

    def _most(self, conductance: FloatArray) -> FloatArray:
        """Largest conductance in S (N, M) of unknown cells that conduct at least ``conductance``."""
        if self._least_ohm:
            return np.maximum(conductance, 1.0 / self._least_ohm)
        return np.maximum(conductance / _SHORT, 1.0 / self._short)

    def _limits(self, measured: FloatArray, at_limit: BoolArray | None) -> _Unknown:
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
        return _Unknown(top | (bottom & top.any(axis=0)), bottom)

    def _envelope_distance(
        self, measured: FloatArray, found: Found, unknown: _Unknown
    ) -> tuple[FloatArray, FloatArray]:
        """Distances in S (N, M) from ``found`` to the lower and upper envelope, see the module docstring."""
        known, groups = found.conductance, unknown.groups()
        down, up = [], []
        sides = [bool(group.at_least.any()) for group in groups]
        if max(sides.count(True), sides.count(False)) > 1:  # otherwise one group of a kind is all of it
            groups.insert(0, unknown)
        for number, some in enumerate(groups):
            visited = self._continue_to_far_end(measured, found, unknown, some, number)
            down.append(known - np.min(visited, axis=0))
            up.append(np.max(visited, axis=0) - known)
        less, more = (np.maximum(side[0], np.sum(side[1:], axis=0)) for side in (down, up))
        # Second-order coupling: through an unknown cell and back along another line. Its size is at most the product
        # of the changes on the two lines.
        moved = np.divide(np.maximum(less, more), known, out=np.zeros_like(known), where=(known > 0) & ~unknown.any)
        moved = np.minimum(moved, 1.0)
        around = _COUPLING_SHARE * known * moved.max(axis=1, keepdims=True) * moved.max(axis=0)
        return less + around, more + around

    def _continue_to_far_end(
        self, measured: FloatArray, found: Found, unknown: _Unknown, moving: _Unknown, number: int
    ) -> list[FloatArray]:
        """Solve by continuation while the unknown cells ``moving`` go to the far end of their range.

        Args:
            measured: V (N, M).
            found: the solution with all unknown cells at their recovered values.
            unknown: all unknown cells; those that are not ``moving`` keep their recovered values.
            moving: the cells that move.
            number: identifies this group of cells from frame to frame.

        Returns:
            Conductances in S, each (N, M), at the points of the continuation, starting with ``found``.

        """
        known = found.conductance
        visited, reached, most = [known], 1.0, self._most(known)
        # The search for the end of a continuation takes the time of many frames. If the same cells are unknown in the
        # next frame, we assume the same end.
        cells, end = self._path_ends.get(number, (None, inf))
        ended = cells is not None and bool((cells == unknown.any).all())
        pending, retries = (
            [times for times in _CONTINUATION_FACTORS if not ended or times < end],
            0 if ended else _RETRIES,
        )
        runaway = _UNBOUNDED_CHANGE
        while pending:
            times = pending[0]
            if (number, times) not in self._continuations:
                self._continuations[number, times] = Inverter(self._model, self._unread, 1e3 * self._accuracy)
            held = Held(unknown.any, moving.moved(known, times, most))
            there = self._continuations[number, times].beside(measured, held, visited[-1])
            # A known cell that conducted has reached zero, so it would need a negative conductance: there is no
            # physical solution at this point.
            if there is not None and ((known > _NOISE * found.target) & (there == 0) & ~unknown.any).any():
                there, runaway = None, _UNBOUNDED_CHANGE_NEGATIVE
            if there is not None:
                visited.append(there)
                reached = pending.pop(0)
            elif retries:
                retries -= 1
                pending.insert(0, reached * float(np.sqrt(min(times / reached, 100.0))))
            else:
                self._path_ends[number], ended, pending = (unknown.any, times), True, []
        if ended:  # no solution at the far end: extrapolate, or give up the bounds of cells that moved
            off = (np.abs(visited[-1] - known) > runaway * known) | (known == 0) | (reached < _CONTINUATION_FACTORS[0])
            onwards = np.maximum(known + _EXTRAPOLATION * (visited[-1] - known), 0.0)
            visited += [np.where(off, inf, onwards), np.where(off, 0.0, onwards)]
        return visited

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
        turn = self._board.turn
        return Recovery(
            resistance=turn(resistance),
            status=turn(status.astype(np.int8)),
            uncertainty=turn(uncertainty),
            residual=found.residual,
            iterations=found.iterations,
            factored=found.factored,
        )


def _insensitive(board: Board, conductance: FloatArray) -> BoolArray:
    """(N, M) cells that their own readings do not depend on, because parts of 0 ohm fix both of their lines.

    All False where no derivatives are available: continuous sheets, and more than 64 x 64 cells.
    """
    if board.continuous or conductance.size > LARGEST:
        return np.zeros(board.shape, dtype=np.bool_)
    with np.errstate(divide="ignore"):
        found = board_sensitivity(board, 1.0 / conductance)
    own = np.einsum("ijij->ij", found.cell_conductance)
    ideal = np.abs(board.circuit.conductance_slope(board, found.volts - board.level))
    return np.asarray(np.abs(own) * ideal < _INSENSITIVE)


def _is_singular(board: Board, live: BoolArray) -> bool:
    """Whether the Jacobian of the readings by the cells ``live`` (N, M) is singular.

    The Jacobian is taken at equal cells, and judged by its singular values. False where it is not available.
    """
    if board.continuous or live.size > LARGEST_MATRIX:
        return False
    found = board_sensitivity(board, np.full(board.shape, 1.0 / _TYPICAL_CONDUCTANCE))
    some = live.ravel()
    jacobian = found.cell_conductance.reshape(live.size, live.size)[np.ix_(some, some)]
    values = np.linalg.svd(jacobian, compute_uv=False)
    return bool(len(values) and values[-1] <= _INSENSITIVE * values[0])


def _short(board: Board) -> float:
    """Resistance in ohm that stands for a short: at most 1 percent of the smallest part of a line."""
    ohms = np.concatenate([board.row_ohms.ravel(), board.column_ohms.ravel()])
    return min(_SHORT, 0.01 * float(np.min(ohms, where=ohms > 0, initial=inf)))


def conditioning(design: Design, resistance: ArrayLike) -> Conditioning:
    """Error propagation from readings to recovered cells: the inverse of the Jacobian in relative units.

    Args:
        design: with a sliced sheet, of at most 64 x 64 cells.
        resistance: (rows, columns) ohm, such as :attr:`Recovery.resistance`; cells that are NaN or inf are left out.

    Raises:
        InputError: as :func:`.sensitivity`, or a cell is shorted.

    """
    cells = np.asarray(resistance, dtype=np.float64)
    left_out = np.isnan(cells)
    cells = design.resistance(np.where(left_out, inf, cells))
    model, turn = Model(design), design.board.turn
    with np.errstate(divide="ignore"):
        conductance = 1.0 / turn(cells)
    if np.isinf(conductance).any():
        raise InputError("a shorted cell (0 ohm) has no relative error; leave it out as nan")
    signal, _ = model.split(conductance)
    live = (conductance > 0) & (signal != 0)
    slope = np.where(live, model.log_slope(signal), 0.0)
    inverse = Factor(model.board, conductance, conductance, slope, live).inverse()
    place = turn(np.arange(cells.size).reshape(model.board.shape)).ravel()  # of each of the array's cells
    return Conditioning(
        inverse=inverse[np.ix_(place, place)],
        volts_to_relative=turn(np.abs(slope)),
        resistance=np.where(turn(live), cells, np.where(left_out, np.nan, cells)),
    )


def _columns_are_independent(board: Board) -> bool:
    """Whether the row lines have no resistance and the column lines have none between their cells."""
    if not board.circuit.virtual_ground or board.floating or not board.plain:
        return False
    if any(fault.ohms == 0 for fault in board.shorts):
        return False  # a complete short holds its column
    return not (board.row_ohms.any() or board.column_ohms.any())


class _Columns(NamedTuple):
    """Closed-form solution for independent columns.

    An output determines the current i of its column and the potential w at the column end of its cells. The selected
    row is at the drive and the other rows are at the reference, so ``i = G drive - w sum(G)`` for each cell G. The sum
    of these equations over the rows gives sum(G), and each equation then gives its own G.
    """

    drive: float
    current: FloatArray
    """(N, M) A"""
    potential: FloatArray
    """(N, M) V against the reference"""
    uncertain: FloatArray
    """(N, M) V: rounding error of ``potential``"""
    rounding: FloatArray
    """(N, M) A: rounding error of ``current``"""
    broken: BoolArray
    """(M,) True where the column's lead is broken"""

    @classmethod
    def of(cls, board: Board, measured: FloatArray) -> _Columns:
        level, offset, gain, reference = board.level, board.offset, board.gain, board.reference
        current = (level + offset) / reference + board.bias - measured / (board.loop_share * reference)
        broken = np.isinf(board.column_lead)
        lead = np.where(broken, 0.0, board.column_lead)
        potential = offset - measured / gain + lead * current
        uncertain = 8 * ULP * (np.abs(offset) + np.abs(measured) / gain + np.abs(lead * current))
        noise = np.abs(measured) + np.abs(level) + np.abs(offset) + np.abs(board.lift)
        rounding = 16 * ULP * noise / reference
        return cls(board.drive, current, potential, uncertain, rounding, broken)

    def found(self, limited: BoolArray) -> Found:
        """Solve for all conductances.

        Cells without current get 0. Cells of columns whose readings do not determine them get NaN.

        ``limited`` (N, M) marks readings at a limit. If such a cell would need a negative conductance, the true output
        lies beyond the limit and the apparent current is wrong. Such cells are set to 0 and the others solved again.
        """
        conductance, lost = self._solve(np.zeros_like(limited))
        beyond = limited & (conductance < 0)
        if beyond.any():
            conductance, lost = self._solve(beyond)
        with np.errstate(invalid="ignore"):
            none = conductance <= self.rounding / abs(self.drive)
        conductance[none | self.broken | beyond] = 0.0
        error = np.where(conductance > 0, lost / abs(self.drive), 0.0)
        return Found(conductance, np.abs(self.current) / abs(self.drive), error, beyond, 0.0, 0, 0)

    def _solve(self, without: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Conductances in S with the cells ``without`` open, and the rounding errors in A of their currents."""
        potential = np.where(without, 0.0, self.potential)
        drive, along = abs(self.drive), np.abs(potential).sum(axis=0)
        left = self.drive - potential.sum(axis=0)
        # A short holds its column at the drive potential. The equation for sum(G) is then singular.
        left[np.abs(left) <= 1e-9 * (drive + along)] = np.nan
        back = self.potential * (np.where(without, 0.0, self.current).sum(axis=0) / left)
        lost = self.rounding + 8 * ULP * np.abs(back) * (1.0 + (drive + along) / np.abs(left))
        return (self.current + back) / self.drive, lost

    def spread(self, found: Found, unknown: _Unknown, most: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distances in S (N, M) from ``found`` to the lower and the upper end of each interval.

        Unknown cells change the sum of conductances of their column. Each known cell of the column then changes in
        proportion to its potential. ``most`` (N, M) in S is the largest conductance of the unknown cells.
        """
        left = 1.0 - np.sum(self.potential, axis=0, where=~unknown.any) / self.drive
        share = np.divide(1.0, left, out=np.full_like(left, inf), where=left > 0)
        per_sum = np.where(unknown.any, 0.0, self.potential / self.drive)
        either = np.where(unknown.any, 0.0, self.uncertain / abs(self.drive))
        change = [
            np.where(part.any(axis=0), np.sum(by, axis=0, where=part) * share, 0.0)
            for part, by in (
                (unknown.at_least, np.maximum(most - found.conductance, 0.0)),
                (unknown.at_most, found.conductance),
            )
        ]
        up, down = np.maximum(per_sum, 0.0) + either, np.maximum(-per_sum, 0.0) + either
        with np.errstate(invalid="ignore"):  # 0 times inf: at zero potential the sum has no effect
            less, more = (
                np.nan_to_num(a * change[0] + b * change[1], nan=0.0, posinf=inf) for a, b in ((down, up), (up, down))
            )
        return less, more


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
