"""CSV in and out: matrices of cells and columns of a recording. Faults name the file and the line."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from .arrays import FloatArray
from .errors import InputError
from .files import whole_file


def read_cells(path: str | Path, shape: tuple[int, int]) -> FloatArray:
    """Read lines of comma-separated cell resistances in ohm (``inf`` = open, 0 = short) as an array of ``shape``.

    Raises:
        InputError: unreadable, empty or ragged file, another shape, a field that is not a number, negative or NaN.

    """
    lines = _lines(path)
    rows = [[_resistance(path, line, field) for field in fields] for line, fields in lines]
    for (line, _), row in zip(lines, rows, strict=True):
        if len(row) != len(rows[0]):
            raise InputError(f"{path}: line {line}: lines of unequal length, {len(row)} fields after {len(rows[0])}")
    matrix = np.array(rows, dtype=np.float64)
    if matrix.shape != shape:
        found, wanted = "{} lines of {} numbers".format(*matrix.shape), "{} lines of {}".format(*shape)
        raise InputError(f"{path}: has {found}, expected {wanted} (rows x columns of the design)")
    return matrix


def read_columns(path: str | Path, names: Sequence[str]) -> dict[str, FloatArray]:
    """Read the named columns of a CSV file with a header line; an empty field or ``nan`` is NaN.

    Raises:
        InputError: unreadable or empty file, a missing column, or a field that is not a number.

    """
    lines = iter(_lines(path))
    _, header = next(lines)
    header = [name.strip() for name in header]
    missing = [name for name in names if name not in header]
    if missing:
        raise InputError(
            f"{path}: line 1: no column '{missing[0]}'; expected {','.join(names)}, got {','.join(header)}"
        )
    places = [header.index(name) for name in names]
    values: list[list[float]] = []
    for line, fields in lines:
        if len(fields) != len(header):
            raise InputError(f"{path}: line {line}: {len(fields)} fields, expected {len(header)}")
        values.append([_number(path, line, fields[k], empty_is_nan=True) for k in places])
    if not values:
        raise InputError(f"{path}: no data below the header")
    table = np.array(values, dtype=np.float64)
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
    """Write a whole file or nothing; InputError where it cannot be written."""
    with whole_file(path) as file:
        file.write(text.encode())


def _lines(path: str | Path) -> list[tuple[int, list[str]]]:
    """Non-blank lines with their numbers, split into fields."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            lines = [(n, fields) for n, fields in enumerate(csv.reader(file), 1) if any(f.strip() for f in fields)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(f"{path}: cannot be read: {reason}") from error
    if not lines:
        raise InputError(f"{path}: the file is empty")
    return lines


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
        shown = field.strip() if len(field) < 40 else field.strip()[:36] + " ..."
        raise InputError(
            f"{path}: line {line}: {shown!r} is not a number; expected numbers separated by commas"
        ) from None
