"""Frames of several boards merged by time to those of one skin, with contacts across boards.

The rows of the boards stand below each other, and a board of fewer columns has no cells in the others. A joined frame
comes as soon as every board has sent a new one, or when one sends its next before that, so that none is left out. It
shows the newest frame of each board. A board that has not sent for :data:`ABSENT_S` is not waited for, and its cells
are not valid (``Reason.MISSING``).

All boards of a computer are on its one clock (:attr:`.Frame.monotonic_time`); recordings of one skin are merged by the
times at which their frames came, so that a replay gives the same frames each time. Readers take joined frames from a
queue as those of one board (:class:`._frames.Frames`).
"""

from __future__ import annotations

import heapq
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

import numpy as np

from ..circuits import Reason
from ..common.arrays import AnyArray
from ..common.geometry import Geometry
from ..errors import InputError, LinkEnded, LinkError, LinkTimeout, OhmskinError, ProtocolError
from ._contacts import ContactsOfFrames, ContactTracker, PressureView, Touch
from ._converted import Converted
from ._frame import Frame
from ._frames import Delivery, Frames
from ._statistics import Counters
from ._stream import RawFrame
from ._tuning import ABSENT_S, BETWEEN_PITCHES

SAME_PLACE_MM = 1e-3
_MISSING, _NO_CELL, _NOISY = int(Reason.MISSING), int(Reason.NO_CELL), int(Reason.UNCERTAIN)


def joined_geometry(boards: Sequence[Geometry]) -> Geometry:
    """The places of all boards. InputError: only some have a shape or space, or cells of two are at one place."""
    from scipy.spatial import cKDTree

    axes = {len(board.axes) for board in boards}
    without = [board.pitch_m is not None for board in boards]
    if len(axes) > 1 or (any(without) and not all(without)):
        raise InputError("boards with a [shape] and without, or flat ones and ones in space; expected all alike")
    across = max(board.shape[1] for board in boards)
    places, areas, left_mm = [], [], 0.0
    for board in boards:
        own = board.places_mm
        if board.pitch_m is not None:
            own = own + np.array([left_mm, 0.0])
            left_mm += 1e3 * board.pitch_m[0] * (board.shape[1] - 1 + BETWEEN_PITCHES)
        places.append(widened(own, across, np.nan))
        areas.append(widened(board.areas_mm2, across, 0.0))
    rows = tuple(board.shape[0] for board in boards)
    whole = Geometry(np.concatenate(places), np.concatenate(areas), rows_of_boards=rows)
    there = whole.places_mm[whole.exists]
    same = cKDTree(there).query_pairs(SAME_PLACE_MM)
    if same:
        one = there[min(same)[0]].tolist()
        raise InputError(f"cells of two boards are at {one} mm; expected a [shape] for each with places of its own")
    return whole


def widened(cells: AnyArray, columns: int, missing: float) -> AnyArray:
    """(rows, columns, ...) with columns without cells on the right."""
    room = [(0, 0), (0, columns - cells.shape[1])] + [(0, 0)] * (cells.ndim - 2)
    return np.pad(cells, room, constant_values=missing)


