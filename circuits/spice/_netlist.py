"""SPICE netlists of a scan step or a frame: the circuit of :func:`.scan` for any SPICE simulator.

SPICE has no exact form for parts of zero resistance, open parts and ideal amplifiers. This module writes
them exactly:

* A part of 0 ohm merges its two nodes. (ngspice would silently use 1 mOhm.)
* A part of infinite resistance is left out.
* The circuits in :mod:`..readouts` write the cards of their amplifiers, including ideal and limited ones.

Node 0 is the reference voltage, so a reference at mid-supply costs no digits. Board ground is the node ``agnd``.

Node names follow line coordinates (:mod:`.._parts`): ``row_I_J`` is the crosspoint on a driven line, and ``col_I_J``
the crosspoint on a sensed line.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from math import inf, isinf
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import FloatArray
from ...errors import InputError, SolverError
from .._board import Board
from .._design import Design
from ..ends import CELL, LINE, REF, ROW, LineEnds, join, spice_cards
from ..readouts import COLUMN_INDEX, FOLLOWER, REFERENCE, ROW_INDEX, CardWriter

_IDLE_COLUMNS = {"float": "are open", "ground": "stay at the reference", "load": "have a load each"}
NONLINEAR_OPTIONS = ".options reltol=1e-9 vntol=1e-12 abstol=1e-15"


@dataclass(frozen=True)
class Deck:
    """A circuit with the analysis that gives its readings."""

    title: str
    cards: tuple[str, ...]
    """elements, options and comments"""
    analysis: str
    """ngspice command, without the dot: ``op`` or ``dc ...``"""
    one_by_one: bool
    """True: column J is read at point J of the innermost sweep. False: all columns are read at each point."""
    outputs: tuple[str, ...]
    """output node of each column; readings are voltages against :attr:`ground`"""
    ground: str
    """node of board ground"""

    def text(self) -> str:
        """Netlist for ``ngspice -b``. ngspice runs the analysis and prints ``volts_J = ...`` for each column J."""
        readings = []
        for column, node in enumerate(self.outputs):
            parts = [f"{sign}v({name})" for sign, name in (("", node), ("-", self.ground)) if name != REFERENCE]
            # ngspice returns a number, not a vector, for a sweep of one point; an index would be an error.
            point = f"[{column}]" if self.one_by_one and len(self.outputs) > 1 else ""
            volts = "".join(part + point for part in parts) or "0"
            readings += [f"let volts_{column} = {volts}", f"print volts_{column}"]
        control = [".control", "set numdgt=16", self.analysis, *readings, "quit", ".endc"]
        return self._joined(control)

    def batch_text(self) -> str:
        """Netlist for ``ngspice -b -r FILE``: the analysis is a card, and only outputs are saved."""
        nodes = dict.fromkeys((*self.outputs, self.ground))
        saved = [f".save v({node})" for node in nodes if node != REFERENCE]
        return self._joined([*saved, f".{self.analysis}"])

    def _joined(self, tail: Iterable[str]) -> str:
        usage = "* ngspice -b FILE prints the column outputs in V as volts_0 = ..., volts_1 = ..."
        return "\n".join([f"* {self.title}", usage, *self.cards, *tail, ".end", ""])


def netlist(design: Design, resistance: ArrayLike, row: int) -> str:
    """The SPICE netlist of one scan step: ``row`` is selected, and every column is read.

    A circuit that senses rows has no such scan step. Its netlist sweeps over the driven columns and reads ``row`` at
    each point.

    The text runs under ``ngspice -b`` and prints the outputs in V as ``volts_0 = ...``, ``volts_1 = ...``

    Args:
        design: with a sliced sheet.
        resistance: (rows, columns) ohm of the cells.
        row: number of the selected row, from 0.

    Raises:
        InputError: there is no such row, or the cells do not fit the design.
        SolverError: ideal parts contradict each other or leave an output undetermined.
    """
    return step_deck(design, resistance, row).text()


def step_deck(design: Design, resistance: ArrayLike, row: int) -> Deck:
    """The circuit that reads one row, with arguments and errors as for :func:`netlist`."""
    if not 0 <= row < design.array.rows:
        raise InputError(f"row {row}: the design has rows 0 to {design.array.rows - 1}")
    board = design.board
    cells = board.turn(design.resistance(resistance))
    if not board.turned:
        return DeckWriter(board, cells, row).deck()
    whole = DeckWriter(board, cells, None).deck()
    last = board.shape[0] - 1
    line = board.sensed_line(row)
    analysis = f"dc Vrow {last} 0 -1" + (f" Vcolumn {line} {line} 1" if whole.one_by_one else "")
    return replace(whole, analysis=analysis, one_by_one=True, outputs=(whole.outputs[line],) * board.shape[0])


def frame_deck(design: Design, resistance: ArrayLike) -> Deck:
    """One circuit for a whole frame: a ``.dc`` sweep over the driven lines.

    A sweep is the fastest analysis for a frame, because ngspice orders its matrix only once. The sweep has one point
    per driven line. A divider whose idle columns float needs one point per cell, row by row.

    Raises:
        InputError: as for :func:`netlist`.
        SolverError: as for :func:`netlist`; also if a limited or ideal amplifier is connected to a row driver without
            any resistance. Only :func:`step_deck` can write this circuit.
    """
    board = design.board
    return DeckWriter(board, board.turn(design.resistance(resistance)), None).deck()


def _marked(node: str, mark: str) -> str:
    """Name of a node in the copy of the circuit for one turn."""
    return node if node == REFERENCE else f"{node}{mark}"


class _Place(NamedTuple):
    """Names of a network's nodes in the whole circuit."""

    place: str
    mark: str
    """of the turn"""
    line: str
    shares_reference: bool
    known: Mapping[str, str] = {}
    """other nodes of the whole circuit"""

    def name(self, node: str) -> str:
        if node in self.known:
            return self.known[node]
        if node == REF and self.shares_reference:
            return f"{node}{self.mark}"
        return _marked(self.line if node == LINE else node if node == REFERENCE else f"{node}_{self.place}", self.mark)


