"""Packets to bytes and back. See ``docs/wire.md`` for the format and the reasons behind it.

The invariant: whatever bytes arrive, in whatever pieces, :meth:`Decoder.feed` returns packets and
:class:`Corrupt` stretches in order. Every byte is in exactly one of them, is a delimiter, or waits for one.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn, Protocol

from cobs import cobs

from ..errors import InputError, ProtocolError
from ._packets import Command, DescriptionPacket, Flag, FramePacket, Order, Packet

VERSION = 1
MAX_PAYLOAD = 2**22
"""bytes; a 1024 x 1024 frame is half of it"""

_HEADER = struct.Struct("<BBIIQ")  # type, version, payload length, sequence, time in us
_CRC = struct.Struct("<I")
_FRAME = struct.Struct("<HHH")  # rows, columns, flags
_MAX_RAW = _HEADER.size + MAX_PAYLOAD + _CRC.size
_MAX_STUFFED = _MAX_RAW + _MAX_RAW // 254 + 1
_KNOWN_FLAGS = sum(flag.value for flag in Flag)


@dataclass(frozen=True, slots=True)
class Corrupt:
    """A stretch of bytes between delimiters that is no packet."""

    size: int
    """bytes on the line, delimiters not counted"""
    reason: str


Event = Packet | Corrupt


class Framer(Protocol):
    """What turns a board's bytes into events. Another family of boards brings another one of these."""

    def feed(self, data: bytes) -> list[Event]:
        """The events completed by ``data``, in order."""
        ...


def encode(packet: Packet) -> bytes:
    """The bytes of one packet on the line, with the delimiter that ends it.

    Raises:
        InputError: the packet is too long, or a data sheet that is not JSON.
    """
    match packet:
        case FramePacket():
            kind = _FRAME_TYPE
            payload = _FRAME.pack(packet.rows, packet.columns, packet.flags.value) + packet.payload
        case DescriptionPacket():
            kind, payload = _DESCRIPTION_TYPE, _write_sheet(packet)
        case Command():
            kind, payload = packet.order.value, b""
    if len(payload) > MAX_PAYLOAD:
        raise InputError(f"packet with {len(payload)} bytes of payload; at most {MAX_PAYLOAD} fit")
    body = _HEADER.pack(kind, VERSION, len(payload), packet.sequence, packet.time_us) + payload
    return bytes(cobs.encode(body + _CRC.pack(zlib.crc32(body)))) + b"\0"


def decode(stuffed: bytes) -> Packet:
    """The packet in the bytes between two delimiters.

    Raises:
        ProtocolError: they are not a packet of this version; the message is the first rule they break.
    """
    try:
        raw: bytes = cobs.decode(stuffed)
    except cobs.DecodeError as error:
        raise ProtocolError(f"not COBS: {error}") from error
    if len(raw) < _HEADER.size + _CRC.size:
        raise ProtocolError(f"{len(raw)} bytes, shorter than any packet")
    body, (crc,) = raw[: -_CRC.size], _CRC.unpack(raw[-_CRC.size :])
    if zlib.crc32(body) != crc:
        raise ProtocolError("checksum does not match")
    kind, version, length, sequence, time_us = _HEADER.unpack_from(body)
    if version != VERSION:
        raise ProtocolError(f"protocol version {version}; this host speaks version {VERSION}")
    payload = body[_HEADER.size :]
    if length != len(payload):
        raise ProtocolError(f"header announces {length} bytes of payload, {len(payload)} came")
    read = _READERS.get(kind)
    if read is None:
        raise ProtocolError(f"unknown packet type 0x{kind:02x}")
    try:
        return read(sequence, time_us, payload)
    except InputError as error:
        raise ProtocolError(str(error)) from error


