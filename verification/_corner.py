"""Worst-case analysis of readings: adjoint sensitivities name the corner, and a solve at that corner gives the value.

A *target* is a number that a reading should keep small: its error, the error of its gain, or what a press elsewhere
does to it (crosstalk). It depends on the part values, on the place of each reading within its ADC step, and on which
cells are pressed. All of these range over a box, and along each axis the readings of a resistive network are monotone.
So the worst case is looked for at the corners of the box (vertex method):

1. The derivatives of every reading by every part and cell (adjoint method, :func:`ohmskin.circuits.sensitivity`) at two
   states, all cells at rest and all pressed, name one corner per cell, per sign and per state.
2. Those corners are solved, each with parts of its own. All cells are, or the :func:`most_solved` that the first-order
   estimate ranks highest.
3. From the worst ones the derivatives are taken again, at the corner itself, until no sign changes any more. Then the
   corner is stationary: changing any single part or cell makes the value smaller to first order.
4. On arrays of up to some 16 x 16 cells every neighbouring corner, which differs in one part or one cell, is solved as
   well, and the search goes on from a better one.

A target that is linear in its axes is thereby searched exhaustively.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..circuits import Boards, Design, Sensitivity, apparent_resistance, scan, scan_population, sensitivity
from ..common.arrays import BoolArray, FloatArray, IntArray
from ._parameters import SECTION, Factors, Population

LEAST_SOLVED, MOST_UNKNOWNS = 64, 256 * 256
"""Corners are solved for every cell as long as cells times cells are no more than that, and for fewer of larger arrays;
per sign and state."""
ROUNDING = 1e-15
"""Relative differences below this are none."""
_REFINED = 2  # corners per sign that are improved
_FEW_CELLS, _REFINED_OF_FEW = 16, 16  # the same for small arrays, where it costs little
_ROUNDS = 5  # of improvement, at most
_MOST_REMEMBERED = 4_000_000  # numbers of the derivatives that a search keeps
_MOST_FLIPS = 200_000  # cells of all neighbouring corners together, up to which they are solved


def most_solved(shape: tuple[int, int]) -> int:
    """Cells whose corners are solved: all up to 16 x 16, fewer of larger arrays, but at least :data:`LEAST_SOLVED`."""
    return max(LEAST_SOLVED, MOST_UNKNOWNS // (shape[0] * shape[1]))


@dataclass(frozen=True)
class Box:
    """What a worst-case search ranges over."""

    design: Design
    factors: Factors
    rest_ohm: float
    pressed_ohm: float
    cell_spread: float
    """relative, of every cell on its own"""

    @property
    def half_step(self) -> float:
        """V by which a code may stand for less or more than was converted."""
        return self.design.adc.step / 2 if self.design.adc else 0.0

    def resistance(self, pressed: FloatArray, scale: FloatArray) -> FloatArray:
        """ohm of cells with ``pressed`` 0 or 1 and ``scale`` from -1 to 1, of any shape."""
        low, high = self.rest_ohm, self.pressed_ohm
        result: FloatArray = (low + (high - low) * pressed) * (1.0 + self.cell_spread * scale)
        return result

    def converted(self, volts: FloatArray, converter: FloatArray) -> FloatArray:
        """V at an ideal converter for the errors (..., 3) of the real one; as in :func:`ohmskin.circuits.adc_codes`."""
        adc = self.design.adc
        if adc is None:
            return volts
        offset, slope, bow = np.moveaxis(converter, -1, 0)
        above = (volts - adc.range[0]) * (1.0 + slope) + offset
        share = np.clip(above / (adc.range[1] - adc.range[0]), 0.0, 1.0)
        shifted: FloatArray = adc.range[0] + above + bow * adc.step * 4.0 * share * (1.0 - share)
        return shifted

    def clipped(self, volts: FloatArray) -> BoolArray:
        """Where the code of ``volts`` is the first or the last."""
        adc = self.design.adc
        if adc is None:
            return np.zeros(volts.shape, dtype=np.bool_)
        low, high = adc.range
        return np.asarray((volts < low + adc.step) | (volts >= high - adc.step))


class Target(ABC):
    """A function of one cell's readings in one or two frames."""

    name: str
    frames: int

    @abstractmethod
    def pressed(self, pattern: FloatArray, row: IntArray, column: IntArray) -> list[FloatArray]:
        """Which cells are pressed (C, N, M) in each frame, for the cells (C,) that are judged."""

    @abstractmethod
    def value(self, ohms: list[FloatArray], true: list[FloatArray]) -> FloatArray:
        """The target (relative, signed) of apparent and true resistances, one array per frame."""

    @abstractmethod
    def weights(self, ohms: list[FloatArray], true: list[FloatArray]) -> list[FloatArray]:
        """Derivatives of :meth:`value` by each frame's apparent resistance, 1/ohm."""

    @abstractmethod
    def toggles(self, frame: int) -> bool:
        """Whether the pattern of the other cells shows in this frame."""

    @abstractmethod
    def own(self, value: FloatArray) -> FloatArray:
        """Derivative of :meth:`value` by a relative change of the cell's own true resistance, readings held."""


