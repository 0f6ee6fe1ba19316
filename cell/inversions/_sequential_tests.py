"""Sequential tests on means of readings of the paper's cell: rest, release (CUSUM), onset of a load (Page's test).

**Rest of a released cell** (:func:`rest`): a scalar Kalman filter of the error of the memory, under the hypothesis that
the cell bears no load. The noise at a turn leaves an error in the memory, which later shows as a load and fades only as
fast as the material recovers. The readings cannot tell such an error from a light load: both recover along the same
curve for seconds. But most released cells bear no load. As long as the pressure of a recovering cell differs from none
by no more than the error of its memory explains, we take the difference for that error and subtract it. The filter
averages the readings of the whole rest, which is much longer than the smoothing may average. While the pressure still
moves, the load that may be left counts as noise of the readings (:data:`GOES_ON`), and the cell is not yet taken for
one at rest. A light load that is subtracted by mistake comes back as the error of the memory fades. Three rules limit
the harm: the subtracted pressure becomes part of the stated standard deviation at once, and is part of it at the next
turn; the filter trusts the memory the more the more it has read; and a rise is no turn if the fading error
(:data:`DRIFTS`) and the return of the subtracted pressure explain it.

**Release** (:func:`release_cusum`): after taps that have left several times the resistance at rest, noise is as many
times larger. A release then takes the rising model back by only three standard deviations of the smoothed readings.
Successive readings together give the evidence: their means are inverted with the rising model and compared with the
largest mean of late, and Page's test adds up by how many standard deviations they lie below it. The largest mean fades
towards the present one, since errors of the memory fade, too; a release is faster than that.

**Onset** (:func:`onset`): under a load the paper's cell forgets sooner than at rest. A small load therefore lets the
resistance of a recovering cell fall *faster*, so that the recovery model needs a negative pressure (a pull), which
would pass for an error of the memory. Two hypotheses are compared while a cell recovers: that it bears nothing, so that
the readings follow from the memory at the last moment without a sign of a load; and that a load has risen since, at
whatever rate. The statistic is the whole pull that the first hypothesis needs; where it needs none, the moment is moved
to the present, as in Page's test. An error of the memory needs a pull once, while a load needs an ever larger one. When
the pull is clear and still grows, the second hypothesis is taken over. Before, its load counts as standard deviation,
weighted by how likely it is. Limit: at one rate of rise, the hidden rate, a load raises the resistance by
just what the cell forgets sooner; the readings are those of a cell at rest until the rate changes. A load that fell to
a part of itself and then grows slowly needs a pull as well. If most of its pressure was there when the recovery began,
the load of the third hypothesis (:mod:`._hypotheses`) is taken over.

T. L. Lai: "Sequential changepoint detection in quality control and dynamical systems", J. R. Statist. Soc. B 57 (1995).
"""

from __future__ import annotations

import math

from ...common.compiled import Places, Record, Records, Row, loop, record
from .._state import CellState, PaperState
from ..estimation import RECENT
from ..materials import PaperModel, lag
from ._linear_models import PaperNumbers, gains_of, lags_before

