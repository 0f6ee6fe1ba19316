"""The passive grid reduced to its ports, by nested dissection in positive arithmetic.

Whatever reads the grid sees it only through N row terminals and M column terminals. This module replaces the
grid by the equivalent network between those N + M ports, a symmetric matrix of nonnegative *port conductances*;
drive, amplifiers, dividers and ADC are then a small dense problem (:mod:`.readout`). Where only the current from
each row into each column is wanted (:func:`transfer_conductances`), the rest of the last merge is left out.

Strategy
--------
Eliminating a node from a resistive network joins its neighbours a, b by g_a g_b / sum(g) (star-mesh). Only
conductances are kept, never the diagonal of the nodal matrix: every result is a sum of products and quotients of
nonnegative numbers, so each entry is accurate to a few ulp times the depth of the computation, however many decades
the resistances span (the argument of Grassmann, Taksar and Heyman for Markov chains). An ideal wire can therefore be
a very large finite conductance without loss, and an open cell is a zero. :func:`rounding_meter` makes a bound of it.

Order: the grid is halved down to leaves of 4 x 4 crosspoints; blocks are merged upwards, each known only by the lines
that leave it. This costs O(n^3) for n x n where elimination line by line costs O(n^4). Blocks of one shape are merged
together in stacked arrays, which is also how a batch of frames is solved in one call. A leaf is eliminated node by
node, all leaves at once. The ports of a block stand in their order around its rim, so that the parts of it that meet
in a merge are slices, not index lists: the work goes into matrix products, not into moving numbers.

Nodes that go in one merge are eliminated as one dense block (LAPACK inverse). That block is a diagonally dominant
M-matrix; where it is close to singular (strongly tied nodes, weakly tied to the rest) the inverse would lose digits,
which diag(A) diag(A^-1) shows. Those blocks are inverted by halves, which never subtracts and so never loses any.
"""

from __future__ import annotations

import math
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

IDEAL_WIRE = 1e20  # conductance of 0 ohm, relative to the largest one it must outdo
LARGEST_PART = 1e14  # S that a part outside the grid (load, lead, Rref/(1 + A)) is taken to have at most
SAFE_GROWTH = 1e3  # diag(A) diag(A^-1) beyond which a block is inverted by halves
LEAF = 4  # crosspoints along the side of a leaf
_ONE_BLOCK = 20  # crosspoints up to which a whole grid is one leaf
_FEW = 8  # up to so many leaves are eliminated as dense blocks
_ULP = float(np.finfo(np.float64).eps) / 2.0
_SUM_OF_GROWTHS = 8  # nodes up to which a rounding bound is not worth another matrix product
_CHUNK = 256  # leaves eliminated together, so that their branches stay in the processor's cache
_KEPT = 1 << 24  # numbers of scratch memory that a thread keeps between calls (128 MB)
_SMALL = 32  # blocks below this size are treated alike at the grid's rim, so that more of them stack

Label = tuple[str, int, int]
"""A node: ("row" | "column", line, place): place 0 is the line's terminal, k the node at its k-th crosspoint."""


@dataclass(frozen=True)
class Lines:
    """Series conductances along the lines, in S; ``inf`` is an ideal wire, 0 a break.

    ``row`` (rows, columns): ``row[i, 0]`` is the lead of row i, ``row[i, j]`` its segment from crosspoint j-1 to j.
    ``column`` (rows, columns): ``column[i, j]`` is the segment of column j from row i-1 to i; ``column[0]`` is unused.
    ``exit`` (columns,): between the last crosspoint of each column and its terminal; None is an ideal wire.
    """

    row: FloatArray
    column: FloatArray
    exit: FloatArray | None = None


class _Scratch(threading.local):
    """Arrays used again, call after call: fresh memory costs more than the arithmetic done in it, because the
    operating system hands it out page by page.
    """

    def __init__(self) -> None:
        self._free: list[FloatArray] = []

    def take(self, *shape: int) -> FloatArray:
        """An array whose content is arbitrary."""
        size = math.prod(shape)
        fitting = [k for k, buffer in enumerate(self._free) if size <= buffer.size]
        if fitting:
            buffer = self._free.pop(min(fitting, key=lambda k: self._free[k].size))
        else:
            if self._free:  # too small, all of them: let the largest grow
                self._free.pop(max(range(len(self._free)), key=lambda k: self._free[k].size))
            buffer = np.empty(size)
        return buffer[:size].reshape(shape)

    def give(self, *arrays: FloatArray) -> None:
        """Hand back arrays that came from :meth:`take`."""
        for array in arrays:
            assert isinstance(array.base, np.ndarray)
            self._free.append(array.base)

    def trim(self) -> None:
        """Forget the largest ones until little is kept."""
        self._free.sort(key=lambda buffer: buffer.size)
        while sum(buffer.size for buffer in self._free) > _KEPT:
            self._free.pop()


