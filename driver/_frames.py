"""The way of frames from the port to their readers: one queue, in which each frame is converted once, in order.

The thread that reads the port puts frames in. The material remembers every load, so the estimator has to see every
frame, whether anybody takes it or not. What a reader gets is decided here, and only here:

==============  =================================  ========================  =======================================
delivery        a reader gets                      frames are converted      a full queue
==============  =================================  ========================  =======================================
``newest``      the newest frame; those before it  as they come              drops the oldest frame
                are left out after ``LATE_S``
``every``       each frame that is still kept      as they come              drops the oldest frame
``lossless``    each frame                         when a reader takes them  keeps the thread from reading the port
==============  =================================  ========================  =======================================

Where frames are converted as they come, the thread converts a few of them between two looks at the port, and steps
aside when a reader waits: readers convert what is left.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from queue import Empty, SimpleQueue
from typing import Literal

from ..common.arrays import FloatArray
from ..errors import LinkError, OhmskinError, ProtocolError
from ._convert import Converter
from ._converted import Converted
from ._statistics import Counters
from ._stream import RawFrame
from ._tuning import CONVERTED_IN_TURN, LATE_S, REMEMBERED

Delivery = Literal["newest", "every", "lossless"]
"""which frames a reader of the skin gets

``newest``
    The newest frame that the reader has not seen. Frames that came since the last one are skipped, and counted.
``every``
    Every frame, in order. A reader that is slower than the board loses the oldest of ``queue`` frames, counted.
``lossless``
    Every frame, in order. The port is not read while ``queue`` frames wait. For recordings and for emulated boards
    that wait for their host; a real board then has to drop frames itself.
