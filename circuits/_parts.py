"""The parts of a board as arrays, with one entry per line, crosspoint or column end: a design expanded.

Line coordinates
----------------
Inside a board the *rows* are the lines that are driven, and the *columns* are the lines that are sensed. For most
circuits these are the array's own rows and columns. The array of a circuit that drives columns and senses rows is
transposed about its other diagonal: :meth:`Parts.transpose` converts arrays of the array's shape to line coordinates
and back. In line coordinates row i is always driven ahead of column 0, and column j is always sensed behind row N - 1.

Readout circuits take :class:`Parts`. All other code takes a :class:`._board.Board`: the parts with their circuit.

Stacks
------
A *stack* is S boards of one design with values of their own (Monte Carlo, corners of tolerances). Its arrays have one
more axis, ahead: (S, N, M) in place of (N, M), (S, N) of rows, (S, 1, M) in place of (M,) and (S, 1, 1) in place of a
number, so that all of them broadcast against readings (S, N, M). Board k reads frame k of cells (S, N, M).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, isfinite
from typing import Literal, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import BoolArray, FloatArray, IntArray
from ._sections import Fault, Sheet
from .ends import Columns, LineEnds
from .solvers import Lines, siemens

LEAST_SHORT_OHM = 1e-3
"""least resistance of a shorted cell with its contacts, for bounds on the effect of a short on other readings"""

T = TypeVar("T", bound=np.generic)

_OF_ROWS, _OF_COLUMNS = ("row_ohms", "column_ohms", "row_lead"), ("column_lead", "reference", "gain", "offset", "bias")
_OF_BOARD = "drive", "level"
"""what the boards of a stack have values of their own of"""


def of_columns(values: FloatArray) -> FloatArray:
    """Values of columns as (M,) or (S, M), of (M,) or (S, 1, M)."""
    return values if values.ndim == 1 else values[..., 0, :]


def at_any(flags: BoolArray, axes: int) -> BoolArray:
    """Where any board of a stack has a flag; the last ``axes`` axes are those of one board."""
    return np.asarray(flags.any(axis=tuple(range(flags.ndim - axes))))


@dataclass(frozen=True, eq=False)
class Parts:
    """The parts of a design in line coordinates: N rows are driven, M columns are sensed."""

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
    transposed: bool
    """whether the array's rows are sensed and its columns driven"""
    floating: bool
    """whether rows that are not selected are left open"""
    pull: float
    """ohm from each row, where its lead ends, to the reference; inf: none"""
    row_lead: FloatArray
    """(N,) ohm of the rows' leads, the part of ``row_ohms[:, 0]`` between driver and pull-down"""
    shared_by: int
    """neighbouring columns that take turns, one of them read and the others idle; 1: all columns are read at once"""
    multiplexed: bool
    """whether one amplifier or load reads one column after the other"""
    idle_columns: Literal["float", "ground", "load"]
    """end of columns that are not read, where these are read one by one"""
    line_ends: LineEnds | None
    """networks at the lines' ends; None: as the circuit says"""
    described: Columns | None
    """the columns' ends by these networks; None where they are no Thevenin equivalents, or there are no networks"""
    continuous: bool
    """whether the sheet conducts from cell to cell"""
    sheet: Sheet
    """geometry of a continuous sheet"""
    steps: IntArray | None
    """rows that are selected; readings of the others, where they cost more, are NaN; None: all"""

    @property
    def is_stack(self) -> bool:
        """Whether these are the parts of several boards."""
        return self.row_ohms.ndim > 2

    def some(self, frames: BoolArray) -> Self:
        """The boards of some frames (S,)."""
        if not self.is_stack or len(self.row_ohms) == 1:  # one board reads all frames
            return self
        return replace(self, **{name: getattr(self, name)[frames] for name in (*_OF_ROWS, *_OF_COLUMNS, *_OF_BOARD)})

    def member(self, frame: int) -> Self:
        """The one board of a frame."""
        if not self.is_stack:
            return self
        number = frame % len(self.row_ohms)
        own = {name: getattr(self, name)[number] for name in _OF_ROWS}
        own |= {name: getattr(self, name)[number, 0] for name in _OF_COLUMNS}
        return replace(self, **own, **{name: getattr(self, name)[number].item() for name in _OF_BOARD})

    @property
    def line_kinds(self) -> tuple[str, str]:
        """Names of the driven and of the sensed lines in the array: "row" and "column", or "column" and "row"."""
        return ("column", "row") if self.transposed else ("row", "column")

    @property
    def array_shape(self) -> tuple[int, int]:
        """Rows and columns of the array itself."""
        return self.shape[::-1] if self.transposed else self.shape

    def driven_line(self, row: int) -> int:
        """Convert row ``row`` in line coordinates to the line's number in the array, or back."""
        return self.shape[0] - 1 - row if self.transposed else row

    def sensed_line(self, column: int) -> int:
        """Convert column ``column`` in line coordinates to the line's number in the array, or back."""
        return self.shape[1] - 1 - column if self.transposed else column

    def transpose(self, values: NDArray[T]) -> NDArray[T]:
        """Convert (..., rows, columns) values of the array to line coordinates, or back; returns a view."""
        return values.swapaxes(-1, -2)[..., ::-1, ::-1] if self.transposed else values

    @cached_property
    def inverse_gain(self) -> FloatArray:
        """(M,) 1 / (1 + A): fraction of an error that an amplifier leaves."""
        return 1.0 / (1.0 + self.gain)

    @cached_property
    def loop_share(self) -> FloatArray:
        """(M,) A / (1 + A): closed-loop gain of a unity-gain follower."""
        return 1.0 / (1.0 + 1.0 / self.gain)

    @cached_property
    def follower_lift(self) -> FloatArray:
        """(M,) V by which a follower's output is above its input, if the input is at the reference voltage."""
        return self.loop_share * self.offset - self.inverse_gain * self.level

    @cached_property
    def lift(self) -> FloatArray:
        """(M,) V across the reference resistor by the bias current."""
        return self.reference * self.bias

    @property
    def pulled(self) -> bool:
        """Whether idle rows are connected to the reference by pull-down resistors.

        The grid then has one more column, ahead of the others: the pull-downs are its cells, and it ends at the
        reference. :attr:`lines` and :meth:`cell_conductance` contain it, and so does the network between the ports.
        """
        return isfinite(self.pull)

    @cached_property
    def idle_resistance(self) -> FloatArray:
        """(M,) ohm behind the lead of each column that is not read, to :attr:`idle_source`; inf is open."""
        if self.described is not None:
            return self.described.idle_resistance
        match self.idle_columns:
            case "float":
                return np.full(self.shape[1], inf)
            case "ground":
                return np.zeros(self.shape[1])
            case "load":
                return self.reference

    @cached_property
    def idle_source(self) -> FloatArray:
        """(M,) V above the idle rows that columns end in which are not read."""
        return np.zeros(self.shape[1]) if self.described is None else self.described.idle_source

    @cached_property
    def turns(self) -> tuple[BoolArray, ...]:
        """(M,) columns that are read together, for each turn of a scan step."""
        columns = np.arange(self.shape[1])
        return tuple(columns % self.shared_by == turn for turn in range(min(self.shared_by, self.shape[1])))

    @cached_property
    def lines(self) -> Lines:
        """Series conductances along the lines in S, with row leads, without column leads."""
        row_ohms, column_ohms = self.row_ohms, self.column_ohms
        if self.pulled:
            row_ohms = np.concatenate([self.row_lead[..., None], row_ohms], axis=-1)
            row_ohms[..., 1] -= self.row_lead
            column_ohms = np.insert(column_ohms, 0, 0.0, axis=-1)
        return Lines(siemens(row_ohms), siemens(column_ohms))

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
        """Whether the grid has only cells between its lines, as the fast solvers require."""
        return not self.continuous and not self.bridges

    def cell_conductance(self, cells: FloatArray) -> FloatArray:
        """S of cells (..., N, M) in ohm, open-cell and shorted-cell faults included, pull-downs ahead of them."""
        conductance = siemens(cells + self.series_ohms) if self.faults else siemens(cells)
        for fault in self.shorts:
            conductance[(..., *fault.place)] += siemens(fault.ohms)
        return np.insert(conductance, 0, 1.0 / self.pull, axis=-1) if self.pulled else conductance
