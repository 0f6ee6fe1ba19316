"""Causal estimation of pressure from resistance, frame by frame: what every estimator shares.

A frame passes these steps. Every estimator then adds its own map from smoothed readings to pressure.

1. Readings become normalised resistances r = R/R0 - 1. NaN, open and shorted readings, and those that no credible load
   can give, are missing: the cell keeps its pressure, and the standard deviation grows.
2. Noise is measured from the readings (:mod:`._noise`).
3. Cells at rest sleep: only their mean is watched, until it leaves the noise. This makes large skins cheap.
4. Readings of the other cells are smoothed as their noise demands (:mod:`._smoothing`).
5. A reading that jumps and is back within :data:`SPARK_S` was a bad contact: the memory from before it is put back.
6. The standard deviation sums the variances of noise, of the memory, of gaps, and of what calibration left unexplained.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import BoolArray, FloatArray, IntArray
from ..errors import InputError
from . import _smoothing as smoothing
from ._forward import resistance_of
from ._noise import NoiseMeter

PRESSURE, GAIN, VARIANCE = range(3)
"""first rows of every memory: kPa; kPa per unit of r by which noise enters it; kPa^2 by which memory adds to it"""
SPARK_S = 0.1
"""a jump that is taken back sooner is no load"""
BACK = 0.2
"""share of a jump within which it counts as taken back"""
LARGE_JUMP, CLEAR_JUMP = 0.05, 12.0
"""of full scale, and in standard deviations of a reading, from which a jump may be a spark"""
BEYOND = 0.75
"""of full scale from its middle, beyond which a jump is not shown at once"""
AT_REST = 0.005
"""of full scale below which a cell may sleep"""
ASLEEP_SIGMAS = 5.0
"""standard deviations by which a single reading wakes a cell, and its mean"""
WATCH_S = 0.5
"""time over which the mean of a sleeping cell is taken"""
SETTLE_EVERY = 16
"""frames between two looks for cells that may go to sleep"""
UNSEEN = 0.8
"""of the noise of a single reading: what a change could be that the smoothing has not noticed yet"""
MODEL_ERROR = 0.005
"""of full scale: the least standard deviation, of a cell whose model nobody compared with a recording"""
FIRST_READINGS = 4
"""averaged before the first estimate of a cell is final"""
AFTER_GAP, AFTER_GAP_S = 0.3, 10.0
"""share of the doubt about a gap that the first reading after it leaves, and the time in which that falls to 1/e"""


@dataclass(frozen=True)
class Conditions:
    """What is known beforehand of readings, loads and errors: from a calibration recording, or by default."""

    model_std_kpa: float = 0.0
    """standard deviation of estimates that even noiseless readings leave"""
    noise: float | None = None
    """standard deviation of r, sample to sample, at rest; it is measured anew. None: unknown. 0: readings are exact,
    nothing is measured, smoothed or put to sleep"""
    speed_kpa_per_s: float = 0.0
    """by which a load changes in a second, rms; 0: full scale"""


class Estimator(ABC):
    """Pressure of an array of cells; made by :meth:`ohmskin.cell.Cell.estimator`.

    Call :meth:`step` for every frame. The first reading of a cell is taken as one at rest or long held.
    """

    rows: tuple[str, ...] = ("pressure", "gain", "variance")
    """names of the memory's rows, the first three in every estimator"""
    filters = True
    """False: the estimator takes readings as they are, whatever their noise"""
    knows_errors = True
    """False: only a calibration can say how far the estimator is off"""

    def __init__(
        self,
        full_scale_kpa: float,
        full_scale_r: float,
        shape: tuple[int, ...],
        rest_resistance_ohm: FloatArray,
        conditions: Conditions,
        *,
        credible: tuple[float, float] = (-1.0, np.inf),
    ) -> None:
        """``full_scale_r``: r at equilibrium under full scale. ``credible``: r beyond which a reading is missing."""
        self.shape, self.full_scale_kpa, self.conditions = shape, full_scale_kpa, conditions
        rest = resistance_of(shape, rest_resistance_ohm).ravel()
        self._per_ohm = 1 / rest
        self._full_scale_r = abs(full_scale_r)
        self._credible = credible
        self._exact = conditions.noise == 0.0 or not self.filters
        cells = rest.size
        self._noise = NoiseMeter(cells, conditions.noise or 0.0)
        self._memory = self._begin(np.zeros(cells))
        self._line = smoothing.begin(np.zeros(cells))
        self._mean = np.zeros(cells)
        self._std = np.full(cells, np.nan)
        self._readings = np.zeros(cells)
        self._awake = np.zeros(cells, dtype=bool)
        self._unread_s = np.zeros(cells)
        self._gap_kpa = np.zeros(cells)
        self._usual_s = 0.0
        self._frames = 0
        self._refresh()
        self._sparks = _Sparks.none(self._memory, self._line)

    # -- the frame ---------------------------------------------------------------------------------------------------

    def step(self, elapsed_s: float, resistance_ohm: ArrayLike) -> FloatArray:
        """Take the frame read ``elapsed_s`` after the last one (any number for the first frame).

        Args:
            elapsed_s: seconds since the last frame.
            resistance_ohm: (shape) in ohm; NaN, infinite and not positive entries are missing.

        Returns:
            (shape) pressure in kPa. A cell whose reading is missing keeps its last value; NaN before its first reading.

        Raises:
            InputError: another shape, or a time step that is not a positive number of seconds.
        """
        resistance = np.asarray(resistance_ohm, dtype=np.float64)
        if resistance.shape != self.shape:
            raise InputError(f"resistance has shape {resistance.shape}, expected {self.shape}")
        if self._frames and not 0 < elapsed_s < np.inf:
            raise InputError(f"a frame follows {elapsed_s} s after the last; expected time stamps that increase")
        dt = float(elapsed_s) if self._frames else 1.0
        r = resistance.ravel() * self._per_ohm
        r -= 1.0
        low, high = self._credible
        readable = r > low
        readable &= r < high
        known = None if np.count_nonzero(readable) == readable.size else readable
        if known is not None:
            r = np.where(known, r, self._mean)
        if not self._exact:
            self._noise.update(r, known)
        if not self._begun:
            self._start(r, readable)
        self._watch(dt, r)
        cells = self._moving
        if known is not None:
            unread = np.flatnonzero(~readable & (self._readings > 0))
            self._pause(unread, dt)
            cells = np.flatnonzero(readable & self._awake)
        if self._all_moving and known is None:
            self._follow(slice(None), dt, r)
        elif cells.size:
            self._follow(cells, dt, r[cells])
        if known is not None or self._doubtful or dt > 3 * self._usual_s:
            self._widen(dt, readable)
        self._usual_s += (dt - self._usual_s) * (0.1 if self._frames > 1 else 1.0)
        self._frames += 1
        if self._frames % SETTLE_EVERY == 0 and not self._exact:
            self._rest()
        return self._shown()

    @property
    def std_kpa(self) -> FloatArray:
        """(shape) standard deviation of the estimate of the last step, in kPa; NaN where none can be stated."""
        std: FloatArray = self._std.reshape(self.shape).copy()
        return std

    def _shown(self) -> FloatArray:
        """(shape) pressure in kPa. A jump beyond full scale is not shown before it has lasted longer than a spark."""
        pressure = self._memory[PRESSURE].copy()
        if self._sparks.cells.size:
            now = pressure[self._sparks.cells]
            beyond = np.abs(now - self.full_scale_kpa / 2) > BEYOND * self.full_scale_kpa
            pressure[self._sparks.cells[beyond]] = self._sparks.memory[PRESSURE, beyond]
        if not self._begun:
            pressure[self._readings == 0] = np.nan
        shown: FloatArray = pressure.reshape(self.shape)
        return shown

    @property
    def states_std(self) -> bool:
        """Whether a standard deviation is stated."""
        return self.knows_errors or self.conditions.model_std_kpa > 0

    # -- steps of a frame, in their order ----------------------------------------------------------------------------

    def _start(self, r: FloatArray, readable: BoolArray) -> None:
        """Take the first readings of cells as those of a load held for ever."""
        new = np.flatnonzero(readable & (self._readings < (1 if self._exact else FIRST_READINGS)))
        if new.size:
            self._readings[new] += 1
            n = self._readings[new]
            self._mean[new] += (r[new] - self._mean[new]) / n
            self._memory[:, new] = self._begin(self._mean[new])
            self._line[:, new] = smoothing.begin(self._mean[new], 1.0)
            self._awake[new] = True
            self._std[new] = self._deviation(self._memory[:, new], 0.0, 0.0)
        self._refresh()

    def _watch(self, dt: float, r: FloatArray) -> None:
        """Wake sleeping cells whose reading, or the mean of their readings, has left what noise does."""
        if self._exact:
            return
        share = -np.expm1(-dt / WATCH_S)
        step = r - self._mean
        step *= share
        self._mean += step
        if self._all_moving:
            return
        noise = self._noise.std(self._mean)
        noise *= ASLEEP_SIGMAS
        left = np.abs(r) > noise + self._band
        noise *= np.sqrt(share / (2 - share))
        left |= np.abs(self._mean) > noise + self._band
        left &= ~self._awake
        if np.count_nonzero(left):
            woken = np.flatnonzero(left & (self._readings > 0))
            self._memory[:, woken] = self._begin(np.zeros(woken.size))
            self._line[:, woken] = smoothing.begin(np.zeros(woken.size), 1.0)
            self._awake[woken] = True
            self._refresh()

    def _follow(self, cells: IntArray | slice, dt: float, r: FloatArray) -> None:
        """Smooth the readings (m,) of cells that move, and let the estimator advance."""
        line, memory = self._line[:, cells], self._memory[:, cells]
        if self._exact:
            memory = self._advance(memory, dt, r, _ZERO)
            self._memory[:, cells] = memory
            self._std[cells] = self._deviation(memory, 0.0, 0.0)
            return
        noise = self._noise.std(r if self._exact else line[smoothing.LEVEL], cells)
        if self._sparks.cells.size:
            self._put_back(cells, line, memory, dt, r)
        was = line.copy()
        smooth = smoothing.advance(line, dt, self._window(dt), r, noise)
        if np.count_nonzero(smooth.jumped):
            self._remember(cells, smooth.jumped, memory, was, r, noise)
        memory = self._advance(memory, dt, smooth.level, smooth.std)
        deviation = self._deviation(memory, smooth.std, noise)
        if self._sparks.cells.size:
            self._doubt_jumps(cells, memory, deviation)
        self._memory[:, cells], self._line[:, cells] = memory, line
        self._std[cells] = deviation

    def _deviation(self, memory: FloatArray, smooth_std: FloatArray | float, noise: FloatArray | float) -> FloatArray:
        """(m,) standard deviation in kPa."""
        if not self.states_std:
            return np.full(memory.shape[1], np.nan)
        variance = np.maximum(smooth_std, UNSEEN * np.asarray(noise)) * memory[GAIN]
        variance *= variance
        variance += memory[VARIANCE]
        variance += (self.conditions.model_std_kpa or MODEL_ERROR * self.full_scale_kpa) ** 2
        return np.asarray(np.sqrt(variance))

    def _pause(self, cells: IntArray, dt: float) -> None:
        """Cells without a reading keep their pressure: that from before, if their reading jumped just now."""
        if cells.size:
            lost = np.isin(self._sparks.cells, cells)
            if lost.any():
                self._memory[:, self._sparks.cells[lost]] = self._sparks.memory[:, lost]
                self._line[:, self._sparks.cells[lost]] = self._sparks.line[:, lost]
                self._sparks = self._sparks.where(~lost)
            self._memory[:, cells] = self._hold(self._memory[:, cells], dt)
            line = self._line[:, cells]
            smoothing.interrupt(line)
            self._line[:, cells] = line

    def _widen(self, dt: float, readable: BoolArray) -> None:
        """Add the doubt about cells that are not read, and what is left of it after a gap."""
        most = self.full_scale_kpa / 2
        speed = self.conditions.speed_kpa_per_s or self.full_scale_kpa
        self._unread_s += dt
        gap = np.maximum(self._unread_s - (self._usual_s or dt), 0.0)
        doubt = -most * np.expm1(-speed * gap / most)
        self._gap_kpa *= np.exp(-dt / AFTER_GAP_S)
        after = np.hypot(self._gap_kpa, AFTER_GAP * doubt)
        self._gap_kpa = np.where(readable, after, self._gap_kpa)
        self._unread_s[readable] = 0.0
        self._doubtful = bool((self._gap_kpa > 1e-3 * most).any() or not readable.all())
        extra = np.where(readable, after, np.hypot(self._gap_kpa, doubt))
        at_rest = self._deviation(self._memory, 0.0, self._noise.std(self._mean))
        own = np.where(self._awake & readable, self._std, at_rest)
        self._std = np.where(self._readings > 0, np.hypot(own, extra), np.nan)

    def _rest(self) -> None:
        """Let cells sleep that read as at rest and remember no load."""
        line = self._line
        quiet = self._band + 2 * self._noise.std(self._mean) * 0.2
        calm = self._awake & (np.abs(self._mean) < quiet) & (np.abs(line[smoothing.LEVEL]) < 3 * quiet)
        calm &= self._settled(self._memory, self._band) & (self._readings >= FIRST_READINGS)
        if calm.any():
            self._memory[:, calm] = self._begin(np.zeros(int(np.count_nonzero(calm))))
            self._awake &= ~calm
            self._refresh()
        asleep = ~self._awake & (self._readings > 0)
        if asleep.any() and not self._doubtful:
            self._std[asleep] = self._deviation(self._memory[:, asleep], 0.0, self._noise.std(self._mean)[asleep])

    def _refresh(self) -> None:
        self._moving = np.flatnonzero(self._awake)
        self._all_moving = self._moving.size == self._awake.size
        enough = 1 if self._exact else FIRST_READINGS
        self._begun = bool((self._readings >= enough).all())
        self._doubtful = bool(self._gap_kpa.any())

    @property
    def _band(self) -> float:
        """r within which a cell counts as at rest."""
        return AT_REST * self._full_scale_r

    def _window(self, dt: float) -> float:
        return smoothing.window_s(self._noise.typical / self._full_scale_r, dt)

    # -- sparks ------------------------------------------------------------------------------------------------------

    def _remember(
        self,
        cells: IntArray | slice,
        jumped: BoolArray,
        memory: FloatArray,
        line: FloatArray,
        r: FloatArray,
        noise: FloatArray,
    ) -> None:
        """Keep the memory of cells from before a jump, unless an earlier one is kept already."""
        jump = r - line[smoothing.LEVEL]
        least = np.maximum(CLEAR_JUMP * noise, LARGE_JUMP * self._full_scale_r)
        place = np.flatnonzero(jumped & (np.abs(jump) > least))
        place = place[~np.isin(self._moving_of(cells)[place], self._sparks.cells)]
        if place.size:
            self._sparks = self._sparks.with_more(
                self._moving_of(cells)[place], memory[:, place], line[:, place], jump[place]
            )

    def _put_back(
        self, cells: IntArray | slice, line: FloatArray, memory: FloatArray, dt: float, r: FloatArray
    ) -> None:
        """Put back the memory of cells whose reading has come back; changes ``line`` and ``memory`` (.., m)."""
        sparks = self._sparks
        sparks.age_s += dt
        sparks.memory = self._hold(sparks.memory, dt)
        of = self._moving_of(cells)
        _, place, kept = np.intersect1d(of, sparks.cells, assume_unique=True, return_indices=True)
        was = sparks.line[smoothing.LEVEL, kept]
        back = np.abs(r[place] - was) < BACK * np.abs(sparks.jump[kept])
        memory[:, place[back]] = sparks.memory[:, kept[back]]
        line[:, place[back]] = sparks.line[:, kept[back]]
        over = sparks.age_s > SPARK_S
        over[kept[back]] = True
        if over.any():
            self._sparks = sparks.where(~over)

    def _doubt_jumps(self, cells: IntArray | slice, memory: FloatArray, deviation: FloatArray) -> None:
        """Half of the jump is added to the standard deviation as long as it may be a spark; changes ``deviation``."""
        of = self._moving_of(cells)
        _, place, kept = np.intersect1d(of, self._sparks.cells, assume_unique=True, return_indices=True)
        jump = memory[PRESSURE, place] - self._sparks.memory[PRESSURE, kept]
        deviation[place] = np.hypot(deviation[place], 0.5 * jump)

    def _moving_of(self, cells: IntArray | slice) -> IntArray:
        return self._moving if isinstance(cells, slice) else cells

    # -- saving ------------------------------------------------------------------------------------------------------

    _KEPT = ("memory", "line", "mean", "std", "readings", "awake", "unread_s", "gap_kpa")

    def state(self) -> dict[str, FloatArray]:
        """Everything remembered, as a copy: arrays of float64 by name, which :meth:`restore` takes."""
        own = {name: getattr(self, f"_{name}") for name in self._KEPT} | self._noise.state()
        own["clock"] = np.array([self._usual_s, self._frames], dtype=np.float64)
        return {name: np.array(value, dtype=np.float64) for name, value in own.items()}

    def restore(self, state: Mapping[str, ArrayLike]) -> None:
        """Continue from a saved :meth:`state` (arrays, or lists as JSON has them).

        Raises:
            InputError: the state is not one of this estimator for cells of this shape.
        """
        expected = self.state()
        given = {name: np.array(value, dtype=np.float64) for name, value in state.items()}
        if {name: value.shape for name, value in expected.items()} != {n: v.shape for n, v in given.items()}:
            raise InputError(f"not a saved state of this estimator for cells of shape {self.shape}")
        for name in self._KEPT:
            value = given[name]
            setattr(self, f"_{name}", value > 0 if name == "awake" else value)
        self._noise.restore(given)
        self._usual_s, frames = given["clock"].tolist()
        self._frames = int(frames)
        self._sparks = _Sparks.none(self._memory, self._line)
        self._refresh()

    # -- what an estimator adds --------------------------------------------------------------------------------------

    @abstractmethod
    def _begin(self, r: FloatArray) -> FloatArray:
        """The memory (rows, m) of cells whose reading has been ``r`` (m,) for ever."""

    @abstractmethod
    def _advance(self, memory: FloatArray, dt_s: float, r: FloatArray, std: FloatArray) -> FloatArray:
        """The memory (rows, m) after the reading went to ``r`` (m,), known to ``std`` (m,), in ``dt_s``.

        May change ``memory`` itself.
        """

    def _hold(self, memory: FloatArray, dt_s: float) -> FloatArray:
        """The memory (rows, m) after ``dt_s`` in which the pressure stayed."""
        return memory

    def _settled(self, memory: FloatArray, band: float) -> BoolArray:
        """(m,) whether the memory is that of a cell at rest, within ``band`` of r."""
        return np.ones(memory.shape[1], dtype=bool)


_ZERO = np.zeros(1)


@dataclass
class _Sparks:
    """Cells whose reading jumped a moment ago, with all that was remembered before it."""

    cells: IntArray
    age_s: FloatArray
    memory: FloatArray
    line: FloatArray
    jump: FloatArray

    @classmethod
    def none(cls, memory: FloatArray, line: FloatArray) -> _Sparks:
        return cls(np.zeros(0, dtype=np.intp), np.zeros(0), memory[:, :0], line[:, :0], np.zeros(0))

    def with_more(self, cells: IntArray, memory: FloatArray, line: FloatArray, jump: FloatArray) -> _Sparks:
        return _Sparks(
            np.concatenate([self.cells, cells]),
            np.concatenate([self.age_s, np.zeros(cells.size)]),
            np.concatenate([self.memory, memory], axis=1),
            np.concatenate([self.line, line], axis=1),
            np.concatenate([self.jump, jump]),
        )

    def where(self, kept: BoolArray) -> _Sparks:
        return _Sparks(self.cells[kept], self.age_s[kept], self.memory[:, kept], self.line[:, kept], self.jump[kept])
