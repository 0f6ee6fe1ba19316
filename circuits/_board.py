"""A board: the parts of a design as arrays, with the circuit that reads them and its converter.

Scans, recovery and all other analyses take a :class:`Board`. ``design.board`` makes it once and keeps it. Its arrays
are in line coordinates, which :mod:`._parts` explains.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from math import inf
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import FloatArray
from ..common.config import Section
from ._parts import Parts
from ._readout import Readout
from ._sections import Adc, Array, Drive, Fault, Sheet
from .ends import (
    GROUND,
    LINE,
    OUT,
    REF,
    Card,
    ColumnEnd,
    Crosspoint,
    LineEnds,
    Network,
    Reference,
    RowEnd,
    Rows,
    amplifier,
)
from .readouts import CIRCUITS, LinearReadout, ReadoutCircuit, networks


class Sections(Protocol):
    """What a board is made of: the sections of a :class:`._design.Design`."""

    @property
    def array(self) -> Array: ...
    @property
    def sheet(self) -> Sheet: ...
    @property
    def drive(self) -> Drive: ...
    @property
    def readout(self) -> Readout: ...
    @property
    def adc(self) -> Adc | None: ...
    @property
    def fault(self) -> tuple[Fault, ...]: ...
    @property
    def row_end(self) -> RowEnd | None: ...
    @property
    def column_end(self) -> ColumnEnd | None: ...
    @property
    def reference(self) -> Reference | None: ...
    @property
    def crosspoint(self) -> Crosspoint | None: ...
    @property
    def is_described(self) -> bool: ...


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
    def of(cls, design: Sections, *, by_nodes: bool = False, values: Mapping[str, FloatArray] | None = None) -> Board:
        """Expand a design. Users take ``design.board``, which keeps the result.

        Args:
            design: any.
            by_nodes: the lines end in networks, even where they are Thevenin equivalents or the design names none.
            values: (S, lines) or (S, 1) of parts, by their keys in the design: a stack, of a design without networks.

        """
        array, drive, readout, faults = design.array, design.drive, design.readout, design.fault
        circuit = CIRCUITS[readout.circuit]
        transposed = circuit.senses == "rows"
        driven, sensed = ("column", "row") if transposed else ("row", "column")
        rows, columns = array.shape[::-1] if transposed else array.shape

        def each(section: Section, key: str, count: int) -> FloatArray:
            given = np.asarray(getattr(section, key) if values is None else values[key], dtype=np.float64)
            lines = np.broadcast_to(given, (*given.shape[:-1], count))
            return np.array(lines[..., ::-1] if transposed else lines)

        def across(section: Section, key: str) -> FloatArray:
            ends = each(section, key, columns)
            return ends if values is None else ends[:, None]

        def single(section: Section, key: str) -> Any:
            return getattr(section, key) if values is None else values[key][..., None]

        if transposed:
            faults = tuple(_transposed_fault(fault, array.shape) for fault in faults)
        severed = series_ohms(faults, "broken-column", (rows, columns))
        row_ohms = np.repeat(each(array, f"{driven}_segment", rows)[..., None], columns, axis=-1)
        row_lead = each(array, f"{driven}_lead", rows)
        row_ohms[..., 0] = row_lead
        column_ohms = np.repeat(each(array, f"{sensed}_segment", columns)[..., None, :], rows, axis=-2)
        column_ohms[..., 0, :] = 0.0
        column_ohms[..., 1:, :] += severed[:-1]
        board = cls(
            shape=(rows, columns),
            row_ohms=row_ohms + series_ohms(faults, "broken-row", (rows, columns)),
            column_ohms=column_ohms,
            column_lead=across(array, f"{sensed}_lead") + severed[-1],
            series_ohms=series_ohms(faults, "open-cell", (rows, columns)),
            faults=faults,
            reference=across(readout, "reference_resistance"),
            gain=across(readout, "open_loop_gain"),
            offset=across(readout, "offset_voltage"),
            bias=across(readout, "bias_current"),
            drive=single(drive, "voltage"),
            level=single(readout, "reference_voltage"),
            supply=readout.supply if circuit.has_amplifiers else (-inf, inf),
            transposed=transposed,
            floating=drive.idle_rows != "ground" and not circuit.drives_idle_lines,
            pull=drive.idle_row_resistance,
            row_lead=row_lead,
            shared_by=1 if circuit.reads_together(readout.columns, readout.idle_columns) else columns,
            multiplexed=readout.columns == "multiplexed",
            idle_columns=readout.idle_columns,
            line_ends=None,
            described=None,
            continuous=array.sheet == "continuous",
            sheet=design.sheet,
            steps=None,
            circuit=circuit,
            readout=readout,
            adc=design.adc,
        )
        return _with_networks(board, design, by_nodes=by_nodes) if design.is_described or by_nodes else board

    @property
    def virtual_grounds(self) -> bool:
        """Whether amplifiers hold all columns at the reference at once, each measuring its column's current."""
        return self.circuit.virtual_ground and not self.multiplexed

    @cached_property
    def linear(self) -> LinearReadout | None:
        """The readout as a linear function of transfer conductances; None where it is not one."""
        return self.circuit.linear(self)


