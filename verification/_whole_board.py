"""Targets that judge a board as a whole: settling, scan rate, stability, and what parts bear.

Their corners have no derivatives at hand. Patterns of presses that are hard on such quantities are where the search
starts, and flips of parts, cells and lines are how it goes on.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..circuits import (
    Boards,
    BoardsInTime,
    Design,
    Event,
    EventScan,
    OperatingPoint,
    Scan,
    operating_points,
    read_together,
    stability_of_boards,
)
from ..common.arrays import IN_CACHE, FloatArray
from ._box import Box, Corners
from ._search import Target
from ._tuning import PERIODS, RANDOM_CORNERS

MOST_SECONDS = 1.0
"""of a frame that never settles"""
SETTLED = 1e-11
"""share of a signal; smaller deviations are rounding"""


class WholeBoardTarget(Target):
    """The largest number of any cell or line of a board."""

    by_cell = False

    @abstractmethod
    def values(self, box: Box, x: FloatArray) -> FloatArray:
        """(C, N, M) what each cell contributes at points (C, D); NaN where it says nothing."""

    def evaluate(self, box: Box, corners: Corners) -> FloatArray:
        if not len(corners):
            return np.zeros(0)
        found = self.values(box, corners.x).reshape(len(corners), -1)
        with np.errstate(invalid="ignore"):
            return np.asarray(np.where(np.isnan(found), -np.inf, found).max(axis=1))

    def evaluate_at(self, box: Box, corners: Corners, place: tuple[int, int]) -> FloatArray:
        return np.asarray(self.values(box, corners.x)[:, place[0], place[1]]) if len(corners) else np.zeros(0)

    def place(self, box: Box, corner: Corners) -> tuple[int, int]:
        found = self.values(box, corner.x)[0]
        row, column = np.unravel_index(int(np.argmax(np.where(np.isnan(found), -np.inf, found))), found.shape)
        return int(row), int(column)

    def starts(self, box: Box) -> Corners:
        """All cells alike, alternating lines, one line or cell unlike the others; and random corners."""
        row, column = np.indices(box.shape)
        patterns = [np.zeros(box.shape), row % 2, column % 2, (row + column) % 2, row == 0, column == 0]
        patterns += [(row == 0) & (column == 0)]
        pressed = np.array([side for pattern in patterns for side in (pattern, 1 - np.asarray(pattern))], dtype=float)
        random = np.random.default_rng(1)
        x = np.zeros((len(pressed) + RANDOM_CORNERS, box.size))
        x[len(pressed) :] = random.choice([-1.0, 1.0], (RANDOM_CORNERS, box.size))
        box.split(x)[1][: len(pressed)] = 2.0 * pressed - 1.0
        return Corners.of_boards(x)


class InTimeTarget(WholeBoardTarget):
    """Numbers of the circuit in time, solved for many boards at once."""

    in_time: ClassVar[bool] = True
    periods: ClassVar[float] = 1.0
    """row periods that are solved of one board, whose matrices are made once"""

    def cost(self, box: Box) -> float:
        rows, columns = box.design.board.shape
        if goes_by_events(box.design):
            return 400.0 * box.cells * self.periods  # a matrix exponential for each reading
        turns = columns if box.design.board.circuit.columns_one_by_one(box.design.board) else 1
        groups = rows if box.design.board.floating else 1
        return self.periods * (box.cells + 3 * groups * turns * columns**2)

    @abstractmethod
    def of_boards(self, box: Box, boards: Boards, cells: FloatArray) -> FloatArray:
        """(B, N, M) as :meth:`values`, of boards with cells (B, N, M) in ohm."""

    def values(self, box: Box, x: FloatArray) -> FloatArray:
        size = max(1, int(self.periods * IN_CACHE / self.cost(box)))
        parts = []
        for first in range(0, len(x), size):
            some = x[first : first + size]
            parts.append(self.of_boards(box, box.population(some).boards, box.cells_of(some)))
        return np.concatenate(parts)


def within_supply(box: Box, settled: FloatArray) -> FloatArray:
    """1 where settled outputs (B, N, M) keep the supply, NaN on boards where one does not: they are not linear."""
    low, high = box.design.board.supply
    kept = ((settled >= low) & (settled <= high)).all(axis=(1, 2), keepdims=True)
    return np.where(kept, 1.0, np.nan) * np.ones(settled.shape)


@dataclass(frozen=True)
class SettlingTarget(InTimeTarget):
    """Deviation of a sampled reading from the settled one, over the largest signal."""

    period: float
    """s for each driven line"""
    signal: float
    """V"""
    name: str = "settling error"

    def of_boards(self, box: Box, boards: Boards, cells: FloatArray) -> FloatArray:
        if goes_by_events(box.design):
            scans = [scan_in_time(boards.design(box.design, b), frame, self.period) for b, frame in enumerate(cells)]
            return np.stack([np.maximum(np.abs(s.sampled - s.settled) / self.signal, SETTLED) for s in scans])
        in_time = BoardsInTime(box.design, boards, cells)
        share = np.maximum(in_time.deviations(self.period).larger / self.signal, SETTLED)
        return share * within_supply(box, in_time.settled)


@dataclass(frozen=True)
class FrameTimeTarget(InTimeTarget):
    """Shortest time of a frame, s, in which every reading settles to so much."""

    allowed: float
    """V"""
    name: str = "frame time"
    periods: ClassVar[float] = PERIODS

    def at(self, box: Box, frame_time: float) -> SettlingTarget:
        """Deviations at one frame time, which take far less time to solve: 1 is as much as is allowed."""
        return SettlingTarget(frame_time / box.design.board.shape[0], self.allowed)

    def of_boards(self, box: Box, boards: Boards, cells: FloatArray) -> FloatArray:
        in_time = BoardsInTime(box.design, boards, cells)
        shortest = in_time.shortest_period(np.full(len(cells), self.allowed)) * box.design.board.shape[0]
        return shortest[:, None, None] * within_supply(box, in_time.settled)

    def place(self, box: Box, corner: Corners) -> tuple[int, int]:
        return self.at(box, min(self.stated(box, corner), MOST_SECONDS)).place(box, corner)


@dataclass(frozen=True)
class PhaseMarginTarget(InTimeTarget):
    """Negative phase margin of each cell's amplifier, degrees."""

    name: str = "phase margin"

    def of_boards(self, box: Box, boards: Boards, cells: FloatArray) -> FloatArray:
        return -stability_of_boards(box.design, boards, cells).phase_margin

    def cost(self, box: Box) -> float:
        return 3.0 * box.cells


