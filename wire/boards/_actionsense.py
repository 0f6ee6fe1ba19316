"""ActionSense: 32 x 32 cells, polled with the letter ``a``; five or six bits in each byte.

The reply to ``a`` is ``[index + 11]``, then for each cell ``[high + 11][low + 11]``, then ``0A``: 2050 bytes. With an
AVR (10 bits) high and low have 5 bits each, with an ESP32 (12 bits) 6 bits each. Every byte but the terminator is 11 or
more, so that a line feed ends every packet. In stream mode each row comes by itself as ``[index + 11][row + 11]``,
64 bytes, ``0A``; the host takes both.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .._framing import LineHost, PolledBoard, one_frame, require
from .._packets import Corrupt, Event, FramePacket, Order
from .._protocol import Family, Layout
from ._circuits import divider

_SIDE = 32
_SHIFT = 11
"""added to every byte, so that none is a line feed"""
_FRAME = 1 + 2 * _SIDE * _SIDE
_ROW = 2 + 2 * _SIDE
_INDICES = 244
"""values of the index that fit into a byte"""


class ActionsenseHost(LineHost):
    """Host end."""

    longest = _FRAME

    def __init__(self, family: Family, layout: Layout) -> None:
        require(family, layout, [(_SIDE, _SIDE)], [10, 12])
        super().__init__(family, layout)
        self._half = layout.adc_bits // 2
        """bits in a byte"""
        self._rows: dict[int, NDArray[np.int64]] = {}
        self._index = -1

    def request(self, order: Order, *, period_us: int = 0) -> bytes:
        return b"a" if order in (Order.ONE_FRAME, Order.START) else b""

    def take(self, line: bytes, received_at: float) -> list[Event]:
        values = np.frombuffer(line, dtype=np.uint8).astype(np.int64) - _SHIFT
        if len(line) not in (_FRAME, _ROW):
            return [Corrupt(len(line) + 1, f"{len(line)} bytes; expected {_FRAME} of a frame or {_ROW} of a row")]
        if values.min() < 0:
            return [Corrupt(len(line) + 1, f"a byte below {_SHIFT}")]
        head = 1 if len(line) == _FRAME else 2
        if values[head:].max() >= 1 << self._half:
            return [Corrupt(len(line) + 1, f"a byte of more than {self._half} bits")]
        counts = (values[head::2] << self._half) + values[head + 1 :: 2]
        if head == 1:
            return one_frame(counts.reshape(_SIDE, _SIDE))
        return self._take_row(int(values[0]), int(values[1]), counts, len(line) + 1)

    def _take_row(self, index: int, row: int, counts: NDArray[np.int64], size: int) -> list[Event]:
        events: list[Event] = []
        if row >= _SIDE:
            return [Corrupt(size, f"row {row}; the array has {_SIDE}")]
        if (index != self._index or row == 0) and self._rows:
            events.append(Corrupt(size * len(self._rows), f"a frame of {len(self._rows)} rows; expected {_SIDE}"))
            self._rows.clear()
        self._index = index
        self._rows[row] = counts
        if len(self._rows) == _SIDE:
            events += one_frame(np.array([self._rows[k] for k in range(_SIDE)]))
            self._rows.clear()
        return events


class ActionsenseBoard(PolledBoard):
    """Board end."""

    def __init__(self, family: Family, layout: Layout) -> None:
        require(family, layout, [(_SIDE, _SIDE)], [10, 12])
        super().__init__(family, layout)
        self._half = layout.adc_bits // 2
        self._index = 0

    def asks(self, byte: int) -> bool:
        return byte == ord("a")

    def frame(self, frame: FramePacket) -> bytes:
        counts = frame.counts.ravel()
        values = np.empty(2 * counts.size, dtype=np.uint8)
        values[0::2] = (counts >> self._half) + _SHIFT
        values[1::2] = (counts & ((1 << self._half) - 1)) + _SHIFT
        index, self._index = self._index, (self._index + 1) % _INDICES
        return bytes([index + _SHIFT]) + values.tobytes() + b"\n"


ACTIONSENSE = Family(
    name="actionsense",
    summary="ActionSense, AVR (10 bits) or ESP32 (12 bits): 32 x 32, polled, dividers",
    host=ActionsenseHost,
    board=ActionsenseBoard,
    layout=Layout(_SIDE, _SIDE, 12),
    baud_rate=1_000_000,
    has_sequence=False,
    has_device_time=False,
    has_description=False,
    polled=True,
    design=divider(_SIDE, _SIDE, 12, 3.3),
)
