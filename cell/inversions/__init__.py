"""Readings to pressures: one :class:`..estimation.Inversion` for each material and method.

====================  ==========================================================================================
:mod:`._static`       without memory: the equilibrium curve of a model, or the calibrated cubic
:mod:`._turning`      the paper's cell, by two hypotheses about when the pressure last turned; its rooms are named there
:mod:`._recovery`     the same cell at rest: a Kalman filter of what it remembers
:mod:`._still`        the same cell after a light touch: whether the load is again what it was
:mod:`._onset`        the same cell under presses that rise slowly while it recovers: Page's test
:mod:`._way`          how far loads go to and fro within the noise
:mod:`._together`     the same, told by neighbours: tremors that cells of a contact share
:mod:`._meter`        both, and how much of that way has not been counted yet
:mod:`._sway`         the paper's cell under such loads: what it keeps of them is taken back
:mod:`._inverse`      ``asymmetric`` and ``m10`` cells, by Newton's method
:mod:`._chains`       ``m10`` cells under such loads: chains that break unnoticed are told from the load
:mod:`._switched`     the paper's own estimator (P8), the baseline
:mod:`._learned`      linear maps of the memories in :mod:`._features`, as calibration learned them
====================  ==========================================================================================
"""

from ._features import Bank, play_follow
from ._inverse import AsymmetricInversion, margin
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
from ._static import EquilibriumInversion, StaticCurveInversion, rest_slope
from ._switched import SwitchedInversion
from ._turning import TurningInversion

__all__ = [
    "BEYOND",
    "DRIFT",
    "UNKNOWN_DRIFT",
    "AsymmetricInversion",
    "Bank",
    "EquilibriumInversion",
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
    "TurningInversion",
    "margin",
    "play_follow",
    "rest_slope",
]
