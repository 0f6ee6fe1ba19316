"""Ends of byte streams that a host can open: pseudo-terminal, TCP, RFC 2217, socket pair. Nothing here waits."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import struct
import time
from abc import ABC, abstractmethod
from functools import cached_property
from pathlib import Path
from typing import Self, cast

from serial.rfc2217 import PortManager, Serial

from ..common.rendezvous import END_OF_TRANSMISSION, Announcement
from ..common.system import has_hung_up, pty, require_posix, tty, unacknowledged_bytes, waiting_bytes
from ..errors import InputError, LinkError
from ._tuning import DEAF_S, PIECE

_RESET, _IN_GOOD_ORDER = struct.pack("ii", 1, 0), struct.pack("ii", 0, 0)
"""whether to linger, and for how many s: how closing a TCP connection ends it (struct linger)"""
LONGEST_SUBOPTION = 1024
"""bytes of a Telnet suboption; a host that sends a longer one is hung up on"""
MOST_UNREAD = 65536
"""bytes that may wait for a host beyond the kernel's buffer; one that asks and reads no answers is hung up on"""


class Port(ABC):
    """One end of a byte stream."""

    name: str
    """what a host opens"""
    hosts = 0
    """hosts so far, for ports that can tell one from the next"""
    _announcement: Announcement | None = None
    _listed = True

    @cached_property
    def hung_up(self) -> dict[str, None]:
        """Why hosts were hung up on, each reason once."""
        return {}

    @abstractmethod
    def host_present(self) -> bool:
        """Whether a host has the port open now."""

    @abstractmethod
    def fileno(self) -> int:
        """To wait on, while a host is present."""

    @abstractmethod
    def read(self) -> bytes | None:
        """What the host has sent since the last call, at most a few kilobytes; None when the host has gone."""

    @abstractmethod
    def write(self, data: bytes) -> int:
        """Send the beginning of ``data``, as much as goes; the number of bytes sent."""

    @abstractmethod
    def unread(self) -> int:
        """How many of the bytes written the host, or its kernel, has not taken yet."""

    def close(self) -> None:
        """Take the port away; a second time does nothing."""
        self._close()
        if self._announcement is not None:
            self._announcement.close()

    @abstractmethod
    def _close(self) -> None:
        """Close what the operating system offers."""

    def _announce(self) -> None:
        """Let hosts of this machine find the port under its present name."""
        if self._announcement is None:
            self._announcement = Announcement(self.name, listed=self._listed)
        else:
            self._announcement.move(self.name)

    def end(self) -> None:
        """Let hosts of this machine know that no byte will follow, before the port is closed."""
        if self._announcement is not None:
            self._announcement.over()

    def unplug(self) -> None:
        """Take the port away for a while, as when the cable is pulled."""
        self._close()
        if self._announcement is not None:
            self._announcement.move("")

    def plug_in(self, name: str | None) -> None:
        """Bring the port back, under another ``name`` if one is given.

        Raises:
            InputError: the name cannot be used.
            LinkError: the port cannot come back.

        """
        raise LinkError(f"{self.name}: a port of this kind cannot be plugged in again")

    def take_reset(self) -> bool:
        """Whether the host has raised the control line DTR since the last call."""
        return False

    def baud_rate(self) -> int | None:
        """Bit/s that the host has set; None where the port cannot tell."""
        return None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Link:
    """A symbolic link to a pseudo-terminal.

    A link to a terminal that is no more, such as a killed emulator leaves, is replaced. Anything else is left alone.

    Raises:
        InputError: something else is there, or the link cannot be made.

    """

    def __init__(self, path: Path) -> None:
        if not path.name:
            raise InputError(f"'{path}' is no name for a link; expected the name of a file")
        self.path = path
        self._device = ""
        if not os.path.lexists(path):
            return
        target = self._target()
        if target is None:
            raise InputError(f"{path}: exists and is no symbolic link; expected a free name")
        if not target.startswith("/dev/") or path.exists():
            use = "is in use, perhaps by another emulator" if path.exists() else "no emulator made"
            raise InputError(f"{path}: leads to {target}, which {use}; expected a free name")

    def point_to(self, device: str) -> None:
        """Let the link lead to ``device``; replaces an earlier link in one step."""
        partial = self.path.with_name(f".{self.path.name}.partial-{os.getpid()}")
        try:
            partial.symlink_to(device)
            partial.replace(self.path)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise InputError(f"{self.path}: cannot be linked: {error.strerror}") from error
        self._device = device

    def remove(self) -> None:
        """Take the link away; one that leads elsewhere by now is left alone."""
        if self._device and self._target() == self._device:
            with contextlib.suppress(OSError):
                self.path.unlink()
        self._device = ""

    def _target(self) -> str | None:
        try:
            return os.readlink(self.path)
        except OSError:
            return None


