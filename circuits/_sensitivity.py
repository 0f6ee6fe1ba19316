"""d(reading)/d(every part) by the adjoint: no re-solve per part.

In a resistive network a part's drop in the *forward* field (the scan step as it is) times its drop in the *adjoint*
field (the step's sources off, a unit source where the reading is taken) is, up to sign, the derivative of the reading
by the part's conductance (Tellegen; Director and Rohrer 1969). Forward and adjoint fields of all readings are
combinations of N + M fields, one for each port of the grid at 1 V; those are solved for once, by one sparse
factorisation. Parts in series with a line go by their current instead, which the cells' currents add up to, so that
a line without resistance has its sensitivities too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from ..arrays import FloatArray, IntArray
from ..errors import InputError, SolverError
from ._design import Design
from ._grid import exact_ports, grid_network
from ._parts import Parts, siemens
from ._readout import Reading, amplifier_ends, read
from .solvers._elimination import inverted
from .solvers._ports import IDEAL_WIRE

LARGEST = 64 * 64
"""cells for which all readings' derivatives by all parts fit into memory (0.13 GB per kind of part)"""
_SHORT = 1e8  # conductance of a shorted cell, relative to the largest other one


@dataclass(frozen=True)
class Sensitivity:
    """Derivatives of the output volts. The first two axes are the reading's (N, M), the last ones the part's."""

    volts: FloatArray
    """the readings themselves, (N, M) V"""
    conductance: FloatArray
    """(N, M) S, at which the cells' derivatives hold; a shorted cell stands for a very small resistance"""
    cell_conductance: FloatArray
    """(N, M, N, M) V/S"""
    row_lead: FloatArray
    """(N, M, N) V/ohm"""
    row_segment: FloatArray
    """(N, M, N, M - 1) V/ohm; [..., i, j] lies between crosspoints j and j + 1 of row i"""
    column_lead: FloatArray
    """(N, M, M) V/ohm"""
    column_segment: FloatArray
    """(N, M, N - 1, M) V/ohm; [..., i, j] lies between crosspoints i and i + 1 of column j"""
    reference_resistance: FloatArray
    """(N, M, M) V/ohm"""
    inverse_gain: FloatArray
    """(N, M, M) V per unit of 1 / open_loop_gain, which is 0 for an ideal amplifier"""
    offset_voltage: FloatArray
    """(N, M, M) V/V"""
    bias_current: FloatArray
    """(N, M, M) V/A"""

    @property
    def cells(self) -> FloatArray:
        """(N, M, N, M) V/ohm of the cells."""
        return -self.cell_conductance * self.conductance**2


def sensitivity(design: Design, resistance: ArrayLike) -> Sensitivity:
    """Derivatives of all readings of a frame by all parts.

    An output at a supply limit does not move, and the others' derivatives hold while it stays there.

    Args:
        design: with a sliced sheet, of at most 64 x 64 cells.
        resistance: (rows, columns) ohm.

    Raises:
        InputError: the cells do not fit, the sheet is continuous or the array too large.
        SolverError: parts of so many decades that the factorisation breaks down.

    """
    cells = design.resistance(resistance)
    if design.array.sheet != "sliced":
        raise InputError(f'sensitivities are for array.sheet = "sliced", not "{design.array.sheet}"')
    if cells.size > LARGEST:
        raise InputError(f"sensitivities are for at most {LARGEST} cells, the design has {cells.size}")
    ports = exact_ports(design, cells).value
    reading = read(design, ports)
    fields = _Fields.of(design, cells)
    result = _empty(reading.volts, fields.conductance)
    groups = _feedback if design.readout.circuit == "voltage-feedback" else _terminated
    for group in groups(design, ports, reading):
        _collect(result, fields, group)
    return result


class _Group(NamedTuple):
    """Readings ``np.ix_(rows, columns)`` that share their fields, as potentials of the N + M ports.

    A field has one row per reading, or one for all readings of a row (of a column), axes (rows, columns, ports).
    """

    rows: IntArray
    columns: IntArray
    forward: FloatArray
    adjoint: FloatArray
    lead_current: FloatArray
    """(rows, columns, M) A of the forward field into the columns' ends"""
    adjoint_lead_current: FloatArray
    amplifiers: dict[str, FloatArray]
    """further derivatives, (rows, columns, M), by name"""


