"""Serial ports and TCP sockets as byte streams. Only this module and :mod:`._port_names` use pyserial.

Waiting uses :mod:`selectors` on file descriptors: ``select()``, which pyserial uses, fails beyond descriptor 1023.
"""

from __future__ import annotations

import contextlib
import errno
import os
import queue
import selectors
import socket
import threading
import time
from abc import abstractmethod
from typing import NamedTuple, Protocol
from urllib.parse import urlsplit

import serial

from ..common.rendezvous import END_OF_TRANSMISSION, announced
from ..common.system import POSIX, urgent_data
from ..errors import LinkEnded, LinkError
from ._port_names import EMULATED_HERE, reason_of, refuse_terminal, why_not_opened
from ._tuning import ANSWER_S, GONE_S, NEGOTIATION_S, READ_BYTES, URL_WAIT_S, WRITE_TIMEOUT_S

BAUDRATE = 1_000_000
"""for a real UART; USB, pseudo-terminals and TCP ignore it"""
_SHORT = 1024
"""bytes below which one system call has returned everything: terminals return up to 4095 at once, sockets more"""
_EMULATOR = "ohmskin.emulator"
"""package with pyserial's handler of ohmskin:// addresses; imported only for such an address"""
_NOT_NOW = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EINTR)
_HUNG_UP = (errno.EPIPE, errno.ECONNRESET, errno.EIO, errno.ENXIO, errno.ENODEV)


class Arrival(NamedTuple):
    """Bytes, and the time at which the host took them from the operating system."""

    data: bytes
    """empty if nothing had come"""
    received_at: float
    """s on the monotonic clock of the port (:meth:`BytePort.now`)"""
    wall_time: float
    """s since the epoch at the same moment"""
    more: bool = True
    """more bytes may have come; False: reading again at once would bring nothing"""


class BytePort(Protocol):
    """A byte stream with arrival times: the interface that a :class:`~ohmskin.driver.Skin` needs of a port.

    A recording can provide it: ``read`` then returns the recorded arrivals, and ``now`` runs with the recording. A port
    whose board's time is a simulation's, at whatever pace, says so by an attribute ``is_simulated``, which is True.
    """

    name: str

    def wait(self, timeout_s: float) -> bool:
        """Wait until bytes have come or the port is gone; False after ``timeout_s`` or after :meth:`interrupt`."""
        ...

    def read(self) -> Arrival:
        """Take the bytes that have come, without waiting.

        Raises:
            LinkEnded: the stream has come to its regular end.
            LinkError: the port is gone.

        """
        ...

    def write(self, data: bytes) -> None:
        """Send all of ``data``; LinkError if that fails."""
        ...

    def interrupt(self) -> None:
        """End a :meth:`wait` that another thread is in."""
        ...

    def now(self) -> float:
        """Present time in s, on the clock of :attr:`Arrival.received_at`."""
        ...

    def close(self) -> None:
        """Release the port; a second call does nothing."""
        ...


def open_port(
    name: str, *, baudrate: int = BAUDRATE, dtr: bool | None = None, rts: bool | None = None
) -> SerialPort | SocketPort | UrlPort:
    """Open a serial device, a pseudo-terminal, ``socket://HOST:PORT`` or another URL that pyserial knows.

    While a serial device is open here, nobody else can open it.

    Args:
        name: of the port.
        baudrate: of the UART, if there is one.
        dtr: level of the control line DTR from the moment of opening; None: the driver's default.
        rts: level of the control line RTS, likewise.

    Raises:
        LinkError: the port does not exist, may not be used, is in use, or is no serial port. The message says which.

    """
    if name.startswith("socket://"):
        return SocketPort(name)
    device = _open_serial(name, baudrate, dtr, rts)
    try:
        return UrlPort(name, device) if _by_pyserial(name) else SerialPort(name, device)
    except OSError as error:  # too many open files
        device.close()
        raise LinkError(f"{name}: cannot be opened: {reason_of(error)}") from error


