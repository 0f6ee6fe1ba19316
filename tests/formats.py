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
    encode: Encode
    top: int = 1023
    period_s: float = 0.05
    boot: bytes = b""
    keeps: tuple[str, ...] = ()
    """what frames carry besides: "time", "number" """
    rest: float = 0.04
    noise: float = 2.0
    least: int = 0
    """lower counts are zeros"""
    idle: tuple[bytes, float] | None = None
    """what comes between frames now and then, and how often a frame has it ahead"""


def _line(values: Any, between: str = ",", end: str = "\r\n") -> bytes:
    return (between.join(f"{value:d}" for value in values.ravel()) + end).encode()


def _rows(v: Counts, between: str = ",", end: str = "\r\n", head: str = "") -> bytes:
    """A line for each row; ``head`` may say its number."""
    return b"".join((head % i if "%" in head else head).encode() + _line(row, between, end) for i, row in enumerate(v))


def _each(text: str, v: Counts) -> bytes:
    """``text`` with row, column and value of each cell."""
    return "".join(text.format(i=i, j=j, k=i * v.shape[1] + j, x=x) for (i, j), x in np.ndenumerate(v)).encode()


def _u8(v: Counts) -> bytes:
    return v.astype(np.uint8).tobytes()


def _le(v: Counts) -> bytes:
    return v.astype("<u2").tobytes()


def _be(v: Counts) -> bytes:
    return v.astype(">u2").tobytes()


def _json(document: Any, end: bytes = b"\r\n", **options: Any) -> bytes:
    return json.dumps(document, **options).encode() + end


def crc16(data: bytes) -> bytes:
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return struct.pack("<H", crc)


def _with_crc(body: bytes) -> bytes:
    return body + crc16(body)


def _with_sum(body: bytes) -> bytes:
    return body + bytes([sum(body) & 255])


def _letters_xz(v: Counts, t: float, k: int) -> bytes:
    return b"z".join(_each("{x}x", half) for half in (v[:10], v[10:])) + b"\r\n"


def _numpy_print(v: Counts, t: float, k: int) -> bytes:
    rows = ["[" + " ".join(f"{x:4d}" for x in row) + "]" for row in v]
    return ("[" + "\n ".join(rows) + "]\n").encode()


def _dollar_star(v: Counts, t: float, k: int) -> bytes:
    body = _line(v, end="")
    return b"$MAT," + body + b"*%02X\r\n" % int(np.bitwise_xor.reduce(np.frombuffer(body, np.uint8)))


def _packets_with_starts(v: Counts, t: float, k: int) -> bytes:
    heads, ends = [struct.pack("<BH", 1, 64 * j) for j in range(4)], [struct.pack("<I", 4 * k + j) for j in range(4)]
    return b"".join(heads[j] + _le(v.ravel()[64 * j :][:64]) + ends[j] + b"wr" for j in range(4))


def _runs_of_zeros(v: Counts, t: float, k: int) -> bytes:
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


def _packed_12_bits(v: Counts, t: float, k: int) -> bytes:
    a, b = v.ravel().reshape(-1, 2).T
    return b"\xfe\xef" + _u8(np.stack([a & 255, a >> 8 | (b & 15) << 4, b >> 4], axis=1))


def _slip(v: Counts, t: float, k: int) -> bytes:
    return b"\xc0" + _le(v).replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc") + b"\xc0"


def _cobs_crc(v: Counts, t: float, k: int) -> bytes:
    from cobs import cobs  # the public library, which no reader of ours is

    return bytes(cobs.encode(_with_crc(struct.pack("<I", k) + _le(v)))) + b"\0"


INSOLE = b"[SD] init failed. Check wiring & CS pin.\r\ntime_ms,ch0,ch1,ch2,ch3,ch4,ch5,ch6,ch7,ch8\r\n"
DASHES = b"----- MATRIZ -----\r\n", b"------------------\n\r\n"
TIMED, BOTH = ("time",), ("time", "number")

