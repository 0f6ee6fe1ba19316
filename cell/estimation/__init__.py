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
from ._scale import Contact, Logarithm, Ratio, Scale

__all__ = [
    "LOADS",
    "UNKNOWN",
    "USUAL",
    "Conditions",
    "Contact",
    "Estimator",
    "Inversion",
    "Logarithm",
    "Material",
    "Ratio",
    "Scale",
    "credible_readings",
    "longest_s",
]
