"""The way that a load goes to and fro within the noise, told by the variances of successive means of the readings.

Cells that answer a rise by more than a fall, or whose conductive chains motion breaks, are moved by each to and fro of
the load, though readings average it away. How fast they are moved follows from the way that the load goes: the sum of
all that it goes up and down.

Mean squares of first and second differences of blocks of readings (:mod:`._variances`) tell the way. Blocks of several
lengths are compared: short ones see all of the way, long ones tell a weak tremor from the noise. The shortest ones that
are clear are believed. From one block to the next the load may go to and fro as well: second differences tell how much.
The shortest blocks hide least: what they and their noise leave room for bounds the way, however long the blocks are
that tell it. So a load that swings slowly and widely may not also tremble by several times as much.

An edge of a load stands alone, while a tremor goes on. Whether a load trembles is therefore told by second differences
that go up as well as down. How far it goes is told by mean squares.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...arrays import FloatArray
from ...compiled import Rows, SpacedRows, loop
from ._variances import DOWN, LOOKS_IN_BLOCK, READINGS, SCALES, SHARE, UP

MEMORY_S, LEAST_SHARE = 1.5, 1.0 / 64.0
"""seconds that the mean squares remember, and the least share of a block in them"""
SIDE = 3.0
"""times the lesser of both sides: their sum counts for no more"""
MAY = 2.0
"""such standard deviations beyond what is seen: as much the mean squares may be"""
OF_SIDES = 1.6
"""such a standard deviation by chance, over the variance of noise and the root of the share of a block: of twice the
mean square to one side, to which half of all differences go"""
ALONE = 2.0
"""standard deviations beyond :attr:`Caution.alone_from` from which own readings alone are believed"""
NOISE_KNOWN = 0.15
"""relative standard deviation of the variance of noise: steps of an ADC are not white, and go by the reading"""
WAY, BEND = 0.84, 0.5
"""way of a load from one block to the next, over the square root of the mean square of differences and of this share of
that of second differences: within a tenth for sines of up to a third of a period per block, and for random motion"""
FAST = 1.5
"""of that share: with it alone, second differences tell as much of motion of which they are largest, and less of slow
motion, which blocks do not hide"""
MOST_HIDDEN, FAST_HZ = 6.0, 4.0
"""times the way that long blocks see: as long it may be; and frequency of the tremors that this is reckoned for"""
HIDES_AT_FAST = 7.4
"""way of a sine over that which blocks of its period see. Those of a share of its period hide the square of that share:
the means see less of it, and it turns the more often between them"""

HIDES, CAUTION, ALONE_FROM = 2, 3, 4
"""rows of the numbers that depend on the time between frames, behind those of :mod:`._variances`; two of them are those
of :class:`Caution`"""
MAY_FROM, TOLD, DOES, OF_MOST = range(4)
"""places of these in that row"""
_PER_LOOK = WAY / LOOKS_IN_BLOCK
_ZERO, _HALF, _ONE, _TWO, _FOUR = (np.array(x) for x in (0.0, 0.5, 1.0, 2.0, 4.0))
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


class Caution(NamedTuple):
    """How sure the way must be, by what an error costs: one that fades slowly adds up for longer.

    The first three are standard deviations of what is known of the mean square of second differences to either side,
    beyond that of noise.
    """

    may_from: float = 0.0
    """from which a load may tremble"""
    told: float = 1.8
    """from which it seems to"""
    does: float = 3.2
    """from which it does"""
    of_most: float = 0.5
    """standard deviation over the most that a way may be beyond what is told, where the neighbours tell it"""
    most_share: float = 1.0 / 8.0
    """largest share of a block in the mean squares"""
    hidden: float = 1.2
    """times the way that short blocks see: as long it may be, since it turns between them"""
    alone_from: float = math.inf
    """such standard deviations from which own readings are believed whatever the neighbours tell: the load of a single
    cell may tremble, or move to and fro beside it. Infinity: never, where turns that pass unseen leave the same"""


class Constants(NamedTuple):
    """Numbers that depend on the time between frames."""

    caution: Caution
    rows: FloatArray
    """(5, SCALES) for machine code: share of a block in the mean squares, readings in it, how much of the way blocks
    may hide, the first four of the caution, and from when own readings are believed alone"""
    shares: FloatArray
    """(SCALES, 1)"""
    hides: FloatArray
    """(SCALES, 1)"""
    by_chance: FloatArray
    """(SCALES, 1) variance of the difference of mean squares from noise"""
    by_chance_and_noise: FloatArray
    """(SCALES, 1) the same where noise is known by its measure only"""
    noise: FloatArray
    """(2 * SCALES, 1) variances of first and second differences, over that of a reading"""
    std: FloatArray
    """(2 * SCALES, 1) their square roots"""


def constants(dt_s: float, readings: int, caution: Caution) -> Constants:
    """The numbers for frames that follow each other after ``dt_s``, with so many ``readings`` from look to look."""
    in_block = LOOKS_IN_BLOCK * readings
    block_s = in_block * dt_s
    share = np.clip(block_s / MEMORY_S, LEAST_SHARE, caution.most_share)
    hides = np.minimum(caution.hidden + HIDES_AT_FAST * (FAST_HZ * block_s) ** 2, MOST_HIDDEN)
    by_chance = share * OF_SIDES**2
    rows = np.array([share[:, 0], in_block[:, 0], hides[:, 0], caution[:SCALES], [caution.alone_from] * SCALES])
    noise = np.concatenate([2.0 / in_block, 6.0 / in_block])
    return Constants(caution, rows, share, hides, by_chance, by_chance + NOISE_KNOWN**2, noise, np.sqrt(noise))


def weights(own: FloatArray, beside: FloatArray, scatter: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Shares of mean squares of own differences and of mean products beside, by inverse variance.

    Args:
        own: (m,) reciprocal variance of the relative change of the load by noise, by own readings.
        beside: (m,) by those beside, see :func:`._together.look`.
        scatter: (SCALES, m) variance of what those beside tell, over that by noise.

    Returns:
        (SCALES, m) share of own ones, and (SCALES, m) share of those beside, which tells the unit of the own load.
    """
    # A mean product has half of the variance of a mean square.
    ratio = np.divide(own, beside, out=np.zeros_like(own), where=beside > _ZERO)
    share = ratio * scatter
    share *= share
    share = _ONE / (share * _HALF + _ONE)
    share *= ratio > _ZERO  # what bears nothing, or has no neighbour, is told by its own readings
    return _ONE - share, share * ratio