_scratch = _Scratch()


class Meter:
    """Adds up how far rounding can have moved the conductances of a network, relative to each of them."""

    def __init__(self) -> None:
        self.relative = 0.0


class _Meters(threading.local):
    def __init__(self) -> None:
        self.current: Meter | None = None


_meters = _Meters()


@contextmanager
def rounding_meter() -> Iterator[Meter]:
    """Measure the rounding errors of all eliminations in the block (of this thread).

    Every elimination is accounted for as if it had been exact, but each conductance it leaves had then been changed by
    at most a relative e (see :func:`_rounding`). A change of all conductances of a network by at most e changes the
    current at port i for 1 V at port j by at most e sqrt(Y_ii Y_jj), Y_ii the conductance of port i against all others
    at ground: by Tellegen's theorem it is the sum of e g dv_i dv_j over all branches, and that of g dv_i^2 is Y_ii. It
    does not matter at which stage of the elimination the network is looked at, so the e of successive stages add up,
    while of blocks that lie side by side only the largest counts.
    """
    outer, _meters.current = _meters.current, Meter()
    try:
        yield _meters.current
    finally:
        _meters.current = outer


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

    @property
    def is_leaf(self) -> bool:
        whole_grid = not (self.bottom or self.right)
        return max(self.rows, self.columns) <= LEAF or (whole_grid and self.rows * self.columns <= _ONE_BLOCK)

    def halves(self) -> tuple[Block, Block, tuple[int, int]]:
        """The left and right (or upper and lower) half, and where the second one starts."""
        if self.columns >= self.rows:
            cut = _half(self.columns)
            first = Block(self.rows, cut, self.bottom, True)
            second = Block(self.rows, self.columns - cut, self.bottom, self.right)
            start = (0, cut)
        else:
            cut = _half(self.rows)
            first = Block(cut, self.columns, True, self.right)
            second = Block(self.rows - cut, self.columns, self.bottom, self.right)
            start = (cut, 0)
        return first._uniform(), second._uniform(), start

    def _uniform(self) -> Block:
        small = self.is_leaf or max(self.rows, self.columns) < _SMALL
        return self._replace(bottom=True, right=True) if small else self


def _half(length: int) -> int:
    """About half of a side, in whole leaves, so that few shapes of leaf arise."""
    return LEAF * max(1, round(length / (2 * LEAF)))


class Run(NamedTuple):
    """Ports of a half that stay together in the merged pair."""

    half: slice
    pair: slice
    eliminated: bool
    """``pair`` counts from the first eliminated node, or from the first port that stays"""


class Merge(NamedTuple):
    """How all blocks of one shape come from two stacks of smaller ones."""

    whole: Block
    first: Block
    second: Block
    first_at: slice | IntArray
    """places of the first halves in their stack"""
    second_at: slice | IntArray
    first_runs: tuple[Run, ...]
    second_runs: tuple[Run, ...]
    eliminated: int


class Plan(NamedTuple):
    """The merges of an N x M grid from the leaves upwards, and where the leaves of each shape start."""

    merges: tuple[Merge, ...]
    leaves: dict[Block, tuple[IntArray, IntArray]]
    root: Block


@lru_cache(maxsize=64)
def plan(rows: int, columns: int) -> Plan:
    """The elimination order for a grid, which depends on its size alone."""
    blocks: dict[Block, list[tuple[int, int]]] = {}
    root = Block(rows, columns, bottom=False, right=False)
    pending = {root: [(0, 0)]}
    pairs: dict[Block, tuple[list[int], list[int]]] = {}
    while pending:  # largest first, so that a shape is complete when its turn comes
        shape = max(pending, key=lambda block: (block.rows * block.columns, -block.right - block.bottom))
        origins = blocks[shape] = pending.pop(shape)
        if shape.is_leaf:
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
    merges = tuple(_merge(shape, *map(_as_slice, pairs[shape])) for shape in reversed(blocks) if shape in pairs)
    leaves = {}
    for shape, origins in blocks.items():
        if shape.is_leaf:
            row_at, column_at = np.array(origins, dtype=np.intp).T
            leaves[shape] = row_at, column_at
    return Plan(merges, leaves, root)


