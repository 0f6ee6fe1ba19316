"""The paper's cell inverted by two hypotheses about when the pressure last turned (multiple-model estimation).

The paper's cell has two linear models and changes from one to the other where the pressure turns. Inverting either is
algebra (:mod:`._paper_steps`). What is hard is to know which model holds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ...arrays import BoolArray, FloatArray, IntArray
from ...compiled import Loop
from ..estimation import (
    DOUBT,
    DOUBTED_LOAD,
    FAR,
    GAIN,
    HIDDEN,
    LIGHT_LOAD,
    LOADS,
    PRESSURE,
    REST_VARIANCE,
    RESTED,
    SIGMAS,
    UNKNOWN,
    USUAL,
    VARIANCE,
    WINDOW,
    Inversion,
    credible_readings,
)
from ..materials import ByStep, PaperModel, lag
from . import _onset as onset
from . import _recovery as recovery
from . import _still as still
from . import _sway as sway
from . import _turning_loops as loops
from ._paper_steps import TurnWeights, step_weights, taken_over, turn_weights
from ._turning_loops import (
    BEFORE_LAST,
    EARLIER_FROM_KPA,
    EARLIER_KPA,
    EARLIEST_KPA,
    EXTREME,
    HIDDEN_SHARE,
    LAST,
    LEFT,
    LOOKS_AT_REST,
    MAY_BEAR_KPA,
    PEAK,
    RECENT_EXTREME,
    REFUTED,
    SETTLES,
    SIGN,
    TAKEN_OFF_KPA,
    THIRD_LAST,
    TURNED,
)
from ._turning_rows import (
    CONFIRMED_FALL,
    CONFIRMED_RISE,
    HYPOTHESES,
    IN_FORCE,
    RECOVERY,
    RISING,
    STATE,
    SURE,
    Beside,
    Rows,
)

TURN, LIGHT_TURN, TURN_SHARE = 0.01, 0.002, 0.02
"""how far a pressure that is known exactly must have gone back for a turn: the second of full scale and the third of
the extreme, but no more than the first of full scale. Errors of the memory grow with the load, and look like turns as
they fade. Near none, a larger limit would miss light taps, and the paper's cell keeps a part of each that is missed"""
EXACTLY, NEAR, ROUND = 1e-9, 1e-3, 2e-3
"""of full scale: rounding; a pressure that is as good as none; and an error of the pressure at a slow turn, which is
noticed late"""
FAST = 2.0
"""turns by which the pressure changes in the frame of a turn, from which the turn is noticed at once"""
EITHER = 0.5
"""standard deviation over the difference of the two hypotheses: either may be right until the pressure has turned"""
BETWEEN = 0.3
"""of the way of a load in a frame: how far beyond the frames it turned. Between none and half; the root mean square"""
HALF = 0.5
"""of the way of the frame before: no less counts in the frame of a turn, since to and fro may leave a small way"""
JUST_BEGUN = 3.0
"""times the way of a frame: how far a load may go in a frame, since it may have begun to move in the midst of the one
before"""
MOST_LOST = 1.0
"""of full scale: no larger standard deviation is stated for turns that were not noticed"""
UNSEEN = 1.5
"""standard deviations of a reading within which a load may go to and fro in a frame unseen"""
LOST, GONE = 1.5, 0.7
"""standard deviations of the smoothed noise by which the hypotheses must have been apart for a doubt to stay, and the
share of the variance that a new beginning takes away"""
LESS = 2.0
"""standard deviations of the smoothed noise by which an extreme counts for less. The largest of many readings is too
large by about as many; with more, the end of a tap of few frames would be missed"""
PULL_SIGMAS = 0.7
"""standard deviations of the reading below none, from which a pressure is an error of the memory. They include what the
smoothing has not noticed: its line overshoots for a moment where a fast release ends"""
STILL = 1.5
"""standard deviations of the reading by which a load that seems to have fallen must be above none. Such a fall may be
steps of the ADC, of any reading that the resistance follows from; most loads that fall are released"""
SMOOTH, AWAY = 0.4, 0.02
"""turns by which a pressure may be unsure where the delay of a smooth turn is told; in more noise it cannot be. And of
full scale by which the extreme must differ from none, where pressures that are too low have been corrected already"""
MAY_BEND = 0.5
"""standard deviation of what such a delay makes, over that: the load may have turned with a bend after all"""
SHARED, CLEAR_RISE = 0.2, 0.05
"""share of a rise by which the recovery model must have risen, too, or else the rise is refuted; and how large, of full
scale, a rise must be to be refuted. Where a cell recovers under a light hold, the rising model takes the recovery for a
load that grows, while the recovery model is almost constant. A press raises both models by about as much. A press of
some seconds that begins while the cell recovers raises them less alike: a share of 0.5 would refute some of these"""
SHARED_FALL, CLEAR_FALL = 0.3, 0.02
"""share of a fall of the recovery model, as the rising model answers it, up to which a fall of the rising model may be
an error of its memory that fades, or a line that overshot; and the fall, of full scale, from which this is so. Where
much is remembered, the resistance under a load that is held falls so fast that the recovery model takes it for a
release, while the rising model is almost constant. A release takes both models back"""
FALLING = 6.0
"""standard deviations of the smoothed noise by which a pressure that goes back in three frames is that of a load that
falls, whatever the share: smooth loads of little noise turn so. By as many, and :data:`LIGHT_TURN`, a pressure must
have gone back from a recent extreme for a turn"""
CREEP = 0.003
"""of full scale: what a recent extreme fades by in a second, beside what an error of two standard deviations of the
memory fades by. A load that goes back faster has turned, however large it is: holds by a hand waver by less than what
makes a turn otherwise"""
FLAT, HELD = 0.003, 0.03
"""of full scale: by how much a pressure that is held may seem to go back, and by how much in a second. A load that goes
back faster has turned: the other hypothesis began at its extreme, and is not to begin again later"""
GOES_BACK = 6.0
"""standard deviations of the memory, at most a turn, per share of its variance that fades in a frame, by which the peak
goes down. As an error of the memory fades, the pressure of a load that is held seems to go back"""
AGAIN = 0.5
"""share by which the other hypothesis begins anew at a frame, within one standard deviation of the extreme.
Beginning at every extreme would take noise for part of the press, beginning late would miss some of the release; half
and half, the two errors about cancel"""
_LIMITED = *range(STATE.start, STATE.stop), TURNED, EXTREME
"""rows that change where a pressure is limited"""

