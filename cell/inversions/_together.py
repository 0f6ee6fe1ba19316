"""Tremors that neighbouring cells share, told by the cross variance of two groups of them (two independent detectors).

Cells of one contact tremble together, and in proportion to their load. A light cell's own readings hardly tell a tremor
of a few percent from noise, while those of its neighbours do: what weighs is the squared load of all of them. Their
readings are therefore combined to the relative change of the load, each weighted by what it knows of it (a matched
filter). What is common in a column of the readings may be noise, though, as of a divider whose idle rows are driven,
and the noise of a sum is not known well. So there are two sums: of the neighbours in the cell's own column and in every
second one beside, and of those in the columns between. Noise has no part in the mean of the product of both, a tremor
has: the product of their differences stands for the square in the variances of :mod:`._way`.

Both tell of the load of a cell what its own readings tell as well. They are weighted by how well they know it. What is
told beside is far better known for most cells, and has the smaller weight where a cell bears far more than the cells
around.
"""

from __future__ import annotations

import math

import numpy as np

from ...arrays import BoolArray, FloatArray, IntArray
from ...compiled import PlaceRows, Rows, loop
from ..estimation import ALIKE, RECENT
from . import _way as way
from ._way import (
    CLEAR,
    SCALES,
    SHARE,
    differences_of,
    limited,
    take_of,
)

LEAST = 1e-9
"""reciprocal variance of a relative change of the load below which a group knows nothing"""

GROUPS = 2
NAMES = (
    *(f"{name}_{group}" for group in ("alike", "between") for name in ("load", *way.SERIES)),
    *way.SQUARES,
)
"""names of the rows of the memory: of each group the relative load, summed up, and its series; then mean products"""
ROWS = len(NAMES)
SQUARES_FROM = GROUPS * (1 + len(way.SERIES))
OF_GROUP = 1 + len(way.SERIES)
_SQUARES_ROWS = slice(SQUARES_FROM, ROWS)
WEIGHTED, KNOWN = range(2)
"""rows of what cells tell: change of r times the change of r with the relative load, over the variance by noise; and
the square of the latter over this variance"""
TELLS = 2
_ZERO, _ONE, _HALF, _LEAST = (np.array(x) for x in (0.0, 1.0, 0.5, LEAST))
_STD = np.sqrt(np.concatenate([2.0 / (RECENT * 2.0 ** np.arange(SCALES)), 6.0 / (RECENT * 2.0 ** np.arange(SCALES))]))[
    :, None
]


def begin(rows: FloatArray) -> None:
    """Begin with cells that bear nothing; writes their ``rows`` (as :data:`NAMES`, m)."""
    rows[...] = 0.0


