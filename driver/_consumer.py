"""``Consumer``: one reader's place in the stream of frames. Iteration, callbacks and asyncio all use one."""

from __future__ import annotations

import contextlib
import copy
import math
import threading
import time
import warnings
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from ..common.checks import function
from ..errors import LinkEnded, LinkError, LinkTimeout, ProtocolError
from ._converted import Converted
from ._frame import Frame
from ._frames import Frames
from ._stream import RawFrame
from ._tuning import CLOSE_S


class Source(Protocol):
    """Where frames come from: a :class:`._connection.Connection`, or several (:class:`._joined.JoinedBoards`)."""

    frames: Frames

    @property
    def port_name(self) -> str:
        """For messages."""

    def poll(self, *, patient: bool = False) -> None:
        """Look for frames that have come."""

    def now(self) -> float:
        """Present time in s, on the clock of :attr:`.Frame.monotonic_time`."""

    def nothing_came(self, what: str, timeout_s: float) -> LinkTimeout | ProtocolError:
        """The error for a wait for ``what`` that timed out."""


class Consumer:
    """One place in the stream of frames. Counts for its reader the frames lost and skipped between those it got."""

    def __init__(self, connection: Source, *, after: int | None = None) -> None:
        """Begin after the frame with this number; None: as :meth:`.Frames.join` says."""
        self._connection = connection
        self._frames = frames = connection.frames
        with frames.lock:
            self._place, last = frames.join(after)
            self._faults = frames.fault.number if after is None else 0
        self._lock = threading.Lock()
        self._reported = _Totals() if last is None else _Totals.of(last, frames.starts)
        self._newest = self._place.index
        """number of the last frame delivered; before the first delivery, of the frame at which this consumer began"""
        self._seen = 0
        """number of the last frame that was looked at"""
        self._frame: Frame | None = None
        """the frame delivered last, original or repeated"""
        weakref.finalize(self, frames.leave, self._place)

    @property
    def index(self) -> int:
        """Number of the last frame delivered or passed."""
        return self._place.index

    def next_frame(self, timeout_s: float, *, while_away: bool = False) -> Frame:
        """Wait for the next frame.

        Args:
            timeout_s: how long to wait.
            while_away: wait for longer while the driver tries to open the port again.

        Raises:
            LinkTimeout: no frame came in time.
            LinkEnded: no frame will come: the stream has ended, or the skin was closed.
            LinkError: the board has gone away.
            ProtocolError: the bytes break the format, or the counts do not fit the design.

        """
        deadline: float | None = None
        late = False
        while True:
            frame = self.frame_if_there(late=late)
            if frame is not None:
                return frame
            if deadline is None:
                deadline = time.monotonic() + timeout_s
            left = deadline - time.monotonic()
            if left <= 0 and not (while_away and self._frames.away):
                if late or timeout_s <= 0:
                    raise self._connection.nothing_came("frame", timeout_s)
                late = True
                continue
            self._wait(left if left > 0 else 1.0)

    def frame_if_there(self, *, late: bool = False) -> Frame | None:
        """The next frame if it has arrived already, looked for once more if ``late``; raises as :meth:`next_frame`."""
        frames, place = self._frames, self._place
        place.used = True
        if frames.newest_only or not frames.has_after(place.index):
            self._connection.poll(patient=late)
        while True:
            if frames.newest_only or place.index >= frames.fault.after:
                self._check_fault()
            self._seen = frames.done if frames.newest_only and frames.done > place.index else place.index
            raw = frames.following(place.index)
            if raw is None:
                self._check()
                return None
            frame = self._claim(raw)
            if frame is not None:
                return frame

    def next_frames(self, most: int, timeout_s: float) -> list[Frame]:
        """The next frame, and those after it that are there already, at most ``most``; raises as :meth:`next_frame`."""
        frames, place, taken = self._frames, self._place, [self.next_frame(timeout_s, while_away=True)]
        frames.catch_up(place.index + most - 1)
        while len(taken) < most and not (frames.fault.number > self._faults and place.index >= frames.fault.after):
            raw = frames.following(place.index)
            frame = None if raw is None or raw.converted is None else self._claim(raw)
            if frame is None:  # the next call waits for it, or says why there is none
                break
            taken.append(frame)
        return taken

    def latest(self, max_age_s: float, timeout_s: float) -> Frame:
        """The newest frame, delivered before or not, if it is at most ``max_age_s`` old; waits for one if needed.

        Raises:
            LinkTimeout: the newest frame is older, and no younger one came within ``timeout_s``.
            LinkEnded, LinkError, ProtocolError: as for :meth:`next_frame`, if there is no frame that young.

        """
        deadline = time.monotonic() + timeout_s
        frames = self._frames
        self._place.used = True
        while True:
            self._connection.poll()
            done, newest = frames.done, frames.latest
            self._seen = newest.index if frames.lossless and newest is not None else done
            if newest is not None and self._age_s(newest) <= max_age_s:
                frame = self._repeat(newest) or self._claim(newest, max_age_s)
                if frame is not None:
                    return frame
                if newest.index > self._newest and self._age_s(newest) <= max_age_s:
                    continue  # another consumer has had a newer frame converted
            self._check()
            left = deadline - time.monotonic()
            if left <= 0:
                away = "" if frames.away is None else f" ({frames.away}; trying to open the port again)"
                raise LinkTimeout(
                    f"{self._connection.port_name}: no frame younger than {max_age_s:g} s: "
                    f"{self._why_none(newest, max_age_s)}{away}"
                )
            self._wait(left)

    def _age_s(self, raw: RawFrame) -> float:
        return self._connection.now() - raw.monotonic_time

    def _why_none(self, newest: RawFrame | None, max_age_s: float) -> str:
        if newest is None:
            return "none came"
        if self._age_s(newest) <= max_age_s and newest.index <= self._newest:
            return "none came since the tare"
        return f"the newest frame is {self._age_s(newest):.3g} s old"

    def for_tare(self) -> Consumer:
        """A consumer of the next frames: where none is dropped, of those after the last one delivered here."""
        return Consumer(self._connection, after=self.index if self._frames.lossless else None)

    def forget(self, tared: Sequence[int] = ()) -> None:
        """Deliver neither the last frame again, nor frames that were converted before this call, nor those of a tare.

        The reader has made use of the ``tared`` frames (their numbers): the next frame does not count them as skipped.
        """
        frames = self._frames
        with self._lock:
            self._reported = replace(self._reported, index=self._reported.index + sum(k > self._newest for k in tared))
            self._frame = None
            latest = None if frames.lossless else frames.latest
            self._newest = max(self._newest, 0 if latest is None else latest.index, *tared)
            frames.move(self._place, self._newest)

    def leave(self) -> None:
        """Give up the place: no more frames are kept for this consumer."""
        self._frames.leave(self._place)

    def _repeat(self, newest: RawFrame) -> Frame | None:
        """The last frame delivered, if it is still the newest."""
        with self._lock:
            frame = self._frame
            if frame is None or self._newest != newest.index:
                return None
            if not frame.repeated:
                frame = self._frame = frame.again()
            return frame

    def _claim(self, raw: RawFrame, max_age_s: float = math.inf) -> Frame | None:
        """Convert a frame and make it the last one delivered.

        Returns:
            None if this consumer, or all others, have passed the frame, or it is older than ``max_age_s`` by the end of
            its conversion.

        """
        frames = self._frames
        measurement = raw.converted or frames.measure(raw)
        notices = frames.counters.notices
        while notices:
            with contextlib.suppress(IndexError):  # another reader was quicker
                warnings.warn(notices.popleft(), RuntimeWarning, stacklevel=2)
        with self._lock:
            age_s = self._connection.now() - raw.monotonic_time
            if age_s > max_age_s:
                return None
            if measurement is None or raw.index <= self._newest:
                # This also covers an interrupt between the two steps below: the frame must not be offered for ever.
                frames.move(self._place, raw.index)
                return None
            frame = self._frame = _frame(raw, measurement, self._reported, self._connection)
            self._newest, self._reported = raw.index, _Totals.of(raw, measurement.estimator_starts)
            frames.move(self._place, raw.index)
            frames.counters.ages_s.append(age_s)
            return frame

    def _check_fault(self) -> None:
        """Raise the newest fault unless this consumer has raised it already."""
        fault = self._frames.fault
        if fault.number > self._faults:
            self._faults = fault.number
            raise copy.copy(fault.error)

    def _check(self) -> None:
        """If no frame will come any more, raise the reason."""
        self._check_fault()
        end = self._frames.end
        if end is not None:
            raise copy.copy(end)

    def _wait(self, timeout_s: float) -> None:
        """Wait for a frame beyond those seen, for a fault, or for the end of the stream."""
        frames, seen = self._frames, self._seen

        def new() -> bool:
            return frames.has_after(seen) or frames.end is not None or frames.fault.number > self._faults

        frames.wait_for(new, min(timeout_s, threading.TIMEOUT_MAX))


