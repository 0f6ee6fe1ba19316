"""Correction of ``m10`` cells for tremor within noise and ADC steps, which breaks conductive chains unnoticed.

Motion breaks conductive chains in proportion to the path length (the "way") of the load, up or down: ``D' = k |s'| -
D/tau``. An inverse counts the way of smoothed readings beyond a play as wide as the noise. A load that trembles goes
farther. The chains that break meanwhile raise r, and an inverse that does not know of them shows a load that grows, by
k over the slope dr/ds for each unit of the way.

:mod:`._meter` estimates the way, in r, from the readings less the branches. The way that the inverse has counted is
subtracted. The rest, converted to load, times k counts as broken chains, and the load as so much smaller. The standard
deviation includes the error of this estimate, and the chains of the further way that noise may hide. Both errors have
one sign, and are added as amounts until the chains have healed. While chains are uncertain, a load that trembles is
held where it is (:mod:`._steady`).

A load that swings slowly and widely goes to and fro, too, but an inverse follows it, and counts more of the way than
the meter tells. The further way that noise may hide then counts less (:data:`FOLLOWED`).
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import FloatArray, IntArray
from ...common.compiled import Row, Rows, SpacedPlaces, SpacedRows, loop
from ..estimation import PRESSURE
from ..materials import M10Model
from . import _meter as meter
from . import _steady as steady
from . import _together as together
from . import _way as way
from ._inverse_loops import ANCHOR, BRANCH, BROKEN, FURTHEST, LATELY, LOAD, MISSED
from ._meter import see_of, tell_of, uncounted_of
from ._steady import look_of as steady_of

READINGS = 2
"""readings from one look to the next. All of the way breaks chains; blocks of twice as many readings hide a third of
the way of a tremor with a period of eight frames, and nearly all of it at a period of five"""
UNSURE = 0.2
"""standard deviation of the way over the way that is told; that of the chains taken for broken follows from it"""
LARGEST = 0.04
"""of full scale: the farthest that a load may go from one look to the next without an edge"""
BEARS = 3.0
"""standard deviations of a reading, in r over r at full scale: a smaller load counts as none, and cannot tremble"""
CAUTION = way.Caution(may_from=2.4, told=3.0, does=5.0, of_most=0.1, most_share=1.0 / 48.0, hidden=1.0, alone_from=4.0)
"""stricter than the default: chains take much longer to heal than a tremor takes to be told, so that a way told by
chance adds up for as long, and widens the standard deviation of still loads"""
FOLLOWED = 0.6
"""share of the way that is told while the mean squares remember: an inverse that has counted so much more than is told
follows the load"""
LEAST_SLOPE = 0.05
"""least slope dr/ds, over r of full scale"""

NAMES = (*meter.NAMES, *steady.NAMES, "broken_before", "missed_before")
"""names of the rows of the memory: those of :mod:`._meter` and of :mod:`._steady`; then, at the last look, r of the
broken chains, and r of chains that may have broken unseen"""
METER = LATELY + 1
"""first row"""
ROWS = slice(METER, METER + len(meter.NAMES))
STEADY = METER + len(meter.NAMES)
STEADY_ROWS = slice(STEADY, STEADY + len(steady.NAMES))
BROKEN_BEFORE, MISSED_BEFORE = STEADY_ROWS.stop, STEADY_ROWS.stop + 1
A, B, K, FULL_KPA, FULL_R, KEPT, OWED, OF_STEADY = range(8)
"""places of the numbers: of the model; full scale in kPa and in r; share of the broken chains that is left at the next
look; :func:`._meter.owed_looks`; and the first place of those of :mod:`._steady`"""
LEAST_WAY = 1e-12
"""of r: avoids division by zero"""
BEARING = together.TELLS
EDGES = together.TELLS + 1
SEEN = together.TELLS + 2
"""rows of the array between the two passes of a look over the cells: first those that the neighbours read
(:mod:`._together`), then the load, and 1 if it has an edge just now; and the number of rows"""
EDGE = meter.edge(READINGS)
_SERIES, _TOLD = METER + meter.SERIES, METER + meter.TOLD
_ZERO, _ONE, _LEAST_WAY = (np.array(x) for x in (0.0, 1.0, LEAST_WAY))


def constants(model: M10Model, dt_s: float, full_scale_kpa: float, full_scale_r: float) -> meter.Constants:
    """The numbers that :func:`look` takes, for frames ``dt_s`` apart."""
    numbers = {
        **{A: model.a, B: model.b, K: model.k, FULL_KPA: full_scale_kpa, FULL_R: full_scale_r},
        KEPT: math.exp(-READINGS * dt_s / model.tau_s),
        OWED: meter.owed_looks(dt_s, READINGS),
        **{OF_STEADY + place: number for place, number in steady.constants(READINGS * dt_s).items()},
    }
    return meter.constants(numbers, dt_s, READINGS, CAUTION)


def begin(memory: FloatArray, r: FloatArray) -> None:
    """Begin with cells whose reading has been ``r`` (m,) for ever; changes their ``memory`` (rows, m)."""
    meter.begin(memory[ROWS], r - memory[BRANCH] - memory[BRANCH + 1])
    steady.begin(memory[STEADY_ROWS], memory[LOAD])
    memory[BROKEN_BEFORE] = memory[BROKEN]


def look(memory: FloatArray, mean: FloatArray, noise: FloatArray, near: IntArray, numbers: meter.Constants) -> None:
    """Take the last readings of m cells; changes their ``memory`` (rows, m).

    To be called every :data:`READINGS` frames.

    Args:
        memory: of the cells.
        mean: (m,) of as many readings.
        noise: (m,) standard deviation of one of them.
        near: (k, m) neighbours, see :class:`..estimation._neighbours.Neighbours`.
        numbers: :func:`constants`.
    """
    a, b, k, full_kpa, full_r, kept, owed = numbers.each[:OF_STEADY]
    load, broken, rows = memory[LOAD], memory[BROKEN], memory[ROWS]
    missed, missed_before = memory[MISSED], memory[MISSED_BEFORE]
    slope = np.maximum(a + 2.0 * b * load, LEAST_SLOPE * full_r)
    newest = mean - memory[BRANCH] - memory[BRANCH + 1]
    largest = slope * LARGEST
    bears = np.where(load > BEARS * noise / full_r, load, _ZERO)
    edges = np.abs(newest - memory[_SERIES]) > noise * EDGE + largest
    found = meter.look(rows, newest, noise, bears * slope, edges, near, meter.Limits(largest, owed, _ZERO), numbers.way)
    counted = (broken - memory[BROKEN_BEFORE] * kept) * (slope / k)
    way_told = found[0]
    told, may = meter.uncounted(rows, found, counted, owed)
    unfollowed = memory[_TOLD] / np.maximum(way_told * (owed * FOLLOWED), _LEAST_WAY)  # the balance is never above 0
    unfollowed += _ONE
    np.maximum(unfollowed, _ZERO, out=unfollowed)
    per_way = k / slope
    breaks = np.minimum(told * per_way / slope, bears)
    missed_before *= kept
    doubt = np.maximum(missed - missed_before, _ZERO) + np.maximum(may - told, _ZERO) * unfollowed * per_way
    doubt += np.minimum(slope * breaks, way_told * per_way * UNSURE)
    most = np.where(bears > _ZERO, broken / slope, _ZERO), bears - breaks
    back, doubt = steady.look(memory[STEADY_ROWS], load, edges, slope, doubt, most, numbers.each[OF_STEADY:])
    breaks += back
    missed_before += doubt
    missed[:] = missed_before
    for row in (LOAD, ANCHOR, FURTHEST):
        memory[row] -= breaks
    memory[PRESSURE] -= breaks * full_kpa
    broken += (a + b * (2.0 * load + breaks)) * breaks  # static response of the load before less after
    memory[BROKEN_BEFORE] = broken


@loop
def look_each(
    memory: SpacedRows, means: Row, noises: Row, near: SpacedPlaces, numbers: Row, way_numbers: Rows, seen: Rows
) -> None:
    """:func:`look` as a loop over cells; ``way_numbers``: those of :mod:`._way`; ``seen`` (SEEN, m): a work array."""
    a, b, k, full_r, owed = numbers[A], numbers[B], numbers[K], numbers[FULL_R], numbers[OWED]
    for i in range(means.size):
        load = memory[LOAD, i]
        slope = max(a + 2.0 * b * load, LEAST_SLOPE * full_r)
        newest, largest = means[i] - memory[BRANCH, i] - memory[BRANCH + 1, i], slope * LARGEST
        bears = load if load > BEARS * noises[i] / full_r else 0.0
        edge = abs(newest - memory[_SERIES, i]) > noises[i] * EDGE + largest
        see_of(memory, METER, i, newest, noises[i], bears * slope, edge, 0.0, largest, way_numbers, seen)
        seen[BEARING, i], seen[EDGES, i] = bears, 1.0 if edge else 0.0
    for i in range(means.size):
        load, broken, bears = memory[LOAD, i], memory[BROKEN, i], seen[BEARING, i]
        slope = max(a + 2.0 * b * load, LEAST_SLOPE * full_r)
        way_told, may = tell_of(
            memory, METER, i, noises[i], bears * slope, slope * LARGEST, owed, seen, near, way_numbers
        )
        counted = (broken - memory[BROKEN_BEFORE, i] * numbers[KEPT]) * (slope / k)
        told, may = uncounted_of(memory, METER, i, way_told, may, counted, owed)
        unfollowed = max(memory[_TOLD, i] / max(way_told * (owed * FOLLOWED), LEAST_WAY) + 1.0, 0.0)
        per_way = k / slope
        breaks = min(told * per_way / slope, bears)
        missed_before = memory[MISSED_BEFORE, i] * numbers[KEPT]
        doubt = max(memory[MISSED, i] - missed_before, 0.0) + max(may - told, 0.0) * unfollowed * per_way
        doubt += min(slope * breaks, way_told * per_way * UNSURE)
        most_added = broken / slope if bears > 0.0 else 0.0
        back, doubt = steady_of(
            memory, STEADY, i, load, seen[EDGES, i] > 0.0, slope, doubt, most_added, bears - breaks, numbers, OF_STEADY
        )
        breaks += back
        memory[MISSED, i] = memory[MISSED_BEFORE, i] = missed_before + doubt
        for row in (LOAD, ANCHOR, FURTHEST):
            memory[row, i] -= breaks
        load = memory[LOAD, i]
        memory[PRESSURE, i] -= breaks * numbers[FULL_KPA]
        broken += (a + b * (2.0 * load + breaks)) * breaks
        memory[BROKEN, i] = memory[BROKEN_BEFORE, i] = broken


LOOPS = (look_each,)
