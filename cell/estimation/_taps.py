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

import math

import numpy as np

from ...arrays import BoolArray, FloatArray, IntArray, scatter
from . import _smoothing as smoothing
from ._inversion import Inversion
from ._noise import ENOUGH

SHARED = 0.05
"""share of a jump by which a neighbour moves with it. Crosstalk by leads that nobody mentions is far less"""
CLEAR = 8.0
"""standard deviations of its reading by which a neighbour moves with a jump"""
JOINTLY = 4.0
"""the same where neighbours along both axes move: fewer suffice, since noise hardly moves two cells at once"""
TOGETHER_S = 0.02
"""time in which a fingertip comes down on all its cells: neighbours that move later tell nothing of a jump"""
IN_LINE_S = 0.005
"""the same of neighbours along one axis only. A frame more is always waited for"""
FRAMES = 2
"""in which such a neighbour must have moved: a disturbance of the converter is over in the next one"""
LASTS = 0.5
"""share of a jump that must be left for it to be under way"""
WHOLE, EVEN, SEEN = 0.85, 0.3, 3.0
"""share of a line's cells that have moved from which the line itself may be bad; share of a jump's pressure, and
standard deviations of its reading, by which a cell has then moved, since a bad line moves its cells alike. Not share of
r: that of electrodes which touch is nearly -1 from a light load on, in the middle and at the rim of a finger alike"""
LEAST_LINE = 4
"""cells of a line that may be called whole: a fingertip covers shorter ones"""
TINY = 1e-30
"""keeps 0/0 from occurring"""
_SOON = 1 + 1e-9


class Taps:
    """Which of the jumps that may be sparks are known to be loads. Arrays are of the k jumps of the last moment."""

    def __init__(self, inversion: Inversion, shape: tuple[int, ...]) -> None:
        """``shape`` is (rows, columns). Cells of an array with another number of axes have no neighbours."""
        self._inversion = inversion
        self._grid = len(shape) == 2
        cells = math.prod(shape)
        self._shape = (shape[0], shape[1]) if self._grid else (1, cells)
        self._neighbours = np.full((4, cells), cells, dtype=np.intp)
        """(4, n) cells above, below, left and right of each cell; beyond the last cell where there is none"""
        if self._grid:
            padded = np.full((shape[0] + 2, shape[1] + 2), cells, dtype=np.intp)
            padded[1:-1, 1:-1] = np.arange(cells).reshape(shape)
            sides = padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]
            self._neighbours = np.array([side.ravel() for side in sides])
        self._before = np.zeros(cells)
        """(n,) readings before the jumps that may still turn out to be one tap"""
        self.forget_all()

    def forget_all(self) -> None:
        """Begin without any jump."""
        self.known = np.zeros(0, dtype=np.bool_)
        """whether the jump is known to be a load"""
        self._places = np.zeros((4, 0), dtype=np.intp)
        """of the cells around the jumps; as many as there are cells where there is none"""
        self._around = np.zeros((4, 0))
        self._frames = np.zeros(0, dtype=np.intp)

    def add(self, cells: IntArray, before: FloatArray, *, anew: bool) -> None:
        """Take jumps that have just begun.

        Args:
            cells: (m,) that have jumped.
            before: (n,) readings of all cells before these jumps.
            anew: whether no other jump is so young that it may belong to the same tap.
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
        """Find out which jumps are loads, in every frame in which there are any.

        Args:
            cells: that have jumped.
            age_s: since they have.
            jump: largest distance of r from that before the jump.
            off: present distance.
            dt_s: since the last frame.
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
        for _ in range(2):  # a fingertip is hardly wider; further cells follow in the next frame
            loads = np.zeros(reading.size)
            loads[cells[self.known]] = 1.0
            self.known[some] |= ((_beside(loads, places) > 0) & with_it).any(axis=0)

    def _unrest(self, reading: FloatArray, noise: FloatArray) -> float:
        """Scatter of the readings (n,) since the jump over their noise (n,), at least 1; of :data:`ENOUGH` of them.

        A finger moves fewer than half of the cells, so the median is that of cells without a load. Where it is large,
        the noise has just grown, or the whole skin moves.
        """
        some = slice(None, None, 1 + reading.size // ENOUGH)
        return max(scatter((reading[some] - self._before[some]) / np.maximum(noise[some], TINY)), 1.0)

    def _lines(
        self, cells: IntArray, before: FloatArray, jump: FloatArray, reading: FloatArray, noise: FloatArray
    ) -> tuple[BoolArray, BoolArray, BoolArray]:
        """What the lines of ``cells`` (m,) have done, whose readings jumped from ``before`` (m,) by ``jump`` (m,).

        ``reading`` (n,) is that of all cells, ``noise`` (n,) their standard deviation.

        Returns:
            (m,) cells whose row or column has moved as a whole; cells whose column has moved at an end; whose row has.

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
                # As many cells have moved where the least of the so many largest rises is one.
                place = length - math.ceil(WHOLE * length)
                whole |= np.partition(line, place, axis=1)[:, place][number] > least
            ends.append(np.maximum(line[:, 0], line[:, -1])[number] > least)
        return whole, ends[1], ends[0]


def _beside(values: FloatArray, places: IntArray) -> FloatArray:
    """(4, m) what ``values`` (n,) has at ``places`` (4, m); NaN at places n."""
    padded = np.empty(values.size + 1)
    padded[:-1], padded[-1] = values, np.nan
    return padded.take(places, mode="clip")  # in half the time of a look whether there are such places
