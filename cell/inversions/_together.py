"""Tremors that neighbouring cells share, told by the cross variance of two groups of them (two independent detectors).

Cells of one contact tremble together, and in proportion to their load. A light cell's own readings hardly tell a tremor
of a few percent from noise, while those of its neighbours do: what weighs is the squared load of all of them. Their
readings are therefore combined to the relative change of the load, each weighted by what it knows of it (a matched
filter). What is common in a column of the readings may be noise, though, as of a divider whose idle rows are driven,
and the noise of a sum is not known well. So there are two sums: of the neighbours in the cell's own column and in every
second one beside, and of those in the columns between. Noise has no part in the mean of the product of both, a tremor
has: the product of their differences stands for the square in the variances of :mod:`._variances`.

Within a group noise may be common to cells as well, and neighbours of another contact move in another way. What each
group tells is therefore known less well than by the noise of single readings. How far both are apart tells by how much:
a tremor that they share has no part in the difference, all else has.

Both tell of the load of a cell what its own readings tell as well. They are weighted by how well they know it. What is
told beside is far better known for most cells, and has the smaller weight where a cell bears far more than the cells
around.
"""

from __future__ import annotations

import math

import numpy as np

from ...arrays import BoolArray, FloatArray, IntArray
from ...compiled import Rows, SpacedPlaces, SpacedRows, loop
from ..estimation import ALIKE
from . import _variances as variances
from ._variances import ALL_SERIES, READINGS, SCALES, SHARE, count_of, differences_of, scaled, take_of

LEAST = 1e-9
"""reciprocal variance of a relative change of the load below which a group knows nothing"""

GROUPS = "alike", "between"
SERIES = tuple(f"{name}_{group}" for group in GROUPS for name in variances.SERIES)
LOADS = tuple(f"load_{group}" for group in GROUPS)
APART = tuple(f"apart_{1 << scale}" for scale in range(SCALES))
"""names of rows of the memory: a series for each group, and its relative load, summed up. Mean products of both are as
:data:`._variances.SQUARES`. For each length of block, mean square of how far second differences of both groups are
apart, over the variance by noise of single readings, and beyond that"""
WEIGHTED, KNOWN = range(2)
"""rows of what cells tell: change of r times the change of r with the relative load, over the variance by noise; and
the square of the latter over this variance"""
TELLS = 2
_ZERO, _LEAST = np.array(0.0), np.array(LEAST)
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


def look(loads: FloatArray, tells: FloatArray, near: IntArray) -> FloatArray:
    """Sum up what neighbours tell of the relative load of m cells.

    Args:
        loads: (as :data:`LOADS`, m) of the memory, changed.
        tells: (TELLS, m) of each cell, none of those whose load has an edge just now.
        near: (k, m) neighbours, see :class:`..estimation._neighbours.Neighbours`.

    Returns:
        (2, m) reciprocal variances by noise of the relative change of the load that both groups read; none is 0.
    """
    beside = np.zeros((TELLS, tells.shape[1] + 1))
    beside[:, :-1] = tells
    of_all = beside.take(near, axis=1)
    weighted: FloatArray
    knows: FloatArray
    weighted, knows = np.stack([of_all[:, :ALIKE].sum(axis=1), of_all[:, ALIKE:].sum(axis=1)], axis=1)
    np.maximum(knows, _LEAST, out=knows)
    weighted /= knows
    loads += weighted
    return knows


def compare(apart: FloatArray, bends: FloatArray, knows: FloatArray, shares: FloatArray, forgotten: BoolArray) -> None:
    """Take how far second differences of both groups are apart.

    Args:
        apart: (as :data:`APART`, m) of the memory, changed.
        bends: (2, SCALES, m) second differences of each group, over their deviation by noise of single readings.
        knows: (2, m) what :func:`look` found.
        shares: (SCALES, m) of these differences in the mean squares.
        forgotten: (m,) cells whose mean squares begin anew.
    """
    np.copyto(apart, _ZERO, where=forgotten)
    alike, between = np.sqrt(knows[::-1] / knows.sum(axis=0))
    off = bends[0] * alike
    off -= bends[1] * between
    off *= off
    variances.count(apart, off, shares)


def known(knows: FloatArray) -> FloatArray:
    """(m,) reciprocal variance of the relative change that mean products know, for :func:`look`; 0: nothing."""
    both: FloatArray = np.sqrt(knows[0] * knows[1])
    both *= np.minimum(knows[0], knows[1]) > _LEAST
    return both


@loop
def look_of(
    memory: SpacedRows,
    series: int,
    squares: int,
    loads: int,
    apart: int,
    i: int,
    tells: Rows,
    near: SpacedPlaces,
    largest: float,
    looks: float,
    numbers: Rows,
) -> float:
    """Take what neighbours tell cell ``i``; returns :func:`known`.

    Series, mean products, relative loads and :data:`APART` begin with these rows of ``memory`` (rows, m).
    """
    knows_alike = load_of(memory, loads, i, tells, near, 0, ALIKE)
    knows_between = load_of(memory, loads + 1, i, tells, near, ALIKE, near.shape[0])
    noise_alike, noise_between = 1.0 / math.sqrt(knows_alike), 1.0 / math.sqrt(knows_between)
    of_alike = math.sqrt(knows_between / (knows_alike + knows_between))
    of_between = math.sqrt(knows_alike / (knows_alike + knows_between))
    block_alike, block_between, length = memory[loads, i], memory[loads + 1, i], 1
    for scale in range(SCALES):
        if int(looks) & (length - 1):
            break
        row, per_reading = series + scale, numbers[READINGS, scale]
        alike, bend_alike, block_alike = differences_of(memory, row, i, block_alike)
        between, bend_between, block_between = differences_of(memory, row + ALL_SERIES, i, block_between)
        by_noise = math.sqrt(2.0 / per_reading)
        alike = scaled(alike, noise_alike * by_noise, largest)
        between = scaled(between, noise_between * by_noise, largest)
        by_noise = math.sqrt(6.0 / per_reading)
        bend_alike = scaled(bend_alike, noise_alike * by_noise, largest)
        bend_between = scaled(bend_between, noise_between * by_noise, largest)
        moved, bent = alike * between, bend_alike * bend_between
        side, bent_side = alike + between, bend_alike + bend_between
        take_of(memory, squares + scale, i, moved, side, bent, bent_side, 0.0, numbers[SHARE, scale])
        off = bend_alike * of_alike - bend_between * of_between
        count_of(memory, apart + scale, i, off * off - 1.0, 1.0, numbers[SHARE, scale])
        length *= 2
    if min(knows_alike, knows_between) > LEAST:
        return math.sqrt(knows_alike * knows_between)
    return 0.0


@loop
def load_of(memory: SpacedRows, row: int, i: int, tells: Rows, near: SpacedPlaces, begin: int, end: int) -> float:
    """What neighbours from ``begin`` to ``end`` know of the relative load of cell ``i``, which ``row`` sums up."""
    weighted, knows, cells = 0.0, 0.0, tells.shape[1]
    for k in range(begin, end):
        cell = near[k, i]
        if cell < cells:
            weighted += tells[WEIGHTED, cell]
            knows += tells[KNOWN, cell]
    knows = max(knows, LEAST)
    memory[row, i] += weighted / knows
    return knows
