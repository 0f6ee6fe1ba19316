"""Forward models of piezoresistive cells (pressure to resistance), in the time domain, for whole arrays of cells.

Over each step the pressure of every cell goes linearly from its last value to the given one. The response to such a
load is exact for any step length. ``dt_s = 0`` is a jump.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...errors import InputError
from . import _lag as lag
from ._models import AsymmetricModel, ContactModel, M10Model, Model, PaperModel


class Forward(ABC):
    """An array of cells of one kind, with their memory. New cells are unloaded and at rest."""

    log_span: float | None = None
    """None: the model describes r = R/R0 - 1. A number: r = ln(R0/R)/log_span, of cells whose resistance falls"""

    def __init__(self, shape: tuple[int, ...], rest_resistance_ohm: FloatArray) -> None:
        self.shape = shape
        self.rest_resistance_ohm = resistance_of(shape, rest_resistance_ohm)
        self.reset()

    def reset(self) -> None:
        """Reset all cells to rest: no load, and no memory of loads."""
        self._pressure = np.zeros(self.shape)

    def step(self, dt_s: float, pressure_kpa: ArrayLike) -> FloatArray:
        """Change the pressure linearly to ``pressure_kpa`` in ``dt_s`` seconds; returns the final resistance in ohm.

        ``pressure_kpa`` is broadcast to ``shape``. Raises InputError for a negative ``dt_s``, another shape, a pressure
        that is not finite, or a pull that would leave no resistance.
        """
        if not 0 <= dt_s < np.inf:
            raise InputError(f"time step is {dt_s} s; expected a finite number of seconds >= 0")
        try:
            pressure = np.broadcast_to(np.asarray(pressure_kpa, dtype=np.float64), self.shape)
        except ValueError as error:
            raise InputError(f"pressure has shape {np.shape(pressure_kpa)}, expected {self.shape}") from error
        if not np.isfinite(pressure).all():
            raise InputError("pressure is not finite everywhere; expected kPa")
        self._check_pull(pressure)
        resistance = self._in_ohms(self._step(dt_s, pressure))
        self._pressure = pressure.copy()
        return resistance

    def _in_ohms(self, linear: FloatArray) -> FloatArray:
        """Resistance (..., *shape) in ohm of R0 (1 + r) = ``linear`` (..., *shape)."""
        if self.log_span is None:
            return linear
        r = linear / self.rest_resistance_ohm - 1.0
        return resistance_on_logarithm(r, self.rest_resistance_ohm, self.log_span)

    def _check_pull(self, pressure_kpa: FloatArray) -> None:
        """InputError where a pull would leave no resistance."""
        lowest = self._lowest_kpa()
        if pressure_kpa.size and pressure_kpa.min() < lowest:
            strongest = f"pressure is {pressure_kpa.min():g} kPa"
            raise InputError(f"{strongest}; a pull below {lowest:.3g} kPa leaves no resistance")

    def run(self, dt_s: ArrayLike, pressure_kpa: ArrayLike, cells: IntArray | None = None) -> FloatArray:
        """Take several steps at once: the same as one call of :meth:`step` per frame, up to rounding.

        Args:
            dt_s: (frames,) seconds that each step takes.
            pressure_kpa: (frames, *shape), or (frames, k) if ``cells`` are given.
            cells: (k,) indices into the flattened array of the cells to step; the others stay as they are.

        Returns:
            Resistance in ohm at the end of each step, shaped as ``pressure_kpa``.

        Raises:
            InputError: a negative or infinite time step, another shape, or a pressure that is not finite.

        """
        dt, pressure = np.asarray(dt_s, dtype=np.float64), np.asarray(pressure_kpa, dtype=np.float64)
        shape = self.shape if cells is None else cells.shape
        if dt.ndim != 1 or pressure.shape != (len(dt), *shape):
            raise InputError(
                f"pressures have shape {pressure.shape}, expected (frames, *{shape}) and one dt_s per frame"
            )
        if not ((dt >= 0) & (dt < np.inf)).all():
            raise InputError("time steps must be finite numbers of seconds >= 0")
        if not np.isfinite(pressure).all():
            raise InputError("pressure is not finite everywhere; expected kPa")
        self._check_pull(pressure)
        if not len(dt):
            return np.empty(pressure.shape)
        if cells is None:
            resistance = self._in_ohms(self._run(dt, pressure))
            self._pressure = pressure[-1].copy()
            return resistance
        some = self._gathered(cells)
        resistance = some._in_ohms(some._run(dt, pressure))
        some._pressure = pressure[-1]
        for name in self._STATE:
            getattr(self, name).flat[cells] = getattr(some, name)
        return resistance

    def put_to_rest(self, cells: IntArray, tolerance: float) -> BoolArray:
        """Reset the memory of unloaded cells whose remaining memory is negligible.

        Args:
            cells: (k,) indices into the flattened array.
            tolerance: largest \\|R/R0 - 1\\| that counts as negligible, now and at any later time without load.

        Returns:
            (k,) which of the cells are at rest now. Their memory is reset.

        """
        some = self._gathered(cells)
        resting: BoolArray = (some._pressure == 0) & (some._remembered() <= tolerance)
        for name in self._STATE:
            getattr(self, name).flat[cells[resting]] = 0
        return resting

    _STATE: ClassVar[tuple[str, ...]] = ("_pressure",)
    """names of the arrays that form the memory of the cells; all zeros: cells at rest"""

    def _gathered(self, cells: IntArray) -> Self:
        """A copy of ``cells`` (k,), as an array of shape (k,)."""
        some = copy.copy(self)
        some.shape = cells.shape
        for name in (*self._STATE, "rest_resistance_ohm"):
            setattr(some, name, getattr(self, name).flat[cells])
        return some

    def _run(self, dt_s: FloatArray, pressure: FloatArray) -> FloatArray:
        """:meth:`run` for all cells; the caller sets ``self._pressure``."""
        resistance = np.empty(pressure.shape)
        for frame, dt in enumerate(dt_s.tolist()):
            resistance[frame] = self._step(dt, pressure[frame])
            self._pressure = pressure[frame]
        return resistance

    def _remembered(self) -> FloatArray:
        """Largest \\|R/R0 - 1\\| of each cell from now on, if its load were removed now."""
        return np.zeros(self.shape)

    @abstractmethod
    def _lowest_kpa(self) -> float:
        """The strongest pull (a negative pressure) that leaves a positive resistance after any history."""

    @abstractmethod
    def _step(self, dt_s: float, pressure: FloatArray) -> FloatArray:
        """Advance the memory from ``self._pressure`` to ``pressure``; returns the resistance in ohm."""


class PaperForward(Forward):
    """The paper's switched model: P4 while the pressure rises and is then held, P5 from a fall to the next rise.

    The resistance is continuous at each switch. The rising phase has one state, which is set so that r is continuous.
    In recovery the slow branch keeps its value, since it follows the load in both phases (repeated presses accumulate
    creep, P9). The fast branch is set so that r is continuous.
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
        self._settled = np.zeros(self.shape)  # kPa: state of the rising phase, which lags behind the load
        self._x2 = np.zeros(self.shape)
        self._x3 = np.zeros(self.shape)
        self._rising = np.zeros(self.shape, dtype=bool)  # either phase: at rest both have the same memory

    _STATE = ("_pressure", "_r", "_settled", "_x2", "_x3", "_rising")

    def _remembered(self) -> FloatArray:
        rising = np.abs(self._r - self._pressure / self.model.e1_kpa - self._x3)
        remembered: FloatArray = np.where(self._rising, rising, np.abs(self._x2)) + np.abs(self._x3)
        return remembered

    def _run(self, dt_s: FloatArray, pressure: FloatArray) -> FloatArray:
        """All steps of a block as array operations over time.

        The phase of a cell depends on its pressure alone. Within a phase, its one free state (``_settled`` or ``_x2``)
        is a linear recurrence. A switch between phases is linear, too, since the resistance is continuous. The free
        state therefore follows y[n] = a[n] y[n-1] + b[n] with known a and b.
        """
        m, eta = self.model, self.model.etau2_kpa
        before = np.concatenate([self._pressure[None], pressure[:-1]])
        change = pressure - before
        dt = dt_s.reshape(-1, *[1] * len(self.shape))
        rising = _held(np.sign(change), np.where(self._rising, 1.0, -1.0)) > 0
        was_rising = np.concatenate([self._rising[None], rising[:-1]])

        gone3, ramp3 = lag.weights(dt, m.t3_s)
        x3 = _recurrence(1.0 - gone3, (before * gone3 + change * ramp3) / m.e3_kpa, self._x3)
        x3_before = np.concatenate([self._x3[None], x3[:-1]])

        gone_up, ramp_up = lag.weights(dt, m.tu_s)
        gone_down, ramp_down = lag.weights(dt, m.t2_s)
        starts, ends = rising & ~was_rising, ~rising & was_rising
        # At a switch of phase the new state is scale * (old state) + offset.
        scale = np.where(starts, -eta, np.where(ends, -1.0 / eta, 1.0))
        elastic = before / m.e1_kpa + x3_before
        taken_up = before * (1.0 + eta / m.eu1_kpa) - eta * elastic
        handed_back = before / m.eu1_kpa + before / eta - elastic
        offset = np.where(starts, taken_up, np.where(ends, handed_back, 0.0))
        keep = 1.0 - np.where(rising, gone_up, gone_down)
        driven = np.where(
            rising, before * gone_up + change * ramp_up, (before * gone_down + change * ramp_down) / m.e2_kpa
        )
        first = np.where(self._rising, self._settled, self._x2)
        free = _recurrence(keep * scale, keep * offset + driven, first)

        r = np.where(rising, pressure / m.eu1_kpa + (pressure - free) / eta, pressure / m.e1_kpa + free + x3)
        self._r, self._x3, self._rising = r[-1], x3[-1], rising[-1]
        self._settled = np.where(self._rising, free[-1], 0.0)
        self._x2 = np.where(self._rising, 0.0, free[-1])
        resistance: FloatArray = self.rest_resistance_ohm * (1 + r)
        return resistance

    def _lowest_kpa(self) -> float:
        return -0.99 / (1 / self.model.eu1_kpa + 1 / self.model.etau2_kpa)

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
    """Asymmetric branches, static curvature and chains broken by motion; see :class:`._models.M10Model`."""

    def __init__(
        self, model: M10Model, full_scale_kpa: float, shape: tuple[int, ...], rest_resistance_ohm: FloatArray
    ) -> None:
        self.model, self.full_scale_kpa = model, full_scale_kpa
        super().__init__(shape, rest_resistance_ohm)

    def reset(self) -> None:
        """Back to rest."""
        super().reset()
        self._x1, self._x2, self._broken = (np.zeros(self.shape) for _ in range(3))

    _STATE = ("_pressure", "_x1", "_x2", "_broken")

    def _remembered(self) -> FloatArray:
        return np.abs(self._x1) + np.abs(self._x2) + np.abs(self._broken)

    def _lowest_kpa(self) -> float:
        m = self.model
        gain, bend = max(m.a, 0.0) + m.alpha1 + m.alpha2, max(-m.b, 0.0)
        # The root of bend s^2 + gain s = 0.99, in a form that is valid for bend = 0, too.
        root = 2 * 0.99 / (gain + np.sqrt(gain**2 + 4 * bend * 0.99)) if gain or bend else np.inf
        return -float(root) * self.full_scale_kpa

    def _run(self, dt_s: FloatArray, pressure: FloatArray) -> FloatArray:
        """All steps of a block, both branches together; coefficients that depend on time alone are computed first.

        Whether a branch charges depends on its state. The branches are therefore stepped frame by frame. A step within
        which a branch changes between charging and discharging is computed by :func:`._lag.asymmetric`.
        """
        m = self.model
        each = (2, *[1] * len(self.shape))
        alpha, rise_s, fall_s = (
            np.reshape(pair, each) for pair in ((m.alpha1, m.alpha2), (m.rise1_s, m.rise2_s), (m.fall1_s, m.fall2_s))
        )
        load = np.concatenate([self._pressure[None], pressure]) / self.full_scale_kpa
        target = alpha * load[:, None]  # (frames + 1, 2, ...)
        change = np.diff(target, axis=0)
        dt = dt_s.reshape(-1, *[1] * (len(self.shape) + 1))
        (gone_up, ramp_up), (gone_down, ramp_down) = (lag.weights(dt, constant) for constant in (rise_s, fall_s))
        rising = change > 0

        branches = np.empty(change.shape)
        state = np.stack([self._x1, self._x2])
        for frame, step_s in enumerate(dt_s.tolist()):
            away = target[frame] - state
            charging = (away > 0) | ((away == 0) & rising[frame])
            gone = np.where(charging, gone_up[frame], gone_down[frame])
            ramp = np.where(charging, ramp_up[frame], ramp_down[frame])
            stepped = state + away * gone + change[frame] * ramp
            turned = away * (target[frame + 1] - stepped) < 0
            if turned.any():
                exactly = lag.asymmetric(state, target[frame], target[frame + 1], step_s, rise_s, fall_s)
                stepped = np.where(turned, exactly, stepped)
            state = branches[frame] = stepped
        self._x1, self._x2 = state

        gone, ramp = lag.weights(dt[:, 0], m.tau_s)
        broken = _recurrence(1.0 - gone, m.k * np.abs(np.diff(load, axis=0)) * (1.0 - ramp), self._broken)
        self._broken = broken[-1]
        r = m.a * load[1:] + m.b * load[1:] ** 2 + branches.sum(axis=1) + broken
        resistance: FloatArray = self.rest_resistance_ohm * (1 + r)
        return resistance

    def _step(self, dt_s: float, pressure: FloatArray) -> FloatArray:
        m, s0, s1 = self.model, self._pressure / self.full_scale_kpa, pressure / self.full_scale_kpa
        self._x1 = lag.asymmetric(self._x1, m.alpha1 * s0, m.alpha1 * s1, dt_s, m.rise1_s, m.fall1_s)
        self._x2 = lag.asymmetric(self._x2, m.alpha2 * s0, m.alpha2 * s1, dt_s, m.rise2_s, m.fall2_s)
        gone, ramp = lag.weights(dt_s, m.tau_s)
        self._broken = self._broken * (1 - gone) + m.k * np.abs(s1 - s0) * (1 - ramp)
        r = m.a * s1 + m.b * s1**2 + self._x1 + self._x2 + self._broken
        return self.rest_resistance_ohm * (1 + r)


