"""The codec: literal bytes, an independent encoder, and attacks on the decoder's invariant."""

from __future__ import annotations

import math
import re
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.circuits import Design
from ohmskin.errors import InputError, ProtocolError
from ohmskin.wire import (
    MAX_DESCRIPTION,
    MAX_PAYLOAD,
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
    PacketDecoder,
    Reply,
    SelfTest,
    Status,
    board_protocol,
    decode,
    encode,
    host_protocol,
    read_description,
    write_description,
)

# The literal packets of docs/wire.md, written here a second time by field.
BOOT = 0x2A
TEXT = b'{"design":{},"cell":{}}'
GOOD, OPEN, SHORTED = LineState.GOOD, LineState.OPEN, LineState.SHORTED
LITERAL: dict[str, Packet] = {
    "FRAME": FramePacket.of(
        [[0, 1, 2], [4660, 4095, 65535]], sequence=7, time_us=20_000, flags=Flag.OVERRUN, boot_id=BOOT
    ),
    "LONG FRAME": FramePacket.of(np.full((1, 130), 257), sequence=8, time_us=40_000, boot_id=BOOT),
    "DESCRIPTION": DescriptionPiece(5, 1_000_000, 0, len(TEXT), TEXT, BOOT),
    "IDENTITY": Identity(5, 1_000_000, 4, 4, 10, True, 20_000, 23, "A1", "demo 0.2", BOOT),
    "SELF_TEST": SelfTest(5, 1_000_000, (GOOD, OPEN), (GOOD, SHORTED, GOOD), ((1000.0, 998.5),), BOOT),
    "REPLY": Reply(5, 1_000_000, Order.RATE.value, Status.OUT_OF_RANGE, 3, BOOT),
    "DESCRIBE": Command(Order.DESCRIBE, sequence=1),
    "START": Command(Order.START, sequence=1),
    "STOP": Command(Order.STOP, sequence=1),
    "IDENTIFY": Command(Order.IDENTIFY, sequence=1),
    "ONE_FRAME": Command(Order.ONE_FRAME, sequence=1),
    "RATE": Command(Order.RATE, 20_000, sequence=1),
    "SELF_TEST command": Command(Order.SELF_TEST, sequence=1),
}

sequences = st.integers(0, 2**32 - 1)
boot_ids = st.integers(0, 2**32 - 1)
times = st.integers(0, 2**64 - 1)
texts = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=20)
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
line_states = st.lists(st.sampled_from(LineState), max_size=20).map(tuple)
ohms = st.floats(0, 1e9, width=32)
references = st.lists(st.tuples(ohms, ohms)).map(tuple)


@st.composite
def frames(draw: st.DrawFn) -> FramePacket:
    rows, columns = draw(st.integers(1, 20)), draw(st.integers(1, 20))
    payload = draw(st.binary(min_size=2 * rows * columns, max_size=2 * rows * columns))
    return FramePacket(
        draw(sequences), draw(times), rows, columns, payload, draw(st.sampled_from(Flag)), draw(boot_ids)
    )


@st.composite
def pieces(draw: st.DrawFn) -> DescriptionPiece:
    data = draw(st.binary(min_size=1, max_size=600))
    offset = draw(st.integers(0, MAX_DESCRIPTION - len(data)))
    total = draw(st.integers(offset + len(data), MAX_DESCRIPTION))
    return DescriptionPiece(draw(sequences), draw(times), offset, total, data, draw(boot_ids))