class _Fields(NamedTuple):
    """What a unit potential of each port, the others at 0, does inside."""

    drops: FloatArray
    """(N + M, N, M) V across the cells, from row to column"""
    conductance: FloatArray
    """(N, M) S"""
    leaving_row: FloatArray
    """(N + M, N, M) A that leaves each crosspoint of a row line, other than along it: by the cell and by bridges"""
    entering_column: FloatArray
    """(N + M, N, M) A that comes to each crosspoint of a column line"""

    @classmethod
    def of(cls, design: Design, cells: FloatArray) -> _Fields:
        rows, columns = cells.shape
        network = grid_network(design, cells)
        cell_at = rows * columns + (rows - 1) * columns
        conductance = network.conductance.copy()
        known = conductance[np.isfinite(conductance)]
        short = _SHORT * float(known.max(initial=0.0)) or 1.0
        conductance[cell_at:] = np.minimum(conductance[cell_at:], short)
        # Ends of ideal wires are one node.
        wired = np.isinf(conductance)
        count = len(network.place)
        a, b = network.ends[wired].T
        _, node = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(count, count)), directed=False)
        a, b = node[network.ends[~wired]].T
        value = conductance[~wired]
        port = node[network.ports]
        size = int(node.max()) + 1
        graph = coo_array((value, (a, b)), shape=(size, size)).tocsr()
        graph = graph + graph.T
        graph.eliminate_zeros()  # they would count as connections
        inner = np.setdiff1d(np.arange(size), port)
        potential = np.zeros((size, rows + columns))
        potential[port, np.arange(rows + columns)] = 1.0
        if len(inner):
            # An island without a port stands at any potential, and a tie of one of its nodes says which.
            _, island = connected_components(graph, directed=False)
            adrift = ~np.isin(island, island[port])
            loose = np.zeros(size)
            loose[np.flatnonzero(adrift)[np.unique(island[adrift], return_index=True)[1]]] = 1.0
            total = np.asarray(graph.sum(axis=1)).ravel() + loose
            matrix = (coo_array((total, (np.arange(size), np.arange(size))), shape=(size, size)) - graph).tocsc()
            try:
                factor = splu(
                    matrix[inner][:, inner],
                    permc_spec="MMD_AT_PLUS_A",
                    diag_pivot_thresh=0.0,
                    options={"SymmetricMode": True},
                )
            except RuntimeError as error:  # SuperLU's word for a singular matrix
                raise SolverError(
                    "the grid's parts span too many decades for sensitivities; give the smallest resistances as 0, or "
                    "the largest as inf"
                ) from error
            potential[inner] = factor.solve(graph[inner][:, port].toarray())
        first, second = potential[node[network.ends[cell_at:]]].transpose(1, 2, 0)
        drops, siemens_at = first - second, conductance[cell_at:]
        ours = slice(cells.size)
        current = (drops * siemens_at).reshape(rows + columns, -1)
        leaving = current[:, ours].reshape(-1, rows, columns).copy()
        entering = leaving.copy()
        for bridge, fault in enumerate((fault for fault in design.fault if fault.bridge), start=cells.size):
            here, there = fault.ends
            if fault.kind == "bridged-rows":
                leaving[:, *here] += current[:, bridge]
                leaving[:, *there] -= current[:, bridge]
            else:
                entering[:, *here] -= current[:, bridge]
                entering[:, *there] += current[:, bridge]
        return cls(
            drops[:, ours].reshape(-1, rows, columns), siemens_at[ours].reshape(rows, columns), leaving, entering
        )


def _empty(volts: FloatArray, conductance: FloatArray) -> Sensitivity:
    rows, columns = volts.shape
    return Sensitivity(
        volts=volts,
        conductance=conductance,
        cell_conductance=np.zeros((rows, columns, rows, columns)),
        row_lead=np.zeros((rows, columns, rows)),
        row_segment=np.zeros((rows, columns, rows, columns - 1)),
        column_lead=np.zeros((rows, columns, columns)),
        column_segment=np.zeros((rows, columns, rows - 1, columns)),
        reference_resistance=np.zeros((rows, columns, columns)),
        inverse_gain=np.zeros((rows, columns, columns)),
        offset_voltage=np.zeros((rows, columns, columns)),
        bias_current=np.zeros((rows, columns, columns)),
    )


