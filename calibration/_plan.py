"""Plan of a calibration: which cells to press together, with which loads, in which order."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from ..arrays import BoolArray, FloatArray, IntArray
from ..errors import InputError

MOST_STEPS = 100
GAINS = (0.25, 4.0)
"""between which a gain is believed: beyond, the load, the area or the data of the cell are another's"""
LEAST_PRESSES = 2
"""of each cell: one press alone says nothing of its own error"""


@dataclass(frozen=True, slots=True)
class Plan:
    """Targets are pressed one after the other with the load of the first step, then with that of the second, ..."""

    shape: tuple[int, int]
    targets: tuple[IntArray, ...]
    """cells that bear a load together, as sorted indices into the flattened array"""
    loads_kpa: tuple[float, ...]
    """load of each step"""

    @classmethod
    def make(cls, shape: tuple[int, int], press: str, loads_kpa: Sequence[float]) -> Plan:
        """A plan from the words of the command line.

        Args:
            shape: (rows, columns) of the skin.
            press: "each" cell by itself, "all" together under a plate, or "RxC": patches of so many rows and columns.
            loads_kpa: mean pressure on each cell, of each step. One load alone is pressed twice.

        Raises:
            InputError: no load, or one that is not positive; or no such way to press.

        """
        cls.check(press, loads_kpa)
        steps = list(loads_kpa) * (LEAST_PRESSES if len(loads_kpa) == 1 else 1)
        rows, columns = shape
        height, width = _patch(press) or shape
        if rows % height or columns % width:
            raise InputError(f"patches of {height} x {width} cells do not fill a skin of {rows} x {columns}")
        indices = np.arange(rows * columns).reshape(shape)
        corners = product(range(0, rows, height), range(0, columns, width))
        targets = (indices[row : row + height, column : column + width].ravel() for row, column in corners)
        return cls(shape, tuple(targets), tuple(steps))

    @staticmethod
    def check(press: str, loads_kpa: Sequence[float]) -> None:
        """InputError for words that fit no skin; arguments as for :meth:`make`."""
        if not loads_kpa or not all(0 < load < np.inf for load in loads_kpa):
            raise InputError("a calibration needs loads above 0 kPa")
        if len(loads_kpa) > MOST_STEPS:
            raise InputError(f"{len(loads_kpa)} loads; expected at most {MOST_STEPS}")
        _patch(press)

    def check_full_scale(self, full_scale_kpa: float) -> None:
        """InputError for a load that cells of this full scale could only feel with a gain that is not believed."""
        largest = max(self.loads_kpa)
        if largest > GAINS[1] * full_scale_kpa:
            raise InputError(
                f"a load of {largest:g} kPa; expected at most {GAINS[1]:g} times the full scale of the cells, "
                f"{full_scale_kpa:g} kPa: is it in Pa, the weight in g, or the area not in m^2?"
            )

    def name(self, target: int) -> str:
        """A target in words."""
        cells = self.targets[target]
        if len(cells) == self.shape[0] * self.shape[1]:
            return "all cells"
        first, last = (self.place(index) for index in (int(cells[0]), int(cells[-1])))
        return f"cell {first}" if first == last else f"cells {first} to {last}"

    def place(self, index: int) -> tuple[int, int]:
        """(row, column) of a cell."""
        return index // self.shape[1], index % self.shape[1]

    def pressed_target(self, load_kpa: FloatArray) -> int:
        """The target that bears the largest mean of the loads (cells,)."""
        order, first = self._in_order
        return int(np.argmax(np.add.reduceat(load_kpa[order], first)))

    def target_of_cell(self, index: int) -> int:
        """The target that a cell belongs to."""
        order, first = self._in_order
        place = int(np.flatnonzero(order == index)[0])
        return int(np.searchsorted(first, place, side="right")) - 1

    @property
    def _in_order(self) -> tuple[IntArray, IntArray]:
        """The cells of all targets one after the other, and the place of the first cell of each. All are as large."""
        size = len(self.targets[0])
        return np.concatenate(self.targets), np.arange(len(self.targets)) * size

    def outside(self, target: int) -> BoolArray:
        """(cells,) mask of the cells that the target leaves alone."""
        mask = np.ones(self.shape[0] * self.shape[1], dtype=np.bool_)
        mask[self.targets[target]] = False
        return mask


def _patch(press: str) -> tuple[int, int] | None:
    """(rows, columns) that bear a load together; None: all of the skin. InputError for other words."""
    if press == "all":
        return None
    patch = re.fullmatch(r"([1-9]\d{0,3})x([1-9]\d{0,3})", "1x1" if press == "each" else press)
    if patch is None:
        raise InputError(f"press '{press}'; expected each, all, or a patch such as 2x3 (rows x columns)")
    return int(patch[1]), int(patch[2])
