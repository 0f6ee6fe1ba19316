"""Correction of the paper's cell for tremor within the noise: ratchet effect of a load that goes to and fro unnoticed.

Motion that goes back by less than a turn, or than noise, is never noticed as turns. The paper's cell answers a rise by
more than a fall, so that r climbs with each to and fro. An inverse by one of the two models takes this for a load that
grows. The path length of the readings (the "way", :mod:`._way`) tells by how much r climbs.

Motion that the inverse has noticed must be left out. While the load rises, r beyond its largest value since the last
turn is explained by the rise; after a turn has been noticed, r below it is explained by the fall. A turn is noticed
late, and then explains all that r went since the extreme. The meter therefore gets the unexplained motion some looks
later, and never sees motion that a turn explains meanwhile. Presses and taps then leave nothing, and neither do tremors
so wide that all turns are noticed. Under the remaining motion, r drifts half of the time by either model.

The pressure that the remaining motion makes is subtracted from both hypotheses and from the extremes with which they
are compared, so that the correction is no turn. The standard deviation gains a share of the correction, since the way
is known to about this share, and the pressure of the further way that noise may hide. Both errors have one sign, and
are added as amounts. A load that grows is left alone, since it goes one way.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Places, Row, Rows, SpacedPlaces, SpacedRows, loop
from ..estimation import FAR, GAIN, PRESSURE, RECENT, RESTED, VARIANCE
from ..materials import PaperModel
from . import _meter as meter
from . import _together as together
from . import _way as way
from ._meter import HELD, HELD_FOR_EVER, tell_of, uncounted_of
from ._meter import see_of as tell_neighbours_of
from ._onset import CLEAR_KPA
from ._paper_steps import fast_r
from ._turning_rows import (
    BEFORE_LAST,
    EARLIER_FROM_KPA,
    EARLIER_LEAST_KPA,
    EXTREME,
    HIGHEST_MEAN_KPA,
    LAST,
    LEFT,
    PEAK,
    RECENT_EXTREME,
    RECOVERY_KPA,
    RECOVERY_X3,
    RISING_KPA,
    RISING_X3,
    SETTLED,
    SIGN,
    STATE_END,
    THIRD_LAST,
    TURNED,
    X2,
    by_steps,
    by_steps_of,
)

UNSURE = 0.3
"""standard deviation of the pressure that is subtracted, over this pressure"""
BLOCK_S = 0.11
"""seconds from one look to the next, at most. A tremor goes to and fro in a quarter of a second, and means over a
longer time hide it; slow boards take fewer readings"""
CAUTION, CAUTION_OF_FEW = way.Caution(), way.Caution(of_most=1.0, most_share=1.0 / 16.0)
"""the second one for looks at fewer than :data:`..estimation.RECENT` readings. Their means are noisier, so that more
blocks are averaged. The whole way that chance leaves room for counts as standard deviation (of_most = 1): turns lie
between frames, and a missed way adds up to one side for as long as the load is held. With of_most = 0.3, half of the
errors after a minute were beyond two standard deviations"""
LARGEST, LARGEST_PER_S = 0.04, 0.6
"""of full scale, and of full scale per second: a load that goes farther from one look to the next has an edge. After an
edge no way is told for as long as the mean squares remember. The limit grows with the time between looks, since a
tremor goes as far in a frame of a slow board as a press does on a fast one"""
LATE_S, LATE_LOOKS = 0.15, 8
"""seconds, and looks at most, after which the meter gets the unexplained motion: by then most turns are noticed"""
TWICE = 2.0
"""the way that the meter sees by mistake, over the motion that a late turn explains: r went there, and the unexplained
motion goes back"""

NAMES = (
    *(*meter.NAMES, "sign_before", "last_r", "extreme_r", "unexplained_r", "looks_back"),
    *(f"unexplained_r_{looks}_before" for looks in range(1, LATE_LOOKS + 1)),
)
"""names of the rows of the memory: those of :mod:`._meter`; 1 if the load rose at the last look, -1 if it fell; r then;
the largest r since the load turned up, or the least since it turned down (the extreme); the unexplained r, which is r
less all of its progress beyond the extreme; looks since r last went beyond the extreme; and the unexplained r at
earlier looks, as known now"""
METER = CLEAR_KPA + 1
"""first row, behind those of :mod:`._onset`"""
_METER = slice(METER, METER + len(meter.NAMES))
SIGN_BEFORE, LAST_R, EXTREME_R, UNEXPLAINED_R, LOOKS_BACK, BEFORE = range(
    METER + len(meter.NAMES), METER + len(NAMES) - LATE_LOOKS + 1
)
_BEFORE, _SERIES = slice(BEFORE, BEFORE + LATE_LOOKS), METER + meter.SERIES
ROWS = slice(METER, METER + len(NAMES))
"""all rows of this module; :func:`begin` writes them"""
RISE_R, FALL_R, PER_E2, PER_E3, ETAU2_KPA, SETTLED_PER_KPA, OF_U, OF_2, OF_3, KEPT_KPA = range(10)
OWED, LARGEST_R, LARGEST_KPA, LOAD_R, LATE, EDGE = range(10, 16)
"""places of the numbers: r per kPa of a fast rise and of a fast fall; constants of the model; the time between looks
over each time constant; kPa that remain per r of the way; :func:`._meter.owed_looks`; how far a load may go unnoticed,
in r and in kPa; r per kPa of a load that goes to and fro; looks after which the meter gets the unexplained motion; and
:func:`._meter.edge`"""
BACK = together.TELLS
SEEN = together.TELLS + 1
"""rows of the array between the two passes of a look over the cells: first those that the neighbours read
(:mod:`._together`), then the way in r that the meter has seen although a late turn explains it; and the number of
rows"""
_ZERO, _HALF, _ONE, _UNSURE, _TWICE = (np.array(x) for x in (0.0, 0.5, 1.0, UNSURE, TWICE))
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.
_LOOKS_BEFORE = np.arange(1.0, LATE_LOOKS + 1.0)[:, None]


def readings(dt_s: float) -> int:
    """Readings from one look to the next, for frames ``dt_s`` apart: :data:`..estimation.RECENT` or a part of it."""
    count = RECENT
    while count > 1 and count * dt_s > BLOCK_S:
        count //= 2
    return count


def caution(dt_s: float) -> way.Caution:
    """How sure the way must be, for frames ``dt_s`` apart."""
    return CAUTION if readings(dt_s) == RECENT else CAUTION_OF_FEW


def unnoticed(dt_s: float) -> float:
    """The farthest, of full scale, that a load may go from one look to the next without an edge."""
    return max(LARGEST, LARGEST_PER_S * readings(dt_s) * dt_s)


def constants(model: PaperModel, dt_s: float, full_scale_kpa: float) -> meter.Constants:
    """The numbers that :func:`look` takes, for frames ``dt_s`` apart."""
    m, count, (rise_r, fall_r) = model, readings(dt_s), fast_r(model)
    between_s, largest_kpa = count * dt_s, unnoticed(dt_s) * full_scale_kpa
    numbers = {
        RISE_R: rise_r,
        FALL_R: fall_r,
        PER_E2: 1 / m.e2_kpa,
        PER_E3: 1 / m.e3_kpa,
        ETAU2_KPA: m.etau2_kpa,
        SETTLED_PER_KPA: 1 + m.etau2_kpa / m.eu1_kpa,
        OF_U: between_s / m.tu_s,
        OF_2: between_s / m.t2_s,
        OF_3: between_s / m.t3_s,
        KEPT_KPA: 0.5 * (rise_r - fall_r) / (rise_r * fall_r),
        OWED: meter.owed_looks(dt_s, count),
        LARGEST_R: largest_kpa * rise_r,
        LARGEST_KPA: largest_kpa,
        LOAD_R: 0.5 * (rise_r + fall_r),
        LATE: min(math.ceil(LATE_S / between_s), LATE_LOOKS),
        EDGE: meter.edge(count),
    }
    return meter.constants(numbers, dt_s, count, caution(dt_s))


def begin(memory: FloatArray, r: FloatArray) -> None:
    """Begin with cells whose reading has been ``r`` (m,) for ever; changes their ``memory`` (rows, m)."""
    meter.begin(memory[_METER], 0.0)
    memory[SIGN_BEFORE] = memory[SIGN]
    memory[[LAST_R, EXTREME_R]] = r
    memory[UNEXPLAINED_R : _BEFORE.stop] = 0.0


def look(
    memory: FloatArray, mean: FloatArray, noise: FloatArray, steps: float, near: IntArray, numbers: meter.Constants
) -> None:
    """Take the last readings of m cells; changes their ``memory`` (rows, m).

    To be called every :func:`readings` frames.

    Args:
        memory: of the cells.
        mean: (m,) of as many readings.
        noise: (m,) standard deviation of one of them.
        steps: standard deviation of r at rest by ADC steps, of all readings that r follows from.
        near: (k, m) neighbours, see :class:`..estimation._neighbours.Neighbours`.
        numbers: :func:`constants`.
    """
    noise = np.maximum(noise, by_steps(memory, steps))
    sign, extreme, unexplained = memory[SIGN], memory[EXTREME_R], memory[UNEXPLAINED_R]
    turned = sign != memory[SIGN_BEFORE]
    gone = mean - extreme
    ahead = gone * sign > _ZERO
    ahead |= turned
    gone *= ahead
    np.copyto(extreme, mean, where=ahead)
    unseen = mean - memory[LAST_R]
    unseen -= gone
    unexplained += unseen
    memory[LAST_R], memory[SIGN_BEFORE] = mean, sign
    largest, owed, late = numbers.each[LARGEST_R], numbers.each[OWED], numbers.each[LATE]
    newest, back = _explained_in_hindsight(memory, turned, late)
    looks_back = memory[LOOKS_BACK]
    looks_back += _ONE
    np.copyto(looks_back, _ZERO, where=ahead)
    edge = noise * numbers.each[EDGE]
    edges = np.abs(gone) > edge + largest
    recent = memory[LAST : THIRD_LAST + 1]
    apart = np.maximum(np.abs(memory[PRESSURE] - recent[0]), np.abs(recent[0] - recent[2]))
    edges |= apart > edge * memory[GAIN] + numbers.each[LARGEST_KPA]
    shown = np.where(memory[RESTED] > _ZERO, _ZERO, np.maximum(memory[PRESSURE], _ZERO))
    rows, load = memory[_METER], shown * numbers.each[LOAD_R]
    found = meter.look(rows, newest, noise, load, edges, near, meter.Limits(largest, owed, late), numbers.way)
    remains = meter.uncounted(rows, found, back, owed)
    told, more = remains
    more -= told
    np.maximum(more, _ZERO, out=more)
    more *= numbers.each[KEPT_KPA]
    if np.count_nonzero(told):
        more += _take_back(memory, told, found[0], shown, numbers.each) * _UNSURE
    doubt = memory[TURNED]
    after = np.sqrt(doubt)
    after += more
    after *= after
    np.minimum(after, np.maximum(doubt, shown * shown), out=after)
    np.copyto(after, doubt, where=more <= _ZERO)  # rounding: the square of a root may differ
    variance = memory[VARIANCE]
    variance += after - doubt
    doubt[...] = after


def _explained_in_hindsight(memory: FloatArray, turned: BoolArray, late: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Let turns (m,) explain the motion of r since the extreme; changes the rows from :data:`BEFORE` on.

    Args:
        memory: (rows, m) of the cells.
        turned: (m,) where a turn has just been noticed.
        late: looks after which the meter gets the unexplained motion.

    Returns:
        (m,) unexplained r ``late`` looks ago; and (m,) way in r that the meter has seen although a turn explains it.
    """
    unexplained, before, looks_back = memory[UNEXPLAINED_R], memory[_BEFORE], memory[LOOKS_BACK]
    back = np.zeros_like(unexplained)
    if np.count_nonzero(turned):
        np.copyto(before, unexplained, where=turned & (looks_back >= _LOOKS_BEFORE))
        np.subtract(unexplained, memory[_SERIES], out=back, where=turned & (looks_back >= late))
        np.abs(back, out=back)
        back *= _TWICE
    newest = before[int(late) - 1].copy()
    before[1:] = before[:-1]
    before[0] = unexplained
    return newest, back


