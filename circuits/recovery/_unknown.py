"""Masks of unknown cells: those whose readings bound their conductance on one side only."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray

_MOST_GROUPS = 3  # groups of unknown cells that move one after another


class Unknown(NamedTuple):
    """Masks (N, M) of cells whose recovered conductance is only a lower or only an upper bound."""

    at_least: BoolArray
    at_most: BoolArray

    @property
    def any(self) -> BoolArray:
        return self.at_least | self.at_most

    def groups(self) -> list[Unknown]:
        """Split the unknown cells by lines and by kind of bound.

        The split is by rows or by columns, whichever of the two has fewer lines with unknown cells.
        """
        rows, columns = (np.flatnonzero(self.any.any(axis=axis)) for axis in (1, 0))
        by_row = len(rows) <= len(columns)
        parts = []
        for some in np.array_split(rows if by_row else columns, min(_MOST_GROUPS, len(rows), len(columns))):
            inside = np.zeros_like(self.at_least)
            inside[(some, slice(None)) if by_row else (slice(None), some)] = True
            parts += [one for one in (self._of(inside, True), self._of(inside, False)) if one.any.any()]
        return parts

    def _of(self, inside: BoolArray, up: bool) -> Unknown:
        nowhere = np.zeros_like(inside)
        return Unknown(self.at_least & inside if up else nowhere, nowhere if up else self.at_most & inside)

    def moved(self, conductance: FloatArray, times: float, most: FloatArray) -> FloatArray:
        """Conductances in S (N, M) with the unknown cells moved by the factor ``times``.

        Args:
            conductance: S (N, M), as recovered.
            times: factor above a lower bound, and divisor below an upper bound.
            most: S (N, M), largest conductance of each cell.

        """
        ordinary = np.median(conductance[conductance > 0]) if (conductance > 0).any() else np.min(most)
        up = np.minimum(np.maximum(conductance, ordinary) * times, np.maximum(conductance, most))
        return np.where(self.at_least, up, np.where(self.at_most, conductance / times, conductance))
