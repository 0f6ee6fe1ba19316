"""Path length of a load that goes to and fro within the noise, estimated from Allan and Hadamard variances of readings.

Two kinds of cell are changed by each to and fro of the load, although readings average the motion away: cells that
answer a rise by more than a fall, and cells whose conductive chains motion breaks. The change follows from the path
length of the load (the "way"): the sum of all that it goes up and down.

The way is estimated from mean squares of first and second differences of blocks of readings (:mod:`._variances`).
Blocks of several lengths are compared: short blocks see all of the way, long ones can tell a weak tremor from noise.
The shortest blocks that are clear are believed. Within a block the load may go to and fro as well; second differences
show how much. The shortest blocks hide least. The way that they and their noise leave room for is an upper bound,
whichever blocks tell the way: a load that swings slowly and widely cannot also tremble by several times as much.

An edge of a load is a single event, while a tremor goes on. Whether a load trembles is therefore decided by second
differences that go up as well as down; how far it goes, by the mean squares.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...common.arrays import FloatArray
from ...common.compiled import Rows, SpacedRows, loop
from ._variances import DOWN, LOOKS_IN_BLOCK, READINGS, SCALES, SHARE, UP

MEMORY_S, LEAST_SHARE = 1.5, 1.0 / 64.0
"""seconds over which the mean squares average, and the least share of a block in them"""
SIDE = 3.0
"""limit of the sum of the mean squares up and down, over the smaller of the two"""
MAY = 2.0
"""standard deviations by which the true mean squares may exceed those seen"""
OF_SIDES = 1.6
"""standard deviation by chance of twice the mean square to one side (half of all differences go to one side), over the
variance of noise and the square root of the share of a block"""
ALONE = 2.0
"""standard deviations beyond :attr:`Caution.alone_from` over which the weight of own readings grows to 1"""
NOISE_KNOWN = 0.15
"""relative standard deviation of the variance of noise, since ADC steps are not white noise and depend on the
reading"""
WAY, BEND = 0.84, 0.5
"""way of a load from one block to the next = WAY sqrt(D1 + BEND D2), with the mean squares D1 and D2 of first and
second differences. This holds within a tenth for sines of up to a third of a period per block, and for random motion"""
FAST = 1.5
"""times :data:`BEND`: WAY sqrt(FAST BEND D2), from second differences alone, is as long for motion with the largest
second differences, and shorter for slow motion, which blocks do not hide"""
MOST_HIDDEN, FAST_HZ = 6.0, 4.0
"""largest ratio of the way that may be to the way that long blocks see; and frequency in Hz of the tremors that this
ratio is meant for"""
HIDES_AT_FAST = 7.4
"""way of a sine over that which blocks of its period see. For blocks of a share x of its period the excess is x^2 times
that: the means see less of the sine, and it turns more often between them"""

HIDES, CAUTION, ALONE_FROM = 2, 3, 4
"""rows of the numbers that depend on the time between frames, behind those of :mod:`._variances`: ratio of hidden way,
the first four of :class:`Caution`, and its ``alone_from``"""
MAY_FROM, TOLD, DOES, OF_MOST = range(4)
"""places in the row :data:`CAUTION`"""
_PER_LOOK = WAY / LOOKS_IN_BLOCK
_ZERO, _HALF, _ONE, _TWO, _FOUR = (np.array(x) for x in (0.0, 0.5, 1.0, 2.0, 4.0))
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


class Caution(NamedTuple):
    """How sure the way must be, by the cost of an error: an error that fades slowly adds up for longer.

    The first three are thresholds of the statistic: the mean square of second differences (to the side where it is
    smaller) beyond that of noise, in standard deviations of what is known of it.
    """

    may_from: float = 0.0
    """above this a load may tremble"""
    told: float = 1.8
    """above this it seems to tremble: the way begins to be told"""
    does: float = 3.2
    """above this it trembles for sure"""
    of_most: float = 0.5
    """standard deviation of the untold way over the most that it may be, where the neighbours tell it"""
    most_share: float = 1.0 / 8.0
    """largest share of a block in the mean squares"""
    hidden: float = 1.2
    """ratio of the way that may be to the way that short blocks see, since the load turns between them"""
    alone_from: float = math.inf
    """above this statistic own readings are believed whatever the neighbours tell: the load of a single cell may
    tremble, or move to and fro beside it. Infinity: never, where turns that pass unseen leave the same error"""


class Constants(NamedTuple):
    """Numbers that depend on the time between frames."""

    caution: Caution
    rows: FloatArray
    """(5, SCALES) for machine code: share of a block in the mean squares; readings in a block; largest ratio of the way
    to that which blocks see; the first four of the caution; and ``alone_from``"""
    shares: FloatArray
    """(SCALES, 1)"""
    hides: FloatArray
    """(SCALES, 1)"""
    by_chance: FloatArray
    """(SCALES, 1) variance by chance of the mean squares, noise being known"""
    by_chance_and_noise: FloatArray
    """(SCALES, 1) the same, with the uncertainty of the measured noise"""
    noise: FloatArray
    """(2 * SCALES, 1) variances of first and second differences, over that of a reading"""
    std: FloatArray
    """(2 * SCALES, 1) their square roots"""


def constants(dt_s: float, readings: int, caution: Caution) -> Constants:
    """The numbers for frames ``dt_s`` apart, with so many ``readings`` from look to look."""
    in_block = LOOKS_IN_BLOCK * readings
    block_s = in_block * dt_s
    share = np.clip(block_s / MEMORY_S, LEAST_SHARE, caution.most_share)
    hides = np.minimum(caution.hidden + HIDES_AT_FAST * (FAST_HZ * block_s) ** 2, MOST_HIDDEN)
    by_chance = share * OF_SIDES**2
    rows = np.array([share[:, 0], in_block[:, 0], hides[:, 0], caution[:SCALES], [caution.alone_from] * SCALES])
    noise = np.concatenate([2.0 / in_block, 6.0 / in_block])
    return Constants(caution, rows, share, hides, by_chance, by_chance + NOISE_KNOWN**2, noise, np.sqrt(noise))


def weights(own: FloatArray, beside: FloatArray, scatter: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weights of own mean squares and of the mean products of neighbours, by inverse variance.

    Args:
        own: (m,) reciprocal variance by noise of the relative change of the load, from own readings.
        beside: (m,) the same from neighbours, see :func:`._together.known`.
        scatter: (SCALES, m) variance of the neighbours' estimate, over that by noise.

    Returns:
        (SCALES, m) weight of own mean squares; and (SCALES, m) weight of the products, times their conversion to the
        unit of own mean squares.
    """
    # A mean product has half of the variance of a mean square.
    ratio = np.divide(own, beside, out=np.zeros_like(own), where=beside > _ZERO)
    share = ratio * scatter
    share *= share
    share = _ONE / (share * _HALF + _ONE)
    share *= ratio > _ZERO  # without load or neighbours, own readings only
    return _ONE - share, share * ratio


def told_by_own(squares: FloatArray, numbers: Constants) -> FloatArray:
    """(m,) weight, 0 to 1, with which own mean ``squares`` (as :data:`._variances.SQUARES`, m) alone are believed."""
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
    """Estimate the way of loads.

    Args:
        squares: (as :data:`._variances.SQUARES`, m) mean squares and products, weighted as below.
        own: (SCALES, m) weight of own mean squares.
        beside: (SCALES, m) weight of the products of neighbours, whose mean by noise is known to be none.
        scatter: (SCALES, m) variance of the neighbours' estimate, over that by noise.
        noise: (m,) standard deviation of a reading.
        numbers: :func:`constants`.

    Returns:
        (2, m) way since the last look that is told from noise; and the way that may be, no less.
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
    # Mean squares beyond those seen: none; what neighbours leave room for; what chance and noise leave room for.
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
        (..., SCALES, m) way per look; and the longest that it may be: of the part of the motion that turns within a few
        blocks, blocks see only the share 1/``hides`` (SCALES, 1).
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
