"""Types of numpy arrays, named once for all packages; median and scatter of small arrays; read-only copies."""

from __future__ import annotations

from statistics import NormalDist
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
    return median(np.abs(values)) / MEDIAN_OF_NORMAL


MEDIAN_OF_NORMAL = NormalDist().inv_cdf(0.75)
"""median of the absolute values of standard normal numbers"""
IN_CACHE = 1 << 17
"""values of the largest temporary arrays of what is computed in pieces: 1 MB; an eighth of it, in an inner cache"""
