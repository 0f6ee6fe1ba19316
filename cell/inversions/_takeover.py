"""What a turn of the pressure leaves where the other hypothesis about the paper's cell is taken over, and its doubt.

The turn falls between two frames, and is noticed later still. How far the load went meanwhile is not known: that stays
in the standard deviation until it fades. Where a load turned smoothly, its delay can be told and is taken back.
"""

from __future__ import annotations

import math

import numpy as np

from ...arrays import FloatArray, IntArray
from ...compiled import Row, Rows, loop
from ..estimation import FAR, GAIN, PRESSURE, VARIANCE
from ..materials import PaperModel
from . import _onset as onset
from . import _recovery as recovery
from ._earlier import MIDWAY, likely_kpa, likely_kpa_of
from ._limits import E1_KPA, SETTLED_PER_KPA, UNKNOWN_KPA2, USUAL_KPA
from ._onset import hidden_kpa_of
from ._paper_steps import TurnWeights, fast_r
from ._recovery import begin_of, variance_at_turn_of
from ._turning_rows import (
    BEFORE_LAST,
    EARLIER_KPA,
    EXTREME,
    FORGOTTEN_KPA,
    IN_FORCE,
    LAST,
    LEFT,
    LOOKS_AT_REST,
    MAY_BEAR_KPA,
    PEAK,
    RECENT_EXTREME,
    RECOVERY,
    RECOVERY_IN_FORCE,
    RECOVERY_KPA,
    REFUTED,
    RELEASED_KPA,
    RISING,
    RISING_IN_FORCE,
    RISING_KPA,
    SETTLED,
    SIGN,
    STATE,
    SURE,
    THIRD_LAST,
    TURNED,
    X2,
    take_gains_of,
)
from ._turns import EXACT_KPA, LESS, TURN

ROUND = 2e-3
"""of full scale: an error of the pressure at a slow turn, which is noticed late"""
FAST = 2.0
"""turns by which the pressure changes in the frame of a turn, from which the turn is noticed at once"""
BETWEEN = 0.3
"""of the way of a load in a frame: how far beyond the frames it turned. Between none and half; the root mean square"""
HALF = 0.5
"""of the way of the frame before: no less counts in the frame of a turn, since to and fro may leave a small way"""
JUST_BEGUN = 3.0
"""times the way of a frame: how far a load may go in a frame, since it may have begun to move in the midst of the one
before"""
SMOOTH, AWAY = 0.4, 0.02
"""turns by which a pressure may be unsure where the delay of a smooth turn is told; in more noise it cannot be. And of
full scale by which the extreme must differ from none, where pressures that are too low have been corrected already"""
MAY_BEND = 0.5
"""standard deviation of what such a delay makes, over that: the load may have turned with a bend after all"""

RISE_R, FALL_R, BEND, FAST_KPA, ROUND_KPA, SMOOTH_KPA, AWAY_KPA, MOST_RESTED_KPA2 = range(23, 31)
"""places of numbers, behind those of :mod:`._earlier`: r per kPa of a fast rise, and of a fast fall; by how much the
former exceeds the latter; what the constants above make of full scale; and the variance of :data:`._recovery.MOST`"""
_ZERO, _ONE, _FAR, _SURE, _LESS, _HALF, _JUST_BEGUN = (
    np.array(x) for x in (0.0, 1.0, FAR, SURE, LESS, HALF, JUST_BEGUN)
)
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


def numbers_of(model: PaperModel, full_scale_kpa: float) -> dict[int, float]:
    """Numbers of the places above."""
    rise_r, fall_r = fast_r(model)
    return {
        RISE_R: rise_r,
        FALL_R: fall_r,
        BEND: rise_r - fall_r,
        FAST_KPA: FAST * TURN * full_scale_kpa,
        ROUND_KPA: ROUND * full_scale_kpa,
        SMOOTH_KPA: SMOOTH * (TURN * full_scale_kpa),
        AWAY_KPA: AWAY * full_scale_kpa,
        MOST_RESTED_KPA2: (recovery.MOST * full_scale_kpa) ** 2,
    }


