"""Forward models of piezoresistive cells (pressure to resistance), in the time domain, for whole arrays of cells.

Over each step the pressure of every cell goes linearly from its last value to the given one. The response to such a
load is exact for any step length. ``dt_s = 0`` is a jump.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Record, Records, zeros
from ...errors import InputError
from ._models import AsymmetricModel, ContactModel, M10Model, Model, PaperModel
from ._steps import M10Cell, M10Memory, PaperCell, PaperMemory, run_m10, run_paper


class Forward(ABC):
    """An array of cells of one kind, with their memory. New cells are unloaded and at rest."""

    log_span: float | None = None
    """None: the model describes r = R/R0 - 1. A number: r = ln(R0/R)/log_span, of cells whose resistance falls"""

    _kind: ClassVar[type[Record]]
    """memory of a cell; all zeros: at rest"""

    def __init__(self, shape: tuple[int, ...], rest_resistance_ohm: FloatArray) -> None:
        self.shape = shape
        self.rest_resistance_ohm = resistance_of(shape, rest_resistance_ohm)
        self._cells = self.rest_resistance_ohm.size
        self.reset()

    def reset(self) -> None:
        """Reset all cells to rest: no load, and no memory of loads."""
        self._memory: Records[Any] = zeros(self._kind, self._cells)

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
        (resistance,) = self.run(np.array([dt_s]), pressure[None])
        return np.asarray(resistance)

    def _in_ohms(self, rest_ohm: FloatArray, r: FloatArray) -> FloatArray:
        """Resistance (n, k) in ohm."""
        if self.log_span is None:
            return np.asarray(rest_ohm * (1.0 + r))
        return resistance_on_logarithm(r, rest_ohm, self.log_span)

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
        rest = self.rest_resistance_ohm.reshape(-1)
        if cells is None:
            r = self._run(self._memory, dt, pressure.reshape(len(dt), -1))
            return self._in_ohms(rest, r).reshape(pressure.shape)
        memory = self._memory[cells]
        r = self._run(memory, dt, pressure)
        self._memory[cells] = memory
        return self._in_ohms(rest[cells], r)

    def put_to_rest(self, cells: IntArray, tolerance: float) -> BoolArray:
        """Reset the memory of unloaded cells whose remaining memory is negligible.

        Args:
            cells: (k,) indices into the flattened array.
            tolerance: largest \\|R/R0 - 1\\| that counts as negligible, now and at any later time without load.

        Returns:
            (k,) which of the cells are at rest now. Their memory is reset.

        """
        memory = self._memory[cells]
        resting: BoolArray = (memory["load"] == 0) & (self._remembered(memory) <= tolerance)
        self._memory[cells[resting]] = zeros(self._kind, 1)
        return resting

    @abstractmethod
    def _run(self, memory: Records[Any], dt_s: FloatArray, pressure: FloatArray) -> FloatArray:
        """r (n, k) of cells with their ``memory`` (k,), changed, after steps ``dt_s`` (n,) to ``pressure`` (n, k)."""

    @abstractmethod
    def _remembered(self, memory: Records[Any]) -> FloatArray:
        """Largest \\|R/R0 - 1\\| of each cell from now on, if its load were removed now."""

    @abstractmethod
    def _lowest_kpa(self) -> float:
        """The strongest pull (a negative pressure) that leaves a positive resistance after any history."""


class PaperForward(Forward):
    """The paper's switched model: P4 while the pressure rises and is then held, P5 from a fall to the next rise.

    The resistance is continuous at each switch. The rising phase has one state, which is set so that r is continuous.
    In recovery the slow branch keeps its value, since it follows the load in both phases (repeated presses accumulate
    creep, P9). The fast branch is set so that r is continuous.
    """

    _kind = PaperMemory

    def __init__(
        self, model: PaperModel, full_scale_kpa: float, shape: tuple[int, ...], rest_resistance_ohm: FloatArray
    ) -> None:
        self.model = m = model
        self._parameters = paper_cells(
            1, m.eu1_kpa, m.etau2_kpa, m.e1_kpa, m.e2_kpa, m.e3_kpa, np.array([[m.tu_s, m.t2_s, m.t3_s]])
        )
        super().__init__(shape, rest_resistance_ohm)

    def _run(self, memory: Records[PaperMemory], dt_s: FloatArray, pressure: FloatArray) -> FloatArray:
        r = np.empty(pressure.shape)
        run_paper.unchecked(self._parameters, memory, dt_s, np.require(pressure, requirements=["C", "W"]), r)
        return r

    def _remembered(self, memory: Records[PaperMemory]) -> FloatArray:
        of_rising = memory["r"] - memory["load"] / self.model.e1_kpa - memory["x3"]
        x2 = np.where(memory["rising"] > 0, of_rising, memory["x2"])
        return np.asarray(np.abs(x2) + np.abs(memory["x3"]))

    def _lowest_kpa(self) -> float:
        return -0.99 / (1 / self.model.eu1_kpa + 1 / self.model.etau2_kpa)


class M10Forward(Forward):
    """Asymmetric branches, static curvature and chains broken by motion; see :class:`._models.M10Model`."""

    _kind = M10Memory

    def __init__(
        self, model: M10Model, full_scale_kpa: float, shape: tuple[int, ...], rest_resistance_ohm: FloatArray
    ) -> None:
        self.model, self.full_scale_kpa = model, full_scale_kpa
        self._parameters = m10_cells(np.array([[getattr(model, name)] for name in M10_PARAMETERS]))
        super().__init__(shape, rest_resistance_ohm)

    def _run(self, memory: Records[M10Memory], dt_s: FloatArray, pressure: FloatArray) -> FloatArray:
        r = np.empty(pressure.shape)
        load = np.ascontiguousarray(pressure / self.full_scale_kpa)
        run_m10.unchecked(self._parameters, memory, dt_s, load, r)
        return r

    def _remembered(self, memory: Records[M10Memory]) -> FloatArray:
        return np.asarray(np.abs(memory["x"]).sum(axis=1) + np.abs(memory["broken"]))

    def _lowest_kpa(self) -> float:
        m = self.model
        gain, bend = max(m.a, 0.0) + m.alpha1 + m.alpha2, max(-m.b, 0.0)
        # The root of bend s^2 + gain s = 0.99, in a form that is valid for bend = 0, too.
        root = 2 * 0.99 / (gain + np.sqrt(gain**2 + 4 * bend * 0.99)) if gain or bend else np.inf
        return -float(root) * self.full_scale_kpa


class Held(Record):
    """Memory of a contact: only its load."""

    load: float


class ContactForward(Forward):
    """Contact resistance as a power law of the load, without memory; a pull (negative pressure) opens the contact."""

    _kind = Held

    def __init__(
        self, model: ContactModel, full_scale_kpa: float, shape: tuple[int, ...], rest_resistance_ohm: FloatArray
    ) -> None:
        self.model, self.full_scale_kpa = model, full_scale_kpa
        super().__init__(shape, rest_resistance_ohm)

    def _run(self, memory: Records[Held], dt_s: FloatArray, pressure: FloatArray) -> FloatArray:
        memory["load"] = pressure[-1]
        return np.maximum(pressure, 0) / self.full_scale_kpa

    def _in_ohms(self, rest_ohm: FloatArray, r: FloatArray) -> FloatArray:
        conductance = 1 / rest_ohm + r**self.model.exponent / self.model.full_scale_resistance_ohm
        return np.asarray(1 / conductance)

    def _remembered(self, memory: Records[Held]) -> FloatArray:
        return np.zeros(memory.size)

    def _lowest_kpa(self) -> float:
        return -np.inf


M10_PARAMETERS = ("a", "b", "alpha1", "rise1_s", "fall1_s", "alpha2", "rise2_s", "fall2_s", "k", "tau_s")


def m10_cells(parameters: FloatArray) -> Records[M10Cell]:
    """Cells with ``parameters`` (10, m), in the order of :data:`M10_PARAMETERS`."""
    a, b, alpha1, rise1, fall1, alpha2, rise2, fall2, k, tau = parameters
    cells = zeros(M10Cell, parameters.shape[1])
    cells["a"], cells["b"], cells["k"], cells["tau_s"] = a, b, k, tau
    for name, pair in (("alpha", (alpha1, alpha2)), ("rise_s", (rise1, rise2)), ("fall_s", (fall1, fall2))):
        cells[name] = np.stack(pair, axis=1)
    return cells


def paper_cells(
    count: int,
    eu1: FloatArray | float,
    etau2: FloatArray | float,
    e1: FloatArray | float,
    e2: FloatArray | float,
    e3: FloatArray | float,
    t_s: FloatArray,
) -> Records[PaperCell]:
    """Cells with these moduli, in the unit of the loads, and time constants (m, 3)."""
    cells = zeros(PaperCell, count)
    for name, value in (("eu1", eu1), ("etau2", etau2), ("e1", e1), ("e2", e2), ("e3", e3), ("t_s", t_s)):
        cells[name] = value
    return cells


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
