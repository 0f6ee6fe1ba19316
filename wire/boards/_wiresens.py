"""WiReSens toolkit (ESP32): packets of 120 readings that run across frames, numbered, without checksum.

A packet has 249 bytes, little-endian::

    int8 id | uint16 first index | 120 x uint16 reading | uint32 packet number | 'w' 'r'

The index counts cells row by row and begins anew after the last one, in the middle of a packet if need be. With the
first index 20000 the payload is 60 pairs of index and reading instead, for cells that have changed.

The terminator is no safe delimiter: packet numbers contain "wr" in 29303 of every 65536 cases. A packet is therefore
taken by its length and all of its fields: readings have 12 bits, the index lies in the array. A stretch that is off by
some bytes fails at its first reading or index.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from .._framing import FixedLengthHost, FreeRunningBoard, one_frame, require
from .._packets import Corrupt, Event, FramePacket
from .._protocol import Family, Layout

READINGS = 120
CHANGES_INDEX = 20000
_HEAD = struct.Struct("<bH")
_NUMBER = struct.Struct("<I")
_SIZE = _HEAD.size + 2 * READINGS + _NUMBER.size + 2
_END = b"wr"
_NUMBERS = 2**32


class WiresensHost(FixedLengthHost):
    """Host end: joins packets to frames, and numbers the frames by the number of the packets."""

    size = _SIZE

    def __init__(self, family: Family, layout: Layout) -> None:
        require(family, layout, [(16, 16), (32, 32)], [12])
        super().__init__(family, layout)
        self._cells = layout.rows * layout.columns
        self._counts = np.zeros(self._cells, dtype=np.uint16)
        self._filled = 0
        """cells of the frame under way that have come, from its first one on; -1: its beginning was missed"""
        self._known = np.zeros(self._cells, dtype=np.bool_)
        self._next: tuple[int, int] | None = None
        """number and first index that the next packet must have"""

    def fault(self, buffer: bytearray, at: int) -> str:
        end = at + _SIZE
        if buffer[end - 2 : end] != _END:
            return "no 'wr' at the end of a packet"
        _, first = _HEAD.unpack_from(buffer, at)
        if first >= self._cells and first != CHANGES_INDEX:
            return f"a packet that begins at cell {first}; the array has {self._cells}"
        highest = np.frombuffer(bytes(buffer[at + 4 : end - 6 : 2]), dtype=np.uint8).max()
        if first != CHANGES_INDEX and highest > 0x0F:
            return "a reading of more than 12 bits"
        return ""

    def candidate(self, buffer: bytearray, at: int) -> int:
        end = buffer.find(_END, at + _SIZE - 2)
        # Without a terminator in sight the last bytes may still begin a packet.
        return end + 2 - _SIZE if end >= 0 else max(at, len(buffer) - _SIZE + 1)

    def take(self, packet: bytes, received_at: float) -> list[Event]:
        _, first = _HEAD.unpack_from(packet)
        (number,) = _NUMBER.unpack_from(packet, _SIZE - 6)
        readings = np.frombuffer(packet, dtype="<u2", count=READINGS, offset=_HEAD.size)
        if first == CHANGES_INDEX:
            return self._take_changes(readings.reshape(-1, 2))
        expected, self._next = self._next, ((number + 1) % _NUMBERS, (first + READINGS) % self._cells)
        if expected != (number, first):
            # Packets are missing: the frame under way has a hole, and only a packet with cell 0 begins the next.
            self._filled = 0 if first == 0 else -1
        return self._fill(first, readings, number)

    def _fill(self, first: int, readings: NDArray[np.uint16], number: int) -> list[Event]:
        events: list[Event] = []
        # Packets have run on without a gap since packet 0, which began with cell 0.
        origin = number * READINGS + (first - number * READINGS) % self._cells
        at = 0
        while at < READINGS:
            place = (first + at) % self._cells
            size = min(self._cells - place, READINGS - at)
            self._counts[place : place + size] = readings[at : at + size]
            if place == 0:
                self._filled = 0
            if self._filled == place:
                self._filled += size
            if self._filled == self._cells:
                sequence = (origin + at) // self._cells % _NUMBERS
                events += one_frame(self._image(), sequence=sequence)
                self._known[:] = True
                self._filled = 0
            at += size
        return events

    def _take_changes(self, pairs: NDArray[np.uint16]) -> list[Event]:
        """Cells that have changed: the frame is the last one with these in it. Such frames have no number."""
        places, readings = pairs[:, 0], pairs[:, 1]
        if places.max() >= self._cells or readings.max() > 0x0FFF:
            return [Corrupt(_SIZE, "a changed cell outside the array, or a reading of more than 12 bits")]
        self._counts[places] = readings
        self._known[places] = True
        return one_frame(self._image()) if self._known.all() else []

    def _image(self) -> NDArray[np.uint16]:
        return self._counts.reshape(self.layout.rows, self.layout.columns).copy()


class WiresensBoard(FreeRunningBoard):
    """Board end: sends a packet whenever 120 readings have come together."""

    def __init__(self, family: Family, layout: Layout) -> None:
        require(family, layout, [(16, 16), (32, 32)], [12])
        super().__init__(family, layout)
        self._waiting = bytearray()
        self._first = 0
        self._number = 0

    def frame(self, frame: FramePacket) -> bytes:
        self._waiting += frame.payload
        sent = bytearray()
        while len(self._waiting) >= 2 * READINGS:
            readings = bytes(self._waiting[: 2 * READINGS])
            del self._waiting[: 2 * READINGS]
            sent += _HEAD.pack(1, self._first) + readings + _NUMBER.pack(self._number) + _END
            self._first = (self._first + READINGS) % (frame.rows * frame.columns)
            self._number = (self._number + 1) % _NUMBERS
        return bytes(sent)


WIRESENS = Family(
    name="wiresens",
    summary="WiReSens toolkit, ESP32: 16 x 16 or 32 x 32, 12 bits, an amplifier on each column",
    host=WiresensHost,
    board=WiresensBoard,
    layout=Layout(16, 16, 12),
    baud_rate=250_000,
    has_sequence=True,
    has_device_time=False,
    has_description=False,
    dtr=False,
    rts=False,
    # volts = 1.8 (1 - Rpot / Rs), with a potentiometer of 50 kohm in 127 steps; its step 114 is the project's choice.
    design={
        "array": {"rows": 16, "columns": 16},
        "drive": {"voltage": 1.8, "idle_rows": "ground"},
        "readout": {
            "circuit": "inverting-amplifier",
            "reference_resistance": 50e3 * (127 - 114) / 127,
            "reference_voltage": 1.8,
            "supply": [0.0, 3.3],
        },
        "adc": {"bits": 12, "range": [0.0, 3.3]},
    },
)
