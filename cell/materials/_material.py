"""The material of a cell: carbon-black fraction by the percolation law (P1); drift of R0 with temperature and age.

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


def drifted_rest_resistance(
    rest_resistance_ohm: ArrayLike,
    *,
    temperature_change_c: float = 0.0,
    per_degree: float = 0.07,
    age_s: float = 0.0,
    per_decade: float = 0.0,
) -> FloatArray:
    """R0 in ohm of a calibrated cell after a change of temperature, and after ageing.

    R0 grows by the factor (1 + ``per_degree``)^dT (7 % per degree is published for one rubber with 50 phr carbon
    black), and by the factor 1 + ``per_decade`` log10(1 + age in hours). Pass the result to ``Cell.forward`` or
    ``Cell.estimator``.
    """
    warm = np.exp(np.log1p(per_degree) * temperature_change_c)
    aged = 1 + per_decade * np.log10(1 + age_s / 3600)
    drifted: FloatArray = np.asarray(rest_resistance_ohm, dtype=np.float64) * warm * aged
    return drifted
