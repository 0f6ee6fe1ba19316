"""The codec: literal bytes, an independent encoder, and attacks on the decoder's invariant."""

from __future__ import annotations

import math
import re
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st

from ohmskin.errors import InputError, ProtocolError
from ohmskin.wire import (
    MAX_PAYLOAD,
    Command,
    Corrupt,
    Decoder,
    DescriptionPacket,
    Event,
    Flag,
    FramePacket,
    Order,
    Packet,
    decode,
    encode,
)

SHEET = b'{"serial_number":"A1","firmware":"0.1.0","design":{},"cell":{}}'

# The literal packets of docs/wire.md, written here a second time by field.
LITERAL: list[tuple[Packet, str]] = [
    (
        FramePacket.of(np.array([[0, 1, 2], [4660, 4095, 65535]]), sequence=7, time_us=20_000, flags=Flag.OVERRUN),
        "04 01 01 12  01 01 02 07 01 01 03 20 4e 01 01 01 01 01 02 02 02 03 02 01"
        "01 01 02 01 02 02 0b 34 12 ff 0f ff ff 08 37 a0 68 00",
    ),
    (
        DescriptionPacket(5, 1_000_000, "A1", "0.1.0", {}, {}),
        "04 02 01 3f 01 01 02 05 01 01 04 40 42 0f 01 01 01 01 44" + SHEET.hex() + "5b c9 3b 55 00",
    ),
    (Command(Order.DESCRIBE), "03 81 01" + "01" * 15 + "05 6e 54 84 a1 00"),
    (Command(Order.START), "03 82 01" + "01" * 15 + "05 0c 89 02 4b 00"),
    (Command(Order.STOP), "03 83 01" + "01" * 15 + "05 ed 3f 50 a4 00"),
]

sequences = st.integers(0, 2**32 - 1)
times = st.integers(0, 2**64 - 1)
texts = st.text(st.characters(codec="utf-8"), max_size=20)
json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False)
    | texts.filter(lambda text: text not in {"Infinity", "-Infinity"}),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=8,
)
tables = st.dictionaries(texts, json_values, max_size=3)


@st.composite
def frames(draw: st.DrawFn) -> FramePacket:
    rows, columns = draw(st.integers(1, 20)), draw(st.integers(1, 20))
    payload = draw(st.binary(min_size=2 * rows * columns, max_size=2 * rows * columns))
    return FramePacket(draw(sequences), draw(times), rows, columns, payload, draw(st.sampled_from(Flag)))


packets = st.one_of(
    frames(),
    st.builds(DescriptionPacket, sequences, times, texts, texts, tables, tables),
    st.builds(Command, st.sampled_from(Order), sequence=sequences, time_us=times),
)


