"""Nodal analysis of a board whose ends are not all Thevenin equivalents: Newton's method, with an a-posteriori bound.

The grid is its port network. Every end adds its own equations (:class:`..ends.Equations`), a shared reference one node.
Diodes follow Shockley's law with Newton steps limited as in SPICE (Nagel 1975, pnjlim); a limited amplifier is linear
or stands at a limit, and the limits are found by active sets. Boards without either need one step.

The error bound is that of Oettli and Prager (1964) with the inverse at hand: for the last Jacobian J with the
approximate inverse R and the residual r, abs(x - x*) <= abs(R) (abs(r) + rounding of r), doubled for the curvature that
remains after the last step.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from math import inf, isinf, sqrt
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.constants import BOLTZMANN, ELEMENTARY_CHARGE
from ...errors import SolverError
from .._tuning import CONVERGED, LEAK, LOOSE, MOST_SIEMENS, MOST_STEPS, MOST_VOLTS, ROUNDS, STANDING, STANDS
from ..solvers import ULP
from ._cards import GROUND, Card
from ._equations import CELL, LINE, ROW, Equations
from ._line_ends import REF, LineEnds, Network

THERMAL_V = BOLTZMANN * 300.15 / ELEMENTARY_CHARGE
"""kT/q at SPICE's usual temperature, 27 degrees Celsius"""
_CROSSPOINT = "x"
"""first letter of the ends that are at cells"""


class _Template(NamedTuple):
    """One network, with its diodes as bends and their resistances as parts."""

    equations: Equations
    diodes: tuple[tuple[str, str, float, float], ...]
    """anode, cathode, saturation current in A, emission voltage in V"""
    limits: tuple[tuple[str, str, float, float], ...]
    """branch, output, low and high in V"""
    end: str = ""


@lru_cache(maxsize=4096)
def _template(network: tuple[Card, ...]) -> _Template:
    parts: list[Card] = []
    diodes, limits = [], []
    for card in network:
        if card.kind == "d":
            anode, cathode = card.nodes
            if card["rs"]:
                inner = f"{card.name}.rs".lower()
                parts.append(Card(f"R.{card.name}", (anode, inner), card["rs"]))
                anode = inner
            diodes.append((anode, cathode, card["is"], card["n"] * THERMAL_V))
        else:
            parts.append(card)
            if card.kind == "x" and not (isinf(card["low"]) and isinf(card["high"])):
                limits.append((card.name, card.nodes[2], card["low"], card["high"]))
    ends = [] if any(ROW in card.nodes for card in network) else [LINE]
    junctions = [node for anode, cathode, *_ in diodes for node in (anode, cathode) if node != GROUND]
    named = dict.fromkeys((*ends, *junctions))
    return _Template(Equations.of(parts, named), tuple(diodes), tuple(limits))


class System(NamedTuple):
    """Equations of one scan step; the first N + M unknowns are the potentials of the ports."""

    static: FloatArray
    """(U, U)"""
    source: FloatArray
    """(U,)"""
    outputs: IntArray
    """(M,) unknown that is sampled at each column; -1 where the column has no turn"""
    diodes: tuple[IntArray, IntArray, FloatArray, FloatArray]
    """anodes, cathodes, saturation currents, emission voltages; the unknown U is ground"""
    limits: tuple[tuple[int, int, float, float], ...]
    """equation of an amplifier, unknown of its output, low and high in V"""
    places: dict[tuple[str, str], int]
    """unknown by the name of an end, and of its node or ``branch`` and part"""


class Solution(NamedTuple):
    """Potentials of one scan step."""

    unknowns: FloatArray
    """(U,)"""
    inverse: FloatArray
    """(U, U) of the last Jacobian"""
    error: FloatArray
    """(U,) bounds"""
    limited: IntArray
    """outputs that stand at a limit"""


