"""CSV files: matrices of cells and columns of recordings. Errors name the file and the line."""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path

import numpy as np

from ..errors import InputError
from ._spreadsheet import Rows
from .arrays import FloatArray
from .files import whole_file
from .text import shortened

MOST_CELL_BYTES = 64 * 2**20
"""size limit of a frame: 1024 x 1024 numbers of 25 characters take 26 MiB"""
MOST_RECORDING_BYTES = 512 * 2**20
"""size limit of a recording: a day at 100 samples/s takes about 400 MB"""
TIME, LINE = "time_s", "line"
OPEN = "OL"
"""what multimeters show beyond their range"""
_PREFIXES = {"": 1.0, "k": 1e3, "K": 1e3, "M": 1e6, "G": 1e9}
_WITH_PREFIX = re.compile(r"([\d.,]+)\s*([kKMG])(?:ohm|Ω)?")


def read_cells(path: str | Path, shape: tuple[int, int]) -> FloatArray:
    """Read lines of cell resistances in ohm as an array of ``shape``; :mod:`._spreadsheet` has the forms of a file.

    ``inf`` and ``OL``, which multimeters show, are open cells, 0 is a short, and ``4.7k``, ``1M`` are taken. A first
    line without a number is a header.

    Raises:
        InputError: unreadable, empty or ragged file, another shape, a field that is not a number, negative or NaN.

    """
    rows = Rows(path, MOST_CELL_BYTES)
    table = _matrix(path, rows, lambda line, field: _resistance(path, rows, line, field), header=True)
    if table.shape != shape:
        found, wanted = "{} lines of {} numbers".format(*table.shape), "{} lines of {}".format(*shape)
        raise InputError(f"{path}: has {found}, expected {wanted} (rows x columns of the design)")
    return table


def read_matrix(path: str | Path) -> FloatArray:
    """Read lines of as many numbers each as a two-dimensional array; :mod:`._spreadsheet` has the forms of a file.

    Raises:
        InputError: unreadable, empty or ragged file, or a field that is not a number.

    """
    rows = Rows(path, MOST_CELL_BYTES)
    return _matrix(path, rows, rows.number, header=False)


def _matrix(path: str | Path, rows: Rows, number: Callable[[int, str], float], *, header: bool) -> FloatArray:
    """Lines of numbers; with ``header``, a first line of which no field looks like a number is left out."""
    values = array("d")
    count = columns = 0
    for line, fields in rows:
        if header:
            header = False
            columns = len(fields)
            if not any(_reads(number, line, field) or field.lstrip()[:1].isdigit() for field in fields):
                continue
        values.extend(number(line, field) for field in fields)
        count, columns = count + 1, columns or len(fields)
        if len(fields) != columns:
            raise InputError(f"{path}: line {line}: lines of unequal length, {len(fields)} fields after {columns}")
    return np.array(values).reshape(count, columns)


def _reads(number: Callable[[int, str], float], line: int, field: str) -> bool:
    try:
        number(line, field)
    except InputError:
        return False
    return True


def read_columns(
    path: str | Path, names: Sequence[str], *, note: Callable[[str], None] = lambda said: None
) -> dict[str, FloatArray]:
    """Read the named columns of a CSV file with a header line; :mod:`._spreadsheet` has the forms of a file.

    An empty field or ``nan`` is NaN. A column ``time_s`` may have dates (ISO 8601), which become seconds since the
    first one.

    Args:
        path: of the file.
        names: of the columns.
        note: called with a message about a last line that was cut off while it was written, and is left out.

    Returns:
        The columns, and under :data:`LINE` the line of each row.

    Raises:
        InputError: unreadable or empty file, a missing column, or a field that is not a number.

    """
    return Table(path, note=note).columns(names)


