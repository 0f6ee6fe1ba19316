"""A third hypothesis about the paper's cell: that the load turned earlier, which the model in force says to go on.

Where a held load lets r drift faster in the recovery model, a load that begins to fall slowly bends r by less than
that, and the rising model takes it for one that goes on slowly. The other hypothesis, which begins anew at each new
extreme, forgets how far the load has fallen. The third one began when r bent. It differs from the other hypothesis by
some kPa, which fade as errors of its model do (the slow branch neglected). No load falls and rises at the same time:
where the pressure of this hypothesis rises by more than a turn and noise, it begins anew, too. A press that rises
quickly therefore begins it at each frame. By how much the rising model's pressure grows counts from there, but for
frames in which this hypothesis seems to rise. In recovery all this holds with rises and falls exchanged.

Of a smooth turn the model in force notices nothing for some frames. The pressure goes back by too little, so that the
other hypothesis begins anew once more, after the turn. What it forgets by that in frames in which the pressure goes
back is told apart: when the turn is noticed, it was a part of the fall, and is given back. A load that is held falls by
almost none, and what it forgot for long is no part of its release.
"""

from __future__ import annotations

import math

import numpy as np

from ...arrays import BoolArray, FloatArray
from ...compiled import Row, Rows, SpacedRows, loop
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
"""standard deviation over what an earlier turn would make: none of that is wrong, or all (the root mean square). And
share of it that is taken back when a turn is noticed"""
GROWN, GROWN_SIGMAS, GROWN_ERRORS, FALLEN = 0.5, 1.5, 0.2, 2.0
"""light turns, standard deviations of the smoothed noise, and of the memory, by which the pressure must have grown for
an earlier turn to be as likely as none; and how much more a fall counts than growth. Constant loads are common. A load
that falls at just the rate that makes the rising model's pressure constant is not"""
GROWN_RELEASED = 1.5
"""the third of these in recovery: errors of the memory are largest there, and fade"""
OF_FALL, LASTS = 4.0, 6.0
"""of what the model in force goes back by in a frame: no more is given back of what the other hypothesis forgot in it.
And by how much sooner that is no part of a turn than an error of the memory fades: within about half a second"""

GROWN_KPA, SURE_RISING, SURE_RECOVERY, TURN_RECOVERY = range(19, 23)
"""places of numbers, behind those of :mod:`._turns`: :data:`GROWN`; standard deviations of the model in force by which
the pressure of this hypothesis rises for sure, where that model is the rising and the recovery model; and what a turn
of the latter is in this hypothesis"""
_ZERO, _ONE, _FAR, _OF_FALL, _LASTS = (np.array(x) for x in (0.0, 1.0, FAR, OF_FALL, LASTS))
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


def numbers_of(model: PaperModel, full_scale_kpa: float) -> dict[int, float]:
    """Numbers of the places above."""
    rise_r, fall_r = fast_r(model)
    ratio = rise_r / fall_r
    return {
        GROWN_KPA: GROWN * LIGHT_TURN * full_scale_kpa,
        SURE_RISING: SURE * ratio,
        SURE_RECOVERY: SURE / ratio,
        TURN_RECOVERY: 1.0 / ratio,
    }


def rose_before(of: MemoryRows) -> BoolArray:
    """(m,) where the pressure rose before a turn that is not confirmed yet, or does if there is none."""
    rose: BoolArray = (of.sign > _ZERO) == (of.left >= _FAR)
    return rose


def fade(of: MemoryRows, weights: TurnWeights) -> None:
    """Let what the third hypothesis differs by fade for a time step."""
    rising_fade, recovery_fade = weights.fades
    of.earlier *= np.where(rose_before(of), recovery_fade, rising_fade)


def follow(of: MemoryRows, numbers: tuple[FloatArray, ...], *, unconfirmed: bool) -> None:
    """Follow the third hypothesis, where the other one has just begun ``of.change`` anew.

    ``unconfirmed``: turns may be, and ``of.confirmed`` marks those that no longer are.
    """
    rose = rose_before(of)
    sign = np.where(rose, 1.0, -1.0)
    forgotten = np.add(of.change[RISING], of.change[RECOVERY], of.spare)
    forgotten *= sign
    of.earlier += forgotten
    _count_forgotten(of, forgotten, sign)
    other = np.where(rose, of.recovery_kpa, -of.rising_kpa)
    # no load falls below none, or rises beyond the usual
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
    """Count what was ``forgotten`` (m,) kPa in a frame in which the pressure goes back, which had ``sign`` (m,)."""
    fallen = (of.last - of.pressure) * sign
    of.forgotten += np.minimum(forgotten, fallen * _OF_FALL)
    of.forgotten *= np.maximum(_ONE - (_ONE - of.fade) * _LASTS, _ZERO)
    np.copyto(of.forgotten, _ZERO, where=(fallen < _ZERO) | (of.forgotten < _ZERO))


def likely_kpa(
    memory: FloatArray, unsure: FloatArray, fallen: FloatArray, numbers: tuple[FloatArray, ...]
) -> FloatArray:
    """(m,) kPa by which an earlier turn would take the pressure back, as far as the load does not seem constant.

    ``unsure`` (m,) is the standard deviation of the pressures by noise. By ``fallen`` (m,) the pressure has gone back,
    which no constant load does either. Cells that are taken for cells at rest bear none.
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
    """1 if the pressure of cell ``i`` rose before an unconfirmed turn, or does if there is none; else -1."""
    sign = memory[SIGN, i]
    return float(-sign if memory[LEFT, i] < FAR else sign)


@loop
def follow_of(memory: SpacedRows, i: int, forgotten_kpa: float, confirmed: bool, of: Rows, numbers: Row) -> None:
    """:func:`follow` in cell ``i``.

    The other hypothesis began ``forgotten_kpa`` anew; a turn has just been ``confirmed``.
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