def _take_back(
    memory: FloatArray, way: FloatArray, told: FloatArray, shown: FloatArray, numbers: tuple[FloatArray, ...]
) -> FloatArray:
    """Subtract the pressure that an uncounted ``way`` (m,) of r has made, of a way ``told`` (m,) since the last look.

    Pressures stay above none: ``shown`` (m,) is the most that is subtracted.

    Returns:
        (m,) kPa that are subtracted.
    """
    rise, fall, per_e2, per_e3, etau2, settled_per_kpa, of_u, of_2, of_3, kept = numbers[: KEPT_KPA + 1]
    sign, pressure, r = memory[SIGN], memory[PRESSURE], memory[STATE_END - 1]
    rises = sign > _ZERO
    share = np.minimum(way / np.where(way > _ZERO, told, _ONE), _ONE)
    x3 = np.where(rises, memory[RISING_X3], memory[RECOVERY_X3])
    x2 = np.where(rises, r - pressure * fall - x3, memory[X2])
    settled = np.where(rises, memory[SETTLED], pressure * settled_per_kpa - r * etau2)
    recovers = (pressure * per_e2 - x2) * of_2 + (pressure * per_e3 - x3) * of_3
    sinks = (settled - pressure) / etau2 * of_u
    drifts = np.where(rises, recovers / fall - sinks / rise, sinks / rise - recovers / fall)
    kpa = way * kept + drifts * share * _HALF
    kpa = np.minimum(np.maximum(kpa, _ZERO), shown)
    for row in (PRESSURE, LAST, BEFORE_LAST, THIRD_LAST, RISING_KPA, RECOVERY_KPA, HIGHEST_MEAN_KPA):
        memory[row] -= kpa
    memory[SETTLED] -= kpa * settled_per_kpa
    memory[X2] += kpa * fall
    ahead = sign * kpa
    for row in (EXTREME, PEAK, RECENT_EXTREME):
        memory[row] -= ahead
    unconfirmed = memory[LEFT] < FAR
    np.negative(ahead, out=ahead, where=unconfirmed)
    for row in (EARLIER_LEAST_KPA, EARLIER_FROM_KPA):
        memory[row] -= ahead
    memory[LEFT] -= np.where(unconfirmed, ahead, _ZERO)
    taken: FloatArray = kpa
    return taken


