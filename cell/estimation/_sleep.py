"""Sleep mode of cells at rest: only the mean is monitored, until a reading or the mean leaves the noise.

Most cells of a large skin carry no load. A sleeping cell costs a few operations per frame, a followed cell about a
hundred.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Flags, Places, Records, Row, loop
from .._state import CellState
from ._noise import noise_of

AT_REST = 0.005
"""fraction of full scale below which a cell may sleep"""
WATCH_S = 0.5
"""time constant of the mean of a cell, in seconds"""
MEANS = 8
"""updates of the mean per time constant"""
ASLEEP_SIGMAS = 5.0
"""standard deviations beyond which a single reading, or the mean, wakes a cell"""
CALM_SIGMAS, LEVEL_BANDS = 0.4, 3.0
"""a cell counts as at rest if its mean exceeds the band of rest by less than the first number of standard deviations,
and its smoothed reading is within the second number times that limit"""


class Sleep:
    """Which of n cells are awake, the mean of each cell's readings, and the thresholds that wake sleeping cells."""

    def __init__(self, cells: int, full_scale_r: float) -> None:
        self.band = AT_REST * full_scale_r
        """r within which a cell counts as at rest"""
        self.awake = np.zeros(cells, dtype=np.bool_)
        self.mean = np.zeros(cells)
        """(n,) mean of r with the time constant :data:`WATCH_S`"""
        self._wake_at = np.full(cells, np.inf)
        """(n,) absolute r beyond which a reading wakes its cell; infinite for cells that are awake"""
        self._sum = np.zeros(cells)
        self._sum_s, self._summed = 0.0, 0
        """seconds and number of readings in the sum"""
        self._sharp, self._woken = np.ones(cells), np.zeros(cells, dtype=np.bool_)

    def watch(
        self,
        dt_s: float,
        r: FloatArray,
        watched: FloatArray | None = None,
        blurred: FloatArray | None = None,
        loaded: IntArray | None = None,
    ) -> bool:
        """Take readings (n,), ``dt_s`` after the last ones.

        Args:
            dt_s: seconds since the last frame.
            r: (n,) readings without shared noise; a single one may wake its cell.
            watched: (n,) readings with shared noise. The mean is taken of these; a single one may wake its cell, too.
                None: same as ``r``.
            blurred: (n,) standard deviation of ``watched`` over that of ``r``; None: 1.
            loaded: (k,) sleeping cells that wake in any case; None: no cells.

        Returns:
            Whether a sleeping cell is awake now, since its reading, or its mean, has left the range of noise.
        """
        watched, blurred = r if watched is None else watched, self._sharp if blurred is None else blurred
        woken = self._woken
        some = watch_each.unchecked(r, watched, blurred, self._sum, self._wake_at)
        if some:
            wake_each.unchecked(r, watched, blurred, self._wake_at, woken)
        self._sum_s += dt_s
        self._summed += 1
        if self._sum_s >= WATCH_S / MEANS:
            share = -math.expm1(-dt_s / WATCH_S)
            averaged = math.sqrt(share / (2 - share))
            share = -math.expm1(-self._sum_s / WATCH_S)
            limits = self._wake_at, self.band, averaged, blurred
            some |= renew_means_each.unchecked(self._sum, self._summed, self.mean, share, *limits, woken)
            self._sum_s, self._summed = 0.0, 0
        if loaded is not None:
            woken[loaded] = some = True
        if some:
            self.awake |= woken
            self._wake_at[woken] = np.inf
            woken[:] = False
        return some

    def begin(self, places: IntArray) -> None:
        """Put cells to sleep; their wake-up thresholds are set by :meth:`renew`."""
        self.awake[places] = False

    def calm(self, cells: Records[CellState], places: IntArray, noise_at_rest: FloatArray) -> BoolArray:
        """(k,) cells that read as at rest; their noise at rest is ``noise_at_rest`` (n,)."""
        calm = np.empty(places.size, dtype=np.bool_)
        calm_each.unchecked(cells, places, self.mean, noise_at_rest, self.band, calm)
        return calm

    def renew(self, asleep: IntArray, noise_at_rest: FloatArray) -> FloatArray:
        """(k,) noise of the sleeping cells, by which their wake-up thresholds are set."""
        noise = np.empty(asleep.size)
        wake_at_each.unchecked(asleep, self.mean, noise_at_rest, self.band, self._wake_at, noise)
        return noise

    def state(self) -> dict[str, FloatArray | BoolArray]:
        """The state, by name."""
        clock = np.array([self._sum_s, self._summed])
        own = {"mean": self.mean, "sum": self._sum, "awake": self.awake, "wake_at": self._wake_at}
        return own | {"sleep_clock": clock}

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a saved :meth:`state`."""
        self.mean, self._sum, self._wake_at = state["mean"], state["sum"], state["wake_at"]
        self.awake = state["awake"] > 0
        self._sum_s, self._summed = float(state["sleep_clock"][0]), int(state["sleep_clock"][1])


@loop
def watch_each(r: Row, watched: Row, blurred: Row, total: Row, wake_at: Row) -> bool:
    """Add readings ``watched`` (n,) to their sum; returns whether one of them, or of ``r`` (n,), wakes its cell.

    The noise of ``watched`` is ``blurred`` (n,) times that of ``r``.
    """
    some = False
    for i in range(r.size):
        total[i] += watched[i]
        some |= wakes(r[i], watched[i], blurred[i], wake_at[i])
    return some


@loop
def wake_each(r: Row, watched: Row, blurred: Row, wake_at: Row, woken: Flags) -> None:
    """Mark in ``woken`` (n,) where a reading wakes its cell; other arguments as of :func:`watch_each`."""
    for i in range(r.size):
        woken[i] = wakes(r[i], watched[i], blurred[i], wake_at[i])


@loop
def wakes(r: float, watched: float, blurred: float, wake_at: float) -> bool:
    """Whether a reading is beyond the noise of a sleeping cell."""
    return (abs(r) > wake_at) | (abs(watched) > wake_at * blurred)


@loop
def renew_means_each(
    total: Row,
    summed: int,
    mean: Row,
    share: float,
    wake_at: Row,
    band: float,
    averaged: float,
    blurred: Row,
    woken: Flags,
) -> bool:
    """Update the means (n,) by the sums of readings, and reset the sums; mark in ``woken`` where a mean wakes its cell.

    ``averaged`` is the standard deviation of a mean over that of a reading. The noise of the summed readings is
    ``blurred`` (n,) times that of the readings to which ``wake_at`` applies. Returns whether any cell wakes.
    """
    some = False
    for i in range(mean.size):
        mean[i] += (total[i] / summed - mean[i]) * share
        total[i] = 0.0
        if abs(mean[i]) > band + averaged * blurred[i] * (wake_at[i] - band):
            woken[i] = some = True
    return some


@loop
def calm_each(
    cells: Records[CellState], places: Places, mean: Row, noise_at_rest: Row, band: float, calm: Flags
) -> None:
    """Mark cells in ``calm`` (k,) that read as at rest, within ``band`` of r and the noise."""
    for k in range(places.size):
        i = places[k]
        quiet = band + CALM_SIGMAS * noise_of(mean[i], noise_at_rest[i])
        calm[k] = abs(mean[i]) < quiet and abs(cells[i].level) < LEVEL_BANDS * quiet


@loop
def wake_at_each(asleep: Places, mean: Row, noise_at_rest: Row, band: float, wake_at: Row, noise: Row) -> None:
    """Set the thresholds ``wake_at`` (n,) of sleeping cells by their ``noise`` (k,), which is written, too."""
    for k in range(asleep.size):
        i = asleep[k]
        noise[k] = noise_of(mean[i], noise_at_rest[i])
        wake_at[i] = ASLEEP_SIGMAS * noise[k] + band