class ContactForward(Forward):
    """Contact resistance as a power law of the load, without memory; a pull (negative pressure) opens the contact."""

    def __init__(
        self,
        model: ContactModel,
        full_scale_kpa: float,
        shape: tuple[int, ...],
        rest_resistance_ohm: FloatArray,
    ) -> None:
        self.model, self.full_scale_kpa = model, full_scale_kpa
        super().__init__(shape, rest_resistance_ohm)

    def _run(self, dt_s: FloatArray, pressure: FloatArray) -> FloatArray:
        return self._step(0.0, pressure)

    def _lowest_kpa(self) -> float:
        return -np.inf

    def _step(self, dt_s: float, pressure: FloatArray) -> FloatArray:
        load = np.maximum(pressure, 0) / self.full_scale_kpa
        conductance: FloatArray = (
            1 / self.rest_resistance_ohm + load**self.model.exponent / self.model.full_scale_resistance_ohm
        )
        return 1 / conductance


def _held(sign: FloatArray, first: FloatArray) -> FloatArray:
    """Signs (frames, ...) with each zero replaced by the last nonzero sign; ``first`` is the sign before frame 0."""
    known = np.concatenate([first[None], sign])
    frames = np.arange(len(known)).reshape(-1, *[1] * first.ndim)
    last = np.maximum.accumulate(np.where(known != 0, frames, 0), axis=0)
    held: FloatArray = np.take_along_axis(known, last, axis=0)[1:]
    return held


