"""Model switch at a turn of the pressure: the other hypothesis about the paper's cell is taken over, with its variance.

The turn falls between two frames, and is noticed later still. How far the load went in between is unknown, and stays in
the standard deviation until the error fades. The part of a fall that the other hypothesis lost where it began anew too
late is given back (:mod:`._earlier`).

A load that sags while it is held may read as a constant one. The pressure that is left after the release then tells
which of both it was, since most released cells bear no load. :mod:`._recovery` therefore counts the possible sag as an
error of the memory, however likely it seemed while the load was held.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import FloatArray, IntArray, columns
from ...common.compiled import Row, Rows, SpacedRows, loop
from ..estimation import FAR, GAIN, PRESSURE, VARIANCE
from ..materials import PaperModel
from . import _onset as onset
from . import _recovery as recovery
from ._earlier import EARLIER, MIDWAY, likely_kpa, likely_kpa_of
from ._limits import E1_KPA, SETTLED_PER_KPA, UNKNOWN_KPA2
from ._onset import hidden_kpa_of
from ._paper_steps import TurnWeights, fast_r
from ._recovery import begin_of, variance_at_turn_of
from ._turning_rows import (
    BEFORE_LAST,
    EARLIER_KPA,
    EXTREME,
    FALLEN,
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
from ._turns import LESS, TURN

ROUND = 2e-3
"""of full scale: standard deviation of the pressure by a slow turn, which is noticed late"""
FAST = 2.0
"""times :data:`._turns.TURN`: if the pressure changes by more in the frame of a turn, the turn is noticed at once.
Beyond, the error :data:`ROUND` is divided by how many times more the pressure changes"""
BETWEEN = 0.3
"""of the way of a load in a frame: standard deviation of how far beyond the readings the load went before it turned.
That is between none and half; the root mean square"""
JUST_BEGUN = 3.0
"""times the way of a load in a frame: the most that it may go in the next frame, since it may have begun to move in the
middle of the first one"""
FALL_PER_RISE, BEND, FAST_KPA, ROUND_KPA, MOST_RESTED_KPA2 = range(23, 28)
"""places of the constants, behind those of :mod:`._earlier`: r per kPa of a fast fall over that of a fast rise; the
difference of both; :data:`FAST` and :data:`ROUND` in kPa; and the variance of :data:`._recovery.MOST`"""
_ZERO, _FAR, _SURE, _LESS, _JUST_BEGUN = (np.array(x) for x in (0.0, FAR, SURE, LESS, JUST_BEGUN))
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


def numbers_of(model: PaperModel, full_scale_kpa: float) -> dict[int, float]:
    """Constants of the places above."""
    rise_r, fall_r = fast_r(model)
    return {
        FALL_PER_RISE: fall_r / rise_r,
        BEND: rise_r - fall_r,
        FAST_KPA: FAST * TURN * full_scale_kpa,
        ROUND_KPA: ROUND * full_scale_kpa,
        MOST_RESTED_KPA2: (recovery.MOST * full_scale_kpa) ** 2,
    }


def take_over(
    memory: FloatArray, turned: IntArray, std: FloatArray, weights: TurnWeights, numbers: tuple[FloatArray, ...]
) -> None:
    """Take over the other hypothesis where the pressure has just ``turned``.

    Args:
        memory: (rows, m) of the cells, changed.
        turned: indices of cells.
        std: (m,) or (1,) standard deviation of the smoothed reading by noise.
        weights: of the time step.
        numbers: as above.
    """
    some = columns(memory, turned)
    left, extreme, sign = some[LEFT], some[EXTREME].copy(), some[SIGN]
    again = left < _FAR
    noise = std.take(turned) if std.size > 1 else std
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
    # The moment of the turn is as uncertain as it was in the last frame whether the pressure had turned.
    before = recovery.variance_at_turn(some)
    rounded = numbers[FAST_KPA] / np.maximum(np.abs(pressure - some[LAST]), numbers[FAST_KPA])
    unseen = _unseen(some, pressure, gain, unsure, numbers) + rounded * numbers[ROUND_KPA]
    noticed = ~again & (extreme < REFUTED)
    hidden = onset.hidden_kpa(some, pressure, extreme, numbers[FALL_PER_RISE])
    unseen += np.where(noticed & (sign > _ZERO), hidden, _ZERO)
    np.copyto(some[LOOKS_AT_REST], _ZERO, where=noticed & (sign < _ZERO))
    some[[MAY_BEAR_KPA, FALLEN]] = 0.0
    by_noise = noise * weights.by_model[0, RECOVERY]
    by_noise *= by_noise
    doubt = np.sqrt(before) + unseen
    doubt = np.minimum(doubt * doubt + by_noise, numbers[UNKNOWN_KPA2])
    some[TURNED] = some[VARIANCE] = doubt  # includes the distance of the hypotheses
    released = noticed & (sign < _ZERO)
    sagged = np.where(released, np.maximum(some[EARLIER_KPA] - earlier, _ZERO) * EARLIER, _ZERO)
    recovery.begin(some, by_noise, sagged, numbers[MOST_RESTED_KPA2])
    some[RELEASED_KPA] = np.where(released, extreme, _ZERO)
    if np.count_nonzero(earlier):
        some[EARLIER_KPA] -= earlier
        pressure = _give_back(some, pressure, earlier, numbers)
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

    The extreme falls between two frames. It exceeds the readings by up to half of the way that the load went in the
    frame before or after, whichever is less. On that way r goes up by one model and down by the other. The errors of
    all turns have the same sign, so that they add up as amounts rather than as variances. A way that noise explains, or
    a converter that flips between two codes, does not count.
    """
    last, before, third = memory[LAST : THIRD_LAST + 1]
    there = np.maximum(memory[SIGN] * (third - before), memory[SIGN] * (before - last))
    there = np.maximum(there, _ZERO)
    way = np.minimum(there * _JUST_BEGUN, np.abs(pressure - last))
    by_load: FloatArray = np.maximum(way - unsure * _SURE, _ZERO)
    return by_load * BETWEEN * numbers[BEND] * gain


