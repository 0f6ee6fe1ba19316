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

from ..arrays import BoolArray, FloatArray, IntArray

JUMP = 4.0
"""standard deviations of a single reading that begin a new line"""
ALLOWED = 0.75
"""standard deviations that a reading may be off without adding to the sum"""
SUM = 4.0
"""standard deviations of the sum that begin a new line"""
STEEPEST = 15.0
"""standard deviations of a reading by which readings usually change within the window"""
SHORTEST_S, LONGEST_S = 0.03, 3.0
"""limits of the time in which the weight of a reading falls to 1/e"""
LEVEL, SLOPE, COUNT = range(3)
SUMS, RUNS = slice(3, 5), slice(5, 7)
"""rows of the memory: the line now, readings since it began; sums of departures upwards and downwards, and readings
since each sum was last zero"""
ROWS = 7


class Smoothed(NamedTuple):
    """What is made of a reading; all (m,)."""

    level: FloatArray
    std: FloatArray
    """standard deviation of the level"""
    jumped: BoolArray
    """where this single reading was so far off that it began a new line"""


class Gains(NamedTuple):
    """By readings since the line began, the first one included."""

    level: FloatArray
    slope: FloatArray
    """per second"""
    std: FloatArray
    """standard deviation of the level over that of a reading"""


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

    The last entry is the limit for many readings.
    """
    forget = np.exp(1 / steps)
    level, slope, std = [1.0], [0.0], [1.0]
    # Covariance of level and slope, over the variance of a reading: a line through few readings is held flat.
    a, b, c = 1.0, 0.0, min(STEEPEST / steps, 1.0) ** 2
    for _ in range(min(int(4 * steps) + 2, 4000)):
        a, b, c = forget * (a + 2 * b + c), forget * (b + c), forget * c
        total = a + 1
        level.append(a / total)
        slope.append(b / total)
        a, b, c = a / total, b / total, c - b * b / total
        std.append(np.sqrt(a))
    return Gains(np.array(level), np.array(slope), np.array(std))


def begin(level: FloatArray, readings: float = 0.0) -> FloatArray:
    """The memory (ROWS, m) of cells whose level is known as well as from so many ``readings``."""
    line = np.zeros((ROWS, *level.shape))
    line[LEVEL], line[COUNT] = level, readings
    return line


def interrupt(line: FloatArray) -> None:
    """Let the next reading begin a new line, whatever it is; changes ``line``."""
    line[SUMS], line[RUNS] = np.inf, 0.0


def advance(line: FloatArray, dt_s: float, window: float, r: FloatArray, noise: FloatArray) -> Smoothed:
    """Take readings ``r`` (m,) with standard deviation ``noise`` (m,); changes ``line`` (ROWS, m)."""
    table = _table(window, dt_s)
    expected = line[SLOPE] * dt_s
    expected += line[LEVEL]
    off = r - expected
    z = off / noise
    jumped = np.abs(z) > JUMP
    sums, runs, count = line[SUMS], line[RUNS], line[COUNT]
    sums[0] += z
    sums[1] -= z
    sums -= ALLOWED
    np.maximum(sums, 0.0, out=sums)
    runs += 1.0
    runs *= sums > 0
    count += 1.0
    np.minimum(count, len(table.level) - 1, out=count)
    left = np.maximum(sums[0], sums[1]) > SUM
    left |= jumped
    n: IntArray = count.astype(np.intp)
    level = expected + table.level.take(n) * off
    line[SLOPE] += table.slope.take(n) * (off / dt_s)
    if np.count_nonzero(left):
        _begin_again(line, np.flatnonzero(left), expected, r, noise, jumped, level)
        n = count.astype(np.intp)
    line[LEVEL] = level
    return Smoothed(line[LEVEL], table.std.take(n) * noise, jumped)


def _begin_again(
    line: FloatArray,
    cells: IntArray,
    expected: FloatArray,
    r: FloatArray,
    noise: FloatArray,
    jumped: BoolArray,
    level: FloatArray,
) -> None:
    """New lines for ``cells`` that left theirs; changes ``line`` and ``level``.

    After a jump the reading itself begins the line. After a run of small departures to one side the mean of that run
    does, which the sum and the length of the run give.
    """
    sums, runs = line[SUMS, cells], line[RUNS, cells]
    side = np.argmax(sums, axis=0)
    every = np.arange(cells.size)
    run, total = np.maximum(runs[side, every], 1.0), sums[side, every]
    mean_off = np.where(side == 0, 1.0, -1.0) * (total / run + ALLOWED) * noise[cells]
    at_once = jumped[cells] | ~np.isfinite(total)
    level[cells] = np.where(at_once, r[cells], expected[cells] + mean_off)
    line[SLOPE, cells] = 0.0
    line[COUNT, cells] = np.where(at_once, 0.0, np.minimum(run, 4.0) - 1.0)
    line[SUMS, cells] = 0.0
    line[RUNS, cells] = 0.0


@lru_cache(maxsize=1024)
def _table(window: float, dt_s: float) -> Gains:
    """Gains for a window on a grid of 10 %, so that time stamps that jitter share a table."""
    steps = max(window / max(dt_s, 1e-9), 0.5)
    return gains(float(1.1 ** round(math.log(steps) / math.log(1.1))))
