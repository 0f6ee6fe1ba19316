"""Turning the scan round: the cells' true resistances from the readings, by inverting the whole circuit model.

Strategy
--------
Without resistance in the row lines the columns are independent of each other and there is a closed form: of a column
whose outputs are known, so are the potentials at its cells, and what is left is linear. All other boards are for the
iteration in :mod:`._inversion`. Either way each cell comes with how far it can be off, and none is called read that
may be off by more than 10,000 times the accuracy asked for.

Cells that are not known
------------------------
A reading at a limit says that a cell's conductance lies beyond something, not what it is; a cell behind a complete
break conducts as well, and no reading is its own. Such cells are marked and NaN, and what the others are depends on
what those may be: from the conductance that just reaches the limit up to a short, or down to nothing; behind a break
from nothing to a short. So the others are recovered again while the unknown cells go to the far end of their range,
outputs at their supply limits as the circuit has them, and what they pass through on the way is what is known of them.

In the closed form that is exact: an unknown cell counts with its column's sum alone, and all others are linear in it.
Else it is an enclosure by argument and test, not by proof. Were the others fixed, every potential would be a Moebius
function of one unknown conductance and so monotone in it, and the two ends would do. But they move along to keep
their own readings, an effect of second order and of either sign; so two places between the ends are looked at as well
(:data:`_STAGES`), the product of what a cell's two lines move by is added (:data:`_AROUND`), and all is widened
(:data:`_MARGIN`). Several unknown cells can make up for each other; so they go to the far end together, then line by
line, and what that does to a cell is added up with equal signs. Where no cells give the readings before the far end is
reached, those that had moved by then may be anything. Tests draw the unknown cells at random and look whether the
others lie within their intervals.
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
from .._board import Board, broken_off
from .._design import Design
from .._sensitivity import LARGEST, board_sensitivity
from ..solvers import ULP, siemens
from ._inversion import Factor, Found, Held, Inverter, Model

_LEAST_SHARE = 1e-9  # of a place's current that a cell beside a known short must carry
_SHORT = 1e-3  # ohm, or a hundredth of the smallest part of a line: less makes no difference to any reading
_NOTHING = 1e-15  # ohm of a short between ideal lines
_MARGIN = 2.0  # by which an interval is widened where cells are unknown
_STAGES = (6.0, 40.0, inf)  # times the conductance recovered, at which the others are looked at
_RETRIES = 1  # in smaller steps
_ONWARDS = 4.0  # times as far the others may go there
_RUNAWAY = 1e-3  # relative change beyond which a cell may be anything where the far end was not reached
_MOVED = 1e-7  # the same where the path ended because a cell would have to conduct less than nothing
_AROUND = 0.25  # share of the product of what its two lines have moved by that a cell may move besides
LARGEST_MATRIX = 1024  # cells of which all readings' derivatives are worth a singular value decomposition
_ORDINARY = 1e-4  # S of all cells, to find out which of them their own readings tell of
_INSENSITIVE = 1e-6  # of what an ideal readout would make of a cell's change: less is rounding
_NOISE = 1e-3  # of an apparent conductance: cells below may come and go with the noise of their readings
_GROUPS = 3  # into which unknown cells are put at most
_DIGITS_LOST = 1e4  # relative error of a cell that counts as read, in units of the accuracy asked for


class Status(IntEnum):
    """What a recovered cell is."""

    READ = 0
    OPEN = 1
    """no current; the resistance is given as inf"""
    SATURATED = 2
    """the output or the converter is at a limit, so the resistance is not known: NaN"""
    DISTURBED = 3
    """known no better than :attr:`Recovery.uncertainty` says, which is more than the accuracy asked for"""
    HIDDEN = 4
    """behind a fault of the design, so that no reading tells of it: NaN"""


@dataclass(frozen=True)
class Recovery:
    """Cells recovered from one frame. Arrays are (rows, columns)."""

    resistance: FloatArray
    """ohm"""
    status: NDArray[np.int8]
    """a :class:`Status` each"""
    uncertainty: FloatArray
    """relative half-width of the interval that a cell's conductance lies in, ``resistance`` being that of its middle: 1
    where the cell may as well be open, inf where nothing is known"""
    residual: float
    """largest relative difference that is left between a reading and the model's, in apparent conductance"""
    iterations: int
    """evaluations of the model on the way that led there; 0 for the closed form"""
    factored: int
    """how often the derivatives were computed"""