def _give_back(
    memory: FloatArray, pressure: FloatArray, kpa: FloatArray, numbers: tuple[FloatArray, ...]
) -> FloatArray:
    """Move the ``pressure`` (m,) of the hypothesis taken over further by ``kpa`` (m,); changes its ``memory``.

    The standard deviation counts this amount already.

    Returns:
        (m,) kPa.
    """
    state = memory[STATE]
    rises = memory[SIGN] > _ZERO
    further: FloatArray = pressure + memory[SIGN] * kpa
    np.copyto(state[RISING], further, where=rises)
    np.copyto(state[RECOVERY], further, where=~rises)
    memory[SETTLED] += np.where(rises, kpa * numbers[SETTLED_PER_KPA], _ZERO)
    memory[X2] += np.where(rises, _ZERO, kpa / numbers[E1_KPA])
    memory[PRESSURE] = further
    return further


@loop
def unseen_of(memory: SpacedRows, i: int, pressure: float, gain: float, unsure: float, numbers: Row) -> float:
    """Standard deviation that turns between two frames leave in the ``pressure`` of cell ``i``."""
    last, before, third, sign = memory[LAST, i], memory[BEFORE_LAST, i], memory[THIRD_LAST, i], memory[SIGN, i]
    there = max(sign * (third - before), sign * (before - last), 0.0)
    way = min(JUST_BEGUN * there, abs(pressure - last))
    by_load = max(way - SURE * unsure, 0.0)
    return float(BETWEEN * by_load * numbers[BEND] * gain)


@loop
def take_over_of(memory: SpacedRows, i: int, noise: float, by_model: Rows, of: Rows, numbers: Row) -> None:
    """:func:`take_over` in cell ``i``, with the weights of its hypothesis in force."""
    left, extreme = memory[LEFT, i], memory[EXTREME, i]
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
    # The moment of the turn is as uncertain as it was in the last frame whether the pressure had turned.
    before = variance_at_turn_of(memory, i)
    rounded = numbers[FAST_KPA] / max(abs(pressure - memory[LAST, i]), numbers[FAST_KPA]) * numbers[ROUND_KPA]
    unseen = unseen_of(memory, i, pressure, gain, unsure, numbers) + rounded
    if left >= FAR and extreme < REFUTED:
        if sign > 0.0:
            unseen += hidden_kpa_of(memory, i, pressure, extreme, numbers[FALL_PER_RISE])
        else:
            memory[LOOKS_AT_REST, i] = 0.0
    memory[MAY_BEAR_KPA, i], memory[FALLEN, i] = 0.0, 0.0
    doubt = math.sqrt(before) + unseen
    by_noise = by_model[0, 1] * noise
    by_noise *= by_noise
    turned = min(doubt * doubt + by_noise, numbers[UNKNOWN_KPA2])
    memory[TURNED, i] = memory[VARIANCE, i] = turned  # includes the distance of the hypotheses
    released = left >= FAR and extreme < REFUTED and sign < 0.0
    sagged = max(memory[EARLIER_KPA, i] - earlier, 0.0) * EARLIER if released else 0.0
    begin_of(memory, i, by_noise, sagged, numbers[MOST_RESTED_KPA2])
    memory[RELEASED_KPA, i] = extreme if released else 0.0
    if earlier > 0.0:
        memory[EARLIER_KPA, i] -= earlier
        pressure += sign * earlier
        memory[PRESSURE, i] = pressure
        if sign > 0.0:
            memory[RISING_KPA, i] = pressure
            memory[SETTLED, i] += earlier * numbers[SETTLED_PER_KPA]
        else:
            memory[RECOVERY_KPA, i] = pressure
            memory[X2, i] += earlier / numbers[E1_KPA]
    now = sign * max(pressure, 0.0)
    if left < FAR:
        memory[EXTREME, i], memory[PEAK, i], memory[LEFT, i] = left, left, FAR
    else:
        memory[EXTREME, i], memory[PEAK, i], memory[LEFT, i] = now - LESS * unsure, now - unsure, extreme
    memory[RECENT_EXTREME, i] = memory[EXTREME, i]
