"""Light touches on cells that recover: a hypothesis test of an unchanged load against one that grows.

The paper's cell answers a rise by more than a fall. Near no load a touch may therefore be noticed as a turn while its
release is not. The rising model then stays in force, and takes the recovery for a load that grows, by up to a twentieth
of full scale. The two usual hypotheses cannot correct this: while the pressure goes up, the recovery model begins anew
where the pressure is.

While the rising model is in force, we therefore follow a third hypothesis: that the load is again what it was when the
recovery model was last in force, and that the cell still has the memory of that time. It predicts the readings without
any inverse. If the readings keep their distance from this prediction while the rising model's pressure grows, the load
would have to grow exactly as fast as the recovery fades. A clear growth of this kind is refuted: the recovery model is
taken over again, with the load of the third hypothesis. A load that really grows takes the readings away from the
prediction. Under a light held load the resistance falls faster than predicted. In both cases the comparison begins
anew.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import FloatArray
from ...common.compiled import Row, SpacedRows, loop
from ..estimation import FAR, PRESSURE, RECENT
from ..materials import PaperModel
from ._paper_steps import Constants, borne_before, numbered, step_weights
from ._turning_rows import (
    EXTREME,
    LEFT,
    LOOKS_AT_REST,
    RECOVERY_KPA,
    RECOVERY_X3,
    REFUTED,
    SIGN,
    STATE_END,
    X2,
)

FLAT = 0.3
"""share of the growth by which the distance to the prediction (in kPa of the recovery model) may change"""
SURE = 3.0
"""standard deviations of the mean of readings by which this distance may change in addition"""
LIGHT_TOUCH = 0.03
"""of full scale: largest distance of the readings from the prediction, in kPa of the recovery model. The release of a
larger load is noticed anyway"""
CLEAR = 0.01
"""of full scale: a larger growth is refuted, unless noise hides more than the share :data:`FLAT` of it"""
FLAT_PRESS, CLEAR_PRESS = 0.05, 0.1
"""as :data:`FLAT` and :data:`CLEAR`, for a growth that began beyond a light touch or was found by :mod:`._onset`: a
load may for a while rise about as fast as the recovery fades, but hardly just as fast for long"""
_ZERO, _FAR, _SURE = (np.array(x) for x in (0.0, FAR, SURE / math.sqrt(RECENT)))
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.

NAMES = ("still_kpa", "still_x2", "still_x3", "off_kpa_before", "pressure_before")
"""names of the rows of the memory"""
STILL_KPA, STILL_X2, STILL_X3, OFF_BEFORE, PRESSURE_BEFORE = range(28, 33)
"""rows: the load of the third hypothesis; r of the two branches beyond their equilibrium under this load. Then values
of when the comparison began: the distance of the readings from the prediction, and the pressure"""

GAIN_KPA, FADES_2, FADES_3, BACK_2, BACK_3 = range(5)
"""places of the numbers that depend on the time between frames: kPa per r in recovery; share of the r of each branch
that is left at the next look; r of each branch in the middle of the averaged readings, over its present r. Then
constants:"""
PER_KPA, PER_KPA_2, PER_KPA_3, PER_KPA_AT_ONCE = range(5, 9)
"""r per kPa of a load at equilibrium: in all, of each branch, and the part that comes at once"""


def constants(model: PaperModel, dt_s: float) -> Constants:
    """The numbers that :func:`look` takes, for frames ``dt_s`` apart; places as above."""
    look_s, (back_2, back_3) = RECENT * dt_s, borne_before(model, 0.5 * (RECENT - 1) * dt_s)
    numbers = {
        GAIN_KPA: float(step_weights(model, dt_s).gain[-1]),
        FADES_2: math.exp(-look_s / model.t2_s),
        FADES_3: math.exp(-look_s / model.t3_s),
        BACK_2: back_2,
        BACK_3: back_3,
        PER_KPA: model.gain_per_kpa,
        PER_KPA_2: 1.0 / model.e2_kpa,
        PER_KPA_3: 1.0 / model.e3_kpa,
        PER_KPA_AT_ONCE: 1.0 / model.e1_kpa,
    }
    return numbered(numbers)


def begin(memory: FloatArray) -> None:
    """Begin with cells that bear no load and have no memory of one; changes their ``memory`` (rows, m)."""
    memory[OFF_BEFORE] = FAR


def hold(memory: FloatArray, left_2: FloatArray, left_3: FloatArray) -> None:
    """Let the r of the branches fade in a gap, which leaves these shares of it; changes ``memory`` (rows, m)."""
    memory[STILL_X2] *= left_2
    memory[STILL_X3] *= left_3


def look(
    memory: FloatArray, mean: FloatArray, noise: FloatArray, full_scale_kpa: float, numbers: tuple[FloatArray, ...]
) -> None:
    """Take the last :data:`..estimation.RECENT` readings of m cells; changes their ``memory`` (rows, m).

    Args:
        memory: of the cells.
        mean: (m,) of those readings.
        noise: (m,) standard deviation of one of them.
        full_scale_kpa: of the cells.
        numbers: :func:`constants`, each.
    """
    load, x2, x3, off_before, pressure_before = memory[STILL_KPA : PRESSURE_BEFORE + 1]
    pressure, rising = memory[PRESSURE], memory[SIGN] > _ZERO
    x2 *= numbers[FADES_2]
    x3 *= numbers[FADES_3]
    released = memory[LEFT] >= _FAR
    released &= ~rising
    if np.count_nonzero(released):
        np.copyto(load, np.maximum(pressure, _ZERO), where=released)
        np.copyto(x2, memory[X2] - load * numbers[PER_KPA_2], where=released)
        np.copyto(x3, memory[RECOVERY_X3] - load * numbers[PER_KPA_3], where=released)
        np.copyto(off_before, _FAR, where=released)
    if not np.count_nonzero(rising):
        return
    off = mean - load * numbers[PER_KPA]
    off -= x2 * numbers[BACK_2]
    off -= x3 * numbers[BACK_3]
    off *= numbers[GAIN_KPA]
    by_noise = noise * _SURE
    by_noise *= numbers[GAIN_KPA]
    light = pressure_before <= load + LIGHT_TOUCH * full_scale_kpa
    light &= memory[LOOKS_AT_REST] >= _ZERO
    flat, clear = np.where(light, FLAT, FLAT_PRESS), np.where(light, CLEAR, CLEAR_PRESS)
    growth = pressure - pressure_before
    alike = np.abs(off - off_before) <= np.maximum(growth, _ZERO) * flat + by_noise
    alike &= np.abs(off) <= by_noise + LIGHT_TOUCH * full_scale_kpa
    anew = rising & ~alike
    np.copyto(off_before, off, where=anew)
    np.copyto(pressure_before, pressure, where=anew)
    np.copyto(growth, _ZERO, where=~(rising & alike))
    refuted = growth > clear * full_scale_kpa
    refuted &= growth * flat > by_noise
    if np.count_nonzero(refuted):
        x3 = x3 + load * numbers[PER_KPA_3]
        np.copyto(memory[RECOVERY_KPA], load, where=refuted)
        np.copyto(memory[RECOVERY_X3], x3, where=refuted)
        np.copyto(memory[X2], memory[STATE_END - 1] - load * numbers[PER_KPA_AT_ONCE] - x3, where=refuted)
        np.copyto(memory[EXTREME], REFUTED, where=refuted)


@loop
def look_each(memory: SpacedRows, mean: Row, noise: Row, full_scale_kpa: float, numbers: Row) -> None:
    """:func:`look` as a loop over cells."""
    for i in range(mean.size):
        pressure = memory[PRESSURE, i]
        x2, x3 = memory[STILL_X2, i] * numbers[FADES_2], memory[STILL_X3, i] * numbers[FADES_3]
        memory[STILL_X2, i], memory[STILL_X3, i] = x2, x3
        if not memory[SIGN, i] > 0.0:
            if memory[LEFT, i] >= FAR:
                load = max(pressure, 0.0)
                memory[STILL_KPA, i], memory[OFF_BEFORE, i] = load, FAR
                memory[STILL_X2, i] = memory[X2, i] - load * numbers[PER_KPA_2]
                memory[STILL_X3, i] = memory[RECOVERY_X3, i] - load * numbers[PER_KPA_3]
            continue
        load = memory[STILL_KPA, i]
        off = mean[i] - load * numbers[PER_KPA] - x2 * numbers[BACK_2] - x3 * numbers[BACK_3]
        off *= numbers[GAIN_KPA]
        by_noise = noise[i] * (SURE / math.sqrt(RECENT)) * numbers[GAIN_KPA]
        light = memory[PRESSURE_BEFORE, i] <= load + LIGHT_TOUCH * full_scale_kpa and memory[LOOKS_AT_REST, i] >= 0.0
        flat, clear = (FLAT, CLEAR) if light else (FLAT_PRESS, CLEAR_PRESS)
        growth = pressure - memory[PRESSURE_BEFORE, i]
        alike = abs(off - memory[OFF_BEFORE, i]) <= max(growth, 0.0) * flat + by_noise
        if not (alike and abs(off) <= by_noise + LIGHT_TOUCH * full_scale_kpa):
            memory[OFF_BEFORE, i], memory[PRESSURE_BEFORE, i] = off, pressure
            continue
        if growth > clear * full_scale_kpa and growth * flat > by_noise:
            x3 = x3 + load * numbers[PER_KPA_3]
            memory[RECOVERY_KPA, i], memory[RECOVERY_X3, i], memory[EXTREME, i] = load, x3, REFUTED
            memory[X2, i] = memory[STATE_END - 1, i] - load * numbers[PER_KPA_AT_ONCE] - x3


LOOPS = (look_each,)
