"""Protocol data units of the ohmskin board: frozen values, checked when they are made.

The same values serve as *events* for every family of boards: what a family's format does not carry (a sequence
number, the board's own time) is None.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError

VERSION = 2
"""version of the native protocol"""
_COUNT = np.dtype("<u2")


class Flag(enum.Flag):
    """Remarks of a board about one frame. Bits without a name are sent as 0 and ignored by a host."""

    NONE = 0
    OVERRUN = 1
    """the board dropped frames just before this one because the host reads too slowly"""
    LAST = 2
    """no frame follows: an emulation or a played recording is at its end"""


class Order(enum.Enum):
    """Commands of a host; the value is the packet type of the native protocol."""

    DESCRIBE = 0x81
    """send the description: design of the readout, data of the cell"""
    START = 0x82
    """stream frames"""
    STOP = 0x83
    """send no frames until START or ONE_FRAME"""
    IDENTIFY = 0x84
    """send the identity: protocol version, boot id, serial number, firmware, array"""
    ONE_FRAME = 0x85
    """scan and send one frame, then be as before"""
    RATE = 0x86
    """change the time between two frames"""
    SELF_TEST = 0x87
    """measure the reference resistors and look for open and shorted lines"""


class Status(enum.Enum):
    """Answer of a board to a command, in a :class:`Reply`."""

    TAKEN = 0
    UNKNOWN_ORDER = 1
    """no command of this packet type exists in the board's version"""
    BAD_PAYLOAD = 2
    """the payload has the wrong length"""
    OUT_OF_RANGE = 3
    """the value is none that this board can take"""
    NOT_NOW = 4
    """the board is busy; the host may ask again"""
    NOT_SUPPORTED = 5
    """the command exists, but this board has no such part"""
    WRONG_VERSION = 6
    """the command came in another version of the protocol than the board speaks"""


class LineState(enum.Enum):
    """Result of the self-test for one row or column line."""

    GOOD = 0
    OPEN = 1
    """no cell of the line conducts"""
    SHORTED = 2
    """the line conducts to another line, to ground or to the supply"""
    NOT_TESTED = 3


@dataclass(frozen=True, slots=True)
class FramePacket:
    """One scan of the whole array. ``FramePacket.of(counts, ...)`` makes one from an array."""

    sequence: int | None
    """number of scans since the board started, modulo 2**32, those it could not send included; None: format has none"""
    time_us: int | None
    """us from the start of the board to the start of this scan; None: the format has no time stamps"""
    rows: int
    columns: int
    payload: bytes
    """the counts, row by row, each a little-endian uint16"""
    flags: Flag = Flag.NONE
    boot_id: int | None = None
    """number that changes whenever the board starts anew; None: the format has none"""
    absent: tuple[int, ...] = ()
    """cells, counted row by row, of which the board has sent no count; theirs are 0 here"""

    def __post_init__(self) -> None:
        if self.sequence is not None and self.time_us is not None:
            _check_header(self.sequence, self.time_us, self.boot_id or 0)
        if not (0 < self.rows <= 0xFFFF and 0 < self.columns <= 0xFFFF):
            raise InputError(f"frame of {self.rows} x {self.columns} cells; expected 1 ... 65535 of each")
        if len(self.payload) != 2 * self.rows * self.columns:
            cells = f"{self.rows} x {self.columns} cells"
            raise InputError(f"frame of {cells} with {len(self.payload)} bytes of counts; expected 2 for each")

    @classmethod
    def of(
        cls,
        counts: ArrayLike,
        *,
        sequence: int | None = None,
        time_us: int | None = None,
        flags: Flag = Flag.NONE,
        boot_id: int | None = None,
        absent: tuple[int, ...] = (),
    ) -> FramePacket:
        """The packet that carries ``counts``.

        Args:
            counts: (rows, columns) integers 0 ... 65535.
            sequence: see the field of that name, as for the rest.
            time_us: in us.
            flags: remarks of the board.
            boot_id: of the board.
            absent: cells without a count.

        Raises:
            InputError: the counts are no such array.

        """
        array = np.asarray(counts)
        if array.ndim != 2 or array.dtype.kind not in "ui":
            raise InputError(f"counts are {array.dtype} of shape {array.shape}; expected integers (rows, columns)")
        if array.size and (array.min() < 0 or array.max() > 0xFFFF):
            raise InputError(f"counts reach from {array.min()} to {array.max()}; expected 0 ... 65535")
        rows, columns = array.shape
        payload = array.astype("<u2").tobytes()
        return cls(sequence, time_us, rows, columns, payload, flags, boot_id, absent)

    @property
    def counts(self) -> NDArray[np.uint16]:
        """The counts as a read-only (rows, columns) array."""
        return np.ndarray((self.rows, self.columns), _COUNT, self.payload)  # half as long as frombuffer() and reshape()