@dataclass(frozen=True)
class OperatingTarget(WholeBoardTarget):
    """What a part bears at the operating point of a frame, by the name of a field of :class:`OperatingPoint`."""

    field: str
    name: str

    def values(self, box: Box, x: FloatArray) -> FloatArray:
        point = operating_points(box.design, box.population(x).boards, box.cells_of(x))
        return np.broadcast_to(self.of_points(box, point), (len(x), *box.shape))

    def of_points(self, box: Box, points: OperatingPoint) -> FloatArray:
        """(C, N, M), or what broadcasts to it."""
        value: FloatArray = getattr(points, self.field)
        if value.ndim == 3:
            return value
        driven = self.field.startswith("driver")
        along_rows = driven != box.design.board.transposed
        return value[:, :, None] if along_rows else value[:, None]

    def cost(self, box: Box) -> float:
        together = read_together(box.design) and not box.design.board.circuit.drives_idle_lines
        return 4.0 * box.cells if together else 400.0 + 10.0 * box.cells


@dataclass(frozen=True)
class LeakageTarget(OperatingTarget):
    """Change of a reading by the leakage of all idle lines, over that reading."""

    amperes: float = 0.0
    """of each idle line, of either sign"""
    field: str = "leakage"
    name: str = "leakage error"

    def of_points(self, box: Box, points: OperatingPoint) -> FloatArray:
        with np.errstate(divide="ignore", invalid="ignore"):
            share: FloatArray = self.amperes * points.leakage / np.abs(points.signal)
        return share


def goes_by_events(design: Design) -> bool:
    """Whether a scan is a list of events, or its ends are networks, which are followed event by event."""
    return design.scan is not None or design.is_described


def scan_in_time(design: Design, cells: FloatArray, period: float) -> EventScan:
    """One frame by the events of the design, or of networks without events by a sample at the end of each period."""
    return EventScan(design, cells, design.scan or Scan(row=(Event(wait=period),), conversion_time=0.0))


def driven_line(box: Box, place: Sequence[int]) -> str:
    """The driven line of a cell, in words."""
    board = box.design.board
    return f"{board.line_kinds[0]} {place[1] if board.transposed else place[0]}"


def sensed_line(box: Box, place: Sequence[int]) -> str:
    """The sensed line of a cell, in words."""
    board = box.design.board
    return f"{board.line_kinds[1]} {place[0] if board.transposed else place[1]}"
