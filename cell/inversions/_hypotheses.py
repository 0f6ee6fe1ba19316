"""The paper's cell inverted under two hypotheses about its last turning point (multiple-model estimation).

The paper's cell has two linear models, one for a rising load and one for recovery, and changes from one to the other
where the pressure turns. Inverting either model is algebra (:mod:`._linear_models`); the question is which one holds.
The paper goes by the sign of dr/dt, which misreads slow ramps and quick presses, since the resistance also falls while
a load is held. We ask the model in force instead: has the pressure by its own inverse gone back? Noise delays the
answer. Two hypotheses are therefore followed at the same time: that the model in force still holds, and that the
pressure turned where it was last near its extreme. When the pressure of the first hypothesis has gone back from the
extreme by more than noise explains, the second one is put in force (taken over). It has followed the load all the time,
so that the delay loses nothing. In each frame, in this order:

1. Both hypotheses take the reading. Their pressures are limited (:func:`limited`): errors cannot add up.
2. Has the pressure turned, or was an earlier turn a false alarm (:func:`gone_back`, :func:`is_refuted`)? If so, the
   other hypothesis is taken over (:func:`take_over`). A turn stays unconfirmed until the pressure of the model that was
   left has gone back, too; until then it may be taken back.
3. No load is negative: a memory that would need a pull is corrected (:func:`without_pull`).
4. As long as the pressure is near its extreme, the other hypothesis begins anew where the one in force is
   (:func:`restart`), since the pressure may turn just there.
5. The distance of the hypotheses is a standard deviation while either may be right (:func:`renew_variance`).

**The third hypothesis: an earlier turn.** Where r under a held load drifts faster in the recovery model than in the
rising model, a load that begins to fall slowly bends r by less than this drift. The rising model then takes the load
for one that goes on slowly, and the other hypothesis, which begins anew at each new extreme, loses how far the load has
fallen. The third hypothesis keeps it: it began when r bent. We store its difference from the other hypothesis in kPa,
which fades as errors of its model do. No load falls and rises at the same time. Where the pressure of the third
hypothesis rises by more than a turn and noise, it therefore begins anew, too. It is taken over if it says that the cell
bears nothing (:func:`release_earlier`). In recovery all this holds with rises and
falls exchanged.

Pressures below that are "ahead" are times the direction: 1 for a rising load, -1 in recovery.
"""

from __future__ import annotations

import math

from ...common.compiled import Places, Records, Row, loop, record
from .._state import CellState, PaperState
from ..estimation import DOUBT, LOADS, UNKNOWN, USUAL, doubt_of
from ..materials import PaperModel
from ._linear_models import PaperNumbers, PaperStep, fast_r, step_both
from ._sequential_tests import COINCIDENCE, MOST_RESTED, begin_after_turn, variance_at_turn
from ._tremor_path import begin_path

