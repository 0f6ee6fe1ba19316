"""Jumps of readings: contact sparks (intermittent electrical contacts) told from taps by what neighbouring cells do.

A reading that jumps from one frame to the next may be a tap, or a bad contact for a moment. One reading cannot tell
them apart while the jump lasts. An array can:

* Pressure spreads. The silicone shares a tap among cells side by side, so readings beside the jump move with it, in
  the direction of a load. A bad contact within one cell moves that cell alone.
* Other faults have the shape of the wiring. A bad line or connector moves whole lines; a crack moves the end of a line;
  a disturbance of the converter moves readings that are converted one after another, in one frame.

A jump is therefore a load where neighbours along both axes move with it; where a neighbour of it is one; or where a
neighbour along one axis moves with it for two frames, and no jump of that line is at its end. Nothing is concluded
of lines that have jumped as a whole, nor of jumps that no neighbour shares. Bad contacts add resistance: where loads
lower it, a fall that lasts for two frames is a load as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import BoolArray, FloatArray, IntArray

SHARED = 0.05
"""share of a jump by which a neighbour moves with it. Crosstalk by leads that nobody mentions is far less"""
CLEAR = 8.0
"""standard deviations of its reading by which a neighbour moves with a jump"""
TOGETHER_S = 0.02
"""time in which a fingertip comes down on all its cells: neighbours that move later tell nothing of a jump"""
IN_LINE_S = 0.005
"""the same of neighbours along one axis only. A frame more is always waited for"""
FRAMES = 2
"""in which such a neighbour must have moved: a disturbance of the converter is over in the next one"""
WHOLE = 0.85
"""share of a line's cells that have jumped from which the line itself may be bad"""
LEAST_LINE = 4
"""cells of a line that may be called whole: a fingertip covers shorter ones"""
_SOON = 1 + 1e-9


@dataclass
class Jumps:
    """Cells whose reading jumped a moment ago, with all that was remembered before it. Arrays (m,) unless it is said."""

    cells: IntArray
    age_s: FloatArray
    memory: FloatArray
    """(rows, m) before the jump"""
    line: FloatArray
    """(smoothing.ROWS, m) before the jump"""
    size: FloatArray
    """largest distance of the reading from that before the jump"""
    around: FloatArray
    """(4, m) readings of the :class:`Neighbours` before the jump; NaN where there is none"""
    shared: IntArray
    """frames in which a neighbour along one axis has moved with the jump"""
    load: BoolArray
    """whether the jump is known to be a load"""

    @classmethod
    def none(cls, memory: FloatArray, line: FloatArray) -> Jumps:
        """No jumps; ``memory`` and ``line`` have the rows of others."""
        none, no_cells = np.zeros(0), np.zeros(0, dtype=np.intp)
        empty = np.zeros((4, 0))
        return cls(no_cells, none, memory[:, :0], line[:, :0], none, empty, no_cells, np.zeros(0, dtype=np.bool_))

    def with_more(
        self, cells: IntArray, memory: FloatArray, line: FloatArray, size: FloatArray, around: FloatArray
    ) -> Jumps:
        """These jumps and those that have just begun."""
        new = cells.size
        return Jumps(
            np.concatenate([self.cells, cells]),
            np.concatenate([self.age_s, np.zeros(new)]),
            np.concatenate([self.memory, memory], axis=1),
            np.concatenate([self.line, line], axis=1),
            np.concatenate([self.size, size]),
            np.concatenate([self.around, around], axis=1),
            np.concatenate([self.shared, np.zeros(new, dtype=np.intp)]),
            np.concatenate([self.load, np.zeros(new, dtype=np.bool_)]),
        )

    def where(self, kept: BoolArray) -> Jumps:
        """The jumps marked by ``kept``."""
        return Jumps(
            self.cells[kept],
            self.age_s[kept],
            self.memory[:, kept],
            self.line[:, kept],
            self.size[kept],
            self.around[:, kept],
            self.shared[kept],
            self.load[kept],
        )


