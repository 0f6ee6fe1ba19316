"""Worst-case analysis: the largest value of a target over the boards and presses of a box, found by solving them.

Along each coordinate of the box the readings of a resistive network are monotone, so that the worst case is looked for
at its corners (vertex method). One search serves every target:

1. Starts. The derivatives of every reading by every part and cell (adjoint method,
   :func:`ohmskin.circuits.sensitivity`), at all cells at rest and at all pressed, name one corner per cell, sign and
   state. Corners of other searches and random corners of the cells that are worst so far are added.
2. Every start is solved, with parts of its own. Of arrays beyond :data:`MOST_UNKNOWNS` only the cells that the
   first-order estimate ranks highest.
3. The worst ones are improved. The gain of flipping each single coordinate to its other end is solved, or on larger
   arrays taken from derivatives at the corner itself; the flips that promise most are made together, as many as help.
   A corner is done when no single flip raises its value.
4. The stated value is that of plain scans of the worst corner.

A search over corners is not complete: a larger value may exist where two or more flips help only together. The report
says so beside each number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from typing import NamedTuple

import numpy as np

from ..circuits import Boards, Design, read_together, scan_population, sensitivity
from ..common.arrays import BoolArray, FloatArray, IntArray
from ._parameters import CONVERTER, SECTION
from ._targets import Box, Corners, Frame, Press, Target, evaluate, frames_of, scanned

LEAST_SOLVED, MOST_UNKNOWNS = 64, 256 * 256
"""Corners are solved for every cell as long as cells times cells are no more than that, and for fewer of larger arrays;
per sign and state."""
MOST_WORK = 4_000_000
"""cells that are solved, all frames of all flips together, while corners are improved"""
ALONE = 30
"""by which less is solved of a design whose boards are scanned one by one, as all are whose outputs saturate"""
MOST_FLIPS = 400_000
"""cells of all flips of one corner, up to which flips are solved"""
FIRST_ORDER_BEYOND = 100
"""cells of an array beyond which corners are improved by derivatives before their flips are solved"""
MOST_PRESSES, CELLS_OF_PRESSES = 16, 4096
"""Presses that a search hands to the Monte Carlo analysis at most, and cells of all of them together."""
_FEWEST = 4  # corners that are improved on the largest arrays, per sign
_RANDOM_CELLS, _RANDOM_CORNERS = 4, 16  # random corners are those of so many cells per sign, so many of each
_ROUNDS = 30  # of improvement, at most
_LEAST_GAIN = 1e-9  # relative: less is rounding
_WITHOUT_INFLUENCE = 1e-10  # relative: a flip that changes the value by less changes nothing


def most_solved(shape: tuple[int, int]) -> int:
    """Cells whose corners are solved: all up to 16 x 16, fewer of larger arrays, but at least :data:`LEAST_SOLVED`."""
    return max(LEAST_SOLVED, MOST_UNKNOWNS // (shape[0] * shape[1]))


@dataclass(frozen=True)
class WorstCase:
    """Where a target is worst, and how that was found."""

    target: Target
    box: Box
    corner: Corners
    """one"""
    value: float
    """of the target; inf where a reading stands beyond the reference, clips, or its output saturates"""
    by_sign: FloatArray
    """(2, N, M): the largest value that was solved for each cell, positive and negative errors; -inf where none was"""
    solved: int
    """corners that were solved"""
    all_cells: bool
    settled: bool
    """no corner that differs in one part or cell is worse"""
    flips_solved: bool
    """whether that was solved, not only estimated to first order"""
    others: Corners
    """the worst corners that were found, the worst first: their presses serve the Monte Carlo analysis"""

    @property
    def cell(self) -> tuple[int, int]:
        return int(self.corner.row[0]), int(self.corner.column[0])

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
        return [frame[0] for frame in frames_of(self.target, self.box, self.corner)]

    @property
    def pattern(self) -> BoolArray:
        """(N, M) which cells are pressed in the last frame"""
        return _pattern(self.target, self.box, self.corner)

    @property
    def presses(self) -> list[Press]:
        """Presses for the Monte Carlo analysis, each with the cell that it was found for: rest, all, the worst."""
        shape = self.box.design.array.shape
        found = [(np.zeros(shape, dtype=np.bool_), self.cell), (np.ones(shape, dtype=np.bool_), self.cell)]
        seen = {pattern.tobytes() for pattern, _ in found}
        count_limit = len(found) + min(MOST_PRESSES, max(2, CELLS_OF_PRESSES // self.box.cells))
        for number in range(len(self.others)):
            corner = self.others.some(slice(number, number + 1))
            cell = int(corner.row[0]), int(corner.column[0])
            pattern = _pattern(self.target, self.box, corner)
            key = pattern.tobytes() if self.target.judged(pattern, cell).sum() > 1 else pattern.tobytes() + bytes(cell)
            if key not in seen and len(found) < count_limit:
                seen.add(key)
                found.append((pattern, cell))
        return found

    @property
    def pressed_cells(self) -> str:
        """The pattern in words."""
        pressed = self.pattern
        if pressed.all():
            return "all cells pressed"
        if not pressed.any():
            return "all cells at rest"
        few, what = (pressed, "pressed") if pressed.sum() * 2 <= pressed.size else (~pressed, "not pressed")
        places = [f"({i}, {j})" for i, j in np.argwhere(few)[:6].tolist()]
        return f"{few.sum()} of {few.size} cells {what}: {', '.join(places)}{', ...' if few.sum() > 6 else ''}"

    @property
    def search(self) -> str:
        """What was searched, for the report."""
        extent = "every cell" if self.all_cells else f"{self.cells_solved} of {self.box.cells} cells"
        if np.isinf(self.value):
            return f"{self.solved} corners solved, for {extent}; the first one beyond a limit ends the search"
        state = "a corner that differs in one part or cell may still be worse"
        if self.settled:
            state = "no part or cell alone makes it worse" + ("" if self.flips_solved else ", to first order")
        return f"{self.solved} corners solved, for {extent}; {state}; plain scans of the corner give this value"

    @property
    def incomplete(self) -> str:
        """What page one says beside the number; empty for a limit that is certainly missed."""
        if np.isinf(self.value):
            return ""
        return f"by search, {'all' if self.all_cells else self.cells_solved} of {self.box.cells} cells"

    @property
    def cells_solved(self) -> int:
        """Cells that at least one corner was solved for."""
        return int((~np.isnan(self.by_cell)).sum())

    @cached_property
    def by_part(self) -> dict[str, float]:
        """The worst value with each kind of part over its tolerance alone, the others nominal; presses are free."""
        return _by_part(self)[0]


def worst_case(target: Target, box: Box, starts: Sequence[Corners] = ()) -> WorstCase:
    """Search the box for the largest value of a target over all cells.

    Args:
        target: what is to be large.
        box: what is searched.
        starts: further corners to start from.

    Raises:
        InputError: a continuous sheet or an array of more than 64 x 64 cells, which has no sensitivities.
    """
    named = Corners.joined([*_named(target, box), *starts])
    search = _Search(target, box)
    search.solve(named)
    random = np.random.default_rng(0)
    worst = search.worst(2 * _RANDOM_CELLS)
    search.solve(worst.at(random.choice([-1.0, 1.0], (len(worst), _RANDOM_CORNERS, box.size))))
    return search.finished()


def improved(found: WorstCase, starts: Corners) -> WorstCase:
    """The worst case, where corners (or boards within the box) that came from elsewhere are looked at as well."""
    search = _Search(found.target, found.box)
    search.solve(Corners.joined([found.corner, found.others, starts, starts.at(np.sign(starts.x))]))
    further = search.finished()
    by_sign = np.fmax(found.by_sign, further.by_sign)
    best = further if further.value > found.value else found
    return replace(best, by_sign=by_sign, solved=found.solved + further.solved, all_cells=found.all_cells)


class _Search:
    """Corners that were solved so far, with their values."""

    def __init__(self, target: Target, box: Box, free: BoolArray | None = None) -> None:
        self.target, self.box = target, box
        self.free = np.ones(box.size, dtype=np.bool_) if free is None else free
        if not box.cell_spread:
            self.free[-box.cells :] = False
        self.by_sign = np.full((2, *box.design.array.shape), -inf)
        self.solved = 0
        self.parts: list[tuple[Corners, FloatArray]] = []
        flips = int(self.free.sum()) * box.cells * target.frames
        self.exact = flips <= MOST_FLIPS
        work = MOST_WORK // ALONE if box.saturates or not read_together(box.design) else MOST_WORK
        self.climbs = max(2 * _FEWEST, work // (3 * max(flips, 1))) if self.exact else 2 * _FEWEST

    def solve(self, corners: Corners) -> FloatArray:
        """Solve corners and keep them; returns their values."""
        values = self.evaluate(corners)
        self.parts.append((corners, values))
        return values

    def evaluate(self, corners: Corners) -> FloatArray:
        """As :meth:`solve`, but only the value of each cell is kept."""
        values = evaluate(self.target, self.box, corners)
        self.solved += len(values)
        np.maximum.at(self.by_sign, ((corners.sign < 0).astype(np.intp), corners.row, corners.column), values)
        return values

    def worst(self, count: int) -> Corners:
        """The worst corner of each cell and sign, of so many of them."""
        corners = Corners.joined([part for part, _ in self.parts])
        values = np.concatenate([value for _, value in self.parts])
        order = np.argsort(-values, kind="stable")
        order = order[values[order] > -inf]
        keys = np.stack([corners.row, corners.column, corners.sign.astype(np.intp)], axis=1)[order]
        _, first = np.unique(keys, axis=0, return_index=True)
        return corners.some(order[np.sort(first)][:count])

    def finished(self) -> WorstCase:
        """Improve the worst corners; the verdict."""
        known = Corners.joined([part for part, _ in self.parts])
        values = np.concatenate([value for _, value in self.parts])
        if not np.isinf(values.max()):
            starts = self.worst(self.climbs)
            extra = known.some(np.argsort(-values, kind="stable")[: self.climbs // 4])
            climbed = self._climbed(Corners.joined([starts, extra]))
            known, values = Corners.joined([known, climbed.corners]), np.concatenate([values, climbed.values])
        order = np.argsort(-values, kind="stable")
        best = known.some(order[:1])
        value, settled = float(values[order[0]]), False
        if np.isfinite(value):
            final = self._polished(best, value)
            best, value, settled = final.corners, float(final.values[0]), bool(final.settled[0])
        stated = scanned(self.target, self.box, best)
        return WorstCase(
            target=self.target,
            box=self.box,
            corner=best,
            value=stated,
            by_sign=np.minimum(self.by_sign, stated),
            solved=self.solved,
            all_cells=bool((self.by_sign.max(axis=0) > -inf).all()),
            settled=settled,
            flips_solved=self.exact,
            others=known.some(order[: 8 * MOST_PRESSES]),
        )

    def _polished(self, corner: Corners, value: float) -> _Climbed:
        """The last improvement, and parts without influence at their nominal values."""
        found = self._climb(corner, np.array([value]), exact=self.exact)
        if not self.exact or np.isinf(found.values[0]):
            return found
        flipped = self.evaluate(self._flipped(found.corners))
        small = _WITHOUT_INFLUENCE * max(abs(float(found.values[0])), 1e-12)
        x = found.corners.x.copy()
        parts = len(self.box.factors)
        without = (np.abs(flipped - found.values[0]) <= small)[:parts]
        x[0, :parts] = np.where(without, 0.0, x[0, :parts])
        plainer = found.corners.at(x)
        again = self.evaluate(plainer)
        return found._replace(corners=plainer, values=again) if again[0] >= found.values[0] - small else found

    def _climbed(self, corners: Corners) -> _Climbed:
        """All corners improved: by derivatives first on larger arrays."""
        values = self.evaluate(corners)
        if self.box.cells <= FIRST_ORDER_BEYOND and self.exact:
            return self._climb(corners, values, exact=True)
        found = self._climb(corners, values, exact=False)
        if not self.exact:
            return found
        best = np.argsort(-found.values, kind="stable")[:_FEWEST]
        return self._climb(found.corners.some(best), found.values[best], exact=True)

    def _climb(self, corners: Corners, values: FloatArray, *, exact: bool) -> _Climbed:
        """Flip the coordinates that raise the value, for all corners side by side, until none does."""
        corners, values = replace(corners, x=corners.x.copy()), values.copy()
        settled = np.isinf(values)
        for _ in range(_ROUNDS):
            active = np.flatnonzero(~settled)
            if not len(active):
                break
            for some in np.array_split(active, -(-len(active) * self.box.size**2 // (1 << 22))):
                here = corners.some(some)
                gains = self._gains(here, values[some], exact=exact)
                trial, best = self._flipped_together(here, values[some], gains)
                better = best > values[some] * (1 + np.sign(values[some]) * _LEAST_GAIN)
                corners.x[some[better]], values[some[better]] = trial[better], best[better]
                settled[some] = ~better | np.isinf(best)
        return _Climbed(corners, values, settled)

    def _flipped(self, corners: Corners) -> Corners:
        """(C D) corners that differ from one of C in one coordinate each."""
        x = np.repeat(corners.x[:, None], self.box.size, axis=1)
        each = np.arange(self.box.size)
        x[:, each, each] = np.where(x[:, each, each] > 0, -1.0, 1.0)
        return corners.at(x)

    def _gains(self, corners: Corners, values: FloatArray, *, exact: bool) -> FloatArray:
        """(C, D) by which flipping each coordinate raises the value; -inf where it may not be flipped."""
        gains = np.full(corners.x.shape, -inf)
        free = np.flatnonzero(self.free)
        if exact:
            flips = self._flipped(corners)
            wanted = np.broadcast_to(self.free, corners.x.shape).ravel()
            gains[:, free] = self.evaluate(flips.some(wanted)).reshape(len(corners), -1) - values[:, None]
            return gains
        for number in range(len(corners)):
            corner = corners.some(slice(number, number + 1))
            slopes = _slopes_at(self.target, self.box, corner)[0]
            step = np.where(corner.x[0] > 0, -1.0, 1.0) - corner.x[0]
            gains[number, free] = (slopes * step)[free]
        return gains

    def _flipped_together(
        self, corners: Corners, values: FloatArray, gains: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The best of each corner with its 1, 2, 4, ... most promising flips; coordinates (C, D) and values (C,)."""
        helpful = (gains > _LEAST_GAIN * np.abs(values)[:, None]).sum(axis=1)
        order = np.argsort(-gains, axis=1, kind="stable")
        count_limit = int(helpful.max(initial=0))
        counts = [0, *(1 << k for k in range(count_limit.bit_length())), count_limit]
        rank = np.empty_like(order)
        np.put_along_axis(rank, order, np.arange(order.shape[1])[None].repeat(len(order), axis=0), axis=1)
        flips = rank[:, None] < np.minimum(np.array(counts)[None, :], helpful[:, None])[..., None]
        x = np.where(flips, np.where(corners.x > 0, -1.0, 1.0)[:, None], corners.x[:, None])
        found = self.evaluate(corners.at(x)).reshape(len(corners), -1)
        best = found.argmax(axis=1)
        each = np.arange(len(corners))
        return x[each, best], found[each, best]