def take_over(
    memory: FloatArray, turned: IntArray, std: FloatArray, weights: TurnWeights, numbers: tuple[FloatArray, ...]
) -> None:
    """Take over the other hypothesis where the pressure has just ``turned``.

    Args:
        memory: (rows, m) of the cells, changed.
        turned: indices of cells.
        std: (m,) or (1,) what noise leaves in the reading.
        weights: of the time step.
        numbers: as above.
    """
    some = memory.take(turned, axis=1)
    left, extreme, sign = some[LEFT], some[EXTREME].copy(), some[SIGN]
    again = left < _FAR
    noise = std.take(turned) if std.size > 1 else std
    late = _late(some, noise, numbers)
    earlier = likely_kpa(some, noise * some[GAIN], _ZERO, numbers) * MIDWAY
    np.copyto(earlier, _ZERO, where=sign < _ZERO)
    np.maximum(earlier, some[FORGOTTEN_KPA], out=earlier)
    np.copyto(earlier, _ZERO, where=again)
    some[FORGOTTEN_KPA] = 0.0
    np.negative(sign, sign)
    some[IN_FORCE] = some[IN_FORCE][::-1].copy()
    gain = weights.by_model[0].dot(some[IN_FORCE])
    pressure = some[RISING_KPA] * some[RISING_IN_FORCE]
    pressure += some[RECOVERY_KPA] * some[RECOVERY_IN_FORCE]
    unsure = noise * gain
    # When the pressure turned is as doubtful as it was in the last frame whether it had turned.
    before = recovery.variance_at_turn(some)
    rounded = numbers[FAST_KPA] / np.maximum(np.abs(pressure - some[LAST]), numbers[FAST_KPA])
    unseen = _unseen(some, pressure, gain, unsure, numbers) + rounded * numbers[ROUND_KPA]
    noticed = ~again & (extreme < REFUTED)
    hidden = onset.hidden_kpa(some, pressure, extreme, numbers[FALL_R] / numbers[RISE_R])
    unseen += np.where(noticed & (sign > _ZERO), hidden, _ZERO)
    np.copyto(some[LOOKS_AT_REST], _ZERO, where=noticed & (sign < _ZERO))
    some[MAY_BEAR_KPA] = 0.0
    by_noise = noise * weights.by_model[0, RECOVERY]
    by_noise *= by_noise
    doubt = np.sqrt(before) + unseen
    doubt = np.minimum(doubt * doubt + by_noise, numbers[UNKNOWN_KPA2])
    some[TURNED] = some[VARIANCE] = doubt  # the distance of the hypotheses is in it
    recovery.begin(some, by_noise, numbers[MOST_RESTED_KPA2])
    some[RELEASED_KPA] = np.where(noticed & (sign < _ZERO), extreme, _ZERO)
    if np.count_nonzero(late) or np.count_nonzero(earlier):
        some[EARLIER_KPA] -= np.maximum(late, earlier)
        pressure = _take_delay_back(some, pressure, late, earlier, numbers)
    now = sign * np.maximum(pressure, _ZERO)
    some[EXTREME] = now - unsure * _LESS
    some[PEAK] = now - unsure
    if np.count_nonzero(again):
        np.copyto(some[EXTREME], left, where=again)
        np.copyto(some[PEAK], left, where=again)
        np.copyto(extreme, FAR, where=again)
    some[RECENT_EXTREME] = some[EXTREME]
    some[LEFT] = extreme
    memory[:, turned] = some


def _unseen(
    memory: FloatArray, pressure: FloatArray, gain: FloatArray, unsure: FloatArray, numbers: tuple[FloatArray, ...]
) -> FloatArray:
    """(m,) standard deviation in kPa that turns between two frames leave in ``pressure`` (m,), known to ``unsure``.

    The extreme itself falls between two frames. How far it was beyond them is up to half of the way that the load went
    in a frame before or after, whichever is less; in the frame of the turn itself it may have gone to and fro. On that
    way r goes up by one model and down by the other. All turns err to the same side, so these errors add up like
    amounts rather than like variances. A way that noise, or a converter that flips between two codes, would go as well
    is no way of the load.
    """
    last, before, third = memory[LAST : THIRD_LAST + 1]
    there = np.maximum(memory[SIGN] * (third - before), memory[SIGN] * (before - last))
    there = np.maximum(there, _ZERO)
    way = np.minimum(there * _JUST_BEGUN, np.maximum(np.abs(pressure - last), there * _HALF))
    by_load: FloatArray = np.maximum(way - unsure * _SURE, _ZERO)
    return by_load * BETWEEN * numbers[BEND] * gain