def _as_slice(places: list[int]) -> slice | IntArray:
    """Evenly spaced places as a slice, which copies nothing."""
    step = places[1] - places[0] if len(places) > 1 else 1
    regular = list(range(places[0], places[-1] + 1, step))
    return slice(places[0], places[-1] + 1, step) if places == regular else np.array(places)


def _merge(whole: Block, first_at: slice | IntArray, second_at: slice | IntArray) -> Merge:
    first, second, start = whole.halves()
    of_first, of_second, stay = first.ports(), second.ports(*start), whole.ports()
    gone = [label for label in dict.fromkeys(of_first + of_second) if label not in set(stay)]
    place = {label: (k, True) for k, label in enumerate(gone)} | {label: (k, False) for k, label in enumerate(stay)}
    first_runs, second_runs = (_runs([place[label] for label in labels]) for labels in (of_first, of_second))
    return Merge(whole, first, second, first_at, second_at, first_runs, second_runs, len(gone))


def _runs(places: list[tuple[int, bool]]) -> tuple[Run, ...]:
    """Consecutive ports that go, forwards or backwards, to consecutive places."""
    runs, start = [], 0
    while start < len(places):
        place, gone = places[start]
        end = start + 1
        step = places[end][0] - place if end < len(places) and places[end][1] == gone else 0
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


class Leaf(NamedTuple):
    """The branches of a leaf and the star-mesh steps that leave only its ports."""

    row_segments: IntArray
    """(rows, columns) numbers of the branches on the left of each crosspoint"""
    column_segments: IntArray
    """(rows, columns) numbers of the branches above each crosspoint"""
    cells: IntArray
    """(rows, columns)"""
    ends: tuple[IntArray, IntArray]
    """nodes at the two ends of the branches that are there from the start; ports come last among the nodes"""
    inner: int
    """how many nodes are not ports"""
    branches: int
    """how many branches there ever are; one more, the last, stays zero"""
    steps: tuple[tuple[IntArray, IntArray, IntArray, IntArray], ...]
    """per node: its arms, and for each pair of them the two places among the arms and the branch that gains"""
    result: IntArray
    """(ports, ports) branch between each two ports"""


@lru_cache(maxsize=64)
def leaf(block: Block) -> Leaf:
    """The elimination of one leaf, in the order of fewest arms."""
    number: dict[frozenset[Label], int] = {}

    def branch(a: Label, b: Label) -> int:
        return number.setdefault(frozenset((a, b)), len(number))

    shape = block.rows, block.columns
    row_segments, column_segments, cells = (np.zeros(shape, dtype=np.intp) for _ in range(3))
    for i, j in np.ndindex(shape):
        row_segments[i, j] = branch(("row", i, j), ("row", i, j + 1))
        column_segments[i, j] = branch(("column", j, i), ("column", j, i + 1))
        cells[i, j] = branch(("row", i, j + 1), ("column", j, i + 1))
    around: dict[Label, set[Label]] = {}
    for pair in number:
        a, b = pair
        around.setdefault(a, set()).add(b)
        around.setdefault(b, set()).add(a)
    ports = block.ports()
    inner = [node for node in around if node not in set(ports)]
    order = {node: k for k, node in enumerate(inner + ports)}
    one, other = np.array([[order[node] for node in pair] for pair in number]).T
    ends, inner_count = (one, other), len(inner)
    steps = []
    while inner:
        node = min(inner, key=lambda n: len(around[n]))
        inner.remove(node)
        arms = sorted(around.pop(node))
        for arm in arms:
            around[arm].remove(node)
            around[arm].update(set(arms) - {arm})
        one, other = np.triu_indices(len(arms), 1)
        joined = np.array([branch(arms[p], arms[q]) for p, q in zip(one, other, strict=True)], dtype=np.intp)
        steps.append((np.array([branch(node, arm) for arm in arms]), one, other, joined))
    result = np.array([[number.get(frozenset((a, b)), -1) for b in ports] for a in ports])
    return Leaf(row_segments, column_segments, cells, ends, inner_count, len(number), tuple(steps), result)


