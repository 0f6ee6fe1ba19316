"""The paper's cell inverted: its switched estimator (P8), and one that follows two hypotheses about the last turn.

The paper's cell has two linear models and changes from one to the other where the pressure turns. Inverting either is
algebra: each lag is discretised exactly for a pressure that is linear over the step, and the equation that remains is
linear in the new pressure. Both inverses are stable (their zeros lie in the left half plane), so that errors fade in
the material's own time. What is hard is to know which model holds.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from ..arrays import BoolArray, FloatArray
from . import _lag as lag
from ._estimator import GAIN, PRESSURE, VARIANCE, Conditions, Estimator
from ._models import PaperModel

LOADS = (-0.5, 3.0)
"""times full scale beyond which no load is looked for"""
TURN = 0.01
"""of full scale by which the pressure must have gone back for a turn"""
EXACTLY, NEAR = 1e-9, 1e-3
"""of full scale: rounding; and an error of the pressure at a turn, noise aside"""
EITHER = 0.5
"""standard deviation over the difference of the two hypotheses: either may be right until the pressure has turned"""
SURE = 3.0
"""standard deviations of the smoothed noise by which it must have, too, and by which an extreme counts for less"""
CONFIRMED = 3.0
"""times that much beyond the extreme that was left, until which the turn may yet be found to have been noise"""
AGAIN_SIGMAS, AGAIN = 1.0, 0.5
"""standard deviations from the extreme within which the other hypothesis begins anew, and by what share at a frame.
Beginning at every extreme would take noise for part of the press, beginning late would miss some of the release; half
and half, the two errors about cancel"""


class StepWeights(NamedTuple):
    """What one time step does: the state is [pressure, settled, x2, x3] before it, r the reading after it."""

    free: FloatArray
    """(3, 4) the state -> what settled, x2, x3 become if the pressure drops to zero over the step"""
    ramp: FloatArray
    """(3, 1) by which they rise per kPa of pressure after the step"""
    answer: FloatArray
    """(2, 4) settled, x2, x3 as if free, and r -> pressure after the step in the rising and in the recovery model"""
    gain: FloatArray
    """(2,) pressure per r of the two"""
    fade: FloatArray
    """(2,) share of a variance of the memory that is left after the step"""


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
    # An error of the memory fades as the inverse's zeros say; the slow branch holds a few percent of it only.
    zeros = np.array([1 - 1 / (m.etau2_kpa / m.eu1_kpa + 1), 1 + m.e1_kpa / m.e2_kpa]) / np.array([m.tu_s, m.t2_s])
    return StepWeights(free, ramps[:, None], answer, np.array([rising, falling]), np.exp(-2 * dt_s * zeros))


class PaperEstimator(Estimator):
    """The paper's estimator (P8): invert the rising or the recovery model, as dr/dt and two thresholds say.

    It is the baseline, and no default: wrong choices of the model add up. The paper leaves open how dr/dt is taken and
    what happens at a change of models. Here dr/dt is (r - l)/T, with l the reading behind a lag T = ``derivative_s``;
    between the thresholds the last model stays; pressure and resistance are continuous at a change.
    """

    rows = ("pressure", "gain", "variance", "r", "rising", "settled", "x2", "x3", "lagged_r")
    filters = False
    knows_errors = False

    def __init__(
        self,
        model: PaperModel,
        full_scale_kpa: float,
        shape: tuple[int, ...],
        rest_resistance_ohm: FloatArray,
        conditions: Conditions,
    ) -> None:
        self.model = model
        steepest = full_scale_kpa * (1 / model.eu1_kpa + 1 / model.etau2_kpa)
        credible = (LOADS[0] * steepest, LOADS[1] * steepest)
        full_r = model.gain_per_kpa * full_scale_kpa
        super().__init__(full_scale_kpa, full_r, shape, rest_resistance_ohm, conditions, credible=credible)

    def _begin(self, r: FloatArray) -> FloatArray:
        m = self.model
        p = r / m.gain_per_kpa
        none = np.zeros_like(r)
        return np.stack([p, none + 1 / m.gain_per_kpa, none, r, none + 1, p, p / m.e2_kpa, p / m.e3_kpa, r])

    def _advance(self, memory: FloatArray, dt_s: float, r: FloatArray, std: FloatArray) -> FloatArray:
        m = self.model
        p, _, _, r_before, was_rising, settled, x2, x3, lagged = memory
        rises, falls = m.thresholds_per_s(self.full_scale_kpa)
        smoothing = -np.expm1(-dt_s / max(m.derivative_s, 1e-9))
        slope = (r - lagged) * smoothing / dt_s
        rising = (slope > rises) | ((was_rising > 0) & (slope >= falls))
        starts, ends = rising & ~(was_rising > 0), ~rising & (was_rising > 0)
        settled = np.where(starts, p * (1 + m.etau2_kpa / m.eu1_kpa) - m.etau2_kpa * r_before, settled)
        x2 = np.where(ends, r_before - p / m.e1_kpa - x3, x2)
        weights = step_weights(m, dt_s)
        free = weights.free @ np.stack([p, settled, x2, x3])
        both = weights.answer @ np.concatenate([free, r[None]])
        p = np.where(rising, both[0], both[1])
        after = free + weights.ramp * p
        new = np.concatenate([[p], memory[1:3], [r], [rising], after, [lagged + (r - lagged) * smoothing]])
        return np.asarray(new, dtype=np.float64)

    def _hold(self, memory: FloatArray, dt_s: float) -> FloatArray:
        m = self.model
        held = memory.copy()
        p, rising = memory[PRESSURE], memory[4] > 0
        gone, _ = lag.weights(dt_s, np.array([[m.tu_s], [m.t2_s], [m.t3_s]]))
        held[5:8] += (np.stack([p, p / m.e2_kpa, p / m.e3_kpa]) - memory[5:8]) * gone
        settled, x2, x3 = held[5:8]
        held[3] = np.where(rising, p / m.eu1_kpa + (p - settled) / m.etau2_kpa, p / m.e1_kpa + x2 + x3)
        held[8] += (held[3] - held[8]) * -np.expm1(-dt_s / max(m.derivative_s, 1e-9))
        return held


TURNED = 3
"""variance from turns not known to the point, which fades"""
STATE = slice(4, 7)
"""settled, x2, x3 of the hypothesis in force"""
OTHER = slice(12, 16)
"""pressure, settled, x2, x3 of the other one"""
SIGN, EXTREME, PEAK, UNCONFIRMED, LEFT = range(7, 12)


class TurningEstimator(Estimator):
    """The exact inverse of the paper's cell, changed from one model to the other where the *pressure* turns.

    The sign of dr/dt, by which the paper goes, misreads slow ramps and quick presses: the resistance also falls while a
    load is held. Whether the pressure turned can be asked of the model in force, whose own inverse then goes back.
    Noise delays the answer. Two hypotheses are therefore followed at the same time: that the model in force still
    holds, and that the pressure turned where it was last near its extreme. When the first one's pressure has gone back
    from the extreme by more than noise does, the second one is taken over, and nothing is lost by the delay.

    Nothing can add up: the pressure is limited to ``LOADS``, the memory follows the limited pressure, and a memory that
    would need a negative pressure is corrected to what the reading says at none.
    """

    rows = (
        *("pressure", "gain", "variance", "turned", "settled", "x2", "x3", "sign"),
        *("extreme", "peak", "unconfirmed", "left_extreme"),
        *("other_pressure", "other_settled", "other_x2", "other_x3"),
    )

    def __init__(
        self,
        model: PaperModel,
        full_scale_kpa: float,
        shape: tuple[int, ...],
        rest_resistance_ohm: FloatArray,
        conditions: Conditions,
    ) -> None:
        self.model = model
        steepest = full_scale_kpa * (1 / model.eu1_kpa + 1 / model.etau2_kpa)
        credible = (LOADS[0] * steepest, LOADS[1] * steepest)
        full_r = model.gain_per_kpa * full_scale_kpa
        self._weights_of = lru_cache(maxsize=1024)(partial(step_weights, model))
        self._lowest, self._highest = LOADS[0] * full_scale_kpa, LOADS[1] * full_scale_kpa
        super().__init__(full_scale_kpa, full_r, shape, rest_resistance_ohm, conditions, credible=credible)

    def _begin(self, r: FloatArray) -> FloatArray:
        m = self.model
        p = r / m.gain_per_kpa
        memory = np.zeros((len(self.rows), *r.shape))
        memory[PRESSURE], memory[GAIN], memory[SIGN], memory[EXTREME] = p, step_weights(m, 0.01).gain[0], 1.0, p
        memory[PEAK] = p
        memory[STATE] = [p, p / m.e2_kpa, p / m.e3_kpa]
        memory[OTHER] = [p, *memory[STATE]]
        return memory

    def _advance(self, memory: FloatArray, dt_s: float, r: FloatArray, std: FloatArray) -> FloatArray:
        m, w = self.model, self._weights_of(dt_s)
        cells = r.size
        rising = memory[SIGN] > 0
        # Both hypotheses side by side: (4, 2 m), the one in force first.
        before = np.empty((4, 2, cells))
        before[0, 0], before[1:, 0], before[:, 1] = memory[PRESSURE], memory[STATE], memory[OTHER]
        known = np.empty((4, 2, cells))
        np.matmul(w.free, before.reshape(4, -1), out=known[:3].reshape(3, -1))
        known[3] = r
        up, down = (w.answer @ known.reshape(4, -1)).reshape(2, 2, cells)
        pressure = np.empty((2, cells))
        pressure[0] = np.where(rising, up[0], down[0])
        pressure[1] = np.where(rising, down[1], up[1])
        np.maximum(pressure, self._lowest, out=pressure)
        np.minimum(pressure, self._highest, out=pressure)
        state = known[:3]
        state += w.ramp[:, :, None] * pressure

        unsure = std * np.where(rising, w.gain[0], w.gain[1])
        sign = memory[SIGN]
        least = self._lowest if self._exact else 0.0  # what is below zero is an error that fades, and no turn
        ahead = sign * np.maximum(pressure[0], least)
        gone_back = memory[EXTREME] - ahead
        threshold = SURE * unsure + TURN * self.full_scale_kpa
        turned = gone_back > threshold
        unconfirmed = memory[UNCONFIRMED] > 0
        if np.count_nonzero(unconfirmed):
            # Back at the extreme that was left: the turn was noise.
            back = -sign * pressure[1] > memory[LEFT] - std * np.where(rising, w.gain[1], w.gain[0])
            turned |= back & unconfirmed
        if np.count_nonzero(turned):
            self._turn(memory, turned, pressure, state, std, w)
            rising, sign = memory[SIGN] > 0, memory[SIGN]
            ahead = sign * np.maximum(pressure[0], least)
            unconfirmed = memory[UNCONFIRMED] > 0
        unconfirmed &= ahead + memory[LEFT] < CONFIRMED * threshold
        memory[UNCONFIRMED] = unconfirmed
        self._correct(pressure, state, rising, r, std, w)

        # The other hypothesis begins anew as long as the pressure is near its extreme.
        below_peak = memory[PEAK] - ahead
        again = AGAIN * (below_peak < AGAIN_SIGMAS * unsure)
        np.copyto(again, 1.0, where=below_peak <= EXACTLY * self.full_scale_kpa)
        np.copyto(again, 0.0, where=unconfirmed)
        p, x3 = pressure[0], state[2, 0]
        np.maximum(memory[PEAK], ahead - AGAIN_SIGMAS * unsure, out=memory[PEAK])
        np.maximum(memory[EXTREME], ahead - SURE * unsure, out=memory[EXTREME])
        memory[PRESSURE], memory[STATE] = p, state[:, 0]
        other = memory[OTHER]
        settled = p * (1 + m.etau2_kpa / m.eu1_kpa) - m.etau2_kpa * r
        x2 = r - p / m.e1_kpa - x3
        other[0], other[1:] = pressure[1], state[:, 1]
        anew = np.empty((4, cells))
        anew[0], anew[1], anew[2], anew[3] = p, settled, x2, x3
        anew -= other
        anew *= again
        other += anew
        memory[GAIN] = np.where(rising, w.gain[0], w.gain[1])
        variance = memory[TURNED]
        variance *= np.where(rising, w.fade[0], w.fade[1])
        apart = other[0] - p
        apart *= EITHER
        memory[VARIANCE] = variance + apart * apart
        return memory

    def _turn(
        self,
        memory: FloatArray,
        turned: BoolArray,
        pressure: FloatArray,
        state: FloatArray,
        std: FloatArray,
        weights: StepWeights,
    ) -> None:
        """Take over the other hypothesis where the pressure ``turned``; changes all but ``turned`` and ``std``."""
        again = memory[UNCONFIRMED, turned] > 0
        left, extreme = memory[LEFT, turned], memory[EXTREME, turned]
        pressure[:, turned] = pressure[::-1, turned]
        state[:, :, turned] = state[:, ::-1][:, :, turned]
        memory[SIGN, turned] *= -1.0
        memory[UNCONFIRMED, turned] = ~again
        memory[LEFT, turned] = extreme
        noise = np.broadcast_to(std, turned.shape)[turned]
        sign = memory[SIGN, turned]
        now, unsure = sign * np.maximum(pressure[0, turned], 0.0), noise * np.where(sign > 0, *weights.gain)
        memory[EXTREME, turned] = np.where(again, left, now - SURE * unsure)
        memory[PEAK, turned] = np.where(again, left, now - AGAIN_SIGMAS * unsure)
        memory[TURNED, turned] += (weights.gain[1] * noise + NEAR * self.full_scale_kpa) ** 2

    def _correct(
        self,
        pressure: FloatArray,
        state: FloatArray,
        rising: BoolArray,
        r: FloatArray,
        std: FloatArray,
        weights: StepWeights,
    ) -> None:
        """Where the hypothesis in force needs a pull, let it remember less instead; changes pressure and state."""
        m = self.model
        allowed = -weights.gain[1] * std - NEAR * self.full_scale_kpa
        pulled = pressure[0] < allowed
        if self._exact or not np.count_nonzero(pulled):
            return
        p = np.broadcast_to(allowed, pulled.shape)[pulled]
        pressure[0, pulled] = p
        state[0, 0, pulled] = p * (1 + m.etau2_kpa / m.eu1_kpa) - m.etau2_kpa * r[pulled]
        state[1, 0, pulled] = r[pulled] - p / m.e1_kpa - state[2, 0, pulled]

    def _hold(self, memory: FloatArray, dt_s: float) -> FloatArray:
        m = self.model
        gone, _ = lag.weights(dt_s, np.array([[m.tu_s], [m.t2_s], [m.t3_s]]))
        gain = np.array([[1.0], [1 / m.e2_kpa], [1 / m.e3_kpa]])
        held = memory.copy()
        held[STATE] += (gain * memory[PRESSURE] - memory[STATE]) * gone
        other, (settled, x2, x3) = held[OTHER], held[STATE]
        other[1:] += (gain * other[0] - other[1:]) * gone
        # The other hypothesis begins where this one is, if it did before.
        p = held[PRESSURE]
        r = np.where(held[SIGN] > 0, p / m.eu1_kpa + (p - settled) / m.etau2_kpa, p / m.e1_kpa + x2 + x3)
        begun = np.stack([p, p * (1 + m.etau2_kpa / m.eu1_kpa) - m.etau2_kpa * r, r - p / m.e1_kpa - x3, x3])
        held[OTHER] = np.where(other[0] == p, begun, other)
        return held

    def _settled(self, memory: FloatArray, band: float) -> BoolArray:
        m = self.model
        kpa = 2 * band / m.gain_per_kpa
        off = np.abs(memory[PRESSURE]) < kpa
        rising = memory[SIGN] > 0
        unsettled = np.where(rising, np.abs(memory[STATE][0]) / m.etau2_kpa, np.abs(memory[STATE][1:]).sum(axis=0))
        found: BoolArray = off & (unsettled < band)
        return found
