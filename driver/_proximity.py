"""Kernels on the neighbours of cells: connected components, maxima, and what neighbours say together.

Cells are those of the flattened array. ``near`` (cells, most) are the neighbours of each one, as
:attr:`ohmskin.common.geometry.Neighbours.near`; the number of cells stands for none.
"""

from __future__ import annotations

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..common.compiled import FixedRow, Flags, PlaceRows, Places, Row, Rows, loop
from ..common.geometry import Geometry

TOGETHER_STDS = 2.0
"""a contact also begins where the mean of neighbouring cells, weighted like a fingertip, exceeds this many times the
mean of their standard deviations. Neighbours share their history, so their errors are taken for common ones. The mean
without the cell's row, and without its column, must exceed it, too: faults of wires and converters move one line"""
BESIDE, AT_CORNER = 0.5, 0.25
"""weights of the cells beside a cell and at its corners under a fingertip; its own weight is 1"""
TIE = 1e-6
"""relative difference of distances that are equal but for rounding"""


class Proximity:
    """Who is near whom on a skin, for the kernels below."""

    def __init__(self, geometry: Geometry) -> None:
        neighbours, count = geometry.neighbours, geometry.areas_mm2.size
        self.near = neighbours.near
        self.beside = neighbours.beside
        self.opposite = neighbours.opposite
        self.places_mm = geometry.places_mm.reshape(count, -1).copy()  # kernels take arrays that may be written to
        """(cells, 2 or 3)"""
        self.areas_mm2 = geometry.areas_mm2.ravel()
        alone_mm = np.sqrt(self.areas_mm2)
        longest = np.where(neighbours.longest_mm > 0, neighbours.longest_mm, alone_mm)
        shortest = np.where(neighbours.shortest_mm > 0, neighbours.shortest_mm, alone_mm)
        self.longest_mm = longest
        """(cells,) to the furthest cell beside"""
        self.pitch_mm = (shortest + longest) / 2
        """(cells,) usual distance of the cells beside"""
        self._columns = geometry.shape[1]
        self._weights = np.where(self.near < count, AT_CORNER, 0.0)
        is_beside = (self.near[:, :, None] == neighbours.beside[:, None, :]).any(axis=-1)
        self._weights[is_beside & (self.near < count)] = BESIDE
        self._waiting = np.empty(count, dtype=np.intp)

    def __deepcopy__(self, memo: object) -> Proximity:
        """Itself, as nothing in it changes that lasts."""
        return self

    def label(self, wanted: BoolArray) -> tuple[IntArray, int]:
        """Connected patches of cells (rows, columns): numbers from 1 in the order of their first cells, 0 elsewhere."""
        labels = np.zeros(wanted.shape, dtype=np.intp)
        return labels, label_each(np.ascontiguousarray(wanted).ravel(), self.near, self._waiting, labels.ravel())

    def largest_around(self, values: FloatArray) -> FloatArray:
        """(rows, columns) largest of the value of each cell and of those near it."""
        largest = values.copy()
        largest_around_each(values.ravel(), self.near, largest.ravel())
        return largest

    def together(self, asked: BoolArray, own_kpa: FloatArray, std_kpa: FloatArray) -> BoolArray:
        """(rows, columns) those of the ``asked`` cells that are loaded by what their neighbours say together."""
        loaded = asked.copy()
        together_each(own_kpa.ravel(), std_kpa.ravel(), self.near, self._weights, self._columns, loaded.ravel())
        return loaded

    def summits(self, labels: IntArray, height: FloatArray, count: int) -> IntArray:
        """(count + 1,) for each label the number of its cells that no cell near them is higher than."""
        found = np.zeros(count + 1, dtype=np.intp)
        summits_each(labels.ravel(), np.ascontiguousarray(height).ravel(), self.near, found)
        return found

    def nearest(self, labels: IntArray, around: BoolArray, force: FloatArray) -> IntArray:
        """(rows, columns) for ``around`` cells the label that is nearest, of equally near ones that of most force.

        Args:
            labels: (rows, columns) from 1; 0: none.
            around: (rows, columns) cells without a label.
            force: (labels + 1,) of each label.

        """
        found = np.zeros(labels.shape, dtype=np.intp)
        nearest_each(
            labels.ravel(), np.flatnonzero(around), np.flatnonzero(labels), self.places_mm, force, found.ravel()
        )
        return found


@loop
def label_each(wanted: Flags, near: PlaceRows, waiting: Places, labels: Places) -> int:
    """Flood one patch after the other; ``waiting`` has room for all cells."""
    count, none = 0, wanted.shape[0]
    for first in range(none):
        if not wanted[first] or labels[first] > 0:
            continue
        count += 1
        labels[first] = count
        waiting[0] = first
        left = 1
        while left > 0:
            left -= 1
            cell = waiting[left]
            for k in range(near.shape[1]):
                other = near[cell, k]
                if other == none:
                    break
                if wanted[other] and labels[other] == 0:
                    labels[other] = count
                    waiting[left] = other
                    left += 1
    return count


@loop
def largest_around_each(values: Row, near: PlaceRows, largest: Row) -> None:
    """Write what :meth:`Proximity.largest_around` returns."""
    none = values.shape[0]
    for cell in range(none):
        for k in range(near.shape[1]):
            other = near[cell, k]
            if other == none:
                break
            largest[cell] = max(largest[cell], values[other])


@loop
def together_each(own: Row, std: Row, near: PlaceRows, weights: Rows, columns: int, loaded: Flags) -> None:
    """Take out the cells that their neighbours do not confirm."""
    none = own.shape[0]
    for cell in range(none):
        if not loaded[cell]:
            continue
        load, spread = own[cell], std[cell]
        load_beyond_row, spread_beyond_row, load_beyond_column, spread_beyond_column = 0.0, 0.0, 0.0, 0.0
        for k in range(near.shape[1]):
            other = near[cell, k]
            if other == none:
                break
            more, more_spread = weights[cell, k] * own[other], weights[cell, k] * std[other]
            load, spread = load + more, spread + more_spread
            if other // columns != cell // columns:
                load_beyond_row += more
                spread_beyond_row += more_spread
            if other % columns != cell % columns:
                load_beyond_column += more
                spread_beyond_column += more_spread
        loaded[cell] = (
            load > TOGETHER_STDS * spread
            and load_beyond_row > TOGETHER_STDS * spread_beyond_row
            and load_beyond_column > TOGETHER_STDS * spread_beyond_column
        )


@loop
def summits_each(labels: Places, height: FixedRow, near: PlaceRows, found: Places) -> None:
    """Write what :meth:`Proximity.summits` returns."""
    none = labels.shape[0]
    for cell in range(none):
        if labels[cell] == 0:
            continue
        top = True
        for k in range(near.shape[1]):
            other = near[cell, k]
            if other == none:
                break
            if labels[other] > 0 and height[other] > height[cell]:
                top = False
                break
        if top:
            found[labels[cell]] += 1


@loop
def nearest_each(labels: Places, around: Places, touched: Places, places_mm: Rows, force: Row, found: Places) -> None:
    """Write what :meth:`Proximity.nearest` returns."""
    for cell in around:
        least = np.inf
        for other in touched:
            square = 0.0
            for axis in range(places_mm.shape[1]):
                square += (places_mm[cell, axis] - places_mm[other, axis]) ** 2
            nearer = square < (1.0 - TIE) * least
            if nearer or (square <= (1.0 + TIE) * least and force[labels[other]] > force[found[cell]]):
                least = square if nearer else least
                found[cell] = labels[other]
