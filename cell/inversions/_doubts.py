"""Doubt about the two hypotheses on the paper's cell: as long as either may be right, their distance is a deviation.

Near the extreme of the pressure the other hypothesis begins anew, again and again, where the one in force is: the
pressure may turn just there. Where it has been apart by more than noise before, the pressure went back and forth
unnoticed, and the doubt stays. Extremes fade as errors of the memory may.
"""

from __future__ import annotations

import math

import numpy as np

from ...arrays import BoolArray, FloatArray
from ...compiled import FlagRows, Row, Rows, SpacedRows, loop
from ..estimation import FAR, PRESSURE, VARIANCE
from . import _earlier as third
from ._earlier import EARLIER, FALLEN, follow_of, likely_kpa_of
from ._limits import MOST_LOST_KPA2, NEAR
from ._turning_rows import (
    AHEAD,
    CONFIRMED,
    EXTREME,
    FADE,
    HELD,
    LEFT,
    MAY_BEAR_KPA,
    NOT_RECOVERY,
    NOT_RISING,
    PEAK,
    RECENT_EXTREME,
    RECOVERY_KPA,
    RISING_KPA,
    SIGN,
    SPARE,
    THIRD_LAST,
    TURNED,
    UNSURE,
    WHERE,
    MemoryRows,
)
from ._turns import EXACT_KPA, LESS, TURN_KPA

EITHER = 0.5
"""standard deviation over the difference of the two hypotheses: either may be right until the pressure has turned"""
LOST, GONE = 1.5, 0.7
"""standard deviations of the smoothed noise by which the hypotheses must have been apart for a doubt to stay, and the
share of the variance that a new beginning takes away"""
CREEP = 0.003
"""of full scale: what a recent extreme fades by in a second, beside what an error of two standard deviations of the
memory fades by. A load that goes back faster has turned, however large it is: holds by a hand waver by less than what
makes a turn otherwise"""
HELD_PER_S = 0.03
"""of full scale: by how much a pressure that is held may seem to go back in a second. A load that goes back faster has
turned"""
GOES_BACK = 6.0
"""standard deviations of the memory, at most a turn, per share of its variance that fades in a frame, by which the peak
goes down. As an error of the memory fades, the pressure of a load that is held seems to go back"""
AGAIN = 0.5
"""share by which the other hypothesis begins anew at a frame, within one standard deviation of the extreme.
Beginning at every extreme would take noise for part of the press, beginning late would miss some of the release; half
and half, the two errors about cancel"""
CREEPS = CREEP / (3.0 * HELD_PER_S)
"""share of what a held pressure may seem to go back by in three frames that a recent extreme fades by in one"""

CLEAR_KPA2 = 28
"""place of a number, behind those of :mod:`._takeover`: a variance that is more than rounding"""
_ZERO, _ONE, _FAR, _LESS, _PER_LESS, _EITHER, _EARLIER, _AGAIN, _GOES_BACK, _KEPT = (
    np.array(x) for x in (0.0, 1.0, FAR, LESS, 1.0 / LESS, EITHER, EARLIER, AGAIN, GOES_BACK, 1.0 - GONE)
)
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


def numbers_of(full_scale_kpa: float) -> dict[int, float]:
    """The number of the place above."""
    return {CLEAR_KPA2: (1.0 - GONE) * (NEAR * full_scale_kpa) ** 2}


def held_kpa(dt_s: float, full_scale_kpa: float) -> float:
    """By how much a pressure that is held may seem to go back in three frames."""
    return 3.0 * dt_s * (HELD_PER_S * full_scale_kpa)


