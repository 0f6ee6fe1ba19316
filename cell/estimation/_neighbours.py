"""Which cells of an array are near each other, as places in the block of those that are followed.

Noise may be common to the cells of a column, as on a divider whose idle rows are driven. The neighbours of a cell are
therefore in two groups that share no column: those in its own column and in every second one beside, and those in the
columns between.
"""

from __future__ import annotations

import numpy as np

from ...arrays import IntArray, spaced, spaced_columns, whole

REACH = 2
"""rows and columns to either side: a fingertip or a gripper's pad covers as much"""
_FAR = range(-REACH, REACH + 1)
_OFFSETS = sorted(((row, column) for row in _FAR for column in _FAR if row or column), key=lambda at: at[1] % 2)
NEAR = len(_OFFSETS)
"""neighbours of a cell that is nowhere near an edge"""
ALIKE = sum(column % 2 == 0 for _, column in _OFFSETS)
"""of these come first: in the cell's own column, and in every second one beside"""


class Neighbours:
    """Of the cells of an array."""

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
        """Places (NEAR, m) of the neighbours of ``cells`` (m,) among these, m for one that is not; the first ALIKE of
        each cell are in columns like its own.
        """
        if cells.size == self._cells:
            return self._near
        place = np.full(self._cells + 1, cells.size, dtype=np.intp)
        place[cells] = np.arange(cells.size)
        found: IntArray = place.take(whole(spaced_columns(self._near, cells)))
        return found[:, : cells.size]
