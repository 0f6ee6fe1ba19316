"""Serialisation of the native packets: COBS framing, CRC-32, little-endian fields. ``docs/wire.md`` is the format.

The invariant: whatever bytes arrive, in whatever pieces, :meth:`PacketDecoder.feed` returns packets and
:class:`Corrupt` stretches in order. Every byte belongs to exactly one of them, is a delimiter, or waits for one.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from typing import Any

from cobs import cobs

from ..errors import InputError, ProtocolError
from ._packets import (
    VERSION,
    BadCommand,
    Command,
    Corrupt,
    DescriptionPiece,
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

MAX_PAYLOAD = 2**22
"""bytes; a frame of 1024 x 1024 cells is half as long"""
MAX_DESCRIPTION = 2**20
"""bytes of JSON; a longer description is refused"""

_HEADER = struct.Struct("<BBIIQ")  # type, version, boot id, sequence number, time in us
_CRC = struct.Struct("<I")
_INTACT = 0x2144DF1C
"""CRC-32 of any bytes that their own CRC-32 follows, in little-endian order: its residue"""
_FRAME = struct.Struct("<HHH")  # rows, columns, flags
_PIECE = struct.Struct("<II")  # offset, total
_IDENTITY = struct.Struct("<HHBBII")  # rows, columns, ADC bits, streaming, period in us, bytes of description
_OVER = 2
"""in the place of ``streaming``: no frame follows"""
_SELF_TEST = struct.Struct("<HHH")  # rows, columns, reference resistors
_REFERENCE = struct.Struct("<ff")  # nominal ohm, measured ohm
_REPLY = struct.Struct("<BBI")  # packet type of the command, status, sequence number of the command
_RATE = struct.Struct("<I")  # us between two frames

_MAX_RAW = _HEADER.size + MAX_PAYLOAD + _CRC.size
_MAX_STUFFED = _MAX_RAW + _MAX_RAW // 254 + 1
_KNOWN_FLAGS = sum(flag.value for flag in Flag)
_NO_FLAGS = Flag.NONE
_FIRST_COMMAND = 0x80
"""packet types from here on go from host to board"""
_Header = dict[str, Any]
"""what every packet of a board keeps: sequence, time_us and boot_id"""


def encode(packet: Packet) -> bytes:
    """The bytes of one packet on the line, with the delimiter that ends it.

    Raises:
        InputError: the packet is too long, or lacks a number that the native protocol needs.

    """
    kind, payload = _write(packet)
    if len(payload) > MAX_PAYLOAD:
        raise InputError(f"packet with {len(payload)} bytes of payload; at most {MAX_PAYLOAD} fit")
    if packet.sequence is None or packet.time_us is None:
        raise InputError("a packet without sequence number or time; the native protocol needs both")
    boot_id = 0 if isinstance(packet, Command) else packet.boot_id or 0
    body = _HEADER.pack(kind, VERSION, boot_id, packet.sequence, packet.time_us) + payload
    return bytes(cobs.encode(body + _CRC.pack(zlib.crc32(body)))) + b"\0"


def _write(packet: Packet) -> tuple[int, bytes]:
    """Packet type and payload."""
    match packet:
        case FramePacket():
            return 0x01, _FRAME.pack(packet.rows, packet.columns, packet.flags.value) + packet.payload
        case DescriptionPiece():
            return 0x02, _PIECE.pack(packet.offset, packet.total) + packet.data
        case Identity():
            return 0x03, _write_identity(packet)
        case SelfTest():
            return 0x04, _write_self_test(packet)
        case Reply():
            return 0x05, _REPLY.pack(packet.order, packet.status.value, packet.command_sequence)
        case Command():
            return packet.order.value, _RATE.pack(packet.period_us) if packet.order is Order.RATE else b""


def decode(stuffed: bytes) -> Packet | BadCommand:
    """The packet in the bytes between two delimiters.

    Args:
        stuffed: without the delimiters.

    Raises:
        ProtocolError: the bytes are no packet of this version; the message is the first rule that they break.

    """
    try:
        raw: bytes = cobs.decode(stuffed)
    except cobs.DecodeError as error:
        raise ProtocolError(f"not COBS: {error}") from error
    if len(raw) < _HEADER.size + _CRC.size:
        raise ProtocolError(f"{len(raw)} bytes, shorter than any packet")
    if zlib.crc32(raw) != _INTACT:
        raise ProtocolError("checksum does not match")
    kind, version, boot_id, sequence, time_us = _HEADER.unpack_from(raw)
    payload = raw[_HEADER.size : -_CRC.size]
    if kind >= _FIRST_COMMAND:
        return _read_command(kind, version, sequence, time_us, payload)
    if version != VERSION:
        raise ProtocolError(f"protocol version {version}; this host speaks version {VERSION}")
    read = _READERS.get(kind)
    if read is None:
        raise ProtocolError(f"unknown packet type 0x{kind:02x}")
    try:
        return read({"sequence": sequence, "time_us": time_us, "boot_id": boot_id}, payload)
    except InputError as error:
        raise ProtocolError(str(error)) from error


class PacketDecoder:
    """Bytes to native packets, for either end. Holds at most one packet of the longest kind, and never raises.

    After noise the decoder is in step again at the next delimiter. Empty stretches are idle fill and are skipped.
    """

    def __init__(self) -> None:
        self._stretch = bytearray()
        self._too_long = False
        """the stretch has outgrown every packet; the rest of it, up to the delimiter, is corrupt too"""

    def feed(self, data: bytes) -> list[Packet | BadCommand | Corrupt]:
        """The packets and corrupt stretches completed by ``data``, in order of arrival."""
        found: list[Packet | BadCommand | Corrupt] = []
        *completed, rest = bytes(data).split(b"\0")
        for piece in completed:
            if piece and not self._stretch and not self._too_long and len(piece) <= _MAX_STUFFED:
                found.append(_decoded(piece))  # the usual case: a packet that came in one piece
                continue
            self._collect(piece, found)
            self._finish(found)
        if rest:
            self._collect(rest, found)
        return found

    def _collect(self, piece: bytes, found: list[Packet | BadCommand | Corrupt]) -> None:
        self._stretch += piece
        if len(self._stretch) > _MAX_STUFFED:
            found.append(Corrupt(len(self._stretch), "no delimiter within the longest packet"))
            self._stretch.clear()
            self._too_long = True

    def _finish(self, found: list[Packet | BadCommand | Corrupt]) -> None:
        stretch, too_long = bytes(self._stretch), self._too_long
        self._stretch.clear()
        self._too_long = False
        if not stretch:
            return
        if too_long:
            found.append(Corrupt(len(stretch), "the end of a stretch longer than any packet"))
            return
        found.append(_decoded(stretch))


def _decoded(stretch: bytes) -> Packet | BadCommand | Corrupt:
    try:
        return decode(stretch)
    except ProtocolError as error:
        return Corrupt(len(stretch), str(error))


def _read_frame(header: _Header, payload: bytes) -> FramePacket:
    if len(payload) < _FRAME.size:
        raise ProtocolError(f"frame with {len(payload)} bytes of payload, expected at least {_FRAME.size}")
    rows, columns, flags = _FRAME.unpack_from(payload)
    return FramePacket(
        rows=rows,
        columns=columns,
        payload=payload[_FRAME.size :],
        flags=Flag(flags & _KNOWN_FLAGS) if flags else _NO_FLAGS,
        **header,
    )


def _read_piece(header: _Header, payload: bytes) -> DescriptionPiece:
    if len(payload) <= _PIECE.size:
        raise ProtocolError(f"piece of a description with {len(payload)} bytes, expected more than {_PIECE.size}")
    offset, total = _PIECE.unpack_from(payload)
    data = payload[_PIECE.size :]
    if total > MAX_DESCRIPTION:
        raise ProtocolError(f"description of {total} bytes; at most {MAX_DESCRIPTION} are taken")
    if offset + len(data) > total:
        raise ProtocolError(f"description of {total} bytes with a piece that ends at {offset + len(data)}")
    return DescriptionPiece(offset=offset, total=total, data=data, **header)


def _write_identity(identity: Identity) -> bytes:
    try:
        numbers = _IDENTITY.pack(
            identity.rows,
            identity.columns,
            identity.adc_bits,
            _OVER if identity.over else identity.streaming,
            identity.period_us,
            identity.description_bytes,
        )
        return numbers + f"{identity.serial_number}\0{identity.firmware}\0".encode()
    except (struct.error, UnicodeEncodeError) as error:
        raise InputError(f"an identity that cannot be sent: {error}") from error


def _read_identity(header: _Header, payload: bytes) -> Identity:
    if len(payload) < _IDENTITY.size:
        raise ProtocolError(f"identity with {len(payload)} bytes of payload, expected at least {_IDENTITY.size}")
    rows, columns, adc_bits, streaming, period_us, description_bytes = _IDENTITY.unpack_from(payload)
    # Later versions of the firmware may add texts after these two; a host leaves them unread.
    texts = payload[_IDENTITY.size :].split(b"\0")
    if len(texts) < 3:
        raise ProtocolError("identity without serial number and firmware, each ended by a zero")
    try:
        serial_number, firmware = texts[0].decode(), texts[1].decode()
    except UnicodeDecodeError as error:
        raise ProtocolError(f"identity with a text that is not UTF-8: {error}") from error
    return Identity(
        rows=rows,
        columns=columns,
        adc_bits=adc_bits,
        streaming=streaming not in (0, _OVER),
        period_us=period_us,
        description_bytes=description_bytes,
        serial_number=serial_number,
        firmware=firmware,
        over=streaming == _OVER,
        **header,
    )


def _write_self_test(result: SelfTest) -> bytes:
    lines = bytes(state.value for state in (*result.rows, *result.columns))
    counts = _SELF_TEST.pack(len(result.rows), len(result.columns), len(result.references))
    return counts + lines + b"".join(_REFERENCE.pack(*pair) for pair in result.references)


def _read_self_test(header: _Header, payload: bytes) -> SelfTest:
    if len(payload) < _SELF_TEST.size:
        raise ProtocolError(f"self-test with {len(payload)} bytes of payload, expected at least {_SELF_TEST.size}")
    rows, columns, references = _SELF_TEST.unpack_from(payload)
    lines_end = _SELF_TEST.size + rows + columns
    expected = lines_end + references * _REFERENCE.size
    if len(payload) != expected:
        raise ProtocolError(f"self-test with {len(payload)} bytes of payload, expected {expected}")
    try:
        lines = [LineState(value) for value in payload[_SELF_TEST.size : lines_end]]
    except ValueError as error:
        raise ProtocolError(f"self-test with a line state that is not known: {error}") from error
    return SelfTest(
        rows=tuple(lines[:rows]),
        columns=tuple(lines[rows:]),
        references=tuple(_REFERENCE.iter_unpack(payload[lines_end:])),
        **header,
    )


def _read_reply(header: _Header, payload: bytes) -> Reply:
    if len(payload) != _REPLY.size:
        raise ProtocolError(f"reply with {len(payload)} bytes of payload, expected {_REPLY.size}")
    order, status, command_sequence = _REPLY.unpack(payload)
    try:
        found = Status(status)
    except ValueError as error:
        raise ProtocolError(f"reply with status {status}, which is not known") from error
    return Reply(order=order, status=found, command_sequence=command_sequence, **header)


def _read_command(kind: int, version: int, sequence: int, time_us: int, payload: bytes) -> Command | BadCommand:
    """A command in an intact packet. The checksum held, so a fault is the host's, and the board can say so."""
    if version != VERSION:
        return BadCommand(kind, sequence, Status.WRONG_VERSION)
    order = _ORDERS.get(kind)
    if order is None:
        return BadCommand(kind, sequence, Status.UNKNOWN_ORDER)
    if len(payload) != (_RATE.size if order is Order.RATE else 0):
        return BadCommand(kind, sequence, Status.BAD_PAYLOAD)
    period_us = _RATE.unpack(payload)[0] if order is Order.RATE else 0
    return Command(order, period_us, sequence=sequence, time_us=time_us)


_ORDERS = {order.value: order for order in Order}

# The packet types from board to host. A new type, or another layout of an old one, raises VERSION.
_READERS: dict[int, Callable[[_Header, bytes], Packet]] = {
    0x01: _read_frame,
    0x02: _read_piece,
    0x03: _read_identity,
    0x04: _read_self_test,
    0x05: _read_reply,
}