TURN, LIGHT_TURN, TURN_SHARE = 0.01, 0.002, 0.02
"""how far a pressure that is known exactly must have gone back for a turn: LIGHT_TURN of full scale + TURN_SHARE of the
extreme, but at most TURN of full scale. Errors of the memory grow with the load, and look like turns as they fade. Near
no load a larger limit would miss light taps, and each missed tap leaves an error in the memory"""
TURN_SIGMAS = 3.0
"""standard deviations, by the noise of the smoothed readings, by which a pressure must have gone back for a turn"""
EXTREME_SIGMAS = 2.0
"""standard deviations of the smoothed noise that are subtracted from an extreme. The largest of many noisy readings is
too large by about so much; if more were subtracted, the end of a tap of few frames would be missed"""
CONFIRMED_RISE, CONFIRMED_FALL = 2.0, 1.0
"""turns by which the pressure of the model that was left must have gone back, too, to confirm a rise and a fall. A rise
must show more: a cell that seems to be pressed again while it recovers more likely bears no load"""
SHARED_RISE, CLEAR_RISE = 0.2, 0.05
"""a rise is refuted if the recovery model has risen by less than the share SHARED_RISE of it, and if it is larger than
CLEAR_RISE of full scale. Where a cell recovers under a light hold, the rising model takes the recovery for a load that
grows, while the recovery model is almost constant. A press raises both models by about as much. A press of some seconds
that begins while the cell recovers raises them less alike: a share of 0.5 would refute some of these presses"""
SHARED_FALL, CLEAR_FALL = 0.3, 0.02
"""a fall of the rising model may be a fading error of its memory, or an overshoot of the smoothing, up to this share of
the fall of the recovery model (as the rising model answers it), counted from a fall of CLEAR_FALL of full scale on.
Where the memory of the cell is large, the resistance under a held load falls so fast that the recovery model takes it
for a release, while the rising model is almost constant. A release takes both models back"""
FAST_SIGMAS = 6.0
"""standard deviations of the smoothed noise. A pressure that goes back by more in three frames is that of a falling
load, whatever :data:`SHARED_FALL` says: smooth loads of little noise turn so. A pressure that has gone back by more,
plus :data:`LIGHT_TURN`, from the recent extreme has turned"""
RELEASED_CUSUM = 3.0
"""statistic of the CUSUM (:func:`._rest_tests.release_cusum`) above which a fall is a release, whatever
:data:`SHARED_FALL` says"""
FELL_CUSUM, FELL_SIGMAS = 1.0, 2.0
"""statistic of that test above which means of readings show a fall, too; and the standard deviations of the smoothed
noise that then suffice for a turn, in the place of :data:`TURN_SIGMAS`, since two tests show the same fall. If that is
a false alarm, the model that is left takes it back at once"""
ROUND, FAST = 2e-3, 2.0
"""of full scale: standard deviation of the pressure by a slow turn, which is noticed late. If the pressure changes by
more than FAST :data:`TURN` in the frame of a turn, the turn is noticed at once: the deviation is divided by how many
times more"""
BETWEEN, JUST_BEGUN = 0.3, 3.0
"""of the path of a load in a frame: standard deviation of how far beyond the readings the load went before it turned.
That is between none and half; the root mean square. And times that path: the most that it may go in
the next frame, since it may have begun to move in the middle of the first one"""
APART = 0.5
"""standard deviation over the difference of the two hypotheses, since either may be right until a turn is noticed"""
LOST_SIGMAS, LOST_SHARE = 1.5, 0.7
"""if a restart of the other hypothesis takes away more than LOST_SHARE of the variance, and the hypotheses were apart
by more than LOST_SIGMAS standard deviations of the smoothed noise, the difference stays in the variance"""
HELD_PER_S = 0.03
"""of full scale per second: rate at which a held pressure may seem to go back. A load that goes back faster has
turned"""
CREEPS_PER_S = 0.003
"""of full scale per second: rate at which a recent extreme fades, in addition to the fading of an error of two standard
deviations of the memory. A load that goes back faster has turned, however large it is: a load held by a hand wavers by
less than the usual limit of a turn"""
PEAK_GOES_BACK = 6.0
"""the peak goes down in each frame by this, times the standard deviation of the memory (at most a turn), times the
share of its variance that fades in the frame: as an error of the memory fades, a held pressure seems to go back"""
RESTART_SHARE = 0.5
"""share by which the other hypothesis is moved to the one in force in a frame, within one standard deviation of the
peak. A restart at every frame there would take noise for a part of the press, and a late restart would miss a part of
the release; with half of each, the two errors about cancel"""
EARLIER, MIDWAY = 0.7, 0.5
"""standard deviation over the change of pressure by an earlier turn: all of this change is real, or none (the root mean
square). And the share of the change that is taken when a turn is noticed"""
GROWN, GROWN_SIGMAS, GROWN_ERRORS, FALLEN = 0.5, 1.5, 0.2, 2.0
"""an earlier turn is as likely as none when the pressure has grown by GROWN light turns + GROWN_SIGMAS standard
deviations of the smoothed noise + GROWN_ERRORS of the memory; a fall counts FALLEN times as much as growth. Growth is
asked for since constant loads are common, while a load that falls at just the rate at which the rising model's pressure
stays constant is rare"""
GROWN_RELEASED = 1.5
"""GROWN_ERRORS in recovery, where errors of the memory are largest, and fade"""
SURELY = 0.99
"""weight of an earlier turn above which it is taken over if the load is none since then, as most released loads are"""
NEGLIGIBLE = 1e-3
"""of full scale: a smaller pressure counts as none"""
ROUNDING = 1e-9
"""of full scale"""
MOST_LOST = 1.0
"""of full scale: largest standard deviation stated for what the memory may have lost. Half of full scale would cover
any load, but a memory that is lost shows up to 1.1 times full scale where there is no load"""
PULL_SIGMAS = 0.7
"""standard deviations of the reading: a pressure below none by more is an error of the memory. These standard
deviations include changes that the smoothing has not noticed yet: its line overshoots for a moment where a fast release
ends"""


