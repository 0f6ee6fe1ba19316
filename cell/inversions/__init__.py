"""Inverse models from resistance to pressure: one :class:`..estimation.Inversion` for each material and method.

================  =======================================================================================
:mod:`._static`   without memory: the equilibrium curve of a model, or the calibrated cubic
:mod:`._paper`    the paper's cell, by the filter; and the paper's own estimator (P8), the baseline
:mod:`._learned`  linear maps of the memories in :mod:`._features`, as calibration learned them
================  =======================================================================================

The states are in :mod:`.._state`.
"""

from ._features import Bank, play_follow
from ._learned import (
    BEYOND,
    DRIFT,
    UNKNOWN_DRIFT,
    Learned,
    LearnedInversion,
    Limits,
    Numbers,
    Reached,
    Seen,
    StaticCurve,
    Terms,
)
from ._paper import FollowedInversion, SwitchedInversion
from ._static import EquilibriumInversion, StaticCurveInversion, rest_slope

__all__ = [
    "BEYOND",
    "DRIFT",
    "UNKNOWN_DRIFT",
    "Bank",
    "EquilibriumInversion",
    "FollowedInversion",
    "Learned",
    "LearnedInversion",
    "Limits",
    "Numbers",
    "Reached",
    "Seen",
    "StaticCurve",
    "StaticCurveInversion",
    "SwitchedInversion",
    "Terms",
    "play_follow",
    "rest_slope",
]