@loop
def look_each(
    memory: SpacedRows,
    means: Row,
    noises: Row,
    steps: float,
    near: SpacedPlaces,
    numbers: Row,
    way_numbers: Rows,
    seen: Rows,
) -> None:
    """:func:`look` as a loop over cells; ``way_numbers``: those of :mod:`._way`; ``seen`` (SEEN, m): a work array."""
    largest, owed = numbers[LARGEST_R], numbers[OWED]
    for i in range(means.size):
        see_of(memory, i, means[i], noise_of(memory, i, noises[i], steps), numbers, way_numbers, seen)
    for i in range(means.size):
        noise, load = noise_of(memory, i, noises[i], steps), shown_of(memory, i) * numbers[LOAD_R]
        told, may = tell_of(memory, METER, i, noise, load, largest, owed, seen, near, way_numbers)
        way, most = uncounted_of(memory, METER, i, told, may, seen[BACK, i], owed)
        if max(way, most) > 0.0:
            take_back_of(memory, i, way, most, told, numbers)


@loop
def noise_of(memory: SpacedRows, i: int, noise: float, steps: float) -> float:
    """Standard deviation of a reading of cell ``i``, no less than that by ADC ``steps``."""
    return max(noise, by_steps_of(memory, i, steps))


@loop
def shown_of(memory: SpacedRows, i: int) -> float:
    """The load of cell ``i`` in kPa; none if the cell is taken for one at rest."""
    return 0.0 if memory[RESTED, i] > 0.0 else max(memory[PRESSURE, i], 0.0)


