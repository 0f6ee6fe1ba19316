"""Lines that break while a board is read: fault detection and isolation by comparing hypotheses (Isermann 2006).

Cells beyond a complete break of their line have no reading any more, but still conduct. If idle lines float, these
cells connect the lines on which they lie. Take a divider whose idle columns float: the cells of a broken row join its
columns, which are near the drive while they are not read, so that the readings of each column grow. Cells of the other
rows then read as if they conducted better: in an 8 x 8 array by 8/7 at rest, and far more if the broken row's cells
conduct well.

One frame cannot tell a break from a row of open cells. The previous frame can: a break changes the readings of the
other lines, cells that open do not. If all readings from one place of a line to its end fall at once, each hypothesis
predicts the other readings from the last known cells. The break is accepted if its prediction is at least twice as
near.

With a broken line, the readings of all others are corrected to those with open cells in its place, by the ratio of two
models at the last cells (deferred correction). The unread cells are assumed to be as they last were. The change by this
correction counts as uncertainty of the other cells, which allows for unread cells from open to about twice their
conductance.
"""

from __future__ import annotations

from math import inf

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...errors import SolverError
from ._coupled_board import CoupledBoard
from ._frame_budget import Budget
from ._linearised import Base

_FELL = 0.25  # share of its last reading below which a cell may be beyond a break
_RENEWED = 8  # frames between records of the usual readings, after as many first ones
_CLEAR = 8.0  # least last reading of such a cell over its error, so that noise alone cannot make it fall so far
_LEAST_CELLS = 2  # least number of cells beyond a break that connect lines
_NEARER = 0.5  # a break is accepted if its misfit is below this share of the misfit with open cells
_OPEN = -46.0  # logarithm of a conductance that counts as zero: 1e-20 S
_SERVES = 0.05  # change of a logarithm up to which the correction is kept, which changes far less
_NOISE = 5.0  # standard deviations of a logarithm, likewise: noise is not to come back through the correction


