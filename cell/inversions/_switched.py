"""The paper's estimator (P8): the rising or the recovery model inverted, switched by thresholds on dr/dt."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ..estimation import PRESSURE, Inversion, credible_readings
from ..materials import ByStep, PaperModel, lag
from ._paper_steps import fast_r, step_weights

STATE_ROWS, R_ROW = [PRESSURE, 5, 6, 7], 3
"""rows of the memory of :class:`SwitchedInversion`: pressure, settled, x2, x3; and the reading"""


class SwitchWeights(NamedTuple):
    """Weights of one time step of the memory of :class:`SwitchedInversion`; its row ``r``: the reading after it."""

    step: FloatArray
    """(5, 9) memory -> pressure in the rising and the recovery model; settled, x2, x3 if the pressure drops to 0"""
    ramp: FloatArray
    """(3, 1) rise of settled, x2 and x3 per kPa of pressure after the step"""
    smoothing: float
    """share by which the lag behind the derivative follows the reading"""


def switch_weights(model: PaperModel, dt_s: float) -> SwitchWeights:
    """The weights for steps of ``dt_s``: :func:`step_weights`, for the rows of the memory."""
    w = step_weights(model, dt_s)
    step = np.zeros((5, 9))
    step[2:, STATE_ROWS] = w.free
    step[:2] = w.answer[:, :3] @ step[2:]
    step[:2, R_ROW] = w.answer[:, 3]
    return SwitchWeights(step, w.ramp, float(-np.expm1(-dt_s / max(model.derivative_s, 1e-9))))


class SwitchedInversion(Inversion):
    """The paper's estimator (P8): invert the rising or the recovery model, selected by dr/dt and two thresholds.

    This is the baseline, and no default: the errors of wrong choices of the model add up. The paper leaves open how
    dr/dt is computed and what happens at a change of models. Here dr/dt = (r - l)/T, where l is the reading behind a
    lag T = ``derivative_s``. Between the thresholds the last model stays. Pressure and resistance are continuous at a
    change.
    """

    rows = ("pressure", "gain", "variance", "r", "rising", "settled", "x2", "x3", "lagged_r")
    knows_errors = False

    def __init__(self, model: PaperModel, full_scale_kpa: float) -> None:
        self.model = model
        self._weights = ByStep(switch_weights, model)
        self._thresholds_per_s = model.thresholds_per_s(full_scale_kpa)
        credible = credible_readings(full_scale_kpa * fast_r(model)[0])
        full_r = model.gain_per_kpa * full_scale_kpa
        super().__init__(full_scale_kpa, full_r, credible=credible, exact=True)

    def begin(self, r: FloatArray) -> FloatArray:
        m = self.model
        p = r / m.gain_per_kpa
        none = np.zeros_like(r)
        return np.stack([p, none + 1 / m.gain_per_kpa, none, r, none + 1, p, p / m.e2_kpa, p / m.e3_kpa, r])

    def advance(
        self, memory: FloatArray, dt_s: float, r: FloatArray, std: FloatArray, doubt: Callable[[], FloatArray]
    ) -> FloatArray:
        weights = self._weights.of(dt_s)
        rises, falls = self._thresholds_per_s
        was_rising = memory[4] > 0
        followed = (r - memory[8]) * weights.smoothing
        slope = followed / dt_s
        rising = (slope > rises) | (was_rising & (slope >= falls))
        changed = rising != was_rising
        if np.count_nonzero(changed):
            self._hand_over(memory, changed & rising, changed & was_rising)
        memory[R_ROW] = r
        after = weights.step @ memory
        p = np.where(rising, after[0], after[1])
        memory[PRESSURE], memory[4] = p, rising
        np.multiply(weights.ramp, p, out=memory[5:8])
        memory[5:8] += after[2:]
        memory[8] += followed
        return memory

    def _hand_over(self, memory: FloatArray, starts: BoolArray, ends: BoolArray) -> None:
        """Let cells (m,) change to the rising or to the recovery model; changes ``memory``."""
        m = self.model
        p, r = memory[PRESSURE], memory[R_ROW]
        np.copyto(memory[5], p * (1 + m.etau2_kpa / m.eu1_kpa) - m.etau2_kpa * r, where=starts)
        np.copyto(memory[6], r - p / m.e1_kpa - memory[7], where=ends)

    def hold(self, memory: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        m = self.model
        held = memory.copy()
        p, rising = memory[PRESSURE], memory[4] > 0
        gone, _ = lag.weights(dt_s, np.array([[m.tu_s], [m.t2_s], [m.t3_s]]))
        held[5:8] += (np.stack([p, p / m.e2_kpa, p / m.e3_kpa]) - memory[5:8]) * gone
        settled, x2, x3 = held[5:8]
        held[3] = np.where(rising, p / m.eu1_kpa + (p - settled) / m.etau2_kpa, p / m.e1_kpa + x2 + x3)
        held[8] += (held[3] - held[8]) * -np.expm1(-dt_s / max(m.derivative_s, 1e-9))
        return held
