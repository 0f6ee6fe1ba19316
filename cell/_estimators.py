"""Causal estimators: resistance to pressure, for whole arrays of cells at once, sample by sample."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import BoolArray, FloatArray
from ..errors import InputError
from . import _lag as lag
from ._forward import resistance_of
from ._models import AsymmetricModel, ContactModel, M10Model, Model, PaperModel

Memory = dict[str, FloatArray]
"""What an estimator remembers of each cell; the last axis of every entry is that of the cells, in one row"""


@dataclass(frozen=True)
class Estimate:
    """What an estimator makes of one frame."""

    pressure_kpa: FloatArray
    """(shape); a cell whose reading is missing keeps its last value, NaN before its first reading"""
    std_kpa: FloatArray | None
    """(shape) standard deviation, where the estimator has one"""


@dataclass(frozen=True)
class Doubt:
    """What calibration says of errors that an estimator cannot see in its readings."""

    std_kpa: float | None = None
    """of the estimate, for estimators without an idea of their own; None: unknown, none is given"""
    noise: float = 0.0
    """standard deviation of a reading from sample to sample, relative to it"""
    step_s: float = 0.0
    """time between readings to which the standard deviation belongs"""
    speed_kpa_per_s: float = 0.0
    """by which a load changes in a second, rms"""
    most_kpa: float = 1e100
    """standard deviation of knowing nothing"""

    def unread_kpa(self, seconds: FloatArray) -> FloatArray:
        """What a load may have done in a gap of ``seconds`` between readings."""
        gap = np.maximum(seconds - 2 * self.step_s, 0.0)
        doubt: FloatArray = -self.most_kpa * np.expm1(-self.speed_kpa_per_s * gap / self.most_kpa)
        return doubt


CERTAIN = Doubt()
LOADS = (-0.5, 3.0)
"""times full scale that an exact inverse answers: what its memories take in from beyond, they carry for long"""
AFTER_GAP = 0.3
"""share of the doubt about a gap that the first reading after it leaves, for memories were not brought along in it"""
AFTER_GAP_S = 10.0
"""in which that fades to 1/e"""


class Estimator(ABC):
    """The common part: time, missing samples, R0, and a state that can be saved and restored.

    A missing sample (NaN, or the infinite resistance of an open cell) does not advance its cell; the next
    good one does, over the whole gap. Meanwhile, and for some time after, the standard deviation is wider.
    The first reading of a cell is taken as one at rest or long held.
    """

    _credible = (-np.inf, np.inf)
    """normalised resistances beyond which a reading is no load's: a cell about to open, a short, a spark"""

    def __init__(self, shape: tuple[int, ...], rest_resistance_ohm: FloatArray, doubt: Doubt = CERTAIN) -> None:
        self.shape, self.doubt = shape, doubt
        self._rest_ohm = resistance_of(shape, rest_resistance_ohm).ravel()
        self._memory = self._begin(np.zeros(self._rest_ohm.size))
        self._read_s = np.full(self._rest_ohm.size, np.nan)  # when each cell was last read
        self._gap_kpa = np.zeros(self._rest_ohm.size)  # what is left of the doubt about gaps
        self._time_s = -np.inf
        self._std_kpa = np.full(shape, np.nan)

    def step(self, elapsed_s: float, resistance_ohm: ArrayLike) -> FloatArray:
        """Take the frame read ``elapsed_s`` after the last one; :attr:`std_kpa` then belongs to what is returned.

        Returns:
            (shape) pressure in kPa; a cell whose reading is missing keeps its last value, NaN before its first reading.

        Raises:
            InputError: another shape, or a time that does not follow the last one.
        """
        start = self._time_s if np.isfinite(self._time_s) else 0.0
        return self.update(start + elapsed_s, resistance_ohm).pressure_kpa

    @property
    def std_kpa(self) -> FloatArray:
        """(shape) standard deviation of the estimate of the last step, in kPa; NaN where none can be stated."""
        return self._std_kpa

    def update(self, time_s: float, resistance_ohm: ArrayLike) -> Estimate:
        """Take the frame read at ``time_s``; entries that are NaN, infinite or not positive are missing, and to an
        inverse of the model those that no load of -1/2 to 3 times full scale (:data:`LOADS`) can give.

        Raises:
            InputError: another shape, or a time that does not follow the last one.
        """
        resistance = np.asarray(resistance_ohm, dtype=np.float64)
        if resistance.shape != self.shape:
            raise InputError(f"resistance has shape {resistance.shape}, expected {self.shape}")
        if not self._time_s < time_s < np.inf:
            raise InputError(f"time {time_s} s does not follow {self._time_s} s; expected time stamps that increase")
        resistance = resistance.ravel()
        r = resistance / self._rest_ohm - 1
        low, high = self._credible
        # NaN is not within any bounds.
        good, begun = np.isfinite(r) & (resistance > 0) & (low <= r) & (r <= high), ~np.isnan(self._read_s)
        since = np.where(begun, time_s - self._read_s, 0.0)
        if (good & begun).all():
            self._memory = self._advance(self._memory, self._elapsed(time_s), r)
        else:
            starts, moves = good & ~begun, good & begun
            begin = self._begin(np.where(good, r, 0.0))
            dt = np.where(moves, since, 1.0)
            moved = self._advance(self._memory, dt, np.where(moves, r, self._memory["r"]))
            self._memory = {
                name: np.where(moves, moved[name], np.where(starts, begin[name], kept))
                for name, kept in self._memory.items()
            }
        self._read_s = np.where(good, time_s, self._read_s)
        self._time_s = float(time_s)
        known, std = good | begun, self._memory.get("std_kpa")
        pressure = np.where(known, self._memory["pressure_kpa"], np.nan).reshape(self.shape)
        if std is None:
            self._std_kpa = np.full(self.shape, np.nan)
            return Estimate(pressure, None)
        unread = self.doubt.unread_kpa(since)
        faded = self._gap_kpa * np.exp(-since / AFTER_GAP_S)
        after = np.hypot(faded, AFTER_GAP * unread)
        self._gap_kpa = np.where(good, after, self._gap_kpa)
        std = np.hypot(std, np.where(good, after, np.hypot(faded, unread)))
        self._std_kpa = np.where(known, std, np.nan).reshape(self.shape)
        return Estimate(pressure, self._std_kpa)

    def state(self) -> dict[str, FloatArray]:
        """Everything remembered, as a copy that :meth:`restore` takes."""
        own = {"read_s": self._read_s, "gap_kpa": self._gap_kpa, "time_s": np.array(self._time_s)}
        return {name: value.copy() for name, value in (self._memory | own).items()}

    def restore(self, state: Mapping[str, FloatArray]) -> None:
        """Continue from a saved :meth:`state`; InputError if it is not one of this kind and shape."""
        expected = self.state()
        if {name: value.shape for name, value in expected.items()} != {
            name: np.shape(value) for name, value in state.items()
        }:
            raise InputError(f"not a saved state of this estimator for cells of shape {self.shape}")
        self._memory = {name: np.array(state[name]) for name in self._memory}
        self._read_s, self._gap_kpa = np.array(state["read_s"]), np.array(state["gap_kpa"])
        self._time_s = float(state["time_s"])

    def _elapsed(self, time_s: float) -> FloatArray | float:
        """Seconds since each cell was last read: one number when they agree, the common case."""
        first = self._read_s[0] if self._read_s.size else time_s
        return float(time_s - first) if (self._read_s == first).all() else time_s - self._read_s

    @abstractmethod
    def _begin(self, r: FloatArray) -> Memory:
        """The memory of cells (n,) whose reading has been ``r`` for ever; has "r" and "pressure_kpa"."""

    @abstractmethod
    def _advance(self, memory: Memory, dt_s: FloatArray | float, r: FloatArray) -> Memory:
        """The memory after the reading went to ``r`` in ``dt_s``; leaves the memory given as it is."""

    def _std(self) -> Memory:
        """A constant standard deviation, if there is one."""
        return {} if self.doubt.std_kpa is None else {"std_kpa": np.full(self._rest_ohm.shape, self.doubt.std_kpa)}


