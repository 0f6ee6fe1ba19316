"""The only place that knows pyserial: bytes in and out of a port, and its failures as link errors."""

from __future__ import annotations

import errno
import os
import select
from pathlib import Path
from typing import Protocol

import serial
from serial.tools import list_ports

from ..errors import LinkError

BAUDRATE = 1_000_000
"""where there is a real UART; USB, ptys and TCP ignore it"""

_CHUNK = 65536


class BytePort(Protocol):
    """What a :class:`~.skin.Skin` needs of a port. A recording can be one."""

    name: str

    def read(self, wait_s: float) -> bytes:
        """What has come, waiting up to ``wait_s`` for the first byte; LinkError when the port is gone."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of ``data``; LinkError when that fails."""
        ...

    def close(self) -> None:
        """Give the port back; a second time does nothing."""
        ...


class SerialPort:
    """A serial device, a pty, or ``socket://HOST:PORT``; nobody else can open it as long as it is open.

    Raises:
        LinkError: it is not there, may not be used, is in use, or is no serial port. The message says which.

    """

    def __init__(self, name: str, baudrate: int = BAUDRATE) -> None:
        self.name = name
        try:
            self._serial = serial.serial_for_url(name, baudrate, timeout=0, write_timeout=1.0, exclusive=True)
        except (serial.SerialException, ValueError, OSError) as error:
            raise LinkError(f"{name}: {_why_not_opened(name, error)}") from error

    def read(self, wait_s: float) -> bytes:
        """What has come, waiting up to ``wait_s`` for the first byte; LinkError when the port is gone."""
        try:
            ready, _, _ = select.select([self._serial], [], [], max(wait_s, 0.0))
            return bytes(self._serial.read(_CHUNK)) if ready else b""
        except (serial.SerialException, OSError) as error:
            raise LinkError(f"{self.name}: the board has gone away ({_reason(error)})") from error

    def write(self, data: bytes) -> None:
        """Send all of ``data``; LinkError when that fails."""
        try:
            self._serial.write(data)
        except (serial.SerialException, OSError) as error:
            raise LinkError(f"{self.name}: the board takes no commands ({_reason(error)})") from error

    def close(self) -> None:
        """Give the port back; a second time does nothing."""
        # pyserial forgets to close a socket whose other end hung up first.
        tcp = getattr(self._serial, "_socket", None)
        self._serial.close()
        if tcp is not None:
            tcp.close()


def _why_not_opened(name: str, error: Exception) -> str:
    match getattr(error, "errno", None):
        case errno.ENOENT:
            present = ", ".join(port.device for port in list_ports.comports()) or "none"
            return f"no such port; serial ports present: {present}"
        case errno.EACCES | errno.EPERM:
            return f"permission denied; the port belongs to {_owner(name)}, which this user is not in"
        case errno.EAGAIN | errno.EBUSY:
            return "in use by another program"
    if os.path.exists(name) and not isinstance(error, ValueError):
        return f"is no serial port ({_reason(error)})"
    return f"cannot be opened: {_reason(error)}"


def _owner(name: str) -> str:
    try:
        return f"group '{Path(name).group()}'"
    except KeyError:
        return f"group {Path(name).stat().st_gid}"


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
