"""Intermittent contacts ("sparks"): a reading that jumps and comes back within :data:`SPARK_S` was no load.

The memory of a cell from before a large jump is stored for that time. If the reading comes back, the stored memory is
restored, unless the jump was a tap: a tap changes the memory of a cell, a bad contact does not. Often the neighbouring
cells show at once that the jump is a tap (:mod:`._taps`).
"""

from __future__ import annotations

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray, columns, put_columns, spaced_anything
from . import _loops as loops
from . import _smoothing as smoothing
from ._gaps import Gaps
from ._inversion import Inversion
from ._noise import NoiseMeter
from ._remembered import Block, Remembered
from ._rows import PRESSURE, READING, SMOOTHED, STD
from ._taps import TOGETHER_S, Taps

SPARK_S = 0.1
"""longest duration of a spark in seconds; longer jumps are loads"""
BACK = 0.05
"""fraction of a jump within which the reading counts as back"""
LARGE_JUMP, CLEAR_JUMP = 0.05, 12.0
"""least size of a jump that may be a spark: fraction of full scale, and standard deviations of a reading"""
CLEAR = 3.0
"""standard deviations of a reading, by which the reading after a bad contact may differ from that before it"""
SUDDEN = 6.0
"""multiple of the change in the frame before; a smaller jump is part of a press"""
NEARER, EITHER, SMALL = 0.5, 0.25, 0.15
"""limits of the decision between spark and tap. The misfit of a spark must be at most the first fraction of the misfit
of a tap. After a tap, the pressure usually differs from that before it by less than the second fraction of the jump, or
than the third fraction of full scale"""
SUDDENLY = 0.6
"""fraction of a jump that must be reversed from one frame to the next"""
BEYOND = 0.57
"""distance from the middle of full scale, as a fraction of full scale, beyond which a jump is not shown at once: just
less than the largest pressure that an inverse in doubt shows"""
IN_DOUBT = 0.5
"""standard deviation of a jump that may be a spark, over the jump"""


_LINE = np.arange(smoothing.ROWS)


