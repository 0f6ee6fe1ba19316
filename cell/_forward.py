"""Forward models: pressure to resistance, for whole arrays of cells at once.

A forward model is stepped: over each step the pressure of every cell goes linearly from where it was to the
value given, and the answer is exact for such a load whatever the step. ``dt_s = 0`` is a jump.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import FloatArray
from ..errors import InputError
from . import _lag as lag
from ._models import AsymmetricModel, ContactModel, M10Model, Model, PaperModel


class Forward(ABC):
    """Cells of one kind with their memory, unloaded and at rest when made."""

    def __init__(self, shape: tuple[int, ...], rest_resistance_ohm: FloatArray) -> None:
        self.shape = shape
        self.rest_resistance_ohm = resistance_of(shape, rest_resistance_ohm)
        self.reset()

    def reset(self) -> None:
        """Back to rest: no load, and none remembered."""
        self._pressure = np.zeros(self.shape)

    def step(self, dt_s: float, pressure_kpa: ArrayLike) -> FloatArray:
        """Let the pressure go linearly to ``pressure_kpa`` in ``dt_s`` seconds; the resistance there, in ohm.

        ``pressure_kpa`` is broadcast to ``shape``. Raises InputError for a negative ``dt_s``, another shape,
        or a pressure that is not finite.
        """
        if not 0 <= dt_s < np.inf:
            raise InputError(f"time step is {dt_s} s; expected a finite number of seconds >= 0")
        try:
            pressure = np.broadcast_to(np.asarray(pressure_kpa, dtype=np.float64), self.shape)
        except ValueError as error:
            raise InputError(f"pressure has shape {np.shape(pressure_kpa)}, expected {self.shape}") from error
        if not np.isfinite(pressure).all():
            raise InputError("pressure is not finite everywhere; expected kPa")
        resistance = self._step(dt_s, pressure)
        self._pressure = pressure.copy()
        return resistance

    @abstractmethod
    def _step(self, dt_s: float, pressure: FloatArray) -> FloatArray:
        """Advance the memory from ``self._pressure`` to ``pressure``; the resistance in ohm."""


class PaperForward(Forward):
    """P4 while the pressure rises and while it is held after that, P5 from a fall to the next rise.

    The resistance is continuous at a hand-over. Rising takes it up in its one state; in recovery the slow
    branch is what it always was (it follows the load in both phases, so that repeated presses accumulate
    creep, P9), and the fast branch takes the rest.
    """

    def __init__(
        self,
        model: PaperModel,
        full_scale_kpa: float,
        shape: tuple[int, ...],
        rest_resistance_ohm: FloatArray,
    ) -> None:
        self.model = model
        super().__init__(shape, rest_resistance_ohm)

    def reset(self) -> None:
        """Back to rest."""
        super().reset()
        self._r = np.zeros(self.shape)
        self._settled = np.zeros(self.shape)  # kPa: the load that the rising phase has settled to
        self._x2 = np.zeros(self.shape)
        self._x3 = np.zeros(self.shape)
        self._rising = np.ones(self.shape, dtype=bool)

    def _step(self, dt_s: float, pressure: FloatArray) -> FloatArray:
        m, before = self.model, self._pressure
        starts = (pressure > before) & ~self._rising
        ends = (pressure < before) & self._rising
        settled = np.where(starts, before * (1 + m.etau2_kpa / m.eu1_kpa) - m.etau2_kpa * self._r, self._settled)
        x2 = np.where(ends, self._r - before / m.e1_kpa - self._x3, self._x2)
        self._rising = (self._rising | starts) & ~ends

        self._settled = lag.symmetric(settled, before, pressure, dt_s, m.tu_s)
        self._x2 = lag.symmetric(x2, before / m.e2_kpa, pressure / m.e2_kpa, dt_s, m.t2_s)
        self._x3 = lag.symmetric(self._x3, before / m.e3_kpa, pressure / m.e3_kpa, dt_s, m.t3_s)
        self._r = np.where(
            self._rising,
            pressure / m.eu1_kpa + (pressure - self._settled) / m.etau2_kpa,
            pressure / m.e1_kpa + self._x2 + self._x3,
        )
        return self.rest_resistance_ohm * (1 + self._r)


class M10Forward(Forward):
    """Asymmetric branches, static curvature and breakdown by motion; see :class:`~.models.M10Model`."""

    def __init__(
        self, model: M10Model, full_scale_kpa: float, shape: tuple[int, ...], rest_resistance_ohm: FloatArray
    ) -> None:
        self.model, self.full_scale_kpa = model, full_scale_kpa
        super().__init__(shape, rest_resistance_ohm)

    def reset(self) -> None:
        """Back to rest."""
        super().reset()
        self._x1, self._x2, self._broken = (np.zeros(self.shape) for _ in range(3))

    def _step(self, dt_s: float, pressure: FloatArray) -> FloatArray:
        m, s0, s1 = self.model, self._pressure / self.full_scale_kpa, pressure / self.full_scale_kpa
        self._x1 = lag.asymmetric(self._x1, m.alpha1 * s0, m.alpha1 * s1, dt_s, m.rise1_s, m.fall1_s)
        self._x2 = lag.asymmetric(self._x2, m.alpha2 * s0, m.alpha2 * s1, dt_s, m.rise2_s, m.fall2_s)
        gone, ramp = lag.weights(dt_s, m.tau_s)
        self._broken = self._broken * (1 - gone) + m.k * np.abs(s1 - s0) * (1 - ramp)
        r = m.a * s1 + m.b * s1**2 + self._x1 + self._x2 + self._broken
        return self.rest_resistance_ohm * (1 + r)


class ContactForward(Forward):
    """Contact resistance, without memory; a pull (negative pressure) opens the contact."""

    def __init__(
        self,
        model: ContactModel,
        full_scale_kpa: float,
        shape: tuple[int, ...],
        rest_resistance_ohm: FloatArray,
    ) -> None:
        self.model, self.full_scale_kpa = model, full_scale_kpa
        super().__init__(shape, rest_resistance_ohm)

    def _step(self, dt_s: float, pressure: FloatArray) -> FloatArray:
        load = np.maximum(pressure, 0) / self.full_scale_kpa
        conductance: FloatArray = (
            1 / self.rest_resistance_ohm + load**self.model.exponent / self.model.full_scale_resistance_ohm
        )
        return 1 / conductance


def make_forward(
    model: Model, full_scale_kpa: float, shape: tuple[int, ...], rest_resistance_ohm: FloatArray
) -> Forward:
    """The forward model of a kind of cell."""
    match model:
        case PaperModel():
            return PaperForward(model, full_scale_kpa, shape, rest_resistance_ohm)
        case AsymmetricModel():
            return M10Forward(as_m10(model, full_scale_kpa), full_scale_kpa, shape, rest_resistance_ohm)
        case M10Model():
            return M10Forward(model, full_scale_kpa, shape, rest_resistance_ohm)
        case ContactModel():
            return ContactForward(model, full_scale_kpa, shape, rest_resistance_ohm)


def as_m10(model: AsymmetricModel, full_scale_kpa: float) -> M10Model:
    """The same cell, written in the more general model."""
    return M10Model(
        a=full_scale_kpa / model.e1_kpa,
        alpha1=full_scale_kpa / model.e2_kpa,
        rise1_s=model.rise_s,
        fall1_s=model.t2_s,
        alpha2=full_scale_kpa / model.e3_kpa,
        rise2_s=model.rise_s,
        fall2_s=model.t3_s,
    )


def resistance_of(shape: tuple[int, ...], rest_resistance_ohm: FloatArray) -> FloatArray:
    """R0 of every cell as an array of ``shape``; InputError unless it fits and is positive and finite."""
    try:
        rest = np.broadcast_to(rest_resistance_ohm, shape).copy()
    except ValueError as error:
        raise InputError(f"rest resistance has shape {rest_resistance_ohm.shape}, expected {shape}") from error
    if not ((rest > 0) & np.isfinite(rest)).all():
        raise InputError("rest resistance must be positive and finite for every cell, in ohm")
    return rest