def paper_numbers(model: PaperModel, full_kpa: float, *, exact: bool) -> PaperNumbers:
    """The constants of cells of a model; ``exact``: readings are taken as free of noise."""
    m, (rise_r, fall_r) = model, fast_r(model)
    return record(
        PaperNumbers,
        full_kpa=full_kpa,
        lowest_kpa=LOADS[0] * full_kpa,
        usual_kpa=USUAL * full_kpa,
        highest_kpa=LOADS[1] * full_kpa,
        least_kpa=LOADS[0] * full_kpa if exact else 0.0,
        rounding_kpa=ROUNDING * full_kpa,
        negligible_kpa=NEGLIGIBLE * full_kpa,
        turn_kpa=TURN * full_kpa,
        light_turn_kpa=LIGHT_TURN * full_kpa,
        clear_rise_kpa=CLEAR_RISE * full_kpa,
        clear_fall_kpa=CLEAR_FALL * full_kpa,
        grown_kpa=GROWN * LIGHT_TURN * full_kpa,
        fast_kpa=FAST * TURN * full_kpa,
        round_kpa=ROUND * full_kpa,
        doubt_kpa2=(DOUBT * full_kpa) ** 2,
        unknown_kpa2=(UNKNOWN * full_kpa) ** 2,
        most_lost_kpa2=(MOST_LOST * full_kpa) ** 2,
        most_rested_kpa2=(MOST_RESTED * full_kpa) ** 2,
        clear_kpa2=(1.0 - LOST_SHARE) * (NEGLIGIBLE * full_kpa) ** 2,
        eu1_kpa=m.eu1_kpa,
        etau2_kpa=m.etau2_kpa,
        e1_kpa=m.e1_kpa,
        e2_kpa=m.e2_kpa,
        e3_kpa=m.e3_kpa,
        tu_s=m.tu_s,
        t2_s=m.t2_s,
        t3_s=m.t3_s,
        r_per_kpa=m.gain_per_kpa,
        settled_per_kpa=1.0 + m.etau2_kpa / m.eu1_kpa,
        rise_per_fall=rise_r / fall_r,
        fall_share=SHARED_FALL * fall_r / rise_r,
        bend=rise_r - fall_r,
        exact=float(exact),
    )


@loop
def begin_each(
    cells: Records[CellState], memory: Records[PaperState], places: Places, r: Row, k: PaperNumbers, gain_kpa: float
) -> None:
    """Begin in cells of ``places`` (k,) that have read ``r`` (k,) for ever; their memories are zero before."""
    for n in range(places.size):
        cell, own = cells[places[n]], memory[places[n]]
        p = r[n] / k.r_per_kpa
        own.r, own.direction = r[n], 1.0
        own.third_last_kpa, own.extreme_kpa, own.recent_extreme_kpa, own.peak_kpa = p, p, p, p
        own.rising_kpa, own.recovery_kpa, own.settled_kpa = p, p, p
        own.x2, own.rising_x3, own.recovery_x3 = p / k.e2_kpa, p / k.e3_kpa, p / k.e3_kpa
        begin_path(own)
        cell.pressure_kpa, cell.last_kpa, cell.before_last_kpa, cell.gain_kpa = p, p, p, gain_kpa
        cell.variance_kpa2, cell.turn_variance_kpa2, cell.rest_variance_kpa2 = 0.0, 0.0, 0.0
        cell.released, cell.unconfirmed, cell.left_kpa, cell.rested = 0.0, 0.0, 0.0, 0.0


@loop
def hold_each(
    cells: Records[CellState], memory: Records[PaperState], places: Places, dt_s: Row, k: PaperNumbers
) -> None:
    """Let the memory of ``places`` (k,) relax for ``dt_s`` (k,) at constant pressure."""
    for n in range(places.size):
        cell, own = cells[places[n]], memory[places[n]]
        own.settled_kpa += (own.rising_kpa - own.settled_kpa) * -math.expm1(-dt_s[n] / k.tu_s)
        own.x2 += (own.recovery_kpa * (1.0 / k.e2_kpa) - own.x2) * -math.expm1(-dt_s[n] / k.t2_s)
        forgets_3 = -math.expm1(-dt_s[n] / k.t3_s)
        own.rising_x3 += (own.rising_kpa * (1.0 / k.e3_kpa) - own.rising_x3) * forgets_3
        own.recovery_x3 += (own.recovery_kpa * (1.0 / k.e3_kpa) - own.recovery_x3) * forgets_3
        if own.direction > 0.0:
            own.r = own.rising_kpa / k.eu1_kpa + (own.rising_kpa - own.settled_kpa) / k.etau2_kpa
        else:
            own.r = own.recovery_kpa / k.e1_kpa + own.x2 + own.recovery_x3
        if own.rising_kpa == own.recovery_kpa:  # hypotheses that agreed before the gap agree after it, too
            move_other(own, 1.0, k)
        cell.variance_kpa2 -= own.may_bear_kpa * own.may_bear_kpa
        own.may_bear_kpa, own.looks_at_rest = 0.0, 0.0
        begin_path(own)


