"""Causal estimation of pressure from resistance, frame by frame, for any material.

Each frame passes these steps:

1. Readings become r, the normalised resistance or what else the cell's scale says (:mod:`._scale`): an interval, by the
   quantisation step or by a limit of the converter, and the variance of the noise.
2. Quantisation that the cells of a column share is taken out (:mod:`._columns`); noise that they share is noise.
3. The filter (:mod:`._filter`, :mod:`._modes`) follows each cell: noise, bad contacts, missing readings, rest and turns
   of the load are modes or probabilities of one state.
4. An :class:`._inversion.Inversion` makes pressures of what the filter follows, and states the error of the model.

A kernel takes many frames at once (:mod:`._frames`), unless the inversion remembers something of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...common.arrays import FloatArray, IntArray
from ...common.compiled import Records, values, zeros
from ...common.measurement import CONDUCTANCE, FIELDS, GREATEST, HALF_STEP, NOISE_VARIANCE, STEP_STD, Measurement
from ...common.noise import NoiseEstimate
from ...errors import InputError
from .._state import CellState
from ..materials import ByStep
from ._conditions import Conditions
from ._filter import Candidates, Estimates, Pools, Reading, Watch
from ._frames import (
    AWAKE,
    BEGUN,
    BELIEVES,
    FORGET_EVERY_S,
    LIKE,
    READ,
    Clock,
    Settings,
    middle,
    show_frames,
    take_frames,
)
from ._inversion import UNKNOWN, Inversion
from ._modes import TUNING, Material, Step, Tuning, discretise
from ._neighbours import beside_in
from ._scale import Scale

SETTLED = 0.01
"""share of r at full scale, which the memory of a sleeping cell may still hold"""
OF_STEP = 0.2
"""least noise of a reading over the deviation by its quantisation: what else is in a step nobody sees"""
READINGS_OVERLOAD = 30.0
"""full scales of r that a filter of readings follows"""
BLOCK = 16384
"""readings that a kernel takes at once: its results fit into the processor's cache"""
_ONLY = np.zeros(1, dtype=np.intp)


