"""Mutations of valid inputs: of bytes anywhere, and of the numbers, words and lines of texts."""

from __future__ import annotations

import random
import re
from collections.abc import Callable

Mutation = Callable[[random.Random, bytes], bytes]

NUMBERS = [
    *("0", "-0.0", "1", "-1", "2", "7", "0.5", "1e-3", "1e3", "1e30", "1.1e30", "-1e30", "1e-30", "0.9e-30"),
    *("1e308", "-1e308", "1e309", "1e-308", "1e-320", "5e-324", "inf", "-inf", "nan", "+inf", "infinity", "NaN"),
    *("1024", "1025", "65535", "65536", "2147483648", "4294967296", "9223372036854775807", "9223372036854775808"),
    *(
        "9" * 400,
        "9" * 5000,
        "1_000",
        "0x10",
        "0b1",
        "1e",
        "e5",
        "--1",
        "1.",
        ".5",
        "1,5",
        "\u0661",
        "true",
        '"1"',
        "[]",
    ),
    *("{}", "[1, 2]", "[[1, 2]]", '""', "1979-05-27", "'x'"),
]
FRAGMENTS = [
    *(b"\0", b"\x1b[31m", b"\xff\xfe", b"\xef\xbb\xbf", b"\xed\xa0\x80", "\u202e".encode(), "\u2028".encode(), b"\r"),
    *(b"\r\n", b"\n", b"\n\n", b"\t", b" ", b"#", b'"', b"'", b'"""', b"=", b".", b",", b",,", b";", b"[", b"]", b"]]"),
    *(b"[[", b"{", b"}", b"a" * 2000, b"[" * 3000, b"a." * 3000, b"\\u0000", b"\\u001b[2J", b"\x00\x00", b"\xff" * 300),
]
_number = re.compile(rb"(?<![\w.])[-+]?\d[\d_.]*(?:[eE][-+]?\d+)?|(?<=[\s,=\[])(?:[-+]?inf|nan)(?=[\s,\]])")
_word = re.compile(rb"[A-Za-z_][A-Za-z_0-9-]+")


def mutated(rng: random.Random, data: bytes, *, text: bool) -> bytes:
    """``data`` after one to four mutations."""
    kinds = [*OF_BYTES, *(OF_TEXT * 3 if text else [])]
    for _ in range(rng.choice((1, 1, 1, 2, 2, 4))):
        data = rng.choice(kinds)(rng, data)
    return data


def _span(rng: random.Random, data: bytes, longest: int = 64) -> tuple[int, int]:
    start = rng.randrange(len(data) + 1)
    return start, min(len(data), start + rng.randrange(1, longest))


def _flip_bit(rng: random.Random, data: bytes) -> bytes:
    if not data:
        return data
    place = rng.randrange(len(data))
    return data[:place] + bytes([data[place] ^ 1 << rng.randrange(8)]) + data[place + 1 :]


def _set_byte(rng: random.Random, data: bytes) -> bytes:
    place, _ = _span(rng, data)
    return data[:place] + bytes([rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))]) + data[place + 1 :]


def _delete(rng: random.Random, data: bytes) -> bytes:
    start, end = _span(rng, data)
    return data[:start] + data[end:]


def _repeat(rng: random.Random, data: bytes) -> bytes:
    start, end = _span(rng, data)
    return data[:end] + data[start:end] * rng.choice((1, 1, 2, 50)) + data[end:]


def _insert_fragment(rng: random.Random, data: bytes) -> bytes:
    place, _ = _span(rng, data)
    return data[:place] + rng.choice(FRAGMENTS) + data[place:]


def _insert_noise(rng: random.Random, data: bytes) -> bytes:
    place, _ = _span(rng, data)
    return data[:place] + rng.randbytes(rng.randrange(1, 20)) + data[place:]


def _cut_end(rng: random.Random, data: bytes) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _replace_number(rng: random.Random, data: bytes) -> bytes:
    return _replace_one(rng, data, _number, rng.choice(NUMBERS).encode())


def _replace_word(rng: random.Random, data: bytes) -> bytes:
    words = _word.findall(data) or [b"x"]
    return _replace_one(rng, data, _word, rng.choice(words))


def _replace_one(rng: random.Random, data: bytes, pattern: re.Pattern[bytes], new: bytes) -> bytes:
    places = list(pattern.finditer(data))
    if not places:
        return data
    place = rng.choice(places)
    return data[: place.start()] + new + data[place.end() :]


def _swap_lines(rng: random.Random, data: bytes) -> bytes:
    lines = data.splitlines(keepends=True)
    if len(lines) > 1:
        one, other = rng.sample(range(len(lines)), 2)
        lines[one], lines[other] = lines[other], lines[one]
    return b"".join(lines)


def _repeat_line(rng: random.Random, data: bytes) -> bytes:
    lines = data.splitlines(keepends=True) or [b"\n"]
    lines.insert(rng.randrange(len(lines) + 1), rng.choice(lines))
    return b"".join(lines)


def _delete_line(rng: random.Random, data: bytes) -> bytes:
    lines = data.splitlines(keepends=True) or [b"\n"]
    del lines[rng.randrange(len(lines))]
    return b"".join(lines)


OF_BYTES: list[Mutation] = [_flip_bit, _set_byte, _delete, _repeat, _insert_fragment, _insert_noise, _cut_end]
OF_TEXT: list[Mutation] = [_replace_number, _replace_number, _replace_word, _swap_lines, _repeat_line, _delete_line]