class ReadingError(Target):
    """Relative error of a resistance that the host makes of an uncalibrated reading."""

    name = "reading error"
    frames = 1

    def pressed(self, pattern: FloatArray, row: IntArray, column: IntArray) -> list[FloatArray]:
        return [pattern]

    def value(self, ohms: list[FloatArray], true: list[FloatArray]) -> FloatArray:
        return ohms[0] / true[0] - 1.0

    def weights(self, ohms: list[FloatArray], true: list[FloatArray]) -> list[FloatArray]:
        return [1.0 / true[0]]

    def toggles(self, frame: int) -> bool:
        return True

    def own(self, value: FloatArray) -> FloatArray:
        return -(1.0 + value)


class GainError(Target):
    """Relative error of the change that the host sees when the cell alone is pressed from rest to full scale."""

    name = "gain error"
    frames = 2

    def pressed(self, pattern: FloatArray, row: IntArray, column: IntArray) -> list[FloatArray]:
        before, after = pattern.copy(), pattern.copy()
        each = np.arange(len(pattern))
        before[each, row, column], after[each, row, column] = 0.0, 1.0
        return [before, after]

    def value(self, ohms: list[FloatArray], true: list[FloatArray]) -> FloatArray:
        return (ohms[1] - ohms[0]) / (true[1] - true[0]) - 1.0

    def weights(self, ohms: list[FloatArray], true: list[FloatArray]) -> list[FloatArray]:
        each = 1.0 / (true[1] - true[0])
        return [-each, each]

    def toggles(self, frame: int) -> bool:
        return True

    def own(self, value: FloatArray) -> FloatArray:
        return -(1.0 + value)


class Crosstalk(Target):
    """Relative change of an untouched cell's reading when other cells are pressed."""

    name = "crosstalk"
    frames = 2

    def pressed(self, pattern: FloatArray, row: IntArray, column: IntArray) -> list[FloatArray]:
        after = pattern.copy()
        after[np.arange(len(pattern)), row, column] = 0.0
        return [np.zeros_like(after), after]

    def value(self, ohms: list[FloatArray], true: list[FloatArray]) -> FloatArray:
        return ohms[1] / ohms[0] - 1.0

    def weights(self, ohms: list[FloatArray], true: list[FloatArray]) -> list[FloatArray]:
        return [-ohms[1] / ohms[0] ** 2, 1.0 / ohms[0]]

    def toggles(self, frame: int) -> bool:
        return frame == 1

    def own(self, value: FloatArray) -> FloatArray:
        return np.zeros_like(value)


