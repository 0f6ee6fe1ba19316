"""Formats that boards with pressure-sensing arrays send, and how `ohmskin doctor` drafts them.

    python -m tests.formats [NAME ...] [--seed N]

Each format is written from facts about the wire only: its encoder shares no code with :mod:`ohmskin.wire`. A draft is
judged by the frames that its own protocol reads from bytes that it has not seen:

=========  ============================================================================================================
right      all frames are those that were sent
asked      they are after the answers to the draft's questions on sides and corners
doubted    they are not, and a question names the layout
none       no draft: doctor says that it does not know the format
WRONG      frames that were never sent, without a question on the layout
=========  ============================================================================================================
"""

from __future__ import annotations

import base64
import json
import struct
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ohmskin.doctor import Chunk, Draft, draft
from ohmskin.wire import BoardFile, FramePacket

Counts = NDArray[np.int64]
Encode = Callable[[Counts, float, int], bytes]
"""(rows, columns) counts, s since the start, number of the frame -> the bytes of a frame"""
SHOWN, UNSEEN = 40, 30
"""frames that the draft is made of, and is judged by"""


@dataclass(frozen=True)
class Format:
    """One format."""

    rows: int
    columns: int
    top: int
    period_s: float
    encode: Encode
    boot: bytes = b""
    keeps: tuple[str, ...] = ()
    """what frames carry besides: "time", "number" """
    rest: float = 0.04
    noise: float = 2.0
    least: int = 0
    """lower counts are zeros"""
    idle: tuple[bytes, float] | None = None
    """what comes between frames now and then, and how often a frame has it ahead"""


FORMATS: dict[str, Format] = {}


def shaped(rows: int, columns: int, top: int = 1023, period_s: float = 0.05, **keys: Any) -> Callable[[Encode], Encode]:
    """Enter an encoder into the table."""

    def enter(encode: Encode) -> Encode:
        FORMATS[encode.__name__.strip("_")] = Format(rows, columns, top, period_s, encode, **keys)
        return encode

    return enter


def _line(values: Any, between: str = ",", end: str = "\r\n") -> bytes:
    return (between.join(f"{value:d}" for value in values) + end).encode()


def crc16(data: bytes) -> bytes:
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return struct.pack("<H", crc)


# Lines of numbers


@shaped(10, 10, boot=b"CFG,10,10,5000\r\n", keeps=("time",))
def csv_time_us(v: Counts, t: float, k: int) -> bytes:
    return b"F,%d," % int(t * 1e6) + _line(v.ravel())


@shaped(18, 23, period_s=0.3)
def walkway_padded(v: Counts, t: float, k: int) -> bytes:
    return b"".join(b"".join(b" %4d" % x for x in row) + b"\n" for row in v) + b"\n"


@shaped(20, 9, period_s=0.02)
def letters_xz(v: Counts, t: float, k: int) -> bytes:
    first, second = (b"".join(b"%dx" % x for x in half.ravel()) for half in (v[:10], v[10:]))
    return first + b"z" + second + b"\r\n"


@shaped(3, 3, period_s=0.25)
def json_list(v: Counts, t: float, k: int) -> bytes:
    return b"[" + b",".join(b"%d" % x for x in v.ravel()) + b"]\r\n"


@shaped(8, 8)
def row_number_first(v: Counts, t: float, k: int) -> bytes:
    return b"".join(b"%d," % i + _line(row) for i, row in enumerate(v))


@shaped(16, 16, period_s=0.1)
def trailing_comma_rows(v: Counts, t: float, k: int) -> bytes:
    return b"".join(_line(row, end=",\r\n") for row in v)


@shaped(16, 16, period_s=0.25)
def text_ahead_of_rows(v: Counts, t: float, k: int) -> bytes:
    head = b"Center point (8,8) value: %d\r\nFull matrix:\r\n" % v[8, 8]
    return head + b"".join(_line(row, end=",\r\n") for row in v)


@shaped(6, 6, 4095, 0.2)
def banner_and_dashes(v: Counts, t: float, k: int) -> bytes:
    rows = b"".join(_line(row[::-1], "\t", "\t\r\n") for row in v)
    return b"----- MATRIZ -----\r\n" + rows + b"------------------\n\r\n"


