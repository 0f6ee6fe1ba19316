"""The bytes of the ohmskin board: packets and their codec, without any I/O.

The format is in ``docs/wire.md``. :mod:`ohmskin.emulator` writes what :mod:`ohmskin.driver` reads.
"""

from ._codec import MAX_PAYLOAD, VERSION, Corrupt, Decoder, Event, Framer, decode, encode
from ._packets import Command, DescriptionPacket, Flag, FramePacket, Order, Packet

__all__ = [
    "MAX_PAYLOAD",
    "VERSION",
    "Command",
    "Corrupt",
    "Decoder",
    "DescriptionPacket",
    "Event",
    "Flag",
    "FramePacket",
    "Framer",
    "Order",
    "Packet",
    "decode",
    "encode",
]
