"""Reconnection: finding the port of a board again, with exponential back-off."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from ..errors import LinkError
from ._port import BytePort, open_port, ports_with, usb_serial_number

FIRST_DELAY_S, LONGEST_DELAY_S = 0.1, 1.0


class PortFinder:
    """Opens the port of one board, and opens it again wherever the operating system has put it since.

    A USB device is known by its USB serial number, so that it is found under another name, and so that another device
    that has taken its name is left alone. Any other port is known by its name.
    """

    def __init__(self, name: str, *, baudrate: int, dtr: bool | None = None, rts: bool | None = None) -> None:
        self.name = name
        self._options = {"baudrate": baudrate, "dtr": dtr, "rts": rts}
        self._usb_serial = usb_serial_number(name)

    def open(self) -> BytePort:
        """Open the port where it is now; LinkError where it is not there."""
        return self._open(self.name)

    def open_again(self) -> BytePort:
        """Open the port where it is now, perhaps under another name; LinkError where it is nowhere."""
        if not self._usb_serial:
            return self._open(self.name)
        names = ports_with(self._usb_serial)
        if not names:
            raise LinkError(f"{self.name}: no USB device with serial number {self._usb_serial} is plugged in")
        return self._open(self.name if self.name in names else names[0])

    def _open(self, name: str) -> BytePort:
        return open_port(name, **self._options)  # type: ignore[arg-type]  # a dict of mixed values


def attempts(limit_s: float, wait: Callable[[float], bool]) -> Iterator[float]:
    """The times, in s from now, at which to try again; ends after ``limit_s`` or when ``wait`` returns True."""
    start, delay = time.monotonic(), FIRST_DELAY_S
    while (elapsed := time.monotonic() - start) < limit_s:
        if wait(min(delay, limit_s - elapsed)):
            return
        delay = min(2 * delay, LONGEST_DELAY_S)
        yield time.monotonic() - start