class Table:
    """A CSV file with columns of any names; columns without a header are called 1, 2, ..."""

    def __init__(self, path: str | Path, *, note: Callable[[str], None] = lambda said: None) -> None:
        """Read a file. Raises InputError: unreadable, empty or ragged; ``note`` reports a last line that is cut."""
        self.path, self._rows = path, Rows(path, MOST_RECORDING_BYTES, spaces=True)
        lines = iter(self._rows)
        self._first, first = next(lines)
        header = [name.strip() for name in first]
        self.named = not all(_is_number_or_date(field) for field in header)
        """whether the file has a header"""
        self.header = header if self.named else [str(place + 1) for place in range(len(header))]
        self.lines: list[int] = [] if self.named else [self._first]
        self._fields: list[list[str]] = [] if self.named else [first]
        for line, fields in _of_length(len(header), lines, self._rows, path, note):
            self.lines.append(line)
            self._fields.append(fields)
        if not self._fields:
            raise InputError(f"{path}: no data below the header")

    def columns(self, names: Sequence[str]) -> dict[str, FloatArray]:
        """As :func:`read_columns`."""
        if missing := [name for name in names if name not in self.header]:
            raise InputError(
                f"{self.path}: line {self._first}: no column '{missing[0]}'; expected {','.join(names)}, got "
                f"{shortened(','.join(self.header))}"
            )
        for line, fields in zip(self.lines, self._fields, strict=True):
            if len(fields) > len(self.header):
                raise InputError(f"{self.path}: line {line}: {len(fields)} fields, expected {len(self.header)}")
        columns = {name: self.numbers(self.header.index(name), dates=name == TIME) for name in names}
        return columns | {LINE: np.array(self.lines, dtype=np.float64)}

    def texts(self, place: int) -> list[str]:
        """A column as it is written."""
        return [fields[place].strip() for fields in self._fields]

    def numbers(self, place: int, *, dates: bool = False) -> FloatArray:
        """A column (n,); empty fields are NaN. ``dates``: they may be dates, which become seconds since the first one.

        Raises InputError, naming the line, for a field that is neither.
        """
        read, found = _Dates(self.path), array("d")
        for line, fields in zip(self.lines, self._fields, strict=True):
            field = fields[place]
            seconds = read.seconds(line, field) if dates and field.strip() else None
            if seconds is not None:
                found.append(seconds)
            elif field.strip().upper() == OPEN:
                found.append(math.inf)
            else:
                found.append(self._rows.number(line, field) if field.strip() else math.nan)
        return np.array(found)


def _of_length(
    count: int, lines: Iterator[tuple[int, list[str]]], rows: Rows, path: str | Path, note: Callable[[str], None]
) -> Iterator[tuple[int, list[str]]]:
    """The lines of ``count`` fields or more; a last one with fewer that is cut off is noted, any other is refused."""
    for line, fields in lines:
        if len(fields) >= count:
            yield line, fields
        elif rows.cut:
            note(f"{path}: line {line} is cut off, and left out")
            return
        else:
            raise InputError(f"{path}: line {line}: {len(fields)} fields, expected {count}")


def _is_number_or_date(field: str) -> bool:
    with suppress(ValueError):
        float(field.replace(",", ".") or "nan")
        return True
    with suppress(ValueError):
        return ":" in field and bool(datetime.fromisoformat(field))
    return False


class _Dates:
    """Dates of one column as seconds since the first one."""

    def __init__(self, path: str | Path) -> None:
        self._path = path
        self._first: datetime | None = None
        self._numbers = False

    def seconds(self, line: int, field: str) -> float | None:
        """None for a field that is no date. Raises InputError for dates among numbers and among other dates."""
        date = None
        if ":" in field:  # no number has a colon
            with suppress(ValueError):
                date = datetime.fromisoformat(field.strip())
        among_dates, among_numbers = self._first is not None, self._numbers
        if (date is None and among_dates) or (date is not None and among_numbers):
            raise InputError(f"{self._path}: line {line}: expected dates in all lines, or numbers of seconds in all")
        if date is None:
            self._numbers = True
            return None
        self._first = self._first or date
        try:
            return (date - self._first).total_seconds()
        except TypeError as error:
            raise InputError(f"{self._path}: line {line}: a date with a time zone among dates without one") from error


def write_matrix(path: str | Path, matrix: FloatArray) -> None:
    """Write a (rows, columns) array as CSV that reads back bit for bit."""
    write_text(path, format_matrix(matrix))


def format_matrix(matrix: FloatArray) -> str:
    """CSV text of a (rows, columns) array."""
    return "".join(",".join(map(repr, row)) + "\n" for row in matrix.tolist())


def write_columns(path: str | Path, columns: Mapping[str, Iterable[float]]) -> None:
    """Write equally long columns with a header line."""
    rows = zip(*(np.asarray(c, dtype=np.float64).tolist() for c in columns.values()), strict=True)
    body = "".join(",".join(map(repr, row)) + "\n" for row in rows)
    write_text(path, ",".join(columns) + "\n" + body)


def write_text(path: str | Path, text: str) -> None:
    """Write a whole UTF-8 file or nothing; InputError where it cannot be written.

    Lone surrogates, which stand for the bytes of a file name that is not UTF-8, become backslash escapes.
    """
    with whole_file(path) as file:
        file.write(text.encode("utf-8", "backslashreplace"))


def _resistance(path: str | Path, rows: Rows, line: int, field: str) -> float:
    text = field.strip()
    if text.upper() == OPEN:
        return math.inf
    found = _WITH_PREFIX.fullmatch(text)
    number, prefix = (found[1], found[2]) if found else (text, "")
    value = rows.number(line, number) * _PREFIXES[prefix]
    if not value >= 0:
        raise InputError(f"{path}: line {line}: {text} is not a resistance; expected ohm >= 0 or inf")
    return value
