"""Separation of touching contacts: watershed by steepest ascent, with basins merged by topological persistence.

The cells of a patch are flooded from the highest pressure downwards. A cell without a higher neighbour is a new summit;
any other one goes to the basin of its highest neighbour. Where a cell joins two basins it is their saddle. They are two
fingers if the saddle is clearly lower than the lower summit: by more than noise, and by more than the unevenness of one
finger. Otherwise the lower basin becomes part of the higher one.
"""

from __future__ import annotations

import math

import numpy as np

from ..common.compiled import Flags, PlaceRows, Places, Row, loop

PART_SHARE, STAY_SHARE = 0.3, 0.15
"""depth of a saddle below the lower maximum, relative to it, at which two fingers part, and stay parted: one finger is
less uneven"""
PART_STDS, STAY_STDS = 5.0, 2.5
"""the same in standard deviations of the difference between the maximum and its saddle"""
PAIRS = 8
"""neighbours of a cell, hence pairs of basins that may meet in it"""
NONE = -1


@loop
def part(
    connected: Places,
    count: int,
    starts: Places,
    order: Places,
    near: PlaceRows,
    height: Row,
    std: Row,
    begins: Flags,
    before: Places,
    labels: Places,
) -> int:
    """Give each finger of a patch its own label; returns the number of labels, which have no gaps.

    Args:
        connected: (n,) connected patches of touched cells, from 1 to ``count``; 0 for the others.
        count: number of these patches.
        starts: (count + 2,) with ``order``: the cells of each patch, as :func:`._patches.sort_by_label` gives them.
        order: (n,)
        near: (n, most) cells near each one; n stands for none.
        height: (n,) kPa.
        std: (n,) standard deviations.
        begins: (n,) cells whose pressure is large enough for a contact to begin.
        before: (n,) labels of the last frame: fingers that were apart then are parted more readily.
        labels: (n,) written.

    """
    root, fingers = np.empty(labels.size, np.intp), count
    for cell in range(labels.size):
        labels[cell], root[cell] = connected[cell], NONE
    for k in range(1, count + 1):
        cells = order[starts[k] : starts[k + 1]]
        if summits(cells, connected, near, height) < 2:
            continue
        falling = np.empty(cells.size, np.intp)
        falling[:] = cells
        sort_falling(falling, height)
        flood(falling, near, height, std, begins, before, root)
        # The basin of the first cell keeps the label; the others follow in the order of their first cells.
        own = root[cells[0]]
        first = fingers
        tops = np.empty(cells.size, np.intp)
        for cell in cells:
            if root[cell] == own:
                continue
            number = first
            while number < fingers and tops[number - first] != root[cell]:
                number += 1
            if number == fingers:
                tops[number - first] = root[cell]
                fingers += 1
            labels[cell] = number + 1
        for cell in cells:
            root[cell] = NONE
    return fingers


@loop
def summits(cells: Places, labels: Places, near: PlaceRows, height: Row) -> int:
    """The number of cells of a patch that no touched cell near them is higher than."""
    found = 0
    for cell in cells:
        top = True
        for other in near[cell]:
            if other == labels.size:
                break
            if labels[other] > 0 and height[other] > height[cell]:
                top = False
                break
        if top:
            found += 1
    return found


@loop
def sort_falling(cells: Places, height: Row) -> None:
    """Sort cells, which are in the order of their numbers, by falling height; the first ones of equal ones first.

    Heap sort (Williams 1964): the cell that is to be last is at the top of the heap.
    """
    count = cells.size
    for start in range(count // 2 - 1, -1, -1):
        sift(cells, start, count, height)
    for last in range(count - 1, 0, -1):
        cells[0], cells[last] = cells[last], cells[0]
        sift(cells, 0, last, height)


@loop
def sift(cells: Places, place: int, count: int, height: Row) -> None:
    """Let the cell at ``place`` of a heap of ``count`` cells sink to where it belongs."""
    cell = cells[place]
    while True:
        below = 2 * place + 1
        if below >= count:
            break
        if below + 1 < count and follows(cells[below + 1], cells[below], height):
            below += 1
        if not follows(cells[below], cell, height):
            break
        cells[place] = cells[below]
        place = below
    cells[place] = cell


@loop
def follows(cell: int, other: int, height: Row) -> bool:
    """Whether ``cell`` comes after the other one by falling height."""
    return bool(height[cell] < height[other] or (height[cell] == height[other] and cell > other))


@loop
def flood(falling: Places, near: PlaceRows, height: Row, std: Row, begins: Flags, before: Places, root: Places) -> None:
    """Flood a patch of m cells.

    Args:
        falling: (m,) cells from the highest one on.
        near: (n, most) as ``height``, ``std``, ``begins`` and ``before`` of :func:`part`.
        height: see ``near``.
        std: see ``near``.
        begins: see ``near``.
        before: see ``near``.
        root: (n,) :data:`NONE`; the summit to whose basin each cell belongs is written.

    """
    none, pairs = height.size, 0
    fingers = np.empty((PAIRS * falling.size, 2), np.intp)
    for cell in falling:
        above, least, several = NONE, none, False
        for other in near[cell]:
            if other < none and root[other] >= 0:
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
            if other == none or root[other] < 0:
                continue
            high, low = summit_of(root, other), summit_of(root, cell)
            if height[low] > height[high] or (height[low] == height[high] and low < high):
                high, low = low, high
            known = high == low
            for k in range(pairs):
                known = known or (fingers[k, 0] == high and fingers[k, 1] == low)
            if known:
                continue
            if are_fingers(falling, high, low, cell, height, std, begins, before, root):
                fingers[pairs, 0], fingers[pairs, 1] = high, low
                pairs += 1
            else:
                root[low] = high
    for cell in falling:
        root[cell] = summit_of(root, cell)


@loop
def summit_of(root: Places, cell: int) -> int:
    """The summit of a cell's basin."""
    while root[cell] != cell:
        cell = root[cell]
    return cell


@loop
def are_fingers(
    cells: Places,
    high: int,
    low: int,
    saddle: int,
    height: Row,
    std: Row,
    begins: Flags,
    before: Places,
    root: Places,
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
    for cell in cells:
        if root[cell] < 0:  # from here on lower than the saddle
            break
        if summit_of(root, cell) == low:
            sure = sure or height[cell] - height[saddle] >= stds * math.hypot(std[cell], std[saddle])
            begun = begun or begins[cell]
    return sure and begun
