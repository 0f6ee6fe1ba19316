"""A plain grid reduced to its ports by nested dissection.

The grid is cut into equal leaves of 3 to 5 crosspoints a side, their number along each axis a power of two; where the
grid does not fill them, nothing does. Leaves are eliminated node by node, all of them at once. Blocks are then merged
pairwise, level by level up to the whole grid, each known only by the lines that leave it. This costs O(n^3) for
n x n where elimination line by line costs O(n^4).

All blocks of a level have the same shape, in all frames of a batch, so that each level is one stack and one merge of
it. What the shape does not say is the grid's far rim, where lines end in nothing: there the last crosspoints of the
outermost leaves are eliminated as well and leave ports that nothing touches, until the merge that drops them.

The ports of a block stand in their order around its rim, so that the parts of it that meet in a merge are slices, not
index lists: the work goes into matrix products, not into moving numbers. The slices of a whole dissection are
prepared once and used again for all frames of one size, with the memory they lie in: fresh memory costs more than the
arithmetic done in it, because the operating system hands it out page by page.
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

LEAF = 5  # crosspoints along the side of a leaf, at most
_CHUNK = 1 << 16  # conductances of leaves eliminated together, so that they stay in the processor's cache
_MOST = 0.6  # of a level's blocks; picking out more than that costs more than it saves
_KEPT = 1 << 24  # numbers of memory that a thread keeps between calls (128 MB)

Label = tuple[str, int, int]
"""A node: ("row" | "column", line, place): place 0 is the line's terminal, k the node at its k-th crosspoint."""


class Block(NamedTuple):
    """A shape of block, seen with the columns' terminals at the top: a block owns the segments (or leads) on its left
    and top. Its ports, in order around its rim from the top right corner: upper ends of the columns, left ends of the
    rows, and where ``bottom`` or ``right`` says so, the lowest node of each column, the last node of each row.
    """

    rows: int
    columns: int
    bottom: bool
    right: bool

    def ports(self, row: int = 0, column: int = 0) -> list[Label]:
        """Labels of the ports of a block whose first crosspoint stands at (row, column)."""
        rows, columns = range(row, row + self.rows), range(column, column + self.columns)
        labels: list[Label] = [("column", j, row) for j in reversed(columns)]
        labels += [("row", i, column) for i in rows]
        if self.bottom:
            labels += [("column", j, row + self.rows) for j in columns]
        if self.right:
            labels += [("row", i, column + self.columns) for i in reversed(rows)]
        return labels


class Run(NamedTuple):
    """Ports of a half that stay together in the merged pair."""

    half: slice
    pair: slice
    eliminated: bool
    """``pair`` counts from the first eliminated node, or from the first port that stays"""


class Merge(NamedTuple):
    """How the blocks of a level come from those of the level below."""

    whole: Block
    axis: int
    """0: one half above the other; 1: side by side"""
    first_runs: tuple[Run, ...]
    second_runs: tuple[Run, ...]
    eliminated: int


class Plan(NamedTuple):
    """How a grid is dissected, which depends on its size alone."""

    leaf: Block
    down: int
    """leaves along a column"""
    along: int
    """leaves along a row"""
    merges: tuple[Merge, ...]


@lru_cache(maxsize=64)
def plan(rows: int, columns: int) -> Plan:
    """Leaves and merges of an N x M grid; halves meet across the shorter side."""
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
    """Side of the leaves and their number."""
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
    """Consecutive ports that go, forwards or backwards, to consecutive places; ports without a place are dropped."""
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
    """Nodes of a leaf that go at once: all have as many arms, and no two gain the same branch."""

    arms: IntArray
    """(arms, nodes) branches to the neighbours"""
    one: IntArray
    """for each pair of a node's arms and each node the first of them, among ``arms`` flattened"""
    other: IntArray
    """the second of them"""
    fresh: slice
    """branches that the first of the pairs make"""
    old: IntArray
    """branches that the rest of the pairs add to"""


class Leaf(NamedTuple):
    """The branches of a leaf and the star-mesh steps that leave only its ports. The branches that are there from the
    start come first: cells, then segments on the left of each crosspoint, then segments above it, each row by row.
    """

    branches: int
    """how many branches there ever are; one more, the last, stays zero"""
    steps: tuple[Step, ...]
    result: IntArray
    """(ports * ports,) branch between each two ports"""
    most: int
    """branches or pairs that are worked on at once, at most"""
    relative: float
    """rounding error of any branch"""


