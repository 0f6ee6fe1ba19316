"""Detection of releases within the noise of single readings, from means of readings: Page's test (CUSUM).

After taps that have left several times the resistance at rest, noise is as many times larger. A release then takes the
rising model back by only three standard deviations of the smoothed readings. That alone is no evidence of a release: a
fall of the rising model may be an error up to a share of the fall of the recovery model, and the recovery model falls
under a held load as well (:data:`._turns.SHARED_FALL`). Successive readings together give the evidence. Their means are
inverted with the rising model and compared with the largest mean of late. Page's test adds up by how many standard
deviations the means lie below it. Overshoots and chance restarts of the smoothing's line have no part in these means.

The largest mean fades towards the present one, since errors of the memory fade, too; a release is faster than that.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import FloatArray
from ...common.compiled import Row, SpacedRows, loop
from ..estimation import RECENT
from ..materials import PaperModel
from ._paper_steps import Constants, fast_r, numbered, step_weights
from ._turning_rows import EXTREME, FALLEN, HIGHEST_MEAN_KPA, RECOVERY_KPA, RISING_KPA, SIGN, STATE_END
from ._turns import SHARED_FALL, TURN

LESS = 1.0
"""standard deviations of a mean that are subtracted from a new largest mean, since it is partly noise"""
ALLOWED = 0.75
"""standard deviations by which a mean may lie below the largest without adding to the sum (the allowance of CUSUM)"""
LASTS_S = 0.5
"""seconds, time constant with which the largest mean fades towards the present one"""
LOUD = 0.05
"""of full scale: above this standard deviation of a mean nothing is summed up. A resistance is the reciprocal of a
current, so that in so much noise single resistances are far too large, and all later ones would seem to fall"""

NAMES = ("highest_mean", "fallen")
"""names of the rows of the memory, from :data:`._turning_rows.HIGHEST_MEAN_KPA` on"""
GAIN_KPA, SINCE, FADES, NOISE_KPA = range(4)
"""places of the numbers that depend on the time between frames: kPa per r in the rising model; share of the way to its
equilibrium that r has gone, under a held load, since the middle of the readings of the mean; share by which the largest
mean fades until the next look; and standard deviation in kPa of a mean over that in r of a reading. Then constants:"""
PER_EU1, RISE_PER_FALL, FALL_SHARE, TURN_KPA, LOUD_KPA = range(4, 9)
"""1/Eu1 of the model; r of a fast rise over that of a fast fall; :data:`._turns.SHARED_FALL` as the recovery model
answers it; a fall that is none; and :data:`LOUD` in kPa"""
_ZERO, _LESS, _ALLOWED = (np.array(x) for x in (0.0, LESS, ALLOWED))
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


def constants(model: PaperModel, dt_s: float, full_scale_kpa: float) -> Constants:
    """The numbers that :func:`look` takes, for frames ``dt_s`` apart; places as above."""
    (rise_r, fall_r), gain_kpa = fast_r(model), float(step_weights(model, dt_s).gain[0])
    numbers = {
        GAIN_KPA: gain_kpa,
        SINCE: -math.expm1(-0.5 * (RECENT - 1) * dt_s / model.tu_s),
        FADES: -math.expm1(-RECENT * dt_s / LASTS_S),
        NOISE_KPA: gain_kpa / math.sqrt(RECENT),
        PER_EU1: 1.0 / model.eu1_kpa,
        RISE_PER_FALL: rise_r / fall_r,
        FALL_SHARE: SHARED_FALL * fall_r / rise_r,
        TURN_KPA: TURN * full_scale_kpa,
        LOUD_KPA: LOUD * full_scale_kpa,
    }
    return numbered(numbers)


def look(memory: FloatArray, mean: FloatArray, noise: FloatArray, numbers: tuple[FloatArray, ...]) -> None:
    """Take the last :data:`..estimation.RECENT` readings of m cells; changes their ``memory`` (rows, m).

    A fast fall of r takes both models back, the recovery model by more (RISE_PER_FALL). A further fall of the recovery
    model is that of a held load. Of this part, the share that may be an error of the rising model is not counted.

    Args:
        memory: of the cells.
        mean: (m,) of those readings.
        noise: (m,) standard deviation of one of them.
        numbers: :func:`constants`, each.
    """
    highest, fallen, rising = memory[HIGHEST_MEAN_KPA], memory[FALLEN], memory[RISING_KPA]
    r, extreme = memory[STATE_END - 1], memory[EXTREME]
    since = rising * numbers[PER_EU1]
    since -= r
    since *= numbers[SINCE]
    pressure = mean + since
    pressure -= r
    pressure *= numbers[GAIN_KPA]
    pressure += rising
    by_noise = noise * numbers[NOISE_KPA]
    begun = pressure - by_noise * _LESS
    anew = begun > highest
    anew |= memory[SIGN] < _ZERO
    anew |= by_noise > numbers[LOUD_KPA]
    held = extreme - memory[RECOVERY_KPA]
    held -= (extreme - rising) * numbers[RISE_PER_FALL]
    np.maximum(held, _ZERO, out=held)
    held *= numbers[FALL_SHARE]
    below = highest - pressure
    fallen += (below - numbers[TURN_KPA] - held) / by_noise
    fallen -= _ALLOWED
    np.maximum(fallen, _ZERO, out=fallen)
    highest -= np.maximum(below, _ZERO) * numbers[FADES]
    np.copyto(fallen, _ZERO, where=anew)
    np.copyto(highest, begun, where=anew)


@loop
def look_each(memory: SpacedRows, mean: Row, noise: Row, numbers: Row) -> None:
    """:func:`look` as a loop over cells."""
    for i in range(mean.size):
        rising, r, extreme = memory[RISING_KPA, i], memory[STATE_END - 1, i], memory[EXTREME, i]
        since = (rising * numbers[PER_EU1] - r) * numbers[SINCE]
        pressure = (mean[i] + since - r) * numbers[GAIN_KPA] + rising
        by_noise = noise[i] * numbers[NOISE_KPA]
        begun, below = pressure - by_noise * LESS, memory[HIGHEST_MEAN_KPA, i] - pressure
        loud = by_noise > numbers[LOUD_KPA]
        if begun > memory[HIGHEST_MEAN_KPA, i] or memory[SIGN, i] < 0.0 or loud:
            memory[HIGHEST_MEAN_KPA, i], memory[FALLEN, i] = begun, 0.0
            continue
        held = extreme - memory[RECOVERY_KPA, i] - (extreme - rising) * numbers[RISE_PER_FALL]
        held = max(held, 0.0) * numbers[FALL_SHARE]
        memory[FALLEN, i] = max(memory[FALLEN, i] + (below - numbers[TURN_KPA] - held) / by_noise - ALLOWED, 0.0)
        memory[HIGHEST_MEAN_KPA, i] -= max(below, 0.0) * numbers[FADES]


LOOPS = (look_each,)