class BrokenLines:
    """Finds the lines of one board that have broken since it was first read. Arrays are (N, M) in line coordinates."""

    def __init__(self, parts: CoupledBoard, price: float) -> None:
        """For a board; ``price`` of a comparison, in addition to the prices of its two models."""
        board, circuit = parts.board, parts.board.circuit
        self._parts, self._besides_models = parts, price
        self._columns_tie = board.floating
        self._rows_tie = not circuit.has_amplifiers and circuit.columns_one_by_one(board)
        sound = parts.sheet is None and not board.faults and not circuit.drives_idle_lines
        self.applies = sound and (self._columns_tie or self._rows_tie)
        """whether cells beyond a break would change other readings"""
        self._before = np.full(parts.shape, -inf)  # V below which a reading has fallen
        self._age = 0  # frames that have settled
        self.beyond: BoolArray | None = None
        """cells beyond breaks; None: no line is broken"""
        self._held: FloatArray = np.zeros(parts.shape)  # logarithms of conductances, for cells beyond breaks
        self._broken = parts.quick
        self._ratio: FloatArray = np.ones(parts.shape)  # readings with open cells over readings with breaks
        self._at: FloatArray | None = None  # (n,) logarithms for which the ratio holds

    def change_notably(self, signal: FloatArray) -> bool:
        """Whether readings, in V from the reference voltage, need the correction :meth:`without` breaks."""
        return self.beyond is not None or bool(np.count_nonzero(signal < self._before) >= _LEAST_CELLS)

    def without(
        self, volts: FloatArray, last: FloatArray, std: FloatArray | float, budget: Budget
    ) -> FloatArray | None:
        """Readings in V as if the cells beyond breaks were open; None: the frame cannot pay for the correction.

        Args:
            volts: the readings of a frame.
            last: (n,) logarithms of the conductances of the last frame that has settled.
            std: (n,) standard deviations of these by rounding and noise.
            budget: of the frame.

        """
        signal = volts - self._parts.board.level
        if not self._look(signal, np.abs(signal) < self._before, last.reshape(self._parts.shape), budget):
            return None
        if self.beyond is None:
            return volts
        if self._at is None or bool((np.abs(last - self._at) > np.maximum(_SERVES, _NOISE * std)).any()):
            cells = np.where(self.beyond, self._held, last.reshape(self._parts.shape))
            if not budget.compare(self._price(cells)):
                return None
            self._take_ratio(cells, self.beyond, last)
        corrected: FloatArray = self._parts.board.level + signal * self._ratio
        return corrected

    def remember(self, volts: FloatArray, error: float) -> None:
        """Record the readings in V, with error ``error``, of a frame that has settled; some frames suffice."""
        self._age += 1
        if self._age % _RENEWED and self._age > _RENEWED:
            return
        signal = np.abs(volts - self._parts.board.level)
        before = np.where(signal > _CLEAR * error, _FELL * signal, -inf)
        self._before = before if self.beyond is None else np.where(self.beyond, self._before, before)

    def change(self, volts: FloatArray, base: Base) -> FloatArray:
        """Relative change (n,) of the conductances by the correction of the readings in V."""
        signal = volts - self._parts.board.level
        with np.errstate(over="ignore"):  # infinite values stay infinite
            changed: FloatArray = np.expm1(np.abs(base.step((signal * (1.0 - 1.0 / self._ratio)).ravel())))
        return changed

    def _look(self, signal: FloatArray, low: BoolArray, last: FloatArray, budget: Budget) -> bool:
        """Find the lines that are broken now, from the readings and those that have fallen (``low``).

        False if the frame cannot pay for the search.
        """
        beyond = self._ends_of_lines(low)
        known = np.zeros_like(low) if self.beyond is None else self.beyond
        if np.array_equal(beyond, known):
            return True
        held, self._at = np.where(known, self._held, last), None
        if (beyond & ~known).any():
            self._break(beyond)
            if not budget.compare(self._price(held)):
                return False
            if self._breaks(signal, beyond, low, held):
                self._at = last.ravel()  # of the ratio that this comparison gave
            else:
                beyond &= known
                self._before[low & ~known] = -inf  # these cells have opened
        self._held = held
        self.beyond = beyond if beyond.any() else None
        if self.beyond is not None:
            self._break(beyond)
        return True

    def _ends_of_lines(self, low: BoolArray) -> BoolArray:
        """Cells from some place to the far end of their line, all without a reading."""
        silent = low | (self._before == -inf)  # the latter without a known reading
        found = np.zeros_like(low)
        if self._rows_tie:
            found |= np.logical_and.accumulate(silent[:, ::-1], axis=1)[:, ::-1] & _several(low, axis=1)
        if self._columns_tie:
            found |= np.logical_and.accumulate(silent, axis=0) & _several(low, axis=0)
        return found if not found.all() else np.zeros_like(low)

    def _breaks(self, signal: FloatArray, beyond: BoolArray, low: BoolArray, cells: FloatArray) -> bool:
        """Whether the other readings match the prediction of a break better than that of open cells.

        If so, the ratio of the two predictions is kept.

        Args:
            signal: V of a frame.
            beyond: cells that a break would cut off.
            low: readings that have fallen.
            cells: logarithms of the conductances before the fall.

        """
        try:
            if_broken = self._through_breaks(cells)
        except SolverError:
            return False
        if_open = self._if_open(cells, beyond)
        others = ~(beyond | low)
        by_break, by_opening = (float(np.abs(signal - volts)[others].sum()) for volts in (if_broken, if_open))
        found = by_break < _NEARER * by_opening
        if found:
            self._ratio = _ratio(if_open, if_broken, ~beyond)
        return found

    def _break(self, beyond: BoolArray) -> None:
        """Make the model of the board with lines broken where cells ``beyond`` begin."""
        board = self._parts.board
        row_ohms, column_ohms, column_lead = board.row_ohms.copy(), board.column_ohms.copy(), board.column_lead.copy()
        if self._rows_tie:
            to_end = np.logical_and.accumulate(beyond[:, ::-1], axis=1)[:, ::-1]
            for row in np.flatnonzero(to_end.sum(axis=1) >= _LEAST_CELLS):
                row_ohms[row, to_end[row].argmax()] = inf
        if self._columns_tie:
            count = np.logical_and.accumulate(beyond, axis=0).sum(axis=0)
            for column in np.flatnonzero(count >= _LEAST_CELLS):
                if count[column] < len(beyond):
                    column_ohms[count[column], column] = inf
                else:
                    column_lead[column] = inf
        self._broken = self._parts.quick.broken(row_ohms, column_ohms, column_lead)

    def _price(self, cells: FloatArray) -> float:
        """Price of comparing the models of the sound and of the broken board, at logarithms (N, M)."""
        return self._besides_models + self._parts.price(cells) + self._broken.price(np.exp(-cells))

    def _take_ratio(self, cells: FloatArray, beyond: BoolArray, last: FloatArray) -> None:
        """Update the ratio from the models of the sound and of the broken board.

        Args:
            cells: logarithms of the conductances, also where they are ``beyond`` a break.
            beyond: these cells.
            last: (n,) logarithms for which this is done.

        """
        try:
            through = self._through_breaks(cells)
        except SolverError:
            return
        self._at, self._ratio = last, _ratio(self._if_open(cells, beyond), through, ~beyond)

    def _through_breaks(self, cells: FloatArray) -> FloatArray:
        """V of the broken board, from the reference voltage, for logarithms of conductances."""
        volts: FloatArray = self._broken(np.exp(-cells)) - self._parts.board.level
        return volts

    def _if_open(self, cells: FloatArray, open_cells: BoolArray) -> FloatArray:
        """V of the sound board with open cells, from the reference voltage, for logarithms of conductances."""
        log = np.where(open_cells, _OPEN, cells).ravel()
        volts: FloatArray = self._parts.at(log).volts.reshape(cells.shape) - self._parts.board.level
        return volts


def _ratio(if_open: FloatArray, through: FloatArray, read: BoolArray) -> FloatArray:
    """Readings with open cells over those through breaks, where they are ``read``; else 1."""
    return np.divide(if_open, through, out=np.ones_like(through), where=(through != 0.0) & read)


def _several(low: BoolArray, axis: int) -> BoolArray:
    """Whether lines along an axis have at least :data:`_LEAST_CELLS` such cells."""
    several: BoolArray = low.sum(axis=axis, keepdims=True) >= _LEAST_CELLS
    return several
