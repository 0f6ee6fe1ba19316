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
from . import _smoothing as smoothing
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
    """Which of the k recent jumps are known to be loads. Arrays (k,) unless stated otherwise."""

    def __init__(self, inversion: Inversion, shape: tuple[int, ...]) -> None:
        """``shape`` is (rows, columns). Cells of an array with another number of axes have no neighbours."""
        self._inversion = inversion
        self._grid = len(shape) == 2
        cells = math.prod(shape)
        self._shape = (shape[0], shape[1]) if self._grid else (1, cells)
        self._neighbours = np.full((4, cells), cells, dtype=np.intp)
        """(4, n) indices of the cells above, below, left and right of each cell; n where there is none"""
        if self._grid:
            padded = np.full((shape[0] + 2, shape[1] + 2), cells, dtype=np.intp)
            padded[1:-1, 1:-1] = np.arange(cells).reshape(shape)
            sides = padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]
            self._neighbours = np.array([side.ravel() for side in sides])
        self._before = np.zeros(cells)
        """(n,) readings before the jumps that may still belong to one tap"""
        self.forget_all()

    def forget_all(self) -> None:
        """Begin without any jump."""
        self.known = np.zeros(0, dtype=np.bool_)
        """whether the jump is known to be a load"""
        self._places = np.zeros((4, 0), dtype=np.intp)
        """(4, k) indices of the cells around the jumps; n where there is none"""
        self._around = np.zeros((4, 0))
        self._frames = np.zeros(0, dtype=np.intp)

    def add(self, cells: IntArray, before: FloatArray, *, anew: bool) -> None:
        """Take jumps that have just begun.

        Args:
            cells: (m,) cells that have jumped.
            before: (n,) readings of all cells before these jumps.
            anew: True if no other jump is recent enough to belong to the same tap.
        """
        if anew:
            self._before = before
        self.known = np.append(self.known, np.zeros(cells.size, dtype=np.bool_))
        places = self._neighbours.take(cells, axis=1)
        self._places = np.append(self._places, places, axis=1)
        self._around = np.append(self._around, _beside(before, places), axis=1)
        self._frames = np.append(self._frames, np.zeros(cells.size, dtype=np.intp))

    def keep(self, kept: BoolArray) -> None:
        """Forget the jumps that are not marked by ``kept``."""
        self.known, self._frames = self.known[kept], self._frames[kept]
        self._places, self._around = self._places.compress(kept, axis=1), self._around.compress(kept, axis=1)

    def look(
        self,
        cells: IntArray,
        age_s: FloatArray,
        jump: FloatArray,
        off: FloatArray,
        dt_s: float,
        reading: FloatArray,
        noise_at_rest: FloatArray,
    ) -> None:
        """Classify the jumps; called in every frame in which there are any.

        Args:
            cells: (k,) cells that have jumped.
            age_s: (k,) seconds since the jump.
            jump: (k,) largest distance of r from its value before the jump.
            off: (k,) present distance.
            dt_s: seconds since the last frame.
            reading: (n,) normalised resistances r of all cells.
            noise_at_rest: (n,) standard deviations of readings of cells at rest.
        """
        young = ~self.known & (age_s <= max(TOGETHER_S, dt_s) * _SOON)
        if not np.count_nonzero(young):
            return
        side = self._inversion.side
        noise = smoothing.noise_of(reading[np.newaxis], noise_at_rest)  # of lines that end in the readings
        young &= (np.abs(off) > LASTS * np.abs(jump)) & (jump * side > 0)
        ends = None
        if self._grid:
            whole, *ends = self._lines(cells, reading[cells] - off, jump, reading, noise)
            young &= ~whole
        some = young.nonzero()[0]
        if not some.size:
            return
        places, size = self._places.take(some, axis=1), np.abs(jump[some])
        moved = (_beside(reading, places) - self._around.take(some, axis=1)) * side
        beside = _beside(noise, places)
        with_it = moved > np.maximum(SHARED * size, CLEAR * beside)  # False where there is none
        along_column, along_row = with_it[0] | with_it[1], with_it[2] | with_it[3]
        jointly = moved > np.maximum(SHARED * size, JOINTLY * self._unrest(reading, noise) * beside)
        spread = (jointly[0] | jointly[1]) & (jointly[2] | jointly[3])
        soon = age_s[some] <= max(IN_LINE_S, dt_s) * _SOON
        self._frames[some] += soon & (along_column | along_row | (side < 0))
        lasted = self._frames[some] >= FRAMES
        if ends is not None:
            lasted &= ~np.where(along_column, ends[0][some], ends[1][some])
        self.known[some] = spread | lasted
        for _ in range(2):  # spreads by two cells, about the width of a fingertip; others follow in the next frame
            loads = np.zeros(reading.size)
            loads[cells[self.known]] = 1.0
            self.known[some] |= ((_beside(loads, places) > 0) & with_it).any(axis=0)

    def _unrest(self, reading: FloatArray, noise: FloatArray) -> float:
        """Robust scatter of the changes (n,) since the jump over the noise (n,), at least 1; of :data:`ENOUGH` cells.

        A finger moves fewer than half of the cells, so that a median-based scatter is that of cells without a load. A
        large scatter means that the noise has just grown, or that the whole skin moves.
        """
        some = slice(None, None, 1 + reading.size // ENOUGH)
        return max(scatter((reading[some] - self._before[some]) / np.maximum(noise[some], TINY)), 1.0)

    def _lines(
        self, cells: IntArray, before: FloatArray, jump: FloatArray, reading: FloatArray, noise: FloatArray
    ) -> tuple[BoolArray, BoolArray, BoolArray]:
        """Movement of the lines of ``cells`` (m,), whose readings jumped from ``before`` (m,) by ``jump`` (m,).

        ``reading`` (n,) are the readings of all cells, ``noise`` (n,) their standard deviation.

        Returns:
            Masks (m,): the row or column of a cell has moved as a whole; an end of its column has moved; an end of its
            row has moved.

        """
        rows, columns = self._shape
        row, column = np.divmod(cells, columns)
        pressure = self._inversion.held_kpa
        moved = ((reading - self._before) * self._inversion.side > SEEN * noise).nonzero()[0]
        rise = np.zeros(reading.size)
        rise[moved] = pressure(reading[moved]) - pressure(self._before[moved])
        rises = rise.reshape(rows, columns)
        least = EVEN * (pressure(before + jump) - pressure(before))
        whole = np.zeros(cells.size, dtype=np.bool_)
        ends = []
        for line, number in ((rises, row), (rises.T, column)):
            length = line.shape[1]
            if length >= LEAST_LINE:
                # WHOLE of the cells have moved if the smallest of that many largest rises exceeds the limit.
                place = length - math.ceil(WHOLE * length)
                whole |= np.partition(line, place, axis=1)[:, place][number] > least
            ends.append(np.maximum(line[:, 0], line[:, -1])[number] > least)
        return whole, ends[1], ends[0]


def _beside(values: FloatArray, places: IntArray) -> FloatArray:
    """(4, m) ``values`` (n,) at ``places`` (4, m); NaN at index n."""
    padded = np.empty(values.size + 1)
    padded[:-1], padded[-1] = values, np.nan
    return padded.take(places, mode="clip")  # takes half as long as a test whether there are such places
