"""The passive grid reduced to its ports, by nested dissection in positive arithmetic.

Whatever reads the grid sees it only through N row terminals and M column terminals. This module replaces the
grid by the equivalent network between those N + M ports, a symmetric matrix of nonnegative *port conductances*;
drive, amplifiers, dividers and ADC are then a small dense problem (:mod:`.readout`).

Strategy
--------
Eliminating a node from a resistive network joins its neighbours a, b by g_a g_b / sum(g) (star-mesh). Only
conductances are kept, never the diagonal of the nodal matrix: every result is a sum of products and quotients of
nonnegative numbers, so each entry is accurate to a few ulp times the depth of the computation, however many decades
the resistances span (the argument of Grassmann, Taksar and Heyman for Markov chains). An ideal wire can therefore be
a very large finite conductance without loss, and an open cell is a zero.

Order: the grid is halved until single crosspoints are left, and blocks are merged upwards, each known only by the
lines that leave it. This costs O(n^3) for n x n where elimination line by line costs O(n^4). Blocks of one shape are
merged together in stacked arrays, which is also how a batch of frames is solved in one call.

Nodes that go in one merge are eliminated as one dense block (LAPACK inverse). That block is a diagonally dominant
M-matrix; where it is close to singular (strongly tied nodes, weakly tied to the rest) the inverse would lose digits,
which diag(A) diag(A^-1) shows. Those merges are redone node by node, which never loses any.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

IDEAL_WIRE = 1e20  # conductance of 0 ohm, relative to the largest one it must outdo
_SAFE_GROWTH = 1e3  # diag(A) diag(A^-1) beyond which a block is inverted node by node
_SMALL = 16  # blocks below this size are treated alike at the grid's rim, so that more of them stack


class Block(NamedTuple):
    """A shape of block. Its ports, in this order: left end of each row, bottom end of each column, and where
    ``right`` or ``top`` says so, right end of each row, top end of each column. A block owns the segments (or leads)
    on its left and top, so that its left port is its neighbour's right one.
    """

    rows: int
    columns: int
    right: bool
    top: bool

    def ports(self, row: int = 0, column: int = 0) -> list[tuple[str, int, int]]:
        """Labels (direction, line, place along it) of the ports, for a block whose first crosspoint is given."""
        rows, columns = range(row, row + self.rows), range(column, column + self.columns)
        labels = [("row", i, column) for i in rows] + [("column", j, row + self.rows) for j in columns]
        if self.right:
            labels += [("row", i, column + self.columns) for i in rows]
        if self.top:
            labels += [("column", j, row) for j in columns]
        return labels

    def halves(self) -> tuple[Block, Block, tuple[int, int]]:
        """The left and right (or top and bottom) half, and where the second one starts."""
        if self.columns >= self.rows:
            cut = self.columns // 2
            first = Block(self.rows, cut, True, self.top)
            second = Block(self.rows, self.columns - cut, self.right, self.top)
            start = (0, cut)
        else:
            cut = self.rows // 2
            first = Block(cut, self.columns, self.right, self.top)
            second = Block(self.rows - cut, self.columns, self.right, True)
            start = (cut, 0)
        return first._uniform(), second._uniform(), start

    def _uniform(self) -> Block:
        return self._replace(right=True, top=True) if max(self.rows, self.columns) < _SMALL else self


class Merge(NamedTuple):
    """How all blocks of one shape come from two stacks of smaller ones."""

    whole: Block
    first: Block
    second: Block
    first_at: IntArray
    """places of the first halves in their stack"""
    second_at: IntArray
    first_to: IntArray
    """where each port of a first half stands among the nodes of the merged pair; eliminated nodes stand first"""
    second_to: IntArray
    eliminated: int


class Plan(NamedTuple):
    """The merges of an N x M grid from crosspoints upwards, and the crosspoints' (row, column) order."""

    merges: tuple[Merge, ...]
    crosspoints: tuple[IntArray, IntArray]


