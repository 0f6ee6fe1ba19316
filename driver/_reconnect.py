"""Reconnection: find the port of a board again, with exponential back-off."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from ..common.rendezvous import AnnouncedPort, announced
from ..errors import LinkError
from ._port import BytePort, open_port, over
from ._port_names import (
    EMULATED_HERE,
    emulated_ports,
    is_numbered_terminal,
    ports_with,
    serial_ports,
    usb_serial_number,
)
from ._tuning import FIRST_DELAY_S, LONGEST_DELAY_S


class PortFinder:
    """Opens the port of one board, and reopens it under whatever name the operating system gives it later.

    A USB device is identified by its USB serial number. It is thus found under another name, and another device that
    has taken its name is left alone. Many converters have no such number. A board behind one is looked for under its
    old name and, if the board sends a serial number of its own, at ports that have appeared since; whoever reopens the
    port must then ask the board for the number. Ports that were there all the time belong to others and are not
    touched.

    The number of a closed pseudo-terminal goes to the next program that opens one. Under such numbers the finder
    therefore looks only for emulated boards, at the places that they announce (:mod:`ohmskin.common.rendezvous`). An
    emulator that was stopped and started again may be at any number or TCP port: if the board was emulated on this
    machine, ports that have appeared since include those of emulated boards.
    """

    def __init__(self, name: str, *, baudrate: int, dtr: bool | None = None, rts: bool | None = None) -> None:
        self.name = name
        self._options = {"baudrate": baudrate, "dtr": dtr, "rts": rts}
        self._usb_serial = usb_serial_number(name)
        self.board_is_numbered: Callable[[], bool] = lambda: False
        """whether the board sends a serial number of its own"""
        self._is_emulated = announced(name) is not None
        self._always_there = self._present()
        """ports that have been there whenever this finder looked"""
        self._last: str | None = None
        """name under which the port was last reopened"""
        self._announced: AnnouncedPort | None = None
        """announcement of an emulated board's port, kept while the port is away"""

    def open(self) -> BytePort:
        """Open the port where it is now; LinkError if it is not there."""
        return self._open(self.name)

    def open_again(self) -> BytePort:
        """Open the port where it is now, perhaps under another name.

        Raises:
            LinkEnded: the port's emulated board has come to its end. One in this process (``ohmskin://``) is never
                opened again, since that would start another board.
            LinkError: the port is nowhere.

        """
        emulated = self._announced
        if self.name.startswith(EMULATED_HERE):
            raise over(self.name)
        if emulated is not None and emulated.is_over:
            emulated.close()
            raise over(self.name)
        names = ports_with(self._usb_serial) if self._usb_serial else self._names_without_number()
        if not names and self._usb_serial:
            raise LinkError(f"{self.name}: no USB device with serial number {self._usb_serial} is plugged in")
        failure = LinkError(f"{self.name}: no such port")
        # Start with the next name, since another board may be behind the last one.
        names.sort(key=lambda name: name != self.name)
        after_last = names.index(self._last) + 1 if self._last in names else 0
        for name in names[after_last:] + names[:after_last]:
            try:
                port = self._open(name)
            except LinkError as error:
                failure = error
                continue
            self._last = name
            return port
        raise failure

    def _names_without_number(self) -> list[str]:
        """The board's name, and those of ports that have appeared since it was opened."""
        present = self._present()
        appeared = sorted(present - self._always_there - {self.name}) if self.board_is_numbered() else []
        self._always_there &= present
        now = self._announced.name if self._announced is not None else ""
        names = dict.fromkeys([self.name, now, *appeared])
        return [name for name in names if name and not _is_of_others(name)]

    def _present(self) -> set[str]:
        return {*serial_ports(), *(emulated_ports() if self._is_emulated else [])}

    def _open(self, name: str) -> BytePort:
        emulated = announced(name)
        port = open_port(name, **self._options)  # type: ignore[arg-type]  # a dict of mixed values
        self._announced = emulated
        return port


def _is_of_others(name: str) -> bool:
    """Whether ``name`` is a numbered pseudo-terminal of another program: no emulated board has that number now."""
    return is_numbered_terminal(name) and announced(name) is None


def attempts(limit_s: float, wait: Callable[[float], bool]) -> Iterator[float]:
    """Times of the attempts, in s from now; ends after ``limit_s`` or when ``wait`` returns True."""
    start, delay = time.monotonic(), FIRST_DELAY_S
    while (elapsed := time.monotonic() - start) < limit_s:
        if wait(min(delay, limit_s - elapsed)):
            return
        delay = min(2 * delay, LONGEST_DELAY_S)
        yield time.monotonic() - start
