"""Nested dissection of a grid: Kron reduction to the grid's ports, block by block.

Nested dissection (George, SIAM Journal on Numerical Analysis 10, 1973) orders the elimination of a grid's nodes. The
grid is cut into small blocks, the *leaves*. The inner nodes of the leaves are eliminated first. Neighbouring blocks are
then merged in pairs, level by level, up to the whole grid. A merge eliminates the nodes at which two blocks meet. Each
block is known only by the conductances between its *ports*, the nodes where lines leave the block. An n x n grid costs
O(n^3); eliminating line after line costs O(n^4).

**Leaves.** All leaves have the same shape (:mod:`._dissection_plan`). They have at most ``LEAF`` crosspoints a side,
and their number along each axis is a power of two. Leaves that reach past the grid are padded with zero conductances.
All leaves are eliminated together by star-mesh transformations (:mod:`._dissection_leaves`).

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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import FloatArray
from ._dissection_leaves import far_rims, fill_leaves, leaf_scratch, reduce_leaves
from ._dissection_plan import Merge, Plan, plan
from ._elimination import inverted
from ._tuning import KEPT_NUMBERS


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
            merge: shapes of the halves, and the ports at which they meet.
            first: (..., p, p) S of the first halves.
            second: (..., p, p) S of the second halves.
            out: (..., ports, ports) S of the pairs. If its shape is (..., rows, columns), only the conductances between
                rows and columns are computed.
            scratch: working memory, of the size given by :func:`_scratch`.

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
        self._far_rims = far_rims(work, rows, columns, np.ones((frames, work.down, work.along), dtype=np.bool_))
        self._leaves = stacks[0].reshape(leaves, *stacks[0].shape[-2:])
        self._joins = _joins(work, stacks, self._scratch)
        self._root = stacks[-1][:, 0, 0]
        self.size = sum(turn.size for turn in turns) + self._scratch.size + self._given.size

    def run(self, cells: FloatArray, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Dissect frames.

        Args:
            cells: (frames, N, M) S.
            row: (N, M) S on the left of each crosspoint, or (frames, N, M).
            column: likewise, S above each crosspoint.

        Returns:
            (frames, ...) S of the last level, padding included, and bounds (frames,) on the relative rounding errors.
            The first array is overwritten by the next call.

        """
        each = (part.reshape(-1, *part.shape[-2:]) for part in (cells, row, column))
        fill_leaves(self._plan, tuple(each), self._given)
        given = self._given.reshape(len(self._given), -1)
        relative = reduce_leaves(self._plan.leaf, given, self._far_rims, self._leaves, self._scratch)
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
    largest = leaf_scratch(work.leaf, frames * work.down * work.along)
    for merge, (*stack, ports, _) in zip(work.merges, list(_stacks(work, frames))[1:], strict=True):
        largest = max(largest, math.prod(stack) * merge.eliminated * (merge.eliminated + 2 * ports))
    return largest


def _halves(axis: int, stack: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """First and second halves of all pairs in a stack (frames, down, along, ...), as views."""
    if axis:
        return stack[:, :, 0::2], stack[:, :, 1::2]
    return stack[:, 0::2], stack[:, 1::2]


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
        row: (N, M) S on the left of each crosspoint, finite, or (frames, N, M).
        column: likewise, S above each crosspoint.
        transfer_only: whether to compute the conductances between rows and columns only.

    Returns:
        (frames, N + M, N + M) S between the ports in the order of :meth:`.Block.ports`, or (frames, N, M) S between
        rows and columns; and bounds (frames,) on the relative rounding errors of all merges together.

    """
    key = (*cells.shape, transfer_only)
    kept = _thread_cache.dissections
    work = kept.pop(key, None) or Dissection(*key)
    network, relative = work.run(cells, row, column)
    network = _without_padding(plan(*cells.shape[1:]), network, cells.shape[1:], transfer_only).copy()
    kept[key] = work  # at the end: the most recently used
    while sum(some.size for some in kept.values()) > KEPT_NUMBERS:
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
