"""Where the emulator meets the operating system: a pseudo-terminal or a TCP socket that one host can open."""

from __future__ import annotations

import errno
import fcntl
import os
import pty
import select
import socket
import struct
import termios
import tty
from abc import ABC, abstractmethod
from pathlib import Path
from types import TracebackType
from typing import Self

from ..errors import InputError, LinkError

_CHUNK = 65536


class Port(ABC):
    """One end of a byte stream. Nothing here waits."""

    name: str
    """what a host opens"""

    @abstractmethod
    def host_present(self) -> bool:
        """Whether a host has the port open now."""

    @abstractmethod
    def fileno(self) -> int:
        """To select on, while a host is present."""

    @abstractmethod
    def read(self) -> bytes | None:
        """What the host has sent since the last call; None when it has gone."""

    @abstractmethod
    def write(self, data: bytes) -> int:
        """Send the beginning of ``data``, as much as goes; the number of bytes sent."""

    @abstractmethod
    def unread(self) -> int:
        """How many of the bytes written the host, or its kernel, has not taken yet."""

    @abstractmethod
    def close(self) -> None:
        """Take the port away."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class PtyPort(Port):
    """A pseudo-terminal, which any serial program can open; ``link`` becomes a symbolic link to it.

    Raises:
        InputError: ``link`` cannot be made, or is there already and is no symbolic link.

    """

    def __init__(self, link: Path | None = None) -> None:
        self._link = link
        self._master, host_end = pty.openpty()
        self._device = os.ttyname(host_end)
        tty.setraw(host_end)
        # From now on the master reports a hang-up whenever no host has the other end open.
        os.close(host_end)
        os.set_blocking(self._master, False)
        self.name = self._device
        if link is not None:
            try:
                self._make_link(link)
            except BaseException:
                os.close(self._master)
                raise
            self.name = str(link)

    def _make_link(self, link: Path) -> None:
        if os.path.lexists(link) and not link.is_symlink():
            raise InputError(f"{link}: exists and is no symbolic link; expected a free name")
        if link.exists():  # what an emulator that died has left behind points to nothing
            raise InputError(f"{link}: leads to {os.path.realpath(link)}, which is there; expected a free name")
        partial = link.with_name(f".{link.name}.partial-{os.getpid()}")
        try:
            partial.symlink_to(self._device)
            partial.replace(link)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise InputError(f"{link}: cannot be linked: {error.strerror}") from error

    def host_present(self) -> bool:
        poll = select.poll()
        poll.register(self._master, select.POLLHUP)
        return not poll.poll(0)

    def fileno(self) -> int:
        return self._master

    def read(self) -> bytes | None:
        try:
            return os.read(self._master, _CHUNK)
        except BlockingIOError:
            return b""
        except OSError as error:
            if error.errno == errno.EIO:  # a hang-up
                return None
            raise LinkError(f"{self.name}: cannot be read: {error.strerror}") from error

    def write(self, data: bytes) -> int:
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise LinkError(f"{self.name}: cannot be written: {error.strerror}") from error

    def unread(self) -> int:
        # Only the host's end knows. Opening it hides a hang-up, hence for a moment only.
        host_end = os.open(self._device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            (waiting,) = struct.unpack("i", fcntl.ioctl(host_end, termios.FIONREAD, struct.pack("i", 0)))
        finally:
            os.close(host_end)
        return int(waiting)

    def close(self) -> None:
        if self._link is not None and self._link.is_symlink() and os.readlink(self._link) == self._device:
            self._link.unlink()
        os.close(self._master)


class TcpPort(Port):
    """A listening TCP socket for one host at a time; a second one is hung up on.

    Raises:
        LinkError: nothing can listen there.

    """

    def __init__(self, host: str, port: int) -> None:
        self._host: socket.socket | None = None
        try:
            self._listener = socket.create_server((host, port))
        except (OSError, UnicodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else str(error)
            raise LinkError(f"{host}:{port}: cannot listen there: {reason}") from error
        self._listener.setblocking(False)
        # Like the small buffer of a serial port, so that a slow host is noticed soon. Inherited by connections.
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 16384)
        self.name = "socket://{}:{}".format(*self._listener.getsockname())

    @classmethod
    def at(cls, address: str) -> TcpPort:
        """Listen at HOST:PORT, or :PORT for the loopback; port 0 takes a free one. Raises InputError, LinkError."""
        host, colon, port = address.rpartition(":")
        if not colon or not port.isdecimal() or int(port) > 65535:
            raise InputError(f"'{address}' is no address; expected HOST:PORT or :PORT with a port up to 65535")
        return cls(host or "127.0.0.1", int(port))

    def host_present(self) -> bool:
        try:
            arrived, _ = self._listener.accept()
        except (BlockingIOError, ConnectionError):
            return self._host is not None
        if self._host is None:
            self._host = arrived
            arrived.setblocking(False)
            arrived.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        else:
            arrived.close()
        return True

    def fileno(self) -> int:
        assert self._host is not None
        return self._host.fileno()

    def read(self) -> bytes | None:
        assert self._host is not None
        try:
            data = self._host.recv(_CHUNK)
        except BlockingIOError:
            return b""
        except ConnectionError:
            data = b""
        if not data:
            self._hang_up()
            return None
        return data

    def write(self, data: bytes) -> int:
        assert self._host is not None
        try:
            return self._host.send(data)
        except (BlockingIOError, ConnectionError):  # what broke shows at the next read
            return 0

    def unread(self) -> int:
        if self._host is None:
            return 0
        (unacknowledged,) = struct.unpack("i", fcntl.ioctl(self._host, termios.TIOCOUTQ, struct.pack("i", 0)))
        return int(unacknowledged)

    def close(self) -> None:
        self._hang_up()
        self._listener.close()

    def _hang_up(self) -> None:
        if self._host is not None:
            self._host.close()
            self._host = None
