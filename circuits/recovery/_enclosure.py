"""Cells beside others whose readings do not determine them: bounds by intervals of Kirchhoff's laws.

A reading at a limit leaves its cell anywhere between the value at the limit and a short. The same holds for the cells
of a column or a row of whose drive nothing is left beyond the readings' error. Such a cell changes others

* of its own column, whose sum T becomes an interval (:meth:`Enclosure._column_sums`);
* of its own row, which it loads while the row is driven (:meth:`Enclosure._rows`);
* of all columns, as it ties its own column to an idle row (:meth:`Enclosure._between`). An idle row m stands at
  u_m = sum_j p_mj C_kj with p_mj = r_m D_mj, and feeds G_ml (u_m - C_kl) to column l while row k is driven.

The potentials C are known from the readings, whatever the unknown cells are. The bounds are those of
:mod:`._law` with intervals in place of numbers.
"""

from __future__ import annotations

from math import isfinite
from typing import NamedTuple, Self

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._board import Board, broken_off
from .._parts import LEAST_SHORT_OHM
from ._law import Law, Ports
from ._law_errors import LawErrors
from ._law_kernels import LEAST, OPEN_ROW, OPEN_SCALE

_MARGIN = 1.2  # for segments, and for what is beyond the first order
_UNCLEAR = 0.1  # relative error from which on a cell's own error counts in other columns
_TIED = 0.01  # share of a row's drive from which on a cell ties its column to the row
_UNUSUAL = 30.0  # largest ratio of a cell beside a short to those of other columns, behind amplifiers
_MOST = 1e6  # relative change that stands for any larger one
_CORRECTED = 3.0  # most by which a cell beyond the law's counts
_LEAST_LEFT = 1e-9  # of a row's drive
_TINY = 1e-300


class Unknowns(NamedTuple):
    """Readings (N, M) that state bounds only."""

    limited: BoolArray
    """the cell conducts at least what the reading says"""
    under_range: BoolArray
    """the cell conducts at most what the reading says"""

    @classmethod
    def of(cls, shape: tuple[int, int], limited: BoolArray | None, under_range: BoolArray | None) -> Self:
        """The same for masks that may be missing."""
        nowhere = np.zeros(shape, dtype=np.bool_)
        return cls(nowhere if limited is None else limited, nowhere if under_range is None else under_range)

    @property
    def any(self) -> BoolArray:
        """Readings of either kind."""
        return self.limited | self.under_range


class Enclosed(NamedTuple):
    """What unknown cells leave open. Arrays are (N, M)."""

    change: FloatArray
    """largest relative change of each cell over all values of the unknown ones"""
    least: FloatArray
    """S, lower bounds on unknown cells; 0 at all others"""
    greatest: FloatArray
    """S, upper bounds on unknown cells; infinite at all others"""


class _Sums(NamedTuple):
    """Intervals of the columns' sums and of the port conductances."""

    rough: BoolArray
    """(M,) columns whose scale is open, or which have an unknown cell"""
    width: FloatArray
    """(M,) S, of the interval of the sum, as far as it is not an error of the column's own readings"""
    per_sum: FloatArray
    """(N, M) change of D per change of the sum"""
    low: FloatArray
    """(M,) S, least sum"""
    below: FloatArray
    """(N, M) S, least D"""
    above: FloatArray
    """(N, M) S, greatest D"""


