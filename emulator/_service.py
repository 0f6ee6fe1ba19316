"""What a board in service needs of the operating system: the request to stop, a thread, and how it waits."""

from __future__ import annotations

import select
import selectors
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal, Protocol

from ..common.system import ENDING_SIGNALS
from ._ports import Port

ClockName = Literal["real", "fast"]

MOST_FOR_SELECT = 1024
"""file descriptors that ``select()`` can wait for (FD_SETSIZE)"""


class Stop:
    """A request to end the run, from a signal or another thread; the loop waits for it along with the port."""

    def __init__(self) -> None:
        self.signal: int | None = None
        """the signal that asked, if one did"""
        self.then: Callable[[], object] = lambda: None
        """called once, when the run shall end, in the thread or signal handler that asks"""
        self._asked = False
        self._read, self._write = socket.socketpair()  # select() of Windows knows no pipes
        self._write.setblocking(False)

    def set(self, number: int | None = None) -> None:
        """End the run between two ticks."""
        self.signal = self.signal or number
        if not self._asked:
            self._asked = True
            self._write.send(b"!")
            self.then()

    def is_set(self) -> bool:
        return self._asked

    def fileno(self) -> int:
        return self._read.fileno()

    def close(self) -> None:
        self._read.close()
        self._write.close()


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """A :class:`Stop` that signals to end set, instead of what they did before. In the main thread only."""
    stop = Stop()
    before = {number: signal.signal(number, lambda number, _: stop.set(number)) for number in ENDING_SIGNALS}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        stop.close()


@dataclass
class Outcome:
    """What a run came to."""

    seconds: float = 0.0
    """board time"""
    dropped: int = 0
    """frames for which the transmit buffer had no room: the host, or the line, was too slow"""
    lost_bytes: int = 0
    """bytes that a UART sent and that the host had no room for"""
    behind_s: float = 0.0
    """real clock: by how much board time fell behind because this machine was too slow"""
    hung_up: list[str] = field(default_factory=list)
    """why hosts were hung up on, each reason once"""

    def notes(self) -> list[str]:
        """What whoever started the run should know, a line each."""
        notes = []
        if self.dropped:
            notes.append(f"{self.dropped} frames were dropped: the host or the line was too slow")
        if self.lost_bytes:
            notes.append(f"{self.lost_bytes} bytes were lost: the host read too slowly")
        if self.behind_s:
            notes.append(f"board time fell {self.behind_s:.1f} s behind: this machine is too slow for the scene")
        return notes + [f"a host was hung up on: {reason}" for reason in self.hung_up]


class HasFileno(Protocol):
    """What a selector can wait for."""

    def fileno(self) -> int: ...


def wait_for(readable: list[HasFileno], writable: list[HasFileno], timeout_s: float) -> None:
    """Wait until one of these is ready, or the time is over.

    ``select()`` waits to the microsecond, but knows no descriptor beyond 1023. ``epoll()`` knows all, but rounds the
    time up to whole milliseconds, which would make frames of a 1 kHz board late by half their period.
    """
    if max(end.fileno() for end in readable) < MOST_FOR_SELECT:
        select.select(readable, writable, [], timeout_s)
        return
    with selectors.DefaultSelector() as selector:
        for end in readable:
            both = selectors.EVENT_WRITE if end in writable else 0
            selector.register(end, selectors.EVENT_READ | both)
        selector.select(timeout_s)


@contextmanager
def in_thread(serve: Callable[[Stop, Callable[[], None]], object], port: Port) -> Iterator[None]:
    """Let ``serve`` run in a thread while the block lasts, which begins when ``serve`` calls its second argument.

    The port is closed when ``serve`` returns. What it raises is raised at the end of the block.
    """
    stop, begun = Stop(), threading.Event()
    failures: list[Exception] = []

    def live() -> None:
        try:
            with port:
                serve(stop, begun.set)
        except Exception as error:
            failures.append(error)
        finally:
            begun.set()

    thread = threading.Thread(target=live, daemon=True)
    thread.start()
    try:
        begun.wait()
        yield
    finally:
        stop.set()
        thread.join()
        stop.close()
    if failures:
        raise failures[0]
