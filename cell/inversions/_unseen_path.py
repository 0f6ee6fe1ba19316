"""Loads that tremble: the way to and fro of a load that readings average away, and the chains that it breaks.

Motion breaks conductive chains in proportion to the way that a load goes, up or down. An inverse counts the way of
smoothed readings beyond the noise. A load that trembles by about the noise goes farther than that, as under fingers and
grippers. The chains that break meanwhile then seem to be a load that grows.

What tells of such a way is that means of readings which follow each other differ, both up and down, by more than noise
lets them. Means over several lengths of time are compared, since nobody knows how fast a load trembles: short ones see
more of the way of a fast tremor, long ones tell a weak one from the noise. A load that rises or falls, and creep, move
the means to one side only. What the way may break beyond the chains that have been counted goes into the deviation. How
fast the load turns is not known well enough to take it for broken.
"""

from __future__ import annotations

import numpy as np

from ...arrays import FloatArray
from ..estimation import RECENT

LENGTHS = (1, 2, 4)
"""of the means that are compared, in looks of :data:`..estimation._noise.RECENT` readings each"""
SHARE = 1.0 / 16.0
"""of a look in the mean squares"""
MOST, AT_ONCE = 4.0, 10.0
"""times the mean square so far, and times the variance of noise: no squared difference counts for more than their sum.
An edge of a load stands alone, while a tremor goes on"""
MAY, DOES = 0.8, 1.4
"""times the variance of noise: mean square to either side beyond that of noise from which a load may tremble, and from
which it does"""
WAY = 1.35
"""of the root mean square of a difference: the way that the load may have gone meanwhile. The mean size of differences
is 0.8 (Gaussian motion) to 0.9 (a sine) of it, and a tremor turns between two means, too"""

LOOKS = 2 * LENGTHS[-1]
NAMES = (
    *(f"mean_{age}" for age in range(LOOKS)),
    *(f"up_{length}" for length in LENGTHS),
    *(f"down_{length}" for length in LENGTHS),
    *("broken_before", "breaks"),
)
"""names of the rows of the memory: means of the last looks, the newest first; mean squares of the differences upwards
and downwards, over the variance that noise gives them; r of the broken chains at the last look; and r that the inverse
says to break from one look to the next, in the mean"""
UP, DOWN, BROKEN_BEFORE, BREAKS = LOOKS, LOOKS + len(LENGTHS), LOOKS + 2 * len(LENGTHS), LOOKS + 2 * len(LENGTHS) + 1
_COMPARED = np.zeros((len(LENGTHS), LOOKS))
for _row, _length in zip(_COMPARED, LENGTHS, strict=True):
    _row[:_length], _row[_length : 2 * _length] = 1.0 / _length, -1.0 / _length
_LENGTHS = np.array(LENGTHS, dtype=np.float64)[:, None]
_PER_NOISE = 2.0 / (RECENT * _LENGTHS)
"""(lengths, 1) variance of the difference of two means, over that of a reading"""


def begin(rows: FloatArray, r: FloatArray) -> None:
    """Begin with cells whose reading has been ``r`` (m,) for ever; writes their ``rows`` (as :data:`NAMES`, m)."""
    rows[:LOOKS] = r
    rows[UP:BROKEN_BEFORE] = 0.5  # what noise makes


def look(
    rows: FloatArray, mean: FloatArray, noise: FloatArray, broken: FloatArray, kept: float
) -> tuple[FloatArray, FloatArray]:
    """Take the last :data:`..estimation._noise.RECENT` readings of m cells; changes their ``rows``.

    Args:
        rows: (as :data:`NAMES`, m) of the memory.
        mean: (m,) of the readings.
        noise: (m,) standard deviation of one of them.
        broken: (m,) r of the broken chains, as the inverse says.
        kept: share of these that have not healed since the last look.

    Returns:
        (m,) r by which readings have gone to and fro since the last look, as far as noise lets it be told; and (m,) r
        of the chains that the inverse has counted for that.

    """
    rows[1:LOOKS] = rows[: LOOKS - 1]
    rows[0] = mean
    change = _COMPARED @ rows[:LOOKS]
    variance = noise * noise * _PER_NOISE
    size = change * change / variance
    ups, downs = rows[UP:DOWN], rows[DOWN:BROKEN_BEFORE]
    for side, moved in ((ups, change > 0.0), (downs, change < 0.0)):
        beyond = np.minimum(np.where(moved, size, 0.0), side * MOST + AT_ONCE)
        np.add(side, (beyond - side) * SHARE, out=side)
    breaks = broken - rows[BROKEN_BEFORE] * kept
    rows[BREAKS] += (breaks - rows[BREAKS]) * SHARE
    rows[BROKEN_BEFORE] = broken
    excess = np.maximum(2.0 * np.minimum(ups, downs) - 1.0, 0.0)
    told = np.clip((excess - MAY) / (DOES - MAY), 0.0, 1.0)
    way = (told * np.sqrt(excess * variance) / _LENGTHS).max(axis=0) * WAY
    return way, np.maximum(rows[BREAKS], 0.0)
