"""First-order lags x' = (u - x)/T, discretised exactly for an input that is linear over each step (first-order hold).

All dynamic parts of a cell are such lags. Forward models and their inverses therefore agree up to rounding at any time
step, and the response to a piecewise linear load does not depend on the sampling.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import FloatArray
from ...common.compiled import Row, loop

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


@loop
def weights_of(dt_s: float, time_constant_s: float) -> tuple[float, float]:
    """``gone`` and ``ramp`` of one step: x1 = x0 + (u0 - x0) gone + (u1 - u0) ramp.

    gone = 1 - exp(-dt/T) is the fraction of the state that the lag forgets. ramp = 1 - gone T/dt is its response, at
    the end of the step, to a ramp that rises by 1 over the step. Both keep full relative precision from dt/T = 1e-300
    to infinity, so that an hour-long lag sampled at 10 kHz does not drift.
    """
    z = dt_s / time_constant_s
    gone = -math.expm1(-z)
    if z < 1e-3:  # 1 - gone/z cancels; here the series is exact
        return gone, z / 2 * (1 - z / 3 * (1 - z / 4 * (1 - z / 5)))
    return gone, 1.0 - gone / z


@loop
def _weights_each(dt_s: Row, time_constants_s: Row, gone: Row, ramp: Row) -> None:
    for i in range(gone.size):
        gone[i], ramp[i] = weights_of(dt_s[i], time_constants_s[i])


def weights(dt_s: ArrayLike, time_constant_s: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """:func:`weights_of` for arrays, which are broadcast."""
    z = np.broadcast_arrays(np.asarray(dt_s, dtype=np.float64), np.asarray(time_constant_s, dtype=np.float64))
    gone, ramp = np.empty(z[0].shape), np.empty(z[0].shape)
    steps, constants = (np.array(each).ravel() for each in z)
    _weights_each.unchecked(steps, constants, gone.reshape(-1), ramp.reshape(-1))
    return gone, ramp
