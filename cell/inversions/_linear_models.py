"""Exact discretisation (ramp-invariant) of the two linear models of the paper's cell, equations (3) and (8).

Each lag is stepped exactly for a pressure that is linear over the step (:mod:`..materials._lag`). The equation for the
pressure at the end of the step is then linear, and so is its inverse. Both inverses are stable, since the zeros of the
models lie in the left half plane: errors of the memory fade with time constants of the material.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.compiled import Record, loop, record
from .._state import PaperState
from ..materials import PaperModel, lag


class PaperNumbers(Record):
    """Constants of a model and of the tests on its cells; :mod:`._hypotheses` explains the thresholds."""

    full_kpa: float
    lowest_kpa: float
    """pressures allowed: the least, the largest while the memory is uncertain, and the largest"""
    usual_kpa: float
    highest_kpa: float
    least_kpa: float
    """below it nothing turns: a negative pressure is an error that fades"""
    rounding_kpa: float
    negligible_kpa: float
    turn_kpa: float
    light_turn_kpa: float
    clear_rise_kpa: float
    clear_fall_kpa: float
    grown_kpa: float
    fast_kpa: float
    round_kpa: float
    doubt_kpa2: float
    """variances: from which a memory counts as uncertain; of a load of which nothing is known; the largest that a
    memory may have lost; the largest with which a rest is averaged; and one that is beyond rounding errors"""
    unknown_kpa2: float
    most_lost_kpa2: float
    most_rested_kpa2: float
    clear_kpa2: float
    eu1_kpa: float
    etau2_kpa: float
    e1_kpa: float
    e2_kpa: float
    e3_kpa: float
    tu_s: float
    t2_s: float
    t3_s: float
    r_per_kpa: float
    """at equilibrium"""
    settled_per_kpa: float
    """1 + etau2/Eu1, by which a pressure enters the settled state of the rising model where this model begins"""
    rise_per_fall: float
    """r per kPa of a fast rise over that of a fast fall"""
    fall_share: float
    bend: float
    """difference of r per kPa of a fast rise and a fast fall"""
    exact: float
    """1: readings are taken as free of noise"""


class PaperStep(Record):
    """Weights of a time step from pressure p to p1: each lag x becomes ``kept`` x + ``free`` p + ``ramp`` p1."""

    kept_u: float
    free_u: float
    ramp_u: float
    kept_2: float
    free_2: float
    ramp_2: float
    kept_3: float
    free_3: float
    ramp_3: float
    rising_gain_kpa: float
    """pressure per r in the rising model"""
    recovery_gain_kpa: float
    settled_gain: float
    """pressure per settled state in the rising model"""
    rising_fade: float
    """share of an error of the memory that is left after the step"""
    recovery_fade: float
    rising_fade2: float
    """its square, of a variance"""
    recovery_fade2: float
    held_kpa: float
    """the most that a held pressure may seem to go back in three frames"""


def fast_r(model: PaperModel) -> tuple[float, float]:
    """Change of r per kPa of a fast change, in the rising and in the recovery model."""
    return 1 / model.eu1_kpa + 1 / model.etau2_kpa, 1 / model.e1_kpa


def lags_before(model: PaperModel, age_s: float) -> tuple[float, float]:
    """r of the two branches ``age_s`` ago over their present r, if they only fade; bounded, to avoid overflow."""
    return math.exp(min(age_s / model.t2_s, 50.0)), math.exp(min(age_s / model.t3_s, 50.0))


def gains_of(model: PaperModel, dt_s: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Pressure per r after a step in the rising and in the recovery model; and the share of a variance that is left."""
    of = paper_step(model, dt_s, 0.0)
    return (of.rising_gain_kpa, of.recovery_gain_kpa), (of.rising_fade2, of.recovery_fade2)


def paper_step(model: PaperModel, dt_s: float, held_kpa_per_s: float) -> PaperStep:
    """The weights for steps of ``dt_s``; ``held_kpa_per_s``: rate at which a held pressure may seem to go back."""
    m = model
    gone, ramp = lag.weights(dt_s, np.array([m.tu_s, m.t2_s, m.t3_s]))
    gains = np.array([1.0, 1 / m.e2_kpa, 1 / m.e3_kpa])
    kept, free, ramps = 1 - gone, gains * (gone - ramp), gains * ramp
    rising_gain = 1 / (1 / m.eu1_kpa + (1 - ramp[0]) / m.etau2_kpa)
    # An error of the memory fades with the zeros of the model; the slow branch, a few percent of it, is neglected.
    of_models = np.array([1 - 1 / (m.etau2_kpa / m.eu1_kpa + 1), 1 + m.e1_kpa / m.e2_kpa]) / np.array([m.tu_s, m.t2_s])
    fade2 = np.exp(-2 * dt_s * of_models)
    return record(
        PaperStep,
        **{f"kept_{lag_of}": float(x) for lag_of, x in zip("u23", kept, strict=True)},
        **{f"free_{lag_of}": float(x) for lag_of, x in zip("u23", free, strict=True)},
        **{f"ramp_{lag_of}": float(x) for lag_of, x in zip("u23", ramps, strict=True)},
        rising_gain_kpa=rising_gain,
        recovery_gain_kpa=1 / (1 / m.e1_kpa + ramps[1] + ramps[2]),
        settled_gain=rising_gain / m.etau2_kpa,
        rising_fade=math.sqrt(fade2[0]),
        recovery_fade=math.sqrt(fade2[1]),
        rising_fade2=fade2[0],
        recovery_fade2=fade2[1],
        held_kpa=3.0 * dt_s * held_kpa_per_s,
    )


@loop
def step_both(own: PaperState, r: float, s: PaperStep) -> None:
    """Invert both models for the reading ``r`` after a time step: pressures, own states, slow branches."""
    own.r = r
    rising, recovery = own.rising_kpa, own.recovery_kpa
    settled = s.free_u * rising + s.kept_u * own.settled_kpa
    own.rising_kpa = s.settled_gain * settled + s.rising_gain_kpa * r
    own.settled_kpa = settled + s.ramp_u * own.rising_kpa
    own.rising_x3 = s.free_3 * rising + s.kept_3 * own.rising_x3 + s.ramp_3 * own.rising_kpa
    x2, x3 = s.free_2 * recovery + s.kept_2 * own.x2, s.free_3 * recovery + s.kept_3 * own.recovery_x3
    own.recovery_kpa = s.recovery_gain_kpa * (r - x2 - x3)
    own.x2, own.recovery_x3 = x2 + s.ramp_2 * own.recovery_kpa, x3 + s.ramp_3 * own.recovery_kpa
