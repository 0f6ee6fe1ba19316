"""Held loads kept through steps of the ADC that all cells of a column share (a play operator on an interval).

On a divider whose idle rows are driven, a step of one reading scales all resistances of its column alike. With few bits
that looks like the release of a load that is held there, and nearly all cells of the column are awake then, so that no
sleeping cells tell the step (:mod:`._shared_noise`). But a cell reads no less than without load, whatever it bears:
that is its reading at rest, and what earlier loads have left. Recovery that takes a minute would pass for a step.

* Where even the third least of a column's readings is below that, that much is shared, and is taken out.
* Where it is above that, it may be shared or a load on all cells. The reading of a cell is then known to an interval:
  with and without the shared part. A cell that has been held for a while keeps its last reading as far as that lies in
  the interval. Other cells are left alone: a tap would lose the part of its rise that its column has in common.

Only cells that stand out from the third least one are changed. A load that comes to the others is not hidden. A shared
part beyond what steps make is a load. Steps that noise makes random are none of this: a reading that is kept would
follow the least of them, one after the other, and a hold would fade.
"""

from __future__ import annotations

import numpy as np

from ...arrays import BoolArray, FloatArray, IntArray
from ...compiled import Flags, Row, loop
from ._dither import undithered_of

TELLING = 3
"""which of the least readings of a column tells what is shared; of one or two, a bad contact would be taken for it"""
STANDS_OUT = 4.0
"""standard deviations of own noise above that reading from which on a cell bears a load of its own"""
MOST = 5.0
"""standard deviations by the steps of all readings that a shared part has at most: equal cells step together"""
LIMIT = 0.5
"""the largest shared part, whatever the steps are"""
HELD_S = 0.4
"""seconds of standing out after which a cell counts as held"""
COUNTS_OFF = 3.0
"""seconds of a load that a second without it counts off"""


def constant(ratio: float) -> float:
    """Share of the steps that stays from frame to frame, for noise of ``ratio`` times that of the steps alone.

    The square of what noise leaves of them in a mean: what is wrongly kept of noise errs to one side for as long as the
    load is held, while what is not kept of a step is in the deviation.
    """
    left = undithered_of(ratio)
    return left * left


def keep(
    r: FloatArray,
    last: FloatArray,
    reference: FloatArray,
    held_s: FloatArray,
    read: BoolArray,
    awake: BoolArray,
    untold: BoolArray,
    own: float,
    steps: float,
    side: float,
    dt_s: float,
) -> IntArray:
    """Keep the readings of cells that stand out from their column; changes ``r`` and ``held_s``.

    Args:
        r: (n,) normalised resistances.
        last: (n,) those of the last frame.
        reference: (n,) those that cells have without load: at rest, and what earlier loads have left.
        held_s: (n,) seconds for which cells have been held.
        read: (n,) which cells have been read.
        awake: (n,) which of them do not sleep.
        untold: (columns,) where no sleeping cells tell what is shared.
        own: standard deviation of r at rest by own noise and own steps.
        steps: the same by the steps of all readings.
        side: sign that a load gives to r.
        dt_s: seconds since the last frame.

    Returns:
        (m,) cells that were changed.
    """
    columns, bound = untold.size, min(MOST * steps, LIMIT)
    off = np.where(read, side * (r - reference) / (1.0 + reference), np.inf).reshape(-1, columns)
    if off.shape[0] < TELLING:
        return np.zeros(0, dtype=np.intp)
    level = np.partition(off, TELLING - 1, axis=0)[TELLING - 1]
    stands_out = awake.reshape(-1, columns) & (off > level + STANDS_OUT * own)
    held_s += np.where(stands_out.ravel(), dt_s, -COUNTS_OFF * dt_s)
    np.maximum(np.minimum(held_s, 2.0 * HELD_S, out=held_s), 0.0, out=held_s)
    above = np.maximum(np.minimum(level - own, 2.0 * bound - (level - own)), 0.0)
    shared = np.where(level < 0.0, np.maximum(np.minimum(level + own, 0.0), -bound), above)
    changes = (shared < 0.0) | ((shared > 0.0) & (held_s > HELD_S).reshape(-1, columns))
    cells: IntArray = ((stands_out & changes & untold).ravel() & read).nonzero()[0]
    if cells.size:
        part, with_it = shared.take(cells % columns), r.take(cells)
        without = (1.0 + with_it) / (1.0 + side * part) - 1.0
        kept = np.maximum(np.minimum(last.take(cells), np.maximum(with_it, without)), np.minimum(with_it, without))
        r[cells] = np.where(part < 0.0, without, kept)
    return cells


@loop
def keep_each(
    r: Row,
    last: Row,
    reference: Row,
    held_s: Row,
    read: Flags,
    awake: Flags,
    untold: Row,
    own: float,
    steps: float,
    side: float,
    dt_s: float,
    watched: Row,
) -> None:
    """:func:`keep` as a loop; also changes ``watched`` (n,). ``untold`` (columns,) is 1 where it is true, else 0."""
    columns, bound = untold.size, min(MOST * steps, LIMIT)
    if r.size < TELLING * columns:
        return
    for column in range(columns):
        least, second, level, some_awake = np.inf, np.inf, np.inf, False
        for i in range(column, r.size, columns):
            some_awake |= awake[i] or held_s[i] > 0.0
            if read[i]:
                off = side * (r[i] - reference[i]) / (1.0 + reference[i])
                if off < least:
                    least, second, level = off, least, second
                elif off < second:
                    second, level = off, second
                elif off < level:
                    level = off
        if not some_awake:
            continue
        shared = 0.0
        if untold[column] > 0.0 and level < 0.0:
            shared = max(min(level + own, 0.0), -bound)
        elif untold[column] > 0.0:
            shared = max(min(level - own, 2.0 * bound - (level - own)), 0.0)
        for i in range(column, r.size, columns):
            off = side * (r[i] - reference[i]) / (1.0 + reference[i]) if read[i] else np.inf
            stands_out = awake[i] and off > level + STANDS_OUT * own
            held_s[i] += dt_s if stands_out else -COUNTS_OFF * dt_s
            held_s[i] = max(min(held_s[i], 2.0 * HELD_S), 0.0)
            if read[i] and stands_out and (shared < 0.0 or (shared > 0.0 and held_s[i] > HELD_S)):
                without = (1.0 + r[i]) / (1.0 + side * shared) - 1.0
                if shared > 0.0:
                    without = max(min(last[i], max(r[i], without)), min(r[i], without))
                r[i] = watched[i] = without


LOOPS = (keep_each,)
