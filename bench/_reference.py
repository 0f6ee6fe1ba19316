"""The reference for readings: modified nodal analysis of a design in exact rational arithmetic.

Every part is one equation or one stamp, as a textbook would write them (Ho, Ruehli and Brennan, IEEE Transactions on
Circuits and Systems 22, 1975). FLINT solves the matrix of rational numbers without any rounding, so singular circuits
are told from nearly singular ones for certain; only the answers are rounded to double precision. Nothing is shared
with ``ohmskin.circuits`` but the keys of a design: no ports, no elimination of the amplifiers, no symmetry, no large
numbers that stand for ideal parts.

Unknowns are the node potentials against the reference voltage, the currents of ideal sources and of parts of 0 ohm,
and the outputs of the amplifiers.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import product
from math import inf, isinf
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.cluster.hierarchy import DisjointSet

from ..circuits import Design
from ..common.arrays import FloatArray
from ..common.extras import install_command
from ..errors import MissingExtra

try:
    import flint
except ImportError:
    flint = None

Node = Hashable
REFERENCE: Node = "reference"
FOLLOWER: Node = "follower"
CIRCUITS = {"inverting-amplifier", "row-amplifier", "voltage-divider", "voltage-feedback"}
"""readouts whose equations :func:`_solve` and :func:`_outputs` have"""


class Indeterminate(ArithmeticError):
    """The circuit has no solution, or more than one."""


def reference_volts(design: Design, resistance: ArrayLike) -> FloatArray:
    """The outputs of one frame, (rows, columns) in V, exact but for their rounding.

    Amplifier of line j: ``v_out = A (Vref + Vos - v_minus)`` within its supply, Rref from ``v_out`` to ``v_minus``,
    and the bias current into the inverting input. Divider: the potential of the line's end, with its load to the
    reference. Voltage feedback: the output of the follower, which drives all idle lines.

    Raises:
        Indeterminate: ideal parts contradict each other or leave a voltage open.
        MissingExtra: python-flint is not installed.
    """
    if flint is None:
        raise MissingExtra(f"the exact reference needs python-flint: {install_command('exact')}")
    cells = design.resistance(resistance)
    rows, columns = cells.shape
    volts = np.empty(cells.shape)
    if design.is_described:
        raise NotImplementedError("bench/_reference.py has no equations of networks; tests/test_ends.py asks ngspice")
    if design.readout.circuit not in CIRCUITS:
        raise NotImplementedError(f"bench/_reference.py has no equations of the readout '{design.readout.circuit}'")
    circuit, idle_columns = design.readout.circuit, design.readout.idle_columns
    one_by_one = (
        circuit == "voltage-feedback"
        or (circuit == "voltage-divider" and idle_columns != "load")
        or design.readout.columns == "multiplexed"
    )

    def together(lines: int) -> list[list[int]]:
        return [[line] for line in range(lines)] if one_by_one else [list(range(lines))]

    if circuit == "row-amplifier":
        for column in range(columns):
            for read in together(rows):
                volts[read, column] = _step(design, cells, column, read)
        return volts
    for row in range(rows):
        for read in together(columns):
            volts[row, read] = _step(design, cells, row, read)
    return volts


def _step(design: Design, cells: FloatArray, row: int, read: list[int]) -> list[float]:
    """The outputs of the lines ``read`` while the driven line ``row`` is selected; tries which of them are saturated.

    Driven lines are rows and lines that are read are columns, but the other way round for "row-amplifier".
    """
    low, high = design.readout.supply
    for first_guess in _saturations(len(read), design.readout.supply):
        guess = first_guess
        tried: list[tuple[float | None, ...]] = []
        while guess not in tried:
            tried.append(guess)
            try:
                outputs, unlimited = _solve(design, cells, row, read, guess)
            except Indeterminate:
                break
            guess = tuple(_limit(volts, low, high) for volts in unlimited)
            if guess == tried[-1]:
                return [_rounded(volts) for volts in outputs]
    raise Indeterminate(f"no unique solution while line {row} is selected")


def _saturations(lines: int, supply: tuple[float, float]) -> Iterator[tuple[float | None, ...]]:
    """First guesses: no output saturated; then, on small grids, every way in which they can be."""
    yield (None,) * lines
    rails = [rail for rail in supply if not isinf(rail)]
    if lines <= 4 and rails:
        yield from product([None, *rails], repeat=lines)


def _solve(
    design: Design, cells: FloatArray, row: int, read: list[int], stuck_at: tuple[float | None, ...]
) -> tuple[list[Any], list[Any]]:
    """Outputs of the lines ``read``, and what the amplifiers would put out at these currents without supply.

    The latter is ``(Vref + Vos - Rref i) A/(1+A)``, i the current out of the grid: it is inside the supply
    if, and only if, ``A (Vref + Vos - v_minus)`` is.
    """
    number = _exact
    readout = design.readout
    system = _Equations()

    parts = _grid(design, cells)
    driven_lines, read_lines = cells.shape[::-1] if readout.circuit == "row-amplifier" else cells.shape
    held: DisjointSet = DisjointSet([REFERENCE])  # nodes whose potential a source or a load ties to the reference
    feedback = readout.circuit == "voltage-feedback"
    if feedback:
        held.add(FOLLOWER)
        held.merge(FOLLOWER, REFERENCE)
    for i in range(driven_lines):
        if i != row and feedback:
            parts.append((("drive", i), FOLLOWER, 0.0))
        elif i == row or design.drive.idle_rows == "ground":
            volts = number(design.drive.voltage if i == row else 0.0)
            system.branch(("source", i), ("drive", i), REFERENCE, [(("drive", i), number(1))], volts)
            held.add(("drive", i))
            held.merge(("drive", i), REFERENCE)

    vref = number(readout.reference_voltage)
    amplified = readout.circuit in {"inverting-amplifier", "row-amplifier"}
    for j in range(read_lines):
        if j in read:
            continue
        if feedback:
            parts.append((("end", j), FOLLOWER, 0.0))
        elif readout.idle_columns != "float":
            ohm = 0.0 if readout.idle_columns == "ground" else _of(readout.reference_resistance, j)
            parts.append((("end", j), REFERENCE, ohm))
    for j, rail in zip(read, stuck_at, strict=True):
        rref, vos = number(_of(readout.reference_resistance, j)), number(_of(readout.offset_voltage, j))
        bias, inverse_gain = number(_of(readout.bias_current, j)), _inverse(_of(readout.open_loop_gain, j))
        minus, out = ("end", j), ("out", j)
        held.add(minus)
        held.merge(minus, REFERENCE)
        if not amplified:
            system.conductor(minus, REFERENCE, 1 / rref)
            if feedback:
                system.add(minus, [], -bias)
                if rail is not None:
                    law, value = [(FOLLOWER, number(1))], number(rail) - vref
                else:
                    law, value = [(FOLLOWER, 1 + inverse_gain), (minus, number(-1))], vos - vref * inverse_gain
                system.branch("follower output", FOLLOWER, REFERENCE, law, value)
            continue
        system.conductor(minus, out, 1 / rref)
        system.add(minus, [], -bias)
        if rail is not None:
            law, value = [(out, number(1))], number(rail) - vref
        else:  # (v_out + Vref) / A = Vos - v_minus
            law, value = [(out, inverse_gain), (minus, number(1))], vos - vref * inverse_gain
        system.branch(("amplifier", j), out, REFERENCE, law, value)

    _join(system, held, parts)
    return _outputs(design, read, system.solution())


def _grid(design: Design, cells: FloatArray) -> list[tuple[Node, Node, float]]:
    """Nodes and ohm of every part of the grid: leads, segments, cells and faults."""
    array = design.array
    rows, columns = cells.shape
    on_rows = design.readout.circuit == "row-amplifier"
    parts: list[tuple[Node, Node, float]] = []
    broken = _in_series(design, "broken-row")
    severed = _in_series(design, "broken-column")
    opened = _in_series(design, "open-cell")
    for i in range(rows):
        ahead = ("end", i) if on_rows else ("drive", i)
        parts += _lead(design, ahead, ("row", i, 0), _of(array.row_lead, i), broken.get((i, 0), 0.0))
        for j in range(columns):
            if j:
                ohm = _of(array.row_segment, i) + broken.get((i, j), 0.0)
                parts.append((("row", i, j - 1), ("row", i, j), ohm))
            if i:
                ohm = _of(array.column_segment, j) + severed.get((i - 1, j), 0.0)
                parts.append((("column", i - 1, j), ("column", i, j), ohm))
            parts.append((("row", i, j), ("column", i, j), float(cells[i, j]) + opened.get((i, j), 0.0)))
    for j in range(columns):
        behind = ("drive", j) if on_rows else ("end", j)
        parts += _lead(
            design, behind, ("column", rows - 1, j), _of(array.column_lead, j), severed.get((rows - 1, j), 0.0)
        )
    for fault in design.fault:
        i, j = fault.place
        if fault.kind == "shorted-cell":
            parts.append((("row", i, j), ("column", i, j), fault.ohms))
        elif fault.kind == "bridged-rows":
            parts.append((("row", i, j), ("row", i + 1 if fault.to is None else fault.to, j), fault.ohms))
        elif fault.kind == "bridged-columns":
            parts.append((("column", i, j), ("column", i, j + 1 if fault.to is None else fault.to), fault.ohms))
    return parts


def _lead(
    design: Design, outside: tuple[str, int], first: Node, lead: float, broken: float
) -> list[tuple[Node, Node, float]]:
    """The lead of a line, a break behind it, and between both the pull-down of a driven line."""
    kind, line = outside
    if kind != "drive" or isinf(design.drive.idle_row_resistance):
        return [(outside, first, lead + broken)]
    start: Node = ("start", line)
    return [(outside, start, lead), (start, first, broken), (start, REFERENCE, design.drive.idle_row_resistance)]


def _join(system: _Equations, held: DisjointSet, parts: list[tuple[Node, Node, float]]) -> None:
    """Put the parts into the equations; ``held`` has the nodes whose potential is tied to the reference without them.

    Parts without resistance are branches of 0 V; one that closes a loop of such parts would add nothing but an
    indeterminate current. An island that nothing holds carries no current: one of its nodes is tied.
    """
    shorts: DisjointSet = DisjointSet()
    for name, (a, b, ohm) in enumerate(parts):
        for node in (a, b):
            shorts.add(node)
            held.add(node)
        if isinf(ohm):
            continue
        held.merge(a, b)
        if ohm:
            system.conductor(a, b, 1 / _exact(ohm))
        elif shorts.merge(a, b):
            system.branch(("short", name), a, b, [(a, _exact(1)), (b, _exact(-1))], _exact(0))
    for island in held.subsets():
        if REFERENCE not in island:
            system.conductor(min(island, key=str), REFERENCE, _exact(1))


def _outputs(design: Design, read: list[int], value_of: dict[Hashable, Any]) -> tuple[list[Any], list[Any]]:
    """What :func:`_solve` returns, from the solution of its equations."""
    number, readout = _exact, design.readout
    vref = number(readout.reference_voltage)
    amplified = readout.circuit in {"inverting-amplifier", "row-amplifier"}
    feedback = readout.circuit == "voltage-feedback"
    outputs, unlimited = [], []
    for j in read:
        share = 1 / (1 + _inverse(_of(readout.open_loop_gain, j)))
        vos = number(_of(readout.offset_voltage, j))
        if feedback:
            outputs.append(value_of[FOLLOWER] + vref)
            unlimited.append((value_of["end", j] + vref + vos) * share)
        elif amplified:
            outputs.append(value_of["out", j] + vref)
            dropped = value_of["end", j] - value_of["out", j]  # Rref i
            unlimited.append((vref + vos - dropped) * share)
        else:
            outputs.append(value_of["end", j] + vref)
            unlimited.append(vref)  # no amplifier, no supply
    return outputs, unlimited


def _in_series(design: Design, kind: str) -> dict[tuple[int, int], float]:
    """Ohm at each place that has faults of this kind."""
    ohms: dict[tuple[int, int], float] = defaultdict(float)
    for fault in design.fault:
        if fault.kind == kind:
            ohms[fault.place] += fault.ohms
    return dict(ohms)


def _of(value: float | tuple[float, ...], line: int) -> float:
    return value[line] if isinstance(value, tuple) else value


def _exact(value: float) -> Any:
    """A finite double as the rational number that it is."""
    return flint.fmpq(*float(value).as_integer_ratio())


def _rounded(value: Any) -> float:
    """The double that is nearest to a rational number."""
    return int(value.p) / int(value.q)


def _limit(volts: Any, low: float, high: float) -> float | None:
    """The supply limit that an output of so many volts would pass."""
    if high < inf and volts > _exact(high):
        return high
    return low if low > -inf and volts < _exact(low) else None


def _inverse(gain: float) -> Any:
    return 1 / _exact(gain) if gain < inf else _exact(0)


@dataclass
class _Equations:
    """A linear system under construction; unknowns are named, and so are the equations, by the same names."""

    place: dict[Hashable, int] = field(default_factory=dict)
    left: dict[tuple[int, int], Any] = field(default_factory=lambda: defaultdict(lambda: _exact(0)))
    right: dict[int, Any] = field(default_factory=lambda: defaultdict(lambda: _exact(0)))

    def add(self, equation: Hashable, terms: Iterable[tuple[Hashable, Any]], constant: Any = 0) -> None:
        """Add ``sum(factor * unknown)`` to the left of an equation and ``constant`` to its right.

        The equation of a node is its current balance; the reference has no equation, and its potential is 0.
        """
        if equation == REFERENCE:
            return
        row = self.place.setdefault(equation, len(self.place))
        self.right[row] += constant
        for unknown, factor in terms:
            if unknown != REFERENCE:
                self.left[row, self.place.setdefault(unknown, len(self.place))] += factor

    def conductor(self, a: Node, b: Node, siemens: Any) -> None:
        self.add(a, [(a, siemens), (b, -siemens)])
        self.add(b, [(b, siemens), (a, -siemens)])

    def branch(self, current: Hashable, a: Node, b: Node, law: Iterable[tuple[Hashable, Any]], constant: Any) -> None:
        """A part with the law ``sum(factor * unknown) = constant``; its current flows from ``a`` to ``b``."""
        self.add(a, [(current, 1)])
        self.add(b, [(current, -1)])
        self.add(current, law, constant)

    def solution(self) -> dict[Hashable, Any]:
        size = len(self.place)
        matrix, right = flint.fmpq_mat(size, size), flint.fmpq_mat(size, 1)
        for place, value in self.left.items():
            matrix[place] = value
        for row, value in self.right.items():
            right[row, 0] = value
        try:
            values = matrix.solve(right)
        except ZeroDivisionError as error:
            raise Indeterminate("singular matrix") from error
        return {unknown: values[place, 0] for unknown, place in self.place.items()}