class _RealTimePort:
    """Common part of all live ports: the machine's time, and the error for a lost port."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.announced = announced(name)
        """announcement of an emulated board's port on this machine; None: the port is another one"""
        self.is_simulated = self.announced is not None or name.startswith(EMULATED_HERE)

    def now(self) -> float:
        """Present time in s on the machine's monotonic clock."""
        return time.monotonic()

    def close(self) -> None:
        """Release the port; a second call does nothing. Not while another thread waits, reads or writes."""
        self._close()
        if self.announced is not None:
            self.announced.close()

    @abstractmethod
    def _close(self) -> None:
        """Close the resources of the operating system."""

    def _arrived(self, data: bytes, *, more: bool = True) -> Arrival:
        return Arrival(data, time.monotonic(), time.time(), more)

    def _gone(self, error: Exception | str) -> LinkError:
        if self.announced is not None and self.announced.is_over:
            return over(self.name)
        reason = error if isinstance(error, str) else reason_of(error)
        return LinkError(f"{self.name}: the board has gone away ({reason})")


class DescriptorPort(_RealTimePort):
    """A port with a non-blocking descriptor that a selector can wait for."""

    def __init__(self, name: str, descriptor: int) -> None:
        super().__init__(name)
        self._descriptor = descriptor
        self._wake_read, self._wake_write = socket.socketpair()
        self._wake_write.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._wake_read, selectors.EVENT_READ)
        self._selector.register(descriptor, selectors.EVENT_READ)
        self._readable = selectors.DefaultSelector()
        self._readable.register(descriptor, selectors.EVENT_READ)
        self._closed = False
        self._closing = threading.Lock()
        self._failure: OSError | None = None
        """how the port broke. The operating system reports this once, and afterwards that the other end hung up"""

    def wait(self, timeout_s: float) -> bool:
        """Wait until bytes have come or the port is gone; False after ``timeout_s`` or after :meth:`interrupt`."""
        ready = {key.fd for key, _ in self._selector.select(max(timeout_s, 0.0))}
        if self._wake_read.fileno() in ready:
            self._wake_read.recv(READ_BYTES)
        return self._descriptor in ready

    def read(self) -> Arrival:
        """Take the bytes that have come, without waiting; LinkError when the port is gone."""
        try:
            data = self._take()
            # A terminal reads nothing when nothing has come. Any port reads nothing when the other end has hung up, but
            # then select() reports the port as readable.
            if not data and self._readable.select(0):
                data = self._take()
                if not data:
                    raise self._gone("the other end hung up" if self._failure is None else self._failure)
        except OSError as error:
            if isinstance(error, LinkError):
                raise
            if error.errno in _NOT_NOW:
                return self._arrived(b"")
            self._failure = error
            raise self._gone(error) from error
        return self._arrived(data, more=len(data) >= _SHORT)

    def write(self, data: bytes) -> None:
        """Send all of ``data``; LinkError when that fails."""
        rest = memoryview(data)
        deadline = time.monotonic() + WRITE_TIMEOUT_S
        while rest:
            try:
                rest = rest[self._send(rest) :]
            except OSError as error:
                if error.errno in _HUNG_UP:
                    if error.errno != errno.EPIPE:  # it reports a break that is known already, or no break
                        self._failure = error
                    raise self._gone(error) from error
                if error.errno not in _NOT_NOW:
                    raise LinkError(f"{self.name}: the board takes no commands ({reason_of(error)})") from error
                if time.monotonic() > deadline:
                    raise LinkError(f"{self.name}: the board takes no commands (the line is full)") from error
                self._wait_writable(deadline)

    def _wait_writable(self, deadline: float) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._descriptor, selectors.EVENT_WRITE)
            selector.select(max(deadline - time.monotonic(), 0.0))

    def interrupt(self) -> None:
        """End a :meth:`wait` that another thread is in."""
        with self._closing, contextlib.suppress(BlockingIOError):
            if not self._closed:
                self._wake_write.send(b"!")

    def _close(self) -> None:
        with self._closing:
            if self._closed:
                return
            self._closed = True
            self._selector.close()
            self._readable.close()
            self._wake_read.close()
            self._wake_write.close()
            self._release()

    def _take(self) -> bytes:
        return os.read(self._descriptor, READ_BYTES)

    def _send(self, data: memoryview) -> int:
        return os.write(self._descriptor, data)

    @abstractmethod
    def _release(self) -> None:
        """Close the object that owns the descriptor."""