class Decoder:
    """Bytes to events, for either end. Holds at most one packet of the longest kind, and never raises.

    After noise it is in step again at the next delimiter. Empty stretches are idle fill and are skipped.
    """

    def __init__(self) -> None:
        self._stretch = bytearray()
        self._hopeless = False
        """the stretch has outgrown every packet; what follows up to the delimiter belongs to it"""

    def feed(self, data: bytes) -> list[Event]:
        """The packets and corrupt stretches completed by ``data``, in order of arrival."""
        events: list[Event] = []
        *completed, rest = bytes(data).split(b"\0")
        for piece in completed:
            self._collect(piece, events)
            self._finish(events)
        self._collect(rest, events)
        return events

    def _collect(self, piece: bytes, events: list[Event]) -> None:
        self._stretch += piece
        if len(self._stretch) > _MAX_STUFFED:
            events.append(Corrupt(len(self._stretch), "no delimiter within the longest packet"))
            self._stretch.clear()
            self._hopeless = True

    def _finish(self, events: list[Event]) -> None:
        stretch, hopeless = bytes(self._stretch), self._hopeless
        self._stretch.clear()
        self._hopeless = False
        if not stretch:
            return
        if hopeless:
            events.append(Corrupt(len(stretch), "the end of a stretch longer than any packet"))
            return
        try:
            events.append(decode(stretch))
        except ProtocolError as error:
            events.append(Corrupt(len(stretch), str(error)))


def _read_frame(sequence: int, time_us: int, payload: bytes) -> FramePacket:
    if len(payload) < _FRAME.size:
        raise ProtocolError(f"frame with {len(payload)} bytes of payload, expected at least {_FRAME.size}")
    rows, columns, flags = _FRAME.unpack_from(payload)
    return FramePacket(sequence, time_us, rows, columns, payload[_FRAME.size :], Flag(flags & _KNOWN_FLAGS))


def _write_sheet(packet: DescriptionPacket) -> bytes:
    sheet: dict[str, Any] = {
        "serial_number": packet.serial_number,
        "firmware": packet.firmware,
    }
    try:
        sheet |= {"design": _without_infinity(packet.design), "cell": _without_infinity(packet.cell)}
        return json.dumps(sheet, allow_nan=False, ensure_ascii=False, separators=(",", ":")).encode()
    except (TypeError, ValueError) as error:
        raise InputError(f"a data sheet that is not JSON: {error}") from error


def _read_sheet(sequence: int, time_us: int, payload: bytes) -> DescriptionPacket:
    try:
        sheet = json.loads(payload.decode(), parse_constant=_refuse_constant)
        entries = {"serial_number": str, "firmware": str, "design": dict, "cell": dict}
        found = {key: _entry(sheet, key, kind) for key, kind in entries.items()}
        found |= {key: _with_infinity(found[key]) for key in ("design", "cell")}
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"description is not JSON: {error}") from error
    return DescriptionPacket(sequence, time_us, **found)


def _entry(sheet: Any, key: str, kind: type) -> Any:
    """Entries that are not known are left unread: a data sheet may grow within a version."""
    if not isinstance(sheet, dict) or not isinstance(sheet.get(key), kind):
        raise ProtocolError(f"description without '{key}' ({'text' if kind is str else 'object'} expected)")
    return sheet[key]


_INFINITIES = {math.inf: "Infinity", -math.inf: "-Infinity"}
_TEXTS = {text: value for value, text in _INFINITIES.items()}


def _without_infinity(value: Any) -> Any:
    """Ideal parts have infinite values, JSON has none: they travel as text."""
    match value:
        case Mapping():
            return {key: _without_infinity(item) for key, item in value.items()}
        case list() | tuple():
            return [_without_infinity(item) for item in value]
        case float():
            return _INFINITIES.get(value, value)
        case str() if value in _TEXTS:
            raise ValueError(f"the text {value!r} stands for a number")
    return value


def _with_infinity(value: Any) -> Any:
    match value:
        case dict():
            return {key: _with_infinity(item) for key, item in value.items()}
        case list():
            return [_with_infinity(item) for item in value]
        case str():
            return _TEXTS.get(value, value)
    return value


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a JSON number")


def _command_reader(order: Order) -> Callable[[int, int, bytes], Packet]:
    def read(sequence: int, time_us: int, payload: bytes) -> Command:
        if payload:
            raise ProtocolError(f"{order.name} with {len(payload)} bytes of payload, expected none")
        return Command(order, sequence=sequence, time_us=time_us)

    return read


# The packet types of this version. A new type, or another layout of an old one, raises VERSION.
_FRAME_TYPE = 0x01
_DESCRIPTION_TYPE = 0x02
_READERS: dict[int, Callable[[int, int, bytes], Packet]] = {
    _FRAME_TYPE: _read_frame,
    _DESCRIPTION_TYPE: _read_sheet,
    **{order.value: _command_reader(order) for order in Order},
}