def _with_networks(board: Board, design: Sections, *, by_nodes: bool) -> Board:
    """The board with the networks of the design at its lines, and those that its other keys stand for."""
    ends = _line_ends(board, design)
    rows = columns = None
    if ends.is_apart and not by_nodes:
        rows = ends.rows(Fraction(board.level) if design.row_end is None else ends.rest())
        columns = None if rows is None else ends.columns(rows.datum)
    drive = board.drive if rows is None else rows.drive
    if rows is None or columns is None:  # each row's step is a network of its own, whose ends are not of the grid
        rows = Rows(np.zeros(board.shape[0]), inf, True, drive, Fraction(0))
    row_ohms = board.row_ohms.copy()
    row_ohms[:, 0] += rows.lead - _leads_in_ends(board, design)
    described = replace(
        board,
        row_ohms=row_ohms,
        row_lead=rows.lead,
        floating=rows.floating,
        pull=rows.pull,
        drive=drive,
        gain=np.full(board.shape[1], inf),
        offset=np.zeros(board.shape[1]),
        bias=np.zeros(board.shape[1]),
        supply=ends.swing,
        shared_by=ends.shared_by,
        multiplexed=False,
        line_ends=ends,
        described=columns,
    )
    circuit = networks(described, inverts=False)
    swing = float(np.mean(circuit.alone(described).gain))
    reference = np.full(board.shape[1], abs(swing / drive)) if columns is None else np.abs(columns.slope)
    return replace(
        described,
        level=float(circuit.at_rest(described).flat[0]),
        reference=reference,
        circuit=networks(described, inverts=(swing > 0) != (drive > 0)),
    )


