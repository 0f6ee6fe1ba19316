"""Jumps of readings: contact sparks (intermittent electrical contacts) told from taps by what neighbouring cells do.

A reading that jumps from one frame to the next may be a tap, or a bad contact for a moment. One reading cannot tell
them apart while the jump lasts. An array can:

* Pressure spreads. The silicone shares a tap among cells side by side, so readings beside the jump move with it, in
  the direction of a load. A bad contact within one cell moves that cell alone.
* Other faults have the shape of the wiring. A bad line or connector moves whole lines; a crack moves the end of a line;
  a disturbance of the converter moves readings that are converted one after another, in one frame.

A jump is therefore a load where neighbours along both axes move with it; where a neighbour of it is one; or where a
neighbour along one axis moves with it for two frames, and the ends of that line have not moved as much. Nothing is
concluded of lines that have moved as a whole, nor of jumps that no neighbour shares. Bad contacts add resistance: where
loads lower it, a fall that lasts for two frames is a load as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import BoolArray, FloatArray, IntArray
from ._smoothing import LEVEL

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
WHOLE, EVEN, SEEN = 0.85, 0.3, 3.0
"""share of a line's cells that have moved from which the line itself may be bad; share of a jump, and standard
deviations of its reading, by which a cell has then moved, since a bad line moves its cells alike"""
LEAST_LINE = 4
"""cells of a line that may be called whole: a fingertip covers shorter ones"""
_SOON = 1 + 1e-9


@dataclass
class Jumps:
    """Cells whose reading jumped a moment ago, with all that was remembered before it. Arrays (m,) unless stated."""

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
        self, jumps: Jumps, dt_s: float, side: float, reading: FloatArray, noise: FloatArray, levels: FloatArray
    ) -> None:
        """Mark jumps that are known to be loads; changes ``jumps``.

        Args:
            jumps: those of this frame included.
            dt_s: since the last frame.
            side: 1 where a load raises the resistance, -1 where it lowers it.
            reading: (n,) normalised resistances of this frame.
            noise: (n,) their standard deviations.
            levels: (n,) normalised resistances before the newest jumps.

        """
        young = ~jumps.load & (jumps.age_s <= max(TOGETHER_S, dt_s) * _SOON)
        if not np.count_nonzero(young):
            return
        cells, size = jumps.cells, np.abs(jumps.size)
        lasts = np.abs(reading[cells] - jumps.line[LEVEL]) > 0.5 * size
        young &= lasts & (jumps.size * side > 0)
        moved = (self.values(reading, cells) - jumps.around) * side
        with_it = moved > np.maximum(SHARED * size, CLEAR * self.values(noise, cells))  # False where there is none
        along_column, along_row = with_it[0] | with_it[1], with_it[2] | with_it[3]
        soon = jumps.age_s <= max(IN_LINE_S, dt_s) * _SOON
        jumps.shared += lasts & soon & (along_column | along_row | (side < 0))
        if self._grid:
            whole, ends_column, ends_row = self._lines(cells, size, (reading - levels) * side, noise)
            young &= ~whole
            at_end = np.where(along_column, ends_column, ends_row)
        else:
            at_end = np.zeros(cells.size, dtype=np.bool_)
        jumps.load |= young & along_column & along_row
        jumps.load |= young & (jumps.shared >= FRAMES) & ~at_end
        for _ in range(2):  # a fingertip is hardly wider; further cells follow in the next frame
            loads = np.zeros(reading.size)
            loads[cells[jumps.load]] = 1.0
            jumps.load |= young & ((self.values(loads, cells) > 0) & with_it).any(axis=0)

    def _lines(
        self, cells: IntArray, size: FloatArray, moved: FloatArray, noise: FloatArray
    ) -> tuple[BoolArray, BoolArray, BoolArray]:
        """What the lines of ``cells`` (m,) have done, whose readings jumped by ``size`` (m,).

        ``moved`` (n,) is how far the readings have moved as a load moves them, ``noise`` (n,) their standard deviation.

        Returns:
            (m,) cells whose row or column has moved as a whole; cells whose column has moved at an end; whose row has.

        """
        rows, columns = self._shape
        row, column = np.divmod(cells, columns)
        seen = np.where(moved > SEEN * noise, moved, 0.0).reshape(rows, columns)
        least = EVEN * size[:, None]
        in_row, in_column = seen[row] > least, seen.T[column] > least
        whole = np.zeros(cells.size, dtype=np.bool_)
        for line, length in ((in_row, columns), (in_column, rows)):
            if length >= LEAST_LINE:
                whole |= np.count_nonzero(line, axis=1) >= WHOLE * length
        return whole, in_column[:, 0] | in_column[:, -1], in_row[:, 0] | in_row[:, -1]