def _reduce_leaves(block: Block, cells: FloatArray, row: FloatArray, column: FloatArray, out: FloatArray) -> None:
    """Port conductances (leaves, p, p) of leaves from their (leaves, rows, columns) branches, into ``out``."""
    program = leaf(block)
    parts = ((program.cells, cells), (program.row_segments, row), (program.column_segments, column))
    if len(cells) <= _FEW:
        value = np.empty((len(cells), len(program.ends[0])))
        for branch, given in parts:
            value[:, branch] = given
        nodes = program.inner + len(program.result)
        network = np.zeros((len(cells), nodes, nodes))
        one, other = program.ends
        network[:, one, other] = network[:, other, one] = value
        out[...] = eliminate_leading(network, program.inner)
        return
    _account(_ULP * sum(len(arms) + 3 for arms, *_ in program.steps))
    for start in range(0, len(cells), _CHUNK):
        some = slice(start, start + _CHUNK)
        value = np.zeros((program.branches + 1, len(cells[some])))
        for branch, given in parts:
            value[branch] = np.moveaxis(given[some], 0, -1)
        for arms, one, other, joined in program.steps:
            arm = value[arms]
            total = arm.sum(axis=0)
            total[total == 0] = 1.0
            share = arm / total
            gain = arm[one]
            gain *= share[other]
            value[joined] += gain
        out[some] = np.moveaxis(value[program.result], -1, 0)


def port_conductances(conductance: FloatArray, lines: Lines) -> FloatArray:
    """Reduce grids to their ports.

    Args:
        conductance: (..., rows, columns) S of the cells, >= 0; inf is a short.
        lines: the wires, common to all grids of the batch.

    Returns:
        (..., N + M, N + M) S between the N row terminals (ahead of their leads) and the M column terminals (behind
        their exits), zero on the diagonal.

    """
    *batch, rows, columns = conductance.shape
    ports = _ports(conductance.reshape(-1, rows, columns), lines)
    return ports.reshape(*batch, rows + columns, rows + columns)


def transfer_conductances(conductance: FloatArray, lines: Lines) -> FloatArray:
    """The block (..., N, M) of :func:`port_conductances` between rows and columns, at a fraction of the work: with
    all else at ground, the current in S into each column terminal for each row's.
    """
    *batch, rows, columns = conductance.shape
    transfer = _ports(conductance.reshape(-1, rows, columns), lines, transfer_only=True)
    return transfer.reshape(*batch, rows, columns)


def _ports(conductance: FloatArray, lines: Lines, transfer_only: bool = False) -> FloatArray:
    """(frames, N + M, N + M), or (frames, N, M) with ``transfer_only``."""
    rows = conductance.shape[1]
    cells, row, column = _capped(conductance, lines)
    if has_ideal_lines(lines):
        ended = np.zeros(len(column[0]), dtype=np.bool_) if lines.exit is None else np.isfinite(lines.exit)
        network = _ideal_lines(cells, row[:, 0], column[0], ended)
        return network[:, :rows, rows:] if transfer_only else network
    # Turned over: the columns' terminals at the top.
    return _merge_all(cells[:, ::-1], row[::-1], column, transfer_only)[:, ::-1, ::-1]


def has_ideal_lines(lines: Lines) -> bool:
    """Whether no line has any resistance between its crosspoints."""
    return bool(np.isinf(lines.row[:, 1:]).all() and np.isinf(lines.column[1:]).all())