def _late(memory: FloatArray, noise: FloatArray, numbers: tuple[FloatArray, ...]) -> FloatArray:
    """(m,) kPa by which the pressure of the model that is left was off when it turned, for readings with ``noise``.

    Where a held load lets r drift faster in the model that is taken over than in the one that is left, r bends at the
    turn, and that bend looks like a load that goes on. The model that is left turns later than a smooth load then. Let
    the load be a parabola in time, and r answer changes by a model's response to fast ones. The ways back of the two
    hypotheses, ``gone`` in the model that is left and ``way`` in the other, then tell both the drift and the delay, and
    with them the error. Where the load bent (corners of a ramp), both ways answer the same change of r, and no error is
    found.
    """
    sign, extreme = memory[SIGN], memory[EXTREME]
    rises = sign > _ZERO
    left_r = np.where(rises, numbers[RISE_R], numbers[FALL_R])
    other_r = np.where(rises, numbers[FALL_R], numbers[RISE_R])
    unsure = noise * memory[GAIN]
    top = extreme + unsure
    rising, recovers = memory[RISING_KPA] * sign, memory[RECOVERY_KPA] * sign
    gone = np.maximum(top - np.where(rises, rising, recovers), numbers[EXACT_KPA])
    way = top - np.where(rises, recovers, rising)
    by_drift = way * other_r / left_r - gone
    smooth = (by_drift > unsure * _SURE) & (unsure < numbers[SMOOTH_KPA]) & (memory[LEFT] >= _FAR)
    smooth &= (np.abs(extreme) > numbers[AWAY_KPA]) & (extreme < numbers[USUAL_KPA])
    error = by_drift * by_drift * (left_r + other_r) / (4.0 * other_r * gone)
    late: FloatArray = np.where(smooth, np.minimum(error, way), _ZERO)
    return late


def _take_delay_back(
    memory: FloatArray, pressure: FloatArray, late: FloatArray, earlier: FloatArray, numbers: tuple[FloatArray, ...]
) -> FloatArray:
    """Correct the ``pressure`` (m,) of the hypothesis taken over; changes its ``memory``.

    It is corrected by ``late`` (m,) kPa, or by what an ``earlier`` (m,) turn makes likely or was forgotten of the fall,
    whichever is more. The deviation counts the latter already.

    Returns:
        (m,) kPa.
    """
    state = memory[STATE]
    rises = memory[SIGN] > _ZERO
    by_bend = late * MAY_BEND
    late = np.maximum(late, earlier)
    corrected: FloatArray = pressure + memory[SIGN] * late
    np.copyto(state[RISING], corrected, where=rises)
    np.copyto(state[RECOVERY], corrected, where=~rises)
    memory[SETTLED] += np.where(rises, late * numbers[SETTLED_PER_KPA], _ZERO)
    memory[X2] += np.where(rises, _ZERO, late / numbers[E1_KPA])
    memory[PRESSURE] = corrected
    doubt = np.sqrt(memory[TURNED]) + by_bend
    np.copyto(memory[TURNED], np.minimum(doubt * doubt, numbers[UNKNOWN_KPA2]), where=late > _ZERO)
    memory[VARIANCE] = memory[TURNED]
    return corrected


@loop
def unseen_of(memory: Rows, i: int, pressure: float, gain: float, unsure: float, numbers: Row) -> float:
    """Standard deviation that turns between two frames leave in the ``pressure`` of cell ``i``."""
    last, before, third, sign = memory[LAST, i], memory[BEFORE_LAST, i], memory[THIRD_LAST, i], memory[SIGN, i]
    there = max(sign * (third - before), sign * (before - last), 0.0)
    way = min(JUST_BEGUN * there, max(abs(pressure - last), HALF * there))
    by_load = max(way - SURE * unsure, 0.0)
    return float(BETWEEN * by_load * numbers[BEND] * gain)


