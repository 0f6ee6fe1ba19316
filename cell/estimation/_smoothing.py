"""Smoothing without lag: an alpha-beta filter (discounted least squares of a line), restarted by CUSUM tests.

A low-pass lags, and an inversion turns lag into error. Here a straight line is fitted to the recent readings, and its
newest point replaces the reading: ramps pass without lag. A reading far from the line, or a cumulative sum of smaller
departures (Page's CUSUM), starts a new line, so that steps pass without lag, too.

The fit is a Kalman filter of level and slope with exponential forgetting. Its gains depend only on the number of
readings since the line began, and are tabulated.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...common.compiled import Flags, Places, Row, Rows, loop
from ._rows import NOISE, READING, SMOOTHED, STD

ALLOWED = 0.75
"""allowance of the CUSUM: departures from the line below this many standard deviations do not add to the sum"""
SUM = 5.0
"""threshold of the CUSUM in standard deviations; a single reading that is 5.75 off exceeds it at once"""
FAR, NEAR = 3.5, 0.5
"""standard deviations beyond which a reading starts a new line alone; and the weight of a nearer reading, which starts
it together with the old line. The reading that triggers the CUSUM after a run of small departures is itself a departure
by selection, and must not stand alone"""
STEEPEST = 15.0
"""usual change of the readings within the window, in standard deviations of a reading"""
SHORTEST_S, LONGEST_S = 0.03, 3.0
"""limits of the window: the time in seconds in which the weight of a reading falls to 1/e"""
LEVEL, SLOPE, COUNT, UP, DOWN, SUMS = *range(5), slice(3, 5)
"""rows of the memory: present level of the line; its slope per second; number of readings since it began; CUSUMs of
departures upwards and downwards"""
ROWS = 5
HIDDEN, SIGMAS = 3.3, 3.0
"""standard deviations of noise that may separate a reading from its noiseless value; and standard deviations of the
estimate within which an unnoticed change of the load must lie"""
LEAST_NOISE = 1e-9
"""added to the standard deviation of r, to keep divisions by the noise finite"""
FAR_SHARE = 1.0 - NEAR
_ALLOWED, _SUM, _FAR, _FAR_SHARE = (np.array(x) for x in (ALLOWED, SUM, FAR, FAR_SHARE))
_ZERO, _ONE = np.array(0.0), np.array(1.0)
_LEAST_NOISE, _HIDDEN, _PER_SIGMAS = (np.array(x) for x in (LEAST_NOISE, HIDDEN, 1.0 / SIGMAS))
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


class Smoothed(NamedTuple):
    """Smoothed readings; all (m,). The next call with the same scratch overwrites ``level`` and ``begun``."""

    level: FloatArray
    std: FloatArray
    """standard deviation of the level"""
    begun: BoolArray | None
    """where the reading starts a new line; None: nowhere"""


class Looked(NamedTuple):
    """The readings of one frame, before and after smoothing. Arrays (m,), which never change again."""

    reading: FloatArray
    noise: FloatArray
    """standard deviation of a reading"""
    std: FloatArray
    """standard deviation of the smoothed readings by the noise"""
    line: FloatArray
    """(ROWS, m) memory of the smoothing after the reading"""

    def doubt_kpa(self, gain_kpa: FloatArray, steepness_kpa: FloatArray) -> FloatArray:
        """(m,) standard deviation in kPa of pressures that follow from the smoothed readings.

        The response of r to a fast change of the load may differ from the gain of the smoothed readings.

        Args:
            gain_kpa: (m,) pressure per r of the smoothed readings.
            steepness_kpa: (2,) pressure per r of a fast rise, and of a fast fall, that the smoothing has not noticed
                yet; 0: the gain.
        """
        doubt: FloatArray = self.reading - self.line[LEVEL]
        falls = doubt < _ZERO
        np.abs(doubt, out=doubt)
        doubt *= steepness_kpa.take(falls) if steepness_kpa.item(1) else gain_kpa
        doubt += self.noise * gain_kpa * _HIDDEN
        doubt *= _PER_SIGMAS
        return np.maximum(doubt, self.std * gain_kpa, out=doubt)

    def doubt(self) -> FloatArray:
        """(m,) standard deviation of the smoothed readings.

        The line may lag behind a change of the load. The true value then lies between the line and the reading, or
        beyond the reading by as much as noise hides. Errors up to there stay within :data:`SIGMAS` standard deviations:

            std = max((|reading - line| + HIDDEN noise) / SIGMAS, std of the line)
        """
        doubt: FloatArray = self.reading - self.line[LEVEL]
        np.abs(doubt, out=doubt)
        doubt += self.noise * _HIDDEN
        doubt *= _PER_SIGMAS
        return np.maximum(doubt, self.std, out=doubt)


class Scratch:
    """The rows of one ``line`` (ROWS, m), and arrays for intermediate results, so that a frame allocates none."""

    def __init__(self, line: FloatArray) -> None:
        cells = line.shape[1]
        self.level, self.slope, self.count, self.sums = line[LEVEL], line[SLOPE], line[COUNT], line[SUMS]
        self.level_and_slope, self.since = line[: SLOPE + 1], line[SLOPE:]
        self.up, self.down = self.sums
        self.off, self.z, self.spare = np.empty((3, cells))
        self.above = np.empty((2, cells), dtype=np.bool_)
        self.begun, self.near = np.empty((2, cells), dtype=np.bool_)
        self.gains = np.empty((3, cells))
        self.steps = self.gains[:2]
        self.level_step, self.slope_step, self.share = self.gains
        self.n = np.empty(cells, dtype=np.intp)


class Gains(NamedTuple):
    """Kalman gains by the number of readings since the line began, starting with the first; (n,) each.

    They are the rows of ``rows`` (3, n).
    """

    level: FloatArray
    slope: FloatArray
    """gain of the slope times the time between readings"""
    std: FloatArray
    """standard deviation of the level over that of a reading"""
    rows: FloatArray


@lru_cache(maxsize=1024)
def window_s(noise: float, dt_s: float) -> float:
    """The window T in seconds, for ``noise`` relative to the range of readings: weights fall to 1/e within T.

    The variance of the line's end falls as noise^2 dt/T. Its bias by curvature, squared, grows as T^4. The best window
    is therefore proportional to (noise^2 dt)^(1/5). The factor is the project's own, from taps and presses.
    """
    best = 10.0 * (noise**2 * dt_s) ** 0.2
    steps = round(2 * math.log2(min(max(best, SHORTEST_S), LONGEST_S)))  # few different tables
    return float(2.0 ** (steps / 2))


@lru_cache(maxsize=64)
def gains(steps: float) -> Gains:
    """Gains of a window of ``steps`` readings. The unit of time is the time between readings, also for the slope.

    The last entry is the limit for many readings. The gains of the Kalman filter are entries of the covariance matrix
    of level and slope. Its inverse, the information matrix, is a sum over readings, so that the table needs no loop.
    """
    age = np.arange(min(int(4 * steps) + 3, 4001), dtype=np.float64)
    weight = np.exp(-age / steps)
    # Information matrix of level and slope: discounted sums over the ages of the readings. A prior on the slope
    # (STEEPEST) keeps lines through few readings flat.
    sum_0, sum_1, sum_2 = (np.cumsum(weight * age**power) for power in range(3))
    sum_2 += weight / min(STEEPEST / steps, 1.0) ** 2
    spread = sum_0 * sum_2 - sum_1**2
    level = sum_2 / spread
    slope, std = sum_1 / spread, np.sqrt(level)
    rows = np.array([level, slope, std])
    return Gains(rows[0], rows[1], rows[2], rows)


def begin(level: FloatArray, readings: float = 0.0) -> FloatArray:
    """The memory (ROWS, m) of cells whose level is as certain as after ``readings`` readings."""
    line = np.zeros((ROWS, *level.shape))
    line[LEVEL], line[COUNT] = level, readings
    return line


def noise_of(line: FloatArray, noise_at_rest: FloatArray) -> FloatArray:
    """(m,) standard deviation of readings near ``line`` (ROWS, m), for cells whose noise at rest is given (m,).

    Boards measure currents: their noise is constant in conductance, and proportional to (1 + r)^2 in r.
    """
    noise: FloatArray = line[LEVEL] + _ONE
    noise *= noise
    noise *= noise_at_rest
    noise += _LEAST_NOISE
    return noise


def interrupt(line: FloatArray) -> None:
    """Make the next reading start a new line, whatever its value; changes ``line``."""
    line[SUMS] = np.inf


def advance(
    line: FloatArray, dt_s: float, gains: Gains, r: FloatArray, noise: FloatArray, scratch: Scratch | None = None
) -> Smoothed:
    """Take readings ``r`` (m,) with standard deviation ``noise`` (m,); changes ``line`` (ROWS, m).

    ``gains`` are those of :func:`gains_for`.
    """
    m = scratch or Scratch(line)
    dt, sums = np.array(dt_s), m.sums
    np.multiply(m.slope, dt, m.spare)
    m.level += m.spare
    np.subtract(r, m.level, m.off)
    np.divide(m.off, noise, m.z)
    m.up += m.z
    m.down -= m.z
    sums -= _ALLOWED
    np.maximum(sums, _ZERO, out=sums)
    m.count += _ONE
    m.n[...] = m.count
    gains.rows.take(m.n, axis=1, out=m.gains, mode="clip")  # the last entry holds from there on
    m.level_step *= m.off
    m.slope_step *= m.off
    m.slope_step /= dt
    m.level_and_slope += m.steps
    begun = None
    if sums.item(sums.argmax()) > SUM:
        np.greater(sums, _SUM, m.above)
        begun = np.logical_or(m.above[0], m.above[1], m.begun)
        _begin_again(m, begun, r)
    return Smoothed(m.level, m.share * noise, begun)


def _begin_again(m: Scratch, begun: BoolArray, r: FloatArray) -> None:
    """Start new lines where ``begun``: at the reading if it is far from the old line, else at a mean of both."""
    near = np.less(np.abs(m.z, m.z), _FAR, m.near)
    near &= begun
    np.copyto(m.since, _ZERO, where=begun)
    np.copyto(m.level, r, where=begun)
    np.copyto(m.share, _ONE, where=begun)
    if np.count_nonzero(near):
        m.off *= _FAR_SHARE
        np.subtract(r, m.off, m.spare)
        np.copyto(m.level, m.spare, where=near)
        np.copyto(m.count, _ONE, where=near)


@lru_cache(maxsize=1024)
def gains_for(window: float, dt_s: float) -> Gains:
    """Gains for a window rounded to a grid of 10 %, so that jittering time stamps share a table."""
    steps = max(window / max(dt_s, 1e-9), 0.5)
    return gains(float(1.1 ** round(math.log(steps) / math.log(1.1))))


@loop
def advance_each(
    line: Rows,
    before: Rows,
    cells: Places,
    on_line: Row,
    keeps: bool,
    dt_s: float,
    gains: Rows,
    taken: Rows,
    begun: Flags,
    large: float,
) -> bool:
    """:func:`advance` as a loop over cells.

    Args:
        line: (ROWS, m), changed.
        before: (ROWS, m), overwritten by the line before this frame.
        cells: (m,) their indices among all n cells.
        on_line: (n,) number of readings since each cell's line began; written if ``keeps``.
        keeps: whether to write ``on_line``, which is read only in frames in which the noise meter works.
        dt_s: seconds since the last readings.
        gains: (3, n), ``rows`` of :class:`Gains`.
        taken: (4, m) readings and their noise; the smoothed readings and their standard deviations are written here.
        begun: (m,) marks where a new line starts; written.
        large: distance of a reading from the line before, beyond which a new line may be a spark.

    Returns:
        Whether a new line starts, and a reading is farther than ``large`` from the line before.
    """
    last = gains.shape[1] - 1
    any_begun, any_large = False, False
    for i in range(begun.size):
        for row in range(ROWS):
            before[row, i] = line[row, i]
        r, noise = taken[READING, i], taken[NOISE, i]
        level = line[LEVEL, i] + line[SLOPE, i] * dt_s
        off = r - level
        z = off / noise
        up = max(line[UP, i] + z - ALLOWED, 0.0)
        down = max(line[DOWN, i] - z - ALLOWED, 0.0)
        count = line[COUNT, i] + 1.0
        n = min(int(count), last)
        level += gains[0, n] * off
        slope = line[SLOPE, i] + gains[1, n] * off / dt_s
        share = gains[2, n]
        begins = up > SUM or down > SUM
        if begins:
            level, slope, count, up, down, share = r, 0.0, 0.0, 0.0, 0.0, 1.0
            if abs(z) < FAR:
                level = r - off * FAR_SHARE
                count = 1.0
        line[LEVEL, i], line[SLOPE, i], line[COUNT, i], line[UP, i], line[DOWN, i] = level, slope, count, up, down
        if keeps:
            on_line[cells[i]] = count
        taken[SMOOTHED, i], taken[STD, i] = level, share * noise
        begun[i] = begins
        any_begun |= begins
        any_large |= abs(r - before[LEVEL, i]) > large
    return any_begun and any_large


LOOPS = (advance_each,)
