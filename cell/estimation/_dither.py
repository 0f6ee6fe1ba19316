"""What noise leaves of the steps of an ADC in a mean of readings (dither).

Steps that noise makes random are noise themselves, which the smoothing averages away.
"""

from __future__ import annotations

import math

import numpy as np

from ...arrays import FloatArray
from ...compiled import loop

DITHER = math.pi**2 / 24.0
"""noise of variance v and steps of q leave exp(-2 pi^2 v / q^2) of the steps in a mean (Widrow, Kollar: Quantization
Noise, 2008). A fourth of that exponent is this constant times v over the variance q^2 / 12 of the steps;
(1 + x / 4)^-4 bounds exp(-x), and machine code rounds it as NumPy does"""
_ZERO, _ONE = np.array(0.0), np.array(1.0)


def undithered(ratio: FloatArray) -> FloatArray:
    """(m,) share of the steps that is left, for standard deviations (m,) of readings over those by steps alone."""
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
