"""What a browser may ask for: one JSON object per WebSocket message, checked before anything is done."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, TypeAdapter, ValidationError

from ..common.config import Finite, Section
from ..common.text import printable, shortened
from ..errors import InputError

LARGEST_BYTES = 4096
"""of an order; a browser that sends more is disconnected"""
MOST_TRACES = 8
MOST_POINTS = 4000

_Number = Annotated[int, Field(ge=-1, lt=2**32)]
_Line = Annotated[int, Field(ge=0, lt=2**16)]


class NextFrame(Section):
    """The newest frame, as soon as there is one beyond frame ``after``. Live skins only."""

    do: Literal["next"]
    after: _Number


class ShowTime(Section):
    """The frame at ``time_s`` of a recording: the last one that is not later."""

    do: Literal["show time"]
    time_s: Finite


class ShowNumber(Section):
    """Frame ``number`` of a recording."""

    do: Literal["show number"]
    number: _Number


class TraceCells(Section):
    """Pressures of some cells, or the total force, over a whole recording, thinned to about ``points`` points each."""

    do: Literal["trace"]
    cells: Annotated[list[tuple[_Line, _Line]], Field(max_length=MOST_TRACES)]
    """row and column"""
    points: Annotated[int, Field(ge=2, le=MOST_POINTS)]
    total: bool = False
    """whether the total force is asked for, too"""


class MakeTare(Section):
    """Take the skin for unloaded now, with ``force`` in spite of signs that it is loaded."""

    do: Literal["tare"]
    force: bool = False


class UndoTare(Section):
    """Go back to the tare before."""

    do: Literal["undo tare"]


class Record(Section):
    """Begin a recording on the machine of the page's server, or end it."""

    do: Literal["record"]
    on: bool


FrameOrder = NextFrame | ShowTime | ShowNumber
Order = FrameOrder | TraceCells | MakeTare | UndoTare | Record
_ORDERS: TypeAdapter[Order] = TypeAdapter(Annotated[Order, Field(discriminator="do")])


def read_order(message: str | bytes) -> Order:
    """The order in a message of a browser.

    Raises:
        InputError: it is none; the message is one line.

    """
    if isinstance(message, bytes):
        raise InputError(f"a binary message of {len(message)} bytes; expected a JSON text")
    try:
        return _ORDERS.validate_json(message)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        reason = f"{where}: {first['msg']}" if where else first["msg"]
        shown = printable(shortened(message))
        raise InputError(f"not an order of this page: {shown}: {printable(shortened(reason, 200))}") from error
