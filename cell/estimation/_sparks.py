"""Bad contacts ("sparks"): a reading that jumps and is back within :data:`SPARK_S` was no load.

What a cell remembered before a large jump is kept for that time. If the reading comes back, the memory from before the
jump is put back, unless the jump was a tap: a cell remembers a tap, but not a bad contact. Often the cells beside it
tell at once that it is a tap (:mod:`._taps`).
"""

from __future__ import annotations

import numpy as np

from ...arrays import BoolArray, FloatArray, IntArray, columns, put_columns, spaced_anything
from . import _loops as loops
from . import _smoothing as smoothing
from ._gaps import Gaps
from ._inversion import Inversion
from ._noise import NoiseMeter
from ._remembered import Block, Remembered
from ._rows import PRESSURE, READING, SMOOTHED, STD
from ._taps import TOGETHER_S, Taps

SPARK_S = 0.1
"""a jump that is taken back sooner is no load"""
BACK = 0.05
"""share of a jump within which it counts as taken back"""
LARGE_JUMP, CLEAR_JUMP = 0.05, 12.0
"""of full scale, and in standard deviations of a reading, from which a jump may be a spark"""
CLEAR = 3.0
"""standard deviations of a reading by which a jump that was taken back may be off and still be a bad contact"""
SUDDEN = 6.0
"""times the change of the reading before it: a smaller jump is part of a press"""
NEARER, EITHER, SMALL = 0.5, 0.25, 0.15
"""share of the distance to a tap within which a bad contact must be; share of the jump, and of full scale, within which
the pressure after a tap is usually that from before it"""
SUDDENLY = 0.6
"""share of a jump that must be taken back from one frame to the next"""
BEYOND = 0.57
"""of full scale from its middle, beyond which a jump is not shown at once: just less than the largest pressure that an
inverse in doubt shows"""
IN_DOUBT = 0.5
"""of a jump that may be a spark: its standard deviation"""


_LINE = np.arange(smoothing.ROWS)