@dataclass(frozen=True)
class Conditioning:
    """How errors of the readings become errors of the recovered resistances."""

    inverse: FloatArray
    """(NM, NM): relative change of each cell's resistance per relative change of each reading's apparent one"""
    volts_to_relative: FloatArray
    """(N, M) 1/V: relative change of an apparent resistance per volt of its reading, as a magnitude"""
    resistance: FloatArray
    """(N, M) ohm at which this holds; NaN and inf are cells that were left out"""

    @property
    def amplification(self) -> FloatArray:
        """(N, M): relative error of a cell if all readings have independent errors of relative size 1. An ideal board
        has 1 everywhere; left-out cells are NaN.
        """
        total = np.sqrt((self.inverse**2).sum(axis=1)).reshape(self.resistance.shape)
        return np.where(np.isfinite(self.resistance), total, np.nan)

    def resistance_std(self, volts_std: ArrayLike) -> FloatArray:
        """(N, M) ohm for independent errors of standard deviation ``volts_std`` (V, a number or (N, M))."""
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
    """The cells that a design's readings come from. For a stream of frames use a :class:`Recoverer`.

    Args:
        design: with its lines, faults, gains, offsets and bias currents as they are.
        volts: (rows, columns) V, as :func:`.scan` gives them.
        accuracy: largest relative difference from the readings, in apparent conductance, to stop at. A cell counts as
            read if it is known to 10,000 times that.
        clipped: (rows, columns) True where the reading is at a limit of the converter: the one that it is nearer to, or
            at either if the design has no [adc]. Outputs at a supply limit are found without.
        least_ohm: what no cell can be less than. By default, one that is not known may be a short, and then little is
            known of its column.

    Raises:
        InputError: wrong shape, or NaN.
        SolverError: no cells give these readings, or the design does not determine them.

    """
    return Recoverer(design, accuracy=accuracy, least_ohm=least_ohm)(volts, clipped=clipped)


class _Unknown(NamedTuple):
    """Cells (N, M) whose conductance is only known to be at least, or at most, the one recovered."""

    at_least: BoolArray
    at_most: BoolArray

    @property
    def any(self) -> BoolArray:
        return self.at_least | self.at_most

    def groups(self) -> list[_Unknown]:
        """Parts of it, each on some lines of its own."""
        rows, columns = (np.flatnonzero(self.any.any(axis=axis)) for axis in (1, 0))
        by_row = len(rows) <= len(columns)
        parts = []
        for some in np.array_split(rows if by_row else columns, min(_GROUPS, len(rows), len(columns))):
            inside = np.zeros_like(self.at_least)
            inside[(some, slice(None)) if by_row else (slice(None), some)] = True
            parts += [one for one in (self._of(inside, True), self._of(inside, False)) if one.any.any()]
        return parts

    def _of(self, inside: BoolArray, up: bool) -> _Unknown:
        nowhere = np.zeros_like(inside)
        return _Unknown(self.at_least & inside if up else nowhere, nowhere if up else self.at_most & inside)

    def moved(self, conductance: FloatArray, times: float, most: FloatArray) -> FloatArray:
        """S (N, M): these cells that much away from the conductance recovered, as far as they can be."""
        ordinary = np.median(conductance[conductance > 0]) if (conductance > 0).any() else np.min(most)
        up = np.minimum(np.maximum(conductance, ordinary) * times, np.maximum(conductance, most))
        return np.where(self.at_least, up, np.where(self.at_most, conductance / times, conductance))