commands = st.builds(
    Command, st.sampled_from([order for order in Order if order is not Order.RATE]), sequence=sequences, time_us=times
) | st.builds(Command, st.just(Order.RATE), st.integers(0, 2**32 - 1), sequence=sequences)
packets = st.one_of(
    frames(),
    pieces(),
    st.builds(
        Identity,
        sequences,
        times,
        *[st.integers(0, 2**16 - 1)] * 2,
        st.integers(0, 32),
        st.booleans(),
        *[st.integers(0, 2**32 - 1)] * 2,
        texts,
        texts,
        boot_ids,
    ),
    st.builds(
        SelfTest, sequences, times, line_states, line_states, st.lists(st.tuples(ohms, ohms)).map(tuple), boot_ids
    ),
    st.builds(Reply, sequences, times, st.integers(0, 255), st.sampled_from(Status), sequences, boot_ids),
    commands,
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


def payload_of(packet: Packet) -> tuple[int, bytes]:
    """Packet type and payload, as docs/wire.md says."""
    match packet:
        case FramePacket():
            return 1, struct.pack("<HHH", packet.rows, packet.columns, packet.flags.value) + packet.payload
        case DescriptionPiece():
            return 2, struct.pack("<II", packet.offset, packet.total) + packet.data
        case Identity():
            numbers = packet.rows, packet.columns, packet.adc_bits, packet.streaming
            rest = struct.pack("<II", packet.period_us, packet.description_bytes)
            words = packet.serial_number.encode() + b"\0" + packet.firmware.encode() + b"\0"
            return 3, struct.pack("<HHBB", *numbers) + rest + words
        case SelfTest():
            head = struct.pack("<HHH", len(packet.rows), len(packet.columns), len(packet.references))
            lines = bytes(state.value for state in packet.rows + packet.columns)
            return 4, head + lines + b"".join(struct.pack("<ff", *pair) for pair in packet.references)
        case Reply():
            return 5, struct.pack("<BBI", packet.order, packet.status.value, packet.command_sequence)
        case Command(order=Order.RATE):
            return 0x86, struct.pack("<I", packet.period_us)
        case Command():
            return packet.order.value, b""


def raw(kind: int, payload: bytes, *, version: int = 2, sequence: int = 0, time_us: int = 0, boot_id: int = 0) -> bytes:
    """A stuffed packet without its delimiter, right or wrong, by the independent encoder."""
    body = struct.pack("<BBIIQ", kind, version, boot_id, sequence, time_us) + payload
    return stuff(body + struct.pack("<I", crc32(body)))


def independent(packet: Packet) -> bytes:
    """The line for ``packet`` by the independent encoder, without delimiter."""
    kind, payload = payload_of(packet)
    boot_id = 0 if isinstance(packet, Command) else packet.boot_id or 0
    assert packet.sequence is not None
    assert packet.time_us is not None
    return raw(kind, payload, sequence=packet.sequence, time_us=packet.time_us, boot_id=boot_id)


def by_bytes(decoder: PacketDecoder, data: bytes) -> list[object]:
    return [event for k in range(len(data)) for event in decoder.feed(data[k : k + 1])]


def document() -> str:
    return (Path(__file__).parents[1] / "docs" / "wire.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", LITERAL)
def test_literal_packets_both_ways_and_byte_by_byte(name: str) -> None:
    """The bytes are read from the document, which is written for people who have nothing else."""
    packet = LITERAL[name]
    (block,) = re.findall(
        rf"^{re.escape(name)}\b(?! command)[^\n]*:\n\n((?:    [0-9a-f ]+\n)+)", document(), flags=re.MULTILINE
    )
    data = bytes.fromhex(block.replace("\n", " "))
    assert encode(packet) == data
    assert independent(packet) + b"\0" == data
    assert PacketDecoder().feed(data) == [packet]
    assert by_bytes(PacketDecoder(), data) == [packet]
    assert decode(data[:-1]) == packet


def test_the_document_shows_no_other_packets() -> None:
    blocks = re.findall(r"(?:^    [0-9a-f ]+\n)+", document(), flags=re.MULTILINE)
    shown = b"".join(bytes.fromhex(block.replace("\n", " ")) for block in blocks if block.rstrip().endswith(" 00"))
    assert PacketDecoder().feed(shown) == list(LITERAL.values())


@settings(max_examples=50)
@given(packets)
def test_an_independent_encoder_agrees(packet: Packet) -> None:
    data = encode(packet)
    assert data.count(0) == 1
    assert data.endswith(b"\0")
    assert by_bytes(PacketDecoder(), data) == [packet]
    # Behind a group of 254 that ends the data, encoders may or may not add an empty group: both decode.
    assert decode(independent(packet)) == packet


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
    assert PacketDecoder().feed(before + b"\0" + encode(packet))[-1] == packet


@given(noise)
def test_every_byte_is_accounted_for(data: bytes) -> None:
    """Whole and byte by byte alike: packets, corrupt stretches and delimiters add up to what came."""
    data += b"\0"
    events = PacketDecoder().feed(data)
    assert by_bytes(PacketDecoder(), data) == events
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
    events = PacketDecoder().feed(bytes(line) + encode(Command(Order.START)))
    assert events[-1] == Command(Order.START)
    assert events[:-1]
    assert all(isinstance(event, Corrupt) for event in events[:-1])


@pytest.mark.parametrize(
    ("stretch", "reason"),
    [
        (b"\x05ab", "not COBS"),
        (stuff(b"x" * 21), "21 bytes, shorter than any packet"),
        (raw(0x05, bytes(6))[:-1] + b"\x7f", "checksum does not match"),
        (raw(0x05, bytes(6), version=3), "protocol version 3; this host speaks version 2"),
        (raw(0x7E, b""), "unknown packet type 0x7e"),
        (raw(0x01, b"\1\0"), "frame with 2 bytes of payload, expected at least 6"),
        (raw(0x01, b"\2\0\2\0\0\0" + b"\0" * 7), "frame of 2 x 2 cells with 7 bytes of counts; expected 2 for each"),
        (raw(0x01, b"\0\0\2\0\0\0"), "frame of 0 x 2 cells; expected 1 ... 65535 of each"),
        (raw(0x02, b"12345678"), "piece of a description with 8 bytes, expected more than 8"),
        (raw(0x02, struct.pack("<II", 0, 2**30) + b"{"), "description of 1073741824 bytes; at most"),
        (raw(0x02, struct.pack("<II", 5, 6) + b"{}"), "description of 6 bytes with a piece that ends at 7"),
        (raw(0x03, b"\0"), "identity with 1 bytes of payload, expected at least 14"),
        (raw(0x03, bytes(14) + b"A1\0"), "identity without serial number and firmware"),
        (raw(0x03, bytes(14) + b"\xff\0\0"), "identity with a text that is not UTF-8"),
        (raw(0x04, b""), "self-test with 0 bytes of payload, expected at least 6"),
        (raw(0x04, b"\1\0\1\0\1\0\0\0"), "self-test with 8 bytes of payload, expected 16"),
        (raw(0x04, b"\1\0\0\0\0\0\x09"), "self-test with a line state that is not known"),
        (raw(0x05, b""), "reply with 0 bytes of payload, expected 6"),
        (raw(0x05, b"\x82\x63\0\0\0\0"), "reply with status 99, which is not known"),
    ],
)
def test_what_breaks_a_rule_is_reported_with_that_rule(stretch: bytes, reason: str) -> None:
    with pytest.raises(ProtocolError, match=re.escape(reason)):
        decode(stretch)
    (event,) = PacketDecoder().feed(stretch + b"\0")
    assert isinstance(event, Corrupt)
    assert event.reason.startswith(reason)
    assert event.size == len(stretch)


@pytest.mark.parametrize(
    ("stretch", "expected"),
    [
        (raw(0x83, b"!", sequence=4), BadCommand(0x83, 4, Status.BAD_PAYLOAD)),
        (raw(0x86, b"", sequence=4), BadCommand(0x86, 4, Status.BAD_PAYLOAD)),
        (raw(0xC0, b"abc", sequence=4), BadCommand(0xC0, 4, Status.UNKNOWN_ORDER)),
        (raw(0x82, b"", sequence=4, version=1), BadCommand(0x82, 4, Status.WRONG_VERSION)),
    ],
)
def test_an_intact_command_that_cannot_be_taken_is_known_as_such(stretch: bytes, expected: BadCommand) -> None:
    assert decode(stretch) == expected
    assert board_protocol("ohmskin").feed(stretch + b"\0") == [expected]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (b"{", "is not JSON"),
        (b"\xff", "is not JSON"),
        (b"[]", "is not a JSON object"),
        (b'{"design":1}', "whose 'design' is no object"),
        (b'{"cell":{"a":NaN}}', "NaN is not a JSON number"),
        (b'{"cell":{"a":1e999}}', "a number is too large: 1e999"),
        (b'{"cell":{"a":' + b"9" * 400 + b"}}", "an integer is too large"),
        (b'{"cell":{"a":' + b"9" * 5000 + b"}}", "is not JSON"),
        (b'{"cell":{"a":' + b"[" * 100 + b"]" * 100 + b"}}", "more than 32 levels"),
        (b"[" * 200_000, "is not JSON"),
    ],
)
def test_a_description_has_limits(text: bytes, reason: str) -> None:
    with pytest.raises(ProtocolError, match=re.escape(reason)):
        read_description(text)
    piece = DescriptionPiece(0, 0, 0, len(text), text)
    (event,) = host_protocol("ohmskin").feed(encode(piece), 0.0)
    assert isinstance(event, Corrupt)
    assert reason in event.reason


