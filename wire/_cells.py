"""Numbers of a frame, in the order in which they are sent, to the counts of an array and back."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..common.config import Finite, Section
from ._packets import Corrupt, Event, FramePacket
from ._protocol import Layout

Numbers = NDArray[np.float64]
Byte = Annotated[int, Field(ge=0, le=255)]


class AnyFrame(Section):
    """Keys of ``[frame]`` in BOARD.toml that every format has: how the numbers lie in the array."""

    order: Literal["row-major", "column-major"] = "row-major"
    flip_rows: bool = False
    flip_columns: bool = False
    invert: bool = False
    """counts fall with pressure: they are turned over before anything else sees them"""
    map: Annotated[tuple[int, ...], Field(strict=False, max_length=2**16)] | None = None
    """place in the array, counted row by row, of each number sent, in place of order and flips"""
    range: Annotated[tuple[Finite, Finite], Field(strict=False)] | None = None
    """numbers that stand for count 0 and for the largest count; None: the numbers are the counts"""
    invalid: Literal["mark", "drop"] = "mark"
    """what a number that is missing, NaN or outside the range costs: the cell, or the frame"""

    copies: Annotated[int, Field(ge=1, le=16)] = 1
    """times that each frame is sent"""

    @property
    def has_number(self) -> bool:
        """Whether frames are numbered."""
        raise NotImplementedError

    @property
    def has_time(self) -> bool:
        """Whether frames have the board's time."""
        raise NotImplementedError

    def cells(self, layout: Layout) -> Cells:
        """The cells of an array."""
        shape, largest = (layout.rows, layout.columns), 2**layout.adc_bits - 1
        index = np.arange(shape[0] * shape[1])
        grid = index.reshape(shape) if self.order == "row-major" else index.reshape(shape[::-1]).T
        if self.map is not None:
            grid = np.empty(index.size, dtype=index.dtype)
            grid[list(self.map)] = index
            grid = grid.reshape(shape)
        grid = grid[:: -1 if self.flip_rows else 1, :: -1 if self.flip_columns else 1]
        lowest, highest = (0.0, float(largest)) if self.range is None else self.range
        step = (highest - lowest) / largest
        return Cells(shape, grid.ravel(), lowest, step, largest, self.invert, drops=self.invalid == "drop")


@dataclass(frozen=True, eq=False)
class Cells:
    """How the numbers of a frame lie in the array, and what they stand for."""

    shape: tuple[int, int]
    place: NDArray[np.intp]
    """for each cell, row by row, the place of its number"""
    lowest: float
    """number that stands for count 0"""
    step: float
    """of the numbers from one count to the next"""
    largest: int
    """count"""
    invert: bool
    drops: bool
    """whether a number that is no count costs the whole frame"""

    @property
    def count(self) -> int:
        """Number of cells."""
        return self.place.size

    def are_counts(self, numbers: Numbers) -> bool:
        """Whether each of these numbers stands for a count."""
        return bool(self._good(self._scaled(numbers)).all())

    def event(
        self, numbers: Numbers, size: int, *, sequence: int | None = None, time_us: int | None = None
    ) -> FramePacket | Corrupt:
        """The frame of (cells,) numbers in the order sent, NaN where one is missing.

        Args:
            numbers: as they were sent.
            size: bytes of the frame on the line.
            sequence: number of the frame; None: it has none.
            time_us: on the board's clock; None: it tells none.

        """
        scaled = self._scaled(numbers[self.place])
        good = self._good(scaled)
        if good.all():
            absent: tuple[int, ...] = ()
        elif self.drops:
            wrong = numbers[self.place][~good][0]
            return Corrupt(size, f"a number that is no count: {wrong:g}")
        else:
            absent = tuple(np.flatnonzero(~good).tolist())
            scaled = np.where(good, scaled, 0.0)
        counts = scaled.astype(np.uint16)
        if self.invert:
            counts = np.uint16(self.largest) - counts
        if absent:
            counts[list(absent)] = 0
        return FramePacket.of(
            counts.reshape(self.shape),
            sequence=None if sequence is None else sequence % 2**32,
            time_us=time_us,
            absent=absent,
        )

    def numbers(self, frame: FramePacket) -> Numbers:
        """The (cells,) numbers that a board sends for ``frame``, in the order sent."""
        counts = frame.counts.ravel().astype(np.float64)
        if self.invert:
            counts = self.largest - counts
        sent = np.empty(counts.size)
        sent[self.place] = self.lowest + self.step * counts
        return sent

    def _scaled(self, numbers: Numbers) -> Numbers:
        with np.errstate(over="ignore", invalid="ignore"):
            scaled: Numbers = np.rint((numbers - self.lowest) / self.step)
        return scaled

    def _good(self, scaled: Numbers) -> NDArray[np.bool_]:
        good: NDArray[np.bool_] = (scaled >= 0) & (scaled <= self.largest)  # both False for NaN
        return good


