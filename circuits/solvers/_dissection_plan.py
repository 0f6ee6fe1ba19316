"""The plan of a nested dissection: how a grid is cut into leaves, and which of their ports meet in each merge.

The plan depends only on the size of the grid. :mod:`._dissection` explains leaves, levels and ports.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

from ._tuning import LEAF

Label = tuple[str, int, int]
"""A node ("row" | "column", line, place). Place 0 is the line's terminal, place k the node at crosspoint k."""


class Block(NamedTuple):
    """The shape of a block, with the columns' terminals at the top.

    A block owns the segments (or leads) on its left and top. Its ports are numbered counterclockwise around its rim,
    from the top right corner: the upper ends of the columns, then the left ends of the rows. If ``bottom`` is set, the
    lowest node of each column follows; if ``right`` is set, the last node of each row follows.
    """

    rows: int
    columns: int
    bottom: bool
    right: bool

    def ports(self, row: int = 0, column: int = 0) -> list[Label]:
        """Labels of the ports of a block whose top left crosspoint is (row, column)."""
        rows, columns = range(row, row + self.rows), range(column, column + self.columns)
        labels: list[Label] = [("column", j, row) for j in reversed(columns)]
        labels += [("row", i, column) for i in rows]
        if self.bottom:
            labels += [("column", j, row + self.rows) for j in columns]
        if self.right:
            labels += [("row", i, column + self.columns) for i in reversed(rows)]
        return labels


class Run(NamedTuple):
    """Consecutive ports of one half that are consecutive in the merged pair as well."""

    half: slice
    pair: slice
    eliminated: bool
    """if true, ``pair`` indexes the eliminated nodes, otherwise the ports that remain"""


class Merge(NamedTuple):
    """The merge of pairs of equal blocks into the blocks of the next level."""

    whole: Block
    axis: int
    """0: the halves lie one above the other; 1: side by side"""
    first_runs: tuple[Run, ...]
    second_runs: tuple[Run, ...]
    eliminated: int
    """number of nodes that the merge eliminates"""


class Plan(NamedTuple):
    """Leaves and merges of a dissection. They depend only on the size of the grid."""

    leaf: Block
    down: int
    """number of leaves along a column"""
    along: int
    """number of leaves along a row"""
    merges: tuple[Merge, ...]


@lru_cache(maxsize=64)
def plan(rows: int, columns: int) -> Plan:
    """Plan the dissection of a grid. Merges double the shorter extent of the blocks, which keeps them nearly square."""
    (height, down), (width, along) = _leaves(rows), _leaves(columns)
    block = Block(height, width, bottom=True, right=True)
    result = Plan(block, down, along, ())
    while down > 1 or along > 1:
        axis = 1 if along > 1 and (down == 1 or block.columns <= block.rows) else 0
        start = (0, block.columns) if axis else (block.rows, 0)
        down, along = (down, along // 2) if axis else (down // 2, along)
        whole = Block(block.rows + start[0], block.columns + start[1], bottom=down > 1, right=along > 1)
        result = result._replace(merges=(*result.merges, _merge(whole, block, start, axis)))
        block = whole
    return result


def _leaves(length: int) -> tuple[int, int]:
    """Side of the leaves along an axis of ``length`` crosspoints, and the number of leaves."""
    count = 1
    while math.ceil(length / count) > LEAF:
        count *= 2
    return math.ceil(length / count), count


def _merge(whole: Block, half: Block, start: tuple[int, int], axis: int) -> Merge:
    first, second, stay = half.ports(), half.ports(*start), whole.ports()
    met = set(first) & set(second)
    gone = [label for label in first if label in met]
    place = {label: (k, True) for k, label in enumerate(gone)} | {label: (k, False) for k, label in enumerate(stay)}
    first_runs, second_runs = (_runs([place.get(label) for label in labels]) for labels in (first, second))
    return Merge(whole, axis, first_runs, second_runs, len(gone))


def _runs(places: list[tuple[int, bool] | None]) -> tuple[Run, ...]:
    """Group consecutive ports with consecutive places, ascending or descending; ports without a place are dropped."""
    runs, start = [], 0
    while start < len(places):
        at = places[start]
        if at is None:
            start += 1
            continue
        place, gone = at
        end = start + 1
        following = places[end] if end < len(places) else None
        step = following[0] - place if following is not None and following[1] == gone else 0
        if abs(step) == 1:
            while end < len(places) and places[end] == (place + step * (end - start), gone):
                end += 1
        length = end - start
        if length > 1 and step == -1:
            last = place - length
            pair = slice(place, last if last >= 0 else None, -1)
        else:
            pair = slice(place, place + length)
        runs.append(Run(slice(start, end), pair, gone))
        start = end
    return tuple(runs)
