"""Fixed-point equation of a follower board's readings, and the enclosure of all its solutions.

:mod:`._follower_solutions` derives the equation G = F(G), and shows why its solutions are enclosed. The two ends of the
enclosure are found together. Trials of factors, from the largest one down to none, look for the first factor at which F
demands more than it gets; rounds of the fixed-point sequence continue from there. After every trial and every round the
factors are an enclosure already.

The loops compute the same as the array operations beside them, and end a trial at the largest possible factor.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...common.compiled import FlagRows, Flags, Row, Rows, loop

LEAST = 1e-30
"""S, or A: counts as zero"""
_NEAR = 0.25  # relative change of cells up to which linear uncertainties suffice
_MOST_SIEMENS = 1.0  # largest conductance of cells that conduct many times as much as they seem to
_PARTS = 24  # equal steps of the logarithms of the largest factors, at which F is tried
_SLACK = 0.01  # relative amount by which F must miss, to cover factors between two trials
_NOTABLE = 0.02  # share of a reading's current
_ROUNDS = 8  # of the sequence, between two trials
_TRIALS = 4
_STILL = 1e-3  # relative change of factors by a round or a trial, below which further ones hardly narrow them
_LEAST_FACTOR = 1e-4  # least factor below the found solution
_SIDES = np.array([1.0, -1.0])[:, None, None]  # of the logarithms of factors: solutions above, and below


class FollowerLaw:
    """The fixed-point equation F(G) = G for the readings of one frame. Arrays are (N, M)."""

    def __init__(
        self,
        row: FloatArray,
        wire: FloatArray,
        lead: FloatArray,
        conductance: FloatArray,
        per_siemens: FloatArray,
        error: FloatArray,
        counts: BoolArray,
        enclose: Callable[..., None] | None = None,
    ) -> None:
        """For the found cells.

        Args:
            row: ohm from crosspoints to the rows' drivers.
            wire: ohm from crosspoints to their columns' last ones.
            lead: ohm (M,) from there to the columns' ends.
            conductance: S of the cells.
            per_siemens: 1/S, current to idle lines per siemens over that of the reference resistor; negative if the
                current comes from idle lines.
            error: relative, by a cell's own reading.
            counts: cells whose readings count; the others stay as they are.
            enclose: the machine code of :func:`enclose`, which takes contiguous arrays; None: there is none.

        """
        self._row, self._wire, self._lead, self._cells = row, wire, lead, conductance
        self._column = wire + lead  # (N, M) ohm from crosspoints to the columns' ends
        self._taken, self._brought = np.maximum(per_siemens, 0.0), np.maximum(-per_siemens, 0.0)
        self._counts, self._wide = counts, 1.0 + error
        self._enclose = enclose

    def _demand(self, cells: FloatArray) -> FloatArray:
        """Conductances G that the readings demand beside cells (..., N, M) in S, up to one factor per reading."""
        row, column = self._row, self._column
        to_drivers = cells / (1.0 + cells * row)
        to_rows = to_drivers.sum(axis=-2, keepdims=True) - to_drivers  # h, from a column to the other rows' drivers
        by_row, by_column = self._by_row(cells), 1.0 + column * to_rows
        attenuation = by_row * by_column + cells * (row * by_column + column * by_row)
        demand: FloatArray = attenuation * (1.0 + self._taken * self._to_idle_lines(cells, by_row))
        return demand

    def _to_idle_lines(self, cells: FloatArray, by_row: FloatArray) -> FloatArray:
        """Upper bound in S (..., 1, M) from columns to idle lines: to other rows, and through these to other columns.

        Each crosspoint counts with the wire of its own distance to the column's end. Other crosspoints share this wire
        and take some of the voltage, which can only reduce S.

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
        """Whether idle lines take a notable current; without it, conductances between terminals have one solution.

        Args:
            most: (..., N, M) S, upper bounds of the cells.

        """
        share = self._taken * self._to_idle_lines(most, self._by_row(most))
        return bool((share > _NOTABLE).any(where=self._counts))

    def _by_idle_lines_above(self, cells: FloatArray, factors: FloatArray) -> FloatArray:
        """Relative change (K, 2, N, M) of cells by currents from idle lines into their readings, if others change.

        Args:
            cells: (K, 1, N, M) S.
            factors: (K, 2, N, M) on these, for the other cells.

        """
        others, brought = factors * cells, self._brought
        now = self._to_idle_lines(cells, self._by_row(cells))
        then = self._to_idle_lines(others, self._by_row(others))
        change: FloatArray = brought * np.abs(then - now) / np.maximum(1.0 - brought * now, LEAST)
        return change

    def _by_detours(self, cells: FloatArray, factors: FloatArray) -> FloatArray:
        """Relative change (K, 2, N, M) of cells by currents that reach their readings on detours, if others change.

        A driven row lifts the columns, by their own wire; these lift other rows; and those feed the sensed column. Such
        a current is not the cell's own.

        Args:
            cells: (K, 1, N, M) S.
            factors: (K, 2, N, M) on these, for the other cells.

        """
        to_columns = self._lifts(factors * cells) - self._lifts(cells)
        change: FloatArray = np.maximum(to_columns, 0.0) / np.maximum(cells, LEAST) * self._demand(cells)
        return change

    def _lifts(self, cells: FloatArray) -> FloatArray:
        """Upper bound in S (..., N, M) from rows to columns by detours, beside cells (..., N, M) in S."""
        columns = self._column * (cells / (1.0 + cells * (self._row + self._column)))  # V per volt
        rows = self._row * cells
        rows = rows / (1.0 + rows.sum(axis=-1, keepdims=True))
        lifted = columns @ np.swapaxes(rows, -1, -2)  # of other rows by each driven one
        lifted *= 1.0 - np.eye(lifted.shape[-1])
        into: FloatArray = lifted @ (cells / (1.0 + cells * self._column))
        return into

    def change(self) -> FloatArray | None:
        """Largest relative change of the cells to those of another solution; None if there is no other solution."""
        cells, limits = self._cells, self._limits(self._cells)
        if limits is None:
            return None
        far, enclosed = self._enclosed(cells, limits, _TRIALS, _ROUNDS)
        if not far.any():
            return None
        change = np.maximum(np.maximum(enclosed / self._wide - 1.0, 1.0 - enclosed * self._wide), 0.0)
        change += self._by_detours(cells, enclosed)
        if self._brought.any():
            change += self._by_idle_lines_above(cells, enclosed)
        largest: FloatArray = change[far].max(axis=0)
        return largest if (largest > _NEAR).any() else None

    def is_conceivable(self, times: float) -> bool:
        """Whether there may be another solution for readings of cells that all conduct ``times`` as much."""
        cells = times * self._cells
        limits = self._limits(cells)
        return limits is not None and bool(self._enclosed(cells, limits, trials=1, rounds=0)[0].any())

    def _limits(self, cells: FloatArray) -> FloatArray | None:
        """Largest and least factors (2, N, M) on cells (N, M) in S that are examined.

        None if idle lines draw hardly a current even with these, so that there is no other solution.
        """
        most = np.where(self._counts, np.maximum(_MOST_SIEMENS, (1.0 + _NEAR) * cells), cells)
        if not self._draws_on_idle_lines(most):
            return None
        limits = np.stack([most / np.maximum(cells, LEAST), np.full(cells.shape, _LEAST_FACTOR)])
        limits[:, ~self._counts] = 1.0
        return limits

    def _enclosed(
        self, cells: FloatArray, factors: FloatArray, trials: int, rounds: int
    ) -> tuple[BoolArray, FloatArray]:
        """Enclose the solutions above and below the found one.

        Args:
            cells: (N, M) S, the found solution.
            factors: (2, N, M) on these, the largest and the least that are examined.
            trials: largest number of trials.
            rounds: largest number of rounds of the sequence after each trial.

        Returns:
            (2,), whether there may be a solution far away on that side; and (2, N, M), factors that enclose it if there
            may be one.

        """
        far, counts = np.ones(2, dtype=np.bool_), self._counts
        if self._enclose is not None:
            above, below = factors
            law = self._row, self._column, self._wire, self._lead, self._taken, self._wide
            self._enclose(cells, *law, counts, trials, rounds, above, below, far)
            return far, factors
        demanded_at_most, near = self._wide**_SIDES / self._demand(cells), (1.0 + _NEAR) ** _SIDES
        beside = np.where(counts, (1.0 + _SLACK) ** _SIDES, 1.0)
        parts = np.arange(1.0, _PARTS + 1.0)[:, None, None, None] / _PARTS
        for _ in range(trials):
            times = np.exp(parts * np.log(factors))
            ratio = self._demand(times * cells) * demanded_at_most / times
            # At the cell farthest away, another solution would demand as much.
            beyond = (_SIDES * ratio >= _SIDES / (1.0 + _SLACK) ** _SIDES) & (_SIDES * times > _SIDES * near)
            possible = beyond.any(axis=(-2, -1), where=counts)
            far &= possible.any(axis=0)
            if not far.any():
                break
            last = _PARTS - 1 - possible[::-1].argmax(axis=0)
            before, factors = factors, times[last, (0, 1)]
            for _ in range(rounds):
                wider = factors
                factors = self._demand(wider * cells)
                factors *= demanded_at_most
                np.clip(factors, np.minimum(beside, wider), np.maximum(beside, wider), out=factors)
                if _alike(factors[far], wider[far]):
                    break
            if _alike(factors[far], before[far]):
                break
        return far, factors