@shaped(
    1,
    16,
    4095,
    0.01,
    boot=b"[SD] init failed. Check wiring & CS pin.\r\ntime_ms,ch0,ch1,ch2,ch3,ch4,ch5,ch6,ch7,ch8\r\n",
    keeps=("time",),
)
def insole_time_ms(v: Counts, t: float, k: int) -> bytes:
    return b"%d," % int(t * 1000) + _line(v.ravel(), end="\n")


@shaped(9, 9)
def tabs(v: Counts, t: float, k: int) -> bytes:
    return _line(v.ravel(), "\t", "\n")


@shaped(4, 4, period_s=0.1)
def rows_by_semicolons(v: Counts, t: float, k: int) -> bytes:
    return b";".join(_line(row, end="") for row in v) + b"\r\n"


@shaped(8, 12)
def row_label(v: Counts, t: float, k: int) -> bytes:
    return b"".join(b"R%d: " % i + _line(row, " ") for i, row in enumerate(v))


@shaped(6, 10)
def row_brackets(v: Counts, t: float, k: int) -> bytes:
    return b"".join(b"Row[%d] = " % (i + 1) + _line(row, ", ") for i, row in enumerate(v))


@shaped(4, 6)
def cell_coordinates(v: Counts, t: float, k: int) -> bytes:
    return b"".join(b"%d,%d,%d\r\n" % (i, j, x) for (i, j), x in np.ndenumerate(v))


@shaped(5, 5)
def cell_parentheses(v: Counts, t: float, k: int) -> bytes:
    return b"".join(b"(%d,%d): %d\r\n" % (i, j, x) for (i, j), x in np.ndenumerate(v))


@shaped(2, 8)
def cell_name(v: Counts, t: float, k: int) -> bytes:
    return b"".join(b"S%d=%d\n" % (i, x) for i, x in enumerate(v.ravel()))


@shaped(4, 4)
def labels_in_a_line(v: Counts, t: float, k: int) -> bytes:
    return b",".join(b"A%d:%d" % (i, x) for i, x in enumerate(v.ravel())) + b"\r\n"


@shaped(6, 6, keeps=("time",))
def time_last(v: Counts, t: float, k: int) -> bytes:
    return _line(v.ravel(), end="") + b",%d\r\n" % int(t * 1000)


@shaped(6, 6, keeps=("time", "number"))
def number_and_time(v: Counts, t: float, k: int) -> bytes:
    return b"%d;%d;" % (k + 17, int(t * 1000) + 4210) + _line(v.ravel(), ";", "\n")


@shaped(8, 8, keeps=("time",))
def seconds_ahead(v: Counts, t: float, k: int) -> bytes:
    return b"%.3f " % (t + 2.5) + _line(v.ravel(), " ", "\n")


@shaped(7, 9)
def volts(v: Counts, t: float, k: int) -> bytes:
    return " ".join(f"{3.3 * x / 1023:.3f}" for x in v.ravel()).encode() + b"\r\n"


@shaped(12, 12)
def matlab_brackets(v: Counts, t: float, k: int) -> bytes:
    return b"[" + b"; ".join(_line(row, " ", "") for row in v) + b"]\n"


@shaped(16, 16, period_s=0.2)
def numpy_print(v: Counts, t: float, k: int) -> bytes:
    rows = ["[" + " ".join(f"{x:4d}" for x in row) + "]" for row in v]
    return ("[" + "\n ".join(rows) + "]\n").encode()


@shaped(10, 6)
def frame_word_ahead(v: Counts, t: float, k: int) -> bytes:
    return b"FRAME %d\r\n" % k + b"".join(_line(row, " ") for row in v)


@shaped(8, 8, 255)
def dollar_star(v: Counts, t: float, k: int) -> bytes:
    body = _line(v.ravel(), end="")
    return b"$MAT," + body + b"*%02X\r\n" % int(np.bitwise_xor.reduce(np.frombuffer(body, np.uint8)))


@shaped(8, 8, 255)
def hex_digits(v: Counts, t: float, k: int) -> bytes:
    return v.astype(np.uint8).tobytes().hex().upper().encode() + b"\r\n"


@shaped(8, 8, 4095)
def hex_words(v: Counts, t: float, k: int) -> bytes:
    return " ".join(f"{x:03x}" for x in v.ravel()).encode() + b"\n"


@shaped(16, 16, 4095)
def base64_words(v: Counts, t: float, k: int) -> bytes:
    return base64.b64encode(v.astype("<u2").tobytes()) + b"\n"