@loop
def late_of(memory: Rows, i: int, noise: float, numbers: Row) -> float:
    """By how much the pressure of the model that cell ``i`` leaves was off when it turned."""
    sign, extreme = memory[SIGN, i], memory[EXTREME, i]
    unsure = noise * memory[GAIN, i]
    if not (unsure < numbers[SMOOTH_KPA] and numbers[AWAY_KPA] < abs(extreme) and extreme < numbers[USUAL_KPA]):
        return 0.0
    top = extreme + unsure
    left, other = memory[RISING_KPA, i] * sign, memory[RECOVERY_KPA, i] * sign
    left_r, other_r = numbers[RISE_R], numbers[FALL_R]
    if sign < 0.0:
        left, other, left_r, other_r = other, left, other_r, left_r
    gone, way = max(top - left, numbers[EXACT_KPA]), top - other
    by_drift = way * other_r / left_r - gone
    if not by_drift > unsure * SURE:
        return 0.0
    return float(min(by_drift * by_drift * (left_r + other_r) / (4.0 * other_r * gone), way))


@loop
def take_over_of(memory: Rows, i: int, noise: float, by_model: Rows, of: Rows, numbers: Row) -> None:
    """:func:`take_over` in cell ``i``, with what depends on its hypothesis in force."""
    left, extreme = memory[LEFT, i], memory[EXTREME, i]
    late = late_of(memory, i, noise, numbers) if left >= FAR else 0.0
    earlier = 0.0
    if left >= FAR:
        if memory[SIGN, i] > 0.0:
            earlier = likely_kpa_of(memory, i, noise * memory[GAIN, i], 0.0, numbers) * MIDWAY
        earlier = max(earlier, memory[FORGOTTEN_KPA, i])
    memory[FORGOTTEN_KPA, i] = 0.0
    sign = -memory[SIGN, i]
    rising, recovers = memory[RECOVERY_IN_FORCE, i], memory[RISING_IN_FORCE, i]
    memory[SIGN, i], memory[RISING_IN_FORCE, i], memory[RECOVERY_IN_FORCE, i] = sign, rising, recovers
    take_gains_of(memory, i, by_model, of)
    gain = memory[GAIN, i]
    pressure = memory[RISING_KPA, i] * rising + memory[RECOVERY_KPA, i] * recovers
    unsure = noise * gain
    # When the pressure turned is as doubtful as it was in the last frame whether it had turned.
    before = variance_at_turn_of(memory, i)
    rounded = numbers[FAST_KPA] / max(abs(pressure - memory[LAST, i]), numbers[FAST_KPA]) * numbers[ROUND_KPA]
    unseen = unseen_of(memory, i, pressure, gain, unsure, numbers) + rounded
    if left >= FAR and extreme < REFUTED:
        if sign > 0.0:
            unseen += hidden_kpa_of(memory, i, pressure, extreme, numbers[FALL_R] / numbers[RISE_R])
        else:
            memory[LOOKS_AT_REST, i] = 0.0
    memory[MAY_BEAR_KPA, i] = 0.0
    doubt = math.sqrt(before) + unseen
    by_noise = by_model[0, 1] * noise
    by_noise *= by_noise
    turned = min(doubt * doubt + by_noise, numbers[UNKNOWN_KPA2])
    memory[TURNED, i] = memory[VARIANCE, i] = turned  # the distance of the hypotheses is in it
    begin_of(memory, i, by_noise, numbers[MOST_RESTED_KPA2])
    memory[RELEASED_KPA, i] = extreme if left >= FAR and extreme < REFUTED and sign < 0.0 else 0.0
    if max(late, earlier) > 0.0:
        doubt = math.sqrt(turned) + late * MAY_BEND
        memory[TURNED, i] = memory[VARIANCE, i] = min(doubt * doubt, numbers[UNKNOWN_KPA2])
        late = max(late, earlier)
        memory[EARLIER_KPA, i] -= late
        pressure += sign * late
        memory[PRESSURE, i] = pressure
        if sign > 0.0:
            memory[RISING_KPA, i] = pressure
            memory[SETTLED, i] += late * numbers[SETTLED_PER_KPA]
        else:
            memory[RECOVERY_KPA, i] = pressure
            memory[X2, i] += late / numbers[E1_KPA]
    now = sign * max(pressure, 0.0)
    if left < FAR:
        memory[EXTREME, i], memory[PEAK, i], memory[LEFT, i] = left, left, FAR
    else:
        memory[EXTREME, i], memory[PEAK, i], memory[LEFT, i] = now - LESS * unsure, now - unsure, extreme
    memory[RECENT_EXTREME, i] = memory[EXTREME, i]
