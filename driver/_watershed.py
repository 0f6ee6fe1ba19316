"""Separation of touching contacts: watershed by steepest ascent, with basins merged by topological persistence.

The cells of a patch are flooded from the highest pressure downwards. A cell without a higher neighbour is a new summit;
any other one goes to the basin of its highest neighbour. Where a cell joins two basins it is their saddle. They are two
fingers if the saddle is clearly lower than the lower summit: by more than noise, and by more than the unevenness of one
finger. Otherwise the lower basin becomes part of the higher one.
"""

from __future__ import annotations

import math

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..common.compiled import Flags, PlaceRows, Places, Row, loop
from ._proximity import Proximity

PART_SHARE, STAY_SHARE = 0.3, 0.15
"""depth of a saddle below the lower maximum, relative to it, at which two fingers part, and stay parted: one finger is
less uneven"""
PART_STDS, STAY_STDS = 5.0, 2.5
"""the same in standard deviations of the difference between the maximum and its saddle"""
PAIRS = 8
"""neighbours of a cell, hence pairs of basins that may meet in it"""


def part(
    labels: IntArray,
    count: int,
    pressure_kpa: FloatArray,
    std_kpa: FloatArray,
    begins: BoolArray,
    before: IntArray,
    proximity: Proximity,
) -> IntArray:
    """Give each finger of a patch its own label.

    Args:
        labels: (rows, columns) connected patches of touched cells, from 1; 0 for the others.
        count: number of these patches.
        pressure_kpa: (rows, columns).
        std_kpa: (rows, columns).
        begins: (rows, columns) cells whose pressure is large enough for a contact to begin.
        before: (rows, columns) labels of the last frame: fingers that were apart then are parted more readily.
        proximity: who is near whom.

    Returns:
        (rows, columns) labels, from 1 without gaps.

    """
    several = np.flatnonzero(proximity.summits(labels, pressure_kpa, count) > 1).tolist()
    parted = labels.copy()
    number = np.full(labels.size + 1, labels.size, dtype=np.intp)
    for label in several:
        cells = np.flatnonzero(labels == label)
        number[cells] = np.arange(cells.size)
        near = np.minimum(number[proximity.near[cells]], cells.size)
        number[cells] = labels.size
        height, std = pressure_kpa.ravel()[cells], std_kpa.ravel()[cells]
        root = np.full(cells.size, -1, dtype=np.intp)
        order = np.argsort(-height, kind="stable")
        fingers = np.empty((PAIRS * cells.size, 2), dtype=np.intp)
        basins_each(order, near, height, std, begins.ravel()[cells], before.ravel()[cells], root, fingers)
        _, own, basins = np.unique(root, return_index=True, return_inverse=True)
        rank = np.argsort(np.argsort(own))[basins]
        parted.flat[cells] = np.where(rank == 0, label, count + rank)
        count += own.size - 1
    return parted


@loop
def basins_each(
    order: Places,
    near: PlaceRows,
    height: Row,
    std: Row,
    begins: Flags,
    before: Places,
    root: Places,
    fingers: PlaceRows,
) -> None:
    """Flood a patch of n cells.

    Args:
        order: (n,) cells from the highest one on.
        near: (n, most) cells near each one; n stands for none.
        height: (n,) as ``std``, ``begins`` and ``before`` of :func:`part`.
        std: see ``height``.
        begins: see ``height``.
        before: see ``height``.
        root: (n,) -1; the summit to whose basin each cell belongs is written.
        fingers: scratch for pairs of summits that are two fingers.

    """
    count, pairs = height.size, 0
    for cell in order:
        above, least, several = -1, count, False
        for other in near[cell]:
            if other < count and root[other] >= 0:
                summit = summit_of(root, other)
                several = several or (above >= 0 and summit != least)
                least = min(least, summit)
                above = other if above < 0 or height[other] > height[above] else above
        if above < 0:
            root[cell] = cell
            continue
        root[cell] = summit_of(root, above) if several else least
        if not several:
            continue
        for other in near[cell]:
            if other == count or root[other] < 0:
                continue
            high, low = summit_of(root, other), summit_of(root, cell)
            if height[low] > height[high] or (height[low] == height[high] and low < high):
                high, low = low, high
            known = high == low
            for k in range(pairs):
                known = known or (fingers[k, 0] == high and fingers[k, 1] == low)
            if known:
                continue
            if are_fingers(high, low, cell, height, std, begins, before, root):
                fingers[pairs, 0], fingers[pairs, 1] = high, low
                pairs += 1
            else:
                root[low] = high
    for cell in order:
        root[cell] = summit_of(root, cell)


@loop
def summit_of(root: Places, cell: int) -> int:
    """The summit of a cell's basin."""
    while root[cell] != cell:
        cell = root[cell]
    return cell


@loop
def are_fingers(
    high: int, low: int, saddle: int, height: Row, std: Row, begins: Flags, before: Places, root: Places
) -> bool:
    """Whether the basin of ``low`` is a finger of its own.

    One cell that is surely higher than the saddle suffices, since the cell at the top may be uncertain for a reason of
    its own.
    """
    apart = before[low] != before[high] and before[low] > 0 and before[high] > 0
    share, stds = (STAY_SHARE, STAY_STDS) if apart else (PART_SHARE, PART_STDS)
    if height[low] - height[saddle] < share * height[low]:
        return False
    sure, begun = False, apart
    for cell in range(height.size):
        if root[cell] >= 0 and summit_of(root, cell) == low:
            sure = sure or height[cell] - height[saddle] >= stds * math.hypot(std[cell], std[saddle])
            begun = begun or begins[cell]
    return sure and begun