class PtyPort(Port):
    """A pseudo-terminal, which any serial program can open at any baud rate.

    Args:
        link: name of a symbolic link to the pseudo-terminal; None: none.
        listed: whether hosts that look for boards open this port to see who is there.

    Raises:
        InputError: ``link`` is in use, is something else than an emulator's link, or cannot be made; or this system
            has no pseudo-terminals.

    """

    def __init__(self, link: Path | None = None, *, listed: bool = True) -> None:
        require_posix("a pseudo-terminal", "give the board a TCP port (--tcp)")
        self._listed = listed
        self._link = None if link is None else _Link(link)
        self._open()

    def _open(self) -> None:
        self._master, host_end = pty.openpty()
        self._device = os.ttyname(host_end)
        tty.setraw(host_end)
        # From now on the master reports a hang-up whenever no host has the other end open.
        os.close(host_end)
        os.set_blocking(self._master, False)
        self.name = self._device
        if self._link is not None:
            try:
                self._link.point_to(self._device)
            except BaseException:
                os.close(self._master)
                raise
            self.name = str(self._link.path)
        self._announce()

    def host_present(self) -> bool:
        if self._master < 0:
            return False
        poll = select.poll()
        poll.register(self._master, select.POLLHUP)
        return not poll.poll(0)

    def fileno(self) -> int:
        return self._master

    def read(self) -> bytes | None:
        try:
            return os.read(self._master, PIECE)
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
            if error.errno == errno.EIO:
                return 0
            raise LinkError(f"{self.name}: cannot be written: {error.strerror}") from error

    def unread(self) -> int:
        # Only the host's end knows, and while the kernel moves bytes on, of a part of them; 0 means that none is left.
        # Opening that end hides a hang-up, hence for a moment only.
        try:
            host_end = os.open(self._device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError:  # a host that has claimed the terminal for itself (TIOCEXCL)
            return 0
        try:
            # Bytes lie in the kernel's transfer buffer until one of its threads has time, and FIONREAD does not count
            # them there. Polling moves them on. Closing the port too early would lose them: a hang-up discards them.
            poll = select.poll()
            poll.register(host_end, select.POLLIN)
            poll.poll(0)
            return waiting_bytes(host_end)
        finally:
            os.close(host_end)

    def plug_in(self, name: str | None) -> None:
        if name is not None and self._link is not None:
            self._link = _Link(self._link.path.with_name(name))
        self._open()

    def _close(self) -> None:
        if self._link is not None:
            self._link.remove()
        if self._master >= 0:
            os.close(self._master)
            self._master = -1


class _SocketPort(Port):
    """A stream socket with a host at its other end, or none."""

    _host: socket.socket | None = None
    _took_at = 0.0
    """time at which the host took bytes last, or at which nothing waited for it"""

    def host_present(self) -> bool:
        return self._host is not None

    def fileno(self) -> int:
        return -1 if self._host is None else self._host.fileno()

    def read(self) -> bytes | None:
        if self._host is None:
            return None
        try:
            data = self._host.recv(PIECE)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._hang_up()
            return None
        return data

    def write(self, data: bytes) -> int:
        if self._host is None:
            return 0
        try:
            sent = self._host.send(data)
        except OSError:  # full, or broken: what broke shows at the next read
            return 0
        self._took_at = time.monotonic()
        return sent

    def unread(self) -> int:
        return 0 if self._host is None else unacknowledged_bytes(self._host)

    def _close(self) -> None:
        self._hang_up()

    def _hang_up(self) -> None:
        if self._host is not None:
            self._host.close()
            self._host = None


class PairPort(_SocketPort):
    """One end of a socket pair, for a host in the same process, who holds the other end."""

    def __init__(self, name: str = "pair") -> None:
        self.name = name
        self._host, self.host_end = socket.socketpair()
        self._host.setblocking(False)
        self._host.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 16384)