def begin_anew(
    of: MemoryRows,
    taken_over: FloatArray,
    held_kpa: float,
    numbers: tuple[FloatArray, ...],
    *,
    unconfirmed: bool,
) -> None:
    """Begin the other hypothesis where the one in force is, as long as the pressure is near its extreme.

    Args:
        of: the cells.
        taken_over: :func:`._paper_steps.taken_over`.
        held_kpa: :func:`held_kpa`.
        numbers: as above.
        unconfirmed: whether turns are, or were until ``of.confirmed`` marked them.
    """
    gone_back = np.subtract(of.third_last, of.pressure, of.spare)
    gone_back *= of.sign
    np.less(gone_back, held_kpa, of.held)
    below_peak = np.subtract(of.peak, of.ahead, of.spare)
    again = np.less(below_peak, of.unsure, of.where).astype(np.float64)
    again *= _AGAIN
    np.copyto(again, _ONE, where=np.less_equal(below_peak, numbers[EXACT_KPA], of.where))
    if unconfirmed:
        np.copyto(again, _ZERO, where=np.less(of.left, _FAR, of.where))
    taken_over.dot(of.state, of.change)
    np.multiply(of.not_rising, again, of.rising_share)
    np.multiply(of.not_recovery, again, of.recovery_share)
    for pair in of.changes_by_model:
        np.multiply(pair, of.share, pair)
    of.hypotheses += of.change
    third.follow(of, numbers, unconfirmed=unconfirmed)
    np.subtract(of.ahead, of.unsure, of.spare)
    np.maximum(of.peak, of.spare, out=of.peak)
    of.unsure *= _LESS
    of.ahead -= of.unsure
    np.maximum(of.extreme, of.ahead, out=of.extreme)


def renew_variance(of: MemoryRows, held_kpa: float, numbers: tuple[FloatArray, ...], *, unconfirmed: bool) -> None:
    """Count the distance of the hypotheses as deviation, and let extremes fade; as and after :func:`begin_anew`."""
    np.subtract(_ONE, of.fade, of.nearby)
    np.sqrt(of.doubt, of.spare)
    fades = np.multiply(of.nearby, of.spare, of.threshold)
    fades += held_kpa * CREEPS
    of.recent_extreme -= fades
    np.maximum(of.recent_extreme, of.ahead, out=of.recent_extreme)
    of.nearby *= np.minimum(of.spare, numbers[TURN_KPA], out=of.spare)
    of.nearby *= _GOES_BACK
    of.nearby *= of.held
    of.peak -= of.nearby
    of.variance -= of.doubt + of.may_bear * of.may_bear  # by which the hypotheses were apart in the last frame
    of.doubt *= of.fade
    apart = np.subtract(of.rising_kpa, of.recovery_kpa, of.spare)
    np.abs(apart, out=apart)
    apart *= _EITHER
    fallen = (of.peak - of.pressure * of.sign) * FALLEN * of.held  # a fast fall is a release
    earlier = third.likely_kpa(of.memory, of.unsure * _PER_LESS, fallen, numbers)
    earlier *= _EARLIER
    if unconfirmed:
        np.copyto(earlier, _ZERO, where=of.left < _FAR)
    apart += earlier
    apart *= apart
    # Whether the variance is large, and little of it is left.
    np.maximum(apart, numbers[CLEAR_KPA2], out=of.nearby)
    np.multiply(of.variance, _KEPT, of.threshold)
    begun = np.greater(of.threshold, of.nearby, of.where)
    if unconfirmed:
        begun &= ~of.confirmed  # what the model that was left says has been decided
    if np.count_nonzero(begun):
        _keep(of, apart, begun, numbers)
    np.add(apart, of.doubt, of.variance)
    of.variance += of.may_bear * of.may_bear


def _keep(of: MemoryRows, apart: FloatArray, begun: BoolArray, numbers: tuple[FloatArray, ...]) -> None:
    """Where the other hypothesis has ``begun`` anew though it was apart by more than noise, the doubt stays.

    The pressure then went back and forth by too little for two turns to be noticed. What that leaves is always of the
    same sign, and adds up like amounts rather than like variances. Changes ``of.doubt``. On a coarse converter that may
    happen at each step at rest, so the doubt has an end: full scale. Half of it would be the deviation of any load, but
    a memory that is lost shows up to 1.1 times full scale where there is no load.
    """
    lost = of.variance - apart
    by_noise = of.unsure * (LOST / LESS)
    begun &= of.variance > by_noise**2
    np.copyto(lost, 0.0, where=~begun)
    kept = np.sqrt(of.doubt) + np.sqrt(np.maximum(lost, 0.0))
    np.minimum(kept * kept, numbers[MOST_LOST_KPA2], out=of.doubt)


