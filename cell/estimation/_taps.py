"""Classification of jumps as taps or intermittent contacts ("sparks"), by the readings of neighbouring cells.

A reading that jumps from one frame to the next may be a tap, or a momentary bad contact. A single reading cannot
distinguish the two while the jump lasts. An array can:

* Pressure spreads. The silicone distributes a tap over adjacent cells, so that readings beside the jump move with it,
  in the direction of a load. A bad contact within one cell moves that cell alone.
* Other faults have the shape of the wiring. A bad line or connector moves whole lines. A crack moves the end of a line.
  A disturbance of the converter moves readings that are converted one after another, in one frame.

A jump is therefore a load in three cases: neighbours along both axes move with it; a neighbour that moves with it is a
load; or a neighbour along one axis moves with it for two frames, and the ends of that line have not moved as much.
Lines that have moved as a whole, and jumps that no neighbour shares, stay undecided. Bad contacts add resistance: where
loads lower it, a fall that lasts for two frames is a load as well.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray, scatter
from ...common.compiled import Records
from .._state import CellState
from ._inversion import Inversion
from ._noise import ENOUGH

SHARED = 0.05
"""fraction of a jump beyond which a neighbour counts as moving with it. Crosstalk by unmodelled lead resistance is far
less"""
CLEAR = 8.0
"""standard deviations of its reading beyond which a neighbour counts as moving with a jump"""
JOINTLY = 4.0
"""the same if neighbours along both axes move: fewer suffice, since noise hardly moves two cells at once"""
TOGETHER_S = 0.02
"""seconds in which a fingertip comes down on all its cells; neighbours that move later are no evidence about a jump"""
IN_LINE_S = 0.005
"""the same for neighbours along one axis only; the following frame counts in any case"""
FRAMES = 2
"""number of frames in which such a neighbour must have moved; a disturbance of the converter lasts for one frame"""
LASTS = 0.5
"""fraction of a jump that must remain for the jump to be under way"""
WHOLE, EVEN, SEEN = 0.85, 0.3, 3.0
"""limits for bad lines. A line may be bad if the first fraction of its cells has moved. A cell has moved if it exceeds
the second fraction of the jump's pressure (a bad line moves its cells alike), and the third number of standard
deviations of its reading. Pressure is compared, and not r: r of touching electrodes is nearly -1 from a light load on,
in the middle and at the rim of a finger alike"""
LEAST_LINE = 4
"""least number of cells of a line that may count as bad; a fingertip covers shorter lines as a whole"""
TINY = 1e-30
"""avoids 0/0"""
_SOON = 1 + 1e-9


class Taps:
    """Tells which recent jumps are loads: sets ``jump_is_load`` of cells."""

    def __init__(self, inversion: Inversion, shape: tuple[int, ...]) -> None:
        """``shape`` is (rows, columns). Cells of an array with another number of axes have no neighbours."""
        self._inversion, self._grid = inversion, len(shape) == 2
        self._shape = (shape[0], shape[1]) if self._grid else (1, math.prod(shape))
        self.before = np.zeros(math.prod(shape))
        """(n,) readings before the jumps that may still belong to one tap"""

    def look(
        self, cells: Records[CellState], jumps: IntArray, dt_s: float, reading: FloatArray, at_rest: FloatArray
    ) -> None:
        """Classify the ``jumps`` (k,), in every frame in which there are any; changes ``cells`` (n,).

        ``reading`` (n,) are the normalised resistances, ``dt_s`` after the last ones; ``at_rest`` (n,) is their noise.
        """
        side, age_s = self._inversion.side, cells["jump_s"]
        noise = (1.0 + reading) ** 2 * at_rest
        young = (cells["jump_is_load"][jumps] == 0.0) & (age_s[jumps] <= max(TOGETHER_S, dt_s) * _SOON)
        off, jump = (reading - self.before)[jumps], cells["jump"][jumps]
        some = jumps[young & (np.abs(off) > LASTS * np.abs(jump)) & (jump * side > 0)]
        if not some.size:
            return
        ends = np.zeros((2, some.size), dtype=np.bool_)
        if self._grid:
            whole, *ends = self._lines(some, cells["jump"][some], reading, noise)
            some, ends = some[~whole], np.array(ends)[:, ~whole]
        size, moved = np.abs(cells["jump"][some]), self._beside((reading - self.before) * side, some)
        beside = self._beside(noise, some)
        with_it = moved > np.maximum(SHARED * size, CLEAR * beside)  # False where there is none
        along_column, along_row = with_it[0] | with_it[1], with_it[2] | with_it[3]
        jointly = moved > np.maximum(SHARED * size, JOINTLY * self._unrest(reading, noise) * beside)
        spread = (jointly[0] | jointly[1]) & (jointly[2] | jointly[3])
        soon = age_s[some] <= max(IN_LINE_S, dt_s) * _SOON
        cells["jump_frames"][some] += soon & (along_column | along_row | (side < 0))
        lasted = (cells["jump_frames"][some] >= FRAMES) & ~np.where(along_column, *ends)
        cells["jump_is_load"][some] = spread | lasted
        for _ in range(2):  # spreads by two cells, about the width of a fingertip; others follow in the next frame
            loads = np.zeros(reading.size)
            loads[jumps] = cells["jump_is_load"][jumps]
            cells["jump_is_load"][some[((self._beside(loads, some) > 0) & with_it).any(axis=0)]] = 1.0

    def _beside(self, values: FloatArray, places: IntArray) -> FloatArray:
        """(4, k) ``values`` (n,) of the cells above, below, left and right; NaN where there is none."""
        if not self._grid:
            return np.full((4, places.size), np.nan)
        padded = np.pad(values.reshape(self._shape), 1, constant_values=np.nan)
        row, column = np.divmod(places, self._shape[1])
        around = ((row, column + 1), (row + 2, column + 1), (row + 1, column), (row + 1, column + 2))
        return np.array([padded[place] for place in around])

    def _unrest(self, reading: FloatArray, noise: FloatArray) -> float:
        """Robust scatter of the changes (n,) since the jump over the noise (n,), at least 1; of :data:`ENOUGH` cells.

        A finger moves fewer than half of the cells, so that a median-based scatter is that of cells without a load. A
        large scatter means that the noise has just grown, or that the whole skin moves.
        """
        some = slice(None, None, 1 + reading.size // ENOUGH)
        return max(scatter((reading[some] - self.before[some]) / np.maximum(noise[some], TINY)), 1.0)

    def _lines(
        self, places: IntArray, jump: FloatArray, reading: FloatArray, noise: FloatArray
    ) -> tuple[BoolArray, BoolArray, BoolArray]:
        """Movement of the lines of cells whose readings jumped by ``jump`` (k,), among all ``reading`` (n,).

        Returns:
            Masks (k,): the row or column of a cell has moved as a whole; an end of its column has moved; an end of its
            row has moved.
        """
        row, column = np.divmod(places, self._shape[1])
        pressure, before = self._inversion.held_kpa, self.before[places]
        moved = ((reading - self.before) * self._inversion.side > SEEN * noise).nonzero()[0]
        rise = np.zeros(reading.size)
        rise[moved] = pressure(reading[moved]) - pressure(self.before[moved])
        rises = rise.reshape(self._shape)
        least = EVEN * (pressure(before + jump) - pressure(before))
        whole = np.zeros(places.size, dtype=np.bool_)
        ends = []
        for line, number in ((rises, row), (rises.T, column)):
            length = line.shape[1]
            if length >= LEAST_LINE:
                # WHOLE of the cells have moved if the smallest of that many largest rises exceeds the limit.
                place = length - math.ceil(WHOLE * length)
                whole |= np.partition(line, place, axis=1)[:, place][number] > least
            ends.append(np.maximum(line[:, 0], line[:, -1])[number] > least)
        return whole, ends[1], ends[0]
