"""Nested dissection of a grid: Kron reduction to the grid's ports, block by block.

Nested dissection (George, SIAM Journal on Numerical Analysis 10, 1973) orders the elimination of a grid's nodes. The
grid is cut into small blocks, the *leaves*. The inner nodes of the leaves are eliminated first. Neighbouring blocks are
then merged in pairs, level by level, up to the whole grid. A merge eliminates the nodes at which two blocks meet. Each
block is known only by the conductances between its *ports*, the nodes where lines leave the block. An n x n grid costs
O(n^3); eliminating line after line costs O(n^4).

**Leaves.** All leaves have the same shape. They have at most :data:`LEAF` crosspoints a side, and their number along
each axis is a power of two. Leaves that reach past the grid are padded with zero conductances. All leaves are
eliminated together by star-mesh transformations.

**Levels.** All blocks of a level have the same shape, in all frames of a batch. Each level is therefore one array, and
one merge computes the next level. At the far rim of the grid, where the lines end, the outermost leaves have ports
to which no further block connects. We eliminate these ports together with the leaves. Their conductances become zero,
and later merges drop them.

**Ports.** The ports of a block are numbered in order around its rim. The ports that two blocks share are then slices,
not index lists, and most of the time goes into matrix products. The slices and the memory of a dissection are prepared
once and reused for all frames of the same size, because fresh memory costs more time than the arithmetic in it.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...arrays import BoolArray, FloatArray, IntArray
from ._elimination import ULP, inverted

LEAF = 5  # largest number of crosspoints along the side of a leaf
_CHUNK_SIZE = 1 << 16  # conductances of the leaves that are eliminated together; they fit into the processor's cache
_MOSTLY_CHANGED = 0.6  # share of changed blocks above which merging the whole level is faster
_CACHE_SIZE = 1 << 24  # numbers that each thread keeps in memory between calls (128 MB)

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


class Step(NamedTuple):
    """Star-mesh transformation of several nodes of a leaf at once.

    An *arm* is a branch from an eliminated node to a neighbour. All nodes of a step have the same number of arms, and
    no two of them add to the same branch. Each pair of arms of a node gives one branch between two neighbours.
    """

    arms: IntArray
    """(arms, nodes) indices of the branches to the neighbours"""
    first_arm: IntArray
    """(pairs,) first arm of each pair, as an index into ``arms`` flattened"""
    second_arm: IntArray
    """(pairs,) second arm of each pair, likewise"""
    created: slice
    """new branches, made by the first pairs"""
    increased: IntArray
    """existing branches, to which the remaining pairs add"""


class Leaf(NamedTuple):
    """Elimination of the inner nodes of a leaf by star-mesh transformations, as a list of index arrays.

    The branches of the grid come first: the cells, then the segments on the left of each crosspoint, then the segments
    above each crosspoint, each of them row by row. Branches that the elimination creates follow.
    """

    branches: int
    """number of branches, including those that the elimination creates; index ``branches`` stands for a zero branch"""
    steps: tuple[Step, ...]
    result: IntArray
    """(ports * ports,) index of the branch between each two ports"""
    widest: int
    """largest number of branches or pairs in one operation"""
    relative: float
    """bound on the relative rounding error of any branch"""


@lru_cache(maxsize=64)
def leaf(block: Block) -> Leaf:
    """Plan the elimination of a leaf by minimum degree: nodes with the fewest arms go first."""
    shape = block.rows, block.columns
    ends: list[tuple[Label, Label]] = []
    ends += [(("row", i, j + 1), ("column", j, i + 1)) for i, j in np.ndindex(shape)]
    ends += [(("row", i, j), ("row", i, j + 1)) for i, j in np.ndindex(shape)]
    ends += [(("column", j, i), ("column", j, i + 1)) for i, j in np.ndindex(shape)]
    number = {frozenset(pair): k for k, pair in enumerate(ends)}
    around: dict[Label, set[Label]] = {}
    for a, b in ends:
        around.setdefault(a, set()).add(b)
        around.setdefault(b, set()).add(a)
    ports = block.ports()
    inner = sorted(set(around) - set(ports))
    steps, operations = [], 0
    while inner:
        nodes = _independent(inner, around)
        arms = [sorted(around[node]) for node in nodes]
        pairs = [
            (p * len(nodes) + k, q * len(nodes) + k, frozenset((arms[k][p], arms[k][q])))
            for p, q in zip(*np.triu_indices(len(arms[0]), 1), strict=True)
            for k in range(len(nodes))
        ]
        pairs.sort(key=lambda pair: pair[2] in number)
        start = len(number)
        for *_, joined in pairs:
            number.setdefault(joined, len(number))
        fresh = slice(start, len(number))
        joins = [
            [number[frozenset((node, arm))] for node, arm in zip(nodes, some, strict=True)]
            for some in zip(*arms, strict=True)
        ]
        one, other, gains = (list(column) for column in zip(*pairs, strict=True))
        old = [number[joined] for joined in gains[fresh.stop - start :]]
        steps.append(Step(_index_array(joins), _index_array(one), _index_array(other), fresh, _index_array(old)))
        operations += len(arms[0]) + 3
        for node in nodes:
            inner.remove(node)
            neighbours = around.pop(node)
            for arm in neighbours:
                around[arm].remove(node)
                around[arm].update(neighbours - {arm})
    result = _index_array([number.get(frozenset((a, b)), len(number)) for a in ports for b in ports])
    most = max(len(result), *(max(len(step.first_arm), step.arms.size) for step in steps), 1)
    return Leaf(len(number), tuple(steps), result, most, ULP * operations)


def _index_array(numbers: list[int] | list[list[int]]) -> IntArray:
    return np.array(numbers, dtype=np.intp)


def _independent(inner: list[Label], around: dict[Label, set[Label]]) -> list[Label]:
    """Nodes of minimum degree that can be eliminated together: no two are neighbours or share two neighbours."""
    fewest = min(len(around[node]) for node in inner)
    chosen: list[Label] = []
    for node in inner:
        apart = all(node not in around[other] and len(around[node] & around[other]) < 2 for other in chosen)
        if len(around[node]) == fewest and apart:
            chosen.append(node)
    return chosen


def _reduce_leaves(
    block: Block, given: FloatArray, rims: list[tuple[slice, IntArray]], out: FloatArray, scratch: FloatArray
) -> FloatArray:
    """Eliminate the inner nodes of leaves.

    Args:
        block: shape of the leaves.
        given: (branches, leaves) S of the branches of the grid, in the order of :class:`Leaf`.
        rims: slices of ports to eliminate as well, each with the leaves at the grid's far rim that have them.
        out: (leaves, p, p) S between the ports; receives the result.
        scratch: working memory, of the size that :func:`_leaf_scratch` tells.

    Returns:
        (leaves,) bounds on the relative rounding errors.

    """
    program = leaf(block)
    ports = out.shape[-1]
    chunk = _leaf_chunk(program, given.shape[1])
    size = program.widest * chunk
    one_work, other_work, third_work, value_work = (scratch[k * size :] for k in range(4))
    for start in range(0, given.shape[1], chunk):
        some = given[:, start : start + chunk]
        leaves = some.shape[1]

        def view(work: FloatArray, count: int, leaves: int = leaves) -> FloatArray:
            return work[: count * leaves].reshape(count, leaves)

        value = view(value_work, program.branches + 1)
        value[: len(some)] = some
        value[-1] = 0.0
        for arms, first_arm, second_arm, created, increased in program.steps:
            arm = np.take(value, arms.ravel(), axis=0, out=view(one_work, arms.size), mode="clip")
            share = arm.reshape(*arms.shape, leaves)
            first = np.take(arm, first_arm, axis=0, out=view(other_work, len(first_arm)), mode="clip")
            total = share.sum(axis=0)
            if not total.all():
                total[total == 0] = 1.0
            share /= total
            gain = np.take(arm, second_arm, axis=0, out=view(third_work, len(first_arm)), mode="clip")
            gain *= first
            new = created.stop - created.start
            value[created] = gain[:new]
            if len(increased):
                value[increased] += gain[new:]
        result = np.take(value, program.result, axis=0, out=view(one_work, ports * ports), mode="clip")
        out[start : start + leaves].reshape(leaves, -1)[...] = result.T
    relative = np.full(len(out), program.relative)
    for gone, places in rims:
        blocks = out[places]
        relative[places] += _eliminate_ports(blocks, gone)
        out[places] = blocks
    return relative


def _leaf_chunk(program: Leaf, leaves: int) -> int:
    return max(1, min(leaves, _CHUNK_SIZE // program.branches))


def _leaf_scratch(block: Block, leaves: int) -> int:
    """Size of the working memory for so many leaves."""
    program = leaf(block)
    return (3 * program.widest + program.branches + 1) * _leaf_chunk(program, leaves)


def _eliminate_ports(blocks: FloatArray, gone: slice) -> FloatArray:
    """Eliminate some ports of blocks (..., p, p) in place. Their conductances become zero.

    Returns:
        (...,) bounds on the relative rounding errors.

    """
    across = blocks[..., gone, :].copy()
    between = across[..., gone].copy()
    across[..., gone] = 0.0
    inverse, relative = inverted(between, across.sum(axis=-1), blocks.shape[-1] - between.shape[-1])
    blocks += np.swapaxes(across, -1, -2) @ (inverse @ across)
    blocks[..., gone, :] = 0.0
    blocks[..., gone] = 0.0
    np.einsum("...ii->...i", blocks)[...] = 0.0
    return relative


class _Join:
    """One merge of two stacks of halves (..., p, p) into a stack of pairs, with all slices prepared.

    The nodes at which the halves meet are eliminated by their Schur complement. The methods name the blocks of the
    nodal matrix: ``between`` is among the eliminated nodes, ``across`` from these to the ports that remain.
    """

    def __init__(
        self, merge: Merge, first: FloatArray, second: FloatArray, out: FloatArray, scratch: FloatArray
    ) -> None:
        """Prepare the slices.

        Args:
            merge: what is merged.
            first: (..., p, p) S of the first halves.
            second: (..., p, p) S of the second halves.
            out: (..., ports, ports) S of the pairs. If its shape is (..., rows, columns), only the conductances between
                rows and columns are computed.
            scratch: working memory, of the size that :func:`_scratch` tells.

        """
        whole, gone = merge.whole, merge.eliminated
        stack, ports = first.shape[:-2], len(whole.ports())
        transfer_only = out.shape[-1] != ports
        top = whole.columns if transfer_only else 0
        ahead, behind = math.prod(stack) * gone * (gone + ports), math.prod(stack) * gone * (top or ports)
        self._rows = scratch[:ahead].reshape(*stack, gone, gone + ports)
        self._between, self._across = self._rows[..., :gone], self._rows[..., gone:]
        self._volts = scratch[ahead : ahead + behind].reshape(*stack, gone, -1)
        self._driven = self._across[..., :top] if transfer_only else self._across
        self._read = np.swapaxes(self._across[..., top:], -1, -2)
        self._out, self._ports, self._transfer_only = out, ports, transfer_only
        self._copied: list[tuple[FloatArray, FloatArray]] = []
        self._added: list[tuple[FloatArray, FloatArray]] = []
        self._staying: list[tuple[FloatArray, FloatArray]] = []
        for half, runs in ((first, merge.first_runs), (second, merge.second_runs)):
            for a in runs:
                for b in runs:
                    part = half[..., a.half, b.half]
                    if a.eliminated and b.eliminated:
                        (self._added if half is second else self._copied).append(
                            (self._between[..., a.pair, b.pair], part)
                        )
                    elif a.eliminated:
                        self._copied.append((self._across[..., a.pair, b.pair], part))
                    elif not b.eliminated and not transfer_only:
                        self._staying.append((out[..., a.pair, b.pair], part))
        if transfer_only:  # only the first half has both rows and columns that remain
            rows, columns = (side // (1 + (axis == merge.axis)) for axis, side in enumerate(whole[:2]))
            part = first[..., columns : columns + rows, :columns]
            self._staying.append((out[..., :rows, whole.columns - columns :], part))

    def run(self) -> FloatArray:
        """Merge; returns bounds (...,) on the relative rounding errors of this merge alone."""
        for to, part in self._copied:
            to[...] = part
        for to, part in self._added:
            np.add(to, part, out=to)
        inverse, relative = inverted(self._between, np.einsum("...ij->...i", self._across), self._ports)
        np.matmul(inverse, self._driven, out=self._volts)
        np.matmul(self._read, self._volts, out=self._out)
        for to, part in self._staying:
            np.add(to, part, out=to)
        if not self._transfer_only:
            np.einsum("...ii->...i", self._out)[...] = 0.0
        return relative


def _joins(work: Plan, stacks: list[FloatArray], scratch: FloatArray) -> list[_Join]:
    """The merges of all levels, each from one stack (frames, down, along, ...) into the next."""
    levels = zip(work.merges, stacks, stacks[1:], strict=False)
    return [_Join(merge, *_halves(merge.axis, below), above, scratch) for merge, below, above in levels]


class Dissection:
    """The dissection of a batch of frames of one size: prepared merges, and their memory."""

    def __init__(self, frames: int, rows: int, columns: int, transfer_only: bool) -> None:
        self._plan = work = plan(rows, columns)
        self._grid = frames, rows, columns
        leaves = frames * work.down * work.along
        shapes = list(_stacks(work, frames))
        if transfer_only and work.merges:
            shapes[-1] = (frames, 1, 1, *work.merges[-1].whole[:2])
        sizes = [math.prod(shape) for shape in shapes]
        # Odd and even levels share one buffer each: a merge reads one buffer and writes the other.
        turns = [np.empty(max(sizes[turn::2], default=0)) for turn in range(2)]
        stacks = [turns[k % 2][:size].reshape(shape) for k, (size, shape) in enumerate(zip(sizes, shapes, strict=True))]
        self._scratch = np.empty(_scratch(work, frames))
        self._given = np.zeros((3 * work.leaf.rows * work.leaf.columns, frames, work.down, work.along))
        self._far_rims = _far_rims(work, rows, columns, np.ones((frames, work.down, work.along), dtype=np.bool_))
        self._leaves = stacks[0].reshape(leaves, *stacks[0].shape[-2:])
        self._joins = _joins(work, stacks, self._scratch)
        self._root = stacks[-1][:, 0, 0]
        self.size = sum(turn.size for turn in turns) + self._scratch.size + self._given.size

    def run(self, cells: FloatArray, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Dissect frames.

        Args:
            cells: (frames, N, M) S.
            row: (N, M) S on the left of each crosspoint.
            column: (N, M) S above each crosspoint.

        Returns:
            (frames, ...) S of the last level, padding included, and bounds (frames,) on the relative rounding errors.
            The first array is overwritten by the next call.

        """
        _fill_leaves(self._plan, (cells, row[None], column[None]), self._given)
        given = self._given.reshape(len(self._given), -1)
        relative = _reduce_leaves(self._plan.leaf, given, self._far_rims, self._leaves, self._scratch)
        relative = relative.reshape(self._given.shape[1:])
        for merge, join in zip(self._plan.merges, self._joins, strict=True):
            relative = np.maximum(*_halves(merge.axis, relative)) + join.run()
        return self._root, relative[:, 0, 0]