class Estimator:
    """Pressure of an array of cells; made by :meth:`ohmskin.cell.Cell.estimator`.

    Call :meth:`step` or :meth:`update` for every frame. The first reading of a cell is taken to be at rest, or that
    of a press whose age is not known.
    """

    def __init__(
        self,
        inversion: Inversion,
        shape: tuple[int, ...],
        rest_resistance_ohm: FloatArray,
        scale: Records[Scale],
        conditions: Conditions,
        beside: IntArray | None = None,
    ) -> None:
        """``rest_resistance_ohm`` (n,) holds R0 of each cell of ``shape``, ``scale`` turns their readings into r.

        ``beside`` is that of :meth:`ohmskin.cell.Cell.estimator`.
        """
        self.shape, self.inversion = shape, inversion
        self._rest_ohm, self._scale, self._conditions = rest_resistance_ohm, scale, conditions
        count = rest_resistance_ohm.size
        material = inversion.material
        follows_load = material is not None
        tuning = TUNING
        if material is None:
            # What a cell without memory reads is over when it is over; bad contacts of the others look like loads.
            bad_hz = TUNING.bad_hz if inversion.remembers or inversion.side > 0.0 else 0.0
            drift = TUNING.drift if inversion.remembers else 0.0
            none = {"memory": 0.0, "floor": 0.0, "relative": 0.0, "extrapolated": 0.0}
            tuning = replace(TUNING, **none, drift=drift, overload=READINGS_OVERLOAD, bad_hz=bad_hz)
            material = Material.without_memory()
        unit = 1.0 if follows_load else inversion.side * inversion.full_scale_r
        full = inversion.full_scale_kpa
        self._settings = zeros(Settings, 1)
        self._settings[0] = (
            *(unit, unit, *inversion.credible, inversion.usual_level),
            *(inversion.remembers, inversion.filtered, follows_load, material.geq, material.gu, material.g3),
            *(full, UNKNOWN * full, 0.0 if follows_load else TUNING.floor * full),
            *(conditions.model_std_kpa, conditions.rest_error, self.states_std, 0.0),
            *(TUNING.alone, TUNING.sudden),
        )
        self._steps = ByStep(_one_step, (material, tuning))
        self._cells, self._befores = zeros(Estimates, count), zeros(Estimates, count)
        self._watches = zeros(Watch, count)
        self._states, self._memory = zeros(CellState, count), zeros(inversion.memory, count)
        self._alone = self._memory.dtype.itemsize == 0 and inversion.filtered
        """nothing is remembered beside the filter: blocks of frames are taken at once"""
        self._noise = NoiseEstimate(count, quantum=0.0, expected=conditions.noise or 0.0)
        self._step_std = np.zeros(count)
        """(n,) relative standard deviation of conductances at rest by quantisation"""
        self._clock = zeros(Clock, 1)
        self._columns = np.zeros(shape[1] if len(shape) == 2 else 1)
        """(columns,) recent mean of what columns share"""
        self._seen = np.zeros((2, count))
        """(2, n) what is remembered of readings"""
        self._sleeps = np.full(count, 0.0 if inversion.exact else 1.0)
        """(n,) 1 where the memory of the inversion is that of rest"""
        self._shown = np.full((3, count), np.nan)
        """(3, n) last pressures in kPa, their standard deviations, and whether cells that are not believed were like
        those beside"""
        self._shown[LIKE] = BELIEVES
        neighbours = beside_in(shape) if beside is None else np.ascontiguousarray(beside, dtype=np.intp)
        self._around = neighbours, np.zeros((3, count))
        self._readings = zeros(Reading, count)
        self._state = (
            *(self._cells, self._befores, self._watches),
            *(zeros(Candidates, 1), zeros(Pools, 1), zeros(Estimates, 1)),
            *(self._settings, scale, self._clock, rest_resistance_ohm, self._sleeps, self._columns),
            *(self._seen, self._readings, self._states, conditions.rest_slope_kpa, self._shown, *self._around),
        )
        """what the kernel of frames takes before the frames themselves"""
        self._one, self._begun = self._scratch(1), False

    # -- frames ------------------------------------------------------------------------------------------------------

    def step(self, elapsed_s: float, resistance_ohm: ArrayLike) -> FloatArray:
        """Take the frame read ``elapsed_s`` after the last one (any number for the first frame).

        The noise of the readings is measured from frame to frame.

        Args:
            elapsed_s: seconds since the last frame.
            resistance_ohm: (shape) in ohm; NaN and not positive entries are missing. An infinite entry reads no
                current: no load, on a cell that is open at rest; else it is missing, as of one that is not connected.

        Returns:
            (shape) pressure in kPa; NaN before a cell's first reading. A cell whose reading is missing keeps its last
            value, unless the cells beside it tell of another one.

        Raises:
            InputError: another shape, or a time step that is not a positive number of seconds.
        """
        resistance = np.asarray(resistance_ohm, dtype=np.float64)
        if resistance.shape != self.shape:
            raise InputError(f"resistance has shape {resistance.shape}, expected {self.shape}")
        return self._take(elapsed_s, self._blocks(resistance.reshape(1, -1)))[0]

    def run(self, elapsed_s: ArrayLike, resistance_ohm: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Take frames at once: bit for bit what :meth:`step` gives for one after the other, but quicker.

        Args:
            elapsed_s: (frames,) seconds since the frame before each.
            resistance_ohm: (frames, shape) as for :meth:`step`.

        Returns:
            (frames, shape) pressures, and their standard deviations in kPa.

        Raises:
            InputError: as :meth:`step`; nothing was taken.

        """
        resistance = np.asarray(resistance_ohm, dtype=np.float64)
        elapsed = np.asarray(elapsed_s, dtype=np.float64)
        if elapsed.ndim != 1 or resistance.shape != (elapsed.size, *self.shape):
            raise InputError(f"resistance has shape {resistance.shape}, expected {(elapsed.size, *self.shape)}")
        flat = resistance.reshape(elapsed.size, self._rest_ohm.size)
        return self._run(elapsed, elapsed.size, lambda frames: self._blocks(flat[frames]))

    def update(self, elapsed_s: float, measured: Measurement) -> FloatArray:
        """The pressures (shape) of :meth:`estimate`."""
        return self.estimate(elapsed_s, measured)[0]

    def estimate(self, elapsed_s: float, measured: Measurement) -> tuple[FloatArray, FloatArray]:
        """Take a frame of conductances with their errors; a reading at a limit of the converter is an interval.

        Noise, steps and what columns share are those that the measurement states.

        Returns:
            (shape) pressures, and their standard deviations in kPa.

        Raises:
            InputError: as :meth:`step`.

        """
        block = measured.block
        if block.shape[1:] != self.shape:
            raise InputError(f"conductance has shape {block.shape[1:]}, expected {self.shape}")
        if not block.flags.c_contiguous:
            block = block.copy()
        self._settings["lasting"] = 1.0
        return self._take(elapsed_s, block.reshape(1, FIELDS, self._rest_ohm.size))

    def run_measured(self, elapsed_s: FloatArray, blocks: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As :meth:`run`, from the blocks (frames, fields, shape) of measurements."""
        if blocks.shape != (elapsed_s.size, FIELDS, *self.shape):
            raise InputError(f"blocks have shape {blocks.shape}, expected {(elapsed_s.size, FIELDS, *self.shape)}")
        flat, self._settings["lasting"] = blocks.reshape(elapsed_s.size, FIELDS, self._rest_ohm.size), 1.0
        return self._run(elapsed_s, elapsed_s.size, lambda frames: np.ascontiguousarray(flat[frames]))

    def _run(
        self, elapsed_s: FloatArray, count: int, blocks: Callable[[slice], FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Take ``count`` frames, whose measurements ``blocks`` gives in order."""
        dt_s = self._time(elapsed_s)
        pressure, std = np.empty((2, count, self._rest_ohm.size))
        most = max(BLOCK // self._rest_ohm.size, 1) if self._alone else 1
        for first in range(0, count, most):
            frames = slice(first, first + most)
            block = blocks(frames)
            self._frames(dt_s[frames].tolist(), block, self._scratch(len(block)), pressure[frames], std[frames])
        shape = (count, *self.shape)
        return pressure.reshape(shape), std.reshape(shape)

    def _scratch(self, frames: int) -> tuple[NDArray[np.int8], FloatArray, FloatArray]:
        """Flags, and levels with their variances (frames, n), for the kernel to write."""
        shape = frames, self._rest_ohm.size
        return np.empty(shape, dtype=np.int8), np.empty(shape), np.empty(shape)

    def _time(self, elapsed_s: FloatArray) -> FloatArray:
        """(frames,) steps of time, that of the first frame any one."""
        if not self._begun and elapsed_s.size:
            elapsed_s = elapsed_s.copy()
            elapsed_s[0] = 1.0
        wrong = ~((elapsed_s > 0.0) & (elapsed_s < np.inf))
        if wrong.any():
            given = elapsed_s[wrong.argmax()]
            raise InputError(f"a frame follows {given} s after the last; expected time stamps that increase")
        return elapsed_s

    def _blocks(self, resistance_ohm: FloatArray) -> FloatArray:
        """(frames, fields, n) measurements by resistances (frames, n), whose noise is measured here."""
        with np.errstate(divide="ignore", invalid="ignore"):
            conductance = np.where(resistance_ohm > 0.0, 1.0 / resistance_ohm, np.nan)
        if not self._scale["open_at_rest"][0]:
            conductance[conductance == 0.0] = np.nan
        steps, self._settings["lasting"] = self._step_std, 0.0
        noise = np.zeros(1) if self.inversion.exact else self._noise.run(conductance * self._rest_ohm)
        blocks = np.zeros((len(conductance), FIELDS, self._rest_ohm.size))
        blocks[:, CONDUCTANCE], blocks[:, GREATEST] = conductance, np.inf
        own = np.maximum(noise * noise - steps * steps, (OF_STEP * steps) ** 2)
        blocks[:, NOISE_VARIANCE] = own / (self._rest_ohm * self._rest_ohm)
        blocks[:, HALF_STEP] = steps / (STEP_STD * self._rest_ohm)
        return blocks

    def _take(self, elapsed_s: float, block: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The pressures (shape) of one frame (1, fields, n), and their standard deviations."""
        if not 0.0 < elapsed_s < math.inf or not self._begun:
            elapsed_s = self._time(np.array([elapsed_s], dtype=np.float64)).item(0)
        answer = np.empty((2, 1, self._rest_ohm.size))
        self._frames([elapsed_s], block, self._one, answer[0], answer[1])
        pressure, std = answer.reshape(2, *self.shape)
        return pressure, std

    def _frames(
        self,
        dt_s: list[float],
        blocks: FloatArray,
        scratch: tuple[NDArray[np.int8], FloatArray, FloatArray],
        pressure: FloatArray,
        std: FloatArray,
    ) -> None:
        """Take frames (frames, fields, n), and write their pressures and standard deviations (frames, n)."""
        steps, which = self._steps.of(round(dt_s[0], 7)), _ONLY
        if len(dt_s) > 1:
            rounded, which = np.unique([round(each, 7) for each in dt_s], return_inverse=True)
            steps = zeros(Step, rounded.size)
            for place, each_s in enumerate(rounded.tolist()):
                np.asarray(steps)[place] = np.asarray(self._steps.of(each_s))[0]
        inversion, memory, states = self.inversion, self._memory, self._states
        if not (self._alone or inversion.exact) and self._clock["since_forgot_s"][0] + dt_s[0] >= FORGET_EVERY_S:
            every, band = np.arange(self._sleeps.size), SETTLED * inversion.full_scale_r
            self._sleeps[:] = inversion.settled(states, memory, every, band)
        status, level, level_variance = scratch
        take_frames.unchecked(*self._state, steps, which, blocks, *scratch, pressure, std)
        self._begun = True
        if inversion.material is not None:
            return
        answers = zeros(CellState, level.size) if self._alone else states
        new, awake = (status & BEGUN).ravel().nonzero()[0], (status & AWAKE).ravel().nonzero()[0]
        if new.size and not self._alone:
            r_unit = self._settings["r_unit"][0]
            r = [middle(self._readings[i]) for i in new.tolist()]
            inversion.begin(answers, memory, new, np.array(r) * r_unit)
        answers["level"] = level.ravel()
        if awake.size:
            inversion.advance(answers, memory, awake, dt_s[0])
        if self._alone:
            self._spread(answers, (status & READ == 0).ravel().nonzero()[0], level_variance.ravel())
        slopes = self._conditions.rest_slope_kpa
        show_frames.unchecked(
            *(status, level, level_variance, answers, states, self._settings, slopes, self._shown),
            *(*self._around, pressure, std),
        )

    def _spread(self, answers: Records[CellState], unread: IntArray, level_variance: FloatArray) -> None:
        """State how far the load of the ``unread`` places (k,) may be, as the gain of their levels.

        Their levels spread over all of the curve, whose slope at one point says little (sigma points: Gauss-Hermite
        quadrature of three, Julier and Uhlmann 1997).
        """
        std = np.sqrt(level_variance[unread]) * abs(self._settings["unit"][0])
        unread, std = unread[std > 0.0], std[std > 0.0]
        if not unread.size:
            return
        level, points = answers["level"][unread], np.arange(3 * unread.size)
        trial = zeros(CellState, points.size)
        trial["level"] = (level + math.sqrt(3.0) * std * np.array([[-1.0], [0.0], [1.0]])).ravel()
        self.inversion.advance(trial, zeros(self.inversion.memory, points.size), points, 1.0)
        below, middle, beyond = trial["pressure_kpa"].reshape(3, -1)
        answers["gain_kpa"][unread] = np.sqrt(((beyond - middle) ** 2 + (below - middle) ** 2) / 6.0) / std

    # -- what is known beside the readings -----------------------------------------------------------------------------

    @property
    def rest_ohm(self) -> FloatArray:
        """(shape) rest resistances in use."""
        return self._rest_ohm.reshape(self.shape)

    @property
    def side(self) -> float:
        """Sign of the change of a resistance under load."""
        return -1.0 if self._scale["falls"][0] else 1.0

    @property
    def rest_error(self) -> float:
        """Relative standard deviation of R0, which widens the stated deviations."""
        return self._settings["rest_error"].item()

    @rest_error.setter
    def rest_error(self, error: float) -> None:
        self._settings["rest_error"] = error

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
        std: FloatArray = self._shown[1].reshape(self.shape).copy()
        return std

    @property
    def states_std(self) -> bool:
        """Whether a standard deviation is stated."""
        return self.inversion.knows_errors or self._conditions.model_std_kpa > 0

    # -- saving ------------------------------------------------------------------------------------------------------

    def state(self) -> dict[str, FloatArray]:
        """A copy of the whole state, for :meth:`restore`: float64 arrays by name."""
        kept = {name: array.copy() for name, array in self._kept().items()}
        return kept | {"step_std": self._step_std.copy(), "rest_error": np.array(self.rest_error)} | self._noise.state()

    def _kept(self) -> dict[str, FloatArray]:
        """The arrays that change from frame to frame, but for the noise."""
        records: dict[str, Records[Any]] = {"cells": self._cells, "befores": self._befores, "watches": self._watches}
        records |= {"states": self._states, "memory": self._memory, "clock": self._clock}
        arrays = {name: values(kept) for name, kept in records.items()}
        return arrays | {"columns": self._columns, "sleeps": self._sleeps, "seen": self._seen, "shown": self._shown}

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
        if given["step_std"].any():
            self.resolve(given["step_std"].reshape(self.shape), self.rest_ohm)
        for name, kept in self._kept().items():
            kept[...] = given[name]
        self.rest_error = given["rest_error"].item()
        self._begun = bool(self._clock["frames"][0])
        self._noise.restore(given)


def _one_step(of: tuple[Material, Tuning], dt_s: float) -> Records[Step]:
    """(1,) the weights of a time step."""
    made = zeros(Step, 1)
    np.asarray(made)[0] = discretise(of[0], dt_s, of[1])
    return made
