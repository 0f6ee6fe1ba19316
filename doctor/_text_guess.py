"""Guesses for text: separator, numbers in a line, and what ends a frame."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Any

import numpy as np

from ..common.arrays import FloatArray
from ._guess import Chunk, Guess, board_guess, shapes

TEXT_SHARE = 0.9
"""share of printable characters from which on a stream is text"""
FEWEST_LINES = 3
USUAL = 0.8
"""share of the cases that makes a rule"""
PAUSE_S = 0.003
"""least pause between two frames"""
ALIKE = 0.8
"""ratio of the differences between lines some lines apart and one apart, below which a frame has that many lines"""
MOST_ROWS = 256

_WORD = r"(?:[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?|[+-]?nan|null|[+-]?inf|ovf)"
_BETWEEN = r"[\s,;:|]"
_NUMBERS = re.compile(rf"{_BETWEEN}*{_WORD}(?:{_BETWEEN}+{_WORD})*{_BETWEEN}*$|{_WORD}?(?:\s*,\s*{_WORD}?)+$", re.I)
"""the end of a line that is numbers, with or without empty places between commas"""
_LABEL = re.compile(r"\b[A-Za-z_]\w*\s*[:=]\s*")
_LETTERED = re.compile(r"[+-]?\d+(?:[A-Za-z]{1,2}[+-]?\d+){3,}[A-Za-z]{0,2}")
_LETTER = re.compile(r"[A-Za-z]+")
_TAIL = re.compile(r"[^\w,;:|.+-]+$")
_DIGITS = re.compile(r"\d+")
_LIST = re.compile(r"(?<=[\[,:\s])[+-]?(nan|inf|ovf)(?=[\],\s}])", re.I)


@dataclass(frozen=True)
class _Line:
    text: str
    time_s: float
    prefix: str = ""
    numbers: tuple[float, ...] = ()
    """empty: a line without numbers"""


def is_text(chunks: Sequence[Chunk]) -> bool:
    """Whether the bytes are lines of printable characters, as far as a stream that begins anywhere shows."""
    data = b"".join(chunk.data for chunk in chunks)
    end = data[len(data) // 2 :]  # the beginning may be a boot loader's, at another baud rate
    return b"\n" in end and sum(32 <= byte < 127 or byte in b"\r\n\t" for byte in end) > TEXT_SHARE * len(end)


def text_guesses(chunks: Sequence[Chunk]) -> Iterator[Guess]:
    """Guesses for a stream of text, the likeliest first."""
    lines = _lines(chunks)
    yield from _json_guesses(lines)
    parsed = [_parsed(line) for line in lines]
    if 2 * sum(len(_LABEL.findall(line.text)) > 1 for line in lines) > sum(bool(line.text) for line in lines):
        bare = [_parsed(_Line(_LABEL.sub("", line.text), line.time_s)) for line in lines]
        for guess in _guesses_of(bare):
            guess.tables["frame"]["labels"] = True
            yield guess
    yield from _guesses_of(parsed)
    yield from _lettered_guesses(lines)
    found = [_TAIL.search(line.text) for line in lines]
    tails = Counter(one[0] for one in found if one is not None)
    for tail, seen in tails.most_common(1):
        if 2 * seen > sum(bool(line.text) for line in lines):
            bare = [_parsed(_Line(line.text.removesuffix(tail), line.time_s)) for line in lines]
            for guess in _guesses_of(bare):
                guess.tables["frame"]["suffix"] = tail
                yield guess


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


def _guesses_of(parsed: Sequence[_Line]) -> Iterator[Guess]:
    kinds = Counter((line.prefix, len(line.numbers)) for line in parsed if line.numbers)
    for (prefix, count), seen in kinds.most_common(3):
        if seen >= FEWEST_LINES:
            yield from _line_guesses(parsed, prefix, count)


def _lines(chunks: Sequence[Chunk]) -> list[_Line]:
    """Whole lines, each with the time at which its end came."""
    lines, rest = [], b""
    for chunk in chunks:
        *whole, rest = (rest + chunk.data).split(b"\n")
        lines += [_Line(line.decode("ascii", "replace").strip(" \t\r\0"), chunk.time_s) for line in whole]
    return lines[1:]


def _parsed(line: _Line) -> _Line:
    """The line with the numbers at its end, and the text ahead of them."""
    text = line.text
    for place in range(min(len(text), 60)):
        if place and (text[place - 1].isalnum() or text[place - 1] in "+-._"):
            continue
        found = _NUMBERS.match(text, place)
        if found is not None:
            words = _words(found[0])
            if words:
                return _Line(text, line.time_s, text[:place], tuple(map(_value, words)))
    return line


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


def _line_guesses(lines: Sequence[_Line], prefix: str, count: int) -> Iterator[Guess]:
    """Guesses where the lines with ``count`` numbers behind ``prefix`` carry the cells."""
    mine = [line for line in lines if line.prefix == prefix and len(line.numbers) == count]
    numbers = np.array([line.numbers for line in mine])
    frame: dict[str, Any] = {"format": "text"}
    separator = _separator(mine, prefix, count)
    if separator is not None:
        frame["separator"] = separator
    if prefix:
        frame["prefix"] = prefix.rstrip()
    ended = _end(lines, mine)
    if ended is not None and count > 1:
        end, rows = ended
        keys: dict[str, Any] = {"layout": "row-per-line", "end": end}
        yield board_guess(rows, count, frame | keys, numbers, known_shape=True)
    if count == 1:
        for lines_in_frame in [ended[1]] if ended else [rows for rows, _ in _rows_without_end(mine, numbers)]:
            keys = {"layout": "cell-per-line"} | ({"end": ended[0]} if ended else {})
            for rows, columns in shapes(lines_in_frame)[:1] or [(1, lines_in_frame)]:
                yield board_guess(rows, columns, _without(frame, "separator") | keys, numbers, known_shape=False)
        return
    numbered = _numbered_rows(numbers[:, 0])
    if numbered:
        keys = {"layout": "row-per-line", "skip": 1, "numbered_rows": True}
        yield board_guess(numbered, count - 1, frame | keys, numbers[:, 1:], known_shape=True)
    if ended is None:
        for rows, how in _rows_without_end(mine, numbers):
            guess = board_guess(rows, count, frame | {"layout": "row-per-line"}, numbers, known_shape=True)
            guess.remarks["frame.layout"] = f"? {how}; nothing in the lines says which one is the first of a frame"
            yield guess
    skip = _rising_columns(numbers)
    for ahead in dict.fromkeys((skip, 0)):
        keys = {"layout": "frame-per-line"} | ({"skip": ahead} if ahead else {})
        for rows, columns in shapes(count - ahead)[:1] or [(1, count - ahead)]:
            yield board_guess(rows, columns, frame | keys, numbers[:, ahead:], known_shape=False)


def _without(frame: dict[str, Any], key: str) -> dict[str, Any]:
    return {name: value for name, value in frame.items() if name != key}


def _separator(lines: Sequence[_Line], prefix: str, count: int) -> str | None:
    """The separator, if it is one that shows missing numbers, too."""
    for mark in (",", ";", "\t"):
        fits = sum(len(line.text[len(prefix) :].split(mark)) in (count, count + 1) for line in lines)
        if fits >= USUAL * len(lines):
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
        if len(between) < FEWEST_LINES - 1:
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


def _numbered_rows(first: FloatArray) -> int:
    """Rows of a frame, if the first numbers of the lines count from 0 or 1 up, again and again; 0: they do not."""
    begins = np.flatnonzero(np.diff(first) != 1) + 1
    if len(begins) < 2 or first[begins[0]] not in (0.0, 1.0):
        return 0
    (rows, seen), *_ = Counter(np.diff(begins).tolist()).most_common(1)
    return rows if rows > 1 and seen >= USUAL * (len(begins) - 1) and set(first[begins]) == {first[begins[0]]} else 0


def _rows_without_end(lines: Sequence[_Line], numbers: FloatArray) -> Iterator[tuple[int, str]]:
    """Rows of a frame by the pauses between lines, and by how much lines are alike."""
    gaps = np.diff([line.time_s for line in lines])
    pauses = np.flatnonzero(gaps > max(3 * float(np.median(gaps)), PAUSE_S))
    if len(pauses) >= FEWEST_LINES:
        (rows, seen), *_ = Counter(np.diff(pauses).tolist()).most_common(1)
        if 1 < rows <= MOST_ROWS and seen >= 0.6 * (len(pauses) - 1):
            yield rows, f"{rows} lines come between two pauses"
    most = min(len(numbers) // 3, MOST_ROWS)
    if most < 2:
        return
    filled = np.nan_to_num(numbers)
    apart = np.array([np.abs(filled[lag:] - filled[:-lag]).mean() for lag in range(1, most + 1)])
    least = apart[1:].min()
    if least < ALIKE * apart[0]:
        rows = 2 + int(np.flatnonzero(apart[1:] <= 1.1 * least)[0])
        yield rows, f"lines {rows} apart are alike"


def _rising_columns(numbers: FloatArray) -> int:
    """Numbers at the head of a line that only rise: counters and times."""
    steps = np.diff(numbers, axis=0)
    rising = (steps >= 0).all(axis=0) & ((steps > 0).mean(axis=0) > USUAL)
    return int(np.argmin(rising)) if not rising.all() else 0


def _json_guesses(lines: Sequence[_Line]) -> Iterator[Guess]:
    """Guesses for a JSON document in each line."""
    found: Counter[tuple[str, tuple[int, ...]]] = Counter()
    samples: dict[tuple[str, tuple[int, ...]], list[FloatArray]] = {}
    for line in lines:
        if line.text[:1] not in ("{", "["):
            continue
        try:
            document = json.loads(_LIST.sub("NaN", line.text))
        except (ValueError, RecursionError):
            continue
        for key, grid in _grids(document, ""):
            kind = (key, grid.shape)
            found[kind] += 1
            samples.setdefault(kind, []).append(grid)
    for (key, shape), seen in sorted(found.items(), key=lambda item: -item[1] * np.prod(item[0][1])):
        if seen < FEWEST_LINES:
            continue
        frame: dict[str, Any] = {"format": "json"} | ({"key": key} if key else {}) | {"layout": "frame-per-line"}
        numbers = np.concatenate([grid.ravel() for grid in samples[key, shape]])
        guessed = [shape] if len(shape) == 2 else shapes(shape[0])[:1] or [(1, shape[0])]
        yield board_guess(guessed[0][0], guessed[0][1], frame, numbers, known_shape=len(shape) == 2)


def _grids(document: Any, key: str) -> Iterator[tuple[str, FloatArray]]:
    """Lists of numbers in a document with their dotted keys, as arrays of one or two axes."""
    if isinstance(document, dict):
        for name, value in document.items():
            if "." not in name:
                yield from _grids(value, f"{key}.{name}" if key else name)
    elif isinstance(document, list) and len(document) > 1:
        try:
            grid = np.array(document, dtype=np.float64)  # null is NaN
        except (ValueError, TypeError):
            return
        if grid.ndim in (1, 2):
            yield key, grid
