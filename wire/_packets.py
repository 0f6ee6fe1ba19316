"""What the packets say: frozen values, checked when they are made."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError


class Flag(enum.Flag):
    """What a board says about one frame. Bits without a name are sent as 0 and ignored by a host."""

    NONE = 0
    OVERRUN = 1
    """the board dropped frames just before this one: the host reads too slowly (the line lost nothing)"""


class Order(enum.Enum):
    """What a host can ask of a board; the value is the packet type."""

    DESCRIBE = 0x81
    """send a DESCRIPTION now"""
    START = 0x82
    """send frames; a board that does already goes on"""
    STOP = 0x83
    """send no frames until START; descriptions still come"""


@dataclass(frozen=True, slots=True)
class FramePacket:
    """One scan of the whole array. ``FramePacket.of(counts, ...)`` makes it from an array."""

    sequence: int
    """frames since the board started, modulo 2**32, those it could not send included"""
    time_us: int
    """us since the board started, when this scan began"""
    rows: int
    columns: int
    payload: bytes
    """the counts, row by row, each a little-endian uint16"""
    flags: Flag = Flag.NONE

    def __post_init__(self) -> None:
        _check_stamp(self)
        if not (0 < self.rows <= 0xFFFF and 0 < self.columns <= 0xFFFF):
            raise InputError(f"frame of {self.rows} x {self.columns} cells; expected 1 ... 65535 of each")
        if len(self.payload) != 2 * self.rows * self.columns:
            cells = f"{self.rows} x {self.columns} cells"
            raise InputError(f"frame of {cells} with {len(self.payload)} bytes of counts; expected 2 for each")

    @classmethod
    def of(cls, counts: ArrayLike, *, sequence: int, time_us: int, flags: Flag = Flag.NONE) -> FramePacket:
        """The packet that carries ``counts``: (rows, columns), integers 0 ... 65535, else InputError."""
        array = np.asarray(counts)
        if array.ndim != 2 or array.dtype.kind not in "ui":
            raise InputError(f"counts are {array.dtype} of shape {array.shape}; expected integers (rows, columns)")
        if array.size and (array.min() < 0 or array.max() > 0xFFFF):
            raise InputError(f"counts reach from {array.min()} to {array.max()}; expected 0 ... 65535")
        rows, columns = array.shape
        return cls(sequence, time_us, rows, columns, array.astype("<u2").tobytes(), flags)

    @property
    def counts(self) -> NDArray[np.uint16]:
        """The counts as a read-only (rows, columns) array."""
        return np.frombuffer(self.payload, dtype="<u2").reshape(self.rows, self.columns)


@dataclass(frozen=True, slots=True)
class DescriptionPacket:
    """The board's electronic data sheet: all that a host needs to turn its counts into ohms and kPa."""

    sequence: int
    """the number that the next frame will have"""
    time_us: int
    """us since the board started"""
    serial_number: str
    firmware: str
    design: Mapping[str, Any]
    """the tables of DESIGN.toml"""
    cell: Mapping[str, Any]
    """the tables of CELL.toml"""

    def __post_init__(self) -> None:
        _check_stamp(self)


@dataclass(frozen=True, slots=True)
class Command:
    """A host's order to the board."""

    order: Order
    sequence: int = field(default=0, kw_only=True)
    """the host's own count of commands; boards ignore it"""
    time_us: int = field(default=0, kw_only=True)
    """the host's clock, for logs of the line; boards ignore it"""

    def __post_init__(self) -> None:
        _check_stamp(self)


Packet = FramePacket | DescriptionPacket | Command


def _check_stamp(packet: Packet) -> None:
    if not 0 <= packet.sequence < 2**32:
        raise InputError(f"sequence number {packet.sequence}; expected 0 ... 2**32 - 1")
    if not 0 <= packet.time_us < 2**64:
        raise InputError(f"time {packet.time_us} us; expected 0 ... 2**64 - 1")
