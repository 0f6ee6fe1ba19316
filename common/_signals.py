"""What SIGINT, SIGTERM and SIGHUP do during the three phases of a command: start, work, exit.

While modules are loaded and while the interpreter shuts down, an exception could surface in code that cannot handle it,
and Python would print a traceback. A signal then ends the process at once. During the work it raises
:class:`Interrupted`, so that partial files are removed and worker processes end.
"""

from __future__ import annotations

import _thread
import os
import signal
import sys
from types import FrameType
from typing import Any

NAMES = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated", signal.SIGHUP: "hung up"}
_mine = False
"""whether this process belongs to the command line; a program that calls ``cli.run`` keeps its own handlers"""


class Interrupted(KeyboardInterrupt):
    """A signal asked the command to end."""

    def __init__(self, signal_number: int) -> None:
        super().__init__()
        self.signal_number = signal_number


def leave_at_once() -> None:
    """Take charge of this process's signals: the phase of the start."""
    global _mine  # noqa: PLW0603  # signals belong to the process, too
    _mine = True
    signal.signal(signal.SIGINT, _leave)
    sys.unraisablehook = _raise_again


def raise_from_now_on() -> None:
    """The phase of the work."""
    if not _mine:
        return
    for number in NAMES:
        # A program that was started to ignore a signal (nohup) goes on ignoring it.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _raise)


def leave_from_now_on(code: int) -> None:
    """The phase of the exit: the work is done, and ``code`` is its outcome."""

    def leave(number: int, frame: FrameType | None) -> None:
        os._exit(code)

    for number in NAMES:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, leave)


def _leave(number: int, frame: FrameType | None) -> None:
    os.write(2, b"ohmskin: interrupted\n")
    os._exit(128 + number)


def _raise(number: int, frame: FrameType | None) -> None:
    raise Interrupted(number)


def _raise_again(unraisable: Any) -> None:
    """An interrupt that hit a destructor or a callback, where Python cannot raise it, is sent once more."""
    if issubclass(unraisable.exc_type, KeyboardInterrupt):
        _thread.interrupt_main(getattr(unraisable.exc_value, "signal_number", signal.SIGINT))
    else:
        sys.__unraisablehook__(unraisable)
