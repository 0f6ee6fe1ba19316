"""Neighbours of each cell of an array, as indices into the block of followed cells.

Noise may be common to the cells of a column, as on a divider whose idle rows are driven. The neighbours of a cell
therefore form two groups that share no column: cells in its own column and every second column beside it, and cells in
the columns between these.
"""

from __future__ import annotations

import numpy as np

from ...common.arrays import IntArray, spaced, spaced_columns, whole

REACH = 2
"""rows and columns to either side; a fingertip or a gripper's pad covers about as many"""
_FAR = range(-REACH, REACH + 1)
_OFFSETS = sorted(((row, column) for row in _FAR for column in _FAR if row or column), key=lambda at: at[1] % 2)
NEAR = len(_OFFSETS)
"""number of neighbours of a cell far from the edges"""
ALIKE = sum(column % 2 == 0 for _, column in _OFFSETS)
"""number of neighbours in the cell's own column and every second column beside it; they come first"""


class Neighbours:
    """The neighbours of the cells of an array, up to :data:`REACH` rows and columns away."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        """``shape`` is (rows, columns). Cells of an array with another number of axes have no neighbours."""
        self._cells = int(np.prod(shape))
        self._near = np.full((NEAR, self._cells), self._cells, dtype=np.intp)
        if len(shape) == 2:
            padded = np.full((shape[0] + 2 * REACH, shape[1] + 2 * REACH), self._cells, dtype=np.intp)
            padded[REACH:-REACH, REACH:-REACH] = np.arange(self._cells).reshape(shape)
            for near, (row, column) in zip(self._near, _OFFSETS, strict=True):
                rows = slice(REACH + row, REACH + row + shape[0])
                near[:] = padded[rows, REACH + column : REACH + column + shape[1]].ravel()
        self._near = spaced(self._near)

    def among(self, cells: IntArray) -> IntArray:
        """Places (NEAR, m) of the neighbours of ``cells`` (m,) within ``cells``; m where a neighbour is not in there.

        The first :data:`ALIKE` rows are neighbours in the cell's own column and every second column beside it.
        """
        if cells.size == self._cells:
            return self._near
        place = np.full(self._cells + 1, cells.size, dtype=np.intp)
        place[cells] = np.arange(cells.size)
        found: IntArray = place.take(whole(spaced_columns(self._near, cells)))
        return found[:, : cells.size]