def test_unknown_flags_texts_and_tables_are_left_unread() -> None:
    frame = decode(raw(0x01, struct.pack("<HHH", 1, 1, 0xFFFF) + b"\5\0", sequence=3))
    assert frame == FramePacket(3, 0, 1, 1, b"\5\0", Flag.OVERRUN | Flag.LAST, 0)
    who = decode(raw(0x03, bytes(14) + b"A1\0F\0red\0"))
    assert isinstance(who, Identity)
    assert (who.serial_number, who.firmware) == ("A1", "F")
    assert read_description(b'{"colour":"red","cell":{"a":1}}') == (None, {"a": 1})


def test_the_text_of_an_infinity_is_a_number() -> None:
    with pytest.raises(InputError, match="stands for a number"):
        write_description({"a": ["Infinity"]}, None)
    text = write_description({"readout": {"supply": [-math.inf, math.inf, 1.5]}}, {"a": "Infinite"})
    assert b'["-Infinity","Infinity",1.5]' in text
    assert read_description(text) == ({"readout": {"supply": [-math.inf, math.inf, 1.5]}}, {"a": "Infinite"})


@given(tables, tables, st.lists(st.integers(1, 300), min_size=1, max_size=5))
def test_a_description_comes_through_in_pieces_of_any_cut(
    design: dict[str, object], cell: dict[str, object], sizes: list[int]
) -> None:
    text = write_description(design, cell)
    packets = board_protocol("ohmskin").describe(text, sequence=3, time_us=4, boot_id=5)
    host, line, events, k = host_protocol("ohmskin"), b"".join(packets), list[Event](), 0
    while line:
        size = sizes[k % len(sizes)]
        events += host.feed(line[:size], 1.5)
        line, k = line[size:], k + 1
    assert events == [Description(3, 4, design, cell, 5)]


