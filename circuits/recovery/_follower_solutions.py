"""Enclosure of all sets of cells that give the readings of a follower board.

A follower of finite gain A or offset holds idle lines a little below the sensed column, by the voltage e. The
column's conductance S to all idle lines then takes the current e S, beside that of the reference resistor:

    Y_ij (drive - V_ij) = V_ij / Rref + e_ij S_ij,        Y_ij = G_ij / att_ij.

Y is the conductance from the row's driver to the column's end, and att what the leads of row and column make of it.
Both att and S rise with all cells. So the cells of a row whose lead takes most of the drive may conduct many times as
well, if those of the columns do too: the larger S demands what the larger att loses. For equal cells this is a
quadratic equation, and both of its solutions may be those of real cells.

With the readings as they are, the equations are a fixed point G = F(G), and F rises with each cell. Let b be a factor
by which some other solution is above the found one at most, at one cell or more. There,

    b G_ij <= F_ij(b G).

Where F(b G) < b G at all cells, no solution is above the found one by b at most. This is tried for all b up to cells of
1 ohm, and likewise for all factors below 1. The largest factor that is left is where F starts from, in a sequence
which falls to the largest solution, cell by cell. Other sets with cells of less than 1 ohm are not enclosed.

Idle lines above the sensed column bring current into it instead, as they do by an offset while a poor conductor is
read. The sequence counts their S as it has been found. Where others may be far away, S is enclosed with them, and so is
what it makes of such a reading. The same holds for current that reaches the column by detours: over a column's own
wire, other rows and their cells.
"""

from __future__ import annotations

import numpy as np

from ...arrays import BoolArray, FloatArray
from ._coupled_board import CoupledBoard, Frame, Known
from ._linearised import Base

_LEAST = 1e-30  # S, or A: next to none
_LARGEST_SIEMENS = 1e6  # that of a cell that ran away is infinite
_BOUNDLESS = 1e12  # 1/S, where a reading is next to none
_MOST_SIEMENS = 1.0  # what cells conduct at most that are many times as conductive as they seem
_LARGEST_ERROR = 1e3  # relative, of a reading that tells of no current
_NEAR = 0.25  # relative change of cells up to which linear uncertainties suffice
_PARTS = np.linspace(0.0, 1.0, 25)[1:]  # of the logarithms of the largest factors, at which F is tried
_SLACK = 0.01  # share by which F must miss, for what lies between two factors
_DRIFTED = 1.65  # factor by which cells may differ from those of a base while it serves
_ALIKE, _ALIKE_MARGIN = 0.05, 1.25  # change of logarithms while a result is kept, and what it is multiplied by
_NOTABLE = 0.02  # share of a reading's current
_ROUNDS = 8  # of the sequence, between two trials
_TRIALS = 4
_STILL = 1e-3  # relative change of factors by a round or a trial after which others hardly narrow them any more
_LEAST_FACTOR = 1e-4  # below the found solution


class FollowerSolutions:
    """All sets of cells that give the readings of one board."""

    def __init__(self, parts: CoupledBoard) -> None:
        """For a board."""
        board, lines = parts.board, parts.lines
        self._parts = parts
        self._row = np.where(np.isfinite(lines.to_driver), lines.to_driver, 0.0)  # (N, M) ohm
        to_end = np.where(np.isfinite(lines.to_end), lines.to_end, 0.0)
        self._wire = to_end  # (N, M) ohm
        self._lead = np.where(np.isfinite(board.column_lead), board.column_lead, 0.0)  # (M,) ohm
        self.applies = board.circuit.drives_idle_lines
        """whether the circuit has followers that hold idle lines"""
        self._kept: tuple[Base | None, bool] = None, False  # whether others are conceivable while a base serves
        self._last: tuple[FloatArray, FloatArray | None] | None = None  # logarithms (n,) and the change found for them

    def change(self, frame: Frame, known: Known, base: Base) -> FloatArray | None:
        """Largest relative change (n,) of the cells from those that have been found to others that give the readings.

        Args:
            frame: the readings.
            known: the cells that have been found for them.
            base: the linear model that served for this.

        Returns:
            None where linear uncertainties suffice, as in nearly all frames.

        """
        if self._kept[0] is base:
            if not self._kept[1]:
                return None
            if self._last is not None and np.abs(self._last[0] - known.log).max() <= _ALIKE:
                return self._last[1]
            (found,) = self._law(frame, known).changes()
        else:
            found, drifted = self._law(frame, known).changes(1.0, _DRIFTED)
            self._kept = base, found is not None or drifted is not None
        change = None if found is None else _ALIKE_MARGIN * found.ravel()
        self._last = known.log, change
        return change

    def _law(self, frame: Frame, known: Known) -> _Law:
        """The fixed point equation of a frame's readings."""
        board, shape = self._parts.board, self._parts.shape
        conductance = np.minimum(board.cell_conductance(known.cells), _LARGEST_SIEMENS)
        column = known.volts.reshape(shape) / board.loop_share - board.level - board.offset
        sign = float(np.sign(board.drive))
        below = sign * (board.inverse_gain * column - board.follower_lift)
        current = np.maximum(sign * (column / board.reference + board.bias), _LEAST)
        counts: BoolArray = ~self._parts.gone.reshape(shape)
        if frame.ignored is not None:
            counts = counts & ~frame.ignored.reshape(shape)
        error = np.minimum(frame.error * frame.slope, _LARGEST_ERROR).reshape(shape)
        per_siemens = np.clip(below / current, -_BOUNDLESS, _BOUNDLESS)
        return _Law(self._row, self._wire, self._lead, conductance, per_siemens, error, counts)


