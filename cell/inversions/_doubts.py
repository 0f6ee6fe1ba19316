"""Model uncertainty of the paper's cell: while either hypothesis may be right, their distance is a standard deviation.

As long as the pressure is near its extreme, the other hypothesis begins anew in each frame where the one in force is,
since the pressure may turn just there. If the two were apart by more than noise explains, the pressure went to and fro
unnoticed, and their distance stays in the variance. Extremes fade as fast as errors of the memory may.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...common.compiled import FlagRows, Row, Rows, SpacedRows, loop
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
"""standard deviation over the difference of the two hypotheses, since either may be right until a turn is noticed"""
LOST, GONE = 1.5, 0.7
"""if a restart of the other hypothesis takes away more than the share GONE of the variance, and the hypotheses were
apart by more than LOST standard deviations of the smoothed noise, the difference stays in the variance"""
CREEP = 0.003
"""of full scale per second: rate at which a recent extreme fades, in addition to the fading of an error of two standard
deviations of the memory. A load that goes back faster has turned, however large it is: a load held by a hand wavers by
less than the usual limit of a turn"""
HELD_PER_S = 0.03
"""of full scale per second: rate at which a held pressure may seem to go back. A load that goes back faster has
turned"""
GOES_BACK = 6.0
"""the peak goes down in each frame by GOES_BACK, times the standard deviation of the memory (at most a turn), times the
share of its variance that fades in the frame: as an error of the memory fades, a held pressure seems to go back"""
AGAIN = 0.5
"""share by which the other hypothesis is moved to the one in force in a frame, within one standard deviation of the
peak. A restart at every frame there would take noise for a part of the press, and a late restart would miss a part of
the release; with half of each, the two errors about cancel"""
CREEPS = CREEP / (3.0 * HELD_PER_S)
"""fading of a recent extreme in one frame, over the most that a held pressure may seem to go back in three frames"""

CLEAR_KPA2 = 28
"""place of a constant, behind those of :mod:`._takeover`: a variance beyond rounding errors"""
_ZERO, _ONE, _FAR, _LESS, _PER_LESS, _EITHER, _EARLIER, _AGAIN, _GOES_BACK, _KEPT = (
    np.array(x) for x in (0.0, 1.0, FAR, LESS, 1.0 / LESS, EITHER, EARLIER, AGAIN, GOES_BACK, 1.0 - GONE)
)
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


def numbers_of(full_scale_kpa: float) -> dict[int, float]:
    """The constant of the place above."""
    return {CLEAR_KPA2: (1.0 - GONE) * (NEAR * full_scale_kpa) ** 2}


def held_kpa(dt_s: float, full_scale_kpa: float) -> float:
    """The most in kPa that a held pressure may seem to go back in three frames."""
    return 3.0 * dt_s * (HELD_PER_S * full_scale_kpa)


def begin_anew(
    of: MemoryRows,
    taken_over: FloatArray,
    held_kpa: float,
    numbers: tuple[FloatArray, ...],
    *,
    unconfirmed: bool,
) -> None:
    """Restart the other hypothesis where the one in force is, as long as the pressure is near its extreme.

    Args:
        of: the cells.
        taken_over: :func:`._paper_steps.taken_over`.
        held_kpa: :func:`held_kpa`.
        numbers: as above.
        unconfirmed: whether turns are unconfirmed, or were until ``of.confirmed`` marked them.
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
    """Add the squared distance of the hypotheses to the variance, and fade extremes; after :func:`begin_anew`."""
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
    of.variance -= of.doubt + of.may_bear * of.may_bear  # leaves the squared distance in the last frame
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
    # A restart has taken away most of a clear variance.
    np.maximum(apart, numbers[CLEAR_KPA2], out=of.nearby)
    np.multiply(of.variance, _KEPT, of.threshold)
    begun = np.greater(of.threshold, of.nearby, of.where)
    if unconfirmed:
        begun &= ~of.confirmed  # a confirmed turn settles which model was right
    if np.count_nonzero(begun):
        _keep(of, apart, begun, numbers)
    np.add(apart, of.doubt, of.variance)
    of.variance += of.may_bear * of.may_bear


def _keep(of: MemoryRows, apart: FloatArray, begun: BoolArray, numbers: tuple[FloatArray, ...]) -> None:
    """Keep the distance in the variance where a restart has ``begun`` though it was more than noise explains.

    The pressure then went to and fro by too little for two turns to be noticed. The errors that this leaves all have
    the same sign, and add up as amounts rather than as variances. Changes ``of.doubt``. On a coarse converter this may
    happen at each step at rest, so that the standard deviation is limited to full scale. Half of full scale would cover
    any load, but a memory that is lost shows up to 1.1 times full scale where there is no load.
    """
    lost = of.variance - apart
    by_noise = of.unsure * (LOST / LESS)
    begun &= of.variance > by_noise**2
    np.copyto(lost, 0.0, where=~begun)
    kept = np.sqrt(of.doubt) + np.sqrt(np.maximum(lost, 0.0))
    np.minimum(kept * kept, numbers[MOST_LOST_KPA2], out=of.doubt)


@loop
def keep_each(memory: SpacedRows, of: Rows, flags: FlagRows, numbers: Row) -> None:
    """:func:`_keep` as a loop over cells."""
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

    ``anew`` (6, m) is the change of each hypothesis if it begins where the other one is.
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
        memory[VARIANCE, i] -= memory[TURNED, i] + may_bear  # leaves the squared distance in the last frame
        memory[TURNED, i] *= of[FADE, i]
        apart = abs(memory[RISING_KPA, i] - memory[RECOVERY_KPA, i]) * EITHER
        if memory[LEFT, i] >= FAR:
            fallen = 0.0
            if flags[HELD, i]:
                fallen = (memory[PEAK, i] - memory[SIGN, i] * memory[PRESSURE, i]) * FALLEN
            apart += likely_kpa_of(memory, i, noise, fallen, numbers) * EARLIER
        apart *= apart
        of[SPARE, i] = apart
        # A restart has taken away most of a clear variance.
        begun = memory[VARIANCE, i] * (1.0 - GONE) > max(apart, numbers[CLEAR_KPA2])
        if unconfirmed and flags[CONFIRMED, i]:
            begun = False  # a confirmed turn settles which model was right
        flags[WHERE, i] = begun
        begun_anywhere |= begun
    if begun_anywhere:
        keep_each(memory, of, flags, numbers)
    for i in range(memory.shape[1]):
        may_bear = memory[MAY_BEAR_KPA, i] * memory[MAY_BEAR_KPA, i]
        memory[VARIANCE, i] = of[SPARE, i] + memory[TURNED, i] + may_bear
