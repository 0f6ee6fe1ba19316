"""Trails of fast fingers: cells that a finger has crossed within a frame or so, told by where readings rise next.

A finger that slides by more than about a cell per frame loads each cell for less than a frame. The material answers a
fast rise by more than a fast fall, so what is left in such a cell reads like a held load for seconds, and its readings
alone cannot tell: the load has come and gone between two of them. The array can. The cells that rise from one frame to
the next show where the finger has gone meanwhile (its *head*). Heads that move on in one direction, frame after frame,
are a slide; whoever rises in their course and does not rise any more when the head is elsewhere has been left behind.

Such a cell counts as untouched until its reading rises anew. The last head of a slide is where the finger has
stopped, unless the readings there fall at once, or are low where the next head would lie beyond the rim of the skin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import BoolArray, FloatArray
from ._around import highest_around, with_all_neighbours
from ._watershed import Segments

SUDDEN = 0.2
"""share of the largest reading in the 3 x 3 cells around a cell by which the reading of a head's cell rises in a frame:
a finger that slides by half a cell per frame makes less"""
CLEAR = 8.0
"""standard deviations of a reading's noise by which it rises in a head, and after which a cell is touched anew"""
ANEW = 0.15
"""share of its least reading since it was left by which a cell rises that is touched anew"""
LEAST_STEP, MOST_STEP = 0.3, 5.0
"""cells per frame from one head to the next"""
LEAST_SPEED = 0.75
"""cells per frame of a slide, the mean of all that there was"""
AHEAD = 0.7
"""least cosine between the last two steps of a slide; a step shorter than the speed above tells no direction"""
HEADS = 3
"""that make a slide: two fingers that come down side by side, one frame apart, make two"""
BEHIND = 1.75
"""cells behind the head, from which the finger is gone"""
FAST = 1.5
"""cells per frame. A slower slide leaves less behind, and its head is farther ahead of the middle of the finger"""
FALLS = 0.2
"""share of the readings of a slide's last head by which they fall in the next frame if the finger is lifted there"""
KEPT = 0.8
"""of the largest reading of a slide: least one at the rim of the skin under a finger that has stopped there"""
GONE = 0.1
"""share by which the readings of the cells behind a slide have fallen together. A cell that was loaded and unloaded
between two frames shows no fall, but those beside it do, on which the finger was when they were read"""


@dataclass(frozen=True, slots=True)
class _Head:
    """Where readings have risen suddenly and together in one frame, and the slide that has led there."""

    row: float
    column: float
    cells: BoolArray
    """(rows, columns) that have risen"""
    course: BoolArray
    """(rows, columns) cells of all heads so far, and those around them, that were untouched before"""
    step: tuple[float, float] = (0.0, 0.0)
    """rows and columns per frame from the head before; 0 where there is none"""
    number: int = 1
    """of heads in the slide so far"""
    way: float = 0.0
    """cells from the first head to this one"""
    frames: int = 0
    """from the first head to this one"""
    missed: int = 0
    """frames since then without a head"""

    @property
    def slides(self) -> bool:
        return self.number >= HEADS and self.way >= LEAST_SPEED * self.frames


