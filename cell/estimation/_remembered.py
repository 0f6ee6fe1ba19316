"""The memory of all cells, and the block of those that are followed at present (gather, work, scatter).

A skin is large and few of its cells are pressed. Work of a frame is done for those only, side by side in a block. A
block is gathered from the memory of all cells when other cells are to be followed, and scattered back before. By
machine code cells that are followed further go from block to block.
"""

from __future__ import annotations

import numpy as np

from ...arrays import BoolArray, FloatArray, IntArray, columns, put_columns, spaced, spaced_anything, spaced_columns
from . import _loops as loops
from . import _smoothing as smoothing
from ._inversion import Inversion


class Block:
    """What is remembered of the cells that are followed, side by side."""

    def __init__(self, cells: IntArray, memory: FloatArray, line: FloatArray) -> None:
        """``cells`` (m,) are indices, ``memory`` (rows, m) is the inversion's, ``line`` (ROWS, m) the smoothing's.

        Rows of the memory need not follow each other without a gap.
        """
        self.cells, self.memory, self.line = cells, memory, line
        self.line_before = line.copy()
        """the line after the last step; replaced, never changed. Machine code sets it when the next step begins"""
        self.scratch: smoothing.Scratch | None = None
        """of the array operations; None: not used yet"""
        self.near: IntArray | None = None
        """(k, m) neighbours, see :meth:`._neighbours.Neighbours.among`; None: not asked for yet"""
        self.taken = np.empty((4, cells.size))
        """readings of the step, for machine code; see :mod:`._rows`"""
        self.begun = np.empty(cells.size, dtype=np.bool_)
        """where a line began in the step, for machine code"""

    def __reduce__(self) -> tuple[type[Block], tuple[IntArray, FloatArray, FloatArray], dict[str, FloatArray]]:
        """For pickle and copy: the rows in ``scratch`` are parts of the line, and would become arrays of their own."""
        return type(self), (self.cells, self.memory, self.line), {"line_before": self.line_before}

    def memory_of(self, place: IntArray) -> FloatArray:
        """A copy of the memory (rows, k) of the cells at ``place`` (k,)."""
        every = place.size == self.cells.size and bool((np.diff(place) > 0).all())
        return spaced(self.memory) if every else spaced_columns(self.memory, place)

    def changed(self) -> None:
        """To be called when ``memory`` and ``line`` have been written to between two steps."""
        self.memory = self.memory[:]  # another array, as sign that it has changed
        self.line_before = self.line.copy()


class Remembered:
    """What is remembered of n cells. Cells that are followed at present have theirs in :attr:`block`."""

    def __init__(self, inversion: Inversion, cells: int) -> None:
        self._inversion = inversion
        self.memory = spaced(inversion.begin(np.zeros(cells)))
        self.line = smoothing.begin(np.zeros(cells))
        self.followed = np.zeros(cells, dtype=np.bool_)
        """(n,) the cells that were chosen last"""
        self.stale = True
        """whether other cells may have to be chosen"""
        self.compiled = False
        """whether the loops are there as machine code"""
        self._at_rest = inversion.begin(np.zeros(1)), smoothing.begin(np.zeros(1), 1.0)
        self._no_block = self._gathered(np.zeros(0, dtype=np.intp))
        self.block = self._no_block

    def follow(self, wanted: BoolArray) -> IntArray:
        """Gather the cells that are ``wanted`` (n,); returns their indices (m,). Those of before are scattered."""
        cells = np.flatnonzero(wanted)
        few = max(cells.size, self.block.cells.size) < wanted.size  # else blocks are the memory of all cells
        if self.compiled and few and self.block.cells.size:
            self.block = self._changed_over(cells, wanted)
        else:
            self.flush()
            self.block = self._gathered(cells)
        self.followed = wanted.copy()
        self.stale = False
        return cells

    def flush(self) -> None:
        """Scatter the block's memory to that of all cells; no cell is followed until they are chosen anew."""
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
        """Let ``cells`` (m,) remember that they have read ``r`` (m,) for ever. To be called after :meth:`flush`."""
        self.put(cells, self._inversion.begin(r), smoothing.begin(r, 1.0))
        self.stale = True

    def wake(self, cells: IntArray) -> None:
        """Let sleeping ``cells`` (m,) be followed, on lines that have read as at rest for ever."""
        # Their memory is that of rest since they sleep, see :meth:`rest`.
        put_columns(self.line, cells, self._at_rest[1])
        self.stale = True

    def rest(self, cells: IntArray) -> None:
        """Let ``cells`` (m,) go to sleep: they remember nothing but rest. To be called after :meth:`flush`."""
        put_columns(self.memory, cells, self._at_rest[0])

    def put(self, cells: IntArray, memory: FloatArray, line: FloatArray) -> None:
        """Let ``cells`` (k,) remember ``memory`` (rows, k) and ``line`` (ROWS, k), outside of the block."""
        put_columns(self.memory, cells, memory)
        put_columns(self.line, cells, line)

    def interrupt(self, cells: IntArray) -> None:
        """Let the next reading of ``cells`` (m,) begin a new line, whatever it is. To be called after :meth:`flush`."""
        line = self.line[:, cells]
        smoothing.interrupt(line)
        put_columns(self.line, cells, line)

    def hold(self, cells: IntArray, unread_s: FloatArray) -> None:
        """Bring up the memory of ``cells`` (m,) that were not read for ``unread_s`` (m,): as if the load had stayed."""
        if self.compiled:
            self._inversion.hold_compiled(self.memory, cells, unread_s)
        else:
            put_columns(self.memory, cells, self._inversion.hold(columns(self.memory, cells), unread_s))

    def left_over(self) -> FloatArray:
        """(n,) r that earlier loads have left in cells, see :meth:`._inversion.Inversion.left_over`."""
        block = self.block
        if not block.cells.size:  # what was followed until the last frame is in the memory of all
            return self._inversion.left_over(self.memory)
        found = np.zeros(self.followed.size)
        found[block.cells] = self._inversion.left_over(block.memory)
        return found

    def state(self) -> dict[str, FloatArray | BoolArray]:
        """What is remembered, by name. To be called after :meth:`flush`."""
        return {"memory": self.memory, "line": self.line, "followed": self.followed}

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a saved :meth:`state`; what was remembered until now is forgotten."""
        self.block = self._no_block
        self.memory, self.line = spaced(state["memory"]), state["line"]
        self.follow(state["followed"] > 0)
        self.stale = True

    def _changed_over(self, cells: IntArray, wanted: BoolArray) -> Block:
        """The block of ``cells`` (m,), which are ``wanted`` (n,), after another one, with which it shares most cells.

        These go from block to block. In the memory of all, each number of a cell is far from the next.
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
            # Not copied, as :meth:`flush` takes it back. Another array, as sign that it may have changed.
            return Block(cells, self.memory[:], self.line[:])
        return Block(cells, spaced_columns(self.memory, cells), self.line.take(cells, axis=1))