@loop
def see_of(memory: SpacedRows, i: int, mean: float, noise: float, numbers: Row, way_numbers: Rows, seen: Rows) -> None:
    """The first pass of a look at cell ``i``; writes its column of ``seen`` (SEEN, m)."""
    sign, gone = memory[SIGN, i], mean - memory[EXTREME_R, i]
    turned, unseen = sign != memory[SIGN_BEFORE, i], mean - memory[LAST_R, i]
    ahead = turned or gone * sign > 0.0
    if ahead:
        memory[EXTREME_R, i] = mean
    else:
        gone = 0.0
    unseen -= gone
    memory[LAST_R, i], memory[SIGN_BEFORE, i] = mean, sign
    memory[UNEXPLAINED_R, i] += unseen
    newest, seen[BACK, i] = explained_in_hindsight_of(memory, i, turned, numbers[LATE])
    memory[LOOKS_BACK, i] = 0.0 if ahead else memory[LOOKS_BACK, i] + 1.0
    apart = max(abs(memory[PRESSURE, i] - memory[LAST, i]), abs(memory[LAST, i] - memory[THIRD_LAST, i]))
    edge = apart > noise * numbers[EDGE] * memory[GAIN, i] + numbers[LARGEST_KPA]
    edge |= abs(gone) > noise * numbers[EDGE] + numbers[LARGEST_R]
    load = shown_of(memory, i) * numbers[LOAD_R]
    late, largest = numbers[LATE], numbers[LARGEST_R]
    tell_neighbours_of(memory, METER, i, newest, noise, load, edge, late, largest, way_numbers, seen)


