"""SPICE netlists of scan steps: the circuit of :func:`.scan` for any SPICE simulator.

Every line ends in a network (:class:`..ends.LineEnds`): as the design describes it, or as its circuit's name says. The
circuit is written once for each state of its switches: each selected row, and each turn of columns that share an end.

SPICE has no exact form for parts of zero resistance and open parts. Parts of 0 ohm, and sources of 0 V, merge their
nodes (ngspice would silently use 1 mOhm); open parts are left out.

Node 0 is board ground. Node names follow line coordinates (:mod:`.._parts`): ``row_I_J`` is the crosspoint on a driven
line, and ``col_I_J`` the crosspoint on a sensed line.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf, isinf
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...errors import InputError, SolverError
from .._design import Design
from .._grid import refuse_contradictions
from ..ends import CELL, GROUND, LINE, REF, ROW, Card, Network, join, spice_cards

NONLINEAR_OPTIONS = ".options reltol=1e-9 vntol=1e-12 abstol=1e-15"


@dataclass(frozen=True)
class Deck:
    """A circuit whose operating point gives some readings."""

    title: str
    cards: tuple[str, ...]
    """elements, options and comments"""
    outputs: tuple[str, ...]
    """node of each reading in V"""

    def text(self) -> str:
        """Netlist for ``ngspice -b``. ngspice runs the analysis and prints ``volts_J = ...`` for each reading J."""
        control = [".control", "set numdgt=16", "op"]
        for number, node in enumerate(self.outputs):
            control += [f"let volts_{number} = {'0' if node == GROUND else f'v({node})'}", f"print volts_{number}"]
        return self._joined([*control, "quit", ".endc"])

    def batch_text(self) -> str:
        """Netlist for ``ngspice -b -r FILE``: the analysis is a card, and only outputs are saved."""
        return self._joined([*(f".save v({node})" for node in dict.fromkeys(self.outputs) if node != GROUND), ".op"])

    def _joined(self, tail: Iterable[str]) -> str:
        usage = "* ngspice -b FILE prints the outputs in V as volts_0 = ..., volts_1 = ..."
        return "\n".join([f"* {self.title}", usage, *self.cards, *tail, ".end", ""])


def netlist(design: Design, resistance: ArrayLike, row: int) -> str:
    """The SPICE netlist of one row's readings: every column is read while ``row`` is selected.

    A circuit that senses rows reads ``row`` while each column is driven in turn.

    The text runs under ``ngspice -b`` and prints the outputs in V as ``volts_0 = ...``, ``volts_1 = ...``

    Args:
        design: with a sliced sheet.
        resistance: (rows, columns) ohm of the cells.
        row: number of the row, from 0.

    Raises:
        InputError: there is no such row, or the cells do not fit the design.
        SolverError: ideal parts contradict each other or leave an output undetermined.
    """
    rows, columns = design.array.shape
    if not 0 <= row < rows:
        raise InputError(f"row {row}: the design has rows 0 to {rows - 1}")
    whole = _Writer(design, resistance)
    lines = whole.board.transpose(np.arange(rows * columns).reshape(whole.board.shape))[row]
    return whole.deck(lines.tolist(), f"row {row} is read").text()


def frame_decks(design: Design, resistance: ArrayLike) -> Iterator[tuple[IntArray, Deck]]:
    """The circuits of a frame, one for each state of its switches: ngspice takes less time for many small ones.

    Yields:
        Crosspoints in line coordinates, as numbers row by row, and the circuit that gives their readings.

    Raises:
        InputError, SolverError: as for :func:`netlist`.
    """
    whole = _Writer(design, resistance)
    rows, columns = whole.board.shape
    for row in range(rows):
        for read in whole.board.turns:
            places = columns * row + np.flatnonzero(read)
            yield places, whole.deck(places.tolist(), f"step {row}")


class _Place(NamedTuple):
    """Names of a network's nodes in the whole circuit."""

    place: str
    mark: str
    """of the state of the switches"""
    line: str
    shares_reference: bool
    """whether its node ref is one for all lines"""
    known: Mapping[str, str] = {}
    """other nodes of the whole circuit"""

    def name(self, node: str) -> str:
        if node == GROUND:
            return GROUND
        own = self.line if node == LINE else REF if node == REF and self.shares_reference else f"{node}_{self.place}"
        return self.known.get(node, f"{own}{self.mark}")