class AsyncFrames:
    """Frames for ``async for``: waits in the event loop, converts in the loop's thread."""

    def __init__(self, connection: Source, timeout_s: float, *, keep: object = None) -> None:
        """``keep``: object protected from garbage collection while frames are taken, since the port closes with it."""
        import asyncio  # takes a tenth of the driver's own time

        self._connection, self._keep = connection, keep
        self._timeout_s = timeout_s
        self._consumer = Consumer(connection)
        self._event = event = asyncio.Event()
        self._loop = loop = asyncio.get_running_loop()

        def wake() -> None:
            # The loop may have ended while frames still come.
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(event.set)

        connection.frames.add_waker(wake)
        weakref.finalize(self, connection.frames.remove_waker, wake)

    def __aiter__(self) -> AsyncFrames:
        return self

    async def __anext__(self) -> Frame:
        """The next frame; errors as for iteration."""
        deadline = time.monotonic() + self._timeout_s
        while True:
            self._event.clear()
            try:
                frame = self._consumer.frame_if_there()
            except LinkEnded:
                raise StopAsyncIteration from None
            if frame is not None:
                return frame
            left = deadline - time.monotonic()
            if left <= 0 and not self._connection.frames.away:
                raise self._connection.nothing_came("frame", self._timeout_s)
            # Not asyncio.wait_for(): up to Python 3.11 it loses a cancellation that arrives together with a frame.
            timer = self._loop.call_later(left if left > 0 else 1.0, self._event.set)
            try:
                await self._event.wait()
            finally:
                timer.cancel()


