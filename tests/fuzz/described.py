"""Judges of BOARD.toml and of the streams that it describes, which share no code with the readers they judge.

The frames of a stream are decoded once more here, from the words of docs/boards.md: lines by splitting, packets by
trying every place. Where a format has whole lines, a checksum or COBS, the host must find the same frames, in any cut.
"""

from __future__ import annotations

import json
import math
import random
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from cobs import cobs

from ohmskin.wire import BoardFile, Family, FramePacket, Order, board_protocol, host_protocol

ROWS, COLUMNS = 2, 3
CELLS = ROWS * COLUMNS
LONGEST_LINE = 1000
"""bytes; longer lines may be dropped"""
Values = list[float | None]
"""the numbers of a frame; None: missing or out of range"""
_CHARACTERS = re.compile(r"[-+.0-9eE]{1,40}")
_MISSING = {"", "-", "nan", "null", "none", "inf", "ovf"}


def board_text(rng: random.Random) -> bytes:
    """A valid BOARD.toml."""
    frame = rng.choice(
        (
            'format = "text"\nseparator = ","\nprefix = "d:"',
            'format = "text"\nlayout = "row-per-line"\nend = "flag"\nrange = [-2048.0, 2047.0]\norder = "column-major"',
            'format = "json"\nkey = "a.b"\ninvert = true\ninvalid = "drop"',
            'format = "binary"\nword = "uint16be"\nheader = [170, 85]\nbefore = 3\nchecksum = "crc16-modbus"',
            'format = "binary"\nword = "float32le"\nframing = "cobs"\nrange = [0.0, 1.0]\nflip_rows = true',
        )
    )
    start = rng.choice(('send = "go"\ndtr = false', 'poll = "a"', "send = [1, 2, 255]"))
    head = 'name = "mat"\nrows = 4\ncolumns = 5\nbits = 12\nbaudrate = 115200'
    return f"[board]\n{head}\n\n[frame]\n{frame}\n\n[start]\n{start}\n".encode()


def round_trip(path: Path, rng: random.Random) -> None:
    """What the described board sends, the described host reads, however the file describes it."""
    file = BoardFile.load(path)
    rows, columns, bits = file.board.rows, file.board.columns, file.board.bits
    if rows * columns > 400:
        return
    again = BoardFile.parse(json.loads(json.dumps(file.tables())), "again")
    shown = [
        np.array([rng.randrange(2**bits) for _ in range(rows * columns)]).reshape(rows, columns) for _ in range(12)
    ]
    for family in (file.family(), again.family()):
        board, host = board_protocol(family), host_protocol(family)
        board.feed(host.request(Order.START))
        found = []
        for number, counts in enumerate(shown):
            data = board.frame(FramePacket.of(counts, sequence=0, time_us=0))
            found += [e.counts for e in host.feed(data, 0.1 * number) if isinstance(e, FramePacket)]
        if _proves(file):
            assert found, "no frame of the described board is read"
            assert all(any(np.array_equal(one, counts) for counts in shown) for one in found), "a frame is read wrongly"


def _proves(file: BoardFile) -> bool:
    """Whether frames of the format cannot be mistaken: lines that end, checksums of some bytes, COBS."""
    frame = file.frame
    if frame.format == "binary":
        return frame.framing == "cobs" or frame.checksum not in ("none", "sum8", "xor8", "crc8")
    return frame.layout == "frame-per-line" or frame.end is not None


# Streams: for each format its tables, the bytes of a frame, and the frames of any bytes.


def _line(numbers: Values) -> bytes:
    return ",".join("" if number is None else f"{number:g}" for number in numbers).encode()


def _number(word: str) -> float | None:
    """The value of a word; NaN where it stands for a missing number, None where it is none."""
    if _CHARACTERS.fullmatch(word):
        try:
            return float(word)
        except ValueError:
            pass
    return math.nan if word.lstrip("+-").lower() in _MISSING else None


def _numbers(line: str, expected: int) -> Values | None:
    words = [word.strip() for word in line.split(",")]
    if len(words) == expected + 1 and words[-1] == "":
        del words[-1]
    values = [_number(word) for word in words]
    return None if None in values else values


def _plain(line: bytes) -> str | None:
    return line.decode("ascii").strip(" \t\r\0") if line.isascii() else None


def _by_line(data: bytes) -> list[Values]:
    frames = []
    first = True
    for line in data.split(b"\n")[:-1]:
        text = _plain(line)
        cut, first = first, False
        if text and not cut:
            values = _numbers(text, CELLS)
            if values is not None and len(values) == CELLS:
                frames.append(values)
    return frames