class TwoModels(Estimator):
    """The paper's rising and recovery models inverted; which of them holds is for others to say.

    A hand-over keeps pressure and resistance where they are, as in :class:`~.forward.PaperForward`. Each inverse is
    the algebraic one of the lag discretised for a pressure linear over the sample: exact for such loads as long as
    the model is the right one.
    """

    def __init__(
        self,
        model: PaperModel,
        full_scale_kpa: float,
        shape: tuple[int, ...],
        rest_resistance_ohm: FloatArray,
        doubt: Doubt = CERTAIN,
    ) -> None:
        self.model, self.full_scale_kpa = model, full_scale_kpa
        steepest = full_scale_kpa * (1 / model.eu1_kpa + 1 / model.etau2_kpa)
        self._credible = (LOADS[0] * steepest, LOADS[1] * steepest)
        super().__init__(shape, rest_resistance_ohm, doubt)

    def _begin(self, r: FloatArray) -> Memory:
        m = self.model
        pressure = r / m.gain_per_kpa
        return self._std() | {
            "r": r,
            "pressure_kpa": pressure,
            "rising": np.ones_like(r),
            "settled_kpa": pressure,
            "x2": pressure / m.e2_kpa,
            "x3": pressure / m.e3_kpa,
        }

    def _inverted(self, memory: Memory, dt_s: FloatArray | float, r: FloatArray, rising: BoolArray) -> Memory:
        """The pressure that takes the reading to ``r`` in the model said, handed over to first if need be."""
        m, p0, r0, x3 = self.model, memory["pressure_kpa"], memory["r"], memory["x3"]
        was_rising = memory["rising"] > 0
        settled = np.where(
            rising & ~was_rising, p0 * (1 + m.etau2_kpa / m.eu1_kpa) - m.etau2_kpa * r0, memory["settled_kpa"]
        )
        x2 = np.where(was_rising & ~rising, r0 - p0 / m.e1_kpa - x3, memory["x2"])

        # Each lag after the step is `free + ramp u1` with u1, the load at its end, still to be found.
        gone_u, ramp_u = lag.weights(dt_s, m.tu_s)
        gone2, ramp2 = lag.weights(dt_s, m.t2_s)
        gone3, ramp3 = lag.weights(dt_s, m.t3_s)
        free_u = settled + (p0 - settled) * gone_u - p0 * ramp_u
        free2 = x2 + (p0 / m.e2_kpa - x2) * gone2 - p0 / m.e2_kpa * ramp2
        free3 = x3 + (p0 / m.e3_kpa - x3) * gone3 - p0 / m.e3_kpa * ramp3
        pressure = np.where(
            rising,
            (r + free_u / m.etau2_kpa) / (1 / m.eu1_kpa + (1 - ramp_u) / m.etau2_kpa),
            (r - free2 - free3) / (1 / m.e1_kpa + ramp2 / m.e2_kpa + ramp3 / m.e3_kpa),
        )
        return self._std() | {
            "r": r,
            "pressure_kpa": pressure,
            "rising": rising.astype(np.float64),
            "settled_kpa": free_u + ramp_u * pressure,
            "x2": free2 + ramp2 / m.e2_kpa * pressure,
            "x3": free3 + ramp3 / m.e3_kpa * pressure,
        }