@dataclass(frozen=True)
class Corners:
    """C corners of the box, one judged cell each."""

    row: IntArray
    column: IntArray
    sign: FloatArray
    """(C,) of the value that is looked for"""
    factors: FloatArray
    """(C, F)"""
    pattern: FloatArray
    """(C, N, M): 1 pressed, 0 at rest"""
    scale: FloatArray
    """(C, N, M): -1 or 1, of each cell's spread"""

    def some(self, which: IntArray | BoolArray) -> Corners:
        return Corners(**{name: getattr(self, name)[which] for name in self.__dataclass_fields__})

    def distinct(self) -> Corners:
        """The corners without repetitions, in the order of their first appearance."""
        first: dict[bytes, int] = {}
        for index in range(len(self.row)):
            key = b"".join(np.asarray(getattr(self, name)[index]).tobytes() for name in self.__dataclass_fields__)
            first.setdefault(key, index)
        return self.some(np.array(list(first.values()), dtype=np.intp))


@dataclass(frozen=True)
class WorstCase:
    """Where a target is worst, and how that was found."""

    target: Target
    box: Box
    corner: Corners
    """one"""
    value: float
    """signed, relative; inf where a reading clips or an output saturates"""
    by_cell: FloatArray
    """(N, M): the largest magnitude that was solved for each cell; NaN where none was"""
    solved: int
    """corners that were solved"""
    all_cells: bool
    neighbours_solved: bool
    """the corners that differ in one part or cell were solved, too"""
    stationary: bool
    """no neighbour is worse, or no sign changes when the derivatives are taken at the corner itself"""
    checked: float
    """relative difference between the value and that of plain scans of the same corner"""

    @property
    def cell(self) -> tuple[int, int]:
        return int(self.corner.row[0]), int(self.corner.column[0])

    @property
    def frames(self) -> list[FloatArray]:
        """(N, M) ohm of the cells in each frame."""
        return [frame[0] for frame in _frames(self.target, self.box, self.corner)]

    @property
    def pattern(self) -> BoolArray:
        """(N, M) which cells are pressed in the last frame"""
        pressed = self.target.pressed(self.corner.pattern, self.corner.row, self.corner.column)[-1]
        return np.asarray(pressed[0] > 0)

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
        cells = self.by_cell.size
        few = most_solved(self.by_cell.shape)
        extent = "every cell" if self.all_cells else f"the {few} of {cells} cells that first order ranks highest"
        state = "a neighbouring corner may still be worse"
        if self.stationary:
            state = "no neighbouring corner is worse" + (
                "" if self.neighbours_solved else " to first order, none solved"
            )
        if np.isinf(self.value):
            return f"{self.solved} corners solved, for {extent}; the first one beyond a limit ends the search"
        agreement = f"plain scans of the corner agree to {max(self.checked, ROUNDING):.0e}"
        return f"{self.solved} corners solved, for {extent}; {state}; {agreement}"

    @cached_property
    def contributions(self) -> dict[str, float]:
        """Signed change of the value by each kind of part alone at its corner, the cells as they are."""
        keys = list(dict.fromkeys(factor.key for factor in self.box.factors.factors))
        masks = np.array([[factor.key == key for factor in self.box.factors.factors] for key in keys], dtype=float)
        count = len(keys) + 1
        rows = np.zeros((count, len(self.box.factors)))
        rows[1:] = masks.reshape(len(keys), len(self.box.factors)) * self.corner.factors
        repeated = Corners(
            **{name: np.repeat(getattr(self.corner, name), count, axis=0) for name in Corners.__dataclass_fields__}
        )
        values = evaluate(self.target, self.box, replace(repeated, factors=rows))
        return {"nominal parts": float(values[0])} | {
            key: float(value - values[0]) for key, value in zip(keys, values[1:], strict=True)
        }


