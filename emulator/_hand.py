"""Loads that a program sets while an emulated board lives, beside those that the scene has written down."""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import FloatArray
from ..common.events import SignalSafeEvent
from ..errors import InputError, LinkTimeout


class Hand:
    """Presses on an emulated skin. Any thread may press; the board takes the load at its next tick."""

    def __init__(self, shape: tuple[int, int]) -> None:
        """A hand that does not touch a skin of ``shape`` (rows, columns)."""
        self.shape = shape
        self._lock = threading.Lock()
        self._pressing: dict[int, SignalSafeEvent] = {}
        """number of a load that somebody waits for -> set when it is in force"""
        self._pressure_kpa = np.zeros(shape)
        self.wanted = 0
        """number of the present load"""
        self._offered = 0
        """number of the load that the board was last given"""
        self._since_s = 0.0

    def press(self, pressure_kpa: ArrayLike, *, timeout_s: float = 10.0) -> float:
        """Press from the board's next tick on, until the next call.

        Args:
            pressure_kpa: (rows, columns) kPa on the surface, or what can be broadcast to it.
            timeout_s: s to wait for the board to take the load.

        Returns:
            Board time, in s as in the frames, of the first frame under this load.

        Raises:
            InputError: a negative or infinite pressure, or one of another shape.
            LinkTimeout: no board takes the load.

        """
        try:
            pressure = np.array(np.broadcast_to(np.asarray(pressure_kpa, dtype=np.float64), self.shape))
        except ValueError as error:
            raise InputError(f"pressure_kpa does not fit {self.shape[0]} x {self.shape[1]} cells") from error
        if not (np.isfinite(pressure) & (pressure >= 0)).all():
            raise InputError("pressure_kpa must be finite and not negative")
        with self._lock:
            self._pressure_kpa = pressure
            self.wanted += 1
            mine = self.wanted
            taken = self._pressing[mine] = SignalSafeEvent()
        try:
            if not taken.wait(timeout_s):
                raise LinkTimeout(f"no board took the load within {timeout_s:g} s")
            return self._since_s
        finally:
            del self._pressing[mine]

    def take_change(self) -> FloatArray | None:
        """For the board: the load (rows, columns) in kPa if it has changed, else None."""
        with self._lock:
            if self._offered == self.wanted:
                return None
            self._offered = self.wanted
            return self._pressure_kpa

    def in_force(self, since_s: float) -> None:
        """For the board: the load that was taken is in force from board time ``since_s`` on."""
        with self._lock:
            self._since_s = since_s
            for number, taken in list(self._pressing.items()):
                if number <= self._offered:
                    taken.set()
