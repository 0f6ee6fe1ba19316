"""Causal estimation of pressure from resistance, frame by frame, for any material.

Each frame passes these steps:

1. Readings become r, the normalised resistance or what else the cell's scale says (:mod:`._scale`). A reading counts as
   missing if it is NaN, open, shorted, or beyond every credible load. Without current a cell that is open at rest
   bears no load. Its cell keeps its pressure, and the standard deviation grows (:mod:`._gaps`).
2. Noise that the cells of a column share is subtracted (:mod:`._shared_noise`). The remaining noise is measured
   (:mod:`._noise`).
3. Cells at rest sleep: only their mean is monitored, until the mean or a reading leaves the noise (:mod:`._sleep`).
4. The other cells are followed. Their readings are smoothed according to the noise (:mod:`._smoothing`), and an
   :class:`._inversion.Inversion` turns them into pressures.
5. A reading that jumps and comes back at once was a bad contact, and the state from before the jump is restored
   (:mod:`._sparks`), unless the neighbouring cells show that the jump was a tap (:mod:`._taps`).
6. The variance of a pressure sums those of noise, of the memory, of motion within the noise (:mod:`._tremor`), of gaps,
   of R0, of creep under loads longer than any in the calibration (:mod:`._held`), and of the residual error of the
   calibration (:mod:`._deviation`).

The state of a cell is a :class:`.._state.CellState` and the memory of the inversion. Every step is a kernel over the
cells that it concerns (:mod:`ohmskin.common.compiled`). Exact readings pass the same kernels: they are not smoothed,
and no cell sleeps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Record, Records, values, zeros
from ...common.measurement import STEP_STD, Measurement
from ...errors import InputError
from .._state import CellState
from . import _smoothing as smoothing
from . import _tremor as tremor
from ._conditions import Conditions
from ._deviation import Deviation
from ._gaps import Gaps
from ._held import Held
from ._inversion import USUAL, Inversion
from ._noise import RECENT, WINDOW, NoiseMeter
from ._scale import Scale
from ._shared_noise import SharedNoise
from ._sleep import Sleep
from ._sparks import Sparks

SETTLE_EVERY = 32
"""frames between two searches for cells that may go to sleep"""
FIRST_LOOKS = 8, 16
"""frames after which there is an additional search: until then all cells are followed, at several times the usual
cost"""
MORE = 1.1
"""ratio of the deviation by the quantisation steps of all readings to that by the cell's own; below this ratio the
steps of other readings are neglected"""
EVENLY = math.sqrt(3.0)
"""largest error over the standard deviation, of an error that is evenly distributed from none to all of it"""
UNUSUAL = 0.1
"""relative change of the time between frames beyond which calls of ``correct_tremor`` are adapted to it"""
UNKNOWN_PAST = 0.25
"""standard deviation of the first pressure of a cell, over that pressure: a load that has just begun reads much larger
than the same load after a long hold. This uncertainty fades as that of a gap does"""
_NOWHERE = np.zeros(0, dtype=np.intp)


class Estimator:
    """Pressure of an array of cells; made by :meth:`ohmskin.cell.Cell.estimator`.

    Call :meth:`step` for every frame. The first reading of a cell is taken to be at equilibrium (at rest, or under a
    load held for long); the standard deviation includes the doubt about that (:data:`UNKNOWN_PAST`).
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
        self._rest_ohm, self._scale = rest_resistance_ohm, scale
        count, full_kpa = rest_resistance_ohm.size, inversion.full_scale_kpa
        self._cells, self._memory = zeros(CellState, count), zeros(inversion.memory, count)
        """(n,) states of all cells"""
        self._at_rest = zeros(CellState, 1), zeros(inversion.memory, 1)
        """(1,) states of a cell at rest"""
        self._begin(*self._at_rest, np.zeros(1, dtype=np.intp), np.zeros(1))
        self._noise = NoiseMeter(count, conditions.noise or 0.0)
        self._shared_noise = SharedNoise(shape, self._noise, inversion.side)
        self._sleep = Sleep(count, inversion.full_scale_r)
        self._gaps = Gaps(count, full_kpa, conditions)
        self._sparks = Sparks(inversion, self._gaps, shape)
        self._deviation = Deviation(inversion, conditions, count, self._at_rest[0])
        self._held = Held(count, full_kpa, conditions.longest_load_s)
        self._pressure = np.full(count, np.nan)
        self._reading = np.zeros(count)
        """(n,) r of the last frame; never changes again"""
        self._watched = self._reading
        """(n,) the same, but readings of sleeping cells still contain shared noise; never changes again"""
        self._by_shared: FloatArray | None = None
        """(n,) kPa^2 by loads that may have been subtracted as shared noise; never changes again; None: zero"""
        self._by_bounds: FloatArray | None = None
        """(n,) kPa^2 by readings of which only an interval is known; never changes again; None: zero"""
        self._read = np.zeros(count, dtype=np.bool_)
        """(n,) whether each cell has been read"""
        self._all_read = False
        self._followed, self._wanted = _NOWHERE, np.zeros(count, dtype=np.bool_)
        """(m,) cells that are followed: awake, and read in the last frame; and (n,) the same as flags"""
        self._stale = True
        """whether the followed cells have to be chosen anew"""
        self._frames = 0
        self._usual_s = self._tremor_for_s = 0.0
        """recent mean of the time between frames; and the time to which the calls of ``correct_tremor`` are adapted"""

    # -- the frame ---------------------------------------------------------------------------------------------------

    def step(self, elapsed_s: float, resistance_ohm: ArrayLike) -> FloatArray:
        """Take the frame read ``elapsed_s`` after the last one (any number for the first frame).

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
        self._by_bounds = None
        return self._step(elapsed_s, resistance.ravel())

    def step_readings(self, elapsed_s: float, readings: Measurement) -> FloatArray:
        """As :meth:`step`, from conductances with their errors; a reading at a limit of the converter is an interval.

        A cell of which only an interval is known shows the least load of the interval, and the width of the interval
        counts as standard deviation. It is missing where the interval says nothing: where it has no bound on the side
        of loads, or where only an open cell, or one that nobody credits, conducts so.
        """
        if readings.conductance.shape != self.shape:
            raise InputError(f"conductance has shape {readings.conductance.shape}, expected {self.shape}")
        with np.errstate(divide="ignore"):
            resistance, most, least = (
                1.0 / part.ravel() for part in (readings.conductance, readings.least, readings.greatest)
            )
        if not self.resolved:
            with np.errstate(invalid="ignore", divide="ignore"):
                self.resolve(STEP_STD * readings.half_step / readings.conductance, 1.0 / readings.conductance)
        self._by_bounds = None
        only = np.isnan(resistance) & (np.isfinite(most) | (least > 0.0))
        if only.any():
            self._by_bounds = np.zeros(resistance.size)
            resistance[only], self._by_bounds[only] = (part[only] for part in self._within(least, most))
            if self.inversion.remembers:
                self._gaps.doubt_within(self._by_bounds)
        return self._step(elapsed_s, resistance)

    def _within(self, least_ohm: FloatArray, most_ohm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Resistances (n,) that stand for readings between ``least_ohm`` and ``most_ohm`` (n,), and variances in kPa^2.

        NaN where the readings are as good as missing.
        """
        falls, full = self._scale.falls, self.inversion.full_scale_kpa
        near, far = (most_ohm, least_ohm) if falls else (least_ohm, most_ohm)
        light, heavy = (self._held_kpa(bound) for bound in (near, far))
        heavy = np.minimum(heavy, USUAL * full) if falls else heavy
        unloaded = light <= 0.0
        if not self._scale.open_at_rest:
            light = np.where(least_ohm > self._rest_ohm, np.nan, light) if falls else light
        stands = np.where(unloaded, self._rest_ohm, near if falls else np.nan)
        stands[~(heavy >= light)] = np.nan
        std = (heavy - np.maximum(light, 0.0)) / EVENLY
        return stands, np.where(np.isnan(stands), 0.0, std * std)

    def _held_kpa(self, bound_ohm: FloatArray) -> FloatArray:
        """(n,) load in kPa whose hold leads to resistances ``bound_ohm`` (n,); NaN where every load does or none.

        A bound of no resistance is that of the heaviest load where loads lower the resistance, and says nothing where
        they raise it; an infinite one is that of no load, or says nothing.
        """
        falls, r = self._scale.falls, np.empty(bound_ohm.size)
        told = np.isfinite(bound_ohm) & (bound_ohm > 0.0)
        self._scale.read(np.where(told, bound_ohm, self._rest_ohm), r)
        held = np.where(told, self.inversion.held_kpa(r), 0.0)
        if falls:
            return np.where(bound_ohm == 0.0, np.inf, held)
        return np.where(np.isinf(bound_ohm), np.nan, held)

    def _step(self, elapsed_s: float, resistance: FloatArray) -> FloatArray:
        """:meth:`step` for resistances (n,)."""
        if self._frames and not 0 < elapsed_s < np.inf:
            raise InputError(f"a frame follows {elapsed_s} s after the last; expected time stamps that increase")
        dt, exact = float(elapsed_s) if self._frames else 1.0, self.inversion.exact
        r = self._reading = np.empty(resistance.size)
        quiet = None
        if self._scale.open_at_rest and np.isinf(resistance).any():
            quiet = np.isinf(resistance) & (resistance > 0.0)  # no current, hence no load, and no noise to be measured
            resistance = np.where(quiet, self._rest_ohm, resistance)
        known = self._normalise(resistance, r)
        before = self._pressure.copy() if self._gaps.concern(dt, self._usual_s or dt, known) else None
        watched = loaded = None
        if self._shared_noise.ratio and not exact:
            r, watched, loaded = self._subtract_shared(dt, r, known)
            self._reading = r
        self._watched = r if watched is None else watched
        if not exact:
            self._noise.update(r, known if quiet is None else ~quiet if known is None else known & ~quiet)
        if not self._all_read:
            self._start(r, known)
        if not exact:
            blurred = None if watched is None else self._shared_noise.mean_std
            self._stale |= self._sleep.watch(dt, r, watched, blurred, loaded)
            if loaded is not None:
                smoothing.interrupt(self._cells, loaded)
        if self._stale or known is not None or self._gaps.open:
            self._choose(known)
        self._by_shared = None
        if self._followed.size:
            self._follow(dt, r)
            if watched is not None:
                self._by_shared = self._shared_noise.doubt_kpa2(self._cells, self._followed)
        if before is None:
            self._gaps.pass_by(dt)
        else:
            self._end_gaps(dt, known, before)
        self._held.advance(dt, self._pressure)
        self._usual_s += (dt - self._usual_s) * (0.1 if self._frames > 1 else 1.0)
        self._frames += 1
        if not exact and (self._frames % SETTLE_EVERY == 0 or self._frames in FIRST_LOOKS):
            self._rest()
        return self._shown()

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
        return self._noise.typical_resolution > 0.0

    def resolve(
        self,
        step_std: ArrayLike,
        resistance_ohm: ArrayLike,
        all_steps_std: ArrayLike | None = None,
        scales_columns: bool = False,
    ) -> None:
        """Set the resolution of the readings (ADC quantisation), which readings do not reveal where noise is small.

        Args:
            step_std: (shape) relative standard deviation of a conductance by the quantisation steps of its own reading.
            resistance_ohm: (shape) readings in ohm at which ``step_std`` holds. Cells without a finite reading get the
                median of the others. If no reading is finite, nothing happens.
            all_steps_std: (shape) as ``step_std``, by the quantisation steps of all readings that a conductance is
                computed from, as in a column of a divider. A load that is held must not seem to fall when one of these
                readings steps. Where idle rows float, ``all_steps_std`` replaces ``step_std``. None: as ``step_std``.
            scales_columns: True if steps of other readings scale all conductances of a column alike, as on a divider
                whose idle rows are driven. False if they give each cell an error of its own, as where idle rows float.
        """
        of_each = all_steps_std if all_steps_std is not None and not scales_columns else step_std
        at_rest, found = self._std_at_rest(of_each, resistance_ohm)
        if not found.any():
            return
        of_all = 0.0
        if all_steps_std is not None:
            by_all, known = self._std_at_rest(all_steps_std, resistance_ohm)
            of_all = float(np.median(by_all[known])) if known.any() else 0.0
            if of_all < MORE * np.median(at_rest[found]):
                of_all = 0.0  # as with virtual grounds: each conductance follows from its own reading alone
        self._noise.resolve(np.where(found, at_rest, np.median(at_rest[found])))
        self._shared_noise.suppose(float(np.median(at_rest[found])), of_all, scales_columns=scales_columns)

    def _std_at_rest(self, relative_std: ArrayLike, resistance_ohm: ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Standard deviation (n,) of r at rest for a relative one of conductances; and (n,) where it is known."""
        std = np.asarray(relative_std, dtype=np.float64).ravel()
        resistance = np.asarray(resistance_ohm, dtype=np.float64).ravel()
        # A step of current is a step of conductance, so that the step of r is proportional to (1 + r)^2, as noise is.
        at_rest = self._scale.at_rest(std, np.where(resistance > 0, resistance, np.nan))
        return at_rest, np.isfinite(at_rest) & (at_rest > 0)

    @property
    def std_kpa(self) -> FloatArray:
        """(shape) standard deviation of the estimate of the last step, in kPa; NaN where none can be stated."""
        return np.asarray(np.sqrt(self.variance_of_last_step()()))

    def variance_of_last_step(self) -> Callable[[], FloatArray]:
        """A function that returns the square of :attr:`std_kpa` of the last step, at any time and in any thread.

        The function keeps references to its inputs.
        """
        by_gaps = self._gaps.variance if self._gaps.doubtful else None
        more = by_gaps, self._held.variance, self._by_shared, self._by_bounds
        return self._deviation.of_last_step(self.shape, self._watched, *more)

    @property
    def states_std(self) -> bool:
        """Whether a standard deviation is stated."""
        return self._deviation.stated

    # -- steps of a frame, in their order ----------------------------------------------------------------------------

    def _normalise(self, resistance_ohm: FloatArray, r: FloatArray) -> BoolArray | None:
        """Write the normalised resistances (n,) into ``r``. A missing reading is replaced by the mean of its cell.

        Returns:
            (n,) which readings are credible; None: all.
        """
        low, high = self.inversion.credible
        self._scale.read(resistance_ohm, r)
        if low < r.item(r.argmin()) and r.item(r.argmax()) < high:  # false if one of them is NaN
            return None
        known: BoolArray = r > low
        known &= r < high
        np.copyto(r, self._sleep.mean, where=~known)
        return known

    def _subtract_shared(
        self, dt: float, r: FloatArray, known: BoolArray | None
    ) -> tuple[FloatArray, FloatArray, IntArray | None]:
        """As :meth:`._shared_noise.SharedNoise.subtract`."""
        left_over = np.zeros(r.size)
        left_over[self._followed] = self.inversion.left_over(self._cells, self._memory, self._followed)
        return self._shared_noise.subtract(dt, r, known, self._sleep.awake, left_over)

    def _begin(self, cells: Records[CellState], memory: Records[Record], places: IntArray, r: FloatArray) -> None:
        """Set the states of cells whose reading has been ``r`` (k,) for ever."""
        smoothing.begin(cells, places, r)
        cells["amplitude"][places] = 1.0
        self.inversion.begin(cells, memory, places, r)

    def _start(self, r: FloatArray, known: BoolArray | None) -> None:
        """Begin cells with their first reading, as if the load had been held for ever."""
        new = np.flatnonzero(~self._read if known is None else ~self._read & known)
        self._begin(self._cells, self._memory, new, r[new])
        if self._memory.dtype.names and self.inversion.remembers:  # earlier loads matter to this inversion
            self._gaps.doubt(new, UNKNOWN_PAST * np.abs(self._cells["pressure_kpa"][new]))
        self._sleep.mean[new] = r[new]
        self._read[new] = self._sleep.awake[new] = self._stale = True
        self._all_read = bool(self._read.all())

    def _choose(self, known: BoolArray | None) -> None:
        """Choose the cells to follow: those that are awake and have been read.

        A cell that is not read keeps its pressure. If its reading had just jumped, it keeps the pressure from before
        the jump. When the cell is read again, its memory is advanced as if the load had been held.
        """
        wanted = self._sleep.awake.copy() if known is None else self._sleep.awake & known
        if known is not None or self._gaps.open:
            self._part(wanted)
        self._wanted, self._followed, self._stale = wanted, wanted.nonzero()[0], False
        self._deviation.wake(self._sleep.awake)

    def _part(self, wanted: BoolArray) -> None:
        """Update the states where reading resumes (as if the load had been held) and where it stops (undo jumps)."""
        lost = (self._wanted & ~wanted).nonzero()[0]
        if lost.size:
            undone = self._sparks.undo(lost, self._cells, self._memory)
            self._pressure[undone] = self._cells["pressure_kpa"][undone]
            smoothing.interrupt(self._cells, lost)
        unread_s = self._gaps.unread_s
        back = (wanted & (unread_s > 0)).nonzero()[0]
        if back.size:
            self.inversion.hold(self._cells, self._memory, back, unread_s[back])

    def _follow(self, dt: float, r: FloatArray) -> None:
        """Take the readings ``r`` (n,) of the cells that are followed, and write their pressures."""
        cells, memory, places, inversion = self._cells, self._memory, self._followed, self.inversion
        usual_s = self._usual_s or dt
        if abs(usual_s - self._tremor_for_s) > UNUSUAL * self._tremor_for_s:
            self._tremor_for_s = usual_s
        if inversion.exact:
            smoothing.take_exactly_each.unchecked(cells, places, r)
            inversion.advance(cells, memory, places, dt)
            self._deviation.show(cells, places, self._pressure)
            return
        smoothing.take_each.unchecked(cells, places, r, self._noise.at_rest)
        if self._sparks.places.size:
            self._sparks.put_back(cells, memory, dt)
        gains = smoothing.gains_for(self._noise.typical / inversion.full_scale_r, dt)
        if smoothing.smooth_each.unchecked(cells, places, self._noise.cells, dt, gains, self._sparks.large_r):
            self._sparks.remember(cells, memory, places, (self._noise.reading(1), self._noise.reading(2)))
        if self._sparks.places.size:
            self._sparks.recognise_taps(cells, dt, r, self._noise.at_rest)
        inversion.advance(cells, memory, places, dt)
        if self._sparks.places.size:
            tremor.accept(cells, self._sparks.taps(cells))
        self._look_back(dt)
        if self._frames % RECENT == 0:
            self._look_for_tremor(ends_window=self._frames % WINDOW == 0)
        self._deviation.show(cells, places, self._pressure)

    def _look_back(self, dt: float) -> None:
        """Call ``check_means`` and ``correct_tremor`` of the inversion when they are due."""
        inversion, states = self.inversion, (self._cells, self._memory, self._followed)
        if inversion.means_every and self._frames % inversion.means_every == 0:
            inversion.check_means(*states, dt, self._noise.mean_of_recent(self._followed, inversion.means_every))
        every = inversion.tremor_every(self._tremor_for_s)
        if every and self._frames % every == 0:
            inversion.correct_tremor(*states, self._tremor_for_s, self._noise.mean_of_recent(self._followed, every))

    def _look_for_tremor(self, *, ends_window: bool) -> None:
        """Doubt the rise of cells whose load oscillates within the noise."""
        cells, places = self._cells, self._followed
        beside = self._noise.beside_parabola(places)
        tremor.look_each.unchecked(cells, places, beside)
        if ends_window:
            missed_kpa = np.empty(places.size)
            if tremor.end_window_each.unchecked(cells, places, self.inversion.seeming, beside, missed_kpa):
                self.inversion.doubt_rises(cells, self._memory, places, missed_kpa)

    def _end_gaps(self, dt: float, known: BoolArray | None, before: FloatArray) -> None:
        """Count the time without readings, and add the doubt of gaps that end; ``before`` (n,) kPa: the last frame."""
        ended = self._gaps.advance(dt, self._usual_s or dt, known)
        if self.inversion.remembers and ended.any():
            whole = np.abs(self._reading) * (self.inversion.full_scale_kpa / self.inversion.full_scale_r)
            change = np.abs(np.nan_to_num(self._pressure - before))  # NaN before the first reading
            self._gaps.doubt_memory(ended, whole, change)

    def _rest(self) -> None:
        """Put cells to sleep whose readings and memory are those of rest."""
        places = self._followed
        calm = places[self._sleep.calm(self._cells, places, self._noise.at_rest)]
        if calm.size:
            self._put_to_sleep(calm[self.inversion.settled(self._cells, self._memory, calm, self._sleep.band)])
        self._watch_over()

    def _put_to_sleep(self, places: IntArray) -> None:
        self._sparks.forget(self._cells, places)
        self._cells[places], self._memory[places] = self._at_rest
        self._pressure[places] = 0.0  # the calibration curve may differ from 0 there by some percent
        self._sleep.begin(places)
        self._noise.cells["on_line"][places] = np.inf  # without a line there is no edge
        self._stale = True
        self._shared_noise.sleep(places, self._sleep.mean[places])

    def _watch_over(self) -> None:
        """Update the thresholds at which sleeping cells wake, and their variances."""
        asleep = np.flatnonzero(~self._sleep.awake & self._read)
        if asleep.size:
            noise = self._sleep.renew(asleep, self._noise.at_rest)
            self._deviation.renew(asleep, noise)

    def _shown(self) -> FloatArray:
        """(shape) pressure in kPa."""
        pressure = self._pressure.copy()
        if self._sparks.places.size:
            self._sparks.hide(self._cells, pressure)
        shown: FloatArray = pressure.reshape(self.shape)
        return shown

    # -- saving ------------------------------------------------------------------------------------------------------

    @property
    def _parts(self) -> tuple[NoiseMeter, SharedNoise, Sleep, Deviation, Gaps, Held, Sparks]:
        """Those that have a state of their own."""
        noise, shared = self._noise, self._shared_noise
        return noise, shared, self._sleep, self._deviation, self._gaps, self._held, self._sparks

    def state(self) -> dict[str, FloatArray]:
        """A copy of the whole state, for :meth:`restore`: float64 arrays by name."""
        own = {"cells": values(self._cells), "memory": values(self._memory), "pressure": self._pressure}
        own |= {"read": self._read, "followed": self._wanted}
        own["clock"] = np.array([self._usual_s, self._tremor_for_s, self._frames])
        for part in self._parts:
            own |= part.state()
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
        values(self._cells)[...], values(self._memory)[...] = given["cells"], given["memory"]
        self._pressure, self._read, self._wanted = given["pressure"], given["read"] > 0, given["followed"] > 0
        self._followed, self._all_read, self._stale = self._wanted.nonzero()[0], bool(self._read.all()), True
        self._usual_s, self._tremor_for_s, frames = given["clock"].tolist()
        self._frames = int(frames)
        for part in self._parts:
            part.restore(given)