@loop
def advance_each(
    cells: Records[CellState],
    memory: Records[PaperState],
    awake: Places,
    k: PaperNumbers,
    s: PaperStep,
) -> None:
    """Take the smoothed readings of the cells that are ``awake`` (m,), one time step after the last ones."""
    for n in range(awake.size):
        cell, own = cells[awake[n]], memory[awake[n]]
        own.third_last_kpa, cell.before_last_kpa, cell.last_kpa = (
            cell.before_last_kpa,
            cell.last_kpa,
            cell.pressure_kpa,
        )
        step_both(own, cell.level, s)
        if limited(cell, own, k, s):
            own.turn_due = 1.0
        ahead, confirmed = turned(cell, own, k, s)
        if k.exact == 0.0:
            without_pull(cell, own, k, s)
        restart(cell, own, ahead, confirmed, k, s)
        renew_variance(cell, own, ahead, confirmed, k, s)


# -- limits (saturation, anti-windup) --------------------------------------------------------------------------------


@loop
def limited(cell: CellState, own: PaperState, k: PaperNumbers, s: PaperStep) -> bool:
    """Keep pressures, and the memory with them, within the limits; returns whether a rising load is refuted.

    While the memory is uncertain, a pressure beyond the usual load is an error of the memory rather than a load.
    """
    rising, recovery = own.rising_kpa, own.recovery_kpa
    if not (min(rising, recovery) < k.lowest_kpa or max(rising, recovery) > k.usual_kpa):
        return False
    rising = min(max(rising, k.lowest_kpa), k.highest_kpa) - rising
    recovery = min(max(recovery, k.lowest_kpa), k.highest_kpa) - recovery
    own.rising_kpa += rising
    own.recovery_kpa += recovery
    own.settled_kpa += s.ramp_u * rising
    own.x2 += s.ramp_2 * recovery
    own.rising_x3 += s.ramp_3 * rising
    own.recovery_x3 += s.ramp_3 * recovery
    if not cell.variance_kpa2 > k.doubt_kpa2:
        return False
    rises, usual = own.direction > 0.0, k.usual_kpa
    rising_beyond, recovery_beyond = own.rising_kpa > usual, own.recovery_kpa > usual
    if rising_beyond if rises else recovery_beyond:
        cell.turn_variance_kpa2 = max(cell.turn_variance_kpa2, k.unknown_kpa2)
    if rising_beyond:
        own.rising_kpa = usual
        own.settled_kpa = usual * k.settled_per_kpa - k.etau2_kpa * own.r
    if recovery_beyond:
        own.recovery_kpa = usual
        own.x2 = own.r - usual / k.e1_kpa - own.recovery_x3
    # The reading falls more slowly than a rising or held load allows: the recovery model explains it.
    return bool(rising_beyond and rises and not recovery_beyond)


@loop
def without_pull(cell: CellState, own: PaperState, k: PaperNumbers, s: PaperStep) -> None:
    """Where the hypothesis in force needs a negative pressure (a pull), correct its memory instead.

    In recovery a pull of up to :data:`TURN_SIGMAS` standard deviations of the smoothed noise is allowed. No load leaves
    a resistance below that at rest. If a reading is lower nevertheless (a bad line, a cell that has become warm), the
    correction leaves a memory that no load has made, and a later reading at rest shows a load. What the reading lacks
    therefore counts as standard deviation.
    """
    allowed = -PULL_SIGMAS * s.recovery_gain_kpa * doubt_of(cell) + -k.negligible_kpa
    if own.direction < 0.0:
        allowed = min(allowed, s.recovery_gain_kpa * cell.level_std * -TURN_SIGMAS)
    if not cell.pressure_kpa < allowed:
        return
    cell.pressure_kpa = allowed
    if own.direction > 0.0:
        own.rising_kpa = allowed
        own.settled_kpa = allowed * k.settled_per_kpa - k.etau2_kpa * own.r
    else:
        own.recovery_kpa = allowed
        own.x2 = own.r - allowed / k.e1_kpa - own.recovery_x3
    missing = (allowed / k.e1_kpa - own.r) * s.rising_gain_kpa
    if missing > 0.0:
        before = cell.turn_variance_kpa2
        cell.turn_variance_kpa2 = max(min(missing * missing, k.most_lost_kpa2), before)
        cell.variance_kpa2 += cell.turn_variance_kpa2 - before