"""


@dataclass(frozen=True, slots=True)
class Fault:
    """A frame that could not be taken. It is reported to every reader once."""

    number: int
    """from 1"""
    error: OhmskinError
    after: int
    """number of the last frame that came before it"""


@dataclass(slots=True, eq=False)
class Place:
    """Position of one reader in the stream."""

    index: int
    """number of the last frame that the reader has passed"""
    used: bool = False
    """the reader has asked for a frame: if nothing may be dropped, the thread waits only for such readers"""


class Frames:
    """The last frames, in order, with their measurements. Each reader keeps its own place.

    State is written with the lock held. Those who wait do so without it, each on a queue of its own: signals may
    interrupt Python's conditions halfway (:mod:`ohmskin.common.events`). Conversions have a lock of their own, since
    the port must be read meanwhile.
    """

    def __init__(self, delivery: Delivery, capacity: int, counters: Counters) -> None:
        """``capacity``: number of frames that are kept, or that wait for readers if none may be dropped."""
        self.newest_only = delivery == "newest"
        self.lossless = delivery == "lossless"
        self.counters = counters
        self.lock = threading.RLock()
        self.newest: RawFrame | None = None
        self.fault = Fault(0, LinkError("none"), 0)
        self.end: OhmskinError | None = None
        """why no frame will come any more"""
        self._away: str | None = None
        self.on_converted: list[Callable[[RawFrame, Converted], None]] = []
        """called with every measurement: for recorders"""
        self._converter: Converter | None = None
        self._capacity = capacity
        self._closed = False
        self._kept: deque[RawFrame] = deque()
        """with consecutive numbers"""
        self._passed = 0
        """if none may be dropped: number of the last frame that all readers have passed"""
        self._room_wanted = False
        self._places: list[Place] = []
        self._wakers: list[Callable[[], None]] = []
        self._converting = threading.RLock()
        self._awaited = False
        """a reader converts frames, or waits for the lock to do so"""
        self._last: RawFrame | None = None
        """the newest frame that was converted"""
        self._converted = 0
        self.done = 0
        """number of the last frame that was converted, skipped, or did not fit"""

    # -- what the thread that reads the port does ----------------------------------------------------------------------

    def put(self, frame: RawFrame) -> None:
        """Add the newest frame. :meth:`wake` then wakes those who wait."""
        with self.lock:
            if self._closed:
                return
            self.newest = frame
            self._kept.append(frame)
            if not self.lossless and len(self._kept) > self._capacity:
                self._kept.popleft()

    def keep_up(self) -> bool:
        """Convert some of the frames that have come, and wake those who wait; whether frames are left."""
        left = False
        if not self.lossless and self._converter is not None and not self._awaited:
            with self._converting:
                newest = self.newest
                left = newest is not None and self._convert_up_to(newest.index, CONVERTED_IN_TURN)
        self.wake()
        return left

    def report(self, error: OhmskinError, after: int | None = None) -> None:
        """Report a fault, after which frames go on; ``after``: the last frame before (None: the newest)."""
        with self.lock:
            if after is None:
                after = 0 if self.newest is None else self.newest.index
            self.fault = Fault(self.fault.number + 1, error, after)
        self.wake()

    def set_away(self, reason: str | None) -> None:
        """Tell readers that the port is lost and may come back, or is back (None)."""
        self._away = reason
        self.wake()

    @property
    def away(self) -> str | None:
        """Why the port is lost, while the driver tries to open it again; None: it is there."""
        return self._away

    def finish(self, error: OhmskinError) -> None:
        """Tell readers that no frame will come any more. The first reason counts."""
        with self.lock:
            self.end = self.end or error
        self.wake()

    def close(self, error: OhmskinError) -> None:
        """Drop the frames, and tell readers that they get no more."""
        with self.lock:
            self._closed = True
            self._kept.clear()
            self.newest = None
            self.end = error
        self.wake()

    def is_full(self, times: int = 1) -> bool:
        """Whether no frame may be added where none may be dropped: ``times`` the capacity waits for readers.

        Frames that nobody has asked for do not count.
        """
        if not self.lossless:
            return False
        with self.lock:
            if self._waiting >= times * self._capacity:
                self._drop_unused()
            return self._waiting >= times * self._capacity

    def wait_for_room(self, timeout_s: float) -> None:
        """Wait until half of the queue is free, for at most ``timeout_s``."""
        self._room_wanted = True
        self.wait_for(lambda: self._has_room() or self.end is not None, timeout_s)
        self._room_wanted = False

    # -- what readers do -----------------------------------------------------------------------------------------------

    def join(self, after: int | None) -> tuple[Place, RawFrame | None]:
        """A place for a new reader.

        Args:
            after: number of the frame after which it begins; None: from now on, with the frames that wait if nothing
                may be dropped.

        Returns:
            The place, and the last frame before it; None if there is none, or a number was given.

        """
        with self.lock:
            before = None
            self._drop(self._places)
            if after is None:
                before = self._frame(self._passed) if self.lossless else self.newest
                after = 0 if before is None else before.index
            place = Place(after)
            self._places.append(place)
            return place, before

    def leave(self, place: Place) -> None:
        """Forget a reader."""
        with self.lock:
            if place in self._places:
                self._places.remove(place)
            self._drop_passed()

    def move(self, place: Place, index: int) -> None:
        """Record that a reader has passed frame ``index``."""
        if index > place.index:
            place.index, newest = index, self.newest
            # There is no room, as long as half of the queue waits for this reader alone.
            if self.lossless and (newest is None or 2 * (newest.index - index) <= self._capacity):
                with self.lock:
                    self._drop_passed()

    def has_after(self, index: int) -> bool:
        """Whether a frame beyond ``index`` has arrived."""
        newest = self.newest
        return newest is not None and newest.index > index

    @property
    def latest(self) -> RawFrame | None:
        """The newest frame for readers: if frames are converted as they come, the newest that was converted."""
        return self.newest if self.lossless or self.newest is None else self._last

    def following(self, index: int) -> RawFrame | None:
        """The frame for a reader who has passed ``index``; None if there is none yet."""
        with self.lock:
            if self.newest_only:
                latest = self.latest
                return latest if latest is not None and latest.index > index else None
            return self._after(index)

    def measure(self, frame: RawFrame) -> Converted | None:
        """The measurement of ``frame``; frames before it that wait for their conversion are converted first.

        Returns:
            None if the frame was skipped, or its counts do not fit the design.

        """
        if frame.converted is None:
            self.catch_up(frame.index)
        return frame.converted

    def catch_up(self, last: int | None = None) -> None:
        """Convert the frames up to the number ``last``; None: all, unless readers convert them as they take them."""
        if self._converter is None or (last is None and self.lossless):
            return
        self._awaited = True
        with self._converting:
            try:
                newest = self.newest
                if newest is not None:
                    self._convert_up_to(newest.index if last is None else last)
            finally:
                self._awaited = False

    def converted_since(self, monotonic_s: float) -> list[RawFrame]:
        """The converted frames that came after this time, in order; with the last one before them.

        Frames from before the estimator's last start, as at a tare, are not among them.
        """
        with self._converting, self.lock:
            starts = self.starts
            kept = [one for one in self._kept if one.converted and one.converted.estimator_starts == starts]
        first = next((k for k, one in enumerate(kept) if one.monotonic_time > monotonic_s), len(kept))
        return kept[max(first - 1, 0) :]

    def wait_for(self, news: Callable[[], bool], timeout_s: float) -> None:
        """Wait until ``news`` returns True, for at most ``timeout_s``; it is called whenever something is new."""
        bell: SimpleQueue[None] = SimpleQueue()

        def ring() -> None:
            bell.put(None)

        until_s = time.monotonic() + timeout_s
        try:
            self.add_waker(ring)
            while not news() and (left_s := until_s - time.monotonic()) > 0:
                with contextlib.suppress(Empty):
                    bell.get(timeout=min(left_s, threading.TIMEOUT_MAX))
        finally:
            self.remove_waker(ring)

    def add_waker(self, waker: Callable[[], None]) -> None:
        """Call ``waker`` from the reader thread whenever something is new."""
        with self.lock:
            self._wakers.append(waker)

    def remove_waker(self, waker: Callable[[], None]) -> None:
        """Undo :meth:`add_waker`."""
        with self.lock, contextlib.suppress(ValueError):  # a forked process has none
            self._wakers.remove(waker)

    def wake(self) -> None:
        """Wake all waiting threads: once for all frames that came together, since each wake-up costs time."""
        if not self._wakers:  # who comes now looks for news after he has joined
            return
        with self.lock:
            for waker in self._wakers:
                waker()

    # -- the converter, whom nobody else calls while frames come -------------------------------------------------------

    @property
    def converter(self) -> Converter:
        """What converts the frames, once the board is known."""
        assert self._converter is not None
        return self._converter

    @converter.setter
    def converter(self, converter: Converter) -> None:
        self._converter = converter

    @property
    def starts(self) -> int:
        """Number of times that the estimator has started without memory."""
        return 0 if self._converter is None else self._converter.starts

    @property
    def skipped(self) -> int:
        """Number of frames before the newest converted one that were not converted."""
        with self._converting:
            return self.converter.last_index - self._converted

    def use_rest(self, rest_ohm: FloatArray | None) -> None:
        """Use these rest resistances from the next conversion on, see :meth:`.Converter.use_rest`."""
        with self._converting:
            self.converter.use_rest(rest_ohm)

    def disown(self, error: LinkError) -> None:
        """In a forked process: replace the locks, whoever held them, and end the stream with ``error``."""
        self.lock, self._converting = threading.RLock(), threading.RLock()
        self._wakers.clear()
        self.close(error)

    def _convert_up_to(self, last: int, most: int | None = None) -> bool:
        """Convert the frames up to the number ``last``, at most ``most`` of them; returns whether frames are left."""
        until_s = math.inf
        at_once = REMEMBERED if most is None else most
        if self.newest_only:
            at_once = min(at_once, CONVERTED_IN_TURN)
            if self.done + at_once < last:
                until_s = time.thread_time() + LATE_S
        while True:
            with self.lock:
                frames = self._all_after(self.done, last, at_once)
            if not frames:
                return False
            fits = self._convert(frames)
            if self.done >= last or most is not None or (self.lossless and not fits):
                return self.done < last
            if until_s < math.inf and time.thread_time() > until_s:
                self.done = max(last - 1, self.done)

    def _convert(self, frames: list[RawFrame]) -> bool:
        """Convert frames that follow one another, up to the first that does not fit; returns whether all do."""
        self.done = frames[-1].index
        try:
            assert self._converter is not None
            converted = self._converter.convert(frames)
        except OhmskinError:
            raise
        except Exception as error:
            # No reader shall wait for frames that no longer come.
            self.finish(LinkError(f"frame {frames[0].index} could not be converted: {error!r}"))
            raise
        for frame, found in zip(frames, converted, strict=False):
            if found.__class__ is not Converted:
                assert isinstance(found, ProtocolError)
                self.done = frame.index
                self.report(found, frame.index)
                return False
            frame.converted = found
            self._last, self._converted = frame, self._converted + 1
            for receive in tuple(self.on_converted):
                receive(frame, found)
        return True

    # -- the queue, with the lock held ---------------------------------------------------------------------------------

    @property
    def _waiting(self) -> int:
        return 0 if self.newest is None else self.newest.index - self._passed

    def _frame(self, index: int) -> RawFrame | None:
        """The frame with this number, if it is kept."""
        place = index - self._kept[0].index if self._kept else -1
        return self._kept[place] if 0 <= place < len(self._kept) else None

    def _after(self, index: int) -> RawFrame | None:
        """The oldest frame beyond ``index`` that is for readers; None if there is none yet."""
        kept = self._kept
        if not kept or kept[-1].index <= index:
            return None
        return kept[-1] if kept[-1].index == index + 1 else kept[self._place_after(index)]

    def _place_after(self, index: int) -> int:
        """The place in the queue of the oldest frame beyond ``index`` that is for readers; one has come."""
        place = (index if index > self._passed else self._passed) + 1 - self._kept[0].index
        return place if 0 <= place < len(self._kept) else 0

    def _all_after(self, index: int, last: int, most: int) -> list[RawFrame]:
        """The frames beyond ``index`` that are for readers, up to the number ``last``, and ``most`` of them."""
        kept = self._kept
        if not kept or kept[-1].index <= index:
            return []
        if kept[-1].index == index + 1 == last:  # as long as readers keep up with the board
            return [kept[-1]]
        place = self._place_after(index)
        wanted = last - kept[place].index + 1
        if wanted <= 1:
            return [kept[place]] if wanted == 1 else []
        return list(islice(kept, place, place + min(wanted, most)))

    def _drop_passed(self) -> None:
        self._drop(self._places)
        if self._room_wanted and self._has_room():
            self.wake()

    def _drop(self, places: list[Place]) -> None:
        """Let the frames that all these places have passed count no longer; none if there are no places."""
        self._passed = max(self._passed, min((place.index for place in places), default=0))
        while len(self._kept) > self._capacity and self._kept[0].index < self._passed:
            self._kept.popleft()

    def _drop_unused(self) -> None:
        """Drop frames passed by all readers that ever took a frame. The others start at the oldest frame left."""
        self._drop([place for place in self._places if place.used])

    def _has_room(self) -> bool:
        # Half a queue at a time: threads that alternate with every frame spend more time on switching than on frames.
        with self.lock:
            self._drop_unused()
            return 2 * self._waiting <= self._capacity
