"""Exact discretisation (ramp-invariant) of the two linear models of the paper's cell, equations (3) and (8).

Each lag is stepped exactly for a pressure that is linear over the step (:mod:`..materials._lag`). The equation for the
pressure at the end of the step is then linear, and so is its inverse. Both inverses are stable, since the zeros of the
models lie in the left half plane: errors of the memory fade with time constants of the material.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...common.arrays import FloatArray
from ..materials import PaperModel, lag


def fast_r(model: PaperModel) -> tuple[float, float]:
    """Change of r per kPa of a fast change, in the rising and in the recovery model."""
    return 1 / model.eu1_kpa + 1 / model.etau2_kpa, 1 / model.e1_kpa


class StepWeights(NamedTuple):
    """Weights of one time step, with the state [pressure, settled, x2, x3] before it and the reading r after it."""

    free: FloatArray
    """(3, 4) the state -> settled, x2, x3 after the step if the pressure drops to zero over the step"""
    ramp: FloatArray
    """(3, 1) rise of settled, x2, x3 per kPa of pressure after the step"""
    answer: FloatArray
    """(2, 4) settled, x2, x3 by ``free``, and r -> pressure after the step in the rising and in the recovery model"""
    gain: FloatArray
    """(2,) pressure per r in the two models"""
    fade: FloatArray
    """(2,) share of a variance of the memory that is left after the step, in the two models"""


def step_weights(model: PaperModel, dt_s: float) -> StepWeights:
    """The weights for steps of ``dt_s``."""
    m = model
    gone, ramp = lag.weights(dt_s, np.array([m.tu_s, m.t2_s, m.t3_s]))
    gains = np.array([1.0, 1 / m.e2_kpa, 1 / m.e3_kpa])
    free = np.zeros((3, 4))
    free[:, 0] = gains * (gone - ramp)
    free[[0, 1, 2], [1, 2, 3]] = 1 - gone
    ramps = gains * ramp
    rising = 1 / (1 / m.eu1_kpa + (1 - ramp[0]) / m.etau2_kpa)
    falling = 1 / (1 / m.e1_kpa + ramps[1] + ramps[2])
    answer = np.array([[rising / m.etau2_kpa, 0, 0, rising], [0, -falling, -falling, falling]])
    # An error of the memory fades with the zeros of the model; the slow branch, a few percent of it, is neglected.
    zeros = np.array([1 - 1 / (m.etau2_kpa / m.eu1_kpa + 1), 1 + m.e1_kpa / m.e2_kpa]) / np.array([m.tu_s, m.t2_s])
    return StepWeights(free, ramps[:, None], answer, np.array([rising, falling]), np.exp(-2 * dt_s * zeros))


def borne_before(model: PaperModel, age_s: float) -> tuple[float, float]:
    """r of the two branches ``age_s`` ago over their present r, if they only fade; bounded, to avoid overflow."""
    return math.exp(min(age_s / model.t2_s, 50.0)), math.exp(min(age_s / model.t3_s, 50.0))


class Constants(NamedTuple):
    """Numbers that depend on the time between frames, by their places."""

    row: FloatArray
    """for machine code"""
    each: tuple[FloatArray, ...]
    """the same numbers, as arrays without axes"""


def numbered(numbers: dict[int, float]) -> Constants:
    """The ``numbers`` of places from 0 on."""
    row = np.array([numbers[place] for place in range(len(numbers))])
    return Constants(row, tuple(np.array(number) for number in row))


class TurnWeights(NamedTuple):
    """Weights of one time step of both hypotheses; rows and columns as :data:`._turning_rows.HYPOTHESES`."""

    step: FloatArray
    """(6, 7) hypotheses before the step, with the reading after it -> hypotheses after it"""
    ramp: FloatArray
    """(6,) rise of each per kPa of its own pressure after the step"""
    by_model: FloatArray
    """(3, 2) in the rising and in the recovery model: pressure per r, the same of the other model, and the share of a
    variance of the memory that is left after the step"""
    fades: tuple[float, float]
    """share of an error of the memory that is left after the step in the rising and in the recovery model"""


def turn_weights(model: PaperModel, dt_s: float) -> TurnWeights:
    """The weights for steps of ``dt_s``: :func:`step_weights`, with the pressure after the step inserted."""
    w = step_weights(model, dt_s)
    step, ramp = np.zeros((6, 7)), np.zeros(6)
    states = np.array([[0, 2, -1, 4], [1, -1, 3, 5]])  # where the state [pressure, settled, x2, x3] is; -1: nowhere
    for one, state in enumerate(states):
        present = np.flatnonzero(state >= 0)
        free = np.zeros((3, 7))
        free[:, state[present]] = w.free[:, present]
        pressure = w.answer[one, :3] @ free
        pressure[6] = w.answer[one, 3]
        after = free + w.ramp * pressure
        step[one], ramp[one] = pressure, 1.0
        for row in present[1:]:
            step[state[row]], ramp[state[row]] = after[row - 1], w.ramp[row - 1, 0]
    rising, recovery = np.sqrt(w.fade).tolist()
    return TurnWeights(step, ramp, np.array([w.gain, w.gain[::-1], w.fade]), (rising, recovery))


def taken_over(model: PaperModel) -> FloatArray:
    """(6, 7) change by which each hypothesis begins where the other one is, resistance and pressure continuous."""
    m = model
    anew = np.zeros((6, 7))
    anew[0, 1] = anew[1, 0] = 1.0
    anew[2, 1], anew[2, 6] = 1 + m.etau2_kpa / m.eu1_kpa, -m.etau2_kpa
    anew[3, 0], anew[3, 4], anew[3, 6] = -1 / m.e1_kpa, -1.0, 1.0
    anew[4, 5] = anew[5, 4] = 1.0
    anew[:, :6] -= np.eye(6)
    return anew
