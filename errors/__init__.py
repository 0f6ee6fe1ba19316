"""Every error ohmskin raises on purpose, split by whose fault it is.

::

    OhmskinError
      InputError         the caller's: a file, key, array or option is not as it must be
        OrderRefused     a board refuses an order, such as a rate that it cannot keep
      MissingExtra       the installation's: an optional dependency is not there
      SolverError        the problem's: no trustworthy number can be computed
      LinkError          the cable's: the port is missing, refused, lost or silent
        LinkTimeout      nothing usable came in time
        LinkEnded        the stream came to its regular end: a finite emulation or recording, or a skin that was closed
      ProtocolError      the peer's: bytes that no conforming board or host sends

The command line turns each into one line on standard error; see :mod:`ohmskin.cli` for the exit codes.
"""

from ..common.text import printable


class OhmskinError(Exception):
    """Base of all errors raised on purpose.

    The text is one line without control characters: a board, a file or a file name that it repeats may hold escape
    sequences, which would command the terminal on which a traceback is shown.
    """

    def __str__(self) -> str:
        return printable(super().__str__().replace("\n", " "))


class InputError(OhmskinError, ValueError):
    """Something the caller handed in is wrong; the message says what, where and what was expected."""


class OrderRefused(InputError):
    """A board has answered that it does not take an order."""

    def __init__(self, message: str, status: str) -> None:
        super().__init__(message)
        self.status = status
        """name of the :class:`ohmskin.wire.Status` in its answer"""


class MissingExtra(OhmskinError, ImportError):
    """An optional dependency is missing; the message names the extra that brings it."""


class SolverError(OhmskinError, ArithmeticError):
    """A circuit has no unique or no trustworthy solution; the message says why and what to change."""


class LinkError(OhmskinError, OSError):
    """The serial link cannot be opened or broke."""


class LinkTimeout(LinkError, TimeoutError):
    """The serial link is open but nothing usable came in time."""


class LinkEnded(LinkError, EOFError):
    """No more will come, and nothing is wrong: the stream is over, or it was closed here."""


class ProtocolError(OhmskinError):
    """Bytes that violate the wire format."""
