"""Slow presses of cells that recover: quickest change detection (Page's test, CUSUM) of the onset of a load.

Under a load the paper's cell forgets sooner than at rest. A small load therefore lets the resistance of a recovering
cell fall *faster*. The recovery model then needs a negative pressure (a pull). A pull passes for an error of the
memory, and is taken out of the memory again and again (:mod:`._limits`). Only a fast press raises the resistance by
more than the cell forgets.

Two hypotheses are compared while a cell recovers:

1. The cell bears nothing. The readings follow from the memory at the last moment without a sign of a load, as far as
   that memory is known and noise allows.
2. A load has risen since that moment, at whatever rate.

The statistic is the whole pull that hypothesis 1 needs. Where it needs none, the moment is moved to the present, as in
Page's test. An error of the memory needs a pull once, while a load needs an ever larger one. When the pull is clear and
still grows, hypothesis 2 is taken over. Before, its load counts as standard deviation, weighted by how likely it is.

A load can hide: at one rate of rise it raises the resistance by just what the cell forgets sooner. The readings are
then those of a cell at rest until the rate changes. When the load emerges, the rising model begins too late. The
smaller the share of the rise that the recovery model shows, the nearer is the rate to this hidden rate, and the more
likely the load began before. Its pressure then lies between that of the rising model and that of a load which began
with the recovery. A load that was hidden and is then held needs a pull, too, and so does a light touch. Where the pull
is clear, the load that may have risen unseen therefore counts as standard deviation. A load that comes to the hidden
rate later needs no further pull; its standard deviation fades instead of ending at once.

A load that fell to a part of itself and then grows slowly needs a pull as well, since the recovery model lets it fall
to none. The hypothesis of :mod:`._earlier` has followed that load. If most of its pressure was there when the recovery
began, this load is taken over, since a held load is more likely than one that goes on at the hidden rate.

T. L. Lai: "Sequential changepoint detection in quality control and dynamical systems", J. R. Statist. Soc. B 57 (1995).
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import BoolArray, FloatArray, columns
from ...common.compiled import Row, SpacedRows, loop
from ..estimation import FAR, PRESSURE, RECENT, REST_VARIANCE, RESTED, VARIANCE
from ..materials import PaperModel, lag
from ._paper_steps import Constants, borne_before, fast_r, numbered, step_weights
from ._recovery import REST_SIGMAS
from ._turning_rows import (
    EARLIER_FROM_KPA,
    EARLIER_KPA,
    EXTREME,
    LEFT,
    LOOKS_AT_REST,
    MAY_BEAR_KPA,
    RECOVERY_KPA,
    RECOVERY_X3,
    REFUTED,
    RISING_KPA,
    RISING_X3,
    SETTLED,
    SIGN,
    STATE_END,
    TURNED,
    X2,
)

SETTLES = 7.0
"""looks at a cell at rest after which its memory is known: by then the smoothing has passed the release"""
HIDDEN_SHARE = 0.7
"""standard deviation over the pressure that a hidden rise would add"""
MODEL = 0.06
"""share of the variance of the memory that no averaging of readings removes, since its error does not fade just as the
filter of :mod:`._recovery` assumes. With this share no rest after taps, in noise of up to 3 mV, needs a pull of
:data:`CLEAR_SIGMAS`"""
SOME_SIGMAS, CLEAR_SIGMAS, MORE_SIGMAS = 0.5, 3.0, 4.0
"""standard deviations of the pull above which a load is possible, and above which the pull is clear; and standard
deviations of noise by which a clear pull must grow further for the load to be taken over: a light touch that has ended
leaves a pull, too"""
AVERAGED = 0.25
"""least weight of the last look in the average of the pull, which averages as long as noise exceeds the memory's
error"""
COINCIDENCE = 0.25
"""share of the load of hypothesis 2: a smaller pull counts as none, since the load would have to follow the hidden rate
all the time"""
NONE, CLEAR = 0.002, 0.01
"""of full scale: a smaller pull counts as none; a smaller load is not taken over"""
EITHER = 0.6
"""standard deviation of a load that is taken over, over the load: it may have begun later"""
HIDES_S, HIDDEN = 2.0, 0.4
"""seconds for which a load may have risen at the hidden rate; and standard deviation over such a load where the pull is
clear"""
HELD = 0.7
"""share of a load that must have been there when recovery began for it to count as held since"""
LASTS_S = 3.0
"""seconds, time constant with which the standard deviation by a load fades that has come to the hidden rate"""
BOUND = REST_SIGMAS**2
PER_SIGMA = 1.0 / (CLEAR_SIGMAS - SOME_SIGMAS)
_ZERO, _ONE, _FAR, _REFUTED, _SETTLES, _AVERAGED, _PER_SIGMA, _BOUND = (
    np.array(x) for x in (0.0, 1.0, FAR, REFUTED, SETTLES, AVERAGED, PER_SIGMA, BOUND)
)
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.

NAMES = (
    *("may_bear_kpa", "looks_at_rest", "earliest_kpa", "begun_kpa", "earliest_settled", "begun_settled"),
    *("expected_x2", "expected_x3", "pull_kpa", "clear_kpa"),
)
"""names of the rows of the memory, from :data:`._turning_rows.MAY_BEAR_KPA` on"""
EARLIEST_KPA, BEGUN_KPA, EARLIEST_SETTLED, BEGUN_SETTLED, EXPECTED_X2, EXPECTED_X3, PULL_KPA, CLEAR_KPA = range(38, 46)
"""rows: pressures of the rising model begun with the recovery and of the one begun at the moment; their settled states;
r of the branches if no load has risen since the moment; the pull, and the pull when it became clear (0: not yet)"""

GAIN_KPA, FADES_2, FADES_3, BACK_2, BACK_3, GONE, RAMP, RISING_GAIN_KPA, HIDDEN_2, HIDDEN_3, LASTS = range(11)
"""places of the numbers that depend on the time between frames: kPa per r in recovery; share of the r of each branch
that is left at the next look; r of each branch in the middle of the averaged readings, over its present r; weights of
the rising model from one look to the next, and kPa per r then; kPa that a load reaches within :data:`HIDES_S` at the
hidden rate, per r of either branch; share of a standard deviation that is left at the next look. Then constants:"""
ETAU2_KPA, SETTLED_PER_KPA = 11, 12
"""of the model; and settled state of the rising model per kPa where this model begins"""


def constants(model: PaperModel, dt_s: float) -> Constants:
    """The numbers that :func:`look` takes, for frames ``dt_s`` apart; places as above."""
    look_s, (back_2, back_3) = RECENT * dt_s, borne_before(model, 0.5 * (RECENT - 1) * dt_s)
    gone, ramp = (float(weight) for weight in lag.weights(look_s, model.tu_s))
    unseen = HIDES_S / fast_r(model)[0]
    numbers = {
        GAIN_KPA: float(step_weights(model, dt_s).gain[-1]),
        FADES_2: math.exp(-look_s / model.t2_s),
        FADES_3: math.exp(-look_s / model.t3_s),
        BACK_2: back_2,
        BACK_3: back_3,
        GONE: gone,
        RAMP: ramp,
        RISING_GAIN_KPA: float(step_weights(model, look_s).gain[0]),
        # A small load p: r' = p' (1 / Eu1 + 1 / etau2) - r / Tu. At rest, each branch: r' = -r / T. The hidden rate
        # equates them.
        HIDDEN_2: unseen * (1.0 / model.tu_s - 1.0 / model.t2_s),
        HIDDEN_3: unseen * (1.0 / model.tu_s - 1.0 / model.t3_s),
        LASTS: math.exp(-look_s / LASTS_S),
        ETAU2_KPA: model.etau2_kpa,
        SETTLED_PER_KPA: 1.0 + model.etau2_kpa / model.eu1_kpa,
    }
    return numbered(numbers)


def begin_anew(memory: FloatArray) -> None:
    """Forget when loads may have begun in m cells; changes their ``memory`` (rows, m)."""
    memory[VARIANCE] -= memory[MAY_BEAR_KPA] * memory[MAY_BEAR_KPA]
    memory[MAY_BEAR_KPA : LOOKS_AT_REST + 1] = 0.0


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
    looks = memory[LOOKS_AT_REST]
    recovers = memory[LEFT] >= _FAR
    recovers &= memory[SIGN] < _ZERO
    by_noise = noise * numbers[GAIN_KPA]
    by_noise *= by_noise
    bound = (memory[REST_VARIANCE] + by_noise) * _BOUND
    recovers &= (memory[PRESSURE] * memory[PRESSURE] < bound) | (looks > _ZERO)
    np.copyto(looks, np.abs(looks) + _ONE, where=recovers)
    memory[EXPECTED_X2] *= numbers[FADES_2]
    memory[EXPECTED_X3] *= numbers[FADES_3]
    pressures, settled = memory[EARLIEST_KPA : BEGUN_KPA + 1], memory[EARLIEST_SETTLED : BEGUN_SETTLED + 1]
    settled += (pressures - settled) * numbers[GONE] - pressures * numbers[RAMP]
    pressures[...] = (memory[STATE_END - 1] + settled / numbers[ETAU2_KPA]) * numbers[RISING_GAIN_KPA]
    settled += pressures * numbers[RAMP]
    rests = (recovers & (looks >= _SETTLES)).nonzero()[0]
    if not rests.size:
        return
    some = columns(memory, rests)
    _compare(some, mean[rests], noise[rests], full_scale_kpa, numbers)
    memory[:, rests] = some


def _compare(
    memory: FloatArray, mean: FloatArray, noise: FloatArray, full_scale_kpa: float, numbers: tuple[FloatArray, ...]
) -> None:
    """Compare the two hypotheses, and take over the second one where it is clear; :func:`look` for some cells."""
    load = memory[BEGUN_KPA]
    by_model = memory[REST_VARIANCE] + memory[TURNED] * MODEL
    by_noise = noise * numbers[GAIN_KPA]
    by_noise *= by_noise
    by_noise *= 1.0 / RECENT
    weight = np.maximum(by_model / (by_model + by_noise), _AVERAGED)
    last = (memory[EXPECTED_X2] * numbers[BACK_2] + memory[EXPECTED_X3] * numbers[BACK_3] - mean) * numbers[GAIN_KPA]
    pull = memory[PULL_KPA] + (last - memory[PULL_KPA]) * weight
    none = NONE * full_scale_kpa
    by_noise = by_noise * (weight / (2.0 - weight)) + none * none
    unsure = np.sqrt(by_model + by_noise)
    settles = memory[LOOKS_AT_REST] == _SETTLES
    anew = settles | (pull <= load * COINCIDENCE + none) | (load < -unsure)
    likely = np.minimum(np.maximum((pull / unsure - SOME_SIGMAS) * _PER_SIGMA, _ZERO), _ONE)
    shown = np.maximum(memory[PRESSURE], _ZERO)
    may_bear = np.sqrt(likely) * np.maximum(load - shown, _ZERO)
    hidden = memory[X2] * numbers[HIDDEN_2] + memory[RECOVERY_X3] * numbers[HIDDEN_3]
    hidden = np.minimum(hidden, memory[EARLIEST_KPA])
    hidden = np.maximum(hidden - shown, _ZERO) * HIDDEN
    clear, clear_before = ~anew & (pull > unsure * CLEAR_SIGMAS), memory[CLEAR_KPA]
    more = clear & (clear_before > _ZERO) & (pull > clear_before + np.sqrt(by_noise) * MORE_SIGMAS)
    held = memory[RISING_KPA] + memory[EARLIER_KPA]
    risen = np.maximum(load, np.where(held * -HELD > memory[EARLIER_FROM_KPA], held, _ZERO))
    more &= risen > CLEAR * full_scale_kpa
    np.maximum(may_bear, hidden, out=may_bear, where=clear)
    np.copyto(may_bear, _ZERO, where=anew)
    np.maximum(may_bear, memory[MAY_BEAR_KPA] * numbers[LASTS], out=may_bear)
    np.copyto(may_bear, _ZERO, where=more)
    memory[VARIANCE] += may_bear * may_bear - memory[MAY_BEAR_KPA] * memory[MAY_BEAR_KPA]
    memory[MAY_BEAR_KPA] = may_bear
    memory[CLEAR_KPA] = np.where(anew, _ZERO, np.where(clear & (clear_before == _ZERO), pull, clear_before))
    memory[PULL_KPA] = np.where(anew, _ZERO, pull)
    forgotten = (memory[X2] + memory[RECOVERY_X3]) * -numbers[ETAU2_KPA]
    for begins, begun_kpa, begun_settled in (
        (settles, EARLIEST_KPA, EARLIEST_SETTLED),
        (anew, BEGUN_KPA, BEGUN_SETTLED),
    ):
        np.copyto(memory[begun_kpa], _ZERO, where=begins)
        np.copyto(memory[begun_settled], forgotten, where=begins)
    np.copyto(memory[EXPECTED_X2], memory[X2], where=anew)
    np.copyto(memory[EXPECTED_X3], memory[RECOVERY_X3], where=anew)
    if np.count_nonzero(more):
        _take_over(memory, more, risen, hidden, numbers)


def _take_over(
    memory: FloatArray, more: BoolArray, risen: FloatArray, hidden: FloatArray, numbers: tuple[FloatArray, ...]
) -> None:
    """Let loads ``risen`` (m,) in kPa bear on those of m cells whose clear pull has grown ``more`` (m,).

    ``hidden`` (m,) is the standard deviation in kPa of an earlier rise at the hidden rate. Changes ``memory``.
    """
    doubt = risen * EITHER
    doubt = memory[TURNED] + doubt * doubt + hidden * hidden
    for row, value in (
        (RISING_KPA, risen),
        (SETTLED, risen * numbers[SETTLED_PER_KPA] - memory[STATE_END - 1] * numbers[ETAU2_KPA]),
        (RISING_X3, memory[RECOVERY_X3]),
        (EXTREME, _REFUTED),
        (RESTED, _ZERO),
        (LOOKS_AT_REST, -memory[LOOKS_AT_REST]),
        (TURNED, doubt),
        (VARIANCE, doubt),
    ):
        np.copyto(memory[row], value, where=more)


def hidden_kpa(memory: FloatArray, pressure: FloatArray, extreme: FloatArray, share: FloatArray) -> FloatArray:
    """(m,) standard deviation in kPa of rises that have just been noticed, and may have begun earlier.

    Args:
        memory: (rows, m) of the cells.
        pressure: (m,) to which the load has risen.
        extreme: (m,) minus the pressure from which it has risen.
        share: pressure of the rising model after a fast change, over that of the recovery model.
    """
    rise = pressure + extreme
    rises = (rise > _ZERO) & (memory[LOOKS_AT_REST] >= _SETTLES)
    shared = (memory[RECOVERY_KPA] + extreme) / np.where(rises, rise, _ONE) * share
    hidden = np.minimum(np.maximum(_ONE - shared, _ZERO), _ONE)
    kpa = hidden * hidden * np.maximum(memory[EARLIEST_KPA] - pressure, _ZERO) * HIDDEN_SHARE
    found: FloatArray = np.where(rises, kpa, _ZERO)
    return found


@loop
def hidden_kpa_of(memory: SpacedRows, i: int, pressure: float, extreme: float, share: float) -> float:
    """:func:`hidden_kpa` of cell ``i``."""
    rise = pressure + extreme
    if memory[LOOKS_AT_REST, i] < SETTLES or rise <= 0.0:
        return 0.0
    shared = (memory[RECOVERY_KPA, i] + extreme) / rise * share
    hidden = min(max(1.0 - shared, 0.0), 1.0)
    return float(hidden * hidden * max(memory[EARLIEST_KPA, i] - pressure, 0.0) * HIDDEN_SHARE)


@loop
def look_each(memory: SpacedRows, mean: Row, noise: Row, full_scale_kpa: float, numbers: Row) -> None:
    """:func:`look` as a loop over cells."""
    none, etau2_kpa = NONE * full_scale_kpa, numbers[ETAU2_KPA]
    for i in range(mean.size):
        looks = memory[LOOKS_AT_REST, i]
        by_noise = noise[i] * numbers[GAIN_KPA]
        by_noise *= by_noise
        bound = (memory[REST_VARIANCE, i] + by_noise) * BOUND
        rests = memory[PRESSURE, i] * memory[PRESSURE, i] < bound or looks > 0.0
        recovers = rests and memory[LEFT, i] >= FAR and memory[SIGN, i] < 0.0
        if recovers:
            looks = abs(looks) + 1.0
            memory[LOOKS_AT_REST, i] = looks
        memory[EXPECTED_X2, i] *= numbers[FADES_2]
        memory[EXPECTED_X3, i] *= numbers[FADES_3]
        r = memory[STATE_END - 1, i]
        for model in range(2):
            load, settled = memory[EARLIEST_KPA + model, i], memory[EARLIEST_SETTLED + model, i]
            settled += (load - settled) * numbers[GONE] - load * numbers[RAMP]
            load = (r + settled / etau2_kpa) * numbers[RISING_GAIN_KPA]
            memory[EARLIEST_KPA + model, i] = load
            memory[EARLIEST_SETTLED + model, i] = settled + load * numbers[RAMP]
        if not (recovers and looks >= SETTLES):
            continue
        load = memory[BEGUN_KPA, i]
        by_model = memory[REST_VARIANCE, i] + memory[TURNED, i] * MODEL
        by_noise *= 1.0 / RECENT
        weight = max(by_model / (by_model + by_noise), AVERAGED)
        last = memory[EXPECTED_X2, i] * numbers[BACK_2] + memory[EXPECTED_X3, i] * numbers[BACK_3] - mean[i]
        pull = memory[PULL_KPA, i] + (last * numbers[GAIN_KPA] - memory[PULL_KPA, i]) * weight
        by_noise = by_noise * (weight / (2.0 - weight)) + none * none
        unsure = math.sqrt(by_model + by_noise)
        may_bear2, shown = memory[MAY_BEAR_KPA, i] * memory[MAY_BEAR_KPA, i], max(memory[PRESSURE, i], 0.0)
        may_bear = memory[MAY_BEAR_KPA, i] * numbers[LASTS]
        if looks == SETTLES or pull <= load * COINCIDENCE + none or load < -unsure:
            settled = (memory[X2, i] + memory[RECOVERY_X3, i]) * -etau2_kpa
            if looks == SETTLES:
                memory[EARLIEST_KPA, i], memory[EARLIEST_SETTLED, i] = 0.0, settled
            memory[BEGUN_KPA, i], memory[BEGUN_SETTLED, i], memory[PULL_KPA, i] = 0.0, settled, 0.0
            memory[EXPECTED_X2, i], memory[EXPECTED_X3, i] = memory[X2, i], memory[RECOVERY_X3, i]
            memory[VARIANCE, i] += may_bear * may_bear - may_bear2
            memory[CLEAR_KPA, i], memory[MAY_BEAR_KPA, i] = 0.0, may_bear
            continue
        memory[PULL_KPA, i] = pull
        clear, clear_before = pull > unsure * CLEAR_SIGMAS, memory[CLEAR_KPA, i]
        if clear and clear_before == 0.0:
            memory[CLEAR_KPA, i] = pull
        hidden = memory[X2, i] * numbers[HIDDEN_2] + memory[RECOVERY_X3, i] * numbers[HIDDEN_3]
        hidden = max(min(hidden, memory[EARLIEST_KPA, i]) - shown, 0.0) * HIDDEN
        more = clear and clear_before > 0.0 and pull > clear_before + math.sqrt(by_noise) * MORE_SIGMAS
        held = memory[RISING_KPA, i] + memory[EARLIER_KPA, i]
        risen = max(load, held) if held * -HELD > memory[EARLIER_FROM_KPA, i] else load
        if more and risen > CLEAR * full_scale_kpa:
            doubt = risen * EITHER
            doubt = memory[TURNED, i] + doubt * doubt + hidden * hidden
            memory[RISING_KPA, i], memory[SETTLED, i] = risen, risen * numbers[SETTLED_PER_KPA] - r * etau2_kpa
            memory[RISING_X3, i], memory[EXTREME, i] = memory[RECOVERY_X3, i], REFUTED
            memory[RESTED, i], memory[LOOKS_AT_REST, i], memory[MAY_BEAR_KPA, i] = 0.0, -looks, 0.0
            memory[TURNED, i] = memory[VARIANCE, i] = doubt
            continue
        likely = min(max((pull / unsure - SOME_SIGMAS) * PER_SIGMA, 0.0), 1.0)
        may_bear = max(may_bear, math.sqrt(likely) * max(load - shown, 0.0))
        if clear:
            may_bear = max(may_bear, hidden)
        memory[VARIANCE, i] += may_bear * may_bear - may_bear2
        memory[MAY_BEAR_KPA, i] = may_bear


LOOPS = (look_each,)
