"""Slow presses of cells that recover: quickest change detection of the moment at which the load began to rise.

Under a load the paper's cell forgets sooner than at rest. A small load therefore lets the resistance of a cell that
still recovers fall *faster*: the recovery model would need a pull, which passes for an error of what it remembers, and
is taken out of its memory again and again. Only a fast press raises the resistance by more than that.

Two hypotheses are compared while a cell recovers. Under the first one it bears nothing: the readings follow what it
remembered when they last gave no sign of a load, as far as that memory is known and noise allows. Under the second one
a load has risen since that moment, at whatever rate. The statistic is the pull that the first hypothesis needs
altogether. Where it needs none, the moment is moved to the present, as in Page's test (CUSUM). An error of the memory
needs a pull once, while a load needs more and more of it. Where the pull is clear, the second hypothesis is taken over.
Before, its load counts as standard deviation in proportion to how likely it has become.

At some rate, a load raises the resistance by just what the cell forgets sooner. Such a load is hidden: the readings are
those of a cell at rest until the rate changes. When it emerges, the rising model begins too late. The less of the rise
the recovery model shares, the nearer the rate is to the hidden one, and the more likely the load began before. Its
pressure is then between that of the rising model and what it would be if the load had begun with the recovery. A load
that was hidden and is then held needs a pull, too, and so does a light touch. Where the pull is clear, how far a load
may have risen unseen therefore counts as standard deviation. A load that comes to the hidden rate needs no more pull:
its doubt fades, and does not end at once.

A load that fell to a part of itself and then grows slowly needs a pull as well, since the recovery model lets it fall
to none. The hypothesis of :mod:`._earlier` has followed that load. Where most of its pressure was there when the
recovery began, it is taken over: one that is held is more likely than one that goes on at the hidden rate.

T. L. Lai: "Sequential changepoint detection in quality control and dynamical systems", J. R. Statist. Soc. B 57 (1995).
"""

from __future__ import annotations

import math

import numpy as np

from ...arrays import BoolArray, FloatArray, columns
from ...compiled import Row, SpacedRows, loop
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
"""looks from which what a cell at rest remembers is known: by then the smoothing has passed the release"""
HIDDEN_SHARE = 0.7
"""standard deviation over what a rise that was hidden would make"""
MODEL = 0.06
"""share of the variance of the memory that no averaging of readings removes: its error fades otherwise than the filter
of :mod:`._recovery` reckons with. Of rests after taps in up to 3 mV none needs a pull of :data:`CLEAR_SIGMAS` then"""
SOME_SIGMAS, CLEAR_SIGMAS, MORE_SIGMAS = 0.5, 3.0, 4.0
"""standard deviations of the pull from which a load is possible, and from which the pull is clear; and those of noise
by which it must grow after that for the load to be taken over. A light touch that has ended leaves a pull, too"""
AVERAGED = 0.25
"""least weight of the last look in the pull: a pull is averaged as long as noise makes more of it than the memory"""
COINCIDENCE = 0.25
"""of the load: a pull that is no larger is none. The load would have to follow the hidden rate for all the time"""
NONE, CLEAR = 0.002, 0.01
"""of full scale: a pull that is none, and a load that is worth taking over"""
EITHER = 0.6
"""standard deviation over a load that is taken over, since it may have begun later"""
HIDES_S, HIDDEN = 2.0, 0.4
"""how long a load may have risen at the hidden rate; and standard deviation over such a load where the pull is clear"""
HELD = 0.7
"""share of a load that must have been there when recovery began, for the load to have been held since"""
LASTS_S = 3.0
"""time in which the doubt about a load fades that has come to the hidden rate"""
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
"""rows: the rising model that began with the recovery, and the one that began at the moment; their second states; what
the branches bear if nothing has risen since the moment; the pull, and what it was when it became clear, else none"""

GAIN_KPA, FADES_2, FADES_3, BACK_2, BACK_3, GONE, RAMP, RISING_GAIN_KPA, HIDDEN_2, HIDDEN_3, LASTS = range(11)
"""places of what depends on the time between frames: kPa per r in recovery; share of what the branches bear that is
left at the next look; by how much more they bore when the mean of the readings was right; weights of the rising model
from one look to the next, and kPa per r then; kPa that a load rises to within :data:`HIDES_S` at the hidden rate, per r
that either branch bears; share of a doubt that lasts until the next look. And constants:"""
ETAU2_KPA, SETTLED_PER_KPA = 11, 12
"""of the model; second state of the rising model, per kPa"""


def constants(model: PaperModel, dt_s: float) -> Constants:
    """What :func:`look` takes, for frames ``dt_s`` apart; places as above."""
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
        # A load p near none makes r' = p' (1 / Eu1 + 1 / etau2) - r / Tu, and at rest each branch makes r' = -r / T.
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
    """Compare the two hypotheses, and take over the second one where it is clear; as :func:`look`, of some cells."""
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
    """Let loads ``risen`` (m,) in kPa bear on those of m cells whose pull is ``more`` (m,) than clear.

    ``hidden`` (m,) is the standard deviation in kPa of what they may have risen by before. Changes ``memory``.
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
        pressure: (m,) to which their load has risen.
        extreme: (m,) from which it has risen, with its sign turned.
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