@lru_cache(maxsize=64)
def leaf(block: Block) -> Leaf:
    """The elimination of one leaf, in the order of fewest arms."""
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
        steps.append(Step(_places(joins), _places(one), _places(other), fresh, _places(old)))
        operations += len(arms[0]) + 3
        for node in nodes:
            inner.remove(node)
            neighbours = around.pop(node)
            for arm in neighbours:
                around[arm].remove(node)
                around[arm].update(neighbours - {arm})
    result = _places([number.get(frozenset((a, b)), len(number)) for a in ports for b in ports])
    most = max(len(result), *(max(len(step.one), step.arms.size) for step in steps), 1)
    return Leaf(len(number), tuple(steps), result, most, ULP * operations)


def _places(numbers: list[int] | list[list[int]]) -> IntArray:
    return np.array(numbers, dtype=np.intp)


def _independent(inner: list[Label], around: dict[Label, set[Label]]) -> list[Label]:
    """Nodes of the fewest arms of which none changes another's, and no two join the same neighbours."""
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
    """Port conductances (leaves, p, p) of leaves from their branches (given, leaves), into ``out``.

    Args:
        block: their shape.
        given: the branches that are there from the start, in the order of :class:`Leaf`.
        rims: ports that are no ports of some of the leaves, and of which ones.
        out: where to.
        scratch: as much as :func:`_leaf_scratch` says.

    Returns:
        (leaves,) relative rounding errors.

    """
    program = leaf(block)
    ports = out.shape[-1]
    chunk = _leaf_chunk(program, given.shape[1])
    size = program.most * chunk
    one_work, other_work, third_work, value_work = (scratch[k * size :] for k in range(4))
    for start in range(0, given.shape[1], chunk):
        some = given[:, start : start + chunk]
        leaves = some.shape[1]

        def held(work: FloatArray, count: int, leaves: int = leaves) -> FloatArray:
            return work[: count * leaves].reshape(count, leaves)

        value = held(value_work, program.branches + 1)
        value[: len(some)] = some
        value[-1] = 0.0
        for arms, one, other, fresh, old in program.steps:
            arm = np.take(value, arms.ravel(), axis=0, out=held(one_work, arms.size), mode="clip")
            share = arm.reshape(*arms.shape, leaves)
            first = np.take(arm, one, axis=0, out=held(other_work, len(one)), mode="clip")
            total = share.sum(axis=0)
            if not total.all():
                total[total == 0] = 1.0
            share /= total
            gain = np.take(arm, other, axis=0, out=held(third_work, len(one)), mode="clip")
            gain *= first
            new = fresh.stop - fresh.start
            value[fresh] = gain[:new]
            if len(old):
                value[old] += gain[new:]
        result = np.take(value, program.result, axis=0, out=held(one_work, ports * ports), mode="clip")
        out[start : start + leaves].reshape(leaves, -1)[...] = result.T
    relative = np.full(len(out), program.relative)
    for gone, places in rims:
        blocks = out[places]
        relative[places] += _trim(blocks, gone)
        out[places] = blocks
    return relative


