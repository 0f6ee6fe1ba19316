"""Causal estimation of pressure from resistance, frame by frame, for any material.

Each frame passes these steps:

1. Readings become r, the normalised resistance or what else the cell's scale says (:mod:`._scale`): an interval, by the
   quantisation step or by a limit of the converter, and the variance of the noise. A reading counts as missing if it is
   NaN, shorted, or beyond every credible load. Without current a cell that is open at rest bears no load.
2. Quantisation that the cells of a column share is taken out (:mod:`._columns`); noise that they share is noise.
3. The filter (:mod:`._filter`, :mod:`._modes`) follows each cell: noise, bad contacts, missing readings, rest and turns
   of the load are modes or probabilities of one state.
4. An :class:`._inversion.Inversion` makes pressures of what the filter follows, and states the error of the model.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import BoolArray, FloatArray
from ...common.compiled import Records, values, zeros
from ...common.measurement import STEP_STD, Measurement
from ...common.noise import NoiseEstimate
from ...errors import InputError
from .._state import CellState
from ..materials import ByStep
from ._columns import share_each
from ._conditions import Conditions
from ._filter import Candidates, Estimates, Pools, Watch, begin_each, step_each
from ._inversion import UNKNOWN, Inversion
from ._modes import TUNING, Material, Step, Tuning, discretise
from ._scale import Scale

FORGET_EVERY_S = 0.05
"""s, after which evidence is forgotten, and cells are put to sleep"""
SETTLED = 0.01
"""share of r at full scale, which the memory of a sleeping cell may still hold"""
LEAST_STD = 1e-6
"""of r: readings are not taken as more exact"""
OF_STEP = 0.2
"""least noise of a reading over the deviation by its quantisation: what else is in a step nobody sees"""
FAR = 1e9
"""r of a bound that is none"""
BELOW_STD = 3.0
"""standard deviations of the noise below zero, from which a reading is in error"""
READINGS_OVERLOAD = 30.0
"""full scales of r that a filter of readings follows"""


class Estimator:
    """Pressure of an array of cells; made by :meth:`ohmskin.cell.Cell.estimator`.

    Call :meth:`step` or :meth:`update` for every frame. The first reading of a cell is taken to be at equilibrium (at
    rest, or under a load held for long).
    """

    def __init__(
        self,
        inversion: Inversion,
        shape: tuple[int, ...],
        rest_resistance_ohm: FloatArray,
        scale: Scale,
        conditions: Conditions,
    ) -> None:
        """``rest_resistance_ohm`` (n,) holds R0 of each cell of ``shape``, ``scale`` turns their readings into r."""
        self.shape, self.inversion = shape, inversion
        self._rest_ohm, self._scale, self._conditions = rest_resistance_ohm, scale, conditions
        self.rest_error = conditions.rest_error
        """relative standard deviation of R0, which widens the stated deviations"""
        count = rest_resistance_ohm.size
        material = inversion.material
        follows_load = material is not None
        self._unit = 1.0 if follows_load else inversion.side * inversion.full_scale_r
        """r, or load, of one unit of what the filter follows"""
        self._r_unit = 1.0 if follows_load else self._unit
        self._material = material if material is not None else Material.without_memory()
        tuning = TUNING
        if not follows_load:
            # What a cell without memory reads is over when it is over.
            bad_hz, drift = (TUNING.bad_hz, TUNING.drift) if inversion.remembers else (0.0, 0.0)
            none = {"memory": 0.0, "floor": 0.0, "relative": 0.0, "extrapolated": 0.0}
            tuning = replace(TUNING, **none, drift=drift, overload=READINGS_OVERLOAD, bad_hz=bad_hz)
        self._steps = ByStep(_one_step, (self._material, tuning))
        self._cells, self._befores = zeros(Estimates, count), zeros(Estimates, count)
        self._watches = zeros(Watch, count)
        self._scratch = zeros(Candidates, 1), zeros(Pools, 1), zeros(Estimates, 1)
        self._states, self._memory = zeros(CellState, count), zeros(inversion.memory, count)
        self._noise = NoiseEstimate(count, quantum=0.0, expected=conditions.noise or 0.0)
        self._step_std = np.zeros(count)
        """(n,) relative standard deviation of conductances at rest by quantisation"""
        self._columns = np.zeros(shape[1] if len(shape) == 2 else 1)
        """(columns,) recent mean of what columns share"""
        self._read = np.zeros(count, dtype=np.bool_)
        """(n,) whether each cell has been read"""
        self._known = np.zeros(count, dtype=np.bool_)
        """(n,) whether each cell was read in the last frame: what was before a gap says nothing without a memory"""
        self._sleeps = np.zeros(count)
        self._pressure, self._variance = np.full((2, count), np.nan)
        self._level_variance = np.zeros(count)
        self._frames, self._since_forgot_s = 0, 0.0

    # -- the frame ---------------------------------------------------------------------------------------------------

    def step(self, elapsed_s: float, resistance_ohm: ArrayLike) -> FloatArray:
        """Take the frame read ``elapsed_s`` after the last one (any number for the first frame).

        The noise of the readings is measured from frame to frame.

        Args:
            elapsed_s: seconds since the last frame.
            resistance_ohm: (shape) in ohm; NaN and not positive entries are missing. An infinite entry reads no
                current: no load, on a cell that is open at rest; else it is missing, as of one that is not connected.

        Returns:
            (shape) pressure in kPa. A cell whose reading is missing keeps its last value; NaN before its first reading.

        Raises:
            InputError: another shape, or a time step that is not a positive number of seconds.
        """
        resistance = np.asarray(resistance_ohm, dtype=np.float64)
        if resistance.shape != self.shape:
            raise InputError(f"resistance has shape {resistance.shape}, expected {self.shape}")
        ohm = resistance.ravel()
        with np.errstate(divide="ignore", invalid="ignore"):
            conductance = np.where(ohm > 0.0, 1.0 / ohm, np.nan)
        if not self._scale.open_at_rest:
            conductance[conductance == 0.0] = np.nan
        known = np.isfinite(conductance)
        relative = conductance * self._rest_ohm
        if self.inversion.exact or not known.any():
            noise = np.zeros(ohm.size)
        else:
            self._noise.update(np.where(known, relative, 0.0), missing=None if known.all() else ~known)
            noise = np.maximum(self._noise.each, 0.0)
        steps = self._step_std
        own = np.sqrt(np.maximum(noise * noise - steps * steps, (OF_STEP * steps) ** 2)) / self._rest_ohm
        half = steps / (STEP_STD * self._rest_ohm)
        return self._take(elapsed_s, conductance, own * own, half, None, None)

    def update(self, elapsed_s: float, measured: Measurement) -> FloatArray:
        """As :meth:`step`, from conductances with their errors; a reading at a limit of the converter is an interval.

        Noise, steps and what columns share are those that the measurement states.
        """
        if measured.conductance.shape != self.shape:
            raise InputError(f"conductance has shape {measured.conductance.shape}, expected {self.shape}")
        conductance = measured.conductance.ravel()
        shared = measured.column_std.ravel(), measured.column_half_step.ravel()
        bounds = measured.least.ravel(), measured.greatest.ravel()
        noise, half = measured.noise_variance.ravel(), measured.half_step.ravel()
        return self._take(elapsed_s, conductance, noise, half, bounds, shared)

    def _take(
        self,
        elapsed_s: float,
        conductance: FloatArray,
        noise_variance: FloatArray,
        half_step: FloatArray,
        bounds: tuple[FloatArray, FloatArray] | None,
        shared: tuple[FloatArray, FloatArray] | None,
    ) -> FloatArray:
        """Take conductances (n,) with the variance of their noise and half a quantisation step.

        ``bounds`` hold where there is no conductance; ``shared``: standard deviation and half step that columns share.
        """
        if self._frames and not 0 < elapsed_s < np.inf:
            raise InputError(f"a frame follows {elapsed_s} s after the last; expected time stamps that increase")
        dt = float(elapsed_s) if self._frames else 1.0
        low, high, var, known, slope = self._readings(conductance, noise_variance, half_step, bounds)
        begins = ~self._read if self.inversion.remembers else ~self._known
        new, self._known = np.flatnonzero(known & begins), known
        if new.size:
            self._begin(new, 0.5 * (low + high)[new])
        marks = np.where(known, 1.0, np.where(self._read, 0.0, -1.0))
        places = self._read.nonzero()[0]
        if not self.inversion.filtered:
            places = known.nonzero()[0]
            self._states["level"][places] = 0.5 * (low + high)[places] * self._r_unit
        elif places.size:
            places = self._filter(dt, low, high, var, marks, shared, slope)
        if places.size:
            self.inversion.advance(self._states, self._memory, places, dt)
        self._show(marks)
        self._frames += 1
        return self._pressure.reshape(self.shape).copy()

    def _readings(
        self,
        conductance: FloatArray,
        noise_variance: FloatArray,
        half_step: FloatArray,
        bounds: tuple[FloatArray, FloatArray] | None,
    ) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray, FloatArray]:
        """Bounds of r (n,), the variance of its noise, which are known, and the slope of r by conductances."""
        count = conductance.size
        exact, r = np.isfinite(conductance), np.empty(count)
        centre = np.where(exact, conductance, np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            self._scale.read(1.0 / centre, r)
            slope = self._scale.slope(centre)
            r, slope = r / self._r_unit, slope / self._r_unit
            half = np.abs(slope) * half_step
            var = np.maximum(slope * slope * noise_variance, LEAST_STD**2)
        if self._scale.open_at_rest:  # no current, hence no load
            silent = exact & ~(np.isfinite(r) & np.isfinite(slope) & (conductance > 0.0))
            r[silent], half[silent], var[silent] = 0.0, 0.0, LEAST_STD**2
        least, most = self.inversion.credible
        # No load and no memory leaves r below zero: what is there beyond the noise is an error of the reading.
        below = np.minimum(r + BELOW_STD * np.sqrt(var) + half, 0.0)
        r, var = r - below, var + below * below
        low, high = r - half, r + half
        credible = ((r + below) * self._r_unit > least) & (r * self._r_unit < most)
        known = exact & credible & np.isfinite(half) & np.isfinite(var)
        if bounds is not None and not exact.all():
            self._bound(np.flatnonzero(~exact), bounds, (low, high, var, known))
        return low, high, np.where(known, var, 1.0), known, np.where(known & exact, slope, 0.0)

    def _bound(
        self,
        places: np.ndarray[tuple[int], np.dtype[np.intp]],
        bounds: tuple[FloatArray, FloatArray],
        readings: tuple[FloatArray, FloatArray, FloatArray, BoolArray],
    ) -> None:
        """Write readings of cells at ``places`` (k,) of which only bounds on the conductance are known."""
        low, high, var, known = readings
        edges = []
        for bound in bounds:
            edge, told = np.full(known.size, np.nan), np.zeros(known.size, dtype=np.bool_)
            told[places] = np.isfinite(bound[places]) & (bound[places] > 0.0)
            with np.errstate(divide="ignore", invalid="ignore"):
                self._scale.read(np.where(told, 1.0 / bound, np.nan), edge)
            edges.append(edge[places] / self._r_unit)
        falls, usual = self._scale.falls, self.inversion.usual_level
        # The unit of a cell whose resistance falls is negative, so that r rises with its load either way.
        first, last = (edges[0], edges[1]) if falls else (edges[1], edges[0])
        if falls and self._scale.open_at_rest:  # a bound below is none
            says = np.isfinite(first) | np.isfinite(last)
        else:
            says = np.isfinite(first) if falls else np.isfinite(last) & (last > 0.0)
        first = np.where(np.isfinite(first), first, -FAR)
        last = np.where(np.isfinite(last), last, FAR)
        if falls:  # usual loads alone are credited
            last = np.minimum(last, np.maximum(usual, first))
        # No load reads less than rest but for errors: as far below as above, so that the middle says nothing.
        low[places], high[places], var[places] = np.maximum(first, -last), last, LEAST_STD**2
        known[places] = says & (first <= last) & (last > 0.0)

    def _begin(self, new: np.ndarray[tuple[int], np.dtype[np.intp]], r: FloatArray) -> None:
        """Begin cells with their first reading, as if the load had been held for ever."""
        m = self._material
        r = np.where(np.abs(r) < 0.1 * FAR, r, 0.0)
        begin_each.unchecked(self._cells, new, r, m.geq, m.gu, m.g3)
        self._watches[new] = zeros(Watch, 1)
        self.inversion.begin(self._states, self._memory, new, r * self._r_unit)
        self._read[new] = True

    def _filter(
        self,
        dt: float,
        low: FloatArray,
        high: FloatArray,
        var: FloatArray,
        marks: FloatArray,
        shared: tuple[FloatArray, FloatArray] | None,
        slope: FloatArray,
    ) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """Let the filter take a frame; returns the cells (k,) that were awake."""
        slept = self._watches["asleep"] > 0.0
        step = self._steps.of(round(dt, 7))
        if shared is not None:
            std, steps = shared[0] * slope, shared[1] * slope
            var += std * std
            if steps.any():
                scratch = np.empty((2, low.size))
                share_each.unchecked(
                    *(self._cells, self._watches, step, STEP_STD * steps, np.abs(steps), marks, self._columns),
                    *(low, high, var, scratch[0], scratch[1]),
                )
        self._since_forgot_s += dt
        forget = 1.0
        if self._since_forgot_s >= FORGET_EVERY_S:
            forget = math.exp(-self._since_forgot_s / TUNING.forget_s)
            self._since_forgot_s = 0.0
            self._sleeps[:] = 0.0 if self.inversion.exact else self._settled()
        load, variance = np.zeros((2, low.size))
        step_each.unchecked(
            *(self._cells, self._befores, self._watches, *self._scratch, step, low, high, var, marks, self._sleeps),
            *(forget, load, variance),
        )
        self._level_variance = variance
        self._states["level"] = load * self._unit
        return np.flatnonzero((marks > 0.0) & ~(slept & (self._watches["asleep"] > 0.0)))

    def _settled(self) -> FloatArray:
        """(n,) 1 where the memory of the inversion is that of rest."""
        every, band = np.arange(self._sleeps.size), SETTLED * self.inversion.full_scale_r
        return np.asarray(self.inversion.settled(self._states, self._memory, every, band) * 1.0)

    def _show(self, marks: FloatArray) -> None:
        """Write the pressures and variances of the frame."""
        states, full = self._states, self.inversion.full_scale_kpa
        asleep = self._watches["asleep"] > 0.0
        pressure = np.where(asleep, 0.0, states["pressure_kpa"])
        variance = states["variance_kpa2"].copy()
        if self.inversion.filtered:
            gain = states["gain_kpa"] * self._unit
            variance += np.minimum(gain * gain * self._level_variance, (UNKNOWN * full) ** 2)
            if self.inversion.material is None:  # the filter's floor is one of loads, and r need not be linear in them
                variance += (TUNING.floor * full) ** 2
        variance += self._conditions.model_std_kpa**2
        slopes = self._conditions.rest_slope_kpa
        if slopes is not None and self.rest_error:
            at = np.interp(pressure, np.linspace(0.0, full, slopes.size), slopes)
            variance += (self.rest_error * at) ** 2
        if not self.states_std:
            variance[:] = np.nan
        unread = marks <= 0.0
        if unread.any():  # the last pressure is kept; what the filter thinks of it since counts as doubt
            kept = self._pressure
            off = np.where(unread & np.isfinite(kept), pressure - kept, 0.0)
            pressure = np.where(unread, kept, pressure)
            variance = np.where(np.isnan(pressure), np.nan, variance + off * off)
        self._pressure, self._variance = pressure, variance

    # -- what is known beside the readings -----------------------------------------------------------------------------

    @property
    def rest_ohm(self) -> FloatArray:
        """(shape) rest resistances in use."""
        return self._rest_ohm.reshape(self.shape)

    @property
    def side(self) -> float:
        """Sign of the change of a resistance under load."""
        return -1.0 if self._scale.falls else 1.0

    @property
    def resolved(self) -> bool:
        """Whether :meth:`resolve` has been called."""
        return bool(self._step_std.any())

    def resolve(self, step_std: ArrayLike, resistance_ohm: ArrayLike) -> None:
        """Set the resolution of readings (ADC quantisation), which :meth:`step` does not see where noise is small.

        Args:
            step_std: (shape) relative standard deviation of a conductance by the quantisation step of its own reading.
            resistance_ohm: (shape) readings in ohm at which ``step_std`` holds. Cells without a finite reading get the
                median of the others. If no reading is finite, nothing happens.
        """
        std = np.broadcast_to(np.asarray(step_std, dtype=np.float64), self.shape).ravel()
        ohm = np.asarray(resistance_ohm, dtype=np.float64).ravel()
        with np.errstate(divide="ignore", invalid="ignore"):
            at_rest = std * np.where(ohm > 0.0, self._rest_ohm / ohm, np.nan)
        found = np.isfinite(at_rest) & (at_rest > 0.0)
        if found.any():
            self._step_std = np.where(found, at_rest, np.median(at_rest[found]))
            self._noise = NoiseEstimate(
                at_rest.size,
                quantum=float(np.median(self._step_std)) * 12.0**0.5,
                expected=self._conditions.noise or 0.0,
            )

    @property
    def std_kpa(self) -> FloatArray:
        """(shape) standard deviation of the estimate of the last step, in kPa; NaN where none can be stated."""
        return np.asarray(np.sqrt(self.variance_of_last_step()()))

    def variance_of_last_step(self) -> Callable[[], FloatArray]:
        """A function that returns the square of :attr:`std_kpa` of the last step, at any time and in any thread."""
        variance = self._variance.reshape(self.shape)
        return variance.copy

    @property
    def states_std(self) -> bool:
        """Whether a standard deviation is stated."""
        return self.inversion.knows_errors or self._conditions.model_std_kpa > 0

    # -- saving ------------------------------------------------------------------------------------------------------

    def state(self) -> dict[str, FloatArray]:
        """A copy of the whole state, for :meth:`restore`: float64 arrays by name."""
        own = {"cells": values(self._cells), "befores": values(self._befores), "watches": values(self._watches)}
        own |= {"states": values(self._states), "memory": values(self._memory), "columns": self._columns}
        own |= {"step_std": self._step_std, "sleeps": self._sleeps, "pressure": self._pressure}
        own |= {
            "variance": self._variance,
            "read": self._read.astype(np.float64),
            "known": self._known.astype(np.float64),
        }
        own["clock"] = np.array([self._frames, self._since_forgot_s, self.rest_error])
        own |= self._noise.state()
        return {name: np.array(value, dtype=np.float64) for name, value in own.items()}

    def restore(self, state: Mapping[str, ArrayLike]) -> None:
        """Continue from a saved :meth:`state` (arrays, or lists as JSON has them).

        Raises:
            InputError: the state is not one of this estimator for cells of this shape.
        """
        expected = self.state()
        given = {name: np.array(value, dtype=np.float64, order="C") for name, value in state.items()}
        shapes = [{name: value.shape for name, value in each.items()} for each in (expected, given)]
        if shapes[0] != shapes[1] or not np.isfinite(given["clock"]).all():
            raise InputError(f"not a saved state of this estimator for cells of shape {self.shape}")
        records: dict[str, Records[Any]] = {"cells": self._cells, "befores": self._befores, "watches": self._watches}
        records |= {"states": self._states, "memory": self._memory}
        for name, kept in records.items():
            values(kept)[...] = given[name]
        if given["step_std"].any():
            self.resolve(given["step_std"].reshape(self.shape), self.rest_ohm)
        self._columns, self._sleeps = given["columns"], given["sleeps"]
        self._read, self._known = given["read"] > 0, given["known"] > 0
        self._pressure, self._variance = given["pressure"], given["variance"]
        frames, self._since_forgot_s, self.rest_error = given["clock"].tolist()
        self._frames = int(frames)
        self._noise.restore(given)


def _one_step(of: tuple[Material, Tuning], dt_s: float) -> Records[Step]:
    """(1,) the weights of a time step."""
    made = zeros(Step, 1)
    np.asarray(made)[0] = discretise(of[0], dt_s, of[1])
    return made
