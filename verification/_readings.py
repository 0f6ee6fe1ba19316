"""Quantities of settled readings: functions of what is read of one cell in one or two frames, for the search.

Errors have a sign, and both signs are searched. A reading is lost, and an infinite error, if it is clipped, if its
output is at a supply limit, or if it stands at or beyond an end of its circuit's law: at the reading of an open cell,
or at that of a short. The law's resistance passes through infinity or zero there and changes its sign, so that a number
of the other sign would look harmless. Of a cell that is open at rest the open end is a state of the cell, not a loss.

The derivatives of every reading by every part (central differences) and cell (adjoint method,
:func:`ohmskin.circuits.sensitivity`), at all cells at rest and at all pressed, name one corner per cell, sign and state
to start from.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from math import inf
from typing import Final

import numpy as np

from ..circuits import Design, at_ideal_converter, ideal_volts, read_together, scan, scan_population, sensitivity
from ..common.arrays import BoolArray, FloatArray, IntArray
from ._box import Box, Corners
from ._search import Target, most_solved
from ._tuning import ALONE, CELLS_TOGETHER, DIFFERENCE

Law = Callable[[FloatArray], FloatArray]
"""The host's resistances in ohm of volts, of the same shape."""


@dataclass(frozen=True)
class Frame:
    """What is known of the judged readings (C,) of one frame."""

    output: FloatArray
    """V, limited to the supply"""
    volts: FloatArray
    """V as an ideal converter would have to see them"""
    true: FloatArray
    """ohm of the judged cells"""
    limited: FloatArray
    """1 or -1 where the reading is clipped or its output at a limit: whether that lies towards a short, or an open
    cell; else 0"""


def law_of(box: Box, row: IntArray, column: IntArray) -> Law:
    """The host's law for readings (C,) of the cells (C,).

    The readings of different cells share frames, since the law of a cell depends on the ends of both its lines.
    """
    board = box.design.board
    if board.transposed:
        row, column = board.shape[0] - 1 - column, board.shape[1] - 1 - row
    place = row * board.shape[1] + column
    order = np.argsort(place, kind="stable")
    ordered = place[order]
    frame = np.empty(len(place), dtype=np.intp)
    frame[order] = np.arange(len(place)) - np.searchsorted(ordered, ordered)

    def ohms(volts: FloatArray) -> FloatArray:
        lines = np.full((frame.max(initial=-1) + 1, *board.shape), board.level)
        lines[frame, row, column] = volts
        found: FloatArray = board.circuit.apparent_resistance(board, lines)[frame, row, column]
        return found

    return ohms


def clipped(design: Design, volts: FloatArray) -> BoolArray:
    """Where the code of ``volts`` is the first or the last."""
    if design.adc is None:
        return np.zeros(volts.shape, dtype=np.bool_)
    low, high = design.adc.range
    return np.asarray((volts < low + design.adc.step) | (volts >= high - design.adc.step))


def limited(box: Box, volts: FloatArray, saturated: BoolArray) -> FloatArray:
    """:attr:`Frame.limited` of converted voltages of any shape."""
    both = (box.rest_ohm, box.pressed_ohm)
    middle = float(np.mean([ideal_volts(box.design, np.full(box.shape, ohms)).mean() for ohms in both]))
    towards = np.where(box.side * (volts - middle) > 0.0, 1.0, -1.0)
    return np.where(saturated | clipped(box.design, volts), towards, 0.0)


FREE: Final = None
"""as the search has it"""
Presses = tuple[float | None, ...]
"""by frame, from 0 at rest to 1 at full scale; or :data:`FREE`"""


@dataclass(frozen=True)
class Frames:
    """What is pressed in the one or two frames that a target judges."""

    own: Presses = (FREE,)
    """of the judged cell"""
    others: Presses = (FREE,)
    """of all other cells"""
    around: Presses = (FREE,)
    """of all cells alike, where derivatives are taken that stand for those of the frames"""

    def __len__(self) -> int:
        return len(self.own)

    def pressed(self, pattern: FloatArray, row: IntArray, column: IntArray) -> list[FloatArray]:
        """Presses (C, N, M) in each frame, for the cells (C,) that are judged."""
        found = []
        for own, others in zip(self.own, self.others, strict=True):
            frame = pattern.copy() if others is FREE else np.full(pattern.shape, others)
            if own is not FREE:
                frame[np.arange(len(row)), row, column] = own
            found.append(frame)
        return found

    def uniform(self, state: float) -> list[float]:
        """The press that all cells share, by frame."""
        return [state if press is FREE else press for press in self.around]


AT_REST = Frames(own=(0.0,), others=(0.0,), around=(0.0,))


