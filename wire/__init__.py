"""Protocols of scan boards, without any I/O: bytes to events, orders to bytes, for each family of boards.

``host_protocol("ohmskin")`` is what a driver talks through, ``board_protocol("ohmskin")`` what an emulator does. The
native format is in ``docs/wire.md``; the other families are in ``docs/boards.md``.
"""

from ._choice import board_family, board_protocol, host_protocol
from ._codec import MAX_DESCRIPTION, MAX_PAYLOAD, PacketDecoder, decode, encode
from ._datasheet import read_description, write_description
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
    "MAX_DESCRIPTION",
    "MAX_PAYLOAD",
    "VERSION",
    "BadCommand",
    "BoardProtocol",
    "Command",
    "Corrupt",
    "Description",
    "DescriptionPiece",
    "Event",
    "Family",
    "Flag",
    "FramePacket",
    "HostProtocol",
    "Identity",
    "Layout",
    "LineState",
    "Order",
    "Packet",
    "PacketDecoder",
    "Reply",
    "SelfTest",
    "Status",
    "board_family",
    "board_protocol",
    "decode",
    "encode",
    "host_protocol",
    "read_description",
    "write_description",
]
