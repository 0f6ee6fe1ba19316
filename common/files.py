"""Files: input read up to a limit, output replaced atomically.

Output goes to a partial file in the same folder, which is renamed over the old file when all of it is written. Whoever
reads the path meets the old file or the new one, never a part. A path that is no regular file (a pipe, a device, a
descriptor of this process such as ``/dev/stdout``) cannot be replaced and is written through.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import BinaryIO

from ..errors import InputError, OhmskinError
from .checks import path_text
from .system import POSIX, lock, take_over

MOST_BYTES = 16 * 2**20
"""size limit of a configuration file: 1024 x 1024 calibrated cells fit"""

_numbers = itertools.count()


def of_board(path: str | Path, board: int) -> Path:
    """Name of the file of one board among several, numbered from 0: of ``skin.mcap`` it is ``skin-1.mcap`` first."""
    path = Path(path)
    return path.with_name(f"{path.stem}-{board + 1}{path.suffix}")


def read_bytes(path: str | Path, *, most_bytes: int = MOST_BYTES) -> bytes:
    """The content of a file, pipe or device.

    Raises:
        InputError: the file cannot be read, or holds more than ``most_bytes`` (a device may be endless).

    """
    with _errors_name(path, "read"), open(path, "rb") as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise InputError(f"{path}: larger than {size(most_bytes)}, the limit for this kind of file")
    return content


@contextmanager
def reading(path: str | Path) -> Iterator[BinaryIO]:
    """A file that is open for reading; what the operating system says meanwhile is an InputError."""
    with _errors_name(path, "read"), open(path, "rb") as file:
        yield file


def read_text(path: str | Path, *, most_bytes: int = MOST_BYTES) -> str:
    """The content of a UTF-8 text file; a byte order mark at its head is dropped. Raises InputError."""
    try:
        return read_bytes(path, most_bytes=most_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: cannot be read: {error}") from error


def read_lines(path: str | Path, *, most_bytes: int, longest_line: int) -> Iterator[str]:
    """The lines of a UTF-8 text file, one at a time, each with its line end.

    Raises:
        InputError: the file cannot be read, is larger than ``most_bytes``, or has a line of more than ``longest_line``
            bytes.

    """
    total = 0
    with _errors_name(path, "read"), open(path, "rb") as file:
        for number in itertools.count(1):
            line = file.readline(longest_line + 1)
            if not line:
                return
            total += len(line)
            if total > most_bytes:
                raise InputError(f"{path}: larger than {size(most_bytes)}, the limit for this kind of file")
            if len(line) > longest_line:
                raise InputError(f"{path}: line {number}: longer than {size(longest_line)}; is this a text file?")
            try:
                yield line.decode("utf-8-sig" if number == 1 else "utf-8")
            except UnicodeDecodeError as error:
                raise InputError(f"{path}: line {number}: cannot be read: {error}") from error


@contextmanager
def whole_file(path: str | Path) -> Iterator[BinaryIO]:
    """A binary file to write to, which replaces ``path`` when the block ends well and vanishes when it does not.

    A symbolic link is followed. An existing file keeps its mode, and its owner where this user may set it. What is no
    regular file is written through.

    Raises:
        InputError: the file cannot be written there.

    """
    output = Output(path)
    try:
        with output.errors():
            output.open()
            yield output.file
            output.finish()
        output.replace()
    finally:
        output.discard()


def write_together(contents: Mapping[str | Path, bytes | None]) -> None:
    """Write several files that belong together; none is replaced before the last is on the disk.

    Args:
        contents: path -> bytes. None removes a file, so that an old one does not lie beside new ones.

    Raises:
        InputError: one of them cannot be written; the others are then as they were, unless a rename failed.

    """
    with ExitStack() as stack:
        outputs = []
        for path, data in contents.items():
            if data is None:
                continue
            output = Output(path)
            stack.callback(output.discard)
            with output.errors():
                output.open()
                output.file.write(data)
                output.finish()
            outputs.append(output)
        for output in outputs:
            output.replace()
    for path, data in contents.items():
        if data is None:
            with _errors_name(path, "removed"):
                Path(path).unlink(missing_ok=True)


def check_writable(*paths: str | Path) -> None:
    """Find out before a long computation whether its results can be written to ``paths``.

    Raises:
        InputError: a path is a folder, its folder is missing, or this user may not write there.

    """
    for path in paths:
        output = Output(path)
        try:
            with output.errors():
                output.open(probe=True)
        finally:
            output.discard()


def make_folder(path: str | Path) -> Path:
    """The folder ``path``, made with its parents if it is not there. Raises InputError."""
    with _errors_name(path, "made"):
        Path(path).mkdir(parents=True, exist_ok=True)
    return Path(path)


def user_cache(name: str) -> Path | None:
    """The folder ``name`` in this user's cache, which no one else writes to; None where it cannot be made."""
    try:
        base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or Path.home() / ".cache"
        folder = Path(base) / "ohmskin" / name
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except (OSError, RuntimeError):
        return None
    return folder