EARLIER, MIDWAY = 0.7, 0.5
"""standard deviation over what an earlier turn would make: none of that is wrong, or all (the root mean square). And
share of it that is taken back when a turn is noticed"""
GROWN, GROWN_SIGMAS, GROWN_ERRORS, FALLEN = 0.5, 1.5, 0.2, 2.0
"""light turns, standard deviations of the smoothed noise, and of the memory, by which the pressure must have grown for
an earlier turn to be as likely as none; and how much more a fall counts than growth. Constant loads are common. A load
that falls at just the rate that makes the rising model's pressure constant is not"""
GROWN_RELEASED = 1.5
"""the third of these in recovery: errors of the memory are largest there, and fade"""


class TurningInversion(Inversion):
    """The exact inverse of the paper's cell, changed from one model to the other where the *pressure* turns.

    The sign of dr/dt, by which the paper goes, misreads slow ramps and quick presses: the resistance also falls while a
    load is held. Whether the pressure turned can be asked of the model in force, whose own inverse then goes back.
    Noise delays the answer. Two hypotheses are therefore followed at the same time: that the model in force still
    holds, and that the pressure turned where it was last near its extreme. When the first one's pressure has gone back
    from the extreme by more than noise does, the second one is taken over, and nothing is lost by the delay.

    Nothing can add up: the pressure is limited to ``LOADS``, the memory follows the limited pressure, and a memory that
    would need a negative pressure is corrected to what the reading says at none.

    Within a step both hypotheses are linear in what they remember and in the reading. A step of both is therefore one
    matrix product. ``tests/turning.py`` writes the same estimator out for one cell.
    """

    rows = (
        *("pressure", "gain", "variance", "last", "before_last", "third_last"),
        *("turned", "sign", "extreme", "peak", "left_extreme", "is_rising", "is_recovery", *HYPOTHESES),
        *("rest_variance", "rested", "drift", "drift_end", "taken_off"),
        *sway.NAMES,
        *("earlier", "earlier_least", "earlier_from"),
        *still.NAMES,
        "recent_extreme",
        *onset.NAMES,
    )
    recovers = True

    def __init__(self, model: PaperModel, full_scale_kpa: float, *, exact: bool) -> None:
        self.model = model
        credible = credible_readings(full_scale_kpa * (1 / model.eu1_kpa + 1 / model.etau2_kpa))
        full_r = model.gain_per_kpa * full_scale_kpa
        self._weights = ByStep(turn_weights, model)
        self._taken_over = taken_over(model)
        self._bend = 1 / model.eu1_kpa + 1 / model.etau2_kpa - 1 / model.e1_kpa
        """r per kPa by which the answer to a fast rise exceeds that to a fast fall"""
        self._left = np.array(1.0 - GONE)
        self._clear_kpa2 = self._left * (NEAR * full_scale_kpa) ** 2
        self._lost_at_most_kpa2 = (MOST_LOST * full_scale_kpa) ** 2
        self._begin_gain = float(step_weights(model, 0.01).gain[0])
        self._most_kpa2 = np.array((UNKNOWN * full_scale_kpa) ** 2)
        """variance of a load of which nothing is known but that it is no more than usual"""
        self._lowest, self._highest = LOADS[0] * full_scale_kpa, LOADS[1] * full_scale_kpa
        self._usual = USUAL * full_scale_kpa
        self._of = Rows(np.zeros((len(self.rows), 0)))
        self._beside = Beside(self._of.memory)
        super().__init__(full_scale_kpa, full_r, credible=credible, exact=exact)
        self.bends = BETWEEN * self._bend, SURE
        self.seeming = WINDOW * UNSEEN * self._bend
        # Constants as arrays: NumPy makes an array of a float in every call, which takes as long as a small operation.
        self._sure, self._less, self._again, self._either, self._far = (
            np.array(x) for x in (SURE, LESS, AGAIN, EITHER, FAR)
        )
        self._none, self._one, self._two = np.array(0.0), np.array(1.0), np.array(2.0)
        self._goes_back, self._by_earlier, self._per_less = (np.array(x) for x in (GOES_BACK, EARLIER, 1.0 / LESS))
        self._missed_by_bend = np.array(BETWEEN * self._bend)
        self._turn_kpa, self._light_kpa, self._flat_kpa, self._exact_kpa = (
            np.array(share * full_scale_kpa) for share in (TURN, LIGHT_TURN, FLAT, EXACTLY)
        )
        self._turn_share, self._shared = np.array(TURN_SHARE), np.array(SHARED)
        self._clear_rise_kpa = CLEAR_RISE * full_scale_kpa
        self._fast_r = np.array([[1 / model.eu1_kpa + 1 / model.etau2_kpa], [1 / model.e1_kpa]])
        """r per kPa of a fast change, in the rising and in the recovery model"""
        self._shared_by_fast = np.array(self._fast_r[1, 0] / self._fast_r[0, 0])
        """pressure of the rising model after a fast change, over that of the recovery model"""
        self._shared_fall = np.array(SHARED_FALL * self._fast_r[1, 0] / self._fast_r[0, 0])
        self._bend_ratio = float(self._fast_r[0, 0] / self._fast_r[1, 0])
        """of r answers to a fast rise and to a fast fall"""
        self._grown_kpa = np.array(GROWN * LIGHT_TURN * full_scale_kpa)
        self._clear_fall_kpa, self._falling = np.array(CLEAR_FALL * full_scale_kpa), np.array(FALLING)
        self._held_kpa_per_s, self._creeps = HELD * full_scale_kpa, CREEP / (3.0 * HELD)
        self._smooth_kpa, self._away_kpa = SMOOTH * self._turn_kpa, np.array(AWAY * full_scale_kpa)
        # What is below zero is an error that fades, and no turn.
        self._least_kpa = np.array(self._lowest if self.exact else 0.0)
        self.steepness_kpa = np.array([1 / (1 / model.eu1_kpa + 1 / model.etau2_kpa), model.e1_kpa])
        self.rests = recovery.RESTED_SIGMAS**2
        self._rests, self._light_load_kpa2 = np.array(self.rests), np.array((LIGHT_LOAD * full_scale_kpa) ** 2)
        self._doubted_load_kpa2 = np.array((DOUBTED_LOAD * full_scale_kpa) ** 2)
        self._recovery = ByStep(recovery.constants, model)
        self._still = ByStep(still.constants, model)
        self._onset = ByStep(onset.constants, model)
        self._kept_kpa = sway.kpa_kept(model)
        self._fast_kpa, self._round_kpa = np.array(FAST * TURN * full_scale_kpa), np.array(ROUND * full_scale_kpa)
        self._most_rested_kpa2 = np.array((recovery.MOST * full_scale_kpa) ** 2)
        self._steps = 0.0
        self._turns = self._numbers_of_turns()

    def take_steps(self, std: float) -> None:
        """As :meth:`.Inversion.take_steps`: for falls of loads that are held, see :data:`STILL`."""
        self._steps = self._turns[loops.STEPS] = std

    def begin(self, r: FloatArray) -> FloatArray:
        m = self.model
        p = r / m.gain_per_kpa
        memory = np.zeros((len(self.rows), *r.shape))
        memory[PRESSURE], memory[GAIN], memory[SIGN], memory[LEFT] = p, self._begin_gain, 1.0, FAR
        memory[[EXTREME, PEAK, RECENT_EXTREME]] = memory[LAST : THIRD_LAST + 1] = p
        memory[IN_FORCE.start + RISING] = 1.0
        sway.begin(memory, r)
        still.begin(memory)
        memory[STATE] = [p, p, p, p / m.e2_kpa, p / m.e3_kpa, p / m.e3_kpa, r]
        return memory

    def advance(
        self, memory: FloatArray, dt_s: float, r: FloatArray, std: FloatArray, doubt: Callable[[], FloatArray]
    ) -> FloatArray:
        w = self._weights.of(dt_s)
        of = self._of
        if memory is not of.memory:
            of = self._of = Rows(memory)
        self._predict(of, r, w)
        unconfirmed = self._take_turns(of, std, w)
        if not self.exact and of.pressure.item(of.pressure.argmin()) < -NEAR * self.full_scale_kpa:
            self._correct(of, std, doubt(), w)
        held_kpa = self._held_kpa(dt_s)
        self._begin_anew(of, held_kpa, unconfirmed=unconfirmed)
        self._renew_variance(of, held_kpa, unconfirmed=unconfirmed)
        return memory

    def _predict(self, of: Rows, r: FloatArray, weights: TurnWeights) -> None:
        """Take both hypotheses to the readings ``r`` (m,)."""
        of.before[...] = of.until_before
        of.last[...] = of.pressure
        of.r[...] = r
        weights.step.dot(of.state, of.change)
        of.hypotheses[...] = of.change
        both = of.both
        if both.item(both.argmin()) < self._lowest or both.item(both.argmax()) > self._usual:
            self._limit(of.memory, weights)

    def _take_turns(self, of: Rows, std: FloatArray, weights: TurnWeights) -> bool:
        """Take over the other hypothesis where the pressure has turned, and confirm earlier turns.

        Returns:
            Whether a turn was unconfirmed before. Then ``of.confirmed`` marks those that no longer are.
        """
        of.take_gains(weights)
        rising_fade, recovery_fade = weights.fades
        of.earlier *= np.where(self._rose_before(of), recovery_fade, rising_fade)
        self._look(of, std)
        turned = self._gone_back_by_turn(of)
        unconfirmed = bool(of.left.item(of.left.argmin()) < FAR)
        if unconfirmed:
            # Back at the extreme that was left: the turn was noise.
            back, noise = self._gone_back(of, std)
            turned |= np.less(back, noise, of.held)
        refuted = self._refuted(of, turned, std, weights) if unconfirmed or np.count_nonzero(turned) else of.none
        np.copyto(turned, of.sign > self._none, where=refuted)
        if np.count_nonzero(turned):
            self._turn(of.memory, turned.nonzero()[0], std, weights)
            of.take_gains(weights, anew=True)
            self._look(of, std)
            unconfirmed = True
            back, noise = self._gone_back(of, std)
        if np.count_nonzero(refuted):
            np.copyto(of.peak, of.ahead - of.unsure, where=refuted)
            np.copyto(of.extreme, of.ahead - of.unsure * self._less, where=refuted)
            np.copyto(of.recent_extreme, of.extreme, where=refuted)
        if unconfirmed:
            # The pressure went back by what would be a turn in the model that was left, too: no noise does both.
            noise *= of.confirming_sigmas
            self._turn_from(of.left, of.nearby)
            of.nearby *= of.confirming_turns
            noise += of.nearby
            confirmed = np.greater_equal(back, noise, of.confirmed)
            confirmed &= of.left < self._far
            rise = np.add(of.left, of.rising_kpa, of.nearby)
            rise *= self._shared
            confirmed &= np.greater_equal(back, rise, of.held) | (of.sign < self._none)
            np.copyto(of.left, self._far, where=confirmed)
        return unconfirmed

    def _refuted(self, of: Rows, turned: BoolArray, std: FloatArray, weights: TurnWeights) -> BoolArray:
        """(m,) where a rise is refuted that has just ``turned`` the pressure (m,), or is not confirmed yet.

        The recovery model then does not share the rise (:data:`SHARED`). The largest of many noisy pressures makes a
        turn, so that the share seems larger than it is by :data:`LESS` deviations. The recovery model stays in force,
        or comes back into force, with all that it remembers. The rising model begins anew where the pressure is. By
        how much the two differed stays in the standard deviation.
        """
        taken = of.left < self._far
        refuted: BoolArray = taken | turned
        refuted &= taken == (of.sign > self._none)
        begun = np.where(taken, of.left, of.extreme)  # the pressure then, with its sign turned
        rise, shared = begun + of.rising_kpa, begun + of.recovery_kpa
        rising_gain, recovery_gain = weights.by_model[0]
        refuted &= shared < rise * self._shared + std * (LESS * recovery_gain)
        refuted &= rise > self._clear_rise_kpa + std * (SURE * rising_gain)
        return refuted

    def _held_kpa(self, dt_s: float) -> float:
        """By how much a pressure that is held may seem to go back in three frames."""
        return 3.0 * dt_s * self._held_kpa_per_s

    def _begin_anew(self, of: Rows, held_kpa: float, *, unconfirmed: bool) -> None:
        """Begin the other hypothesis where the one in force is, as long as the pressure is near its extreme.

        For ``held_kpa`` see :meth:`_held_kpa`.
        """
        gone_back = np.subtract(of.third_last, of.pressure, of.spare)
        gone_back *= of.sign
        np.less(gone_back, held_kpa, of.held)
        np.multiply(of.held, self._flat_kpa, of.nearby)
        np.maximum(of.unsure, of.nearby, out=of.nearby)
        below_peak = np.subtract(of.peak, of.ahead, of.spare)
        again = np.less(below_peak, of.nearby, of.where).astype(np.float64)
        again *= self._again
        np.copyto(again, self._one, where=np.less_equal(below_peak, self._exact_kpa, of.where))
        if unconfirmed:
            np.copyto(again, self._none, where=np.less(of.left, self._far, of.where))
        self._taken_over.dot(of.state, of.change)
        np.multiply(of.not_rising, again, of.rising_share)
        np.multiply(of.not_recovery, again, of.recovery_share)
        for pair in of.changes_by_model:
            np.multiply(pair, of.share, pair)
        of.hypotheses += of.change
        self._follow_earlier_turn(of, unconfirmed=unconfirmed)
        np.subtract(of.ahead, of.unsure, of.spare)
        np.maximum(of.peak, of.spare, out=of.peak)
        of.unsure *= self._less
        of.ahead -= of.unsure
        np.maximum(of.extreme, of.ahead, out=of.extreme)

    def _rose_before(self, of: Rows) -> BoolArray:
        """(m,) where the pressure rose before a turn that is not confirmed yet, or does if there is none."""
        rose: BoolArray = (of.sign > self._none) == (of.left >= self._far)
        return rose

    def _follow_earlier_turn(self, of: Rows, *, unconfirmed: bool) -> None:
        """Follow a third hypothesis: that a load turned earlier, which the model in force says to go on.

        Where a held load lets r drift faster in the recovery model, a load that begins to fall slowly bends r by less
        than that, and the rising model takes it for one that goes on slowly. The other hypothesis, which begins anew
        at each new extreme, forgets how far the load has fallen. The third one began when r bent. It differs from the
        other hypothesis by ``of.earlier`` kPa, which fade as errors of its model do (the slow branch neglected). No
        load falls and rises at the same time: where the pressure of this hypothesis rises by more than a turn and
        noise, it begins anew, too. A press that rises quickly therefore begins it at each frame. By how much the rising
        model's pressure grows counts from there, but for frames in which this hypothesis seems to rise. In recovery
        all this holds with rises and falls exchanged.
        """
        rose = self._rose_before(of)
        sign = np.where(rose, 1.0, -1.0)
        forgotten = np.add(of.change[RISING], of.change[RECOVERY], of.spare)
        forgotten *= sign
        of.earlier += forgotten
        other = np.where(rose, of.recovery_kpa, -of.rising_kpa)
        # no load falls below none, or rises beyond the usual
        np.minimum(of.earlier, other + np.where(rose, 0.0, self._usual), out=of.earlier)
        ahead = np.subtract(other, of.earlier, of.spare)
        np.minimum(of.earlier_least, ahead, out=of.earlier_least)
        ahead -= of.earlier_least
        ahead -= of.unsure * np.where(rose, SURE * self._bend_ratio, SURE / self._bend_ratio)
        way = (of.pressure - of.last) * sign
        np.add(of.earlier_from, way, of.earlier_from, where=np.greater(ahead, self._none, of.where))
        self._turn_from(of.extreme, of.nearby)
        of.nearby *= np.where(rose, 1.0, 1.0 / self._bend_ratio)
        anew = np.greater(ahead, of.nearby, of.where)
        if unconfirmed:
            anew |= of.confirmed
        np.copyto(of.earlier, self._none, where=anew)
        np.copyto(of.earlier_least, other, where=anew)
        np.copyto(of.earlier_from, of.pressure * sign, where=anew)

    def _earlier_kpa(self, memory: FloatArray, unsure: FloatArray, fallen: FloatArray) -> FloatArray:
        """(m,) kPa by which an earlier turn would take the pressure back, as far as the load does not seem constant.

        ``unsure`` (m,) is the standard deviation of the pressures by noise. By ``fallen`` (m,) the pressure has gone
        back, which no constant load does either. Cells that are taken for cells at rest bear none.
        """
        grown = np.maximum(np.maximum(memory[PEAK] - memory[EARLIER_FROM_KPA], fallen), self._none)
        released = memory[SIGN] < self._none
        errors = np.where(released, GROWN_RELEASED, GROWN_ERRORS)
        grown /= unsure * GROWN_SIGMAS + np.sqrt(memory[TURNED]) * errors + self._grown_kpa
        grown *= grown
        kpa: FloatArray = np.maximum(memory[EARLIER_KPA], self._none) * (grown / (grown + self._one))
        np.copyto(kpa, self._none, where=released & (memory[RESTED] > self._none))
        return kpa

    def _renew_variance(self, of: Rows, held_kpa: float, *, unconfirmed: bool) -> None:
        """Either hypothesis may be right until the pressure has turned: their distance counts as deviation.

        Extremes fade as errors of the memory may. For ``held_kpa`` see :meth:`_held_kpa`.
        """
        np.subtract(self._one, of.fade, of.nearby)
        np.sqrt(of.doubt, of.spare)
        fades = np.multiply(of.nearby, of.spare, of.threshold)
        fades += held_kpa * self._creeps
        of.recent_extreme -= fades
        np.maximum(of.recent_extreme, of.ahead, out=of.recent_extreme)
        of.nearby *= np.minimum(of.spare, self._turn_kpa, out=of.spare)
        of.nearby *= self._goes_back
        of.nearby *= of.held
        of.peak -= of.nearby
        of.variance -= of.doubt + of.may_bear * of.may_bear  # by which the hypotheses were apart in the last frame
        of.doubt *= of.fade
        apart = np.subtract(of.rising_kpa, of.recovery_kpa, of.spare)
        np.abs(apart, out=apart)
        apart *= self._either
        fallen = (of.peak - of.pressure * of.sign) * FALLEN * of.held  # a fast fall is a release
        earlier = self._earlier_kpa(of.memory, of.unsure * self._per_less, fallen)
        earlier *= self._by_earlier
        if unconfirmed:
            np.copyto(earlier, self._none, where=of.left < self._far)
        apart += earlier
        apart *= apart
        # Whether the variance is large, and little of it is left.
        np.maximum(apart, self._clear_kpa2, out=of.nearby)
        np.multiply(of.variance, self._left, of.threshold)
        begun = np.greater(of.threshold, of.nearby, of.where)
        if unconfirmed:
            begun &= ~of.confirmed  # what the model that was left says has been decided
        if np.count_nonzero(begun):
            self._keep(of, apart, begun)
        np.add(apart, of.doubt, of.variance)
        of.variance += of.may_bear * of.may_bear

    def loops_used(self) -> tuple[Loop[..., Any], ...]:
        return *loops.ALL, *recovery.LOOPS, *still.LOOPS, *onset.LOOPS, *sway.LOOPS

    def _numbers_of_turns(self) -> FloatArray:
        """What the loops take."""
        numbers: dict[int, float | FloatArray] = {
            loops.LOWEST: self._lowest,
            loops.USUAL: self._usual,
            loops.SURE: SURE,
            loops.TURN_KPA: self._turn_kpa,
            loops.LIGHT_KPA: self._light_kpa,
            loops.TURN_SHARE: self._turn_share,
            loops.STEPS: self._steps,
            loops.STILL: STILL,
            loops.FALL: SURE + LESS,
            loops.LEAST_KPA: self._least_kpa,
            loops.PULLED_KPA: -NEAR * self.full_scale_kpa,
            loops.FLAT_KPA: self._flat_kpa,
            loops.EXACT_KPA: self._exact_kpa,
            loops.AGAIN: AGAIN,
            loops.LESS: LESS,
            loops.EITHER: EITHER,
            loops.LEFT_OVER: self._left,
            loops.CLEAR: self._clear_kpa2,
            loops.JUST_BEGUN: JUST_BEGUN,
            loops.BETWEEN: BETWEEN,
            loops.BEND: self._bend,
            loops.ROUND_KPA: self._round_kpa,
            loops.MOST_KPA2: self._most_kpa2,
            loops.CONFIRMED_RISE: CONFIRMED_RISE,
            loops.CONFIRMED_FALL: CONFIRMED_FALL,
            loops.HALF: HALF,
            loops.PULL: -PULL_SIGMAS,
            loops.NEAR_KPA: NEAR * self.full_scale_kpa,
            loops.SETTLED_PER_KPA: 1 + self.model.etau2_kpa / self.model.eu1_kpa,
            loops.ETAU2_KPA: self.model.etau2_kpa,
            loops.E1_KPA: self.model.e1_kpa,
            loops.LOST_SIGMAS: LOST / LESS,
            loops.MOST_LOST_KPA2: self._lost_at_most_kpa2,
            loops.HIDDEN: HIDDEN,
            loops.PER_SIGMAS: 1.0 / SIGMAS,
            loops.FAST_KPA: self._fast_kpa,
            loops.LIGHT: recovery.LIGHT,
            loops.PART: recovery.PART,
            loops.DRIFTS: recovery.DRIFTS,
            loops.MOST_RESTED_KPA2: self._most_rested_kpa2,
            loops.GOES_BACK: GOES_BACK,
            loops.RISE_R: self._fast_r[0, 0],
            loops.FALL_R: self._fast_r[1, 0],
            loops.SMOOTH_KPA: self._smooth_kpa,
            loops.AWAY_KPA: self._away_kpa,
            loops.MAY_BEND: MAY_BEND,
            loops.SHARED: SHARED,
            loops.CLEAR_RISE_KPA: self._clear_rise_kpa,
            loops.SHARED_FALL: self._shared_fall,
            loops.CLEAR_FALL_KPA: self._clear_fall_kpa,
            loops.FALLING: FALLING,
            loops.EARLIER: EARLIER,
            loops.MIDWAY: MIDWAY,
            loops.GROWN_KPA: self._grown_kpa,
            loops.GROWN_SIGMAS: GROWN_SIGMAS,
            loops.GROWN_ERRORS: GROWN_ERRORS,
            loops.FALLEN: FALLEN,
            loops.BEND_RATIO: self._bend_ratio,
            loops.CREEPS: self._creeps,
            loops.GROWN_RELEASED: GROWN_RELEASED,
        }
        return np.array([float(numbers[place]) for place in range(len(numbers))])

    def advance_compiled(self, memory: FloatArray, taken: FloatArray, line: FloatArray, dt_s: float) -> FloatArray:
        w, of, numbers = self._weights.of(dt_s), self._beside, self._turns
        if memory is not of.memory:
            of = self._beside = Beside(memory)
        loops.take.code(memory, taken)
        w.step.dot(of.state, of.change)
        if w is not of.weights:
            loops.take_gains.code(memory, w.by_model, of.rows, numbers)
            of.weights = w
        beside = of.change, taken, w.by_model, of.rows, of.flags, numbers
        found = loops.step_and_turn.code(memory, *beside, False)
        if found & loops.BEYOND:
            self._limit(memory, w)
            found = loops.step_and_turn.code(memory, *beside, True)
        if found & loops.PULLED:
            loops.correct.code(memory, taken, w.by_model, numbers)
        self._taken_over.dot(of.state, of.change)
        unconfirmed = found & loops.UNCONFIRMED > 0
        loops.begin_anew.code(memory, of.change, of.rows, of.flags, self._held_kpa(dt_s), unconfirmed, numbers)
        return memory

    def _keep(self, of: Rows, apart: FloatArray, begun: BoolArray) -> None:
        """Where the other hypothesis has ``begun`` anew though it was apart by more than noise, the doubt stays.

        The pressure then went back and forth by too little for two turns to be noticed. What that leaves is always of
        the same sign, and adds up like amounts rather than like variances. Changes ``of.doubt``. On a coarse converter
        that may happen at each step at rest, so the doubt has an end: full scale. Half of it would be the deviation of
        any load, but a memory that is lost shows up to 1.1 times full scale where there is no load.
        """
        lost = of.variance - apart
        by_noise = of.unsure * (LOST / LESS)
        begun &= of.variance > by_noise**2
        np.copyto(lost, 0.0, where=~begun)
        kept = np.sqrt(of.doubt) + np.sqrt(np.maximum(lost, 0.0))
        np.minimum(kept * kept, self._lost_at_most_kpa2, out=of.doubt)

    def recover(self, memory: FloatArray, dt_s: float, mean: FloatArray, noise: FloatArray, count: FloatArray) -> None:
        """See :func:`._recovery.look`, :func:`._still.look`, :func:`._onset.look` and :func:`._sway.look`."""
        recovery.look(memory, mean, noise, count, self._recovery.of(dt_s).each)
        still.look(memory, mean, noise, self.full_scale_kpa, self._still.of(dt_s).each)
        onset.look(memory, mean, noise, self.full_scale_kpa, self._onset.of(dt_s).each)
        sway.look(memory, mean, noise, self._kept_kpa)

    def recover_compiled(
        self,
        memory: FloatArray,
        taken: FloatArray,
        dt_s: float,
        line: FloatArray,
        ring: FloatArray,
        newest: int,
        cells: IntArray,
    ) -> None:
        """See :func:`._recovery.look_each`, and those of :mod:`._still`, :mod:`._onset` and :mod:`._sway`."""
        recovery.look_each.code(memory, taken, line, ring, newest, cells, self._recovery.of(dt_s).row)
        numbers = self._still.of(dt_s).row
        still.look_each.code(memory, taken, ring, newest, cells, self.full_scale_kpa, numbers)
        numbers = self._onset.of(dt_s).row
        onset.look_each.code(memory, taken, ring, newest, cells, self.full_scale_kpa, numbers)
        sway.look_each.code(memory, taken, ring, newest, cells, sway.LOOKS_IN_BLOCK, self._kept_kpa)

    def released(self, memory: FloatArray) -> BoolArray | None:
        released: BoolArray = memory[SIGN] < self._none
        released |= memory[LEFT] < self._far
        return released if np.count_nonzero(released) else None

    def hides_kpa2(self, memory: FloatArray, noise_kpa: FloatArray) -> FloatArray:
        """A released cell shows what clearly differs from rest; noise and memory both may make the difference.

        How little noise there is does not matter. The error of the memory was made by the noise of all taps so far.
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
            np.minimum(noise_kpa2, self._doubted_load_kpa2, out=noise_kpa2)
            np.maximum(hides, noise_kpa2, out=hides, where=doubted)
        np.copyto(hides, light, where=released)
        released &= (memory[RESTED] > self._none) | (memory[PRESSURE] < self._none)
        np.copyto(hides, rests, where=released)
        return hides

    def miss(self, memory: FloatArray, rise_kpa: FloatArray) -> None:
        """A load to and fro within the noise seems to rise: r goes up by one model, and would go down by the other."""
        before = memory[TURNED]
        after = np.minimum((np.sqrt(before) + rise_kpa) ** 2, self._lost_at_most_kpa2)
        memory[VARIANCE] += after - before
        memory[TURNED] = after

    def _look(self, of: Rows, std: FloatArray) -> None:
        """Of the hypothesis in force: pressure, its standard deviation by noise, how far it is ahead in its direction,
        and how far it may seem to have gone back without a turn, as threshold.
        """
        np.multiply(of.pressures, of.in_force, of.share)
        np.add(of.rising_share, of.recovery_share, of.pressure)
        np.multiply(std, of.gain, of.unsure)
        of.threshold[...] = self._seeming(of)
        if self._steps > 0.0:
            self._doubt_falls(of, std)
        np.maximum(of.pressure, self._least_kpa, out=of.ahead)
        of.ahead *= of.sign

    def _gone_back_by_turn(self, of: Rows) -> BoolArray:
        """(m,) where pressures have gone back by a turn, from the extreme or, by less, from the recent one.

        In recovery the latter fades as the error of the memory does, so that this may seem no turn twice.
        """
        self._turn_from(of.extreme, of.nearby)
        of.nearby += np.multiply(of.unsure, self._sure, of.spare)
        of.nearby += of.threshold
        turned: BoolArray = np.greater(np.subtract(of.extreme, of.ahead, of.spare), of.nearby, of.where)
        np.multiply(of.unsure, self._falling, of.nearby)
        of.nearby += self._light_kpa
        of.nearby += np.multiply(of.threshold, of.rises, of.spare)
        turned |= np.greater(np.subtract(of.recent_extreme, of.ahead, of.spare), of.nearby, of.held)
        return turned

    def _seeming(self, of: Rows) -> FloatArray:
        """(m,) kPa by which pressures may seem to go back though the load has not turned.

        Under a load that rises this is no more than a share of what the recovery model has gone back by, and none where
        the pressure has gone back by more than noise in the last three frames.
        """
        shared: FloatArray = np.subtract(of.extreme, of.recovery_kpa, of.spare)
        shared -= self._clear_fall_kpa
        np.maximum(shared, self._none, out=shared)
        shared *= self._shared_fall
        np.minimum(shared, of.drift, out=shared)
        falls = np.subtract(of.third_last, of.pressure, of.nearby)
        np.copyto(shared, self._none, where=np.greater(falls, of.unsure * self._falling, of.where))
        np.copyto(shared, of.drift, where=np.less(of.sign, self._none, of.where))
        return shared

    def _doubt_falls(self, of: Rows, std: FloatArray) -> None:
        """Let a load that seems to fall, and not to none, fall by more than steps of the ADC; changes the threshold."""
        other = (of.pressures * of.not_in_force).sum(axis=0)
        scale = of.r + 1.0
        by_steps = scale * scale * self._steps
        falls = (of.sign > 0.0) & (other > np.maximum(by_steps, std) * of.other_gain * STILL)
        of.threshold += np.where(falls, np.maximum(by_steps - std, 0.0) * of.gain * (SURE + LESS), 0.0)

    def _turn_from(self, extreme: FloatArray, limit: FloatArray) -> None:
        """Write into ``limit`` (m,) how far exact pressures in kPa must go back from ``extreme`` (m,) for a turn."""
        np.abs(extreme, out=limit)
        limit *= self._turn_share
        limit += self._light_kpa
        np.minimum(limit, self._turn_kpa, out=limit)

    def _gone_back(self, of: Rows, std: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How far the other hypothesis is behind the extreme that was left, and its standard deviation by noise."""
        np.multiply(of.pressures, of.not_in_force, of.share)
        back = np.add(of.rising_share, of.recovery_share, of.spare)
        back *= of.sign
        back += of.left
        return back, np.multiply(of.other_gain, std, of.noise)

    def _turn(self, memory: FloatArray, turned: IntArray, std: FloatArray, weights: TurnWeights) -> None:
        """Take over the other hypothesis where the pressure ``turned`` (indices of cells); changes ``memory``."""
        some = memory.take(turned, axis=1)
        left, extreme, sign = some[LEFT], some[EXTREME].copy(), some[SIGN]
        again = left < self._far
        noise = std.take(turned) if std.size > 1 else std
        late = self._late(some, noise)
        earlier = self._earlier_kpa(some, noise * some[GAIN], self._none) * MIDWAY
        np.copyto(earlier, self._none, where=again | (sign < self._none))
        np.negative(sign, sign)
        some[IN_FORCE] = some[IN_FORCE][::-1].copy()
        gain = weights.by_model[0].dot(some[IN_FORCE])
        pressure = some[STATE.start] * some[IN_FORCE.start]
        pressure += some[STATE.start + 1] * some[IN_FORCE.start + 1]
        unsure = noise * gain
        # When the pressure turned is as doubtful as it was in the last frame whether it had turned.
        before = some[VARIANCE]
        left_over = before * recovery.LIGHT + some[TAKEN_OFF_KPA] * some[TAKEN_OFF_KPA]
        rested = np.minimum(before, some[REST_VARIANCE] + left_over)
        np.copyto(before, rested, where=some[RESTED] > self._none)
        rounded = self._fast_kpa / np.maximum(np.abs(pressure - some[LAST]), self._fast_kpa)
        unseen = self._unseen(some, pressure, gain, unsure) + rounded * self._round_kpa
        noticed = ~again & (extreme < REFUTED)
        unseen += np.where(noticed & (sign > self._none), self._hidden(some, pressure, extreme), self._none)
        np.copyto(some[LOOKS_AT_REST], self._none, where=noticed & (sign < self._none))
        some[MAY_BEAR_KPA] = 0.0
        by_noise = noise * weights.by_model[0, RECOVERY]
        by_noise *= by_noise
        doubt = np.sqrt(before) + unseen
        doubt = np.minimum(doubt * doubt + by_noise, self._most_kpa2)
        some[TURNED] = some[VARIANCE] = doubt  # the distance of the hypotheses is in it
        recovery.begin(some, by_noise, self._most_rested_kpa2)
        if np.count_nonzero(late) or np.count_nonzero(earlier):
            some[EARLIER_KPA] -= np.maximum(late, earlier)
            pressure = self._take_delay_back(some, pressure, late, earlier)
        now = sign * np.maximum(pressure, self._none)
        some[EXTREME] = now - unsure * self._less
        some[PEAK] = now - unsure
        if np.count_nonzero(again):
            np.copyto(some[EXTREME], left, where=again)
            np.copyto(some[PEAK], left, where=again)
            np.copyto(extreme, FAR, where=again)
        some[RECENT_EXTREME] = some[EXTREME]
        some[LEFT] = extreme
        memory[:, turned] = some

    def _hidden(self, memory: FloatArray, pressure: FloatArray, extreme: FloatArray) -> FloatArray:
        """(m,) standard deviation in kPa of rises that may have begun earlier, see :mod:`._onset`.

        The load of released cells has risen from ``-extreme`` (m,) to ``pressure`` (m,).
        """
        rise = pressure + extreme
        rises = (rise > self._none) & (memory[LOOKS_AT_REST] >= SETTLES)
        shared = (memory[STATE][1] + extreme) / np.where(rises, rise, self._one) * self._shared_by_fast
        hidden = np.minimum(np.maximum(self._one - shared, self._none), self._one)
        kpa = hidden * hidden * np.maximum(memory[EARLIEST_KPA] - pressure, self._none) * HIDDEN_SHARE
        found: FloatArray = np.where(rises, kpa, self._none)
        return found

    def _late(self, memory: FloatArray, noise: FloatArray) -> FloatArray:
        """(m,) kPa by which the pressure of the model that is left was off when it turned, for readings with ``noise``.

        Where a held load lets r drift faster in the model that is taken over than in the one that is left, r bends at
        the turn, and that bend looks like a load that goes on. The model that is left turns later than a smooth load
        then. Let the load be a parabola in time, and r answer changes by a model's response to fast ones. The ways
        back of the two hypotheses, ``gone`` in the model that is left and ``way`` in the other, then tell both the
        drift and the delay, and with them the error. Where the load bent (corners of a ramp), both ways answer the
        same change of r, and no error is found.
        """
        sign, extreme = memory[SIGN], memory[EXTREME]
        rises = sign > self._none
        left_r, other_r = np.where(rises, self._fast_r, self._fast_r[::-1])
        unsure = noise * memory[GAIN]
        top = extreme + unsure
        rising, recovery = memory[STATE.start] * sign, memory[STATE.start + 1] * sign
        gone = np.maximum(top - np.where(rises, rising, recovery), self._exact_kpa)
        way = top - np.where(rises, recovery, rising)
        by_drift = way * other_r / left_r - gone
        smooth = (by_drift > unsure * self._sure) & (unsure < self._smooth_kpa) & (memory[LEFT] >= self._far)
        smooth &= (np.abs(extreme) > self._away_kpa) & (extreme < self._usual)
        error = by_drift * by_drift * (left_r + other_r) / (4.0 * other_r * gone)
        late: FloatArray = np.where(smooth, np.minimum(error, way), self._none)
        return late

    def _take_delay_back(
        self, memory: FloatArray, pressure: FloatArray, late: FloatArray, earlier: FloatArray
    ) -> FloatArray:
        """Correct the ``pressure`` (m,) of the hypothesis taken over; changes its ``memory``.

        It is corrected by ``late`` (m,) kPa, or by what an ``earlier`` (m,) turn makes likely, whichever is more. The
        deviation counts the latter already.

        Returns:
            (m,) kPa.
        """
        m, state = self.model, memory[STATE]
        rises = memory[SIGN] > self._none
        by_bend = late * MAY_BEND
        late = np.maximum(late, earlier)
        corrected: FloatArray = pressure + memory[SIGN] * late
        np.copyto(state[RISING], corrected, where=rises)
        np.copyto(state[RECOVERY], corrected, where=~rises)
        state[2] += np.where(rises, late * (1 + m.etau2_kpa / m.eu1_kpa), self._none)
        state[3] += np.where(rises, self._none, late / m.e1_kpa)
        memory[PRESSURE] = corrected
        doubt = np.sqrt(memory[TURNED]) + by_bend
        np.copyto(memory[TURNED], np.minimum(doubt * doubt, self._most_kpa2), where=late > self._none)
        memory[VARIANCE] = memory[TURNED]
        return corrected

    def _unseen(self, memory: FloatArray, pressure: FloatArray, gain: FloatArray, unsure: FloatArray) -> FloatArray:
        """(m,) standard deviation in kPa that turns between two frames leave in ``pressure`` (m,), known to ``unsure``.

        The extreme itself falls between two frames. How far it was beyond them is up to half of the way that the load
        went in a frame before or after, whichever is less; in the frame of the turn itself it may have gone to and
        fro. On that way r goes up by one model and down by the other. All turns err to the same side, so these errors
        add up like amounts rather than like variances. A way that noise, or a converter that flips between two codes,
        would go as well is no way of the load.
        """
        last, before, third = memory[LAST : THIRD_LAST + 1]
        there = np.maximum(memory[SIGN] * (third - before), memory[SIGN] * (before - last))
        there = np.maximum(there, self._none)
        way = np.minimum(there * JUST_BEGUN, np.maximum(np.abs(pressure - last), there * HALF))
        by_load: FloatArray = np.maximum(way - unsure * self._sure, self._none)
        return by_load * BETWEEN * self._bend * gain

    def within_frame(self, memory: FloatArray, noise_kpa: FloatArray) -> FloatArray:
        """A load that bent may as well have turned within the frame: no reading tells of the turn yet."""
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

    def _limit(self, memory: FloatArray, weights: TurnWeights) -> None:
        """Keep pressures within :data:`LOADS`, and what is remembered with them; changes the state of few cells.

        Where the memory is in doubt, a pressure beyond full scale is an error of the memory rather than a load.
        """
        pressures = memory[STATE][:2]
        some = np.flatnonzero(((pressures < self._lowest) | (pressures > self._usual)).any(axis=0))
        of = Rows(memory.take(some, axis=1))
        self._limit_each(of, weights)
        for row in _LIMITED:  # one by one: NumPy takes far longer for all at once where there are many cells
            memory[row, some] = of.memory[row]

    def _limit_each(self, of: Rows, weights: TurnWeights) -> None:
        """:meth:`_limit` of cells that have a pressure beyond the usual."""
        m, state = self.model, of.state
        excess = np.clip(of.pressures, self._lowest, self._highest) - of.pressures
        state[:6] += weights.ramp[:, None] * np.tile(excess, (3, 1))
        doubtful = of.variance > (DOUBT * self.full_scale_kpa) ** 2
        beyond = doubtful & (of.pressures > self._usual)
        if not beyond.any():
            return
        np.minimum(of.pressures, self._usual, where=beyond, out=of.pressures)
        np.maximum(of.doubt, self._most_kpa2, where=(beyond & (of.in_force > 0)).any(axis=0), out=of.doubt)
        p, r = self._usual, of.r
        # The reading falls more slowly than a load that rises or is held allows: it is recovery that explains it.
        refuted = beyond[RISING] & ~beyond[RECOVERY] & (of.in_force[RISING] > 0)
        np.copyto(of.extreme, REFUTED, where=refuted)
        np.copyto(state[2], p * (1 + m.etau2_kpa / m.eu1_kpa) - m.etau2_kpa * r, where=beyond[RISING])
        np.copyto(state[3], r - p / m.e1_kpa - state[5], where=beyond[RECOVERY])

    def _correct(self, of: Rows, std: FloatArray, doubt: FloatArray, weights: TurnWeights) -> None:
        """Where the hypothesis in force needs a pull, let it remember less instead; changes state and pressure.

        In recovery noise that the smoothing passes on makes up for a pull of :data:`SURE` deviations.

        No load leaves a resistance below that at rest. A reading that is lower nevertheless (a bad line, a cell that
        has become warm) makes a memory that no load has made, and a reading at rest again shows a load then. What is
        missing counts as standard deviation.
        """
        m = self.model
        allowed = -PULL_SIGMAS * weights.by_model[0, RECOVERY] * doubt - NEAR * self.full_scale_kpa
        by_noise = weights.by_model[0, RECOVERY] * std * -SURE
        allowed = np.where(of.sign < self._none, np.minimum(allowed, by_noise), allowed)
        pulled = (of.pressure < allowed).nonzero()[0]
        if not pulled.size:
            return
        p = allowed[pulled]
        state, r, rising = of.state, of.r[pulled], of.in_force[RISING, pulled] > 0
        of.pressure[pulled] = p
        state[np.where(rising, 0, 1), pulled] = p
        state[2, pulled[rising]] = (p * (1 + m.etau2_kpa / m.eu1_kpa) - m.etau2_kpa * r)[rising]
        state[3, pulled[~rising]] = (r - p / m.e1_kpa - state[5, pulled])[~rising]
        missing = np.maximum((p / m.e1_kpa - r) * weights.by_model[0, RISING], self._none)
        doubt = of.doubt[pulled]
        more = np.maximum(np.minimum(missing * missing, self._lost_at_most_kpa2), doubt) - doubt
        of.doubt[pulled] += more
        of.variance[pulled] += more

    def hold(self, memory: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        m = self.model
        gone, _ = lag.weights(dt_s, np.array([[m.tu_s], [m.t2_s], [m.t3_s], [m.t3_s]]))
        held = memory.copy()
        state = held[STATE]
        # A hypothesis that begins where the one in force is does so after the gap, too.
        apart = state[0] != state[1]
        pressures = state[[0, 1, 0, 1]] * np.array([[1.0], [1 / m.e2_kpa], [1 / m.e3_kpa], [1 / m.e3_kpa]])
        state[2:6] += (pressures - state[2:6]) * gone
        settled, x2, _, x3 = state[2:6]
        rising = state[0] / m.eu1_kpa + (state[0] - settled) / m.etau2_kpa
        state[6] = np.where(held[SIGN] > 0, rising, state[1] / m.e1_kpa + x2 + x3)
        share = np.where(apart, 0.0, held[IN_FORCE][::-1])
        state[:6] += (self._taken_over @ state) * np.tile(share, (3, 1))
        still.hold(held, 1.0 - gone[1], 1.0 - gone[2])
        onset.begin_anew(held)
        sway.begin_anew(held, np.ones(held.shape[1], dtype=np.bool_))
        return held

    def settled(self, memory: FloatArray, band: float) -> BoolArray:
        m = self.model
        kpa = 2 * band / m.gain_per_kpa
        off = np.abs(memory[PRESSURE]) < kpa
        _, _, settled, x2, _, x3 = memory[STATE][:6]
        unsettled = np.where(memory[SIGN] > 0, np.abs(settled) / m.etau2_kpa, np.abs(x2) + np.abs(x3))
        found: BoolArray = off & (unsettled < band)
        return found