@shaped(6, 8, idle=(b"[I][main] heap 182344 rssi -61\r\n", 0.2))
def log_lines_between(v: Counts, t: float, k: int) -> bytes:
    return b"data:" + _line(v.ravel(), " ")


@shaped(5, 8)
def each_frame_twice(v: Counts, t: float, k: int) -> bytes:
    return 2 * _line(v.ravel())


@shaped(8, 8, idle=(b"keepalive\r\n", 0.3))
def keep_alive_lines(v: Counts, t: float, k: int) -> bytes:
    return b"".join(_line(row, "\t") for row in v) + b"\r\n"


# JSON


@shaped(4, 5, keeps=("time",))
def json_object(v: Counts, t: float, k: int) -> bytes:
    return json.dumps({"t": int(t * 1000), "id": "mat1", "data": v.tolist()}).encode() + b"\n"


@shaped(6, 6, keeps=("time", "number"))
def json_flat(v: Counts, t: float, k: int) -> bytes:
    document = {"type": "frame", "seq": k, "timestamp_us": int(t * 1e6), "v": v.ravel().tolist()}
    return json.dumps(document, separators=(",", ":")).encode() + b"\r\n"


@shaped(3, 4)
def json_rows(v: Counts, t: float, k: int) -> bytes:
    return json.dumps({f"row{i}": row.tolist() for i, row in enumerate(v)}).encode() + b"\r\n"


@shaped(2, 4)
def json_sensors(v: Counts, t: float, k: int) -> bytes:
    sensors = [{"id": i, "value": int(x)} for i, x in enumerate(v.ravel())]
    return json.dumps({"sensors": sensors}).encode() + b"\r\n"


@shaped(2, 4)
def json_named(v: Counts, t: float, k: int) -> bytes:
    return json.dumps({f"s{i}": int(x) for i, x in enumerate(v.ravel())}).encode() + b"\r\n"


# Bytes


@shaped(56, 28, 207)
def end_mark_only(v: Counts, t: float, k: int) -> bytes:
    return v.astype(np.uint8).tobytes() + b"\xff\xfe\xfe\xff"


@shaped(16, 16, 255, boot=b"Velostat 16x16 Streaming Ready\r\n", period_s=0.1)
def bytes_and_pauses(v: Counts, t: float, k: int) -> bytes:
    return np.maximum(v.T, 1).astype(np.uint8).tobytes()


@shaped(16, 16, 4095, 0.03, keeps=("number",))
def packets_with_starts(v: Counts, t: float, k: int) -> bytes:
    cells = v.ravel().astype("<u2")
    return b"".join(
        struct.pack("<BH", 1, 64 * j) + cells[64 * j :][:64].tobytes() + struct.pack("<I", 4 * k + j) + b"wr"
        for j in range(4)
    )


@shaped(4, 8, 4095)
def modbus_answer(v: Counts, t: float, k: int) -> bytes:
    body = b"\x01\x04\x40" + v[::-1].astype(">u2").tobytes()
    return body + crc16(body)


@shaped(16, 16, 254, rest=0.0, noise=0.4, least=3)
def runs_of_zeros(v: Counts, t: float, k: int) -> bytes:
    out, zeros = bytearray(), 0
    for x in [*v.ravel().tolist(), None]:
        if x == 0 and zeros < 254:
            zeros += 1
            continue
        if zeros:
            out += bytes([0, zeros])
        zeros = int(x == 0)
        if x:
            out.append(x)
    return bytes(out) + b"\xff"


@shaped(8, 16, 1023, keeps=("time",))
def header_time_words(v: Counts, t: float, k: int) -> bytes:
    return b"\xa5\x5a" + struct.pack("<I", int(t * 1000) + 900) + v.astype("<u2").tobytes()


@shaped(8, 8, 4095, keeps=("number", "time"))
def header_number_time_crc(v: Counts, t: float, k: int) -> bytes:
    body = struct.pack("<HI", k + 250, int(t * 1e6)) + v.astype(">u2").tobytes()
    return b"\xaa\x55" + body + crc16(body)


@shaped(12, 10, 4095)
def packed_12_bits(v: Counts, t: float, k: int) -> bytes:
    pairs = v.ravel().reshape(-1, 2)
    a, b = pairs[:, 0], pairs[:, 1]
    packed = np.stack([a & 255, a >> 8 | (b & 15) << 4, b >> 4], axis=1)
    return b"\xfe\xef" + packed.astype(np.uint8).tobytes()