@lru_cache(maxsize=64)
def plan(rows: int, columns: int) -> Plan:
    """The elimination order for a grid, which depends on its size alone."""
    blocks: dict[Block, list[tuple[int, int]]] = {}
    pending = {Block(rows, columns, right=False, top=False): [(0, 0)]}
    pairs: dict[Block, tuple[list[int], list[int]]] = {}
    while pending:  # largest first, so that a shape is complete when its turn comes
        shape = max(pending, key=lambda block: (block.rows * block.columns, -block.right - block.top))
        origins = pending.pop(shape)
        blocks[shape] = origins
        if shape.rows == shape.columns == 1:
            continue
        first, second, (down, along) = shape.halves()
        firsts, seconds = pending.setdefault(first, []), pending.setdefault(second, [])
        at: tuple[list[int], list[int]] = ([], [])
        for row, column in origins:
            at[0].append(len(firsts))
            firsts.append((row, column))
            at[1].append(len(seconds))
            seconds.append((row + down, column + along))
        pairs[shape] = at
    merges = [_merge(shape, *map(np.array, pairs[shape])) for shape in reversed(blocks) if shape in pairs]
    crosspoint = next(shape for shape in blocks if shape.rows == shape.columns == 1)
    row_at, column_at = np.array(blocks[crosspoint], dtype=np.intp).T
    return Plan(tuple(merges), (row_at, column_at))


def _merge(whole: Block, first_at: IntArray, second_at: IntArray) -> Merge:
    first, second, start = whole.halves()
    of_first, of_second, kept = first.ports(), second.ports(*start), whole.ports()
    gone = [label for label in dict.fromkeys(of_first + of_second) if label not in set(kept)]
    place = {label: k for k, label in enumerate(gone + kept)}
    return Merge(
        whole,
        first,
        second,
        first_at,
        second_at,
        np.array([place[label] for label in of_first]),
        np.array([place[label] for label in of_second]),
        len(gone),
    )


@dataclass(frozen=True)
class Lines:
    """Series conductances along the lines, in S; ``inf`` is an ideal wire, 0 a break.

    ``row`` (rows, columns): ``row[i, 0]`` is the lead of row i, ``row[i, j]`` its segment from crosspoint j-1 to j.
    ``column`` (rows, columns): ``column[i, j]`` is the segment of column j from row i-1 to i; ``column[0]`` is unused.
    """

    row: FloatArray
    column: FloatArray


def port_conductances(conductance: FloatArray, lines: Lines) -> FloatArray:
    """Reduce grids to their ports.

    Args:
        conductance: (..., rows, columns) S of the cells, >= 0; inf is a short.
        lines: the wires, common to all grids of the batch.

    Returns:
        (..., N + M, N + M) S between the N row terminals (ahead of their leads) and the M column terminals (at the
        last row), zero on the diagonal.

    """
    *batch, rows, columns = conductance.shape
    cells = conductance.reshape(-1, rows, columns)
    short = IDEAL_WIRE * max(_largest_finite(part) for part in (cells, lines.row, lines.column))
    wire = IDEAL_WIRE * short  # an ideal line holds its potential even across a shorted cell
    cells = np.minimum(cells, short)
    row_line, column_line = np.minimum(lines.row, wire), np.minimum(lines.column, wire)
    if np.isinf(lines.row[:, 1:]).all() and np.isinf(lines.column[1:]).all():
        return _ideal_lines(cells, row_line[:, 0]).reshape(*batch, rows + columns, rows + columns)
    steps, (row_at, column_at) = plan(rows, columns)

    # A crosspoint alone: ports left, bottom, right (the row's node), top; bottom is the column's node.
    stack = np.zeros((len(cells), len(row_at), 4, 4))
    for a, b, value in (
        (0, 2, row_line[row_at, column_at]),
        (2, 1, cells[:, row_at, column_at]),
        (1, 3, np.where(row_at > 0, column_line[row_at, column_at], 0.0)),
    ):
        stack[:, :, a, b] = stack[:, :, b, a] = value
    crosspoint = Block(1, 1, right=True, top=True)
    if not steps:
        return eliminate(stack[:, 0], np.array([2, 3])).reshape(*batch, 2, 2)
    stacks = {crosspoint: stack}
    for step in steps:
        first = stacks[step.first][:, step.first_at]
        second = stacks[step.second][:, step.second_at]
        size = len(np.union1d(step.first_to, step.second_to))
        joint = np.zeros((*first.shape[:2], size, size))
        joint[:, :, step.first_to[:, None], step.first_to] = first
        joint[:, :, step.second_to[:, None], step.second_to] += second
        stacks[step.whole] = eliminate_leading(joint, step.eliminated)
    return stacks[steps[-1].whole].reshape(*batch, rows + columns, rows + columns)