class Copies:
    """Drops the copies of a board that sends each frame several times."""

    def __init__(self, copies: int) -> None:
        self._copies = copies
        self._last: FramePacket | None = None
        self._seen = 0

    def without(self, events: list[Event]) -> list[Event]:
        """The events without the frames that are copies."""
        return [event for event in events if not (isinstance(event, FramePacket) and self._is_copy(event))]

    def _is_copy(self, frame: FramePacket) -> bool:
        last, self._last = self._last, frame
        alike = last is not None and (frame.payload, frame.absent) == (last.payload, last.absent)
        self._seen = self._seen + 1 if alike and self._seen < self._copies else 1
        return self._seen > 1


class Unwrapped:
    """A number that begins again after some steps, without these jumps."""

    WRAPS = 2**8, 2**16, 2**32
    """after which numbers of microcontrollers begin again"""

    def __init__(self) -> None:
        self._last: float = 0
        self._offset = 0
        self._begun = False

    def of(self, read: tuple[int, int] | None) -> int | None:
        """The number behind the value and the period that were read; None: none was."""
        if read is None:
            return None
        value, period = read
        last = self._last
        self._last = int(last) + (value - int(last)) % period if self._begun else value
        self._begun = True
        return int(self._last)

    def of_text(self, value: float) -> float:
        """The number behind one in a text, which does not say after how many steps it begins again."""
        value = min(max(value, 0.0), 2.0**53)
        fallen = self._last - value
        wraps = (wrap for wrap in self.WRAPS if self._last < wrap and wrap - fallen < wrap / 8)
        self._offset += next(wraps, 0) if fallen > 0 else 0
        self._last = value
        return value + self._offset


class Pauses:
    """Where frames begin in a stream that shows them by nothing but the pauses between them.

    The stream is counted in units, lines or bytes, of which a frame has ``period``. The time from the arrival of one
    unit to the next is summed for each place in the period. Frames begin at the place with the longest pauses.
    """

    TOLD_APART = 2.0
    """ratio of the longest pause to the next, from which on it is clear"""
    FORGET = 0.7
    """weight of the pauses one period ago"""
    PERIODS = 3
    """after which the place is decided"""

    def __init__(self, period: int) -> None:
        self._period = period
        self._pause_s: dict[int, float] = {}
        self._latest: float | None = None
        self._longest_s, self._usual_s = 0.0, math.inf
        """longest pause of this period, and of the usual one"""
        self._since = self._counted = 0
        self.origin = 0
        """place at which frames begin if no pause is clear: that of the first unit, or of the last clear pause"""

    def arrive(self, received_at: float, units: int = 1) -> int:
        """Count units that came together; returns the place of the first of them in the period."""
        place = self._counted % self._period
        if self._latest is not None:
            # A pause of the operating system, however long, counts as two of the board.
            pause_s = min(max(received_at - self._latest, 0.0), 2.0 * self._usual_s)
            self._longest_s = max(self._longest_s, pause_s)
            self._pause_s[place] = self._pause_s.get(place, 0.0) + pause_s
        self._latest = received_at
        self._counted += units
        self._since += units
        while self._since >= self._period:
            self._since -= self._period
            self._pause_s = {at: self.FORGET * pause for at, pause in self._pause_s.items() if pause > 1e-9}
            if self.decided:
                usual_s = self._longest_s if math.isinf(self._usual_s) else self._usual_s
                self._usual_s = self.FORGET * usual_s + (1.0 - self.FORGET) * self._longest_s
            self._longest_s = 0.0
        return place

    def begin(self) -> None:
        """A frame begins with the next unit, as far as is known without pauses."""
        self.origin = self._counted % self._period

    @property
    def decided(self) -> bool:
        """Whether enough has come to tell where frames begin."""
        return self._counted >= self.PERIODS * self._period

    @property
    def by_pause(self) -> int | None:
        """Place at which frames begin; None: no pause is clearly longer than the others."""
        longest = sorted(self._pause_s.items(), key=lambda item: item[1])[-2:]
        if not longest or longest[-1][1] <= 0.0 or self._period == 1:
            return None
        second = longest[0][1] if len(longest) > 1 else 0.0
        return longest[-1][0] if longest[-1][1] >= self.TOLD_APART * second else None

    @property
    def start(self) -> int:
        """Place at which frames begin."""
        place = self.by_pause
        if place is not None:
            self.origin = place
        return self.origin
