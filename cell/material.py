"""What the paper says of the material around the cell: concentration, sensitivity, temperature, ageing."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from .lag import FloatArray
from .models import AsymmetricModel, ContactModel, M10Model, Model, PaperModel


def percolation_resistance(
    mass_fraction: ArrayLike,
    *,
    threshold: float = 0.008,
    exponent: float = 2.0,
    reference_fraction: float = 0.015,
    reference_resistance_ohm: float = 10000.0,
) -> FloatArray:
    """R0 of a cell against its carbon-black mass fraction (P1): R0 ~ (fraction - threshold)^-exponent, in ohm.

    An exponent of about 2 is published for carbon black (1.95); threshold and reference are the project's own, so
    that the paper's choice of 1.5 % gives the example cell. At or below the threshold nothing conducts: inf.

    Raises:
        InputError: the reference does not conduct.
    """
    if not reference_fraction > threshold:
        raise InputError(f"reference fraction {reference_fraction} must lie above the threshold {threshold}")
    above = np.maximum(np.asarray(mass_fraction, dtype=np.float64) - threshold, 0.0)
    with np.errstate(divide="ignore"):
        resistance: FloatArray = reference_resistance_ohm * ((reference_fraction - threshold) / above) ** exponent
    return resistance


def percolation_sensitivity(
    mass_fraction: ArrayLike, *, threshold: float = 0.008, exponent: float = 2.0, strain: float = 0.2
) -> FloatArray:
    """S = (Rmax - R0)/R0 against mass fraction (P1, Fig. 3): it rises as the fraction falls.

    Saturation is where deformation has undone the share ``strain`` of the conducting fraction, so that the
    effective fraction is (1 - strain) of the true one: S = ((f - t)/((1 - strain) f - t))^exponent - 1, inf where
    that leaves nothing that conducts.
    """
    fraction = np.asarray(mass_fraction, dtype=np.float64)
    rest = percolation_resistance(fraction, threshold=threshold, exponent=exponent)
    pressed = percolation_resistance(fraction * (1 - strain), threshold=threshold, exponent=exponent)
    known = np.isfinite(rest)
    sensitivity: FloatArray = np.divide(pressed, rest, out=np.full(fraction.shape, np.nan), where=known) - 1
    return sensitivity


def sensitivity(model: Model, full_scale_kpa: float, rest_resistance_ohm: float) -> float:
    """S = (Rmax - R0)/R0 of a cell at equilibrium under full scale; negative where contact dominates (P2)."""
    match model:
        case PaperModel() | AsymmetricModel():
            return model.gain_per_kpa * full_scale_kpa
        case M10Model():
            return model.a + model.b + model.alpha1 + model.alpha2
        case ContactModel():
            return 1 / (1 + rest_resistance_ohm / model.full_scale_resistance_ohm) - 1


def contact_resistance(
    force: ArrayLike, *, coefficient: float, exponent: float = 1.0, rest_resistance_ohm: float = np.inf
) -> FloatArray:
    """R of touching electrodes (P2): coefficient force^-exponent, in parallel with what conducts without force."""
    conductance = np.maximum(np.asarray(force, dtype=np.float64), 0.0) ** exponent / coefficient
    with np.errstate(divide="ignore"):
        resistance: FloatArray = 1 / (conductance + 1 / rest_resistance_ohm)
    return resistance


def drifted_rest_resistance(
    rest_resistance_ohm: ArrayLike,
    *,
    temperature_change_c: float = 0.0,
    per_degree: float = 0.07,
    age_s: float = 0.0,
    per_decade: float = 0.0,
) -> FloatArray:
    """R0 after a change of temperature and with age: what a calibrated cell may have become.

    Temperature enters exponentially (7 % per degree is published for one rubber with 50 phr carbon black), age as a
    share ``per_decade`` of log10(1 + age in hours). Hand the result to ``Cell.forward`` or ``Cell.estimator``.
    """
    warm = np.exp(np.log1p(per_degree) * temperature_change_c)
    aged = 1 + per_decade * np.log10(1 + age_s / 3600)
    drifted: FloatArray = np.asarray(rest_resistance_ohm, dtype=np.float64) * warm * aged
    return drifted
