"""Separation of touching contacts: watershed by steepest ascent, with basins merged by topological persistence.

Every touched cell belongs to the local maximum of the pressure to which steepest ascent leads. Two neighbouring maxima
are two fingers if the saddle between them is clearly lower than the lower maximum: by more than noise, and by more than
the unevenness of one finger. Otherwise the lower maximum is merged into the higher one.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from ..common import compiled
from ..common.arrays import BoolArray, FloatArray, IntArray
from ..common.compiled import Flags, Places, Row, loop
from ._around import highest_around, with_all_neighbours

PART_SHARE, STAY_SHARE = 0.3, 0.15
"""depth of a saddle below the lower maximum, relative to it, at which two fingers part, and stay parted: one finger is
less uneven"""
PART_STDS, STAY_STDS = 5.0, 2.5
"""the same in standard deviations of the difference between the maximum and its saddle"""
NEIGHBOURS = np.ones((3, 3), dtype=int)
"""cells that touch at a corner are connected: a finger rarely covers whole rows"""
_AROUND = [(row, column) for row in range(3) for column in range(3)]
_ALL, _BUT_LAST, _BUT_FIRST = slice(None), slice(None, -1), slice(1, None)
_PAIRS = [
    ((_ALL, _BUT_LAST), (_ALL, _BUT_FIRST)),
    ((_BUT_LAST, _ALL), (_BUT_FIRST, _ALL)),
    ((_BUT_LAST, _BUT_LAST), (_BUT_FIRST, _BUT_FIRST)),
    ((_BUT_LAST, _BUT_FIRST), (_BUT_FIRST, _BUT_LAST)),
]
"""slices for the two cells of each pair of neighbours: side by side, below each other, and on both diagonals"""


class Segments:
    """Connected patches of an array, and the fingers in them; by machine code if available."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.shape = shape
        self.compiled = compiled.load(label_loop, part_loop)
        """whether the loops are machine code"""
        self._waiting = np.empty(shape[0] * shape[1], dtype=np.intp)

    def label(self, touched: BoolArray) -> tuple[IntArray, int]:
        """(rows, columns) numbers from 1 of patches of cells that touch at a side or a corner; and their count."""
        if not self.compiled:
            labels, count = ndimage.label(touched, structure=NEIGHBOURS)
            return labels.astype(np.intp), count
        numbers: IntArray = np.empty(touched.size, dtype=np.intp)
        count = label_loop.code(np.ravel(touched), self.shape[1], numbers, self._waiting)
        return numbers.reshape(self.shape), count

    def part(
        self,
        labels: IntArray,
        pressure_kpa: FloatArray,
        std_kpa: FloatArray,
        begins: BoolArray,
        before: IntArray,
        *,
        were_parted: bool,
    ) -> IntArray:
        """As :func:`part`."""
        if not self.compiled:
            return part(labels, pressure_kpa, std_kpa, begins, before, were_parted=were_parted)
        parted: IntArray = np.empty(labels.size, dtype=np.intp)
        height: FloatArray = np.array(pressure_kpa, dtype=np.float64).ravel()
        std: FloatArray = np.array(std_kpa, dtype=np.float64).ravel()
        numbers, summits, last = np.ravel(labels), np.ravel(begins), np.ravel(before)
        if part_loop.code(numbers, height, std, summits, last, self.shape[1], were_parted, parted):
            return parted.reshape(self.shape)
        return labels


def part(
    labels: IntArray,
    pressure_kpa: FloatArray,
    std_kpa: FloatArray,
    begins: BoolArray,
    before: IntArray,
    *,
    were_parted: bool,
) -> IntArray:
    """Give each finger of a patch its own label.

    Args:
        labels: (rows, columns) connected patches of touched cells, from 1; 0 for the others.
        pressure_kpa: (rows, columns).
        std_kpa: (rows, columns); NaN where unknown.
        begins: (rows, columns) cells whose pressure is large enough for a contact to begin.
        before: (rows, columns) labels of the last frame: fingers that were apart then are parted more readily.
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
    std = np.where(std_kpa > 0, std_kpa, 0.0)  # an unknown deviation counts as 0
    root = _merged(tops, basin, height, std, begins, before.ravel())
    numbers = np.cumsum(np.bincount(root) > 0)[root]
    return np.where(touched, numbers[basin], 0)


def _tops(height: FloatArray) -> IntArray:
    """For each cell of the flattened array, the local maximum reached by steepest ascent."""
    rows, columns = height.shape
    padded = np.full((rows + 2, columns + 2), -np.inf)
    padded[1:-1, 1:-1] = height
    around = np.stack([padded[row : row + rows, column : column + columns] for row, column in _AROUND])
    # The middle first: a cell as high as its neighbours leads nowhere, so that no path is a circle.
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
    """(basins,) the basin into which each one is merged; itself for a finger of its own."""
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

    One cell suffices, since the cell at the top may be uncertain for a reason of its own.
    """
    noise = np.hypot(std[within], std.flat[saddle])
    return bool((height[within] - height.flat[saddle] >= stds * noise).any())


def _saddles(basin: IntArray, height: FloatArray) -> list[tuple[int, int, int]]:
    """Pairs of touching basins, with the cell of the saddle on the highest path between them; the highest first."""
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


