"""Scales of a divider's columns: the factor by which readings leave them open, and its effect on other cells.

Row i has a lead r_i between its driver and its crosspoints; column j has a load of h_j siemens. D_ij is the
conductance from row i's driver to column j, and p_ij = r_i D_ij is the share of column j in row i's potential. A
reading y_ij is the potential of column j, over the drive, while row i is driven. Kirchhoff's current laws then give:

1. The readings of a column have the ratios of its D. They leave open one factor F for all D of the column, its scale.
2. While all rows are driven, column j lies below the drive by d_j = 1 - sum_i y_ij. If idle columns are loaded, row i
   lies below the drive by e_i = r_i sum_j h_j y_ij, by reciprocity. The readings give both, whatever the cells are.
3. The currents into a column are then known. With G_ij = D_ij / (1 - sum_j p_ij) they fix its scale:

       excess(F) = sum_i G_ij(F) (d_j - e_i) - h_j sum_i y_ij = 0.

4. While row k is driven, an idle row i lies at u_ik = sum_j p_ij y_kj, and feeds all columns through its cells.
   With o_k the potential of row k itself, the cells of a column whose sum T_j is known follow from

       G_kj o_k = (h_j + T_j) y_kj - sum_(i != k) G_ij u_ik.

If every column lies above every row, d_j > e_i, all terms of the third law are positive and grow with F: the scale is
unique. If a row lies below a column, its term falls as the row's potential follows that column more, and two scales may
give the same readings: the row follows the column, or hardly takes part. Columns of good conductors have small d_j. If
an ADC step hides d_j, any scale up to that of a short is possible.

The columns in question are thus known from the readings. For each of them we search the whole range of scales, from no
conductance to a short, for the least and the largest possible one, while the other columns take any value within their
own ranges. The fourth law, whose cells fall with every u and o, then bounds all other cells. These bounds enclose all
sets of cells, not only those near the fitted one. Segments along a column count as an error of its d.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ._coupled_board import CoupledBoard, Frame, Known
from ._coupled_prices import CoupledPrices
from ._frame_budget import Budget
from ._linearised import Base

_NEAR = 2.0  # margin of the condition for columns in question, so that it holds for all cells for which a base serves
_BESIDE = 2.0  # the same for columns whose shapes may change beside a column below which a row may lie
_UNKNOWN = 0.02  # relative change of cells by a column's scale, beyond which linear uncertainties do not suffice
_MARGIN = 1.2  # for segments along the lines, and for terms beyond the first order
_JOINED = 2.0  # largest scale over that of a short, beside other columns in question, which distort the shape
_MOST_SEARCHED = 4  # columns whose scales are searched for; with more in question, any scale counts as possible
_BOUNDLESS = 1e100
_LARGEST_SIEMENS = 1e30  # for cells whose fit ran away to infinity
_LARGEST = 1e6  # scale beyond which no lead limits one
_NOT_LEFT = 1e-9  # share of a voltage that counts as none
_LEAST = np.finfo(np.float64).tiny
_SWEEPS = 3  # of the fourth law
_CLOSE = 1.0 - np.logspace(-5.0, -0.31, 30)
_TO_SHORT = np.concatenate([_CLOSE, np.logspace(-0.32, -9.0, 40)])  # share of 1/F left on the way to a short
_TO_OPEN = np.concatenate([_CLOSE, np.logspace(-0.32, -6.0, 20)])  # F


class ColumnScales:
    """Possible scales of the columns of one board; for dividers whose idle rows are driven."""

    def __init__(self, parts: CoupledBoard, prices: CoupledPrices) -> None:
        """For a board."""
        self._prices = prices
        board, to_driver = parts.board, parts.lines.to_driver
        self._parts = parts
        behind = np.broadcast_to(board.reference + board.column_lead, parts.shape[1:])
        self.lead = np.where(np.isfinite(to_driver), to_driver, 0.0)
        """(N, M) ohm from crosspoints to the rows' drivers"""
        to_end = parts.lines.to_end
        self._wire = np.where(np.isfinite(to_end), to_end, 0.0).max(axis=0)  # (M,) ohm along the columns
        self.load = 1.0 / behind
        """(M,) S"""
        self.per_volt = behind / board.reference / board.drive
        """(M,) 1/V: share of the drive at a column, per volt of a reading; its sign is that of the drive"""
        self.loaded = board.idle_columns == "load"
        """whether columns are loaded while they are not read"""
        self.applies = not (board.floating or board.circuit.has_amplifiers) and bool(self.lead.any())
        """whether scales of columns change other cells"""
        adc = board.adc
        self._offset, self._gain, self._lowest = (
            (0.0, 0.0, 0.0) if adc is None else (abs(adc.offset_voltage), abs(adc.gain_error), adc.range[0])
        )
        self._kept: tuple[Base | None, bool] = None, False  # whether columns may be in question while a base serves

    def disturb(self, frame: Frame, known: Known, base: Base, covered: float, budget: Budget) -> FloatArray | None:
        """Largest relative change (n,) from the fitted cells to others with the same readings.

        Args:
            frame: the readings.
            known: the cells found for the readings.
            base: the linear model of the fit.
            covered: V, error of a reading that linear uncertainties cover.
            budget: of the frame.

        Returns:
            None if all scales are known well enough for linear uncertainties, as in nearly all frames, or if the frame
            cannot pay.

        """
        served, near = self._kept
        if (served is base and not near) or not budget.judge(self._prices.told):
            return None
        told = self._told(frame, known, covered)
        if served is not base:
            near = bool(told.in_question(_NEAR).any())
            self._kept = base, near
            if not near:
                return None
        in_question = told.in_question(1.0)
        if not in_question.any():
            return None
        suspect = told.suspect(1.0)
        if suspect.any():  # rows that may follow such a column also change the shape of others not far below
            suspect = told.suspect(_BESIDE)
        columns = np.flatnonzero(in_question | suspect)
        searched = _searched(int(np.count_nonzero(suspect))) if self.loaded else 0
        if not budget.judge(self._prices.scales + searched * self._prices.narrow):
            return None
        conductance = np.minimum(self._parts.board.cell_conductance(known.cells), _LARGEST_SIEMENS)
        with np.errstate(over="ignore"):  # infinite values stay infinite
            found = _Scales(self.lead, self.load, conductance, told, columns, suspect[columns])
            if self.loaded:
                found.search()
            return (_MARGIN * found.changes()).ravel()

    def _told(self, frame: Frame, known: Known, covered: float) -> _Told:
        """Deficits of all columns and rows, by the readings."""
        parts, per_volt = self._parts, self.per_volt
        rows = parts.shape[0]
        signal = known.volts.reshape(parts.shape) - parts.board.level
        apart = frame.volts - signal - parts.board.level
        counts: BoolArray = np.ones(parts.shape[1], dtype=np.bool_)
        if frame.ignored is not None:
            ignored = frame.ignored.reshape(parts.shape)
            counts, apart = ~np.logical_and.reduce(ignored, axis=0), np.where(ignored, 0.0, apart)
        share, error = signal * per_volt, frame.error * np.abs(per_volt)
        conductance = np.minimum(parts.board.cell_conductance(known.cells), _LARGEST_SIEMENS)
        through = self.lead * conductance
        along = 1.0 + through.sum(axis=1, keepdims=True)
        own = (1.0 + np.einsum("ij,ij->i", through, share)[:, None]) / along  # o
        # Errors of a column's readings add up as independent ones, except for the converter's offset and gain error.
        together = min(sqrt(rows) * covered, rows * frame.error)
        shift = rows * self._offset + self._gain * np.abs(frame.volts - self._lowest).sum(axis=0)
        below = np.zeros((2, rows))
        if self.loaded:
            below = np.stack([(self.lead * share) @ self.load, self.lead @ (error * self.load)])
        deficit = 1.0 - share.sum(axis=0)
        # The crosspoints of a column differ by the voltage that currents from row to row lose in its segments.
        apart_by_wire = self._wire * (conductance * np.abs(deficit - below[0][:, None])).sum(axis=0)
        return _Told(
            share=share,
            error=error,
            deficit=deficit,
            read=deficit - apart.sum(axis=0) * per_volt,
            deficit_error=(together + shift) * np.abs(per_volt) + apart_by_wire,
            row_deficit=below[0],
            row_error=below[1],
            lowest=float((below[0] + below[1]).max()),
            hang=(through / along / own).max(axis=0),
            counts=counts,
        )


