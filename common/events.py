"""An event for threads that a signal cannot leave in a bad state.

``threading.Event``, ``threading.Condition`` and ``queue.Queue`` are written in Python. A signal handler that raises an
exception in the main thread (Ctrl-C) may interrupt them halfway: between ``release`` and ``remove`` in
``Condition.notify`` it leaves a waiter that no longer waits, and the next wake-up is lost to it. What is written in C
(locks, ``queue.SimpleQueue``) is interrupted before or after each call only.
"""

from __future__ import annotations

import contextlib
import threading
from queue import Empty, SimpleQueue


class SignalSafeEvent:
    """A flag that threads wait for, as ``threading.Event``, on a queue in C."""

    def __init__(self) -> None:
        self._is_set = False
        self._bell: SimpleQueue[None] = SimpleQueue()

    def set(self) -> None:
        """Set the flag, and wake those who wait. May be called from a signal handler."""
        self._is_set = True
        self._bell.put(None)

    def clear(self) -> None:
        """Take the flag back."""
        self._is_set = False

    def is_set(self) -> bool:
        """Whether the flag is set."""
        return self._is_set

    def wait(self, timeout_s: float) -> bool:
        """Wait until the flag is set, or for ``timeout_s``; returns the flag. After :meth:`clear` it may return early.

        Each who wakes up rings for the next, so that all do.
        """
        if not self._is_set and timeout_s > 0:
            with contextlib.suppress(Empty):
                self._bell.get(timeout=min(timeout_s, threading.TIMEOUT_MAX))
            if self._is_set:
                self._bell.put(None)
        return self._is_set
