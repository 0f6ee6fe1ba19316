"""Lazy evaluation of a frame's arrays: each is computed once, on first use, in the calling thread."""

from __future__ import annotations

import threading
import weakref
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from ..common.arrays import FloatArray

if TYPE_CHECKING:
    from ._frame import Frame


class Later:
    """An array that is computed on first use.

    The computation must depend only on immutable values, so that the time of the call makes no difference.
    """

    __slots__ = ("_array", "_compute", "_lock")

    def __init__(self, compute: Callable[[], FloatArray]) -> None:
        self._compute: Callable[[], FloatArray] | None = compute
        self._array: FloatArray | None = None
        self._lock = threading.Lock()

    def __call__(self) -> FloatArray:
        """The array, read-only; every call returns the same one."""
        array = self._array
        if array is None:
            with self._lock:
                array = self._array
                if array is None:
                    assert self._compute is not None
                    array = self._compute()
                    array.setflags(write=False)
                    self._array = array
                    self._compute = None  # its inputs are several times as large as the array
        return array


class Retained:
    """Computes the standard deviations of frames that somebody keeps after a while, so that kept frames stay small."""

    def __init__(self, frames: int) -> None:
        """``frames``: number of newer frames after which the deviations are computed."""
        self._frames = frames
        self._waiting: deque[weakref.ref[Frame]] = deque()

    def add(self, frame: Frame) -> None:
        """Add the newest frame."""
        self._waiting.append(weakref.ref(frame))
        if len(self._waiting) > self._frames:
            kept = self._waiting.popleft()()
            if kept is not None:
                _ = kept.pressure_std
