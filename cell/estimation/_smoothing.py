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

import numpy as np

from ...common.arrays import FloatArray, IntArray
from ...common.compiled import Places, Records, Row, Rows, loop
from .._state import CellState, NoiseState

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
HIDDEN, SIGMAS = 3.3, 3.0
"""standard deviations of noise that may separate a reading from its noiseless value; and standard deviations of the
estimate within which an unnoticed change of the load must lie"""
LEAST_NOISE = 1e-9
"""added to the standard deviation of r, to keep divisions by the noise finite"""
FAR_SHARE = 1.0 - NEAR


# -- gains -------------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=1024)
def gains_for(noise: float, dt_s: float) -> FloatArray:
    """(3, n) gains for ``noise`` relative to the range of readings, and frames every ``dt_s``; see :func:`gains`.

    Windows are rounded to a grid of 10 %, so that jittering time stamps share a table.
    """
    steps = max(window_s(noise, dt_s) / max(dt_s, 1e-9), 0.5)
    return gains(float(1.1 ** round(math.log(steps) / math.log(1.1))))


def window_s(noise: float, dt_s: float) -> float:
    """The window T in seconds, for ``noise`` relative to the range of readings: weights fall to 1/e within T.

    The variance of the line's end falls as noise^2 dt/T. Its bias by curvature, squared, grows as T^4. The best window
    is therefore proportional to (noise^2 dt)^(1/5). The factor is the project's own, from taps and presses.
    """
    best = 10.0 * (noise**2 * dt_s) ** 0.2
    steps = round(2 * math.log2(min(max(best, SHORTEST_S), LONGEST_S)))  # few different tables
    return float(2.0 ** (steps / 2))


@lru_cache(maxsize=64)
def gains(steps: float) -> FloatArray:
    """(3, n) Kalman gains of a window of ``steps`` readings, by the number of readings since the line began.

    Rows: gain of the level; of the slope times the time between readings; and the standard deviation of the level over
    that of a reading. The unit of time is the time between readings. The last entry is the limit for many
    readings. The gains are entries of the covariance matrix of level and slope. Its inverse, the information matrix, is
    a sum over readings, so that the table needs no loop.
    """
    age = np.arange(min(int(4 * steps) + 3, 4001), dtype=np.float64)
    weight = np.exp(-age / steps)
    # Information matrix of level and slope: discounted sums over the ages of the readings. A prior on the slope
    # (STEEPEST) keeps lines through few readings flat.
    sum_0, sum_1, sum_2 = (np.cumsum(weight * age**power) for power in range(3))
    sum_2 += weight / min(STEEPEST / steps, 1.0) ** 2
    spread = sum_0 * sum_2 - sum_1**2
    level = sum_2 / spread
    return np.array([level, sum_1 / spread, np.sqrt(level)])


# -- lines -------------------------------------------------------------------------------------------------------------


def begin(cells: Records[CellState], places: IntArray, r: FloatArray) -> None:
    """Begin the lines of cells with one reading ``r`` (k,)."""
    cells["level"][places], cells["count"][places] = r, 1.0
    for name in ("slope", "up", "down"):
        cells[name][places] = 0.0


def interrupt(cells: Records[CellState], places: IntArray) -> None:
    """Make the next readings of cells start a new line, whatever their value."""
    cells["up"][places] = cells["down"][places] = np.inf


@loop
def take_each(cells: Records[CellState], places: Places, r: Row, at_rest: Row) -> None:
    """Take the readings ``r`` (n,) of a frame; their noise at rest is ``at_rest`` (n,).

    Boards measure currents: their noise is constant in conductance, and proportional to (1 + r)^2 in r.
    """
    for k in range(places.size):
        i = places[k]
        cell, scale = cells[i], cells[i].level + 1.0
        cell.reading = r[i]
        cell.noise = scale * scale * at_rest[i] + LEAST_NOISE


@loop
def take_exactly_each(cells: Records[CellState], places: Places, r: Row) -> None:
    """Take the readings ``r`` (n,) of a frame, which are exact: no line is needed."""
    for k in range(places.size):
        cell = cells[places[k]]
        cell.reading = cell.level = r[places[k]]
        cell.noise, cell.level_std = 0.0, 0.0


@loop
def smooth_each(
    cells: Records[CellState], places: Places, noise: Records[NoiseState], dt_s: float, gains: Rows, large: float
) -> bool:
    """Take the readings of a frame into the lines; ``gains`` (3, n) are those of :func:`gains_for`.

    Returns:
        Whether a reading starts a new line, and one is farther than ``large`` from the line before.
    """
    last = gains.shape[1] - 1
    any_begun, any_large = False, False
    for k in range(places.size):
        cell = cells[places[k]]
        cell.level_before, cell.slope_before, cell.count_before = cell.level, cell.slope, cell.count
        cell.up_before, cell.down_before = cell.up, cell.down
        level = cell.level + cell.slope * dt_s
        off = cell.reading - level
        z = off / cell.noise
        cell.up = max(cell.up + z - ALLOWED, 0.0)
        cell.down = max(cell.down - z - ALLOWED, 0.0)
        cell.count += 1.0
        n = min(int(cell.count), last)
        cell.level = level + gains[0, n] * off
        cell.slope += gains[1, n] * off / dt_s
        cell.level_std = gains[2, n] * cell.noise
        cell.begun = 0.0
        if cell.up > SUM or cell.down > SUM:
            cell.level, cell.slope, cell.count, cell.up, cell.down = cell.reading, 0.0, 0.0, 0.0, 0.0
            if abs(z) < FAR:
                cell.level = cell.reading - off * FAR_SHARE
                cell.count = 1.0
            cell.level_std, cell.begun = cell.noise, 1.0
            any_begun = True
        noise[places[k]].on_line = cell.count
        any_large |= abs(cell.reading - cell.level_before) > large
    return any_begun and any_large


@loop
def doubt_of(cell: CellState) -> float:
    """Standard deviation of the level, with a change of the load that the line has not followed yet.

    The true value then lies between the line and the reading, or beyond the reading by as much as noise hides. Errors
    up to there stay within :data:`SIGMAS` standard deviations:

        std = max((|reading - line| + HIDDEN noise) / SIGMAS, std of the line)
    """
    return max((abs(cell.reading - cell.level) + cell.noise * HIDDEN) * (1.0 / SIGMAS), cell.level_std)
