"""Causal estimation of pressure from resistance, frame by frame: what every estimator shares.

A frame passes these steps. Every estimator then adds its own map from smoothed readings to pressure.

1. Readings become normalised resistances r = R/R0 - 1. NaN, open and shorted readings, and those that no credible load
   can give, are missing: the cell keeps its pressure, and the standard deviation grows.
2. Noise is measured from the readings (:mod:`._noise`).
3. Cells at rest sleep: only their mean is watched, until it leaves the noise. This makes large skins cheap.
4. Readings of the other cells are smoothed as their noise demands (:mod:`._smoothing`).
5. A reading that jumps and is back within :data:`SPARK_S` was a bad contact: the memory from before it is put back,
   unless the cells beside it tell that it was a tap (:mod:`._jumps`).
6. The standard deviation sums the variances of noise, of the memory, of motion within the noise (:mod:`._tremor`), of
   gaps, of R0, of creep under loads longer than any in the calibration (:mod:`._held`), and of what calibration left
   unexplained.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .. import compiled
from ..arrays import BoolArray, FloatArray, IntArray
from ..compiled import Loop
from ..errors import InputError
from . import _loops as loops
from . import _noise as noise_meter
from . import _smoothing as smoothing
from . import _tremor as tremor
from ._forward import resistance_of
from ._held import Held
from ._jumps import TOGETHER_S, Jumps, Neighbours
from ._loops import ASLEEP_SIGMAS, CALM_SIGMAS, LEVEL_BANDS
from ._noise import WINDOW, NoiseMeter
from ._rows import GAIN, PRESSURE, VARIANCE
from ._tremor import Tremor

SHARED = 6
"""number of rows, at most, that the standard deviation follows from"""
SPARK_S = 0.1
"""a jump that is taken back sooner is no load"""
BACK = 0.05
"""share of a jump within which it counts as taken back"""
LARGE_JUMP, CLEAR_JUMP = 0.05, 12.0
"""of full scale, and in standard deviations of a reading, from which a jump may be a spark"""
CLEAR = 3.0
"""standard deviations of a reading by which a jump that was taken back may be off and still be a bad contact"""
SUDDEN = 6.0
"""times the change of the reading before it: a smaller jump is part of a press"""
NEARER, EITHER, SMALL = 0.5, 0.25, 0.15
"""share of the distance to a tap within which a bad contact must be; share of the jump, and of full scale, within which
the pressure after a tap is usually that from before it"""
SUDDENLY = 0.6
"""share of a jump that must be taken back from one frame to the next"""
BEYOND = 0.57
"""of full scale from its middle, beyond which a jump is not shown at once: just less than the largest pressure that an
inverse in doubt shows"""
AT_REST = 0.005
"""of full scale below which a cell may sleep"""
WATCH_S = 0.5
"""time over which the mean of a sleeping cell is taken"""
MEANS = 8
"""times in that time that the mean is renewed"""
NO_LOAD_SIGMAS, TINY = 2.0, 1e-30
"""standard deviations of the noise at which a load and none are as likely; keeps 0/0 from occurring"""
SETTLE_EVERY = 32
"""frames between two looks for cells that may go to sleep"""
HIDDEN, SIGMAS = 3.3, 3.0
"""standard deviations of the noise by which a load may be off its reading; and of the estimate, which are to cover what
a change could be that the smoothing has not noticed yet"""
LOOKS = 3
"""for tremor, in a window of readings"""
MODEL_ERROR = 0.005
"""of full scale: the least standard deviation without a calibration. It covers what an estimator passes over: loads
that let a cell sleep, turns below a percent. It is no estimate of a model's error, for nobody compared the model with a
recording"""
USUAL = 1.1
"""times full scale beyond which the excess over full scale counts as standard deviation"""
FIRST_READINGS = 4
"""averaged before the first estimate of a cell is final"""
UNKNOWN_PAST = 0.25
"""of the first pressure of a cell: its standard deviation, since a load that began just now shows as much more than one
that has been there for long; it falls as the doubt about a gap does"""
AFTER_GAP, AFTER_GAP_S = 0.3, 10.0
"""share of the doubt about a gap that the first reading after it leaves, and the time in which that falls to 1/e"""
CHANGED_IN_GAP = 0.4
"""share of a pressure's change over a long gap that is in doubt: presses that came and went may have left it behind"""


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
    rest_std_kpa: FloatArray | None = None
    """(n,) standard deviation that the uncertainty of R0 gives to pressures evenly from 0 to full scale; None: none"""
    longest_load_s: float = 0.0
    """how long the load of the calibration recording lasted at most; 0: unknown"""