class TcpPort(_SocketPort):
    """A listening TCP socket for one host at a time.

    A second host is hung up on, unless the first one has left bytes unread for :data:`DEAF_S`.

    A host on another machine can tell the regular end of the board from a cable that was pulled and from a program that
    was killed: only the regular end sends a byte of urgent data, which programs that do not ask for it never see, and
    closes the connection in good order (FIN). Everything else resets it (RST), by a linger time of 0 (SO_LINGER), which
    the kernel keeps to also when the program is killed.

    Raises:
        LinkError: nothing can listen there.

    """

    SCHEME = "socket"

    def __init__(self, host: str, port: int) -> None:
        self._is_over = False
        self._listen(host, port)

    def _listen(self, host: str, port: int) -> None:
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._listener: socket.socket | None = socket.create_server((host, port), family=family)
        except (OSError, UnicodeError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise LinkError(f"{host}:{port}: cannot listen there: {reason}") from error
        self._listener.setblocking(False)
        # Like the small buffer of a serial port, so that a slow host is noticed soon. Inherited by connections.
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 16384)
        self._address = self._listener.getsockname()[:2]
        shown = f"[{self._address[0]}]" if ":" in self._address[0] else self._address[0]
        self.name = f"{self.SCHEME}://{shown}:{self._address[1]}"
        self._announce()

    @classmethod
    def at(cls, address: str) -> Self:
        """Listen at HOST:PORT, or :PORT for the loopback; port 0 takes a free one. Raises InputError, LinkError."""
        return cls(*_host_and_port(address))

    def host_present(self) -> bool:
        if self._listener is None:
            return False
        try:
            arrived, _ = self._listener.accept()
        except (BlockingIOError, ConnectionError):
            return self._host is not None
        except OSError as error:  # too many open files: the host is left waiting
            if error.errno in (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM):
                return self._host is not None
            raise LinkError(f"{self.name}: cannot accept a host: {error.strerror}") from error
        if self._host is not None and (time.monotonic() - self._took_at > DEAF_S or has_hung_up(self._host)):
            self._hang_up()
        if self._host is None:
            arrived.setblocking(False)
            arrived.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            arrived.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
            self._took_at = time.monotonic()
            self._host = arrived
            self.hosts += 1
            self._greet()
        else:
            arrived.close()
        return True

    def _greet(self) -> None:
        """A host has come."""

    def end(self) -> None:
        super().end()
        self._is_over = True
        if self._host is not None:
            self._say_over(self._host)
            self._host.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _IN_GOOD_ORDER)

    def _say_over(self, host: socket.socket) -> None:
        """Let the host know, beside the stream, that no byte will follow."""
        with contextlib.suppress(OSError):  # full, or broken
            host.send(END_OF_TRANSMISSION, socket.MSG_OOB)

    def plug_in(self, name: str | None) -> None:
        host, port = self._address
        self._listen(host, port if name is None else _host_and_port(f":{name}")[1])

    def _close(self) -> None:
        # In this order a host that is hung up on, and knocks again, finds nobody.
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        super()._close()

    def _hang_up(self) -> None:
        if self._host is not None and self._is_over:
            # Closing resets a connection on which bytes of the host have come that nobody has read.
            with contextlib.suppress(OSError):
                self._host.shutdown(socket.SHUT_WR)
        super()._hang_up()


