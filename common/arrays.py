"""Types of numpy arrays, named once for all rooms; median and scatter of small arrays; copies in a given layout."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
SingleArray = NDArray[np.float32]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]
CodeArray = NDArray[np.uint32]
AnyArray = NDArray[Any]
N = TypeVar("N", np.float64, np.intp)

_SOON_SORTED = 256
"""values that are sorted sooner than their middle is found"""


def median(values: FloatArray) -> float:
    """Median of all values, at least one and none of them NaN.

    The same number as numpy.median, which spends ten times as long on the axes, masks and NaN of a small array.
    """
    ordered = values.flatten()
    half = ordered.size // 2
    if ordered.size <= _SOON_SORTED:
        ordered.sort()
        below = half - 1
    else:
        # One place at a time: NumPy takes several times as long to put two numbers in theirs.
        ordered.partition(half)
        below = int(ordered[:half].argmax())
    if ordered.size % 2:
        return ordered.item(half)
    return (ordered.item(below) + ordered.item(half)) / 2


def scatter(values: FloatArray) -> float:
    """Standard deviation about zero of most of the values, whatever the others are (median absolute deviation).

    At least one value, none of them NaN.
    """
    return median(np.abs(values)) / _MEDIAN_OF_NORMAL


_MEDIAN_OF_NORMAL = 0.6745
"""median of the absolute values of standard normal numbers"""


def read_only(values: AnyArray) -> AnyArray:
    """A contiguous, read-only copy in double precision, as loops of :mod:`ohmskin.common.compiled` take."""
    copy = np.array(values, dtype=np.float64, order="C")
    copy.flags.writeable = False
    return copy


_FEW = 64
"""columns that are written for all rows at once"""
_LINE = 8
"""numbers in a line of a processor's cache"""


def spaced(rows: NDArray[N]) -> NDArray[N]:
    """A copy of ``rows`` (n, m) that begin an odd number of cache lines apart (padding of the leading dimension).

    Loops over cells take a number from each of a hundred rows. Where rows are a power of two apart, as those of 64 x 64
    cells, all these numbers would share the few places of one set of the cache, and each would be fetched anew.
    """
    count, columns = rows.shape
    copy: NDArray[N] = np.empty((count, _apart(columns)), dtype=rows.dtype)[:, :columns]
    copy[...] = rows
    return copy


def spaced_anything(count: int, columns: int) -> FloatArray:
    """:func:`spaced` rows (count, columns) of any numbers, to be written to."""
    return np.empty((count, _apart(columns)))[:, :columns]


def whole(rows: NDArray[N]) -> NDArray[N]:
    """:func:`spaced` rows (n, m) with what is between them (n, more than m), without a gap; others as they are."""
    padded = rows.base
    if isinstance(padded, np.ndarray) and len(padded) == len(rows) and padded.strides == rows.strides:
        begins, padded_begins = (each.__array_interface__["data"] for each in (rows, padded))
        if begins == padded_begins:
            return padded
    return rows


def columns(rows: FloatArray, places: IntArray) -> FloatArray:
    """The columns of ``rows`` (n, m) at ``places`` (k,), (n, k). Of :func:`spaced` rows NumPy would first copy all."""
    return whole(rows).take(places, axis=1)


def spaced_columns(rows: NDArray[N], places: IntArray) -> NDArray[N]:
    """:func:`spaced` :func:`columns`, copied once: the first column of all fills the space between the rows."""
    padded = np.zeros(_apart(places.size), dtype=np.intp)
    padded[: places.size] = places
    found: NDArray[N] = whole(rows).take(padded, axis=1)
    return found[:, : places.size]


def put_columns(rows: FloatArray, places: IntArray, new: FloatArray) -> None:
    """Write ``new`` (n, k), or (n, 1) for all alike, over the columns of ``rows`` (n, m) at ``places`` (k,).

    Row by row if there are many: NumPy takes 15 times as long for all rows at once where there are thousands of places,
    and a third where there are a few. (For the same reason columns are read by ``take`` and ``compress``.)
    """
    if places.size <= _FEW:
        rows[:, places] = new
        return
    alike = new.shape[1] == 1  # a number is written in half the time of an array of one
    if alike and places.size == rows.shape[1]:
        rows[...] = new
        return
    for row, written in zip(rows, new[:, 0].tolist() if alike else new, strict=True):
        row[places] = written


def _apart(columns: int) -> int:
    """Numbers from the begin of one row to that of the next: an odd number of cache lines."""
    return (-(-columns // _LINE) | 1) * _LINE