class Enclosure:
    """Bounds of one board's cells beside unknown ones."""

    def __init__(self, board: Board, law: Law, shared: FloatArray, to_driver: FloatArray, to_end: FloatArray) -> None:
        """For a board and its laws.

        Args:
            board: the board.
            law: its laws.
            shared: (N, M, M) ohm of wire that two cells of a row share on the way to its driver.
            to_driver: (N, M) ohm of wire between each cell and its row's driver.
            to_end: (N, M) ohm of wire between each cell and its column's end.

        """
        self._board, self._law, self._shared = board, law, shared
        circuit, drive = board.circuit, abs(board.drive)
        ends = circuit.read_ends(board) if circuit.has_amplifiers and not circuit.drives_idle_lines else None
        self._to_driver = to_driver
        self._short = 1.0 / (to_driver + LEAST_SHORT_OHM)  # S, of a short behind its row
        at_end = 0.0 if circuit.drives_idle_lines else circuit.end_resistance(board)
        self._behind = at_end + law.wire  # ohm (M,) that the current of a mean cell of a column passes
        own_wire = law.wire - to_end.mean(axis=0) + to_end  # ohm (N, M) from each cell to its column's end
        self._behind_cell = at_end + own_wire
        self._floating, self._follows = board.floating, circuit.drives_idle_lines
        self._divides, self._one_by_one = not circuit.has_amplifiers, circuit.columns_one_by_one(board)
        self._idle = 1.0 / np.maximum(
            board.idle_resistance + law.wire, LEAST_SHORT_OHM
        )  # S (M,) of an idle column's end
        # A short while its own row is driven: S into the column's end, per volt of drive, and V of the column.
        self._adrift = np.zeros(board.shape)
        self._saturates, self._into_end, self._column = False, self._short, np.full(board.shape, drive)
        source = np.zeros(board.shape[1])
        behind = board.reference + law.wire
        if ends is not None:
            source, behind = ends.source + source, ends.resistance + law.wire
            low, high = board.supply if (board.drive > 0) != circuit.inverts else board.supply[::-1]
            limit, self._saturates = high, isfinite(high)
            if isfinite(low):  # an output at this limit leaves its column between the offset and the other lines
                self._adrift = 2.0 * np.abs(board.offset) * np.ones(board.shape)
            if self._saturates:
                beyond = np.abs(limit - board.level) + np.abs(board.offset)
                self._into_end = (1.0 + beyond / drive) / (to_driver + board.reference + own_wire)
            else:
                to_source = ends.resistance + own_wire
                self._into_end = 1.0 / (to_driver + to_source + LEAST_SHORT_OHM)
                self._column = self._into_end * to_source * drive + np.abs(source)
            if self._one_by_one:  # others are read while its column ends as idle ones do
                into_idle = 1.0 / (to_driver + board.idle_resistance + own_wire + LEAST_SHORT_OHM)
                whole = board.shared_by >= board.shape[1]
                self._into_end = into_idle if whole else np.maximum(self._into_end, into_idle)
        self._holds, self._pull = ends is not None, board.pull
        self._hidden = broken_off(board)
        self._most_beside = 1.0 / (law.wire[:, None] + law.wire + 2.0 * LEAST_SHORT_OHM)  # S, from column to column
        apart = behind + LEAST_SHORT_OHM
        self._driven_apart = np.abs(source[:, None] - source) / (apart[:, None] + apart)  # A between joined columns
        # Share of a column's current that a joined one takes.
        self._passes_on = behind[:, None] / (apart[:, None] + apart)

    def unheld(self, unknowns: Unknowns) -> bool:
        """Whether an amplifier's output may stand at a limit, so that it does not hold its column."""
        limited, under_range = unknowns
        return not self._divides and bool(limited.any() or (under_range.any() and self._adrift.any()))

    def coupling(self, cells: FloatArray) -> FloatArray:
        """(M,) share of a column's current that may pass to other columns by way of the rows, at cells (N, M) in S."""
        behind: FloatArray = self._law.behind * cells.sum(axis=0)
        if self._floating:
            return behind
        loss = float((self._law.lead[:, None] * cells).sum(axis=1).max())
        share: FloatArray = loss * behind / (1.0 + behind)
        return share

    @np.errstate(divide="ignore", invalid="ignore", over="ignore")
    def __call__(
        self, ports: Ports, errors: LawErrors, cells: FloatArray, unknowns: Unknowns | None, volts: FloatArray
    ) -> Enclosed:
        """Bounds for cells (N, M) in S behind readings ``volts``."""
        shape = cells.shape
        unknowns = Unknowns.of(shape, None, None) if unknowns is None else unknowns
        if not self._board.plain and unknowns.any.any():  # bridges and sheets pass currents by other ways
            return Enclosed(np.full(shape, np.inf), np.zeros(shape), np.full(shape, np.inf))
        drive, share = np.abs(ports.drive), ports.share
        sums = self._column_sums(ports, errors, unknowns, volts, share, drive)
        potential = self._potentials(ports, sums, volts, drive)
        row, low, high = self._rows(ports, errors, unknowns, sums, drive, potential)
        added = np.zeros(shape)
        if self._law.has_leads or self._floating or self._hidden.any():
            added = self._between(ports, errors, cells, unknowns, sums, row / low, potential) / drive
        change = self._changes(ports, sums, share, added, row, low, high)
        change = _MARGIN * change * np.maximum(ports.cells / np.maximum(cells, _TINY), 1.0)
        least = np.where(unknowns.limited, np.maximum(sums.below - added, 0.0), 0.0)
        greatest = np.where(unknowns.under_range, (sums.above + added) / low, np.inf)
        return Enclosed(change, least, greatest)

    def _column_sums(
        self,
        ports: Ports,
        errors: LawErrors,
        unknowns: Unknowns,
        volts: FloatArray,
        share: FloatArray,
        drive: FloatArray,
    ) -> _Sums:
        limited, under_range = unknowns
        unknown, driven, total = unknowns.any, ports.driven, ports.total
        least = np.where(limited, np.maximum(driven - errors.of_driven, 0.0), 0.0)
        # What the column's potential drives into a under_range cell is no part of its reading.
        offset = np.abs(self._law.potential(volts) / drive) * np.maximum(total, 0.0)
        most = np.where(limited, self._short, np.maximum(driven, 0.0) + errors.of_driven + offset)
        scale_open = errors.column_open > OPEN_SCALE
        error = np.where(scale_open, errors.of_left, 0.0)
        known, left = np.where(unknown, 0.0, ports.apart), 1.0 - np.where(unknown, 0.0, share).sum(axis=0)
        low = np.fmin((known + np.where(limited, least, 0.0)).sum(axis=0) / (left + error), total)
        known = np.where(unknown, most, ports.apart)
        left = 1.0 - np.where(limited, 0.0, share).sum(axis=0)
        high = known.sum(axis=0) / np.where(left > error, left - error, 0.0)
        # No D exceeds that of a short behind its row; C / W itself may be off.
        off = errors.error * self._law.share_slope(ports)
        surely = np.where(unknown, 0.0, share - off)
        short = self._short
        if self._law.cancels:  # an offset that drives a current through a short is not cancelled by as large cells
            usual = np.where(unknown.any(axis=0), 0.0, np.maximum(driven, 0.0)).max()
            short = np.minimum(short, _UNUSUAL * usual) if usual > 0.0 else short
        bound = np.where(surely > LEAST, (short - ports.apart) / np.maximum(surely, LEAST), np.inf)
        high = np.fmax(np.fmin(high, bound.min(axis=0)), total)
        # A current into an unknown cell leaves the column at that cell, not at a mean one.
        per_sum, loose = np.abs(share), (most * unknown).sum(axis=0)
        if self._law.has_potential and unknown.any():
            behind = np.where(loose > 0.0, (most * unknown * self._behind_cell).sum(axis=0) / loose, self._behind)
            per_sum = np.abs(share - ports.apart * self._behind) + np.abs(ports.apart) * behind
        per_sum = np.where(scale_open, per_sum + off, per_sum)
        wider = np.where(per_sum != 0.0, per_sum * (high - total), 0.0)
        most = np.where(under_range, most + wider, most)
        return _Sums(
            rough=scale_open | unknown.any(axis=0),
            width=np.where(unknown.any(axis=0) | np.isinf(errors.of_left), high - low, 0.0),
            per_sum=per_sum,
            low=low,
            below=np.where(unknown, least, driven - per_sum * (total - low)),
            above=np.where(unknown, most, driven + wider),
        )

    def _potentials(self, ports: Ports, sums: _Sums, volts: FloatArray, drive: FloatArray) -> FloatArray:
        """V (N, M), of the columns above the idle lines while each row is driven."""
        if self._floating:
            floating: FloatArray = np.abs(self._board.drive - ports.drive)
            return floating
        potential = np.abs(self._law.potential(volts))
        if self._follows:  # what the selected row drives through the leads of the idle columns
            return np.maximum(potential, self._law.wire * np.maximum(ports.driven, 0.0) * drive)
        if self._one_by_one:  # idle columns stand where their idle ends leave them
            behind = np.maximum(sums.low, LEAST * self._short.max()) + self._idle
            potential = potential + np.abs(ports.apart) / behind * drive
        return np.minimum(potential, drive)

    def _rows(
        self,
        ports: Ports,
        errors: LawErrors,
        unknowns: Unknowns,
        sums: _Sums,
        drive: FloatArray,
        potential: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Potential (N, M) of a driven row at its cells over the drive, and its bounds."""
        driven, full = ports.driven, abs(self._board.drive) if self._floating else drive
        potential = potential / full
        row = np.clip(1.0 - self._lost(driven - np.maximum(driven, 0.0) * potential), _LEAST_LEFT, 1.0)
        more, less = np.maximum(sums.above - driven, 0.0), np.maximum(driven - sums.below, 0.0)
        if self._holds:
            into_end = self._into_end
            if self._saturates:  # the current of the column's other cells leaves by their idle rows
                idle = np.where(unknowns.limited, 0.0, np.maximum(driven, 0.0)).sum(axis=0)
                into_end = np.minimum(into_end + idle, self._short)
            more = np.where(unknowns.limited, np.maximum(into_end - ports.apart * (drive / full), 0.0), more)
        slack = self._to_driver * np.where(errors.row_open > OPEN_ROW, errors.of_sums, 0.0)[:, None]
        low = row - self._lost(more) - slack
        high = np.minimum(row + self._lost(less) + slack, 1.0)
        if self._divides:  # a row stands above all columns that it feeds
            low = np.maximum(low, np.minimum(potential.max(axis=1)[:, None], row))
        return row, np.clip(low, 0.0, row), high

    def _lost(self, conductance: FloatArray) -> FloatArray:
        """Share (N, M) of a row's drive lost on the way to its cells, which conduct so many S (N, M) each."""
        lost: FloatArray = (self._shared @ conductance[:, :, None])[..., 0]
        return lost

    def _changes(
        self,
        ports: Ports,
        sums: _Sums,
        share: FloatArray,
        added: FloatArray,
        row: FloatArray,
        low: FloatArray,
        high: FloatArray,
    ) -> FloatArray:
        """Relative change (N, M) of the cells by the laws, with the bounds of the rows and S (N, M) of currents."""
        up, down = row / low, row / high
        nominal = np.maximum(np.abs(ports.driven), _TINY)
        by_sum = sums.per_sum * sums.width / nominal
        rough = by_sum * up + up * (1.0 + added / nominal) - 1.0
        apart, share = ports.apart / row, share / row
        left, left_high = 1.0 - share.sum(axis=0), 1.0 - (share * up).sum(axis=0)
        total = apart.sum(axis=0) / left
        total_high = (apart * up + added / low).sum(axis=0) / np.where(left_high > 0.0, left_high, 0.0)
        total_high = np.where(left > 0.0, total_high, np.inf)
        total_low = (apart * down - added / row).sum(axis=0) / (1.0 - (share * down).sum(axis=0))
        middle = apart + share * total
        highest = (apart + added / row) * up + np.where(share != 0.0, share * up * total_high, 0.0)
        lowest = (apart - added / row) * down + share * down * total_low
        fine = np.maximum(highest - middle, middle - lowest) / np.maximum(np.abs(middle), _TINY)
        changed = np.where(sums.rough, rough, fine)
        return np.where(np.isnan(changed), np.inf, np.maximum(changed, 0.0))

    def _between(
        self,
        ports: Ports,
        errors: LawErrors,
        cells: FloatArray,
        unknowns: Unknowns,
        sums: _Sums,
        raised: FloatArray,
        potential: FloatArray,
    ) -> FloatArray:
        """A (N, M) into each column in each step that unknown cells may add, or keep away.

        Args:
            ports: of the frame.
            errors: of these.
            cells: (N, M) S.
            unknowns: readings that state bounds only.
            sums: bounds of the columns.
            raised: (N, M) factor by which a row's cells may conduct more.
            potential: (N, M) V of the columns.

        """
        limited, unknown = unknowns.limited, unknowns.any
        usual = np.maximum(np.minimum(ports.cells, _CORRECTED * cells), 0.0)
        ordinary = np.where(limited, 0.0, np.where(unknowns.under_range, sums.above, usual))
        if self._floating:
            others = np.maximum(ordinary.sum(axis=1)[:, None], _TINY)
            share = ordinary / others
            most = np.where(limited, 1.0, sums.above / (sums.above + others))
            loose = np.where(unknown, most, np.where(np.any(unknown, axis=1, keepdims=True), share, 0.0))
            leak = np.where(limited, 1.0 / (self._pull + 1.0 / np.maximum(sums.above, _TINY)), 0.0)
        else:
            share = np.minimum(self._to_driver * np.maximum(ports.driven, 0.0), 1.0)
            width = sums.above - sums.below
            loose = np.where(width > _LEAST_LEFT * np.abs(sums.above), np.minimum(self._to_driver * width, 1.0), 0.0)
        # V, of the column in its cell's own step, in which an output at a limit does not hold it.
        in_own_step = np.where(limited, self._column, np.where(unknowns.under_range, self._adrift, 0.0))
        # Potentials (steps, rows) of the idle rows that the unknown cells may change, and what the rows then feed.
        lifted = potential @ share.T
        change = potential @ loose.T + lifted * loose.sum(axis=1) + in_own_step @ (loose + share).T
        conducting = np.where(limited, 0.0, ordinary * raised)
        conducting = np.where(np.isfinite(conducting), conducting, _MOST)
        added = _of_idle(change) @ conducting
        added += potential * (loose.sum(axis=1) @ conducting)  # what a row that follows such a cell takes, or does not
        # Unknown cells let the current of their own column out to others, and in from them.
        added += _of_idle((potential + in_own_step) @ conducting.T) @ loose
        added += potential * (conducting.sum(axis=1) @ loose)
        unclear = np.where(errors.linear > _UNCLEAR, np.minimum(errors.linear, _MOST), 0.0) * ordinary
        if unclear.any():
            added += _of_idle(lifted) @ unclear + potential * (share.sum(axis=1) @ unclear)
        if self._floating:  # a cell at a limit lets its column's potential out by its row's pull-down
            added += potential * leak.sum(axis=0)
        # Two unknown cells of one row may join their columns: these share their currents, and what drives them apart.
        ties = unknown & (loose > _TIED)
        if (np.count_nonzero(ties, axis=1) > 1).any():
            together = ties.T.astype(np.float64) @ ties
            together.flat[:: len(together) + 1] = 0.0
            joined: BoolArray = np.greater(together, 0.5)
            passes_on = np.where(joined, self._passes_on, 0.0)
            current = np.abs(ports.apart) * np.abs(ports.drive)
            beyond = np.where(limited, current, 0.0)  # nothing holds the column in that step
            added += current @ passes_on + current * passes_on.sum(axis=1) + beyond @ joined
            added += np.where(joined, self._driven_apart, 0.0).sum(axis=0)
        if self._hidden.any() and in_own_step.any():
            # So may cells behind a break. An output at its supply no longer holds its column, which feeds the others.
            beside = (self._hidden.T.astype(np.float64) @ self._hidden) * self._most_beside
            beside.flat[:: len(beside) + 1] = 0.0
            added += in_own_step @ beside
        return np.nan_to_num(added, posinf=np.inf)


def _of_idle(by_step: FloatArray) -> FloatArray:
    """Values (steps, rows) without those of the rows that are driven in their own steps."""
    idle = by_step.copy()
    idle.flat[:: len(idle) + 1] = 0.0
    return idle
