"""The native protocol of ohmskin boards (``docs/wire.md``): numbered frames with CRC, board time and description."""

from __future__ import annotations

from ...errors import ProtocolError
from .._codec import PacketDecoder, encode
from .._datasheet import read_description
from .._packets import (
    BadCommand,
    Command,
    Corrupt,
    Description,
    DescriptionPiece,
    Event,
    FramePacket,
    Identity,
    Order,
    Reply,
    SelfTest,
)
from .._protocol import BoardProtocol, Family, HostProtocol, Layout

PIECE_BYTES = 192
"""bytes of the description in one packet: with its framing below 254, so that one block of COBS holds it"""


class OhmskinHost(HostProtocol):
    """Host end of the native protocol."""

    def __init__(self, family: Family, layout: Layout) -> None:
        super().__init__(family, layout)
        self._decoder = PacketDecoder()
        self._description = _Assembly()

    def feed(self, data: bytes, received_at: float) -> list[Event]:
        events: list[Event] = []
        for packet in self._decoder.feed(data):
            match packet:
                case FramePacket() | Identity() | SelfTest() | Reply() | Corrupt():
                    events.append(packet)
                case DescriptionPiece():
                    complete = self._description.add(packet)
                    if complete is not None:
                        events.append(complete)
                case Command() | BadCommand():
                    # Only a line that echoes returns a host's own commands.
                    events.append(Corrupt(0, "a command, which only hosts send: the line echoes"))
        return events

    def request(self, order: Order, *, period_us: int = 0) -> bytes:
        self.commands = (self.commands + 1) % 2**32
        # The zero ends what an earlier host may have left unfinished.
        return b"\0" + encode(Command(order, period_us, sequence=self.commands))


class OhmskinBoard(BoardProtocol):
    """Board end of the native protocol."""

    def __init__(self, family: Family, layout: Layout) -> None:
        super().__init__(family, layout)
        self._decoder = PacketDecoder()

    def feed(self, data: bytes) -> list[Command | BadCommand]:
        return [packet for packet in self._decoder.feed(data) if isinstance(packet, Command | BadCommand)]

    def frame(self, frame: FramePacket) -> bytes:
        return encode(frame)

    def identify(self, identity: Identity) -> bytes:
        return encode(identity)

    def describe(self, text: bytes, *, sequence: int, time_us: int, boot_id: int) -> list[bytes]:
        pieces = (
            DescriptionPiece(sequence, time_us, offset, len(text), text[offset : offset + PIECE_BYTES], boot_id)
            for offset in range(0, len(text), PIECE_BYTES)
        )
        return [encode(piece) for piece in pieces]

    def self_test(self, result: SelfTest) -> bytes:
        return encode(result)

    def reply(self, reply: Reply) -> bytes:
        return encode(reply)


class _Assembly:
    """Joins the pieces of a description. A piece that the line lost is taken from the next time that they are sent."""

    def __init__(self) -> None:
        self._text = bytearray()
        self._missing = bytearray()
        """for each byte of the text 1 until it has come"""
        self._boot_id = 0

    def add(self, piece: DescriptionPiece) -> Description | Corrupt | None:
        """The description, when ``piece`` was the last one missing; Corrupt when the text is wrong; else None."""
        if (piece.total, piece.boot_id) != (len(self._text), self._boot_id):
            self._text, self._missing = bytearray(piece.total), bytearray(b"\1" * piece.total)
            self._boot_id = piece.boot_id
        end = piece.offset + len(piece.data)
        self._text[piece.offset : end] = piece.data
        self._missing[piece.offset : end] = bytes(len(piece.data))
        if 1 in self._missing:
            return None
        text, self._text = bytes(self._text), bytearray()
        try:
            design, cell = read_description(text)
        except ProtocolError as error:
            return Corrupt(len(text), str(error), is_description=True)
        return Description(piece.sequence, piece.time_us, design, cell, piece.boot_id)


OHMSKIN = Family(
    name="ohmskin",
    summary="boards that speak docs/wire.md: any array, CRC, numbered frames, own clock, own description",
    host=OhmskinHost,
    board=OhmskinBoard,
    layout=Layout(4, 4, 12),
    baud_rate=1_000_000,
    has_sequence=True,
    has_device_time=True,
    has_description=True,
)
