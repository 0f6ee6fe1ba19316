"""Percolation law: resistance and sensitivity of a cell as functions of the carbon-black fraction (P1).

Above the threshold phi_c the conductance grows as (phi - phi_c)^t, with t about 2 (1.95 is published for carbon black).
A load breaks some of the conductive paths. The model treats the loss as a decrease of the fraction by d, proportional
to the load::

    r = ((phi - phi_c)/(phi - phi_c - d))^t - 1

Hence r grows as phi approaches the threshold from above. One known cell determines d.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import FloatArray
from ...errors import InputError


@dataclass(frozen=True)
class Percolation:
    """A family of mixtures that contains one known cell. Fractions are mass fractions (0.015 is 1.5 %).

    Threshold and exponent are the project's own choice: the paper gives neither.
    """

    fraction: float
    """mass fraction of the known cell"""
    rest_resistance_ohm: float
    sensitivity: float
    """(Rmax - R0)/R0 of the known cell at full scale"""
    threshold: float = 0.006
    exponent: float = 2.0

    def __post_init__(self) -> None:
        if not 0 <= self.threshold < self.fraction < 1:
            raise InputError(f"fraction {self.fraction}: expected between the threshold {self.threshold} and 1")
        if not (self.exponent > 0 and self.rest_resistance_ohm > 0 and self.sensitivity > 0):
            raise InputError("exponent, rest resistance and sensitivity: expected numbers above 0")

    def rest_resistance(self, fraction: ArrayLike) -> FloatArray:
        """R0 in ohm of mixtures; infinite at the threshold and below."""
        return self._ohm(np.asarray(fraction, dtype=np.float64) - self.threshold)

    def resistance(self, fraction: ArrayLike, load: ArrayLike) -> FloatArray:
        """Resistance in ohm under ``load`` (1 is full scale); arguments broadcast; infinite where no path remains."""
        above = self.fraction - self.threshold
        broken = above * (1.0 - (1.0 + self.sensitivity) ** (-1.0 / self.exponent))
        return self._ohm(np.asarray(fraction, dtype=np.float64) - self.threshold - broken * np.asarray(load))

    def sensitivities(self, fraction: ArrayLike) -> FloatArray:
        """(Rmax - R0)/R0 at full scale; infinite where full scale breaks the last path."""
        rest = self.rest_resistance(fraction)
        with np.errstate(invalid="ignore"):
            change = self.resistance(fraction, 1.0) / rest - 1.0
        return np.where(np.isfinite(rest), change, np.inf)

    def _ohm(self, above: FloatArray) -> FloatArray:
        known = self.fraction - self.threshold
        with np.errstate(divide="ignore"):
            ratio = np.where(above > 0, known / np.where(above > 0, above, 1.0), np.inf)
        ohm: FloatArray = self.rest_resistance_ohm * ratio**self.exponent
        return ohm
