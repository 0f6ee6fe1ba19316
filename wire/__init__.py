"""Protocols of scan boards, without any I/O: bytes to events, orders to bytes, for each family of boards.

``host_protocol("ohmskin")`` is what a driver talks through, ``board_protocol("ohmskin")`` what an emulator does. The
native format is in ``docs/wire.md``; the other families, the boards that a BOARD.toml describes (:class:`BoardFile`),
and the helpers for a family of one's own (:class:`LineHost`, :class:`FixedLengthHost` ...) are in ``docs/boards.md``.
"""

from ._blocks import WORDS, FieldText
from ._board_file import BoardFile
from ._checksums import CHECKSUMS
from ._choice import board_family, board_protocol, host_protocol, known_family
from ._codec import MAX_DESCRIPTION, MAX_PAYLOAD, PacketDecoder, decode, encode
from ._datasheet import read_description, write_description
from ._delimited import FRAMINGS
from ._framing import FixedLengthHost, FreeRunningBoard, LineHost, PolledBoard, one_frame, require
from ._packets import (
    VERSION,
    BadCommand,
    Command,
    Corrupt,
    Description,
    DescriptionPiece,
    Event,
    Flag,
    FramePacket,
    Identity,
    LineState,
    Order,
    Packet,
    Reply,
    SelfTest,
    Status,
)
from ._protocol import BoardProtocol, Family, HostProtocol, Layout
from .boards import BOARDS

__all__ = [
    "BOARDS",
    "CHECKSUMS",
    "FRAMINGS",
    "MAX_DESCRIPTION",
    "MAX_PAYLOAD",
    "VERSION",
    "WORDS",
    "BadCommand",
    "BoardFile",
    "BoardProtocol",
    "Command",
    "Corrupt",
    "Description",
    "DescriptionPiece",
    "Event",
    "Family",
    "FieldText",
    "FixedLengthHost",
    "Flag",
    "FramePacket",
    "FreeRunningBoard",
    "HostProtocol",
    "Identity",
    "Layout",
    "LineHost",
    "LineState",
    "Order",
    "Packet",
    "PacketDecoder",
    "PolledBoard",
    "Reply",
    "SelfTest",
    "Status",
    "board_family",
    "board_protocol",
    "decode",
    "encode",
    "host_protocol",
    "known_family",
    "one_frame",
    "read_description",
    "require",
    "write_description",
]
