"""Causal estimation of pressure from resistance, common to all materials: noise, smoothing, faults, uncertainty.

:mod:`._estimator` lists the steps of a frame and the module of each. These modules contain no model of a cell.
:class:`Inversion` is the interface by which a material turns readings into pressures; its subclasses are in
:mod:`..inversions`. :mod:`._rows` names the rows of the arrays that are passed to them.
The constants exported here are thresholds that inversions share with the estimator.
"""

from ._conditions import Conditions
from ._dither import undithered, undithered_of
from ._estimator import Estimator
from ._held import longest_s
from ._inversion import (
    DOUBT,
    DOUBTED_LOAD,
    LIGHT_LOAD,
    LOADS,
    UNKNOWN,
    USUAL,
    Inversion,
    RecentReadings,
    credible_readings,
)
from ._loops import FAR, REST_VARIANCE, RESTED
from ._neighbours import ALIKE
from ._rows import GAIN, NOISE, PRESSURE, READING, SMOOTHED, STD, VARIANCE
from ._scale import Contact, Logarithm, Ratio, Scale
from ._smoothing import COUNT, HIDDEN, SIGMAS
from ._window import RECENT, WINDOW

__all__ = [
    "ALIKE",
    "COUNT",
    "DOUBT",
    "DOUBTED_LOAD",
    "FAR",
    "GAIN",
    "HIDDEN",
    "LIGHT_LOAD",
    "LOADS",
    "NOISE",
    "PRESSURE",
    "READING",
    "RECENT",
    "RESTED",
    "REST_VARIANCE",
    "SIGMAS",
    "SMOOTHED",
    "STD",
    "UNKNOWN",
    "USUAL",
    "VARIANCE",
    "WINDOW",
    "Conditions",
    "Contact",
    "Estimator",
    "Inversion",
    "Logarithm",
    "Ratio",
    "RecentReadings",
    "Scale",
    "credible_readings",
    "longest_s",
    "undithered",
    "undithered_of",
]
