"""First-order lags x' = (u - x)/T, discretised exactly for an input that is linear over each step (first-order hold).

All dynamic parts of a cell are such lags. Forward models and their inverses therefore agree up to rounding at any time
step, and the response to a piecewise linear load does not depend on the sampling.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import FloatArray

M = TypeVar("M")
T = TypeVar("T")


class ByStep(Generic[M, T]):
    """Cache of the coefficients of a time step, by the length of the step."""

    def __init__(self, computed: Callable[[M, float], T], model: M) -> None:
        self._made_from = computed, model
        self.of = lru_cache(maxsize=1024)(partial(computed, model))

    def __reduce__(self) -> tuple[type[ByStep[M, T]], tuple[Callable[[M, float], T], M]]:
        """For pickle and copy: without the cached values."""
        return type(self), self._made_from


def forgotten(dt_s: ArrayLike, time_constant_s: ArrayLike) -> FloatArray:
    """The fraction 1 - exp(-dt/T) of its state that a lag forgets in one step, see :func:`weights`."""
    share: FloatArray = -np.expm1(-_lengths(dt_s, time_constant_s))
    return share


def _lengths(dt_s: ArrayLike, time_constant_s: ArrayLike) -> FloatArray:
    return np.asarray(np.asarray(dt_s, dtype=np.float64) / np.asarray(time_constant_s, dtype=np.float64))


def weights(dt_s: ArrayLike, time_constant_s: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """``gone`` and ``ramp`` of one step: x1 = x0 + (u0 - x0) gone + (u1 - u0) ramp.

    gone = 1 - exp(-dt/T) is the fraction of the state that the lag forgets. ramp = 1 - gone T/dt is its response, at
    the end of the step, to a ramp that rises by 1 over the step. Both keep full relative precision from dt/T = 1e-300
    to infinity, so that an hour-long lag sampled at 10 kHz does not drift. Shapes follow the arguments.
    """
    z = _lengths(dt_s, time_constant_s)
    gone = -np.expm1(-z)
    series = z / 2 * (1 - z / 3 * (1 - z / 4 * (1 - z / 5)))  # 1 - gone/z cancels; below 1e-3 this is exact
    ramp = np.where(z < 1e-3, series, 1 - gone / np.maximum(z, 1e-3))
    return gone, ramp


def symmetric(x: FloatArray, u0: FloatArray, u1: FloatArray, dt_s: ArrayLike, time_constant_s: ArrayLike) -> FloatArray:
    """The state of a lag after a step in which its input went linearly from ``u0`` to ``u1``."""
    gone, ramp = weights(dt_s, time_constant_s)
    stepped: FloatArray = x + (u0 - x) * gone + (u1 - u0) * ramp
    return stepped


def asymmetric(
    x: FloatArray,
    u0: FloatArray,
    u1: FloatArray,
    dt_s: ArrayLike,
    charging_s: ArrayLike,
    discharging_s: ArrayLike,
) -> FloatArray:
    """A lag with the time constant ``charging_s`` while u > x, else ``discharging_s``; exact through the change-over.

    Let w = u - x and u' = v, so that w' = v - w/T. From zero, w can only move towards the sign of v. Hence w changes
    sign at most once in a step, at the time T log(1 - w0/(v T)).
    """
    dt = np.asarray(dt_s, dtype=np.float64)
    w0, change = u0 - x, u1 - u0
    first = np.where((w0 > 0) | ((w0 == 0) & (change > 0)), charging_s, discharging_s)
    turns = (w0 * change < 0) & (dt > 0)
    ratio = np.divide(-w0 * dt, change * first, out=np.zeros_like(w0), where=turns)
    before = np.where(turns, np.minimum(first * np.log1p(ratio), dt), dt)
    share = np.divide(before, dt, out=np.ones_like(w0), where=dt > 0)
    middle = u0 + change * share
    x = symmetric(x, u0, middle, before, first)
    second = np.where(change > 0, charging_s, discharging_s)
    return symmetric(x, middle, u1, dt - before, second)
