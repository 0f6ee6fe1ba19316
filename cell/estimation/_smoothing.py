"""Smoothing without lag: an alpha-beta filter (discounted least squares of a line) that CUSUM tests start afresh.

A low-pass would answer late, and an inverse turns lateness into error. Here the newest point of a straight line fitted
to the recent readings stands for the reading: ramps pass without lag. A reading far from the line, or a cumulative sum
of smaller departures (Page's CUSUM), begins a new line, so that steps pass without lag too.

Fitting the line is a Kalman filter of level and slope with exponential forgetting. Its gains depend only on the number
of readings since the line began, and are tabulated.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ...arrays import BoolArray, FloatArray
from ...compiled import Flags, Places, Row, Rows, loop
from ._rows import NOISE, READING, SMOOTHED, STD

ALLOWED = 0.75
"""standard deviations that a reading may be off without adding to the sum"""
SUM = 5.0
"""standard deviations of the sum that begin a new line; a single reading that is 5.75 off does it at once"""
FAR, NEAR = 3.5, 0.5
"""standard deviations from which a reading begins a line by itself; the weight of a nearer one. After a run of small
departures the last reading is a departure, too, by selection: it must not stand alone"""
STEEPEST = 15.0
"""standard deviations of a reading by which readings usually change within the window"""
SHORTEST_S, LONGEST_S = 0.03, 3.0
"""limits of the time in which the weight of a reading falls to 1/e"""
LEVEL, SLOPE, COUNT, UP, DOWN, SUMS = *range(5), slice(3, 5)
"""rows of the memory: the line now, its slope per second, readings since it began; sums of departures upwards and
downwards"""
ROWS = 5
HIDDEN, SIGMAS = 3.3, 3.0
"""standard deviations of the noise by which a load may be off its reading; and of the estimate, which are to cover what
a change could be that the smoothing has not noticed yet"""
LEAST_NOISE = 1e-9
"""of r: keeps a division by the noise finite"""
FAR_SHARE = 1.0 - NEAR
_ALLOWED, _SUM, _FAR, _FAR_SHARE = (np.array(x) for x in (ALLOWED, SUM, FAR, FAR_SHARE))
_ZERO, _ONE = np.array(0.0), np.array(1.0)
_LEAST_NOISE, _HIDDEN, _PER_SIGMAS = (np.array(x) for x in (LEAST_NOISE, HIDDEN, 1.0 / SIGMAS))
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


class Smoothed(NamedTuple):
    """What is made of a reading; all (m,). The next call with the same scratch overwrites ``level`` and ``begun``."""

    level: FloatArray
    std: FloatArray
    """standard deviation of the level"""
    begun: BoolArray | None
    """where the reading begins a new line; None: nowhere"""


class Looked(NamedTuple):
    """The readings of one frame as the smoothing took them. Arrays (m,), which never change again."""

    reading: FloatArray
    noise: FloatArray
    """standard deviation of a reading"""
    std: FloatArray
    """standard deviation of the smoothed readings by the noise"""
    line: FloatArray
    """(ROWS, m) memory of the smoothing after the reading"""

    def doubt_kpa(self, gain_kpa: FloatArray, steepness_kpa: FloatArray) -> FloatArray:
        """(m,) standard deviation in kPa of pressures that follow from the smoothed readings.

        A fast change of the load may be answered by less or by more of r than the smoothed readings are inverted with.

        Args:
            gain_kpa: (m,) pressure per r of the smoothed readings.
            steepness_kpa: (2,) pressure per r of a fast rise and of a fast fall that the smoothing has not noticed yet;
                0: the gain.
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

        A change of the load that the line has not taken up is anything between the line and a little beyond the
        reading, since noise may hide as much: errors up to there are to stay within :data:`SIGMAS` deviations.
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
    """By readings since the line began, the first one included; (n,) each, rows of ``rows`` (3, n)."""

    level: FloatArray
    slope: FloatArray
    """times the time between readings"""
    std: FloatArray
    """standard deviation of the level over that of a reading"""
    rows: FloatArray


@lru_cache(maxsize=1024)
def window_s(noise: float, dt_s: float) -> float:
    """The time in which the weight of a reading should fall to 1/e, for noise relative to the range of readings.

    The variance of the line's end falls with the window as noise^2 dt/T, its bias from curvature grows as T^4: the
    best window is proportional to (noise^2 dt)^(1/5). The factor is the project's own, from taps and presses.
    """
    best = 10.0 * (noise**2 * dt_s) ** 0.2
    steps = round(2 * math.log2(min(max(best, SHORTEST_S), LONGEST_S)))  # few different tables
    return float(2.0 ** (steps / 2))


@lru_cache(maxsize=64)
def gains(steps: float) -> Gains:
    """Gains of a window of ``steps`` readings, in units of the time between readings (the slope's too).

    The last entry is the limit for many readings. The gains of the Kalman filter are the covariances of its level and
    slope, whose inverse is a sum over readings: the table takes no loop.
    """
    age = np.arange(min(int(4 * steps) + 3, 4001), dtype=np.float64)
    weight = np.exp(-age / steps)
    # Information of level and slope: discounted sums over the ages of the readings. A line through few readings is
    # held flat by the usual slope.
    sum_0, sum_1, sum_2 = (np.cumsum(weight * age**power) for power in range(3))
    sum_2 += weight / min(STEEPEST / steps, 1.0) ** 2
    spread = sum_0 * sum_2 - sum_1**2
    level = sum_2 / spread
    slope, std = sum_1 / spread, np.sqrt(level)
    rows = np.array([level, slope, std])
    return Gains(rows[0], rows[1], rows[2], rows)


def begin(level: FloatArray, readings: float = 0.0) -> FloatArray:
    """The memory (ROWS, m) of cells whose level is known as well as from so many ``readings``."""
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
    """Let the next reading begin a new line, whatever it is; changes ``line``."""
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
    """New lines where ``begun``: a far reading begins one by itself, a near one together with the line so far."""
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
    """Gains for a window on a grid of 10 %, so that time stamps that jitter share a table."""
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
        before: (ROWS, m), to keep the line from before.
        cells: (m,) their indices among all n cells.
        on_line: (n,) for each cell the readings since its line began; written to if ``keeps``.
        keeps: whether the noise meter looks at the next frame, since only then ``on_line`` is read.
        dt_s: since the last readings.
        gains: (3, n), ``rows`` of :class:`Gains`.
        taken: (4, m) readings and their noise; given their smoothed values and the standard deviations of these.
        begun: (m,) to mark where a new line begins.
        large: jump from the line before, from which it may matter that a line begins.

    Returns:
        Whether one begins, and a cell has jumped by more than that.
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