def worst_case(target: Target, box: Box) -> WorstCase:
    """Search the box for the largest magnitude of a target over all cells.

    Raises:
        InputError: a continuous sheet or an array of more than 64 x 64 cells, which has no sensitivities.
    """
    starts = [
        corner
        for pressed in (0.0, 1.0)
        for sign in (1.0, -1.0)
        for corner in [named_corners(target, box, pressed, sign)]
    ]
    known = Corners(
        **{name: np.concatenate([getattr(s, name) for s in starts]) for name in Corners.__dataclass_fields__}
    )
    known = known.distinct()
    values = evaluate(target, box, known)
    memory = _Linearisations(box)
    by_cell = np.full(box.design.array.shape, np.nan)
    for row, column, value in zip(known.row, known.column, np.abs(values), strict=True):
        by_cell[row, column] = np.fmax(by_cell[row, column], value)
    solved, best, best_value = len(values), known.some(np.array([0])), -np.inf
    stationary = neighbours_solved = False
    for sign in (1.0, -1.0):
        order = np.argsort(-np.where(known.sign == sign, sign * values, -np.inf), kind="stable")
        for index in order[: _REFINED_OF_FEW if by_cell.size <= _FEW_CELLS else _REFINED]:
            found = _Climbed(known.some(np.array([index])), float(sign * values[index]))
            found = _by_derivatives(target, memory, sign, found)
            found, by_solution = _by_neighbours(target, box, sign, found)
            solved += found.solved
            if found.value > best_value or np.isnan(found.value):
                best, best_value, stationary, neighbours_solved = found.corner, found.value, found.settled, by_solution
    signed = best_value * float(best.sign[0])
    row, column = int(best.row[0]), int(best.column[0])
    by_cell[row, column] = np.fmax(by_cell[row, column], abs(best_value))
    return WorstCase(
        target=target,
        box=box,
        corner=best,
        value=signed,
        by_cell=by_cell,
        solved=solved,
        all_cells=bool(np.isfinite(by_cell).all() or by_cell.size <= most_solved(by_cell.shape)),
        neighbours_solved=neighbours_solved,
        stationary=stationary,
        checked=_checked(target, box, best, signed),
    )


class _Climbed(NamedTuple):
    """How far one start of the search has come."""

    corner: Corners
    """a single one"""
    value: float
    """the target there, times the sign that is sought"""
    solved: int = 0
    """corners that were solved on the way"""
    settled: bool = False
    """whether nothing that was tried last is worse"""


def _by_derivatives(target: Target, memory: _Linearisations, sign: float, found: _Climbed) -> _Climbed:
    """Go to the corner that the derivatives name, as long as its solution is worse."""
    corner, value, solved, settled = found
    for _ in range(_ROUNDS):
        if not np.isfinite(value):
            break
        moved = _improved(target, memory, corner)
        settled = all(
            np.array_equal(getattr(moved, name), getattr(corner, name)) for name in ("factors", "pattern", "scale")
        )
        if settled:
            break
        further = float(sign * evaluate(target, memory.box, moved)[0])
        solved += 1
        if not further > value:
            break
        corner, value = moved, further
    return _Climbed(corner, value, solved, settled)


def _by_neighbours(target: Target, box: Box, sign: float, found: _Climbed) -> tuple[_Climbed, bool]:
    """Go to the worst of the corners one part away, all solved, until none is worse; and whether any were solved."""
    corner, value, solved, settled = found
    any_solved = False
    for _ in range(_ROUNDS):
        neighbours = _neighbours(target, box, corner)
        if neighbours is None or not np.isfinite(value):
            break
        any_solved = True
        values = sign * evaluate(target, box, neighbours)
        solved += len(values)
        index = int(np.argmax(values))
        settled = not values[index] > value * (1.0 + 1e-12)
        if settled:
            break
        corner, value = neighbours.some(np.array([index])), float(values[index])
    return _Climbed(corner, value, solved, settled), any_solved