class _Climbed(NamedTuple):
    """How far the starts of a search have come."""

    corners: Corners
    values: FloatArray
    settled: BoolArray
    """(C,) whether nothing that was tried last is worse"""


def _pattern(target: Target, box: Box, corner: Corners) -> BoolArray:
    """(N, M) which cells are pressed in the last frame of one corner."""
    press = (1.0 + box.split(corner.x)[1]) / 2.0
    return np.asarray(target.pressed(press, corner.row, corner.column)[-1][0] > 0.5)


@dataclass(frozen=True)
class _Linear:
    """Readings of one frame and their derivatives."""

    output: FloatArray
    """(N, M) V"""
    volts: FloatArray
    """(N, M) V behind the converter's errors"""
    by_factor: FloatArray
    """(N, M, F) V"""
    by_cell: FloatArray
    """(N, M, N, M) V/ohm"""


def _linearised(box: Box, factors: FloatArray, cells: FloatArray) -> _Linear:
    population = box.factors.population(factors[None])
    found = sensitivity(population.boards.design(box.design, 0), cells)
    by_part = {
        "row_lead": found.row_lead,
        "row_segment": found.row_segment.sum(axis=-1),
        "column_lead": found.column_lead,
        "column_segment": found.column_segment.sum(axis=-2),
        "reference_resistance": found.reference_resistance,
        "open_loop_gain": -found.inverse_gain / population.boards.open_loop_gain**2,
        "offset_voltage": found.offset_voltage,
        "bias_current": found.bias_current,
    }
    by_factor = np.zeros((*cells.shape, len(box.factors)))
    for name, section in SECTION.items():
        matrix = box.factors.slopes(f"{section}.{name}")
        if not matrix.any():
            continue
        if name in by_part:
            by_factor += by_part[name] @ matrix
        else:
            by_factor += _by_difference(box.design, population.boards, name, cells)[..., None] * matrix[0]
    converter = population.converter[0]
    volts = box.converted(found.volts, converter)
    if box.design.adc is not None:
        for name, unit in zip(CONVERTER, 1e-6 * np.eye(len(CONVERTER)), strict=True):
            moved = box.converted(found.volts, converter + unit)
            by_factor += ((moved - volts) / 1e-6)[..., None] * box.factors.slopes(f"adc.{name}")[0]
    return _Linear(found.volts, volts, by_factor, found.cells)