@loop
def keep_each(memory: SpacedRows, of: Rows, flags: FlagRows, numbers: Row) -> None:
    """Keep the doubt where the other hypothesis has begun anew though it was apart by more than noise."""
    for i in range(memory.shape[1]):
        by_noise = of[UNSURE, i] * (LOST / LESS)
        lost = 0.0
        if flags[WHERE, i] and memory[VARIANCE, i] > by_noise * by_noise:
            lost = memory[VARIANCE, i] - of[SPARE, i]
        doubt = math.sqrt(memory[TURNED, i]) + math.sqrt(max(lost, 0.0))
        memory[TURNED, i] = min(doubt * doubt, numbers[MOST_LOST_KPA2])


@loop
def begin_anew_each(
    memory: SpacedRows,
    anew: Rows,
    of: Rows,
    flags: FlagRows,
    held_kpa: float,
    unconfirmed: bool,
    numbers: Row,
) -> None:
    """:func:`begin_anew` and :func:`renew_variance` as loops over cells.

    ``anew`` (6, m) is by how much the hypotheses change if they begin where the other one is; ``held_kpa`` by how much
    a pressure that is held may seem to go back in three frames.
    """
    begun_anywhere = False
    for i in range(memory.shape[1]):
        held = (memory[THIRD_LAST, i] - memory[PRESSURE, i]) * memory[SIGN, i] < held_kpa
        flags[HELD, i] = held
        below_peak = memory[PEAK, i] - of[AHEAD, i]
        again = 0.0
        if below_peak < of[UNSURE, i]:
            again = AGAIN
        if below_peak <= numbers[EXACT_KPA]:
            again = 1.0
        if unconfirmed and memory[LEFT, i] < FAR:
            again = 0.0
        rising, recovery = of[NOT_RISING, i] * again, of[NOT_RECOVERY, i] * again
        for row in range(0, 6, 2):
            memory[RISING_KPA + row, i] += anew[row, i] * rising
            memory[RECOVERY_KPA + row, i] += anew[row + 1, i] * recovery
        confirmed = bool(unconfirmed and flags[CONFIRMED, i])
        follow_of(memory, i, anew[0, i] * rising + anew[1, i] * recovery, confirmed, of, numbers)
    for i in range(memory.shape[1]):
        ahead, noise = of[AHEAD, i], of[UNSURE, i]
        memory[PEAK, i] = max(memory[PEAK, i], ahead - noise)
        unsure = noise * LESS
        of[UNSURE, i] = unsure
        memory[EXTREME, i] = max(memory[EXTREME, i], ahead - unsure)
        error_kpa, fades = math.sqrt(memory[TURNED, i]), 1.0 - of[FADE, i]
        recent = memory[RECENT_EXTREME, i] - (fades * error_kpa + held_kpa * CREEPS)
        memory[RECENT_EXTREME, i] = max(recent, ahead - unsure)
        if flags[HELD, i]:
            memory[PEAK, i] -= fades * min(error_kpa, numbers[TURN_KPA]) * GOES_BACK
        may_bear = memory[MAY_BEAR_KPA, i] * memory[MAY_BEAR_KPA, i]
        memory[VARIANCE, i] -= memory[TURNED, i] + may_bear  # by which the hypotheses were apart in the last frame
        memory[TURNED, i] *= of[FADE, i]
        apart = abs(memory[RISING_KPA, i] - memory[RECOVERY_KPA, i]) * EITHER
        if memory[LEFT, i] >= FAR:
            fallen = 0.0
            if flags[HELD, i]:
                fallen = (memory[PEAK, i] - memory[SIGN, i] * memory[PRESSURE, i]) * FALLEN
            apart += likely_kpa_of(memory, i, noise, fallen, numbers) * EARLIER
        apart *= apart
        of[SPARE, i] = apart
        # Whether the variance is large, and little of it is left.
        begun = memory[VARIANCE, i] * (1.0 - GONE) > max(apart, numbers[CLEAR_KPA2])
        if unconfirmed and flags[CONFIRMED, i]:
            begun = False  # what the model that was left says has been decided
        flags[WHERE, i] = begun
        begun_anywhere |= begun
    if begun_anywhere:
        keep_each(memory, of, flags, numbers)
    for i in range(memory.shape[1]):
        may_bear = memory[MAY_BEAR_KPA, i] * memory[MAY_BEAR_KPA, i]
        memory[VARIANCE, i] = of[SPARE, i] + memory[TURNED, i] + may_bear