def evaluate(target: Target, box: Box, corners: Corners) -> FloatArray:
    """The target (C,) at each corner, the readings at the worst places within their ADC steps.

    Infinite where a reading that counts is beyond the converter's range or its output at a limit.
    """
    population = box.factors.population(corners.factors)
    each = np.arange(len(corners.row))
    readings, true, beyond = [], [], np.zeros(len(each), dtype=np.bool_)
    for cells in _frames(target, box, corners):
        found = scan_population(box.design, population.boards, cells, resolve_saturation=False)
        volts = box.converted(found.volts, population.converter[:, None, None])
        beyond |= (found.saturated | box.clipped(volts))[each, corners.row, corners.column]
        readings.append(volts)
        true.append(cells[each, corners.row, corners.column])
    return _value(target, box, corners, readings, true, beyond)


def _value(
    target: Target, box: Box, corners: Corners, readings: list[FloatArray], true: list[FloatArray], beyond: BoolArray
) -> FloatArray:
    each = np.arange(len(corners.row))

    def ohms(shifts: list[FloatArray]) -> list[FloatArray]:
        return [
            apparent_resistance(box.design, volts + shift[:, None, None])[each, corners.row, corners.column]
            for volts, shift in zip(readings, shifts, strict=True)
        ]

    still = [np.zeros(len(each)) for _ in readings]
    at_middle = ohms(still)
    if box.half_step:
        tiny = [np.full(len(each), 1e-3 * box.half_step) for _ in readings]
        with np.errstate(invalid="ignore"):
            slope = [above - middle for above, middle in zip(ohms(tiny), at_middle, strict=True)]
            weights = target.weights(at_middle, true)
            shifts = [
                np.where(corners.sign * weight * rise < 0, -1.0, 1.0) * box.half_step
                for weight, rise in zip(weights, slope, strict=True)
            ]
        at_middle = ohms(shifts)
    with np.errstate(invalid="ignore", divide="ignore"):
        value = target.value(at_middle, true)
    # A reading that says nothing is as wrong as can be, in the direction that is looked for.
    return np.where(beyond | ~np.isfinite(value), corners.sign * np.inf, value)


def _frames(target: Target, box: Box, corners: Corners) -> list[FloatArray]:
    return [
        box.resistance(pressed, corners.scale)
        for pressed in target.pressed(corners.pattern, corners.row, corners.column)
    ]


@dataclass(frozen=True)
class _Linear:
    """Apparent resistances of one frame and their derivatives."""

    ohms: FloatArray
    """(N, M)"""
    by_factor: FloatArray
    """(N, M, F) ohm"""
    by_cell: FloatArray
    """(N, M, N, M) ohm/ohm"""


def part_derivatives(found: Sensitivity, open_loop_gain: FloatArray) -> dict[str, FloatArray]:
    """Derivatives of the readings by the keys of the design's parts, one per line: (N, M, lines) by key."""
    return {
        "row_lead": found.row_lead,
        "row_segment": found.row_segment.sum(axis=-1),
        "column_lead": found.column_lead,
        "column_segment": found.column_segment.sum(axis=-2),
        "reference_resistance": found.reference_resistance,
        "open_loop_gain": -found.inverse_gain / open_loop_gain**2,
        "offset_voltage": found.offset_voltage,
        "bias_current": found.bias_current,
    }


def _linearised(box: Box, factors: FloatArray, cells: FloatArray) -> _Linear:
    population = box.factors.population(factors[None])
    design = population.boards.design(box.design, 0)
    found = sensitivity(design, cells)
    by_factor = np.zeros((*cells.shape, len(box.factors)))
    for name, derivative in part_derivatives(found, population.boards.open_loop_gain).items():
        matrix = box.factors.matrix[f"{SECTION[name]}.{name}"]
        if matrix.any():
            by_factor += derivative @ matrix
    for name in ("voltage", "reference_voltage"):
        matrix = box.factors.matrix[f"{SECTION[name]}.{name}"]
        if matrix.any():
            by_factor += _by_difference(box.design, population.boards, name, cells)[..., None] * matrix[0]
    volts, by_cell = found.volts, found.cells
    adc = box.design.adc
    if adc is not None:
        for number, name in enumerate(("offset_voltage", "gain_error", "inl_steps")):
            unit = np.zeros((1, 3))
            unit[0, number] = 1e-6
            moved = box.converted(volts, population.converter[0] + unit[0])
            still = box.converted(volts, population.converter[0])
            by_factor += ((moved - still) / 1e-6)[..., None] * box.factors.matrix[f"adc.{name}"][0]
    volts = box.converted(volts, population.converter[0])
    small = 1e-6 * max(float(np.abs(volts - box.design.readout.reference_voltage).max()), 1e-12)
    ohms = apparent_resistance(box.design, volts)
    with np.errstate(invalid="ignore"):
        slope = (apparent_resistance(box.design, volts + small) - apparent_resistance(box.design, volts - small)) / (
            2 * small
        )
    slope = np.where(np.isfinite(slope), slope, 0.0)
    return _Linear(ohms, slope[..., None] * by_factor, slope[..., None, None] * by_cell)


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


