"""Frames of several boards merged by time to those of one skin, with contacts across boards.

The rows of the boards stand below each other, and a board of fewer columns has no cells in the others. A joined frame
comes as soon as every board has sent a new one, or when one sends its next before that, so that none is left out. It
shows the newest frame of each board. A board that has not sent for :data:`SILENT_S` is not waited for, and its cells
are not valid (``Reason.MISSING``).

All boards of a computer are on its one clock (:attr:`.Frame.monotonic_time`); recordings of one skin are merged by the
times at which their frames came, so that a replay gives the same frames each time.
"""

from __future__ import annotations

import copy
import heapq
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..circuits import Reason
from ..common.arrays import AnyArray
from ..common.events import SignalSafeEvent
from ..common.geometry import Geometry
from ..errors import InputError, LinkEnded, LinkError, LinkTimeout, OhmskinError
from ._contacts import ContactsOfFrames, ContactTracker, PressureView, Touch
from ._frame import Frame

SILENT_S = 0.2
"""a board that has sent no frame for longer is not waited for; until then its last one counts"""
BETWEEN_PITCHES = 3.0
"""distance of boards whose places nobody has given, in pitches: contacts do not go across"""
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

    def add(self, board: int, frame: Frame) -> list[Frame]:
        """The joined frames, none or more, that follow from a frame of a board."""
        waits_long = any(
            fresh and last is not None and frame.monotonic_time - last.monotonic_time > SILENT_S
            for fresh, last in zip(self._fresh, self._last, strict=True)
        )
        joined = [self._join()] if self._fresh[board] or waits_long else []
        self._last[board], self._fresh[board] = frame, True
        if all(
            fresh or last is None or frame.monotonic_time - last.monotonic_time > SILENT_S
            for fresh, last in zip(self._fresh, self._last, strict=True)
        ):
            joined.append(self._join())
        return joined

    def rest(self) -> list[Frame]:
        """The joined frame of what has not been shown yet, if there is any."""
        return [self._join()] if any(self._fresh) else []

    def _join(self) -> Frame:
        parts, fresh = list(self._last), list(self._fresh)
        self._fresh = [False] * len(parts)
        new = [part for part, is_new in zip(parts, fresh, strict=True) if is_new and part is not None]
        newest = max(new, key=lambda frame: frame.monotonic_time)
        reason = self._cells(parts, lambda frame: frame.reason, _MISSING, _NO_CELL).astype(np.int8)
        old = np.zeros(reason.shape, dtype=np.bool_)
        first = 0
        for part, (rows, _), is_new in zip(parts, self._shapes, fresh, strict=True):
            own = slice(first, first + rows)
            old[own] = not is_new
            if part is None or newest.monotonic_time - part.monotonic_time > SILENT_S:
                reason[own][reason[own] != _NO_CELL] = _MISSING
            first += rows
        pressure = self._cells(parts, lambda frame: frame.pressure)
        std = self._cells(parts, lambda frame: frame.pressure_std)
        valid = reason == 0
        unread = old | ~(valid | (reason == _NOISY))
        view = PressureView(newest.monotonic_time, pressure, std, unread)
        self._contacts.pass_by(view)
        resistance = np.where(valid, self._cells(parts, lambda frame: frame.resistance), np.nan)
        arrays = {
            "counts": self._cells(parts, lambda frame: frame.counts, 0, 0).astype(np.uint16),
            "valid": valid,
            "reason": reason,
            "resistance": resistance,
            "pressure": pressure,
            "pressure_std": std,
            "rest_counts": self._cells(parts, lambda frame: frame.rest_counts, 0.0, 0.0),
        }
        for array in arrays.values():
            array.setflags(write=False)
        return Frame(
            sequence=None,
            device_time=None,
            host_time=newest.host_time,
            monotonic_time=newest.monotonic_time,
            lost_before=total([one.lost_before for one in new]),
            skipped_before=0,
            overrun=any(one.overrun for one in new),
            reconnected=any(one.reconnected for one in new),
            rebooted=any(one.rebooted for one in new),
            estimator_restarted=any(one.estimator_restarted for one in new),
            repeated=False,
            geometry=self.geometry,
            _contacts=partial(self._contacts.of, view),
            _now=lambda: newest.monotonic_time + newest.age,
            **arrays,
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


class _Joined(NamedTuple):
    """A joined frame in the stream, with what has been counted up to it."""

    number: int
    frame: Frame
    lost: int | None
    events: tuple[int, ...]
    """numbers of frames so far with each of :data:`_EVENTS`"""


_EVENTS = ("overrun", "reconnected", "rebooted", "estimator_restarted")


class Stream:
    """The last joined frames, and those who wait for the next."""

    def __init__(self, joiner: Joiner, boards: Sequence[Iterable[Frame]], *, newest_only: bool, queue: int) -> None:
        self.newest_only = newest_only
        self._joiner, self._boards = joiner, boards
        self._kept: deque[_Joined] = deque(maxlen=queue)
        self._waiting: list[SignalSafeEvent] = []
        self._lock = threading.RLock()
        self._ends: dict[int, OhmskinError] = {}
        self.end: OhmskinError | None = None
        """why no frame will come any more"""
        self._played: Iterator[tuple[float, int, Frame]] | None = None
        """frames of recordings by time, with the numbers of their boards"""

    def play(self) -> None:
        """Take the frames of recordings when they are asked for."""

        def of_board(board: int, skin: Iterable[Frame]) -> Iterator[tuple[float, int, Frame]]:
            for frame in skin:
                yield frame.host_time, board, frame

        self._played = heapq.merge(*(of_board(board, skin) for board, skin in enumerate(self._boards)))

    @property
    def newest(self) -> _Joined | None:
        return self._kept[-1] if self._kept else None

    def arrive(self, board: int, frame: Frame) -> None:
        """Take the next frame of a board."""
        with self._lock:
            self._keep(self._joiner.add(board, frame))
        self._wake()

    def _keep(self, frames: list[Frame]) -> None:
        for joined in frames:
            before = self.newest
            lost = joined.lost_before
            if before is not None:
                lost = None if lost is None or before.lost is None else before.lost + lost
            earlier = (0,) * len(_EVENTS) if before is None else before.events
            events = tuple(so_far + getattr(joined, name) for so_far, name in zip(earlier, _EVENTS, strict=True))
            self._kept.append(_Joined(1 if before is None else before.number + 1, joined, lost, events))

    def part_ended(self, board: int, error: Exception) -> None:
        """A board sends no more frames; the skin ends with its last one."""
        self._ends[board] = error if isinstance(error, OhmskinError) else LinkError(str(error))
        if len(self._ends) == len(self._boards):
            broken = [one for one in self._ends.values() if not isinstance(one, LinkEnded)]
            self.finish(broken[0] if broken else self._ends[board])

    def finish(self, error: OhmskinError) -> None:
        """No frame will come any more. The first reason counts."""
        with self._lock:
            if self.end is None:
                self._keep(self._joiner.rest())
                self.end = error
        self._wake()

    def close(self, error: OhmskinError) -> None:
        """Drop the frames, and tell readers that they get no more."""
        with self._lock:
            self._kept.clear()
            self.end, self._played = error, None
        self._wake()

    def _wake(self) -> None:
        with self._lock:
            for event in self._waiting:
                event.set()

    def since(self, monotonic_s: float) -> list[tuple[_Joined, _Joined | None]]:
        """The frames that came after this time, each with the one before it."""
        with self._lock:
            kept: list[_Joined] = list(self._kept)
        pairs = zip(kept, [None, *kept], strict=False)
        return [(one, before) for one, before in pairs if one.frame.monotonic_time > monotonic_s]

    def after(self, number: int, deadline_s: float) -> _Joined:
        """The frame for a reader who has had those up to ``number``; errors as :meth:`.Skin.read`."""
        event = SignalSafeEvent()
        with self._lock:
            self._waiting.append(event)
        try:
            while True:
                with self._lock:
                    event.clear()
                    found = self._following(number)
                    if found is None and self.end is None and self._played is not None:
                        self._play_on()
                        continue
                if found is not None:
                    return found
                if self.end is not None:
                    raise copy.copy(self.end)
                left_s = deadline_s - time.monotonic()
                if left_s <= 0:
                    raise LinkTimeout(f"no frame of {len(self._boards)} boards came in time")
                event.wait(min(left_s, 1.0))
        finally:
            with self._lock:
                self._waiting.remove(event)

    def _following(self, number: int) -> _Joined | None:
        if not self._kept or self._kept[-1].number <= number:
            return None
        if self.newest_only:
            return self._kept[-1]
        return self._kept[max(number + 1 - self._kept[0].number, 0)]

    def _play_on(self) -> None:
        assert self._played is not None
        try:
            _, board, frame = next(self._played)
        except StopIteration:
            self.finish(LinkEnded("the recordings are over"))
        else:
            self.arrive(board, frame)


class JoinedPlace:
    """A reader's place among joined frames."""

    def __init__(self, stream: Stream, *, from_start: bool = False) -> None:
        self._stream = stream
        self._before = None if from_start else stream.newest
        self._lock = threading.Lock()

    def next_frame(self, timeout_s: float) -> Frame:
        """Wait for the next frame; errors as :meth:`.Skin.read`."""
        with self._lock:
            before = self._before
            found = self._stream.after(0 if before is None else before.number, time.monotonic() + timeout_s)
            self._before = found
        return counted_since(found, before)

    def latest(self, max_age_s: float, timeout_s: float) -> Frame:
        """The newest frame, had before or not; errors as :meth:`.Skin.latest`."""
        until_s = time.monotonic() + timeout_s
        while True:
            newest = self._stream.newest
            age_s = math.inf if newest is None else newest.frame.age
            if newest is not None and age_s <= max_age_s:
                with self._lock:
                    before, self._before = self._before, newest
                if before is not None and before.number == newest.number:
                    return newest.frame.again()
                return counted_since(newest, before)
            try:
                self._stream.after(0 if newest is None else newest.number, until_s)
            except LinkTimeout as error:
                found = f"the newest is {age_s:.3g} s old" if newest is not None else "none has come"
                raise LinkTimeout(f"no frame of at most {max_age_s:g} s: {found}") from error

    def pass_all(self) -> None:
        """Leave out the frames that have come."""
        with self._lock:
            self._before = self._stream.newest

    def leave(self) -> None:
        """Nothing is kept for a reader."""


def counted_since(joined: _Joined, before: _Joined | None) -> Frame:
    """The frame for a reader whose last one was ``before``."""
    if before is None:
        return replace(joined.frame, skipped_before=joined.number - 1)
    lost = None if joined.lost is None or before.lost is None else joined.lost - before.lost
    happened: dict[str, Any] = {name: joined.events[k] > before.events[k] for k, name in enumerate(_EVENTS)}
    return replace(joined.frame, lost_before=lost, skipped_before=joined.number - before.number - 1, **happened)
