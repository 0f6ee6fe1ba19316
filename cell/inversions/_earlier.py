"""A third hypothesis about the paper's cell: the load turned earlier, though the model in force says that it goes on.

Where r under a held load drifts faster in the recovery model than in the rising model, a load that begins to fall
slowly bends r by less than this drift. The rising model then takes the load for one that goes on slowly. The other
hypothesis, which begins anew at each new extreme, loses how far the load has fallen. The third hypothesis keeps it: it
began when r bent. We store the difference between the third and the other hypothesis, in kPa; it fades as errors of its
model do (the slow branch neglected).

No load falls and rises at the same time. Where the pressure of the third hypothesis rises by more than a turn and
noise, it therefore begins anew, too; in a quick press it does so at each frame. The growth of the rising model's
pressure counts from there, except for frames in which the third hypothesis seems to rise. In recovery all this holds
with rises and falls exchanged.

The model in force notices a smooth turn some frames late. Until then the pressure goes back by so little that the other
hypothesis begins anew once more, after the turn. The part of the fall that it loses by this, in frames in which the
pressure goes back, is counted separately (the forgotten pressure) and given back when the turn is noticed. Under a held
load this part is almost none, and older parts fade quickly, since they are no part of the release.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...common.compiled import Row, Rows, SpacedRows, loop
from ..estimation import FAR, PRESSURE, RESTED
from ..materials import PaperModel
from ._limits import USUAL_KPA
from ._paper_steps import TurnWeights, fast_r
from ._turning_rows import (
    EARLIER_FROM_KPA,
    EARLIER_KPA,
    EARLIER_LEAST_KPA,
    EXTREME,
    FADE,
    FORGOTTEN_KPA,
    LAST,
    LEFT,
    PEAK,
    RECOVERY,
    RECOVERY_KPA,
    RISING,
    RISING_KPA,
    SIGN,
    SURE,
    TURNED,
    UNSURE,
    MemoryRows,
)
from ._turns import LIGHT_TURN, turn_from, turn_from_of

EARLIER, MIDWAY = 0.7, 0.5
"""standard deviation over the change of pressure by an earlier turn: all of this change is real, or none (the root mean
square). And the share of the change that is taken when a turn is noticed"""
GROWN, GROWN_SIGMAS, GROWN_ERRORS, FALLEN = 0.5, 1.5, 0.2, 2.0
"""an earlier turn is as likely as none when the pressure has grown by GROWN light turns + GROWN_SIGMAS standard
deviations of the smoothed noise + GROWN_ERRORS of the memory; a fall counts FALLEN times as much as growth. Growth is
asked for since constant loads are common, while a load that falls at just the rate at which the rising model's pressure
stays constant is rare"""
GROWN_RELEASED = 1.5
"""GROWN_ERRORS in recovery, where errors of the memory are largest, and fade"""
OF_FALL, LASTS = 4.0, 6.0
"""the forgotten pressure of a frame counts up to OF_FALL times the fall of the model in force in that frame; and it
fades LASTS times as fast as the variance of the memory, within about half a second"""

GROWN_KPA, SURE_RISING, SURE_RECOVERY, TURN_RECOVERY = range(19, 23)
"""places of the constants, behind those of :mod:`._turns`: :data:`GROWN` in kPa; standard deviations of the model in
force by which the pressure of the third hypothesis must rise to rise for sure, with the rising model in force and with
the recovery model; and a turn of the third hypothesis over one of the recovery model"""
_ZERO, _ONE, _FAR, _OF_FALL, _LASTS = (np.array(x) for x in (0.0, 1.0, FAR, OF_FALL, LASTS))
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


def numbers_of(model: PaperModel, full_scale_kpa: float) -> dict[int, float]:
    """Constants of the places above."""
    rise_r, fall_r = fast_r(model)
    ratio = rise_r / fall_r
    return {
        GROWN_KPA: GROWN * LIGHT_TURN * full_scale_kpa,
        SURE_RISING: SURE * ratio,
        SURE_RECOVERY: SURE / ratio,
        TURN_RECOVERY: 1.0 / ratio,
    }


def rose_before(of: MemoryRows) -> BoolArray:
    """(m,) whether the pressure rose before the unconfirmed turn; without one, whether it rises now."""
    rose: BoolArray = (of.sign > _ZERO) == (of.left >= _FAR)
    return rose


def fade(of: MemoryRows, weights: TurnWeights) -> None:
    """Let the difference of the third hypothesis from the other one fade for a time step."""
    rising_fade, recovery_fade = weights.fades
    of.earlier *= np.where(rose_before(of), recovery_fade, rising_fade)


def follow(of: MemoryRows, numbers: tuple[FloatArray, ...], *, unconfirmed: bool) -> None:
    """Follow the third hypothesis after the other one has changed by ``of.change``, beginning anew.

    ``unconfirmed``: turns may be unconfirmed, and ``of.confirmed`` marks those that have just been confirmed.
    """
    rose = rose_before(of)
    sign = np.where(rose, 1.0, -1.0)
    forgotten = np.add(of.change[RISING], of.change[RECOVERY], of.spare)
    forgotten *= sign
    of.earlier += forgotten
    _count_forgotten(of, forgotten, sign)
    other = np.where(rose, of.recovery_kpa, -of.rising_kpa)
    # no load falls below none or rises beyond the usual
    np.minimum(of.earlier, other + np.where(rose, _ZERO, numbers[USUAL_KPA]), out=of.earlier)
    ahead = np.subtract(other, of.earlier, of.spare)
    np.minimum(of.earlier_least, ahead, out=of.earlier_least)
    ahead -= of.earlier_least
    ahead -= of.unsure * np.where(rose, numbers[SURE_RISING], numbers[SURE_RECOVERY])
    way = (of.pressure - of.last) * sign
    np.add(of.earlier_from, way, of.earlier_from, where=np.greater(ahead, _ZERO, of.where))
    turn_from(of.extreme, of.nearby, numbers)
    of.nearby *= np.where(rose, _ONE, numbers[TURN_RECOVERY])
    anew = np.greater(ahead, of.nearby, of.where)
    if unconfirmed:
        anew |= of.confirmed
    np.copyto(of.earlier, _ZERO, where=anew)
    np.copyto(of.earlier_least, other, where=anew)
    np.copyto(of.earlier_from, of.pressure * sign, where=anew)


def _count_forgotten(of: MemoryRows, forgotten: FloatArray, sign: FloatArray) -> None:
    """Count the ``forgotten`` (m,) kPa of a frame in which the pressure goes back from its direction ``sign`` (m,)."""
    fallen = (of.last - of.pressure) * sign
    of.forgotten += np.minimum(forgotten, fallen * _OF_FALL)
    of.forgotten *= np.maximum(_ONE - (_ONE - of.fade) * _LASTS, _ZERO)
    np.copyto(of.forgotten, _ZERO, where=(fallen < _ZERO) | (of.forgotten < _ZERO))


def likely_kpa(
    memory: FloatArray, unsure: FloatArray, fallen: FloatArray, numbers: tuple[FloatArray, ...]
) -> FloatArray:
    """(m,) kPa by which an earlier turn would take the pressure back, times its weight.

    The weight is small while the load seems constant: with g = growth (or ``fallen``) over the growth at which an
    earlier turn is as likely as none (:data:`GROWN`), it is g^2/(g^2 + 1). ``unsure`` (m,) is the standard deviation of
    the pressures by noise; ``fallen`` (m,) is how far the pressure has gone back, which a constant load does not. Cells
    that are taken for cells at rest bear no load.
    """
    grown = np.maximum(np.maximum(memory[PEAK] - memory[EARLIER_FROM_KPA], fallen), _ZERO)
    released = memory[SIGN] < _ZERO
    errors = np.where(released, GROWN_RELEASED, GROWN_ERRORS)
    grown /= unsure * GROWN_SIGMAS + np.sqrt(memory[TURNED]) * errors + numbers[GROWN_KPA]
    grown *= grown
    kpa: FloatArray = np.maximum(memory[EARLIER_KPA], _ZERO) * (grown / (grown + _ONE))
    np.copyto(kpa, _ZERO, where=released & (memory[RESTED] > _ZERO))
    return kpa


@loop
def sign_before_of(memory: SpacedRows, i: int) -> float:
    """1 if the pressure of cell ``i`` rose before the unconfirmed turn (without one: rises now), else -1."""
    sign = memory[SIGN, i]
    return float(-sign if memory[LEFT, i] < FAR else sign)


@loop
def follow_of(memory: SpacedRows, i: int, forgotten_kpa: float, confirmed: bool, of: Rows, numbers: Row) -> None:
    """:func:`follow` in cell ``i``.

    The other hypothesis has just changed by ``forgotten_kpa``, beginning anew; ``confirmed``: a turn has just been.
    """
    sign, by_noise = sign_before_of(memory, i), of[UNSURE, i]
    least = turn_from_of(memory[EXTREME, i], numbers)
    if sign > 0.0:
        other = most = memory[RECOVERY_KPA, i]
        by_noise *= numbers[SURE_RISING]
    else:
        other, most = -memory[RISING_KPA, i], numbers[USUAL_KPA] - memory[RISING_KPA, i]
        by_noise *= numbers[SURE_RECOVERY]
        least *= numbers[TURN_RECOVERY]
    earlier = min(memory[EARLIER_KPA, i] + forgotten_kpa * sign, most)
    ahead = other - earlier
    fallen, lasts = (memory[LAST, i] - memory[PRESSURE, i]) * sign, max(1.0 - (1.0 - of[FADE, i]) * LASTS, 0.0)
    kept = (memory[FORGOTTEN_KPA, i] + min(forgotten_kpa * sign, fallen * OF_FALL)) * lasts
    memory[FORGOTTEN_KPA, i] = 0.0 if fallen < 0.0 else max(kept, 0.0)
    memory[EARLIER_KPA, i] = earlier
    memory[EARLIER_LEAST_KPA, i] = min(memory[EARLIER_LEAST_KPA, i], ahead)
    ahead -= memory[EARLIER_LEAST_KPA, i] + by_noise
    if ahead > 0.0:
        memory[EARLIER_FROM_KPA, i] += (memory[PRESSURE, i] - memory[LAST, i]) * sign
    if confirmed or ahead > least:
        memory[EARLIER_KPA, i], memory[EARLIER_LEAST_KPA, i] = 0.0, other
        memory[EARLIER_FROM_KPA, i] = memory[PRESSURE, i] * sign


@loop
def likely_kpa_of(memory: SpacedRows, i: int, unsure: float, fallen: float, numbers: Row) -> float:
    """:func:`likely_kpa` of cell ``i``."""
    grown = max(memory[PEAK, i] - memory[EARLIER_FROM_KPA, i], fallen, 0.0)
    errors = GROWN_ERRORS
    if memory[SIGN, i] < 0.0:
        if memory[RESTED, i] > 0.0:
            return 0.0
        errors = GROWN_RELEASED
    errors *= math.sqrt(memory[TURNED, i])
    grown /= unsure * GROWN_SIGMAS + errors + numbers[GROWN_KPA]
    grown *= grown
    return float(max(memory[EARLIER_KPA, i], 0.0) * (grown / (grown + 1.0)))
