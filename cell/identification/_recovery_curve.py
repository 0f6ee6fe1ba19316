"""Graphical identification by curve stripping (P6, equation 9): gains and time constants from a recovery curve."""

from __future__ import annotations

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...errors import InputError


def recovery_branches(
    time_s: FloatArray, r: FloatArray, released_kpa: float
) -> tuple[float, float, float, float, float]:
    """E1, E2, E3 in kPa and T2, T3 in s from a recovery curve, by the paper's graphical method (P6, equation 9).

    Args:
        time_s: (n,) from the last loaded sample on; the cell is unloaded from the second sample on.
        r: (n,) normalised resistance, in equilibrium at the first sample.
        released_kpa: the pressure that was released.

    The slow branch is a straight line fitted to the late part of log r. The fast branch is a line fitted to the log of
    the remainder. The elastic branch is the instantaneous drop. Raises InputError if the curve does not decay.
    """
    t = time_s[1:] - time_s[1]
    left = r[1:]
    slow_gain, slow = _line(t, left, t >= 0.5 * t[-1])
    rest = left - slow_gain * np.exp(-t / slow)
    fast_gain, fast = _line(t, rest, (rest > 0.1 * rest[0]) & (t <= 0.5 * t[-1]))
    gains = np.array([r[0] - fast_gain - slow_gain, fast_gain, slow_gain])
    if not (gains > 0).all() or not fast < slow:
        raise InputError("the recovery curve is not an instant part and two decays, the slower one smaller")
    e1, e2, e3 = (released_kpa / gains).tolist()
    return e1, e2, e3, fast, slow


def _line(t: FloatArray, y: FloatArray, where: BoolArray) -> tuple[float, float]:
    usable = where & (y > 0)
    if np.count_nonzero(usable) < 3:
        raise InputError("the recovery curve has too few samples above zero to read a decay from")
    slope, log_gain = np.polyfit(t[usable], np.log(y[usable]), 1, w=y[usable])
    if not slope < 0:
        raise InputError("the recovery curve does not decay")
    return float(np.exp(log_gain)), float(-1 / slope)
