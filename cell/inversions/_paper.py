"""Inversions of the paper's cell: by hypotheses about its turning points, and the paper's own estimator (P8)."""

from __future__ import annotations

from functools import partial

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Record, Records, zeros
from .._state import CellState, PaperState
from ..estimation import RECENT, WINDOW, Inversion, credible_readings
from ..materials import ByStep, PaperModel, lag
from . import _hypotheses as hypotheses
from . import _sequential_tests as tests
from . import _tremor_path as tremor
from ._linear_models import fast_r, gains_of, paper_step

UNSEEN = 1.5
"""standard deviations of a reading: a load may go to and fro by so much in a frame without being noticed"""


class TurningInversion(Inversion):
    """The exact inverse of the paper's cell, changed from one model to the other where the *pressure* turns.

    The frame is :mod:`._hypotheses`. Every few frames, means of readings answer whether a released cell bears no load,
    whether a load has been released or has begun to rise (:mod:`._sequential_tests`), and how far a load goes to and
    fro within the noise (:mod:`._tremor_path`).
    """

    memory = PaperState

    def __init__(self, model: PaperModel, full_scale_kpa: float, *, exact: bool) -> None:
        self.model = model
        rise_r, _ = fast_r(model)
        full_r = model.gain_per_kpa * full_scale_kpa
        super().__init__(full_scale_kpa, full_r, credible=credible_readings(full_scale_kpa * rise_r), exact=exact)
        self._numbers = hypotheses.paper_numbers(model, full_scale_kpa, exact=exact)
        bend = float(self._numbers.bend)
        self.bends = hypotheses.BETWEEN * bend, hypotheses.TURN_SIGMAS
        self.seeming = WINDOW * UNSEEN * bend
        self.steepness_kpa = np.array([1 / rise_r, model.e1_kpa])
        self.rests, self.means_every = tests.RESTED_SIGMAS**2, 0 if exact else RECENT
        held_kpa_per_s = hypotheses.HELD_PER_S * full_scale_kpa
        self._steps = ByStep(partial(paper_step, held_kpa_per_s=held_kpa_per_s), model)
        self._looks = ByStep(tests.look_step, model)
        self._paths = ByStep(partial(tremor.path_step, full_kpa=full_scale_kpa), model)
        self._begin_gain_kpa = gains_of(model, 0.01)[0][0]

    def held_kpa(self, r: FloatArray) -> FloatArray:
        return r / self.model.gain_per_kpa

    def begin(self, cells: Records[CellState], memory: Records[PaperState], places: IntArray, r: FloatArray) -> None:
        memory[places] = zeros(PaperState, 1)
        hypotheses.begin_each.unchecked(cells, memory, places, r, self._numbers, self._begin_gain_kpa)

    def advance(self, cells: Records[CellState], memory: Records[PaperState], awake: IntArray, dt_s: float) -> None:
        hypotheses.advance_each.unchecked(cells, memory, awake, self._numbers, self._steps.of(dt_s))

    def check_means(
        self, cells: Records[CellState], memory: Records[PaperState], awake: IntArray, dt_s: float, mean: FloatArray
    ) -> None:
        tests.test_each.unchecked(cells, memory, awake, mean, self._numbers, self._looks.of(dt_s))

    def tremor_every(self, dt_s: float) -> int:
        return 0 if self.exact else tremor.readings_in_look(dt_s)

    def correct_tremor(
        self, cells: Records[CellState], memory: Records[PaperState], awake: IntArray, dt_s: float, mean: FloatArray
    ) -> None:
        tremor.correct_each.unchecked(cells, memory, awake, mean, self._numbers, self._paths.of(dt_s))

    def doubt_rises(
        self, cells: Records[CellState], memory: Records[PaperState], places: IntArray, rise_kpa: FloatArray
    ) -> None:
        """A load that goes to and fro within the noise seems to rise: r goes up by one model and down, by less, by the
        other."""
        before = cells["turn_variance_kpa2"][places]
        after = np.minimum((np.sqrt(before) + rise_kpa) ** 2, self._numbers.most_lost_kpa2)
        cells["variance_kpa2"][places] += after - before
        cells["turn_variance_kpa2"][places] = after

    def hold(self, cells: Records[CellState], memory: Records[PaperState], places: IntArray, dt_s: FloatArray) -> None:
        hypotheses.hold_each.unchecked(cells, memory, places, dt_s, self._numbers)

    def settled(
        self, cells: Records[CellState], memory: Records[PaperState], places: IntArray, band: float
    ) -> BoolArray:
        m, own = self.model, memory[places]
        off = np.abs(cells["pressure_kpa"][places]) < 2 * band / m.gain_per_kpa
        of_rising, of_recovery = (
            np.abs(own["settled_kpa"]) / m.etau2_kpa,
            np.abs(own["x2"]) + np.abs(own["recovery_x3"]),
        )
        return np.asarray(off & (np.where(own["direction"] > 0, of_rising, of_recovery) < band))


class SwitchedState(Record):
    """Memory of :class:`SwitchedInversion`: the model in force, the reading, and the states of both models."""

    r: float
    rising: float
    """1: the rising model is in force, else 0"""
    settled_kpa: float
    x2: float
    x3: float
    lagged_r: float


class SwitchedInversion(Inversion):
    """The paper's estimator (P8): invert the rising or the recovery model, selected by dr/dt and two thresholds.

    This is the baseline, and no default: the errors of wrong choices of the model add up. The paper leaves open how
    dr/dt is computed and what happens at a change of models. Here dr/dt = (r - l)/T, where l is the reading behind a
    lag T = ``derivative_s``. Between the thresholds the last model stays. Pressure and resistance are continuous at a
    change.
    """

    memory = SwitchedState
    knows_errors = False

    def __init__(self, model: PaperModel, full_scale_kpa: float) -> None:
        self.model = model
        self._steps = ByStep(partial(paper_step, held_kpa_per_s=0.0), model)
        self._thresholds_per_s = model.thresholds_per_s(full_scale_kpa)
        credible = credible_readings(full_scale_kpa * fast_r(model)[0])
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
