"""A nodal analysis of its own, to judge the solvers and the worst cases by: one dense system per driven line.

It shares nothing with the package but the numbers of a design. Modified nodal analysis: potentials of all nodes, and
the currents of what has no conductance (parts of 0 ohm, sources, amplifier outputs).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ohmskin.circuits import Design

Array = NDArray[np.float64]


class _Circuit:
    """Parts, collected as equations."""

    def __init__(self) -> None:
        self.numbers: dict[object, int] = {}
        self.resistors: list[tuple[int, int, float]] = []
        self.constraints: list[tuple[dict[int, float], float, dict[int, float]]] = []
        """sum of factors times potentials, its value in V, and the nodes that the constraint's own current enters"""
        self.drawn: dict[int, float] = {}
        """A that leave a node"""

    def node(self, name: object) -> int:
        return self.numbers.setdefault(name, len(self.numbers))

    def resistor(self, a: object, b: object, ohm: float) -> None:
        one, other = self.node(a), self.node(b)
        if ohm:
            self.resistors.append((one, other, 1.0 / ohm))
        else:
            self.constraints.append(({one: 1.0, other: -1.0}, 0.0, {one: 1.0, other: -1.0}))

    def source(self, name: object, volts: float) -> None:
        """A node held at a potential."""
        at = self.node(name)
        self.constraints.append(({at: 1.0}, volts, {at: 1.0}))

    def amplifier(self, plus: object, minus: object, out: object, gain: float, offset: float) -> None:
        """``out = gain (plus + offset - minus)``."""
        terms: dict[int, float] = {}
        for name, factor in ((minus, 1.0), (plus, -1.0), (out, 1.0 / gain)):
            terms[self.node(name)] = terms.get(self.node(name), 0.0) + factor
        self.constraints.append((terms, offset, {self.node(out): 1.0}))

    def solve(self) -> Array:
        """Potentials of all nodes."""
        nodes, extra = len(self.numbers), len(self.constraints)
        matrix, right = np.zeros((nodes + extra, nodes + extra)), np.zeros(nodes + extra)
        for a, b, siemens in self.resistors:
            for one, other in ((a, b), (b, a)):
                matrix[one, one] += siemens
                matrix[one, other] -= siemens
        for number, (terms, volts, entered) in enumerate(self.constraints, nodes):
            for node, factor in terms.items():
                matrix[number, node] += factor
            right[number] = volts
            for node, factor in entered.items():
                matrix[node, number] -= factor
        for node, amperes in self.drawn.items():
            right[node] -= amperes
        return np.linalg.solve(matrix, right)


def read(design: Design, cells: Array, *, limited: bool = False) -> Array:
    """V (rows, columns) at the outputs of a design without faults and with a sliced sheet.

    With ``limited``, inverting amplifiers that would leave the supply are held at its limit, which shifts others.
    """
    rows, columns = design.array.shape
    volts = np.empty((rows, columns))
    circuit = design.readout.circuit
    if circuit == "row-amplifier":
        for column in range(columns):
            volts[:, column] = _within(design, cells, column, limited=limited)
        return volts
    one_by_one = circuit == "voltage-feedback" or (
        circuit == "voltage-divider" and design.readout.idle_columns == "float"
    )
    for row in range(rows):
        if one_by_one:
            for column in range(columns):
                volts[row, column] = _step(design, cells, row, column)[column]
        else:
            volts[row] = _within(design, cells, row, limited=limited)
    return volts


def _within(design: Design, cells: Array, driven: int, *, limited: bool) -> Array:
    """Outputs of one scan step; more and more of them held at their limits, until none is beyond."""
    held: dict[int, float] = {}
    while True:
        volts = _step(design, cells, driven, held=held)
        low, high = design.readout.supply
        beyond = [line for line in np.flatnonzero((volts < low) | (volts > high)) if line not in held]
        if not limited or not beyond:
            return volts
        held |= {int(line): float(np.clip(volts[line], low, high)) for line in beyond}


def _step(
    design: Design,
    cells: Array,
    driven: int,
    sensed: int | None = None,
    held: Mapping[int, float] | None = None,
) -> Array:
    """Outputs of one scan step; ``held`` are outputs at a limit, V by line."""
    array, readout = design.array, design.readout
    rows, columns = array.shape
    by_rows = readout.circuit == "row-amplifier"
    count_driven, count_sensed = (columns, rows) if by_rows else (rows, columns)

    def each(value: object, count: int) -> Array:
        return np.broadcast_to(np.asarray(value, dtype=float), count)

    made = _Circuit()
    row_lead, column_lead = each(array.row_lead, rows), each(array.column_lead, columns)
    row_segment, column_segment = each(array.row_segment, rows), each(array.column_segment, columns)
    for i in range(rows):
        for j in range(columns):
            made.resistor(("r", i, j), ("c", i, j), float(cells[i, j]))
            if j:
                made.resistor(("r", i, j - 1), ("r", i, j), float(row_segment[i]))
            if i:
                made.resistor(("c", i - 1, j), ("c", i, j), float(column_segment[j]))
        made.resistor(("row end", i), ("r", i, 0), float(row_lead[i]))
    for j in range(columns):
        made.resistor(("c", rows - 1, j), ("column end", j), float(column_lead[j]))
    kinds = ("column end", "row end") if by_rows else ("row end", "column end")
    level, drive = readout.reference_voltage, design.drive.voltage
    reference, gain = each(readout.reference_resistance, count_sensed), each(readout.open_loop_gain, count_sensed)
    offset, bias = each(readout.offset_voltage, count_sensed), each(readout.bias_current, count_sensed)
    follows = readout.circuit == "voltage-feedback"
    made.source("reference", level)
    for line in range(count_driven):
        if line == driven:
            made.source((kinds[0], line), level + drive)
        elif follows:
            made.resistor((kinds[0], line), "follower", 0.0)
        elif design.drive.idle_rows == "ground":
            made.source((kinds[0], line), level)
    for line in range(count_sensed):
        end = (kinds[1], line)
        if follows and line != sensed:
            made.resistor(end, "follower", 0.0)
        elif follows:
            made.resistor(end, "reference", float(reference[line]))
            made.drawn[made.node(end)] = float(bias[line])
            made.amplifier(end, "follower", "follower", float(gain[line]), float(offset[line]))
        elif readout.circuit == "voltage-divider":
            if sensed in (None, line):
                made.resistor(end, "reference", float(reference[line]))
        else:
            made.resistor(end, ("out", line), float(reference[line]))
            made.drawn[made.node(end)] = float(bias[line])
            if held and line in held:
                made.source(("out", line), held[line])
            else:
                made.amplifier("reference", end, ("out", line), float(gain[line]), float(offset[line]))
    potential = made.solve()
    if follows:
        return np.full(count_sensed, potential[made.node("follower")])
    name = kinds[1] if readout.circuit == "voltage-divider" else "out"
    known = [made.numbers.get((name, line)) for line in range(count_sensed)]
    return np.array([np.nan if number is None else potential[number] for number in known])
