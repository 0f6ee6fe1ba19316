"""Leaves of a nested dissection: the smallest blocks of a grid, whose inner nodes star-mesh transformations eliminate.

All leaves have the same shape and are eliminated together: one array operation handles the same branch of every leaf.
Nodes are eliminated in minimum-degree order.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ...common.arrays import IN_CACHE, BoolArray, FloatArray, IntArray
from ._dissection_plan import Block, Label, Plan
from ._elimination import ULP, inverted


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
    neighbours_of: dict[Label, set[Label]] = {}
    for a, b in ends:
        neighbours_of.setdefault(a, set()).add(b)
        neighbours_of.setdefault(b, set()).add(a)
    ports = block.ports()
    inner = sorted(set(neighbours_of) - set(ports))
    steps, operations = [], 0
    while inner:
        nodes = _independent(inner, neighbours_of)
        arms = [sorted(neighbours_of[node]) for node in nodes]
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
            neighbours = neighbours_of.pop(node)
            for arm in neighbours:
                neighbours_of[arm].remove(node)
                neighbours_of[arm].update(neighbours - {arm})
    result = _index_array([number.get(frozenset((a, b)), len(number)) for a in ports for b in ports])
    widest = max(len(result), *(max(len(step.first_arm), step.arms.size) for step in steps), 1)
    return Leaf(len(number), tuple(steps), result, widest, ULP * operations)


def _index_array(numbers: list[int] | list[list[int]]) -> IntArray:
    return np.array(numbers, dtype=np.intp)


def _independent(inner: list[Label], neighbours_of: dict[Label, set[Label]]) -> list[Label]:
    """Nodes of minimum degree that can be eliminated together: no two are neighbours or share two neighbours."""
    fewest = min(len(neighbours_of[node]) for node in inner)
    chosen: list[Label] = []
    for node in inner:
        apart = all(
            node not in neighbours_of[other] and len(neighbours_of[node] & neighbours_of[other]) < 2 for other in chosen
        )
        if len(neighbours_of[node]) == fewest and apart:
            chosen.append(node)
    return chosen


def reduce_leaves(
    block: Block, given: FloatArray, rims: list[tuple[slice, IntArray]], out: FloatArray, scratch: FloatArray
) -> FloatArray:
    """Eliminate the inner nodes of leaves.

    Args:
        block: shape of the leaves.
        given: (branches, leaves) S of the branches of the grid, in the order of :class:`Leaf`.
        rims: slices of ports to eliminate as well, each with the leaves at the grid's far rim that have them.
        out: (leaves, p, p) S between the ports; receives the result.
        scratch: working memory, of the size given by :func:`leaf_scratch`.

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
    return max(1, min(leaves, IN_CACHE // 2 // program.branches))


def leaf_scratch(block: Block, leaves: int) -> int:
    """Size of the working memory for a number of leaves."""
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


def fill_leaves(work: Plan, parts: tuple[FloatArray, ...], given: FloatArray) -> None:
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


def far_rims(work: Plan, rows: int, columns: int, some: BoolArray) -> list[tuple[slice, IntArray]]:
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
