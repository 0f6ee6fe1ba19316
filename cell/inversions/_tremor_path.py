"""Tremor within the noise of the paper's cell: path length of the load by Allan and Hadamard variances; ratchet effect.

Motion that goes back by less than a turn, or than noise, is never noticed as turns. The paper's cell answers a rise by
more than a fall, so that r climbs with each to and fro, and an inverse by one of the two models takes this for a load
that grows. By how much r climbs follows from the path length: the sum of all that the load goes up and down.

**Path length** (:func:`path_lengths`). If means of successive blocks of readings differ by more than noise explains,
the load moves: half the mean square of these first differences is the Allan variance. If the load goes on in one
direction, as in presses and in creep, the second differences are small (Hadamard variance). A load that trembles has
large differences of both orders, up and down. Blocks of several lengths are compared: short blocks see all of the path,
long ones can tell a weak tremor from noise; the shortest blocks that are clear are believed. Within a block the load
may go to and fro as well; second differences show how much. The path that the shortest blocks and their noise leave
room for is an upper bound. An edge of a load is a single event, while a tremor goes on: whether a load trembles is
decided by second differences that go up as well as down, and the mean squares are robust.

**Motion that a turn explains is left out** (:func:`unexplained`). While the load rises, r beyond its largest value
since the last turn is explained by the rise; after a turn has been noticed, r below it is explained by the fall. A turn
is noticed late, and then explains all that r went since the extreme. The meter therefore gets the unexplained motion
some looks later. Presses and taps then leave nothing, and neither do tremors so wide that all turns are noticed. From
the path that is told we subtract what a late turn has explained after the meter saw it.

**Correction** (:func:`subtract`). The pressure that the remaining path makes is subtracted from both hypotheses and
from the extremes with which they are compared, so that the correction is no turn. The standard deviation gains a share
of the correction, and the pressure of the further path that noise may hide. Both errors have one sign, and are added as
amounts. A load that grows is left alone, since it goes one way.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.compiled import Places, Record, Records, Row, loop, record
from .._state import CellState, PaperState, Scales
from ..estimation import RECENT
from ..materials import PaperModel
from ._linear_models import PaperNumbers, fast_r

SCALES = 4
"""number of block lengths: one, two, four and eight times the readings from one look to the next"""
GROWS, AT_ONCE = 1.0, 0.25
"""a single squared difference raises a mean square by at most GROWS times the mean square so far (noise included), plus
AT_ONCE times the variance of noise"""
MOST = 8.0
"""times the variance of noise: limit of a squared second difference in the mean squares up and down, which tell whether
a load trembles"""
EDGE_SIGMAS = 3.0
"""standard deviations of a difference by noise: a difference is clipped at so many, plus the largest unnoticed
motion"""
MEMORY_S, LEAST_SHARE, MOST_SHARE, MOST_SHARE_OF_FEW = 1.5, 1.0 / 64.0, 1.0 / 8.0, 1.0 / 16.0
"""seconds over which the mean squares average, and the least and the largest share of a block in them; the last where a
look has fewer than :data:`..estimation.RECENT` readings, whose means are noisier"""
MAY_TREMBLE, SEEMS_TO, TREMBLES = 0.0, 1.8, 3.2
"""thresholds of the statistic: the mean square of second differences (to the side where it is smaller) beyond that of
noise, in standard deviations of what is known of it. Above the first a load may tremble; above the second it seems to,
and the path begins to be told; above the third it trembles for sure"""
SIDE = 3.0
"""limit of the sum of the mean squares up and down, over the smaller of the two"""
MAY = 2.0
"""standard deviations by which the true mean squares may exceed those seen"""
OF_SIDES = 1.6
"""standard deviation by chance of twice the mean square to one side (half of all differences go to one side), over the
variance of noise and the square root of the share of a block"""
NOISE_KNOWN = 0.15
"""relative standard deviation of the variance of noise, since ADC steps are not white noise and depend on the
reading"""
PATH, BEND = 0.84, 0.5
"""path of a load from one block to the next = PATH sqrt(D1 + BEND D2), with the mean squares D1 and D2 of first and
second differences. This holds within a tenth for sines of up to a third of a period per block, and for random motion"""
FAST = 1.5
"""times :data:`BEND`: PATH sqrt(FAST BEND D2), from second differences alone, is as long for motion with the largest
second differences, and shorter for slow motion, which blocks do not hide"""
HIDDEN, MOST_HIDDEN, FAST_HZ = 1.2, 6.0, 4.0
"""least and largest ratio of the path that may be to the path that blocks see; and frequency in Hz of the tremors that
the latter is meant for"""
HIDES_AT_FAST = 7.4
"""path of a sine over that which blocks of its period see. For blocks of a share x of its period the excess is x^2
times that: the means see less of the sine, and it turns more often between them"""
UNSURE = 0.3
"""standard deviation of the pressure that is subtracted, over this pressure"""
LOOK_S = 0.11
"""seconds from one look to the next, at most. A tremor goes to and fro in a quarter of a second, and means over a
longer time hide it; slow boards take fewer readings"""
LARGEST, LARGEST_PER_S = 0.04, 0.6
"""of full scale, and of full scale per second: a load that goes farther from one look to the next has an edge. After an
edge no path is told for as long as the mean squares remember. The limit grows with the time between looks, since a
tremor goes as far in a frame of a slow board as a press does on a fast one"""
LATE_S, LATE_LOOKS = 0.15, 8
"""seconds, and looks at most, after which the meter gets the unexplained motion: by then most turns are noticed"""
TWICE = 2.0
"""the path that the meter sees by mistake, over the motion that a late turn explains: r went there, and the unexplained
motion goes back"""
NO_EDGE_LOOKS = 1e6
"""looks since an edge, of a cell that has had none"""


class PathStep(Record):
    """Numbers that depend on the time between frames."""

    share: Scales
    """of a block in the mean squares"""
    readings: Scales
    """in a block"""
    sure: Scales
    """standard deviation of the statistic by chance and by the uncertainty of the noise"""
    hides: Scales
    """largest ratio of the path to that which blocks see"""
    remembered: float
    """looks that the mean squares remember"""
    late: float
    """looks after which the meter gets the unexplained motion"""
    largest_r: float
    """how far a load may go unnoticed"""
    largest_kpa: float
    edge: float
    """largest difference of two means by noise, in standard deviations of a reading"""
    of_u: float
    """time between looks over each time constant"""
    of_2: float
    of_3: float
    ratchet_kpa: float
    """kPa that remain per r of the path"""
    rise_r: float
    fall_r: float


def readings_in_look(dt_s: float) -> int:
    """Readings from one look to the next, for frames ``dt_s`` apart: :data:`..estimation.RECENT` or a part of it."""
    count = RECENT
    while count > 1 and count * dt_s > LOOK_S:
        count //= 2
    return count


def path_step(model: PaperModel, dt_s: float, full_kpa: float) -> PathStep:
    """The numbers for frames ``dt_s`` apart."""
    m, count, (rise_r, fall_r) = model, readings_in_look(dt_s), fast_r(model)
    look_s = count * dt_s
    in_block = 2.0 ** np.arange(SCALES) * count
    share = np.clip(in_block * dt_s / MEMORY_S, LEAST_SHARE, MOST_SHARE if count == RECENT else MOST_SHARE_OF_FEW)
    largest_kpa = max(LARGEST, LARGEST_PER_S * look_s) * full_kpa
    return record(
        PathStep,
        share=share,
        readings=in_block,
        sure=np.sqrt(share * OF_SIDES**2 + NOISE_KNOWN**2),
        hides=np.minimum(HIDDEN + HIDES_AT_FAST * (FAST_HZ * in_block * dt_s) ** 2, MOST_HIDDEN),
        remembered=MEMORY_S / look_s,
        late=min(math.ceil(LATE_S / look_s), LATE_LOOKS),
        largest_r=largest_kpa * rise_r,
        largest_kpa=largest_kpa,
        edge=EDGE_SIGMAS * math.sqrt(2.0 / count),
        of_u=look_s / m.tu_s,
        of_2=look_s / m.t2_s,
        of_3=look_s / m.t3_s,
        ratchet_kpa=0.5 * (rise_r - fall_r) / (rise_r * fall_r),
        rise_r=rise_r,
        fall_r=fall_r,
    )


@loop
def begin_path(own: PaperState) -> None:
    """Begin in a cell that has had its reading for ever."""
    own.looks, own.looks_held, own.balance_r, own.may_balance_r = 0.0, NO_EDGE_LOOKS, 0.0, 0.0
    for scale in range(SCALES):
        own.mean_r[scale], own.mean_before_r[scale] = 0.0, 0.0
    forget(own)
    own.direction_before, own.last_r, own.extreme_r = own.direction, own.r, own.r
    own.unexplained_r, own.looks_back = 0.0, 0.0
    for look in range(LATE_LOOKS):
        own.unexplained_before_r[look] = 0.0


@loop
def correct_each(
    cells: Records[CellState],
    memory: Records[PaperState],
    awake: Places,
    means: Row,
    k: PaperNumbers,
    s: PathStep,
) -> None:
    """Take the ``means`` (m,) of the readings since the last look at the cells that are ``awake`` (m,)."""
    for n in range(awake.size):
        cell, own = cells[awake[n]], memory[awake[n]]
        newest, explained_late, edge = unexplained(cell, own, means[n], s)
        shown = 0.0 if cell.rested > 0.0 else max(cell.pressure_kpa, 0.0)
        told, may = path_lengths(own, newest, cell.noise, edge, s)
        if shown > 0.0 and own.looks_held >= s.remembered:
            path, most = carried_over(own, told, may, explained_late, s)
        else:
            told = 0.0
            path, most = carried_over(own, 0.0, 0.0, explained_late, s)
        if max(path, most) > 0.0:
            subtract(cell, own, path, most, told, shown, k, s)


# -- path length -----------------------------------------------------------------------------------------------------


@loop
def forget(own: PaperState) -> None:
    """Begin the mean squares anew."""
    for scale in range(SCALES):
        own.bends[scale], own.up[scale], own.down[scale] = 0.0, 0.0, 0.0
        own.bends_up[scale], own.bends_down[scale] = 0.0, 0.0


@loop
def clipped(difference: float, std: float, largest: float) -> float:
    """A difference over its standard deviation by noise, clipped."""
    limit = largest / std + EDGE_SIGMAS
    return float(min(max(difference / std, -limit), limit))


@loop
def averaged(before: float, square: float, by_noise: float, share: float) -> float:
    """A mean square less the part of noise, in units of the variance by noise, after a further ``square``."""
    room = max(before * GROWS + (by_noise * GROWS + AT_ONCE), AT_ONCE)
    return float(before + min((square - by_noise - before) * share, room))


@loop
def path_lengths(own: PaperState, newest: float, noise: float, edge: bool, s: PathStep) -> tuple[float, float]:
    """Take the mean of the last readings; returns the path since the last look in r that is told, and that may be."""
    own.looks_held = 0.0 if edge else own.looks_held + 1.0
    if own.looks_held <= s.late:
        forget(own)
    own.looks += 1.0
    block, length = newest, 1
    for scale in range(SCALES):
        if int(own.looks) & (length - 1):
            break
        last, share = own.mean_r[scale], s.share[scale]
        change = block - last
        bend = own.mean_before_r[scale] - last + change
        own.mean_before_r[scale], own.mean_r[scale] = last, block
        block = (block + last) * 0.5
        change = clipped(change, noise * math.sqrt(2.0 / s.readings[scale]), s.largest_r)
        bend = clipped(bend, noise * math.sqrt(6.0 / s.readings[scale]), s.largest_r)
        moved, bent = change * change, bend * bend
        own.bends[scale] = averaged(own.bends[scale], bent, 1.0, share)
        bent = min(max(bent, -MOST), MOST)
        own.up[scale] = averaged(own.up[scale], moved if change > 0.0 else 0.0, 0.5, share)
        own.bends_up[scale] = averaged(own.bends_up[scale], bent if bend > 0.0 else 0.0, 0.5, share)
        own.down[scale] = averaged(own.down[scale], moved if change < 0.0 else 0.0, 0.5, share)
        own.bends_down[scale] = averaged(own.bends_down[scale], bent if bend < 0.0 else 0.0, 0.5, share)
        length *= 2
    told, most, most_by_shortest, rest, rest_of_most, looks = 0.0, 0.0, 0.0, 1.0, 1.0, 1.0
    for scale in range(SCALES):
        sure, hides = s.sure[scale], s.hides[scale]
        bends, up, down = max(own.bends[scale], 0.0), own.up[scale], own.down[scale]
        clear = min(own.bends_up[scale], own.bends_down[scale]) * 2.0 / sure
        moved = max(min(up + down, min(up, down) * SIDE + (0.5 * SIDE - 1.0)), 0.0)
        of_change, of_bend = noise * noise * (2.0 / s.readings[scale]), noise * noise * (6.0 / s.readings[scale])
        if scale == 0:
            beyond = sure * MAY
            _, most_by_shortest = path_of((moved + beyond) * of_change, (bends + beyond) * of_bend, looks, hides)
        if clear > 0.0 and rest > 0.0:
            seen, longest = path_of(moved * of_change, bends * of_bend, looks, hides)
            may = min(max((clear - MAY_TREMBLE) * (1.0 / (SEEMS_TO - MAY_TREMBLE)), 0.0), 1.0)
            does = min(max((clear - SEEMS_TO) * (1.0 / (TREMBLES - SEEMS_TO)), 0.0), 1.0)
            told += rest * does * seen
            rest *= 1.0 - does
            most += rest_of_most * may * longest
            rest_of_most *= 1.0 - may
        looks *= 2.0
    return told, told + max(min(most, most_by_shortest) - told, 0.0)


@loop
def path_of(moved2: float, bends2: float, looks: float, hides: float) -> tuple[float, float]:
    """Path per look for mean squares of first and second differences; and the longest that it may be.

    Of the part of the motion that turns within a few blocks of so many ``looks``, blocks see only the share 1/hides.
    """
    bends2 = min(bends2, moved2 * 4.0)
    seen = math.sqrt(moved2 + bends2 * BEND) * (PATH / looks)
    return seen, seen + math.sqrt(bends2 * (BEND * FAST)) * (PATH / looks) * (hides - 1.0)


@loop
def carried_over(own: PaperState, told: float, may: float, explained_late: float, s: PathStep) -> tuple[float, float]:
    """Paths less what turns have explained too late.

    The mean squares see a motion later than a turn explains it, so that what was explained too much is carried over, up
    to what they remember.
    """
    most_told, most_may = s.remembered * told, s.remembered * may
    path = min(max(own.balance_r + told - explained_late, -most_told), most_told)
    most = min(max(own.may_balance_r + may - explained_late, -most_may), most_may)
    own.balance_r, own.may_balance_r = min(path, 0.0), min(most, 0.0)
    return max(path, 0.0), max(most, 0.0)


# -- ratchet ---------------------------------------------------------------------------------------------------------


@loop
def unexplained(cell: CellState, own: PaperState, mean: float, s: PathStep) -> tuple[float, float, bool]:
    """Take a mean of readings; returns unexplained r, path seen by mistake, and whether there is an edge."""
    late = int(s.late)
    turned, gone = own.direction != own.direction_before, mean - own.extreme_r
    unseen = mean - own.last_r
    ahead = turned or gone * own.direction > 0.0
    if ahead:
        own.extreme_r = mean
    else:
        gone = 0.0
    own.last_r, own.direction_before = mean, own.direction
    own.unexplained_r += unseen - gone
    by_mistake = 0.0
    if turned:
        for look in range(min(int(own.looks_back), LATE_LOOKS)):
            own.unexplained_before_r[look] = own.unexplained_r
        if own.looks_back >= s.late:
            by_mistake = abs(own.unexplained_r - own.mean_r[0]) * TWICE
    newest = own.unexplained_before_r[late - 1]
    for look in range(LATE_LOOKS - 1, 0, -1):
        own.unexplained_before_r[look] = own.unexplained_before_r[look - 1]
    own.unexplained_before_r[0] = own.unexplained_r
    own.looks_back = 0.0 if ahead else own.looks_back + 1.0
    apart = max(abs(cell.pressure_kpa - cell.last_kpa), abs(cell.last_kpa - own.third_last_kpa))
    edge = apart > cell.noise * s.edge * cell.gain_kpa + s.largest_kpa
    return newest, by_mistake, bool(edge or abs(gone) > cell.noise * s.edge + s.largest_r)


@loop
def subtract(
    cell: CellState,
    own: PaperState,
    path: float,
    most: float,
    told: float,
    shown: float,
    k: PaperNumbers,
    s: PathStep,
) -> None:
    """Subtract the pressure that a ``path`` has made of the path ``told``; ``most`` is the path that may be.

    Under such motion r drifts half of the time by either model. Pressures stay above none: ``shown`` is the most that
    is subtracted.
    """
    if own.direction > 0.0:
        x3, settled = own.rising_x3, own.settled_kpa
        x2 = own.r - cell.pressure_kpa * s.fall_r - x3
    else:
        x3, x2 = own.recovery_x3, own.x2
        settled = cell.pressure_kpa * k.settled_per_kpa - own.r * k.etau2_kpa
    recovers = (cell.pressure_kpa * (1 / k.e2_kpa) - x2) * s.of_2 + (cell.pressure_kpa * (1 / k.e3_kpa) - x3) * s.of_3
    share = min(path / told, 1.0) if path > 0.0 else 0.0
    sinks = (settled - cell.pressure_kpa) / k.etau2_kpa * s.of_u
    drifts = recovers / s.fall_r - sinks / s.rise_r
    if own.direction < 0.0:
        drifts = -drifts
    kpa = min(max(path * s.ratchet_kpa + drifts * share * 0.5, 0.0), shown)
    more = max(most - path, 0.0) * s.ratchet_kpa + kpa * UNSURE
    if not more > 0.0:
        return
    cell.pressure_kpa -= kpa
    cell.last_kpa -= kpa
    cell.before_last_kpa -= kpa
    own.third_last_kpa -= kpa
    own.rising_kpa -= kpa
    own.recovery_kpa -= kpa
    own.largest_mean_kpa -= kpa
    own.settled_kpa -= kpa * k.settled_per_kpa
    own.x2 += kpa * s.fall_r
    ahead = own.direction * kpa
    own.extreme_kpa -= ahead
    own.peak_kpa -= ahead
    own.recent_extreme_kpa -= ahead
    if cell.unconfirmed > 0.0:
        ahead = -ahead
        cell.left_kpa -= ahead
    own.earlier_least_kpa -= ahead
    own.earlier_from_kpa -= ahead
    before = cell.turn_variance_kpa2
    after = math.sqrt(before) + more
    cell.turn_variance_kpa2 = min(after * after, max(before, shown * shown))
    cell.variance_kpa2 += cell.turn_variance_kpa2 - before