USUAL_ERROR = 0.3
"""share of the variance stated for the memory at a release that the usual error has; the rest covers rare errors"""
MOST_RESTED = 0.2
"""of full scale: if the standard deviation of the memory is larger, rest is no better a guess than a load"""
REST_SIGMAS = 2.0
"""standard deviations by which the pressure of a cell at rest may differ from zero"""
RESTED_SIGMAS = 5.0
"""standard deviations, of smoothed noise and memory together, at which a load and no load are equally likely in a
released cell. More than in other cells: the error of the memory shows in every frame of a rest, and its standard
deviation here is only that of the usual error (:data:`USUAL_ERROR`)"""
GOES_ON, STEADY = 4.0, 0.25
"""standard deviation of the load that is left while it still moves, over its change in three frames; and the change
that does not count, in standard deviations of a reading"""
FELL = 0.75
"""times what is left of the pressure: it must have fallen by so much for the remainder to be an error of the memory. A
load that trembles falls by less, however long it is held. Where recovery began without a fall, as after a refuted rise,
this condition is not asked for"""
LIGHT = 0.1
"""share of the variance of the memory that stays after a rest, since the released cell may have borne a light load
after all. The squares of the subtracted pressure and of a load that may have begun are added. The subtracted pressure
stays in the variance, while it fades, until a clearly larger load is released: the falls of a tremor are no new signs
of rest"""
CLEARLY_LARGER2 = 4.0
"""square of a load that is larger than the subtracted pressure for sure, over the square of that pressure"""
DRIFTS = 2.0
"""standard deviations of the memory: so large a change of pressure may look like a turn as the error fades"""
OVERSHOOT, OLD = 3.0, 3.0 * RECENT
"""standard deviations of a reading by which the line of the smoothing may overshoot where a rising load stops: readings
must depart from the line by some standard deviations before a new line begins. A smaller fall may be no turn. And the
readings of a line from which this is allowed for; the end of a shorter line is as uncertain anyway"""
PEAK_FADES = 0.15
"""share of the distance to the extreme by which the peak goes down from one look to the next. The noisy first pressures
of a press may exceed all later ones; the other hypothesis would otherwise begin there, however long the load is held"""

MEAN_SIGMAS, ALLOWANCE = 1.0, 0.75
"""standard deviations of a mean that are subtracted from a new largest mean, since it is partly noise; and those by
which a mean may lie below the largest without adding to the sum (the allowance of CUSUM)"""
LARGEST_S = 0.5
"""seconds, time constant with which the largest mean fades towards the present one"""
LOUD = 0.05
"""of full scale: above this standard deviation of a mean nothing is summed up. A resistance is the reciprocal of a
current, so that in so much noise single resistances are far too large, and all later ones would seem to fall"""

SETTLES = 7.0
"""looks at a cell at rest after which its memory is known: by then the smoothing has passed the release"""
MODEL = 0.06
"""share of the variance of the memory that no averaging of readings removes, since its error does not fade just as the
filter of :func:`rest` assumes. With this share no rest after taps, in noise of up to 3 mV, needs a clear pull"""
SOME_SIGMAS, CLEAR_SIGMAS, MORE_SIGMAS = 0.5, 3.0, 4.0
"""standard deviations of the pull above which a load is possible, and above which the pull is clear; and standard
deviations of noise by which a clear pull must grow further for the load to be taken over: a light touch that has ended
leaves a pull, too"""
AVERAGED = 0.25
"""least weight of the last look in the average of the pull, which averages as long as noise exceeds the memory's
error"""
COINCIDENCE = 0.25
"""share of the load of the second hypothesis: a smaller pull counts as none, since the load would have to follow the
hidden rate all the time"""
NONE, CLEAR = 0.002, 0.01
"""of full scale: a smaller pull counts as none; a smaller load is not taken over"""
EITHER = 0.6
"""standard deviation of a load that is taken over, over the load: it may have begun later"""
HELD = 0.7
"""share of a load that must have been there when recovery began for it to count as held since"""
LASTS_S = 3.0
"""seconds, time constant with which the standard deviation by a load fades that has come to the hidden rate"""


class LookStep(Record):
    """Numbers that depend on the time between frames."""

    rising_gain_kpa: float
    """pressure per r in a frame in the rising model"""
    recovery_gain_kpa: float
    variance_fades: float
    """share of a variance of the memory in recovery that is left at the next look"""
    rising_drift: float
    """share of its way that a drift goes until the next look under a rising load"""
    recovery_drift: float
    before_2: float
    """r of the first branch in the middle of the readings of the mean, over its present r"""
    before_3: float
    fades_2: float
    """share of the r of the first branch that is left at the next look"""
    fades_3: float
    since: float
    """share of the way to its equilibrium that r has gone, under a held load, since the middle of the readings"""
    largest_fades: float
    """share by which the largest mean fades until the next look"""
    forgets_u: float
    """weights of the rising model from one look to the next"""
    ramp_u: float
    look_gain_kpa: float
    """pressure per r of the rising model from one look to the next"""
    may_bear_fades: float
    """share of the standard deviation by a load at the hidden rate that is left at the next look"""


