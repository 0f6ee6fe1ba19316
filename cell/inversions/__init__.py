"""Inverse models from resistance to pressure: one :class:`..estimation.Inversion` for each material and method.

================  ================================================================================
The states are in :mod:`.._state`.
"""

from ._features import Bank, play_follow
from ._learned import (
    BEYOND,
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
