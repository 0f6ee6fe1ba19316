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

import math

import numpy as np

from ...common.compiled import Flags, Records, Row, loop
from .._state import ColumnState

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


DITHER = math.pi**2 / 24.0
"""constant of the exponent of the dither. In a mean, noise of variance v leaves the fraction exp(-x) of the error of
steps q, where x = 2 pi^2 v / q^2 (Widrow, Kollar: Quantization Noise, 2008). x / 4 is this constant times v over the
variance q^2 / 12 of the quantisation error. We use the upper bound (1 + x / 4)^-4 of exp(-x)"""


def constant(ratio: float) -> float:
    """Fraction of the quantisation error that is constant from frame to frame, as noise makes the rest random.

    ``ratio`` is the standard deviation of readings over that by quantisation alone. The result is the square of the
    fraction that is left in a mean, as a cautious choice: keeping too much is a bias as long as the load is held,
    whereas a step that is not kept is covered by the standard deviation.
    """
    left = (1.0 + max(ratio * ratio - 1.0, 0.0) * DITHER) ** -4
    return left * left


@loop
def keep_each(
    r: Row,
    last: Row,
    reference: Row,
    held_s: Row,
    read: Flags,
    awake: Flags,
    columns: Records[ColumnState],
    own: float,
    steps: float,
    side: float,
    dt_s: float,
    watched: Row,
) -> None:
    """Keep the readings of cells that stand out from their column; changes ``r``, ``held_s`` and ``watched``.

    Args:
        r: (n,) normalised resistances.
        last: (n,) normalised resistances of the last frame.
        reference: (n,) unloaded readings: at rest, plus the remainder of earlier loads.
        held_s: (n,) seconds for which cells have been held.
        read: (n,) which cells have been read.
        awake: (n,) which cells do not sleep.
        columns: their states; ``untold`` where no sleeping cells measure the shared part.
        own: standard deviation of r at rest by own noise and own quantisation.
        steps: standard deviation of r at rest by the quantisation of all readings.
        side: sign of r under a load.
        dt_s: seconds since the last frame.
        watched: (n,) readings whose mean is monitored.
    """
    count, bound = columns.size, min(MOST * steps, LIMIT)
    if r.size < TELLING * count:
        return
    for column in range(count):
        least, second, level, some_awake = np.inf, np.inf, np.inf, False
        for i in range(column, r.size, count):
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
        if columns[column].untold > 0.0 and level < 0.0:
            shared = max(min(level + own, 0.0), -bound)
        elif columns[column].untold > 0.0:
            shared = max(min(level - own, 2.0 * bound - (level - own)), 0.0)
        for i in range(column, r.size, count):
            off = side * (r[i] - reference[i]) / (1.0 + reference[i]) if read[i] else np.inf
            stands_out = awake[i] and off > level + STANDS_OUT * own
            held_s[i] += dt_s if stands_out else -COUNTS_OFF * dt_s
            held_s[i] = max(min(held_s[i], 2.0 * HELD_S), 0.0)
            if read[i] and stands_out and (shared < 0.0 or (shared > 0.0 and held_s[i] > HELD_S)):
                without = (1.0 + r[i]) / (1.0 + side * shared) - 1.0
                if shared > 0.0:
                    without = max(min(last[i], max(r[i], without)), min(r[i], without))
                r[i] = watched[i] = without
