"""Causal estimation of pressure from resistance, common to all materials: noise, smoothing, faults, uncertainty.

:mod:`._estimator` lists the steps of a frame and the module of each. These modules contain no model of a cell.
:class:`Inversion` is the interface by which a material turns readings into pressures; its subclasses are in
:mod:`..inversions`. The constants exported here are thresholds that inversions share with the estimator.
"""

from ._conditions import Conditions
from ._estimator import Estimator
from ._held import longest_s
from ._inversion import (
    DOUBT,
    LOADS,
    UNKNOWN,
    USUAL,
    Inversion,
    credible_readings,
)
from ._noise import RECENT, WINDOW
from ._scale import Contact, Logarithm, Ratio, Scale
from ._smoothing import HIDDEN, SIGMAS, doubt_of

__all__ = [
    "DOUBT",
    "HIDDEN",
    "LOADS",
    "RECENT",
    "SIGMAS",
    "UNKNOWN",
    "USUAL",
    "WINDOW",
    "Conditions",
    "Contact",
    "Estimator",
    "Inversion",
    "Logarithm",
    "Ratio",
    "Scale",
    "credible_readings",
    "doubt_of",
    "longest_s",
]