def _capped(conductance: FloatArray, lines: Lines) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Cells, row lines and column lines (from the exits backwards) with large numbers in place of infinite ones."""
    exits = np.full(conductance.shape[-1], np.inf) if lines.exit is None else lines.exit
    short = IDEAL_WIRE * max(_largest_finite(part) for part in (conductance, lines.row, lines.column, exits))
    wire = IDEAL_WIRE * short  # an ideal line holds its potential even across a shorted cell
    column = np.concatenate([exits[None], lines.column[:0:-1]])
    return np.minimum(conductance, short), np.minimum(lines.row, wire), np.minimum(column, wire)


def _merge_all(cells: FloatArray, row: FloatArray, column: FloatArray, transfer_only: bool) -> FloatArray:
    """Ports of whole grids, in the order of :meth:`Block.ports`, or only rows against columns of them."""
    frames, *shape = cells.shape
    work = plan(*shape)
    stacks: dict[Block, FloatArray] = {}
    rounding: dict[Block, float] = {}
    for block, (row_at, column_at) in work.leaves.items():
        i = row_at[:, None, None] + np.arange(block.rows)[:, None]
        j = column_at[:, None, None] + np.arange(block.columns)
        size = (block.rows, block.columns)
        ports = len(block.ports())
        stacks[block] = _scratch.take(frames, len(row_at), ports, ports)
        branches = [np.broadcast_to(part[..., i, j], (frames, *i.shape[:1], *size)) for part in (cells, row, column)]
        flat = [part.reshape(-1, *size) for part in branches]
        with rounding_meter() as meter:
            _reduce_leaves(block, flat[0], flat[1], flat[2], stacks[block].reshape(-1, ports, ports))
        rounding[block] = meter.relative
    uses = Counter(half for step in work.merges for half in (step.first, step.second))
    last = len(work.merges) - 1
    for number, step in enumerate(work.merges):
        first, second = stacks[step.first][:, step.first_at], stacks[step.second][:, step.second_at]
        with rounding_meter() as meter:
            stacks[step.whole] = _join(step, first, second, transfer_only and number == last)
        rounding[step.whole] = meter.relative + max(rounding[step.first], rounding[step.second])
        for half in (step.first, step.second):
            uses[half] -= 1
            if not uses[half]:
                _scratch.give(stacks.pop(half))
    _account(rounding[work.root])
    result = stacks.pop(work.root)
    network = result[:, 0].copy()
    if transfer_only and not work.merges:
        network = network[:, shape[1] :, : shape[1]]
    _scratch.give(result)
    _scratch.trim()
    return network


class Tree:
    """One grid whose cells change from frame to frame: all blocks are kept, and of a new frame only those on the way
    from a changed cell to the whole grid are merged again.
    """

    def __init__(self, lines: Lines) -> None:
        rows, columns = lines.row.shape
        self._lines = lines
        self._plan = plan(rows, columns)
        self._given: tuple[FloatArray, FloatArray, FloatArray] | None = None
        self._stacks: dict[Block, FloatArray] = {}
        self._rounding: dict[Block, float] = {}

    def transfer(self, conductance: FloatArray) -> FloatArray:
        """As :func:`transfer_conductances`, for a frame (N, M) of cells in S."""
        cells, row, column = _capped(conductance, self._lines)
        given = cells[::-1], row[::-1], column
        old, self._given = self._given, given
        if old is None or not all(np.array_equal(old[k], given[k]) for k in (1, 2)):
            changed = np.ones(cells.shape, dtype=np.bool_)
        else:
            changed = old[0] != given[0]
        stale = {block: self._reduce(block, changed) for block in self._plan.leaves}
        for number, step in enumerate(self._plan.merges):
            stale[step.whole] = self._merge(step, stale, number == len(self._plan.merges) - 1)
        _account(self._rounding[self._plan.root])
        network: FloatArray = self._stacks[self._plan.root][0, 0]
        if not self._plan.merges:
            network = network[cells.shape[1] :, : cells.shape[1]]
        return network[::-1, ::-1].copy()

    def _reduce(self, block: Block, changed: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Eliminate the leaves of one shape that have changed, and tell which."""
        assert self._given is not None
        row_at, column_at = self._plan.leaves[block]
        i = row_at[:, None, None] + np.arange(block.rows)[:, None]
        j = column_at[:, None, None] + np.arange(block.columns)
        stale: NDArray[np.bool_] = changed[i, j].any(axis=(1, 2))
        ports = len(block.ports())
        stack = self._stacks.setdefault(block, np.empty((1, len(row_at), ports, ports)))
        if stale.any():
            fresh = np.empty((int(stale.sum()), ports, ports))
            cells, row, column = (part[i[stale], j[stale]] for part in self._given)
            with rounding_meter() as meter:
                _reduce_leaves(block, cells, row, column, fresh)
            stack[0, stale] = fresh
            self._rounding[block] = max(meter.relative, self._rounding.get(block, 0.0))
        return stale

    def _merge(self, step: Merge, stale: dict[Block, NDArray[np.bool_]], last: bool) -> NDArray[np.bool_]:
        """Merge the pairs of one shape of which a half has changed, and tell which."""
        again: NDArray[np.bool_] = stale[step.first][step.first_at] | stale[step.second][step.second_at]
        if again.any():
            everything = again.all()
            first, second = self._stacks[step.first][:, step.first_at], self._stacks[step.second][:, step.second_at]
            with rounding_meter() as meter:
                fresh = _join(
                    step, first if everything else first[:, again], second if everything else second[:, again], last
                )
            stack = self._stacks.setdefault(step.whole, np.empty((1, len(again), *fresh.shape[2:])))
            stack[:, again] = fresh
            _scratch.give(fresh)
            own = meter.relative + max(self._rounding[step.first], self._rounding[step.second])
            self._rounding[step.whole] = max(own, self._rounding.get(step.whole, 0.0))
        return again


