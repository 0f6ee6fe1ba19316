"""Parting of touching contacts: a watershed by steepest ascent, merged by topological persistence.

Every touched cell belongs to the local maximum of the pressure that steepest ascent leads to. Two neighbouring maxima
are two fingers if the saddle between them is clearly lower than the lower one of both: by more than noise, and by more
than the unevenness of one finger. Otherwise the lower maximum becomes part of the higher one.
"""

from __future__ import annotations

import numpy as np

from ..arrays import BoolArray, FloatArray, IntArray
from ._around import highest_around, with_all_neighbours

PART_SHARE, STAY_SHARE = 0.3, 0.15
"""of a maximum, by which a saddle must be lower for two fingers, and to stay two: one finger is uneven by less"""
PART_STDS, STAY_STDS = 5.0, 2.5
"""the same in standard deviations of the difference between the maximum and its saddle"""
_AROUND = [(row, column) for row in range(3) for column in range(3)]
_ALL, _BUT_LAST, _BUT_FIRST = slice(None), slice(None, -1), slice(1, None)
_PAIRS = [
    ((_ALL, _BUT_LAST), (_ALL, _BUT_FIRST)),
    ((_BUT_LAST, _ALL), (_BUT_FIRST, _ALL)),
    ((_BUT_LAST, _BUT_LAST), (_BUT_FIRST, _BUT_FIRST)),
    ((_BUT_LAST, _BUT_FIRST), (_BUT_FIRST, _BUT_LAST)),
]
"""places of the two cells of each pair of neighbours: side by side, below each other, and on both diagonals"""


def part(
    labels: IntArray,
    pressure_kpa: FloatArray,
    std_kpa: FloatArray,
    begins: BoolArray,
    before: IntArray,
    *,
    were_parted: bool,
) -> IntArray:
    """Give each finger of a patch a label of its own.

    Args:
        labels: (rows, columns) connected patches of touched cells, from 1; 0 for the others.
        pressure_kpa: (rows, columns).
        std_kpa: (rows, columns); NaN where unknown.
        begins: (rows, columns) cells whose pressure is large enough for a contact to begin.
        before: (rows, columns) labels of the last frame: what was apart then is parted more readily.
        were_parted: whether any patch was parted in the last frame.

    Returns:
        (rows, columns) labels, from 1 without gaps.

    """
    touched = labels > 0
    height = np.where(touched, pressure_kpa, -np.inf)
    summits = touched & (height >= highest_around(height))
    if not were_parted:
        summits &= with_all_neighbours(begins)
    if np.count_nonzero(summits) <= labels.max():
        return labels
    top = _tops(height)
    tops = np.flatnonzero((top == np.arange(top.size)) & touched.ravel())
    number = np.zeros(top.size, dtype=np.intp)
    number[tops] = np.arange(len(tops))
    basin: IntArray = number[top].reshape(labels.shape)
    std = np.where(std_kpa > 0, std_kpa, 0.0)  # what is not known counts as nothing
    root = _merged(tops, basin, height, std, begins, before.ravel())
    numbers = np.cumsum(np.bincount(root) > 0)[root]
    return np.where(touched, numbers[basin], 0)


def _tops(height: FloatArray) -> IntArray:
    """For each cell of the flattened array, the local maximum that steepest ascent leads to."""
    rows, columns = height.shape
    padded = np.full((rows + 2, columns + 2), -np.inf)
    padded[1:-1, 1:-1] = height
    around = np.stack([padded[row : row + rows, column : column + columns] for row, column in _AROUND])
    # The middle first: cells of equal height lead nowhere else, and no path is a circle.
    step: IntArray = np.where(around[4] >= around.max(axis=0), 4, around.argmax(axis=0)).reshape(-1)
    to: IntArray = np.arange(height.size)
    to += (step // 3 - 1) * columns + step % 3 - 1
    while True:
        further: IntArray = to[to]
        if np.array_equal(further, to):
            return to
        to = further


def _merged(
    tops: IntArray, basin: IntArray, height: FloatArray, std: FloatArray, begins: BoolArray, before: IntArray
) -> IntArray:
    """(basins,) the basin that each one becomes part of; itself where it is a finger of its own."""
    root = list(range(len(tops)))

    def find(one: int) -> int:
        while root[one] != one:
            root[one] = root[root[one]]
            one = root[one]
        return one

    peaks, cells = height.ravel()[tops].tolist(), tops.tolist()
    for one, other, saddle in _saddles(basin, height):
        a, b = find(one), find(other)
        if a == b:
            continue
        low, high = (a, b) if peaks[a] < peaks[b] else (b, a)
        now, then = before[cells[low]], before[cells[high]]
        apart = bool(now and then and now != then)
        share, stds = (STAY_SHARE, STAY_STDS) if apart else (PART_SHARE, PART_STDS)
        within = basin == low
        deep = peaks[low] - float(height.flat[saddle]) >= share * peaks[low]
        sure = deep and (apart or begins[within].any()) and _surely_above(height, std, within, saddle, stds)
        if not sure:
            root[low] = high
    return np.array([find(one) for one in root], dtype=np.intp)


def _surely_above(height: FloatArray, std: FloatArray, within: BoolArray, saddle: int, stds: float) -> bool:
    """Whether any cell ``within`` (rows, columns) is higher than the saddle by so many deviations of the difference.

    Any, since a single cell at the top may be uncertain for a reason of its own.
    """
    noise = np.hypot(std[within], std.flat[saddle])
    return bool((height[within] - height.flat[saddle] >= stds * noise).any())


def _saddles(basin: IntArray, height: FloatArray) -> list[tuple[int, int, int]]:
    """Pairs of basins that touch, with the cell over which the highest way between them leads; the highest first."""
    cell = np.arange(basin.size).reshape(basin.shape)
    touched = height > -np.inf
    ones, others = [], []
    for here, there in _PAIRS:
        differs = (basin[here] != basin[there]) & touched[here] & touched[there]
        ones.append(cell[here][differs])
        others.append(cell[there][differs])
    one, other = np.concatenate(ones), np.concatenate(others)
    flat = height.ravel()
    saddle = np.where(flat[one] < flat[other], one, other)
    order = np.argsort(-flat[saddle], kind="stable")
    pairs = basin.ravel()[np.stack([one, other])][:, order]
    pairs.sort(axis=0)
    first = np.sort(np.unique(pairs[0] * (basin.max() + 1) + pairs[1], return_index=True)[1])
    return list(zip(*pairs[:, first].tolist(), saddle[order][first].tolist(), strict=True))
