"""Tremors that neighbouring cells share, told by the cross variance of two groups of them (two independent detectors).

Cells of one contact tremble together, and in proportion to their load. The own readings of a lightly loaded cell hardly
tell a tremor of a few percent from noise. All its neighbours together can: their information grows with the sum of
their squared loads. Their readings are therefore combined to an estimate of the relative change of the load, each
weighted by its signal over its noise variance (a matched filter).

Motion that a column of the readings has in common may be noise, though, as in a divider whose idle rows are driven. And
the noise of a sum is not known well. We therefore form two sums: one of the neighbours in the cell's own column and in
every second column beside it, and one of those in the columns between. Noise has no part in the mean product of both
sums, while a tremor has. This product of their differences takes the place of the square in :mod:`._variances`.

Within a group, too, cells may share noise, and neighbours under another contact move in another way. Each group
therefore knows less than the noise of single readings suggests. The difference of the two groups tells by how much: a
tremor that they share cancels in it, all else does not.

The groups estimate the same motion of the load as the cell's own readings. The two estimates are weighted by inverse
variance (:func:`._way.weights`). The neighbours know far more for most cells; own readings have the larger weight where
a cell bears far more than the cells around.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Rows, SpacedPlaces, SpacedRows, loop
from ..estimation import ALIKE
from . import _variances as variances
from ._variances import ALL_SERIES, READINGS, SCALES, SHARE, count_of, differences_of, scaled, take_of

LEAST = 1e-9
"""reciprocal variance of the relative change of the load: a group with less knows nothing"""

GROUPS = "alike", "between"
SERIES = tuple(f"{name}_{group}" for group in GROUPS for name in variances.SERIES)
LOADS = tuple(f"load_{group}" for group in GROUPS)
APART = tuple(f"apart_{1 << scale}" for scale in range(SCALES))
"""names of rows of the memory: a series for each group; the relative load of each group, integrated from its changes;
and for each block length the mean square of the difference of both groups' second differences, in units of the variance
by noise of single readings and less the part of noise. Mean products are as :data:`._variances.SQUARES`"""
WEIGHTED, KNOWN = range(2)
"""rows that the neighbours read, with the change of r since the last look, dr/dl of the relative load l, and the
variance of r by noise: change times dr/dl over variance; and (dr/dl)^2 over variance"""
TELLS = 2
_ZERO, _LEAST = np.array(0.0), np.array(LEAST)
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


def look(loads: FloatArray, tells: FloatArray, near: IntArray) -> FloatArray:
    """Combine the readings of neighbours to the relative load of m cells.

    Args:
        loads: (as :data:`LOADS`, m) of the memory, changed.
        tells: (TELLS, m) of each cell; 0 for cells whose load has an edge just now.
        near: (k, m) neighbours, see :class:`..estimation._neighbours.Neighbours`.

    Returns:
        (2, m) reciprocal variances by noise of the relative change of the load from each group; always positive.
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
    """Take the difference of both groups' second differences into its mean square.

    Args:
        apart: (as :data:`APART`, m) of the memory, changed.
        bends: (2, SCALES, m) second differences of each group, over their deviation by noise of single readings.
        knows: (2, m) what :func:`look` returned.
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
    """(m,) reciprocal variance of the relative change from mean products, for those of :func:`look`; 0: unknown."""
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
    """Take the readings of the neighbours of cell ``i``; returns :func:`known`.

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
    """Add the relative change from neighbours ``begin`` to ``end`` of cell ``i`` to ``row``; returns what they know."""
    weighted, knows, cells = 0.0, 0.0, tells.shape[1]
    for k in range(begin, end):
        cell = near[k, i]
        if cell < cells:
            weighted += tells[WEIGHTED, cell]
            knows += tells[KNOWN, cell]
    knows = max(knows, LEAST)
    memory[row, i] += weighted / knows
    return knows