def _collect(result: Sensitivity, fields: _Fields, group: _Group) -> None:
    at = np.ix_(group.rows, group.columns)
    forward = np.tensordot(group.forward, fields.drops, axes=1)
    adjoint = np.tensordot(group.adjoint, fields.drops, axes=1)
    result.cell_conductance[at] = -forward * adjoint
    # A line carries what leaves it beyond (rows), or has come to it so far (columns).
    along, down = [], []
    for field in (group.forward, group.adjoint):
        leaving = np.tensordot(field, fields.leaving_row, axes=1)
        along.append(np.cumsum(leaving[..., ::-1], axis=-1)[..., ::-1])
        down.append(np.cumsum(np.tensordot(field, fields.entering_column, axes=1), axis=-2)[..., :-1, :])
    result.row_lead[at] = along[0][..., 0] * along[1][..., 0]
    result.row_segment[at] = along[0][..., 1:] * along[1][..., 1:]
    result.column_segment[at] = down[0] * down[1]
    result.column_lead[at] = group.lead_current * group.adjoint_lead_current
    for name, values in group.amplifiers.items():
        getattr(result, name)[at] = values


class _Ties(NamedTuple):
    """The ports' potentials as a function of what each is tied to."""

    ports: FloatArray
    tie: FloatArray
    """(N + M,) S"""
    inner: FloatArray
    """(N + M, N + M) ohm"""

    @classmethod
    def of(cls, ports: FloatArray, tie: FloatArray) -> _Ties:
        largest = max(float(ports.max(initial=0.0)), float(np.max(tie, where=np.isfinite(tie), initial=1e-300)))
        tie = np.minimum(tie, IDEAL_WIRE * largest)
        return cls(ports, tie, inverted(ports, tie).value)

    def potentials(self, source: FloatArray) -> FloatArray:
        """(..., N + M) V at the ports for sources (..., N + M) behind their ties."""
        result: FloatArray = (source * self.tie) @ self.inner
        return result

    def currents(self, potential: FloatArray, source: FloatArray) -> FloatArray:
        """(..., N + M) A into what the ports are tied to: by the tie or, where that is the stiffer, by the grid."""
        stiff = self.tie > self.ports.sum(axis=-1)
        through_tie = np.where(stiff, 0.0, self.tie) * (potential - source)
        through_grid = potential @ self.ports - potential * self.ports.sum(axis=-1)
        result: FloatArray = np.where(stiff, through_grid, through_tie)
        return result


def _terminated(design: Design, ports: FloatArray, reading: Reading) -> Iterator[_Group]:
    """Amplifiers and dividers: each column ends in a resistance and a source."""
    rows, columns = design.array.shape
    parts = Parts.of(design)
    amplified = design.readout.circuit == "inverting-amplifier"
    at_high = reading.volts >= design.readout.supply[1]
    state = np.where(reading.saturated, np.where(at_high, 1, -1), 0).astype(np.int8)
    floating = design.drive.idle_rows == "float"
    single = not amplified and design.readout.idle_columns == "float"
    patterns, pattern_of = np.unique(state, axis=0, return_inverse=True)
    for number, pattern in enumerate(patterns):
        its_rows = np.flatnonzero(pattern_of.ravel() == number)
        for some_rows in np.split(its_rows, len(its_rows)) if floating else [its_rows]:
            linear = np.flatnonzero(pattern == 0)
            for some in np.split(linear, len(linear)) if single else [linear]:
                if not len(some):
                    continue
                ends = amplifier_ends(design, pattern)
                ohms, source, slope = ends.resistance, ends.source, ends.slope
                if not amplified:
                    ohms, source, slope = parts.reference, np.zeros(columns), parts.reference
                tie = np.zeros(rows + columns)
                tie[some_rows if floating else slice(rows)] = np.inf
                tied = rows + (some if single else np.arange(columns))
                tie[tied] = siemens((ohms + parts.column_lead)[tied - rows])
                ties = _Ties.of(ports, tie)
                behind = np.zeros((len(some_rows), rows + columns))
                behind[:, rows:] = source
                behind[np.arange(len(some_rows)), some_rows] = design.drive.voltage
                forward = ties.potentials(behind)
                unit = np.zeros((len(some), rows + columns))
                unit[np.arange(len(some)), rows + some] = slope[some]
                adjoint = ties.potentials(unit)
                current = ties.currents(forward, behind)[:, None, rows:]
                adjoint_current = ties.currents(adjoint, unit)[None, :, rows:]
                chain = _amplifier_parts if amplified else _divider_parts
                yield _Group(
                    rows=some_rows,
                    columns=some,
                    forward=forward[:, None],
                    adjoint=adjoint[None],
                    lead_current=current,
                    adjoint_lead_current=adjoint_current,
                    amplifiers=chain(design, parts, pattern, some, current, adjoint_current),
                )