class _Resistor(NamedTuple):
    """A part of the grid."""

    name: str
    a: str
    b: str
    ohm: float


def _is_wire(card: Card, network: Network) -> bool:
    """Whether a part joins its nodes, and no other part is controlled by its current."""
    return card.kind in "rv" and card.value == 0 and all(card.name != other.control for other in network)


class _Writer:
    """Writes the SPICE cards of one board with cells, in line coordinates."""

    def __init__(self, design: Design, resistance: ArrayLike) -> None:
        board = design.board
        cells = board.transpose(design.resistance(resistance))
        if board.continuous:
            raise InputError('array.sheet = "continuous" has no netlist; expected "sliced"')
        if not design.is_described:
            undetermined = refuse_contradictions(board, cells)
            if undetermined is not None and undetermined.any():
                raise SolverError("an output is not determined with parts of 0 ohm; give array.row_lead a resistance")
            board = design.board_by_nodes
        assert board.line_ends is not None
        self.board, self.ends = board, board.line_ends
        self.resistance: FloatArray = cells + board.series_ohms
        if self.ends.crosspoint and not self.resistance.all():
            raise SolverError("a netlist with parts at the cells has no cell of 0 ohm; give it a resistance")
        self._resistors = list(self._parts())
        self._name = design.readout.circuit if not design.is_described else "networks at the lines' ends"

    def deck(self, places: Sequence[int], what: str) -> Deck:
        """The circuit that gives the readings at some crosspoints, by their numbers row by row."""
        columns, turns = self.board.shape[1], self.board.turns
        turn_of = [next(turn for turn, read in enumerate(turns) if read[j]) for j in range(columns)]
        steps = dict.fromkeys((place // columns, turn_of[place % columns]) for place in places)
        cards: list[str] = []
        outputs: dict[int, str] = {}
        several_rows, several_turns = len({row for row, _ in steps}) > 1, len({turn for _, turn in steps}) > 1
        for row, turn in steps:
            mark = (f"_s{row}" if several_rows else "") + (f"_t{turn}" if several_turns else "")
            copy, found = self._step(row, turns[turn], mark)
            cards += ["", f"* Row {row} is selected; read are columns {', '.join(map(str, found))}.", *copy]
            outputs |= {columns * row + column: node for column, node in found.items()}
        if any(card.startswith(("B", "D")) for card in cards):
            cards.append(NONLINEAR_OPTIONS)
        title = f"ohmskin: {' x '.join(map(str, self.board.array_shape))} cells, {self._name}, {what}"
        if self.board.transposed:
            title += "; columns are driven: row I, column J here are the array's column, row counted from the end"
        return Deck(title, tuple(cards), tuple(outputs[place] for place in places))

    def _step(self, row: int, read: BoolArray, mark: str) -> tuple[list[str], dict[int, str]]:
        """The cards of one state of the switches, and the output of each column that is read."""
        from scipy.cluster.hierarchy import DisjointSet

        rows, columns = self.board.shape
        lines = [*(f"row_end_{i}" for i in range(rows)), *(f"line_{j}" for j in range(columns))]
        networks: list[tuple[_Place, Network]] = []
        outputs: dict[int, str] = {}
        states = list(self.ends.of_step(row, read))
        # A stiff source of the reference is one part for all networks that have it.
        stiff = next((card for *_, network in states for card in network if card.name == "V.REF"), None)
        shared = bool(self.ends.reference) or stiff is not None
        for place, number, network in states:
            at = _Place(place, mark, lines[number] if number < len(lines) else "", shared)
            networks.append((at, network))
            if rows <= number < len(lines) and read[number - rows]:
                outputs[number - rows] = at.name(self.ends.out)
        resistors: list[_Resistor] = []
        for part, a, b, ohm in self._resistors:
            row_side, column_side = f"{a}{mark}", f"{b}{mark}"
            if self.ends.crosspoint and part.startswith("R_"):
                known = {ROW: row_side, CELL: f"cell{part[1:]}{mark}"}
                networks.append((_Place(f"x{part[1:]}", mark, "", shared, known), self.ends.held(self.ends.crosspoint)))
                row_side = known[CELL]
            resistors.append(_Resistor(f"{part}{mark}", row_side, column_side, ohm))
        networks = [(at, tuple(card for card in network if card != stiff)) for at, network in networks]
        networks.append((_Place("level", mark, "", shared), () if stiff is None else (stiff,)))

        merged, held = DisjointSet([GROUND, f"{REF}{mark}"]), DisjointSet([GROUND])
        for _, a, b, ohm in resistors:
            for islands, joined in ((merged, ohm == 0), (held, ohm < inf)):
                islands.add(a)
                islands.add(b)
                if joined:
                    islands.merge(a, b)
        for at, network in networks:
            for card in network:
                for node in card.nodes:
                    merged.add(at.name(node))
                if _is_wire(card, network):
                    merged.merge(*map(at.name, card.nodes))
            join(held, network, at.name)
        first: dict[str, str] = {}  # merged nodes have the name of the first one
        name = {node: first.setdefault(merged[node], node) for node in merged}
        cards: list[str] = []
        for part, a, b, ohm in resistors:
            if ohm == 0:
                cards.append(f"* {part} is 0 ohm: {a} and {b} are one node, {name[a]}")
            elif isinf(ohm):
                cards.append(f"* {part} is open")
            elif name[a] == name[b]:
                cards.append(f"* {part} is shorted: {a} and {b} are one node, {name[a]}")
            else:
                cards.append(f"{part} {name[a]} {name[b]} {ohm!r}")
        for at, network in networks:
            some = [card for card in network if not _is_wire(card, network)]
            nodes = {node: name[at.name(node)] for card in some for node in card.nodes}
            cards += spice_cards(some, nodes.__getitem__, f"_{at.place}{mark}")
        # No current flows in an island that nothing holds, so that a tie of 1 ohm changes no reading.
        for number, island in enumerate(held.subsets()):
            if GROUND not in {name[node] for node in island}:
                cards.append(f"Rtie_{number}{mark} {name[min(island)]} {GROUND} 1")
        return cards, {column: name[node] for column, node in outputs.items()}

    # The grid

    def _row(self, i: int, j: int) -> str:
        return f"row_{i}_{j}" if self.board.row_ohms[i, 1:].any() else f"row_{i}"

    def _column(self, i: int, j: int) -> str:
        return f"col_{i}_{j}" if self.board.column_ohms[1:, j].any() else f"col_{j}"

    def _parts(self) -> Iterator[_Resistor]:
        """The parts of the grid. All crosspoints of a line without segment resistance are one node."""
        row, column = self.board.row_ohms.tolist(), self.board.column_ohms.tolist()
        for i, lead in enumerate(self.board.row_lead.tolist()):
            yield _Resistor(f"Rlead_row_{i}", f"row_end_{i}", self._row(i, 0), row[i][0] - lead)
        for j, ohm in enumerate(self.board.column_lead.tolist()):
            yield _Resistor(f"Rlead_col_{j}", self._column(len(row) - 1, j), f"line_{j}", ohm)
        for i, cells in enumerate(self.resistance.tolist()):
            for j, ohm in enumerate(cells):
                if j and self._row(i, j) != self._row(i, j - 1):
                    yield _Resistor(f"Rseg_row_{i}_{j}", self._row(i, j - 1), self._row(i, j), row[i][j])
                if i and self._column(i, j) != self._column(i - 1, j):
                    yield _Resistor(f"Rseg_col_{i}_{j}", self._column(i - 1, j), self._column(i, j), column[i][j])
                yield _Resistor(f"R_{i}_{j}", self._row(i, j), self._column(i, j), ohm)
        for number, fault in enumerate(self.board.faults):
            if fault.kind == "shorted-cell":
                yield _Resistor(f"Rfault_{number}", self._row(*fault.place), self._column(*fault.place), fault.ohms)
            elif fault.bridge:
                node = self._row if fault.kind == "bridged-rows" else self._column
                yield _Resistor(f"Rfault_{number}", node(*fault.ends[0]), node(*fault.ends[1]), fault.ohms)