def _join(step: Merge, first: FloatArray, second: FloatArray, transfer_only: bool) -> FloatArray:
    """Merge stacked pairs (frames, places, p, p); the result is scratch."""
    whole, gone = step.whole, step.eliminated
    stack, ports = first.shape[:2], len(whole.ports())
    between, across = _scratch.take(*stack, gone, gone), _scratch.take(*stack, gone, ports)
    between.fill(0.0)
    across.fill(0.0)
    for half, runs in ((first, step.first_runs), (second, step.second_runs)):
        for a in runs:
            for b in runs:
                if a.eliminated and b.eliminated:
                    between[..., a.pair, b.pair] += half[..., a.half, b.half]
                elif a.eliminated:
                    across[..., a.pair, b.pair] = half[..., a.half, b.half]
    inner = impedance(between, across.sum(axis=-1), ports)
    if transfer_only:  # ports: columns from right to left, then rows
        columns, upper, left = whole.columns, step.first.rows, step.first.columns
        result = _scratch.take(*stack, whole.rows, columns)
        np.matmul(np.swapaxes(across[..., columns:], -1, -2), inner @ across[..., :columns], out=result)
        result[..., :upper, columns - left :] += first[..., left : left + upper, :left]
    else:
        volts, result = _scratch.take(*across.shape), _scratch.take(*stack, ports, ports)
        np.matmul(inner, across, out=volts)
        np.matmul(np.swapaxes(across, -1, -2), volts, out=result)
        for half, runs in ((first, step.first_runs), (second, step.second_runs)):
            stay = [run for run in runs if not run.eliminated]
            for a in stay:
                for b in stay:
                    result[..., a.pair, b.pair] += half[..., a.half, b.half]
        np.einsum("...ii->...i", result)[...] = 0.0
        _scratch.give(volts)
    _scratch.give(between, across)
    return result


def _ideal_lines(cells: FloatArray, lead: FloatArray, exits: FloatArray, ended: NDArray[np.bool_]) -> FloatArray:
    """Without segment resistance a line is one node, and only leads and exits are left to eliminate; the rows in
    closed form, since rows meet columns only. ``ended`` (columns,) are the columns whose exits are not ideal.
    """
    frames, rows, columns = cells.shape
    total = lead + cells.sum(axis=-1)
    total[total == 0] = 1.0
    share = cells / total[..., None]
    near, far = rows + np.flatnonzero(ended), rows + columns + np.arange(ended.sum())
    both = rows + columns + len(far)
    network = np.zeros((frames, both, both))
    column = slice(rows, rows + columns)
    network[:, :rows, column] = lead[:, None] * share
    network[:, column, :rows] = np.swapaxes(network[:, :rows, column], 1, 2)
    network[:, column, column] = np.swapaxes(cells, 1, 2) @ share
    np.einsum("...ii->...i", network)[...] = 0.0
    network[:, far, near] = network[:, near, far] = exits[ended]
    stay = np.arange(rows + columns)
    stay[near] = far
    order = np.concatenate([near, stay])
    return eliminate_leading(network[:, order[:, None], order], len(near)) if len(near) else network


def _largest_finite(values: FloatArray) -> float:
    """At least :data:`LARGEST_PART`; conductances above 1e200 S are as good as shorts."""
    return float(np.max(values, where=values < 1e200, initial=LARGEST_PART))


def eliminate_leading(network: FloatArray, count: int) -> FloatArray:
    """Remove the first ``count`` nodes from stacked networks (..., n, n) of conductances (S, zero diagonal).

    Returns (..., n - count, n - count), symmetric with zero diagonal. Nodes that nothing touches just go.
    """
    gone, kept = slice(0, count), slice(count, None)
    across = network[..., gone, kept]
    inner = impedance(network[..., gone, gone], across.sum(axis=-1), across.shape[-1])
    result = np.swapaxes(across, -1, -2) @ (inner @ across)
    result += network[..., kept, kept]
    np.einsum("...ii->...i", result)[...] = 0.0
    return result


