"""The share of the noise that scales with the conductance, told by readings of pressed cells (a variance function).

Noise of a supply, of a resistive divider, or of the cell itself scales with the conductance. Its standard deviation in
r is proportional to 1 + r, that of additive noise to (1 + r)^2. Readings of pressed cells tell how much of a board's
noise is of either kind (Davidian and Carroll 1987). Taken for additive, noise of 1 % at rest would be 2.5 % at 2.5
times the resistance at rest. So no more is taken for multiplicative than is clear.
"""

from __future__ import annotations

import math

import numpy as np

from ...arrays import FloatArray
from ...compiled import loop

CLEAR = 3.0
"""standard deviations by which the multiplicative share of the noise must exceed none"""
LONGEST = 800.0
"""information about that share, as of so many readings, beyond which older readings count for less"""
WEIGHT, FOUND, COMMON, LATELY, BY_REST = range(5)
"""places of the sums: weights of readings; the same times the share that each tells; by how much an error of the noise
at rest would change the latter, since the last time; the same of late, as long as that error lasts; and the variance
that follows"""
_ONE = np.array(1.0)  # NumPy makes an array of a float in every call


class MultiplicativeNoise:
    """The multiplicative share of the variance of own noise at rest."""

    def __init__(self) -> None:
        self.share = 0.0
        """as far as it is clear"""
        self.sums = np.zeros(5)
        """that tell it, see :data:`WEIGHT`"""

    def tell(self, ratio: FloatArray, r: FloatArray, excess: FloatArray) -> None:
        """Let readings of pressed cells tell the share (weighted least squares).

        A square over its variance is 1 - (s - m) x, where s is the share, m what was taken for it, and x the
        derivative. A single reading weighs no more than 1.

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
        sums[COMMON] /= math.sqrt(ratio.size)  # errors of several cells
        self.sums[: COMMON + 1] += sums

    def find(self, averaged: float, looks: int) -> None:
        """Renew the share: none, where chance or an error of the noise at rest may be the cause.

        ``averaged`` is the share of a look in the average of the noise at rest; ``looks`` have been taken since the
        last time.
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
        """(6,) all that is remembered."""
        return np.array([self.share, *self.sums])

    def restore(self, state: FloatArray) -> None:
        """Continue from a :meth:`state`."""
        self.share, self.sums = state.item(0), state[1:].copy()


def additive(squares: FloatArray, multiplicative: float) -> FloatArray:
    """(m,) variance of noise of which a share is ``multiplicative``, over what it would be if all were additive.

    Args:
        squares: (m,) of 1 + r. Cells that read below rest have the noise of rest.
        multiplicative: share of the variance at rest.
    """
    part: FloatArray = multiplicative / np.maximum(squares, _ONE)
    part += 1.0 - multiplicative
    return part


@loop
def additive_of(square: float, multiplicative: float) -> float:
    """:func:`additive` of one cell."""
    return multiplicative / max(square, 1.0) + (1.0 - multiplicative)
