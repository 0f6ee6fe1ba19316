"""``JoinedSkin``: the boards of one skin as one. Their frames are merged by time, and contacts go across boards.

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
import weakref
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..circuits import Design, Reason
from ..common.arrays import AnyArray
from ..common.checks import number, positive
from ..common.events import SignalSafeEvent
from ..common.files import of_board
from ..common.geometry import Geometry
from ..common.progress import Progress
from ..errors import InputError, LinkEnded, LinkError, LinkTimeout, OhmskinError
from ..wire import Order
from ._consumer import FrameCallback
from ._contacts import ContactsOfFrames, ContactTracker, PressureView, Touch
from ._frame import Frame
from ._options import QUEUE
from ._orders import Answer
from ._port import Arrival
from ._recording import Recording
from ._replay import RecordedSettings
from ._skin import MAX_AGE_S, Skin
from ._statistics import LinkStatistics
from ._tare import KNOWN_DRIFT, SPREAD, Tare

SILENT_S = 0.2
"""a board that has sent no frame for longer is not waited for; until then its last one counts"""
BETWEEN_PITCHES = 3.0
"""distance of boards whose places nobody has given, in pitches: contacts do not go across"""
SAME_PLACE_MM = 1e-3
_MISSING, _NO_CELL, _NOISY = int(Reason.MISSING), int(Reason.NO_CELL), int(Reason.UNCERTAIN)


def open_joined(
    ports: Sequence[str | Path], record: str | Path | None, *, overwrite: bool, progress: Progress, **settings: Any
) -> JoinedSkin:
    """The boards behind several ports, or their recordings, as one skin; errors as :meth:`.Skin.open`.

    A setting that is a list has a value for each board. A recording ``skin.mcap`` becomes one file for each board:
    ``skin-1.mcap``, ``skin-2.mcap`` and so on.
    """
    if not ports:
        raise InputError("no ports; expected at least one")
    recorded = [str(port).endswith(".mcap") for port in ports]
    if any(recorded) and not all(recorded):
        raise InputError("recordings and ports of boards in one skin; expected one or the other")
    if settings.get("delivery") == "lossless":
        raise InputError("delivery is lossless; expected newest or every, as several boards do not wait for each other")
    for name, value in settings.items():
        if isinstance(value, list) and len(value) != len(ports):
            raise InputError(f"{name} has {len(value)} values; expected one for each of {len(ports)} boards")
    own = [
        {name: value[k] if isinstance(value, list) else value for name, value in settings.items()}
        for k in range(len(ports))
    ]
    files = [None if record is None else of_board(record, k) for k in range(len(ports))]
    boards: list[Skin] = []
    try:
        for port, each, file in zip(ports, own, files, strict=True):
            boards.append(Skin.open(port, record=file, overwrite=overwrite, progress=progress, **each))
        return JoinedSkin(boards, delivery=settings.get("delivery"), queue=settings.get("queue", QUEUE))
    except BaseException:
        for board in boards:
            board.close()
        raise


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
        places.append(_widened(own, across, np.nan))
        areas.append(_widened(board.areas_mm2, across, 0.0))
    whole = Geometry(np.concatenate(places), np.concatenate(areas))
    there = whole.places_mm[whole.exists]
    same = cKDTree(there).query_pairs(SAME_PLACE_MM)
    if same:
        one = there[min(same)[0]].tolist()
        raise InputError(f"cells of two boards are at {one} mm; expected a [shape] for each with places of its own")
    return whole


def _widened(cells: AnyArray, columns: int, missing: float) -> AnyArray:
    """(rows, columns, ...) with columns without cells on the right."""
    room = [(0, 0), (0, columns - cells.shape[1])] + [(0, 0)] * (cells.ndim - 2)
    return np.pad(cells, room, constant_values=missing)


class Joiner:
    """Merges frames. What comes out depends on the order in which they are added, and on nothing else."""

    def __init__(self, boards: Sequence[Geometry], touch: Touch) -> None:
        self.geometry = joined_geometry(boards)
        self._columns = self.geometry.shape[1]
        self._shapes = [board.shape for board in boards]
        self._contacts = ContactsOfFrames(ContactTracker(self.geometry, *touch))
        self._last: list[Frame | None] = [None] * len(boards)
        self._fresh = [False] * len(boards)
        self._number = 0

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

    def _join(self) -> Frame:
        parts, fresh = list(self._last), list(self._fresh)
        self._fresh = [False] * len(parts)
        self._number += 1
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
        view = PressureView(self._number, newest.monotonic_time, pressure, std, unread)
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
            lost_before=_sum([one.lost_before for one in new]),
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
        own = [
            np.full(shape, silent) if part is None else values(part)
            for part, shape in zip(parts, self._shapes, strict=True)
        ]
        return np.concatenate([_widened(cells, self._columns, none) for cells in own])


class _Joined(NamedTuple):
    """A joined frame in the stream, with what has been counted up to it."""

    number: int
    frame: Frame
    lost: int | None
    events: tuple[int, ...]
    """numbers of frames so far with each of :data:`_EVENTS`"""


_EVENTS = ("overrun", "reconnected", "rebooted", "estimator_restarted")


class _Stream:
    """The last joined frames, and those who wait for the next."""

    def __init__(self, joiner: Joiner, boards: Sequence[Skin], *, newest_only: bool, queue: int) -> None:
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

        def of_board(board: int, skin: Skin) -> Iterator[tuple[float, int, Frame]]:
            for frame in skin:
                yield frame.host_time, board, frame

        self._played = heapq.merge(*(of_board(board, skin) for board, skin in enumerate(self._boards)))

    @property
    def newest(self) -> _Joined | None:
        return self._kept[-1] if self._kept else None

    def arrive(self, board: int, frame: Frame) -> None:
        """Take the next frame of a board."""
        with self._lock:
            for joined in self._joiner.add(board, frame):
                before = self.newest
                lost = joined.lost_before
                if before is not None:
                    lost = None if lost is None or before.lost is None else before.lost + lost
                events = tuple(
                    (0 if before is None else before.events[k]) + getattr(joined, name)
                    for k, name in enumerate(_EVENTS)
                )
                self._kept.append(_Joined(1 if before is None else before.number + 1, joined, lost, events))
        self._wake()

    def part_ended(self, board: int, error: Exception) -> None:
        """A board sends no more frames; the skin ends with its last one."""
        self._ends[board] = error if isinstance(error, OhmskinError) else LinkError(str(error))
        if len(self._ends) == len(self._boards):
            broken = [one for one in self._ends.values() if not isinstance(one, LinkEnded)]
            self.finish(broken[0] if broken else self._ends[board])

    def finish(self, error: OhmskinError) -> None:
        """No frame will come any more. The first reason counts."""
        self.end = self.end or error
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

    def __init__(self, stream: _Stream, *, from_start: bool = False) -> None:
        self._stream = stream
        self._before = None if from_start else stream.newest
        self._lock = threading.Lock()

    def next_frame(self, timeout_s: float) -> Frame:
        """Wait for the next frame; errors as :meth:`.Skin.read`."""
        with self._lock:
            before = self._before
            found = self._stream.after(0 if before is None else before.number, time.monotonic() + timeout_s)
            self._before = found
        return _told_after(found, before)

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
                return _told_after(newest, before)
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


def _told_after(joined: _Joined, before: _Joined | None) -> Frame:
    """The frame for a reader whose last one was ``before``."""
    if before is None:
        return replace(joined.frame, skipped_before=joined.number - 1)
    lost = None if joined.lost is None or before.lost is None else joined.lost - before.lost
    happened: dict[str, Any] = {name: joined.events[k] > before.events[k] for k, name in enumerate(_EVENTS)}
    return replace(joined.frame, lost_before=lost, skipped_before=joined.number - before.number - 1, **happened)


class JoinedSkin(Skin):
    """Several boards as one skin: the methods of :class:`.Skin`, and :attr:`boards` for what each board alone has.

    Made by ``Skin.open([...])``.
    """

    def __init__(self, boards: Sequence[Skin], *, delivery: str | None = None, queue: int = QUEUE) -> None:
        """Join open skins, which belong to this one from then on.

        Raises:
            InputError: some have a shape and others none, or cells of two boards are at one place.

        """
        self._boards = tuple(boards)
        limits = [board.touch for board in boards]
        touch = Touch(
            max(one.full_scale_kpa for one in limits),
            max(one.drift_kpa for one in limits),
            any(one.faults_press for one in limits),
        )
        joiner = Joiner([board.geometry for board in boards], touch)
        self._geometry = joiner.geometry
        self._timeout = max(board._timeout for board in boards)
        self.family, self.cell, self.calibration = boards[0].family, boards[0].cell, None
        played = [board.recorded_s for board in boards]
        self.recorded_s = None if None in played else max(seconds or 0.0 for seconds in played)
        every = delivery == "every" or self.recorded_s is not None
        self._stream = _Stream(joiner, boards, newest_only=not every, queue=queue)
        self._place = JoinedPlace(self._stream, from_start=True)
        self._joined_callbacks: list[FrameCallback] = []
        weakref.finalize(self, _close, self._boards).atexit = False
        if self.recorded_s is not None:
            self._stream.play()
        else:
            for k, board in enumerate(boards):
                board.on_frame(partial(self._stream.arrive, k), partial(self._stream.part_ended, k))

    def _refused(self, what: str) -> InputError:
        return InputError(f"{what} belongs to one board; ask one of the {len(self.boards)} in boards")

    @property
    def boards(self) -> tuple[Skin, ...]:
        """The skin of each board."""
        return self._boards

    # -- what is known -------------------------------------------------------------------------------------------------

    @property
    def port_name(self) -> str:
        """Names of the ports."""
        return " + ".join(board.port_name for board in self.boards)

    @property
    def serial_number(self) -> str:
        """Serial numbers of the boards; empty if none sends one."""
        return " + ".join(filter(None, (board.serial_number for board in self.boards)))

    @property
    def identity(self) -> None:
        """Each board has its own."""
        return None

    @property
    def description(self) -> None:
        """Each board has its own."""
        return None

    @property
    def knows_circuit(self) -> bool:
        """Whether those of all boards are known."""
        return all(board.knows_circuit for board in self.boards)

    @property
    def design(self) -> Design:
        """InputError: each board has its own."""
        raise self._refused("a design")

    @property
    def circuit_name(self) -> str | None:
        """Of the readouts; None where one is not known."""
        names = [board.circuit_name for board in self.boards]
        return None if None in names else ", ".join(dict.fromkeys(filter(None, names)))

    @property
    def count_bits(self) -> int:
        """The most bits of a count."""
        return max(board.count_bits for board in self.boards)

    @property
    def full_scale_kpa(self) -> float | None:
        """The largest; None: not known of all."""
        known = [board.full_scale_kpa for board in self.boards]
        return None if None in known else max(kpa or 0.0 for kpa in known)

    @property
    def touch(self) -> Touch:
        """InputError: each board has its own."""
        raise self._refused("what tells contacts")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows of all boards, and the most columns of one."""
        return self._geometry.shape

    @property
    def geometry(self) -> Geometry:
        """Places of all cells."""
        return self._geometry

    @property
    def estimator_name(self) -> str:
        """Names of the estimators."""
        return ", ".join(dict.fromkeys(filter(None, (board.estimator_name for board in self.boards))))

    @property
    def away(self) -> str | None:
        """Why boards are lost, while the driver tries to open their ports again; None: all are there."""
        return "; ".join(f"{board.port_name}: {board.away}" for board in self.boards if board.away) or None

    def __repr__(self) -> str:
        rows, columns = self.shape
        return f"<JoinedSkin of {len(self.boards)} boards: {rows} x {columns}; {', '.join(map(repr, self.boards))}>"

    def stats(self) -> LinkStatistics:
        """Sums over the boards; of ages and jitter the largest, and the rate of the fastest board."""
        each = [board.stats() for board in self.boards]
        return LinkStatistics(
            **{item.name: _together([getattr(one, item.name) for one in each]) for item in fields(each[0])}
        )

    # -- frames --------------------------------------------------------------------------------------------------------

    def __next__(self) -> Frame:
        while True:
            try:
                return self.read()
            except LinkEnded:
                raise StopIteration from None
            except LinkTimeout:
                if not self.away:
                    raise

    def read(self, timeout: float | None = None) -> Frame:
        """Wait for the next frame, as :meth:`.Skin.read`."""
        return self._place.next_frame(self._timeout if timeout is None else number("timeout", timeout, "s"))

    def latest(self, max_age: float = MAX_AGE_S, timeout: float = 0.0) -> Frame:
        """The newest frame, as :meth:`.Skin.latest`."""
        return self._place.latest(positive("max_age", max_age, "s"), number("timeout", timeout, "s"))

    def frames(self) -> Iterator[Frame]:
        """An iterator with a place of its own, from now on."""
        place = JoinedPlace(self._stream)

        def follow() -> Iterator[Frame]:
            while True:
                try:
                    yield place.next_frame(self._timeout)
                except LinkEnded:
                    return

        return follow()

    def __aiter__(self) -> AsyncIterator[Frame]:
        """The frames from now on, for ``async for``."""
        import asyncio  # takes a tenth of the driver's own time

        place = JoinedPlace(self._stream)

        async def follow() -> AsyncIterator[Frame]:
            while True:
                try:
                    yield await asyncio.to_thread(place.next_frame, self._timeout)
                except LinkEnded:
                    return

        return follow()

    def frames_since(self, monotonic_time: float) -> list[Frame]:
        """All frames that came after a moment, as :meth:`.Skin.frames_since`."""
        pairs = self._stream.since(number("monotonic_time", monotonic_time, "s"))
        if not pairs and self._stream.end is not None:
            raise copy.copy(self._stream.end)
        return [_told_after(one, before) for one, before in pairs]

    def on_frame(
        self, callback: Callable[[Frame], None], on_end: Callable[[Exception], None] | None = None
    ) -> FrameCallback:
        """Call ``callback`` with each frame from now on, as :meth:`.Skin.on_frame`."""
        made = FrameCallback(JoinedPlace(self._stream), self.port_name, callback, on_end, keep=self)
        self._joined_callbacks = [earlier for earlier in self._joined_callbacks if not earlier.is_over] + [made]
        return made

    def on_bytes(self, tap: Callable[[Arrival], None]) -> None:
        """InputError: each board has its own."""
        raise self._refused("a stream of bytes")

    def close(self) -> None:
        """Release all ports, as :meth:`.Skin.close`."""
        for callback in self._joined_callbacks:
            callback.end()
        errors = _close(self.boards)
        self._stream.close(LinkEnded(f"{self.port_name}: the skin is closed"))
        for callback in self._joined_callbacks:
            callback.close()
        if errors:
            raise errors[0]

    # -- orders, recordings --------------------------------------------------------------------------------------------

    def request(self, order: Order, *, period_us: int = 0, timeout: float | None = None) -> Answer | None:
        """InputError: ask one of the boards."""
        raise self._refused("an order")

    def settings_to_join(self) -> RecordedSettings:
        """InputError: record each of the boards."""
        raise self._refused("a recording")

    def attach(self, recording: Recording) -> None:
        """InputError: record each of the boards."""
        raise self._refused("a recording")

    def detach(self, recording: Recording) -> None:
        """InputError: record each of the boards."""
        raise self._refused("a recording")

    @property
    def recorder(self) -> Recording | None:
        """The recording of the first board."""
        return self.boards[0].recorder

    # -- rest ----------------------------------------------------------------------------------------------------------

    def tare(
        self, frames: int = 20, *, force: bool = False, drift: float = KNOWN_DRIFT, spread: float = SPREAD
    ) -> Tare:
        """Tare all boards at once, or none, as :meth:`.Skin.tare`."""
        with ThreadPoolExecutor(len(self.boards)) as pool:
            made = [pool.submit(board.tare, frames, force=force, drift=drift, spread=spread) for board in self.boards]
        failed = [error for one in made if (error := one.exception()) is not None]
        if failed:
            for board, one in zip(self.boards, made, strict=True):
                if one.exception() is None:
                    board.undo_tare()
            raise failed[0]
        self._place.pass_all()
        return self._as_one([one.result() for one in made])

    @property
    def tared(self) -> Tare | None:
        """The tares in use as one; None: not all boards have one."""
        found = [tare for board in self.boards if (tare := board.tared) is not None]
        return self._as_one(found) if len(found) == len(self.boards) else None

    def use_tare(self, tare: Tare | str | Path | None) -> None:
        """InputError, but for None: each board has its own."""
        if tare is not None:
            raise self._refused("a saved tare")
        for board in self.boards:
            board.use_tare(None)

    def undo_tare(self) -> Tare | None:
        """Return to the tares before. Returns those then in use."""
        for board in self.boards:
            board.undo_tare()
        return self.tared

    def _as_one(self, tares: Sequence[Tare]) -> Tare:
        across = self.shape[1]

        def cells(name: str, none: float) -> Any:
            return np.concatenate([_widened(getattr(tare, name), across, none) for tare in tares])

        only_counts = all(tare.rest_counts is not None for tare in tares)
        return Tare(
            rest_resistance_ohm=cells("rest_resistance_ohm", np.nan),
            measured=cells("measured", True),
            std_ohm=cells("std_ohm", np.nan),
            frames=min(tare.frames for tare in tares),
            lost=_sum([tare.lost for tare in tares]),
            serial_number=self.serial_number,
            wall_time=max(tare.wall_time for tare in tares),
            remarks=tuple(remark for tare in tares for remark in tare.remarks),
            rest_counts=cells("rest_counts", np.nan) if only_counts else None,
        )


def _close(boards: Sequence[Skin]) -> list[InputError]:
    """Close all; the errors of recordings that could not be written to their ends."""
    errors = []
    for board in boards:
        try:
            board.close()
        except InputError as error:
            errors.append(error)
    return errors


def _sum(numbers: Sequence[int | None]) -> int | None:
    """None if one is not known."""
    return None if None in numbers else sum(number or 0 for number in numbers)


def _together(values: Sequence[Any]) -> Any:
    """One value of the statistics for those of several boards."""
    match values[0]:
        case dict():
            names = dict.fromkeys(name for value in values for name in value)
            of = max if any(isinstance(name, int) for name in names) else sum
            return {name: of([value.get(name, 0) for value in values]) for name in names}
        case float():
            return max(values)
        case int() if None not in values:
            return sum(values)
        case str():
            return "; ".join(filter(None, values))
    told = [value for value in values if isinstance(value, str)]
    return "; ".join(told) or None
