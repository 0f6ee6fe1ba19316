"""What only POSIX systems have (Linux, macOS), in one module: elsewhere its users do without or say what is missing.

No other module imports ``fcntl``, ``grp``, ``pty``, ``pwd``, ``termios`` or ``tty``.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import struct
from collections.abc import Callable, Iterator
from typing import IO, TYPE_CHECKING

from ..errors import InputError

if TYPE_CHECKING:
    import fcntl
    import grp
    import pty
    import pwd
    import termios
    import tty

    POSIX = True
else:
    try:
        import fcntl
        import grp
        import pty
        import pwd
        import termios
        import tty

        POSIX = True
    except ImportError:
        fcntl = grp = pty = pwd = termios = tty = None
        POSIX = False

__all__ = ["ENDING_SIGNALS", "POSIX", "grp", "pty", "pwd", "require_posix", "tty"]

ENDING_SIGNALS: dict[int, str] = {
    int(getattr(signal, name)): said
    for name, said in (("SIGINT", "interrupted"), ("SIGTERM", "terminated"), ("SIGHUP", "hung up"))
    if hasattr(signal, name)
}
"""signals that ask a command to end, and what it then says"""


def require_posix(what: str, instead: str) -> None:
    """Raises InputError where ``what`` cannot be had on this system; ``instead`` says what can."""
    if not POSIX:
        raise InputError(f"{what} needs Linux or macOS; {instead}")


def lock(file: IO[bytes] | int, *, shared: bool = False, wait: bool = False) -> None:
    """Lock an open file until it is closed or unlocked; does nothing where the system has no such locks.

    Raises:
        BlockingIOError: somebody else holds it, and ``wait`` is False.

    """
    if POSIX:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB))


def unlock(file: IO[bytes] | int) -> None:
    """Undo :func:`lock`."""
    if POSIX:
        fcntl.flock(file, fcntl.LOCK_UN)


def take_over(descriptor: int, old: os.stat_result) -> None:
    """Give a new file the mode of an old one, and its owner where this user may set it."""
    if POSIX:
        with contextlib.suppress(PermissionError):
            os.fchown(descriptor, old.st_uid, old.st_gid)
        os.fchmod(descriptor, old.st_mode & 0o7777)


@contextlib.contextmanager
def interrupts_blocked() -> Iterator[None]:
    """SIGINT waits until the end of the block; processes that are started within ignore it."""
    if not POSIX:
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def waiting_bytes(descriptor: int) -> int:
    """Bytes that have come at a terminal or socket and were not read. POSIX only."""
    return int(struct.unpack("i", fcntl.ioctl(descriptor, termios.FIONREAD, struct.pack("i", 0)))[0])


def unacknowledged_bytes(connection: socket.socket) -> int:
    """Bytes that were sent and that the peer has not acknowledged; 0 where the system does not tell."""
    if not hasattr(termios, "TIOCOUTQ"):
        return 0
    return int(struct.unpack("i", fcntl.ioctl(connection, termios.TIOCOUTQ, struct.pack("i", 0)))[0])


def has_hung_up(connection: socket.socket) -> bool:
    """Whether the peer has closed its end: on Linux even if bytes that it sent before are unread."""
    if hasattr(select, "POLLRDHUP"):
        poll = select.poll()
        poll.register(connection, select.POLLRDHUP)
        return bool(poll.poll(0))
    try:
        return connection.recv(1, socket.MSG_PEEK) == b""
    except BlockingIOError:
        return False


def urgent_data(connection: socket.socket) -> Callable[[], bool]:
    """A function that tells whether urgent data have come. select() alone would fail beyond descriptor 1023."""
    if not hasattr(select, "poll"):
        return lambda: bool(select.select([], [], [connection], 0)[2])
    poll = select.poll()
    poll.register(connection, select.POLLPRI)
    return lambda: bool(poll.poll(0))