def step_system(
    ends: LineEnds,
    lead: FloatArray,
    ports: FloatArray,
    networks: Iterable[tuple[str, int, Network]],
    read: BoolArray,
) -> System:
    """The equations of one state of the switches.

    Args:
        ends: of all lines.
        lead: (M,) ohm between each column's port and its end.
        ports: (N + M, N + M) S of one frame.
        networks: as :meth:`.LineEnds.of_step` yields them.
        read: (M,) columns that have their turn.

    """
    rows, columns = ends.shape
    ports = np.minimum(ports, MOST_SIEMENS)
    count = rows + columns
    at_end = np.arange(rows, count)
    behind = np.flatnonzero(lead > 0)
    at_end[behind] = count + np.arange(len(behind))
    count += len(behind)
    reference = count if ends.reference else -1
    count += bool(ends.reference)
    outputs: IntArray = np.full(columns, -1)
    located: list[tuple[_Template, IntArray]] = []
    places: dict[tuple[str, str], int] = {}
    line_at = [*range(rows), *at_end.tolist()]
    cells, crosspoints = _crosspoints(ends, ports)
    for end, line, network in (*networks, *crosspoints):
        template = _template(network)
        equations = template.equations
        if end.startswith(_CROSSPOINT):
            places[end, ROW] = line
        elif line < len(line_at):
            places[end, LINE] = line_at[line]
        if reference >= 0:
            places[end, REF] = reference
        own = []
        for name in (*equations.nodes, *(f"branch {name}" for name in equations.branches)):
            if (end, name) not in places:
                places[end, name] = count
                count += 1
            own.append(places[end, name])
        located.append((template._replace(end=end), np.array(own, dtype=np.intp)))
        if rows <= line < rows + columns and read[line - rows] and not end.startswith(_CROSSPOINT):
            outputs[line - rows] = places[end, ends.out]
    static, source = np.zeros((count, count)), np.zeros(count)
    every = np.arange(rows + columns)
    static[np.ix_(every, every)] = -ports
    static[every, every] += ports.sum(axis=1) + LEAK * max(float(ports.max(initial=0.0)), 1e-12)
    through = np.where(np.isinf(lead[behind]), 0.0, 1.0 / lead[behind])
    _join(static, rows + behind, at_end[behind], through)
    if crosspoints:
        at_rows, at_columns = np.nonzero(cells)
        _join(static, at_rows, rows + at_columns, -cells[cells > 0])
        inner = np.array([places[end, CELL] for end, *_ in crosspoints])
        _join(static, inner, rows + at_columns, cells[cells > 0])
    diodes: list[tuple[int, int, float, float]] = []
    limits = []
    for template, index in located:
        if len(index):
            static[np.ix_(index, index)] += template.equations.static
            source[index] += template.equations.source

        def node(name: str, end: str = template.end) -> int:
            return count if name == GROUND else places[end, name]

        diodes += [(node(anode), node(cathode), amperes, volts) for anode, cathode, amperes, volts in template.diodes]
        limits += [(node(f"branch {name}"), node(out), low, high) for name, out, low, high in template.limits]
    nothing = np.flatnonzero(~static.any(axis=1))
    static[nothing, nothing] = 1e-12
    anodes, cathodes = (np.array([diode[side] for diode in diodes], np.intp) for side in (0, 1))
    saturation, emission = (np.array([diode[side] for diode in diodes]) for side in (2, 3))
    return System(static, source, outputs, (anodes, cathodes, saturation, emission), tuple(limits), places)


def _join(static: FloatArray, here: IntArray, there: IntArray, conductance: FloatArray) -> None:
    """Add conductances in S between pairs of unknowns."""
    for a, b in ((here, there), (there, here)):
        np.add.at(static, (a, a), conductance)
        np.add.at(static, (a, b), -conductance)


def _crosspoints(ends: LineEnds, ports: FloatArray) -> tuple[FloatArray, list[tuple[str, int, Network]]]:
    """S of the cells (N, M), and the network of each that conducts, with the number of its row.

    The lines have no resistance between the cells and the rows no leads: ports are joined by cells alone.
    """
    rows = len(ends.selected)
    cells = ports[:rows, rows:]
    if not ends.crosspoint:
        return cells, []
    places = zip(*np.nonzero(cells), strict=True)
    return cells, [(f"{_CROSSPOINT}{i}_{j}", int(i), ends.held(ends.crosspoint)) for i, j in places]