def _ideal_lines(cells: FloatArray, lead: FloatArray) -> FloatArray:
    """Without segment resistance a line is one node, and only the row leads are left to eliminate: in closed form,
    since rows meet columns only.
    """
    frames, rows, columns = cells.shape
    total = lead + cells.sum(axis=-1)
    total[total == 0] = 1.0
    share = cells / total[..., None]
    ports = np.zeros((frames, rows + columns, rows + columns))
    ports[:, :rows, rows:] = lead[:, None] * share
    ports[:, rows:, :rows] = np.swapaxes(ports[:, :rows, rows:], 1, 2)
    ports[:, rows:, rows:] = np.swapaxes(cells, 1, 2) @ share
    np.einsum("...ii->...i", ports)[...] = 0.0
    return ports


def _largest_finite(values: FloatArray) -> float:
    return float(np.max(values, where=np.isfinite(values), initial=np.finfo(np.float64).tiny))


def eliminate(network: FloatArray, nodes: IntArray) -> FloatArray:
    """Remove the given nodes; the others keep their order. See :func:`eliminate_leading`."""
    kept = np.setdiff1d(np.arange(network.shape[-1]), nodes)
    order = np.concatenate([nodes, kept])
    return eliminate_leading(network[..., order[:, None], order], len(nodes))


def eliminate_leading(network: FloatArray, count: int) -> FloatArray:
    """Remove the first ``count`` nodes from stacked networks (..., n, n) of conductances (S, zero diagonal).

    Returns (..., n - count, n - count), symmetric with zero diagonal. Nodes that nothing touches just go.
    """
    gone, kept = slice(0, count), slice(count, None)
    across = network[..., gone, kept]
    inner = impedance(network[..., gone, gone], across.sum(axis=-1))
    result = np.swapaxes(across, -1, -2) @ (inner @ across)
    result += network[..., kept, kept]
    np.einsum("...ii->...i", result)[...] = 0.0
    return result


def impedance(between: FloatArray, to_ground: FloatArray) -> FloatArray:
    """Impedance matrices (..., n, n) in ohm of n nodes: volts at each for a unit current into each.

    Args:
        between: (..., n, n) S between the nodes, zero on the diagonal.
        to_ground: (..., n) S from each node to ground. Nodes that nothing ties to ground may stand at any
            potential; theirs is set by an arbitrary conductance.

    """
    total = between.sum(axis=-1) + to_ground
    total[total == 0] = 1.0
    matrix = -between
    np.einsum("...ii->...i", matrix)[...] = total
    try:
        result = np.linalg.inv(matrix).astype(np.float64, copy=False)
    except np.linalg.LinAlgError:
        return _impedance_one_by_one(between, to_ground)
    growth = np.einsum("...ii->...i", result) * total  # at least 1, were it exact
    suspect = ~((growth > 0.5) & (growth <= _SAFE_GROWTH)).all(axis=-1)
    if suspect.any():
        result[suspect] = _impedance_one_by_one(between[suspect], to_ground[suspect])
    return result


def _impedance_one_by_one(between: FloatArray, to_ground: FloatArray) -> FloatArray:
    """:func:`impedance` by star-mesh steps: slower, but without a single subtraction.

    Each node in turn hands its conductances and its share of every injected current to the nodes left; on the way
    back its voltage follows from theirs.
    """
    nodes = between.shape[-1]
    mesh = np.concatenate([between, to_ground[..., None]], axis=-1)  # the last column is ground
    injected = np.zeros_like(between)
    np.einsum("...ii->...i", injected)[...] = 1.0
    totals = np.empty_like(to_ground)
    for k in range(nodes):
        arms = mesh[..., k, k + 1 :]
        total = arms.sum(axis=-1)
        totals[..., k] = np.where(total == 0, 1.0, total)
        share = arms / totals[..., k, None]
        mesh[..., k + 1 :, k + 1 :] += arms[..., :-1, None] * share[..., None, :]
        later = np.arange(k + 1, nodes)
        mesh[..., later, later] = 0.0
        injected[..., k + 1 :, :] += share[..., :-1, None] * injected[..., k, None, :]
    volts = injected
    for k in range(nodes - 1, -1, -1):
        volts[..., k, :] += (mesh[..., k, k + 1 : nodes, None] * volts[..., k + 1 :, :]).sum(axis=-2)
        volts[..., k, :] /= totals[..., k, None]
    return volts