def look_step(model: PaperModel, dt_s: float) -> LookStep:
    """The numbers for frames ``dt_s`` apart."""
    m, look_s = model, RECENT * dt_s
    gain, (rising_fade, fade) = gains_of(m, dt_s)
    before, (forgets, ramp) = lags_before(m, 0.5 * (RECENT - 1) * dt_s), lag.weights(look_s, m.tu_s)
    return record(
        LookStep,
        rising_gain_kpa=gain[0],
        recovery_gain_kpa=gain[1],
        variance_fades=fade**RECENT,
        rising_drift=1.0 - rising_fade ** (RECENT / 2),  # errors fade as the root of their variance
        recovery_drift=1.0 - fade ** (RECENT / 2),
        before_2=before[0],
        before_3=before[1],
        fades_2=math.exp(-look_s / m.t2_s),
        fades_3=math.exp(-look_s / m.t3_s),
        since=-math.expm1(-0.5 * (RECENT - 1) * dt_s / m.tu_s),
        largest_fades=-math.expm1(-look_s / LARGEST_S),
        forgets_u=float(forgets),
        ramp_u=float(ramp),
        look_gain_kpa=gains_of(m, look_s)[0][0],
        may_bear_fades=math.exp(-look_s / LASTS_S),
    )


@loop
def test_each(
    cells: Records[CellState],
    memory: Records[PaperState],
    awake: Places,
    means: Row,
    k: PaperNumbers,
    s: LookStep,
) -> None:
    """Take the ``means`` (m,) of the last :data:`..estimation.RECENT` readings of the cells that are ``awake`` (m,)."""
    for n in range(awake.size):
        cell, own = cells[awake[n]], memory[awake[n]]
        rest(cell, own, means[n], k, s)
        release_cusum(cell, own, means[n], k, s)
        onset(cell, own, means[n], k, s)


# -- rest ------------------------------------------------------------------------------------------------------------


@loop
def rest(cell: CellState, own: PaperState, mean: float, k: PaperNumbers, s: LookStep) -> None:
    """Subtract the error of the memory of a released cell that the mean of its readings tells."""
    own.peak_kpa += (own.extreme_kpa - own.peak_kpa) * PEAK_FADES
    rises = own.direction > 0.0
    drift_end = own.drift_end_kpa + max(own.subtracted_kpa, 0.0)
    own.drift_kpa += (drift_end - own.drift_kpa) * (s.rising_drift if rises else s.recovery_drift)
    if rises and cell.count >= OLD:
        own.drift_kpa = max(own.drift_kpa, cell.noise * cell.gain_kpa * OVERSHOOT)
    cell.rest_variance_kpa2 *= s.variance_fades
    own.subtracted_before_kpa2 *= s.variance_fades
    if rises or cell.unconfirmed > 0.0:
        return
    shown, x3, gain = cell.pressure_kpa, own.recovery_x3, s.recovery_gain_kpa
    pressure = (mean - (own.x2 * s.before_2 + x3 * s.before_3)) * gain
    by_noise = cell.noise * gain
    moves = max(abs(own.third_last_kpa - shown) - by_noise * STEADY, 0.0) * GOES_ON
    by_noise = by_noise * by_noise * (1.0 / RECENT)
    bound = (cell.rest_variance_kpa2 + by_noise) * (REST_SIGMAS * REST_SIGMAS)
    left = shown + own.subtracted_kpa
    fell = own.released_kpa - left >= left * FELL or own.released_kpa <= 0.0
    if not (fell and pressure * pressure < bound and shown * shown < bound):
        return
    share = cell.rest_variance_kpa2 / (cell.rest_variance_kpa2 + by_noise + moves * moves)
    error = pressure * share
    cell.rest_variance_kpa2 *= 1.0 - share
    if moves == 0.0:
        cell.rested = 1.0
    own.subtracted_kpa += error
    more = max(own.subtracted_kpa * own.subtracted_kpa - cell.turn_variance_kpa2, 0.0)
    cell.turn_variance_kpa2 += more
    cell.variance_kpa2 += more
    p = shown - error
    cell.pressure_kpa, own.rising_kpa, own.recovery_kpa = p, p, p
    own.settled_kpa = p * k.settled_per_kpa - own.r * k.etau2_kpa
    own.x2 = own.r - p / k.e1_kpa - x3
    own.rising_x3 = x3
    own.extreme_kpa = min(own.extreme_kpa + error, 0.0)
    own.peak_kpa = min(own.peak_kpa + error, 0.0)
    own.recent_extreme_kpa = min(own.recent_extreme_kpa + error, 0.0)


