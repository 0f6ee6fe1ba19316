"""Causal estimation of pressure from resistance: one switching filter for all materials.

:mod:`._estimator` lists the steps of a frame. :mod:`._modes` has the dynamics, the modes and every tuned number,
:mod:`._filter` the state and the kernel. :class:`Inversion` is the interface by which a material turns what the filter
follows into pressures; its subclasses are in :mod:`..inversions`.
"""

from ._conditions import Conditions
from ._estimator import Estimator
from ._held import longest_s
from ._inversion import LOADS, UNKNOWN, USUAL, Inversion, credible_readings
from ._modes import Material
from ._scale import CONTACT, LOGARITHM, RATIO, Scale, scale_of

__all__ = [
    "CONTACT",
    "LOADS",
    "LOGARITHM",
    "RATIO",
    "UNKNOWN",
    "USUAL",
    "Conditions",
    "Estimator",
    "Inversion",
    "Material",
    "Scale",
    "credible_readings",
    "longest_s",
    "scale_of",
]
