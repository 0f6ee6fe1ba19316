"""Plan of a calibration: groups of cells (targets) that are pressed together, the loads, and their order."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..errors import InputError
from ._tuning import GAINS, LEAST_PRESSES

MOST_STEPS = 100


@dataclass(frozen=True, slots=True)
class Plan:
    """All targets are pressed in turn with the load of the first step, then with that of the second, and so on."""

    shape: tuple[int, int]
    targets: tuple[IntArray, ...]
    """groups of cells that are pressed together, as sorted indices into the flattened array"""
    loads_kpa: tuple[float, ...]
    """mean pressure in each step"""

    @classmethod
    def make(cls, shape: tuple[int, int], press: str, loads_kpa: Sequence[float]) -> Plan:
        """A plan from the options of the command line.

        Args:
            shape: (rows, columns) of the skin.
            press: "each" cell by itself, "all" together under a plate, or "RxC": patches of R rows and C columns.
            loads_kpa: mean pressure on each cell in each step. A single load is pressed twice.

        Raises:
            InputError: there is no load, or one is not positive; ``press`` is unknown or does not fit the skin.

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
        """Raise InputError for options that are invalid for any skin; arguments as for :meth:`make`."""
        if not loads_kpa or not all(0 < load < np.inf for load in loads_kpa):
            raise InputError("a calibration needs loads above 0 kPa")
        if len(loads_kpa) > MOST_STEPS:
            raise InputError(f"{len(loads_kpa)} loads; expected at most {MOST_STEPS}")
        _patch(press)

    def check_full_scale(self, full_scale_kpa: float) -> None:
        """Raise InputError for a load so large that it needs a gain outside :data:`GAINS` at this full scale."""
        largest = max(self.loads_kpa)
        if largest > GAINS[1] * full_scale_kpa:
            raise InputError(
                f"a load of {largest:g} kPa; expected at most {GAINS[1]:g} times the full scale of the cells, "
                f"{full_scale_kpa:g} kPa: is it in Pa, the weight in g, or the area not in m^2?"
            )

    def name(self, target: int) -> str:
        """Name of a target for messages."""
        cells = self.targets[target]
        if len(cells) == self.shape[0] * self.shape[1]:
            return "all cells"
        first, last = (self.place(index) for index in (int(cells[0]), int(cells[-1])))
        return f"cell {first}" if first == last else f"cells {first} to {last}"

    def place(self, index: int) -> tuple[int, int]:
        """(row, column) of a cell."""
        return index // self.shape[1], index % self.shape[1]

    def pressed_target(self, load_kpa: FloatArray) -> int:
        """The target with the largest mean of the loads (cells,)."""
        order, first = self._in_order
        return int(np.argmax(np.add.reduceat(load_kpa[order], first)))

    def target_of_cell(self, index: int) -> int:
        """The target that a cell belongs to."""
        order, first = self._in_order
        place = int(np.flatnonzero(order == index)[0])
        return int(np.searchsorted(first, place, side="right")) - 1

    @property
    def _in_order(self) -> tuple[IntArray, IntArray]:
        """The cells of all targets in sequence, and the index of each target's first cell. Targets have equal sizes."""
        size = len(self.targets[0])
        return np.concatenate(self.targets), np.arange(len(self.targets)) * size

    def outside(self, target: int) -> BoolArray:
        """(cells,) mask of the cells outside a target."""
        mask = np.ones(self.shape[0] * self.shape[1], dtype=np.bool_)
        mask[self.targets[target]] = False
        return mask


def _patch(press: str) -> tuple[int, int] | None:
    """(rows, columns) of a patch; None: the whole skin. InputError for an unknown ``press``."""
    if press == "all":
        return None
    patch = re.fullmatch(r"([1-9]\d{0,3})x([1-9]\d{0,3})", "1x1" if press == "each" else press)
    if patch is None:
        raise InputError(f"press '{press}'; expected each, all, or a patch such as 2x3 (rows x columns)")
    return int(patch[1]), int(patch[2])