def impedance(between: FloatArray, to_ground: FloatArray, ports: int = 1) -> FloatArray:
    """Impedance matrices (..., n, n) in ohm of n nodes: volts at each for a unit current into each.

    Args:
        between: (..., n, n) S between the nodes, zero on the diagonal.
        to_ground: (..., n) S from each node to ground. Nodes that nothing ties to ground may stand at any
            potential; theirs is set by an arbitrary conductance.
        ports: how many conductances ``to_ground`` is the sum of.

    """
    nodes = between.shape[-1]
    total = between.sum(axis=-1) + to_ground
    total[total == 0] = 1.0
    matrix = -between
    np.einsum("...ii->...i", matrix)[...] = total
    try:
        result = np.linalg.inv(matrix).astype(np.float64, copy=False)
    except np.linalg.LinAlgError:
        _account(_ULP * 6.0 * nodes * (nodes + ports))
        return _impedance_by_halves(between, to_ground)
    growth = np.einsum("...ii->...i", result) * total  # at least 1, were it exact
    suspect = ~((growth > 0.5) & (growth <= SAFE_GROWTH)).all(axis=-1)
    if suspect.any():
        result[suspect] = _impedance_by_halves(between[suspect], to_ground[suspect])
        growth[suspect] = 1.0
    if _meters.current is not None:
        _account(_rounding(result[~suspect], total[~suspect], growth[~suspect], ports))
        if suspect.any():
            _account(_ULP * 6.0 * nodes * (nodes + ports))
    return result


def _account(relative: float) -> None:
    if _meters.current is not None:
        _meters.current.relative += relative


def _rounding(inverse: FloatArray, total: FloatArray, growth: FloatArray, ports: int) -> float:
    """Bound on the relative error of any conductance that an elimination through ``inverse`` (..., n, n) leaves.

    LU with its two triangular solves is exact for a matrix within 3 gamma_n |L||U| of the given one (Higham, Accuracy
    and Stability, theorem 9.4); the diagonal itself carries the rounding of its sum. For a diagonally dominant M-matrix
    |L||U| is at most 3 total in the sense that (Z |L||U| Z)_ij <= 3 (Z diag(total) Z)_ij. What that is relative to
    Z_ij is computed, or for small blocks bounded by the sum of the growths, since Z_ik Z_kj <= Z_ij Z_kk in an inverse
    M-matrix. The two products with Z then add gamma_n each, being sums of nonnegative numbers.
    """
    if not inverse.size:
        return 0.0
    nodes: int = inverse.shape[-1]
    if nodes <= _SUM_OF_GROWTHS:
        amplification = float(growth.sum(axis=-1).max())
    else:
        twice = (inverse * total[..., None, :]) @ inverse
        np.divide(twice, inverse, out=twice, where=inverse > 0)
        amplification = float(twice.max())
    return _ULP * (amplification * (9.0 * nodes + nodes + ports) + 2.0 * nodes + 4.0)


def _impedance_by_halves(between: FloatArray, to_ground: FloatArray) -> FloatArray:
    """:func:`impedance` without a single subtraction: the first half of the nodes is eliminated, which adds to the
    conductances of the second half; that half's impedance then gives the first half's.
    """
    nodes = between.shape[-1]
    if nodes == 1:
        return 1.0 / np.where(to_ground == 0, 1.0, to_ground)[..., None]
    one, other = slice(0, nodes // 2), slice(nodes // 2, None)
    across = between[..., one, other]
    own = _impedance_by_halves(between[..., one, one], to_ground[..., one] + across.sum(axis=-1))
    share = own @ across  # volts at the first half for 1 V at a node of the second
    added = np.swapaxes(across, -1, -2) @ share
    np.einsum("...ii->...i", added)[...] = 0.0
    leak = (np.swapaxes(share, -1, -2) @ to_ground[..., one, None])[..., 0]
    rest = _impedance_by_halves(between[..., other, other] + added, to_ground[..., other] + leak)
    result = np.empty_like(between)
    result[..., other, other] = rest
    result[..., one, other] = share @ rest
    result[..., other, one] = np.swapaxes(result[..., one, other], -1, -2)
    result[..., one, one] = own + result[..., one, other] @ np.swapaxes(share, -1, -2)
    return result