class SerialPort(DescriptorPort):
    """A serial device or a pseudo-terminal, opened and configured by pyserial."""

    def __init__(self, name: str, device: serial.SerialBase) -> None:
        self._device = device
        super().__init__(name, device.fileno())

    def _release(self) -> None:
        self._device.close()


class SocketPort(DescriptorPort):
    """A TCP connection to ``socket://HOST:PORT``, without the pauses of pyserial's own implementation.

    Raises:
        LinkError: the name is no such address, or nobody answers at the address.

    """

    def __init__(self, name: str) -> None:
        try:
            address = urlsplit(name)
            if not address.hostname or address.port is None:
                raise ValueError("expected socket://HOST:PORT")
            self._socket = socket.create_connection((address.hostname, address.port), timeout=ANSWER_S)
        except (OSError, ValueError) as error:
            raise LinkError(f"{name}: cannot be opened: {reason_of(error)}") from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        _end_when_unheard(self._socket)
        self._socket.setblocking(False)
        self._has_urgent = urgent_data(self._socket)
        self._is_over = False
        """whether the emulated board at the other end has announced that no byte will follow"""
        try:
            super().__init__(name, self._socket.fileno())
        except OSError as error:  # too many open files
            self._socket.close()
            raise LinkError(f"{name}: cannot be opened: {reason_of(error)}") from error

    def read(self) -> Arrival:
        """Take the bytes that have come, without waiting; LinkError when the port is gone."""
        if self._has_urgent():  # the kernel drops urgent data when the bytes behind them are read
            with contextlib.suppress(OSError):
                self._is_over = self._socket.recv(1, socket.MSG_OOB) == END_OF_TRANSMISSION or self._is_over
        return super().read()

    def _take(self) -> bytes:
        return self._socket.recv(READ_BYTES)

    def _send(self, data: memoryview) -> int:
        return self._socket.send(data)

    def _gone(self, error: Exception | str) -> LinkError:
        return over(self.name) if self._is_over else super()._gone(error)

    def _release(self) -> None:
        self._socket.close()


class UrlPort(_RealTimePort):
    """A port that pyserial reads by its own method: ``rfc2217://HOST:PORT``, or a serial port of Windows."""

    def __init__(self, name: str, device: serial.SerialBase) -> None:
        super().__init__(name)
        self._device = device
        connection = getattr(device, "_socket", None)  # pyserial offers no limit of its own
        if isinstance(connection, socket.socket) and connection.family in (socket.AF_INET, socket.AF_INET6):
            _end_when_unheard(connection)
        self._waiting = b""
        self._reading = threading.Lock()
        """held by the thread that takes bytes: a second thread would get later bytes before earlier ones"""

    def wait(self, timeout_s: float) -> bool:
        """Wait until bytes have come or the port is gone; False after 0.1 s, or at once without a ``timeout_s``."""
        with self._reading:
            if not self._waiting and timeout_s > 0:
                self._waiting = self._read_device(1)
            return bool(self._waiting)

    def read(self) -> Arrival:
        """Take the bytes that have come, without waiting; LinkError when the port is gone.

        While another thread waits there is nothing to take, since that thread takes the next byte.
        """
        if not self._reading.acquire(blocking=False):
            return self._arrived(b"")
        try:
            first, self._waiting = self._waiting, b""
            return self._arrived(first + self._read_device(None))
        finally:
            self._reading.release()

    def _read_device(self, size: int | None) -> bytes:
        """Wait for so many bytes, for at most 0.1 s; None: take the bytes that are there."""
        try:
            if size is None:
                queued = _queued_bytes(self._device)
                if queued:
                    return queued
                size = min(self._device.in_waiting, READ_BYTES)  # type: ignore[attr-defined]  # the stubs lack it
            return bytes(self._device.read(size)) if size else b""
        except BlockingIOError:  # another thread has taken the bytes
            return b""
        except (serial.SerialException, OSError, TypeError, AttributeError) as error:
            # If another thread closes the port, pyserial raises TypeError or AttributeError.
            raise self._gone(error) from error

    def write(self, data: bytes) -> None:
        """Send all of ``data``; LinkError when that fails."""
        try:
            self._device.write(data)
        except (serial.SerialException, OSError) as error:
            raise LinkError(f"{self.name}: the board takes no commands ({reason_of(error)})") from error

    def interrupt(self) -> None:
        """Does nothing: a wait ends by itself within 0.1 s."""

    def _close(self) -> None:
        self._device.close()


