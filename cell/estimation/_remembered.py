"""The memory of all cells, and the block of followed cells (gather, compute, scatter).

A skin is large, and few of its cells are pressed. A frame computes only those cells, side by side in a block. When the
set of followed cells changes, the old block is scattered back to the memory of all cells, and a new block is gathered.
Compiled loops copy cells that stay followed directly from block to block.
"""

from __future__ import annotations

import numpy as np

from ...common.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    columns,
    put_columns,
    spaced,
    spaced_anything,
    spaced_columns,
)
from . import _loops as loops
from . import _smoothing as smoothing
from ._inversion import Inversion


class Block:
    """The memory of the followed cells, side by side."""

    def __init__(self, cells: IntArray, memory: FloatArray, line: FloatArray) -> None:
        """``cells`` (m,) are indices, ``memory`` (rows, m) is the inversion's, ``line`` (ROWS, m) the smoothing's.

        The rows of the memory need not be contiguous.
        """
        self.cells, self.memory, self.line = cells, memory, line
        self.line_before = line.copy()
        """the line after the last step; replaced, never changed. Compiled loops set it when the next step begins"""
        self.scratch: smoothing.Scratch | None = None
        """scratch arrays of the array operations; None: not used yet"""
        self.near: IntArray | None = None
        """(k, m) neighbours, see :meth:`._neighbours.Neighbours.among`; None: not computed yet"""
        self.taken = np.empty((4, cells.size))
        """readings of the step, for compiled loops; see :mod:`._rows`"""
        self.begun = np.empty(cells.size, dtype=np.bool_)
        """where a line began in the step, for compiled loops"""

    def __reduce__(self) -> tuple[type[Block], tuple[IntArray, FloatArray, FloatArray], dict[str, FloatArray]]:
        """For pickle and copy: leaves ``scratch`` out, whose rows are views of the line."""
        return type(self), (self.cells, self.memory, self.line), {"line_before": self.line_before}

    def memory_of(self, place: IntArray) -> FloatArray:
        """A copy of the memory (rows, k) of the cells at ``place`` (k,)."""
        every = place.size == self.cells.size and bool((np.diff(place) > 0).all())
        return spaced(self.memory) if every else spaced_columns(self.memory, place)

    def changed(self) -> None:
        """To be called after ``memory`` and ``line`` have been written to between two steps."""
        self.memory = self.memory[:]  # a new array object signals the change
        self.line_before = self.line.copy()