class DeckWriter(CardWriter):
    """Writes the SPICE cards of one board.

    The cards of the readout circuit come from :meth:`.ReadoutCircuit.cards`, which asks this object for node names and
    values of parts.
    """

    board: Board

    def __init__(self, board: Board, cells: FloatArray, row: int | None) -> None:
        """Name the nodes of the circuit.

        Args:
            board: the board.
            cells: (N, M) ohm, in line coordinates.
            row: the selected row, or None for a sweep over all rows.

        Raises:
            InputError: the sheet is continuous.
            SolverError: ideal parts contradict each other.

        """
        if board.continuous:
            raise InputError('array.sheet = "continuous" has no netlist; expected "sliced"')
        self.board, self.row, self.circuit = board, row, board.circuit
        self.resistance = cells + board.series_ohms
        self.rows, self.columns = board.shape
        self.row_ohms, self.column_ohms = board.row_ohms, board.column_ohms
        self.feedback = board.circuit.drives_idle_lines
        self.one_by_one = board.circuit.columns_one_by_one(board) and (self.columns > 1 or self.feedback)
        self.floating = board.floating and not self.feedback
        self.described = board.line_ends
        self.driven = [i for i in range(self.rows) if row in {None, i} or not self.floating or self.described]
        self.ground = "agnd" if board.level and not self.described else REFERENCE
        self.name = self._merged_node_names()
        self.drivers = {self.name[self._driver(i)]: i for i in self.driven}
        self._refuse_contradictions()

    def deck(self) -> Deck:
        """The circuit with its analysis."""
        if self.described is not None:
            return self._described_deck(self.described)
        cards = [*self._sources(), *self._grid(), "", *self.circuit.cards(self), *self._island_ties()]
        if any(card.startswith("B") for card in cards):
            cards += [
                "",
                "* Sources given as expressions: take nothing but the settled answer.",
                NONLINEAR_OPTIONS,
            ]
        sweep = ["dc"] if self.one_by_one or self.row is None else ["op"]
        if self.one_by_one:
            sweep.append(f"Vcolumn 0 {self.columns - 1} 1")
        if self.row is None:
            sweep.append(f"Vrow 0 {self.rows - 1} 1")
        outputs = tuple(self.circuit.output_node(self, j) for j in range(self.columns))
        step = "all rows in turn" if self.row is None else f"row {self.row} selected"
        rows, columns = self.board.array_shape
        title = f"ohmskin: {rows} x {columns} cells, {self.circuit.name}, {step}"
        if self.board.turned:
            title += "; columns are driven: row I, column J here are the array's column, row counted from the end"
        return Deck(title, tuple(cards), " ".join(sweep), self.one_by_one, outputs, self.ground)

    def _described_deck(self, ends: LineEnds) -> Deck:
        """The circuit of a board with networks at its lines: the whole of it once for each turn of the columns."""
        from scipy.cluster.hierarchy import DisjointSet

        if self.row is None:
            raise SolverError("networks at the lines' ends change from row to row; only a netlist of one row has them")
        if ends.crosspoint and not self.resistance.all():
            raise SolverError("a netlist with parts at the cells has no cell of 0 ohm; give it a resistance")
        outputs = [REFERENCE] * self.columns
        at_ends = (*map(self._driver, self.driven), *map(self.circuit.column_end, range(self.columns)))
        lines = [self.name[node] for node in at_ends]
        cards = [f"* Row {self.row} is selected."]
        for turn, read in enumerate(self.board.turns):
            mark = f"_t{turn}" if len(self.board.turns) > 1 else ""
            if mark:
                cards += ["", f"* Turn {turn}: columns {', '.join(map(str, np.flatnonzero(read)))} are read."]
            for line in self._grid():
                if not line.startswith("R"):
                    cards.append(line)
                    continue
                name, *nodes, value = line.split()
                a, b = (_marked(node, mark) for node in nodes)
                if ends.crosspoint and name.startswith("R_"):
                    row, a = a, f"cell{name[1:]}{mark}"
                    place = f"x{name[1:]}"
                    at = _Place(place, mark, "", bool(ends.reference), {ROW: row, CELL: a})
                    cards += spice_cards(ends.held(ends.crosspoint), at.name, f"_{place}{mark}")
                cards.append(f"{name}{mark} {a} {b} {value}")
            cards.append("")
            islands = DisjointSet([REFERENCE])
            for _, a, b, ohm in self._resistors():
                for node in (a, b):
                    islands.add(_marked(self.name[node], mark))
                if ohm < inf:
                    islands.merge(*(_marked(self.name[node], mark) for node in (a, b)))
            for place, number, network in ends.of_step(self.row, read):
                at = _Place(place, mark, lines[number] if number < len(lines) else "", bool(ends.reference))
                cards += spice_cards(network, at.name, f"_{place}{mark}")
                join(islands, network, at.name)
                if self.rows <= number < len(lines) and read[number - self.rows]:
                    outputs[number - self.rows] = at.name(ends.out)
            for number, island in enumerate(islands.subsets()):
                if REFERENCE not in island:
                    cards.append(f"Rtie_{number}{mark} {min(island)} {REFERENCE} 1")
        if any(card.startswith(("B", "D")) for card in cards):
            cards.append(NONLINEAR_OPTIONS)
        rows, columns = self.board.array_shape
        title = f"ohmskin: {rows} x {columns} cells, networks at the lines' ends, row {self.row} selected"
        return Deck(title, tuple(cards), "op", False, tuple(outputs), REFERENCE)

    # Nodes

    def _driver(self, i: int) -> str:
        """Node at the driven end of row i's lead. For an idle row this is the reference or the follower's output."""
        if self.described is not None:
            return f"row_end_{i}"
        return f"drive_{i}" if self.row in {None, i} else FOLLOWER if self.feedback else REFERENCE

    def _start(self, i: int) -> str:
        """Node of row i's pull-down, where the lead ends; a break at the first crosspoint lies behind this node."""
        return f"start_{i}" if self.row_ohms[i, 0] != self.board.row_lead[i] else self._row(i, 0)

    def _row(self, i: int, j: int) -> str:
        return f"row_{i}_{j}" if self.row_ohms[i, 1:].any() else f"row_{i}"

    def _column(self, i: int, j: int) -> str:
        return f"col_{i}_{j}" if self.column_ohms[1:, j].any() else f"col_{j}"

    def _resistors(self) -> Iterator[tuple[str, str, str, float]]:
        """Name, two nodes and ohm of each part of the grid.

        All crosspoints of a line without segment resistance are one node.
        """
        row, column = self.row_ohms.tolist(), self.column_ohms.tolist()
        if self.described is not None:
            for i in self.driven:
                yield f"Rlead_row_{i}", self._driver(i), self._row(i, 0), row[i][0] - float(self.board.row_lead[i])
        elif self.board.pulled:
            lead = self.board.row_lead.tolist()
            for i in range(self.rows):
                yield f"Rpull_row_{i}", self._start(i), REFERENCE, self.board.pull
                if self._start(i) != self._row(i, 0):
                    yield f"Rbreak_row_{i}", self._start(i), self._row(i, 0), row[i][0] - lead[i]
                if i in self.driven:
                    yield f"Rlead_row_{i}", self._driver(i), self._start(i), lead[i]
        else:
            for i in self.driven:
                yield f"Rlead_row_{i}", self._driver(i), self._row(i, 0), row[i][0]
        for j, ohm in enumerate(self.board.column_lead.tolist()):
            yield f"Rlead_col_{j}", self._column(self.rows - 1, j), self.circuit.column_end(j), ohm
        for i, cells in enumerate(self.resistance.tolist()):
            for j, ohm in enumerate(cells):
                if j and self._row(i, j) != self._row(i, j - 1):
                    yield f"Rseg_row_{i}_{j}", self._row(i, j - 1), self._row(i, j), row[i][j]
                if i and self._column(i, j) != self._column(i - 1, j):
                    yield f"Rseg_col_{i}_{j}", self._column(i - 1, j), self._column(i, j), column[i][j]
                yield f"R_{i}_{j}", self._row(i, j), self._column(i, j), ohm
        for number, fault in enumerate(self.board.faults):
            if fault.kind == "shorted-cell":
                yield f"Rfault_{number}", self._row(*fault.place), self._column(*fault.place), fault.ohms
            elif fault.bridge:
                node = self._row if fault.kind == "bridged-rows" else self._column
                yield f"Rfault_{number}", node(*fault.ends[0]), node(*fault.ends[1]), fault.ohms

    def _merged_node_names(self) -> dict[str, str]:
        """Name of each node after parts of 0 ohm have merged nodes (union-find)."""
        from scipy.cluster.hierarchy import DisjointSet

        # Merged nodes take the name of the first one added. Nodes of sources and amplifiers are therefore added first.
        joined = DisjointSet([REFERENCE])
        for node in [*map(self._driver, self.driven), *map(self.circuit.column_end, range(self.columns))]:
            joined.add(node)
        if self.feedback:
            joined.add(FOLLOWER)
        for _, a, b, ohm in self._resistors():
            joined.add(a)
            joined.add(b)
            if ohm == 0:
                joined.merge(a, b)
        first: dict[str, str] = {}
        return {node: first.setdefault(joined[node], node) for node in joined}

    def _refuse_contradictions(self) -> None:
        """Raise SolverError if ideal parts join sources of different voltages."""
        if self.described is not None:
            return
        if len(self.drivers) < len({self._driver(i) for i in self.driven}) and not (self.row is None and self.floating):
            raise SolverError(
                "rows that are driven to different voltages are joined by parts of 0 ohm; "
                "give array.row_lead or the shorted cells a resistance"
            )
        self.circuit.refuse_cards(self)

    # Cards

    def _sources(self) -> Iterator[str]:
        level, volts = self.board.level, self.board.drive
        if self.ground != REFERENCE:
            yield "* Node 0 is the reference; board ground lies below it."
            yield f"Vreference {REFERENCE} {self.ground} DC {level!r}"
        if self.floating:
            idle = "have pull-downs" if self.board.pulled else "are open"
        else:
            idle = f"stay at the {'follower' if self.feedback else 'reference'}"
        if self.row is not None:
            yield f"* Row {self.row} is driven; the idle rows {idle}."
            yield f"Vdrive_{self.row} {self._driver(self.row)} {REFERENCE} DC {volts!r}"
        else:
            yield f"* The row whose number is v({ROW_INDEX}) is driven; the idle rows {idle}."
            yield f"Vrow {ROW_INDEX} {REFERENCE} DC 0"
            for i in range(self.rows):
                drive, selected = self.name[self._driver(i)], f"abs(v({ROW_INDEX})-{i})<0.5"
                if not self.floating:
                    rest = f"v({FOLLOWER})" if self.feedback else "0"
                    yield f"Bdrive_{i} {drive} {REFERENCE} V = {selected} ? {volts!r} : {rest}"
                else:  # while idle, this equation sets the current of the source to 0
                    yield f"Bdrive_{i} {drive} open_{i} V = {selected} ? {volts!r} : v({drive})+i(Vopen_{i})"
                    yield f"Vopen_{i} open_{i} {REFERENCE} DC 0"
        if self.one_by_one:
            others = "stay at the follower" if self.feedback else _IDLE_COLUMNS[self.board.idle_columns]
            yield f"* Only the column whose number is v({COLUMN_INDEX}) is read; the others {others}."
            yield f"Vcolumn {COLUMN_INDEX} {REFERENCE} DC 0"

    def _grid(self) -> Iterator[str]:
        yield ""
        yield "* The grid: leads, line segments (to crosspoint I_J from the one before) and cells R_I_J."
        for part, a, b, ohm in self._resistors():
            if ohm == 0:
                yield f"* {part} is 0 ohm: {a} and {b} are one node, {self.name[a]}"
            elif isinf(ohm):
                yield f"* {part} is open"
            elif self.name[a] == self.name[b]:
                yield f"* {part} is shorted: {a} and {b} are one node, {self.name[a]}"
            else:
                yield f"{part} {self.name[a]} {self.name[b]} {ohm!r}"

    def _island_ties(self) -> Iterator[str]:
        """Tie floating islands to the reference, since their undetermined potential makes the matrix singular.

        No current flows in such an island, so a tie of 1 ohm changes no reading.
        """
        from scipy.cluster.hierarchy import DisjointSet

        tied = DisjointSet([REFERENCE])
        for node in self.name.values():
            tied.add(node)
        for _, a, b, ohm in self._resistors():
            if ohm < inf:
                tied.merge(self.name[a], self.name[b])
        if self.feedback or not self.one_by_one or self.board.idle_columns != "float":
            for j in range(self.columns):
                tied.merge(self.name[self.circuit.column_end(j)], REFERENCE)
        driven_one_by_one = self.row is None and self.floating
        if not driven_one_by_one:
            for driver in self.drivers:
                tied.merge(driver, REFERENCE)
        for number, island in enumerate(tied.subsets()):
            if REFERENCE in island:
                continue
            node = min(island)
            drivers = sorted(i for i in self.driven if driven_one_by_one and self.name[self._driver(i)] in island)
            if len(drivers) == self.rows:
                continue  # one of these rows is always driven
            yield f"* Nothing else holds the island of {node}; no current flows here."
            idle = [f"abs(v({ROW_INDEX})-{i})>0.5" for i in drivers]
            if self.one_by_one and self.circuit.has_amplifiers:  # an amplifier holds the column that is read
                ends = [self.name[self.circuit.column_end(j)] for j in range(self.columns)]
                idle += [f"abs(v({COLUMN_INDEX})-{j})>0.5" for j, end in enumerate(ends) if end in island]
            if idle:
                yield f"Btie_{number} {node} {REFERENCE} I = {' && '.join(idle)} ? v({node}) : 0"
            else:
                yield f"Rtie_{number} {node} {REFERENCE} 1"