def _leaf_chunk(program: Leaf, leaves: int) -> int:
    return max(1, min(leaves, _CHUNK // program.branches))


def _leaf_scratch(block: Block, leaves: int) -> int:
    """Numbers of scratch memory for so many leaves."""
    program = leaf(block)
    return (3 * program.most + program.branches + 1) * _leaf_chunk(program, leaves)


def _trim(blocks: FloatArray, gone: slice) -> FloatArray:
    """Eliminate some ports of blocks (..., p, p) in place, so that nothing touches them, and tell the rounding errors
    (...,).
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
    """One merge of stacks of halves (..., p, p) into a stack of pairs, with all slices prepared."""

    def __init__(
        self, merge: Merge, first: FloatArray, second: FloatArray, out: FloatArray, scratch: FloatArray
    ) -> None:
        """``out`` (..., ports, ports) of the pairs, or if it is (..., rows, columns), only rows against columns."""
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
        if transfer_only:  # of the second half, either the rows or the columns have just been eliminated
            rows, columns = (side // (1 + (axis == merge.axis)) for axis, side in enumerate(whole[:2]))
            part = first[..., columns : columns + rows, :columns]
            self._staying.append((out[..., :rows, whole.columns - columns :], part))

    def run(self) -> FloatArray:
        """Merge, and tell the rounding errors (...,)."""
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
    """The merges of whole stacks (frames, down, along, ...), each into the next one."""
    levels = zip(work.merges, stacks, stacks[1:], strict=False)
    return [_Join(merge, *_halves(merge.axis, below), above, scratch) for merge, below, above in levels]


class Dissection:
    """All merges of grids of one size, and the memory for them."""

    def __init__(self, frames: int, rows: int, columns: int, transfer_only: bool) -> None:
        self._plan = work = plan(rows, columns)
        self._grid = frames, rows, columns
        leaves = frames * work.down * work.along
        shapes = list(_stacks(work, frames))
        if transfer_only and work.merges:
            shapes[-1] = (frames, 1, 1, *work.merges[-1].whole[:2])
        sizes = [math.prod(shape) for shape in shapes]
        turns = [np.empty(max(sizes[turn::2], default=0)) for turn in range(2)]  # each level from one into the other
        stacks = [turns[k % 2][:size].reshape(shape) for k, (size, shape) in enumerate(zip(sizes, shapes, strict=True))]
        self._scratch = np.empty(_scratch(work, frames))
        self._given = np.zeros((3 * work.leaf.rows * work.leaf.columns, frames, work.down, work.along))
        self._rims = _rims(work, rows, columns, np.ones((frames, work.down, work.along), dtype=np.bool_))
        self._leaves = stacks[0].reshape(leaves, *stacks[0].shape[-2:])
        self._joins = _joins(work, stacks, self._scratch)
        self._root = stacks[-1][:, 0, 0]
        self.size = sum(turn.size for turn in turns) + self._scratch.size + self._given.size

    def run(self, cells: FloatArray, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The last stack (frames, ...) and its relative rounding errors (frames,).

        Args:
            cells: (frames, N, M) S.
            row: (N, M) S on the left of each crosspoint.
            column: (N, M) S above each crosspoint.

        """
        _load(self._plan, (cells, row[None], column[None]), self._given)
        given = self._given.reshape(len(self._given), -1)
        relative = _reduce_leaves(self._plan.leaf, given, self._rims, self._leaves, self._scratch)
        relative = relative.reshape(self._given.shape[1:])
        for merge, join in zip(self._plan.merges, self._joins, strict=True):
            relative = np.maximum(*_halves(merge.axis, relative)) + join.run()
        return self._root, relative[:, 0, 0]


def _stacks(work: Plan, frames: int) -> Iterator[tuple[int, ...]]:
    """Shapes (frames, down, along, ports, ports) of the stacks of blocks, level by level."""
    down, along, ports = work.down, work.along, len(work.leaf.ports())
    yield frames, down, along, ports, ports
    for merge in work.merges:
        down, along = (down, along // 2) if merge.axis else (down // 2, along)
        ports = len(merge.whole.ports())
        yield frames, down, along, ports, ports


def _scratch(work: Plan, frames: int) -> int:
    """Numbers of scratch memory that any level needs."""
    most = _leaf_scratch(work.leaf, frames * work.down * work.along)
    for merge, (*stack, ports, _) in zip(work.merges, list(_stacks(work, frames))[1:], strict=True):
        most = max(most, math.prod(stack) * merge.eliminated * (merge.eliminated + 2 * ports))
    return most


def _halves(axis: int, stack: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """The first and second halves of the pairs in a stack (frames, down, along, ...)."""
    if axis:
        return stack[:, :, 0::2], stack[:, :, 1::2]
    return stack[:, 0::2], stack[:, 1::2]


def _load(work: Plan, parts: tuple[FloatArray, ...], given: FloatArray) -> None:
    """Cells, row and column segments (frames or 1, N, M) into the branches (given, frames, down, along) of leaves."""
    block = work.leaf
    into = given.reshape(3, block.rows, block.columns, *given.shape[1:])
    filled = block.rows * work.down, block.columns * work.along
    for to, part in zip(into, parts, strict=True):
        if part.shape[1:] != filled:
            padded = np.zeros((len(part), *filled))
            padded[:, : part.shape[1], : part.shape[2]] = part
            part = padded  # noqa: PLW2901  # the same, filled up
        to[...] = part.reshape(-1, work.down, block.rows, work.along, block.columns).transpose(2, 4, 0, 1, 3)


def _rims(work: Plan, rows: int, columns: int, some: BoolArray) -> list[tuple[slice, IntArray]]:
    """Ports of leaves at the grid's far rim, where lines end in nothing, and which of ``some`` of the leaves (frames,
    down, along) these are.
    """
    block, rims = work.leaf, []
    height, width = block.rows, block.columns
    number = np.cumsum(some).reshape(some.shape) - 1
    if columns == width * work.along:
        rims.append((slice(height + 2 * width, None), number[:, :, -1][some[:, :, -1]]))
    if rows == height * work.down:
        rims.append((slice(height + width, height + 2 * width), number[:, -1][some[:, -1]]))
    return [(gone, places) for gone, places in rims if len(places)]


class _Kept(threading.local):
    """What this thread has used last."""

    def __init__(self) -> None:
        self.dissections: dict[tuple[int, int, int, bool], Dissection] = {}


_kept = _Kept()


def dissect(
    cells: FloatArray, row: FloatArray, column: FloatArray, transfer_only: bool
) -> tuple[FloatArray, FloatArray]:
    """Ports of whole grids in the order of :meth:`Block.ports`, or only rows against columns of them, and the relative
    rounding error (frames,) of every merge together.

    Arguments are those of :meth:`Dissection.run`, in S and finite.
    """
    key = (*cells.shape, transfer_only)
    kept = _kept.dissections
    work = kept.pop(key, None) or Dissection(*key)
    network, relative = work.run(cells, row, column)
    network = _whole(plan(*cells.shape[1:]), network, cells.shape[1:], transfer_only).copy()
    kept[key] = work  # the latest
    while sum(some.size for some in kept.values()) > _KEPT:
        del kept[next(iter(kept))]
    return network, relative


def _whole(work: Plan, root: FloatArray, shape: tuple[int, ...], transfer_only: bool) -> FloatArray:
    """Without what only fills up the leaves."""
    rows, columns = shape
    width = work.leaf.columns * work.along
    if not transfer_only:
        ports = slice(width - columns, width + rows)
        return root[..., ports, ports]
    if not work.merges:
        root = root[..., width:, :width]
    return root[..., :rows, width - columns :]


class Tree:
    """One grid whose cells change from frame to frame: all blocks are kept, and of a new frame only those on the way
    from a changed cell to the whole grid are merged again.
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
        self._some_joins: dict[tuple[int, int], tuple[FloatArray, FloatArray, _Join, FloatArray]] = {}
        self._some = [np.empty(max(stack.size for stack in self._stacks)) for _ in range(3)]

    def transfer(self, cells: FloatArray, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As :func:`dissect`, for a frame (1, N, M) of cells in S, between rows and columns only."""
        given = np.zeros(self._given.shape)
        _load(self._plan, (cells, row[None], column[None]), given)
        stale = (given != self._given).any(axis=0)
        self._given.fill(np.nan)  # should this be interrupted, nothing can be relied on
        if stale.any():
            self._reduce(given, stale)
        for level, merge in enumerate(self._plan.merges):
            first, second = _halves(merge.axis, stale)
            stale = first | second
            if stale.any():
                self._merge(level, stale)
        self._given = given
        network, relative = self._stacks[-1][:, 0, 0], self._relative[-1][:, 0, 0]
        return _whole(self._plan, network, self._grid, transfer_only=True), relative

    def _reduce(self, given: FloatArray, stale: BoolArray) -> None:
        """Eliminate the leaves again that have changed, or all if that is no more work."""
        stack = self._stacks[0]
        everything = bool(stale.mean() > _MOST)
        if everything:
            stale = np.ones_like(stale)
        count = int(stale.sum())
        fresh = stack.reshape(-1, *stack.shape[-2:]) if everything else self._buffer(0, (count, *stack.shape[-2:]))
        rims = _rims(self._plan, *self._grid, stale)
        self._relative[0][stale] = _reduce_leaves(self._plan.leaf, given[:, stale], rims, fresh, self._scratch)
        if not everything:
            stack[stale] = fresh

    def _merge(self, level: int, stale: BoolArray) -> None:
        """Merge the pairs again of which a half has changed, or all if that is no more work."""
        if stale.mean() > _MOST:
            first, second = _halves(self._plan.merges[level].axis, self._relative[level])
            self._relative[level + 1] = self._joins[level].run() + np.maximum(first, second)
            return
        merge, below, above = self._plan.merges[level], self._stacks[level], self._stacks[level + 1]
        count, blocks = int(stale.sum()), below.reshape(-1, *below.shape[-2:])
        one_at, other_at = (
            places[stale] for places in _halves(merge.axis, np.arange(len(blocks)).reshape(below.shape[:3]))
        )
        one, other, join, fresh = self._picked(level, count)
        np.take(blocks, one_at, axis=0, out=one, mode="clip")
        np.take(blocks, other_at, axis=0, out=other, mode="clip")
        own = join.run()
        above[stale] = fresh
        relative = self._relative[level].ravel()
        self._relative[level + 1][stale] = own + np.maximum(relative[one_at], relative[other_at])

    def _picked(self, level: int, count: int) -> tuple[FloatArray, FloatArray, _Join, FloatArray]:
        """Where to put so many pairs of halves, how to merge them, and where they will then be."""
        if (level, count) not in self._some_joins:
            half, whole = ((count, *self._stacks[k].shape[-2:]) for k in (level, level + 1))
            one, other, fresh = self._buffer(0, half), self._buffer(1, half), self._buffer(2, whole)
            join = _Join(self._plan.merges[level], one, other, fresh, self._scratch)
            self._some_joins[level, count] = one, other, join, fresh
        return self._some_joins[level, count]

    def _buffer(self, number: int, shape: tuple[int, ...]) -> FloatArray:
        return self._some[number][: math.prod(shape)].reshape(shape)
