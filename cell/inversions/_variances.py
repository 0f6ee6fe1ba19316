"""Allan and Hadamard variances of readings, for blocks of several lengths, averaged recursively.

If means of successive blocks of readings differ by more than noise explains, the load moves: half the mean square of
these first differences is the Allan variance. If the load goes on in one direction, as in presses and in creep, the
second differences are small (Hadamard variance). A load that trembles has large differences of both orders, up and
down; the mean squares of upward and downward differences are therefore kept apart.

An edge of a load is a single event, while a tremor goes on. The mean squares are therefore robust: a squared second
difference up or down is clipped near the level of noise (:data:`MOST`), and no single difference may raise a mean
square by much (:data:`GROWS`, :data:`AT_ONCE`).

The same code takes products of the differences of two series that tremble together and have independent noise. Noise
has no part in the mean of such products (cross variance, :mod:`._together`).
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...common.compiled import Rows, SpacedRows, loop

SCALES = 4
"""number of block lengths: one, two, four and eight times the readings from one look to the next"""
GROWS, AT_ONCE = 1.0, 0.25
"""a single squared difference raises a mean square by at most GROWS times the mean square so far (noise included), plus
AT_ONCE times the variance of noise"""
MOST = 8.0
"""times the variance of noise: limit of a squared second difference in the mean squares up and down, which tell whether
a load trembles"""
CLEAR = 3.0
"""standard deviations of a difference by noise: a difference is clipped at so many, plus the largest unnoticed
motion"""

SERIES = tuple(f"{name}_{1 << scale}" for name in ("mean", "mean_before") for scale in range(SCALES))
"""names of the rows of a series: for each block length in looks, the mean of the last block, and of the one before"""
SQUARES = tuple(
    f"{name}_{1 << scale}" for name in ("bends", "up", "bends_up", "down", "bends_down") for scale in range(SCALES)
)
"""names of the rows of mean squares, in units of the variance by noise and less the part of noise: of second
differences; of first differences upwards; of second differences upwards; and of both downwards"""
ALL_SERIES, ALL_SQUARES = len(SERIES), len(SQUARES)
BENDS, UP, DOWN = 0, SCALES, 3 * SCALES
SHARE, READINGS = 0, 1
"""rows (SCALES,) of the numbers that depend on the time between frames: share of a block in the mean squares, and
readings in a block; further rows are those of :mod:`._way`"""
LOOKS_IN_BLOCK = 2.0 ** np.arange(SCALES)[:, None]
_BEFORE_END = LOOKS_IN_BLOCK.astype(np.intp) - 1
"""bits of the number of looks that are 0 at the end of a block"""
_ROOM = np.repeat([1.0, 0.5], (SCALES, 4 * SCALES))[:, None] * GROWS + AT_ONCE
"""(rows of SQUARES, 1) by which one difference may raise a mean square at the level of noise"""
_ZERO, _HALF, _ONE, _CLEAR, _MOST, _LEAST, _AT_ONCE = (
    np.array(x) for x in (0.0, 0.5, 1.0, CLEAR, MOST, -MOST, AT_ONCE)
)
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


def ends_of_blocks(looks: FloatArray) -> BoolArray:
    """(SCALES, m) where blocks of each length end after ``looks`` (m,) looks."""
    ends: BoolArray = looks.astype(np.intp) & _BEFORE_END == 0
    return ends


def differences(
    series: FloatArray,
    newest: FloatArray,
    noise: FloatArray,
    largest: FloatArray,
    ends: BoolArray,
    noise_of_differences: FloatArray,
) -> FloatArray:
    """Take the ``newest`` means (k, m) into k ``series`` (k, as :data:`SERIES`, m), changed.

    Args:
        series: of the memory.
        newest: means of the readings since the last look.
        noise: (k, m) standard deviation of a reading.
        largest: (k, m) largest motion that may go unnoticed.
        ends: :func:`ends_of_blocks`.
        noise_of_differences: (2 * SCALES, 1) standard deviations of first and second differences, over that of a
            reading.

    Returns:
        (k, 2 * SCALES, m) first, then second differences of blocks, over their standard deviations by noise.
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
    std = noise[:, None] * noise_of_differences
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
        by_noise: (j, 1, 1) mean of these products by noise.
        side: (j, 2 * SCALES, m) positive where they go up, negative where down.
        shares: (SCALES, m) of the products.
        forgotten: (m,) cells whose mean squares begin anew.
    """
    if np.count_nonzero(forgotten):
        np.copyto(squares, _ZERO, where=forgotten)
    beyond = np.empty_like(squares)
    bends = product[:, SCALES:]
    np.subtract(bends, by_noise, beyond[:, :UP])
    np.minimum(bends, _MOST, out=bends)
    np.maximum(bends, _LEAST, out=bends)
    np.multiply(product, side > _ZERO, beyond[:, UP:DOWN])
    np.multiply(product, side < _ZERO, beyond[:, DOWN:])
    beyond[:, UP:] -= by_noise * _HALF
    beyond -= squares
    by_scale = beyond.reshape(len(squares), -1, *shares.shape)
    by_scale *= shares
    room = squares * GROWS
    room += _ROOM
    np.maximum(room, _AT_ONCE, out=room)
    np.minimum(beyond, room, out=beyond)
    squares += beyond


def count(squares: FloatArray, product: FloatArray, shares: FloatArray) -> None:
    """Take a ``product`` of differences (SCALES, m), changed, whose mean by noise is 1, into mean squares.

    Args:
        squares: (SCALES, m) of the memory, less the part of noise, changed.
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
    """Take the ``mean`` of the last readings of cell ``i``; its series and mean squares begin with these rows."""
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
    """Reset the mean squares of cell ``i``, which begin with row ``squares`` of ``memory``."""
    for row in range(squares, squares + ALL_SQUARES):
        memory[row, i] = 0.0


@loop
def scaled(change: float, std: float, largest: float) -> float:
    """A difference over its standard deviation by noise, clipped."""
    limit = largest / std + CLEAR
    return min(max(change / std, -limit), limit)


@loop
def differences_of(memory: SpacedRows, row: int, i: int, block: float) -> tuple[float, float, float]:
    """:func:`differences` of cell ``i`` for one block length, whose last mean is in ``row``; and the longer block."""
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
    """:func:`take` of cell ``i`` for one block length, whose first mean square is in ``row``."""
    count_of(memory, row + BENDS, i, bent - by_noise, 1.0, share)
    bent, by_noise = min(max(bent, -MOST), MOST), 0.5 * by_noise
    count_of(memory, row + UP, i, (moved if moved_side > 0.0 else 0.0) - by_noise, 0.5, share)
    count_of(memory, row + UP + SCALES, i, (bent if bent_side > 0.0 else 0.0) - by_noise, 0.5, share)
    count_of(memory, row + DOWN, i, (moved if moved_side < 0.0 else 0.0) - by_noise, 0.5, share)
    count_of(memory, row + DOWN + SCALES, i, (bent if bent_side < 0.0 else 0.0) - by_noise, 0.5, share)


@loop
def count_of(memory: SpacedRows, row: int, i: int, product: float, by_noise: float, share: float) -> None:
    """Take a ``product``, less its mean by noise, into the mean in ``row`` of cell ``i``, limited by ``by_noise``."""
    before = memory[row, i]
    room = max(before * GROWS + (by_noise * GROWS + AT_ONCE), AT_ONCE)
    memory[row, i] = before + min((product - before) * share, room)
