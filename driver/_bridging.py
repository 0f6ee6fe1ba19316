"""Contacts across unread cells: linear interpolation over gaps of one cell.

A dead line, or the column of a shorted cell, would cut a finger into two contacts. A missing cell therefore belongs to
a contact if two of its neighbours on opposite sides do. Its pressure is estimated by their mean. If the middle of a
finger lies on the gap, the finger presses harder there, and its force is a lower bound. Gaps of two cells and more are
not bridged, since there may be two fingers. A gap at the rim of the skin is not bridged either, since it has one side
only.
"""

from __future__ import annotations

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray


def bridge(
    pressure_kpa: FloatArray, touched: BoolArray, missing: BoolArray, opposite: IntArray
) -> tuple[BoolArray, FloatArray]:
    """Find the missing cells within contacts.

    Args:
        pressure_kpa: (rows, columns); NaN allowed where missing.
        touched: (rows, columns) cells of contacts.
        missing: (rows, columns) cells that are not read.
        opposite: (n, 3) a cell and two neighbours on opposite sides of it, as numbers in the flattened array.

    Returns:
        (rows, columns) missing cells between touched ones, and (rows, columns) pressures in kPa: interpolated there,
        but not below the cell's last one, and as given elsewhere.

    """
    seen = (touched & ~missing).ravel()
    cell, one, other = opposite.T
    across = missing.ravel()[cell] & seen[one] & seen[other]
    cell, one, other = opposite[across].T
    pressure = pressure_kpa.ravel()
    sums = np.bincount(cell, (pressure[one] + pressure[other]) / 2, minlength=pressure.size)
    ways = np.bincount(cell, minlength=pressure.size)
    inside = (ways > 0).reshape(pressure_kpa.shape)
    between = (sums / np.maximum(ways, 1)).reshape(pressure_kpa.shape)
    return inside, np.where(inside, np.fmax(pressure_kpa, between), pressure_kpa)