class Remembered:
    """The memory of n cells. That of followed cells is in :attr:`block`."""

    def __init__(self, inversion: Inversion, cells: int) -> None:
        self._inversion = inversion
        self.memory = spaced(inversion.begin(np.zeros(cells)))
        self.line = smoothing.begin(np.zeros(cells))
        self.followed = np.zeros(cells, dtype=np.bool_)
        """(n,) the cells of the last call of :meth:`follow`"""
        self.stale = True
        """whether the followed cells have to be chosen anew"""
        self.compiled = False
        """whether compiled loops are in use"""
        self._at_rest = inversion.begin(np.zeros(1)), smoothing.begin(np.zeros(1), 1.0)
        self._no_block = self._gathered(np.zeros(0, dtype=np.intp))
        self.block = self._no_block

    def follow(self, wanted: BoolArray) -> IntArray:
        """Scatter the block, and gather the cells that are ``wanted`` (n,); returns their indices (m,)."""
        cells = np.flatnonzero(wanted)
        few = max(cells.size, self.block.cells.size) < wanted.size  # else a block is the memory of all cells itself
        if self.compiled and few and self.block.cells.size:
            self.block = self._changed_over(cells, wanted)
        else:
            self.flush()
            self.block = self._gathered(cells)
        self.followed = wanted.copy()
        self.stale = False
        return cells

    def flush(self) -> None:
        """Scatter the block to the memory of all cells; no cell is followed until the next :meth:`follow`."""
        block, self.block = self.block, self._no_block
        if block.cells.size == self.followed.size:
            self.memory, self.line = block.memory, block.line
        elif self.compiled:
            every = np.arange(block.cells.size)
            for of_all, old in (self.memory, block.memory), (self.line, block.line):
                rows = np.arange(len(of_all))
                loops.copy.unchecked(old, rows, every, of_all, rows, block.cells)
        else:
            self.put(block.cells, block.memory, block.line)
        self.stale = True

    def begin(self, cells: IntArray, r: FloatArray) -> None:
        """Set the memory of ``cells`` (m,) as after reading ``r`` (m,) for ever. To be called after :meth:`flush`."""
        self.put(cells, self._inversion.begin(r), smoothing.begin(r, 1.0))
        self.stale = True

    def wake(self, cells: IntArray) -> None:
        """Mark sleeping ``cells`` (m,) for following; their smoothing starts as after one reading at rest."""
        # Their memory has been that of rest since they fell asleep, see :meth:`rest`.
        put_columns(self.line, cells, self._at_rest[1])
        self.stale = True

    def rest(self, cells: IntArray) -> None:
        """Reset the memory of ``cells`` (m,) that go to sleep to that of rest. To be called after :meth:`flush`."""
        put_columns(self.memory, cells, self._at_rest[0])

    def put(self, cells: IntArray, memory: FloatArray, line: FloatArray) -> None:
        """Write ``memory`` (rows, k) and ``line`` (ROWS, k) of ``cells`` (k,), outside of the block."""
        put_columns(self.memory, cells, memory)
        put_columns(self.line, cells, line)

    def interrupt(self, cells: IntArray) -> None:
        """Make the next reading of ``cells`` (m,) start a new line. To be called after :meth:`flush`."""
        line = self.line[:, cells]
        smoothing.interrupt(line)
        put_columns(self.line, cells, line)

    def hold(self, cells: IntArray, unread_s: FloatArray) -> None:
        """Advance the memory of ``cells`` (m,) by ``unread_s`` (m,) without readings, as if the load had been held."""
        if self.compiled:
            self._inversion.hold_compiled(self.memory, cells, unread_s)
        else:
            put_columns(self.memory, cells, self._inversion.hold(columns(self.memory, cells), unread_s))

    def left_over(self) -> FloatArray:
        """(n,) r that earlier loads have left in cells, see :meth:`._inversion.Inversion.left_over`."""
        block = self.block
        if not block.cells.size:  # the block has been flushed
            return self._inversion.left_over(self.memory)
        found = np.zeros(self.followed.size)
        found[block.cells] = self._inversion.left_over(block.memory)
        return found

    def state(self) -> dict[str, FloatArray | BoolArray]:
        """The state, by name. To be called after :meth:`flush`."""
        return {"memory": self.memory, "line": self.line, "followed": self.followed}

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a saved :meth:`state`; discards the present state."""
        self.block = self._no_block
        self.memory, self.line = spaced(state["memory"]), state["line"]
        self.follow(state["followed"] > 0)
        self.stale = True

    def _changed_over(self, cells: IntArray, wanted: BoolArray) -> Block:
        """The block of ``cells`` (m,), which are ``wanted`` (n,), made from the present block, which shares most cells.

        Shared cells are copied from block to block, since access to the memory of all cells is scattered and slow.
        """
        before, followed = self.block, self.followed[cells]
        stay = wanted[before.cells]
        kept, left = stay.nonzero()[0], (~stay).nonzero()[0]
        same, new = followed.nonzero()[0], (~followed).nonzero()[0]
        memory, line = spaced_anything(len(self.memory), cells.size), np.empty((len(self.line), cells.size))
        for of_all, old, now in (self.memory, before.memory, memory), (self.line, before.line, line):
            rows = np.arange(len(of_all))
            loops.copy.unchecked(old, rows, left, of_all, rows, before.cells[left])
            loops.copy.unchecked(old, rows, kept, now, rows, same)
            loops.copy.unchecked(of_all, rows, cells[new], now, rows, new)
        return Block(cells, memory, line)

    def _gathered(self, cells: IntArray) -> Block:
        if cells.size == self.memory.shape[1]:
            # Not copied, since :meth:`flush` takes it back. A new array object signals that it may have changed.
            return Block(cells, self.memory[:], self.line[:])
        return Block(cells, spaced_columns(self.memory, cells), self.line.take(cells, axis=1))