class Sparks:
    """Cells whose reading has just jumped, with their memory from before the jump."""

    def __init__(self, inversion: Inversion, noise: NoiseMeter, gaps: Gaps, shape: tuple[int, ...]) -> None:
        """``gaps`` takes the doubt about jumps that may have been spark or tap; ``shape`` is that of the array."""
        self._taps = Taps(inversion, shape)
        self._inversion, self._noise, self._gaps = inversion, noise, gaps
        self._kept = inversion.held_rows
        """(kept,) rows of the inversion's memory that are stored"""
        self._compact = np.arange(self._kept.size)
        """(kept,) the same rows in the stored memory"""
        self.large_r = LARGE_JUMP * inversion.full_scale_r
        """least jump of r that may be a spark"""
        self.compiled = False
        """whether compiled loops of the inversion are in use"""
        self.forget_all()

    def forget_all(self) -> None:
        """Treat all recent jumps as loads."""
        self.cells = np.zeros(0, dtype=np.intp)
        """(k,) indices of the cells that have jumped"""
        self._looked_up = self.cells, self.cells, self.cells
        """cache of :meth:`_places_in`: cells of the block, cells of the jumps, and (k,) places of the latter in the
        former"""
        self._age_s, self._jump = np.zeros((2, 0))
        self._taps.forget_all()
        self._memory = np.zeros((self._kept.size, 0))
        self._line = smoothing.begin(np.zeros(0))

    def forget(self, cells: IntArray) -> None:
        """Treat the jumps of ``cells`` (m,) as loads."""
        if self.cells.size:
            self._keep(~np.isin(self.cells, cells))

    def remember(self, block: Block, begun: BoolArray, reading: FloatArray, noise: FloatArray) -> None:
        """Store the memory of cells from before a jump, unless the memory from before an earlier jump is stored.

        Args:
            block: the followed cells; their lines contain the readings already, their memory does not yet.
            begun: (m,) whether a reading started a new line.
            reading: (m,) r.
            noise: (m,) standard deviation of r.
        """
        place = begun.nonzero()[0]
        jump = reading[place] - block.line_before[smoothing.LEVEL, place]
        size = np.abs(jump)
        if size.item(size.argmax()) <= self.large_r:
            return
        reading, noise = reading[place], noise[place]
        jumped = size > np.maximum(CLEAR_JUMP * noise, self.large_r)
        if self._inversion.side > 0:
            # Bad contacts add resistance. Where loads add resistance, too, a fall of a loaded cell that does not go
            # below rest is a release.
            loaded = block.memory[PRESSURE, place] > LARGE_JUMP * self._inversion.full_scale_kpa
            jumped &= ~(loaded & (jump < 0) & (reading > -CLEAR * noise))
        if self.cells.size:
            kept = np.zeros(self._noise.at_rest.size, dtype=np.bool_)  # takes a tenth of the time of numpy.isin
            kept[self.cells] = True
            jumped &= ~kept[block.cells[place]]
        jumped &= size > SUDDEN * np.abs(self._noise.window.change_before(block.cells[place]))
        if np.count_nonzero(jumped):
            self._add(block, place[jumped], jump[jumped])

    def put_back(self, block: Block, dt: float, reading: FloatArray, noise: FloatArray) -> None:
        """Restore the memory of cells whose reading has come back; changes the block.

        ``reading`` (m,) is r, ``dt`` seconds after the last frame; ``noise`` (m,) is its standard deviation.
        """
        self._age_s += dt
        place = self._places_in(block)
        off = reading[place] - self._line[smoothing.LEVEL]
        np.copyto(self._jump, off, where=np.abs(off) > np.abs(self._jump))
        jump, moved = np.abs(self._jump), self._line[smoothing.SLOPE] * self._age_s
        over = self._age_s > SPARK_S * (1 + 1e-9)
        back = np.abs(off - moved) < BACK * jump + CLEAR * noise[place] + np.abs(moved)
        back &= np.abs(block.line[smoothing.LEVEL, place] - reading[place]) > SUDDENLY * jump
        back &= ~over
        over |= back
        back &= ~self._taps.known
        if back.any():
            some = np.flatnonzero(back)
            back[some] = self._were_sparks(block, some, place[some], dt, reading, noise)
        if back.any():
            self._remember_again(block.memory, block.line, place[back], back)
            block.changed()
        if over.any():
            self._keep(~over)

    def recognise_taps(self, dt: float, r: FloatArray) -> None:
        """Find jumps that are loads, by the readings ``r`` (n,) of all cells, ``dt`` seconds after the last frame."""
        off = r[self.cells] - self._line[smoothing.LEVEL]
        self._taps.look(self.cells, self._age_s, self._jump, off, dt, r, self._noise.at_rest)

    def taps(self) -> IntArray:
        """Indices of cells that have just jumped, and are known to be under a load."""
        return self.cells[self._taps.known & (self._age_s <= TOGETHER_S)]

    def _were_sparks(
        self, block: Block, some: IntArray, place: IntArray, dt: float, reading: FloatArray, noise: FloatArray
    ) -> BoolArray:
        """Whether reversed jumps (k,) were bad contacts rather than taps.

        A tap changes the memory of a cell. After a tap, the pressure computed with that changed memory equals the
        pressure before the tap, but the reading differs from the reading before. After a bad contact it is the other
        way round. In doubt, a jump is a tap. If both are plausible, the difference between the two pressures is added
        as a standard deviation, which decays.

        Args:
            block: the followed cells.
            some: (k,) places of the jumps among all that are stored.
            place: (k,) places of their cells in the block.
            dt: seconds since the last frame.
            reading: (m,) r of the block's cells.
            noise: (m,) standard deviation of r.
        """
        full_kpa, reading, noise = self._inversion.full_scale_kpa, reading[place], noise[place]
        before, top = self._memory[PRESSURE, some], block.memory[PRESSURE, place]
        tapped = self._tapped(self._memory_of(block, place), dt, reading, noise)
        off = np.abs(reading - self._line[smoothing.LEVEL, some]) - CLEAR * noise
        off_if_tapped = np.abs(tapped - before)
        moved = np.abs(top - before)
        found: BoolArray = off * moved <= NEARER * off_if_tapped * np.abs(self._jump[some])
        plausible = np.maximum(EITHER * moved, SMALL * full_kpa)
        either = found & (off_if_tapped < plausible) & (tapped > -LARGE_JUMP * full_kpa)
        self._gaps.doubt(self.cells[some][either], off_if_tapped[either])
        return found

    def _memory_of(self, block: Block, place: IntArray) -> FloatArray:
        """(rows, k) memory of the cells at ``place`` (k,) in the block; only rows that a step needs are valid."""
        if not self.compiled:
            return block.memory_of(place)
        memory = spaced_anything(len(self._inversion.rows), place.size)
        loops.copy.unchecked(block.memory, self._kept, place, memory, self._kept, np.arange(place.size))
        return memory

    def _tapped(self, memory: FloatArray, dt: float, reading: FloatArray, noise: FloatArray) -> FloatArray:
        """(k,) kPa if the jumps were taps, by ``memory`` (rows, k), which changes; see :meth:`_were_sparks`."""
        if self.compiled:
            taken = np.zeros((4, reading.size))
            taken[READING] = taken[SMOOTHED] = reading
            taken[STD] = noise
            line = smoothing.begin(reading)
            after = self._inversion.advance_compiled(memory, taken, line, dt)
        else:
            after = self._inversion.advance(memory, dt, reading, noise, lambda: noise)
        pressure: FloatArray = after[PRESSURE]
        return pressure

    def variance(self, block: Block, memory: FloatArray) -> FloatArray:
        """(m,) kPa^2 by jumps that may be sparks: the standard deviation is :data:`IN_DOUBT` times the jump."""
        place = self._places_in(block)
        jump = memory[PRESSURE, place] - self._memory[PRESSURE]
        variance = np.zeros(memory.shape[1])
        variance[place] = np.where(self._taps.known, 0.0, (IN_DOUBT * jump) ** 2)
        return variance

    def undo(self, lost: BoolArray, remembered: Remembered, pressure: FloatArray) -> None:
        """Restore the memory from before the jump of cells that are ``lost`` (n,), as they are no longer read.

        Cells that were tapped keep their present memory.
        """
        gone = lost[self.cells]
        if not np.count_nonzero(gone):
            return
        back = gone & ~self._taps.known
        cells = self.cells[back]
        self._remember_again(remembered.memory, remembered.line, cells, back)
        pressure[cells] = self._memory[PRESSURE, back]
        self._keep(~gone)

    def _places_in(self, block: Block) -> IntArray:
        """(k,) places of the jumps' cells in the block."""
        if self._looked_up[0] is not block.cells or self._looked_up[1] is not self.cells:
            every = np.array_equal(self.cells, block.cells)  # takes a tenth of the time of a search
            place = np.arange(self.cells.size) if every else np.searchsorted(block.cells, self.cells)
            self._looked_up = block.cells, self.cells, place
        return self._looked_up[2]

    def hide(self, pressure: FloatArray) -> None:
        """Hide jumps beyond :data:`BEYOND` until they have lasted longer than a spark; changes ``pressure`` (n,)."""
        full_kpa, now = self._inversion.full_scale_kpa, pressure[self.cells]
        beyond = ~self._taps.known & (np.abs(now - full_kpa / 2) > BEYOND * full_kpa)
        pressure[self.cells[beyond]] = self._memory[PRESSURE, beyond]

    def _remember_again(self, memory: FloatArray, line: FloatArray, places: IntArray, some: BoolArray) -> None:
        """Restore the memory of ``some`` jumps' cells, advanced by the time since the jump at constant load.

        Args:
            memory: (rows, m), changed.
            line: (ROWS, m), changed.
            places: (k,) columns of these cells in ``memory`` and ``line``.
            some: mask of the jumps, true for k of them.
        """
        jumps = some.nonzero()[0]
        age_s = self._age_s[jumps]
        if self.compiled:
            loops.copy.unchecked(self._memory, self._compact, jumps, memory, self._kept, places)
            self._inversion.hold_compiled(memory, places, age_s)
            loops.copy.unchecked(self._line, _LINE, jumps, line, _LINE, places)
            return
        held = np.zeros((len(self._inversion.rows), jumps.size))
        held[self._kept] = self._memory.take(jumps, axis=1)
        put_columns(memory, places, self._inversion.hold(held, age_s))
        put_columns(line, places, self._line.take(jumps, axis=1))

    def _add(self, block: Block, place: IntArray, jump: FloatArray) -> None:
        """Store the memory of the cells at ``place`` (k,) in the block, from before their ``jump`` (k,)."""
        before = self._noise.window.reading(1).copy()
        before[self.cells] = self._line[smoothing.LEVEL]
        self._taps.add(block.cells[place], before, anew=not (self._age_s <= TOGETHER_S).any())
        self.cells = np.concatenate([self.cells, block.cells[place]])
        self._age_s = np.concatenate([self._age_s, np.zeros(place.size)])
        line = block.line_before
        if place.size < block.cells.size:  # taking all columns would take several times as long as concatenating them
            line = line.take(place, axis=1)
        memory = self._before(block, place)
        self._memory = np.concatenate([self._memory, memory], axis=1) if self._memory.size else memory
        self._line = np.concatenate([self._line, line], axis=1)
        self._jump = np.concatenate([self._jump, jump])

    def _before(self, block: Block, place: IntArray) -> FloatArray:
        """(kept, k) the stored rows of the memory of the cells at ``place`` (k,) in the block."""
        if self.compiled:
            memory = np.empty((self._kept.size, place.size))
            loops.copy.unchecked(block.memory, self._kept, place, memory, self._compact, np.arange(place.size))
            return memory
        return columns(block.memory, place)[self._kept]

    def _keep(self, kept: BoolArray) -> None:
        self.cells, self._age_s, self._jump = self.cells[kept], self._age_s[kept], self._jump[kept]
        self._memory, self._line = self._memory.compress(kept, axis=1), self._line.compress(kept, axis=1)
        self._taps.keep(kept)