def _by_rows(data: bytes) -> list[Values]:
    frames: list[Values] = []
    rows: list[Values] | None = None
    broken = True
    for line in data.split(b"\n")[:-1]:
        text = _plain(line)
        if text == "":
            if rows is not None and not broken and len(rows) == ROWS:
                frames.append([value for row in rows for value in row])
            rows, broken = [], False
            continue
        rows = [] if rows is None else rows
        values = None if text is None else _numbers(text, COLUMNS)
        if values is None:
            broken = broken or text is None or bool(rows)
        else:
            rows.append(values)
            broken = broken or len(values) != COLUMNS
    return frames


def _by_zeros(data: bytes) -> list[Values]:
    frames = []
    for stretch in data.split(b"\0")[:-1]:
        try:
            body = bytes(cobs.decode(stretch)) if stretch else b""
        except cobs.DecodeError:
            continue
        if len(body) == 2 * CELLS + 1 and sum(body[:-1]) % 256 == body[-1]:
            frames.append(list(map(float, struct.unpack(f"<{CELLS}H", body[:-1]))))
    return frames


def _cobs_frame(numbers: Values) -> bytes:
    body = struct.pack(f"<{CELLS}H", *(int(number or 0) for number in numbers))
    return bytes(cobs.encode(body + bytes([sum(body) % 256]))) + b"\0"


def _crc_frame(numbers: Values) -> bytes:
    body = b"\x07" + struct.pack(f">{CELLS}H", *(int(number or 0) for number in numbers))
    return b"\xa5\x5a" + body + struct.pack("<I", zlib.crc32(body))


def _by_crc(data: bytes) -> list[Values]:
    size, frames, at = 2 + 1 + 2 * CELLS + 4, [], 0
    while at + size <= len(data):
        body = data[at + 2 : at + size - 4]
        if data[at : at + 2] == b"\xa5\x5a" and data[at + size - 4 : at + size] == struct.pack("<I", zlib.crc32(body)):
            frames.append(list(map(float, struct.unpack(f">{CELLS}H", body[1:]))))
            at += size
        else:
            at += 1
    return frames


FORMATS: list[tuple[dict[str, object], Callable[[Values], bytes], Callable[[bytes], list[Values]]]] = [
    ({"format": "text", "separator": ","}, lambda numbers: _line(numbers) + b"\r\n", _by_line),
    (
        {"format": "text", "separator": ",", "layout": "row-per-line", "end": ""},
        lambda numbers: _line(numbers[:COLUMNS]) + b"\n" + _line(numbers[COLUMNS:]) + b"\n\n",
        _by_rows,
    ),
    (
        {"format": "binary", "word": "uint16le", "framing": "cobs", "checksum": "sum8"},
        _cobs_frame,
        _by_zeros,
    ),
    (
        {"format": "binary", "word": "uint16be", "header": [0xA5, 0x5A], "before": 1, "checksum": "crc32"}
        | {"checksum_of": "body"},
        _crc_frame,
        _by_crc,
    ),
]


def stream(rng: random.Random) -> bytes:
    """The number of a format, and some of its frames with text between them."""
    number = rng.randrange(len(FORMATS))
    write = FORMATS[number][1]
    pieces = [bytes([number]), rng.choice((b"", b"rst:0x1 boot\r\n\0", b"\n\0"))]
    for _ in range(rng.randrange(3, 6)):
        pieces.append(write([None if rng.random() < 0.1 else float(rng.randrange(4200)) for _ in range(CELLS)]))
        pieces.append(rng.choice((b"", b"", b"[wifi] rssi -60\r\n")))
    return b"".join(pieces)


def judged_stream(data: bytes, rng: random.Random) -> bool:
    """Whether the host finds frames; AssertionError if they are not those that this module finds."""
    tables, _, decode = FORMATS[data[0] % len(FORMATS)] if data else FORMATS[0]
    board = {"name": "mat", "rows": ROWS, "columns": COLUMNS, "bits": 12}
    family = BoardFile.parse({"board": board, "frame": tables}, "stream").family()
    data = data[1:]
    found = _heard(family, data, lambda: rng.choice((1, 7, 64, 4096)))
    if tables["format"] == "binary" or all(len(line) < LONGEST_LINE for line in data.split(b"\n")):
        expected = [[_count(value) for value in frame] for frame in decode(data)]
        assert found == expected, f"frames {found}, expected {expected}"
    else:
        assert found == _heard(family, data, lambda: 1), "frames depend on how the bytes are cut"
    return bool(found)


def _heard(family: Family, data: bytes, size: Callable[[], int]) -> list[list[int | None]]:
    host, frames, at = host_protocol(family), [], 0
    while at < len(data):
        end = at + size()
        for event in host.feed(data[at:end], 0.0):
            if isinstance(event, FramePacket):
                flat = event.counts.ravel().tolist()
                frames.append([None if k in event.absent else count for k, count in enumerate(flat)])
        at = end
    return frames


def _count(value: float | None) -> int | None:
    """The count of a number; None where it is none."""
    if value is None or not math.isfinite(value) or not -0.5 <= value <= 4095.5:
        return None
    return round(value) if 0 <= round(value) <= 4095 else None
