"""Inverse models from resistance to pressure: one :class:`..estimation.Inversion` for each material and method.

====================  ==========================================================================================
:mod:`._static`       without memory: the equilibrium curve of a model, or the calibrated cubic
:mod:`._turning`      the paper's cell, by two hypotheses about when the pressure last turned; lists its own modules
:mod:`._inverse`      ``asymmetric`` and ``m10`` cells, by the equation of a step; :mod:`._change_over` solves rare ones
:mod:`._switched`     the paper's own estimator (P8), the baseline
:mod:`._learned`      linear maps of the memories in :mod:`._features`, as calibration learned them
====================  ==========================================================================================

A load that goes to and fro within the noise leaves an error in either kind of cell that the inverse does not notice:

====================  ==========================================================================================
:mod:`._variances`    Allan and Hadamard variances of readings
:mod:`._way`          the path length of the load (its "way", up and down), from these variances
:mod:`._together`     the same, from the cross variance of a cell's neighbours
:mod:`._meter`        own readings and neighbours combined; the part of the way that the inverse has not counted yet
:mod:`._sway`         the error that the way leaves in the paper's cell
:mod:`._chains`       the error that the way leaves in ``m10`` cells: chains that break unnoticed
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
