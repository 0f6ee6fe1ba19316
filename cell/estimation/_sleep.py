"""Sleep mode of cells at rest: only the mean is monitored, until a reading or the mean leaves the noise.

Most cells of a large skin carry no load. A sleeping cell costs a few operations per frame, a followed cell about a
hundred.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from . import _loops as loops
from . import _smoothing as smoothing
from ._loops import CALM_SIGMAS, LEVEL_BANDS
from ._noise import NoiseMeter
from ._remembered import Block

AT_REST = 0.005
"""fraction of full scale below which a cell may sleep"""
WATCH_S = 0.5
"""time constant of the mean of a cell, in seconds"""
MEANS = 8
"""updates of the mean per time constant"""


class Sleep:
    """Which of n cells are awake, the mean of each cell's readings, and the thresholds that wake sleeping cells."""

    def __init__(self, cells: int, full_scale_r: float) -> None:
        self.band = AT_REST * full_scale_r
        """r within which a cell counts as at rest"""
        self.awake = np.zeros(cells, dtype=np.bool_)
        self.all_awake = False
        """whether all cells are followed, and none needs to be watched"""
        self.mean = np.zeros(cells)
        """(n,) mean of r with the time constant :data:`WATCH_S`"""
        self.wake_at = np.full(cells, np.inf)
        """(n,) absolute r beyond which a reading wakes its cell; infinite for cells that are awake"""
        self._sum = np.zeros(cells)
        self._sum_s, self._summed = 0.0, 0
        """seconds and number of readings in the sum"""
        self._sharp = np.ones(cells)
        self.compiled = False
        """whether compiled loops are in use"""

    def watch(
        self,
        dt: float,
        r: FloatArray,
        watched: FloatArray | None = None,
        blurred: FloatArray | None = None,
        loaded: IntArray | None = None,
    ) -> IntArray | None:
        """Take readings (n,), ``dt`` after the last ones.

        Args:
            dt: seconds since the last frame.
            r: (n,) readings without shared noise; a single one may wake its cell.
            watched: (n,) readings with shared noise. The mean is taken of these; a single one may wake its cell, too.
                None: same as ``r``.
            blurred: (n,) standard deviation of ``watched`` over that of ``r``; None: 1.
            loaded: (k,) sleeping cells that wake in any case; None: no cells.

        Returns:
            (m,) sleeping cells whose reading, or mean, has left the range of noise; they are awake now. None: no cells.
        """
        watched, blurred = r if watched is None else watched, self._sharp if blurred is None else blurred
        may_wake = self._add_up(r, watched, blurred)
        self._sum_s += dt
        self._summed += 1
        averaged = None
        if self._sum_s >= WATCH_S / MEANS:
            share = -math.expm1(-dt / WATCH_S)
            averaged = math.sqrt(share / (2 - share))
            may_wake |= self._renew_means(averaged, blurred)
        if not may_wake and loaded is None:
            return None
        left: BoolArray = np.abs(r) > self.wake_at
        if watched is not r:
            left |= np.abs(watched) > self.wake_at * blurred
        if averaged is not None:
            left |= np.abs(self.mean) > self.band + averaged * blurred * (self.wake_at - self.band)
        if loaded is not None:
            left[loaded] = True
        if not np.count_nonzero(left):
            return None
        cells = np.flatnonzero(left)
        self.awake[cells] = True
        return cells

    def _add_up(self, r: FloatArray, watched: FloatArray, blurred: FloatArray) -> bool:
        """Add readings to the sum for the mean; returns whether one of them may wake its cell."""
        if self.compiled:
            return loops.watch.unchecked(r, watched, blurred, self._sum, self.wake_at)
        self._sum += watched
        return not self.all_awake

    def _renew_means(self, averaged: float, blurred: FloatArray) -> bool:
        """Update the means by the sums; returns whether a mean may wake its cell.

        ``averaged`` is the standard deviation of a mean over that of a reading; for ``blurred`` see :meth:`watch`.
        """
        share, summed = -math.expm1(-self._sum_s / WATCH_S), self._summed
        self._sum_s, self._summed = 0.0, 0
        if self.compiled:
            limits = self.wake_at, self.band, averaged, blurred
            return loops.renew_means.unchecked(self._sum, summed, self.mean, share, *limits)
        self._sum /= summed
        self._sum -= self.mean
        self._sum *= share
        self.mean += self._sum
        self._sum[:] = 0.0
        return not self.all_awake

    def follow(self, cells: IntArray) -> None:
        """Note that ``cells`` (m,) are followed, and need no wake-up threshold."""
        self.all_awake = cells.size == self.awake.size
        self.wake_at[cells] = np.inf

    def begin(self, cells: IntArray) -> None:
        """Put ``cells`` (m,) to sleep; the caller sets their wake-up thresholds next."""
        self.awake[cells] = False
        self.all_awake = False

    def calm(self, block: Block, noise: NoiseMeter) -> BoolArray:
        """(m,) cells that are followed and read as at rest."""
        cells = block.cells
        calm: BoolArray
        if self.compiled:
            calm = np.empty(cells.size, dtype=np.bool_)
            loops.find_calm.unchecked(cells, self.mean, noise.at_rest, block.line, self.band, calm)
            return calm
        mean = self.mean[cells]
        quiet = self.band + CALM_SIGMAS * noise.std(mean, cells)
        calm = np.abs(mean) < quiet
        calm &= np.abs(block.line[smoothing.LEVEL]) < LEVEL_BANDS * quiet
        return calm

    @property
    def clock(self) -> list[float]:
        """Seconds and number of readings in the sum, to be saved."""
        return [self._sum_s, self._summed]

    def state(self) -> dict[str, FloatArray | BoolArray]:
        """The state without :attr:`clock`, by name."""
        return {"mean": self.mean, "sum": self._sum, "awake": self.awake}

    def restore(self, state: dict[str, FloatArray], clock: list[float]) -> None:
        """Continue from a saved :meth:`state` and :attr:`clock`."""
        self.mean, self._sum, self.awake = state["mean"], state["sum"], state["awake"] > 0
        self.wake_at, self.all_awake = np.full(self.awake.size, np.inf), False
        self._sum_s, self._summed = clock[0], int(clock[1])