@loop
def label_loop(touched: Flags, columns: int, labels: Places, waiting: Places) -> int:
    """Number 8-connected patches of a flattened array in the order of their first cells, as ``scipy.ndimage.label``.

    Args:
        touched: (cells,).
        columns: of the array.
        labels: (cells,), written: from 1, and 0 for the others.
        waiting: (cells,) room for the cells of a patch.

    Returns:
        Number of patches.

    """
    cells, count = touched.size, 0
    for cell in range(cells):
        labels[cell] = 0
    for first in range(cells):
        if not touched[first] or labels[first] > 0:
            continue
        count += 1
        labels[first] = count
        waiting[0] = first
        left = 1
        while left > 0:
            left -= 1
            cell = waiting[left]
            row, column = cell // columns, cell % columns
            for r in range(max(row - 1, 0), min(row + 2, cells // columns)):
                for c in range(max(column - 1, 0), min(column + 2, columns)):
                    other = r * columns + c
                    if touched[other] and labels[other] == 0:
                        labels[other] = count
                        waiting[left] = other
                        left += 1
    return count


@loop
def part_loop(
    labels: Places,
    height: Row,
    std: Row,
    begins: Flags,
    before: Places,
    columns: int,
    were_parted: bool,
    parted: Places,
) -> bool:
    """Do the work of :func:`part` on flattened arrays (cells,); returns whether ``parted`` was written.

    Otherwise the labels stay as they are.
    """
    cells = labels.size
    rows = cells // columns
    top = np.empty(cells, dtype=np.intp)
    summits, patches = 0, 0
    for cell in range(cells):
        top[cell] = -1
        if labels[cell] == 0:
            continue
        patches = max(patches, labels[cell])
        row, column = cell // columns, cell % columns
        highest, near = cell, False
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(column - 1, 0), min(column + 2, columns)):
                other = r * columns + c
                near = near or begins[other]
                # Among equal neighbours the first one counts, but the middle before all.
                if labels[other] > 0 and height[other] > height[highest]:
                    highest = other
        top[cell] = highest
        if highest == cell and (were_parted or near):
            summits += 1
    if summits <= patches:
        return False
    number = np.empty(cells, dtype=np.intp)
    tops = np.empty(cells, dtype=np.intp)
    count = 0
    for cell in range(cells):
        if top[cell] == cell:
            number[cell] = count
            tops[count] = cell
            count += 1
    basin = np.empty(cells, dtype=np.intp)
    for cell in range(cells):
        basin[cell] = -1
        if labels[cell] > 0:
            to = cell
            while top[to] != to:
                to = top[to]
            basin[cell] = number[to]
    # For each pair of basins the highest saddle; among equal ones the first.
    saddle = np.full((count, count), -1, dtype=np.intp)
    place = np.zeros((count, count), dtype=np.intp)
    position = 0
    for kind in range(4):
        for row in range(rows):
            for column in range(columns):
                position += 1
                r, c = row + (kind > 0), column + (kind % 2 == 0)
                here = row * columns + column
                if kind == 3:
                    here, c = here + 1, column
                if r >= rows or c >= columns or (kind == 3 and column + 1 >= columns):
                    continue
                there = r * columns + c
                a, b = basin[here], basin[there]
                if a < 0 or b < 0 or a == b:
                    continue
                lower = here if height[here] < height[there] else there
                a, b = min(a, b), max(a, b)
                if saddle[a, b] < 0 or height[lower] > height[saddle[a, b]]:
                    saddle[a, b], place[a, b] = lower, position
    root = np.arange(count)
    while True:
        first, second = -1, -1
        for a in range(count):
            for b in range(a + 1, count):
                if saddle[a, b] < 0:
                    continue
                if first >= 0:
                    rival, own = height[saddle[first, second]], height[saddle[a, b]]
                    if own < rival or (own == rival and place[a, b] > place[first, second]):
                        continue
                first, second = a, b
        if first < 0:
            break
        at = saddle[first, second]
        saddle[first, second] = -1
        while root[first] != first:
            first = root[first]
        while root[second] != second:
            second = root[second]
        if first == second:
            continue
        low, high = second, first
        if height[tops[first]] < height[tops[second]]:
            low, high = first, second
        now, then = before[tops[low]], before[tops[high]]
        apart = now * then != 0 and now != then
        share, stds = PART_SHARE, PART_STDS
        if apart:
            share, stds = STAY_SHARE, STAY_STDS
        peak = height[tops[low]]
        sure = False
        if peak - height[at] >= share * peak:
            begun, above = apart, False
            known = std[at] if std[at] > 0 else 0.0
            for cell in range(cells):
                if basin[cell] == low:
                    begun = begun or begins[cell]
                    own = std[cell] if std[cell] > 0 else 0.0
                    above = above or height[cell] - height[at] >= stds * math.hypot(own, known)
            sure = begun and above
        if not sure:
            root[low] = high
    final = np.zeros(count, dtype=np.intp)
    for one in range(count):
        to = one
        while root[to] != to:
            to = root[to]
        root[one] = to
        final[to] = 1
    total = 0
    for one in range(count):
        total += final[one]
        final[one] = total
    for cell in range(cells):
        parted[cell] = 0 if basin[cell] < 0 else final[root[basin[cell]]]
    return True