def _stacks(work: Plan, frames: int) -> Iterator[tuple[int, ...]]:
    """Shapes (frames, down, along, ports, ports) of the stacks of blocks, from the leaves up."""
    down, along, ports = work.down, work.along, len(work.leaf.ports())
    yield frames, down, along, ports, ports
    for merge in work.merges:
        down, along = (down, along // 2) if merge.axis else (down // 2, along)
        ports = len(merge.whole.ports())
        yield frames, down, along, ports, ports


def _scratch(work: Plan, frames: int) -> int:
    """Size of the working memory that suffices for every level."""
    most = _leaf_scratch(work.leaf, frames * work.down * work.along)
    for merge, (*stack, ports, _) in zip(work.merges, list(_stacks(work, frames))[1:], strict=True):
        most = max(most, math.prod(stack) * merge.eliminated * (merge.eliminated + 2 * ports))
    return most


def _halves(axis: int, stack: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """First and second halves of all pairs in a stack (frames, down, along, ...), as views."""
    if axis:
        return stack[:, :, 0::2], stack[:, :, 1::2]
    return stack[:, 0::2], stack[:, 1::2]


def _fill_leaves(work: Plan, parts: tuple[FloatArray, ...], given: FloatArray) -> None:
    """Copy the conductances of grids into the branches of their leaves, padded with zeros.

    Args:
        work: the plan.
        parts: cells, row segments and column segments, each (frames or 1, N, M) S.
        given: (branches, frames, down, along) S; receives the result.

    """
    block = work.leaf
    into = given.reshape(3, block.rows, block.columns, *given.shape[1:])
    filled = block.rows * work.down, block.columns * work.along
    for to, part in zip(into, parts, strict=True):
        if part.shape[1:] != filled:
            padded = np.zeros((len(part), *filled))
            padded[:, : part.shape[1], : part.shape[2]] = part
            part = padded  # noqa: PLW2901  # the same array, padded
        to[...] = part.reshape(-1, work.down, block.rows, work.along, block.columns).transpose(2, 4, 0, 1, 3)


def _far_rims(work: Plan, rows: int, columns: int, some: BoolArray) -> list[tuple[slice, IntArray]]:
    """Ports at the far rim of the grid, where the lines end, and the leaves that have them.

    Args:
        work: the plan.
        rows: of the grid.
        columns: of the grid.
        some: (frames, down, along) the leaves in question; their indices count these leaves only.

    Returns:
        Slices of ports, each with indices of leaves. There are none along an axis with padded leaves, because the ports
        at their far rim have zero conductances already.

    """
    block, rims = work.leaf, []
    height, width = block.rows, block.columns
    number = np.cumsum(some).reshape(some.shape) - 1
    if columns == width * work.along:
        rims.append((slice(height + 2 * width, None), number[:, :, -1][some[:, :, -1]]))
    if rows == height * work.down:
        rims.append((slice(height + width, height + 2 * width), number[:, -1][some[:, -1]]))
    return [(gone, places) for gone, places in rims if len(places)]


class _ThreadCache(threading.local):
    """The dissections that this thread has used last, in order of use."""

    def __init__(self) -> None:
        self.dissections: dict[tuple[int, int, int, bool], Dissection] = {}


_thread_cache = _ThreadCache()


def dissect(
    cells: FloatArray, row: FloatArray, column: FloatArray, transfer_only: bool
) -> tuple[FloatArray, FloatArray]:
    """Kron reduction of whole grids to their ports by nested dissection.

    Args:
        cells: (frames, N, M) S, finite.
        row: (N, M) S on the left of each crosspoint, finite.
        column: (N, M) S above each crosspoint, finite.
        transfer_only: whether to compute the conductances between rows and columns only.

    Returns:
        (frames, N + M, N + M) S between the ports in the order of :meth:`Block.ports`, or (frames, N, M) S between rows
        and columns; and bounds (frames,) on the relative rounding errors of all merges together.

    """
    key = (*cells.shape, transfer_only)
    kept = _thread_cache.dissections
    work = kept.pop(key, None) or Dissection(*key)
    network, relative = work.run(cells, row, column)
    network = _without_padding(plan(*cells.shape[1:]), network, cells.shape[1:], transfer_only).copy()
    kept[key] = work  # at the end: the most recently used
    while sum(some.size for some in kept.values()) > _CACHE_SIZE:
        del kept[next(iter(kept))]
    return network, relative


def _without_padding(work: Plan, root: FloatArray, shape: tuple[int, ...], transfer_only: bool) -> FloatArray:
    """Conductances of the whole grid without the rows and columns that pad the leaves."""
    rows, columns = shape
    width = work.leaf.columns * work.along
    if not transfer_only:
        ports = slice(width - columns, width + rows)
        return root[..., ports, ports]
    if not work.merges:
        root = root[..., width:, :width]
    return root[..., :rows, width - columns :]


class Tree:
    """Nested dissection of a grid whose cells change from frame to frame.

    The blocks of all levels are kept. For a new frame only the leaves with changed cells and the blocks above them are
    computed again.
    """

    def __init__(self, rows: int, columns: int) -> None:
        self._grid = rows, columns
        self._plan = work = plan(rows, columns)
        shapes = list(_stacks(work, 1))
        if work.merges:
            shapes[-1] = (1, 1, 1, *work.merges[-1].whole[:2])
        self._stacks = [np.empty(shape) for shape in shapes]
        self._relative = [np.zeros(shape[:3]) for shape in shapes]
        self._given = np.full((3 * work.leaf.rows * work.leaf.columns, 1, work.down, work.along), np.nan)
        self._scratch = np.empty(_scratch(work, 1))
        self._joins = _joins(work, self._stacks, self._scratch)
        self._partial_joins: dict[tuple[int, int], tuple[FloatArray, FloatArray, _Join, FloatArray]] = {}
        self._buffers = [np.empty(max(stack.size for stack in self._stacks)) for _ in range(3)]

    def transfer(self, cells: FloatArray, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As :func:`dissect` with ``transfer_only``, for a frame (1, N, M) of cells in S."""
        given = np.zeros(self._given.shape)
        _fill_leaves(self._plan, (cells, row[None], column[None]), given)
        stale = (given != self._given).any(axis=0)
        self._given.fill(np.nan)  # if an exception interrupts us, the next call computes everything
        if stale.any():
            self._reduce(given, stale)
        for level, merge in enumerate(self._plan.merges):
            first, second = _halves(merge.axis, stale)
            stale = first | second
            if stale.any():
                self._merge(level, stale)
        self._given = given
        network, relative = self._stacks[-1][:, 0, 0], self._relative[-1][:, 0, 0]
        return _without_padding(self._plan, network, self._grid, transfer_only=True), relative

    def _reduce(self, given: FloatArray, stale: BoolArray) -> None:
        """Eliminate the changed leaves again, or all leaves where most have changed."""
        stack = self._stacks[0]
        everything = bool(stale.mean() > _MOSTLY_CHANGED)
        if everything:
            stale = np.ones_like(stale)
        count = int(stale.sum())
        fresh = stack.reshape(-1, *stack.shape[-2:]) if everything else self._buffer(0, (count, *stack.shape[-2:]))
        rims = _far_rims(self._plan, *self._grid, stale)
        self._relative[0][stale] = _reduce_leaves(self._plan.leaf, given[:, stale], rims, fresh, self._scratch)
        if not everything:
            stack[stale] = fresh

    def _merge(self, level: int, stale: BoolArray) -> None:
        """Merge the pairs with a changed half again, or all pairs where most have changed."""
        if stale.mean() > _MOSTLY_CHANGED:
            first, second = _halves(self._plan.merges[level].axis, self._relative[level])
            self._relative[level + 1] = self._joins[level].run() + np.maximum(first, second)
            return
        merge, below, above = self._plan.merges[level], self._stacks[level], self._stacks[level + 1]
        count, blocks = int(stale.sum()), below.reshape(-1, *below.shape[-2:])
        one_at, other_at = (
            places[stale] for places in _halves(merge.axis, np.arange(len(blocks)).reshape(below.shape[:3]))
        )
        one, other, join, fresh = self._partial_join(level, count)
        np.take(blocks, one_at, axis=0, out=one, mode="clip")
        np.take(blocks, other_at, axis=0, out=other, mode="clip")
        own = join.run()
        above[stale] = fresh
        relative = self._relative[level].ravel()
        self._relative[level + 1][stale] = own + np.maximum(relative[one_at], relative[other_at])

    def _partial_join(self, level: int, count: int) -> tuple[FloatArray, FloatArray, _Join, FloatArray]:
        """Buffers for ``count`` pairs: first halves, second halves, their prepared merge, and the merged pairs."""
        if (level, count) not in self._partial_joins:
            half, whole = ((count, *self._stacks[k].shape[-2:]) for k in (level, level + 1))
            one, other, fresh = self._buffer(0, half), self._buffer(1, half), self._buffer(2, whole)
            join = _Join(self._plan.merges[level], one, other, fresh, self._scratch)
            self._partial_joins[level, count] = one, other, join, fresh
        return self._partial_joins[level, count]

    def _buffer(self, number: int, shape: tuple[int, ...]) -> FloatArray:
        return self._buffers[number][: math.prod(shape)].reshape(shape)