def solve(system: System, start: FloatArray | None = None) -> Solution:
    """Newton's method.

    Raises:
        SolverError: the equations determine no potentials, or it does not converge.

    """
    size = len(system.source)
    anode, cathode, saturation, emission = system.diodes
    critical = emission * np.log(emission / (sqrt(2.0) * saturation)) if len(emission) else emission
    junction = np.zeros(len(anode))
    if start is not None and len(start) == size and len(anode):
        padded = np.append(start, 0.0)
        junction = np.minimum(padded[anode] - padded[cathode], critical)
    state = [0] * len(system.limits)
    gmin, before = 1e-12, inf
    for attempt in range(MOST_STEPS):
        static, source = system.static.copy(), system.source.copy()
        for (equation, output, low, high), side in zip(system.limits, state, strict=True):
            if side:
                static[equation] = 0.0
                static[equation, output], source[equation] = 1.0, high if side > 0 else low
        if len(anode):
            with np.errstate(over="ignore"):
                exponential = np.exp(np.minimum(junction / emission, 200.0))
            conductance = saturation / emission * exponential + gmin
            current = saturation * (exponential - 1.0) + gmin * junction
            _stamp(static, source, system.diodes, conductance, current - conductance * junction)
        static, inverse = inverted_nodes(static)
        unknowns = inverse @ source
        unknowns += inverse @ (source - static @ unknowns)
        padded = np.append(unknowns, 0.0)
        wanted = _limited(junction, padded[anode] - padded[cathode], emission, critical)
        moved = float(np.abs(wanted - junction).max(initial=0.0))
        junction = wanted
        sides = _sides(system, unknowns, state)
        if attempt >= ROUNDS and sides != state:
            first = next(place for place, side in enumerate(sides) if side != state[place])
            sides = [
                side if place == first else old for place, (side, old) in enumerate(zip(sides, state, strict=True))
            ]
        near = CONVERGED * (1.0 + float(np.abs(junction).max(initial=0.0)))
        if sides == state and (moved <= near or STANDS * before <= moved <= STANDING * near):
            break
        state, before = sides, moved
    else:
        raise SolverError(f"no operating point of the ends' diodes or limits was found in {MOST_STEPS} steps")
    magnitude = np.abs(static) @ np.abs(unknowns) + np.abs(source)
    residual = np.abs(source - static @ unknowns) + (size + 3) * ULP * magnitude
    error = 2.0 * (np.abs(inverse) @ residual) + 2.0 * moved + ULP * np.abs(unknowns)
    if np.abs(unknowns).max(initial=0.0) > MOST_VOLTS:
        raise SolverError(
            "ideal sources at the ends of the lines contradict each other; expected resistances between them"
        )
    limited = [output for (_, output, *_), side in zip(system.limits, state, strict=True) if side]
    return Solution(unknowns, inverse, error, np.array(limited, dtype=np.intp))


def inverted_nodes(static: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Equations (U, U) and their inverse. Where nothing holds some nodes, a leak to ground that is added does.

    Raises:
        SolverError: no leak determines the potentials: ideal sources and amplifiers contradict each other.

    """
    for leak in (0.0, LOOSE):
        equations = static + leak * float(np.abs(static).max()) * np.eye(len(static)) if leak else static
        with suppress(np.linalg.LinAlgError):
            return equations, np.linalg.inv(equations).astype(np.float64, copy=False)
    raise SolverError("the ends of the lines determine no potentials: is an input of an ideal amplifier not connected?")


def _stamp(
    static: FloatArray,
    source: FloatArray,
    diodes: tuple[IntArray, IntArray, FloatArray, FloatArray],
    conductance: FloatArray,
    shift: FloatArray,
) -> None:
    """Add the diodes' Norton equivalents; ``shift`` is the current at no voltage."""
    ground = len(source)
    for here, there, sign in ((diodes[0], diodes[1], 1.0), (diodes[1], diodes[0], -1.0)):
        real = here != ground
        np.add.at(static, (here[real], here[real]), conductance[real])
        np.add.at(source, here[real], -sign * shift[real])
        both = real & (there != ground)
        np.add.at(static, (here[both], there[both]), -conductance[both])


def _limited(old: FloatArray, new: FloatArray, emission: FloatArray, critical: FloatArray) -> FloatArray:
    """Junction voltages of the next step, no further than the exponential can be followed."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ahead = 1.0 + (new - old) / emission
        careful = np.where(
            old > 0, np.where(ahead > 0, old + emission * np.log(ahead), critical), emission * np.log(new / emission)
        )
    jumps = (new > critical) & (np.abs(new - old) > 2.0 * emission)
    return np.where(jumps, careful, new)


def _sides(system: System, unknowns: FloatArray, state: list[int]) -> list[int]:
    """Limits that the amplifiers are at: 0 none, -1 the lower, 1 the upper one."""
    sides = []
    for (equation, output, low, high), side in zip(system.limits, state, strict=True):
        if side == 0:
            sides.append(int(unknowns[output] > high) - int(unknowns[output] < low))
        else:
            # The law of the amplifier, v+ - v- + Vos - out / A, which is above 0 where it drives its output up.
            excess = float(system.static[equation] @ unknowns - system.source[equation])
            sides.append(side if excess * side > 0 else 0)
    return sides


def alone(ends: LineEnds, row: int, column: int, conductance: FloatArray) -> FloatArray:
    """V of the output with one cell alone between a selected row and a read column, for each conductance in S."""
    row_end, column_end = slice(row, row + 1), slice(column, column + 1)
    own = {name: getattr(ends, name)[row_end] for name in ("selected", "idle")}
    own |= {name: getattr(ends, name)[column_end] for name in ("read", "unread")}
    one = replace(ends, shared_by=1, **own)
    found, start, read = [], None, np.array([True])
    for siemens in conductance:
        network = np.array([[0.0, siemens], [siemens, 0.0]])
        system = step_system(one, np.zeros(1), network, one.of_step(0, read), read)
        solution = solve(system, start)
        start = solution.unknowns
        found.append(solution.unknowns[system.outputs[0]])
    return np.array(found)
