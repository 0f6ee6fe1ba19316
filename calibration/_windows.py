"""Mean, noise (successive differences) and edges of signals that were sampled frame by frame."""

from __future__ import annotations

import numpy as np

from ..common.arrays import FloatArray


def window_mean(values: FloatArray) -> FloatArray:
    """Mean over the frames; NaN for a cell without readings in a fifth of them or more."""
    if not len(values):
        return np.full(values.shape[1:], np.nan)
    known = np.isfinite(values)
    mean = np.where(known, values, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.where(known.mean(axis=0) > 0.8, mean, np.nan)


def noise(values: FloatArray) -> FloatArray:
    """Standard deviation from frame to frame, by successive differences, so that a trend does not count."""
    if len(values) < 2:
        return np.zeros(values.shape[1:])
    squares = np.diff(values, axis=0) ** 2
    known = np.isfinite(squares)
    mean = np.where(known, squares, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    deviation: FloatArray = np.sqrt(mean / 2)
    return deviation


def corners(time_s: FloatArray, load: FloatArray) -> FloatArray:
    """Times (4,) of a load's trapezoid: begin and end of the rise, begin and end of the fall.

    The rise is the line through the crossings of 10 and 90 % of the load. The fall is the line through the crossings of
    90 and 50 %, since a press ends at 50 %.
    """
    last_half = load[len(load) // 2 : -1] if len(load) > 4 else load
    level = float(np.median(last_half))
    up90 = _crossing(time_s, load, 0.9 * level, int(np.argmax(load >= 0.9 * level)))
    before = np.flatnonzero((load < 0.1 * level) & (time_s < up90))
    up10 = _crossing(time_s, load, 0.1 * level, int(before[-1]) + 1 if before.size else 1)
    above = np.flatnonzero(load >= 0.9 * level)
    down90 = _crossing(time_s, load, 0.9 * level, min(int(above[-1]) + 1, len(load) - 1))
    down50 = max(_crossing(time_s, load, 0.5 * level, len(load) - 1), down90)
    rise_s, fall_s = max(up90 - up10, 0.0) / 8, (down50 - down90) / 4
    start = up10 - rise_s
    there = max(up90 + rise_s, start + 1e-6)
    falls = max(down90 - fall_s, there + 1e-6)
    gone = max(down50 + 5 * fall_s, falls + 1e-6)
    return np.array([start, there, falls, gone])


def _crossing(time_s: FloatArray, load: FloatArray, level: float, after: int) -> float:
    """Time at which the load crosses ``level`` between frames ``after`` - 1 and ``after``, by linear interpolation."""
    first, last = max(after - 1, 0), after
    change = load[last] - load[first]
    share = 1.0 if change == 0 else float(np.clip((level - load[first]) / change, 0.0, 1.0))
    return float(time_s[first] + share * (time_s[last] - time_s[first]))
