"""FSR array of Aightech: n x n cells in one or two layers, polled with one byte; begin and end of the scan in us.

The host sends ``mode << 6 | n``. The reply has no header: ``uint32 begin_us, uint32 end_us``, then ``uint16`` counts
row by row, little-endian; with two layers each row of the first is followed by that of the second. Frames of two
layers are delivered as (2 n, n): the first layer above the second. Mode 0 for one layer and 1 for two is this project's
reading of the format.

Without header or checksum a reply is recognised by its times, the end of the scan less than a second after its begin,
and by its counts of 12 bits. The board's 32-bit time is counted on beyond its wrap after 71 minutes.
"""

from __future__ import annotations

import struct

import numpy as np

from ...errors import InputError
from .._framing import FixedLengthHost, PolledBoard, one_frame, require
from .._packets import Event, FramePacket, Order
from .._protocol import Family, Layout
from ._circuits import divider

_TIMES = struct.Struct("<II")
_LONGEST_SCAN_US = 1_000_000
_WRAP = 2**32


def _layers(family: Family, layout: Layout) -> int:
    """Number of layers of the array. Raises InputError."""
    require(family, layout, [], [12])
    if not 1 <= layout.columns <= 16 or layout.rows not in (layout.columns, 2 * layout.columns):
        size = f"{layout.rows} x {layout.columns}"
        raise InputError(f"a board '{family.name}' of {size} cells; the family has n x n or, in two layers, 2n x n")
    return layout.rows // layout.columns


class FsrArrayHost(FixedLengthHost):
    """Host end."""

    def __init__(self, family: Family, layout: Layout) -> None:
        self._layers = _layers(family, layout)
        super().__init__(family, layout)
        self.size = _TIMES.size + 2 * layout.rows * layout.columns
        self._time_us: int | None = None

    def request(self, order: Order, *, period_us: int = 0) -> bytes:
        if order not in (Order.ONE_FRAME, Order.START):
            return b""
        return bytes([(self._layers - 1) << 6 | self.layout.columns])

    def fault(self, buffer: bytearray, at: int) -> str:
        begin_us, end_us = _TIMES.unpack_from(buffer, at)
        if (end_us - begin_us) % _WRAP > _LONGEST_SCAN_US:
            return "a scan that ends before it begins, or takes more than a second"
        if self._time_us is not None and (begin_us - self._time_us) % _WRAP > _WRAP // 2:
            return "a scan that begins before the one before"
        high = bytes(buffer[at + _TIMES.size + 1 : at + self.size : 2])
        return "a count of more than 12 bits" if max(high) > 0x0F else ""

    def take(self, packet: bytes, received_at: float) -> list[Event]:
        begin_us, _ = _TIMES.unpack_from(packet)
        before = begin_us if self._time_us is None else self._time_us
        self._time_us = before + (begin_us - before) % _WRAP
        counts = np.frombuffer(packet, dtype="<u2", offset=_TIMES.size)
        side = self.layout.columns
        layers = counts.reshape(side, self._layers, side).swapaxes(0, 1)
        return one_frame(layers.reshape(self.layout.rows, side), time_us=self._time_us)


class FsrArrayBoard(PolledBoard):
    """Board end."""

    def __init__(self, family: Family, layout: Layout) -> None:
        self._layers = _layers(family, layout)
        super().__init__(family, layout)

    def asks(self, byte: int) -> bool:
        return byte == (self._layers - 1) << 6 | self.layout.columns

    def frame(self, frame: FramePacket) -> bytes:
        begin_us = (frame.time_us or 0) % _WRAP
        side = self.layout.columns
        counts = frame.counts.reshape(self._layers, side, side).swapaxes(0, 1)
        return _TIMES.pack(begin_us, (begin_us + 1000) % _WRAP) + counts.astype("<u2").tobytes()


FSR_ARRAY = Family(
    name="fsr-array",
    summary="Aightech FSR array: n x n up to 16, one or two layers, 12 bits, polled, time stamps",
    host=FsrArrayHost,
    board=FsrArrayBoard,
    layout=Layout(16, 16, 12),
    baud_rate=500_000,
    has_sequence=False,
    has_device_time=True,
    has_description=False,
    polled=True,
    design=divider(16, 16, 12, 3.3),
)