@loop
def subtracted2(own: PaperState) -> float:
    """Square in kPa^2 of the pressure that rests have subtracted: the last one, or those since a clear release."""
    before = own.subtracted_before_kpa2
    if own.released_kpa * own.released_kpa > CLEARLY_LARGER2 * before:
        before = 0.0
    return float(max(own.subtracted_kpa * own.subtracted_kpa, before))


@loop
def variance_at_turn(cell: CellState, own: PaperState) -> float:
    """Variance in kPa^2 of the memory of a cell that has just turned, less the part that a rest averaged away."""
    variance = cell.variance_kpa2
    if cell.rested > 0.0:
        left_over = variance * LIGHT + subtracted2(own) + own.may_bear_kpa * own.may_bear_kpa
        variance = min(variance, cell.rest_variance_kpa2 + left_over)
    return float(variance)


@loop
def begin_after_turn(cell: CellState, own: PaperState, by_noise: float, sagged_kpa: float, k: PaperNumbers) -> None:
    """Begin the filter anew in a cell that has just turned.

    All of ``by_noise``, the variance in kPa^2 by noise of the turn's own reading, and of ``sagged_kpa``, the standard
    deviation by a load that may have sagged before its release, belongs to the usual error.
    """
    variance, most = cell.turn_variance_kpa2, k.most_rested_kpa2
    if cell.rested > 0.0:
        own.subtracted_before_kpa2 = subtracted2(own)
    cell.rested, own.drift_kpa, own.subtracted_kpa = 0.0, 0.0, 0.0
    usual = max(variance - by_noise, 0.0) * USUAL_ERROR + min(by_noise, variance)
    cell.rest_variance_kpa2 = (usual if variance < most else 0.0) + sagged_kpa * sagged_kpa
    own.drift_end_kpa = math.sqrt(min(variance, most)) * DRIFTS


# -- release ---------------------------------------------------------------------------------------------------------


@loop
def release_cusum(cell: CellState, own: PaperState, mean: float, k: PaperNumbers, s: LookStep) -> None:
    """Add up by how much means of readings lie below the largest of late.

    A fast fall of r takes both models back, the recovery model by more. A further fall of the recovery model is that of
    a held load. Of this part, the share that may be an error of the rising model is not counted.
    """
    since = (own.rising_kpa * (1.0 / k.eu1_kpa) - own.r) * s.since
    pressure = (mean + since - own.r) * s.rising_gain_kpa + own.rising_kpa
    by_noise = cell.noise * (s.rising_gain_kpa / math.sqrt(RECENT))
    begun, below = pressure - by_noise * MEAN_SIGMAS, own.largest_mean_kpa - pressure
    if begun > own.largest_mean_kpa or own.direction < 0.0 or by_noise > LOUD * k.full_kpa:
        own.largest_mean_kpa, own.cusum = begun, 0.0
        return
    held = own.extreme_kpa - own.recovery_kpa - (own.extreme_kpa - own.rising_kpa) * k.rise_per_fall
    held = max(held, 0.0) * k.fall_share
    own.cusum = max(own.cusum + (below - k.turn_kpa - held) / by_noise - ALLOWANCE, 0.0)
    own.largest_mean_kpa -= max(below, 0.0) * s.largest_fades


# -- onset -----------------------------------------------------------------------------------------------------------


