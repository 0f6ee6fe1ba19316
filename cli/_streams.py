"""The standard streams of the command: a closed or broken one changes no exit code but that of its own content."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedWriter, FileIO, TextIOWrapper
from typing import Any


class OutputError(OSError):
    """Standard output cannot be written; told apart from the errors of other files and of sockets."""


class _Output(FileIO):
    """Descriptor 1, whose errors say so."""

    is_extra = False
    """whether what is printed is in files as well, so that an output that breaks is no error"""

    def write(self, data: Any) -> Any:
        try:
            return super().write(data)
        except OSError as error:
            if self.is_extra:
                return len(memoryview(data).cast("B"))
            raise OutputError(*error.args) from error


class _Messages(FileIO):
    """Descriptor 2. Messages that nobody can read are lost, and nothing else is."""

    def write(self, data: Any) -> Any:
        try:
            return super().write(data)
        except OSError:
            return len(memoryview(data).cast("B"))


def set_up() -> None:
    """Take charge of the standard streams. Those that are closed lead nowhere from now on.

    A file that is opened later would otherwise get the number of a closed stream, and whatever is said there.
    """
    for number, mode in ((0, os.O_RDONLY), (1, os.O_WRONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, mode)  # the lowest number that is free
    if sys.stdin is None:
        sys.stdin = open(os.devnull)  # noqa: SIM115  # as long as the process lives
    sys.stdout = _text(_Output, 1, sys.stdout)
    sys.stderr = _text(_Messages, 2, sys.stderr)


def _text(kind: type[FileIO], number: int, present: Any) -> Any:
    """The stream in place of the present one; text that does not fit the terminal's encoding is escaped."""
    if present is None:
        return open(os.devnull, "w")
    if not isinstance(present, TextIOWrapper):  # a program has put another one there
        return present
    raw = kind(present.fileno(), "wb", closefd=False)
    by_line = number == 2 or present.isatty()
    return TextIOWrapper(BufferedWriter(raw), present.encoding, "backslashreplace", line_buffering=by_line)


@contextmanager
def extra_output() -> Iterator[None]:
    """What is printed in the block is in files as well: a standard output that breaks loses it, and nothing else."""
    raw = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
    if not isinstance(raw, _Output):
        yield
        return
    raw.is_extra = True
    try:
        yield
        sys.stdout.flush()
    finally:
        raw.is_extra = False
