"""Lazy evaluation of a frame's arrays: each is computed once, on first use, in the calling thread."""

from __future__ import annotations

import threading
from collections.abc import Callable

from ..common.arrays import FloatArray


class Lazy:
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