# -- turning points --------------------------------------------------------------------------------------------------


@loop
def turn_from(extreme_kpa: float, k: PaperNumbers) -> float:
    """How far an exactly known pressure must go back from an extreme for a turn, in kPa."""
    return float(min(abs(extreme_kpa) * TURN_SHARE + k.light_turn_kpa, k.turn_kpa))


@loop
def turned(cell: CellState, own: PaperState, k: PaperNumbers, s: PaperStep) -> tuple[float, bool]:
    """Take over the other hypothesis where the pressure has turned, and confirm earlier turns.

    Returns:
        How far the pressure is ahead in kPa; and whether a turn has just been confirmed.
    """
    rises = own.direction > 0.0
    was_unconfirmed, was_due = cell.unconfirmed > 0.0, own.turn_due > 0.0
    # The pressure rose before the unconfirmed turn; without one, it rises now.
    own.earlier_kpa *= s.recovery_fade if rises != was_unconfirmed else s.rising_fade
    ahead, back, turns = gone_back(cell, own, k, s)
    refuted = False
    if (was_unconfirmed or turns) and was_unconfirmed == rises and not (was_due and not was_unconfirmed):
        refuted = is_refuted(cell, own, k, s)
        if refuted:
            turns = rises
    own.turn_due = 0.0
    confirmed = False
    if turns:
        take_over(cell, own, was_due, k, s)
        confirmed = was_due and not was_unconfirmed
        ahead, back, _ = gone_back(cell, own, k, s)
    if refuted:
        unsure = cell.level_std * cell.gain_kpa
        own.peak_kpa = ahead - unsure
        own.extreme_kpa = own.recent_extreme_kpa = ahead - unsure * EXTREME_SIGMAS
    if cell.unconfirmed > 0.0:
        # Noise does not make a turn in both models.
        turns_of_it = CONFIRMED_RISE if own.direction > 0.0 else CONFIRMED_FALL
        other_gain = s.recovery_gain_kpa if own.direction > 0.0 else s.rising_gain_kpa
        least = other_gain * cell.level_std * (turns_of_it * TURN_SIGMAS) + turn_from(cell.left_kpa, k) * turns_of_it
        if back >= least:
            cell.unconfirmed, confirmed = 0.0, True
    return ahead, confirmed


@loop
def gone_back(cell: CellState, own: PaperState, k: PaperNumbers, s: PaperStep) -> tuple[float, float, bool]:
    """Evaluate the hypothesis in force, and write its pressure and gain.

    Returns:
        How far the pressure is ahead in kPa; how far the other hypothesis has gone back from the extreme that was left,
        if a turn is unconfirmed; and whether the pressure has turned, or an earlier turn was a false alarm.
    """
    rises = own.direction > 0.0
    pressure, other = (own.rising_kpa, own.recovery_kpa) if rises else (own.recovery_kpa, own.rising_kpa)
    gain, other_gain = s.rising_gain_kpa, s.recovery_gain_kpa
    if not rises:
        gain, other_gain = other_gain, gain
    cell.pressure_kpa, cell.gain_kpa = pressure, gain
    unsure = cell.level_std * gain
    ahead = max(pressure, k.least_kpa) * own.direction
    back = other * own.direction + cell.left_kpa
    # By so much the pressure may seem to go back though the load has not turned: the drift by a fading error.
    seeming = own.drift_kpa
    if rises:
        shared = own.extreme_kpa - own.recovery_kpa - k.clear_fall_kpa
        seeming = min(seeming, max(shared, 0.0) * k.fall_share)
        if own.third_last_kpa - pressure > unsure * FAST_SIGMAS or own.cusum > RELEASED_CUSUM:
            seeming = 0.0
    sure = FELL_SIGMAS if own.cusum > FELL_CUSUM else TURN_SIGMAS
    least = turn_from(own.extreme_kpa, k) + unsure * sure
    turns = own.turn_due > 0.0 or own.extreme_kpa - ahead > least + seeming
    # The recent extreme fades as the error of the memory does, so that in recovery the drift is not added to it.
    least = k.light_turn_kpa + unsure * FAST_SIGMAS
    if rises:
        least += seeming
    turns |= own.recent_extreme_kpa - ahead > least
    if cell.unconfirmed > 0.0:
        turns |= back < other_gain * cell.level_std  # back at the extreme that was left: the turn was noise
    return ahead, back, turns


