"""3D-ViTac: a frame of text, 16 lines of 16 decimals, ended by an empty line.

Each number is followed by a space, each line by CR LF. Lines break in practice: a frame is taken only when exactly 16
good lines stand between two empty ones.
"""

from __future__ import annotations

import numpy as np

from .._packets import Corrupt, Event, FramePacket
from .._protocol import Family, Layout
from ._circuits import divider
from ._framing import FreeRunningBoard, LineHost, one_frame, require

_SIDE = 16


class VitacHost(LineHost):
    """Host end."""

    longest = _SIDE * 4 + 8

    def __init__(self, family: Family, layout: Layout) -> None:
        require(family, layout, [(_SIDE, _SIDE)], [8])
        super().__init__(family, layout)
        self._rows: list[list[int]] = []
        self._size = 0
        """bytes of the lines since the last empty one"""
        self._fault = "the host joined in the middle of a frame"

    def take(self, line: bytes, received_at: float) -> list[Event]:
        self._size += len(line) + 1
        if line.strip():
            self._add(line)
            return []
        rows, size, fault = self._rows, self._size, self._fault
        self._rows, self._size, self._fault = [], 0, ""
        if not fault and len(rows) != _SIDE:
            fault = f"a frame of {len(rows)} lines; expected {_SIDE}"
        if not fault:
            return one_frame(np.array(rows), received_at)
        return [Corrupt(size, fault)]

    def broken(self) -> None:
        self._fault = self._fault or "a line that is too long"

    def _add(self, line: bytes) -> None:
        words = line.split()
        good = len(words) == _SIDE and all(len(word) <= 3 and word.isdigit() for word in words)
        row = [int(word) for word in words] if good else []
        if not good or max(row) > 255:
            self._fault = self._fault or f"a line that is not {_SIDE} numbers of 0 ... 255"
        if len(self._rows) <= _SIDE:  # more lines need not be kept to know that they are too many
            self._rows.append(row)


class VitacBoard(FreeRunningBoard):
    """Board end."""

    def __init__(self, family: Family, layout: Layout) -> None:
        require(family, layout, [(_SIDE, _SIDE)], [8])
        super().__init__(family, layout)

    def frame(self, frame: FramePacket) -> bytes:
        lines = ("".join(f"{count} " for count in row) + "\r\n" for row in frame.counts.tolist())
        return ("".join(lines) + "\r\n").encode()


VITAC = Family(
    name="vitac",
    summary="3D-ViTac: 16 x 16, 8 bits, dividers, text",
    host=VitacHost,
    board=VitacBoard,
    layout=Layout(16, 16, 8),
    baud_rate=2_000_000,
    has_sequence=False,
    has_device_time=False,
    has_description=False,
    design=divider(16, 16, 8, 5.0),
)