def told_by_own(squares: FloatArray, numbers: Constants) -> FloatArray:
    """(m,) 0 to 1: whether own mean ``squares`` (as :data:`._variances.SQUARES`, m) alone are believed."""
    lesser = np.minimum(squares[UP + SCALES : DOWN], squares[DOWN + SCALES :])
    lesser /= np.sqrt(numbers.by_chance_and_noise)
    alone: FloatArray = lesser.max(axis=0)
    alone *= _TWO
    alone -= numbers.caution.alone_from
    alone *= 1.0 / ALONE
    np.minimum(np.maximum(alone, _ZERO, out=alone), _ONE, out=alone)
    return alone


def tell(
    squares: FloatArray,
    own: FloatArray,
    beside: FloatArray,
    scatter: FloatArray,
    noise: FloatArray,
    numbers: Constants,
) -> FloatArray:
    """How far loads go to and fro.

    Args:
        squares: (as :data:`._variances.SQUARES`, m) mean squares, of own differences and of those beside in the shares
            below.
        own: (SCALES, m) share of own ones.
        beside: (SCALES, m) the same of those beside, which know the noise.
        scatter: (SCALES, m) variance of what those beside tell, over that by noise.
        noise: (m,) standard deviation of a reading.
        numbers: :func:`constants`.

    Returns:
        (2, m) way since the last look as far as it is told from noise; and way that may be, no less.
    """
    by_chance = numbers.by_chance
    by_chance_beside = beside * scatter
    by_chance_beside *= by_chance_beside * (by_chance * _HALF)
    sure = numbers.by_chance_and_noise * (own * own)
    sure += by_chance_beside
    np.sqrt(sure, out=sure)
    ups, downs = squares[UP:DOWN], squares[DOWN:]
    lesser = np.minimum(ups, downs)
    clear = lesser[SCALES:] * _TWO / sure
    sides = lesser[:SCALES] * SIDE
    sides += 0.5 * SIDE - 1.0
    np.minimum(ups[:SCALES] + downs[:SCALES], sides, out=sides)
    # Beyond what is seen there may be: none, what neighbours leave room for, what chance and noise leave room for.
    beyond = np.zeros((3, *clear.shape))
    np.sqrt(by_chance_beside, out=beyond[1])
    beyond[2] = sure
    beyond *= MAY
    moved, bends = np.maximum(sides, _ZERO) + beyond, np.maximum(squares[:UP], _ZERO) + beyond
    seen, may = _ways(moved, bends, noise * noise * numbers.noise, numbers.hides)
    ways = np.stack([seen[0], may[0]])
    all_beside, most_by_shortest = may[1], may[2, 0]
    least = np.expand_dims(all_beside.argmin(axis=0), 0)
    (most_beside,) = np.take_along_axis(all_beside, least, axis=0)
    (of_own,) = np.take_along_axis(own, least, axis=0)
    gates = np.empty_like(ways)
    may_from, seems, does, of_most = numbers.caution[:SCALES]
    np.multiply(clear - seems, 1.0 / (does - seems), out=gates[0])
    np.multiply(clear - may_from, 1.0 / (seems - may_from), out=gates[1])
    np.minimum(np.maximum(gates, _ZERO, out=gates), _ONE, out=gates)
    rest = np.ones_like(gates)
    np.cumprod(_ONE - gates[:, :-1], axis=1, out=rest[:, 1:])
    rest *= gates
    rest *= ways
    found: FloatArray = rest.sum(axis=1)
    told, most = found
    np.minimum(most, most_by_shortest, out=most)
    most -= told
    np.maximum(most, _ZERO, out=most)
    most *= of_own
    most_beside -= told
    np.maximum(most_beside, _ZERO, out=most_beside)
    most_beside *= (_ONE - of_own) * of_most
    most += most_beside
    most += told
    return found


