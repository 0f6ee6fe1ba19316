"""Rendezvous of emulated boards and their hosts: a directory with one small file for each port of an emulated board.

The operating system lists no pseudo-terminals and no listening sockets as ports, and makes the same hang-up of a board
that has come to its end and of one whose program was killed. The files tell both: which ports there are, and which of
them are over. Boards and hosts meet in ``$OHMSKIN_RUNTIME_DIR``, else in ``$XDG_RUNTIME_DIR/ohmskin``, and where there
is none in ``ohmskin-UID`` of the directory for temporary files, so they must be of one user and one machine. Without
such a directory there are merely no announcements.

A host opens what the files name. So only this user may have written them: the directory must be no link, belong to this
user and let nobody else in (mode 700); each file must be a regular one of this user, too. Anything else is as if it
were not there. A file may name a pseudo-terminal, a serial device, or a socket of the loopback
(:func:`_may_be_announced`). It cannot name a URL of pyserial that writes files, or an ``ohmskin://`` address: those are
for users to type.

A file is locked (flock) as long as its emulator lives. The kernel drops the lock when the emulator dies, however it
dies, so a file that can be locked was left behind. A host keeps the file open and can read it after it was removed.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import socket
import stat
import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

from .checks import is_loopback
from .system import POSIX, lock, unlock

END_OF_TRANSMISSION = b"\x04"
"""what a board over TCP sends as urgent data before it ends: to hosts of other machines, which see no files of this one
(EOT in ASCII)"""
SUFFIX = ".port"
_LONGEST = 4096
"""bytes of a file that are read: a line with the name, and one of the words below or nothing"""
_OVER, _UNLISTED = b"over\n", b"unlisted\n"


class Announcement:
    """The file of one emulated board, from now on until :meth:`close`.

    Args:
        port: name of the port; empty while it is away.
        listed: whether boards that are looked for are looked for there; False: whoever opens the port uses it up.

    """

    def __init__(self, port: str, *, listed: bool = True) -> None:
        self._state = b"" if listed else _UNLISTED
        self._file, self._path = -1, Path()
        for directory in _directories():
            with contextlib.suppress(OSError), _opened(directory, make=True) as folder:
                name = f"{os.getpid()}-{secrets.token_hex(8)}{SUFFIX}"
                options = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
                self._file, self._path = os.open(name, options, 0o600, dir_fd=folder), directory / name
                break
        if self._file >= 0:
            with contextlib.suppress(OSError):
                lock(self._file, wait=True)
            self.move(port)

    def move(self, port: str) -> None:
        """Tell the present name of the port; empty while the port is away.

        A socket that listens at all addresses is announced at the loopback's. Hosts ignore one that listens at another
        address only.
        """
        self._write(_local(port).encode() + b"\n" + self._state)

    def over(self) -> None:
        """Tell that the board has come to its regular end: no byte will follow."""
        if self._file >= 0:
            self._write(_read(self._file).partition(b"\n")[0] + b"\n" + _OVER)

    def close(self) -> None:
        """Take the file away; a second time does nothing."""
        if self._file >= 0:
            with contextlib.suppress(OSError):
                self._path.unlink()
            os.close(self._file)
            self._file = -1

    def _write(self, text: bytes) -> None:
        if self._file >= 0:
            with contextlib.suppress(OSError):  # a full disk
                os.pwrite(self._file, text, 0)
                os.ftruncate(self._file, len(text))


class AnnouncedPort:
    """The announcement of a port as its host sees it. Stays readable until :meth:`close`, or as long as this lives."""

    def __init__(self, file: int) -> None:
        self._file = file
        self.close = weakref.finalize(self, os.close, file)
        """gives the file back; a second time does nothing"""

    @property
    def name(self) -> str:
        """The present name of the port; empty while the port is away, and where no such name may be announced."""
        name = self._content()[0].decode(errors="replace")
        return name if _may_be_announced(name) else ""

    @property
    def is_over(self) -> bool:
        """Whether the board has come to its regular end. False as well if its program was stopped or killed."""
        return self._state() == _OVER

    @property
    def is_listed(self) -> bool:
        """Whether there is a board now that may be opened to see who it is."""
        return bool(self.name) and self._state() == b""

    def _state(self) -> bytes:
        return self._content()[2]

    def _content(self) -> tuple[bytes, bytes, bytes]:
        return (_read(self._file) if self.close.alive else b"").partition(b"\n")

    def is_at(self, port: str) -> bool:
        """Whether ``port`` is another way to write the name of this port."""
        return _same_place(self.name, port)


def announced_ports() -> Iterator[AnnouncedPort]:
    """The ports of the emulated boards that are there now; files of emulators that have died are removed."""
    for directory in _directories():
        with contextlib.suppress(OSError), _opened(directory) as folder:
            for name in sorted(name for name in os.listdir(folder) if name.endswith(SUFFIX)):
                with contextlib.suppress(OSError):
                    file = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=folder)
                    port = AnnouncedPort(file)
                    if not _is_own(os.fstat(file)):
                        continue
                    if _is_left_behind(file):
                        os.unlink(name, dir_fd=folder)
                    elif port.name and not port.is_over:
                        yield port


def announced(port: str) -> AnnouncedPort | None:
    """The announcement of the port with this name; None where it is not that of an emulated board of this machine."""
    return next((one for one in announced_ports() if one.is_at(port)), None)


def _directories() -> list[Path]:
    """Where announcements may be: a board takes the first one that it can, a host looks into all of them.

    A program that no login has started, such as a service, may be without ``XDG_RUNTIME_DIR``.
    """
    if not POSIX:
        return []
    if given := os.environ.get("OHMSKIN_RUNTIME_DIR"):
        return [Path(given)]
    of_login = os.environ.get("XDG_RUNTIME_DIR", "")
    usual = Path(tempfile.gettempdir()) / f"ohmskin-{os.getuid()}"
    # A program that was started by `sudo` may have the directory of another user's login.
    is_own = os.path.isdir(of_login) and os.stat(of_login).st_uid == os.getuid()
    return [Path(of_login) / "ohmskin", usual] if is_own else [usual]


@contextlib.contextmanager
def _opened(directory: Path, *, make: bool = False) -> Iterator[int]:
    """Descriptor of a directory that is this user's alone; OSError where there is none."""
    if make:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    folder = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        status = os.fstat(folder)
        if status.st_uid != os.getuid() or status.st_mode & 0o077:
            raise PermissionError(f"{directory} is open to others")
        yield folder
    finally:
        os.close(folder)


