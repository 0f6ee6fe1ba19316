"""Snowboard (discontinued): 10 x 16 cells of 8 bits as a line of decimals with commas, polled by any byte."""

from __future__ import annotations

import numpy as np

from .._packets import Corrupt, Event, FramePacket, Order
from .._protocol import Family, Layout
from ._circuits import divider
from ._framing import LineHost, PolledBoard, one_frame, require

_ROWS, _COLUMNS = 10, 16


class SnowboardHost(LineHost):
    """Host end."""

    longest = _ROWS * _COLUMNS * 4 + 8

    def __init__(self, family: Family, layout: Layout) -> None:
        require(family, layout, [(_ROWS, _COLUMNS)], [8])
        super().__init__(family, layout)

    def request(self, order: Order, *, period_us: int = 0) -> bytes:
        return b"?" if order in (Order.ONE_FRAME, Order.START) else b""

    def take(self, line: bytes, received_at: float) -> list[Event]:
        words = line.strip().split(b",")
        good = len(words) == _ROWS * _COLUMNS and all(len(word) <= 3 and word.isdigit() for word in words)
        counts = [int(word) for word in words] if good else []
        if not good or max(counts) > 255:
            return [Corrupt(len(line) + 1, f"a line that is not {_ROWS * _COLUMNS} numbers of 0 ... 255")]
        return one_frame(np.array(counts).reshape(_ROWS, _COLUMNS), received_at)


class SnowboardBoard(PolledBoard):
    """Board end."""

    def __init__(self, family: Family, layout: Layout) -> None:
        require(family, layout, [(_ROWS, _COLUMNS)], [8])
        super().__init__(family, layout)

    def frame(self, frame: FramePacket) -> bytes:
        return ",".join(map(str, frame.counts.ravel().tolist())).encode() + b"\r\n"


SNOWBOARD = Family(
    name="snowboard",
    summary="Snowboard, discontinued: 10 x 16, 8 bits, polled, dividers, text",
    host=SnowboardHost,
    board=SnowboardBoard,
    layout=Layout(_ROWS, _COLUMNS, 8),
    baud_rate=115_200,
    has_sequence=False,
    has_device_time=False,
    has_description=False,
    polled=True,
    design=divider(_ROWS, _COLUMNS, 8, 5.0),
)