def _searched(suspects: int) -> int:
    """Number of searches for that many columns: the result for one column narrows the others'."""
    return suspects * min(suspects, 2) if suspects <= _MOST_SEARCHED else 0


class _Told(NamedTuple):
    """Potentials of the lines by the readings, as shares of the drive."""

    share: FloatArray
    """(N, M) y, potential of each column while a row is driven, by the model at the fitted cells"""
    error: FloatArray
    """(M,) of a reading"""
    deficit: FloatArray
    """(M,) d, by which columns lie below the drive while all rows are driven, at the fitted cells"""
    read: FloatArray
    """(M,) the same by the readings"""
    deficit_error: FloatArray
    """(M,) error of the deficit"""
    row_deficit: FloatArray
    """(N,) e, by which rows lie below the drive"""
    row_error: FloatArray
    """(N,) error of the rows' deficit"""
    lowest: float
    """largest possible deficit of a row"""
    hang: FloatArray
    """(M,) largest relative change of a row's other cells by that of the column's scale"""
    counts: BoolArray
    """(M,) columns that are not left out"""

    def in_question(self, near: float) -> BoolArray:
        """Columns (M,) below which a row may lie, or whose scale is hardly known; a larger ``near`` finds more."""
        deficit = np.minimum(self.deficit, self.read)
        error = near * self.deficit_error
        unknown = error * self.hang > _UNKNOWN * (deficit - error)
        return self.suspect(near) | (self.counts & unknown)

    def suspect(self, near: float) -> BoolArray:
        """Columns (M,) below which a row may lie, or which may not lie below the drive at all; ``near`` as above."""
        found: BoolArray = np.minimum(self.deficit, self.read) < near * (self.deficit_error + self.lowest)
        return self.counts & found


