"""One frame of the followed cells: smooth the readings, advance the inversion, sum the variances.

There are three implementations. Exact readings go to the inversion without smoothing. Noisy readings are handled by
array operations, or by compiled loops, which do the same arithmetic operation for operation.
"""

from __future__ import annotations

import numpy as np

from ...common.arrays import FloatArray
from . import _loops as loops
from . import _smoothing as smoothing
from ._deviation import Deviation, total
from ._inversion import Inversion, RecentReadings
from ._neighbours import Neighbours
from ._noise import NoiseMeter
from ._remembered import Block
from ._rows import NOISE, PRESSURE, READING
from ._smoothing import LEAST_NOISE, Looked
from ._sparks import Sparks
from ._tremor import Tremor
from ._window import RECENT, WINDOW

_ZERO = np.zeros(1)
UNUSUAL = 0.1
"""relative change of the time between frames beyond which the interval between calls of ``sway`` is adapted"""


def _no_doubt() -> FloatArray:
    return _ZERO


class Following:
    """Takes a block of cells from one frame to the next."""

    def __init__(
        self,
        inversion: Inversion,
        noise: NoiseMeter,
        sparks: Sparks,
        deviation: Deviation,
        tremor: Tremor,
        neighbours: Neighbours,
    ) -> None:
        self._inversion, self._noise, self._tremor = inversion, noise, tremor
        self._sparks, self._deviation, self._neighbours = sparks, deviation, neighbours
        self._fall_kpa = float(inversion.steepness_kpa[1])
        """pressure per r of a fast fall; 0: the response to fast falls is that to all loads"""
        self._smoothed_for = (-1.0, -1.0)
        self._smoothed_by = smoothing.gains_for(1.0, 1.0)
        self._sways_for_s = 0.0
        """time between frames to which the interval between calls of ``sway`` is adapted"""
        self.compiled = False
        """whether compiled loops are in use"""

    def expect(self, usual_s: float) -> None:
        """Set the recent mean of the time between frames.

        Changes below a tenth (:data:`UNUSUAL`) are ignored, so that jitter or a lost frame does not change the interval
        between calls of :meth:`._inversion.Inversion.sway`.
        """
        if abs(usual_s - self._sways_for_s) > UNUSUAL * self._sways_for_s:
            self._sways_for_s = usual_s

    def advance(self, block: Block, dt: float, r: FloatArray, frame: int, pressure: FloatArray) -> None:
        """Take the readings ``r`` (n,) of a frame.

        Args:
            block: the cells that are followed, changed.
            dt: seconds since the last frame.
            r: (n,) normalised resistances.
            frame: number of the frame.
            pressure: (n,) kPa to show; written for the followed cells.
        """
        if self.compiled:
            self._advance_by_machine_code(block, dt, r, frame, pressure)
        elif self._inversion.exact:
            self._advance_exactly(block, dt, r, pressure)
        else:
            self._advance_by_array_operations(block, dt, r, frame, pressure)

    def _advance_exactly(self, block: Block, dt: float, r: FloatArray, pressure: FloatArray) -> None:
        reading = r if block.cells.size == r.size else r.take(block.cells, mode="clip")
        block.memory = self._inversion.advance(block.memory, dt, reading, _ZERO, _no_doubt)
        self._deviation.take_exact(block)
        pressure[block.cells] = block.memory[PRESSURE]

    def _advance_by_array_operations(
        self, block: Block, dt: float, r: FloatArray, frame: int, pressure: FloatArray
    ) -> None:
        cells, line, every = block.cells, block.line, block.cells.size == r.size
        reading, at_rest = r, self._noise.at_rest
        if not every:
            reading, at_rest = r.take(cells, mode="clip"), at_rest.take(cells, mode="clip")
        noise = smoothing.noise_of(line, at_rest)
        if self._sparks.cells.size:
            self._sparks.put_back(block, dt, reading, noise)
        if block.scratch is None:
            block.scratch = smoothing.Scratch(line)
        smooth = smoothing.advance(line, dt, self._gains(dt), reading, noise, block.scratch)
        if self._noise.looks_next:
            self._noise.on_line[cells] = line[smoothing.COUNT]
        if smooth.begun is not None:
            self._sparks.remember(block, smooth.begun, reading, noise)
        if self._sparks.cells.size:
            self._sparks.recognise_taps(dt, r)
        block.line_before = line.copy()
        looked = Looked(reading, noise, smooth.std, block.line_before)
        memory = block.memory = self._inversion.advance(block.memory, dt, smooth.level, smooth.std, looked.doubt)
        if self._fall_kpa:
            self._tremor.doubt_falls(cells, memory, looked, self._fall_kpa)
        if self._sparks.cells.size:
            self._accept_taps(block)
        self._look_back(block, dt, noise, block.line_before, frame)
        if frame % RECENT == 0:
            self._look_for_tremor(block, noise, ends_window=frame % WINDOW == 0)
        added = None
        if self._tremor.suspicious:
            most_kpa = self._inversion.most_seeming(memory, noise)
            added = self._tremor.variance(cells, memory[PRESSURE], most_kpa)
        if self._sparks.cells.size:
            added = total(added, self._sparks.variance(block, memory))
        shown = self._deviation.show(block, looked, added)
        if every:
            pressure[...] = shown
        else:
            pressure[cells] = shown

    def _advance_by_machine_code(
        self, block: Block, dt: float, r: FloatArray, frame: int, pressure: FloatArray
    ) -> None:
        cells, line, taken = block.cells, block.line, block.taken
        loops.take.unchecked(r, self._noise.at_rest, cells, line, taken, LEAST_NOISE)
        if self._sparks.cells.size:
            self._sparks.put_back(block, dt, taken[READING], taken[NOISE])
        gains = self._gains(dt).rows
        beside = block.line_before, cells, self._noise.on_line, self._noise.looks_next
        if smoothing.advance_each.unchecked(line, *beside, dt, gains, taken, block.begun, self._sparks.large_r):
            self._sparks.remember(block, block.begun, taken[READING], taken[NOISE])
        if self._sparks.cells.size:
            self._sparks.recognise_taps(dt, r)
        memory = block.memory = self._inversion.advance_compiled(block.memory, taken, line, dt)
        if self._fall_kpa:
            self._tremor.doubt_falls_compiled(cells, memory, taken, line, self._fall_kpa)
        if self._sparks.cells.size:
            self._accept_taps(block)
        self._look_back(block, dt, taken[NOISE], line, frame)
        if frame % RECENT == 0:
            self._look_for_tremor_compiled(block, ends_window=frame % WINDOW == 0)
        added = np.zeros(cells.size)
        if self._tremor.suspicious:
            self._tremor.add_variance(cells, memory, taken, self._inversion.seeming, added)
        if self._sparks.cells.size:
            added += self._sparks.variance(block, memory)
        self._deviation.show_compiled(block, added, pressure)

    def _accept_taps(self, block: Block) -> None:
        """Tell the tremor detector that cells just tapped are under a load, not in motion within the noise."""
        cells = self._sparks.taps()
        if cells.size:
            self._tremor.accept(cells, block.memory[PRESSURE, np.searchsorted(block.cells, cells)])

    def _look_for_tremor(self, block: Block, noise: FloatArray, *, ends_window: bool) -> None:
        """Doubt the rise of cells whose load oscillates within the ``noise`` (m,); changes their memory."""
        cells, memory = block.cells, block.memory
        beside = self._noise.beside_parabola(cells)
        self._tremor.look(cells, memory, beside)
        if ends_window:
            most_kpa = self._inversion.most_seeming(memory, noise)
            missed = self._tremor.end_window(cells, memory[PRESSURE], most_kpa, beside)
            if missed is not None:
                self._inversion.miss(memory, missed)

    def _look_for_tremor_compiled(self, block: Block, *, ends_window: bool) -> None:
        """:meth:`_look_for_tremor` by compiled loops, for the readings that the block has taken."""
        cells, memory = block.cells, block.memory
        beside = self._noise.beside_parabola(cells)
        self._tremor.look(cells, memory, beside)
        if ends_window:
            seeming = self._inversion.seeming
            missed = self._tremor.end_window_compiled(cells, memory, block.taken, seeming, beside)
            if missed is not None:
                self._inversion.miss(memory, missed)

    def _look_back(self, block: Block, dt: float, noise: FloatArray, line: FloatArray, frame: int) -> None:
        """Call ``recover`` and ``sway`` of the inversion when they are due; changes the block's memory.

        ``noise`` (m,) is the standard deviation of the readings, ``line`` (ROWS, m) the memory of their smoothing.
        """
        inversion, recent = self._inversion, None
        if inversion.recovers and frame % inversion.recent == 0:
            recent = self._recent(block, dt, noise, line, inversion.recent)
            (inversion.recover_compiled if self.compiled else inversion.recover)(block.memory, recent)
        usual_s = self._sways_for_s
        every = inversion.sways_in(usual_s)
        if every and frame % every == 0:
            if recent is None or every != inversion.recent:
                recent = self._recent(block, dt, noise, line, every)
            sway = inversion.sway_compiled if self.compiled else inversion.sway
            sway(block.memory, recent._replace(dt_s=usual_s))

    def _recent(self, block: Block, dt: float, noise: FloatArray, line: FloatArray, count: int) -> RecentReadings:
        """The last ``count`` readings of the block, for its inversion; other arguments as in :meth:`_look_back`."""
        if block.near is None:
            block.near = self._neighbours.among(block.cells)
        mean = self._noise.window.mean_of_recent(block.cells, count)
        return RecentReadings(dt, mean, noise, line[smoothing.COUNT], block.near)

    def _gains(self, dt: float) -> smoothing.Gains:
        """Gains of the smoothing, for the present noise and time between frames."""
        if (self._noise.typical, dt) != self._smoothed_for:
            self._smoothed_for = self._noise.typical, dt
            window_s = smoothing.window_s(self._noise.typical / self._inversion.full_scale_r, dt)
            self._smoothed_by = smoothing.gains_for(window_s, dt)
        return self._smoothed_by