def _alike(factors: FloatArray, before: FloatArray) -> bool:
    """Whether all factors are nearly the same as before."""
    return bool((np.abs(factors - before) <= _STILL * before).all())


@loop
def _demand_of(
    cells: Rows, row: Rows, column: Rows, wire: Rows, lead: Row, taken: Rows, to_drivers: Row, into: Row, demand: Rows
) -> None:
    """Write the ``demand`` (N, M) of :meth:`FollowerLaw._demand`; ``to_drivers`` and ``into`` (M,) are overwritten."""
    rows, columns = cells.shape
    to_drivers[:] = 0.0
    into[:] = 0.0
    for i in range(rows):
        to_ends = 0.0
        for j in range(columns):
            to_end = cells[i, j] / (1.0 + cells[i, j] * column[i, j])
            to_ends += to_end
            demand[i, j] = to_end
            to_drivers[j] += cells[i, j] / (1.0 + cells[i, j] * row[i, j])
        for j in range(columns):
            by_row = 1.0 + row[i, j] * (to_ends - demand[i, j])
            behind = row[i, j] / by_row + wire[i, j]
            into[j] += cells[i, j] / (1.0 + cells[i, j] * behind)
            demand[i, j] = by_row
    for j in range(columns):
        into[j] /= 1.0 + lead[j] * into[j]
    for i in range(rows):
        for j in range(columns):
            by_row, ohm = demand[i, j], column[i, j]
            to_rows = to_drivers[j] - cells[i, j] / (1.0 + cells[i, j] * row[i, j])
            by_column = 1.0 + ohm * to_rows
            attenuation = by_row * by_column + cells[i, j] * (row[i, j] * by_column + ohm * by_row)
            demand[i, j] = attenuation * (1.0 + taken[i, j] * into[j])