class ControlLines:
    """Settings and control lines of the serial port that an RFC 2217 host believes to talk to."""

    def __init__(self) -> None:
        self.baudrate = 9600
        self.bytesize = 8
        self.parity = "N"
        self.stopbits = 1
        self.xonxoff = False
        self.rtscts = False
        self.break_condition = False
        self.cts = self.dsr = self.cd = True
        self.ri = False
        self.rts = False
        self.raised = False
        """DTR has gone from off to on"""
        self._dtr = False

    @property
    def dtr(self) -> bool:
        """Data terminal ready; boards of the Arduino family reset when it is raised."""
        return self._dtr

    @dtr.setter
    def dtr(self, level: bool) -> None:
        self.raised = self.raised or (level and not self._dtr)
        self._dtr = level

    def reset_input_buffer(self) -> None:
        """Nothing waits in a buffer of its own."""

    def reset_output_buffer(self) -> None:
        """Nothing waits in a buffer of its own."""


class Rfc2217Port(TcpPort):
    """A TCP port with Telnet's COM port option (RFC 2217), through which baud rate and control lines are seen."""

    SCHEME = "rfc2217"

    def _greet(self) -> None:
        self.control = ControlLines()
        self._outgoing = bytearray()
        """bytes for the socket, escaped, with the answers of the negotiation among them"""
        self._manager = PortManager(cast("Serial", self.control), cast("Serial", _Connection(self._outgoing)))

    def read(self) -> bytes | None:
        data = super().read()
        if not data:
            self._flush()
            return data
        broken, plain = "", b""
        try:
            plain = b"".join(self._manager.filter(data))
        except (KeyError, ValueError, TypeError, struct.error):
            broken = "a suboption of Telnet that breaks RFC 2217"
        if len(self._manager.suboption or b"") > LONGEST_SUBOPTION:
            broken = f"a suboption of Telnet of more than {LONGEST_SUBOPTION} bytes"
        if not (self._flush() or broken) and len(self._outgoing) > MOST_UNREAD:
            broken = f"it asks and does not read: more than {MOST_UNREAD} bytes of answers wait"
        if not broken:
            return plain
        self.hung_up[broken] = None
        self._hang_up()
        return None

    def write(self, data: bytes) -> int:
        if self._host is None:
            return 0
        if self._outgoing and not self._flush():
            return 0
        taken = data[:PIECE]
        self._outgoing += taken.replace(b"\xff", b"\xff\xff")
        self._flush()
        return len(taken)

    def unread(self) -> int:
        return super().unread() + (len(self._outgoing) if self._host is not None else 0)

    def _say_over(self, host: socket.socket) -> None:
        """As a modem does that is switched off: data set ready (DSR) and carrier detect (CD) go off."""
        self.control.dsr = self.control.cd = False
        self._manager.check_modem_lines()
        self._flush()

    def take_reset(self) -> bool:
        if self._host is None:
            return False
        raised, self.control.raised = self.control.raised, False
        return raised

    def baud_rate(self) -> int | None:
        return None if self._host is None else self.control.baudrate

    def _flush(self) -> bool:
        """Send what waits; whether everything has gone."""
        if self._outgoing:
            del self._outgoing[: super().write(bytes(self._outgoing))]
        return not self._outgoing


class _Connection:
    """What pyserial's :class:`PortManager` writes its answers to."""

    def __init__(self, outgoing: bytearray) -> None:
        self._outgoing = outgoing

    def write(self, data: bytes) -> None:
        self._outgoing += data


def _host_and_port(address: str) -> tuple[str, int]:
    host, colon, port = address.rpartition(":")
    if not colon or not (port.isascii() and port.isdecimal() and len(port) < 6 and int(port) < 65536):
        raise InputError(f"'{address}' is no address; expected HOST:PORT or :PORT with a port up to 65535")
    if host.startswith("[") and host.endswith("]"):  # IPv6
        host = host[1:-1]
    return host or "127.0.0.1", int(port)