def _recurrence(keep: FloatArray, driven: FloatArray, first: FloatArray) -> FloatArray:
    """y[n] = keep[n] y[n-1] + driven[n] for all frames (frames, ...), with y[-1] = ``first``.

    Frames are computed one by one, so that rounding errors do not depend on how a history is cut into blocks.
    """
    result = np.array(driven)
    if first.size == 1:  # plain numbers are faster than arrays of one cell
        x, states = float(first.item()), []
        for factor, add in zip(keep.ravel().tolist(), result.ravel().tolist(), strict=True):
            x = factor * x + add
            states.append(x)
        return np.reshape(states, result.shape)
    last = first
    carried = np.empty_like(first)
    for factor, state in zip(keep, result, strict=True):
        np.multiply(factor, last, out=carried)
        np.add(state, carried, out=state)
        last = state
    return result


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
    """The same cell as an :class:`._models.M10Model`, which is more general."""
    return M10Model(
        a=full_scale_kpa / model.e1_kpa,
        alpha1=full_scale_kpa / model.e2_kpa,
        rise1_s=model.rise_s,
        fall1_s=model.t2_s,
        alpha2=full_scale_kpa / model.e3_kpa,
        rise2_s=model.rise_s,
        fall2_s=model.t3_s,
    )


def resistance_on_logarithm(r: FloatArray, rest_resistance_ohm: FloatArray | float, log_span: float) -> FloatArray:
    """Resistance in ohm of cells whose r is ln(R0/R)/``log_span``."""
    return np.asarray(rest_resistance_ohm * np.exp(-log_span * r))


def resistance_of(shape: tuple[int, ...], rest_resistance_ohm: FloatArray) -> FloatArray:
    """R0 of every cell as an array of ``shape``; InputError unless it fits and is positive and finite."""
    try:
        rest = np.broadcast_to(rest_resistance_ohm, shape).copy()
    except ValueError as error:
        raise InputError(f"rest resistance has shape {rest_resistance_ohm.shape}, expected {shape}") from error
    if not ((rest > 0) & np.isfinite(rest)).all():
        raise InputError("rest resistance must be positive and finite for every cell, in ohm")
    return rest