class Recoverer:
    """:func:`recover` for a stream of frames: starts from the frame before and keeps its factorisation."""

    def __init__(self, design: Design, *, accuracy: float = 1e-11, least_ohm: float = 0.0) -> None:
        """As :func:`recover`."""
        if not least_ohm >= 0:
            raise InputError(f"least_ohm is {least_ohm}; expected ohm >= 0")
        self._design, self._accuracy = design, accuracy
        self._board = board = design.board
        self._by_columns = _columns_are_independent(board)
        self._least_ohm, self._short = least_ohm, _NOTHING if self._by_columns else _short(board)
        self._series, self._cut_off = board.series_ohms, broken_off(board)
        # Faults of cells change what is sought, but for a complete short: there nothing is left to be sought.
        # In a continuous sheet the current beside a short is not the cell's own.
        self._shunts = [fault for fault in board.shorts if fault.ohms > 0 and not board.continuous]
        kept = [
            fault
            for fault in design.fault
            if fault.kind != "open-cell" and (fault.kind != "shorted-cell" or fault.ohms == 0 or board.continuous)
        ]
        if any(fault.ohms == 0 for fault in board.shorts + board.bridges):
            # Not perfectly: a cell at the end of a long divider may move its own reading very little.
            self._cut_off |= _insensitive(board, np.full(board.shape, _ORDINARY))
        self._undetermined = any(fault.ohms == 0 for fault in board.bridges) and _is_singular(board, ~self._cut_off)
        self._unread = self._cut_off.copy()
        for fault in board.shorts:
            self._unread[fault.place] |= fault.ohms == 0
            self._cut_off[fault.place] &= fault.ohms > 0
        self._model = Model(design.replace(fault=tuple(kept)))
        self._inverter = Inverter(self._model, self._unread, accuracy)
        self._far: dict[tuple[int, float], Inverter] = {}
        self._ends: dict[int, tuple[BoolArray, float]] = {}

    def __call__(self, volts: ArrayLike, *, clipped: ArrayLike | None = None) -> Recovery:
        """As :func:`recover`."""
        if self._undetermined:
            raise SolverError("the readings do not determine the cells: lines joined by 0 ohm read as one")
        board = self._board
        measured = board.turn(_checked(self._design, volts))
        limits = self._limits(measured, None if clipped is None else board.turn(np.asarray(clipped, dtype=np.bool_)))
        columns = _Columns.of(board, measured) if self._by_columns else None
        found = self._inverter(measured) if columns is None else columns.found(limits.any)
        lost = np.isnan(found.conductance)
        found.conductance[lost] = 0.0
        # A cell that takes its column to the drive is a short, and it hides the column's other cells.
        shorted = np.zeros_like(lost)
        if columns is not None:
            shorted = lost & (np.abs(columns.potential - board.drive) <= 1e-6 * abs(board.drive))
        # At a limit without any signal stands the output of an open cell, on a board that reads down to its reference.
        signal = np.abs(measured - board.level) > 1e-9 * abs(board.drive)
        conducting = signal | (found.conductance > 0)
        limited = _Unknown(limits.at_least & conducting, limits.at_most & conducting)
        # Where an offset makes less than none of a reading, its gain is what other cells of the column make of it.
        offset = found.clamped & (limited.any | self._cut_off).any(axis=0)
        unknown = _Unknown(limited.at_least | self._cut_off | offset, limited.at_most & (found.conductance > 0))
        low, high = np.maximum(found.conductance - found.error, 0.0), found.conductance + found.error
        if columns is None and found.conductance.max(initial=0.0) >= 1.0 / self._short:
            # A shorted cell may hold its lines, so that their other cells read as nothing, whatever they are.
            silent = (found.conductance == 0) & ~unknown.any
            if silent.any():
                hidden = silent & _insensitive(board, found.conductance)
                unknown = _Unknown(unknown.at_least | hidden, unknown.at_most)
                lost = lost | hidden
        if unknown.any.any():
            down, up = (
                self._spread(measured, found, unknown)
                if columns is None
                else columns.spread(found, unknown, self._most(found.conductance))
            )
            low, high = np.maximum(low - _MARGIN * down, 0.0), high + _MARGIN * up
        behind_short = lost & shorted.any(axis=0) & ~shorted & ~limited.any
        return self._result(found, low, high, lost | limited.any, shorted & ~limited.any, behind_short)

    def _most(self, conductance: FloatArray) -> FloatArray:
        """S (N, M) of the cells where they are not known, but to be at least ``conductance``."""
        if self._least_ohm:
            return np.maximum(conductance, 1.0 / self._least_ohm)
        return np.maximum(conductance / _SHORT, 1.0 / self._short)

    def _limits(self, measured: FloatArray, at_limit: BoolArray | None) -> _Unknown:
        """Which readings are at a limit, and on which side of what they say the cell's conductance then is."""
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
        # How far below a limit an offset takes an output depends on all cells of its column.
        return _Unknown(top | (bottom & top.any(axis=0)), bottom)

    def _spread(self, measured: FloatArray, found: Found, unknown: _Unknown) -> tuple[FloatArray, FloatArray]:
        """S (N, M) by which cells can be less, and more, than ``found``, see the top of this module."""
        known, groups = found.conductance, unknown.groups()
        down, up = [], []
        sides = [bool(group.at_least.any()) for group in groups]
        if max(sides.count(True), sides.count(False)) > 1:  # else one by one is also all together
            groups.insert(0, unknown)
        for number, some in enumerate(groups):
            visited = self._visit(measured, found, unknown, some, number)
            down.append(known - np.min(visited, axis=0))
            up.append(np.max(visited, axis=0) - known)
        less, more = (np.maximum(side[0], np.sum(side[1:], axis=0)) for side in (down, up))
        # By way of an unknown cell and back by another line: as much as both lines are moved at most.
        moved = np.divide(np.maximum(less, more), known, out=np.zeros_like(known), where=(known > 0) & ~unknown.any)
        moved = np.minimum(moved, 1.0)
        around = _AROUND * known * moved.max(axis=1, keepdims=True) * moved.max(axis=0)
        return less + around, more + around

    def _visit(
        self, measured: FloatArray, found: Found, unknown: _Unknown, some: _Unknown, number: int
    ) -> list[FloatArray]:
        """The conductances in S (N, M) while ``some`` of the unknown cells go to their far end."""
        known = found.conductance
        visited, reached, most = [known], 1.0, self._most(known)
        # Where one frame's path came to an end, so will the next one's: looking for it costs many frames' time.
        cells, end = self._ends.get(number, (None, inf))
        ended = cells is not None and bool((cells == unknown.any).all())
        pending, retries = [times for times in _STAGES if not ended or times < end], 0 if ended else _RETRIES
        runaway = _RUNAWAY
        while pending:
            times = pending[0]
            if (number, times) not in self._far:
                self._far[number, times] = Inverter(self._model, self._unread, 1e3 * self._accuracy)
            held = Held(unknown.any, some.moved(known, times, most))
            there = self._far[number, times].beside(measured, held, visited[-1])
            # A cell that conducts now would have to conduct less than nothing: no cells give these readings.
            if there is not None and ((known > _NOISE * found.target) & (there == 0) & ~unknown.any).any():
                there, runaway = None, _MOVED
            if there is not None:
                visited.append(there)
                reached = pending.pop(0)
            elif retries:
                retries -= 1
                pending.insert(0, reached * float(np.sqrt(min(times / reached, 100.0))))
            else:
                self._ends[number], ended, pending = (unknown.any, times), True, []
        if ended:  # no cells give the readings with these so far out, and some may be anything by then
            off = (np.abs(visited[-1] - known) > runaway * known) | (known == 0) | (reached < _STAGES[0])
            onwards = np.maximum(known + _ONWARDS * (visited[-1] - known), 0.0)
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
        """``low``, ``high``: S (N, M) between which conductances lie; ``lost``: readings that do not tell theirs."""
        shunt = np.zeros_like(low)
        for fault in self._shunts:
            shunt[fault.place] += siemens(fault.ohms)
        least, own, most = (self._own(value, shunt) for value in (low, found.conductance, high))
        middle = np.where(np.isfinite(most), (least + most) / 2, own)
        worth = _DIGITS_LOST * self._accuracy
        none = (own == 0) & (most <= worth * np.maximum(found.target, 1e-6 * found.target.max(initial=0.0)))
        with np.errstate(divide="ignore", invalid="ignore"):
            resistance = np.where(none, inf, 1.0 / middle)
            uncertainty = np.where(none, 0.0, np.where(np.isfinite(most), (most - least) / (most + least), inf))
        status = np.where(uncertainty > worth, Status.DISTURBED, np.where(none, Status.OPEN, Status.READ))
        # Beside a short that carries nearly all of the current, a cell is not to be seen.
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

    def _own(self, conductance: FloatArray, shunt: FloatArray) -> FloatArray:
        """S of the cells without what known faults put beside and ahead of them."""
        own = np.maximum(conductance - shunt, 0.0)
        if not self._series.any():
            return own
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(own > 0, 1.0 / np.maximum(1.0 / own - self._series, 0.0), 0.0)


