"""FlexiTac (Arduino Nano): header AA 55 and a byte for each cell; no length, no checksum, no terminator.

Known fault of the format: two neighbouring cells that read 170 and 85 look like a header, and a reader that hunts for
AA 55 can lock onto them for as long as the load stays. This host therefore keeps the phase that it has. Where a frame
contains a second AA 55, the host compares each possible phase with the last good frame and takes the nearest; without
a good frame it reports the frame as ambiguous, until the load changes and only one phase still has its header.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .._packets import Corrupt, Event, FramePacket, Order
from .._protocol import Family, HostProtocol, Layout
from ._circuits import divider
from ._framing import FreeRunningBoard, one_frame, require

HEADER = b"\xaa\x55"
_SHAPES = [(16, 32), (12, 32)]


class FlexitacHost(HostProtocol):
    """Host end: keeps the phase of the frames."""

    def __init__(self, family: Family, layout: Layout) -> None:
        require(family, layout, _SHAPES, [8])
        super().__init__(family, layout)
        self._length = len(HEADER) + layout.rows * layout.columns
        self._buffer = bytearray()
        self._in_step = False
        """the bytes at the head of the buffer follow a good frame"""
        self._last: NDArray[np.uint8] | None = None
        """the last good frame"""

    def feed(self, data: bytes, received_at: float) -> list[Event]:
        self._buffer += data
        events: list[Event] = []
        while True:
            event = self._next(received_at)
            if event is None:
                return events
            events.append(event)

    def request(self, order: Order, *, period_us: int = 0) -> bytes:
        return b""

    def _next(self, received_at: float) -> Event | None:
        """The next event in the buffer, or None when more bytes are needed."""
        length = self._length
        if len(self._buffer) < length:
            return None
        if self._in_step and self._buffer.startswith(HEADER) and not self._second_header():
            return self._take(received_at)
        # A frame that may begin at the last place of the first length reaches to here, with the header behind it.
        if len(self._buffer) < 2 * length + len(HEADER) - 1:
            return None
        places = [at for at in range(length) if self._header_at(at) and self._header_at(at + length)]
        if not places:
            return self._skip(length, "no header AA 55 at the distance of a frame")
        if len(places) == 1:
            best = places[0]
        elif self._last is None:
            return self._skip(length, "ambiguous header: cells of 170 and 85 look like one, and no frame is known")
        else:
            best = min(places, key=self._distance)
        if best > 0:
            return self._skip(best, "bytes ahead of the header AA 55", in_step=True)
        return self._take(received_at)

    def _header_at(self, at: int) -> bool:
        return self._buffer[at : at + len(HEADER)] == HEADER

    def _second_header(self) -> bool:
        """Whether a header may begin within the frame, its last byte included."""
        return self._buffer.find(HEADER, 1, self._length + 1) >= 0

    def _cells_at(self, at: int) -> NDArray[np.uint8]:
        return np.frombuffer(bytes(self._buffer[at + len(HEADER) : at + self._length]), dtype=np.uint8)

    def _distance(self, at: int) -> int:
        """Sum of the differences to the last good frame, if a frame begins at ``at``."""
        assert self._last is not None
        return int(np.abs(self._cells_at(at).astype(np.int64) - self._last).sum())

    def _take(self, received_at: float) -> Event:
        self._last = self._cells_at(0)
        self._in_step = True
        del self._buffer[: self._length]
        (event,) = one_frame(self._last.reshape(self.layout.rows, self.layout.columns), received_at)
        return event

    def _skip(self, size: int, reason: str, *, in_step: bool = False) -> Corrupt:
        self._in_step = in_step
        del self._buffer[:size]
        return Corrupt(size, reason)


class FlexitacBoard(FreeRunningBoard):
    """Board end."""

    def __init__(self, family: Family, layout: Layout) -> None:
        require(family, layout, _SHAPES, [8])
        super().__init__(family, layout)

    def frame(self, frame: FramePacket) -> bytes:
        return HEADER + frame.counts.astype(np.uint8).tobytes()


FLEXITAC = Family(
    name="flexitac",
    summary="FlexiTac, Arduino Nano: 16 x 32 or 12 x 32, 10 bits sent as 8, dividers",
    host=FlexitacHost,
    board=FlexitacBoard,
    layout=Layout(16, 32, 8),
    baud_rate=2_000_000,
    has_sequence=False,
    has_device_time=False,
    has_description=False,
    design=divider(16, 32, 8, 5.0),
)