class ReadingTarget(Target):
    """A number of one cell's readings in one or two frames."""

    frames: Frames = Frames()

    @abstractmethod
    def smooth(self, box: Box, law: Law, frames: Sequence[Frame]) -> FloatArray:
        """The signed value (C,) without infinities and steps, for derivatives."""

    @abstractmethod
    def value(self, box: Box, law: Law, frames: Sequence[Frame], sign: FloatArray) -> FloatArray:
        """The value (C,) in the direction ``sign``, at the least favourable places within the converter's steps."""

    def frames_of(self, box: Box, corners: Corners) -> list[FloatArray]:
        _, press, scale = box.split(corners.x)
        pressed = self.frames.pressed((1.0 + press) / 2.0, corners.row, corners.column)
        return [box.resistance(frame, scale) for frame in pressed]

    def pattern(self, box: Box, corner: Corners) -> BoolArray:
        press = (1.0 + box.split(corner.x)[1]) / 2.0
        return np.asarray(self.frames.pressed(press, corner.row, corner.column)[-1][0] > 0.5)

    def cost(self, box: Box) -> float:
        alone = box.saturates or not read_together(box.design)
        return box.cells * len(self.frames) * (ALONE if alone else 1)

    def starts(self, box: Box) -> Corners:
        named = named_corners(self, box)
        return Corners.joined([corners for one in named for corners in (one.corners, one.around)])

    def gradient(self, box: Box, corner: Corners) -> FloatArray | None:
        cells = [frame[0] for frame in self.frames_of(box, corner)]
        linear = [_linearised(box, box.split(corner.x)[0][0], frame) for frame in cells]
        slopes: FloatArray = _slopes(self, box, linear, corner, cells)[1][0]
        return slopes

    def evaluate(self, box: Box, corners: Corners) -> FloatArray:
        values = np.empty(len(corners))
        size = max(1, CELLS_TOGETHER // box.cells)
        for first in range(0, len(corners), size):
            some = corners.some(slice(first, first + size))
            population = box.population(some.x)
            driven = some.column if box.design.board.transposed else some.row
            frames = []
            for cells in self.frames_of(box, some):
                found = scan_population(
                    box.design, population.boards, cells, driven=driven, resolve_saturation=box.saturates
                )
                frames.append(_frame(box, population.converter, found.volts, found.saturated, cells, some))
            values[first : first + size] = self.value(box, law_of(box, some.row, some.column), frames, some.sign)
        return values

    def stated(self, box: Box, corner: Corners) -> float:
        """By plain scans of the corner's board, one frame after the other."""
        design, converter = box.board(corner.x[0]), box.population(corner.x).converter
        frames = []
        for cells in self.frames_of(box, corner):
            found = scan(design, cells[0], method="exact")
            frames.append(_frame(box, converter, found.volts[None], found.saturated[None], cells, corner))
        return float(self.value(box, law_of(box, corner.row, corner.column), frames, corner.sign)[0])


def _frame(
    box: Box, converter: FloatArray, output: FloatArray, saturated: BoolArray, cells: FloatArray, corners: Corners
) -> Frame:
    """The judged readings of outputs (C, N, M)."""
    own = (np.arange(len(corners)), corners.row, corners.column)
    volts = at_ideal_converter(box.design, output[own], converter)
    return Frame(output[own], volts, cells[own], limited(box, volts, saturated[own]))


class ReadingErrorTarget(ReadingTarget):
    """An error of what the host makes of the readings, in the unit of the box's scale."""

    @abstractmethod
    def error(self, box: Box, read: Sequence[FloatArray], true: Sequence[FloatArray]) -> FloatArray:
        """Signed error of 1, of displayed and true values by frame (:meth:`.Scale.of`)."""

    def smooth(self, box: Box, law: Law, frames: Sequence[Frame]) -> FloatArray:
        show = box.scale.of
        with np.errstate(all="ignore"):
            read = [show(law(frame.volts)) for frame in frames]
            return self.error(box, read, [show(frame.true) for frame in frames])

    def value(self, box: Box, law: Law, frames: Sequence[Frame], sign: FloatArray) -> FloatArray:
        show, forgiving = box.scale.of, box.scale.open_is_rest
        true = [show(frame.true) for frame in frames]
        ends = (-box.half_step, box.half_step) if box.half_step else (0.0,)
        worst = np.full(true[0].shape, -inf)
        lost = np.zeros(worst.shape, dtype=np.bool_)
        (empty, short), read = box.domain, []
        for frame in frames:
            volts = np.clip(frame.volts, *box.design.adc.range) if forgiving and box.design.adc else frame.volts
            lost |= ~(box.side * (short - volts) > box.half_step)
            lost |= frame.limited > 0.0 if forgiving else frame.limited != 0.0
            if not forgiving:
                lost |= ~(box.side * (volts - empty) > box.half_step)
            read.append([volts + end for end in ends])
        with np.errstate(all="ignore"):
            if forgiving:  # what lies beyond an open cell is displayed as one
                read = [[np.where(box.side * (v - empty) > 0.0, v, empty) for v in both] for both in read]
            shown = [[show(law(volts)) for volts in both] for both in read]
            for displayed in product(*shown):
                worst = np.fmax(worst, sign * self.error(box, displayed, true))
        return np.where(lost | np.isnan(worst), inf, worst)


@dataclass(frozen=True)
class Excursion(ReadingTarget):
    """How far a voltage goes beyond its limits, V; negative within them. The board has no supply limits."""

    name: str
    limits: tuple[float, float]
    """V, lowest and highest"""
    at_converter: bool
    """whether the converter's errors count"""
    frames: Frames = Frames()

    def smooth(self, box: Box, law: Law, frames: Sequence[Frame]) -> FloatArray:
        return frames[0].volts if self.at_converter else frames[0].output

    def value(self, box: Box, law: Law, frames: Sequence[Frame], sign: FloatArray) -> FloatArray:
        volts, (low, high) = self.smooth(box, law, frames), self.limits
        return np.where(sign > 0, volts - high, low - volts)


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
    """By central differences along each factor, and by the adjoint method for the cells."""
    count = len(factors)
    moves = DIFFERENCE * np.concatenate([np.zeros((1, count)), np.eye(count), -np.eye(count)])
    population = box.factors.population(factors + moves)
    by_cell = sensitivity(population.boards.design(box.design, 0), cells).cells
    each = np.broadcast_to(cells, (len(moves), *cells.shape))
    output = scan_population(box.design, population.boards, each, resolve_saturation=False).volts
    volts = at_ideal_converter(box.design, output, population.converter[:, None, None])
    by_factor = np.moveaxis(volts[1 : count + 1] - volts[count + 1 :], 0, -1) / (2.0 * DIFFERENCE)
    return _Linear(output[0], volts[0], by_factor, by_cell)


def _slopes(
    target: ReadingTarget, box: Box, linear: Sequence[_Linear], corners: Corners, cells: Sequence[FloatArray]
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
    each, law = np.arange(len(row)), law_of(box, row, column)
    nothing = np.zeros(len(row))
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
    moves = zip(*(target.frames.pressed(press, row, column) for press in (ones, 0.0 * ones)), strict=True)
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
            own, by_true = (each, row, column), np.nan_to_num(nudged / 2e-6)
            press[own] += by_true * ((high - low) * width * deviating / ohms)[own]
            scale[own] += by_true * (box.cell_spread / deviating)[own]
        flat = [part.reshape(len(row), -1) for part in (factors, press, scale)]
        return signed(0), np.concatenate(flat, axis=1)


class _Uniform:
    """Derivatives where all cells are in one state, which serve the corners of all judged cells."""

    def __init__(self, target: ReadingTarget, box: Box, state: float, known: dict[float, _Linear]) -> None:
        self.target, self.box = target, box
        shape = box.design.array.shape
        self.row, self.column = (index.ravel() for index in np.indices(shape))
        states = target.frames.uniform(state)
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


@dataclass(frozen=True)
class NamedCorners:
    """The corners that derivatives about one state name, with the values to first order that they come from."""

    corners: Corners
    around: Corners
    """the same with all cells in that state, where the derivatives by the parts hold: what a part does may be a product
    with presses, as with floating rows, of which derivatives about nominal parts know nothing"""
    centre: FloatArray
    """(K,) values of nominal boards with all cells alike"""
    slopes: FloatArray
    """(K, D) by the coordinates"""


def named_corners(target: ReadingTarget, box: Box) -> list[NamedCorners]:
    """By state (all cells at rest, all pressed) and sign, of the cells that rank highest."""
    known: dict[float, _Linear] = {}
    found = []
    for state in (0.0, 1.0):
        uniform = _Uniform(target, box, state, known)
        for sign in (1.0, -1.0):
            order = np.argsort(-uniform.estimates(sign), kind="stable")[: most_solved(box.shape)]
            centre, values, slopes = uniform.slopes(order, sign)
            x, alike = np.sign(slopes), np.sign(slopes)
            press = box.split(x)[1]
            press[press == 0] = -1.0
            press[np.arange(len(order)), centre.row, centre.column] = 2.0 * state - 1.0
            box.split(alike)[1][:] = 2.0 * state - 1.0
            found.append(NamedCorners(centre.at(x), centre.at(alike), values, slopes))
    return found


def first_order(target: ReadingTarget, box: Box) -> FloatArray:
    """(2, N, M): the largest value of each cell's target to first order about all cells at rest, by sign.

    Raises:
        InputError: the design has no sensitivities.
    """
    at_rest = _Uniform(target, box, 0.0, {})
    return np.stack([at_rest.estimates(sign).reshape(box.shape) for sign in (1.0, -1.0)])