class Sparks:
    """Cells whose reading jumped a moment ago, with all that was remembered of them before."""

    def __init__(self, inversion: Inversion, noise: NoiseMeter, gaps: Gaps, shape: tuple[int, ...]) -> None:
        """``gaps`` is told of jumps that may have been either, a spark or a tap; ``shape`` is that of the array."""
        self._taps = Taps(inversion, shape)
        self._inversion, self._noise, self._gaps = inversion, noise, gaps
        self._kept = inversion.held_rows
        """(kept,) rows of the memory, as far as putting it back needs them"""
        self._compact = np.arange(self._kept.size)
        """(kept,) where these are in what is remembered of jumps"""
        self.large_r = LARGE_JUMP * inversion.full_scale_r
        """r from which a jump may be a spark"""
        self.compiled = False
        """whether the inversion's loops are there as machine code"""
        self.forget_all()

    def forget_all(self) -> None:
        """Take jumps of the last moment for loads."""
        self.cells = np.zeros(0, dtype=np.intp)
        """(k,) indices"""
        self._looked_up = self.cells, self.cells, self.cells
        """cells of a block, those of the jumps, and (k,) the places of these among the former"""
        self._age_s, self._jump = np.zeros((2, 0))
        self._taps.forget_all()
        self._memory = np.zeros((self._kept.size, 0))
        self._line = smoothing.begin(np.zeros(0))

    def forget(self, cells: IntArray) -> None:
        """Take the jumps of ``cells`` (m,) for loads."""
        if self.cells.size:
            self._keep(~np.isin(self.cells, cells))

    def remember(self, block: Block, begun: BoolArray, reading: FloatArray, noise: FloatArray) -> None:
        """Keep the memory of cells from before a jump, unless an earlier one is kept already.

        Args:
            block: the cells that are followed, after their lines took the readings, before their memory does.
            begun: (m,) whether a reading began a new line.
            reading: (m,) r.
            noise: (m,) standard deviation of it.
        """
        place = begun.nonzero()[0]
        jump = reading[place] - block.line_before[smoothing.LEVEL, place]
        size = np.abs(jump)
        if size.item(size.argmax()) <= self.large_r:
            return
        reading, noise = reading[place], noise[place]
        jumped = size > np.maximum(CLEAR_JUMP * noise, self.large_r)
        if self._inversion.side > 0:
            # Bad contacts add resistance: where loads do so too, a fall to no less than that at rest is a release, if
            # there was a load.
            loaded = block.memory[PRESSURE, place] > LARGE_JUMP * self._inversion.full_scale_kpa
            jumped &= ~(loaded & (jump < 0) & (reading > -CLEAR * noise))
        if self.cells.size:
            kept = np.zeros(self._noise.at_rest.size, dtype=np.bool_)  # in a tenth of the time of numpy.isin
            kept[self.cells] = True
            jumped &= ~kept[block.cells[place]]
        jumped &= size > SUDDEN * np.abs(self._noise.window.change_before(block.cells[place]))
        if np.count_nonzero(jumped):
            self._add(block, place[jumped], jump[jumped])

    def put_back(self, block: Block, dt: float, reading: FloatArray, noise: FloatArray) -> None:
        """Put back the memory of cells whose reading has come back; changes the block.

        ``reading`` (m,) is r ``dt`` after the last frame, ``noise`` (m,) its standard deviation.
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
        """Look for jumps that are loads, by the readings ``r`` (n,) of all cells ``dt`` after the last ones."""
        off = r[self.cells] - self._line[smoothing.LEVEL]
        self._taps.look(self.cells, self._age_s, self._jump, off, dt, r, self._noise.at_rest)

    def taps(self) -> IntArray:
        """Indices of cells that have jumped just now, under a load."""
        return self.cells[self._taps.known & (self._age_s <= TOGETHER_S)]

    def _were_sparks(
        self, block: Block, some: IntArray, place: IntArray, dt: float, reading: FloatArray, noise: FloatArray
    ) -> BoolArray:
        """Whether jumps (k,) that were taken back were bad contacts rather than taps.

        A cell remembers a tap. After one, the pressure that follows from the memory of the tap is the one from before,
        and the reading is not; after a bad contact it is the other way round. Taps are the rule. Where both may be, the
        difference counts as standard deviation, until it has faded.

        Args:
            block: the cells that are followed.
            some: (k,) places of the jumps among all that are kept.
            place: (k,) places of their cells in the block.
            dt: since the last frame.
            reading: (m,) r of the block's cells.
            noise: (m,) its standard deviation.
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
        """(rows, k) what the cells at ``place`` (k,) in the block remember, as far as a step needs it."""
        if not self.compiled:
            return block.memory_of(place)
        memory = spaced_anything(len(self._inversion.rows), place.size)
        loops.copy.unchecked(block.memory, self._kept, place, memory, self._kept, np.arange(place.size))
        return memory

    def _tapped(self, memory: FloatArray, dt: float, reading: FloatArray, noise: FloatArray) -> FloatArray:
        """(k,) kPa by what cells remember of taps, ``memory`` (rows, k), which changes; see :meth:`_were_sparks`."""
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
        """(m,) kPa^2: half of a jump counts as standard deviation as long as it may be a spark."""
        place = self._places_in(block)
        jump = memory[PRESSURE, place] - self._memory[PRESSURE]
        variance = np.zeros(memory.shape[1])
        variance[place] = np.where(self._taps.known, 0.0, (IN_DOUBT * jump) ** 2)
        return variance

    def undo(self, lost: BoolArray, remembered: Remembered, pressure: FloatArray) -> None:
        """Put back what cells remembered before they jumped that are ``lost`` (n,): they are not read any more.

        Cells that were tapped keep what they remember.
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
        """(k,) places of the jumps' cells among those of the block."""
        if self._looked_up[0] is not block.cells or self._looked_up[1] is not self.cells:
            every = np.array_equal(self.cells, block.cells)  # in a tenth of the time of a search
            place = np.arange(self.cells.size) if every else np.searchsorted(block.cells, self.cells)
            self._looked_up = block.cells, self.cells, place
        return self._looked_up[2]

    def hide(self, pressure: FloatArray) -> None:
        """Show no jump beyond full scale before it has lasted longer than a spark; changes ``pressure`` (n,)."""
        full_kpa, now = self._inversion.full_scale_kpa, pressure[self.cells]
        beyond = ~self._taps.known & (np.abs(now - full_kpa / 2) > BEYOND * full_kpa)
        pressure[self.cells[beyond]] = self._memory[PRESSURE, beyond]

    def _remember_again(self, memory: FloatArray, line: FloatArray, places: IntArray, some: BoolArray) -> None:
        """Put back what ``some`` of the jumps' cells remembered before, after the time since, the load held.

        Args:
            memory: (rows, m), changed.
            line: (ROWS, m), changed.
            places: (k,) of these cells there.
            some: which jumps, k of all.
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
        """Keep what is remembered of the cells at ``place`` (k,) in the block, from before their ``jump`` (k,)."""
        before = self._noise.window.reading(1).copy()
        before[self.cells] = self._line[smoothing.LEVEL]
        self._taps.add(block.cells[place], before, anew=not (self._age_s <= TOGETHER_S).any())
        self.cells = np.concatenate([self.cells, block.cells[place]])
        self._age_s = np.concatenate([self._age_s, np.zeros(place.size)])
        line = block.line_before
        if place.size < block.cells.size:  # taking as many columns takes several times as long as a copy
            line = line.take(place, axis=1)
        memory = self._before(block, place)
        self._memory = np.concatenate([self._memory, memory], axis=1) if self._memory.size else memory
        self._line = np.concatenate([self._line, line], axis=1)
        self._jump = np.concatenate([self._jump, jump])

    def _before(self, block: Block, place: IntArray) -> FloatArray:
        """(kept, k) what the cells at ``place`` (k,) in the block remember, as far as it is kept."""
        if self.compiled:
            memory = np.empty((self._kept.size, place.size))
            loops.copy.unchecked(block.memory, self._kept, place, memory, self._compact, np.arange(place.size))
            return memory
        return columns(block.memory, place)[self._kept]

    def _keep(self, kept: BoolArray) -> None:
        self.cells, self._age_s, self._jump = self.cells[kept], self._age_s[kept], self._jump[kept]
        self._memory, self._line = self._memory.compress(kept, axis=1), self._line.compress(kept, axis=1)
        self._taps.keep(kept)