class FrameCallback:
    """Calls a function with each new frame, in a thread of its own, until :meth:`close`."""

    def __init__(
        self,
        consumer: Consumer,
        name: str,
        callback: Callable[[Frame], None],
        on_end: Callable[[Exception], None] | None = None,
        *,
        keep: object = None,
    ) -> None:
        """Begin at the place of a ``consumer``, of the skin ``name``. InputError if a callback is no function.

        ``keep``: as for :class:`AsyncFrames`, until the calls end.
        ``on_end`` is called with the reason when no frame will come any more, or with the error of the callback.
        """
        function("callback", callback)
        if on_end is not None:
            function("on_end", on_end)
        self._keep = keep
        self._consumer = consumer
        self._callback, self._on_end = callback, on_end
        self._closed = False
        self._thread = _CallbackThread(target=self._run, name=f"ohmskin callback {name}", daemon=True)
        self._thread.start()

    @property
    def is_over(self) -> bool:
        """Whether the calls have ended."""
        return not self._thread.is_alive()

    def end(self) -> None:
        """End the calls, without waiting for a running one."""
        self._closed = True

    def close(self) -> None:
        """End the calls. Waits for a running call, for at most 2 s.

        From within a callback this does not wait: two callbacks that end each other would wait for ever.
        """
        self.end()
        if not isinstance(threading.current_thread(), _CallbackThread):
            self._thread.join(CLOSE_S)

    def _run(self) -> None:
        try:
            while not self._closed:
                try:
                    frame = self._consumer.next_frame(0.1)
                except (LinkTimeout, ProtocolError):
                    continue
                except LinkError as error:
                    if self._on_end is not None and not self._closed:
                        self._on_end(error)
                    return
                if not self._closed:
                    self._call(frame)
        finally:
            self._consumer.leave()
            self._keep = None

    def _call(self, frame: Frame) -> None:
        try:
            self._callback(frame)
        except Exception as error:
            if self._on_end is not None:
                self._on_end(error)
            raise


class _CallbackThread(threading.Thread):
    """A thread in which a callback runs."""


def follower(connection: Source, receive: Callable[[Frame], None]) -> Callable[[RawFrame, Converted], None]:
    """A function that passes every converted frame to a recorder, in order, whoever asked for the conversion."""
    before = _Totals()

    def converted(raw: RawFrame, measurement: Converted) -> None:
        nonlocal before
        frame, before = _frame(raw, measurement, before, connection), _Totals.of(raw, measurement.estimator_starts)
        receive(frame)

    return converted


def frames_since(connection: Source, monotonic_s: float) -> list[Frame]:
    """The frames that came after this time, in order, as :meth:`.Skin.frames_since`."""
    if not connection.frames.lossless:
        connection.poll()
    frames, before = [], _Totals()
    for raw in connection.frames.converted_since(monotonic_s):
        measurement = raw.converted
        assert measurement is not None
        if raw.monotonic_time > monotonic_s:
            frames.append(_frame(raw, measurement, before, connection))
        before = _Totals.of(raw, measurement.estimator_starts)
    return frames


@dataclass(slots=True)
class _Totals:
    """Totals up to the last frame taken, which the reader knows already."""

    index: int = 0
    lost: int | None = 0
    overruns: int = 0
    reconnects: int = 0
    reboots: int = 0
    estimator_starts: int = 0

    @classmethod
    def of(cls, frame: RawFrame, estimator_starts: int = 0) -> _Totals:
        return cls(frame.index, frame.lost, frame.overruns, frame.reconnects, frame.reboots, estimator_starts)


def _frame(raw: RawFrame, measurement: Converted, before: _Totals, connection: Source) -> Frame:
    """The frame for a reader whose totals up to now are ``before``."""
    return Frame(  # by position: so many keywords take 3 us
        raw.sequence,
        raw.device_time,
        raw.host_time,
        raw.monotonic_time,
        None if raw.lost is None else raw.lost - (before.lost or 0),
        raw.index - before.index - 1,  # skipped
        raw.overruns > before.overruns,
        raw.reconnects > before.reconnects,
        raw.reboots > before.reboots,
        measurement.estimator_starts > before.estimator_starts,
        False,  # not repeated
        raw.counts,
        measurement.valid,
        measurement.reason,
        measurement.resistance,
        measurement.pressure,
        measurement.pressure_std,
        measurement.rest_counts,
        measurement.geometry,
        measurement.contacts,
        connection.now,
    )