def _by_difference(design: Design, boards: Boards, name: str, cells: FloatArray) -> FloatArray:
    """dV/d(part) (N, M) of a part that all lines share; outputs are linear in both of these."""
    value = getattr(boards, name)
    width = 1e-3 * max(abs(float(value[0, 0])), 1.0)
    high, low = (
        scan_population(design, replace(boards, **{name: value + step}), cells[None], resolve_saturation=False).volts[0]
        for step in (width, -width)
    )
    result: FloatArray = (high - low) / (2 * width)
    return result


def _slopes(
    target: Target, box: Box, linear: Sequence[_Linear], corners: Corners, cells: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Smooth values (C,) in the direction of the corners' signs, and their derivatives (C, D) by the coordinates.

    Args:
        target: what is judged.
        box: the box.
        linear: the readings of each frame, shared by all corners.
        corners: their judged cells, signs and coordinates.
        cells: (N, M) ohm of the cells in each frame, shared by all corners.
    """
    row, column = corners.row, corners.column
    each, law = np.arange(len(row)), box.law(row, column)
    nothing = np.zeros(len(row), dtype=np.bool_)
    frames = [
        Frame(one.output[row, column], one.volts[row, column], ohms[row, column], nothing)
        for one, ohms in zip(linear, cells, strict=True)
    ]

    def signed(number: int, volts: FloatArray | float = 0.0, true: float = 1.0) -> FloatArray:
        """The value with one frame's readings moved by ``volts``, or its judged cells' resistances by a factor."""
        here = frames[number]
        moved = Frame(here.output + volts, here.volts + volts, here.true * true, nothing)
        changed = [moved if k == number else frame for k, frame in enumerate(frames)]
        return corners.sign * target.smooth(box, law, changed)

    factors, press, scale = (np.zeros(part.shape) for part in box.split(corners.x))
    width = (box.pressed_ohm - box.rest_ohm) / 2.0
    deviating = 1.0 + box.cell_spread * box.split(corners.x)[2]
    ones = np.ones_like(press)
    moves = zip(target.pressed(ones, row, column), target.pressed(0.0 * ones, row, column), strict=True)
    with np.errstate(all="ignore"):
        for number, (one, ohms, (high, low)) in enumerate(zip(linear, cells, moves, strict=True)):
            frame = frames[number]
            small = 1e-6 * np.maximum(np.abs(frame.volts - box.design.readout.reference_voltage), 1e-9)
            ends = [signed(number, step) for step in (small, -small)]
            weight = np.nan_to_num((ends[0] - ends[1]) / (2 * small), posinf=0.0, neginf=0.0)
            factors += weight[:, None] * one.by_factor[row, column]
            by_cell = weight[:, None, None] * one.by_cell[row, column]
            press += by_cell * (high - low) * width * deviating
            scale += by_cell * ohms / deviating * box.cell_spread
            nudged = signed(number, true=1 + 1e-6) - signed(number, true=1 - 1e-6)
            scale[each, row, column] += np.nan_to_num(nudged / 2e-6) * box.cell_spread
        flat = [part.reshape(len(row), -1) for part in (factors, press, scale)]
        return signed(0), np.concatenate(flat, axis=1)


def _slopes_at(target: Target, box: Box, corner: Corners) -> FloatArray:
    """Derivatives (1, D) at one corner."""
    cells = [frame[0] for frame in frames_of(target, box, corner)]
    linear = [_linearised(box, box.split(corner.x)[0][0], frame) for frame in cells]
    return _slopes(target, box, linear, corner, cells)[1]


class _Uniform:
    """Derivatives where all cells are in one state, which serve the corners of all judged cells."""

    def __init__(self, target: Target, box: Box, state: float, known: dict[float, _Linear]) -> None:
        self.target, self.box = target, box
        shape = box.design.array.shape
        self.row, self.column = (index.ravel() for index in np.indices(shape))
        states = target.uniform(state)
        self.cells = [box.resistance(np.full(shape, frame), np.zeros(shape)) for frame in states]
        for frame, ohms in zip(states, self.cells, strict=True):
            if frame not in known:
                known[frame] = _linearised(box, np.zeros(len(box.factors)), ohms)
        self.linear = [known[frame] for frame in states]

    def slopes(self, some: IntArray, sign: float) -> tuple[Corners, FloatArray, FloatArray]:
        """Centres of the box for some cells, the values there, and their derivatives."""
        x = np.zeros((len(some), self.box.size))
        centre = Corners(self.row[some], self.column[some], np.full(len(some), sign), x)
        return centre, *_slopes(self.target, self.box, self.linear, centre, self.cells)

    def estimates(self, sign: float) -> FloatArray:
        """(cells,) largest values to first order."""
        found = []
        for some in np.array_split(np.arange(self.box.cells), -(-(self.box.cells**2) // (1 << 20))):
            _, value, slopes = self.slopes(some, sign)
            found.append(np.nan_to_num(value + np.abs(slopes).sum(axis=1), nan=inf, posinf=inf))
        return np.concatenate(found)


def first_order(target: Target, box: Box) -> FloatArray:
    """(2, N, M): the largest value of each cell's target to first order about all cells at rest, by sign.

    Raises:
        InputError: as :func:`worst_case`.
    """
    at_rest = _Uniform(target, box, 0.0, {})
    return np.stack([at_rest.estimates(sign).reshape(box.design.array.shape) for sign in (1.0, -1.0)])


def _named(target: Target, box: Box) -> list[Corners]:
    """The corners that derivatives name, at all cells at rest and at all pressed, of the cells that rank highest."""
    known: dict[float, _Linear] = {}
    found = []
    for state in (0.0, 1.0):
        uniform = _Uniform(target, box, state, known)
        for sign in (1.0, -1.0):
            order = np.argsort(-uniform.estimates(sign), kind="stable")[: most_solved(box.design.array.shape)]
            centre, _, slopes = uniform.slopes(order, sign)
            x = np.sign(slopes)
            press = box.split(x)[1]
            press[press == 0] = -1.0
            press[np.arange(len(order)), centre.row, centre.column] = 2.0 * state - 1.0
            found.append(centre.at(x))
    return found


def _by_part(found: WorstCase) -> tuple[dict[str, float], Corners]:
    """The worst value by kind of part alone, and the corners where it is."""
    box, target = found.box, found.target
    names = [factor.key for factor in box.factors.factors]
    kinds = ["nominal parts", *dict.fromkeys(names), *(["cells.rest_resistance"] if box.cell_spread else [])]
    starts = Corners.joined([found.corner, found.others.some(slice(0, _FEWEST))])
    values, corners = {}, []
    for kind in kinds:
        free = np.ones(box.size, dtype=np.bool_)
        free[: len(names)] = [name == kind for name in names]
        free[-box.cells :] = kind == "cells.rest_resistance"
        search = _Search(target, box, free)
        search.climbs = 2
        search.solve(starts.at(np.where(free, starts.x, 0.0)))
        alone = search.finished()
        values[kind] = alone.value
        corners.append(alone.corner)
    return values, Corners.joined(corners)