@loop
def onset(cell: CellState, own: PaperState, mean: float, k: PaperNumbers, s: LookStep) -> None:
    """Compare the hypotheses that a recovering cell bears nothing and that a load rises, and take over a clear load."""
    none, looks = NONE * k.full_kpa, own.looks_at_rest
    by_noise = cell.noise * s.recovery_gain_kpa
    by_noise *= by_noise
    bound = (cell.rest_variance_kpa2 + by_noise) * (REST_SIGMAS * REST_SIGMAS)
    rests = cell.pressure_kpa * cell.pressure_kpa < bound or looks > 0.0
    recovers = rests and cell.unconfirmed == 0.0 and own.direction < 0.0
    if recovers:
        looks = abs(looks) + 1.0
        own.looks_at_rest = looks
    own.expected_x2 *= s.fades_2
    own.expected_x3 *= s.fades_3
    own.begun_kpa, own.begun_settled_kpa = risen_since(own.begun_kpa, own.begun_settled_kpa, own.r, k, s)
    if not (recovers and looks >= SETTLES):
        return
    load = own.begun_kpa
    by_model = cell.rest_variance_kpa2 + cell.turn_variance_kpa2 * MODEL
    by_noise *= 1.0 / RECENT
    weight = max(by_model / (by_model + by_noise), AVERAGED)
    last = own.expected_x2 * s.before_2 + own.expected_x3 * s.before_3 - mean
    pull = own.pull_kpa + (last * s.recovery_gain_kpa - own.pull_kpa) * weight
    by_noise = by_noise * (weight / (2.0 - weight)) + none * none
    unsure = math.sqrt(by_model + by_noise)
    shown, may_bear = max(cell.pressure_kpa, 0.0), own.may_bear_kpa * s.may_bear_fades
    if looks == SETTLES or pull <= load * COINCIDENCE + none or load < -unsure:
        settled = (own.x2 + own.recovery_x3) * -k.etau2_kpa
        own.begun_kpa, own.begun_settled_kpa, own.pull_kpa, own.clear_pull_kpa = 0.0, settled, 0.0, 0.0
        own.expected_x2, own.expected_x3 = own.x2, own.recovery_x3
        may_bear_load(cell, own, may_bear)
        return
    own.pull_kpa = pull
    clear, clear_before = pull > unsure * CLEAR_SIGMAS, own.clear_pull_kpa
    if clear and clear_before == 0.0:
        own.clear_pull_kpa = pull
    more = clear and clear_before > 0.0 and pull > clear_before + math.sqrt(by_noise) * MORE_SIGMAS
    held = own.rising_kpa + own.earlier_kpa
    risen = max(load, held) if held * -HELD > own.earlier_from_kpa else load
    if more and risen > CLEAR * k.full_kpa:
        doubt = risen * EITHER
        own.rising_kpa, own.settled_kpa = risen, risen * k.settled_per_kpa - own.r * k.etau2_kpa
        own.rising_x3, own.turn_due, own.looks_at_rest, own.may_bear_kpa = own.recovery_x3, 1.0, -looks, 0.0
        cell.rested = 0.0
        cell.turn_variance_kpa2 = cell.turn_variance_kpa2 + doubt * doubt
        cell.variance_kpa2 = cell.turn_variance_kpa2
        return
    likely = min(max((pull / unsure - SOME_SIGMAS) * (1.0 / (CLEAR_SIGMAS - SOME_SIGMAS)), 0.0), 1.0)
    may_bear_load(cell, own, max(may_bear, math.sqrt(likely) * max(load - shown, 0.0)))


@loop
def risen_since(load_kpa: float, settled_kpa: float, r: float, k: PaperNumbers, s: LookStep) -> tuple[float, float]:
    """The pressure of the rising model and its settled state at a look, from those at the last one."""
    settled_kpa += (load_kpa - settled_kpa) * s.forgets_u - load_kpa * s.ramp_u
    load_kpa = (r + settled_kpa / k.etau2_kpa) * s.look_gain_kpa
    return load_kpa, settled_kpa + load_kpa * s.ramp_u


@loop
def may_bear_load(cell: CellState, own: PaperState, kpa: float) -> None:
    """Set the standard deviation by a load that may have begun to rise while the cell recovers."""
    cell.variance_kpa2 += kpa * kpa - own.may_bear_kpa * own.may_bear_kpa
    own.may_bear_kpa = kpa