class _Scales:
    """Possible scales of K columns, and their effect on the cells. The fitted scale is 1."""

    def __init__(
        self,
        lead: FloatArray,
        load: FloatArray,
        conductance: FloatArray,
        told: _Told,
        columns: IntArray,
        suspect: BoolArray,
    ) -> None:
        """Bound the scales by Kirchhoff's current law and by shorts.

        Args:
            lead: (N, M) ohm from crosspoints to the rows' drivers.
            load: (M,) S.
            conductance: (N, M) S, the fitted cells.
            told: deficits by the readings.
            columns: (K,) their numbers.
            suspect: (K,) columns that may have any scale, by the first test.

        """
        self._suspect, self._all_suspect = suspect, bool(suspect.all())
        self._load, self._cells, self._told, self._columns = load, conductance, told, columns
        through = lead * conductance
        self._left = 1.0 / (1.0 + through.sum(axis=1))  # (N,) share of its own driver in a row's potential
        self._hangs = through * self._left[:, None]  # (N, M) p
        cells, hangs = conductance[:, columns], self._hangs[:, columns]
        # D over the reading that it causes: a reading's error may hide a D of this size times the error.
        per_share = load[columns] + (cells * (1.0 - hangs)).sum(axis=0)
        self._hidden = lead[:, columns] * np.minimum(told.error[columns] * per_share, _BOUNDLESS)  # (N, K) of p
        self._rise = told.read[columns] - told.row_deficit[:, None]  # (N, K) from rows to columns, all rows driven
        self._rise_error = told.deficit_error[columns] + told.row_error[:, None]
        self._current = (cells * (told.deficit[columns] - told.row_deficit[:, None])).sum(axis=0)  # (K,) S
        with np.errstate(divide="ignore"):
            short = 1.0 / np.maximum(hangs - self._hidden, 0.0).max(axis=0)
            least_current = np.maximum((cells * (self._rise - self._rise_error)).sum(axis=0), _LEAST)
            most = np.where(self._suspect, _BOUNDLESS, self._current / least_current)
        least = self._current / np.maximum((cells * (self._rise + self._rise_error)).sum(axis=0), _LEAST)
        joined = np.where(self._suspect & (np.count_nonzero(self._suspect) > 1), _JOINED, 1.0)
        self._most: FloatArray = np.clip(np.minimum(most, joined * short), 1.0, _BOUNDLESS)
        self._least: FloatArray = np.where(self._suspect, 0.0, np.clip(least, 0.0, 1.0))
        self._hangs_least = hangs * self._least
        self._hangs_most = np.maximum(np.minimum(self._most * (hangs + self._hidden), 1.0), hangs)

    def search(self) -> None:
        """Narrow the scales of the suspect columns, each with the others anywhere in their ranges."""
        suspects = np.flatnonzero(self._suspect).tolist()
        for number in range(_searched(len(suspects))):
            self._narrow(suspects[number % len(suspects)])

    def _narrow(self, each: int) -> None:
        """Search the whole range of scales of one column for those that the current law allows."""
        hangs = self._hangs[:, self._columns]
        more, less = self._hangs_most - hangs, hangs - self._hangs_least
        own = hangs[:, each]
        left = self._left + own
        law = _CurrentLaw(
            cells=self._cells[:, self._columns[each]],
            driven=self._cells[:, self._columns[each]] * self._left,
            hangs=own,
            left_least=np.maximum(left - (more.sum(axis=1) - more[:, each]), own),
            left_most=left + (less.sum(axis=1) - less[:, each]),
            rise=self._rise[:, each],
            error=self._rise_error[:, each],
            current=float(self._current[each]),
            beside=self._beside(each),
        )
        self._least[each], self._most[each] = law.possible_scales()
        self._hangs_least[:, each] = self._least[each] * own
        most = np.minimum(self._most[each] * (own + self._hidden[:, each]), self._hangs_most[:, each])
        self._hangs_most[:, each] = np.maximum(most, own)

    def _beside(self, each: int) -> _Beside:
        """All other columns, whose rows change the shape of one column."""
        number, hangs, most = self._columns[each], self._hangs.copy(), self._all_hangs_most()
        hangs[:, number] = most[:, number] = 0.0
        return _Beside(hangs, most, self._told.share)

    def _all_hangs_most(self) -> FloatArray:
        """Largest p (N, M) of all columns."""
        most: FloatArray = self._hangs.copy()
        most[:, self._columns] = self._hangs_most
        return most

    def changes(self) -> FloatArray:
        """Largest relative change (N, M) of the cells over all possible scales, by the fourth law."""
        columns, share, cells = self._columns, self._told.share, self._cells
        now, of_columns = self._hangs[:, columns], share[:, columns]
        more, less = self._hangs_most - now, now - self._hangs_least
        lift = self._hangs @ share.T  # (N, N): u, of each row while another one is driven
        own = self._left + np.diagonal(lift)
        lift_most = np.minimum(lift + self._lifted(more, of_columns), np.maximum(lift, share.max(axis=1)))
        lift_least = np.maximum(lift - self._lifted(less, of_columns), 0.0)
        own_most = np.minimum(own + self._together(less * (1.0 - of_columns)), 1.0)[:, None]
        own_least = own - self._together(more * (1.0 - of_columns))
        own_least = np.maximum(own_least, np.minimum(own, of_columns.min(axis=1)))
        own_least = np.maximum(own_least, _NOT_LEFT)[:, None]
        for each in (lift, lift_most, lift_least):
            each.flat[:: len(each) + 1] = 0.0  # as np.fill_diagonal, which takes several times as long
        told = cells * own[:, None] + lift.T @ cells  # S: (h + T) y
        least: FloatArray = np.zeros_like(cells)
        most = cells
        for _ in range(_SWEEPS):
            most = np.maximum((told - lift_least.T @ least) / own_least, cells)
            least = np.clip((told - lift_most.T @ most) / own_most, 0.0, cells)
        # A row that may follow a column can have cells whose effect is within the errors of its readings.
        may_hang = own_least[:, 0] < own * (1.0 - _NOT_LEFT)
        hidden = self._told.error * (self._load + cells.sum(axis=0)) * (may_hang[:, None] / own_least)
        change = np.maximum(most - cells, cells - least) + lift_most.T @ hidden
        relative: FloatArray = change / np.maximum(cells, _LEAST)
        relative[:, columns[self._suspect]] = self._own_changes(more, less)[:, self._suspect]
        return relative

    def _own_changes(self, more: FloatArray, less: FloatArray) -> FloatArray:
        """The same for the cells (N, K) of the columns in question, given the rises and falls (N, K) of their p."""
        left = np.maximum(self._left, _NOT_LEFT)
        left_least = np.maximum(self._left - self._together(more), _NOT_LEFT)
        left_most = left + self._together(less)
        most = self._most * (left / left_least)[:, None]
        least = self._least * (left / left_most)[:, None]
        changes: FloatArray = np.maximum(most - 1.0, 1.0 - least)
        # Currents that rows carry to other columns matter most in cells of little conductance beside the others.
        cells = self._cells[:, self._columns]
        carried = self._all_hangs_most().T @ (cells * most) - self._least * (self._hangs.T @ cells)  # (M, K)
        carried[self._columns, np.arange(len(self._columns))] = 0.0
        changes += self._told.share @ np.maximum(carried, 0.0) / np.maximum(cells * left_least[:, None], _LEAST)
        return changes

    def _together(self, change: FloatArray) -> FloatArray:
        """Sum (N,) of changes (N, K) by each column; changes by errors of readings add up as independent ones."""
        if self._all_suspect:
            return np.asarray(change.sum(axis=1), dtype=np.float64)
        suspect, others = change[:, self._suspect], change[:, ~self._suspect]
        together: FloatArray = suspect.sum(axis=1) + np.sqrt(np.einsum("ij,ij->i", others, others))
        return together

    def _lifted(self, change: FloatArray, share: FloatArray) -> FloatArray:
        """Change (N, N) of the rows' potentials by changes (N, K) of p, given the columns' potentials (N, K)."""
        if self._all_suspect:
            return np.asarray(change @ share.T, dtype=np.float64)
        suspect, others = self._suspect, ~self._suspect
        by_suspects = change[:, suspect] @ share[:, suspect].T
        by_others = np.sqrt(change[:, others] ** 2 @ (share[:, others] ** 2).T)
        lifted: FloatArray = by_suspects + by_others
        return lifted


