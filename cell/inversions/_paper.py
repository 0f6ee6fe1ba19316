"""Inversions of the paper's cell: by the filter that follows it, and the paper's own estimator (P8), the baseline."""

from __future__ import annotations

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Record, Records, record, zeros
from .._state import CellState
from ..estimation import Inversion, Material, credible_readings
from ..materials import ByStep, PaperModel, lag


class FollowedInversion(Inversion):
    """The paper's cell, whose two phases are the dynamics of the filter: it follows the load itself."""

    def __init__(self, model: PaperModel, full_scale_kpa: float, *, exact: bool) -> None:
        self.material = Material.of(model, full_scale_kpa)
        super().__init__(
            full_scale_kpa,
            model.gain_per_kpa * full_scale_kpa,
            credible=credible_readings(self.material.gu),
            exact=exact,
        )


class SwitchedState(Record):
    """Memory of :class:`SwitchedInversion`: the model in force, the reading, and the states of both models."""

    r: float
    rising: float
    """1: the rising model is in force, else 0"""
    settled_kpa: float
    x2: float
    x3: float
    lagged_r: float


class PaperStep(Record):
    """Weights of one time step: of the lag of the rising phase, and of the two branches of recovery."""

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


def paper_step(model: PaperModel, dt_s: float) -> PaperStep:
    """The weights for steps of ``dt_s``."""
    m = model
    gone, ramp = lag.weights(dt_s, np.array([m.tu_s, m.t2_s, m.t3_s]))
    gains = np.array([1.0, 1 / m.e2_kpa, 1 / m.e3_kpa])
    kept, free, ramps = 1 - gone, gains * (gone - ramp), gains * ramp
    rising_gain = 1 / (1 / m.eu1_kpa + (1 - ramp[0]) / m.etau2_kpa)
    return record(
        PaperStep,
        **{f"kept_{lag_of}": float(x) for lag_of, x in zip("u23", kept, strict=True)},
        **{f"free_{lag_of}": float(x) for lag_of, x in zip("u23", free, strict=True)},
        **{f"ramp_{lag_of}": float(x) for lag_of, x in zip("u23", ramps, strict=True)},
        rising_gain_kpa=rising_gain,
        recovery_gain_kpa=1 / (1 / m.e1_kpa + ramps[1] + ramps[2]),
        settled_gain=rising_gain / m.etau2_kpa,
    )


class SwitchedInversion(Inversion):
    """The paper's estimator (P8): invert the rising or the recovery model, selected by dr/dt and two thresholds.

    This is the baseline, and no default: the errors of wrong choices of the model add up. The paper leaves open how
    dr/dt is computed and what happens at a change of models. Here dr/dt = (r - l)/T, where l is the reading behind a
    lag T = ``derivative_s``. Between the thresholds the last model stays. Pressure and resistance are continuous at a
    change.
    """

    memory = SwitchedState
    knows_errors = filtered = False

    def __init__(self, model: PaperModel, full_scale_kpa: float) -> None:
        self.model = model
        self._steps = ByStep(paper_step, model)
        self._thresholds_per_s = model.thresholds_per_s(full_scale_kpa)
        credible = credible_readings(full_scale_kpa * (1 / model.eu1_kpa + 1 / model.etau2_kpa))
        super().__init__(full_scale_kpa, model.gain_per_kpa * full_scale_kpa, credible=credible, exact=True)

    def begin(self, cells: Records[CellState], memory: Records[SwitchedState], places: IntArray, r: FloatArray) -> None:
        m, begun, p = self.model, zeros(SwitchedState, places.size), r / self.model.gain_per_kpa
        begun["r"], begun["lagged_r"], begun["rising"] = r, r, 1.0
        begun["settled_kpa"], begun["x2"], begun["x3"] = p, p / m.e2_kpa, p / m.e3_kpa
        memory[places] = begun
        cells["pressure_kpa"][places], cells["gain_kpa"][places] = p, 1 / m.gain_per_kpa
        cells["variance_kpa2"][places] = 0.0

    def advance(self, cells: Records[CellState], memory: Records[SwitchedState], awake: IntArray, dt_s: float) -> None:
        m, s, own, r = self.model, self._steps.of(dt_s), memory[awake], cells["level"][awake]
        rises, falls = self._thresholds_per_s
        p, was_rising = cells["pressure_kpa"][awake], own["rising"] > 0
        followed = (r - own["lagged_r"]) * -np.expm1(-dt_s / max(m.derivative_s, 1e-9))
        slope = followed / dt_s
        rising: BoolArray = (slope > rises) | (was_rising & (slope >= falls))
        settled = p * (1 + m.etau2_kpa / m.eu1_kpa) - m.etau2_kpa * own["r"]
        own["settled_kpa"] = np.where(rising & ~was_rising, settled, own["settled_kpa"])
        own["x2"] = np.where(was_rising & ~rising, own["r"] - p / m.e1_kpa - own["x3"], own["x2"])
        settled = s.free_u * p + s.kept_u * own["settled_kpa"]
        x2, x3 = s.free_2 * p + s.kept_2 * own["x2"], s.free_3 * p + s.kept_3 * own["x3"]
        p = np.where(rising, s.settled_gain * settled + s.rising_gain_kpa * r, s.recovery_gain_kpa * (r - x2 - x3))
        own["settled_kpa"], own["x2"], own["x3"] = settled + s.ramp_u * p, x2 + s.ramp_2 * p, x3 + s.ramp_3 * p
        own["r"], own["rising"] = r, rising
        own["lagged_r"] += followed
        memory[awake] = own
        cells["pressure_kpa"][awake] = p

    def hold(
        self, cells: Records[CellState], memory: Records[SwitchedState], places: IntArray, dt_s: FloatArray
    ) -> None:
        m, own, p = self.model, memory[places], cells["pressure_kpa"][places]
        for name, e_kpa, t_s in (("settled_kpa", 1.0, m.tu_s), ("x2", m.e2_kpa, m.t2_s), ("x3", m.e3_kpa, m.t3_s)):
            own[name] += (p / e_kpa - own[name]) * lag.weights(dt_s, t_s)[0]
        of_rising = p / m.eu1_kpa + (p - own["settled_kpa"]) / m.etau2_kpa
        own["r"] = np.where(own["rising"] > 0, of_rising, p / m.e1_kpa + own["x2"] + own["x3"])
        own["lagged_r"] += (own["r"] - own["lagged_r"]) * lag.weights(dt_s, max(m.derivative_s, 1e-9))[0]
        memory[places] = own
