"""BOARD.toml: every format against literal bytes, in any cut, damaged, through emulator, driver and recording."""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from boards import Script, lossless, scene
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ohmskin.circuits import Design, Reason, adc_codes
from ohmskin.cli import run
from ohmskin.common.config import parse
from ohmskin.driver import Skin, discover
from ohmskin.emulator import PtyPort, running
from ohmskin.errors import InputError
from ohmskin.wire import (
    BOARDS,
    CHECKSUMS,
    FRAMINGS,
    BoardFile,
    Command,
    Corrupt,
    Event,
    Family,
    FramePacket,
    HostProtocol,
    Order,
    board_family,
    board_protocol,
    host_protocol,
)

NAMED = [name for name in BOARDS if name != "ohmskin"]
EXAMPLES = sorted((Path(__file__).parent.parent / "examples/boards").glob("*.toml"))
FRAME_S = 0.05
Counts = NDArray[np.uint16]


def described(frame: dict[str, Any], rows: int = 2, columns: int = 3, bits: int = 8, **start: Any) -> Family:
    tables = {"board": {"name": "mat", "rows": rows, "columns": columns, "bits": bits}, "frame": frame, "start": start}
    return BoardFile.parse(tables, "board.toml").family()


def text(layout: str = "frame-per-line", **keys: Any) -> Family:
    return described({"format": "text", "layout": layout, **keys})


def heard(family: Family, *pieces: bytes, apart_s: float = 0.0) -> list[Event]:
    host = host_protocol(family)
    return [event for k, piece in enumerate(pieces) for event in host.feed(piece, k * apart_s)]


def frames(events: list[Event]) -> list[list[list[int]]]:
    return [event.counts.tolist() for event in events if isinstance(event, FramePacket)]


def reasons(events: list[Event]) -> list[str]:
    return [event.reason for event in events if isinstance(event, Corrupt)]


A, B = [[1, 2, 3], [4, 5, 6]], [[7, 8, 9], [10, 11, 12]]


# Blocks


def blocks(*block: dict[str, Any], rows: int = 2, columns: int = 3, bits: int = 8, **keys: Any) -> Family:
    return described({"format": "binary", "block": list(block), **keys}, rows, columns, bits)