def test_pieces_of_different_boots_are_not_mixed() -> None:
    board, host = board_protocol("ohmskin"), host_protocol("ohmskin")
    before, after = ({"name": letter * 1000} for letter in "ab")
    old = board.describe(write_description(before, {}), sequence=0, time_us=0, boot_id=1)
    new = board.describe(write_description(after, {}), sequence=0, time_us=0, boot_id=2)
    assert not host.feed(b"".join(old[:2] + new[2:]), 0.0)
    assert host.feed(b"".join(new[:2]), 0.0) == [Description(0, 0, after, {}, 2)]


def test_every_order_of_a_host_is_understood_by_a_board() -> None:
    host, board = host_protocol("ohmskin"), board_protocol("ohmskin")
    for number, order in enumerate(Order, 1):
        period_us = 5_000 if order is Order.RATE else 0
        taken = board.feed(b"\x11noise" + host.request(order, period_us=period_us))
        assert taken == [Command(order, period_us, sequence=number)]


def test_a_line_that_echoes_is_reported() -> None:
    host = host_protocol("ohmskin")
    (event,) = host.feed(host.request(Order.START), 0.0)
    assert isinstance(event, Corrupt)
    assert "echoes" in event.reason


def test_an_unknown_family_names_the_nearest() -> None:
    with pytest.raises(InputError, match="no family of boards 'ohmskinn'; the nearest is 'ohmskin'"):
        host_protocol("ohmskinn")


def test_idle_zeros_are_no_events() -> None:
    assert PacketDecoder().feed(bytes(1000)) == []


def test_noise_without_end_takes_bounded_memory_and_is_reported_while_it_comes() -> None:
    decoder, block, corrupt, blocks = PacketDecoder(), b"\x01" * 100_000, 0, 250
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
        (lambda: Identity(0, 0, 1, 1, 8, True, 0, 0, "a\0", ""), "the character NUL"),
        (lambda: encode(Identity(0, 0, 1, 1, 8, True, 0, 0, "\ud800", "")), "cannot be sent"),
        (lambda: encode(Identity(0, 0, 1, 1, 800, True, 0, 0, "", "")), "cannot be sent"),
        (lambda: encode(FramePacket(None, None, 1, 1, b"ab")), "without sequence number or time"),
        (lambda: encode(DescriptionPiece(0, 0, 0, 9, b"x" * MAX_PAYLOAD)), "at most 4194304 fit"),
        (lambda: write_description({"gain": float("nan")}, {}), "not JSON"),
        (lambda: write_description({"name": "x" * MAX_DESCRIPTION}, {}), "at most 1048576 fit"),
        (lambda: Reply(0, 0, 1, Status.TAKEN, 0, boot_id=2**32), "boot id 4294967296"),
    ],
)
def test_packets_that_cannot_be_sent_are_refused(make: object, message: str) -> None:
    assert callable(make)
    with pytest.raises(InputError, match=re.escape(message)):
        make()


def test_the_smallest_description_of_the_page_is_a_design() -> None:
    """A board's author copies it and changes the numbers."""
    (line,) = (line.strip() for line in document().splitlines() if line.startswith('    {"design":{"array"'))
    tables, cell = read_description(line.encode())
    assert tables is not None
    assert cell is None
    design = Design.model_validate(tables)
    assert design.array.shape == (4, 4)
    assert design.adc is not None


def test_a_lost_piece_of_a_description_comes_with_the_next_description() -> None:
    board = board_protocol("ohmskin")
    tables = {"name": "x" * 1000}
    packets = board.describe(write_description(tables, {}), sequence=0, time_us=0, boot_id=1)
    assert len(packets) > 4
    for lost in range(len(packets)):
        host = host_protocol("ohmskin")
        assert not host.feed(b"".join(packets[:lost] + packets[lost + 1 :]), 0.0)
        events = host.feed(b"".join(packets), 0.0)
        assert events == [Description(0, 0, tables, {}, 1)]
        assert host.feed(b"".join(packets), 0.0) == events
