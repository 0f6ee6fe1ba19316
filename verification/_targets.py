"""The quantities that a worst-case search maximises, as functions of a board, a press and one judged cell.

A *box* holds every board and press that a design allows. Its coordinates lie between -1 and 1: the factors of the
parts (:mod:`._parameters`), the press of each cell (-1 at rest, 1 at full scale), and each cell's own deviation. A
*target* is a number of the readings of one cell that should be small: the error of the resistance, of the gain, the
crosstalk, or how far a voltage goes towards a limit. Errors have a sign, and both signs are searched.

A reading that stands at the reference or beyond it says nothing about the cell. So does one that is clipped, or whose
output is at a supply limit. All of these are infinite errors, whatever number the law of the ideal circuit makes of
them: its resistance passes through infinity at the reference and changes sign, so that a number of the other sign would
look harmless.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from math import inf

import numpy as np

from ..circuits import Design, apparent_resistance, ideal_volts, scan, scan_population
from ..common.arrays import BoolArray, FloatArray, IntArray
from ._parameters import Factors

_TOGETHER = 1 << 20
"""cells that are read in one call, so that the arrays stay small"""
Law = Callable[[FloatArray], FloatArray]
"""The host's resistances in ohm of volts, of the same shape."""
Press = tuple[BoolArray, tuple[int, int]]
"""Pressed cells (N, M), and the cell that is judged where a press serves only one."""