@loop
def is_refuted(cell: CellState, own: PaperState, k: PaperNumbers, s: PaperStep) -> bool:
    """Whether the recovery model does not share the rise of a cell, which has been taken over or is about to be.

    A turn is found at the largest of many noisy pressures, so that the share seems too large by :data:`EXTREME_SIGMAS`
    standard deviations. The recovery model stays in force, or comes back into force, with its own memory. The rising
    model begins anew where the pressure is. The difference of the two stays in the standard deviation.
    """
    begun = cell.left_kpa if cell.unconfirmed > 0.0 else own.extreme_kpa  # minus the pressure at which it began
    rise, shared = begun + own.rising_kpa, begun + own.recovery_kpa
    clear = rise > k.clear_rise_kpa + cell.level_std * (TURN_SIGMAS * s.rising_gain_kpa)
    return bool(clear and shared < rise * SHARED_RISE + cell.level_std * (EXTREME_SIGMAS * s.recovery_gain_kpa))


@loop
def take_over(cell: CellState, own: PaperState, due: bool, k: PaperNumbers, s: PaperStep) -> None:
    """Put the other hypothesis in force; ``due``: because the readings refute the one in force.

    The turn falls between two frames, and is noticed later still. How far the load went in between is unknown, and
    stays in the standard deviation until the error fades. A load that sags while it is held may read as a constant one.
    The pressure that is left after the release then tells which of both it was, since most released cells bear no load:
    the possible sag counts as an error of the memory, however likely it seemed while the load was held.
    """
    again, extreme, std = cell.unconfirmed > 0.0, own.extreme_kpa, cell.level_std
    earlier = 0.0
    if not again and own.direction > 0.0:
        earlier = likely_earlier_kpa(cell, own, std * cell.gain_kpa, 0.0, k) * MIDWAY
    own.direction = -own.direction
    rises = own.direction > 0.0
    cell.released = 0.0 if rises else 1.0
    pressure, gain = (own.rising_kpa, s.rising_gain_kpa) if rises else (own.recovery_kpa, s.recovery_gain_kpa)
    unsure = std * gain
    # The moment of the turn is as uncertain as it was in the last frame whether the pressure had turned.
    before = variance_at_turn(cell, own)
    rounded = k.fast_kpa / max(abs(pressure - cell.last_kpa), k.fast_kpa) * k.round_kpa
    unseen = unseen_kpa(cell, own, pressure, gain, unsure, k) + rounded
    noticed = not again and not due
    if noticed and not rises:
        own.looks_at_rest = 0.0
    own.may_bear_kpa, own.cusum = 0.0, 0.0
    doubt = math.sqrt(before) + unseen
    by_noise = s.recovery_gain_kpa * std
    by_noise *= by_noise
    cell.turn_variance_kpa2 = min(doubt * doubt + by_noise, k.unknown_kpa2)
    cell.variance_kpa2 = cell.turn_variance_kpa2  # includes the distance of the hypotheses
    released = noticed and not rises
    sagged = max(own.earlier_kpa - earlier, 0.0) * EARLIER if released else 0.0
    begin_after_turn(cell, own, by_noise, sagged, k)
    own.released_kpa = extreme if released else 0.0
    if earlier > 0.0:
        own.earlier_kpa -= earlier
        pressure -= earlier
        own.recovery_kpa = pressure
        own.x2 += earlier / k.e1_kpa
    now = own.direction * max(pressure, 0.0)
    if again:
        own.extreme_kpa, own.peak_kpa, cell.unconfirmed = cell.left_kpa, cell.left_kpa, 0.0
    else:
        own.extreme_kpa, own.peak_kpa = now - EXTREME_SIGMAS * unsure, now - unsure
        cell.left_kpa, cell.unconfirmed = extreme, 0.0 if due else 1.0
    own.recent_extreme_kpa = own.extreme_kpa


