"""A material that none of the product's models describes, to judge estimators by.

Hysteresis is a Preisach ensemble of relays, creep a fractional one (a power law of time, no time constant at all).
Nothing here is shared with the forward models or the estimators.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import fftconvolve

from ..common.arrays import FloatArray


def preisach(load: FloatArray, rng: np.random.Generator, *, relays: int = 400) -> FloatArray:
    """Share (n,) of relays that are on under a load (n,): each switches on above one level, off below a lower one."""
    on = rng.uniform(0, 1, relays)
    off = on - rng.exponential(0.12, relays)
    state = np.zeros(relays, dtype=bool)
    share = np.empty_like(load)
    for n, value in enumerate(load):
        state = (state & (value > off)) | (value >= on)
        share[n] = state.mean()
    return share


def fractional_creep(load: FloatArray, dt_s: float, *, order: float = 0.2, unit_s: float = 60.0) -> FloatArray:
    """Response (n,) to a load (n,) of a material that creeps as (t / ``unit_s``)^``order`` under a unit step."""
    changes = np.diff(load, prepend=0.0)
    compliance = ((np.arange(len(load)) + 1) * dt_s / unit_s) ** order
    response: FloatArray = fftconvolve(changes, compliance)[: len(load)]
    return response


def presses(rng: np.random.Generator, seconds: float, dt_s: float, *, holds: bool) -> FloatArray:
    """A normalised load (n,): presses of random height and speed, with pauses and holds or without any."""
    times, levels = [0.0, 5.0], [0.0, 0.0]
    while times[-1] < seconds:
        level = rng.uniform(0.3, 1.0) if levels[-1] < 0.3 else rng.uniform(0.0, 0.25)
        times.append(times[-1] + rng.uniform(1.0, 12.0))
        levels.append(level)
        if holds:
            times.append(times[-1] + rng.exponential(15.0))
            levels.append(level)
    at = np.arange(0, seconds, dt_s)
    load: FloatArray = np.interp(at, times, levels)
    return load
