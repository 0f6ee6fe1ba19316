"""Frames in lines: numbers with separators, or JSON documents, as ``[frame]`` of BOARD.toml describes them.

A line is whole or dropped. A line without numbers (boot messages, debug output) is skipped and counted. A frame of
several lines ends at its end line, or its lines say their place; where neither is so, the pauses between frames show
which line is the first (:class:`._cells.Pauses`). What a line has besides cells is a pattern (:class:`._patterns`).
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cached_property
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ._blocks import WORDS
from ._cells import AnyFrame, Cells, Copies, Numbers, Pauses, Unwrapped
from ._framing import LineHost, StartTable
from ._packets import Corrupt, Event, Order
from ._patterns import PLACES, TIMES_US, LinePattern
from ._protocol import Family, Layout

LONGEST_NUMBER = 40
"""characters of a number in a line"""
LEAST_LINE = 1024
"""characters that a line may have at least, for boot messages"""
MISSING = frozenset(("", "nan", "null", "none", "inf", "ovf"))
"""what boards print in the place of a number that they do not have"""
AMBIGUOUS = (
    "ambiguous: no end line, row number or pause shows which line is the first of a frame; "
    "counted from the first that came"
)
MOST_LISTS = 8
"""lists in each other in a JSON document"""
MOST_FOUND = 2**16
"""values that a key of a JSON document may name"""

_SEPARATORS = re.compile(r"[\s,;:|\[\](){}]+")
_AROUND = " \t,;:|[](){}"
"""separators at the ends of a list"""
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
_LABEL = re.compile(r"\b[A-Za-z_]\w*\s*[:=]\s*")
_BARE_NAN = re.compile(rb"(?<=[\[,:\s])[+-]?(nan|inf|ovf)(?=[\],\s}])", re.IGNORECASE)
"""what C prints for numbers that JSON lacks"""


@dataclass(frozen=True)
class LineNumbers:
    """What a line carries."""

    cells: list[float]
    """NaN where one is missing"""
    fields: Mapping[str, float] = field(default_factory=dict)
    """other numbers by name, as in :mod:`._patterns`"""

    @property
    def place(self) -> tuple[float, ...]:
        """What the line says of its place: row, row and column, or index; empty: nothing."""
        return tuple(self.fields[name] for name in PLACES if name in self.fields)


class _LinesFrame(AnyFrame):
    """Keys of formats that send lines."""

    layout: Literal["frame-per-line", "row-per-line", "cell-per-line"] = "frame-per-line"
    end: Annotated[str, Field(max_length=200)] | None = None
    """unless frame-per-line: line, or beginning of the line, that ends a frame; "": an empty line; None: none does"""
    skip: Annotated[int, Field(ge=0, le=64)] = 0
    """numbers ahead of the cells in each line"""
    numbered_rows: bool = False
    """row-per-line: the first of the skipped numbers is the row's, from 0 or from 1"""
    newline: Annotated[str, Field(pattern=r"^[ \t,;]*\r?\n$")] = "\r\n"
    """end of a line as the emulator sends it; a host takes every usual one"""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.layout == "frame-per-line" and self.end is not None:
            raise ValueError('end has no effect on layout = "frame-per-line"; expected "row-per-line"')
        if self.layout != "row-per-line" and self.numbered_rows:
            raise ValueError(f'numbered_rows has no effect on layout = "{self.layout}"; expected "row-per-line"')
        if self.numbered_rows and not self.skip:
            raise ValueError("numbered_rows needs skip = 1 or more: the first skipped number is that of the row")
        return self

    @model_validator(mode="after")
    def _is_read_back(self) -> Self:
        """What a board of this format sends is what its host looks for: each text in one line, nothing beside it."""
        values = [1.0, 0.0, 2.0]
        line, *more = _lines_of(self.written(values, {}) + self.newline)
        found = self.read(line, len(values))
        if more or found is None or found.cells != values:
            raise ValueError(
                f"a line of this format, {self.written(values, {}) + self.newline!r}, would not be read; expected "
                "printable ASCII without white space at the ends of a line, and a newline that adds no separator"
            )
        if self.end is not None:
            line, *more = _lines_of(self.end + "\n")
            if more or not self.is_end(line):
                raise ValueError(f'end: {self.end!r} is no line; expected printable ASCII in one line, or ""')
        return self

    @property
    def by_frames(self) -> bool:
        """Whether a line is a whole frame."""
        return self.layout == "frame-per-line"

    def cells_in_line(self, layout: Layout) -> int:
        """Cells in a line."""
        return {"frame-per-line": layout.rows * layout.columns, "row-per-line": layout.columns, "cell-per-line": 1}[
            self.layout
        ]

    def is_end(self, line: str) -> bool:
        """Whether a line ends a frame."""
        return self.end is not None and (line.startswith(self.end.strip()) if self.end.strip() else not line)

    @property
    def marked(self) -> bool:
        """Whether a line shows that its beginning is not missing."""
        return True

    @property
    def ahead(self) -> list[str]:
        """Names of the numbers ahead of the cells that no pattern names."""
        return [*(["row"] if self.numbered_rows else []), *["skip"] * self.skip][: self.skip]

    @property
    def fields(self) -> list[str]:
        """Names of what a line carries beside the cells."""
        return self.ahead

    @property
    def has_number(self) -> bool:
        return "number" in self.fields

    @property
    def has_time(self) -> bool:
        return self.time is not None

    @property
    def placed(self) -> bool:
        """Whether each line says its place in the frame."""
        return any(name in PLACES for name in self.fields)

    @property
    def time(self) -> str | None:
        """Name of the field of the board's time."""
        return next((name for name in self.fields if name in TIMES_US), None)

    def read(self, line: str, expected: int) -> LineNumbers | None:
        """The numbers of a line of so many cells; None: the line is no line of numbers."""
        raise NotImplementedError

    def written(self, values: list[float], fields: Mapping[str, int]) -> str:
        """A line with these numbers, without its end."""
        raise NotImplementedError

    def with_ahead(self, numbers: list[float], fields: Mapping[str, float]) -> LineNumbers:
        """The numbers of a line, of which the first are no cells."""
        named = dict(zip(self.ahead, numbers, strict=False))
        return LineNumbers(numbers[self.skip :], named | dict(fields))

    def write(self, numbers: Numbers, layout: Layout, *, sequence: int = 0, time_us: int = 0) -> bytes:
        """The bytes of a frame with these numbers; those that are not read are zeros."""
        text, in_line = "", self.cells_in_line(layout)
        time_name = self.time
        for number, row in enumerate(numbers.reshape(-1, in_line).tolist()):
            at = number * in_line
            fields = {"index": number, "row": at // layout.columns, "column": at % layout.columns, "number": sequence}
            if time_name is not None:
                fields[time_name] = int(time_us / TIMES_US[time_name])
            whole = [int(value) if value.is_integer() else float(f"{value:.15g}") for value in row]
            text += self.written(whole, fields) + self.newline
        return (text + ("" if self.end is None else self.end + "\r\n")).encode()


class TextFrame(_LinesFrame):
    """``[frame]`` with ``format = "text"``: numbers in lines."""

    format: Literal["text"]
    separator: Annotated[str, Field(min_length=1, max_length=8, pattern=r"^[^0-9+\-.\r\n]+$")] | None = None
    """between two numbers; of letters: any run of these; None: any run of spaces, tabs, brackets, and , ; : |"""
    labels: bool = False
    """each number has its name ahead, as in ``A0:512``; the names are not read"""
    prefix: Annotated[str, Field(max_length=200)] = ""
    """text at the head of every line with numbers; other lines are skipped"""
    suffix: Annotated[str, Field(max_length=200)] = ""
    """text at the end of every line with numbers, likewise"""

    line: Annotated[str, Field(min_length=1, max_length=400)] | None = None
    """what a line looks like (:mod:`._patterns`), in place of prefix, suffix, skip and numbered_rows"""
    encoding: Literal["decimal", "hex", "base64"] = "decimal"
    word: Literal["", *WORDS] = ""  # type: ignore[valid-type]  # a list of names that is in one place only
    """of numbers without separators, in hexadecimal digits or base64"""

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if self.line is not None:
            for key in ("prefix", "suffix", "skip", "numbered_rows"):
                if key in self.model_fields_set:
                    raise ValueError(f"{key} has no effect beside line, which says all that a line has")
            places = self._pattern.places
            fits = {"row-per-line": (["row"], ["index"]), "cell-per-line": (["row", "column"], ["index"])}
            if places and places not in fits.get(self.layout, ()):
                names = " and ".join(f"{{{name}}}" for name in places)
                raise ValueError(f'line: {names} do not place the lines of layout = "{self.layout}"')
        if self.encoding == "base64" and not self.word:
            raise ValueError('encoding = "base64" needs a word, such as uint16le')
        if self.word and self.encoding == "decimal":
            raise ValueError('word has no effect on decimal numbers; expected encoding = "hex" or "base64"')
        return self

    @cached_property
    def _pattern(self) -> LinePattern:
        """The pattern of a line."""
        if self.line is None:
            return LinePattern((self.prefix, "cells", self.suffix))
        return LinePattern.parse(self.line)

    @property
    def marked(self) -> bool:
        return bool(self._pattern.parts[0].strip())

    @property
    def fields(self) -> list[str]:
        return self.ahead if self.line is None else self._pattern.fields

    def read(self, line: str, expected: int) -> LineNumbers | None:
        found = self._pattern.read(line)
        if found is None:
            return None
        text, fields = found
        numbers = self._numbers(text, expected + self.skip)
        return None if None in numbers else self.with_ahead(numbers, fields)  # type: ignore[arg-type]  # None is not in it

    def _numbers(self, text: str, expected: int) -> list[float | None]:
        """The numbers between their separators; None for what is no number."""
        if self.word:
            return self._decoded(text)
        if self.labels:
            text = _LABEL.sub("", text)
        if self.separator is None:
            words = _SEPARATORS.split(text.strip(_AROUND))
        elif self.separator.isalpha():
            words = re.split(f"[{self.separator}\\s]+", text.strip(f" \t{self.separator}"))
        else:
            words = [word.strip() for word in text.split(self.separator)]
            if len(words) == expected + 1 and not words[-1]:
                words.pop()
        return [_hexadecimal(word) if self.encoding == "hex" else _number(word) for word in words]

    def _decoded(self, text: str) -> list[float | None]:
        """The numbers of words without separators."""
        word = WORDS[self.word]
        try:
            data = bytes.fromhex(text) if self.encoding == "hex" else base64.b64decode(text.strip(), validate=True)
        except (ValueError, binascii.Error):
            return [None]
        count = word.count_in(len(data))
        return [None] if count is None else list(word.decode(data, count).tolist())

    def written(self, values: list[float], fields: Mapping[str, int]) -> str:
        words = list(map(str, [*(fields.get(name, 0) for name in self.ahead), *values]))
        between = " " if self.separator is None else self.separator[:1] if self.separator.isalpha() else self.separator
        if self.word:
            data = WORDS[self.word].encode(np.array(values))
            text = data.hex() if self.encoding == "hex" else base64.b64encode(data).decode()
        elif self.encoding == "hex":
            text = between.join(f"{int(value):x}" for value in values)
        else:
            text = between.join(f"c{k}:{word}" for k, word in enumerate(words)) if self.labels else between.join(words)
        return self._pattern.write(text, {name: str(value) for name, value in fields.items()})


Key = Annotated[str, Field(max_length=200)]


class JsonFrame(_LinesFrame):
    """``[frame]`` with ``format = "json"``: a JSON document in each line."""

    format: Literal["json"]
    key: Key = ""
    """of the list of numbers, keys of inner objects after dots, where ``*`` and ``?`` stand for any characters and a
    list's items have the keys 0, 1 ...; "": the document is the list"""
    number: Key = ""
    """key of the frame's number"""
    row_number: Key = ""
    """row-per-line: key of the row's number, from 0 or 1 on"""
    time_s: Key = ""
    time_ms: Key = ""
    time_us: Key = ""
    """key of the board's time"""

    @property
    def fields(self) -> list[str]:
        return [*self.ahead, *self._named]

    @property
    def _named(self) -> dict[str, str]:
        """Fields by name, with their keys."""
        keys = {"row": self.row_number, "number": self.number}
        keys |= {"time_s": self.time_s, "time_ms": self.time_ms, "time_us": self.time_us}
        return {name: key for name, key in keys.items() if key}

    def read(self, line: str, expected: int) -> LineNumbers | None:
        try:
            document = json.loads(_BARE_NAN.sub(b"NaN", line.encode()))
            fields = {name: float(_found(document, key)[0]) for name, key in self._named.items()}
            numbers = list(_flat(_found(document, self.key), MOST_LISTS))
        except (ValueError, KeyError, TypeError, IndexError, RecursionError, OverflowError):
            return None
        return self.with_ahead(numbers, fields)

    def written(self, values: list[float], fields: Mapping[str, int]) -> str:
        numbers = [*(fields.get(name, 0) for name in self.ahead), *values]
        document: Any = {}
        for name, key in self._named.items():
            document = _joined(document, _put(key, fields.get(name, 0)))
        parts = self.key.split(".")
        if any(map(_is_pattern, parts)):
            for k, number in enumerate(numbers):
                document = _joined(document, _put(_numbered(self.key, k), number))
        elif self.key:
            document = _joined(document, _put(self.key, numbers))
        else:
            document = numbers
        return json.dumps(document, separators=(",", ":"))


def _is_pattern(part: str) -> bool:
    return "*" in part or "?" in part


def _found(document: Any, key: str) -> list[Any]:
    """The values that a key names, in the order of the document. KeyError or TypeError: there is none."""
    found = [document]
    for part in key.split(".") if key else []:
        if not _is_pattern(part):
            found = [one[part] for one in found]
        else:
            found = [value for one in found for name, value in _items(one) if fnmatchcase(name, part)]
        if len(found) > MOST_FOUND:
            raise TypeError("too many values")
    return found


def _items(one: Any) -> list[tuple[str, Any]]:
    """Names and values of an object, or of a list's items."""
    return list(one.items()) if isinstance(one, dict) else [(str(k), item) for k, item in enumerate(one)]


def _numbered(key: str, number: int) -> str:
    """A key that a key with ``*`` or ``?`` stands for."""
    head, *rest = re.split(r"[*?]+", key)
    return head + str(number) + "".join(rest)


def _put(key: str, value: object) -> object:
    """Objects in each other with the value at a key."""
    for part in reversed(key.split(".")):
        value = {part: value}
    return value


def _joined(one: Any, other: Any) -> Any:
    """Two documents as one."""
    if not (isinstance(one, dict) and isinstance(other, dict)):
        return other
    return one | {name: _joined(one.get(name), value) for name, value in other.items()}


def _lines_of(sent: str) -> list[str]:
    """The lines of what is sent as a host has them."""
    return [_text_of(line) for line in sent.encode().split(b"\n")[:-1]]


def _text_of(line: bytes) -> str:
    """A line as text, without white space at its ends; with U+FFFD for bytes that are none."""
    return line.decode("ascii", errors="replace").strip(" \t\r\0")


def _number(word: str) -> float | None:
    """The number of a word; NaN where the board has none, None where the word is none."""
    if len(word) <= LONGEST_NUMBER and _NUMBER.fullmatch(word):
        return float(word)
    return math.nan if word == "-" or (word.lstrip("+-").lower() in MISSING and not word.endswith("-")) else None


def _hexadecimal(word: str) -> float | None:
    """The number of hexadecimal digits."""
    digits = word.lower().removeprefix("0x")
    return float(int(digits, 16)) if re.fullmatch(r"[0-9a-f]{1,8}", digits) else None


def _flat(found: list[object], levels: int) -> Iterator[float]:
    """The numbers of lists in lists; TypeError for anything else."""
    for item in found:
        if isinstance(item, list) and levels > 1:
            yield from _flat(item, levels - 1)
        elif item is None:
            yield math.nan
        elif isinstance(item, int | float) and not isinstance(item, bool):
            yield float(item) if isinstance(item, float) or abs(item) < 2**63 else math.nan
        else:
            raise TypeError("no number")


class TextHost(LineHost):
    """Host end of a format in lines."""

    def __init__(
        self, form: TextFrame | JsonFrame, cells: Cells, start: StartTable, family: Family, layout: Layout
    ) -> None:
        super().__init__(family, layout)
        self._form, self._cells, self._start = form, cells, start
        self._in_line = form.cells_in_line(layout)
        self._expected, self._lines = form.skip + self._in_line, cells.count // self._in_line
        """numbers in a line, and lines in a frame"""
        affixes = len(form.written([], {}))
        self.longest = max(self._expected * (LONGEST_NUMBER // 2) + affixes, LEAST_LINE)
        self._rows: list[LineNumbers] = []
        """of the frame under way"""
        self._places: set[int] = set()
        """of its lines, where they say it"""
        self._first_place: float | None = None
        """number of the first row, column or line: 0 or 1; None: not known yet"""
        self._size = 0
        """bytes of the lines of the frame under way"""
        self._fault = ""
        """why the frame under way is none"""
        if form.end is not None and not family.polled:
            self._fault = "the host joined in the middle of a frame"
        # The beginning of a first line may be missing, unless its prefix or its brackets show that it is whole.
        self._first = not (family.polled or form.marked)
        self._pauses = Pauses(self._lines)
        self._copies = Copies(form.copies)
        self._count, self._clock = Unwrapped(), Unwrapped()
        self._ahead = 0
        """bytes of lines that came before it was known where a frame begins"""

    def request(self, order: Order, *, period_us: int = 0) -> bytes:
        return self._start.order(order)

    def broken(self) -> None:
        self._fault = self._fault or "a line that is too long"

    def take(self, line: bytes, received_at: float) -> list[Event]:
        return self._copies.without(self._take(line, received_at))

    def _take(self, line: bytes, received_at: float) -> list[Event]:
        size, first, self._first = len(line) + 1, self._first, False
        text = _text_of(line)
        if not text.isascii():
            self._fault = self._fault or "a line with bytes that are no text"
            return [Corrupt(size, "a line with bytes that are no text")]
        if not self._form.by_frames and self._form.is_end(text):
            self._size += size
            return self._finish()
        if not text:
            return []
        if first and self._form.end is None and not self._form.placed:
            return [Corrupt(size, "the host joined in the middle of a line")]
        numbers = self._form.read(text, self._in_line)
        if numbers is None:
            self._pauses.begin()
            if 0 < len(self._rows) < self._lines:  # as likely a damaged row as a message
                self._fault = self._fault or "a line without numbers between its rows"
            return [Corrupt(size, f"a line of text: {text[:40]!r}")]
        found = len(numbers.cells)
        fault = "" if found == self._in_line else f"a line of {found} numbers; expected {self._in_line}"
        if self._form.by_frames:
            return [Corrupt(size, fault) if fault else self._event([numbers], size)]
        return self._place(numbers, size, fault, received_at)

    def _place(self, numbers: LineNumbers, size: int, fault: str, received_at: float) -> list[Event]:
        """Take one of the lines of a frame."""
        events: list[Event] = []
        if self._form.end is None or self._form.placed:
            begins = self._begins_by_place(numbers) if self._form.placed else self._begins(received_at)
            if not begins and not self._rows:
                self._ahead += size
                return []
            if begins:
                events = self._drop()
        self._size += size
        self._fault = self._fault or fault or self._misplaced(numbers)
        if len(self._rows) <= self._lines:  # more rows need not be kept to know that they are too many
            self._rows.append(numbers)
        if self._form.end is None and len(self._rows) == self._lines:
            events += self._finish()
        return events

    def _begins_by_place(self, numbers: LineNumbers) -> bool:
        """Whether a line that says its place begins a frame: it is the first, and not among the frame under way."""
        place = set(numbers.place)
        if len(place) > 1 or not place <= ({0.0, 1.0} if self._first_place is None else {self._first_place}):
            return False
        return not self._rows or self._at(numbers, self._rows[0].place[0]) in self._places | {-1}

    def _misplaced(self, numbers: LineNumbers) -> str:
        """Why a line that says its place is none of the frame under way; empty if it is."""
        if not self._form.placed:
            return ""
        at = self._at(numbers, numbers.place[0] if not self._rows else self._rows[0].place[0])
        if at in self._places or not 0 <= at < self._lines:
            return "rows whose numbers do not follow each other"
        self._places.add(at)
        return ""

    def _at(self, numbers: LineNumbers, first: float) -> int:
        """Which line of the frame this is, by what it says; -1: none."""
        place = [value - first for value in numbers.place]
        if any(not value.is_integer() or value < 0 for value in place):
            return -1
        if len(place) == 1:
            return int(place[0])
        columns = self.layout.columns
        return int(place[0]) * columns + int(place[1]) if place[1] < columns else -1

    def _begins(self, received_at: float) -> bool:
        """Whether a line begins a frame, by the pauses between lines."""
        place = self._pauses.arrive(received_at)
        return self._pauses.decided and place == self._pauses.start

    def _drop(self) -> list[Event]:
        """End what came before a frame, or a frame that is not complete."""
        events: list[Event] = []
        if self._ahead:
            reason = AMBIGUOUS if self._pauses.by_pause is None else "lines ahead of the first pause"
            reason = "lines ahead of the first one of a frame" if self._form.placed else reason
            events.append(Corrupt(self._ahead, reason))
        if self._rows or self._fault:
            fault = self._fault or f"a frame of {len(self._rows)} lines; expected {self._lines}"
            events.append(Corrupt(self._size, fault))
        self._rows, self._places, self._size, self._fault, self._ahead = [], set(), 0, "", 0
        return events

    def _finish(self) -> list[Event]:
        """The event of the frame under way, which is over."""
        rows, size, form = self._rows, self._size, self._form
        if not rows and not self._fault:
            self._size = 0
            return []  # an end line behind another
        if self._fault or len(rows) != self._lines:
            return self._drop()
        self._rows, self._places, self._size = [], set(), 0
        if form.placed:
            first = self._first_place = rows[0].place[0]
            rows = sorted(rows, key=lambda row: self._at(row, first))
        return [self._event(rows, size)]

    def _event(self, rows: list[LineNumbers], size: int) -> Event:
        """The event of a whole frame."""
        fields, clock = rows[0].fields, self._form.time
        sequence = round(self._count.of_text(fields["number"])) if "number" in fields else None
        time_us = None if clock is None else round(TIMES_US[clock] * self._clock.of_text(fields[clock]))
        cells = np.array([row.cells for row in rows]).ravel()
        return self._cells.event(cells, size, sequence=sequence, time_us=time_us)