class Neighbours:
    """The cells above, below, left and right of each cell of an array."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        """Of a grid (rows, columns). Cells of an array with another number of axes have no neighbours."""
        cells = int(np.prod(shape))
        self._grid = len(shape) == 2
        self._shape = (shape[0], shape[1]) if self._grid else (1, cells)
        self._of = np.full((4, cells), cells, dtype=np.intp)  # a cell beyond the last one stands for none
        if self._grid:
            numbers = np.full((shape[0] + 2, shape[1] + 2), cells, dtype=np.intp)
            numbers[1:-1, 1:-1] = np.arange(cells).reshape(shape)
            sides = numbers[:-2, 1:-1], numbers[2:, 1:-1], numbers[1:-1, :-2], numbers[1:-1, 2:]
            self._of = np.array([side.ravel() for side in sides])

    def values(self, of_cells: FloatArray, cells: IntArray) -> FloatArray:
        """(4, m) what ``of_cells`` (n,) has for the neighbours of ``cells`` (m,); NaN where there is none."""
        return np.append(of_cells, np.nan)[self._of[:, cells]]

    def recognise_loads(
        self, jumps: Jumps, dt_s: float, side: float, reading: FloatArray, noise: FloatArray, level: FloatArray
    ) -> None:
        """Mark jumps that are known to be loads; changes ``jumps``.

        Args:
            jumps: those of this frame included.
            dt_s: since the last frame.
            side: 1 where a load raises the resistance, -1 where it lowers it.
            reading: (n,) normalised resistances of this frame.
            noise: (n,) their standard deviations.
            level: (m,) normalised resistances of the jumps' cells in this frame, over those before them.

        """
        young = ~jumps.load & (jumps.age_s <= max(TOGETHER_S, dt_s) * _SOON)
        if not np.count_nonzero(young):
            return
        lasts = np.abs(level) > 0.5 * np.abs(jumps.size)
        young &= lasts & (jumps.size * side > 0)
        moved = (self.values(reading, jumps.cells) - jumps.around) * side
        least = np.maximum(SHARED * np.abs(jumps.size), CLEAR * self.values(noise, jumps.cells))
        with_it = moved > least  # False where there is no neighbour
        along_columns, along_rows = with_it[0] | with_it[1], with_it[2] | with_it[3]
        soon = jumps.age_s <= max(IN_LINE_S, dt_s) * _SOON
        told = along_columns | along_rows | (side < 0)
        jumps.shared += lasts & soon & told
        whole, at_end = self._lines(jumps, along_columns)
        young &= ~whole
        jumps.load |= young & along_columns & along_rows
        jumps.load |= young & (jumps.shared >= FRAMES) & ~at_end
        for _ in range(2):  # a fingertip is no wider; on the next frame come further cells
            loads = np.zeros(self._of.shape[1])
            loads[jumps.cells[jumps.load]] = 1.0
            jumps.load |= young & ((self.values(loads, jumps.cells) > 0) & with_it).any(axis=0)

    def _lines(self, jumps: Jumps, along_columns: BoolArray) -> tuple[BoolArray, BoolArray]:
        """(m,) jumps in a line that has jumped as a whole; and those in a line of whose jumps one is at its end.

        ``along_columns`` (m,) marks jumps whose neighbour in the column has moved: their column counts, else their row.
        """
        rows, columns = self._shape
        row, column = np.divmod(jumps.cells, columns)
        in_row, in_column = np.bincount(row, minlength=rows), np.bincount(column, minlength=columns)
        whole = (in_row[row] >= WHOLE * columns) & (columns >= LEAST_LINE)
        whole |= (in_column[column] >= WHOLE * rows) & (rows >= LEAST_LINE)
        ends_row, ends_column = np.zeros(rows, dtype=np.bool_), np.zeros(columns, dtype=np.bool_)
        ends_row[row[(column == 0) | (column == columns - 1)]] = True
        ends_column[column[(row == 0) | (row == rows - 1)]] = True
        return whole, np.where(along_columns, ends_column[column], ends_row[row])
