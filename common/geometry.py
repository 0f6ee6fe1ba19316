"""Where the cells of a skin are: places and areas, holes, and which cells are neighbours (proximity graph).

A flat rectangle, an insole and a sleeve are all the same here: points in two or three dimensions. Two cells lie side by
side if no third one lies between them: if none sees them under an angle of about 90 degrees or more (Gabriel graph;
Gabriel and Sokal 1969), and no gap parts them. Two cells are near if they lie side by side, or both beside a third one
that sees them under about a right angle at most, like cells that touch at a corner. On a rectangle these are the
neighbourhoods of 4 and of 8 cells, in a honeycomb both are the six neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .arrays import BoolArray, FloatArray, IntArray

SIDE_DEGREES, CORNER_DEGREES = 80.0, 100.0
"""angles from which a third cell lies between two: below and above the right angle under which a corner of a rectangle
sees the diagonal, so that unevenness of some degrees changes no neighbours"""
OPPOSITE_DEGREES = 135.0
"""angle at a cell between neighbours that lie on opposite sides of it"""
GAP = 1.6
"""distance of neighbours, over the usual one at either end, above which a gap parts them"""
OBLONG = 3.5
"""largest ratio of the distances along and across a line of cells; where lines are further apart there is a gap"""
NEAREST = 24
"""cells around a cell among which its neighbours are looked for: all that lie within OBLONG of it on a rectangle"""
AT_ONCE = 1024
"""cells whose surroundings are looked at together, in some MB"""


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Neighbours of the cells of the flattened array. A row is filled up with the number of cells, which is no cell."""

    beside: IntArray
    """(cells, most) cells side by side with each cell"""
    near: IntArray
    """(cells, most) these first, then those at its corners"""
    opposite: IntArray
    """(n, 3) a cell and two of its neighbours on opposite sides of it"""
    shortest_mm: FloatArray
    """(cells,) to the nearest of the cells beside; 0 where there is none"""
    longest_mm: FloatArray
    """(cells,) to the furthest of these"""


