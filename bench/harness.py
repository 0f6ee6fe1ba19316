"""One table for all measurements: rows are dataclasses, whose fields say how their columns look."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from time import monotonic
from typing import Any, Protocol, TypeVar

import numpy as np

from ..common.arrays import FloatArray

GAP = "  "
MISS = 40.0
"""2/0.05, the price of an error beyond a 95 % interval"""


@dataclass(frozen=True)
class Column:
    """How a field of a row is shown."""

    title: str
    """with ``{}`` for the key, of a field that is a dictionary and has a column for each key"""
    form: str
    """a format of :meth:`str.format`"""
    width: int
    """least width; texts are longer in later rows than in the first"""
    unit: float
    """by which a number is divided"""


def column(title: str, form: str = "{:.3g}", *, width: int = 0, unit: float = 1.0) -> dict[str, Column]:
    """Metadata of a field of a measurement that its table shows; other fields are in its JSON only."""
    return {"column": Column(title, form, width, unit)}


def table(rows: Iterable[Any], head: str = "") -> Iterator[str]:
    """The measurements as lines of text, as they come, beneath ``head`` and the titles of the first one's columns."""
    if head:
        yield head
    widths: list[int] = []
    for row in rows:
        cells = list(_cells(row))
        if not widths:
            widths = [max(len(title), len(text), width) for title, text, width, _ in cells]
            titles = [_aligned(title, width, left) for (title, _, _, left), width in zip(cells, widths, strict=True)]
            yield GAP.join(titles).rstrip()
        texts = (_aligned(text, width, left) for (_, text, _, left), width in zip(cells, widths, strict=True))
        yield GAP.join(texts).rstrip()


def _aligned(text: str, width: int, left: bool) -> str:
    return f"{text:<{width}}" if left else f"{text:>{width}}"


def _cells(row: Any) -> Iterator[tuple[str, str, int, bool]]:
    """Title, text, least width and whether it is aligned to the left, of each column of a row."""
    for item in fields(row):
        column: Column | None = item.metadata.get("column")
        if column is None:
            continue
        value = getattr(row, item.name)
        pairs = value.items() if isinstance(value, dict) else [(None, value)]
        for key, one in pairs:
            title = column.title if key is None else column.title.format(key)
            yield title, _text(one, column), column.width, isinstance(one, str)


def _text(value: Any, column: Column) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        value = len(value)
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if isinstance(value, (int, float)) and column.unit != 1.0:
        value /= column.unit
    return column.form.format(value)


class Tally(Protocol):
    """What a search has found in one family."""

    findings: list[str]


Found = TypeVar("Found", bound=Tally)


def search(
    tallies: Mapping[str, Found], check: Callable[[str, int, Found], None], seed: int, seconds: float
) -> Iterator[str]:
    """Check number after number, one of each family in turn, until the time is up; yields findings as they are made."""
    until, number = monotonic() + seconds, seed * 10_000_000
    while monotonic() < until:
        for family, tally in tallies.items():
            known = len(tally.findings)
            check(family, number, tally)
            yield from tally.findings[known:]
        number += 1


def interval_score(error: FloatArray, std: FloatArray) -> float:
    """Mean interval score (Gneiting & Raftery 2007, equation 43) of two standard deviations to both sides.

    Width of the 95 % interval, and :data:`MISS` times the distance of a truth that lies outside: proper, so that a
    deviation is neither too wide nor too narrow for free. Arguments have one shape and unit.
    """
    return float(np.mean(4.0 * std + MISS * np.maximum(np.abs(error) - 2.0 * std, 0.0)))