@loop
def explained_in_hindsight_of(memory: SpacedRows, i: int, turned: bool, late: float) -> tuple[float, float]:
    """:func:`_explained_in_hindsight` of cell ``i``."""
    unexplained, looks_back, back = memory[UNEXPLAINED_R, i], memory[LOOKS_BACK, i], 0.0
    if turned:
        for before in range(min(int(looks_back), LATE_LOOKS)):
            memory[BEFORE + before, i] = unexplained
        if looks_back >= late:
            back = abs(unexplained - memory[_SERIES, i]) * TWICE
    newest = memory[BEFORE + int(late) - 1, i]
    for before in range(LATE_LOOKS - 1, 0, -1):
        memory[BEFORE + before, i] = memory[BEFORE + before - 1, i]
    memory[BEFORE, i] = unexplained
    return newest, back


@loop
def take_back_of(memory: SpacedRows, i: int, way: float, most: float, told: float, numbers: Row) -> None:
    """:func:`_take_back` of cell ``i``, and the rest of :func:`look`: adds to its variance."""
    rise, fall, etau2, kept = numbers[RISE_R], numbers[FALL_R], numbers[ETAU2_KPA], numbers[KEPT_KPA]
    sign, pressure, r = memory[SIGN, i], memory[PRESSURE, i], memory[STATE_END - 1, i]
    if sign > 0.0:
        x3, settled = memory[RISING_X3, i], memory[SETTLED, i]
        x2 = r - pressure * fall - x3
    else:
        x3, x2 = memory[RECOVERY_X3, i], memory[X2, i]
        settled = pressure * numbers[SETTLED_PER_KPA] - r * etau2
    recovers = (pressure * numbers[PER_E2] - x2) * numbers[OF_2] + (pressure * numbers[PER_E3] - x3) * numbers[OF_3]
    share = min(way / told, 1.0) if way > 0.0 else 0.0
    sinks = (settled - pressure) / etau2 * numbers[OF_U]
    drifts = recovers / fall - sinks / rise if sign > 0.0 else sinks / rise - recovers / fall
    kpa = way * kept + drifts * share * 0.5
    shown = shown_of(memory, i)
    kpa = min(max(kpa, 0.0), shown)
    more = max(most - way, 0.0) * kept + kpa * UNSURE
    if not more > 0.0:
        return
    memory[PRESSURE, i] -= kpa
    for row in range(LAST, THIRD_LAST + 1):
        memory[row, i] -= kpa
    memory[RISING_KPA, i] -= kpa
    memory[RECOVERY_KPA, i] -= kpa
    memory[HIGHEST_MEAN_KPA, i] -= kpa
    memory[SETTLED, i] -= kpa * numbers[SETTLED_PER_KPA]
    memory[X2, i] += kpa * fall
    ahead = sign * kpa
    memory[EXTREME, i] -= ahead
    memory[PEAK, i] -= ahead
    memory[RECENT_EXTREME, i] -= ahead
    if memory[LEFT, i] < FAR:
        ahead = -ahead
        memory[LEFT, i] -= ahead
    memory[EARLIER_LEAST_KPA, i] -= ahead
    memory[EARLIER_FROM_KPA, i] -= ahead
    doubt = memory[TURNED, i]
    after = math.sqrt(doubt) + more
    after = min(after * after, max(doubt, shown * shown))
    memory[VARIANCE, i] += after - doubt
    memory[TURNED, i] = after


@loop
def begin_each(memory: SpacedRows, places: Places) -> None:
    """:func:`begin` for the cells at ``places`` (k,), with the r in their memory."""
    for row in range(METER, BEFORE + LATE_LOOKS):
        for k in range(places.size):
            memory[row, places[k]] = 0.0
    for k in range(places.size):
        i = places[k]
        memory[METER + HELD, i] = HELD_FOR_EVER
        memory[SIGN_BEFORE, i] = memory[SIGN, i]
        memory[LAST_R, i] = memory[EXTREME_R, i] = memory[STATE_END - 1, i]


LOOPS = (look_each,)
