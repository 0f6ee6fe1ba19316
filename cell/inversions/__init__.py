"""Inverse models from resistance to pressure: one :class:`..estimation.Inversion` for each material and method.

=========================  =====================================================================================
:mod:`._static`            without memory: the equilibrium curve of a model, or the calibrated curve
:mod:`._paper`             the paper's cell, and the paper's own estimator (P8), the baseline
:mod:`._linear_models`     the two linear models of the paper's cell, discretised and inverted
:mod:`._hypotheses`        the frame of the paper's cell: two hypotheses about its last turning point
:mod:`._sequential_tests`  tests on means of its readings: rest, release, onset of a load
:mod:`._tremor_path`       the error that a tremor within the noise leaves in it, by its path length
:mod:`._learned`           linear maps of the memories in :mod:`._features`, as calibration learned them
=========================  =====================================================================================

Kernels decide, cell by cell; the classes hold constants. The states are in :mod:`.._state`.
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
from ._paper import SwitchedInversion, TurningInversion
from ._static import EquilibriumInversion, StaticCurveInversion, rest_slope

__all__ = [
    "BEYOND",
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
    "play_follow",
    "rest_slope",
]
