"""Separation of touching contacts: watershed by steepest ascent, with basins merged by topological persistence.

The cells of a patch are flooded from the highest pressure downwards. A cell without a higher neighbour is a new summit;
any other one goes to the basin of its highest neighbour. Where a cell joins two basins it is their saddle. They are two
fingers if the saddle is clearly lower than the lower summit: by more than noise, and by more than the unevenness of one
finger. Otherwise the lower basin becomes part of the higher one.
"""

from __future__ import annotations

import math

import numpy as np

from ..common.compiled import PlaceRows, Places, Row, loop
from ._touch import Memory, Scan, Skin
from ._tuning import PART_SHARE, SURE_STDS

PAIRS = 8
"""neighbours of a cell, hence pairs of basins that may meet in it"""
NONE = -1


@loop
def part(count: int, starts: Places, skin: Skin, memory: Memory, scan: Scan) -> int:
    """Give each finger of ``count`` connected patches a label of its own; returns the number of labels, without gaps.

    ``starts`` (count + 2,) and the order of cells are those of :func:`._patches.sort_by_label`. Fingers that were apart
    in the last frame are parted more readily.
    """
    labels, connected = memory.labels, scan.connected
    root, fingers = np.empty(labels.size, np.intp), count
    for cell in range(labels.size):
        labels[cell], root[cell] = connected[cell], NONE
    for k in range(1, count + 1):
        cells = memory.order[starts[k] : starts[k + 1]]
        if summits(cells, connected, skin.near, scan.height) < 2:
            continue
        falling = cells[np.argsort(-scan.height[cells], kind="mergesort")]  # the first ones of equal ones first
        flood(falling, skin.near, scan, root)
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
def flood(falling: Places, near: PlaceRows, scan: Scan, root: Places) -> None:
    """Flood a patch whose cells (m,) are given from the highest one on.

    ``root`` (n,) is :data:`NONE`; the summit to whose basin each cell belongs is written.
    """
    height = scan.height
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
            if are_fingers(falling, high, low, cell, scan, root):
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
def are_fingers(cells: Places, high: int, low: int, saddle: int, scan: Scan, root: Places) -> bool:
    """Whether the basin of ``low`` is a finger of its own.

    One cell that is surely higher than the saddle suffices, since the cell at the top may be uncertain for a reason of
    its own.
    """
    height, std, before = scan.height, scan.known_std, scan.before
    apart = before[low] != before[high] and before[low] > 0 and before[high] > 0
    share, stds = (PART_SHARE / 2.0, SURE_STDS / 2.0) if apart else (PART_SHARE, SURE_STDS)
    if height[low] - height[saddle] < share * height[low]:
        return False
    sure, begun = False, apart
    for cell in cells:
        if root[cell] < 0:  # from here on lower than the saddle
            break
        if summit_of(root, cell) == low:
            sure = sure or height[cell] - height[saddle] >= stds * math.hypot(std[cell], std[saddle])
            begun = begun or scan.begins[cell]
    return sure and begun
