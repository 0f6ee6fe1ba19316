"""The paper's cell inverted by two hypotheses about when the pressure last turned (multiple-model estimation).

The paper's cell has two linear models, one for a rising load and one for recovery, and changes from one to the other
where the pressure turns (changes its direction). Inverting either model is algebra (:mod:`._paper_steps`); the hard
question is which model holds. This module has the order of a frame and the interface to the estimator. Each question
has a module of its own, with array operations and loops side by side (``docs/design.md``, "Inside an estimator"). In
every frame, in this order:

==================  =================================================================================
:mod:`._limits`     limits of the pressure and of the memory of both hypotheses
:mod:`._turns`      whether the pressure has turned, and whether an earlier turn was a false alarm
:mod:`._takeover`   the change to the other hypothesis at a turn, and the error that the turn leaves
:mod:`._doubts`     restarts of the other hypothesis; the distance of both as standard deviation
:mod:`._earlier`    a third hypothesis: that the load turned earlier
==================  =================================================================================

And every few frames, from the mean of the readings since the last time (:data:`..estimation.RECENT` readings, or
:func:`._sway.readings`):

==================  =================================================================================
:mod:`._recovery`   whether a released cell bears no load; if so, corrects its memory
:mod:`._released`   whether a load has been released within the noise
:mod:`._still`      whether a load that seems to grow is only the recovery after a light touch
:mod:`._onset`      whether a load has begun to rise while the cell recovers
:mod:`._sway`       the error that loads leave which go to and fro within the noise
==================  =================================================================================

The constants that the modules of a frame need are in one row; each module names its places in that row.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Loop
from ..estimation import (
    DOUBTED_LOAD,
    FAR,
    GAIN,
    LIGHT_LOAD,
    PRESSURE,
    REST_VARIANCE,
    RESTED,
    VARIANCE,
    WINDOW,
    Inversion,
    RecentReadings,
    credible_readings,
)
from ..materials import ByStep, PaperModel, lag
from . import _doubts as doubts
from . import _earlier as earlier
from . import _limits as limits
from . import _onset as onset
from . import _recovery as recovery
from . import _released as released
from . import _still as still
from . import _sway as sway
from . import _takeover as takeover
from . import _turning_loops as loops
from . import _turns as turns
from ._paper_steps import Constants, TurnWeights, fast_r, numbered, step_weights, taken_over, turn_weights
from ._turning_rows import (
    BEFORE_LAST,
    EXTREME,
    FORGOTTEN_KPA,
    HYPOTHESES,
    IN_FORCE,
    LAST,
    LEFT,
    PEAK,
    RECENT_EXTREME,
    RISING_IN_FORCE,
    SIGN,
    STATE,
    SURE,
    THIRD_LAST,
    TURNED,
    UNDITHERED,
    Beside,
    MemoryRows,
    take_each,
    take_gains_each,
)

UNSEEN = 1.5
"""standard deviations of a reading: a load may go to and fro by so much in a frame without being noticed"""


class TurningInversion(Inversion):
    """The exact inverse of the paper's cell, changed from one model to the other where the *pressure* turns.

    The paper goes by the sign of dr/dt. That sign misreads slow ramps and quick presses, since the resistance also
    falls while a load is held. We ask the model in force instead: has the pressure by its own inverse gone back? Noise
    delays the answer. Two hypotheses are therefore followed at the same time: that the model in force still holds, and
    that the pressure turned where it was last near its extreme. When the pressure of the first hypothesis has gone back
    from the extreme by more than noise explains, the second hypothesis is put in force (taken over). It has followed
    the load all the time, so that the delay loses nothing.

    Errors cannot add up without limit. The pressure is limited to ``LOADS``, the memory follows the limited pressure,
    and a memory that would need a negative pressure is corrected to the one that the reading implies at no load.

    Within a step both hypotheses are linear in their memory and in the reading, so that a step of both is one matrix
    product.
    """

    rows = (
        *("pressure", "gain", "variance", "last", "before_last", "third_last"),
        *("turned", "sign", "extreme", "peak", "left_extreme", "is_rising", "is_recovery", *HYPOTHESES),
        *("rest_variance", "rested", "drift", "drift_end", "taken_off"),
        *("earlier", "earlier_least", "earlier_from"),
        *still.NAMES,
        *("recent_extreme", "forgotten", "undithered"),
        *onset.NAMES,
        *sway.NAMES,
        *("released", "taken_before"),
        *released.NAMES,
    )
    recovers = True

    def __init__(self, model: PaperModel, full_scale_kpa: float, *, exact: bool) -> None:
        self.model = model
        rise_r, _ = fast_r(model)
        full_r = model.gain_per_kpa * full_scale_kpa
        super().__init__(full_scale_kpa, full_r, credible=credible_readings(full_scale_kpa * rise_r), exact=exact)
        self._weights = ByStep(turn_weights, model)
        self._taken_over = taken_over(model)
        self._to_hold = np.array([1 / model.e2_kpa, 1 / model.e3_kpa, model.eu1_kpa, model.etau2_kpa, model.e1_kpa])
        self._begin_gain = float(step_weights(model, 0.01).gain[0])
        self._of = MemoryRows(np.zeros((len(self.rows), 0)))
        self._beside = Beside(self._of.memory)
        self._numbers = self._numbers_of(steps=0.0, own=0.0)
        # Constants as arrays: NumPy makes an array of a float in every call, which takes as long as a small operation.
        self._none, self._far, self._two, self._sure = (np.array(x) for x in (0.0, FAR, 2.0, SURE))
        bend = float(self._numbers.row[takeover.BEND])
        self._missed_by_bend = np.array(takeover.BETWEEN * bend)
        self.bends = takeover.BETWEEN * bend, SURE
        self.seeming = WINDOW * UNSEEN * bend
        self.steepness_kpa = np.array([1 / rise_r, model.e1_kpa])
        self.rests = recovery.RESTED_SIGMAS**2
        self._rests, self._light_load_kpa2 = np.array(self.rests), np.array((LIGHT_LOAD * full_scale_kpa) ** 2)
        self._light_load_kpa = np.array(LIGHT_LOAD * full_scale_kpa)
        self._doubted_load_kpa2 = np.array((DOUBTED_LOAD * full_scale_kpa) ** 2)
        self._recovery = ByStep(recovery.constants, model)
        self._still = ByStep(still.constants, model)
        self._released = ByStep(partial(released.constants, full_scale_kpa=full_scale_kpa), model)
        self._onset = ByStep(onset.constants, model)
        self._sway = ByStep(partial(sway.constants, full_scale_kpa=full_scale_kpa), model)

    def _numbers_of(self, steps: float, own: float) -> Constants:
        """The constants of all modules; ``steps`` and ``own``: :data:`._turns.STEPS` and :data:`._turns.OWN_STEPS`."""
        of = self.model, self.full_scale_kpa
        parts = (
            *(limits.numbers_of(*of), turns.numbers_of(*of, exact=self.exact, steps=(steps, own))),
            *(earlier.numbers_of(*of), takeover.numbers_of(*of), doubts.numbers_of(self.full_scale_kpa)),
        )
        return numbered({place: number for part in parts for place, number in part.items()})

    def take_steps(self, std: float, own: float) -> None:
        """As :meth:`.Inversion.take_steps`: ADC steps may look like the fall of a held load (:data:`._turns.STILL`)."""
        self._numbers = self._numbers_of(std, own)

    def held_kpa(self, r: FloatArray) -> FloatArray:
        return r / self.model.gain_per_kpa

    def begin(self, r: FloatArray) -> FloatArray:
        m, p = self.model, self.held_kpa(r)
        memory = np.zeros((len(self.rows), *r.shape))
        memory[PRESSURE], memory[GAIN], memory[SIGN], memory[LEFT] = p, self._begin_gain, 1.0, FAR
        memory[[EXTREME, PEAK, RECENT_EXTREME]] = memory[LAST : THIRD_LAST + 1] = p
        memory[RISING_IN_FORCE] = memory[UNDITHERED] = 1.0
        sway.begin(memory, r)
        still.begin(memory)
        memory[STATE] = [p, p, p, p / m.e2_kpa, p / m.e3_kpa, p / m.e3_kpa, r]
        return memory

    def advance(
        self, memory: FloatArray, dt_s: float, r: FloatArray, std: FloatArray, doubt: Callable[[], FloatArray]
    ) -> FloatArray:
        w, numbers = self._weights.of(dt_s), self._numbers.each
        of = self._of
        if memory is not of.memory:
            of = self._of = MemoryRows(memory)
        of.take(r)
        w.step.dot(of.state, of.change)
        of.hypotheses[...] = of.change
        limits.limit(of, w, numbers)
        unconfirmed = self._take_turns(of, std, w)
        if not self.exact and of.pressure.item(of.pressure.argmin()) < numbers[limits.PULLED_KPA].item():
            limits.correct(of, std, doubt(), w, numbers)
        held_kpa = doubts.held_kpa(dt_s, self.full_scale_kpa)
        doubts.begin_anew(of, self._taken_over, held_kpa, numbers, unconfirmed=unconfirmed)
        doubts.renew_variance(of, held_kpa, numbers, unconfirmed=unconfirmed)
        return memory

    def _take_turns(self, of: MemoryRows, std: FloatArray, weights: TurnWeights) -> bool:
        """Take over the other hypothesis where the pressure has turned, and confirm earlier turns.

        Returns:
            Whether any turn is or was unconfirmed. If so, ``of.confirmed`` marks those that have just been confirmed.
        """
        numbers = self._numbers.each
        of.take_gains(weights)
        earlier.fade(of, weights)
        turns.look(of, std, numbers)
        turned = turns.gone_back(of, numbers)
        unconfirmed = bool(of.left.item(of.left.argmin()) < FAR)
        if unconfirmed:
            # Back at the extreme that was left: the turn was noise.
            back, noise = turns.other_gone_back(of, std)
            turned |= np.less(back, noise, of.held)
        refuted = of.none
        if unconfirmed or np.count_nonzero(turned):
            refuted = turns.refuted(of, turned, std, weights, numbers)
        np.copyto(turned, of.sign > self._none, where=refuted)
        if np.count_nonzero(turned):
            takeover.take_over(of.memory, turned.nonzero()[0], std, weights, numbers)
            of.take_gains(weights, anew=True)
            turns.look(of, std, numbers)
            unconfirmed = True
            back, noise = turns.other_gone_back(of, std)
        if np.count_nonzero(refuted):
            turns.begin_at_refuted(of, refuted)
        if unconfirmed:
            turns.confirm(of, back, noise, numbers)
        return unconfirmed

    def loops_used(self) -> tuple[Loop[..., Any], ...]:
        return (
            *loops.ALL,
            turns.look_at_steps_each,
            *recovery.LOOPS,
            *released.LOOPS,
            *still.LOOPS,
            *onset.LOOPS,
            *sway.LOOPS,
        )

    def advance_compiled(self, memory: FloatArray, taken: FloatArray, line: FloatArray, dt_s: float) -> FloatArray:
        w, of, numbers = self._weights.of(dt_s), self._beside, self._numbers.row
        if memory is not of.memory:
            of = self._beside = Beside(memory)
        take_each.unchecked(memory, taken)
        w.step.dot(of.state, of.change)
        if w is not of.weights:
            take_gains_each.unchecked(memory, w.by_model, of.rows)
            of.weights = w
        beside = of.change, taken, w.by_model, of.rows, of.flags, numbers
        found = loops.step_and_turn.unchecked(memory, *beside, False)
        if found & loops.BEYOND:
            limits.limit_each.unchecked(memory, w.ramp, numbers)
            found = loops.step_and_turn.unchecked(memory, *beside, True)
        if found & loops.PULLED:
            limits.correct_each.unchecked(memory, taken, w.by_model, numbers)
        self._taken_over.dot(of.state, of.change)
        held_kpa, unconfirmed = doubts.held_kpa(dt_s, self.full_scale_kpa), found & loops.UNCONFIRMED > 0
        doubts.begin_anew_each.unchecked(memory, of.change, of.rows, of.flags, held_kpa, unconfirmed, numbers)
        return memory

    def recover(self, memory: FloatArray, recent: RecentReadings) -> None:
        """Answer the questions that need means of readings, in the order of the list above."""
        dt_s, mean, noise, count, _ = recent
        turns.look_at_steps(memory, noise, self._numbers.each)
        recovery.look(memory, mean, noise, count, self._recovery.of(dt_s).each)
        released.look(memory, mean, noise, self._released.of(dt_s).each)
        still.look(memory, mean, noise, self.full_scale_kpa, self._still.of(dt_s).each)
        onset.look(memory, mean, noise, self.full_scale_kpa, self._onset.of(dt_s).each)

    def recover_compiled(self, memory: FloatArray, recent: RecentReadings) -> None:
        """:meth:`recover` by loops."""
        dt_s, mean, noise, count, _ = recent
        turns.look_at_steps_each.unchecked(memory, noise, self._numbers.row)
        recovery.look_each.unchecked(memory, mean, noise, count, self._recovery.of(dt_s).row)
        released.look_each.unchecked(memory, mean, noise, self._released.of(dt_s).row)
        still.look_each.unchecked(memory, mean, noise, self.full_scale_kpa, self._still.of(dt_s).row)
        onset.look_each.unchecked(memory, mean, noise, self.full_scale_kpa, self._onset.of(dt_s).row)

    def sways_in(self, dt_s: float) -> int:
        return sway.readings(dt_s)

    def sway(self, memory: FloatArray, recent: RecentReadings) -> None:
        dt_s, mean, noise, _, near = recent
        sway.look(memory, mean, noise, self._numbers.row[turns.STEPS], near, self._sway.of(dt_s))

    def sway_compiled(self, memory: FloatArray, recent: RecentReadings) -> None:
        """:meth:`sway` by loops."""
        dt_s, mean, noise, _, near = recent
        of = self._sway.of(dt_s)
        seen = np.empty((sway.SEEN, mean.size))
        sway.look_each.unchecked(memory, mean, noise, self._numbers.row[turns.STEPS], near, of.row, of.way.rows, seen)

    def released(self, memory: FloatArray) -> BoolArray | None:
        released: BoolArray = memory[SIGN] < self._none
        released |= memory[LEFT] < self._far
        return released if np.count_nonzero(released) else None

    def hides_kpa2(self, memory: FloatArray, noise_kpa: FloatArray) -> FloatArray:
        """A released cell shows a pressure only if it differs from rest by more than noise and the memory's error.

        Low noise now does not help: the error of the memory comes from the noise of all taps so far.
        """
        noise_kpa2 = noise_kpa * noise_kpa
        rests = noise_kpa2 + memory[REST_VARIANCE]
        rests *= self._rests
        hides = super().hides_kpa2(memory, noise_kpa)
        light = np.minimum(rests, self._light_load_kpa2)
        np.maximum(hides, light, out=light)
        released = memory[SIGN] < self._none
        doubted = memory[LEFT] < self._far
        doubted &= ~released
        if np.count_nonzero(doubted):
            noise_kpa2 += memory[TURNED]
            noise_kpa2 *= self._rests
            # The rise is in doubt. A load that was clearly shown before the rise is not.
            loaded = memory[LEFT] < noise_kpa * -recovery.RESTED_SIGMAS - self._light_load_kpa
            np.minimum(noise_kpa2, np.where(loaded, self._light_load_kpa2, self._doubted_load_kpa2), out=noise_kpa2)
            np.maximum(hides, noise_kpa2, out=hides, where=doubted)
        np.copyto(hides, light, where=released)
        released &= (memory[RESTED] > self._none) | (memory[PRESSURE] < self._none)
        np.copyto(hides, rests, where=released)
        return hides

    def miss(self, memory: FloatArray, rise_kpa: FloatArray) -> None:
        """A load that goes to and fro within the noise seems to rise: r goes up by one model and down, by less, by the
        other."""
        before = memory[TURNED]
        after = np.minimum((np.sqrt(before) + rise_kpa) ** 2, self._numbers.each[limits.MOST_LOST_KPA2])
        memory[VARIANCE] += after - before
        memory[TURNED] = after

    def within_frame(self, memory: FloatArray, noise_kpa: FloatArray) -> FloatArray:
        """A load whose rate has changed may have turned within the frame: no reading shows the turn yet."""
        bend: FloatArray = memory[LAST] * self._two
        np.subtract(memory[PRESSURE], bend, out=bend)
        bend += memory[BEFORE_LAST]
        np.abs(bend, out=bend)
        bend -= noise_kpa * self._sure
        np.maximum(bend, self._none, out=bend)
        bend *= self._missed_by_bend
        bend *= memory[GAIN]
        bend *= bend
        return bend

    def hold(self, memory: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        m = self.model
        gone = lag.forgotten(dt_s, np.array([[m.tu_s], [m.t2_s], [m.t3_s], [m.t3_s]]))
        held = memory.copy()
        state = held[STATE]
        # Hypotheses that agreed before the gap agree after it, too.
        apart = state[0] != state[1]
        pressures = state[[0, 1, 0, 1]] * np.array([[1.0], [1 / m.e2_kpa], [1 / m.e3_kpa], [1 / m.e3_kpa]])
        state[2:6] += (pressures - state[2:6]) * gone
        settled, x2, _, x3 = state[2:6]
        rising = state[0] / m.eu1_kpa + (state[0] - settled) / m.etau2_kpa
        state[6] = np.where(held[SIGN] > 0, rising, state[1] / m.e1_kpa + x2 + x3)
        share = np.where(apart, 0.0, held[IN_FORCE][::-1])
        state[:6] += (self._taken_over @ state) * np.tile(share, (3, 1))
        still.hold(held, 1.0 - gone[1], 1.0 - gone[2])
        held[FORGOTTEN_KPA] = 0.0
        onset.begin_anew(held)
        sway.begin(held, state[6])
        return held

    def hold_compiled(self, memory: FloatArray, places: IntArray, dt_s: FloatArray) -> None:
        m = self.model
        gone = np.array([lag.forgotten(dt_s, time_constant_s) for time_constant_s in (m.tu_s, m.t2_s, m.t3_s, m.t3_s)])
        loops.hold_lags_each.unchecked(memory, places, gone, self._to_hold)
        loops.hold_each.unchecked(memory, places, gone, self._taken_over.dot(memory[STATE].take(places, axis=1)))

    @property
    def held_rows(self) -> IntArray:
        return np.delete(np.arange(len(self.rows)), sway.ROWS)

    def settled(self, memory: FloatArray, band: float) -> BoolArray:
        m = self.model
        kpa = 2 * band / m.gain_per_kpa
        off = np.abs(memory[PRESSURE]) < kpa
        _, _, settled, x2, _, x3 = memory[STATE][:6]
        unsettled = np.where(memory[SIGN] > 0, np.abs(settled) / m.etau2_kpa, np.abs(x2) + np.abs(x3))
        found: BoolArray = off & (unsettled < band)
        return found
