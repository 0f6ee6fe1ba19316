"""The box of all boards and presses that a design allows, and corners of it.

Its coordinates lie between -1 and 1: the factors of the parts (:mod:`._parameters`), the press of each cell (-1 at
rest, 1 at full scale), and each cell's own deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..circuits import Design
from ..common.arrays import BoolArray, FloatArray, IntArray
from ._parameters import IN_TIME, Factors, Population
from ._scale import Scale


@dataclass(frozen=True)
class Box:
    """What a worst-case search ranges over."""

    design: Design
    factors: Factors
    rest_ohm: float
    pressed_ohm: float
    cell_spread: float
    """relative, of every cell on its own"""
    scale: Scale
    """what errors of readings are stated in"""
    saturates: bool = False
    """whether an output may reach its supply limit, so that what it does to the other readings is to be solved"""

    @property
    def shape(self) -> tuple[int, int]:
        return self.design.array.shape

    @property
    def cells(self) -> int:
        """Number of cells."""
        return self.shape[0] * self.shape[1]

    @property
    def size(self) -> int:
        """Number of coordinates: factors, presses, deviations of the cells."""
        return len(self.factors) + 2 * self.cells

    def split(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Factors (C, F), presses and deviations of the cells (C, N, M) of coordinates (C, D); returns views."""
        count, first = len(self.factors), len(self.factors) + self.cells
        shape = (len(x), *self.shape)
        return x[:, :count], x[:, count:first].reshape(shape), x[:, first:].reshape(shape)

    def free(self, *, in_time: bool) -> BoolArray:
        """(D,) coordinates that quantities of settled readings, or of readings in time, can depend on."""
        free = np.ones(self.size, dtype=np.bool_)
        if not in_time:
            free[: len(self.factors)] = [factor.key not in IN_TIME for factor in self.factors.factors]
        if not self.cell_spread:
            free[-self.cells :] = False
        return free

    def near(self, row: int, column: int) -> BoolArray:
        """(D,) parts, and the cells of a row, of the row before and of a column: those that a reading feels most."""
        cells = np.zeros(self.shape, dtype=np.bool_)
        cells[[row, row - 1]] = cells[:, [column, column - 1]] = True
        return np.concatenate([np.ones(len(self.factors), dtype=np.bool_), cells.ravel(), cells.ravel()])

    def lines(self) -> BoolArray:
        """(K, D) the presses of each row, of each column, and of all cells."""
        row, column = np.indices(self.shape)
        groups = [row.ravel() == i for i in range(self.shape[0])] + [column.ravel() == j for j in range(self.shape[1])]
        found = np.zeros((len(groups) + 1, self.size), dtype=np.bool_)
        found[:-1, len(self.factors) : len(self.factors) + self.cells] = groups
        found[-1] = found[:-1].any(axis=0)
        return found

    def exchanged(self, corner: Corners, row: int, column: int) -> FloatArray:
        """(D,) one corner with the lines of its judged cell and those of another cell exchanged, as if relabelled."""
        order = [np.arange(count) for count in self.shape]
        for lines, one, other in zip(order, (corner.row[0], corner.column[0]), (row, column), strict=True):
            lines[[one, other]] = other, one
        factors, press, scale = (part[0] for part in self.split(corner.x))
        place = {(factor.key, factor.line, factor.package): n for n, factor in enumerate(self.factors.factors)}
        found = factors.copy()
        for number, (key, line, package) in enumerate(place):
            if line is not None:
                lines = order[0 if key.partition(".")[2].startswith("row_") else self.sensed_axis]
                found[number] = factors[place.get((key, int(lines[line % len(lines)]), package), number)]
        cells = np.ix_(*order)
        return np.concatenate([found, press[cells].ravel(), scale[cells].ravel()])

    @property
    def sensed_axis(self) -> int:
        """The axis of the array along which lines have a readout."""
        return 0 if self.design.board.transposed else 1

    @property
    def half_step(self) -> float:
        """V by which a code may stand for less or more than was converted."""
        return self.design.adc.step / 2 if self.design.adc else 0.0

    @cached_property
    def domain(self) -> tuple[float, float]:
        """V of an open cell and of a short by the host's law: readings at or beyond either say nothing of a cell."""
        board = self.design.board
        return board.circuit.domain(board)

    @property
    def side(self) -> float:
        """1 or -1: the direction from the reading of an open cell to that of a short."""
        return 1.0 if self.domain[1] > self.domain[0] else -1.0

    def resistance(self, pressed: FloatArray, scale: FloatArray) -> FloatArray:
        """ohm of cells with ``pressed`` from 0 to 1 and ``scale`` from -1 to 1, of any shape."""
        low, high = self.rest_ohm, self.pressed_ohm
        result: FloatArray = (low + (high - low) * pressed) * (1.0 + self.cell_spread * scale)
        return result

    def population(self, x: FloatArray) -> Population:
        """The boards of coordinates (C, D)."""
        return self.factors.population(self.split(x)[0])

    def board(self, x: FloatArray) -> Design:
        """The design of the one board of coordinates (D,)."""
        return self.population(x[None]).boards.design(self.design, 0)

    def cells_of(self, x: FloatArray) -> FloatArray:
        """(C, N, M) ohm of the cells of coordinates (C, D), pressed as these say."""
        _, press, scale = self.split(x)
        return self.resistance((1.0 + press) / 2.0, scale)

    def in_words(self, pressed: BoolArray) -> str:
        """Which cells (N, M) are pressed."""
        if pressed.all():
            return "all cells pressed"
        if not pressed.any():
            return "all cells at rest"
        few, what = (pressed, "pressed") if pressed.sum() * 2 <= pressed.size else (~pressed, "not pressed")
        places = [f"({i}, {j})" for i, j in np.argwhere(few)[:6].tolist()]
        return f"{few.sum()} of {few.size} cells {what}: {', '.join(places)}{', ...' if few.sum() > 6 else ''}"


@dataclass(frozen=True)
class Corners:
    """C points of a box, each with the cell that is judged there and the sign of its error.

    Targets that judge a board as a whole take no notice of cell and sign.
    """

    row: IntArray
    column: IntArray
    sign: FloatArray
    """(C,) of the value that is looked for"""
    x: FloatArray
    """(C, D) coordinates"""

    def __len__(self) -> int:
        return len(self.row)

    @classmethod
    def of_boards(cls, x: FloatArray) -> Corners:
        """Points (C, D) of boards that are judged as a whole."""
        nothing = np.zeros(len(x), dtype=np.intp)
        return cls(nothing, nothing, np.ones(len(x)), x)

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
