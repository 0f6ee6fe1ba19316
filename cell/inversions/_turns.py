"""Detection of turning points: has the pressure of the paper's cell turned, and was an earlier turn a false alarm?

The pressure has turned when it has gone back from its extreme by more than noise and fading errors of the memory can
make of a held load. The other hypothesis is then taken over, but the turn stays unconfirmed until the pressure of the
model that was left has gone back, too. Until then the turn may be taken back as a false alarm. A rise that the recovery
model does not share is refuted.
"""

from __future__ import annotations

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...common.compiled import Row, Rows, SpacedRows, loop
from ..estimation import FAR, GAIN, LOADS, PRESSURE, undithered, undithered_of
from ..materials import PaperModel
from ._paper_steps import TurnWeights, fast_r
from ._turning_rows import (
    AHEAD,
    CONFIRMING_SIGMAS,
    CONFIRMING_TURNS,
    DRIFT_KPA,
    EXTREME,
    FALLEN,
    LEFT,
    NOISE,
    NOT_RECOVERY,
    NOT_RISING,
    OTHER_GAIN,
    PEAK,
    RECENT_EXTREME,
    RECOVERY_IN_FORCE,
    RECOVERY_KPA,
    RISING_IN_FORCE,
    RISING_KPA,
    SIGN,
    SPARE,
    SURE,
    THIRD_LAST,
    UNDITHERED,
    UNSURE,
    MemoryRows,
    by_steps,
    by_steps_of,
)

TURN, LIGHT_TURN, TURN_SHARE = 0.01, 0.002, 0.02
"""how far a pressure that is known exactly must have gone back for a turn: LIGHT_TURN of full scale + TURN_SHARE of the
extreme, but at most TURN of full scale. Errors of the memory grow with the load, and look like turns as they fade. Near
no load a larger limit would miss light taps, and each missed tap leaves an error in the memory"""
EXACTLY = 1e-9
"""of full scale: rounding error"""
LESS = 2.0
"""standard deviations of the smoothed noise that are subtracted from an extreme. The largest of many noisy readings is
too large by about so much; if more were subtracted, the end of a tap of few frames would be missed"""
STILL = 1.5
"""standard deviations of the reading. A fall to a load of more than this may be caused by ADC steps, of any reading
that the resistance follows from; a fall to less is a release, as most falls are"""
SHARED, CLEAR_RISE = 0.2, 0.05
"""a rise is refuted if the recovery model has risen by less than the share SHARED of it, and if it is larger than
CLEAR_RISE of full scale. Where a cell recovers under a light hold, the rising model takes the recovery for a load that
grows, while the recovery model is almost constant. A press raises both models by about as much. A press of some seconds
that begins while the cell recovers raises them less alike: a share of 0.5 would refute some of these presses"""
SHARED_FALL, CLEAR_FALL = 0.3, 0.02
"""a fall of the rising model may be a fading error of its memory, or an overshoot of the smoothing, up to this share of
the fall of the recovery model (as the rising model answers it), counted from a fall of CLEAR_FALL of full scale on.
Where the memory of the cell is large, the resistance under a held load falls so fast that the recovery model takes it
for a release, while the rising model is almost constant. A release takes both models back"""
FALLING = 6.0
"""standard deviations of the smoothed noise. A pressure that goes back by more in three frames is that of a falling
load, whatever :data:`SHARED_FALL` says: smooth loads of little noise turn so. A pressure that has gone back by more,
plus :data:`LIGHT_TURN`, from the recent extreme has turned"""
RELEASED = 3.0
"""statistic of Page's test (:mod:`._released`) above which a fall is a release, whatever :data:`SHARED_FALL` says"""
SEEN_FALLING, SURE_SEEN = 1.0, 2.0
"""statistic of that test above which means of readings show a fall, too; and the standard deviations of the smoothed
noise that then suffice for a turn, in the place of :data:`._turning_rows.SURE`, since two tests show the same fall. If
that is a false alarm, the model that is left takes it back at once"""

TURN_KPA, LIGHT_KPA, LEAST_KPA, EXACT_KPA, CLEAR_RISE_KPA, CLEAR_FALL_KPA, FALL_SHARE, STEPS, OWN_STEPS = range(10, 19)
"""places of the constants, behind those of :mod:`._limits`: pressures in kPa of a turn and of a light turn; the least
pressure, below which nothing turns; the rounding error; clear rises and falls; :data:`SHARED_FALL` as the recovery
model answers it; and standard deviations of r at rest by the ADC steps of all readings that r follows from, and of the
cell's own reading (0: unknown)"""
_ZERO, _FAR, _SURE, _LESS, _TURN_SHARE, _SHARED, _FALLING, _RELEASED, _SEEN_FALLING, _LESS_SURE = (
    np.array(x) for x in (0.0, FAR, SURE, LESS, TURN_SHARE, SHARED, FALLING, RELEASED, SEEN_FALLING, SURE - SURE_SEEN)
)
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