class PaperEstimator(TwoModels):
    """The paper's estimator (P8): invert the rising or the recovery model, as dr/dt and two thresholds say.

    What the paper leaves open is settled thus. dr/dt is (r - l)/T, with l the reading behind a lag
    T = ``derivative_s``: noise is smoothed, yet a sudden change is seen in the sample in which it happens.
    Between the thresholds the last model stays.
    """

    def _begin(self, r: FloatArray) -> Memory:
        return super()._begin(r) | {"lagged_r": r}

    def _advance(self, memory: Memory, dt_s: FloatArray | float, r: FloatArray) -> Memory:
        rises, falls = self.model.thresholds_per_s(self.full_scale_kpa)
        smoothing = -np.expm1(-np.asarray(dt_s) / max(self.model.derivative_s, 1e-9))
        slope = (r - memory["lagged_r"]) * smoothing / dt_s
        rising = (slope > rises) | ((memory["rising"] > 0) & (slope >= falls))
        lagged = memory["lagged_r"] + (r - memory["lagged_r"]) * smoothing
        return self._inverted(memory, dt_s, r, rising) | {"lagged_r": lagged}


class EquilibriumEstimator(Estimator):
    """The equilibrium of the model inverted, without memory: what a calibration curve gives."""

    def __init__(
        self, model: Model, full_scale_kpa: float, shape: tuple[int, ...], rest_resistance_ohm: FloatArray
    ) -> None:
        self.model, self.full_scale_kpa = model, full_scale_kpa
        super().__init__(shape, rest_resistance_ohm)

    def _begin(self, r: FloatArray) -> Memory:
        return {"r": r, "pressure_kpa": self._invert(r)}

    def _advance(self, memory: Memory, dt_s: FloatArray | float, r: FloatArray) -> Memory:
        return self._begin(r)

    def _invert(self, r: FloatArray) -> FloatArray:
        m = self.model
        match m:
            case PaperModel() | AsymmetricModel():
                return r / m.gain_per_kpa
            case M10Model():
                load = np.linspace(0, 1, 1025)
                curve = np.maximum.accumulate((m.a + m.alpha1 + m.alpha2) * load + m.b * load**2)
                rises = np.concatenate(([True], np.diff(curve) > 0))
                return np.interp(r, curve[rises], load[rises]) * self.full_scale_kpa
            case ContactModel():
                rest = self._rest_ohm
                conductance = np.maximum(1 / (rest * np.maximum(1 + r, 1e-9)) - 1 / rest, 0)
                load = (conductance * m.full_scale_resistance_ohm) ** (1 / m.exponent)
                return np.minimum(load, 1) * self.full_scale_kpa
