"""Guesses for text: what a line looks like, which of its numbers are cells, and what ends a frame.

A line is parsed as a head, a list of numbers and a tail. Lines with the same texts and as many numbers are of one kind.
The numbers of a kind are columns: one that counts lines over and over is a place (row, column, index), one that only
rises is the board's time or a count of frames; all others are cells.
"""

from __future__ import annotations

import base64
import binascii
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Any

import numpy as np

from ..common.arrays import FloatArray
from ._guess import Chunk, Guess, board_guess, counting_role, shapes
from ._json_guess import json_guesses
from ._tuning import FEWEST, LIST, PAUSE_S, PROVEN, TEXT_SHARE, USUAL
from ._word_guess import words_in

MOST_ROWS = 256

_WORD = r"(?:[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?|[+-]?nan|null|[+-]?inf|ovf)"
_BETWEEN = r"[\s,;:|\[\](){}]"
_RUN = re.compile(rf"(?<![\w.+-]){_WORD}(?:{_BETWEEN}+{_WORD})*(?![\w.])|(?<![\w.]){_WORD}?(?:\s*,\s*{_WORD}?)+$", re.I)
"""numbers one after the other, with or without empty places between commas"""
_LABEL = re.compile(r"\b[A-Za-z_]\w*\s*[:=]\s*")
_LETTERED = re.compile(r"[+-]?\d+(?:[A-Za-z]{1,2}[+-]?\d+){3,}[A-Za-z]{0,2}")
_LETTER = re.compile(r"[A-Za-z]+")
_DIGITS = re.compile(r"\d+(?:\.\d+)?")
_ALNUM = re.compile(r"\w+")
_EDGES = " \t,;:|[](){}"
_HEX_LINE = re.compile(r"(.*?[^0-9A-Za-z])??((?:0x)?[0-9A-Fa-f]{2,}(?:[\s,;]+(?:0x)?[0-9A-Fa-f]{2,})*)[\s,;]*")
_BASE64_LINE = re.compile(r"(.*?[^0-9A-Za-z+/=])??([A-Za-z0-9+/]{11,}={0,2})")


@dataclass(frozen=True)
class _Line:
    text: str
    time_s: float
    head: str = ""
    """text ahead of the list, with # for each number"""
    fields: tuple[float, ...] = ()
    """these numbers"""
    numbers: tuple[float, ...] = ()
    """the list; empty: a line without numbers"""
    tail: str = ""
    gaps: tuple[str, ...] = ()
    """texts between the numbers of the list"""

    @property
    def kind(self) -> tuple[str, int, str]:
        """What lines of one kind share: texts, of which separators at the ends tell nothing, and how many numbers."""
        head = self.head.strip(_EDGES) and self.head
        return head, len(self.numbers), _ALNUM.sub("#", self.tail.strip(_EDGES) and self.tail)


