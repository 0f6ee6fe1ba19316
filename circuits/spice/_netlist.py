"""SPICE netlists of a scan: the same circuit as :func:`ohmskin.circuits._scan`, for anybody's simulator.

What a part without resistance, an open part or an ideal amplifier becomes in SPICE is decided here, exactly:

* 0 ohm joins its two nodes (ngspice would silently take 1 mOhm); inf is left out.
* Node 0 is the reference voltage, so that a mid-supply reference costs no digits; board ground is ``agnd``.
* An amplifier of finite gain is a voltage-controlled source with its feedback resistor. With a gain above 1e8
  or infinite, or with a supply that limits it, it is written by what its column sees, which is exactly the
  same but has no large number in it and a slope that Newton's method can follow. With i the current out of the
  column, A the gain, ``wanted = A/(1+A) (v_plus - Rref i)``, and ``lack`` what the supply takes from it::

      v_minus = A/(1+A) v_plus + i Rref/(1+A) + lack        v_out = v_minus - Rref i
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from math import inf, isinf

import numpy as np
from numpy.typing import ArrayLike
from scipy.cluster.hierarchy import DisjointSet

from ...arrays import FloatArray
from ...errors import InputError, SolverError
from .._design import Design
from .._parts import Parts, line_ohms, series_faults

REFERENCE = "0"  # SPICE's node 0
FOLLOWER = "follower"
ROW_INDEX, COLUMN_INDEX = "row_index", "column_index"
LARGEST_GAIN = 1e8  # of a voltage-controlled source: a larger one would multiply ngspice's rounding errors
NONLINEAR_OPTIONS = ".options reltol=1e-9 vntol=1e-12 abstol=1e-15"


@dataclass(frozen=True)
class Deck:
    """A circuit with the one analysis that reads it."""

    title: str
    cards: tuple[str, ...]
    """elements, options and comments"""
    analysis: str
    """ngspice command, without the dot: ``op`` or ``dc ...``"""
    one_by_one: bool
    """column J is to be read at point J of the (innermost) sweep, not all columns at each point"""
    outputs: tuple[str, ...]
    """the node of each column's output; its voltage counts from :attr:`ground`"""
    ground: str
    """the node of board ground"""

    def text(self) -> str:
        """For ``ngspice -b``: runs the analysis and prints ``volts_J = ...`` for each column J."""
        readings = []
        for column, node in enumerate(self.outputs):
            parts = [f"{sign}v({name})" for sign, name in (("", node), ("-", self.ground)) if name != REFERENCE]
            point = f"[{column}]" if self.one_by_one else ""
            volts = "".join(part + point for part in parts) or "0"
            readings += [f"let volts_{column} = {volts}", f"print volts_{column}"]
        control = [".control", "set numdgt=16", self.analysis, *readings, "quit", ".endc"]
        return self._joined(control)

    def batch_text(self) -> str:
        """For ``ngspice -b -r FILE`` and for libngspice: the analysis as a card, output nodes only."""
        nodes = dict.fromkeys((*self.outputs, self.ground))
        saved = [f".save v({node})" for node in nodes if node != REFERENCE]
        return self._joined([*saved, f".{self.analysis}"])

    def _joined(self, tail: Iterable[str]) -> str:
        usage = "* ngspice -b FILE prints the column outputs in V as volts_0 = ..., volts_1 = ..."
        return "\n".join([f"* {self.title}", usage, *self.cards, *tail, ".end", ""])


def netlist(design: Design, resistance: ArrayLike, row: int) -> str:
    """The SPICE netlist of one scan step: ``row`` is selected, every column is read.

    ``resistance`` is (rows, columns) in ohm. The text runs as it is under ``ngspice -b`` and prints the
    outputs in V as ``volts_0 = ...``, ``volts_1 = ...``

    Raises:
        InputError: there is no such row, or the cells do not fit the design.
        SolverError: ideal parts contradict each other or leave an output undetermined.
    """
    return step_deck(design, resistance, row).text()


def step_deck(design: Design, resistance: ArrayLike, row: int) -> Deck:
    """The circuit of one scan step; see :func:`netlist`."""
    if not 0 <= row < design.array.rows:
        raise InputError(f"row {row}: the design has rows 0 to {design.array.rows - 1}")
    return _Writer(design, design.resistance(resistance), row).deck()


def frame_deck(design: Design, resistance: ArrayLike) -> Deck:
    """One circuit for a whole frame: a ``.dc`` sweep of the row index.

    This is ngspice's fastest way to a frame, since it orders the matrix once. The points of the sweep are the
    rows or, with a divider whose idle columns float, row by row the columns.

    Raises:
        InputError, SolverError: as :func:`netlist`; SolverError also where a limited or ideal amplifier sits
            directly on a row driver, which only :func:`step_deck` can write.
    """
    return _Writer(design, design.resistance(resistance), None).deck()