@dataclass(frozen=True)
class Box:
    """What a worst-case search ranges over."""

    design: Design
    factors: Factors
    rest_ohm: float
    pressed_ohm: float
    cell_spread: float
    """relative, of every cell on its own"""
    saturates: bool = False
    """whether an output may reach its supply limit, so that what it does to the other readings is to be solved"""

    @property
    def cells(self) -> int:
        """Number of cells."""
        return self.design.array.rows * self.design.array.columns

    @property
    def size(self) -> int:
        """Number of coordinates: factors, presses, deviations of the cells."""
        return len(self.factors) + 2 * self.cells

    def split(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Factors (C, F), presses and deviations of the cells (C, N, M) of coordinates (C, D); returns views."""
        count, first = len(self.factors), len(self.factors) + self.cells
        shape = (len(x), *self.design.array.shape)
        return x[:, :count], x[:, count:first].reshape(shape), x[:, first:].reshape(shape)

    @property
    def half_step(self) -> float:
        """V by which a code may stand for less or more than was converted."""
        return self.design.adc.step / 2 if self.design.adc else 0.0

    @cached_property
    def side(self) -> float:
        """1 or -1: on which side of the reference the readings of sound cells are."""
        at_rest = ideal_volts(self.design, np.full(self.design.array.shape, self.rest_ohm))
        return float(np.sign(at_rest.flat[0] - self.design.readout.reference_voltage))

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

    def law(self, row: IntArray, column: IntArray) -> Law:
        """The host's law for readings (C,) of the cells (C,)."""
        board = self.design.board
        sensed = board.shape[1] - 1 - row if board.turned else column
        each = np.arange(len(sensed))

        def ohms(volts: FloatArray) -> FloatArray:
            lines = np.full((len(sensed), 1, board.shape[1]), board.level)
            lines[each, 0, sensed] = volts
            found: FloatArray = board.circuit.apparent_resistance(board, lines)[each, 0, sensed]
            return found

        return ohms


@dataclass(frozen=True)
class Frame:
    """What is known of the judged readings of one frame; arrays of one shape, such as (C,) or (boards, N, M)."""

    output: FloatArray
    """V, limited to the supply"""
    volts: FloatArray
    """V as an ideal converter would have to see them"""
    true: FloatArray
    """ohm of the judged cells"""
    lost: BoolArray
    """clipped, or of an output at a supply limit"""


class Target(ABC):
    """A number of one cell's readings in one or two frames; the larger, the worse."""

    name: str
    frames: int = 1

    @abstractmethod
    def pressed(self, pattern: FloatArray, row: IntArray, column: IntArray) -> list[FloatArray]:
        """Which cells are pressed (C, N, M) in each frame, for the cells (C,) that are judged."""

    def uniform(self, state: float) -> list[float]:
        """The press that all cells share, by frame, where derivatives stand for those of :meth:`pressed`."""
        return [state]

    def judged(self, pattern: BoolArray, cell: tuple[int, int]) -> BoolArray:
        """(N, M) cells that :meth:`pressed` of this pattern and cell serves."""
        return np.ones(pattern.shape, dtype=np.bool_)

    @abstractmethod
    def smooth(self, box: Box, law: Law, frames: Sequence[Frame]) -> FloatArray:
        """The signed value without infinities and steps, for derivatives."""

    @abstractmethod
    def value(self, box: Box, law: Law, frames: Sequence[Frame], sign: FloatArray | float) -> FloatArray:
        """The value in the direction ``sign``, at the least favourable places within the steps of the converter."""


class _Error(Target):
    """A relative error of what the host makes of the readings."""

    @abstractmethod
    def error(self, ohms: Sequence[FloatArray], true: Sequence[FloatArray]) -> FloatArray:
        """Signed and relative, of apparent and true ohm by frame."""

    def smooth(self, box: Box, law: Law, frames: Sequence[Frame]) -> FloatArray:
        with np.errstate(all="ignore"):
            return self.error([law(frame.volts) for frame in frames], [frame.true for frame in frames])

    def value(self, box: Box, law: Law, frames: Sequence[Frame], sign: FloatArray | float) -> FloatArray:
        true = [frame.true for frame in frames]
        ends = (-box.half_step, box.half_step) if box.half_step else (0.0,)
        worst = np.full(true[0].shape, -inf)
        with np.errstate(all="ignore"):
            read = [[law(frame.volts + end) for end in ends] for frame in frames]
            for ohms in product(*read):
                worst = np.fmax(worst, sign * self.error(ohms, true))
        nothing = np.zeros(worst.shape, dtype=np.bool_)
        for frame in frames:
            signal = box.side * (frame.volts - box.design.readout.reference_voltage)
            nothing |= frame.lost | ~(signal > box.half_step)
        return np.where(nothing | np.isnan(worst), inf, worst)


class ReadingError(_Error):
    """Relative error of a resistance that the host makes of an uncalibrated reading."""

    name = "reading error"

    def pressed(self, pattern: FloatArray, row: IntArray, column: IntArray) -> list[FloatArray]:
        return [pattern]

    def error(self, ohms: Sequence[FloatArray], true: Sequence[FloatArray]) -> FloatArray:
        return ohms[0] / true[0] - 1.0


class GainError(_Error):
    """Relative error of the change that the host sees when the cell alone is pressed from rest to full scale."""

    name = "gain error"
    frames = 2

    def pressed(self, pattern: FloatArray, row: IntArray, column: IntArray) -> list[FloatArray]:
        before, after = pattern.copy(), pattern.copy()
        each = np.arange(len(pattern))
        before[each, row, column], after[each, row, column] = 0.0, 1.0
        return [before, after]

    def uniform(self, state: float) -> list[float]:
        return [0.0, 1.0]

    def judged(self, pattern: BoolArray, cell: tuple[int, int]) -> BoolArray:
        own = np.zeros(pattern.shape, dtype=np.bool_)
        own[cell] = True
        return own

    def error(self, ohms: Sequence[FloatArray], true: Sequence[FloatArray]) -> FloatArray:
        return (ohms[1] - ohms[0]) / (true[1] - true[0]) - 1.0


class Crosstalk(_Error):
    """Relative change of an untouched cell's reading when other cells are pressed."""

    name = "crosstalk"
    frames = 2

    def pressed(self, pattern: FloatArray, row: IntArray, column: IntArray) -> list[FloatArray]:
        after = pattern.copy()
        after[np.arange(len(pattern)), row, column] = 0.0
        return [np.zeros_like(after), after]

    def uniform(self, state: float) -> list[float]:
        return [0.0, state]

    def judged(self, pattern: BoolArray, cell: tuple[int, int]) -> BoolArray:
        return ~pattern

    def error(self, ohms: Sequence[FloatArray], true: Sequence[FloatArray]) -> FloatArray:
        return ohms[1] / ohms[0] - 1.0


@dataclass(frozen=True)
class Excursion(Target):
    """How far a voltage goes beyond its limits, V; negative within them. The board has no supply limits."""

    name: str
    limits: tuple[float, float]
    """V, lowest and highest"""
    at_converter: bool
    """whether the converter's errors count"""
    at_rest: bool = False
    """whether all cells stay untouched"""

    def pressed(self, pattern: FloatArray, row: IntArray, column: IntArray) -> list[FloatArray]:
        return [np.zeros_like(pattern) if self.at_rest else pattern]

    def smooth(self, box: Box, law: Law, frames: Sequence[Frame]) -> FloatArray:
        return frames[0].volts if self.at_converter else frames[0].output

    def value(self, box: Box, law: Law, frames: Sequence[Frame], sign: FloatArray | float) -> FloatArray:
        volts, (low, high) = self.smooth(box, law, frames), self.limits
        return np.where(np.asarray(sign) > 0, volts - high, low - volts)


@dataclass(frozen=True)
class Corners:
    """C corners of a box, one judged cell each."""

    row: IntArray
    column: IntArray
    sign: FloatArray
    """(C,) of the value that is looked for"""
    x: FloatArray
    """(C, D) coordinates"""

    def __len__(self) -> int:
        return len(self.row)

    def some(self, which: IntArray | BoolArray | slice) -> Corners:
        """Some of them."""
        return Corners(self.row[which], self.column[which], self.sign[which], self.x[which])

    def at(self, x: FloatArray) -> Corners:
        """The same judged cells, each repeated for its coordinates (C, K, D) or (C, D)."""
        times = x.shape[1] if x.ndim == 3 else 1
        places = np.repeat(self.row, times), np.repeat(self.column, times)
        return Corners(*places, np.repeat(self.sign, times), x.reshape(-1, x.shape[-1]))

    @classmethod
    def joined(cls, parts: Sequence[Corners]) -> Corners:
        """All of several."""
        names = ("row", "column", "sign", "x")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def frames_of(target: Target, box: Box, corners: Corners) -> list[FloatArray]:
    """(C, N, M) ohm of the cells in each frame."""
    _, press, scale = box.split(corners.x)
    pressed = target.pressed((1.0 + press) / 2.0, corners.row, corners.column)
    return [box.resistance(frame, scale) for frame in pressed]


def evaluate(target: Target, box: Box, corners: Corners) -> FloatArray:
    """The target (C,) at each corner."""
    values = np.empty(len(corners))
    size = max(1, _TOGETHER // box.cells)
    for first in range(0, len(corners), size):
        some = slice(first, first + size)
        values[some] = _evaluate(target, box, corners.some(some))
    return values


def _evaluate(target: Target, box: Box, corners: Corners) -> FloatArray:
    population = box.factors.population(box.split(corners.x)[0])
    each = np.arange(len(corners))
    driven = corners.column if box.design.board.turned else corners.row
    frames = []
    for cells in frames_of(target, box, corners):
        found = scan_population(box.design, population.boards, cells, driven=driven, resolve_saturation=box.saturates)
        own = (each, corners.row, corners.column)
        volts = box.converted(found.volts[own], population.converter)
        frames.append(Frame(found.volts[own], volts, cells[own], found.saturated[own] | box.clipped(volts)))
    return target.value(box, box.law(corners.row, corners.column), frames, corners.sign)


def scanned(target: Target, box: Box, corner: Corners) -> float:
    """The target at one corner by plain scans of its board, one frame after the other."""
    population = box.factors.population(box.split(corner.x)[0])
    design = population.boards.design(box.design, 0)
    own = (corner.row, corner.column)
    frames = []
    for cells in frames_of(target, box, corner):
        found = scan(design, cells[0], method="exact")
        volts = box.converted(found.volts[own], population.converter)
        frames.append(Frame(found.volts[own], volts, cells[0][own], found.saturated[own] | box.clipped(volts)))
    return float(target.value(box, box.law(*own), frames, corner.sign)[0])


def values_of_boards(target: Target, box: Box, x: FloatArray, presses: Sequence[Press]) -> tuple[FloatArray, IntArray]:
    """The target of many boards under given presses, whatever judged cell is worst.

    Args:
        target: what is judged.
        box: the boards' design.
        x: (S, D) coordinates of the boards; their presses do not count.
        presses: under which each board is judged.

    Returns:
        Values (S, P), and the judged cell (S, P) as a flat index, with the sign of the error: -1 - index for negative.
    """
    factors, _, scale = box.split(x)
    population = box.factors.population(factors)
    converter = population.converter[:, None, None]
    values, places = np.full((len(x), len(presses)), -inf), np.zeros((len(x), len(presses)), dtype=np.intp)
    at_rest: list[Frame] = []

    def read(pressed: FloatArray, *, resolve: bool) -> Frame:
        if not pressed.any() and at_rest:
            return at_rest[0]
        cells = box.resistance(np.broadcast_to(pressed, scale.shape), scale)
        found = scan_population(box.design, population.boards, cells, resolve_saturation=resolve)
        volts = box.converted(found.volts, converter)
        frame = Frame(found.volts, volts, cells, found.saturated | box.clipped(volts))
        if not pressed.any():
            at_rest.append(frame)
        return frame

    for number, (pattern, cell) in enumerate(presses):
        judged = target.judged(pattern, cell)
        if not judged.any():
            continue
        place = (np.array([cell[0]]), np.array([cell[1]]))
        # Where all cells are judged, a board with a saturated output has an infinite error whatever the others read.
        pressed = target.pressed(pattern[None].astype(np.float64), *place)
        frames = [read(frame[0], resolve=box.saturates and not judged.all()) for frame in pressed]
        for sign in (1.0, -1.0):
            found = target.value(box, lambda volts: apparent_resistance(box.design, volts), frames, sign)
            found = np.where(judged, found, -inf).reshape(len(x), -1)
            index = found.argmax(axis=1)
            larger = found[np.arange(len(x)), index] > values[:, number]
            values[larger, number] = found[larger, index[larger]]
            places[larger, number] = index[larger] if sign > 0 else -1 - index[larger]
    return values, places