def numbers_of(
    model: PaperModel, full_scale_kpa: float, *, exact: bool, steps: tuple[float, float]
) -> dict[int, float]:
    """Constants of the places above; ``exact``: readings are taken as they are; ``steps``: of the last two places."""
    rise_r, fall_r = fast_r(model)
    return {
        TURN_KPA: TURN * full_scale_kpa,
        LIGHT_KPA: LIGHT_TURN * full_scale_kpa,
        # A pressure below zero is an error that fades, and no turn.
        LEAST_KPA: LOADS[0] * full_scale_kpa if exact else 0.0,
        EXACT_KPA: EXACTLY * full_scale_kpa,
        CLEAR_RISE_KPA: CLEAR_RISE * full_scale_kpa,
        CLEAR_FALL_KPA: CLEAR_FALL * full_scale_kpa,
        FALL_SHARE: SHARED_FALL * fall_r / rise_r,
        STEPS: steps[0],
        OWN_STEPS: steps[1],
    }


def turn_from(extreme: FloatArray, limit: FloatArray, numbers: tuple[FloatArray, ...]) -> None:
    """Write into ``limit`` (m,) how far exact pressures in kPa must go back from ``extreme`` (m,) for a turn."""
    np.abs(extreme, out=limit)
    limit *= _TURN_SHARE
    limit += numbers[LIGHT_KPA]
    np.minimum(limit, numbers[TURN_KPA], out=limit)


def look(of: MemoryRows, std: FloatArray, numbers: tuple[FloatArray, ...]) -> None:
    """Evaluate the hypothesis in force, for smoothed readings with a standard deviation ``std`` (m,) by noise.

    Writes the pressure; its standard deviation by noise (``unsure``); sign times pressure (``ahead``); and the part of
    a fall that may be seen without a turn (``threshold``).
    """
    np.multiply(of.pressures, of.in_force, of.share)
    np.add(of.rising_share, of.recovery_share, of.pressure)
    np.multiply(std, of.gain, of.unsure)
    of.threshold[...] = _seeming(of, numbers)
    if numbers[STEPS].item() > 0.0:
        _doubt_falls(of, std, numbers[STEPS])
    np.maximum(of.pressure, numbers[LEAST_KPA], out=of.ahead)
    of.ahead *= of.sign


def look_at_steps(memory: FloatArray, noise: FloatArray, numbers: tuple[FloatArray, ...]) -> None:
    """Find how far the ``noise`` (m,) of a reading, ADC steps included, dithers the steps; changes ``memory``."""
    if numbers[OWN_STEPS].item() > 0.0:
        memory[UNDITHERED] = undithered(noise / by_steps(memory, numbers[OWN_STEPS]))


def _seeming(of: MemoryRows, numbers: tuple[FloatArray, ...]) -> FloatArray:
    """(m,) kPa by which pressures may seem to go back though the load has not turned.

    In recovery this is the drift by a fading error of the memory. Under a rising load it is also limited to a share of
    the fall of the recovery model. It is none where the pressure has gone back by more than noise in the last three
    frames, or where Page's test of the means shows a fall.
    """
    shared: FloatArray = np.subtract(of.extreme, of.recovery_kpa, of.spare)
    shared -= numbers[CLEAR_FALL_KPA]
    np.maximum(shared, _ZERO, out=shared)
    shared *= numbers[FALL_SHARE]
    np.minimum(shared, of.drift, out=shared)
    falls = np.subtract(of.third_last, of.pressure, of.nearby)
    np.greater(falls, of.unsure * _FALLING, of.where)
    of.where |= np.greater(of.fallen, _RELEASED, of.held)
    np.copyto(shared, _ZERO, where=of.where)
    np.copyto(shared, of.drift, where=np.less(of.sign, _ZERO, of.where))
    return shared