@loop
def unseen_kpa(
    cell: CellState, own: PaperState, pressure_kpa: float, gain_kpa: float, unsure_kpa: float, k: PaperNumbers
) -> float:
    """Standard deviation that turns between two frames leave in a pressure, known to ``unsure_kpa`` by noise.

    The extreme falls between two frames. It exceeds the readings by up to half of the path that the load went in the
    frame before or after, whichever is less. On that path r goes up by one model and down by the other. The errors of
    all turns have the same sign, so that they add up as amounts rather than as variances. A path that noise explains,
    or a converter that flips between two codes, does not count.
    """
    last, before = cell.last_kpa, cell.before_last_kpa
    there = max(own.direction * (own.third_last_kpa - before), own.direction * (before - last), 0.0)
    path = min(JUST_BEGUN * there, abs(pressure_kpa - last))
    by_load = max(path - TURN_SIGMAS * unsure_kpa, 0.0)
    return float(BETWEEN * by_load * k.bend * gain_kpa)


# -- distance of the hypotheses, and the third one ---------------------------------------------------------------------


@loop
def restart(cell: CellState, own: PaperState, ahead: float, confirmed: bool, k: PaperNumbers, s: PaperStep) -> None:
    """Begin the other hypothesis anew where the one in force is, as long as the pressure is near its extreme."""
    unsure = cell.level_std * cell.gain_kpa
    below_peak = own.peak_kpa - ahead
    share = RESTART_SHARE if below_peak < unsure else 0.0
    if below_peak <= k.rounding_kpa:
        share = 1.0
    if cell.unconfirmed > 0.0:
        share = 0.0
    moved = move_other(own, share, k)
    follow_earlier(cell, own, moved, unsure, confirmed, k)
    own.peak_kpa = max(own.peak_kpa, ahead - unsure)
    own.extreme_kpa = max(own.extreme_kpa, ahead - unsure * EXTREME_SIGMAS)


@loop
def move_other(own: PaperState, share: float, k: PaperNumbers) -> float:
    """Move the other hypothesis by a ``share`` of the way to the one in force; returns its change in kPa.

    Where it begins, resistance and pressure are continuous.
    """
    if own.direction > 0.0:
        moved = (own.rising_kpa - own.recovery_kpa) * share
        x2 = own.r - own.rising_kpa / k.e1_kpa - own.rising_x3
        own.x2 += (x2 - own.x2) * share
        own.recovery_x3 += (own.rising_x3 - own.recovery_x3) * share
        own.recovery_kpa += moved
    else:
        moved = (own.recovery_kpa - own.rising_kpa) * share
        settled = own.recovery_kpa * k.settled_per_kpa - k.etau2_kpa * own.r
        own.settled_kpa += (settled - own.settled_kpa) * share
        own.rising_x3 += (own.recovery_x3 - own.rising_x3) * share
        own.rising_kpa += moved
    return float(moved)


@loop
def follow_earlier(
    cell: CellState, own: PaperState, moved_kpa: float, unsure: float, confirmed: bool, k: PaperNumbers
) -> None:
    """Follow the third hypothesis after the other one was ``moved_kpa``, beginning anew.

    ``confirmed``: a turn has just been; the third hypothesis then begins anew, too.
    """
    rose = (own.direction > 0.0) != (cell.unconfirmed > 0.0)  # before the unconfirmed turn; without one, now
    least = turn_from(own.extreme_kpa, k)
    if rose:
        direction, other, by_noise = 1.0, own.recovery_kpa, unsure * (TURN_SIGMAS * k.rise_per_fall)
        most = other  # no load falls below none
    else:
        direction, other, by_noise = -1.0, -own.rising_kpa, unsure * (TURN_SIGMAS / k.rise_per_fall)
        most = k.usual_kpa - own.rising_kpa  # nor rises beyond the usual
        least *= 1.0 / k.rise_per_fall
    own.earlier_kpa = min(own.earlier_kpa + moved_kpa * direction, most)
    ahead = other - own.earlier_kpa
    own.earlier_least_kpa = min(own.earlier_least_kpa, ahead)
    ahead -= own.earlier_least_kpa + by_noise
    if ahead > 0.0:
        own.earlier_from_kpa += (cell.pressure_kpa - cell.last_kpa) * direction
    if confirmed or ahead > least:
        own.earlier_kpa, own.earlier_least_kpa = 0.0, other
        own.earlier_from_kpa = cell.pressure_kpa * direction


