"""M1616, a commercial 16 x 16 board: header AA AB AC, big-endian counts, and four bytes of unknown meaning.

There is no checksum. A frame is taken when its header is in place and every count has 12 bits; the four bytes at its
end are not checked. The number of bits is this project's reading of the format.
"""

from __future__ import annotations

import numpy as np

from .._packets import Event, FramePacket
from .._protocol import Family, Layout
from ._circuits import divider
from ._framing import FixedLengthHost, FreeRunningBoard, one_frame, require

HEADER = b"\xaa\xab\xac"
_SIDE = 16
_TRAILER = bytes(4)


class M1616Host(FixedLengthHost):
    """Host end."""

    size = len(HEADER) + 2 * _SIDE * _SIDE + len(_TRAILER)

    def __init__(self, family: Family, layout: Layout) -> None:
        require(family, layout, [(_SIDE, _SIDE)], [12])
        super().__init__(family, layout)

    def candidate(self, buffer: bytearray, at: int) -> int:
        found = buffer.find(HEADER, at)
        return found if found >= 0 else max(at, len(buffer) - len(HEADER) + 1)

    def fault(self, buffer: bytearray, at: int) -> str:
        if buffer[at : at + len(HEADER)] != HEADER:
            return "no header AA AB AC"
        high = bytes(buffer[at + len(HEADER) : at + self.size - len(_TRAILER) : 2])
        return "a count of more than 12 bits" if max(high) > 0x0F else ""

    def take(self, packet: bytes, received_at: float) -> list[Event]:
        counts = np.frombuffer(packet, dtype=">u2", count=_SIDE * _SIDE, offset=len(HEADER))
        return one_frame(counts.reshape(_SIDE, _SIDE), received_at)


class M1616Board(FreeRunningBoard):
    """Board end."""

    def __init__(self, family: Family, layout: Layout) -> None:
        require(family, layout, [(_SIDE, _SIDE)], [12])
        super().__init__(family, layout)

    def frame(self, frame: FramePacket) -> bytes:
        return HEADER + frame.counts.astype(">u2").tobytes() + _TRAILER


M1616 = Family(
    name="m1616",
    summary="M1616, commercial: 16 x 16, 12 bits, big-endian, dividers",
    host=M1616Host,
    board=M1616Board,
    layout=Layout(_SIDE, _SIDE, 12),
    baud_rate=115_200,
    has_sequence=False,
    has_device_time=False,
    has_description=False,
    design=divider(_SIDE, _SIDE, 12, 3.3),
)