def _doubt_falls(of: MemoryRows, std: FloatArray, steps: FloatArray) -> None:
    """Raise the threshold by the ADC steps where a rising load seems to fall, but not to none."""
    other = (of.pressures * of.not_in_force).sum(axis=0)
    stepped = by_steps(of.memory, steps) * of.undithered
    falls = (of.sign > 0.0) & (other > np.maximum(stepped, std) * of.other_gain * STILL)
    of.threshold += np.where(falls, np.maximum(stepped - std, 0.0) * of.gain * (SURE + LESS), 0.0)


def gone_back(of: MemoryRows, numbers: tuple[FloatArray, ...]) -> BoolArray:
    """(m,) where pressures have gone back by a turn from the extreme, or by a light turn from the recent extreme.

    The recent extreme fades as the error of the memory does. In recovery the threshold, which allows for the same
    error, is therefore not added to it.
    """
    turn_from(of.extreme, of.nearby, numbers)
    sure = np.multiply(np.greater(of.fallen, _SEEN_FALLING, of.where), _LESS_SURE, of.spare)
    np.subtract(_SURE, sure, sure)
    sure *= of.unsure
    of.nearby += sure
    of.nearby += of.threshold
    turned: BoolArray = np.greater(np.subtract(of.extreme, of.ahead, of.spare), of.nearby, of.where)
    np.multiply(of.unsure, _FALLING, of.nearby)
    of.nearby += numbers[LIGHT_KPA]
    of.nearby += np.multiply(of.threshold, of.rises, of.spare)
    turned |= np.greater(np.subtract(of.recent_extreme, of.ahead, of.spare), of.nearby, of.held)
    return turned


