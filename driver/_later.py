"""Lazy evaluation of arrays of a frame: computed once, when somebody asks for them, in whatever thread that is."""

from __future__ import annotations

import threading
import weakref
from collections import deque
from collections.abc import Callable

from ..arrays import FloatArray


class Later:
    """An array that is computed when it is first called for.

    The computation must depend on nothing that changes: the array is then that of its frame, whenever it is asked for.
    """

    __slots__ = ("__weakref__", "_array", "_compute", "_lock")

    def __init__(self, compute: Callable[[], FloatArray]) -> None:
        self._compute: Callable[[], FloatArray] | None = compute
        self._array: FloatArray | None = None
        self._lock = threading.Lock()

    def __call__(self) -> FloatArray:
        """The array, read-only, the same one for all who ask."""
        array = self._array
        if array is None:
            with self._lock:
                array = self._array
                if array is None:
                    assert self._compute is not None
                    array = self._compute()
                    array.setflags(write=False)
                    self._array = array
                    self._compute = None  # what it holds is several times as large as the array
        return array


class Retained:
    """Has the arrays of frames that somebody keeps computed after a while, so that kept frames stay small."""

    def __init__(self, frames: int) -> None:
        """``frames``: number of newer frames after which that is done."""
        self._frames = frames
        self._waiting: deque[weakref.ref[Later]] = deque()

    def add(self, later: Later) -> None:
        """Take the array of the newest frame."""
        self._waiting.append(weakref.ref(later))
        if len(self._waiting) > self._frames:
            kept = self._waiting.popleft()()
            if kept is not None:
                kept()
