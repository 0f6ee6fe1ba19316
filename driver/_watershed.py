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
from ._proximity import Proximity

PART_SHARE, STAY_SHARE = 0.3, 0.15
"""depth of a saddle below the lower maximum, relative to it, at which two fingers part, and stay parted: one finger is
less uneven"""
PART_STDS, STAY_STDS = 5.0, 2.5
"""the same in standard deviations of the difference between the maximum and its saddle"""


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
    for label in several:
        cells = np.flatnonzero(labels == label)
        patch = _Patch(
            cells.tolist(),
            proximity.near[cells].tolist(),
            *(values.ravel()[cells].tolist() for values in (pressure_kpa, std_kpa, begins, before)),
        )
        basins = patch.basins()
        first, *others = dict.fromkeys(basins)
        numbers = {first: label} | {summit: count + k for k, summit in enumerate(others, start=1)}
        parted.flat[cells] = [numbers[summit] for summit in basins]
        count += len(others)
    return parted


class _Patch:
    """The cells of one patch by their numbers: (n,) lists."""

    def __init__(
        self,
        places: list[int],
        near: list[list[int]],
        height: list[float],
        std: list[float],
        begins: list[bool],
        before: list[int],
    ) -> None:
        """``places`` are cell numbers, and ``near`` those of the cells near each of them."""
        self._places, self._near = places, near
        self._height, self._std, self._begins, self._before = height, std, begins, before
        self._root: dict[int, int] = {}
        """cell -> summit, or a cell nearer to it"""

    def basins(self) -> list[int]:
        """(n,) the summit to whose basin each cell belongs."""
        number, height, root = {place: k for k, place in enumerate(self._places)}, self._height, self._root
        fingers: set[tuple[int, int]] = set()
        """pairs of summits that are two fingers"""
        for cell in sorted(range(len(height)), key=lambda k: -height[k]):
            higher = [k for k in [number.get(place, -1) for place in self._near[cell]] if k in root]
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
