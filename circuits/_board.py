"""A board: the parts of a design as arrays, with the circuit that reads them and its converter.

Scans, recovery and all other analyses take a :class:`Board`. ``design.board`` makes it once and keeps it. Its arrays
are in line coordinates, which :mod:`._parts` explains.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import inf
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import FloatArray
from ._parts import Parts
from ._readout import Readout
from ._sections import Adc, Array, Drive, Fault, PerLine, Sheet
from .readouts import CIRCUITS, LinearReadout, ReadoutCircuit


@dataclass(frozen=True, eq=False)
class Board(Parts):
    """Parts in line coordinates, with the readout circuit and the ADC."""

    circuit: ReadoutCircuit
    """the circuit at the columns' ends"""
    readout: Readout
    """the design's own section: capacitances, bandwidth and noise, which are the same for all columns"""
    adc: Adc | None
    """None: the outputs are not converted"""

    @classmethod
    def of(
        cls, array: Array, sheet: Sheet, drive: Drive, readout: Readout, adc: Adc | None, faults: tuple[Fault, ...]
    ) -> Self:
        """Expand the sections of a design. Users take ``design.board``, which keeps the result."""
        circuit = CIRCUITS[readout.circuit]
        turned = circuit.senses == "rows"
        row_keys, column_keys = (array.row_lead, array.row_segment), (array.column_lead, array.column_segment)
        driven, sensed = (column_keys, row_keys) if turned else (row_keys, column_keys)
        rows, columns = array.shape[::-1] if turned else array.shape

        def each(value: PerLine, count: int) -> FloatArray:
            lines: FloatArray = np.full(count, value, dtype=np.float64)
            return lines[::-1] if turned else lines

        if turned:
            faults = tuple(_turned_fault(fault, array.shape) for fault in faults)
        severed = series_ohms(faults, "broken-column", (rows, columns))
        row_ohms = np.repeat(each(driven[1], rows)[:, None], columns, axis=1)
        row_lead = each(driven[0], rows)
        row_ohms[:, 0] = row_lead
        column_ohms = np.repeat(each(sensed[1], columns)[None], rows, axis=0)
        column_ohms[0] = 0.0
        column_ohms[1:] += severed[:-1]
        return cls(
            shape=(rows, columns),
            row_ohms=row_ohms + series_ohms(faults, "broken-row", (rows, columns)),
            column_ohms=column_ohms,
            column_lead=each(sensed[0], columns) + severed[-1],
            series_ohms=series_ohms(faults, "open-cell", (rows, columns)),
            faults=faults,
            reference=each(readout.reference_resistance, columns),
            gain=each(readout.open_loop_gain, columns),
            offset=each(readout.offset_voltage, columns),
            bias=each(readout.bias_current, columns),
            drive=drive.voltage,
            level=readout.reference_voltage,
            supply=readout.supply,
            turned=turned,
            floating=drive.idle_rows != "ground" and not circuit.drives_idle_lines,
            pull=drive.idle_row_resistance,
            row_lead=row_lead,
            multiplexed=readout.columns == "multiplexed",
            idle_columns=readout.idle_columns,
            continuous=array.sheet == "continuous",
            sheet=sheet,
            circuit=circuit,
            readout=readout,
            adc=adc,
        )

    @property
    def virtual_grounds(self) -> bool:
        """Whether amplifiers hold all columns at the reference at once, each measuring its column's current."""
        return self.circuit.virtual_ground and not self.multiplexed

    @cached_property
    def linear(self) -> LinearReadout | None:
        """The readout as a linear function of transfer conductances; None where it is not one."""
        return self.circuit.linear(self)


def cell_alone(board: Board, conductance: FloatArray, shunt: FloatArray) -> FloatArray:
    """Conductance (N, M) in S of the cells, without known faults in parallel (``shunt``, S) and in series."""
    own = np.maximum(conductance - shunt, 0.0)
    if not board.series_ohms.any():
        return own
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(own > 0, 1.0 / np.maximum(1.0 / own - board.series_ohms, 0.0), 0.0)


def series_ohms(faults: tuple[Fault, ...], kind: str, shape: tuple[int, int]) -> FloatArray:
    """Ohm (rows, columns) in series by all faults of one kind; several faults at one place add up."""
    ohms = np.zeros(shape)
    for fault in faults:
        if fault.kind == kind:
            ohms[fault.place] += fault.ohms
    return ohms


_TURNED_KIND = {
    "broken-row": "broken-column",
    "broken-column": "broken-row",
    "bridged-rows": "bridged-columns",
    "bridged-columns": "bridged-rows",
}


def _turned_fault(fault: Fault, shape: tuple[int, int]) -> Fault:
    """The same fault in the line coordinates of a board that senses the array's rows."""
    rows, columns = shape
    (row, column), there = fault.ends if fault.bridge else (fault.place, fault.place)
    to = None
    if fault.bridge:
        to = rows - 1 - there[0] if fault.kind == "bridged-rows" else columns - 1 - there[1]
    place = columns - 1 - column, rows - 1 - row
    return fault.replace(kind=_TURNED_KIND.get(fault.kind, fault.kind), place=place, to=to)


def broken_off(board: Board) -> NDArray[np.bool_]:
    """(N, M) cells beyond a complete break of their line: they conduct, but have no reading of their own."""
    cut = np.zeros(board.shape, dtype=np.bool_)
    for fault in board.faults:
        row, column = fault.place
        if fault.kind == "broken-row" and fault.ohms == inf:
            cut[row, column:] = True
        elif fault.kind == "broken-column" and fault.ohms == inf:
            cut[: row + 1, column] = True
    return cut
