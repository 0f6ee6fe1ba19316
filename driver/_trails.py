"""Trails of fast fingers: cells that a finger crossed within about a frame, recognised by where readings rise next.

A finger that slides by more than about a cell per frame loads each cell for less than a frame. The material responds
more to a fast rise than to a fast fall, so the remaining reading of such a cell looks like a held load for seconds. The
cell's own readings cannot show the difference: the load has come and gone between two of them. The array can. The cells
that rise from one frame to the next show where the finger is now (its *head*). Heads that move on in one direction,
frame after frame, are a slide. A cell that rose in their course, and does not rise any more when the head is elsewhere,
has been left behind.

Such a cell counts as untouched until its reading rises again. The last head of a slide is the place where the finger
has stopped, unless the readings there fall at once, or the readings are low and the next head would lie beyond the rim
of the skin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..common.arrays import BoolArray, FloatArray
from ._around import highest_around, with_all_neighbours
from ._watershed import Segments

SUDDEN = 0.2
"""rise of a head's cell in one frame, over the largest reading in the 3 x 3 cells around it: a finger that slides by
half a cell per frame causes less"""
CLEAR = 8.0
"""standard deviations of a reading's noise by which it rises in a head, and by which a cell left behind must rise to be
touched again"""
ANEW = 0.15
"""rise of a cell that is touched again, over its least reading since it was left"""
LEAST_STEP, MOST_STEP = 0.3, 5.0
"""cells per frame from one head to the next"""
LEAST_SPEED = 0.75
"""least mean speed of a slide in cells per frame"""
AHEAD = 0.7
"""least cosine between the last two steps of a slide; a step shorter than the speed above has no clear direction"""
HEADS = 3
"""least number of heads in a slide: two fingers that come down side by side, one frame apart, make two"""
BEHIND = 1.75
"""cells behind the head from which on the finger is gone"""
FAST = 1.5
"""cells per frame. A slower slide leaves less behind, and its head is farther ahead of the middle of the finger"""
FALLS = 0.2
"""relative fall of the readings of a slide's last head in the next frame if the finger is lifted there"""
KEPT = 0.8
"""least reading at the rim of the skin under a finger that has stopped there, over the largest reading of the slide"""
GONE = 0.1
"""relative fall of the sum of the readings of the cells behind a slide. A cell that was loaded and unloaded between two
frames shows no fall, but its neighbours do, which the finger was on when they were read"""
LESS = 2.0
"""standard deviations of a reading's noise subtracted from the largest of several readings: noise makes the largest too
large by about as much, which on a board of few steps looks like a fall"""


@dataclass(frozen=True, slots=True)
class _Head:
    """Place where readings have risen suddenly and together in one frame, and the slide that has led there."""

    row: float
    column: float
    cells: BoolArray
    """(rows, columns) that have risen"""
    course: BoolArray
    """(rows, columns) cells of all heads so far, and the previously untouched cells around them"""
    step: tuple[float, float] = (0.0, 0.0)
    """rows and columns per frame from the head before; 0 if there is none"""
    number: int = 1
    """number of heads in the slide so far"""
    way: float = 0.0
    """length of the slide in cells, from the first head to this one"""
    frames: int = 0
    """frames from the first head to this one"""
    missed: int = 0
    """frames without a head since then"""

    @property
    def slides(self) -> bool:
        return self.number >= HEADS and self.way >= LEAST_SPEED * self.frames


class Trails:
    """Follows fast slides, and marks the cells that they have left behind."""

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
        """Begin anew: rest resistances have changed."""
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
                if self._have_fallen(behind, reading, noise):
                    self._leave(behind, reading)
        for head in last:
            if id(head) not in gone_on:
                behind = head.course & ~sudden
                if head.slides and self._is_over(head, reading, rise) and self._have_fallen(behind, reading, noise):
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
        """(rows, columns) position relative to the head, in cells along its direction of motion."""
        down, right = head.step
        way: FloatArray = (self._rows - head.row) * down + (self._columns - head.column) * right
        return way / math.hypot(down, right)

    def _is_over(self, head: _Head, reading: FloatArray, rise: FloatArray) -> bool:
        """Whether a slide without a head in this frame has left the skin.

        The last cells under a finger that was lifted fall at once. Where a finger has gone beyond the rim, the cells
        keep less than it pressed into the others. Under a finger that has stopped, the cells do neither.
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

    def _have_fallen(self, cells: BoolArray, reading: FloatArray, noise: FloatArray) -> bool:
        """Whether the readings of these cells have fallen as they do when a finger is gone.

        They do not fall under an object that comes down on one cell after the other, from end to end. Nor do they fall
        under fingers that come down together, the one at the rim last.
        """
        cells = cells & ~np.isnan(reading)
        highest = self._highest[cells]
        return bool((highest - reading[cells] - LESS * noise[cells]).sum() > GONE * highest.sum())

    def _leave(self, cells: BoolArray, reading: FloatArray) -> None:
        new = cells & ~self.left & ~np.isnan(reading)
        self._least = np.where(new, reading, self._least)
        self.left |= new
        self.any_left = bool(self.left.any())


def _goes_on(head: _Head, row: float, column: float) -> bool:
    """Whether a head at (row, column) may continue this one's slide."""
    down, right = row - head.row, column - head.column
    length, frames = math.hypot(down, right), 1 + head.missed
    if not LEAST_STEP * frames <= length <= MOST_STEP * frames:
        return False
    before = math.hypot(*head.step)
    return before < LEAST_SPEED or down * head.step[0] + right * head.step[1] >= AHEAD * length * before