def is_text(chunks: Sequence[Chunk]) -> bool:
    """Whether the bytes are lines of printable characters, as far as a stream that begins anywhere shows."""
    data = b"".join(chunk.data for chunk in chunks)
    end = data[len(data) // 2 :]  # the beginning may be a boot loader's, at another baud rate
    return b"\n" in end and sum(32 <= byte < 127 or byte in b"\r\n\t" for byte in end) > TEXT_SHARE * len(end)


def text_guesses(chunks: Sequence[Chunk]) -> Iterator[Guess]:
    """Guesses for a stream of text, the likeliest first."""
    lines = _lines(chunks)
    yield from json_guesses([(line.text, line.time_s) for line in lines])
    yield from _encoded_guesses(lines)
    parsed = [_parsed(line) for line in lines]
    if 2 * sum(len(_LABEL.findall(line.text)) > 1 for line in lines) > sum(bool(line.text) for line in lines):
        bare = [_parsed(_Line(_LABEL.sub("", line.text), line.time_s)) for line in lines]
        for guess in _guesses_of(bare):
            guess.tables["frame"]["labels"] = True
            yield guess
    yield from _guesses_of(parsed)
    yield from _lettered_guesses(lines)


def _lettered_guesses(lines: Sequence[_Line]) -> Iterator[Guess]:
    """Guesses for numbers with letters between them."""
    lettered = [line for line in lines if _LETTERED.fullmatch(line.text)]
    if 2 * len(lettered) <= sum(bool(line.text) for line in lines):
        return
    letters = "".join(sorted({one for line in lettered for one in line.text if one.isalpha()}))
    bare = [_parsed(_Line(_LETTER.sub(" ", line.text), line.time_s)) for line in lettered]
    for guess in _guesses_of(bare):
        guess.tables["frame"]["separator"] = letters
        yield guess


def _encoded_guesses(lines: Sequence[_Line]) -> Iterator[Guess]:
    """Guesses for lines of hexadecimal digits or base64, each a frame or a row."""
    spoken = [line for line in lines if line.text]
    for encoding, expression in (("hex", _HEX_LINE), ("base64", _BASE64_LINE)):
        found = [(line, match) for line in spoken if (match := expression.fullmatch(line.text))]
        kinds = Counter((match[1] or "", len(match[2])) for _, match in found)
        for (prefix, length), seen in kinds.most_common(1):
            mine = [match[2] for _, match in found if (match[1] or "", len(match[2])) == (prefix, length)]
            if seen < FEWEST or 2 * seen < len(spoken) or not any(re.search("[A-Za-z]", text) for text in mine):
                continue
            frame: dict[str, Any] = {"format": "text", "layout": "frame-per-line", "encoding": encoding}
            frame |= {"prefix": prefix.rstrip()} if prefix else {}
            yield from (
                _words_of(mine, frame) if encoding == "base64" or len(mine[0].split()) == 1 else _digits_of(mine, frame)
            )


def _words_of(texts: Sequence[str], frame: dict[str, Any]) -> Iterator[Guess]:
    """Guesses for words without separators."""
    rows = []
    for text in texts:
        try:
            rows.append(bytes.fromhex(text) if frame["encoding"] == "hex" else base64.b64decode(text, validate=True))
        except (ValueError, binascii.Error):
            return
    if len(set(map(len, rows))) == 1:
        bodies = np.array([list(row) for row in rows], dtype=np.uint8)
        for _, guess in sorted(words_in(bodies, frame), key=lambda item: -item[0])[:3]:
            yield guess


def _digits_of(texts: Sequence[str], frame: dict[str, Any]) -> Iterator[Guess]:
    """Guesses for hexadecimal numbers with separators."""
    numbers = np.array([[float(int(word, 16)) for word in re.split(r"[\s,;]+", text)] for text in texts])
    for rows, columns in shapes(numbers.shape[1])[:1]:
        yield board_guess(rows, columns, frame, numbers, known_shape=False)


def _guesses_of(parsed: Sequence[_Line]) -> Iterator[Guess]:
    kinds = Counter(line.kind for line in parsed if line.numbers)
    for kind, seen in kinds.most_common(3):
        if seen >= FEWEST:
            yield from _line_guesses(parsed, kind)


def _lines(chunks: Sequence[Chunk]) -> list[_Line]:
    """Whole lines, each with the time at which its end came."""
    lines, rest = [], b""
    for chunk in chunks:
        *whole, rest = (rest + chunk.data).split(b"\n")
        lines += [_Line(line.decode("ascii", "replace").strip(" \t\r\0"), chunk.time_s) for line in whole]
    return lines[1:]


def _parsed(line: _Line) -> _Line:
    """The line with its list of numbers, and the texts around it."""
    text = line.text
    runs = [(found, words) for found in _RUN.finditer(text) if (words := _words(found[0]))]
    if not runs:
        return line
    longest = max(len(words) for _, words in runs)
    found, words = runs[-1] if longest < LIST else next(run for run in runs if len(run[1]) == longest)
    head, tail = text[: found.start()], text[found.end() :]
    fields = tuple(float(one) for one in _DIGITS.findall(head))
    gaps = tuple(re.findall(rf"{_BETWEEN}+", found[0].strip()))
    return _Line(text, line.time_s, _DIGITS.sub("#", head), fields, tuple(map(_value, words)), tail, gaps)


def _words(text: str) -> list[str]:
    stripped = text.strip()
    if re.search(r",\s*,", stripped):  # empty places
        return [word.strip() for word in stripped.removesuffix(",").split(",")]
    return [word for word in re.split(rf"{_BETWEEN}+", stripped) if word]


def _value(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return float("nan")


@dataclass(frozen=True)
class _Columns:
    """The numbers of the lines of one kind, and what they are."""

    lines: list[_Line]
    numbers: FloatArray
    """(lines, numbers): those of the head, then those of the list"""
    roles: dict[int, str]
    """column -> name of its field; others are cells"""

    @property
    def cells(self) -> FloatArray:
        """(lines, cells)"""
        return self.numbers[:, [k for k in range(self.numbers.shape[1]) if k not in self.roles]]

    @property
    def places(self) -> dict[str, FloatArray]:
        """Places by name."""
        return {role: self.numbers[:, k] for k, role in self.roles.items() if role in ("row", "column", "index")}


def _columns(mine: list[_Line]) -> _Columns:
    numbers = np.array([(*line.fields, *line.numbers) for line in mine])
    times = np.array([line.time_s for line in mine])
    heads, count = len(mine[0].fields), numbers.shape[1]
    roles: dict[int, str] = {}
    for k in range(count - 1):
        if {"row", "index"} & set(roles.values()):
            role = None
        elif k + 2 < count and _is_nested(numbers[:, k], numbers[:, k + 1]):
            roles |= {k: "row", k + 1: "column"}
            continue
        else:
            role = "index" if _cycle(numbers[:, k]) else None
        if k not in roles:
            role = role or counting_role(numbers[:, k], times)
            if role is None and k >= heads:
                break
            constant = k < heads and len(set(numbers[:, k])) == 1
            roles[k] = "constant" if constant else role or "skip"
    for k in range(count - 1, heads, -1):  # behind the cells
        role = None if k in roles or len(roles) >= count - 1 else counting_role(numbers[:, k], times)
        if role is None or role in roles.values():
            break
        roles[k] = role
    if "index" in roles.values() and count - len(roles) > 1:
        roles = {k: "row" if role == "index" else role for k, role in roles.items()}
    seen: set[str] = set()
    for k, role in roles.items():
        if role in seen and role not in ("skip", "constant"):
            roles[k] = "skip"
        seen.add(role)
    return _Columns(mine, numbers, roles)


def _pattern(columns: _Columns, separator: str | None) -> dict[str, Any]:
    """The keys of [frame] that say what a line looks like."""
    line, roles = columns.lines[0], columns.roles
    heads = len(line.fields)
    pieces = line.head.split("#")
    texts = iter(_DIGITS.findall(line.text))
    text = pieces[0]
    for k, piece in enumerate(pieces[1:]):
        shown = next(texts)
        text += (shown if roles[k] == "constant" else f"{{{roles[k]}}}") + piece
    listed = [f"{{{roles[k]}}}" if k in roles else "" for k in range(heads, columns.numbers.shape[1])]
    first, behind = listed.index(""), listed[::-1].index("")
    tail = line.tail if line.tail.strip(_EDGES) else ""
    if len({one.tail for one in columns.lines}) > 1:
        tail = _ALNUM.sub("{text}", tail)
    if all(role == "constant" for role in roles.values()) and "{" not in tail:
        text = text if text.strip(_EDGES) else ""
        return ({"prefix": text.rstrip()} if text.strip() else {}) | ({"suffix": tail} if tail else {})
    gaps = [*line.gaps, *[separator or " "] * len(listed)]
    text += "".join(map("".join, zip(listed[:first], gaps, strict=False))) + "{cells}"
    last = len(listed) - behind
    text += "".join(map("".join, zip(gaps[last - 1 :], listed[last:], strict=False)))
    return {"line": text.strip() + tail.rstrip()}


def _line_guesses(lines: Sequence[_Line], kind: tuple[str, int, str]) -> Iterator[Guess]:
    """Guesses where the lines of one kind carry the cells."""
    mine = [line for line in lines if line.numbers and line.kind == kind]
    columns = _columns(mine)
    cells, places = columns.cells, columns.places
    count = cells.shape[1]
    separator = _separator(mine)
    frame: dict[str, Any] = {"format": "text"} | _pattern(columns, separator)
    if separator is not None and count > 1:
        frame["separator"] = separator
    if places:
        yield from _placed_guesses(frame, columns)
    # An end line lies behind all rows of a frame.
    ended = _end(lines, mine)
    plain = (
        frame if not places else {"format": "text"} | _pattern(replace(columns, roles=_unplaced(columns)), separator)
    )
    if ended is not None and count > 1:
        end, rows = ended
        keys: dict[str, Any] = {"layout": "row-per-line", "end": end}
        yield board_guess(rows, count, plain | keys, cells, known_shape=True)
    if count == 1:
        for lines_in_frame in [ended[1]] if ended else [rows for rows, _ in _rows_without_end(mine, cells)]:
            keys = {"layout": "cell-per-line"} | ({"end": ended[0]} if ended else {})
            for rows, wide in shapes(lines_in_frame)[:1] or [(1, lines_in_frame)]:
                yield board_guess(rows, wide, plain | keys, cells, known_shape=False)
        return
    if ended is None:
        for rows, how in _rows_without_end(mine, cells):
            guess = board_guess(rows, count, plain | {"layout": "row-per-line"}, cells, known_shape=True)
            guess.remarks["frame.layout"] = f"? {how}; nothing in the lines says which one is the first of a frame"
            yield guess
    for rows, wide in shapes(count)[:1] or [(1, count)]:
        yield board_guess(rows, wide, plain | {"layout": "frame-per-line"}, cells, known_shape=False)


def _unplaced(columns: _Columns) -> dict[int, str]:
    places = ("row", "column", "index")
    return {k: "skip" if role in places else role for k, role in columns.roles.items()}


def _placed_guesses(frame: dict[str, Any], columns: _Columns) -> Iterator[Guess]:
    """Guesses where each line says its place."""
    places, cells = columns.places, columns.cells
    sizes = [int(one.max() - one.min()) + 1 for one in places.values()]
    if len(sizes) == 2 and cells.shape[1] == 1:
        yield board_guess(sizes[0], sizes[1], frame | {"layout": "cell-per-line"}, cells, known_shape=True)
    elif "row" in places and len(sizes) == 1:
        yield board_guess(sizes[0], cells.shape[1], frame | {"layout": "row-per-line"}, cells, known_shape=True)
    elif "index" in places:
        for rows, wide in shapes(sizes[0])[:1] or [(1, sizes[0])]:
            yield board_guess(rows, wide, frame | {"layout": "cell-per-line"}, cells, known_shape=False)


def _separator(lines: Sequence[_Line]) -> str | None:
    """The separator, if it is one that shows missing numbers, too."""
    count = len(lines[0].numbers)
    for mark in (",", ";", "\t"):
        texts = (line.text[: len(line.text) - len(line.tail)] for line in lines)
        # Numbers of the head may have other separators; the list's are the last ones.
        fits = sum(len(text.rstrip(mark).split(mark)) in (count, count + len(lines[0].fields)) for text in texts)
        if count > 1 and fits >= USUAL * len(lines):
            return mark
    return None


def _end(lines: Sequence[_Line], mine: Sequence[_Line]) -> tuple[str, int] | None:
    """The line that ends a frame, and the lines of numbers between two of them."""
    carrying = {id(line) for line in mine}
    places: dict[str, list[int]] = {}
    passed = 0
    for line in lines:
        if id(line) in carrying:
            passed += 1
        elif not line.numbers or line.text:
            places.setdefault(_DIGITS.sub("#", line.text), []).append(passed)
    for pattern in sorted(places, key=len):
        between = np.diff(places[pattern])
        between = between[between > 0]
        if len(between) < FEWEST - 1:
            continue
        (rows, seen), *_ = Counter(between.tolist()).most_common(1)
        texts = [line.text for line in lines if _DIGITS.sub("#", line.text) == pattern and id(line) not in carrying]
        mark = _common_head(texts).rstrip()
        # "frame 10" ... "frame 19" have a digit in common that is no part of the mark.
        mark = re.sub(r"\d+$", "", mark).rstrip() if len(set(texts)) > 1 else mark
        if 1 < rows <= MOST_ROWS and seen >= USUAL * len(between) and (mark or not pattern):
            return mark, rows
    return None


def _common_head(texts: Sequence[str]) -> str:
    """The characters with which all texts begin."""
    alike = (one == other for one, other in zip(min(texts), max(texts), strict=False))
    return min(texts)[: sum(takewhile(bool, alike))]


def _cycle(values: FloatArray) -> int:
    """Steps of a number that counts from 0 or 1 up, again and again; 0: it does not."""
    begins = np.flatnonzero(np.diff(values) != 1) + 1
    if len(begins) < 2 or values[begins[0]] not in (0.0, 1.0):
        return 0
    (steps, seen), *_ = Counter(np.diff(begins).tolist()).most_common(1)
    whole = steps > 1 and seen >= PROVEN * (len(begins) - 1) and set(values[begins]) == {values[begins[0]]}
    return steps if whole else 0


def _is_nested(row: FloatArray, column: FloatArray) -> bool:
    """Whether two numbers are row and column of cells that are sent one after the other."""
    for inner, outer in ((column, row), (row, column)):
        steps = _cycle(inner)
        if steps:
            begins = np.flatnonzero(np.diff(inner) != 1) + 1
            if (np.diff(outer)[np.diff(inner) == 1] == 0).mean() > PROVEN and _cycle(outer[begins]):
                return True
    return False


def _rows_without_end(lines: Sequence[_Line], numbers: FloatArray) -> Iterator[tuple[int, str]]:
    """Rows of a frame by the pauses between lines, and by how much lines are alike."""
    gaps = np.diff([line.time_s for line in lines])
    pauses = np.flatnonzero(gaps > max(3 * float(np.median(gaps)), PAUSE_S))
    if len(pauses) >= FEWEST:
        (rows, seen), *_ = Counter(np.diff(pauses).tolist()).most_common(1)
        if 1 < rows <= MOST_ROWS and seen >= 0.6 * (len(pauses) - 1):
            yield rows, f"{rows} lines come between two pauses"
    most = min(len(numbers) // 3, MOST_ROWS)
    if most < 2:
        return
    filled = np.nan_to_num(numbers)
    apart = np.array([np.abs(filled[lag:] - filled[:-lag]).mean() for lag in range(1, most + 1)])
    least = apart[1:].min()
    if least < USUAL * apart[0]:
        rows = 2 + int(np.flatnonzero(apart[1:] <= 1.1 * least)[0])
        yield rows, f"lines {rows} apart are alike"