class Estimator(ABC):
    """Pressure of an array of cells; made by :meth:`ohmskin.cell.Cell.estimator`.

    Call :meth:`step` for every frame. The first reading of a cell is taken as one at rest or long held, and the
    standard deviation tells of the doubt (:data:`UNKNOWN_PAST`).
    """

    rows: tuple[str, ...] = ("pressure", "gain", "variance")
    """names of the memory's rows, the first three in every estimator"""
    filters = True
    """False: the estimator takes readings as they are, whatever their noise"""
    knows_errors = True
    """False: only a calibration can say how far the estimator is off"""
    remembers = True
    """False: the resistance follows from the present load alone, so what came in a gap left nothing behind"""

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
        self._full_scale_r, self._side = abs(full_scale_r), math.copysign(1.0, full_scale_r)
        self._credible = credible
        self._exact = conditions.noise == 0.0 or not self.filters
        self._states_std = self.states_std
        self._model_variance = (conditions.model_std_kpa or MODEL_ERROR * full_scale_kpa) ** 2
        rest_std_kpa = conditions.rest_std_kpa
        self._rest_variance = None if rest_std_kpa is None else rest_std_kpa**2
        self._rest_variances = np.zeros(0) if rest_std_kpa is None else rest_std_kpa**2
        self._rest_at_kpa = np.linspace(0, full_scale_kpa, 0 if rest_std_kpa is None else rest_std_kpa.size)
        self._band = AT_REST * self._full_scale_r
        """r within which a cell counts as at rest"""
        cells = rest.size
        self._noise = NoiseMeter(cells, conditions.noise or 0.0)
        self._mean = np.zeros(cells)
        self._sum = np.zeros(cells)
        self._tremor = Tremor(cells)
        self._sum_s, self._summed = 0.0, 0
        self._pressure = np.full(cells, np.nan)
        self._variance = np.full(cells, np.nan)  # kPa^2; without the cells of _left_open; replaced, never changed
        self._left_open: _LeftOpen | _Stated | None = None
        self._asleep: _Asleep | None = None
        self._reading = np.zeros(cells)
        self._readings = np.zeros(cells)
        self._awake = np.zeros(cells, dtype=np.bool_)
        self._gaps = _Gaps.none(cells)
        self._held = Held(cells, full_scale_kpa, conditions.longest_load_s)
        self._usual_s = 0.0
        self._frames = 0
        self._begun = False
        self._wake_at = np.full(cells, np.inf)
        self._smoothed_for = (-1.0, -1.0)
        self._smoothed_by = smoothing.gains_for(1.0, 1.0)
        self._all_awake = False
        self._compiled = False
        self._bends = 0.0, 0.0
        """standard deviation of r by a turn within the frame, per kPa by which the load bent, and by how many standard
        deviations of noise it must have bent; 0: see :meth:`_within_frame`, which says the same"""
        self._seeming = 0.0
        """kPa by which motion as large as the noise may let a pressure seem to rise in :data:`WINDOW` frames, per
        standard deviation of a reading and per squared gain; 0: it does not"""
        self._numbers = np.zeros(0)
        # What is remembered of each cell. The cells that are followed at present have theirs in the block.
        self._memory = self._begin(np.zeros(cells))
        self._line = smoothing.begin(np.zeros(cells))
        none = np.zeros(0, dtype=np.intp)
        self._no_block = _Block(none, self._memory.take(none, axis=1), self._line.take(none, axis=1))
        self._block = self._no_block
        self._followed = np.zeros(cells, dtype=np.bool_)
        self._stale = True
        self._jumps = Jumps.none(self._memory, self._line)
        self._before_jumps = np.zeros(cells)
        """(n,) smoothed readings before the jumps that may still turn out to be one tap"""
        self._neighbours = Neighbours(shape)

    # -- machine code ------------------------------------------------------------------------------------------------

    def compile(self) -> bool:
        """Do the work of frames by machine code from now on, where the extra ``fast`` is installed.

        Loading takes half a second in the first call of a process, and compiling ten where no earlier process has done
        so. An estimator of exact readings (``noise=0``) has no machine code.

        Returns:
            Whether machine code does the work. Pressures and standard deviations are the same either way.
        """
        self._use(machine_code=not self._exact and compiled.load(*self._loops()))
        return self._compiled

    def _use(self, *, machine_code: bool) -> None:
        """Do the work of frames by machine code, or by array operations."""
        self._compiled = self._noise.compiled = self._tremor.compiled = machine_code
        self._block.line_before = self._block.line.copy()  # machine code has that from before the last step
        self._numbers = self._numbers_of_loops()

    def _loops(self) -> tuple[Loop[..., Any], ...]:
        """All that a frame calls."""
        return *loops.ALL, *smoothing.LOOPS, *noise_meter.LOOPS, *tremor.LOOPS

    def _numbers_of_loops(self) -> FloatArray:
        """What :func:`._loops.show` takes."""
        full = self.full_scale_kpa
        numbers = {
            loops.MODEL_VARIANCE: self._model_variance,
            loops.WITHIN: self._bends[0],
            loops.SURE: self._bends[1],
            loops.FULL: full,
            loops.MUCH: USUAL * full,
            loops.MUCH_NOISE: AT_REST * full,
            loops.NO_LOAD: NO_LOAD_SIGMAS,
            loops.TINY: TINY,
            loops.HIDDEN: HIDDEN,
            loops.PER_SIGMAS: 1.0 / SIGMAS,
            loops.STATED: float(self._states_std),
            loops.SIGMAS: SIGMAS,
            loops.HIDDEN_SHARE: HIDDEN / SIGMAS,
        }
        return np.array([numbers[place] for place in range(len(numbers))])

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue from a pickle, perhaps in a process without machine code."""
        self.__dict__.update(state)
        if self._compiled:
            self.compile()

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
        r = self._reading = np.empty(resistance.size)
        known = None if self._normalise(resistance.ravel(), r) else self._readable(r)
        before = self._pressure.copy()
        if not self._exact:
            self._noise.update(r, known)
        if not self._begun:
            self._start(r, known)
        if not self._exact:
            self._watch(dt, r)
        if self._stale or known is not None or self._gaps.open:
            self._choose(known)
        if self._block.cells.size:
            self._follow(dt, r)
        ended = self._gaps.advance(dt, self._usual_s or dt, known, self._most_kpa, self._speed)
        if ended is not None:
            self._doubt_after_gaps(ended, before)
        self._held.advance(dt, self._pressure)
        self._usual_s += (dt - self._usual_s) * (0.1 if self._frames > 1 else 1.0)
        self._frames += 1
        if self._frames % SETTLE_EVERY == 0 and not self._exact:
            self._rest()
        return self._shown()

    @property
    def resolved(self) -> bool:
        """Whether :meth:`resolve` has been called."""
        return self._noise.typical_resolution > 0.0

    def resolve(self, step_std: ArrayLike, resistance_ohm: ArrayLike) -> None:
        """Take the resolution of the readings, which the readings themselves do not show where noise is small.

        Args:
            step_std: (shape) relative standard deviation of a conductance by the steps of the ADC.
            resistance_ohm: (shape) the readings in ohm for which that holds. Where one of them is not finite the median
                of the others is taken; if all are not, nothing happens.
        """
        step = np.asarray(step_std, dtype=np.float64).ravel()
        resistance = np.asarray(resistance_ohm, dtype=np.float64).ravel()
        # A step of current is one of conductance: that of r is proportional to (1 + r)^2, as noise is.
        at_rest = np.divide(step, resistance * self._per_ohm, out=np.full(step.size, np.nan), where=resistance > 0)
        found = np.isfinite(at_rest) & (at_rest > 0)
        if found.any():
            self._noise.resolve(np.where(found, at_rest, np.median(at_rest[found])))

    @property
    def std_kpa(self) -> FloatArray:
        """(shape) standard deviation of the estimate of the last step, in kPa; NaN where none can be stated."""
        return np.asarray(np.sqrt(self.variance_of_last_step()()))

    def variance_of_last_step(self) -> Callable[[], FloatArray]:
        """A function that gives the square of :attr:`std_kpa` of the last step, whenever and in whatever thread.

        The function holds what it needs, so that a step whose standard deviation nobody asks for hardly pays for it.
        """
        by_gaps = self._gaps.variance if self._gaps.doubtful else None
        by_creep = self._held.variance
        return partial(
            self._variance_after, self._variance, self._asleep, self._reading, self._left_open, by_gaps, by_creep
        )

    def _variance_after(
        self,
        before: FloatArray,
        asleep: _Asleep | None,
        reading: FloatArray,
        left_open: _LeftOpen | _Stated | None,
        by_gaps: FloatArray | None,
        by_creep: FloatArray | None,
    ) -> FloatArray:
        """(shape) kPa^2, from variances (n,) in kPa^2: before the step, asleep, of the step, by gaps, by creep."""
        if left_open is not None and left_open.cells.size == before.size:
            variance = self._variance_of(left_open)
        else:
            variance = before.copy()
            if asleep is not None:
                asleep.add_to(variance, reading, compiled=self._compiled)
            if left_open is not None:
                variance[left_open.cells] = self._variance_of(left_open)
        for more in (by_gaps, by_creep):
            if more is not None:
                variance += more
        return variance.reshape(self.shape)

    @property
    def states_std(self) -> bool:
        """Whether a standard deviation is stated."""
        return self.knows_errors or self.conditions.model_std_kpa > 0

    def _shown(self) -> FloatArray:
        """(shape) pressure in kPa. A jump beyond full scale is not shown before it has lasted longer than a spark."""
        pressure = self._pressure.copy()
        if self._jumps.cells.size:
            now = pressure[self._jumps.cells]
            beyond = np.abs(now - self.full_scale_kpa / 2) > BEYOND * self.full_scale_kpa
            beyond &= ~self._jumps.load
            pressure[self._jumps.cells[beyond]] = self._jumps.memory[PRESSURE, beyond]
        shown: FloatArray = pressure.reshape(self.shape)
        return shown

    def _doubt_after_gaps(self, hidden_kpa: FloatArray, before: FloatArray) -> None:
        """Doubt the memory of cells whose gap has just ended: loads that nobody saw may have changed it.

        A reading is the sum of load and memory, both on the same side of rest. So neither is larger than the whole
        reading, and a cell that reads as at rest is at rest.

        Args:
            hidden_kpa: (n,) largest change of a load in the gap; 0 without a gap.
            before: (n,) kPa shown before it; NaN before the first reading.
        """
        if not self.remembers:
            return
        cells = np.flatnonzero(hidden_kpa > 0)
        hidden = hidden_kpa[cells]
        whole = np.abs(self._reading[cells]) * (self.full_scale_kpa / self._full_scale_r)
        change = np.abs(np.nan_to_num(self._pressure[cells] - before[cells]))
        held = AFTER_GAP * np.minimum(hidden, whole)
        left_behind = CHANGED_IN_GAP * change * (hidden / self._most_kpa)
        self._gaps.doubt(cells, np.hypot(held, left_behind))

    # -- steps of a frame, in their order ----------------------------------------------------------------------------

    def _normalise(self, resistance_ohm: FloatArray, r: FloatArray) -> bool:
        """Write the normalised resistances (n,) of the cells into ``r``; whether they were found to be credible."""
        if self._compiled:
            return loops.read.code(resistance_ohm, self._per_ohm, r, *self._credible)
        np.multiply(resistance_ohm, self._per_ohm, out=r)
        r -= _ONE
        return False

    def _readable(self, r: FloatArray) -> BoolArray | None:
        """(n,) which readings are credible; None: all. The others become the mean of their cell, in place."""
        low, high = self._credible
        if low < r.item(r.argmin()) and r.item(r.argmax()) < high:  # false if one of them is NaN
            return None
        known: BoolArray = r > low
        known &= r < high
        np.copyto(r, self._mean, where=~known)
        return known

    def _start(self, r: FloatArray, known: BoolArray | None) -> None:
        """Take the first readings of cells as those of a load held for ever."""
        enough = 1 if self._exact else FIRST_READINGS
        early = self._readings < enough
        new = np.flatnonzero(early if known is None else early & known)
        if new.size:
            self._flush()
            self._readings[new] += 1
            self._mean[new] += (r[new] - self._mean[new]) / self._readings[new]
            self._memory[:, new] = self._begin(self._mean[new])
            if len(self.rows) > len(Estimator.rows):  # what the cell bore before counts
                first = new[self._readings[new] == 1]
                self._gaps.doubt(first, UNKNOWN_PAST * np.abs(self._memory[PRESSURE, first]))
            self._line[:, new] = smoothing.begin(self._mean[new], 1.0)
            self._awake[new] = True
            self._stale = True
        self._begun = bool((self._readings >= enough).all())

    def _watch(self, dt: float, r: FloatArray) -> None:
        """Wake sleeping cells whose reading, or the mean of their readings, has left what noise does."""
        woken = self._add_up(r)
        self._sum_s += dt
        self._summed += 1
        means = self._sum_s >= WATCH_S / MEANS
        if means:
            share = -math.expm1(-dt / WATCH_S)
            averaged = math.sqrt(share / (2 - share))
            woken |= self._renew_means(averaged)
        if not woken:
            return
        left: BoolArray = np.abs(r) > self._wake_at
        if means:
            left |= np.abs(self._mean) > self._band + averaged * (self._wake_at - self._band)
        if np.count_nonzero(left):
            cells = np.flatnonzero(left)
            self._memory[:, cells] = self._memory_at_rest
            self._line[:, cells] = _LINE_AT_REST
            self._awake[cells] = True
            self._stale = True

    def _add_up(self, r: FloatArray) -> bool:
        """Add the readings (n,) to the sum of which the mean is made; whether one of them may wake its cell."""
        if self._compiled:
            return loops.watch.code(r, self._sum, self._wake_at)
        self._sum += r
        return not self._all_awake

    def _renew_means(self, averaged: float) -> bool:
        """Take the sums into the means; whether one of these may wake its cell, for noise that is ``averaged``."""
        share, summed = -math.expm1(-self._sum_s / WATCH_S), self._summed
        self._sum_s, self._summed = 0.0, 0
        if self._compiled:
            return loops.renew_means.code(self._sum, summed, self._mean, share, self._wake_at, self._band, averaged)
        self._sum /= summed
        self._sum -= self._mean
        self._sum *= share
        self._mean += self._sum
        self._sum[:] = 0.0
        return not self._all_awake

    def _choose(self, known: BoolArray | None) -> None:
        """Gather the cells to follow: those that are awake and have been read.

        A cell that is not read keeps its pressure: that from before, if its reading had jumped just then. Its memory
        is brought up when it is read again, as if the load had been held.
        """
        wanted = self._awake if known is None else self._awake & known
        if not self._stale and np.array_equal(wanted, self._followed):
            return
        self._flush()
        if known is not None or self._gaps.open:
            self._part(wanted)
        self._followed = wanted.copy()
        cells = np.flatnonzero(wanted)
        self._block = _Block(cells, self._memory.take(cells, axis=1), self._line.take(cells, axis=1))
        self._all_awake = cells.size == wanted.size
        self._wake_at[cells] = np.inf
        self._stale = False

    def _part(self, wanted: BoolArray) -> None:
        """Bring up the memory of cells that are read again, and of those that are not read any more."""
        lost = self._followed & ~wanted
        if np.count_nonzero(lost):
            self._undo_jumps(lost)
            self._interrupt(np.flatnonzero(lost))
        back = np.flatnonzero(wanted & (self._gaps.unread_s > 0))
        if back.size:
            self._memory[:, back] = self._hold(self._memory[:, back], self._gaps.unread_s[back])

    def _undo_jumps(self, lost: BoolArray) -> None:
        """Put back what cells that are not read any more remembered before they jumped, unless it was a load."""
        jumps = self._jumps
        gone = lost[jumps.cells]
        if not np.count_nonzero(gone):
            return
        back = gone & ~jumps.load
        cells = jumps.cells[back]
        self._memory[:, cells] = jumps.memory[:, back]
        self._line[:, cells] = jumps.line[:, back]
        self._pressure[cells] = jumps.memory[PRESSURE, back]
        self._jumps = jumps.where(~gone)

    def _interrupt(self, cells: IntArray) -> None:
        """Let the next reading of cells begin a new line, whatever it is."""
        line = self._line[:, cells]
        smoothing.interrupt(line)
        self._line[:, cells] = line

    def _flush(self) -> None:
        """Store what the cells that are followed remember with that of all cells; none is followed until they are
        chosen anew.
        """
        block = self._block
        if self._left_open is not None:
            self._variance = self._variance.copy()
            self._variance[self._left_open.cells] = self._variance_of(self._left_open)
            self._left_open = None
        self._memory[:, block.cells] = block.memory
        self._line[:, block.cells] = block.line
        self._block = self._no_block
        self._stale = True

    def _follow(self, dt: float, r: FloatArray) -> None:
        """Smooth the readings of cells that are followed, and let the estimator advance."""
        if self._compiled:
            self._follow_compiled(dt, r)
            return
        block = self._block
        cells, line = block.cells, block.line
        every = cells.size == r.size
        reading = r if every else r.take(cells, mode="clip")
        if self._exact:
            memory = block.memory = self._advance(block.memory, dt, reading, _ZERO, _no_doubt)
            self._left_open = _LeftOpen(cells, memory[:SHARED].copy(), None, None)
            self._pressure[cells] = memory[PRESSURE]
            return
        at_rest = self._noise.at_rest
        noise = line[smoothing.LEVEL] + _ONE
        noise *= noise
        noise *= at_rest if every else at_rest.take(cells, mode="clip")
        noise += _LEAST_NOISE
        if self._jumps.cells.size:
            self._put_back(dt, reading, noise)
        if block.scratch is None:
            block.scratch = smoothing.Scratch(line)
        smooth = smoothing.advance(line, dt, self._gains(dt), reading, noise, block.scratch)
        if smooth.begun is not None:
            self._remember(smooth.begun, reading, noise)
        if self._jumps.cells.size:
            self._recognise_loads(dt, r)
        block.line_before = line.copy()
        looked = Looked(reading, noise, smooth.std, block.line_before)
        memory = block.memory = self._advance(block.memory, dt, smooth.level, smooth.std, looked.doubt)
        if self._jumps.cells.size:
            self._accept_loads(memory)
        if self._frames % (WINDOW // LOOKS) == 0:
            self._look_for_tremor(memory, self._most_seeming(memory, noise))
        pressure, added = memory[PRESSURE], None
        if self._tremor.suspicious:
            added = self._tremor.variance(cells, pressure, self._most_seeming(memory, noise))
        if self._jumps.cells.size:
            added = _sum(added, self._variance_of_jumps(memory))
        if pressure.item(pressure.argmax()) > USUAL * self.full_scale_kpa:
            # A pressure that the cell is not meant for may as well be an error of the memory.
            added = _sum(added, np.maximum(pressure - self.full_scale_kpa, 0.0) ** 2)
        noise_kpa = smooth.std * memory[GAIN]
        if noise_kpa.item(noise_kpa.argmax()) > AT_REST * self.full_scale_kpa:
            likely = self._likely(pressure, noise_kpa)
            added = _sum(added, (pressure - likely) ** 2)
            pressure = likely
        self._left_open = _LeftOpen(cells, memory[:SHARED].copy(), looked, added)
        if every:
            self._pressure[...] = pressure
        else:
            self._pressure[cells] = pressure

    def _follow_compiled(self, dt: float, r: FloatArray) -> None:
        """The same by machine code, except where a reading jumps."""
        block = self._block
        cells, line, taken = block.cells, block.line, block.taken
        reading, noise, level, std = taken
        loops.take.code(r, self._noise.at_rest, cells, line, taken, LEAST_NOISE)
        if self._jumps.cells.size:
            self._put_back(dt, reading, noise)
        gains, large = self._gains(dt).rows, LARGE_JUMP * self._full_scale_r
        if smoothing.advance_each.code(line, block.line_before, dt, gains, taken, block.begun, large):
            self._remember(block.begun, reading, noise)
        if self._jumps.cells.size:
            self._recognise_loads(dt, r)
        memory = block.memory = self._advance_compiled(dt, level, std, Looked(reading, noise, std, line))
        if self._jumps.cells.size:
            self._accept_loads(memory)
        if self._frames % (WINDOW // LOOKS) == 0:
            self._look_for_tremor_compiled(memory, taken)
        added = np.zeros(cells.size)
        if self._tremor.suspicious:
            self._tremor.add_variance(cells, memory, taken, self._seeming, added)
        if self._jumps.cells.size:
            added += self._variance_of_jumps(memory)
        variance = np.empty(cells.size)
        loops.show.code(
            *(memory, line, taken, added, self._numbers, self._rest_at_kpa, self._rest_variances),
            *(cells, self._pressure, variance),
        )
        self._left_open = _Stated(cells, variance)

    def _advance_compiled(self, dt: float, r: FloatArray, std: FloatArray, looked: Looked) -> FloatArray:
        """The block's memory after :meth:`_advance`; an estimator that has loops for that calls them."""
        return self._advance(self._block.memory, dt, r, std, looked.doubt)

    def _look_for_tremor(self, memory: FloatArray, most_kpa: FloatArray) -> None:
        """Doubt the rise of cells whose load goes to and fro within the noise; changes ``memory``.

        ``most_kpa`` (m,) is the rise that motion as large as the noise may at most make up in a window.
        """
        cells = self._block.cells
        beside = self._noise.beside_parabola(cells)
        self._tremor.look(cells, memory, beside)
        if self._frames % WINDOW == 0:
            unrest = self._noise.unrest(cells, beside)
            missed = self._tremor.end_window(cells, memory[PRESSURE], most_kpa, beside, unrest)
            if missed is not None:
                self._miss(memory, missed)

    def _look_for_tremor_compiled(self, memory: FloatArray, taken: FloatArray) -> None:
        """The same by machine code; ``taken`` (4, m) are the readings and their noise."""
        cells = self._block.cells
        beside = self._noise.beside_parabola(cells)
        self._tremor.look(cells, memory, beside)
        if self._frames % WINDOW == 0:
            before = self._noise.beside
            missed = self._tremor.end_window_compiled(cells, memory, taken, self._seeming, beside, before)
            if missed is not None:
                self._miss(memory, missed)

    def _likely(self, pressure: FloatArray, noise_kpa: FloatArray) -> FloatArray:
        """(m,) pressures with those that noise alone could give shown nearer to none.

        Most cells carry no load: of a pressure below two standard deviations of the noise, no load is the likelier
        cause. What is remembered stays as it is.
        """
        squared = pressure * pressure
        squared *= squared
        hides = NO_LOAD_SIGMAS * noise_kpa
        hides *= hides
        likely: FloatArray = pressure * (squared / (squared + hides * hides + TINY))
        return likely

    def _variance_of(self, left_open: _LeftOpen | _Stated) -> FloatArray:
        """(m,) variance in kPa^2 of the cells that were followed in a step; gaps are not counted."""
        if isinstance(left_open, _Stated):
            return left_open.variance.copy()
        doubt = _ZERO if left_open.looked is None else left_open.looked.doubt()
        variance = self._own_variance(left_open.memory, doubt)
        if left_open.added is not None:
            variance += left_open.added
        return variance

    def _own_variance(self, memory: FloatArray, std: FloatArray) -> FloatArray:
        """(m,) variance in kPa^2 of cells whose readings are known to ``std`` (m,); gaps are not counted."""
        if not self._states_std:
            return np.full(memory.shape[1], np.nan)
        variance: FloatArray = std * memory[GAIN]
        variance *= variance
        variance += self._within_frame(memory, np.sqrt(variance))
        variance += memory[VARIANCE]
        variance += self._model_variance
        if self._rest_variance is not None:
            variance += np.interp(memory[PRESSURE], self._rest_at_kpa, self._rest_variance)
        return variance

    def _rest(self) -> None:
        """Let cells sleep that read as at rest and remember no load."""
        block, cells = self._block, self._block.cells
        if cells.size:
            calm = self._calm()
            if np.count_nonzero(calm):
                calm &= self._settled(block.memory, self._band)
                calm &= self._readings[cells] >= FIRST_READINGS
                self._put_to_sleep(cells[calm])
        asleep = np.flatnonzero(~self._awake & (self._readings > 0))
        if asleep.size:
            self._variance = self._variance.copy()
            self._asleep = self._watch_over(asleep)

    def _calm(self) -> BoolArray:
        """(m,) cells that are followed and read as at rest."""
        block, cells = self._block, self._block.cells
        calm: BoolArray
        if self._compiled:
            calm = np.empty(cells.size, dtype=np.bool_)
            loops.find_calm.code(cells, self._mean, self._noise.at_rest, block.line, self._band, calm)
            return calm
        mean = self._mean[cells]
        quiet = self._band + CALM_SIGMAS * self._noise.std(mean, cells)
        calm = np.abs(mean) < quiet
        calm &= np.abs(block.line[smoothing.LEVEL]) < LEVEL_BANDS * quiet
        return calm

    @cached_property
    def _memory_at_rest(self) -> FloatArray:
        """(rows, 1) memory of a cell that has been at rest for ever."""
        return self._begin(np.zeros(1))

    def _watch_over(self, asleep: IntArray) -> _Asleep:
        """Renew the limits at which sleeping cells (m,) wake, and their variances, for the present noise."""
        if self._compiled:
            per_reading, hidden_kpa = np.empty((2, asleep.size))
            loops.watch_over.code(
                *(asleep, self._memory, self._mean, self._noise.at_rest, self._band, self._numbers),
                *(self._rest_at_kpa, self._rest_variances, self._wake_at, per_reading, hidden_kpa, self._variance),
            )
            return _Asleep(asleep, per_reading, hidden_kpa)
        memory = self._memory[:, asleep]
        noise = self._noise.std(self._mean[asleep], asleep)
        self._wake_at[asleep] = ASLEEP_SIGMAS * noise + self._band
        self._variance[asleep] = self._own_variance(memory, _ZERO) + memory[PRESSURE] ** 2
        return _Asleep(asleep, memory[GAIN] / SIGMAS, memory[GAIN] * (HIDDEN / SIGMAS) * noise)

    def _put_to_sleep(self, cells: IntArray) -> None:
        if not cells.size:
            return
        self._flush()
        self._memory[:, cells] = self._memory_at_rest
        self._pressure[cells] = 0.0  # a calibration curve may miss that by some percent
        if self._jumps.cells.size:
            self._jumps = self._jumps.where(~np.isin(self._jumps.cells, cells))
        self._awake[cells] = False
        self._tremor.forget(cells)
        self._all_awake = False
        self._stale = True

    @property
    def _most_kpa(self) -> float:
        """Standard deviation of a load of which nothing is known."""
        return self.full_scale_kpa / 2

    @property
    def _speed(self) -> float:
        return self.conditions.speed_kpa_per_s or self.full_scale_kpa

    def _gains(self, dt: float) -> smoothing.Gains:
        """Of the smoothing, which the noise and the time between frames ask for."""
        if (self._noise.typical, dt) != self._smoothed_for:
            self._smoothed_for = self._noise.typical, dt
            window_s = smoothing.window_s(self._noise.typical / self._full_scale_r, dt)
            self._smoothed_by = smoothing.gains_for(window_s, dt)
        return self._smoothed_by

    # -- sparks ------------------------------------------------------------------------------------------------------

    def _remember(self, begun: BoolArray, reading: FloatArray, noise: FloatArray) -> None:
        """Keep the memory of cells from before a jump, unless an earlier one is kept already."""
        block = self._block
        jump = reading - block.line_before[smoothing.LEVEL]
        size = np.abs(jump)
        if size.item(size.argmax()) <= LARGE_JUMP * self._full_scale_r:
            return
        least = np.maximum(CLEAR_JUMP * noise, LARGE_JUMP * self._full_scale_r)
        # Bad contacts add resistance: where loads do so too, a fall to no less than that at rest is a release, if there
        # was a load.
        loaded = block.memory[PRESSURE] > LARGE_JUMP * self.full_scale_kpa
        released = loaded & (self._side > 0) & (jump < 0) & (reading > -CLEAR * noise)
        place = np.flatnonzero(begun & (size > least) & ~released)
        if not place.size:
            return
        if self._jumps.cells.size:
            place = place[~np.isin(block.cells[place], self._jumps.cells)]
        place = place[size[place] > SUDDEN * np.abs(self._noise.change_before(block.cells[place]))]
        if place.size:
            cells, before = block.cells[place], block.line_before[:, place]
            levels = self._levels_before()
            if not (self._jumps.age_s <= TOGETHER_S).any():
                self._before_jumps = levels
            around = self._neighbours.values(levels, cells)
            self._jumps = self._jumps.with_more(cells, block.memory[:, place], before, jump[place], around)

    def _levels_before(self) -> FloatArray:
        """(n,) smoothed readings before this frame, or before a jump that is under way."""
        levels = self._mean.copy()
        levels[self._block.cells] = self._block.line_before[smoothing.LEVEL]
        levels[self._jumps.cells] = self._jumps.line[smoothing.LEVEL]
        return levels

    def _recognise_loads(self, dt: float, r: FloatArray) -> None:
        """Find the jumps that are loads, by their neighbours in the readings (n,)."""
        noise = (r + 1.0) ** 2 * self._noise.at_rest + LEAST_NOISE
        self._neighbours.recognise_loads(self._jumps, dt, self._side, r, noise, self._before_jumps)

    def _accept_loads(self, memory: FloatArray) -> None:
        """Let jumps that are loads, in the block's ``memory``, be no motion within the noise."""
        load = self._jumps.load & (self._jumps.age_s <= TOGETHER_S)
        if np.count_nonzero(load):
            cells = self._jumps.cells[load]
            self._tremor.accept(cells, memory[PRESSURE, np.searchsorted(self._block.cells, cells)])

    def _put_back(self, dt: float, r: FloatArray, noise: FloatArray) -> None:
        """Put back the memory of cells whose reading has come back; changes the block."""
        jumps, block = self._jumps, self._block
        jumps.age_s += dt
        jumps.memory = self._hold(jumps.memory, dt)
        place = np.searchsorted(block.cells, jumps.cells)
        off = r[place] - jumps.line[smoothing.LEVEL]
        np.copyto(jumps.size, off, where=np.abs(off) > np.abs(jumps.size))
        size, moved = np.abs(jumps.size), jumps.line[smoothing.SLOPE] * jumps.age_s
        over = jumps.age_s > SPARK_S * (1 + 1e-9)
        back = np.abs(off - moved) < BACK * size + CLEAR * noise[place] + np.abs(moved)
        back &= np.abs(block.line[smoothing.LEVEL, place] - r[place]) > SUDDENLY * size
        back &= ~over
        over |= back
        back &= ~jumps.load
        if back.any():
            some = place[back]
            back[back] = self._was_spark(some, dt, jumps.where(back), r[some], noise[some])
            block.memory = block.memory.copy()  # another array, as sign that it has changed
            block.memory[:, place[back]] = jumps.memory[:, back]
            block.line[:, place[back]] = jumps.line[:, back]
            block.line_before = block.line.copy()
        if over.any():
            self._jumps = jumps.where(~over)

    def _was_spark(self, place: IntArray, dt: float, jumps: Jumps, reading: FloatArray, noise: FloatArray) -> BoolArray:
        """Whether jumps (m,) that were taken back were bad contacts rather than taps; ``place`` of them in the block.

        A cell remembers a tap. After one, the pressure that follows from the memory of the tap is the one from before,
        and the reading is not; after a bad contact it is the other way round. Taps are the rule. Where both may be, the
        difference counts as standard deviation, until it has faded.
        """
        before, top = jumps.memory[PRESSURE], self._block.memory[PRESSURE, place]
        tapped = self._advance(self._block.memory[:, place], dt, reading, noise, lambda: noise)
        off = np.abs(reading - jumps.line[smoothing.LEVEL]) - CLEAR * noise
        off_if_tapped = np.abs(tapped[PRESSURE] - before)
        moved = np.abs(top - before)
        found: BoolArray = off * moved <= NEARER * off_if_tapped * np.abs(jumps.size)
        plausible = np.maximum(EITHER * moved, SMALL * self.full_scale_kpa)
        either = found & (off_if_tapped < plausible) & (tapped[PRESSURE] > -LARGE_JUMP * self.full_scale_kpa)
        self._gaps.doubt(jumps.cells[either], off_if_tapped[either])
        return found

    def _variance_of_jumps(self, memory: FloatArray) -> FloatArray:
        """(m,) kPa^2: half of a jump counts as standard deviation as long as it may be a spark."""
        jumps = self._jumps
        place = np.searchsorted(self._block.cells, jumps.cells)
        change = np.where(jumps.load, 0.0, memory[PRESSURE, place] - jumps.memory[PRESSURE])
        variance = np.zeros(memory.shape[1])
        variance[place] = (0.5 * change) ** 2
        return variance

    # -- saving ------------------------------------------------------------------------------------------------------

    _KEPT = ("memory", "line", "mean", "sum", "pressure", "variance", "readings", "awake", "followed")

    def state(self) -> dict[str, FloatArray]:
        """Everything remembered, as a copy: arrays of float64 by name, which :meth:`restore` takes."""
        self._flush()
        own = {name: getattr(self, f"_{name}") for name in self._KEPT} | self._noise.state() | self._gaps.state()
        own |= self._held.state() | self._tremor.state()
        clock = [self._usual_s, self._frames, self._sum_s, self._summed]
        own["clock"] = np.array(clock, dtype=np.float64)
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
            setattr(self, f"_{name}", value > 0 if name in ("awake", "followed") else value)
        self._noise.restore(given)
        self._gaps.restore(given)
        self._held.restore(given)
        self._tremor.restore(given)
        self._usual_s, frames, self._sum_s, summed = given["clock"].tolist()
        self._frames, self._summed = int(frames), int(summed)
        self._jumps = Jumps.none(self._memory, self._line)
        self._begun = bool((self._readings >= (1 if self._exact else FIRST_READINGS)).all())
        cells = np.flatnonzero(self._followed)
        self._block = _Block(cells, self._memory.take(cells, axis=1), self._line.take(cells, axis=1))
        self._stale = True

    # -- what an estimator adds --------------------------------------------------------------------------------------

    @abstractmethod
    def _begin(self, r: FloatArray) -> FloatArray:
        """The memory (rows, m) of cells whose reading has been ``r`` (m,) for ever."""

    @abstractmethod
    def _advance(
        self, memory: FloatArray, dt_s: float, r: FloatArray, std: FloatArray, doubt: Callable[[], FloatArray]
    ) -> FloatArray:
        """The memory (rows, m) after the reading went to ``r`` (m,) in ``dt_s``.

        ``std`` (m,) is what noise leaves in it, ``doubt()`` (m,) also what the smoothing may not have noticed yet.
        May change ``memory`` itself.
        """

    def _hold(self, memory: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """The memory (rows, m) after ``dt_s``, one number or (m,), in which the pressure stayed."""
        return memory

    def _most_seeming(self, memory: FloatArray, noise: FloatArray) -> FloatArray:
        """(m,) kPa by which motion as large as the ``noise`` (m,) may at most let pressures seem to rise."""
        gain = memory[GAIN]
        most: FloatArray = noise * self._seeming
        most *= gain * gain
        return most

    def _miss(self, memory: FloatArray, rise_kpa: FloatArray) -> None:  # noqa: B027 - without a memory nothing is missed
        """Count what cells may remember wrong where a rise (m,) may only have seemed to be one; changes ``memory``."""

    def _within_frame(self, memory: FloatArray, noise_kpa: FloatArray) -> FloatArray:
        """(m,) variance in kPa^2 by what the load may have done since the last frame.

        ``memory`` (SHARED, m) are the first rows, ``noise_kpa`` (m,) the standard deviation by noise.
        """
        return _ZERO

    def _settled(self, memory: FloatArray, band: float) -> BoolArray:
        """(m,) whether the memory is that of a cell at rest, within ``band`` of r."""
        return np.ones(memory.shape[1], dtype=bool)


_ZERO = np.zeros(1)
_LINE_AT_REST = smoothing.begin(_ZERO, 1.0)
LEAST_NOISE = 1e-9
"""of r: keeps a division by the noise finite"""
_ONE, _LEAST_NOISE, _HIDDEN, _PER_SIGMAS = (np.array(x) for x in (1.0, LEAST_NOISE, HIDDEN, 1.0 / SIGMAS))
# As arrays: NumPy makes an array of a float in every call, which takes as long as a small operation.


def _no_doubt() -> FloatArray:
    return _ZERO


def _sum(one: FloatArray | None, other: FloatArray) -> FloatArray:
    return other if one is None else one + other


class Looked(NamedTuple):
    """The readings of one step as the smoothing took them. Arrays (m,), which never change again."""

    reading: FloatArray
    noise: FloatArray
    """standard deviation of a reading"""
    std: FloatArray
    """standard deviation of the smoothed readings by the noise"""
    line: FloatArray
    """(smoothing.ROWS, m) memory of the smoothing after the reading"""

    def doubt(self) -> FloatArray:
        """(m,) standard deviation of the smoothed readings.

        A change of the load that the line has not taken up is anything between the line and a little beyond the
        reading, since noise may hide as much: errors up to there are to stay within :data:`SIGMAS` deviations.
        """
        doubt: FloatArray = self.reading - self.line[smoothing.LEVEL]
        np.abs(doubt, out=doubt)
        doubt += self.noise * _HIDDEN
        doubt *= _PER_SIGMAS
        return np.maximum(doubt, self.std, out=doubt)


class _Asleep(NamedTuple):
    """What the readings of sleeping cells leave open. Arrays never change again."""

    cells: IntArray
    """(m,) that sleep, or have done so a few frames ago"""
    per_reading: FloatArray
    """(m,) kPa of standard deviation per r: the load may be the reading's, though none is shown"""
    hidden_kpa: FloatArray
    """(m,) what the noise may hide beyond, as standard deviation"""

    def add_to(self, variance: FloatArray, reading: FloatArray, *, compiled: bool) -> None:
        """Add what the present readings (n,) leave open to variances (n,) in kPa^2."""
        if compiled:
            loops.add_asleep.code(variance, reading, self.cells, self.per_reading, self.hidden_kpa)
            return
        std = np.abs(reading.take(self.cells))
        std *= self.per_reading
        std += self.hidden_kpa
        std *= std
        variance[self.cells] += std


class _LeftOpen(NamedTuple):
    """All that the variances of one step follow from. Arrays never change again."""

    cells: IntArray
    """(m,) that were followed"""
    memory: FloatArray
    """(SHARED, m) first rows of their memory after the step"""
    looked: Looked | None
    """None: readings are exact"""
    added: FloatArray | None
    """(m,) kPa^2 beside that of noise and memory"""


class _Stated(NamedTuple):
    """The variances of one step, worked out. Arrays never change again."""

    cells: IntArray
    """(m,) that were followed"""
    variance: FloatArray
    """(m,) kPa^2; gaps are not counted"""


class _Block:
    """What is remembered of the cells that are followed, side by side."""

    def __init__(self, cells: IntArray, memory: FloatArray, line: FloatArray) -> None:
        self.cells, self.memory, self.line = cells, memory, line
        self.line_before = line.copy()
        """the line after the last step; replaced, never changed. Machine code sets it when the next step begins"""
        self.scratch: smoothing.Scratch | None = None
        """of the array operations; None: not used yet"""
        self.taken = np.empty((4, cells.size))
        """readings of the step, for machine code; see :mod:`._rows`"""
        self.begun = np.empty(cells.size, dtype=np.bool_)
        """where a line began in the step, for machine code"""

    def __reduce__(self) -> tuple[type[_Block], tuple[IntArray, FloatArray, FloatArray], dict[str, FloatArray]]:
        """For pickle and copy: the rows in ``scratch`` are parts of the line, and would become arrays of their own."""
        return type(self), (self.cells, self.memory, self.line), {"line_before": self.line_before}


class _Gaps:
    """How long each cell has not been read, and the variance in kPa^2 that this adds."""

    def __init__(self, unread_s: FloatArray, left: FloatArray) -> None:
        self.unread_s = unread_s
        self._left = left
        self.variance = left.copy()
        self.open = False
        """whether a cell was not read in the last frame"""
        self.doubtful = False
        """whether the variance is not zero"""

    @classmethod
    def none(cls, cells: int) -> _Gaps:
        return cls(np.zeros(cells), np.zeros(cells))

    def advance(
        self, dt: float, usual_s: float, known: BoolArray | None, most_kpa: float, speed: float
    ) -> FloatArray | None:
        """Take a frame of which ``known`` (n,) was read (None: all), ``dt`` after the last one.

        Returns:
            (n,) kPa by which a load may have changed in the gap that this frame ends, 0 for cells without one. None if
            there is no such cell.

        """
        fade = math.exp(-2 * dt / AFTER_GAP_S)
        if known is None and not self.open and dt <= 3 * usual_s:
            if self.doubtful:
                self._left *= fade
                self.variance = self._left.copy()
                self._end_if_small(most_kpa)
            return None
        self._left *= fade
        self.unread_s += dt
        gap = np.maximum(self.unread_s - usual_s, 0.0)
        hidden = -most_kpa * np.expm1(-speed * gap / most_kpa)
        read: BoolArray | slice = slice(None) if known is None else known
        ended = np.zeros(len(hidden))
        ended[read] = hidden[read]
        hidden[read] = 0.0
        self.unread_s[read] = 0.0
        self.variance = self._left + hidden**2
        self._renew()
        if self.doubtful:
            self._end_if_small(most_kpa)
        return ended if ended.any() else None

    def _end_if_small(self, most_kpa: float) -> None:
        """End doubts that hardly count any more."""
        if self.variance.item(self.variance.argmax()) < (1e-3 * most_kpa) ** 2:
            self._left[:] = 0.0
            self.doubtful = self.open

    def doubt(self, cells: IntArray, std_kpa: FloatArray) -> None:
        """Add a standard deviation in kPa to what readings leave open of these cells."""
        self._left[cells] += std_kpa**2
        self.variance = self.variance.copy()
        self.variance[cells] += std_kpa**2
        self._renew()

    def _renew(self) -> None:
        self.open = bool(self.unread_s.any())
        self.doubtful = self.open or bool(self._left.any())

    def state(self) -> dict[str, FloatArray]:
        return {"unread_s": self.unread_s, "gap_variance": self._left, "gap_shown": self.variance}

    def restore(self, state: dict[str, FloatArray]) -> None:
        self.unread_s, self._left, self.variance = (state[n] for n in ("unread_s", "gap_variance", "gap_shown"))
        self._renew()