@loop
def enclose(
    cells: Rows,
    row: Rows,
    column: Rows,
    wire: Rows,
    lead: Row,
    taken: Rows,
    wide: Rows,
    counts: FlagRows,
    trials: int,
    rounds: int,
    above: Rows,
    below: Rows,
    far: Flags,
) -> None:
    """As :meth:`FollowerLaw._enclosed`: narrows the factors ``above`` and ``below`` (N, M), and writes ``far`` (2,)."""
    rows, columns = cells.shape
    found, demand, tried = np.empty((rows, columns)), np.empty((rows, columns)), np.empty((rows, columns))
    logarithm, times = np.empty((rows, columns)), np.empty((rows, columns))
    to_drivers, into = np.empty(columns), np.empty(columns)
    _demand_of(cells, row, column, wire, lead, taken, to_drivers, into, found)
    before = np.empty((2, rows, columns))
    for _ in range(trials):
        for side in range(2):
            if not far[side]:
                continue
            factors = above if side == 0 else below
            for i in range(rows):
                for j in range(columns):
                    logarithm[i, j] = np.log(factors[i, j])
            far[side] = False
            part = _PARTS
            while part > 0 and not far[side]:
                share = part / _PARTS
                for i in range(rows):
                    for j in range(columns):
                        times[i, j] = np.exp(share * logarithm[i, j])
                        tried[i, j] = times[i, j] * cells[i, j]
                _demand_of(tried, row, column, wire, lead, taken, to_drivers, into, demand)
                for i in range(rows):
                    for j in range(columns):
                        if not counts[i, j]:
                            continue
                        if side == 0:
                            ratio = demand[i, j] * (wide[i, j] / found[i, j]) / times[i, j]
                            far[side] |= ratio >= 1.0 / (1.0 + _SLACK) and times[i, j] > 1.0 + _NEAR
                        else:
                            ratio = demand[i, j] * (1.0 / wide[i, j] / found[i, j]) / times[i, j]
                            far[side] |= ratio <= 1.0 + _SLACK and times[i, j] < 1.0 / (1.0 + _NEAR)
                part -= 1
            if far[side]:
                for i in range(rows):
                    for j in range(columns):
                        before[side, i, j] = factors[i, j]
                        factors[i, j] = times[i, j]
        if not (far[0] or far[1]):
            break
        for _ in range(rounds):
            still = True
            for side in range(2):
                if not far[side]:
                    continue
                factors = above if side == 0 else below
                for i in range(rows):
                    for j in range(columns):
                        tried[i, j] = factors[i, j] * cells[i, j]
                _demand_of(tried, row, column, wire, lead, taken, to_drivers, into, demand)
                for i in range(rows):
                    for j in range(columns):
                        wider = factors[i, j]
                        if side == 0:
                            end = 1.0 + _SLACK if counts[i, j] else 1.0
                            demanded = demand[i, j] * (wide[i, j] / found[i, j])
                        else:
                            end = 1.0 / (1.0 + _SLACK) if counts[i, j] else 1.0
                            demanded = demand[i, j] * (1.0 / wide[i, j] / found[i, j])
                        factors[i, j] = min(max(demanded, min(end, wider)), max(end, wider))
                        still &= abs(factors[i, j] - wider) <= _STILL * wider
            if still:
                break
        rests = True
        for side in range(2):
            factors = above if side == 0 else below
            for i in range(rows):
                for j in range(columns):
                    if far[side]:
                        rests &= abs(factors[i, j] - before[side, i, j]) <= _STILL * before[side, i, j]
        if rests:
            break