class Joiner:
    """Merges frames. What comes out depends on the order in which they are added, and on nothing else."""

    def __init__(self, boards: Sequence[Geometry], touch: Touch) -> None:
        self.geometry = joined_geometry(boards)
        self._shapes = [board.shape for board in boards]
        self._contacts = ContactsOfFrames(ContactTracker(self.geometry, *touch))
        self._last: list[Frame | None] = [None] * len(boards)
        self._fresh = [False] * len(boards)
        self.newest: Frame | None = None
        """of any board"""
        self._joined = self._overruns = self._reconnects = self._reboots = 0
        self._lost: int | None = 0
        self.starts = 0
        """joined frames since whose predecessor an estimator has started anew"""

    def add(self, board: int, frame: Frame) -> list[RawFrame]:
        """The joined frames, none or more, that follow from a frame of a board."""
        waits_long = any(
            fresh and last is not None and frame.monotonic_time - last.monotonic_time > ABSENT_S
            for fresh, last in zip(self._fresh, self._last, strict=True)
        )
        joined = [self._join()] if self._fresh[board] or waits_long else []
        self._last[board], self._fresh[board], self.newest = frame, True, frame
        if all(
            fresh or last is None or frame.monotonic_time - last.monotonic_time > ABSENT_S
            for fresh, last in zip(self._fresh, self._last, strict=True)
        ):
            joined.append(self._join())
        return joined

    def rest(self) -> list[RawFrame]:
        """The joined frame of what has not been shown yet, if there is any."""
        return [self._join()] if any(self._fresh) else []

    def _join(self) -> RawFrame:
        parts, fresh = list(self._last), list(self._fresh)
        self._fresh = [False] * len(parts)
        new = [part for part, is_new in zip(parts, fresh, strict=True) if is_new and part is not None]
        # Of all boards: the frame that is new may be older than another that is shown, and time would go back.
        newest = max((part for part in parts if part is not None), key=lambda frame: frame.monotonic_time)
        reason = self._cells(parts, lambda frame: frame.reason, _MISSING, _NO_CELL).astype(np.int8)
        old = np.zeros(reason.shape, dtype=np.bool_)
        first = 0
        for part, (rows, _), is_new in zip(parts, self._shapes, fresh, strict=True):
            own = slice(first, first + rows)
            old[own] = not is_new
            if part is None or newest.monotonic_time - part.monotonic_time > ABSENT_S:
                reason[own][reason[own] != _NO_CELL] = _MISSING
            first += rows
        pressure = self._cells(parts, lambda frame: frame.pressure)
        std = self._cells(parts, lambda frame: frame.pressure_std)
        valid = reason == 0
        unread = old | ~(valid | (reason == _NOISY))
        view = PressureView(newest.monotonic_time, pressure, std, unread)
        resistance = np.where(valid, self._cells(parts, lambda frame: frame.resistance), np.nan)
        counts = self._cells(parts, lambda frame: frame.counts, 0, 0).astype(np.uint16)
        rest_counts = self._cells(parts, lambda frame: frame.rest_counts, 0.0, 0.0)
        for array in (counts, valid, reason, resistance, pressure, std, rest_counts):
            array.setflags(write=False)
        self._joined += 1
        self._lost = total([self._lost, *(one.lost_before for one in new)])
        self._overruns += any(one.overrun for one in new)
        self._reconnects += any(one.reconnected for one in new)
        self._reboots += any(one.rebooted for one in new)
        self.starts += any(one.estimator_restarted for one in new)
        contacts = self._contacts.pass_by(view)
        return RawFrame(
            self._joined,
            sequence=None,
            device_time=None,
            counts=counts,
            host_time=newest.host_time,
            monotonic_time=newest.monotonic_time,
            time_s=newest.monotonic_time,
            lost=self._lost,
            overruns=self._overruns,
            reconnects=self._reconnects,
            reboots=self._reboots,
            converted=Converted(
                valid, reason, resistance, pressure, std, rest_counts, self.geometry, contacts, self.starts
            ),
        )

    def _cells(
        self,
        parts: Sequence[Frame | None],
        values: Callable[[Frame], AnyArray],
        silent: float = np.nan,
        none: float = np.nan,
    ) -> AnyArray:
        """(rows, columns) of all boards; ``silent`` if one has not sent yet, ``none`` where there is no cell."""
        found = np.full(self.geometry.shape, none)
        first = 0
        for part, (rows, columns) in zip(parts, self._shapes, strict=True):
            found[first : first + rows, :columns] = silent if part is None else values(part)
            first += rows
        return found


def total(numbers: Sequence[int | None]) -> int | None:
    """None if one is not known."""
    return None if None in numbers else sum(number or 0 for number in numbers)


class Board(Protocol):
    """What is asked of a board's own skin."""

    @property
    def port_name(self) -> str:
        """For messages."""

    @property
    def away(self) -> str | None:
        """Why its port is lost; None: it is there."""

    def __next__(self) -> Frame:
        """Its next frame."""