def _is_own(status: os.stat_result) -> bool:
    return stat.S_ISREG(status.st_mode) and status.st_uid == os.getuid()


def _may_be_announced(name: str) -> bool:
    """Whether ``name`` is a pseudo-terminal or a serial device, perhaps by a link, or a socket of the loopback."""
    if not name.isprintable():
        return False
    if "://" not in name:
        return os.path.isabs(name) and re.fullmatch(r"/dev/(pts/[0-9]+|tty\w+)", os.path.realpath(name)) is not None
    found = re.fullmatch(r"(?:socket|rfc2217)://(?:([0-9.]+)|\[([0-9a-f:]+)\]):[0-9]{1,5}", name)
    return found is not None and is_loopback(found[1] or found[2])


def _is_left_behind(file: int) -> bool:
    """Whether the emulator that wrote this file is no more."""
    try:
        lock(file, shared=True)
    except BlockingIOError:
        return False
    # Between its making and its locking, too, a file can be locked. It is empty then, as long as this lock holds.
    size = os.fstat(file).st_size
    unlock(file)
    return size > 0


def _read(file: int) -> bytes:
    return os.pread(file, _LONGEST, 0)


def _same_place(one: str, other: str) -> bool:
    """Whether two names are of the same pseudo-terminal, or of the same socket of this machine."""
    if "://" not in one and "://" not in other:
        return os.path.realpath(one) == os.path.realpath(other)
    try:
        here, there = urlsplit(_local(one)), urlsplit(_local(other))
        if here.scheme != there.scheme or here.port != there.port or not (here.hostname and there.hostname):
            return False
        return here.hostname == there.hostname or socket.gethostbyname(there.hostname) == here.hostname
    except (OSError, ValueError):
        return False


def _local(name: str) -> str:
    """A name that holds in every folder; for a socket that listens at all addresses, the loopback's."""
    if name and "://" not in name:
        return os.path.abspath(name)
    return name.replace("://0.0.0.0:", "://127.0.0.1:").replace("://[::]:", "://[::1]:")
