"""Released cells: a scalar Kalman filter of the error of the memory, under the hypothesis that the cell bears no load.

The noise at a turn leaves an error in the memory, which later shows as a load and fades only as fast as the material
recovers. The readings cannot tell such an error from a light load: both recover along the same curve for seconds. But
most released cells bear no load. As long as the pressure of a recovering cell differs from none by no more than the
error of its memory explains, we take the difference for that error and subtract it. The filter averages the readings of
the whole rest, which is much longer than the smoothing may average. While the pressure still moves, the load that
may be left counts as noise of the readings (:data:`GOES_ON`), and the cell is not yet taken for one at rest.

A light load that is subtracted by mistake comes back as the error of the memory fades. Three rules limit the harm:

1. The subtracted pressure becomes part of the stated standard deviation at once, and is part of it at the next turn.
2. The filter trusts the memory the more the more it has read, so that it does not go on subtracting.
3. A rise is no turn if the fading error (:data:`DRIFTS`) and the return of the subtracted pressure explain it. The
   rising model would otherwise take the recovery for a load that grows.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import FloatArray, columns
from ...common.compiled import Row, SpacedRows, loop
from ..estimation import FAR, PRESSURE, RECENT, REST_VARIANCE, RESTED, VARIANCE
from ..estimation import GAIN as GAIN_ROW
from ..materials import PaperModel
from ._paper_steps import Constants, borne_before, numbered, step_weights
from ._turning_rows import (
    DRIFT_END_KPA,
    DRIFT_KPA,
    EXTREME,
    LEFT,
    MAY_BEAR_KPA,
    PEAK,
    RECENT_EXTREME,
    RECOVERY_KPA,
    RECOVERY_X3,
    RELEASED_KPA,
    RISING_KPA,
    RISING_X3,
    SETTLED,
    SIGN,
    STATE_END,
    TAKEN_BEFORE_KPA2,
    TAKEN_OFF_KPA,
    THIRD_LAST,
    TURNED,
    X2,
)

PART = 0.3
"""share of the variance stated for the memory at a release that the usual error has; the rest covers rare errors"""
MOST = 0.2
"""of full scale: if the standard deviation of the memory is larger, rest is no better a guess than a load"""
REST_SIGMAS = 2.0
"""standard deviations by which the pressure of a cell at rest may differ from zero"""
RESTED_SIGMAS = 5.0
"""standard deviations, of smoothed noise and memory together, at which a load and no load are equally likely in a
released cell. More than in other cells (:data:`..estimation._inversion.NO_LOAD_SIGMAS`): the error of the memory shows
in every frame of a rest, and its standard deviation here is only that of the usual error (:data:`PART`)"""
GOES_ON, STEADY = 4.0, 0.25
"""standard deviation of the load that is left while it still moves, over its change in three frames; and the change
that does not count, in standard deviations of a reading"""
FELL = 0.75
"""times what is left of the pressure: it must have fallen by so much for the remainder to be an error of the memory. A
load that trembles falls by less, however long it is held. Where recovery began without a fall, as after a refuted rise,
this condition is not asked for"""
LIGHT = 0.1
"""share of the variance of the memory that stays after a rest, since the released cell may have borne a light load
after all. The squares of the subtracted pressure and of a load that may have begun (:mod:`._onset`) are added. The
subtracted pressure stays in the variance, while it fades, until a clearly larger load is released: the falls of a
tremor are no new signs of rest"""
TWICE = 4.0
"""square of a load that is larger than the subtracted pressure for sure, over the square of that pressure"""
DRIFTS = 2.0
"""standard deviations of the memory: so large a change of pressure may look like a turn as the error fades"""
OVERSHOOT = 3.0
"""standard deviations of a reading by which the line of the smoothing may overshoot where a rising load stops: readings
must depart from the line by some standard deviations before a new line begins. A smaller fall may be no turn"""
OLD = 3.0 * RECENT
"""readings of a line from which the overshoot is allowed for; the end of a shorter line is as uncertain anyway"""
PEAK_FADES = 0.15
"""share of the distance to the extreme by which the peak goes down from one look to the next. The noisy first pressures
of a press may exceed all later ones; the other hypothesis would otherwise begin there, however long the load is held"""

GAIN, FADES, BACK_2, BACK_3, DRIFT_SHARE, RISING_DRIFT_SHARE = range(6)
"""places of the numbers that depend on the time between frames: kPa per r in recovery; share of a variance of the
memory that is left at the next look; the r of the two branches in the middle of the readings of the mean, over their
present r; share of its way that a drift goes until the next look, in recovery and under a rising load. Then
constants:"""
BOUND, E1_KPA, SETTLED_PER_KPA, ETAU2_KPA, LATELY, BEYOND = range(6, 12)
""":data:`REST_SIGMAS` squared; three of the model; :data:`PEAK_FADES`; :data:`OVERSHOOT`"""


_ZERO, _ONE, _FAR, _OLD, _PER_READING, _GOES_ON, _STEADY, _FELL = (
    np.array(x) for x in (0.0, 1.0, FAR, OLD, 1.0 / RECENT, GOES_ON, STEADY, FELL)
)
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


def constants(model: PaperModel, dt_s: float) -> Constants:
    """The numbers that :func:`look` takes, for frames ``dt_s`` apart; places as above."""
    weights = step_weights(model, dt_s)
    gain_kpa, (rising_fade, fade) = float(weights.gain[-1]), weights.fade.tolist()
    back_2, back_3 = borne_before(model, 0.5 * (RECENT - 1) * dt_s)
    numbers = {
        GAIN: gain_kpa,
        FADES: fade**RECENT,
        BACK_2: back_2,
        BACK_3: back_3,
        DRIFT_SHARE: 1.0 - fade ** (RECENT / 2),  # errors fade as the root of their variance
        RISING_DRIFT_SHARE: 1.0 - rising_fade ** (RECENT / 2),
        BOUND: REST_SIGMAS**2,
        E1_KPA: model.e1_kpa,
        SETTLED_PER_KPA: 1.0 + model.etau2_kpa / model.eu1_kpa,
        ETAU2_KPA: model.etau2_kpa,
        LATELY: PEAK_FADES,
        BEYOND: OVERSHOOT,
    }
    return numbered(numbers)


def look(
    memory: FloatArray, mean: FloatArray, noise: FloatArray, count: FloatArray, numbers: tuple[FloatArray, ...]
) -> None:
    """Take the last :data:`..estimation.RECENT` readings of m cells; changes their ``memory`` (rows, m).

    Args:
        memory: of the cells.
        mean: (m,) of those readings.
        noise: (m,) standard deviation of one of them.
        count: (m,) readings since the smoothing last noticed a change.
        numbers: :func:`constants`, each.
    """
    peak, drift, variance, shown = memory[PEAK], memory[DRIFT_KPA], memory[REST_VARIANCE], memory[PRESSURE]
    peak += (memory[EXTREME] - peak) * numbers[LATELY]
    comes_back = np.maximum(memory[TAKEN_OFF_KPA], _ZERO)
    rising = memory[SIGN] > _ZERO
    share = np.where(rising, numbers[RISING_DRIFT_SHARE], numbers[DRIFT_SHARE])
    drift += (memory[DRIFT_END_KPA] + comes_back - drift) * share
    held = rising & (count >= _OLD)
    np.maximum(drift, noise * memory[GAIN_ROW] * numbers[BEYOND], out=drift, where=held)
    variance *= numbers[FADES]
    taken_before = memory[TAKEN_BEFORE_KPA2]
    taken_before *= numbers[FADES]
    calm = (memory[SIGN] < _ZERO) & (memory[LEFT] >= _FAR)
    if not np.count_nonzero(calm):
        return
    remembered = memory[X2] * numbers[BACK_2] + memory[RECOVERY_X3] * numbers[BACK_3]
    pressure = (mean - remembered) * numbers[GAIN]
    by_noise = noise * numbers[GAIN]
    left_over = np.maximum(np.abs(memory[THIRD_LAST] - shown) - by_noise * _STEADY, _ZERO)
    by_noise = by_noise * by_noise * _PER_READING
    bound = (variance + by_noise) * numbers[BOUND]
    calm &= (pressure * pressure < bound) & (shown * shown < bound)
    left, released = shown + memory[TAKEN_OFF_KPA], memory[RELEASED_KPA]
    calm &= (released - left >= left * _FELL) | (released <= _ZERO)
    rests = calm.nonzero()[0]
    if not rests.size:
        return
    some, left_over = columns(memory, rests), left_over[rests] * _GOES_ON
    share = some[REST_VARIANCE] / (some[REST_VARIANCE] + by_noise[rests] + left_over * left_over)
    error = pressure[rests] * share
    some[REST_VARIANCE] *= 1.0 - share
    np.copyto(some[RESTED], _ONE, where=left_over == _ZERO)
    some[TAKEN_OFF_KPA] += error
    more = np.maximum(some[TAKEN_OFF_KPA] * some[TAKEN_OFF_KPA] - some[TURNED], _ZERO)
    some[TURNED] += more
    some[VARIANCE] += more
    p = some[PRESSURE] - error
    r, x3 = some[STATE_END - 1], some[RECOVERY_X3]
    some[PRESSURE] = some[RISING_KPA] = some[RECOVERY_KPA] = p
    some[SETTLED] = p * numbers[SETTLED_PER_KPA] - r * numbers[ETAU2_KPA]
    some[X2] = r - p / numbers[E1_KPA] - x3
    some[RISING_X3] = x3
    some[EXTREME] = np.minimum(some[EXTREME] + error, _ZERO)
    some[PEAK] = np.minimum(some[PEAK] + error, _ZERO)
    some[RECENT_EXTREME] = np.minimum(some[RECENT_EXTREME] + error, _ZERO)
    memory[:, rests] = some


def _taken_off(memory: FloatArray) -> FloatArray:
    """(m,) square in kPa^2 of the pressure that rests have subtracted: the last one, or those since a clear release."""
    released, before = memory[RELEASED_KPA], memory[TAKEN_BEFORE_KPA2]
    before = np.where(released * released > TWICE * before, _ZERO, before)
    taken: FloatArray = np.maximum(memory[TAKEN_OFF_KPA] * memory[TAKEN_OFF_KPA], before)
    return taken


def variance_at_turn(memory: FloatArray) -> FloatArray:
    """(m,) variance in kPa^2 of the memory of cells that have just turned, less the part that a rest averaged away."""
    variance = memory[VARIANCE]
    left_over = variance * LIGHT + _taken_off(memory)
    left_over += memory[MAY_BEAR_KPA] * memory[MAY_BEAR_KPA]
    rested = np.minimum(variance, memory[REST_VARIANCE] + left_over)
    found: FloatArray = np.where(memory[RESTED] > _ZERO, rested, variance)
    return found


def begin(memory: FloatArray, by_noise: FloatArray, sagged_kpa: FloatArray, most_kpa2: FloatArray) -> None:
    """Begin anew in m cells that have just turned; changes their ``memory`` (rows, m).

    Args:
        memory: of the cells.
        by_noise: (m,) variance in kPa^2 by the noise of the turn's own reading; all of it belongs to the usual error.
        sagged_kpa: (m,) standard deviation by a load that may have sagged before its release; all of it belongs to the
            usual error.
        most_kpa2: without axes, the square of :data:`MOST` in kPa.
    """
    turned = memory[TURNED]
    np.copyto(memory[TAKEN_BEFORE_KPA2], _taken_off(memory), where=memory[RESTED] > _ZERO)
    memory[[RESTED, DRIFT_KPA, REST_VARIANCE, TAKEN_OFF_KPA]] = 0.0
    usual = np.maximum(turned - by_noise, _ZERO) * PART
    usual += np.minimum(by_noise, turned)
    np.copyto(memory[REST_VARIANCE], usual, where=turned < most_kpa2)
    memory[REST_VARIANCE] += sagged_kpa * sagged_kpa
    memory[DRIFT_END_KPA] = np.sqrt(np.minimum(turned, most_kpa2)) * DRIFTS


@loop
def taken_off_of(memory: SpacedRows, i: int) -> float:
    """:func:`_taken_off` of cell ``i``."""
    released, before = memory[RELEASED_KPA, i], memory[TAKEN_BEFORE_KPA2, i]
    if released * released > TWICE * before:
        before = 0.0
    return float(max(memory[TAKEN_OFF_KPA, i] * memory[TAKEN_OFF_KPA, i], before))


@loop
def variance_at_turn_of(memory: SpacedRows, i: int) -> float:
    """:func:`variance_at_turn` of cell ``i``."""
    variance = memory[VARIANCE, i]
    if memory[RESTED, i] > 0.0:
        left_over = variance * LIGHT + taken_off_of(memory, i) + memory[MAY_BEAR_KPA, i] * memory[MAY_BEAR_KPA, i]
        variance = min(variance, memory[REST_VARIANCE, i] + left_over)
    return float(variance)


@loop
def begin_of(memory: SpacedRows, i: int, by_noise: float, sagged_kpa: float, most_kpa2: float) -> None:
    """:func:`begin` in cell ``i``."""
    turned = memory[TURNED, i]
    if memory[RESTED, i] > 0.0:
        memory[TAKEN_BEFORE_KPA2, i] = taken_off_of(memory, i)
    memory[RESTED, i], memory[DRIFT_KPA, i], memory[TAKEN_OFF_KPA, i] = 0.0, 0.0, 0.0
    usual = max(turned - by_noise, 0.0) * PART + min(by_noise, turned)
    memory[REST_VARIANCE, i] = (usual if turned < most_kpa2 else 0.0) + sagged_kpa * sagged_kpa
    memory[DRIFT_END_KPA, i] = math.sqrt(min(turned, most_kpa2)) * DRIFTS


@loop
def look_each(memory: SpacedRows, mean: Row, noise: Row, count: Row, numbers: Row) -> None:
    """:func:`look` as a loop over cells."""
    gain = numbers[GAIN]
    for i in range(mean.size):
        memory[PEAK, i] += (memory[EXTREME, i] - memory[PEAK, i]) * numbers[LATELY]
        drift_end = memory[DRIFT_END_KPA, i] + max(memory[TAKEN_OFF_KPA, i], 0.0)
        rising = memory[SIGN, i] > 0.0
        share = numbers[RISING_DRIFT_SHARE] if rising else numbers[DRIFT_SHARE]
        memory[DRIFT_KPA, i] += (drift_end - memory[DRIFT_KPA, i]) * share
        if rising and count[i] >= OLD:
            memory[DRIFT_KPA, i] = max(memory[DRIFT_KPA, i], noise[i] * memory[GAIN_ROW, i] * numbers[BEYOND])
        memory[REST_VARIANCE, i] *= numbers[FADES]
        memory[TAKEN_BEFORE_KPA2, i] *= numbers[FADES]
        if not (memory[SIGN, i] < 0.0 and memory[LEFT, i] >= FAR):
            continue
        shown, x3 = memory[PRESSURE, i], memory[RECOVERY_X3, i]
        remembered = memory[X2, i] * numbers[BACK_2] + x3 * numbers[BACK_3]
        pressure = (mean[i] - remembered) * gain
        by_noise = noise[i] * gain
        left_over = max(abs(memory[THIRD_LAST, i] - shown) - by_noise * STEADY, 0.0) * GOES_ON
        by_noise = by_noise * by_noise * (1.0 / RECENT)
        bound = (memory[REST_VARIANCE, i] + by_noise) * numbers[BOUND]
        left, released = shown + memory[TAKEN_OFF_KPA, i], memory[RELEASED_KPA, i]
        fell = released - left >= left * FELL or released <= 0.0
        if not (fell and pressure * pressure < bound and shown * shown < bound):
            continue
        share = memory[REST_VARIANCE, i] / (memory[REST_VARIANCE, i] + by_noise + left_over * left_over)
        error = pressure * share
        memory[REST_VARIANCE, i] *= 1.0 - share
        if left_over == 0.0:
            memory[RESTED, i] = 1.0
        memory[TAKEN_OFF_KPA, i] += error
        more = max(memory[TAKEN_OFF_KPA, i] * memory[TAKEN_OFF_KPA, i] - memory[TURNED, i], 0.0)
        memory[TURNED, i] += more
        memory[VARIANCE, i] += more
        p, r = shown - error, memory[STATE_END - 1, i]
        memory[PRESSURE, i], memory[RISING_KPA, i], memory[RECOVERY_KPA, i] = p, p, p
        memory[SETTLED, i] = p * numbers[SETTLED_PER_KPA] - r * numbers[ETAU2_KPA]
        memory[X2, i] = r - p / numbers[E1_KPA] - x3
        memory[RISING_X3, i] = x3
        memory[EXTREME, i] = min(memory[EXTREME, i] + error, 0.0)
        memory[PEAK, i] = min(memory[PEAK, i] + error, 0.0)
        memory[RECENT_EXTREME, i] = min(memory[RECENT_EXTREME, i] + error, 0.0)


LOOPS = (look_each,)