@dataclass(frozen=True, slots=True)
class Identity:
    """Who the board is, in a packet that the smallest microcontroller can send."""

    sequence: int
    """number that the next frame will have"""
    time_us: int
    """us since the board started"""
    rows: int
    columns: int
    adc_bits: int
    streaming: bool
    """False after STOP"""
    period_us: int
    """us between two frames"""
    description_bytes: int
    """length of the description; 0: this board has none"""
    serial_number: str
    firmware: str
    boot_id: int = 0
    over: bool = False
    """no frame follows: an emulation is at its end. ``streaming`` is then False"""

    def __post_init__(self) -> None:
        _check_header(self.sequence, self.time_us, self.boot_id)
        if self.over and self.streaming:
            raise InputError("an identity of a board that is at its end and streams; expected one of them")
        if "\0" in self.serial_number + self.firmware:
            raise InputError("a serial number or firmware name contains the character NUL; expected text")


@dataclass(frozen=True, slots=True)
class DescriptionPiece:
    """Some bytes of the description. A board sends the pieces in order; the host joins them."""

    sequence: int
    time_us: int
    offset: int
    """of the first byte, from the beginning of the description"""
    total: int
    """length of the whole description in bytes"""
    data: bytes
    boot_id: int = 0

    def __post_init__(self) -> None:
        _check_header(self.sequence, self.time_us, self.boot_id)


@dataclass(frozen=True, slots=True)
class Description:
    """The board's electronic data sheet: all that a host needs to turn counts into ohms and kPa."""

    sequence: int | None
    """number that the next frame will have"""
    time_us: int | None
    """us since the board started"""
    design: Mapping[str, Any] | None
    """the tables of DESIGN.toml; None: the board does not say"""
    cell: Mapping[str, Any] | None
    """the tables of CELL.toml; None: the board does not say"""
    boot_id: int | None = None


@dataclass(frozen=True, slots=True)
class SelfTest:
    """Result of the board's self-test."""

    sequence: int
    """number that the next frame will have"""
    time_us: int
    rows: tuple[LineState, ...]
    columns: tuple[LineState, ...]
    references: tuple[tuple[float, float], ...]
    """(nominal, measured) ohm of each reference resistor"""
    boot_id: int = 0

    def __post_init__(self) -> None:
        _check_header(self.sequence, self.time_us, self.boot_id)


@dataclass(frozen=True, slots=True)
class Reply:
    """Whether a command was taken, and if not, why not."""

    sequence: int
    """number that the next frame will have"""
    time_us: int
    order: int
    """packet type of the command"""
    status: Status
    command_sequence: int
    """sequence number of the command"""
    boot_id: int = 0

    def __post_init__(self) -> None:
        _check_header(self.sequence, self.time_us, self.boot_id)


@dataclass(frozen=True, slots=True)
class Command:
    """An order of the host to the board."""

    order: Order
    period_us: int = 0
    """RATE only: us between two frames"""
    sequence: int = field(default=0, kw_only=True)
    """the host's own count of commands, which a :class:`Reply` repeats"""
    time_us: int = field(default=0, kw_only=True)
    """the host's clock, for logs of the line; boards ignore it"""

    def __post_init__(self) -> None:
        _check_header(self.sequence, self.time_us, 0)
        if not 0 <= self.period_us < 2**32:
            raise InputError(f"period of {self.period_us} us; expected 0 ... 2**32 - 1")


@dataclass(frozen=True, slots=True)
class BadCommand:
    """A command that arrived intact and cannot be taken; the board answers with a :class:`Reply`."""

    order: int
    """packet type of the command"""
    sequence: int
    status: Status


@dataclass(frozen=True, slots=True)
class Corrupt:
    """A stretch of bytes that is no part of any packet."""

    size: int
    """bytes on the line, delimiters not counted"""
    reason: str
    is_description: bool = False
    """True: a description came whole, in packets without fault, and cannot be read; no noise of the line does that"""


Packet = FramePacket | Identity | DescriptionPiece | SelfTest | Reply | Command
"""What one packet of the native protocol can be"""

Event = FramePacket | Identity | Description | SelfTest | Reply | Corrupt
"""What a host hears of a board, whatever its family"""


def _check_header(sequence: int, time_us: int, boot_id: int) -> None:
    if not 0 <= sequence < 2**32:
        raise InputError(f"sequence number {sequence}; expected 0 ... 2**32 - 1")
    if not 0 <= time_us < 2**64:
        raise InputError(f"time {time_us} us; expected 0 ... 2**64 - 1")
    if not 0 <= boot_id < 2**32:
        raise InputError(f"boot id {boot_id}; expected 0 ... 2**32 - 1")