def _queued_bytes(device: serial.SerialBase) -> bytes:
    """Take bytes that pyserial's thread for RFC 2217 has queued; empty for other devices.

    pyserial's own ``read`` takes a lock for each byte, for which both threads compete. If other programs use the
    processor, a frame then takes a second.
    """
    waiting = getattr(device, "_read_buffer", None)
    if not isinstance(waiting, queue.Queue):
        return b""
    with waiting.mutex:
        count = waiting.queue.index(None) if None in waiting.queue else len(waiting.queue)  # None: the connection's end
        return b"".join(waiting.queue.popleft() for _ in range(min(count, READ_BYTES)))


def _end_when_unheard(connection: socket.socket) -> None:
    """Break a TCP connection after :data:`GONE_S` without an acknowledgement (Linux)."""
    if hasattr(socket, "TCP_USER_TIMEOUT"):
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(1e3 * GONE_S))


def over(name: str) -> LinkEnded:
    """The error for a port whose emulated board has come to its regular end."""
    return LinkEnded(f"{name}: the emulated board has come to the end of its time")


def _patient(name: str) -> str:
    """The name of a port, with more time for Telnet's negotiation than pyserial's 3 s: either end may be starved."""
    if not name.startswith("rfc2217://") or "timeout=" in name:
        return name
    return f"{name}{'&' if '?' in name else '?'}timeout={NEGOTIATION_S:g}"


def _by_pyserial(name: str) -> bool:
    """Whether bytes are read by pyserial's own method: of addresses, and of devices that have no descriptor."""
    return "://" in name or not POSIX


def _open_serial(name: str, baudrate: int, dtr: bool | None, rts: bool | None) -> serial.SerialBase:
    refuse_terminal(name)
    if name.startswith(EMULATED_HERE) and _EMULATOR not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append(_EMULATOR)
    # pyserial's RFC 2217 client refuses a write timeout, and each change of a timeout is an exchange with the server.
    write_timeout_s = None if name.startswith("rfc2217://") else WRITE_TIMEOUT_S
    timeout_s = URL_WAIT_S if _by_pyserial(name) else 0.0
    try:
        device = serial.serial_for_url(
            _patient(name), baudrate, timeout=timeout_s, write_timeout=write_timeout_s, do_not_open=True
        )
        device.exclusive = True
        if dtr is not None:
            device.dtr = dtr
        if rts is not None:
            device.rts = rts
        device.open()
    except (serial.SerialException, NotImplementedError, ValueError, OSError) as error:
        raise LinkError(f"{name}: {why_not_opened(name, error)}") from error
    # FTDI converters hold bytes back for 16 ms unless set otherwise. Other devices do not have this setting.
    with contextlib.suppress(Exception):
        device.set_low_latency_mode(True)
    return device