def _line_ends(board: Board, design: Sections) -> LineEnds:
    """Cards of all ends; of those that are not described, as the other keys of the design say."""
    if board.circuit.drives_idle_lines:
        return _followed(board)
    rows, columns = board.shape
    row_end, column_end = design.row_end, design.column_end
    ref = REF if design.reference or board.level else GROUND
    selected, idle = _named_rows(board, ref)
    if row_end is not None:
        selected = row_end.lines("selected", rows) if row_end.selected is not None else selected
        idle = row_end.lines("idle", rows) if row_end.idle is not None else idle
    if column_end is None:
        shared = board.shared_by
        read, unread = _named_columns(board, ref)
    else:
        shared = column_end.shared_by
        at_ends = column_end.lines("parts", -(-columns // shared))
        read, unread = tuple(at_ends[j // shared] for j in range(columns)), column_end.lines("idle", columns)
    reference = () if design.reference is None else design.reference.lines("parts", 1)[0]
    if design.crosspoint is None:
        return LineEnds(selected, idle, read, unread, shared, reference, board.level)
    leads = np.zeros(rows) if board.pulled and row_end is None else _leads_in_ends(board, design)
    selected, idle = (tuple(map(_behind_lead, ends, leads.tolist())) for ends in (selected, idle))
    crosspoint = design.crosspoint.lines("parts", 1)[0]
    return LineEnds(selected, idle, read, unread, shared, reference, board.level, crosspoint)


def _leads_in_ends(board: Board, design: Sections) -> FloatArray:
    """(N,) ohm of the rows' leads that are parts of their ends: ahead of pull-downs, and where the ports of a grid with
    ideal lines have to be its cells alone.
    """
    if design.crosspoint is not None:
        return board.row_ohms[:, 0]
    return board.row_lead if board.pulled and design.row_end is None else np.zeros(board.shape[0])


def _followed(board: Board) -> LineEnds:
    """The ends where the column that is read has its load, and a follower that drives all idle lines: the node ref."""
    rows, columns = board.shape
    zero = "level" if board.level else GROUND
    level = (Card("VLEVEL", (zero, GROUND), board.level),) if board.level else ()
    idle = (Card("VIDLE", (LINE, REF), 0.0),)
    read = []
    for j, (ohm, bias) in enumerate(zip(board.reference.tolist(), board.bias.tolist(), strict=True)):
        load = Card("RREF", (LINE, zero), ohm), Card("IBIAS", (LINE, zero), bias)
        follower = _amplifier(board, j, (LINE, OUT, OUT), bias_current=0.0)  # on its own card: the input is the load's
        read.append((*level, *load, follower, Card("VOUT", (OUT, REF), 0.0)))
    drive = (*level, Card("VDRIVE", (LINE, zero), board.drive))
    nothing = (Card("IREF", (REF, GROUND), 0.0),)  # the node is one for all lines
    return LineEnds((drive,) * rows, (idle,) * rows, tuple(read), (idle,) * columns, columns, nothing, board.level)


def _behind_lead(network: Network, ohm: float) -> Network:
    """A row's end with the lead of its line."""
    if not ohm or not network:
        return network
    inside = tuple(card.renamed(lambda node: "lead" if node == LINE else node, str) for card in network)
    return (*inside, Card("R.LEAD", ("lead", LINE), ohm))


def _named_rows(board: Board, ref: str) -> tuple[tuple[Network, ...], tuple[Network, ...]]:
    """The networks that ``[drive]`` stands for, with the reference voltage at the node ``ref``."""
    driver = Card("VDRIVE", ("line", ref), board.drive)
    if board.pulled:
        pull = Card("RPULL", ("line", ref), board.pull)
        at = driver.renamed(lambda node: "driver" if node == "line" else node, str)
        leads = [Card("RLEAD", ("driver", "line"), float(ohm)) for ohm in board.row_lead]
        return tuple((at, lead, pull) for lead in leads), ((pull,),) * board.shape[0]
    idle = () if board.floating else (Card("VIDLE", ("line", ref), 0.0),)
    return ((driver,),) * board.shape[0], (idle,) * board.shape[0]


def _named_columns(board: Board, ref: str) -> tuple[tuple[Network, ...], tuple[Network, ...]]:
    """The networks that ``[readout]`` stands for, of an end while it has its turn and of an idle column."""
    read: list[Network] = []
    unread: list[Network] = []
    for j, ohm in enumerate(board.reference.tolist()):
        load = Card("RREF", ("line", "out" if board.circuit.virtual_ground else ref), ohm)
        amplified = _amplifier(board, j, (ref, "line", "out"))
        feedback = Card("CREF", load.nodes, board.readout.feedback_capacitance)
        read.append((load, feedback, amplified) if board.circuit.virtual_ground else (load,))
        match board.idle_columns:
            case "float":
                unread.append(())
            case "ground":
                unread.append((Card("VIDLE", ("line", ref), 0.0),))
            case "load":
                unread.append((Card("RIDLE", ("line", ref), ohm),))
    return tuple(read), tuple(unread)


def _amplifier(board: Board, column: int, nodes: tuple[str, str, str], **keys: float) -> Card:
    """The amplifier of a column between its inputs (+ and -) and its output."""
    part = board.readout
    own = {"open_loop_gain": board.gain, "offset_voltage": board.offset, "bias_current": board.bias}
    given = {key: float(values[column]) for key, values in own.items()}
    given |= {key: getattr(part, key) for key in ("gain_bandwidth", "voltage_noise", "current_noise")}
    low, high = board.supply
    plus, minus, out = nodes
    return amplifier(plus, minus, out, **(given | {"low": low, "high": high} | keys))


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


def _transposed_fault(fault: Fault, shape: tuple[int, int]) -> Fault:
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