class Trails:
    """Follows fast slides, and knows which cells they have left behind."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.shape = shape
        self._segments = Segments(shape)
        self.left: BoolArray = np.zeros(shape, dtype=np.bool_)
        """(rows, columns) cells that were left behind and have not been touched since"""
        self.any_left = False
        self._least = np.zeros(shape)
        """(rows, columns) least reading since then"""
        self._highest = self._least
        """(rows, columns) largest reading since there have been heads"""
        self._before: FloatArray | None = None
        self._heads: list[_Head] = []
        self._rows, self._columns = np.indices(shape)

    def forget(self) -> None:
        """Begin anew: readings count from other rest resistances."""
        self.left = np.zeros(self.shape, dtype=np.bool_)
        self.any_left, self._before, self._heads = False, None, []

    def look(self, reading: FloatArray, noise: FloatArray, touched: BoolArray) -> None:
        """Take the readings of the next frame.

        Args:
            reading: (rows, columns) R/R0 - 1, positive in the direction of a load; NaN where the cell was not read.
            noise: (rows, columns) standard deviation of one reading.
            touched: (rows, columns) cells of contacts in the frame before.

        """
        before, self._before = self._before, reading
        if self.any_left:
            self._let_rise_again(reading, noise)
        if before is None:
            return
        rise = reading - before
        sudden = rise > CLEAR * noise  # False where NaN
        if sudden.any():
            sudden &= rise > SUDDEN * highest_around(np.where(np.isnan(reading), 0.0, reading))
        elif not self._heads:
            return
        if self.any_left:
            self.left &= ~sudden
        last, self._heads = self._heads, []
        self._highest = np.fmax(self._highest, reading) if last else reading
        gone_on = set[int]()
        if sudden.any():
            labels, count = self._segments.label(sudden)
            for label in range(1, count + 1):
                self._heads.append(self._head(labels == label, rise, last, gone_on, touched))
        for head in self._heads:
            if head.slides:
                slow = max(FAST - head.way / head.frames, 0.0)
                behind = head.course & ~sudden & (self._along(head) < -BEHIND - slow)
                if self._have_fallen(behind, reading):
                    self._leave(behind, reading)
        for head in last:
            if id(head) not in gone_on:
                behind = head.course & ~sudden
                if head.slides and self._is_over(head, reading, rise) and self._have_fallen(behind, reading):
                    self._leave(behind, reading)
                elif not head.missed:
                    self._heads.append(replace(head, missed=1))

    def _let_rise_again(self, reading: FloatArray, noise: FloatArray) -> None:
        self.left &= ~(reading > (1.0 + ANEW) * self._least + CLEAR * noise)
        np.fmin(self._least, reading, out=self._least)
        self.any_left = bool(self.left.any())

    def _head(
        self, cells: BoolArray, rise: FloatArray, last: list[_Head], gone_on: set[int], touched: BoolArray
    ) -> _Head:
        weights = rise[cells]
        row = float(self._rows[cells] @ weights / weights.sum())
        column = float(self._columns[cells] @ weights / weights.sum())
        around = with_all_neighbours(cells) & (cells | ~touched)
        before = [head for head in last if _goes_on(head, row, column)]
        if not before:
            return _Head(row, column, cells, around)
        head = max(before, key=lambda one: (one.number, -math.hypot(row - one.row, column - one.column)))
        gone_on.add(id(head))
        frames = 1 + head.missed
        down, right = row - head.row, column - head.column
        return _Head(
            row,
            column,
            cells,
            head.course | around,
            step=(down / frames, right / frames),
            number=head.number + 1,
            way=head.way + math.hypot(down, right),
            frames=head.frames + frames,
        )

    def _along(self, head: _Head) -> FloatArray:
        """(rows, columns) cells from the head, in the direction in which it moves."""
        down, right = head.step
        way: FloatArray = (self._rows - head.row) * down + (self._columns - head.column) * right
        return way / math.hypot(down, right)

    def _is_over(self, head: _Head, reading: FloatArray, rise: FloatArray) -> bool:
        """Whether a slide that has no head in this frame has left the skin.

        A finger that was lifted makes its last cells fall at once. Of one that has gone beyond the rim, the cells there
        keep less than it pressed into the others. Under a finger that has stopped they do neither.
        """
        front = head.cells & (self._along(head) >= 0.0) & ~np.isnan(rise)
        if rise[front].sum() < -FALLS * (reading - rise)[front].sum():
            return True
        rows, columns = self.shape
        row, column = head.row + head.step[0], head.column + head.step[1]
        if -0.5 <= row <= rows - 0.5 and -0.5 <= column <= columns - 0.5:
            return False
        last = np.fmax.reduce(reading[with_all_neighbours(head.cells)])
        return bool(last < KEPT * np.fmax.reduce(self._highest[head.course]))

    def _have_fallen(self, cells: BoolArray, reading: FloatArray) -> bool:
        """Whether the readings of these cells have fallen as under a finger that is gone.

        Under an object that comes down on one cell after the other, from one end to the other, they have not. Nor have
        they under fingers that come down together, of which the one at the rim is the last to stop.
        """
        cells = cells & ~np.isnan(reading)
        highest = self._highest[cells]
        return bool((highest - reading[cells]).sum() > GONE * highest.sum())

    def _leave(self, cells: BoolArray, reading: FloatArray) -> None:
        new = cells & ~self.left & ~np.isnan(reading)
        self._least = np.where(new, reading, self._least)
        self.left |= new
        self.any_left = bool(self.left.any())


def _goes_on(head: _Head, row: float, column: float) -> bool:
    """Whether the next head may be at (row, column)."""
    down, right = row - head.row, column - head.column
    length, frames = math.hypot(down, right), 1 + head.missed
    if not LEAST_STEP * frames <= length <= MOST_STEP * frames:
        return False
    before = math.hypot(*head.step)
    return before < LEAST_SPEED or down * head.step[0] + right * head.step[1] >= AHEAD * length * before