@dataclass(frozen=True, eq=False)
class Geometry:
    """Places and areas of the cells of an array. Arrays are (rows, columns) and read-only."""

    places_mm: FloatArray
    """(rows, columns, 2 or 3) x, y and maybe z of the cells' middles; NaN where there is no cell"""
    areas_mm2: FloatArray
    """0 where there is no cell"""
    pitch_m: tuple[float, float] | None = None
    """of a rectangle: distance of neighbouring cells along a row (x), and along a column (y); None: no rectangle"""

    def __reduce__(self) -> tuple[type[Geometry], tuple[FloatArray, FloatArray, tuple[float, float] | None]]:
        """For pickle and copy: without what follows from the places."""
        return Geometry, (self.places_mm, self.areas_mm2, self.pitch_m)

    def __deepcopy__(self, memo: object) -> Geometry:
        """Itself, as nothing in it changes."""
        return self

    def __post_init__(self) -> None:
        for array in (self.places_mm, self.areas_mm2):
            array.setflags(write=False)

    @classmethod
    def rectangle(cls, shape: tuple[int, ...], pitch_m: float | tuple[float, float]) -> Geometry:
        """Rows and columns at equal distances, from the middle of cell (0, 0): x along a row, y along a column."""
        rows, columns = np.indices(shape)
        x_m, y_m = pitch_m if isinstance(pitch_m, tuple) else (pitch_m, pitch_m)
        places = np.stack([1e3 * x_m * columns, 1e3 * y_m * rows], axis=-1)
        return cls(places, np.full(shape, 1e6 * x_m * y_m), (x_m, y_m))

    @classmethod
    def of(
        cls, shape: tuple[int, int], cells: IntArray, places_mm: FloatArray, areas_mm2: FloatArray | None
    ) -> Geometry:
        """Cells at places of their own.

        Args:
            shape: rows and columns of the array.
            cells: (n, 2) row and column of each cell that there is.
            places_mm: (n, 2 or 3), no two at one place.
            areas_mm2: (n,); None: each cell is as long and as wide as its neighbours are away.

        """
        places = np.full((*shape, places_mm.shape[1]), np.nan)
        places[tuple(cells.T)] = places_mm
        areas = np.zeros(shape)
        if areas_mm2 is None:
            found = cls(places, areas).neighbours
            own = found.shortest_mm * found.longest_mm
            alone = own == 0
            own[alone] = np.median(own[~alone]) if not alone.all() else 1.0
            areas_mm2 = own.reshape(shape)[tuple(cells.T)]
        areas = np.zeros(shape)
        areas[tuple(cells.T)] = areas_mm2
        return cls(places, areas)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self.areas_mm2.shape
        return rows, columns

    @cached_property
    def exists(self) -> BoolArray:
        """Where there is a cell."""
        there: BoolArray = np.isfinite(self.places_mm[..., 0])
        there.setflags(write=False)
        return there

    @cached_property
    def is_whole(self) -> bool:
        """Whether there is a cell at every crossing."""
        return bool(self.exists.all())

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the coordinates: x_mm, y_mm, and z_mm in space."""
        return ("x_mm", "y_mm", "z_mm")[: self.places_mm.shape[-1]]

    @cached_property
    def neighbours(self) -> Neighbours:
        """Which cells are neighbours."""
        return _neighbours(self)


def _neighbours(geometry: Geometry) -> Neighbours:
    count = geometry.areas_mm2.size
    there = np.flatnonzero(geometry.exists)
    places = geometry.places_mm.reshape(count, -1)[there]
    pairs, lengths = _edges(places)
    beside = _listed(pairs, lengths, len(places))
    corners = _corners(places, beside)
    shortest, longest = np.zeros(count), np.zeros(count)
    ends, twice = pairs.ravel(), np.repeat(lengths, 2)
    nearest = np.full(len(places), np.inf)
    furthest = np.zeros(len(places))
    np.minimum.at(nearest, ends, twice)
    np.maximum.at(furthest, ends, twice)
    shortest[there], longest[there] = np.where(np.isfinite(nearest), nearest, 0.0), furthest
    near = _listed(
        np.concatenate([pairs, corners]), np.concatenate([lengths, np.full(len(corners), np.inf)]), len(places)
    )
    number = np.append(there, count)  # of those that exist, and of none
    side, around = (_spread(number[rows], there, count) for rows in (beside, near))
    return Neighbours(side, around, number[_opposite(places, beside)], shortest, longest)


def _edges(places: FloatArray) -> tuple[IntArray, FloatArray]:
    """Pairs (m, 2) of cells side by side, and their distances (m,)."""
    from scipy.spatial import cKDTree

    count, most = len(places), min(NEAREST, len(places) - 1)
    if most < 1:
        return np.empty((0, 2), dtype=np.intp), np.empty(0)
    found = cKDTree(places).query(places, most + 1)
    distance, others = (np.asarray(table)[:, 1:] for table in found)
    own = np.arange(count)
    clear = np.empty((count, most), dtype=np.bool_)
    for start in range(0, count, AT_ONCE):
        some = slice(start, start + AT_ONCE)
        clear[some] = _clear(places[some], places[others[some]], SIDE_DEGREES)
    # Third cells were looked for around one end only; a pair counts if it is clear as seen from both ends.
    forth = np.repeat(own, most)[clear.ravel()] * count + others[clear]
    back = others[clear] * count + np.repeat(own, most)[clear.ravel()]
    both = np.isin(forth, back)
    pairs = np.stack(np.divmod(forth[both], count), axis=1)
    lengths = distance[clear][both]
    kept = (lengths <= GAP * _usual(places, pairs, lengths)) & (pairs[:, 0] < pairs[:, 1])
    return pairs[kept], lengths[kept]


def _clear(ends: FloatArray, others: FloatArray, degrees: float) -> BoolArray:
    """(n, m) whether none of ``others`` (n, m, d) lies between ``ends`` (n, d) and each other one of them."""
    away = others - ends[:, None]  # (n, m, d)
    towards = others[:, None, :, :] - others[:, :, None, :]  # (n, third, other, d)
    along = -np.einsum("nkd,nkmd->nkm", away, towards)
    lengths = np.linalg.norm(away, axis=-1)[:, :, None] * np.linalg.norm(towards, axis=-1)
    angle_is_wide = along <= np.cos(np.radians(degrees)) * lengths
    each = np.arange(others.shape[1])
    angle_is_wide[:, each, each] = False  # a cell is not between itself and another
    clear: BoolArray = ~angle_is_wide.any(axis=1)
    return clear


def _usual(places: FloatArray, pairs: IntArray, lengths: FloatArray) -> FloatArray:
    """(m,) usual distance of neighbours at the ends of each pair, the smaller of the two.

    That is the distance to the nearest neighbour; or, where lines of cells are further apart than the cells of a line,
    the one across the lines.
    """
    count = len(places)
    ahead = (places[pairs[:, 1]] - places[pairs[:, 0]]) / lengths[:, None]
    order = np.lexsort((lengths, pairs[:, 0]))
    first = order[np.unique(pairs[order, 0], return_index=True)[1]]  # the shortest pair of each cell
    nearest, direction = np.full(count, np.inf), np.zeros((count, places.shape[1]))
    nearest[pairs[first, 0]], direction[pairs[first, 0]] = lengths[first], ahead[first]
    across = np.abs((ahead * direction[pairs[:, 0]]).sum(axis=1)) < np.cos(np.radians(45.0))
    second = np.full(count, np.inf)
    np.minimum.at(second, pairs[across, 0], lengths[across])
    usual = np.where(second <= OBLONG * nearest, np.maximum(second, nearest), nearest)
    smaller: FloatArray = usual[pairs].min(axis=1)
    return smaller


def _listed(pairs: IntArray, lengths: FloatArray, count: int) -> IntArray:
    """(cells, most) neighbours of each cell by distance, filled up with ``count``."""
    if not len(pairs):
        return np.full((count, 1), count, dtype=np.intp)
    both, twice = np.concatenate([pairs, pairs[:, ::-1]]), np.concatenate([lengths, lengths])
    both = both[np.lexsort((both[:, 1], twice, both[:, 0]))]
    ends = np.bincount(both[:, 0], minlength=count)
    starts = np.concatenate(([0], np.cumsum(ends)[:-1]))
    listed = np.full((count, int(ends.max())), count, dtype=np.intp)
    listed[both[:, 0], np.arange(len(both)) - starts[both[:, 0]]] = both[:, 1]
    return listed


def _corners(places: FloatArray, beside: IntArray) -> IntArray:
    """Pairs (m, 2) of cells that are not side by side, but both beside a third one, which sees no wide angle."""
    count, most = beside.shape
    ends = np.stack([np.repeat(beside, most, axis=1).ravel(), np.tile(beside, (1, most)).ravel()], axis=1)
    third = np.repeat(np.arange(count), most * most)
    kept = (ends[:, 0] < ends[:, 1]) & (ends < count).all(axis=1)
    ends, third = ends[kept], third[kept]
    one, other = (places[ends[:, k]] - places[third] for k in (0, 1))
    lengths = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
    sees = (one * other).sum(axis=1) >= np.cos(np.radians(CORNER_DEGREES)) * lengths
    names = ends[:, 0] * (count + 1) + ends[:, 1]
    blocked = np.unique(names[~sees])
    own = np.repeat(np.arange(count), most) * (count + 1) + beside.ravel()
    found = np.unique(names[sees])
    found = found[~np.isin(found, blocked) & ~np.isin(found, own)]
    return np.stack(np.divmod(found, count + 1), axis=1)


def _opposite(places: FloatArray, beside: IntArray) -> IntArray:
    """(n, 3) a cell and two of its neighbours on opposite sides of it."""
    count, most = beside.shape
    one, other = np.repeat(beside, most, axis=1), np.tile(beside, (1, most))
    cell = np.broadcast_to(np.arange(count)[:, None], one.shape)
    kept = (one < other) & (other < count)
    cell, one, other = cell[kept], one[kept], other[kept]
    first, second = places[one] - places[cell], places[other] - places[cell]
    lengths = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    apart = (first * second).sum(axis=1) <= np.cos(np.radians(OPPOSITE_DEGREES)) * lengths
    found: IntArray = np.stack([cell, one, other], axis=1)[apart]
    return found


def _spread(rows: IntArray, there: IntArray, count: int) -> IntArray:
    """The lists of the cells that exist, as lists of all cells of the array."""
    spread = np.full((count, rows.shape[1]), count, dtype=np.intp)
    spread[there] = rows
    return spread
