"""The way that a load goes to and fro within the noise, told by the variances of successive means of the readings.

Cells that answer a rise by more than a fall, or whose conductive chains motion breaks, are moved by each to and fro of
the load, though readings average it away. How fast they are moved follows from the way that the load goes: the sum of
all that it goes up and down.

Where means of successive blocks of readings differ by more than noise lets them, the load moves: half the mean square
of these differences is the Allan variance. Where it goes on in one direction, as in presses and in creep, the
differences of these differences are small (Hadamard variance). A load that trembles has both, up and down. Blocks of
several lengths are compared: short ones see all of the way, long ones tell a weak tremor from the noise. The shortest
ones that are clear are believed. From one block to the next the load may go to and fro as well: second differences tell
how much. The shortest blocks hide least: what they and their noise leave room for bounds the way, however long the
blocks are that tell it. So a load that swings slowly and widely may not also tremble by several times as much.

An edge of a load stands alone, while a tremor goes on. Whether a load trembles is therefore told by second differences
of which none counts for much more than those of noise, and which must go up as well as down. How far it goes is told by
mean squares that no single difference may raise by much.

What a series of means tells are products of its differences. Two series that tremble together, with independent noise,
tell the same by products of one's differences with the other's. Noise makes none of that in the mean
(:mod:`._together`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...arrays import BoolArray, FloatArray
from ...compiled import Rows, SpacedRows, loop

SCALES = 4
"""lengths of blocks: one, two, four and eight times the readings from one look to the next"""
MEMORY_S, LEAST_SHARE = 1.5, 1.0 / 64.0
"""seconds that the mean squares remember, and the least share of a block in them"""
GROWS, AT_ONCE = 1.0, 0.25
"""of the mean square so far, and of the variance of noise: by no more does a single squared difference raise it"""
MOST = 8.0
"""times the variance of noise: no squared second difference counts for more where it is told whether a load trembles"""
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
CLEAR = 3.0
"""standard deviations of a difference by noise, beside the largest motion that may go unnoticed: no more counts"""
MOST_HIDDEN, FAST_HZ = 6.0, 4.0
"""times the way that long blocks see: as long it may be; and frequency of the tremors that this is reckoned for"""
HIDES_AT_FAST = 7.4
"""way of a sine over that which blocks of its period see. Those of a share of its period hide the square of that share:
the means see less of it, and it turns the more often between them"""

SERIES = tuple(f"{name}_{1 << scale}" for name in ("mean", "mean_before") for scale in range(SCALES))
"""names of the rows of a series: for each length of block in looks, mean of the last one, and of the one before"""
SQUARES = tuple(
    f"{name}_{1 << scale}" for name in ("bends", "up", "bends_up", "down", "bends_down") for scale in range(SCALES)
)
"""names of the rows of mean squares, over the variances by noise and beyond what noise makes: of second differences, of
differences upwards, of second differences upwards, and of both downwards"""
ALL_SERIES, ALL_SQUARES = len(SERIES), len(SQUARES)
_BENDS, _UP, _DOWN = 0, SCALES, 3 * SCALES
SHARE, HIDES, CAUTION, ALONE_FROM, READINGS = range(5)
"""rows of the numbers that depend on the time between frames; two of them are those of :class:`Caution`"""
MAY_FROM, TOLD, DOES, OF_MOST = range(4)
"""places of these in that row"""
_LOOKS_IN_BLOCK = 2.0 ** np.arange(SCALES)[:, None]
_BEFORE_END = _LOOKS_IN_BLOCK.astype(np.intp) - 1
"""bits of the number of looks that are 0 at the end of a block"""
_PER_LOOK = WAY / _LOOKS_IN_BLOCK
_ROOM = np.repeat([1.0, 0.5], (SCALES, 4 * SCALES))[:, None] * GROWS + AT_ONCE
"""(rows of SQUARES, 1) by which one difference may raise a mean square that is that of noise"""
_ZERO, _HALF, _ONE, _TWO, _FOUR, _CLEAR, _MOST, _LEAST, _AT_ONCE = (
    np.array(x) for x in (0.0, 0.5, 1.0, 2.0, 4.0, CLEAR, MOST, -MOST, AT_ONCE)
)
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
    """(5, SCALES) for machine code: share of a block in the mean squares, how much of the way blocks may hide, the
    first four of the caution, from when own readings are believed alone, and readings in a block"""
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
    in_block = _LOOKS_IN_BLOCK * readings
    block_s = in_block * dt_s
    share = np.clip(block_s / MEMORY_S, LEAST_SHARE, caution.most_share)
    hides = np.minimum(caution.hidden + HIDES_AT_FAST * (FAST_HZ * block_s) ** 2, MOST_HIDDEN)
    by_chance = share * OF_SIDES**2
    rows = np.array([share[:, 0], hides[:, 0], caution[:SCALES], [caution.alone_from] * SCALES, in_block[:, 0]])
    noise = np.concatenate([2.0 / in_block, 6.0 / in_block])
    return Constants(caution, rows, share, hides, by_chance, by_chance + NOISE_KNOWN**2, noise, np.sqrt(noise))


def ends_of_blocks(looks: FloatArray) -> BoolArray:
    """(SCALES, m) where blocks end after so many ``looks`` (m,)."""
    ends: BoolArray = looks.astype(np.intp) & _BEFORE_END == 0
    return ends


def differences(
    series: FloatArray,
    newest: FloatArray,
    noise: FloatArray,
    largest: FloatArray,
    ends: BoolArray,
    numbers: Constants,
) -> FloatArray:
    """Take the ``newest`` means (k, m) into k ``series`` (k, as :data:`SERIES`, m), changed.

    Args:
        series: of the memory.
        newest: means of the readings since the last look.
        noise: (k, m) standard deviation of one of them.
        largest: (k, m) way that a load may go without being noticed otherwise.
        ends: :func:`ends_of_blocks`.
        numbers: :func:`constants`.

    Returns:
        (k, 2 * SCALES, m) first differences of blocks of each length, and second ones, over their deviation by noise.
    """
    means, befores = series[:, :SCALES], series[:, SCALES:]
    blocks = np.empty_like(means)
    blocks[:, 0] = newest
    for scale in range(1, SCALES):
        block = blocks[:, scale]
        np.add(blocks[:, scale - 1], means[:, scale - 1], block)
        block *= _HALF
    change = np.empty_like(series)
    np.subtract(blocks, means, change[:, :SCALES])
    np.subtract(befores, means, change[:, SCALES:])
    change[:, SCALES:] += change[:, :SCALES]
    np.copyto(befores, means, where=ends)
    np.copyto(means, blocks, where=ends)
    std = noise[:, None] * numbers.std
    change /= std
    limit = np.divide(largest[:, None], std, std)
    limit += _CLEAR
    np.minimum(change, limit, out=change)
    np.negative(limit, out=limit)
    np.maximum(change, limit, out=change)
    return change


def take(
    squares: FloatArray,
    product: FloatArray,
    by_noise: FloatArray,
    side: FloatArray,
    shares: FloatArray,
    forgotten: BoolArray,
) -> None:
    """Take products of differences into j sets of mean ``squares`` (j, as :data:`SQUARES`, m), changed.

    Args:
        squares: of the memory.
        product: (j, 2 * SCALES, m) of first and second differences.
        by_noise: (j, 1, 1) what noise makes of that in the mean.
        side: (j, 2 * SCALES, m) positive where they go up, negative where down.
        shares: (SCALES, m) of the products.
        forgotten: (m,) cells whose mean squares begin anew.
    """
    if np.count_nonzero(forgotten):
        np.copyto(squares, _ZERO, where=forgotten)
    beyond = np.empty_like(squares)
    bends = product[:, SCALES:]
    np.subtract(bends, by_noise, beyond[:, :_UP])
    np.minimum(bends, _MOST, out=bends)
    np.maximum(bends, _LEAST, out=bends)
    np.multiply(product, side > _ZERO, beyond[:, _UP:_DOWN])
    np.multiply(product, side < _ZERO, beyond[:, _DOWN:])
    beyond[:, _UP:] -= by_noise * _HALF
    beyond -= squares
    by_scale = beyond.reshape(len(squares), -1, *shares.shape)
    by_scale *= shares
    room = squares * GROWS
    room += _ROOM
    np.maximum(room, _AT_ONCE, out=room)
    np.minimum(beyond, room, out=beyond)
    squares += beyond


def count(squares: FloatArray, product: FloatArray, shares: FloatArray) -> None:
    """Take a ``product`` of differences (SCALES, m), changed, of which noise makes 1 in the mean, into mean squares.

    Args:
        squares: (SCALES, m) of the memory, beyond what noise makes, changed.
        product: to take.
        shares: (SCALES, m) of it.
    """
    product -= _ONE
    product -= squares
    product *= shares
    room = squares * GROWS
    room += _ROOM[0]
    np.minimum(product, room, out=product)
    squares += product


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
    """(m,) 0 to 1: whether own mean ``squares`` (as :data:`SQUARES`, m) alone are believed."""
    lesser = np.minimum(squares[_UP + SCALES : _DOWN], squares[_DOWN + SCALES :])
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
        squares: (as :data:`SQUARES`, m) mean squares, of own differences and of those beside in the shares below.
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
    ups, downs = squares[_UP:_DOWN], squares[_DOWN:]
    lesser = np.minimum(ups, downs)
    clear = lesser[SCALES:] * _TWO / sure
    # Of what is seen, of the most that neighbours let it be, and of the most that chance lets it be.
    moved, bends = np.empty((3, *clear.shape)), np.empty((3, *clear.shape))
    sides = lesser[:SCALES] * SIDE
    sides += 0.5 * SIDE - 1.0
    np.minimum(ups[:SCALES] + downs[:SCALES], sides, out=sides)
    np.maximum(sides, _ZERO, out=moved[0])
    np.maximum(squares[:_UP], _ZERO, out=bends[0])
    beyond = np.sqrt(by_chance_beside)
    beyond *= MAY
    np.add(moved[0], beyond, out=moved[1])
    np.add(bends[0], beyond, out=bends[1])
    sure *= MAY
    np.add(moved[0], sure, out=moved[2])
    np.add(bends[0], sure, out=bends[2])
    variance = noise * noise * numbers.noise
    ways, hidden = _ways(moved, bends, variance)
    hidden *= numbers.hides - _ONE
    may = ways + hidden
    all_beside = may[1]
    least = np.expand_dims(all_beside.argmin(axis=0), 0)
    (most_beside,) = np.take_along_axis(all_beside, least, axis=0)
    (of_own,) = np.take_along_axis(own, least, axis=0)
    most_by_shortest = may[2, 0]
    ways = ways[:2]
    ways[1] = may[0]
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


def _ways(moved: FloatArray, bends: FloatArray, variance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ways for mean squares of first and second differences, over their ``variance`` by noise; changes both.

    Returns:
        (..., SCALES, m) way per look; and that of the part of the motion that turns within some blocks, of which
        blocks may hide more.
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
    return moved, bends


# -- machine code ----------------------------------------------------------------------------------------------------


@loop
def look_of(
    memory: SpacedRows,
    series: int,
    squares: int,
    i: int,
    looks: float,
    mean: float,
    noise: float,
    largest: float,
    numbers: Rows,
) -> None:
    """Take the ``mean`` of the last readings of cell ``i``, whose series and mean squares begin with these rows."""
    block, length = mean, 1
    for scale in range(SCALES):
        if int(looks) & (length - 1):
            break
        change, bend, block = differences_of(memory, series + scale, i, block)
        per_reading = numbers[READINGS, scale]
        change = scaled(change, noise * math.sqrt(2.0 / per_reading), largest)
        bend = scaled(bend, noise * math.sqrt(6.0 / per_reading), largest)
        share = numbers[SHARE, scale]
        take_of(memory, squares + scale, i, change * change, change, bend * bend, bend, 1.0, share)
        length *= 2


@loop
def forget_of(memory: SpacedRows, squares: int, i: int) -> None:
    """Let the mean squares of cell ``i``, which begin with row ``squares`` of ``memory``, begin anew."""
    for row in range(squares, squares + ALL_SQUARES):
        memory[row, i] = 0.0


@loop
def scaled(change: float, std: float, largest: float) -> float:
    """A difference over its standard deviation by noise, within limits."""
    limit = largest / std + CLEAR
    return min(max(change / std, -limit), limit)


@loop
def differences_of(memory: SpacedRows, row: int, i: int, block: float) -> tuple[float, float, float]:
    """:func:`differences` of cell ``i`` for blocks of one length, whose last mean is in ``row``, and the next block."""
    last = memory[row, i]
    change = block - last
    bend = memory[row + SCALES, i] - last + change
    memory[row + SCALES, i], memory[row, i] = last, block
    return change, bend, (block + last) * 0.5


@loop
def take_of(
    memory: SpacedRows,
    row: int,
    i: int,
    moved: float,
    moved_side: float,
    bent: float,
    bent_side: float,
    by_noise: float,
    share: float,
) -> None:
    """:func:`take` of cell ``i`` for blocks of one length, whose first mean square is in ``row``."""
    count_of(memory, row + _BENDS, i, bent - by_noise, 1.0, share)
    bent, by_noise = min(max(bent, -MOST), MOST), 0.5 * by_noise
    count_of(memory, row + _UP, i, (moved if moved_side > 0.0 else 0.0) - by_noise, 0.5, share)
    count_of(memory, row + _UP + SCALES, i, (bent if bent_side > 0.0 else 0.0) - by_noise, 0.5, share)
    count_of(memory, row + _DOWN, i, (moved if moved_side < 0.0 else 0.0) - by_noise, 0.5, share)
    count_of(memory, row + _DOWN + SCALES, i, (bent if bent_side < 0.0 else 0.0) - by_noise, 0.5, share)


@loop
def count_of(memory: SpacedRows, row: int, i: int, product: float, by_noise: float, share: float) -> None:
    """Count a ``product`` in a ``row`` of cell ``i``, to which noise gives ``by_noise`` more than is written there."""
    before = memory[row, i]
    room = max(before * GROWS + (by_noise * GROWS + AT_ONCE), AT_ONCE)
    memory[row, i] = before + min((product - before) * share, room)


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
        alone = max(alone, min(memory[row + _UP, i], memory[row + _DOWN, i]) / sure)
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
        up = own * memory[row + _UP, i] + beside * memory[other + _UP, i]
        down = own * memory[row + _DOWN, i] + beside * memory[other + _DOWN, i]
        row, other = row + SCALES, other + SCALES
        bends_up = own * memory[row + _UP, i] + beside * memory[other + _UP, i]
        bends_down = own * memory[row + _DOWN, i] + beside * memory[other + _DOWN, i]
        clear = min(bends_up, bends_down) * 2.0 / sure
        moved = max(min(up + down, min(up, down) * SIDE + (0.5 * SIDE - 1.0)), 0.0)
        per_reading = numbers[READINGS, scale]
        of_change, of_bend = noise * noise * (2.0 / per_reading), noise * noise * (6.0 / per_reading)
        beyond, hides = math.sqrt(by_chance_beside) * MAY, numbers[HIDES, scale]
        may_beside = way_that_may_be(moved + beyond, bends + beyond, of_change, of_bend, length, hides)
        if may_beside < most_beside:
            most_beside, of_own = may_beside, own
        if scale == 0:
            beyond = sure * MAY
            most_by_shortest = way_that_may_be(moved + beyond, bends + beyond, of_change, of_bend, length, hides)
        if clear > 0.0 and rest > 0.0:
            way = way_of(moved, bends, of_change, of_bend, length)
            may = min(max((clear - may_from) * (1.0 / (seems - may_from)), 0.0), 1.0)
            does = min(max((clear - seems) * (1.0 / (surely - seems)), 0.0), 1.0)
            told += rest * does * way
            rest *= 1.0 - does
            most += rest_of_most * may * way_that_may_be(moved, bends, of_change, of_bend, length, hides)
            rest_of_most *= 1.0 - may
        length *= 2.0
    untold = max(min(most, most_by_shortest) - told, 0.0) * of_own
    untold += max(most_beside - told, 0.0) * (1.0 - of_own) * numbers[CAUTION, OF_MOST]
    return told, told + untold


@loop
def way_of(moved: float, bends: float, of_change: float, of_bend: float, length: float) -> float:
    """Way per look for mean squares over their variances by noise, of blocks of ``length`` looks."""
    moved *= of_change
    return math.sqrt(moved + min(bends * of_bend, moved * 4.0) * BEND) * (WAY / length)


@loop
def way_that_may_be(moved: float, bends: float, of_change: float, of_bend: float, length: float, hides: float) -> float:
    """Longest way per look, of which such blocks hide some."""
    seen = way_of(moved, bends, of_change, of_bend, length)
    fast = min(bends * of_bend, moved * of_change * 4.0) * (BEND * FAST)
    return seen + math.sqrt(fast) * (WAY / length) * (hides - 1.0)