@loop
def likely_earlier_kpa(cell: CellState, own: PaperState, unsure: float, fallen_kpa: float, k: PaperNumbers) -> float:
    """By how much an earlier turn would take the pressure back, times its weight, in kPa.

    The weight is small while the load seems constant: with g = growth (or ``fallen_kpa``, by which the pressure has
    gone back, as a constant load does not) over the growth at which an earlier turn is as likely as none
    (:data:`GROWN`), it is g^2/(g^2 + 1). Cells that are taken for cells at rest bear no load.
    """
    grown = max(own.peak_kpa - own.earlier_from_kpa, fallen_kpa, 0.0)
    errors = GROWN_ERRORS
    if own.direction < 0.0:
        if cell.rested > 0.0:
            return 0.0
        errors = GROWN_RELEASED
    errors *= math.sqrt(cell.turn_variance_kpa2)
    grown /= unsure * GROWN_SIGMAS + errors + k.grown_kpa
    grown *= grown
    return float(max(own.earlier_kpa, 0.0) * (grown / (grown + 1.0)))


@loop
def release_earlier(own: PaperState, k: PaperNumbers) -> None:
    """Take over a likely third hypothesis that says that the cell bears nothing while its load seems to rise.

    A touch of few frames may be noticed while its release is not. The rising model then takes the recovery for a load
    that goes on rising, which would have to follow the hidden rate (:mod:`._sequential_tests`) all the time. A load
    counts as none below the share :data:`COINCIDENCE` of this rise.
    """
    bears = own.recovery_kpa - own.earlier_kpa
    if bears < (own.peak_kpa - own.earlier_from_kpa) * COINCIDENCE:
        own.recovery_kpa, own.turn_due = bears, 1.0
        own.x2 += own.earlier_kpa / k.e1_kpa
        own.earlier_kpa = 0.0


@loop
def renew_variance(
    cell: CellState, own: PaperState, ahead: float, confirmed: bool, k: PaperNumbers, s: PaperStep
) -> None:
    """Set the variance to that of the memory and the squared distance of the hypotheses, and fade extremes.

    If the two were apart by more than noise explains when a restart brought them together, the pressure went to and fro
    by too little for two turns to be noticed, and their distance stays in the variance. The errors that this leaves all
    have the same sign, and add up as amounts rather than as variances.
    """
    unsure = cell.level_std * cell.gain_kpa
    fade = s.rising_fade2 if own.direction > 0.0 else s.recovery_fade2
    error_kpa, fades = math.sqrt(cell.turn_variance_kpa2), 1.0 - fade
    recent = own.recent_extreme_kpa - (fades * error_kpa + s.held_kpa * (CREEPS_PER_S / (3.0 * HELD_PER_S)))
    own.recent_extreme_kpa = max(recent, ahead - unsure * EXTREME_SIGMAS)
    held = (own.third_last_kpa - cell.pressure_kpa) * own.direction < s.held_kpa
    if held:
        own.peak_kpa -= fades * min(error_kpa, k.turn_kpa) * PEAK_GOES_BACK
    may_bear = own.may_bear_kpa * own.may_bear_kpa
    variance = cell.variance_kpa2 - (cell.turn_variance_kpa2 + may_bear)  # the squared distance in the last frame
    cell.turn_variance_kpa2 *= fade
    apart = abs(own.rising_kpa - own.recovery_kpa) * APART
    if cell.unconfirmed == 0.0:
        fallen = 0.0
        if held:  # a fast fall is a release
            fallen = (own.peak_kpa - own.direction * cell.pressure_kpa) * FALLEN
        earlier = likely_earlier_kpa(cell, own, unsure, fallen, k)
        apart += earlier * EARLIER
        if own.direction > 0.0 and own.earlier_kpa > k.turn_kpa and earlier > own.earlier_kpa * SURELY:
            release_earlier(own, k)
    apart *= apart
    begun = variance * (1.0 - LOST_SHARE) > max(apart, k.clear_kpa2)
    by_noise = unsure * EXTREME_SIGMAS * (LOST_SIGMAS / EXTREME_SIGMAS)
    if begun and not confirmed and variance > by_noise * by_noise:  # a confirmed turn settles which model was right
        doubt = math.sqrt(cell.turn_variance_kpa2) + math.sqrt(max(variance - apart, 0.0))
        cell.turn_variance_kpa2 = min(doubt * doubt, k.most_lost_kpa2)
    cell.variance_kpa2 = apart + cell.turn_variance_kpa2 + may_bear
