"""Cells beside others whose readings do not determine them: bounds by Kirchhoff's laws.

A reading at a limit leaves its cell anywhere between the value at the limit and a short. The same holds for the cells of
a column or a row of whose drive nothing is left beyond the readings' error. Such a cell changes others

* in its own column, whose sum T is then an interval;
* in its own row, whose driver it loads: the current I of its own step;
* in all other columns, as it ties its column to its row while the row is idle. A row of resistance r lets the current
  C_lj (C_kj - C_kl) pass from column j to column l, with C_lj = sum_m r_m D_mj G_ml.

The bounds follow from the laws of :mod:`._law` with intervals in place of numbers.
"""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._board import Board
from .._parts import LEAST_SHORT_OHM
from ..readouts import PortLaw
from ._law import LEAST, Law, Ports

if TYPE_CHECKING:
    from ._live_law import _Errors

_MARGIN = 1.2  # for segments, and for what is beyond the first order
_UNCLEAR = 0.1  # relative uncertainty from which on a cell's own error counts in other columns
_OPEN_SCALE = 0.2  # error of what is left of a column's drive, relative to it, from which on its scale is open
_OPEN_ROW = 0.3
_FOLLOWS = 0.25  # share of a row's drive that a follower's error may reach


class Unknowns(NamedTuple):
    """Readings (N, M) that state bounds only."""

    limited: BoolArray
    """the cell conducts at least what the reading says"""
    faint: BoolArray
    """the cell conducts at most what the reading says"""

    @classmethod
    def of(cls, shape: tuple[int, int], limited: BoolArray | None, faint: BoolArray | None) -> Self:
        nowhere = np.zeros(shape, dtype=np.bool_)
        return cls(nowhere if limited is None else limited, nowhere if faint is None else faint)

    @property
    def any(self) -> BoolArray:
        return self.limited | self.faint


