"""Hand-over of frames from the reader thread to those who take them: a bounded queue with one writer, many readers."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from queue import Empty, SimpleQueue

from ..errors import LinkError, OhmskinError
from ._stream import RawFrame


@dataclass(frozen=True, slots=True)
class Fault:
    """A frame that could not be taken. Every consumer is told of it once."""

    number: int
    """from 1"""
    error: OhmskinError
    after: int
    """number of the last frame that came before it"""


@dataclass(slots=True, eq=False)
class Place:
    """Position of one consumer in the stream."""

    index: int
    """number of the last frame that the consumer has passed"""
    used: bool = False
    """the consumer has asked for a frame: if nothing may be dropped, the reader thread waits only for such consumers"""


class Mailbox:
    """The newest frames. Each consumer keeps its own place, so that consumers do not disturb each other.

    All attributes are written with ``lock`` held. Those who wait do so without it, each on a queue of its own: signals
    may interrupt Python's conditions halfway (:mod:`ohmskin.common.events`).
    """

    def __init__(self, capacity: int, *, drops_oldest: bool = True) -> None:
        """``capacity``: number of frames that wait for consumers."""
        self.lock = threading.RLock()
        self.capacity = capacity
        self.newest: RawFrame | None = None
        self.fault = Fault(0, LinkError("none"), 0)
        self.end: OhmskinError | None = None
        """why no frame will come any more"""
        self.away: str | None = None
        """why the port is lost, while the driver tries to open it again"""
        self._drops_oldest = drops_oldest
        self._closed = False
        self._room_wanted = False
        self._frames: deque[RawFrame] = deque()
        self._dropped: RawFrame | None = None
        """the frame before the oldest one kept"""
        self._places: list[Place] = []
        self._wakers: list[Callable[[], None]] = []

    def put(self, frame: RawFrame) -> None:
        """Add the newest frame; a full queue drops the oldest one. :meth:`tell` then wakes those who wait."""
        with self.lock:
            if self._closed:
                return
            self.newest = frame
            self._frames.append(frame)
            if self._drops_oldest and len(self._frames) > self.capacity:
                self._dropped = self._frames.popleft()

    def tell(self) -> None:
        """Wake all waiting threads: once for all frames that came together, since each wake-up costs time."""
        with self.lock:
            self._tell()

    def report(self, error: OhmskinError, after: int | None = None) -> None:
        """Report a fault, after which frames go on; ``after``: the last frame before (None: the newest)."""
        with self.lock:
            if after is None:
                after = 0 if self.newest is None else self.newest.index
            self.fault = Fault(self.fault.number + 1, error, after)
            self._tell()

    def set_away(self, reason: str | None) -> None:
        """Tell consumers that the port is lost and may come back, or is back (None)."""
        with self.lock:
            self.away = reason
            self._tell()

    def finish(self, error: OhmskinError) -> None:
        """Tell consumers that no frame will come any more. The first reason counts."""
        with self.lock:
            self.end = self.end or error
            self._tell()

    def close(self, error: OhmskinError) -> None:
        """Drop the queue, and tell consumers that they get no more frames."""
        with self.lock:
            self._closed = True
            self._frames.clear()
            self.newest = None
            self.end = error
            self._tell()

    def has_after(self, index: int) -> bool:
        """Whether a frame beyond ``index`` has arrived."""
        newest = self.newest
        return newest is not None and newest.index > index

    def after(self, index: int) -> RawFrame | None:
        """The oldest frame beyond ``index``; None if there is none yet."""
        with self.lock:
            if not self._frames or self._frames[-1].index <= index:
                return None
            return self._frames[max(index + 1 - self._frames[0].index, 0)]

    def join(self, after: int | None) -> tuple[Place, RawFrame | None]:
        """A place for a new consumer.

        Args:
            after: number of the frame after which it begins; None: from now on, with the frames that are kept if
                nothing may be dropped.

        Returns:
            The place, and the last frame before it; None if there is none, or a number was given.

        """
        with self.lock:
            before = None
            if after is None:
                before = self.newest if self._drops_oldest else self._dropped
                after = 0 if before is None else before.index
            place = Place(after)
            self._places.append(place)
            return place, before

    def leave(self, place: Place) -> None:
        """Forget a consumer."""
        with self.lock:
            if place in self._places:
                self._places.remove(place)
            self._drop_passed()

    def move(self, place: Place, index: int) -> None:
        """Record that a consumer has passed frame ``index``. Frames that all consumers have passed are dropped."""
        with self.lock:
            if index > place.index:
                place.index = index
                self._drop_passed()

    def _drop_passed(self) -> None:
        self._drop(self._places)
        if self._room_wanted and self._has_room():
            self._tell()

    def _drop(self, places: Sequence[Place]) -> None:
        """Drop the frames that all these places have passed; none if there are no places."""
        passed = min((place.index for place in places), default=0)
        while self._frames and self._frames[0].index <= passed:
            self._dropped = self._frames.popleft()

    def _drop_unused(self) -> None:
        """Drop frames passed by all consumers that ever took a frame. The others start at the oldest frame left."""
        self._drop([place for place in self._places if place.used])

    def is_full(self, times: int = 1) -> bool:
        """Whether ``times`` the queue has no room, even after dropping frames that nobody has asked for."""
        with self.lock:
            if len(self._frames) >= times * self.capacity:
                self._drop_unused()
            return len(self._frames) >= times * self.capacity

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

    def disown(self, error: LinkError) -> None:
        """In a forked process: replace the lock, whoever held it, and end the stream with ``error``."""
        self.lock = threading.RLock()
        self._wakers.clear()
        self.close(error)

    def wait_for_room(self, timeout_s: float) -> None:
        """Wait until half of the queue is free, for at most ``timeout_s``."""
        self._room_wanted = True
        self.wait_for(lambda: self._has_room() or self.end is not None, timeout_s)
        self._room_wanted = False

    def _has_room(self) -> bool:
        # Half a queue at a time: threads that alternate with every frame spend more time on switching than on frames.
        with self.lock:
            self._drop_unused()
            return 2 * len(self._frames) <= self.capacity

    def add_waker(self, waker: Callable[[], None]) -> None:
        """Call ``waker`` from the reader thread whenever something is new."""
        with self.lock:
            self._wakers.append(waker)

    def remove_waker(self, waker: Callable[[], None]) -> None:
        """Undo :meth:`add_waker`."""
        with self.lock, contextlib.suppress(ValueError):  # a forked process has none
            self._wakers.remove(waker)

    def _tell(self) -> None:
        for waker in self._wakers:
            waker()