def other_gone_back(of: MemoryRows, std: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How far the other hypothesis has gone back from the extreme that was left, and its deviation by noise."""
    np.multiply(of.pressures, of.not_in_force, of.share)
    back = np.add(of.rising_share, of.recovery_share, of.spare)
    back *= of.sign
    back += of.left
    return back, np.multiply(of.other_gain, std, of.noise)


def refuted(
    of: MemoryRows, turned: BoolArray, std: FloatArray, weights: TurnWeights, numbers: tuple[FloatArray, ...]
) -> BoolArray:
    """(m,) where a rise is refuted that has just ``turned`` the pressure (m,), or is not confirmed yet.

    A rise is refuted if the recovery model does not share it (:data:`SHARED`). A turn is found at the largest of many
    noisy pressures, so that the share seems too large by :data:`LESS` standard deviations. The recovery model stays in
    force, or comes back into force, with its own memory. The rising model begins anew where the pressure is. The
    difference of the two stays in the standard deviation.
    """
    taken = of.left < _FAR
    refuted: BoolArray = taken | turned
    refuted &= taken == (of.sign > _ZERO)
    begun = np.where(taken, of.left, of.extreme)  # minus the pressure at which the rise began
    rise, shared = begun + of.rising_kpa, begun + of.recovery_kpa
    rising_gain, recovery_gain = weights.by_model[0]
    refuted &= shared < rise * _SHARED + std * (LESS * recovery_gain)
    refuted &= rise > numbers[CLEAR_RISE_KPA] + std * (SURE * rising_gain)
    return refuted


def begin_at_refuted(of: MemoryRows, refuted: BoolArray) -> None:
    """Set the extremes to the present pressure where a rise was ``refuted`` (m,)."""
    np.copyto(of.peak, of.ahead - of.unsure, where=refuted)
    np.copyto(of.extreme, of.ahead - of.unsure * _LESS, where=refuted)
    np.copyto(of.recent_extreme, of.extreme, where=refuted)


def confirm(of: MemoryRows, back: FloatArray, noise: FloatArray, numbers: tuple[FloatArray, ...]) -> None:
    """Confirm turns that the model that was left shows, too: noise does not make a turn in both models.

    ``back`` and ``noise`` (m,) are those of :func:`other_gone_back`. Marks in ``of.confirmed`` which turns were
    confirmed.
    """
    noise *= of.confirming_sigmas
    turn_from(of.left, of.nearby, numbers)
    of.nearby *= of.confirming_turns
    noise += of.nearby
    confirmed = np.greater_equal(back, noise, of.confirmed)
    confirmed &= of.left < _FAR
    np.copyto(of.left, _FAR, where=confirmed)


@loop
def turn_from_of(extreme: float, numbers: Row) -> float:
    """:func:`turn_from` of one cell."""
    return float(min(abs(extreme) * TURN_SHARE + numbers[LIGHT_KPA], numbers[TURN_KPA]))


@loop
def look_at_steps_each(memory: SpacedRows, noise: Row, numbers: Row) -> None:
    """:func:`look_at_steps` as a loop over cells."""
    if not numbers[OWN_STEPS] > 0.0:
        return
    for i in range(noise.size):
        memory[UNDITHERED, i] = undithered_of(noise[i] / by_steps_of(memory, i, numbers[OWN_STEPS]))


@loop
def seeming_of(memory: SpacedRows, i: int, unsure: float, numbers: Row) -> float:
    """:func:`_seeming` of cell ``i``, whose pressure has the standard deviation ``unsure`` by noise."""
    drift = memory[DRIFT_KPA, i]
    if memory[SIGN, i] > 0.0:
        shared = memory[EXTREME, i] - memory[RECOVERY_KPA, i] - numbers[CLEAR_FALL_KPA]
        drift = min(drift, max(shared, 0.0) * numbers[FALL_SHARE])
        if memory[THIRD_LAST, i] - memory[PRESSURE, i] > unsure * FALLING or memory[FALLEN, i] > RELEASED:
            drift = 0.0
    return float(drift)


@loop
def look_of(memory: SpacedRows, i: int, std: float, of: Rows, numbers: Row) -> bool:
    """:func:`look` at cell ``i``; returns whether it has gone back by a turn, or an earlier turn was a false alarm."""
    rising, recovery = memory[RISING_KPA, i], memory[RECOVERY_KPA, i]
    pressure = rising * memory[RISING_IN_FORCE, i] + recovery * memory[RECOVERY_IN_FORCE, i]
    sign = memory[SIGN, i]
    unsure = std * memory[GAIN, i]
    ahead = max(pressure, numbers[LEAST_KPA]) * sign
    other = rising * of[NOT_RISING, i] + recovery * of[NOT_RECOVERY, i]
    back = other * sign + memory[LEFT, i]
    noise = of[OTHER_GAIN, i] * std
    memory[PRESSURE, i] = pressure
    of[UNSURE, i], of[AHEAD, i], of[SPARE, i], of[NOISE, i] = unsure, ahead, back, noise
    seeming = seeming_of(memory, i, unsure, numbers)
    if numbers[STEPS] > 0.0 and sign > 0.0:
        stepped = by_steps_of(memory, i, numbers[STEPS]) * memory[UNDITHERED, i]
        if other > max(stepped, std) * of[OTHER_GAIN, i] * STILL:
            seeming += max(stepped - std, 0.0) * memory[GAIN, i] * (SURE + LESS)
    sure = SURE_SEEN if memory[FALLEN, i] > SEEN_FALLING else SURE
    least = turn_from_of(memory[EXTREME, i], numbers) + unsure * sure
    gone_back = memory[EXTREME, i] - ahead > least + seeming
    least = numbers[LIGHT_KPA] + unsure * FALLING
    if sign > 0.0:
        least += seeming
    gone_back |= memory[RECENT_EXTREME, i] - ahead > least
    return bool(gone_back or back < noise)


@loop
def refuted_of(memory: SpacedRows, i: int, std: float, by_model: Rows, numbers: Row) -> bool:
    """Whether the recovery model does not share the rise of cell ``i``, which has been taken over or is about to be."""
    begun = memory[LEFT, i] if memory[LEFT, i] < FAR else memory[EXTREME, i]  # minus the pressure at which it began
    rise, shared = begun + memory[RISING_KPA, i], begun + memory[RECOVERY_KPA, i]
    clear = rise > numbers[CLEAR_RISE_KPA] + std * (SURE * by_model[0, 0])
    return bool(clear and shared < rise * SHARED + std * (LESS * by_model[0, 1]))


@loop
def begin_at_refuted_of(memory: SpacedRows, i: int, of: Rows) -> None:
    """:func:`begin_at_refuted` in cell ``i``."""
    memory[PEAK, i] = of[AHEAD, i] - of[UNSURE, i]
    memory[EXTREME, i] = of[AHEAD, i] - of[UNSURE, i] * LESS
    memory[RECENT_EXTREME, i] = memory[EXTREME, i]


@loop
def confirm_of(memory: SpacedRows, i: int, of: Rows, numbers: Row) -> bool:
    """:func:`confirm` of cell ``i``, whose turn is unconfirmed, after :func:`look_of`."""
    least = of[NOISE, i] * of[CONFIRMING_SIGMAS, i]
    least += turn_from_of(memory[LEFT, i], numbers) * of[CONFIRMING_TURNS, i]
    confirmed = of[SPARE, i] >= least
    if confirmed:
        memory[LEFT, i] = FAR
    return bool(confirmed)