class _Beside(NamedTuple):
    """The other columns. A row that follows two columns carries current from one to the other."""

    hangs: FloatArray
    """(N, M) p; 0 in the column itself"""
    hangs_most: FloatArray
    """(N, M) the same at most; 0 in the column itself"""
    share: FloatArray
    """(N, M) y"""


class _CurrentLaw(NamedTuple):
    """Kirchhoff's current law of one column with all rows driven, as a function of the column's scale; N rows."""

    cells: FloatArray
    """(N,) S: G of the scale 1"""
    driven: FloatArray
    """(N,) S: D of the scale 1"""
    hangs: FloatArray
    """(N,) p"""
    left_least: FloatArray
    """(N,) least share of a row's potential that other columns leave to this one and to the row's driver"""
    left_most: FloatArray
    """(N,) the largest such share"""
    rise: FloatArray
    """(N,) voltage from the rows to the column"""
    error: FloatArray
    """(N,) error of the rise"""
    current: float
    """S, into the column's load, over the drive"""
    beside: _Beside
    """the other columns"""

    @property
    def largest(self) -> float:
        """The scale of a short, which leaves no share of a row's potential to its driver."""
        return float((self.left_most / np.maximum(self.hangs, _LEAST)).min())

    def possible_scales(self) -> tuple[float, float]:
        """The least and the largest possible scale, searched from 1 down to zero and up to that of a short."""
        largest = min(self.largest, _LARGEST) * (1.0 - _NOT_LEFT)
        scales, down = _TO_OPEN, len(_TO_OPEN)
        if largest > 1.0:
            scales = np.concatenate([scales, 1.0 / (1.0 / largest + (1.0 - 1.0 / largest) * _TO_SHORT)])
        low, high = self._excess(scales)
        np.clip(low, -_BOUNDLESS, _BOUNDLESS, out=low)
        np.clip(high, -_BOUNDLESS, _BOUNDLESS, out=high)
        least = _last_possible(scales[:down], low[:down], high[:down], 0.0)
        if largest <= 1.0:
            return least, 1.0
        return least, _last_possible(scales[down:], low[down:], high[down:], largest)

    def _excess(self, scales: FloatArray) -> tuple[FloatArray, FloatArray]:
        """S, least and largest current (P,) into the column beyond that of its load, at scales (P,)."""
        scale = scales[:, None]
        by_most = scale * self.driven / np.maximum(self.left_least - scale * self.hangs, _NOT_LEFT)
        by_least = scale * self.driven / np.maximum(self.left_most - scale * self.hangs, _NOT_LEFT)
        low, high = self.rise - self.error, self.rise + self.error
        excess_low = np.where(low > 0.0, by_least, by_most) @ low - self.current
        excess_high = np.where(high > 0.0, by_most, by_least) @ high - self.current
        # Currents that rows carry to other columns distort the shape of this one, by the other columns' readings.
        hangs, hangs_most, share = self.beside
        carried = np.abs(by_most @ hangs_most - scale * (self.cells @ hangs))
        per_driven = by_most / np.maximum(self.driven, _LEAST) / scale
        distorted = ((per_driven * (np.abs(self.rise) + self.error)) @ share * carried).sum(axis=1)
        return excess_low - distorted, excess_high + distorted


def _last_possible(scales: FloatArray, low: FloatArray, high: FloatArray, end: float) -> float:
    """The possible scale farthest from 1.

    Args:
        scales: (P,) from 1 on outwards.
        low: S, least excess (P,) at these scales.
        high: S, largest excess (P,).
        end: the result if the last scale is possible.

    """
    possible = (low <= 0.0) & (high >= 0.0)
    side = np.where(possible, 0.0, np.sign(low + high))
    last = np.flatnonzero(possible | np.append(np.diff(side) != 0.0, False))
    place = int(last[-1]) if last.size else 0
    if place + 1 == len(scales):
        return end
    # From there to the next scale, the bound nearer to 0 crosses it.
    bound = low if low[place + 1] > 0.0 else high
    before, after = float(bound[place]), float(bound[place + 1])
    part = before / (before - after) if before * after < 0.0 else 1.0
    return float(scales[place] + part * (scales[place + 1] - scales[place]))