def _insensitive(board: Board, conductance: FloatArray) -> BoolArray:
    """(N, M) cells whose own readings do not change with them, because parts of 0 ohm hold both of their lines.

    Nowhere where there are no derivatives: continuous sheets, and more than 64 x 64 cells.
    """
    if board.continuous or conductance.size > LARGEST:
        return np.zeros(board.shape, dtype=np.bool_)
    with np.errstate(divide="ignore"):
        found = board_sensitivity(board, 1.0 / conductance)
    own = np.einsum("ijij->ij", found.cell_conductance)
    ideal = np.abs(board.circuit.conductance_slope(board, found.volts - board.level))
    return np.asarray(np.abs(own) * ideal < _INSENSITIVE)


def _is_singular(board: Board, live: BoolArray) -> bool:
    """Whether the readings of cells ``live`` (N, M) leave it open what these cells are, with all of them alike."""
    if board.continuous or live.size > LARGEST_MATRIX:
        return False
    found = board_sensitivity(board, np.full(board.shape, 1.0 / _ORDINARY))
    some = live.ravel()
    jacobian = found.cell_conductance.reshape(live.size, live.size)[np.ix_(some, some)]
    values = np.linalg.svd(jacobian, compute_uv=False)
    return bool(len(values) and values[-1] <= _INSENSITIVE * values[0])


