"""Common-mode quantisation steps of a column, kept away from held loads (a play operator on an interval).

On a divider whose idle rows are driven, a quantisation step of one reading scales all resistances of its column alike.
With few bits such a step looks like the release of a held load. If nearly all cells of the column are awake, too few
cells sleep to measure the step (:mod:`._shared_noise`).

The readings have a lower bound instead: no cell reads less than its unloaded reading, whatever load it carries. The
unloaded reading is the reading at rest plus the remainder of earlier loads. (Without that remainder, a recovery that
takes a minute would look like a step.) The level of a column is the third smallest departure of a reading from the
unloaded reading.

* If the level is negative, the readings contain at least that much shared error, which is removed.
* If the level is positive, it may be shared error or a load on all cells. Each reading is then known only to an
  interval, whose ends are the readings with and without the level. A cell that has been held for a while keeps its last
  reading, clipped to the interval. Other cells are not changed: a tap would lose the part of its rise that it shares
  with its column.

Only cells that stand out from the level are changed, so that new loads on the other cells are not hidden. A shared part
larger than quantisation can cause is a load. Where noise makes the quantisation error random (dither), nothing is kept:
a kept reading would follow the smallest of the random readings, and a hold would fade.
"""

from __future__ import annotations

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Flags, Row, loop
from ._dither import undithered_of

TELLING = 3
"""rank, from the smallest, of the departure that is the level of a column; a lower rank would let one or two bad
contacts set the level"""
STANDS_OUT = 4.0
"""standard deviations of own noise above the level, beyond which a cell carries a load of its own"""
MOST = 5.0
"""largest shared part, in standard deviations by the quantisation of all readings: equal cells step together"""
LIMIT = 0.5
"""largest shared part of r, however large the quantisation steps are"""
HELD_S = 0.4
"""seconds of standing out after which a cell counts as held"""
COUNTS_OFF = 3.0
"""seconds of standing out that one second without standing out subtracts"""


def constant(ratio: float) -> float:
    """Fraction of the quantisation error that is constant from frame to frame.

    ``ratio`` is the standard deviation of readings over that by quantisation alone. The result is the square of
    :func:`.undithered_of`, as a cautious choice: keeping too much is a bias as long as the load is held, whereas a step
    that is not kept is covered by the standard deviation.
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
        last: (n,) normalised resistances of the last frame.
        reference: (n,) unloaded readings: at rest, plus the remainder of earlier loads.
        held_s: (n,) seconds for which cells have been held.
        read: (n,) which cells have been read.
        awake: (n,) which cells do not sleep.
        untold: (columns,) columns in which no sleeping cells measure the shared part.
        own: standard deviation of r at rest by own noise and own quantisation.
        steps: standard deviation of r at rest by the quantisation of all readings.
        side: sign of r under a load.
        dt_s: seconds since the last frame.

    Returns:
        (m,) cells whose reading was changed.
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