class JoinedFrames(Frames):
    """The queue of joined frames, which come converted."""

    def __init__(self, joiner: Joiner, boards: Sequence[Board], delivery: Delivery, queue: int) -> None:
        super().__init__(delivery, queue, Counters())
        self._joiner, self._boards = joiner, boards
        self._joining = threading.RLock()
        self._ends: dict[int, OhmskinError] = {}
        self._played: Iterator[tuple[float, int, Frame]] | None = None
        """frames of recordings by time, with the numbers of their boards"""

    @property
    def away(self) -> str | None:
        """Why boards are lost, while the driver tries to open their ports again; None: all are there."""
        return "; ".join(f"{board.port_name}: {board.away}" for board in self._boards if board.away) or None

    @property
    def starts(self) -> int:
        """Joined frames since whose predecessor an estimator has started anew."""
        return self._joiner.starts

    def play(self) -> None:
        """Take the frames of recordings when they are asked for."""

        def of_board(board: int) -> Iterator[tuple[float, int, Frame]]:
            while True:
                try:
                    frame = next(self._boards[board])
                except StopIteration:
                    return
                except ProtocolError as error:  # a later frame may be good
                    self.report(error)
                    continue
                yield frame.host_time, board, frame

        self._played = heapq.merge(*map(of_board, range(len(self._boards))))

    def catch_up(self, last: int | None = None) -> None:
        """Play recordings up to the joined frame ``last``; None: up to the next one."""
        if self._played is None:
            return
        with self._joining:
            last = 1 + (0 if self.newest is None else self.newest.index) if last is None else last
            while not (self.has_after(last - 1) or self.is_full() or self.end):
                following = next(self._played, None)
                if following is None:
                    self.finish(LinkEnded("the recordings are over"))
                else:
                    self.arrive(*following[1:])

    def arrive(self, board: int, frame: Frame) -> None:
        """Take the next frame of a board."""
        with self._joining:
            for joined in self._joiner.add(board, frame):
                self.put(joined)
        self.wake()

    def put(self, frame: RawFrame) -> None:
        """Add the newest joined frame."""
        super().put(frame)
        self._last, self.done = frame, frame.index

    def part_ended(self, board: int, error: Exception) -> None:
        """A board sends no more frames; the skin ends with its last one."""
        self._ends[board] = error if isinstance(error, OhmskinError) else LinkError(str(error))
        if len(self._ends) == len(self._boards):
            broken = [one for one in self._ends.values() if not isinstance(one, LinkEnded)]
            self.finish(broken[0] if broken else self._ends[board])

    def finish(self, error: OhmskinError) -> None:
        """Show what has not been shown yet; no frame will come any more. The first reason counts."""
        with self._joining:
            if self.end is None:
                for joined in self._joiner.rest():
                    self.put(joined)
            super().finish(error)


class JoinedBoards:
    """The boards of a joined skin in the place of a :class:`._connection.Connection`."""

    def __init__(self, boards: Sequence[Board], frames: JoinedFrames, joiner: Joiner) -> None:
        self._boards, self._joiner = boards, joiner
        self.frames: Frames = frames

    @property
    def port_name(self) -> str:
        """Names of the ports."""
        return " + ".join(board.port_name for board in self._boards)

    def poll(self, *, patient: bool = False) -> None:
        """Take the next joined frame of recordings; the frames of boards come by themselves."""
        self.frames.catch_up()

    def now(self) -> float:
        """Present time of the board whose frame came last."""
        newest = self._joiner.newest
        return time.monotonic() if newest is None else newest.monotonic_time + newest.age

    def nothing_came(self, what: str, timeout_s: float) -> LinkTimeout:
        """The error for a wait for ``what`` that timed out."""
        away = f" ({self.frames.away})" if self.frames.away else ""
        return LinkTimeout(f"{self.port_name}: no {what} of {len(self._boards)} boards within {timeout_s:g} s{away}")
