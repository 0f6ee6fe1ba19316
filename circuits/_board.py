"""A board: one design expanded into arrays, with one entry per line, crosspoint or column end.

Every solver and every analysis takes a :class:`Board`. ``design.board`` makes it once and keeps it.

Line coordinates
----------------
Inside a board the *rows* are the lines that are driven, and the *columns* are the lines that are sensed. For most
circuits these are the array's own rows and columns. A circuit that drives columns and senses rows has its array turned:
:meth:`Board.turn` takes arrays of the array's shape into line coordinates and back. In line coordinates row i is always
driven ahead of column 0, and column j is always sensed behind row N - 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import inf
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from .solvers import Lines, siemens

if TYPE_CHECKING:
    from ._design import Design, Fault, PerLine, Sheet
    from .readouts import LinearReadout, ReadoutCircuit

T = TypeVar("T", bound=np.generic)


@dataclass(frozen=True, eq=False)
class Board:
    """The parts of a design in line coordinates: N rows are driven, M columns are sensed."""

    design: Design
    circuit: ReadoutCircuit
    """what the columns end in"""
    shape: tuple[int, int]
    """N, M"""
    row_ohms: FloatArray
    """(N, M) ohm of the wire ahead of each crosspoint along its row, breaks included; ``[:, 0]`` is the row's lead"""
    column_ohms: FloatArray
    """(N, M) ohm of the wire ahead of each crosspoint along its column, breaks included; ``[0]`` is 0"""
    column_lead: FloatArray
    """(M,) ohm behind each column's last crosspoint; inf where the line is broken there"""
    series_ohms: FloatArray
    """(N, M) ohm that open-cell faults put in series with the cells"""
    faults: tuple[Fault, ...]
    """the design's faults, their places in line coordinates"""
    reference: FloatArray
    """(M,) ohm: the amplifiers' Rref, or the dividers' load"""
    gain: FloatArray
    """(M,) open-loop gain A"""
    offset: FloatArray
    """(M,) V, offset voltages"""
    bias: FloatArray
    """(M,) A, bias currents"""
    drive: float
    """V of the selected row against the reference"""
    level: float
    """V, the reference voltage"""
    supply: tuple[float, float]
    """V, output swing"""

    @classmethod
    def of(cls, design: Design, circuit: ReadoutCircuit) -> Board:
        """Expand a design. Users take ``design.board``, which keeps the result."""
        array, readout = design.array, design.readout
        turned = circuit.senses == "rows"
        row_keys, column_keys = (array.row_lead, array.row_segment), (array.column_lead, array.column_segment)
        driven, sensed = (column_keys, row_keys) if turned else (row_keys, column_keys)
        rows, columns = array.shape[::-1] if turned else array.shape

        def each(value: PerLine, count: int) -> FloatArray:
            lines: FloatArray = np.full(count, value, dtype=np.float64)
            return lines[::-1] if turned else lines

        faults = tuple(_turned_fault(fault, array.shape) for fault in design.fault) if turned else design.fault
        severed = series_ohms(faults, "broken-column", (rows, columns))
        row_ohms = np.repeat(each(driven[1], rows)[:, None], columns, axis=1)
        row_ohms[:, 0] = each(driven[0], rows)
        column_ohms = np.repeat(each(sensed[1], columns)[None], rows, axis=0)
        column_ohms[0] = 0.0
        column_ohms[1:] += severed[:-1]
        return cls(
            design=design,
            circuit=circuit,
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
            drive=design.drive.voltage,
            level=readout.reference_voltage,
            supply=readout.supply,
        )

    @property
    def turned(self) -> bool:
        """Whether the array's rows are sensed and its columns driven."""
        return self.circuit.senses == "rows"

    @property
    def line_kinds(self) -> tuple[str, str]:
        """What the array calls the lines that are driven and those that are sensed: "row" and "column", or reversed."""
        return ("column", "row") if self.turned else ("row", "column")

    def driven_line(self, row: int) -> int:
        """The array's number of the line that is row ``row`` of the board, or the other way round."""
        return self.shape[0] - 1 - row if self.turned else row

    def sensed_line(self, column: int) -> int:
        """The array's number of the line that is column ``column`` of the board, or the other way round."""
        return self.shape[1] - 1 - column if self.turned else column

    def turn(self, values: NDArray[T]) -> NDArray[T]:
        """Arrays (..., rows, columns) of the array in line coordinates, or from line coordinates back: a view."""
        return values.swapaxes(-1, -2)[..., ::-1, ::-1] if self.turned else values

    @property
    def floating(self) -> bool:
        """Whether rows that are not selected are left open."""
        return self.design.drive.idle_rows == "float" and not self.circuit.drives_idle_lines

    @property
    def continuous(self) -> bool:
        """Whether the sheet conducts from cell to cell."""
        return self.design.array.sheet == "continuous"

    @property
    def sheet(self) -> Sheet:
        """The geometry of a continuous sheet."""
        return self.design.sheet

    @cached_property
    def inverse_gain(self) -> FloatArray:
        """(M,) 1 / (1 + A): the share of an error that an amplifier leaves."""
        return 1.0 / (1.0 + self.gain)

    @cached_property
    def loop_share(self) -> FloatArray:
        """(M,) A / (1 + A): the share of its input that a unity-gain amplifier puts out."""
        return 1.0 / (1.0 + 1.0 / self.gain)

    @cached_property
    def lift(self) -> FloatArray:
        """(M,) V that the bias current makes across the reference resistor."""
        return self.reference * self.bias

    @cached_property
    def lines(self) -> Lines:
        """Series conductances along the lines in S, row leads included, column leads not."""
        return Lines(siemens(self.row_ohms), siemens(self.column_ohms))

    @cached_property
    def bridges(self) -> tuple[Fault, ...]:
        """Faults that join two lines."""
        return tuple(fault for fault in self.faults if fault.bridge)

    @cached_property
    def shorts(self) -> tuple[Fault, ...]:
        """Faults across a cell, complete or not."""
        return tuple(fault for fault in self.faults if fault.kind == "shorted-cell")

    @cached_property
    def plain(self) -> bool:
        """Whether the grid is nothing but cells between lines, so that the fast solvers may be used."""
        return not self.continuous and not self.bridges

    @cached_property
    def linear(self) -> LinearReadout | None:
        """The readout as a linear function of transfer conductances; None where it is not one."""
        return self.circuit.linear(self)

    def cell_conductance(self, cells: FloatArray) -> FloatArray:
        """S of cells (..., N, M) in ohm, open-cell and shorted-cell faults included."""
        if not self.faults:
            return siemens(cells)
        conductance = siemens(cells + self.series_ohms)
        for fault in self.shorts:
            conductance[(..., *fault.place)] += siemens(fault.ohms)
        return conductance


def cell_alone(board: Board, conductance: FloatArray, shunt: FloatArray) -> FloatArray:
    """Conductance (N, M) in S of the cells, without known faults in parallel (``shunt``, S) and in series."""
    own = np.maximum(conductance - shunt, 0.0)
    if not board.series_ohms.any():
        return own
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(own > 0, 1.0 / np.maximum(1.0 / own - board.series_ohms, 0.0), 0.0)


def series_ohms(faults: tuple[Fault, ...], kind: str, shape: tuple[int, int]) -> FloatArray:
    """Ohm (rows, columns) that the faults of one kind put in series; several at one place add up."""
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
    """(N, M) cells beyond a complete break of their line: they conduct, but no reading is theirs."""
    cut = np.zeros(board.shape, dtype=np.bool_)
    for fault in board.faults:
        row, column = fault.place
        if fault.kind == "broken-row" and fault.ohms == inf:
            cut[row, column:] = True
        elif fault.kind == "broken-column" and fault.ohms == inf:
            cut[: row + 1, column] = True
    return cut