def _short(board: Board) -> float:
    """Ohm below which a cell makes no difference to any reading."""
    ohms = np.concatenate([board.row_ohms.ravel(), board.column_ohms.ravel()])
    return min(_SHORT, 0.01 * float(np.min(ohms, where=ohms > 0, initial=inf)))


def conditioning(design: Design, resistance: ArrayLike) -> Conditioning:
    """How much worse than the readings the recovered cells are.

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
    """Whether rows have no resistance of their own and columns none between their cells."""
    if not board.circuit.virtual_ground or board.floating or not board.plain:
        return False
    if any(fault.ohms == 0 for fault in board.shorts):
        return False  # a complete short holds its column
    return not (board.row_ohms.any() or board.column_ohms.any())


class _Columns(NamedTuple):
    """The closed form where columns are independent.

    An output gives its column's current i and the potential w that its cells end at. With the selected row at the
    drive and the others at the reference, ``i = G drive - w sum(G)``; the sum follows from the sum over the rows.
    """

    drive: float
    current: FloatArray
    """(N, M) A"""
    potential: FloatArray
    """(N, M) V against the reference"""
    uncertain: FloatArray
    """(N, M) V by which rounding can have moved it"""
    rounding: FloatArray
    """(N, M) A"""
    broken: BoolArray
    """(M,)"""

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
        """Conductances 0 where no current is left for a cell, NaN in columns whose readings do not determine them.

        ``limited`` (N, M): readings at a limit. Where such a cell would have to conduct less than nothing, its output
        is beyond the limit, and its current not the one that it seems.
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
        """Conductances in S if those ``without`` conduct nothing, and by how many A rounding may have moved them."""
        potential = np.where(without, 0.0, self.potential)
        drive, along = abs(self.drive), np.abs(potential).sum(axis=0)
        left = self.drive - potential.sum(axis=0)
        # A short holds its column at the drive: then nothing is left that would tell of the column's cells.
        left[np.abs(left) <= 1e-9 * (drive + along)] = np.nan
        back = self.potential * (np.where(without, 0.0, self.current).sum(axis=0) / left)
        lost = self.rounding + 8 * ULP * np.abs(back) * (1.0 + (drive + along) / np.abs(left))
        return (self.current + back) / self.drive, lost

    def spread(self, found: Found, unknown: _Unknown, most: FloatArray) -> tuple[FloatArray, FloatArray]:
        """S (N, M) by which cells can be less, and more, than ``found``: what the unknown ones add to their column's
        sum, each cell's reading adds again in proportion to its potential.
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
        with np.errstate(invalid="ignore"):  # no potential, no change, whatever the sum
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