def _divider_parts(
    design: Design, parts: Parts, pattern: NDArray[np.int8], some: IntArray, current: FloatArray, adjoint: FloatArray
) -> dict[str, FloatArray]:
    """A load is a part of its column's end, and what turns its current into volts."""
    load = current * adjoint
    load[:, np.arange(len(some)), some] += current[:, 0, some]
    return {"reference_resistance": load}


def _amplifier_parts(
    design: Design, parts: Parts, pattern: NDArray[np.int8], some: IntArray, current: FloatArray, adjoint: FloatArray
) -> dict[str, FloatArray]:
    """Through the end of each column (:func:`._readout.amplifier_ends`), and directly in the reading's own column.

    With x = 1/A: d(1/(1+A))/dx = share^2 and d(share)/dx = -share^2.
    """
    level, linear = design.readout.reference_voltage, pattern == 0
    inverse, share = 1.0 / (1.0 + parts.gain), 1.0 / (1.0 + 1.0 / parts.gain)
    end = current * adjoint
    source = np.broadcast_to(adjoint, end.shape)
    weight = np.where(linear, inverse, 1.0)
    lift = level + parts.offset + parts.reference * parts.bias
    by_name = {
        "reference_resistance": weight * (end - source * parts.bias),
        "inverse_gain": np.where(linear, share**2 * (end * parts.reference - source * lift), 0.0),
        "offset_voltage": np.where(linear, share * source, 0.0),
        "bias_current": -weight * parts.reference * source,
    }
    own, flow = np.arange(len(some)), current[:, 0, some]
    ratio, reference = share[some], parts.reference[some]
    by_name["reference_resistance"][:, own, some] += ratio * (parts.bias[some] - flow)
    by_name["inverse_gain"][:, own, some] -= ratio**2 * (lift[some] - reference * flow)
    by_name["offset_voltage"][:, own, some] += ratio
    by_name["bias_current"][:, own, some] += ratio * reference
    return by_name


def _feedback(design: Design, ports: FloatArray, reading: Reading) -> Iterator[_Group]:
    """The follower's circuit: the sensed column's potential V is the one unknown (:func:`._readout.read`).

    Its equation's derivative by a conductance is that of the current into a column held at V while the idle lines are
    held at F; its derivative by V itself is D.
    """
    rows, columns = design.array.shape
    parts, level, drive = Parts.of(design), design.readout.reference_voltage, design.drive.voltage
    ties = _Ties.of(ports, np.concatenate([np.full(rows, np.inf), siemens(parts.column_lead)]))
    inverse, share = 1.0 / (1.0 + parts.gain), 1.0 / (1.0 + 1.0 / parts.gain)
    column = reading.volts / share - level - parts.offset
    follower = reading.volts - level
    behind = np.repeat(follower[..., None], rows + columns, axis=-1)
    every_row, every_column = np.arange(rows), np.arange(columns)
    behind[every_row, :, every_row] = drive
    behind[:, every_column, rows + every_column] = column
    forward = ties.potentials(behind)
    unit = np.zeros((columns, rows + columns))
    unit[every_column, rows + every_column] = 1.0
    field = ties.potentials(unit)
    back = ties.currents(field, unit)  # at the column itself: less than nothing flows in
    driven = ties.currents(field, unit)[:, :rows].T  # Y from the selected row to the sensed column
    idle = -back[every_column, rows + every_column] - driven
    slope = driven + idle * inverse + siemens(parts.reference)
    gain = np.where(reading.saturated, 0.0, share / slope)
    own = {name: np.zeros((rows, columns, columns)) for name in ("reference_resistance", "inverse_gain")}
    own |= {name: np.zeros((rows, columns, columns)) for name in ("offset_voltage", "bias_current")}
    live = np.where(reading.saturated, 0.0, 1.0)
    at = (slice(None), every_column, every_column)
    above = level + column + parts.offset
    own["reference_resistance"][at] = gain * column / parts.reference**2
    own["bias_current"][at] = -gain
    own["offset_voltage"][at] = gain * idle * share + live * share
    own["inverse_gain"][at] = -(gain * idle + live) * share**2 * above
    yield _Group(
        rows=every_row,
        columns=every_column,
        forward=forward,
        adjoint=gain[..., None] * field,
        lead_current=ties.currents(forward, behind)[..., rows:],
        adjoint_lead_current=gain[..., None] * back[:, rows:],
        amplifiers=own,
    )
