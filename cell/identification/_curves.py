"""Static calibration curves: a cubic, or a monotone regression, of the reading or of its logarithm."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np

from ...common.arrays import FloatArray
from ..inversions import BEYOND, Limits, StaticCurve

CurveName = Literal["cubic", "logarithmic", "monotone"]
CURVES: tuple[CurveName, ...] = get_args(CurveName)
POINTS = 65
"""points of a tabulated curve"""
BINS = 24
"""bins of readings in a monotone regression, half of them with equal ranges and half with equal numbers of readings"""
OUTLIERS = 1e-3
"""share of the readings at either end that a curve does not reach"""


def static_curve(name: CurveName, r: FloatArray, load: FloatArray, *, logarithmic: bool = False) -> StaticCurve:
    """The curve of a kind that fits normalised loads (n,) to readings r (n,) best by least squares.

    Curves are monotone in the direction of the recording (isotonic regression of the tabulated curve).

    Args:
        name: the kind of curve.
        r: normalised resistance.
        load: normalised load.
        logarithmic: whether the curve's reading is log(R0/R) instead of r.
    """
    x = -np.log(np.maximum(1 + r, 1e-6)) if logarithmic else r
    low, high = np.quantile(x, [OUTLIERS, 1 - OUTLIERS])
    if not high > low:
        high = low + max(abs(low), 1.0) * 1e-6
    inside = np.clip(x, low, high)
    at = np.linspace(low, high, POINTS)
    if name == "monotone":
        at, found = _binned(inside, load, low, high)
    elif name == "logarithmic" and not logarithmic:
        found = _cubic(np.log(np.maximum(1 + inside, 1e-6)), load)(np.log(np.maximum(1 + at, 1e-6)))
    else:
        found = _cubic(inside, load)(at)
    rises = bool(np.cov(inside, load)[0, 1] >= 0)
    monotone = _isotonic(found, np.ones_like(found), rises)
    lowest, highest = np.percentile(load, [0.1, 99.9])
    limits = Limits(lowest=min(float(lowest), 0.0), highest=max(float(highest), 1.0) * BEYOND)
    return StaticCurve(
        readings=tuple(at.tolist()),
        loads=tuple(monotone.tolist()),
        logarithmic=logarithmic,
        limits=limits,
        std_kpa=1.0,
    )


def answers(curve: StaticCurve, r: FloatArray) -> FloatArray:
    """The normalised loads (n,) that a curve shows for readings r (n,)."""
    return np.clip(curve.load(r), curve.limits.lowest, curve.limits.highest)


def _cubic(x: FloatArray, load: FloatArray) -> Callable[[FloatArray], FloatArray]:
    # With few different readings the cubic is not unique, and the minimum-norm one is found; `full` avoids a warning.
    polynomial, _ = np.polynomial.Polynomial.fit(x, load, 3, full=True)
    return polynomial


def _binned(x: FloatArray, load: FloatArray, low: float, high: float) -> tuple[FloatArray, FloatArray]:
    """Readings and loads of a monotone regression of means in bins."""
    edges = np.unique(np.concatenate([np.linspace(low, high, BINS // 2), np.quantile(x, np.linspace(0, 1, BINS // 2))]))
    place = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    count = np.bincount(place, minlength=len(edges) - 1)
    filled = count > 0
    means = [np.bincount(place, values, minlength=len(count))[filled] / count[filled] for values in (x, load)]
    at, mean = means
    rises = bool(np.cov(x, load)[0, 1] >= 0)
    mean = _isotonic(mean, count[filled].astype(np.float64), rises)
    # The curve reaches both ends with the slope of the last bins.
    distinct = np.concatenate([[True], np.diff(at) > 1e-9 * (high - low)])
    at, mean = at[distinct], mean[distinct]
    if len(at) < 2:
        return np.array([low, high]), np.repeat(mean[:1], 2)
    ends = [
        mean[k] + (end - at[k]) * (mean[k] - mean[n]) / (at[k] - at[n]) for end, k, n in ((low, 0, 1), (high, -1, -2))
    ]
    middle = (at > low) & (at < high)
    return np.concatenate([[low], at[middle], [high]]), np.concatenate([ends[:1], mean[middle], ends[1:]])


def _isotonic(values: FloatArray, weights: FloatArray, rises: bool) -> FloatArray:
    from scipy.optimize import isotonic_regression

    return np.asarray(isotonic_regression(values, weights=weights, increasing=rises).x)
