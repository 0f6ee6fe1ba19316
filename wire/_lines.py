"""Frames in lines: numbers with separators, or JSON documents, as ``[frame]`` of BOARD.toml describes them.

A line is whole or dropped. A line without numbers (boot messages, debug output) is skipped and counted. A frame of
several lines ends at its end line, or its rows are numbered; where neither is so, the pauses between frames show which
line is the first (:class:`._cells.Pauses`).
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ._cells import AnyFrame, Cells, Numbers, Pauses
from ._framing import LineHost, StartTable
from ._packets import Corrupt, Event, Order
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

_SEPARATORS = re.compile(r"[\s,;:|]+")
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
_LABEL = re.compile(r"\b[A-Za-z_]\w*\s*[:=]\s*")
_BARE_NAN = re.compile(rb"(?<=[\[,:\s])[+-]?(nan|inf|ovf)(?=[\],\s}])", re.IGNORECASE)
"""what C prints for numbers that JSON lacks"""


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
        line, *more = _lines_of(self.line(values) + self.newline)
        if more or self.read(line, len(values)) != values:
            raise ValueError(
                f"a line of this format, {self.line(values) + self.newline!r}, would not be read; expected texts of "
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

    def read(self, line: str, expected: int) -> list[float] | None:
        """The numbers of a line, NaN where one is missing; None: the line is no line of numbers."""
        raise NotImplementedError

    def line(self, values: list[float]) -> str:
        """A line with these numbers, without its end."""
        raise NotImplementedError

    def write(self, numbers: Numbers, layout: Layout, *, sequence: int = 0, time_us: int = 0) -> bytes:
        """The bytes of a frame with these numbers; those that are not read are zeros, such as a number or a time."""
        text = ""
        for number, row in enumerate(numbers.reshape(-1, self.cells_in_line(layout)).tolist()):
            ahead = [0 if self.by_frames else number, *[0] * (self.skip - 1)][: self.skip]
            whole = (int(value) if value.is_integer() else float(f"{value:.15g}") for value in row)
            text += self.line([*ahead, *whole]) + self.newline
        return (text + ("" if self.end is None else self.end + "\r\n")).encode()


class TextFrame(_LinesFrame):
    """``[frame]`` with ``format = "text"``: numbers in lines."""

    format: Literal["text"]
    separator: Annotated[str, Field(min_length=1, max_length=8, pattern=r"^[^0-9+\-.\r\n]+$")] | None = None
    """between two numbers; of letters: any run of these; None: any run of spaces, tabs, and , ; : |"""
    labels: bool = False
    """each number has its name ahead, as in ``A0:512``; the names are not read"""
    prefix: Annotated[str, Field(max_length=200)] = ""
    """text at the head of every line with numbers; other lines are skipped"""
    suffix: Annotated[str, Field(max_length=200)] = ""
    """text at the end of every line with numbers, likewise"""

    @property
    def marked(self) -> bool:
        return bool(self.prefix)

    def read(self, line: str, expected: int) -> list[float] | None:
        if not (line.startswith(self.prefix) and line[len(self.prefix) :].endswith(self.suffix)):
            return None
        text = line[len(self.prefix) : len(line) - len(self.suffix)]
        if self.labels:
            text = _LABEL.sub("", text)
        if self.separator is None:
            words = _SEPARATORS.split(text.strip(" \t,;:|"))
        elif self.separator.isalpha():
            words = re.split(f"[{self.separator}\\s]+", text.strip(f" \t{self.separator}"))
        else:
            words = [word.strip() for word in text.split(self.separator)]
            if len(words) == expected + 1 and not words[-1]:
                words.pop()
        numbers = [_number(word) for word in words]
        return None if None in numbers else numbers  # type: ignore[return-value]  # None is not in it

    def line(self, values: list[float]) -> str:
        words = [f"c{k}:{value}" for k, value in enumerate(values)] if self.labels else map(str, values)
        between = " " if self.separator is None else self.separator[:1] if self.separator.isalpha() else self.separator
        return self.prefix + between.join(words) + self.suffix


class JsonFrame(_LinesFrame):
    """``[frame]`` with ``format = "json"``: a JSON document in each line."""

    format: Literal["json"]
    key: Annotated[str, Field(max_length=200)] = ""
    """of the list of numbers, keys of inner objects after dots; "": the document is the list"""

    def read(self, line: str, expected: int) -> list[float] | None:
        try:
            found = json.loads(_BARE_NAN.sub(b"NaN", line.encode()))
            for part in self._path:
                found = found[part]
            return list(_flat(found, MOST_LISTS)) if isinstance(found, list) else None
        except (ValueError, KeyError, TypeError, RecursionError):
            return None

    def line(self, values: list[float]) -> str:
        document: object = values
        for key in reversed(self._path):
            document = {key: document}
        return json.dumps(document, separators=(",", ":"))

    @property
    def _path(self) -> list[str]:
        return self.key.split(".") if self.key else []


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
        in_line = form.cells_in_line(layout)
        self._expected, self._lines = form.skip + in_line, cells.count // in_line
        """numbers in a line, and lines in a frame"""
        affixes = len(form.prefix + form.suffix) if isinstance(form, TextFrame) else 0
        self.longest = max(self._expected * (LONGEST_NUMBER // 2) + affixes, LEAST_LINE)
        self._rows: list[list[float]] = []
        """of the frame under way"""
        self._size = 0
        """bytes of the lines of the frame under way"""
        self._fault = ""
        """why the frame under way is none"""
        if form.end is not None and not family.polled:
            self._fault = "the host joined in the middle of a frame"
        # The beginning of a first line may be missing, unless its prefix or its brackets show that it is whole.
        self._first = not (family.polled or form.marked)
        self._pauses = Pauses(self._lines)
        self._ahead = 0
        """bytes of lines that came before it was known where a frame begins"""

    def request(self, order: Order, *, period_us: int = 0) -> bytes:
        return self._start.order(order)

    def broken(self) -> None:
        self._fault = self._fault or "a line that is too long"

    def take(self, line: bytes, received_at: float) -> list[Event]:
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
        if first and self._form.end is None:
            return [Corrupt(size, "the host joined in the middle of a line")]
        numbers = self._form.read(text, self._expected)
        if numbers is None:
            self._pauses.begin()
            if 0 < len(self._rows) < self._lines:  # as likely a damaged row as a message
                self._fault = self._fault or "a line without numbers between its rows"
            return [Corrupt(size, f"a line of text: {text[:40]!r}")]
        wrong = len(numbers) != self._expected
        fault = f"a line of {len(numbers)} numbers; expected {self._expected}" if wrong else ""
        if self._form.by_frames:
            cells = np.array(numbers[self._form.skip :])
            return [Corrupt(size, fault) if fault else self._cells.event(cells, size)]
        events: list[Event] = []
        if self._form.end is None:
            begins = self._begins_by_number(numbers) if self._form.numbered_rows else self._begins(received_at)
            if not begins and not self._rows:
                self._ahead += size
                return []
            if begins:
                events = self._drop()
        self._size += size
        self._fault = self._fault or fault
        if len(self._rows) <= self._lines:  # more rows need not be kept to know that they are too many
            self._rows.append(numbers)
        if self._form.end is None and len(self._rows) == self._lines:
            events += self._finish()
        return events

    def _begins_by_number(self, numbers: list[float]) -> bool:
        """Whether a numbered row begins a frame: its number does not follow the last one."""
        if self._rows and self._rows[-1][0] + 1 == numbers[0]:
            return False
        return numbers[0] in (0.0, 1.0) or not self._rows

    def _begins(self, received_at: float) -> bool:
        """Whether a line begins a frame, by the pauses between lines."""
        place = self._pauses.arrive(received_at)
        return self._pauses.decided and place == self._pauses.start

    def _drop(self) -> list[Event]:
        """End what came before a frame, or a frame that is not complete."""
        events: list[Event] = []
        if self._ahead:
            reason = AMBIGUOUS if self._pauses.by_pause is None else "lines ahead of the first pause"
            events.append(Corrupt(self._ahead, reason))
        if self._rows or self._fault:
            fault = self._fault or f"a frame of {len(self._rows)} lines; expected {self._lines}"
            events.append(Corrupt(self._size, fault))
        self._rows, self._size, self._fault, self._ahead = [], 0, "", 0
        return events

    def _finish(self) -> list[Event]:
        """The event of the frame under way, which is over."""
        rows, size, form = self._rows, self._size, self._form
        if not rows and not self._fault:
            self._size = 0
            return []  # an end line behind another
        if self._fault or len(rows) != self._lines:
            return self._drop()
        if form.numbered_rows and any(row[0] != rows[0][0] + k for k, row in enumerate(rows)):
            self._fault = "rows whose numbers do not follow each other"
            return self._drop()
        self._rows, self._size = [], 0
        return [self._cells.event(np.array([row[form.skip :] for row in rows]).ravel(), size)]