FORMATS: dict[str, Format] = {
    # Lines of numbers
    "csv_time_us": Format(10, 10, lambda v, t, k: b"F,%d," % int(t * 1e6) + _line(v),
                          boot=b"CFG,10,10,5000\r\n", keeps=TIMED),
    "walkway_padded": Format(
        18, 23, lambda v, t, k: b"".join(_each(" {x:4d}", row[None]) + b"\n" for row in v) + b"\n", period_s=0.3),
    "letters_xz": Format(20, 9, _letters_xz, period_s=0.02),
    "json_list": Format(3, 3, lambda v, t, k: b"[" + _line(v, end="]\r\n"), period_s=0.25),
    "row_number_first": Format(8, 8, lambda v, t, k: _rows(v, head="%d,")),
    "trailing_comma_rows": Format(16, 16, lambda v, t, k: _rows(v, end=",\r\n"), period_s=0.1),
    "text_ahead_of_rows": Format(
        16, 16, lambda v, t, k: b"Center point (8,8) value: %d\r\nFull matrix:\r\n" % v[8, 8] + _rows(v, end=",\r\n"),
        period_s=0.25),
    "banner_and_dashes": Format(
        6, 6, lambda v, t, k: DASHES[0] + _rows(v[:, ::-1], "\t", "\t\r\n") + DASHES[1], 4095, 0.2),
    "insole_time_ms": Format(1, 16, lambda v, t, k: b"%d," % int(t * 1000) + _line(v, end="\n"), 4095, 0.01,
                             boot=INSOLE, keeps=TIMED),
    "tabs": Format(9, 9, lambda v, t, k: _line(v, "\t", "\n")),
    "rows_by_semicolons": Format(4, 4, lambda v, t, k: _rows(v, end=";")[:-1] + b"\r\n", period_s=0.1),
    "row_label": Format(8, 12, lambda v, t, k: _rows(v, " ", head="R%d: ")),
    "row_brackets": Format(
        6, 10, lambda v, t, k: b"".join(b"Row[%d] = " % (i + 1) + _line(row, ", ") for i, row in enumerate(v))),
    "cell_coordinates": Format(4, 6, lambda v, t, k: _each("{i},{j},{x}\r\n", v)),
    "cell_parentheses": Format(5, 5, lambda v, t, k: _each("({i},{j}): {x}\r\n", v)),
    "cell_name": Format(2, 8, lambda v, t, k: _each("S{k}={x}\n", v)),
    "labels_in_a_line": Format(4, 4, lambda v, t, k: _each("A{k}:{x},", v)[:-1] + b"\r\n"),
    "time_last": Format(6, 6, lambda v, t, k: _line(v, end="") + b",%d\r\n" % int(t * 1000), keeps=TIMED),
    "number_and_time": Format(
        6, 6, lambda v, t, k: b"%d;%d;" % (k + 17, int(t * 1000) + 4210) + _line(v, ";", "\n"), keeps=BOTH),
    "seconds_ahead": Format(8, 8, lambda v, t, k: b"%.3f " % (t + 2.5) + _line(v, " ", "\n"), keeps=TIMED),
    "volts": Format(7, 9, lambda v, t, k: " ".join(f"{3.3 * x / 1023:.3f}" for x in v.ravel()).encode() + b"\r\n"),
    "matlab_brackets": Format(12, 12, lambda v, t, k: b"[" + _rows(v, " ", "; ")[:-2] + b"]\n"),
    "numpy_print": Format(16, 16, _numpy_print, period_s=0.2),
    "frame_word_ahead": Format(10, 6, lambda v, t, k: b"FRAME %d\r\n" % k + _rows(v, " ")),
    "dollar_star": Format(8, 8, _dollar_star, 255),
    "hex_digits": Format(8, 8, lambda v, t, k: _u8(v).hex().upper().encode() + b"\r\n", 255),
    "hex_words": Format(8, 8, lambda v, t, k: " ".join(f"{x:03x}" for x in v.ravel()).encode() + b"\n", 4095),
    "base64_words": Format(16, 16, lambda v, t, k: base64.b64encode(_le(v)) + b"\n", 4095),
    "log_lines_between": Format(6, 8, lambda v, t, k: b"data:" + _line(v, " "),
                                idle=(b"[I][main] heap 182344 rssi -61\r\n", 0.2)),
    "each_frame_twice": Format(5, 8, lambda v, t, k: 2 * _line(v)),
    "keep_alive_lines": Format(8, 8, lambda v, t, k: _rows(v, "\t") + b"\r\n", idle=(b"keepalive\r\n", 0.3)),
    # JSON
    "json_object": Format(4, 5, lambda v, t, k: _json({"t": int(t * 1000), "id": "mat1", "data": v.tolist()}, b"\n"),
                          keeps=TIMED),
    "json_flat": Format(
        6, 6, lambda v, t, k: _json({"type": "frame", "seq": k, "timestamp_us": int(t * 1e6), "v": v.ravel().tolist()},
                                    separators=(",", ":")), keeps=BOTH),
    "json_rows": Format(3, 4, lambda v, t, k: _json({f"row{i}": row.tolist() for i, row in enumerate(v)})),
    "json_sensors": Format(
        2, 4, lambda v, t, k: _json({"sensors": [{"id": i, "value": int(x)} for i, x in enumerate(v.ravel())]})),
    "json_named": Format(2, 4, lambda v, t, k: _json({f"s{i}": int(x) for i, x in enumerate(v.ravel())})),
    # Bytes
    "end_mark_only": Format(56, 28, lambda v, t, k: _u8(v) + b"\xff\xfe\xfe\xff", 207),
    "bytes_and_pauses": Format(16, 16, lambda v, t, k: _u8(np.maximum(v.T, 1)), 255, 0.1,
                               boot=b"Velostat 16x16 Streaming Ready\r\n"),
    "packets_with_starts": Format(16, 16, _packets_with_starts, 4095, 0.03, keeps=("number",)),
    "modbus_answer": Format(4, 8, lambda v, t, k: _with_crc(b"\x01\x04\x40" + _be(v[::-1])), 4095),
    "runs_of_zeros": Format(16, 16, _runs_of_zeros, 254, rest=0.0, noise=0.4, least=3),
    "header_time_words": Format(
        8, 16, lambda v, t, k: b"\xa5\x5a" + struct.pack("<I", int(t * 1000) + 900) + _le(v), keeps=TIMED),
    "header_number_time_crc": Format(
        8, 8, lambda v, t, k: b"\xaa\x55" + _with_crc(struct.pack("<HI", k + 250, int(t * 1e6)) + _be(v)), 4095,
        keeps=BOTH),
    "packed_12_bits": Format(12, 10, _packed_12_bits, 4095),
    "big_endian_length_sum": Format(
        16, 16, lambda v, t, k: b"\x7e" + _with_sum(struct.pack(">H", 512) + _be(v))),
    "row_packets": Format(
        16, 32, lambda v, t, k: b"".join(b"\xaa\xbb" + bytes([i]) + _u8(row) for i, row in enumerate(v)), 255),
    "row_packets_sum": Format(
        8, 12, lambda v, t, k: b"".join(b"\xff\x01" + _with_sum(bytes([i + 1]) + _le(row)) for i, row in enumerate(v))),
    "value_index_pairs": Format(
        4, 4, lambda v, t, k: b"".join(bytes([0xF5, i, x]) for i, x in enumerate(v.ravel().tolist())), 255),
    "slip": Format(6, 10, _slip),
    "cobs_crc": Format(8, 8, _cobs_crc, 4095, keeps=("number",)),
    "floats": Format(4, 6, lambda v, t, k: b"DATA" + (v * 3.3 / 4095).astype("<f4").tobytes(), 4095),
    "bytes_and_newline": Format(10, 16, lambda v, t, k: b"S" + _u8(v) + b"\n", 255),
    "column_by_column": Format(15, 14, lambda v, t, k: b"\xff\x00\xff" + _u8(np.minimum(v.T, 250)), 255, 0.02),
    "copies_of_packets": Format(8, 8, lambda v, t, k: 3 * (b"\xa0\x5f" + _le(v) + b"\xc0")),
}  # fmt: skip


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
