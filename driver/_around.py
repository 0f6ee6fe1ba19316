"""Filters over the 3 x 3 cells around each cell: separable maximum and weighted sums, by shifted slices.

``scipy.ndimage`` gives the same numbers. On arrays of some hundred cells its calls take longer than the arithmetic, and
contacts need several of these filters in every frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..common.arrays import BoolArray, FloatArray

ACROSS = 0.5
"""weight of a neighbour along a row or a column beside that of the cell itself; at a corner its square"""


class Sums(NamedTuple):
    """Weighted sums (rows, columns) of cells and their neighbours; places beyond the rim count as 0."""

    whole: FloatArray
    """of all nine cells"""
    other_rows: FloatArray
    """of the six cells in the rows above and below"""
    other_columns: FloatArray
    """of the six cells in the columns to the left and right"""


def highest_around(values: FloatArray) -> FloatArray:
    """(rows, columns) the largest value among each cell and the up to eight cells around it."""
    rows, columns = values.shape
    padded = np.full((rows + 2, columns + 2), -np.inf)
    padded[1:-1, 1:-1] = values
    along = np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:])
    return np.maximum(np.maximum(along[:, :-2], along[:, 1:-1]), along[:, 2:])


def sums_around(values: FloatArray) -> Sums:
    """Sums with weights like a fingertip's bell: 1 in the middle, :data:`ACROSS` beside it, its square at corners."""
    rows, columns = values.shape
    padded = np.zeros((rows + 2, columns + 2))
    padded[1:-1, 1:-1] = values
    along_row = padded[:, 1:-1] + ACROSS * (padded[:, :-2] + padded[:, 2:])
    along_column = padded[1:-1] + ACROSS * (padded[:-2] + padded[2:])
    other_rows = ACROSS * (along_row[:-2] + along_row[2:])
    other_columns = ACROSS * (along_column[:, :-2] + along_column[:, 2:])
    return Sums(along_row[1:-1] + other_rows, other_rows, other_columns)


def with_direct_neighbours(cells: BoolArray) -> BoolArray:
    """(rows, columns) these cells and those above, below, left and right of them."""
    wider = cells.copy()
    wider[1:] |= cells[:-1]
    wider[:-1] |= cells[1:]
    wider[:, 1:] |= cells[:, :-1]
    wider[:, :-1] |= cells[:, 1:]
    return wider


def with_all_neighbours(cells: BoolArray) -> BoolArray:
    """(rows, columns) these cells and the up to eight cells around each."""
    along = cells.copy()
    along[1:] |= cells[:-1]
    along[:-1] |= cells[1:]
    wider = along.copy()
    wider[:, 1:] |= along[:, :-1]
    wider[:, :-1] |= along[:, 1:]
    return wider