@shaped(16, 16, 1023)
def big_endian_length_sum(v: Counts, t: float, k: int) -> bytes:
    body = struct.pack(">H", 512) + v.astype(">u2").tobytes()
    return b"\x7e" + body + bytes([sum(body) & 255])


@shaped(16, 32, 255)
def row_packets(v: Counts, t: float, k: int) -> bytes:
    return b"".join(b"\xaa\xbb" + bytes([i]) + row.astype(np.uint8).tobytes() for i, row in enumerate(v))


@shaped(8, 12, 1023)
def row_packets_sum(v: Counts, t: float, k: int) -> bytes:
    out = b""
    for i, row in enumerate(v):
        body = bytes([i + 1]) + row.astype("<u2").tobytes()
        out += b"\xff\x01" + body + bytes([sum(body) & 255])
    return out


@shaped(4, 4, 255)
def value_index_pairs(v: Counts, t: float, k: int) -> bytes:
    return b"".join(bytes([0xF5, i, x]) for i, x in enumerate(v.ravel().tolist()))


@shaped(6, 10, 1023)
def slip(v: Counts, t: float, k: int) -> bytes:
    body = v.astype("<u2").tobytes()
    return b"\xc0" + body.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc") + b"\xc0"


@shaped(8, 8, 4095, keeps=("number",))
def cobs_crc(v: Counts, t: float, k: int) -> bytes:
    from cobs import cobs  # the public library, which no reader of ours is

    body = struct.pack("<I", k) + v.astype("<u2").tobytes()
    return bytes(cobs.encode(body + crc16(body))) + b"\0"


@shaped(4, 6, 4095)
def floats(v: Counts, t: float, k: int) -> bytes:
    return b"DATA" + (v * 3.3 / 4095).astype("<f4").tobytes()


@shaped(10, 16, 255)
def bytes_and_newline(v: Counts, t: float, k: int) -> bytes:
    return b"S" + v.astype(np.uint8).tobytes() + b"\n"


@shaped(15, 14, 255, period_s=0.02)
def column_by_column(v: Counts, t: float, k: int) -> bytes:
    return b"\xff\x00\xff" + np.minimum(v.T, 250).astype(np.uint8).tobytes()


@shaped(8, 8, 1023)
def copies_of_packets(v: Counts, t: float, k: int) -> bytes:
    return 3 * (b"\xa0\x5f" + v.astype("<u2").tobytes() + b"\xc0")


# What is judged


@dataclass
class Judged:
    """How a draft does."""

    outcome: str
    found: Draft | None = None
    frames: int = 0
    of: int = 0
    kept: list[str] = field(default_factory=list)
    """of what frames carry besides"""


def loads(form: Format, count: int, seed: int) -> Iterator[tuple[float, Counts]]:
    """Times and (rows, columns) counts of a finger that wanders, with noise."""
    rng = np.random.default_rng(seed)
    row, column = np.mgrid[: form.rows, : form.columns]
    for k in range(count):
        t = k * form.period_s
        x, y = (0.5 + 0.4 * np.sin(1.7 * t)) * (form.columns - 1), (0.5 + 0.4 * np.cos(2.3 * t)) * (form.rows - 1)
        bump = 0.75 * (0.6 + 0.4 * np.sin(5 * t)) * np.exp(-((column - x) ** 2 + (row - y) ** 2) / 4.0)
        noisy = (form.rest + bump) * form.top + rng.normal(0, form.noise, bump.shape)
        counts = np.clip(np.rint(noisy), 0, form.top).astype(np.int64)
        yield t, np.where(counts < form.least, 0, counts)


