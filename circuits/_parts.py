"""A design's parts as arrays, one entry per line, with its faults in place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from ..arrays import FloatArray
from ._design import Design, PerLine
from .solvers._ports import Lines

_WIRE = 1e60  # S


@dataclass(frozen=True)
class Parts:
    """Every key that takes a number or a list, as an array of one per row (N,) or per column (M,)."""

    row_lead: FloatArray
    """ohm"""
    row_segment: FloatArray
    column_lead: FloatArray
    """ohm; inf where the line is broken behind its last crosspoint"""
    column_segment: FloatArray
    reference: FloatArray
    """ohm: Rref, or the divider's load"""
    gain: FloatArray
    offset: FloatArray
    """V"""
    bias: FloatArray
    """A"""

    @classmethod
    def of(cls, design: Design) -> Self:
        """The parts of a design. Of its faults only the break of a column's lead is here, see :func:`line_ohms`."""
        array, readout = design.array, design.readout
        rows, columns = array.shape
        return cls(
            row_lead=_each(array.row_lead, rows),
            row_segment=_each(array.row_segment, rows),
            column_lead=_each(array.column_lead, columns) + series_faults(design, "broken-column")[-1],
            column_segment=_each(array.column_segment, columns),
            reference=_each(readout.reference_resistance, columns),
            gain=_each(readout.open_loop_gain, columns),
            offset=_each(readout.offset_voltage, columns),
            bias=_each(readout.bias_current, columns),
        )


def line_ohms(design: Design) -> tuple[FloatArray, FloatArray]:
    """Ohm of the wire ahead of each crosspoint along its row and along its column, both (rows, columns).

    ``row[i, 0]`` is the row's lead; ``column[0]`` is 0, since a column line starts there.
    """
    array = design.array
    row = np.repeat(_each(array.row_segment, array.rows)[:, None], array.columns, axis=1)
    row[:, 0] = _each(array.row_lead, array.rows)
    column = np.repeat(_each(array.column_segment, array.columns)[None], array.rows, axis=0)
    column[0] = 0.0
    column[1:] += series_faults(design, "broken-column")[:-1]
    return row + series_faults(design, "broken-row"), column


def lines(design: Design) -> Lines:
    """Series conductances along the lines in S, row leads and breaks included, column leads not."""
    row, column = line_ohms(design)
    return Lines(siemens(row), siemens(column))


def cell_conductance(design: Design, resistance: FloatArray) -> FloatArray:
    """S of the cells (..., rows, columns), open and shorted ones among them."""
    if not design.fault:
        return siemens(resistance)
    conductance = siemens(resistance + series_faults(design, "open-cell"))
    for fault in design.fault:
        if fault.kind == "shorted-cell":
            conductance[(..., *fault.place)] += siemens(fault.ohms)
    return conductance


def siemens(ohms: FloatArray | float) -> FloatArray:
    """Conductances; what is below 1e-60 ohm is a wire, since products of larger conductances would overflow."""
    with np.errstate(divide="ignore", over="ignore"):
        conductance = np.divide(1.0, ohms)
    return conductance if conductance.max(initial=0.0) <= _WIRE else np.where(conductance > _WIRE, np.inf, conductance)


def series_faults(design: Design, kind: str) -> FloatArray:
    """Ohm (rows, columns) that the faults of one kind put in series."""
    ohms = np.zeros(design.array.shape)
    for fault in design.fault:
        if fault.kind == kind:
            ohms[fault.place] += fault.ohms
    return ohms


def _each(value: PerLine, count: int) -> FloatArray:
    return np.full(count, value, dtype=np.float64)