class _Law:
    """The fixed point equation F(G) = G of the readings of one frame. Arrays are (N, M)."""

    def __init__(
        self,
        row: FloatArray,
        wire: FloatArray,
        lead: FloatArray,
        conductance: FloatArray,
        per_siemens: FloatArray,
        error: FloatArray,
        counts: BoolArray,
    ) -> None:
        """For cells that have been found.

        Args:
            row: ohm from crosspoints to the rows' drivers.
            wire: ohm from crosspoints to their columns' last ones.
            lead: ohm (M,) from there to the columns' ends.
            conductance: S of the cells.
            per_siemens: 1/S, current to idle lines per siemens over that of the reference resistor; negative where
                it comes from idle lines.
            error: relative, by a cell's own reading.
            counts: cells whose readings count; the others stay as they are.

        """
        self._row, self._wire, self._lead, self._cells = row, wire, lead, conductance
        self._column = wire + lead  # (N, M) ohm from crosspoints to the columns' ends
        self._taken, self._brought = np.maximum(per_siemens, 0.0), np.maximum(-per_siemens, 0.0)
        self._counts, self._wide = counts, 1.0 + error

    def _demand(self, cells: FloatArray) -> FloatArray:
        """Conductance G that the readings demand beside cells (..., N, M) in S, but for a factor of each reading."""
        row, column = self._row, self._column
        to_drivers = cells / (1.0 + cells * row)
        to_rows = to_drivers.sum(axis=-2, keepdims=True) - to_drivers  # h, from a column to the other rows' drivers
        by_row, by_column = self._by_row(cells), 1.0 + column * to_rows
        attenuation = by_row * by_column + cells * (row * by_column + column * by_row)
        demand: FloatArray = attenuation * (1.0 + self._taken * self._to_idle_lines(cells, by_row))
        return demand

    def _to_idle_lines(self, cells: FloatArray, by_row: FloatArray) -> FloatArray:
        """S (..., 1, M) of columns to idle lines at most: to other rows, and by way of these to other columns.

        Each crosspoint counts with the wire of its own distance to the column's end. That other crosspoints share
        this wire, and take some of the voltage, can only lessen S.

        Args:
            cells: (..., N, M) S.
            by_row: (..., N, M), see :meth:`_by_row`.

        """
        behind = self._row / by_row + self._wire
        into = (cells / (1.0 + cells * behind)).sum(axis=-2, keepdims=True)
        siemens: FloatArray = into / (1.0 + self._lead * into)
        return siemens

    def _by_row(self, cells: FloatArray) -> FloatArray:
        """1 + r g (..., N, M), with g from a row to the other columns' ends, beside cells (..., N, M) in S."""
        to_ends = cells / (1.0 + cells * self._column)
        by_row: FloatArray = 1.0 + self._row * (to_ends.sum(axis=-1, keepdims=True) - to_ends)
        return by_row

    def _draws_on_idle_lines(self, most: FloatArray) -> bool:
        """Whether idle lines take a notable current; without it conductances between terminals have one solution.

        Args:
            most: (..., N, M) S, what cells conduct at most.

        """
        share = self._taken * self._to_idle_lines(most, self._by_row(most))
        return bool((share > _NOTABLE).any(where=self._counts))

    def _by_idle_lines_above(self, cells: FloatArray, factors: FloatArray) -> FloatArray:
        """Relative change (K, 2, N, M) of cells to whose readings idle lines bring current, if others change.

        Args:
            cells: (K, 1, N, M) S.
            factors: (K, 2, N, M) of them, the others.

        """
        others, brought = factors * cells, self._brought
        now = self._to_idle_lines(cells, self._by_row(cells))
        then = self._to_idle_lines(others, self._by_row(others))
        change: FloatArray = brought * np.abs(then - now) / np.maximum(1.0 - brought * now, _LEAST)
        return change

    def _by_detours(self, cells: FloatArray, factors: FloatArray) -> FloatArray:
        """Relative change (K, 2, N, M) of cells by current that detours bring to their readings, if others change.

        A driven row lifts the columns, by their own wire, these lift other rows, and those feed the sensed column. What
        comes so is not the cell's.

        Args:
            cells: (K, 1, N, M) S.
            factors: (K, 2, N, M) of them, the others.

        """
        to_columns = self._lifts(factors * cells) - self._lifts(cells)
        change: FloatArray = np.maximum(to_columns, 0.0) / np.maximum(cells, _LEAST) * self._demand(cells)
        return change

    def _lifts(self, cells: FloatArray) -> FloatArray:
        """S (..., N, M) at most from rows to columns by detours, beside cells (..., N, M) in S."""
        columns = self._column * (cells / (1.0 + cells * (self._row + self._column)))  # V per volt
        rows = self._row * cells
        rows = rows / (1.0 + rows.sum(axis=-1, keepdims=True))
        lifted = columns @ np.swapaxes(rows, -1, -2)  # of other rows by each driven one
        lifted *= 1.0 - np.eye(lifted.shape[-1])
        into: FloatArray = lifted @ (cells / (1.0 + cells * self._column))
        return into

    def changes(self, *times: float) -> list[FloatArray | None]:
        """Largest relative change of the cells to those of another solution; None where there is no other one.

        Args:
            times: for readings of cells that all conduct so many times as well as those that were found; 1 without it.

        Returns:
            For each of ``times``. All are narrowed as long as there is another solution for the first of them.

        """
        # Axes: the readings, then solutions above and below, then the cells.
        cells = np.array(times or (1.0,))[:, None, None, None] * self._cells
        counts, most = self._counts, np.maximum(_MOST_SIEMENS, (1.0 + _NEAR) * cells)
        most = np.where(counts, most, cells)
        if not self._draws_on_idle_lines(most):
            return [None] * len(cells)
        above = most / np.maximum(cells, _LEAST)
        limits = np.concatenate([above, np.full(above.shape, _LEAST_FACTOR)], axis=1)
        far, enclosed = self._enclosed(cells, np.where(counts, limits, 1.0))
        change = np.maximum(np.maximum(enclosed / self._wide - 1.0, 1.0 - enclosed * self._wide), 0.0)
        if far.any():
            change += self._by_detours(cells, enclosed)
            if self._brought.any():
                change += self._by_idle_lines_above(cells, enclosed)
        largest = change.max(axis=1, where=far[..., None, None], initial=0.0)
        return [each if (each > _NEAR).any() else None for each in largest]

    def _enclosed(self, cells: FloatArray, factors: FloatArray) -> tuple[BoolArray, FloatArray]:
        """Enclose the solutions above and below those that were found.

        Args:
            cells: (K, 1, N, M) S, found for K sets of readings.
            factors: (K, 2, N, M) of them, the largest and the least that are looked at.

        Returns:
            (K, 2), whether there may be a solution far away on that side; and (K, 2, N, M), factors within which it is.

        """
        counts, side = self._counts, np.array([1.0, -1.0])[:, None, None]  # of the logarithms
        found, wide = self._demand(cells), self._wide**side
        demanded_at_most, near = wide / found, (1.0 + _NEAR) ** side
        beside = np.where(counts, (1.0 + _SLACK) ** side, 1.0)
        each = np.indices(factors.shape[:2])
        far = np.ones(factors.shape[:2], dtype=np.bool_)
        for _ in range(_TRIALS):
            logarithm = np.log(factors)
            times = np.exp(_PARTS[:, None, None, None, None] * logarithm)
            ratio = self._demand(times * cells) * demanded_at_most / times
            # At the cell that is farthest off, another solution would demand as much.
            beyond = (side * ratio >= side / (1.0 + _SLACK) ** side) & (side * times > side * near)
            possible = beyond.any(axis=(-2, -1), where=counts)
            far &= possible.any(axis=0)
            if not far[0].any():
                break
            last = len(_PARTS) - 1 - possible[::-1].argmax(axis=0)
            before, factors = factors, times[last, *each]
            for _ in range(_ROUNDS):
                wider = factors
                factors = self._demand(wider * cells)
                factors *= demanded_at_most
                np.clip(factors, np.minimum(beside, wider), np.maximum(beside, wider), out=factors)
                if _alike(factors, wider):
                    break
            if _alike(factors, before):
                break
        return far, factors


def _alike(factors: FloatArray, before: FloatArray) -> bool:
    """Whether no factor differs notably from what it was before."""
    return bool((np.abs(factors - before) <= _STILL * before).all())
