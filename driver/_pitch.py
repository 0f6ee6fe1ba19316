"""Pitch of the cells: the distances along a row and along a column, which differ where cells are not square."""

from __future__ import annotations

import math
from typing import NamedTuple

from ..common.checks import number
from ..errors import InputError


class Pitch(NamedTuple):
    """Distances from the middle of a cell to those of its neighbours, in m."""

    x_m: float
    """to the next cell of the row"""
    y_m: float
    """to the next cell of the column"""

    @classmethod
    def of(cls, pitch_m: float | tuple[float, float]) -> Pitch:
        """From one number for square cells, else from (x, y); InputError unless they are positive numbers."""
        pair = pitch_m if isinstance(pitch_m, tuple | list) else (pitch_m, pitch_m)
        if len(pair) != 2 or not all(0 < number("pitch", one, "m") < math.inf for one in pair):
            raise InputError(f"pitch is {pitch_m} m; expected more than 0, or two such numbers (x, y)")
        return cls(float(pair[0]), float(pair[1]))

    @property
    def mean_m(self) -> float:
        """Side of a square cell of the same area."""
        return math.sqrt(self.x_m * self.y_m)

    @property
    def area_m2(self) -> float:
        """Area of one cell."""
        return self.x_m * self.y_m
