"""Separation of touching contacts: watershed by steepest ascent, with basins merged by topological persistence.

The cells of a patch are flooded from the highest pressure downwards. A cell without a higher neighbour is a new summit;
any other one goes to the basin of its highest neighbour. Where a cell joins two basins it is their saddle. They are two
fingers if the saddle is clearly lower than the lower summit: by more than noise, and by more than the unevenness of one
finger. Otherwise the lower basin becomes part of the higher one.
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray

PART_SHARE, STAY_SHARE = 0.3, 0.15
"""depth of a saddle below the lower maximum, relative to it, at which two fingers part, and stay parted: one finger is
less uneven"""
PART_STDS, STAY_STDS = 5.0, 2.5
"""the same in standard deviations of the difference between the maximum and its saddle"""
NEIGHBOURS = np.ones((3, 3), dtype=int)
"""cells that touch at a corner are connected: a finger rarely covers whole rows"""


def part(
    labels: IntArray, pressure_kpa: FloatArray, std_kpa: FloatArray, begins: BoolArray, before: IntArray
) -> IntArray:
    """Give each finger of a patch its own label.

    Args:
        labels: (rows, columns) connected patches of touched cells, from 1; 0 for the others.
        pressure_kpa: (rows, columns).
        std_kpa: (rows, columns).
        begins: (rows, columns) cells whose pressure is large enough for a contact to begin.
        before: (rows, columns) labels of the last frame: fingers that were apart then are parted more readily.

    Returns:
        (rows, columns) labels, from 1 without gaps.

    """
    from scipy import ndimage

    height = np.where(labels > 0, pressure_kpa, -np.inf)
    summits = labels[(labels > 0) & (height >= ndimage.maximum_filter(height, 3, mode="nearest"))]
    several = (np.bincount(summits) > 1).nonzero()[0].tolist()
    width = labels.shape[1] + 1
    parted, count = labels.copy(), int(labels.max(initial=0))
    for label in several:
        rows, columns = np.nonzero(labels == label)
        patch = _Patch(
            (rows * width + columns).tolist(),
            width,
            pressure_kpa[rows, columns].tolist(),
            std_kpa[rows, columns].tolist(),
            begins[rows, columns].tolist(),
            before[rows, columns].tolist(),
        )
        basins = patch.basins()
        first, *others = dict.fromkeys(basins)
        numbers = {first: label} | {summit: count + k for k, summit in enumerate(others, start=1)}
        parted[rows, columns] = [numbers[summit] for summit in basins]
        count += len(others)
    return parted


class _Patch:
    """The cells of one patch by their numbers: (n,) lists."""

    def __init__(
        self,
        places: list[int],
        width: int,
        height: list[float],
        std: list[float],
        begins: list[bool],
        before: list[int],
    ) -> None:
        """``places`` are cell numbers in rows of ``width``, which is more than there are columns."""
        self._places, self._height, self._std, self._begins, self._before = places, height, std, begins, before
        self._around = [width * down + right for down, right in product((-1, 0, 1), repeat=2) if down or right]
        self._root: dict[int, int] = {}
        """cell -> summit, or a cell nearer to it"""

    def basins(self) -> list[int]:
        """(n,) the summit to whose basin each cell belongs."""
        number, height, root = {place: k for k, place in enumerate(self._places)}, self._height, self._root
        fingers: set[tuple[int, int]] = set()
        """pairs of summits that are two fingers"""
        for cell in sorted(range(len(height)), key=lambda k: -height[k]):
            place = self._places[cell]
            higher = [k for k in [number.get(place + step, -1) for step in self._around] if k in root]
            if not higher:
                root[cell] = cell
                continue
            summits = {self._summit(one) for one in higher}
            root[cell] = min(summits)
            if len(summits) == 1:
                continue
            root[cell] = own = self._summit(max(higher, key=height.__getitem__))
            for one in summits - {own}:
                high, low = sorted((one, self._summit(cell)), key=lambda k: (-height[k], k))
                if (high, low) in fingers:
                    continue
                if self._are_fingers(high, low, cell):
                    fingers.add((high, low))
                else:
                    root[low] = high
        return [self._summit(cell) for cell in range(len(height))]

    def _summit(self, cell: int) -> int:
        while self._root[cell] != cell:
            cell = self._root[cell]
        return cell

    def _are_fingers(self, high: int, low: int, saddle: int) -> bool:
        """Whether the basin of ``low`` is a finger of its own.

        One cell that is surely higher than the saddle suffices, since the cell at the top may be uncertain for a reason
        of its own.
        """
        height, std, before = self._height, self._std, self._before
        apart = before[low] != before[high] and before[low] > 0 and before[high] > 0
        share, stds = (STAY_SHARE, STAY_STDS) if apart else (PART_SHARE, PART_STDS)
        if height[low] - height[saddle] < share * height[low]:
            return False
        own = [cell for cell in self._root if self._summit(cell) == low]
        sure = any(height[k] - height[saddle] >= stds * math.hypot(std[k], std[saddle]) for k in own)
        return sure and (apart or any(self._begins[k] for k in own))