class Enclosure:
    """Bounds of one board's cells beside unknown ones."""

    def __init__(
        self, board: Board, laws: Law, law: PortLaw, wire: FloatArray, to_driver: FloatArray, to_end: FloatArray
    ) -> None:
        self._board, self._laws, self._law = board, laws, law
        self._wire = wire
        lead = laws.lead
        self._lead = lead
        self._short = 1.0 / (to_driver + LEAST_SHORT_OHM)
        ohms = 0.0 if board.circuit.drives_idle_lines else board.circuit.end_resistance(board)
        lead_out = wire - to_end.mean(axis=0)
        self._to_end, self._behind = ohms + lead_out + to_end, ohms + wire  # ohm, of each cell and of a column
        ends = board.circuit.ends(board)
        low, high = board.supply
        drive = abs(board.drive)
        self._holds = ends is not None  # whether amplifiers hold the columns
        self._saturates = False
        most = self._short  # S, largest current of a short in its own step, per volt of drive
        column = np.full(board.shape, drive)  # V, potential of its column then
        if ends is not None:
            limit = (low if board.drive > 0 else high) if board.circuit.inverts else (high if board.drive > 0 else low)
            self._saturates = isfinite(limit)
            if self._saturates:
                source = np.abs(limit - board.level) + np.abs(board.offset)
                most = (1.0 + source / drive) / (lead[:, None] + board.reference + wire)
                self._per_ohm = True
            else:
                behind = ends.resistance + wire
                most = 1.0 / (lead[:, None] + behind + LEAST_SHORT_OHM)
                column = most * behind * drive + np.abs(ends.source)
        self._most, self._column = most, column
        self._floating = board.floating
        self._one_by_one = board.circuit.columns_one_by_one(board)
        self._divides = not board.circuit.has_amplifiers
        source = np.zeros(board.shape[1]) if ends is None else ends.source * np.ones(board.shape[1])
        behind = (board.reference if ends is None else ends.resistance) + wire + LEAST_SHORT_OHM
        self._apart = np.abs(source[:, None] - source) / (behind[:, None] + behind)  # A between two joined columns
        self._follows = board.circuit.drives_idle_lines

    def coupling(self, cells: FloatArray) -> FloatArray:
        """(M,) share of a column's current that may pass to other columns by way of the rows, at cells (N, M) in S."""
        (_, i1), (_, c1), (_, w1) = self._law
        per_siemens = np.abs((c1 - (w1 if self._floating else 0.0) * 1.0) / i1)  # ohm behind the column
        behind = per_siemens * cells.sum(axis=0)
        if self._floating:
            return behind
        loss = float((self._lead * cells.sum(axis=1)).max())
        return loss * behind / (1.0 + behind)

    def in_question(self, ports: Ports, of_left: FloatArray) -> BoolArray:
        """Columns (M,) whose scale the readings leave open: more than one may give them.

        While all rows are driven, a column lies ``left`` below the drive. By reciprocity a row then lies r sum(I) below
        it, per volt. The scale of a column is unique if the column lies below all rows; else a row may follow it.
        """
        if not self._divides or self._one_by_one:
            return np.zeros(len(of_left), dtype=np.bool_)
        below = float((self._lead * ports.apart.sum(axis=1)).max())
        return ports.left - of_left < below

    def may_follow(self, ports: Ports, volts: FloatArray) -> BoolArray:
        """Cells (N, M) of rows that the follower's own error may lift as far as their drive."""
        (i0, i1), (c0, c1), _ = self._law
        apart = np.abs((c0 + c1 * volts) - self._wire * (i0 + i1 * volts))  # V, of the column's end above idle lines
        lifted = (self._lead * (apart / (self._wire + 1.0)).sum(axis=1))[:, None]
        return (lifted > _FOLLOWS * np.abs(ports.drive)) | (np.abs(ports.share).sum(axis=0) > _FOLLOWS)

    @np.errstate(divide="ignore", invalid="ignore", over="ignore")
    def __call__(
        self, ports: Ports, errors: _Errors, cells: FloatArray, unknowns: Unknowns | None
    ) -> FloatArray:
        """Largest relative change (N, M) of each cell over all values of the unknown ones."""
        shape = cells.shape
        limited, faint = Unknowns.of(shape, None, None) if unknowns is None else unknowns
        unknown = limited | faint
        if not self._board.plain and unknown.any():  # bridges and sheets pass currents by other ways
            return np.full(shape, np.inf)
        _, (_, c1), (_, w1) = self._law
        drive, share = (np.broadcast_to(np.abs(each), shape) for each in (ports.drive, ports.share))
        share = np.broadcast_to(ports.share, shape)
        own = errors.error * np.broadcast_to(errors.sensitivity.slope, shape)
        driven, lead = ports.driven, self._lead[:, None]
        scale_open = errors.column_open > _OPEN_SCALE
        # Port conductances: unknown cells, and columns of an open scale.
        least = np.where(limited, np.maximum(driven - own, 0.0), 0.0)
        most = np.where(limited, self._short, np.maximum(driven, 0.0) + own)
        error = np.where(scale_open, errors.of_left, 0.0)
        known, left = np.where(unknown, 0.0, ports.apart), 1.0 - np.where(unknown, 0.0, share).sum(axis=0)
        low = (known + np.where(limited, least, 0.0)).sum(axis=0) / (left + error)
        known, left = np.where(limited, most, ports.apart + own * faint), 1.0 - np.where(limited, 0.0, share).sum(axis=0)
        high = known.sum(axis=0) / np.where(left > error, left - error, 0.0)
        # Error of C / W, which counts where it may exceed what is left of the drive.
        off = errors.error * np.abs(c1 - w1 * share) / drive
        surely = share - off
        bound = np.where((surely > LEAST) & ~unknown, (self._short - ports.apart) / np.maximum(surely, LEAST), np.inf)
        high = np.fmax(np.fmin(high, bound.min(axis=0)), ports.total)  # no D exceeds that of a short behind its row
        low = np.fmin(low, ports.total)
        # A current into an unknown cell leaves the column at that cell, not at a mean one.
        by_sum = np.abs(share)
        if self._laws.has_potential and unknown.any():
            loose_sum = (most * unknown).sum(axis=0)
            where = np.where(loose_sum > 0.0, (most * unknown * self._to_end).sum(axis=0) / loose_sum, self._behind)
            by_sum = np.abs(share - ports.apart * self._behind) + np.abs(ports.apart) * where
        by_sum = np.where(scale_open, by_sum + off, by_sum)
        most = np.where(faint, most + by_sum * (high - ports.total), most)
        below = np.where(unknown, least, driven - by_sum * (ports.total - low))
        above = np.where(unknown, most, driven + np.where(by_sum != 0.0, by_sum * (high - ports.total), 0.0))
        # Potentials of the columns above the idle lines.
        potential = np.abs(share) * drive
        if self._floating:
            potential = np.abs(self._board.drive - np.broadcast_to(ports.drive, shape))
        elif self._follows:  # what the selected row drives through the leads of the idle columns
            potential = np.maximum(potential, self._wire * np.maximum(driven, 0.0) * drive)
        elif self._one_by_one:  # idle columns have no load
            potential = potential + np.abs(ports.apart) / np.maximum(low, LEAST * self._short.max()) * drive
            potential = np.minimum(potential, drive)
        # Rows while they are driven: their potential over the drive.
        lifted = (lead * np.maximum(driven, 0.0) * potential / drive).sum(axis=1)[:, None]
        row = np.clip(ports.row_left[:, None] + lifted, 1e-9, 1.0)
        current = np.maximum(above - driven, 0.0)
        lacking = np.maximum(driven - below, 0.0)
        if self._saturates:
            idle = np.where(limited, 0.0, np.maximum(driven, 0.0)).sum(axis=0)
            current = np.where(limited, np.maximum(np.minimum(self._most + idle, self._short) - ports.apart, 0.0), current)
        elif self._holds:
            current = np.where(limited, np.maximum(self._most - ports.apart, 0.0), current)
        slack = np.where(errors.row_open > _OPEN_ROW, errors.sums, 0.0)[:, None]
        row_low = row - lead * (current.sum(axis=1)[:, None] + slack)
        row_high = np.minimum(row + lead * (lacking.sum(axis=1)[:, None] + slack), 1.0)
        if self._divides:  # a row stands above all columns that it feeds
            row_low = np.maximum(row_low, np.minimum((potential / drive).max(axis=1)[:, None], row))
        row_low = np.clip(row_low, 0.0, row)
        # Currents from column to column by way of the idle rows.
        added = np.zeros(shape)
        if self._laws.has_leads or self._floating:
            added = self._between(ports, errors, cells, unknowns, below, above, row / row_low, potential)
        added = added / drive
        # Cells
        up, down = row / row_low, row / row_high
        rough = scale_open | unknown.any(axis=0)
        nominal = np.maximum(np.abs(driven), 1e-300)
        by_total = by_sum * (high - low) / nominal
        apart_, share_ = ports.apart / row, share / row
        left = 1.0 - share_.sum(axis=0)
        total = apart_.sum(axis=0) / left
        left_high = 1.0 - (share_ * up).sum(axis=0)
        total_high = (apart_ * up + added / row_low).sum(axis=0) / np.where(left_high > 0.0, left_high, 0.0)
        total_low = (apart_ * down - added / row).sum(axis=0) / (1.0 - (share_ * down).sum(axis=0))
        total_high = np.where(left > 0.0, total_high, np.inf)
        middle = apart_ + share_ * total
        highest = (apart_ + added / row) * up + np.where(share_ != 0.0, share_ * up * total_high, 0.0)
        lowest = (apart_ - added / row) * down + share_ * down * total_low
        by_law = np.maximum(highest - middle, middle - lowest) / np.maximum(np.abs(middle), 1e-300)
        changed = np.where(rough, by_total + (up * (1.0 + added / nominal) - 1.0) + by_total * (up - 1.0), by_law)
        changed = np.where(np.isnan(changed), np.inf, np.maximum(changed, 0.0))
        alone = ports.cells
        return _MARGIN * changed * np.maximum(alone / np.maximum(cells, 1e-300), 1.0)

    def _between(
        self,
        ports: Ports,
        errors: _Errors,
        cells: FloatArray,
        unknowns: Unknowns | None,
        below: FloatArray,
        above: FloatArray,
        raised: FloatArray,
        potential: FloatArray,
    ) -> FloatArray:
        """A (N, M) into each column in each step that unknown cells may add or keep away."""
        shape, lead = cells.shape, self._lead[:, None]
        limited, faint = Unknowns.of(shape, None, None) if unknowns is None else unknowns
        unknown = limited | faint
        usual = np.maximum(np.minimum(ports.cells, 3.0 * cells), 0.0)
        ordinary = np.where(limited, 0.0, np.where(faint, above, usual))
        apart = above - below
        if self._floating:
            sums = np.maximum(ordinary.sum(axis=1)[:, None], 1e-300)
            share = ordinary / sums
            up = np.where(limited, 1.0, np.where(unknown, above / (above + sums), 0.0))
            loose_share = np.where(unknown, up, np.where(unknown.any(axis=1)[:, None], share, 0.0))
        else:
            share = np.minimum(lead * np.maximum(ports.driven, 0.0), 1.0)
            loose_share = np.where(apart > 1e-9 * np.abs(above), np.minimum(lead * apart, 1.0), 0.0)
        # Potential (steps, rows) of idle rows that the unknown cells may change.
        lifted = potential @ share.T
        change = potential @ loose_share.T + lifted * loose_share.sum(axis=1)
        loose = np.where(limited, self._column, 0.0)
        change += loose @ (loose_share + share).T
        change.flat[:: len(change) + 1] = 0.0
        raised = np.where(limited, 0.0, ordinary * raised)
        raised = np.where(np.isfinite(raised), raised, 1e6)
        added = change @ raised
        # Unknown cells let the current of their own column out to others, and in from them.
        into_row = (potential + loose) @ raised.T
        into_row.flat[:: len(into_row) + 1] = 0.0
        added += into_row @ loose_share + potential * (raised.sum(axis=1) @ loose_share)
        unclear = np.where(errors.linear > _UNCLEAR, np.minimum(errors.linear, 1e6), 0.0) * ordinary
        if unclear.any():
            between = lifted.copy()
            between.flat[:: len(between) + 1] = 0.0
            added += between @ unclear + potential * (share.sum(axis=1) @ unclear)
        # Two unknown cells of one row may join their columns: these share their currents, and what drives them apart.
        good = unknown & (loose_share > 0.01)
        if (np.count_nonzero(good, axis=1) > 1).any():
            joined = good.T.astype(np.float64) @ good > 0.5
            joined.flat[:: len(joined) + 1] = False
            current = np.abs(ports.apart) * np.abs(ports.drive)
            added += current @ joined + np.where(joined, self._apart, 0.0).sum(axis=0)
        return np.nan_to_num(added, posinf=np.inf)
