"""The way that a load goes to and fro within the noise, told by the variances of successive means of the readings.

Cells that answer a rise by more than a fall, or whose conductive chains motion breaks, are moved by each to and fro of
the load, though readings average it away. How fast they are moved follows from the way that the load goes: the sum of
all that it goes up and down.

Where means of successive blocks of readings differ by more than noise lets them, the load moves: half the mean square
of these differences is the Allan variance. Where it goes on in one direction, as in presses and in creep, the
differences of these differences are small (Hadamard variance). A load that trembles has both, up and down. Blocks of
several lengths are compared: short ones see all of the way, long ones tell a weak tremor from the noise. The shortest
ones that are clear are believed. From one block to the next the load may go to and fro as well: second differences tell
how much.

An edge of a load stands alone, while a tremor goes on. Whether a load trembles is therefore told by second differences
of which none counts for much more than those of noise, and which must go up as well as down. How far it goes is told by
mean squares that no single difference may raise by much.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...arrays import BoolArray, FloatArray
from ...compiled import Rows, loop
from ..estimation import RECENT

SCALES = 4
"""lengths of blocks: one, two, four and eight times the readings of which the noise meter takes the mean"""
MEMORY_S, SHARES = 1.5, (1.0 / 64.0, 1.0 / 8.0)
"""seconds that the mean squares remember, and limits of the share of a block in them"""
GROWS, AT_ONCE = 1.0, 0.25
"""of the mean square so far, and of the variance of noise: by no more does a single squared difference raise it"""
MOST = 8.0
"""times the variance of noise: no squared second difference counts for more where it is told whether a load trembles"""
SIDE = 3.0
"""times the lesser of both sides: their sum counts for no more"""
MAY, TOLD, DOES = 0.0, 1.8, 3.2
"""standard deviations of what noise alone makes: mean square of second differences to either side, beyond the mean of
what noise makes, from which a load may tremble; from which it seems to, and up to which it may do so unnoticed; and
from which it does. Any excess may be a tremor: from 1 on, a fifth of the errors on noisy dividers was not covered"""
OF_SIDES = 1.6
"""such a standard deviation, over the variance of noise and the root of the share of a block: of twice the mean square
to one side, to which half of all differences go"""
WAY, BEND = 0.84, 0.5
"""way of a load from one block to the next, over the square root of the mean square of differences and of this share of
that of second differences: within a tenth for sines of up to a third of a period per block, and for random motion"""
CLEAR = 3.0
"""standard deviations of a difference by noise, beside the largest motion that may go unnoticed: no more counts"""
HIDDEN = 1.2, 2.0, 5.0, 6.0
"""times the way that blocks of each length see: as long it may be, since it turns between them"""

NAMES = (
    "looks",
    *(
        f"{name}_{RECENT << scale}"
        for name in ("mean", "mean_before", "bends", "up", "bends_up", "down", "bends_down")
        for scale in range(SCALES)
    ),
)
"""names of the rows of the memory: looks; then one for each length of block. Mean of the last one, and of the one
before; mean squares of second differences, of differences upwards, of second differences upwards, and of both
downwards, over the variances that noise gives them"""
_BEFORE, _BENDS, _UP, _DOWN = 1 + SCALES, 1 + 2 * SCALES, 1 + 3 * SCALES, 1 + 5 * SCALES
ROWS = len(NAMES)
_MEANS, _BEFORES, _ALL_BENDS = slice(1, _BEFORE), slice(_BEFORE, _BENDS), slice(_BENDS, _UP)
_UPS, _DOWNS = slice(_UP, _DOWN), slice(_DOWN, ROWS)
SHARE, MAY_FROM, TOLD_FROM, DOES_FROM, HIDES = range(5)
"""rows of the numbers that depend on the time between frames"""
_LOOKS_IN_BLOCK = 2.0 ** np.arange(SCALES)[:, None]
_BEFORE_END = np.tile(_LOOKS_IN_BLOCK.astype(np.intp) - 1, (2, 1))
"""bits of the number of looks that are 0 at the end of a block"""
_NOISE = np.concatenate([2.0 / (RECENT * _LOOKS_IN_BLOCK), 6.0 / (RECENT * _LOOKS_IN_BLOCK)])
"""(2 * SCALES, 1) variances of first and second differences, over that of a reading"""
_PER_LOOK = WAY / _LOOKS_IN_BLOCK
_SEEN = np.stack([np.ones(SCALES), HIDDEN], axis=1)[:, :, None]
"""(SCALES, 2, 1) of what is told, and of what may be"""
_ZERO, _HALF, _ONE, _GROWS, _AT_ONCE, _MOST = (np.array(x) for x in (0.0, 0.5, 1.0, GROWS, AT_ONCE, MOST))
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


class Constants(NamedTuple):
    """Numbers that depend on the time between frames."""

    rows: FloatArray
    """(5, SCALES) for machine code: share of a block in the mean squares; mean squares of second differences to either
    side, twice and beyond those of noise, from which a load may tremble, seems to, and does; and :data:`HIDDEN`"""
    shares: FloatArray
    """(2 * SCALES, 1)"""
    limits: FloatArray
    """(SCALES, 2, 1)"""
    per_limit: FloatArray
    """(SCALES, 2, 1)"""
    least: float
    """mean square of second differences to either side up to which no load can tremble"""


def constants(dt_s: float) -> Constants:
    """The numbers for frames that follow each other after ``dt_s``."""
    share = np.clip(_LOOKS_IN_BLOCK[:, 0] * (RECENT * dt_s / MEMORY_S), *SHARES)
    by_noise = OF_SIDES * np.sqrt(share)
    rows = np.stack([share, MAY * by_noise, TOLD * by_noise, DOES * by_noise, HIDDEN])
    limits = rows[[TOLD_FROM, MAY_FROM]].T[:, :, None]
    per_limit = 1.0 / (rows[[DOES_FROM, TOLD_FROM]].T[:, :, None] - limits)
    least = 0.5 * (1.0 + float(rows[MAY_FROM].min()))
    return Constants(rows, np.tile(share, 2)[:, None], limits, per_limit, least)


def begin(rows: FloatArray) -> None:
    """Begin with cells whose reading has been none for ever; writes their ``rows`` (as :data:`NAMES`, m)."""
    rows[:_BENDS] = 0.0
    rows[_ALL_BENDS] = 1.0  # what noise makes
    rows[_UP:ROWS] = 0.5


def forget(rows: FloatArray, cells: BoolArray) -> None:
    """Forget how far the loads of some ``cells`` (m,) went; changes their ``rows``."""
    np.copyto(rows[_ALL_BENDS], _ONE, where=cells)
    np.copyto(rows[_UP:ROWS], _HALF, where=cells)


@loop
def forget_of(memory: Rows, first: int, i: int) -> None:
    """:func:`forget` of cell ``i``, whose rows of ``memory`` (rows, m) begin with row ``first``."""
    for row in range(first + _BENDS, first + _UP):
        memory[row, i] = 1.0
    for row in range(first + _UP, first + ROWS):
        memory[row, i] = 0.5


def look(
    rows: FloatArray, mean: FloatArray, noise: FloatArray, largest: float, numbers: Constants
) -> FloatArray | None:
    """Take the last :data:`..estimation._noise.RECENT` readings of m cells; changes their ``rows``.

    Args:
        rows: (as :data:`NAMES`, m) of the memory.
        mean: (m,) of the readings.
        noise: (m,) standard deviation of one of them.
        largest: r that a load may go without being noticed otherwise.
        numbers: :func:`constants`.

    Returns:
        (2, m) way in r that loads have gone to and fro since the last look: as far as it is told from noise, and by how
        much more it may be; None: of none.

    """
    rows[0] += _ONE
    ends = rows[0].astype(np.intp) & _BEFORE_END == 0
    means, befores, bends = rows[_MEANS], rows[_BEFORES], rows[_ALL_BENDS]
    blocks = np.empty_like(means)
    blocks[0] = mean
    for scale in range(1, SCALES):
        np.add(blocks[scale - 1], means[scale - 1], blocks[scale])
        blocks[scale] *= _HALF
    change = np.empty((2 * SCALES, mean.size))
    np.subtract(blocks, means, change[:SCALES])
    np.subtract(befores, means, change[SCALES:])
    change[SCALES:] += change[:SCALES]
    np.copyto(befores, means, where=ends[:SCALES])
    np.copyto(means, blocks, where=ends[:SCALES])
    variance = noise * noise * _NOISE
    size = np.abs(change)
    size /= np.sqrt(variance)
    np.minimum(size, largest / np.sqrt(variance) + CLEAR, out=size)
    size *= size
    shares = ends * numbers.shares
    bends += np.minimum((size[SCALES:] - bends) * shares[SCALES:], bends * _GROWS + _AT_ONCE)
    np.minimum(size[SCALES:], _MOST, out=size[SCALES:])
    ups, downs = rows[_UPS], rows[_DOWNS]
    for side, moved in ((ups, change > _ZERO), (downs, change < _ZERO)):
        beyond = size * moved
        beyond -= side
        beyond *= shares
        np.add(side, np.minimum(beyond, side * _GROWS + _AT_ONCE), out=side)
    lesser = np.minimum(ups, downs)
    both = lesser[SCALES:]
    if both.item(both.argmax()) <= numbers.least:
        return None
    sure = np.minimum(np.maximum((both[:, None] * 2.0 - _ONE - numbers.limits) * numbers.per_limit, _ZERO), _ONE)
    moved = np.maximum(np.minimum(ups[:SCALES] + downs[:SCALES], lesser[:SCALES] * SIDE) - _ONE, _ZERO)
    moved *= variance[:SCALES]
    bent = np.minimum(np.maximum(bends - _ONE, _ZERO) * variance[SCALES:], moved * 4.0)
    ways = (np.sqrt(moved + bent * BEND) * _PER_LOOK)[:, None] * _SEEN
    way: FloatArray = np.zeros(ways[0].shape)
    rest = np.ones(way.shape)
    for scale in range(SCALES):
        way += rest * sure[scale] * ways[scale]
        rest *= _ONE - sure[scale]
    np.maximum(way[1] - way[0], _ZERO, out=way[1])
    return way


@loop
def look_of(
    memory: Rows, first: int, i: int, mean: float, noise: float, largest: float, numbers: Rows
) -> tuple[float, float]:
    """:func:`look` of cell ``i``, whose rows of ``memory`` (rows, m) begin with row ``first``."""
    looks = memory[first, i] + 1.0
    memory[first, i] = looks
    variance = noise * noise * (1.0 / RECENT)
    block, length, ended = mean, 1.0, True
    told, most, rest, rest_of_most = 0.0, 0.0, 1.0, 1.0
    for scale in range(SCALES):
        row = first + 1 + scale
        bends, up, down = first + _BENDS + scale, first + _UP + scale, first + _DOWN + scale
        ended = ended and looks % length == 0.0
        if ended:
            last = memory[row, i]
            change = block - last
            bend = change - (last - memory[row + SCALES, i])
            memory[row + SCALES, i], memory[row, i] = last, block
            block = (block + last) * 0.5
            share, std = numbers[SHARE, scale], math.sqrt(variance * 6.0)
            size = min(abs(bend) / std, largest / std + CLEAR)
            count_of(memory, bends, i, size * size, share)
            size = min(size * size, MOST)
            count_of(memory, up + SCALES, i, size if bend > 0.0 else 0.0, share)
            count_of(memory, down + SCALES, i, size if bend < 0.0 else 0.0, share)
            std = math.sqrt(variance * 2.0)
            size = min(abs(change) / std, largest / std + CLEAR)
            size *= size
            count_of(memory, up, i, size if change > 0.0 else 0.0, share)
            count_of(memory, down, i, size if change < 0.0 else 0.0, share)
        clear = 2.0 * min(memory[up + SCALES, i], memory[down + SCALES, i]) - 1.0
        may_from, told_from = numbers[MAY_FROM, scale], numbers[TOLD_FROM, scale]
        if clear > may_from and rest > 0.0:
            moved = min(memory[up, i] + memory[down, i], min(memory[up, i], memory[down, i]) * SIDE)
            moved = max(moved - 1.0, 0.0) * (variance * 2.0)
            bent = max(memory[bends, i] - 1.0, 0.0) * (variance * 6.0)
            way = math.sqrt(moved + min(bent, moved * 4.0) * BEND) * (WAY / length)
            may = min((clear - may_from) * (1.0 / (told_from - may_from)), 1.0)
            most += rest_of_most * may * (way * numbers[HIDES, scale])
            rest_of_most *= 1.0 - may
            sure = min(max((clear - told_from) * (1.0 / (numbers[DOES_FROM, scale] - told_from)), 0.0), 1.0)
            told += rest * sure * way
            rest *= 1.0 - sure
        variance *= 0.5
        length *= 2.0
    return told, max(most - told, 0.0)


@loop
def count_of(memory: Rows, row: int, i: int, size: float, share: float) -> None:
    """Count a square of a ``size``, over its variance by noise, in a ``row`` of cell ``i``."""
    before = memory[row, i]
    memory[row, i] = before + min((size - before) * share, before * GROWS + AT_ONCE)
