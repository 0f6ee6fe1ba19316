"""Worst-case analysis: the largest value of a target over the boards and presses of a box, found by solving them.

A target is what one quantity asks of a board: an error of a reading, a settling error, a current. One search serves
every target:

1. Starts. A target names corners of the box: those of its derivatives by all parts and cells where it has any (adjoint
   method), else patterns of presses that are hard for it. Random corners of what is worst so far are added.
2. Every start is solved, with parts of its own. Of arrays beyond :data:`MOST_UNKNOWNS` only the cells that the
   first-order estimate ranks highest.
3. The worst ones are improved. The gain of flipping each coordinate to its other end is solved, or on larger arrays
   taken from derivatives at the corner itself, or solved for the parts, the cells near the judged one and whole lines.
   The flips that promise most are made together, as many as help. A corner is done when no flip raises its value.
4. Line search. Along each coordinate the value is solved at points within the box, and the best of them is refined: a
   ratio, a ringing amplifier, a power or a phase margin need not be worst at an end.
5. The stated value is that of the target's own plain solution of the worst point.

A search is not complete: a larger value may exist where two or more changes help only together. The report says so
beside each number.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray
from ._box import Box, Corners
from ._parameters import TEMPERATURE
from ._tuning import (
    FEW,
    FIRST_ORDER_BEYOND,
    LEAST_RISE,
    LEAST_SOLVED,
    LINE_POINTS,
    LINE_POINTS_IN_TIME,
    MOST_FLIPS,
    MOST_LINES,
    MOST_NEAR,
    MOST_ROUNDS,
    MOST_UNKNOWNS,
    RANDOM_CORNERS,
    ROUNDING,
    WORK,
    ZOOMS,
)


def most_solved(shape: tuple[int, int]) -> int:
    """Cells whose corners are solved: all up to 16 x 16, fewer of larger arrays, but at least :data:`LEAST_SOLVED`."""
    return max(LEAST_SOLVED, MOST_UNKNOWNS // (shape[0] * shape[1]))


Moves = Literal["flips", "slopes", "lines"]
"""flips of single coordinates, solved or by derivatives; presses of whole lines"""


class Target(ABC):
    """A number of a board that should be small; the larger, the worse. Infinite where a reading is lost."""

    name: str
    in_time: ClassVar[bool] = False
    """whether the number depends on bandwidth and capacitances"""
    by_cell: ClassVar[bool] = True
    """whether each corner judges one cell; else the board as a whole"""

    @abstractmethod
    def evaluate(self, box: Box, corners: Corners) -> FloatArray:
        """The value (C,) at each point; -inf where the target says nothing."""

    @abstractmethod
    def starts(self, box: Box) -> Corners:
        """Corners that are likely to be bad. Raises InputError where the design has no such analysis."""

    @abstractmethod
    def cost(self, box: Box) -> float:
        """Effort of one corner, in cells of one frame that are read together with others."""

    def gradient(self, box: Box, corner: Corners) -> FloatArray | None:
        """Derivatives (D,) at one corner; None: flips are solved instead."""
        return None

    def stated(self, box: Box, corner: Corners) -> float:
        """The value at one point, by the plainest way to it."""
        return float(self.evaluate(box, corner)[0])

    def evaluate_at(self, box: Box, corners: Corners, place: tuple[int, int]) -> FloatArray:
        """:meth:`evaluate` of one cell of each board, where values have one."""
        return self.evaluate(box, corners)

    def place(self, box: Box, corner: Corners) -> tuple[int, int]:
        """The cell that is worst at one point."""
        return int(corner.row[0]), int(corner.column[0])

    def frames_of(self, box: Box, corners: Corners) -> list[FloatArray]:
        """(C, N, M) ohm of the cells in each frame."""
        return [box.cells_of(corners.x)]

    def pattern(self, box: Box, corner: Corners) -> BoolArray:
        """(N, M) which cells are pressed at one point, in the last frame."""
        return np.asarray(box.split(corner.x)[1][0] > 0.0)


@dataclass(frozen=True)
class WorstCase:
    """Where a target is worst, and how that was found."""

    target: Target
    box: Box
    corner: Corners
    """one"""
    value: float
    """of the target; inf where a reading is lost"""
    by_sign: FloatArray
    """(2, N, M): the largest value that was solved for each cell, positive and negative errors; -inf where none was"""
    solved: int
    """points that were solved"""
    settled: bool
    """no change of one part or cell alone is worse"""
    flips_solved: bool
    """whether that was solved for every coordinate"""
    others: Corners
    """the worst corners that were found, the worst first"""

    @cached_property
    def cell(self) -> tuple[int, int]:
        return self.target.place(self.box, self.corner)

    @property
    def factors(self) -> FloatArray:
        """(F,) of the corner."""
        found: FloatArray = self.box.split(self.corner.x)[0][0]
        return found

    @property
    def by_cell(self) -> FloatArray:
        """(N, M) the largest value that was solved for each cell; NaN where none was."""
        largest = self.by_sign.max(axis=0)
        return np.where(largest > -inf, largest, np.nan)

    @property
    def frames(self) -> list[FloatArray]:
        """(N, M) ohm of the cells in each frame."""
        return [frame[0] for frame in self.target.frames_of(self.box, self.corner)]

    @property
    def where(self) -> str:
        """Cell, press and parts, in words."""
        parts = f"; {self.box.factors.describe(self.factors)}" if len(self.box.factors) else ""
        return f"cell {self.cell}; {self.box.in_words(self.target.pattern(self.box, self.corner))}{parts}"

    @property
    def extent(self) -> str:
        """Which cells were searched."""
        solved = int((~np.isnan(self.by_cell)).sum()) if self.target.by_cell else self.box.cells
        return f"{'all' if solved == self.box.cells else solved} of {self.box.cells} cells"

    @property
    def search(self) -> str:
        """What was searched, for the report."""
        extent = self.extent.replace(f"all of {self.box.cells} cells", "every cell")
        if np.isinf(self.value):
            return f"{self.solved} corners solved, for {extent}; the first one beyond a limit ends the search"
        state = "a corner that differs in one part or cell may still be worse"
        if self.settled:
            state = "no part or cell alone makes it worse" + ("" if self.flips_solved else ", of those looked at")
        return f"{self.solved} corners and points between them solved, for {extent}; {state}"

    @property
    def incomplete(self) -> str:
        """What page one says beside the number; empty for a limit that is certainly missed."""
        return "" if np.isinf(self.value) else f"by search, {self.extent}"

    @cached_property
    def statistical(self) -> tuple[float, float]:
        """Under the worst presses: the value of nominal parts, and that plus the root sum of squares of what parts add.

        Temperature is the same for all parts and no chance: what it adds is added as it is (ECSS-Q-HB-30-01A).
        """
        box, presses = self.box, slice(len(self.box.factors), len(self.box.factors) + self.box.cells)
        moved = box.free(in_time=self.target.in_time)
        moved[presses] = False
        centre = self.corner.at(np.where(moved, 0.0, self.corner.x))
        nominal = float(self.target.evaluate_at(box, centre, self.cell)[0])
        if not np.isfinite(nominal):
            return nominal, nominal
        slopes = self.target.gradient(box, centre)
        added = np.zeros(box.size) if slopes is None else np.where(moved, np.abs(slopes), 0.0)
        if slopes is None:  # each part alone, to both of its ends
            search = _Search(self.target, box, moved)
            which = np.flatnonzero(search.free if search.exact else search.near(centre))
            x = np.repeat(centre.x, 2 * len(which), axis=0)
            x[np.arange(len(x)), np.repeat(which, 2)] = np.tile([-1.0, 1.0], len(which))
            reached = self.target.evaluate_at(box, centre.at(x[None]), self.cell).reshape(-1, 2)
            added[which] = np.maximum(reached.max(axis=1) - nominal, 0.0)
        bias = np.array([factor.key == TEMPERATURE for factor in box.factors.factors], dtype=np.bool_)
        of_parts = added[: len(box.factors)]
        chance = np.concatenate([of_parts[~bias], added[presses.stop :]])
        return nominal, nominal + float(of_parts[bias].sum() + np.sqrt((chance**2).sum()))

    @cached_property
    def by_part(self) -> dict[str, float]:
        """The worst value with each kind of part over its tolerance alone, the others nominal; presses are free."""
        box, names = self.box, [factor.key for factor in self.box.factors.factors]
        of_cells = ["cells.rest_resistance"] if box.cell_spread else []
        starts = Corners.joined([self.corner, self.others.some(slice(0, FEW))])
        values = {}
        for kind in ["nominal parts", *dict.fromkeys(names), *of_cells]:
            free = np.ones(box.size, dtype=np.bool_)
            free[: len(names)] = [name == kind for name in names]
            free[-box.cells :] = kind == "cells.rest_resistance"
            search = _Search(self.target, box, free)
            search.climbs = 2
            search.solve(starts.at(np.where(free, starts.x, 0.0)))
            values[kind] = min(search.finished().value, self.value)
        return values


def worst_case(target: Target, box: Box, starts: Sequence[Corners] = ()) -> WorstCase:
    """Search the box for the largest value of a target over all cells.

    Args:
        target: what is to be large.
        box: what is searched.
        starts: further corners to start from.

    Raises:
        InputError: the design has no such analysis, as a continuous sheet or an array of more than 64 x 64 cells.
    """
    search = _Search(target, box)
    search.solve(Corners.joined([target.starts(box), *starts]))
    random = np.random.default_rng(0)
    worst = search.worst(2 * FEW if target.by_cell else 1)
    search.solve(worst.at(random.choice([-1.0, 1.0], (len(worst), RANDOM_CORNERS, box.size))))
    return search.finished()


def with_worse_presses(target: Target, box: Box, corners: Corners, values: FloatArray) -> FloatArray:
    """The values (C,) at some boards, after presses are changed as long as that makes them larger.

    Presses change alone, or where that would take more than :data:`WORK` as whole lines, or not at all.
    """
    presses = np.zeros(box.size, dtype=np.bool_)
    presses[len(box.factors) : len(box.factors) + box.cells] = True
    search = _Search(target, box, presses)
    each = len(corners) * target.cost(box)
    if each * len(search.lines) > WORK:
        return values
    return search.climb(corners, values, "flips" if each * box.cells <= WORK else "lines").values


class _Search:
    """Corners that were solved so far, with their values."""

    def __init__(self, target: Target, box: Box, free: BoolArray | None = None) -> None:
        self.target, self.box = target, box
        self.free = box.free(in_time=target.in_time)
        if free is not None:
            self.free &= free
        self.by_sign = np.full((2, *box.shape), -inf)
        self.solved = 0
        self.parts: list[tuple[Corners, FloatArray]] = []
        flips = max(int(self.free.sum()), 1) * target.cost(box)
        self.exact = flips <= MOST_FLIPS
        self.lines = box.lines() & self.free
        most = 64 if target.by_cell else FEW
        self.climbs = int(np.clip(WORK // (3 * flips), 2 * FEW if target.by_cell else 1, most))

    def solve(self, corners: Corners) -> FloatArray:
        """Solve corners and keep them; returns their values."""
        corners = replace(corners, x=np.where(self.free, corners.x, 0.0))  # what does not count is nominal
        values = self.evaluate(corners)
        self.parts.append((corners, values))
        return values

    def evaluate(self, corners: Corners) -> FloatArray:
        """As :meth:`solve`, but only the value of each cell is kept."""
        values = self.target.evaluate(self.box, corners)
        self.solved += len(values)
        np.maximum.at(self.by_sign, ((corners.sign < 0).astype(np.intp), corners.row, corners.column), values)
        return values

    def worst(self, count: int) -> Corners:
        """The worst corner of each cell and sign, as many of either; of whole boards the worst ones that differ."""
        corners = Corners.joined([part for part, _ in self.parts])
        values = np.concatenate([value for _, value in self.parts])
        order = np.argsort(-values, kind="stable")
        order = order[values[order] > -inf]
        keys = np.stack([corners.row, corners.column, corners.sign.astype(np.intp)], axis=1)[order]
        if not self.target.by_cell:
            keys = np.sign(corners.x[order]).astype(np.intp)
        _, first = np.unique(keys, axis=0, return_index=True)
        order = order[np.sort(first)]
        if self.target.by_cell:  # as many of either sign: where a reading stops at a limit, one starts from nothing
            negative = corners.sign[order] < 0
            rank = np.where(negative, np.cumsum(negative), np.cumsum(~negative))
            order = order[np.argsort(rank, kind="stable")]
        return corners.some(order[:count])

    def finished(self) -> WorstCase:
        """Improve the worst corners; the verdict."""
        known = Corners.joined([part for part, _ in self.parts])
        values = np.concatenate([value for _, value in self.parts])
        settled = False
        flat = values.max() == values.min()  # nothing settles, nothing flows
        if not np.isposinf(values.max()) and not flat:
            starts = self.worst(self.climbs)
            if self.target.by_cell:
                starts = Corners.joined([starts, known.some(np.argsort(-values, kind="stable")[: self.climbs // 4])])
            climbed = self._climbed(starts)
            if self.target.by_cell:
                climbed = climbed.and_(self._climbed(self._elsewhere(climbed)))
            best = np.argsort(-climbed.values, kind="stable")[: 2 if self.target.in_time else 1]
            refined = self._refined(climbed.some(best))
            known = Corners.joined([refined.corners, climbed.corners, known])
            values = np.concatenate([refined.values, climbed.values, values])
            settled = bool(refined.settled[0])
        order = np.argsort(-values, kind="stable")
        best_corner = known.some(order[:1])
        if np.isfinite(values[order[0]]):
            best_corner = self._plain(best_corner, float(values[order[0]]))
        stated = self.target.stated(self.box, best_corner)
        return WorstCase(
            target=self.target,
            box=self.box,
            corner=best_corner,
            value=stated,
            by_sign=np.minimum(self.by_sign, stated),
            solved=self.solved,
            settled=settled,
            flips_solved=self.exact,
            others=known.some(order[: 32 * FEW]),
        )

    def _elsewhere(self, climbed: _Climbed) -> Corners:
        """Starts from the best corner of each sign, at all cells that are solved, with its lines exchanged for theirs.

        How far a start is from its summit differs from cell to cell, so that those that begin highest need not end so.
        """
        judged = self.worst(2 * most_solved(self.box.shape))
        x = judged.x.copy()
        for sign in np.unique(climbed.corners.sign):
            same = np.flatnonzero(climbed.corners.sign == sign)
            best = climbed.corners.some(same[[int(climbed.values[same].argmax())]])
            for number in np.flatnonzero(judged.sign == sign):
                x[number] = self.box.exchanged(best, int(judged.row[number]), int(judged.column[number]))
        moved = judged.at(x)
        return moved.some(np.argsort(-self.solve(moved), kind="stable")[: max(self.climbs // 4, 1)])

    def _plain(self, corner: Corners, value: float) -> Corners:
        """The corner with those parts at their nominal values that have no influence on it."""
        parts = len(self.box.factors)
        if not parts:
            return corner
        x = np.repeat(corner.x, parts, axis=0)
        each = np.arange(parts)
        x[each, each] = np.where(x[each, each] > 0, -1.0, 1.0)
        small = ROUNDING * max(abs(value), 1e-12)
        without = np.abs(self.evaluate(corner.at(x[None])) - value) <= small
        plainer = corner.x.copy()
        plainer[0, :parts] = np.where(without, 0.0, plainer[0, :parts])
        again = self.evaluate(corner.at(plainer))
        return corner.at(plainer) if again[0] >= value - small else corner

    def _climbed(self, corners: Corners) -> _Climbed:
        """All corners improved: by derivatives first on larger arrays."""
        values = self.evaluate(corners)
        if self.exact and (self.box.cells <= FIRST_ORDER_BEYOND or not self.target.by_cell):
            return self.climb(corners, values, "flips")
        found = self.climb(corners, values, "slopes")
        if not self.exact:
            return found
        best = np.argsort(-found.values, kind="stable")[:1]
        return self.climb(found.corners.some(best), found.values[best], "flips")

    def climb(self, corners: Corners, values: FloatArray, moves: Moves) -> _Climbed:
        """Make the moves that raise the value, for all corners side by side, until none does."""
        corners, values = replace(corners, x=corners.x.copy()), values.copy()
        settled = ~np.isfinite(values)
        for _ in range(MOST_ROUNDS):
            active = np.flatnonzero(~settled)
            if not len(active):
                break
            for some in np.array_split(active, min(-(-len(active) * self.box.size**2 // (1 << 22)), len(active))):
                trial, best = self._moved_together(corners.some(some), values[some], moves)
                better = best > values[some] + ROUNDING * np.abs(values[some])
                corners.x[some[better]], values[some[better]] = trial[better], best[better]
                settled[some] = ~better | np.isinf(best)
        return _Climbed(corners, values, settled)

    def _moved_together(self, corners: Corners, values: FloatArray, kind: Moves) -> tuple[FloatArray, FloatArray]:
        """The best of each corner with its 1, 2, 4, ... most promising moves; coordinates (C, D) and values (C,)."""
        row, moves, gains = self._gains(corners, values, kind)
        helpful = gains > ROUNDING * np.abs(values[row])
        owner, trials = [], []
        for number, corner in enumerate(corners.x):
            mine = np.flatnonzero(helpful & (row == number))
            x, tried = corner, _doubling(len(mine))
            for count, move in enumerate(moves[mine[np.argsort(-gains[mine], kind="stable")]].tolist(), 1):
                x = self._after(x[None], np.array([move]), corner[None])[0]
                if count in tried:
                    owner.append(number)
                    trials.append(x)
        found_x, found = corners.x.copy(), values.copy()
        if trials:
            reached = self.evaluate(replace(corners.some(np.array(owner)), x=np.stack(trials)))
            for number, x, value in zip(owner, trials, reached.tolist(), strict=True):
                if value > found[number]:
                    found_x[number], found[number] = x, value
        return found_x, found

    def _gains(self, corners: Corners, values: FloatArray, kind: Moves) -> tuple[IntArray, IntArray, FloatArray]:
        """What moves would add: the corner (K,) that each belongs to, the move (K,), and its gain (K,).

        Either every flip is solved, or flips are taken from derivatives, or whole lines are solved; of targets without
        derivatives, lines and flips near the worst cell are.
        """
        each, free, size = np.arange(len(corners)), np.flatnonzero(self.free), self.box.size
        row, moves = np.repeat(each, len(free)), np.tile(free, len(each))
        if kind != "flips":
            found = (self.target.gradient(self.box, corners.some(each[[n]])) for n in each) if kind == "slopes" else ()
            slopes = [slope for slope in found if slope is not None]
            if slopes:
                return row, moves, (np.stack(slopes) * (np.where(corners.x > 0, -1.0, 1.0) - corners.x))[row, moves]
            some = [np.arange(size, size + 2 * len(self.lines))] * len(each)
            if kind == "slopes":
                some = [np.append(np.flatnonzero(self.near(corners.some(each[[n]]))), some[n]) for n in each]
            row, moves = np.repeat(each, [len(one) for one in some]), np.concatenate(some)
        here = corners.some(row)
        return row, moves, self.evaluate(replace(here, x=self._after(here.x, moves, here.x))) - values[row]

    def _after(self, x: FloatArray, moves: IntArray, start: FloatArray) -> FloatArray:
        """Coordinates (K, D) after a move (K,) each: one coordinate to the other end than in ``start``, or a line."""
        x, size = x.copy(), self.box.size
        flips = np.flatnonzero(moves < size)
        x[flips, moves[flips]] = np.where(start[flips, moves[flips]] > 0, -1.0, 1.0)
        for k in np.flatnonzero(moves >= size):
            line, low = divmod(int(moves[k]) - size, 2)
            x[k, self.lines[line]] = -1.0 if low else 1.0
        return x

    def near(self, corner: Corners) -> BoolArray:
        """(D,) parts, and cells near the worst one; of them only that one where many cost too much."""
        row, column = self.target.place(self.box, corner)
        near = self.free & self.box.near(row, column)
        if near.sum() * self.target.cost(self.box) > MOST_NEAR:
            parts, place = len(self.box.factors), row * self.box.shape[1] + column
            near[parts:] = False
            near[[parts + place, parts + self.box.cells + place]] = True
            near &= self.free
        return near

    def _refined(self, found: _Climbed) -> _Climbed:
        """Line searches within the box from each of some corners, and flips from where they lead."""
        corners, values, settled = found.corners, found.values.copy(), found.settled.copy()
        parts = []
        for number in range(len(corners)):
            corner, value = corners.some(slice(number, number + 1)), float(values[number])
            for _ in range(MOST_LINES):
                if np.isinf(value):
                    break
                x, best = self._line_search(corner, value)
                rises = best > value + LEAST_RISE * max(abs(value), 1e-12)
                if not rises:
                    break
                corner, value = corner.at(x[None]), best
                again = self.climb(corner, np.array([value]), "flips" if self.exact else "slopes")
                corner, value = again.corners, float(again.values[0])
            parts.append(corner)
            values[number] = value
        return _Climbed(Corners.joined(parts), values, settled)

    def _line_search(self, corner: Corners, value: float) -> tuple[FloatArray, float]:
        """The best point (D,) that differs from a corner in one coordinate, and its value."""
        every = self.exact and self.box.cells <= FIRST_ORDER_BEYOND
        looked_at = np.flatnonzero(self.free if every else self.near(corner)).tolist()
        shared = [factor.line is None for factor in self.box.factors.factors] if self.target.in_time else []
        grids = [
            np.linspace(-1.0, 1.0, LINE_POINTS_IN_TIME if k < len(shared) and shared[k] else LINE_POINTS)
            for k in looked_at
        ]
        best_x, best = corner.x[0], value
        if not grids:
            return best_x, best
        place = np.repeat(looked_at, [len(grid) for grid in grids])
        x = np.repeat(corner.x, len(place), axis=0)
        x[np.arange(len(x)), place] = np.concatenate(grids)
        reached = self.evaluate(corner.at(x[None]))
        top = int(reached.argmax())
        along, width = place[top], 2.0 / (len(grids[looked_at.index(place[top])]) - 1)
        for zoom in range(ZOOMS + 1):
            if reached[top] > best:
                best_x, best = x[top], float(reached[top])
            if zoom == ZOOMS or np.isinf(reached[top]):
                break
            near = np.clip(x[top, along] + width * np.linspace(-1.0, 1.0, LINE_POINTS), -1.0, 1.0)
            x = np.repeat(x[[top]], LINE_POINTS, axis=0)
            x[:, along] = near
            reached = self.evaluate(corner.at(x[None]))
            top, width = int(reached.argmax()), 2.0 * width / (LINE_POINTS - 1)
        return best_x, best


class _Climbed(NamedTuple):
    """How far the starts of a search have come."""

    corners: Corners
    values: FloatArray
    settled: BoolArray
    """(C,) whether nothing that was tried last is worse"""

    def and_(self, other: _Climbed) -> _Climbed:
        joined = (np.concatenate(pair) for pair in zip(self[1:], other[1:], strict=True))
        return _Climbed(Corners.joined([self.corners, other.corners]), *joined)

    def some(self, which: IntArray) -> _Climbed:
        return _Climbed(self.corners.some(which), self.values[which], self.settled[which])


def _doubling(count: int) -> IntArray:
    """0, 1, 2, 4, ... up to a count, and the count itself."""
    return np.array([0, *(1 << k for k in range(count.bit_length())), count], dtype=np.intp)
