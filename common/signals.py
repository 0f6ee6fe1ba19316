"""What SIGINT, SIGTERM and SIGHUP do during the three phases of a command: start, work, exit.

While modules are loaded and while the interpreter shuts down, an exception could surface in code that cannot handle it,
and Python would print a traceback. A signal then ends the process at once. During the work it raises
:class:`Interrupted`, so that partial files are removed and worker processes end.

Python can drop such an exception: those that surface in destructors, weak-reference callbacks and callbacks from C are
reported and forgotten, and foreign code may swallow any. An :class:`Interrupted` that is destroyed before
:func:`number_of` has seen it therefore sends its signal again, after a delay, by SIGALRM. Sending it at once would
raise the next one within the same destructor.
"""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType
from typing import Any

from .system import ENDING_SIGNALS, POSIX

_AGAIN_S = 0.02
"""until a lost signal is sent again: most destructors and callbacks have returned by then"""
_mine = False
"""whether this process belongs to the command line; a program that calls ``cli.run`` keeps its own handlers"""
_lost: int = signal.SIGINT
"""the signal that SIGALRM stands for"""


class Interrupted(KeyboardInterrupt):
    """A signal asked the command to end."""

    def __init__(self, signal_number: int) -> None:
        super().__init__()
        self.signal_number = signal_number
        self.arrived = False
        """whether :func:`number_of` has seen it"""

    def __del__(self) -> None:
        global _lost  # noqa: PLW0603  # signals belong to the process, too
        if POSIX and not self.arrived and not sys.is_finalizing():
            _lost = self.signal_number
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)


def number_of(error: BaseException) -> int:
    """The signal that ended the work with this error, which may have taken the place of an :class:`Interrupted`."""
    found: int = signal.SIGINT
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, Interrupted):
            cause.arrived, found = True, cause.signal_number
        cause = cause.__context__
    return found


def leave_at_once() -> None:
    """Take charge of this process's signals: the phase of the start."""
    global _mine  # noqa: PLW0603  # signals belong to the process, too
    _mine = True
    signal.signal(signal.SIGINT, _leave)


def raise_from_now_on() -> None:
    """The phase of the work."""
    if not _mine:
        return
    sys.unraisablehook = _report_others
    if POSIX:
        signal.signal(signal.SIGALRM, lambda number, frame: _raise(_lost, frame))
    for number in ENDING_SIGNALS:
        # A program that was started to ignore a signal (nohup) goes on ignoring it.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _raise)


def leave_from_now_on(code: int) -> None:
    """The phase of the exit: the work is done, and ``code`` is its outcome."""

    def leave(number: int, frame: FrameType | None) -> None:
        os._exit(code)

    for number in ENDING_SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, leave)


def _leave(number: int, frame: FrameType | None) -> None:
    os.write(2, b"ohmskin: interrupted\n")
    os._exit(128 + number)


def _raise(number: int, frame: FrameType | None) -> None:
    raise Interrupted(number)


def _report_others(unraisable: Any) -> None:
    """Python's report of errors in destructors and callbacks, without interrupts, which are not lost."""
    if not issubclass(unraisable.exc_type, Interrupted):
        sys.__unraisablehook__(unraisable)