class _Writer:
    """Writes the cards of one design. ``row`` is the selected row, or None for the sweep over all of them."""

    def __init__(self, design: Design, resistance: FloatArray, row: int | None) -> None:
        if design.array.sheet != "sliced":
            raise InputError(f'array.sheet = "{design.array.sheet}" has no netlist; expected "sliced"')
        self.design, self.row = design, row
        self.resistance = resistance + series_faults(design, "open-cell")
        self.rows, self.columns = design.array.shape
        self.parts = Parts.of(design)
        self.row_ohms, self.column_ohms = line_ohms(design)
        self.amplified = design.readout.circuit == "inverting-amplifier"
        self.feedback = design.readout.circuit == "voltage-feedback"
        one_by_one = not self.amplified and design.readout.idle_columns == "float" and self.columns > 1
        self.single = one_by_one or self.feedback
        self.floating = design.drive.idle_rows == "float" and not self.feedback
        self.driven = [i for i in range(self.rows) if row in {None, i} or not self.floating]
        self.ground = "agnd" if design.readout.reference_voltage else REFERENCE
        self.name = self._joined_nodes()
        self.drivers = {self.name[self._driver(i)]: i for i in self.driven}
        self._refuse_contradictions()

    def deck(self) -> Deck:
        cards = [*self._sources(), *self._grid(), *self._readout(), *self._ties()]
        if any(card.startswith("B") for card in cards):
            cards += [
                "",
                "* Sources given as expressions: take nothing but the settled answer.",
                NONLINEAR_OPTIONS,
            ]
        sweep = ["dc"] if self.single or self.row is None else ["op"]
        if self.single:
            sweep.append(f"Vcolumn 0 {self.columns - 1} 1")
        if self.row is None:
            sweep.append(f"Vrow 0 {self.rows - 1} 1")
        outputs = tuple(self._output(j) for j in range(self.columns))
        step = "all rows in turn" if self.row is None else f"row {self.row} selected"
        title = f"ohmskin: {self.rows} x {self.columns} cells, {self.design.readout.circuit}, {step}"
        return Deck(title, tuple(cards), " ".join(sweep), self.single, outputs, self.ground)

    # Nodes

    def _driver(self, i: int) -> str:
        """What row i's lead starts from; a row that stays idle starts from the reference, or the follower, itself."""
        return f"drive_{i}" if self.row in {None, i} else FOLLOWER if self.feedback else REFERENCE

    def _row(self, i: int, j: int) -> str:
        return f"row_{i}_{j}" if self.row_ohms[i, 1:].any() else f"row_{i}"

    def _column(self, i: int, j: int) -> str:
        return f"col_{i}_{j}" if self.column_ohms[1:, j].any() else f"col_{j}"

    def _end(self, j: int) -> str:
        return f"minus_{j}" if self.amplified else f"end_{j}"

    def _output(self, j: int) -> str:
        if self.feedback:
            return FOLLOWER
        return f"out_{j}" if self.amplified else self.name[self._end(j)]

    def _resistors(self) -> Iterator[tuple[str, str, str, float]]:
        """Name, nodes and ohm of each part of the grid; the crosspoints of a line without segments are one."""
        row, column = self.row_ohms.tolist(), self.column_ohms.tolist()
        for i in self.driven:
            yield f"Rlead_row_{i}", self._driver(i), self._row(i, 0), row[i][0]
        for j, ohm in enumerate(self.parts.column_lead.tolist()):
            yield f"Rlead_col_{j}", self._column(self.rows - 1, j), self._end(j), ohm
        for i, cells in enumerate(self.resistance.tolist()):
            for j, ohm in enumerate(cells):
                if j and self._row(i, j) != self._row(i, j - 1):
                    yield f"Rseg_row_{i}_{j}", self._row(i, j - 1), self._row(i, j), row[i][j]
                if i and self._column(i, j) != self._column(i - 1, j):
                    yield f"Rseg_col_{i}_{j}", self._column(i - 1, j), self._column(i, j), column[i][j]
                yield f"R_{i}_{j}", self._row(i, j), self._column(i, j), ohm
        for number, fault in enumerate(self.design.fault):
            if fault.kind == "shorted-cell":
                yield f"Rfault_{number}", self._row(*fault.place), self._column(*fault.place), fault.ohms
            elif fault.bridge:
                node = self._row if fault.kind == "bridged-rows" else self._column
                yield f"Rfault_{number}", node(*fault.ends[0]), node(*fault.ends[1]), fault.ohms

    def _joined_nodes(self) -> dict[str, str]:
        """The name under which each node appears once the parts of 0 ohm have joined theirs."""
        # The first of a joined group lends its name, so those that sources and amplifiers know come first.
        joined = DisjointSet([REFERENCE])
        for node in [*map(self._driver, self.driven), *map(self._end, range(self.columns))]:
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
        if len(self.drivers) < len({self._driver(i) for i in self.driven}) and not (self.row is None and self.floating):
            raise SolverError(
                "rows that are driven to different voltages are joined by parts of 0 ohm; "
                "give array.row_lead or the shorted cells a resistance"
            )
        ends = [self.name[self._end(j)] for j in range(self.columns)]
        if self.feedback and len({*ends, *self.drivers, FOLLOWER}) < len(ends) + len({*self.drivers, FOLLOWER}):
            raise SolverError(
                "a column's end is joined to another one or to a row driver by parts of 0 ohm, which a netlist of the "
                "voltage-feedback circuit cannot express; give array.column_lead a resistance"
            )
        ideal = np.isinf(self.parts.gain) & self.amplified
        for j, end in enumerate(ends):
            if ideal[j] and end in ends[:j] and end not in self.drivers:
                raise SolverError(
                    f"columns {ends.index(end)} and {j} are joined by parts of 0 ohm, so that two ideal "
                    "amplifiers share one input; give readout.open_loop_gain a finite value"
                )

    # Cards

    def _sources(self) -> Iterator[str]:
        readout, volts = self.design.readout, self.design.drive.voltage
        if self.ground != REFERENCE:
            yield "* Node 0 is the reference; board ground lies below it."
            yield f"Vreference {REFERENCE} {self.ground} DC {readout.reference_voltage!r}"
        idle = "are open" if self.floating else f"stay at the {'follower' if self.feedback else 'reference'}"
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
                else:  # while idle, this says that the current of the source is 0
                    yield f"Bdrive_{i} {drive} open_{i} V = {selected} ? {volts!r} : v({drive})+i(Vopen_{i})"
                    yield f"Vopen_{i} open_{i} {REFERENCE} DC 0"
        if self.single:
            others = "stay at the follower" if self.feedback else "are open"
            yield f"* Only the column whose number is v({COLUMN_INDEX}) has its load; the others {others}."
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

    def _readout(self) -> Iterator[str]:
        yield ""
        if self.amplified:
            yield "* Inverting amplifiers, one per column."
            if self.design.readout.supply != (-inf, inf):
                yield "* lack_J: how far its supply keeps the output from the voltage that its feedback asks for."
            for j in range(self.columns):
                yield from self._amplifier(j)
            return
        if self.feedback:
            yield from self._follower()
            return
        yield "* Loads; what is across them is read."
        for j in range(self.columns):
            end, ohm = self.name[self._end(j)], float(self.parts.reference[j])
            if end == REFERENCE:
                yield f"* end_{j} is shorted to the reference"
            elif self.single:
                chosen = f"abs(v({COLUMN_INDEX})-{j})<0.5"
                yield f"Bload_{j} {end} {REFERENCE} I = {chosen} ? v({end})/{ohm!r} : 0"
            else:
                yield f"Rload_{j} {end} {REFERENCE} {ohm!r}"

    def _amplifier(self, j: int) -> Iterator[str]:
        readout = self.design.readout
        minus, out, ground = self.name[self._end(j)], f"out_{j}", self.ground
        gain, rref, vos, bias = self._amplifier_parts(j)
        low, high = readout.supply
        limited = low > -inf or high < inf
        by_current = limited or gain > LARGEST_GAIN
        if bias and minus != REFERENCE:
            yield f"Ibias_{j} {minus} {REFERENCE} DC {bias!r}"
        if not by_current:
            yield f"Voffset_{j} plus_{j} {REFERENCE} DC {vos!r}"
            yield f"Rref_{j} {minus} {out} {rref!r}"
            yield f"Eamplifier_{j} {out} {ground} plus_{j} {minus} {gain!r}"
            return
        if minus in self.drivers:
            yield f"* {minus} is held by a driver: the feedback cannot move it."
            yield f"Vamplifier_{j} {out} {ground} DC {self._comparator(j)!r}"
            yield f"Rref_{j} {minus} {out} {rref!r}"
            return
        # Vvirtual measures the column's current; from it follow the potential of the input and the output.
        at, share = f"in_{j}", 1.0 if isinf(gain) else gain / (1.0 + gain)
        yield f"Vvirtual_{j} {minus} {at} DC 0"
        yield f"Hrref_{j} {out} {at} Vvirtual_{j} {-rref!r}"
        if limited:
            wanted = f"{share!r}*({readout.reference_voltage!r}+{vos!r}-{rref!r}*i(Vvirtual_{j}))"
            terms = [f"min({high!r}-{wanted},0)"] if high < inf else []
            terms += [f"max({low!r}-{wanted},0)"] if low > -inf else []
            yield f"Black_{j} {at} lack_{j} V = {'+'.join(terms)}"
            at = f"lack_{j}"
        if not isinf(gain):
            yield f"Hinput_{j} {at} plus_{j} Vvirtual_{j} {rref / (1.0 + gain)!r}"
            at = f"plus_{j}"
        offset = share * vos - readout.reference_voltage / (1.0 + gain)
        yield f"Voffset_{j} {at} {REFERENCE} DC {offset!r}"

    def _follower(self) -> Iterator[str]:
        """One follower, switched from column to column with its load. Its law is written with the loop closed, so that
        no large gain appears; an end's current, through Vend_J, meets the load or is whatever the follower gives.
        """
        level, (low, high) = self.design.readout.reference_voltage, self.design.readout.supply
        yield "* The load of the chosen column, whose end the follower repeats to all idle lines and to the converter."
        law = "0"
        for j in reversed(range(self.columns)):
            gain, rref, vos, bias = self._amplifier_parts(j)
            end, chosen = self.name[self._end(j)], f"abs(v({COLUMN_INDEX})-{j})<0.5"
            yield f"Vend_{j} {end} at_{j} DC 0"
            yield f"Bend_{j} at_{j} {REFERENCE} V = {chosen} ? {rref!r}*(i(Vend_{j})-{bias!r}) : v({FOLLOWER})"
            law = f"{chosen} ? {1 / (1 + 1 / gain)!r}*(v({end})+{level + vos!r}) : ({law})"
        if high < inf:
            law = f"min({law},{high!r})"
        if low > -inf:
            law = f"max({law},{low!r})"
        yield f"Bfollower {FOLLOWER} {self.ground} V = {law}"

    def _amplifier_parts(self, j: int) -> tuple[float, float, float, float]:
        """Gain, Rref, offset voltage and bias current of column j's amplifier."""
        parts = self.parts
        gain, rref, vos, bias = (float(part[j]) for part in (parts.gain, parts.reference, parts.offset, parts.bias))
        return gain, rref, vos, bias

    def _comparator(self, j: int) -> float:
        """The output of amplifier j, whose inverting input sits on an ideal source."""
        end = self.name[self._end(j)]
        gain, _, vos, _ = self._amplifier_parts(j)
        low, high = self.design.readout.supply
        if self.row is None:
            raise SolverError(
                f"column {j}'s amplifier sits directly on the driver of row {self.drivers[end]}; "
                "a sweep over the rows cannot express that, a netlist for each row can"
            )
        held_at = 0.0 if end == REFERENCE else self.design.drive.voltage
        difference = vos - held_at
        output = gain * difference if difference else 0.0
        if isinf(gain) and (not difference or isinf(high if difference > 0 else low)):
            raise SolverError(
                f"column {j}'s ideal amplifier sits directly on the driver of a row (parts of 0 ohm), so that "
                "its output is not determined; give array.row_lead or the cell a resistance, or "
                "readout.open_loop_gain a finite value"
            )
        return min(max(output, low), high)

    def _ties(self) -> Iterator[str]:
        """Islands that nothing holds make the matrix singular; no current flows there, so 1 ohm holds them."""
        held = DisjointSet([REFERENCE])
        for node in self.name.values():
            held.add(node)
        for _, a, b, ohm in self._resistors():
            if ohm < inf:
                held.merge(self.name[a], self.name[b])
        if self.feedback or not self.single:
            for j in range(self.columns):
                held.merge(self.name[self._end(j)], REFERENCE)
        sometimes = self.row is None and self.floating
        if not sometimes:
            for driver in self.drivers:
                held.merge(driver, REFERENCE)
        for number, island in enumerate(held.subsets()):
            if REFERENCE in island:
                continue
            node = min(island)
            drivers = sorted(i for i in self.driven if sometimes and self.name[self._driver(i)] in island)
            if len(drivers) == self.rows:
                continue  # one of them always holds it
            yield f"* Nothing else holds the island of {node}; no current flows here."
            if drivers:
                idle = " && ".join(f"abs(v({ROW_INDEX})-{i})>0.5" for i in drivers)
                yield f"Btie_{number} {node} {REFERENCE} I = {idle} ? v({node}) : 0"
            else:
                yield f"Rtie_{number} {node} {REFERENCE} 1"