def crc32(data: bytes) -> int:
    """IEEE 802.3, reflected, bit by bit."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def stuff(data: bytes) -> bytes:
    """COBS after Cheshire and Baker (1999): each code byte is the distance to the next zero, at most 255."""
    out = bytearray()
    for group in data.split(b"\0"):
        start = 0
        while len(group) - start >= 254:
            out += b"\xff" + group[start : start + 254]
            start += 254
        out += bytes([len(group) - start + 1]) + group[start:]
    return bytes(out)


def raw(kind: int, payload: bytes, *, version: int = 1, length: int | None = None, sequence: int = 0) -> bytes:
    """A stuffed packet without its delimiter, right or wrong, by the independent encoder."""
    announced = len(payload) if length is None else length
    body = struct.pack("<BBIIQ", kind, version, announced, sequence, 0) + payload
    return stuff(body + struct.pack("<I", crc32(body)))


def by_bytes(decoder: Decoder, data: bytes) -> list[Event]:
    return [event for k in range(len(data)) for event in decoder.feed(data[k : k + 1])]


@pytest.mark.parametrize(("packet", "line"), LITERAL, ids=lambda value: type(value).__name__)
def test_literal_packets_both_ways_and_byte_by_byte(packet: Packet, line: str) -> None:
    data = bytes.fromhex(line)
    assert encode(packet) == data
    assert Decoder().feed(data) == [packet]
    assert by_bytes(Decoder(), data) == [packet]
    assert decode(data[:-1]) == packet


def test_the_document_shows_these_literal_packets() -> None:
    page = (Path(__file__).parents[1] / "docs" / "wire.md").read_text(encoding="utf-8")
    blocks = re.findall(r"(?:^    [0-9a-f ]+\n)+", page, flags=re.MULTILINE)
    shown = b"".join(bytes.fromhex(block.replace("\n", " ")) for block in blocks if block.rstrip().endswith(" 00"))
    assert Decoder().feed(shown) == [packet for packet, _ in LITERAL]


def test_counts_are_a_read_only_array_of_their_shape() -> None:
    counts = np.arange(6, dtype=np.uint16).reshape(2, 3)
    packet = FramePacket.of(counts, sequence=0, time_us=0)
    np.testing.assert_array_equal(packet.counts, counts)
    assert not packet.counts.flags.writeable


@given(packets)
def test_an_independent_encoder_agrees(packet: Packet) -> None:
    data = encode(packet)
    assert data.count(0) == 1
    assert data.endswith(b"\0")
    event = by_bytes(Decoder(), data)
    assert event == [packet]
    if isinstance(packet, FramePacket):
        head = struct.pack("<HHH", packet.rows, packet.columns, packet.flags.value)
        body = struct.pack("<BBIIQ", 1, 1, 6 + len(packet.payload), packet.sequence, packet.time_us)
        body += head + packet.payload
        # Behind a group of 254 that ends the data, encoders may or may not add an empty group: both decode.
        assert decode(stuff(body + struct.pack("<I", crc32(body)))) == packet


@given(st.lists(packets, max_size=4), st.lists(st.integers(1, 40), min_size=1, max_size=20))
def test_any_chunking_gives_the_same_packets(sent: list[Packet], sizes: list[int]) -> None:
    data, decoder, events, at = b"".join(map(encode, sent)), Decoder(), [], 0
    while at < len(data):
        size = sizes[at % len(sizes)]
        events += decoder.feed(data[at : at + size])
        at += size
    assert events == sent


# Noise that is hard: zeros, short groups, and pieces of real packets.
noise = st.lists(
    st.one_of(
        st.binary(max_size=30),
        st.sampled_from([b"\0", b"\0\0", b"\x01", b"\xff" * 300]),
        packets.map(encode).flatmap(lambda line: st.integers(0, len(line)).map(lambda k: line[:k])),
    ),
    max_size=12,
).map(b"".join)


@given(noise, packets)
def test_whatever_came_before_the_next_delimiter_restores_the_step(before: bytes, packet: Packet) -> None:
    assert Decoder().feed(before + b"\0" + encode(packet))[-1] == packet


@given(noise)
def test_every_byte_is_accounted_for(data: bytes) -> None:
    """Whole and byte by byte alike: packets, corrupt stretches and delimiters add up to what came."""
    data += b"\0"
    events = Decoder().feed(data)
    assert by_bytes(Decoder(), data) == events
    corrupt = sum(event.size for event in events if isinstance(event, Corrupt))
    good = [stretch for stretch in data.split(b"\0") if stretch and not _refused(stretch)]
    assert len(good) == len([event for event in events if not isinstance(event, Corrupt)])
    assert corrupt + sum(map(len, good)) + data.count(0) == len(data)


def _refused(stretch: bytes) -> bool:
    try:
        decode(stretch)
    except ProtocolError:
        return True
    return False


@given(packets, st.data())
def test_one_changed_byte_never_passes_for_a_packet(packet: Packet, data: st.DataObject) -> None:
    line = bytearray(encode(packet))
    at = data.draw(st.integers(0, len(line) - 2))
    line[at] ^= data.draw(st.integers(1, 255))
    events = Decoder().feed(bytes(line) + encode(Command(Order.START)))
    assert events[-1] == Command(Order.START)
    assert events[:-1]
    assert all(isinstance(event, Corrupt) for event in events[:-1])


@pytest.mark.parametrize(
    ("stretch", "reason"),
    [
        (b"\x05ab", "not COBS"),
        (stuff(b"x" * 21), "21 bytes, shorter than any packet"),
        (raw(0x82, b"")[:-1] + b"\x7f", "checksum does not match"),
        (raw(0x82, b"", version=2), "protocol version 2; this host speaks version 1"),
        (raw(0x82, b"", length=1), "header announces 1 bytes of payload, 0 came"),
        (raw(0x7E, b""), "unknown packet type 0x7e"),
        (raw(0x83, b"!"), "STOP with 1 bytes of payload, expected none"),
        (raw(0x01, b"\1\0"), "frame with 2 bytes of payload, expected at least 6"),
        (
            raw(0x01, b"\2\0\2\0\0\0" + b"\0" * 7),
            "frame of 2 x 2 cells with 7 bytes of counts; expected 2 for each",
        ),
        (raw(0x01, b"\0\0\2\0\0\0"), "frame of 0 x 2 cells; expected 1 ... 65535 of each"),
        (raw(0x02, b"{"), "description is not JSON"),
        (raw(0x02, b"\xff"), "description is not JSON"),
        (raw(0x02, b"[" * 200_000), "description is not JSON"),
        (raw(0x02, b"[" * 900 + b"]" * 900), "description without 'serial_number'"),
        (
            raw(0x02, SHEET.replace(b"{}", b'{"a":' + b"[" * 990 + b"]" * 990 + b"}", 1)),
            "description is not JSON: maximum recursion",
        ),
        (raw(0x02, SHEET.replace(b"{}", b'{"a":NaN}')), "description is not JSON: NaN is not a JSON number"),
        (raw(0x02, b"[]"), "description without 'serial_number' (text expected)"),
        (raw(0x02, SHEET.replace(b"{}", b"1", 1)), "description without 'design' (object expected)"),
    ],
)
def test_what_breaks_a_rule_is_reported_with_that_rule(stretch: bytes, reason: str) -> None:
    with pytest.raises(ProtocolError, match=re.escape(reason)):
        decode(stretch)
    (event,) = Decoder().feed(stretch + b"\0")
    assert isinstance(event, Corrupt)
    assert event.reason.startswith(reason)
    assert event.size == len(stretch)


def test_unknown_flags_and_unknown_data_are_left_unread() -> None:
    frame = decode(raw(0x01, struct.pack("<HHH", 1, 1, 0xFFFF) + b"\5\0", sequence=3))
    assert frame == FramePacket(3, 0, 1, 1, b"\5\0", Flag.OVERRUN)
    sheet = decode(raw(0x02, SHEET[:-1] + b',"colour":"red"}'))
    assert sheet == DescriptionPacket(0, 0, "A1", "0.1.0", {}, {})


def test_the_text_of_an_infinity_is_a_number_in_tables_alone() -> None:
    name = DescriptionPacket(0, 0, "Infinity", "-Infinity", {}, {})
    assert Decoder().feed(encode(name)) == [name]
    with pytest.raises(InputError, match="stands for a number"):
        encode(DescriptionPacket(0, 0, "", "", {"a": ["Infinity"]}, {}))


def test_infinite_values_of_ideal_parts_travel_as_text() -> None:
    sheet = DescriptionPacket(0, 0, "", "", {"readout": {"supply": [-math.inf, math.inf, 1.5]}}, {"a": "Infinite"})
    data = encode(sheet)
    assert b'["-Infinity","Infinity",1.5]' in cobs.decode(data[:-1])
    assert Decoder().feed(data) == [sheet]


def test_idle_zeros_are_no_events() -> None:
    assert Decoder().feed(bytes(1000)) == []


def test_noise_without_end_takes_bounded_memory_and_is_reported_while_it_comes() -> None:
    decoder, block, corrupt, blocks = Decoder(), b"\x01" * 100_000, 0, 250
    tracemalloc.start()
    for _ in range(blocks):
        corrupt += sum(event.size for event in decoder.feed(block) if isinstance(event, Corrupt))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert corrupt > 4 * MAX_PAYLOAD
    assert peak < 3 * MAX_PAYLOAD
    (end,) = decoder.feed(b"\0")
    assert isinstance(end, Corrupt)
    assert corrupt + end.size == blocks * len(block)
    assert decoder.feed(encode(Command(Order.STOP))) == [Command(Order.STOP)]


def test_the_largest_array_of_a_design_fits() -> None:
    counts = np.random.default_rng(1).integers(0, 2**16, (1024, 1024), dtype=np.uint16)
    packet = FramePacket.of(counts, sequence=1, time_us=2)
    assert Decoder().feed(encode(packet)) == [packet]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FramePacket.of([[1.5]], sequence=0, time_us=0), "expected integers"),
        (lambda: FramePacket.of([1, 2], sequence=0, time_us=0), "expected integers"),
        (lambda: FramePacket.of([[-1]], sequence=0, time_us=0), "from -1 to -1; expected 0 ... 65535"),
        (lambda: FramePacket.of([[70000]], sequence=0, time_us=0), "from 70000 to 70000"),
        (lambda: FramePacket.of([[1]], sequence=2**32, time_us=0), "sequence number 4294967296"),
        (lambda: FramePacket.of([[1]], sequence=0, time_us=-1), "time -1 us"),
        (lambda: FramePacket.of(np.empty((0, 3), dtype=int), sequence=0, time_us=0), "frame of 0 x 3 cells"),
        (lambda: encode(DescriptionPacket(0, 0, "", "", {"gain": float("nan")}, {})), "not JSON"),
        (lambda: encode(DescriptionPacket(0, 0, "\ud800", "", {}, {})), "not JSON"),
        (lambda: encode(DescriptionPacket(0, 0, "x" * MAX_PAYLOAD, "", {}, {})), "at most 4194304 fit"),
    ],
)
def test_packets_that_cannot_be_sent_are_refused(make: object, message: str) -> None:
    assert callable(make)
    with pytest.raises(InputError, match=re.escape(message)):
        make()