def size(count: int) -> str:
    """A number of bytes for people: ``16 MiB``."""
    for unit in ("bytes", "KiB", "MiB"):
        if count < 1024:
            return f"{count} {unit}"
        count //= 1024
    return f"{count} GiB"


def claim(file: BinaryIO) -> None:
    """Mark an open file as being written until it is closed, for :func:`is_claimed`, where the system can."""
    with contextlib.suppress(OSError):
        lock(file)


def is_claimed(path: Path) -> bool:
    """Whether somebody, in this process or in another one, writes a file that was marked by :func:`claim`."""
    if path.is_file():
        with contextlib.suppress(OSError), path.open("rb") as file:
            try:
                lock(file, shared=True)
            except BlockingIOError:
                return True
    return False


@contextmanager
def one_at_a_time(folder: Path) -> Iterator[None]:
    """Wait until no other thread or process is in such a block for this folder, where the system has such marks."""
    with ExitStack() as stack:
        if POSIX:
            with contextlib.suppress(OSError):
                descriptor = os.open(folder, os.O_RDONLY)
                stack.callback(os.close, descriptor)
                lock(descriptor, wait=True)
        yield


def forget(file: BinaryIO) -> None:
    """In a forked process: send what the buffer of the parent's file holds nowhere, since the parent writes it."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, file.fileno(), inheritable=False)
    os.close(nowhere)


class Output:
    """One file on its way to ``path``: opened, filled, finished and put in place of the old one, in either order."""

    file: BinaryIO

    def __init__(self, path: str | Path) -> None:
        self._path = path
        self._target = Path()
        self._partial: Path | None = None
        self._opened = False

    def open(self, *, probe: bool = False) -> None:
        """Open the partial file, or what is written through; a probe leaves the latter alone."""
        descriptor = _own_descriptor(self._path)
        self._target = Path(os.path.realpath(self._path))
        if self._target.is_dir():
            raise IsADirectoryError(0, "is a directory")
        if descriptor is not None:
            # Opening /dev/stdout anew would begin at the head of the file behind it, and O_TRUNC would empty that file.
            self._use(os.fdopen(os.dup(descriptor), "wb"))
        elif self._target.exists() and not self._target.is_file():
            if not probe:
                self._use(self._target.open("wb"))
        else:
            self._use(self._open_partial())

    def _use(self, file: BinaryIO) -> None:
        self.file = file
        self._opened = True

    def _open_partial(self) -> BinaryIO:
        old = os.stat(self._target) if self._target.exists() else None
        if old is not None and not os.access(self._target, os.W_OK):
            raise PermissionError(0, "Permission denied")
        name = f".{self._target.name[:40]}.partial-{os.getpid()}-{next(_numbers)}"
        partial = self._target.with_name(name)
        descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
        self._partial = partial
        if old is not None:
            take_over(descriptor, old)
        return os.fdopen(descriptor, "wb")

    @property
    def is_new(self) -> bool:
        """Whether :meth:`replace` would put a new file in its place; False for what is written through."""
        return self._partial is not None

    def finish(self) -> None:
        """Everything written; what the disk cannot hold is found here."""
        self.file.close()

    def replace(self) -> None:
        """Put the file in the place of the old one."""
        if self._partial is not None:
            with self.errors():
                os.replace(self._partial, self._target)
            self._partial = None

    def discard(self) -> None:
        """Remove what has not replaced anything."""
        if self._opened:
            with contextlib.suppress(OSError):
                self.file.close()
        if self._partial is not None:
            with contextlib.suppress(OSError):
                self._partial.unlink()

    @contextmanager
    def errors(self) -> Iterator[None]:
        """An operating system's error in the block as an InputError that names the file."""
        with _errors_name(self._path, "written"):
            yield


def _own_descriptor(path: str | Path) -> int | None:
    """The number of the descriptor of this process that ``path`` stands for (``/dev/stdout``, ``/dev/fd/3``)."""
    step = os.fspath(path)
    for _ in range(40):  # the kernel's own limit for links in a row
        folder, name = os.path.split(step)
        if re.fullmatch(rf"/proc/{os.getpid()}(/task/\d+)?/fd", os.path.realpath(folder)) and name.isdecimal():
            for stream in (sys.stdout, sys.stderr):
                stream.flush()  # what was printed before comes first
            return int(name)
        if not os.path.islink(step):
            return None
        step = os.path.join(folder, os.readlink(step))
    return None


@contextmanager
def _errors_name(path: str | Path, done: str) -> Iterator[None]:
    """An operating system's error as an InputError that names ``path``. A number is no path but an open descriptor."""
    path_text("path", path)
    try:
        yield
    except OhmskinError:  # some are OSErrors, too
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be {done}: {error.strerror or error}") from error
    except ValueError as error:
        if "null byte" not in str(error):
            raise
        raise InputError(f"{path}: cannot be {done}: a file name has no NUL character") from error
