"""Dither: the fraction of an ADC's quantisation error that remains in a mean of noisy readings.

Noise makes the quantisation error random. A random error is averaged away by the smoothing, like any noise.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import FloatArray
from ...common.compiled import loop

DITHER = math.pi**2 / 24.0
"""constant of the exponent. In a mean, noise of variance v leaves the fraction exp(-x) of the error of steps q, where
x = 2 pi^2 v / q^2 (Widrow, Kollar: Quantization Noise, 2008). x / 4 is this constant times v over the variance
q^2 / 12 of the quantisation error. We use the upper bound (1 + x / 4)^-4 of exp(-x), since compiled loops round it as
NumPy does"""
_ZERO, _ONE = np.array(0.0), np.array(1.0)


def undithered(ratio: FloatArray) -> FloatArray:
    """(m,) fraction of the quantisation error that remains in a mean.

    ``ratio`` (m,) is the standard deviation of readings over that by quantisation alone.
    """
    left: FloatArray = _ONE / (_ONE + np.maximum(ratio * ratio - _ONE, _ZERO) * DITHER)
    left *= left
    left *= left
    return left


@loop
def undithered_of(ratio: float) -> float:
    """:func:`undithered` of one cell."""
    left = 1.0 / (1.0 + max(ratio * ratio - 1.0, 0.0) * DITHER)
    left *= left
    return left * left
