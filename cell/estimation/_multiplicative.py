"""Multiplicative noise: estimates the variance function of the readings by weighted least squares (pressed cells).

Noise of a supply, of a resistive divider, or of the cell itself scales with the conductance. Its standard deviation in
r is proportional to 1 + r; that of additive noise is proportional to (1 + r)^2. The scatter of pressed cells shows how
much of a board's noise is of either kind (Davidian and Carroll 1987). The choice matters: at 2.5 times the resistance
at rest, noise of 1 % of the resistance stays 1 % if it is multiplicative, and becomes 2.5 % if it is additive. Noise
counts as additive, unless a multiplicative share is clear.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import FloatArray
from ...common.compiled import loop

CLEAR = 3.0
"""standard deviations by which the multiplicative share must exceed 0 to be believed"""
LONGEST = 800.0
"""largest weight of the readings seen so far; beyond it, older readings are discounted"""
WEIGHT, FOUND, COMMON, LATELY, BY_REST = range(5)
"""indices of the sums: weights of the readings; weights times the share that each reading indicates; change of the
latter per relative error of the noise at rest, since the last :meth:`MultiplicativeNoise.find`; the same, discounted as
that error is forgotten; variance by that error"""
_ONE = np.array(1.0)  # NumPy makes an array of a float in every call


class MultiplicativeNoise:
    """Estimator of the multiplicative share of the variance of own noise at rest."""

    def __init__(self) -> None:
        self.share = 0.0
        """the share; 0 while it is not clear"""
        self.sums = np.zeros(5)
        """(5,) see :data:`WEIGHT`"""

    def tell(self, ratio: FloatArray, r: FloatArray, excess: FloatArray) -> None:
        """Add readings of pressed cells to the sums (weighted least squares).

        The expectation of a squared difference over its assumed variance is 1 - (s - m) x. Here s is the true share, m
        the share assumed so far, and x minus the relative derivative of the variance with respect to the share. The
        information of a single reading is at most 1.

        Args:
            ratio: (m,) squared third differences over their variance.
            r: (m,) readings.
            excess: (m,) variance of shared noise at rest, over that of own noise.
        """
        scale = r + _ONE
        scale *= scale
        slope = (scale - _ONE) / (scale * additive(scale, self.share) + excess)
        weight = slope / (slope * slope + _ONE)
        found = slope * self.share + _ONE - ratio
        sums = np.add.accumulate([weight * slope, weight * found, weight], axis=1)[:, -1]
        sums[COMMON] /= math.sqrt(ratio.size)  # the errors of the cells' noise at rest are independent
        self.sums[: COMMON + 1] += sums

    def find(self, averaged: float, looks: int) -> None:
        """Update the share. It is 0 where chance, or an error of the noise at rest, may explain the readings.

        ``averaged`` is the weight of one look in the average of the noise at rest; ``looks`` is the number of looks
        since the last call.
        """
        weight, found, common, lately, by_rest = self.sums.tolist()
        if not weight:
            return
        lately = lately * (1.0 - averaged) ** looks + common
        by_rest += 2.0 * averaged * common * (2.0 * lately - common)
        share, doubt = found / weight, math.sqrt(2.0 * weight + by_rest) / weight
        self.share = min(share, 1.0) if share > CLEAR * doubt else 0.0
        less = min(LONGEST / weight, 1.0)
        self.sums[:] = weight * less, found * less, 0.0, lately * less, by_rest * less * less

    def state(self) -> FloatArray:
        """(6,) the state."""
        return np.array([self.share, *self.sums])

    def restore(self, state: FloatArray) -> None:
        """Continue from a :meth:`state`."""
        self.share, self.sums = state.item(0), state[1:].copy()


def additive(squares: FloatArray, multiplicative: float) -> FloatArray:
    """(m,) variance of noise with a ``multiplicative`` share, over the variance if all of it were additive.

    Args:
        squares: (m,) squares of 1 + r. Below rest (squares < 1) the ratio is 1.
        multiplicative: share of the variance at rest.
    """
    part: FloatArray = multiplicative / np.maximum(squares, _ONE)
    part += 1.0 - multiplicative
    return part


@loop
def additive_of(square: float, multiplicative: float) -> float:
    """:func:`additive` for one cell."""
    return multiplicative / max(square, 1.0) + (1.0 - multiplicative)