def _gradients(
    target: Target, box: Box, linear: list[_Linear], cells: list[FloatArray], judged: tuple[IntArray, IntArray]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Value (C,) and its derivatives by factors (C, F), by the pattern and by the scale of the cells (C, N, M)."""
    row, column = judged
    each = np.arange(len(row))
    ohms = [frame.ohms[row, column] for frame in linear]
    true = [frame[row, column] for frame in cells]
    with np.errstate(invalid="ignore", divide="ignore"):
        value = target.value(ohms, true)
        weights = [np.nan_to_num(weight, posinf=0.0, neginf=0.0) for weight in target.weights(ohms, true)]
    by_factor = np.zeros((len(row), len(box.factors)))
    by_pattern, by_scale = np.zeros((2, len(row), *box.design.array.shape))
    for number, (frame, weight, state) in enumerate(zip(linear, weights, cells, strict=True)):
        by_factor += weight[:, None] * frame.by_factor[row, column]
        by_cell = weight[:, None, None] * frame.by_cell[row, column]
        if target.toggles(number):
            by_pattern += by_cell * (box.pressed_ohm - box.rest_ohm)
        by_scale += by_cell * state * box.cell_spread
    by_scale[each, row, column] += np.nan_to_num(target.own(value)) * box.cell_spread
    return value, by_factor, by_pattern, by_scale


def _corners(
    sign: float, row: IntArray, column: IntArray, gradients: tuple[FloatArray, FloatArray, FloatArray]
) -> Corners:
    """The corner that each gradient points to."""
    by_factor, by_pattern, by_scale = (np.asarray(sign * gradient) for gradient in gradients)
    return Corners(
        row=row,
        column=column,
        sign=np.full(len(row), sign),
        factors=np.sign(by_factor),
        pattern=(by_pattern > 0).astype(np.float64),
        scale=np.sign(by_scale),
    )


def named_corners(target: Target, box: Box, pressed: float, sign: float) -> Corners:
    """The corners of the cells that rank highest, by derivatives at a state that all cells share."""
    shape = box.design.array.shape
    row, column = (index.ravel() for index in np.indices(shape))
    still = np.zeros(len(box.factors))
    first, last = np.zeros(shape), np.full(shape, pressed)
    states = [first, last] if target.frames == 2 else [last]
    if target.frames == 2 and not target.toggles(0) and not pressed:
        states = [first, first]
    if isinstance(target, GainError):
        states = [first, np.ones(shape)]
    cells = [box.resistance(state, np.zeros(shape)) for state in states]
    linear = [_linearised(box, still, frame) for frame in cells]
    value, *gradients = _gradients(target, box, linear, cells, (row, column))
    found = _corners(sign, row, column, (gradients[0], gradients[1], gradients[2]))
    if isinstance(target, ReadingError):  # its own state is the one that was looked at
        found.pattern[np.arange(len(row)), row, column] = pressed
    if isinstance(target, GainError):
        found = replace(found, pattern=np.where(pressed, found.pattern, 1.0 - found.pattern))
    rise = sum(np.abs(gradient).reshape(len(row), -1).sum(axis=1) for gradient in gradients)
    estimate = np.nan_to_num(sign * value + rise, nan=np.inf, posinf=np.inf)
    return found.some(np.argsort(-estimate, kind="stable")[: most_solved(shape)])


class _Linearisations:
    """Derivatives at corners of one box. Searches from several cells often come to the same corner."""

    def __init__(self, box: Box) -> None:
        self.box = box
        self._known: dict[tuple[bytes, bytes], _Linear] = {}
        values = box.design.array.rows * box.design.array.columns
        self._most = _MOST_REMEMBERED // (values * (values + len(box.factors)))

    def at(self, factors: FloatArray, cells: FloatArray) -> _Linear:
        """Derivatives for one board (F,) and its cells (N, M) in ohm."""
        key = factors.tobytes(), cells.tobytes()
        if key not in self._known:
            if len(self._known) >= self._most:
                self._known.clear()
            self._known[key] = _linearised(self.box, factors, cells)
        return self._known[key]


def _improved(target: Target, memory: _Linearisations, corner: Corners) -> Corners:
    """The corner that the derivatives at ``corner`` (one) name."""
    box = memory.box
    cells = [frame[0] for frame in _frames(target, box, corner)]
    linear = [memory.at(corner.factors[0], frame) for frame in cells]
    _, *gradients = _gradients(target, box, linear, cells, (corner.row, corner.column))
    found = _corners(float(corner.sign[0]), corner.row, corner.column, (gradients[0], gradients[1], gradients[2]))
    row, column = int(corner.row[0]), int(corner.column[0])
    found.pattern[0, row, column] = corner.pattern[0, row, column]
    # A part without influence stays where it is.
    return replace(
        found,
        factors=np.where(found.factors == 0, corner.factors, found.factors),
        scale=np.where(found.scale == 0, corner.scale, found.scale),
    )


def _neighbours(target: Target, box: Box, corner: Corners) -> Corners | None:
    """The corners that differ in one part, in the press or the spread of one cell; None where there are too many."""
    rows, columns = box.design.array.shape
    row, column = int(corner.row[0]), int(corner.column[0])
    cells = rows * columns
    count = len(box.factors) + cells + (cells if box.cell_spread else 0)
    if count * cells * target.frames > _MOST_FLIPS:
        return None
    factors, pattern, scale = (
        np.repeat(getattr(corner, name), count, axis=0) for name in ("factors", "pattern", "scale")
    )
    parts = np.arange(len(box.factors))
    factors[parts, parts] = np.where(factors[parts, parts] > 0, -1.0, 1.0)
    each, places = np.arange(cells), np.indices((rows, columns)).reshape(2, -1)
    first = len(parts)
    pattern[first + each, places[0], places[1]] = 1.0 - pattern[first + each, places[0], places[1]]
    if box.cell_spread:
        first += cells
        flipped = np.where(scale[first + each, places[0], places[1]] > 0, -1.0, 1.0)
        scale[first + each, places[0], places[1]] = flipped
    return Corners(np.full(count, row), np.full(count, column), np.full(count, corner.sign[0]), factors, pattern, scale)


def _checked(target: Target, box: Box, corner: Corners, value: float) -> float:
    """Relative difference of ``value`` from that of plain scans, one board at a time."""
    population: Population = box.factors.population(corner.factors)
    design = population.boards.design(box.design, 0)
    readings, true, beyond = [], [], np.zeros(1, dtype=np.bool_)
    for cells in _frames(target, box, corner):
        found = scan(design, cells[0], method="exact")
        volts = box.converted(found.volts, population.converter[0])
        beyond |= (found.saturated | box.clipped(volts))[corner.row, corner.column]
        readings.append(volts[None])
        true.append(cells[0][corner.row, corner.column])
    again = float(_value(target, box, corner, readings, true, beyond)[0])
    if np.isinf(value) or np.isinf(again):
        return 0.0 if value == again else np.inf
    return abs(again - value) / max(abs(value), 1e-9)