def stream(form: Format, seed: int, *, baud: int | None = None) -> tuple[list[Chunk], list[Counts]]:
    """What a host hears that joins within the first frame, and the frames; ``baud``: of a UART, None: a burst each."""
    rng = np.random.default_rng(seed + 1)
    chunks, sent, free_at = [], [], 0.0
    for k, (t, counts) in enumerate(loads(form, SHOWN + UNSEEN, seed)):
        data = form.encode(counts, t, k)
        data = form.boot + data if k == 0 and form.boot else data[len(data) // 3 :] if k == 0 else data
        if form.idle is not None and rng.random() < form.idle[1]:
            data = form.idle[0] + data
        at = max(t, free_at) + rng.uniform(0.0, 0.001)
        size = 4095 if baud is None else 62
        for begin in range(0, len(data), size):
            piece = data[begin : begin + size]
            at += 1e-5 if baud is None else 10 * len(piece) / baud
            chunks.append(Chunk(at, piece))
        free_at = at
        sent.append(counts)
    return chunks, sent


def judged(form: Format, seed: int = 7, *, baud: int | None = None) -> Judged:
    """Draft a format from a part of the stream, and read all of it with the draft."""
    chunks, sent = stream(form, seed, baud=baud)
    found = draft(chunks[: len(chunks) * SHOWN // (SHOWN + UNSEEN)], baudrate=baud or 115_200)
    if found is None:
        return Judged("none")
    family = BoardFile.parse(found.guess.tables, "draft").family()
    host = family.host(family, family.layout)
    heard = [e for chunk in chunks for e in host.feed(chunk.data, chunk.time_s) if isinstance(e, FramePacket)]
    result = Judged("", found, len(heard), len(sent))
    result.outcome = _outcome(form, found, heard, sent)
    times = [one.time_us for one in heard if one.time_us is not None]
    numbers = [one.sequence for one in heard if one.sequence is not None]
    if (
        len(times) == len(heard)
        and abs(float(np.median(np.diff(times))) - form.period_s * 1e6) < 0.1 * form.period_s * 1e6
    ):
        result.kept.append("time")
    if len(numbers) == len(heard) and np.median(np.diff(numbers)) == 1:
        result.kept.append("number")
    return result


def _outcome(form: Format, found: Draft, heard: Sequence[FramePacket], sent: Sequence[Counts]) -> str:
    scale = _numbers(found)
    read = [scale(one.counts) for one in heard]
    tolerance = 0.0 if "range" not in found.guess.tables["frame"] else 0.51
    doubt = any(question.startswith("frame.") for question in found.questions)
    if 2 * len(read) < len(sent):
        return "doubted" if doubt else "WRONG"
    for how, turned in _turned(read, (form.rows, form.columns), form.top):
        left = iter(sent)
        if all(any(np.abs(frame - one).max() <= tolerance for one in left) for frame in turned):
            return "right" if how == "as it is" else "asked"
    return "doubted" if doubt else "WRONG"


def _numbers(found: Draft) -> Callable[[NDArray[np.uint16]], NDArray[np.float64]]:
    board, frame = found.guess.tables["board"], found.guess.tables["frame"]
    low, high = frame.get("range", (0.0, 2.0 ** board["bits"] - 1))
    step = (high - low) / (2.0 ** board["bits"] - 1)
    return lambda counts: low + step * counts.astype(np.float64)


def _turned(
    read: Sequence[NDArray[np.float64]], shape: tuple[int, int], top: int
) -> Iterator[tuple[str, list[NDArray[np.float64]]]]:
    """The frames as they are, and after each answer to the questions on sides and corners; in volts, made counts."""
    factor = top / 3.3 if max(frame.max() for frame in read) < 3.4 else 1.0
    read = [frame * factor for frame in read]
    if read[0].shape == shape:
        yield "as it is", list(read)
    if read[0].size == shape[0] * shape[1]:
        for order, up, left in product("CF", (1, -1), (1, -1)):
            yield "turned", [frame.ravel().reshape(shape, order=order)[::up, ::left] for frame in read]


def main() -> None:
    """Print a line for each format, and the shares."""
    chosen = [name for name in sys.argv[1:] if name in FORMATS] or list(FORMATS)
    outcomes: Counter[str] = Counter()
    for name in chosen:
        for baud in (None, 115_200):
            one = judged(FORMATS[name], baud=baud)
            outcomes[one.outcome] += 1
            what = "" if one.found is None else one.found.summary
            missing = [key for key in FORMATS[name].keeps if key not in one.kept]
            print(
                f"{name:24} {'uart' if baud else 'burst':6}{one.outcome:8} {one.frames:3}/{one.of:3}  {what}"
                + (f"  without {', '.join(missing)}" if missing and one.found else "")
            )
            if "-v" in sys.argv and one.found is not None:
                print(one.found.toml([]))
    total = sum(outcomes.values())
    print(f"{len(chosen)} formats, {total} streams: " + ", ".join(f"{n} {name}" for name, n in outcomes.most_common()))


if __name__ == "__main__":
    main()
