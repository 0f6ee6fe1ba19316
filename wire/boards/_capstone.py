"""Capstone skin (STM32): header AA 55, counts, sum of the payload's bytes, CR LF."""

from __future__ import annotations

import struct

import numpy as np

from .._packets import Event, FramePacket
from .._protocol import Family, Layout
from ._circuits import divider
from ._framing import FixedLengthHost, FreeRunningBoard, one_frame, require

HEADER = b"\xaa\x55"
END = b"\r\n"
_SUM = struct.Struct("<H")
_SHAPES = [(16, 32), (12, 20), (40, 40)]


class CapstoneHost(FixedLengthHost):
    """Host end."""

    def __init__(self, family: Family, layout: Layout) -> None:
        require(family, layout, _SHAPES, [12, 16])
        super().__init__(family, layout)
        self.size = len(HEADER) + 2 * layout.rows * layout.columns + _SUM.size + len(END)

    def candidate(self, buffer: bytearray, at: int) -> int:
        found = buffer.find(HEADER, at)
        return found if found >= 0 else max(at, len(buffer) - 1)

    def fault(self, buffer: bytearray, at: int) -> str:
        if buffer[at : at + 2] != HEADER:
            return "no header AA 55"
        end = at + self.size
        if buffer[end - 2 : end] != END:
            return "no CR LF at the end of a frame"
        (announced,) = _SUM.unpack_from(buffer, end - 4)
        if sum(buffer[at + 2 : end - 4]) % 2**16 != announced:
            return "the sum of the bytes does not match"
        return ""

    def take(self, packet: bytes, received_at: float) -> list[Event]:
        counts = np.frombuffer(packet[2:-4], dtype="<u2")
        return one_frame(counts.reshape(self.layout.rows, self.layout.columns), received_at)


class CapstoneBoard(FreeRunningBoard):
    """Board end."""

    def __init__(self, family: Family, layout: Layout) -> None:
        require(family, layout, _SHAPES, [12, 16])
        super().__init__(family, layout)

    def frame(self, frame: FramePacket) -> bytes:
        return HEADER + frame.payload + _SUM.pack(sum(frame.payload) % 2**16) + END


CAPSTONE = Family(
    name="capstone",
    summary="Capstone skin, STM32: 16 x 32, 12 x 20 or 40 x 40, 12 bits, dividers, sum check",
    host=CapstoneHost,
    board=CapstoneBoard,
    layout=Layout(16, 32, 12),
    baud_rate=115_200,
    has_sequence=False,
    has_device_time=False,
    has_description=False,
    design=divider(16, 32, 12, 3.3),
)