@given(
    repeat=st.integers(1, 4),
    count=st.integers(1, 5),
    word=st.sampled_from(["uint8", "uint16le", "uint16be", "int32be", "float32le"]),
    place=st.sampled_from(["", "index uint8", "index uint16be 1", "start uint16le"]),
    number=st.sampled_from(["", "number uint8", "number uint32le"]),
    clock=st.sampled_from(["", "time_us uint32be", "time_ms uint16le"]),
    check=st.sampled_from(["", "sum8", "crc16", "crc32"]),
    tail=st.sampled_from(["", "const 0x0D 0x0A"]),
    cut=st.integers(1, 60),
    seed=st.integers(0, 2**32),
)
def test_what_a_described_board_writes_its_host_reads(
    repeat: int, count: int, word: str, place: str, number: str, clock: str, check: str, tail: str, cut: int, seed: int
) -> None:
    """Whatever the fields, and however the bytes are cut; the stream is joined in the middle of a frame."""
    inner = ["const 0xAA 0x55", place, clock, "skip 1", f"cells {word} {count}", number, check, tail]
    block = {"fields": [one for one in inner if one], "repeat": repeat}
    # Blocks that say no place look alike: only a header ahead of them shows where a frame begins.
    head = [] if place or repeat == 1 else [{"fields": ["const 0xFE 0xFD 0xFC"]}]
    family = blocks(*head, block, rows=repeat, columns=count, bits=7)
    assert (family.has_sequence, family.has_device_time) == (bool(number), bool(clock))
    board, rng = board_protocol(family), np.random.default_rng(seed)
    sent = [
        FramePacket.of(rng.integers(0, 100, (repeat, count)), sequence=k, time_us=1000 * k) for k in range(300, 306)
    ]
    written = [board.frame(frame) for frame in sent]
    stream = b"".join(written)[len(written[0]) // 2 :]
    events = heard(family, *(stream[k : k + cut] for k in range(0, len(stream), cut)))
    found = [event for event in events if isinstance(event, FramePacket)]
    assert [one.counts.tolist() for one in found] == [one.counts.tolist() for one in sent[-len(found) :]]
    assert len(found) >= 4
    if number:
        assert np.diff([one.sequence or 0 for one in found]).tolist() == [1] * (len(found) - 1)
    if clock:
        assert np.diff([one.time_us or 0 for one in found]).tolist() == [1000] * (len(found) - 1)


def test_packets_of_a_frame_are_placed_by_what_they_say() -> None:
    """Literal bytes: start, two cells, number of the packet, "wr". A lost packet costs its frame."""
    family = blocks({"fields": ["start uint16le", "cells uint8 2", "number uint16be", "const 0x77 0x72"], "repeat": 3})
    packets = [bytes((2 * j, 0, 10 * k + j, 20 + j, 0, 3 * k + j)) + b"wr" for k in range(4) for j in range(3)]
    events = heard(family, *packets)
    assert frames(events) == [[[10 * k, 20, 10 * k + 1], [21, 10 * k + 2, 22]] for k in range(4)]
    assert [event.sequence for event in events if isinstance(event, FramePacket)] == [0, 1, 2, 3]
    del packets[4]
    assert frames(heard(family, *packets)) == [[[0, 20, 1], [21, 2, 22]], *frames(events)[2:]]


def test_a_map_places_each_number() -> None:
    family = text(map=[5, 3, 1, 4, 2, 0])
    assert frames(heard(family, b"cut\n", b"1 2 3 4 5 6\n")) == [[[6, 3, 5], [2, 4, 1]]]
    board = board_protocol(family)
    sent = board.frame(FramePacket.of(np.array([[6, 3, 5], [2, 4, 1]])))
    assert sent == b"1 2 3 4 5 6\r\n"


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        ({"block": [{"fields": ["cells uint8 5"]}]}, "5 cells in a frame; expected 6"),
        ({"block": [{"fields": ["cell uint8 6"]}]}, "'cell uint8 6' is no field"),
        ({"block": [{"fields": ["const 0x100"]}]}, "no whole number from 0 to 255"),
        ({"block": [{"fields": ["cells uint8 3", "cells uint16le 3"]}]}, "expected one word for all"),
        (
            {"block": [{"fields": ["cells uint8 6"], "repeat": 65536}, {"fields": ["skip 1048576"]}]},
            "more than 1048576",
        ),
        ({"block": [{"fields": ["cells uint8 6"]}], "word": "uint8"}, "word stands in place of [[frame.block]]"),
        ({}, "word is missing"),
        ({"word": "uint8", "map": [0, 1, 2, 3, 4, 4]}, "each place from 0 to 5 once"),
    ],
)
def test_fields_that_fit_no_frame_are_refused(frame: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as refused:
        described({"format": "binary", **frame})
    assert message in str(refused.value)


# Lines

LINE, CELL = b"1,2,3,4,5,6\n", [f"{k}\n".encode() for k in range(1, 7)]
ROWS, CELLS = {"layout": "row-per-line"}, {"layout": "cell-per-line"}
SKIPPED = {"skip": 1, "numbered_rows": True}
NUMBERED = [[b"%d: 1 2 3\n" % first, b"%d: 4 5 6\n" % (first + 1)] * 3 for first in (0, 1)]
BY_COLUMNS = [f"({r},{c}): {A[r][c]}\n".encode() for c in range(3) for r in range(2)]
NAMED_CELLS = [f"S{k + 1}={k + 7}\n".encode() for k in range(6)]
OTHER_NUMBERS: list[tuple[dict[str, Any], bytes]] = [
    ({"encoding": "hex"}, b"1 2 3 4 5 6"),
    ({"encoding": "hex", "separator": ","}, b"0x01,02,3,4,5,06"),
    ({"encoding": "hex", "word": "uint8"}, b"010203040506"),
    ({"encoding": "hex", "word": "uint16be", "prefix": "M"}, b"M000100020003000400050006"),
    ({"encoding": "base64", "word": "uint16le"}, b"AQACAAMABAAFAAYA"),
]
HEARD: list[tuple[dict[str, Any], list[bytes], list[Any]]] = [
    # Text beside the rows of a frame costs nothing; the first frame is the one that the host joins.
    (ROWS | {"end": ""}, [b"1 2 3\r\n4 5 6\r\nsum of all\r\n\r\n"] * 5, [A] * 4),
    (ROWS | {"end": ""}, [b"frame\r\n1 2 3\r\n4 5 6\r\n\r\n"] * 5, [A] * 4),
    (ROWS | {"end": "matrix"}, [b"centre\r\nmatrix\r\n1 2 3\r\n4 5 6\r\n"] * 5, [A] * 4),
    (ROWS | {"end": ""}, [b"1 2 3\r\n4 5 6\r\n-------\r\n\r\n"] * 5, [A] * 4),
    (ROWS | {"end": "---"}, [b"1 2 3\r\n4 5 6\r\n-------\r\n\r\n"] * 5, [A] * 4),
    # Between them it may be a damaged row.
    (ROWS | {"end": ""}, [b"1 2 3\r\n4 5 6\r\n\r\n", b"1 2 3\r\n4 x 6\r\n4 5 6\r\n\r\n"] * 2, [A]),
    # Anything may separate numbers, and a prefix tells them from other text.
    ({"separator": "xz"}, [b"cut\n", b"1x2x3xz4x5x6x\r\n"], [A]),
    *(({}, [b"cut\n", line], [A]) for line in (LINE, b" 1  2 3\t4;5, 6;\n", b"1.0 2e0 +3 4.4 4.6 6\n")),
    ({"prefix": "{", "suffix": "}"}, [b"{1,2,3,4,5,6}\n1,2,3,4,5,6\n{7,8,9\n{7 8 9 10 11 12 }\n"], [A, B]),
    ({"prefix": "data:"}, [b"data: 1 2 3 4 5 6\n9 9 9 9 9 9\ndata:7 8 9 10 11 12\n"], [A, B]),
    *((keys, [b"x\n", line + b"\r\n", line[:-1] + b"!\r\n", line + b"\n"], [A, A]) for keys, line in OTHER_NUMBERS),
    # A line for each cell; numbers with names; cells that say row and column in any order; rows with numbers.
    (CELLS | {"end": ""}, [b"5\n\n", *CELL, b"\n", *CELL[1:], b"\n", *CELL, b"\n"], [A, A]),
    ({"labels": True}, [b"\nA0:1,A1:2 A2 = 3 left:4,right: 5,up:6\n"], [A]),
    (CELLS | {"line": "({row},{column}): {cells}"}, [*BY_COLUMNS[3:], *BY_COLUMNS, *BY_COLUMNS], [A, A]),
    (CELLS | {"line": "S{index}={cells}"}, NAMED_CELLS * 2, [B, B]),
    *((ROWS | SKIPPED, [b"x\n", *rows[1:]], [A, A]) for rows in NUMBERED),
    *(
        (ROWS | {"skip": 1, "numbered_rows": True}, [b"x\n", *rows[:2], rows[0], *rows[2:4]], [A, A])
        for rows in NUMBERED
    ),
    # Copies of a frame are dropped, and equal frames are not.
    ({"copies": 2}, [b"x\n", *[LINE] * 2, *[b"7 8 9 10 11 12\n"] * 4, LINE], [A, B, B, A]),
    # Numbers find their cells.
    ({"order": "column-major"}, [b"\n", LINE], [[[1, 3, 5], [2, 4, 6]]]),
    ({"flip_rows": True}, [b"\n", LINE], [[[4, 5, 6], [1, 2, 3]]]),
    ({"flip_columns": True}, [b"\n", LINE], [[[3, 2, 1], [6, 5, 4]]]),
    ({"invert": True}, [b"\n", LINE], [[[254, 253, 252], [251, 250, 249]]]),
    ({"range": [1.0, 6.0]}, [b"\n", LINE], [[[0, 51, 102], [153, 204, 255]]]),
]


@pytest.mark.parametrize(("keys", "pieces", "expected"), HEARD)
def test_lines_are_read_as_the_file_says(keys: dict[str, Any], pieces: list[bytes], expected: list[Any]) -> None:
    assert frames(heard(text(**keys), *pieces)) == expected


def test_text_is_skipped_and_counted_and_damaged_lines_are_dropped() -> None:
    lines = b"\nrst:0x1 (POWERON),boot:0x13\n1,2,3,4,5,6\n\n1,2,3,4,5\n[wifi] rssi -60\n1,2,3,4,5,6,7\n7,8,9,10,11,12\n"
    events = heard(text(separator=","), lines)
    assert frames(events) == [A, B]
    assert len(reasons(events)) == 4
    assert "'[wifi] rssi -60'" in reasons(events)[2]
    assert reasons(events)[1] == "a line of 5 numbers; expected 6"


@pytest.mark.parametrize("missing", ["", "nan", "NaN", "null", "-", "inf", "ovf", "-3", "256", "1e99"])
def test_a_missing_or_impossible_number_costs_its_cell_or_the_frame(missing: str) -> None:
    line = f"\n1,2,{missing},4,5,6\n7,8,9,10,11,12\n".encode()
    marked, whole = (event for event in heard(text(separator=","), line) if isinstance(event, FramePacket))
    assert (marked.absent, whole.absent) == ((2,), ())
    assert marked.counts.tolist() == [[1, 2, 0], [4, 5, 6]]
    dropped = heard(text(separator=",", invalid="drop"), line)
    assert frames(dropped) == [B]
    assert "no count" in reasons(dropped)[0]


@pytest.mark.parametrize("end", ["", "flag", "Frame"])
def test_a_line_for_each_row_until_an_end_line(end: str) -> None:
    end_line = {"": b"\r\n", "flag": b"flag\r\n", "Frame": b"Frame 17 ---\r\n"}[end]
    rows = [b"1 2 3\r\n", b"4 5 6\r\n", end_line, b"7 8 9\r\n", b"10 11 12\r\n", end_line]
    family = text("row-per-line", end=end)
    assert frames(heard(family, end_line, *rows)) == [A, B]
    assert frames(heard(family, *rows)) == [B]  # the beginning of the first frame may be missing
    assert frames(heard(family, end_line, rows[0], *rows[2:])) == [B]  # a lost row
    assert frames(heard(family, end_line, *rows[:2], *rows[3:], *rows)) == [A, B]  # a lost end line costs both frames
    assert frames(heard(family, end_line, rows[0], b"wifi 5\n", *rows[1:])) == [B]
    assert frames(heard(family, end_line, *rows[:3], b"wifi: x\n", *rows[3:])) == [A, B]


def test_pauses_show_where_a_frame_begins_where_nothing_else_does() -> None:
    family = text("row-per-line")
    host, seen, time_s = host_protocol(family), list[list[list[int]]](), 0.0
    for number in range(40):
        for row in range(2):
            if number or row:  # the host joins at the second row
                seen += frames(host.feed(f"{row} {number} 0\n".encode(), time_s))
            time_s += 0.001 if row == 0 else 0.03
        if number == 20:
            host.feed(b"5 5 5\n", time_s)  # a line too many: the pauses show the order again
    good = [[[0, number, 0], [1, number, 0]] for number in range(40)]
    assert sum(frame in good for frame in seen) >= 30
    assert all(frame in good for frame in seen[-10:])
    unpaced = heard(family, *[b"1 2 3\n", b"4 5 6\n"] * 10)
    assert frames(unpaced)
    assert any("ambiguous" in reason for reason in reasons(unpaced))


@given(
    line=st.sampled_from(
        ["{time_us};{row}:{cells}", "R{row} = {cells}", "[{row}] {cells} *{text}", "{number},{row},{cells},{time_ms}"]
    ),
    separator=st.sampled_from([None, ",", ";", "\t"]),
    first=st.sampled_from([0, 1]),
    newline=st.sampled_from(["\r\n", "\n"]),
    seed=st.integers(0, 2**32),
)
def test_a_pattern_says_what_a_line_looks_like(
    line: str, separator: str | None, first: int, newline: str, seed: int
) -> None:
    """Lines made from the pattern by hand, joined in the middle of a frame; one row lost costs its frame."""
    keys = {"line": line} | ({} if separator is None else {"separator": separator})
    family = described({"format": "text", "layout": "row-per-line", **keys}, 4, 3, 10)
    rng, sent, lines = np.random.default_rng(seed), [], []
    for k in range(6):
        sent.append(rng.integers(0, 1024, (4, 3)))
        for row, cells in enumerate(sent[-1]):
            text = line.replace("{cells}", (separator or " ").join(map(str, cells))).replace("{row}", str(row + first))
            for name, value in (("time_us", 5000 * k), ("time_ms", 5 * k), ("number", 250 + k), ("text", "5F")):
                text = text.replace(f"{{{name}}}", str(value % 256 if name == "number" else value))
            lines.append((text + newline).encode())
    del lines[4 * 3 + 2]
    events = [event for event in heard(family, *lines[2:]) if isinstance(event, FramePacket)]
    assert [event.counts.tolist() for event in events] == [sent[k].tolist() for k in (1, 2, 4, 5)]
    if "time" in line:
        assert [event.time_us for event in events] == [5000 * k for k in (1, 2, 4, 5)]
    if "number" in line:  # of one byte
        assert [event.sequence for event in events] == [250 + k for k in (1, 2, 4, 5)]


@given(frame=st.binary(min_size=6, max_size=400), name=st.sampled_from(sorted(FRAMINGS)))
def test_a_framing_gives_back_what_it_was_given(frame: bytes, name: str) -> None:
    """And its delimiter stands between packets only."""
    framing = FRAMINGS[name]
    frame = frame.replace(b"\xff", b"\xfe") if name == "zero-runs" else frame
    inner = framing.write(frame).strip(bytes([framing.delimiter]))
    assert framing.delimiter not in inner
    assert framing.decode(inner, len(frame)) == frame


def test_literal_bytes_of_each_framing() -> None:
    assert FRAMINGS["zero-runs"].write(bytes(300) + b"\x07\0") == b"\x00\xfe\x00\x2e\x07\x00\x01\xff"
    assert FRAMINGS["slip"].write(b"\xc0\x01\xdb") == b"\xc0\xdb\xdc\x01\xdb\xdd\xc0"
    family = binary(word="uint8", framing="zero-runs")
    whole = b"\x01\x00\x02\x04\x05\x06\xff"
    events = heard(family, whole[3:], whole, b"\x01\x00\xff", b"\x00\x06\xff")
    assert frames(events) == [[[1, 0, 0], [4, 5, 6]], [[0, 0, 0], [0, 0, 0]]]


def test_two_numbers_share_three_bytes() -> None:
    """Literal bytes of 0x123 0x456 0x789 in both orders."""
    for name, line in (("uint12le", b"\x23\x61\x45\x89\x07"), ("uint12be", b"\x12\x34\x56\x78\x90")):
        family = described({"format": "binary", "word": name, "header": [0xFE, 0xEF]}, 1, 3, 12)
        assert frames(heard(family, *[b"\xfe\xef" + line] * 3))[-1] == [[0x123, 0x456, 0x789]]
        assert (
            board_protocol(family).frame(FramePacket.of([[0x123, 0x456, 0x789]], sequence=0, time_us=0))
            == b"\xfe\xef" + line
        )


def test_json_keys_with_stars_and_named_numbers() -> None:
    rows = described({"format": "json", "key": "row*", "time_ms": "t", "number": "head.n"})
    document = {"t": 12, "head": {"n": 3}, "row0": [1, 2, 3], "row1": [4, 5, 6]}
    (event,) = [e for e in heard(rows, json.dumps(document).encode() + b"\n") if isinstance(e, FramePacket)]
    assert (event.counts.tolist(), event.time_us, event.sequence) == (A, 12_000, 3)
    items = described({"format": "json", "key": "s.*.v"})
    document = {"s": [{"id": k, "v": k + 1} for k in range(6)]}
    assert frames(heard(items, json.dumps(document).encode() + b"\n")) == [A]
    lines = described({"format": "json", "key": "v", "layout": "row-per-line", "row_number": "r"})
    sent = [json.dumps({"r": r, "v": A[r]}).encode() + b"\n" for r in (1, 0, 1, 0, 1)]
    assert frames(heard(lines, *sent)) == [A, A]


def test_json_documents() -> None:
    family = described({"format": "json", "key": "sensor.values"})
    lines = b'{"sensor": {"values": [1,2,3,4,5,6]}}\n{"log": "x"}\n{"sensor":{"values":[[7,8,9],[10,null,nan]]}}\nsens'
    first, second = (event for event in heard(family, lines) if isinstance(event, FramePacket))
    assert first.counts.tolist() == A
    assert second.absent == (4, 5)
    assert frames(heard(described({"format": "json"}), b'[1,2,3,4,5,6]\n[1,"2",3,4,5,6]\n[1,2,3\n')) == [A]
    for hostile in (b"[" * 5000, b"[1e999,2,3,4,5,6]", b"[" + b"9" * 900 + b",2,3,4,5,6]", b"{}", b"[true,2,3,4,5,6]"):
        assert all(frame[1] == [4, 5, 6] for frame in frames(heard(described({"format": "json"}), hostile + b"\n")))


# Words


def binary(**keys: Any) -> Family:
    bits = keys.pop("bits", 8)
    return described({"format": "binary", **keys}, bits=bits)


@pytest.mark.parametrize(
    ("word", "line"),
    [
        ("uint8", b"\x01\x02\x03\x04\x05\x06"),
        ("uint16le", struct.pack("<6H", *range(1, 7))),
        ("uint16be", struct.pack(">6H", *range(1, 7))),
        ("int32le", struct.pack("<6i", *range(1, 7))),
        ("uint32be", struct.pack(">6I", *range(1, 7))),
        ("float32le", struct.pack("<6f", *range(1, 7))),
        ("float64be", struct.pack(">6d", *range(1, 7))),
    ],
)
def test_words_in_literal_bytes(word: str, line: bytes) -> None:
    family = binary(word=word, bits=7, header=[0xAA, 0x55], before=1, after=2)
    whole = b"\xaa\x55\x99" + line + b"\x98\x97"
    assert frames(heard(family, whole * 3)) == [A, A, A]
    sent = board_protocol(family).frame(FramePacket.of(np.array(A), sequence=0, time_us=0))
    assert sent == b"\xaa\x55\0" + line + b"\0\0"


@given(
    word=st.sampled_from(["float32le", "float64be", "int32le", "uint16be"]),
    bits=st.integers(1, 16),
    middle=st.one_of(st.floats(-1e39, 1e39), st.sampled_from([0.0, 1e-308, 1e308])),
    width=st.floats(-320.0, 308.0).map(lambda power: 10.0**power),
    seed=st.integers(0, 2**32),
)
def test_the_numbers_of_a_range_are_refused_or_told_apart(
    word: str, bits: int, middle: float, width: float, seed: int
) -> None:
    """The ends lie so near to each other, or so far out, that some words hold all counts and others do not."""
    try:
        family = binary(word=word, bits=bits, range=[middle, middle + width], framing="cobs")
    except InputError:
        assert not (word.startswith("float") and 1e-30 < width < 1e30 and abs(middle) <= 10 * width)
        return
    counts = np.random.default_rng(seed).integers(0, 2**bits, (2, 3)).astype(np.uint16)
    sent = board_protocol(family).frame(FramePacket.of(counts, sequence=0, time_us=0))
    assert frames(heard(family, sent * 3))[-1] == counts.tolist()


@pytest.mark.parametrize("name", CHECKSUMS)
def test_the_usual_check_value_of_every_checksum(name: str) -> None:
    """Of the ASCII text "123456789", as the catalogues of CRCs list it."""
    values = {
        "sum8": 0xDD, "crc8": 0xF4, "xor8": 0x31, "sum16le": 0x1DD, "sum16be": 0x1DD, "crc16-ccitt": 0x29B1,
        "crc16-xmodem": 0x31C3, "crc16-modbus": 0x4B37, "crc32": 0xCBF43926,
    }  # fmt: skip
    order = "big" if name.endswith("be") else "little"
    expected = values[name.removesuffix("-be")].to_bytes(CHECKSUMS[name].size, order)  # type: ignore[arg-type]
    assert CHECKSUMS[name].of(b"123456789") == expected


@pytest.mark.parametrize("of", ["payload", "body", "frame"])
def test_a_checksum_is_of_what_the_file_says(of: str) -> None:
    family = binary(word="uint8", header=[0xAA, 0x55], before=1, checksum="crc32", checksum_of=of)
    head, ahead, cells = b"\xaa\x55", b"\x07", b"\1\2\3\4\5\6"
    covered = {"payload": cells, "body": ahead + cells, "frame": head + ahead + cells}[of]
    whole = head + ahead + cells + struct.pack("<I", zlib.crc32(covered))
    assert frames(heard(family, b"boot\r\n" + whole[3:], whole, b"debug: 5\r\n", whole)) == [A, A]
    assert frames(heard(family, whole[:4] + b"\x09" + whole[5:], whole)) == [A]


def test_text_between_frames_without_a_checksum_is_skipped() -> None:
    family = binary(word="uint8", header=[0xAA, 0x55])
    frame = b"\xaa\x55\1\2\3\4\5\6"
    events = heard(family, b"boot ok\r\n", *[frame + b"[wifi] rssi -60\r\n", frame] * 4)
    assert frames(events) == [A] * 8
    assert reasons(events).count("text between two frames") == 4


@pytest.mark.parametrize("start", [{"poll": "a"}, {"send": "go", "poll": "a"}, {"send": [1, 2]}])
def test_a_board_is_started_and_asked(start: dict[str, Any]) -> None:
    family = described({"format": "text"}, **start)
    host, board = host_protocol(family), board_protocol(family)
    begins, asks = host.request(Order.START), host.request(Order.ONE_FRAME)
    assert family.polled == bool(asks)
    one = FramePacket.of(np.array(A), sequence=0, time_us=0)
    if begins:
        assert board.frame(one) == b""
    commands = board.feed(begins + asks)
    assert commands == ([Command(Order.ONE_FRAME)] if asks else [Command(Order.START)])
    assert board.frame(one) == b"1 2 3 4 5 6\r\n"
    if asks:
        assert frames(host.feed(board.frame(one), 0.0)) == [A]  # a reply is whole


# Any stream


def pictures(family: Family, count: int) -> list[Counts]:
    layout, random = family.layout, np.random.default_rng(7)
    most = (
        255 if (family.tables or {}).get("frame", {}).get("framing") == "zero-runs" else 2**layout.adc_bits
    )  # 255 ends a frame there
    return [random.integers(0, most, (layout.rows, layout.columns)).astype(np.uint16) for _ in range(count)]


def sent_by(family: Family, shown: list[Counts]) -> list[bytes]:
    board = board_protocol(family)
    board.feed(host_protocol(family).request(Order.START))
    return [board.frame(FramePacket.of(counts, sequence=0, time_us=0)) for counts in shown]


def fed(host: HostProtocol, pieces: list[bytes], cuts: list[int]) -> Iterator[Event]:
    """The events of frames that come at an even pace, each in pieces that end at ``cuts``."""
    for number, piece in enumerate(pieces):
        at = k = 0
        while at < len(piece):
            yield from host.feed(piece[at : at + cuts[k % len(cuts)]], number * FRAME_S + 1e-5 * k)
            at, k = at + cuts[k % len(cuts)], k + 1


@pytest.mark.parametrize("board", [*NAMED, *EXAMPLES], ids=lambda board: Path(board).stem)
@settings(max_examples=10)
@given(cuts=st.lists(st.integers(1, 900), min_size=1, max_size=5))
def test_frames_come_through_in_any_cut(board: str | Path, cuts: list[int]) -> None:
    family = board_family(board)
    shown = pictures(family, 8)
    pieces = sent_by(family, shown)
    seen = [
        event.counts for event in fed(host_protocol(family), [*pieces, *pieces], cuts) if isinstance(event, FramePacket)
    ]
    assert len(seen) >= 2 * len(shown) - 5
    for one in seen:
        assert any(np.array_equal(one, counts) for counts in shown)


@pytest.mark.parametrize("board", [*NAMED, *EXAMPLES], ids=lambda board: Path(board).stem)
@settings(max_examples=10)
@given(noise=st.binary(max_size=300), cut=st.integers(0, 2000))
def test_damage_costs_the_frames_that_it_hits(board: str | Path, noise: bytes, cut: int) -> None:
    """Where the format has a checksum, a length or whole lines, no wrong frame is taken."""
    family, name = board_family(board), Path(board).stem
    shown = pictures(family, 6)
    pieces = sent_by(family, shown * 3)
    pieces[2] = pieces[2][: min(cut, len(pieces[2]))] + noise
    events = list(fed(host_protocol(family), pieces, [4096]))
    seen = [event for event in events if isinstance(event, FramePacket)]
    for counts in shown:
        assert sum(np.array_equal(one.counts, counts) for one in seen) >= (
            1 if name in ("raw-bytes", "fsr-array") else 2
        )
    wrong = [one for one in seen if not any(np.array_equal(one.counts, counts) for counts in shown)]
    # Digits in noise may change the number that they meet; nothing else may.
    unchecked = {"raw-bytes": 6} | dict.fromkeys(("flexitac", "fsr-array", "m1616", "wiresens", "actionsense"), 2)
    allowed = unchecked.get(name, 0 if name in ("crc", "cobs") else 1)
    assert len(wrong) <= allowed


# With driver, emulator and recordings


def emulated(family: Family, rate_hz: float = 40.0) -> Any:
    """A scene whose board has the array and the converter of the family, a divider in each column."""
    layout = family.layout
    press = {"cells": [[min(layout.rows - 1, 1), 1]], "load_kpa": [[0.0, 0.0], [0.05, 12.0]]}
    design = {
        "array": {"rows": layout.rows, "columns": layout.columns},
        "drive": {"voltage": 3.3, "idle_rows": "ground"},
        "readout": {"circuit": "voltage-divider", "reference_resistance": 1e3},
        "adc": {"bits": layout.adc_bits, "range": [0.0, 3.3]},
    }
    return scene(skin={"design": design}, contact=[press], board={"frame_rate": rate_hz})


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_end_to_end(path: Path, tmp_path: Path) -> None:
    """Emulator, pty, driver, recording and replay without the file: counts of the press, tared.

    Where only pauses part the frames, a busy machine joins and cuts them; what a host makes of pauses is tested above
    on a clock of its own.
    """
    family, port, what = board_family(path), PtyPort(), emulated(board_family(path))
    with running(what, port, family=str(path), truth=tmp_path / "truth.npz"):
        with Skin.open(port.name, board=str(path), timeout=30.0, delivery="every", record=tmp_path / "x.mcap") as skin:
            taken = list(islice(skin, 6))
            assert not skin.knows_circuit
            assert skin.shape == (family.layout.rows, family.layout.columns)
            with pytest.raises(InputError, match="is not known; expected a design"):
                _ = skin.design
            tare = skin.tare(4, force=True)
            after = skin.read()
        (found,) = discover([port.name], board=path, timeout=20.0)
    assert (found.rows, found.columns) == (family.layout.rows, family.layout.columns)
    with np.load(tmp_path / "truth.npz") as truth:
        scanned = adc_codes(what.skin.design, truth["volts"])
    sent = [bool((scanned == frame.counts).all(axis=(1, 2)).any()) for frame in taken]
    assert all(sent) or path.stem == "raw-bytes"
    for frame in taken:
        assert frame.valid.all()
        assert np.isnan(frame.resistance).all()
        assert np.isnan(frame.pressure).all()
    assert tare.rest_counts is not None
    np.testing.assert_array_equal(after.rest_counts, tare.rest_counts)
    np.testing.assert_allclose(after.change, after.counts - tare.rest_counts)
    with Skin.open(tmp_path / "x.mcap") as again:
        assert again.family.name == family.name
        replayed = list(again)
    np.testing.assert_array_equal([frame.counts for frame in replayed[:6]], [frame.counts for frame in taken])
    np.testing.assert_array_equal(replayed[-1].rest_counts, after.rest_counts)


def test_a_design_and_a_cell_give_ohms_and_pressures(tmp_path: Path) -> None:
    what = emulated(board_family(Path(__file__).parent.parent / "examples/boards/kobakant.toml"))
    lines = ['[board]\nname = "mat"\nrows = 7\ncolumns = 7\nbits = 10\ndesign = "circuit.toml"\ncell = "cell.toml"']
    lines.append('[frame]\nformat = "text"')
    (tmp_path / "board.toml").write_text("\n".join(lines))
    design = what.skin.design
    (tmp_path / "circuit.toml").write_text(
        '[array]\nrows = 7\ncolumns = 7\n[drive]\nvoltage = 3.3\nidle_rows = "ground"\n'
        '[readout]\ncircuit = "voltage-divider"\nreference_resistance = 1e3\n[adc]\nbits = 10\nrange = [0.0, 3.3]\n'
    )
    what.skin.cell.save(tmp_path / "cell.toml")
    board, port = tmp_path / "board.toml", PtyPort()
    with (
        running(what, port, family=str(board)),
        Skin.open(port.name, board=board, timeout=60.0, record=tmp_path / "x.mcap") as skin,
    ):
        taken = list(islice(skin, 12))
    assert skin.design.array.shape == design.array.shape
    assert taken[-1].pressure[1, 1] > 6.0
    for file in ("board.toml", "circuit.toml", "cell.toml"):
        (tmp_path / file).unlink()
    with Skin.open(tmp_path / "x.mcap") as again:
        assert list(again)[-1].pressure[1, 1] > 6.0


def test_a_cell_that_the_board_leaves_out_is_marked_as_missing() -> None:
    design = {
        "array": {"rows": 2, "columns": 3},
        "drive": {"voltage": 3.3},
        "readout": {"circuit": "voltage-divider", "reference_resistance": 1e3},
        "adc": {"bits": 8, "range": [0.0, 3.3]},
    }
    port = Script(b"\n10,20,30,40,50,60\n10,20,,40,50,60\n")
    with lossless(port, board=text(separator=","), design=parse(design, Design, source="design"), timeout=30.0) as skin:
        whole, marked = skin.read(), skin.read()
    assert whole.valid.all()
    assert marked.reason[0, 2] == Reason.MISSING
    assert marked.counts[0, 2] == 0
    others = np.arange(6).reshape(2, 3) != 2
    np.testing.assert_allclose(marked.resistance[others], whole.resistance[others], rtol=1e-6)


# Files


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"board": {"row": 3}}, "unknown key 'board.row'; the nearest known key, 'rows', is there already"),
        ({"board": {"bits": 17}}, "board.bits: input should be less than or equal to 16 (got 17)"),
        ({"frame": {"format": "txt"}}, "frame.format: input should be 'text', 'json' or 'binary' (got 'txt')"),
        ({"frame": {"end": ""}}, 'end has no effect on layout = "frame-per-line"'),
        ({"frame": {"header": [1]}}, "unknown key 'frame.text.header'"),
        ({"frame": {"separator": "1"}}, "frame.text.separator"),
        ({"frame": {"range": [5.0, 5.0]}}, "the smaller number first"),
        (
            {"frame": {"format": "binary", "word": "float32le", "framing": "cobs", "range": [0.0, 1e-308]}},
            "cannot tell",
        ),
        ({"start": {"send": [256]}}, "start.send"),
        ({"frame": {"format": "binary", "word": "uint8"}, "board": {"bits": 12}}, "a uint8 has 8 bits"),
        ({"frame": {"format": "binary", "word": "uint8", "checksum": "sum8"}}, "expected a header or framing"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(
    changes: dict[str, Any], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tables: dict[str, Any] = {"board": {"name": "m", "rows": 2, "columns": 3, "bits": 8}, "frame": {"format": "text"}}
    for name, keys in changes.items():
        tables[name] = tables.get(name, {}) | keys
    lines = [
        f"[{name}]\n" + "\n".join(f"{key} = {json.dumps(value)}" for key, value in keys.items())
        for name, keys in tables.items()
    ]
    path = tmp_path / "mat.toml"
    path.write_text("\n".join(lines))
    with pytest.raises(InputError) as refused:
        board_family(path)
    assert str(path) in str(refused.value)
    assert message in str(refused.value)
    assert run(["record", "/dev/null", "--board", str(path), "-o", str(tmp_path / "x.mcap")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_design_of_another_size_is_refused() -> None:
    with pytest.raises(
        InputError, match=r"board 'mat' has 2 x 3 cells of 8 bits in its BOARD\.toml; the design has 4 x 4"
    ):
        host_protocol(text(), shape=(4, 4))


def test_the_family_of_the_documentation_works_and_its_recordings_open_with_it_alone(tmp_path: Path) -> None:
    page = (Path(__file__).parent.parent / "docs/boards.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names: dict[str, Any] = {}
    exec(code, names)  # the reader's own program
    family, port = names["HEX"], PtyPort()
    with (
        running(emulated(family), port, family=family),
        Skin.open(port.name, board=family, timeout=30.0, record=tmp_path / "x.mcap") as skin,
    ):
        counts = skin.read().counts
    assert counts.shape == (1, 8)
    with pytest.raises(InputError, match=r"x\.mcap: a recording of the board 'hex', .* give it \(board=\)"):
        Skin.open(tmp_path / "x.mcap")
    with Skin.open(tmp_path / "x.mcap", board=family) as again:
        np.testing.assert_array_equal(next(again).counts, counts)


def test_the_page_names_every_key_and_every_example() -> None:
    page = (Path(__file__).parent.parent / "docs/boards.md").read_text()
    frame = BoardFile.model_json_schema()["$defs"]
    keys = {key for name, table in frame.items() if name.endswith(("Frame", "Table")) for key in table["properties"]}
    assert not {key for key in keys if f"`{key}" not in page and f"\n{key} = " not in page}
    assert not [path.name for path in EXAMPLES if f"({'../examples/boards/' + path.name})" not in page]


@pytest.mark.parametrize(
    "keys",
    [
        {"layout": "row-per-line", "end": "a\nb"},
        {"layout": "row-per-line", "end": "\n"},
        {"layout": "row-per-line", "end": "\x0c"},
        {"layout": "row-per-line", "end": "\u00e9"},
        {"prefix": " d"},
        {"prefix": "d\n"},
        {"suffix": "x\t"},
        {"suffix": "\u00e9"},
        {"separator": "\u00a0"},
        {"separator": "|", "newline": " ;\r\n"},
    ],
)
def test_a_text_that_no_line_matches_is_refused(keys: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"frame\.text: (end: .* is no line|a line of .* would not)"):
        text(**keys)


def test_a_family_of_ones_own_package_is_found_by_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "matfamily.py").write_text(
        "from ohmskin.wire import BoardFile\n"
        "MAT = BoardFile.parse({'board': {'name': 'mat', 'rows': 2, 'columns': 3},"
        " 'frame': {'format': 'text'}}, 'mat').family()\n"
        "WRONG = 5\n"
    )
    info = tmp_path / "matfamily-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: matfamily\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[ohmskin.boards]\nmat = matfamily:MAT\nwrong = matfamily:WRONG\nlost = matfamily:NOTHING\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert board_family("mat").layout.columns == 3
    with pytest.raises(
        InputError, match=r"family 'wrong' of the package matfamily is 5; expected an ohmskin\.wire\.Family"
    ):
        board_family("wrong")
    with pytest.raises(InputError, match="family 'lost' of the package matfamily cannot be imported"):
        board_family("lost")
    with pytest.raises(InputError, match="no family of boards 'mta'; the nearest is 'mat'"):
        board_family("mta")
