"""Rows of CSV files as programs and spreadsheets write them.

=============================  ====================================================================================
``1,2``, ``1;2``, tab          the separator is a semicolon or a tab if the first line with data has one, else a comma;
                               a first line ``sep=;``, as spreadsheets write it, decides
``1 2``                        spaces, where they are allowed and the first line with data has only numbers
``1,5;2``                      a decimal comma, if commas do not separate fields; between tabs ``4,700`` is refused,
                               because it may be 4.7 or 4700
``# ...``                      a comment line
empty lines                    left out
=============================  ====================================================================================
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from ..errors import InputError
from .files import read_lines
from .text import shortened

LONGEST_LINE = 2**20
"""bytes: 1024 numbers take 26 KiB"""
_DECLARED = re.compile(r"sep=(.)", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?(\d+,\d*|,\d+)(e[+-]?\d+)?", re.IGNORECASE)
_SPACED = re.compile(r"\s*[+-]?[\d.]+(e[+-]?\d+)?( +[+-]?[\d.]+(e[+-]?\d+)?)+\s*$", re.IGNORECASE)
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")


class Rows:
    """The rows of one file with the numbers of their lines."""

    def __init__(self, path: str | Path, most_bytes: int, *, spaces: bool = False) -> None:
        """``spaces``: whether they may separate numbers."""
        self._path, self._most_bytes, self._spaces = path, most_bytes, spaces
        self._separator: str | None = None
        self.cut = False
        """whether the line that was read last has no line end"""

    def __iter__(self) -> Iterator[tuple[int, list[str]]]:
        """Yields line numbers and fields of all lines that are not blank. Raises InputError; also for an empty file."""
        lines = self._lines()
        head = list(self._up_to_data(lines))
        separator = self._separator or ","
        reader = csv.reader(chain(head, lines), delimiter=separator, skipinitialspace=separator == " ")
        empty = True
        try:
            for fields in reader:
                if any(field.strip() for field in fields):
                    empty = False
                    yield reader.line_num, fields
        except csv.Error as error:
            raise InputError(f"{self._path}: line {reader.line_num}: cannot be read: {error}") from error
        if empty:
            raise InputError(f"{self._path}: the file is empty")

    def number(self, line: int, field: str) -> float:
        """The number in a field. Raises InputError."""
        text = field.strip()
        try:
            return float(text)
        except ValueError:
            pass
        shown = repr(shortened(text, 40))
        if self._separator not in (None, ",") and _DECIMAL_COMMA.fullmatch(text):
            if self._separator == "\t" and _THOUSANDS.fullmatch(text):
                raise InputError(f"{self._path}: line {line}: {shown} may be a decimal comma or a thousands separator")
            return float(text.replace(",", "."))
        raise InputError(
            f"{self._path}: line {line}: {shown} is not a number; expected numbers separated by commas, semicolons or "
            "tabs"
        )

    def _lines(self) -> Iterator[str]:
        """All lines; comments and the declaration of the separator are made blank, so that lines keep their numbers."""
        lines = read_lines(self._path, most_bytes=self._most_bytes, longest_line=LONGEST_LINE)
        for number, text in enumerate(lines):
            self.cut = not text.endswith(("\n", "\r"))
            declared = _DECLARED.fullmatch(text.rstrip("\r\n")) if number == 0 else None
            if declared:
                self._separator = declared[1]
            yield "\n" if declared or text.lstrip().startswith("#") else text

    def _up_to_data(self, lines: Iterator[str]) -> Iterator[str]:
        """The lines up to the first one with data, which decides the separator where none is declared."""
        for text in lines:
            yield text
            if text.strip():
                if self._separator is None:
                    self._separator = next(
                        (mark for mark in ";\t" if mark in text), " " if self._spaces and _SPACED.match(text) else ","
                    )
                return