def weights(own: FloatArray, beside: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Shares of mean squares of own differences and of mean products beside, by inverse variance.

    Args:
        own: (m,) reciprocal variance of the relative change of the load, by own readings.
        beside: (m,) by those beside, see :func:`look`.

    Returns:
        (m,) share of own ones, and (m,) share of those beside, which tells r of the own load.
    """
    # A mean product has half of the variance of a mean square.
    ratio = np.divide(own, beside, out=np.zeros_like(own), where=beside > _ZERO)
    share = _ONE / (ratio * ratio * _HALF + _ONE)
    share *= ratio > _ZERO  # what bears nothing, or has no neighbour, is told by its own readings
    return _ONE - share, share * ratio


def look(
    rows: FloatArray,
    tells: FloatArray,
    near: IntArray,
    largest: FloatArray,
    ends: BoolArray,
    shares: FloatArray,
    forgotten: BoolArray,
) -> FloatArray:
    """Take what the neighbours of m cells tell; changes their ``rows``.

    Args:
        rows: (as :data:`NAMES`, m) of the memory.
        tells: (TELLS, m) of each cell, none of those whose load has an edge just now.
        near: (k, m) neighbours, see :class:`..estimation._neighbours.Neighbours`.
        largest: (m,) relative change of the load that may go without being noticed otherwise.
        ends: (SCALES, m) where blocks end.
        shares: (SCALES, 1) of a block in mean products.
        forgotten: (m,) cells whose mean products begin anew.

    Returns:
        (m,) reciprocal variance of the relative change of a load that mean products know; 0: nothing.
    """
    beside = np.zeros((TELLS, tells.shape[1] + 1))
    beside[:, :-1] = tells
    of_all = beside.take(near, axis=1)
    scaled, known = [], []
    for group, members in enumerate((of_all[:, :ALIKE], of_all[:, ALIKE:])):
        weighted, knows = members.sum(axis=1)
        np.maximum(knows, _LEAST, out=knows)
        of_group = rows[group * OF_GROUP : (group + 1) * OF_GROUP]
        of_group[0] += weighted / knows
        change = way.differences(of_group[1:], of_group[0], ends)
        std = _STD / np.sqrt(knows)
        change /= std
        limit = largest / std + CLEAR
        np.minimum(np.maximum(change, -limit, out=change), limit, out=change)
        scaled.append(change)
        known.append(knows)
    alike, between = scaled
    way.take(rows[_SQUARES_ROWS], alike * between, 0.0, alike + between, ends * shares, forgotten)
    both: FloatArray = np.sqrt(known[0] * known[1])
    both *= np.minimum(*known) > _LEAST
    return both


@loop
def weights_of(own: float, beside: float) -> tuple[float, float]:
    """:func:`weights` of one cell."""
    if not min(own, beside) > 0.0:
        return 1.0, 0.0
    ratio = own / beside
    share = 1.0 / (ratio * ratio * 0.5 + 1.0)
    return 1.0 - share, share * ratio


@loop
def look_of(
    memory: Rows,
    first: int,
    i: int,
    tells: Rows,
    near: PlaceRows,
    largest: float,
    looks: float,
    numbers: Rows,
) -> float:
    """:func:`look` of cell ``i``, whose rows of ``memory`` (rows, m) begin with row ``first``, after so many looks."""
    knows_alike, blocks_alike = load_of(memory, first, i, tells, near, 0, ALIKE)
    knows_between, blocks_between = load_of(memory, first + OF_GROUP, i, tells, near, ALIKE, near.shape[0])
    length, squares = 1.0, first + SQUARES_FROM
    for scale in range(SCALES):
        if looks % length != 0.0:
            break
        row, per_reading = first + 1 + scale, RECENT * length
        alike, bend_alike, blocks_alike = differences_of(memory, row, i, blocks_alike)
        between, bend_between, blocks_between = differences_of(memory, row + OF_GROUP, i, blocks_between)
        by_noise = math.sqrt(2.0 / per_reading)
        alike = scaled(alike, by_noise, knows_alike, largest)
        between = scaled(between, by_noise, knows_between, largest)
        by_noise = math.sqrt(6.0 / per_reading)
        bend_alike = scaled(bend_alike, by_noise, knows_alike, largest)
        bend_between = scaled(bend_between, by_noise, knows_between, largest)
        moved, bent = alike * between, bend_alike * bend_between
        share = numbers[SHARE, scale]
        take_of(memory, squares + scale, i, moved, alike + between, bent, bend_alike + bend_between, 0.0, share)
        length *= 2.0
    if min(knows_alike, knows_between) > LEAST:
        return math.sqrt(knows_alike * knows_between)
    return 0.0


@loop
def load_of(memory: Rows, row: int, i: int, tells: Rows, near: PlaceRows, begin: int, end: int) -> tuple[float, float]:
    """What neighbours from ``begin`` to ``end`` know of the relative load, and that load, which ``row`` sums up."""
    weighted, knows, cells = 0.0, 0.0, tells.shape[1]
    for k in range(begin, end):
        cell = near[k, i]
        if cell < cells:
            weighted += tells[WEIGHTED, cell]
            knows += tells[KNOWN, cell]
    knows = max(knows, LEAST)
    memory[row, i] += weighted / knows
    return knows, memory[row, i]


@loop
def scaled(change: float, by_noise: float, knows: float, largest: float) -> float:
    """A difference over its standard deviation by noise, within limits."""
    std = by_noise / math.sqrt(knows)
    return limited(change / std, largest / std + CLEAR)