def _ways(
    moved: FloatArray, bends: FloatArray, variance: FloatArray, hides: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Ways for mean squares of first and second differences, over their ``variance`` by noise; changes both.

    Returns:
        (..., SCALES, m) way per look; and the longest that it may be: of the part of the motion that turns within some
        blocks, blocks see only one in ``hides`` (SCALES, 1).
    """
    moved *= variance[:SCALES]
    bends *= variance[SCALES:]
    np.minimum(bends, moved * _FOUR, out=bends)
    bends *= BEND
    moved += bends
    np.sqrt(moved, out=moved)
    moved *= _PER_LOOK
    bends *= FAST
    np.sqrt(bends, out=bends)
    bends *= _PER_LOOK
    bends *= hides - _ONE
    bends += moved
    return moved, bends


# -- machine code ----------------------------------------------------------------------------------------------------


@loop
def weights_of(own: float, beside: float, scatter: float) -> tuple[float, float]:
    """:func:`weights` of one cell, for blocks of one length."""
    if not min(own, beside) > 0.0:
        return 1.0, 0.0
    ratio = own / beside
    share = ratio * scatter
    share = 1.0 / (share * share * 0.5 + 1.0)
    return 1.0 - share, share * ratio


@loop
def told_by_own_of(memory: SpacedRows, squares: int, i: int, numbers: Rows) -> float:
    """:func:`told_by_own` of cell ``i``, whose mean squares begin with row ``squares`` of ``memory``."""
    alone = 0.0
    for scale in range(SCALES):
        row = squares + scale + SCALES
        sure = math.sqrt(numbers[SHARE, scale] * OF_SIDES**2 + NOISE_KNOWN**2)
        alone = max(alone, min(memory[row + UP, i], memory[row + DOWN, i]) / sure)
    return float(min(max((alone * 2.0 - numbers[ALONE_FROM, 0]) * (1.0 / ALONE), 0.0), 1.0))


@loop
def tell_of(
    memory: SpacedRows,
    squares: int,
    squares_beside: int,
    apart: int,
    i: int,
    own_knows: float,
    beside_knows: float,
    noise: float,
    numbers: Rows,
) -> tuple[float, float]:
    """:func:`tell` of cell ``i``, for reciprocal variances as in :func:`weights`.

    Mean squares begin with rows ``squares`` and ``squares_beside`` of ``memory``, those of :mod:`._together` with
    ``apart``.
    """
    told, most, most_by_shortest, most_beside, of_own = 0.0, 0.0, math.inf, math.inf, 1.0
    alone = told_by_own_of(memory, squares, i, numbers)
    may_from, seems, surely = numbers[CAUTION, MAY_FROM], numbers[CAUTION, TOLD], numbers[CAUTION, DOES]
    rest, rest_of_most, length = 1.0, 1.0, 1.0
    for scale in range(SCALES):
        row, other, scatter = squares + scale, squares_beside + scale, max(memory[apart + scale, i] + 1.0, 1.0)
        own, beside = weights_of(own_knows, beside_knows, scatter)
        own, beside = max(own, alone), beside * (1.0 - alone)
        by_chance = numbers[SHARE, scale] * OF_SIDES**2
        by_chance_beside = beside * scatter
        by_chance_beside *= by_chance_beside * (by_chance * 0.5)
        sure = math.sqrt((by_chance + NOISE_KNOWN**2) * (own * own) + by_chance_beside)
        bends = max(own * memory[row, i] + beside * memory[other, i], 0.0)
        up = own * memory[row + UP, i] + beside * memory[other + UP, i]
        down = own * memory[row + DOWN, i] + beside * memory[other + DOWN, i]
        row, other = row + SCALES, other + SCALES
        bends_up = own * memory[row + UP, i] + beside * memory[other + UP, i]
        bends_down = own * memory[row + DOWN, i] + beside * memory[other + DOWN, i]
        clear = min(bends_up, bends_down) * 2.0 / sure
        moved = max(min(up + down, min(up, down) * SIDE + (0.5 * SIDE - 1.0)), 0.0)
        per_reading = numbers[READINGS, scale]
        of_change, of_bend = noise * noise * (2.0 / per_reading), noise * noise * (6.0 / per_reading)
        beyond, hides = math.sqrt(by_chance_beside) * MAY, numbers[HIDES, scale]
        _, may_beside = ways_of(moved + beyond, bends + beyond, of_change, of_bend, length, hides)
        if may_beside < most_beside:
            most_beside, of_own = may_beside, own
        if scale == 0:
            beyond = sure * MAY
            _, most_by_shortest = ways_of(moved + beyond, bends + beyond, of_change, of_bend, length, hides)
        if clear > 0.0 and rest > 0.0:
            way, longest = ways_of(moved, bends, of_change, of_bend, length, hides)
            may = min(max((clear - may_from) * (1.0 / (seems - may_from)), 0.0), 1.0)
            does = min(max((clear - seems) * (1.0 / (surely - seems)), 0.0), 1.0)
            told += rest * does * way
            rest *= 1.0 - does
            most += rest_of_most * may * longest
            rest_of_most *= 1.0 - may
        length *= 2.0
    untold = max(min(most, most_by_shortest) - told, 0.0) * of_own
    untold += max(most_beside - told, 0.0) * ((1.0 - of_own) * numbers[CAUTION, OF_MOST])
    return told, told + untold


@loop
def ways_of(
    moved: float, bends: float, of_change: float, of_bend: float, length: float, hides: float
) -> tuple[float, float]:
    """:func:`_ways` of one cell, for blocks of ``length`` looks; ``of_change`` and ``of_bend``: variances by noise."""
    moved *= of_change
    bends = min(bends * of_bend, moved * 4.0)
    seen = math.sqrt(moved + bends * BEND) * (WAY / length)
    return seen, seen + math.sqrt(bends * (BEND * FAST)) * (WAY / length) * (hides - 1.0)
