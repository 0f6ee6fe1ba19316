"""CSV files: matrices of cells and columns of recordings. Errors name the file and the line."""

from __future__ import annotations

import csv
import math
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from ..errors import InputError
from .arrays import FloatArray
from .files import read_lines, whole_file
from .text import shortened

MOST_CELL_BYTES = 64 * 2**20
"""size limit of a frame: 1024 x 1024 numbers of 25 characters take 26 MiB"""
MOST_RECORDING_BYTES = 512 * 2**20
"""size limit of a recording: a day at 100 samples/s takes about 400 MB"""
LONGEST_LINE = 2**20
"""bytes: 1024 numbers take 26 KiB"""


def read_cells(path: str | Path, shape: tuple[int, int]) -> FloatArray:
    """Read lines of comma-separated cell resistances in ohm (``inf`` = open, 0 = short) as an array of ``shape``.

    Raises:
        InputError: unreadable, empty or ragged file, another shape, a field that is not a number, negative or NaN.

    """
    values = array("d")
    rows = columns = 0
    for line, fields in _lines(path, MOST_CELL_BYTES):
        values.extend(_resistance(path, line, field) for field in fields)
        rows, columns = rows + 1, columns or len(fields)
        if len(fields) != columns:
            raise InputError(f"{path}: line {line}: lines of unequal length, {len(fields)} fields after {columns}")
    if (rows, columns) != shape:
        found, wanted = f"{rows} lines of {columns} numbers", "{} lines of {}".format(*shape)
        raise InputError(f"{path}: has {found}, expected {wanted} (rows x columns of the design)")
    return np.array(values).reshape(shape)


def read_matrix(path: str | Path) -> FloatArray:
    """Read lines of as many comma-separated numbers each as a two-dimensional array.

    Raises:
        InputError: unreadable, empty or ragged file, or a field that is not a number.

    """
    values = array("d")
    rows = columns = 0
    for line, fields in _lines(path, MOST_CELL_BYTES):
        values.extend(_number(path, line, field) for field in fields)
        rows, columns = rows + 1, columns or len(fields)
        if len(fields) != columns:
            raise InputError(f"{path}: line {line}: lines of unequal length, {len(fields)} fields after {columns}")
    return np.array(values).reshape(rows, columns)


def read_columns(path: str | Path, names: Sequence[str]) -> dict[str, FloatArray]:
    """Read the named columns of a CSV file with a header line; an empty field or ``nan`` is NaN.

    Raises:
        InputError: unreadable or empty file, a missing column, or a field that is not a number.

    """
    lines = _lines(path, MOST_RECORDING_BYTES)
    _, header = next(lines)
    header = [name.strip() for name in header]
    missing = [name for name in names if name not in header]
    if missing:
        raise InputError(
            f"{path}: line 1: no column '{missing[0]}'; expected {','.join(names)}, got {shortened(','.join(header))}"
        )
    places = [header.index(name) for name in names]
    values = array("d")
    for line, fields in lines:
        if len(fields) != len(header):
            raise InputError(f"{path}: line {line}: {len(fields)} fields, expected {len(header)}")
        values.extend(_number(path, line, fields[k], empty_is_nan=True) for k in places)
    if not values:
        raise InputError(f"{path}: no data below the header")
    table = np.array(values).reshape(-1, len(names))
    return {name: table[:, k].copy() for k, name in enumerate(names)}


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


def _lines(path: str | Path, most_bytes: int) -> Iterator[tuple[int, list[str]]]:
    """Non-blank lines with their numbers, split into fields."""
    empty = True
    reader = csv.reader(read_lines(path, most_bytes=most_bytes, longest_line=LONGEST_LINE))
    try:
        for fields in reader:
            if any(field.strip() for field in fields):
                empty = False
                yield reader.line_num, fields
    except csv.Error as error:
        raise InputError(f"{path}: line {reader.line_num}: cannot be read: {error}") from error
    if empty:
        raise InputError(f"{path}: the file is empty")


def _resistance(path: str | Path, line: int, field: str) -> float:
    value = _number(path, line, field)
    if not value >= 0:
        raise InputError(f"{path}: line {line}: {field.strip()} is not a resistance; expected ohm >= 0 or inf")
    return value


def _number(path: str | Path, line: int, field: str, *, empty_is_nan: bool = False) -> float:
    if empty_is_nan and not field.strip():
        return math.nan
    try:
        return float(field)
    except ValueError:
        shown = shortened(field.strip(), 40)
        raise InputError(
            f"{path}: line {line}: {shown!r} is not a number; expected numbers separated by commas"
        ) from None
