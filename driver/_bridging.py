"""Contacts across unread cells: linear interpolation over gaps of one cell.

A dead line, or the column of a shorted cell, would cut a finger into two contacts. A missing cell therefore belongs to
a contact if the cells on both sides of it do, along its row or along its column. Its pressure is estimated by the mean
of these two. If the middle of a finger lies on the gap, the finger presses harder there, and its force is a lower
bound. Gaps of two cells and more are not bridged, since there may be two fingers. A gap at the rim of the skin is not
bridged either, since it has one side only.
"""

from __future__ import annotations

import numpy as np

from ..common.arrays import BoolArray, FloatArray


def bridge(pressure_kpa: FloatArray, touched: BoolArray, missing: BoolArray) -> tuple[BoolArray, FloatArray]:
    """Find the missing cells within contacts.

    Args:
        pressure_kpa: (rows, columns); NaN allowed where missing.
        touched: (rows, columns) cells of contacts.
        missing: (rows, columns) cells that are not read.

    Returns:
        (rows, columns) missing cells between touched ones, and (rows, columns) pressures in kPa: interpolated there,
        but not below the cell's last one, and as given elsewhere.

    """
    seen = touched & ~missing
    by_column, in_column = _between(pressure_kpa.T, seen.T)
    by_row, in_row = _between(pressure_kpa, seen)
    in_column, by_column = in_column.T, by_column.T
    inside = missing & (in_column | in_row)
    ways = np.maximum(in_column.astype(np.float64) + in_row, 1.0)
    between = (np.where(in_column, by_column, 0.0) + np.where(in_row, by_row, 0.0)) / ways
    return inside, np.where(inside, np.fmax(pressure_kpa, between), pressure_kpa)


def _between(pressure_kpa: FloatArray, seen: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Mean pressure of the cells left and right of each cell, and where both are seen."""
    mean, both = np.zeros(pressure_kpa.shape), np.zeros(seen.shape, dtype=np.bool_)
    mean[:, 1:-1] = (pressure_kpa[:, :-2] + pressure_kpa[:, 2:]) / 2
    both[:, 1:-1] = seen[:, :-2] & seen[:, 2:]
    return mean, both
