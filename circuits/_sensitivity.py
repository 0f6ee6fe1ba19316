"""Adjoint method: the derivatives of all readings by all parts of the board.

Principle
---------
Two fields belong to a reading. The forward field has the sources of its scan step. The adjoint field has these sources
off and a unit source at the output where the reading is taken. The derivative of the reading by the conductance of a
part is, up to its sign, the voltage across the part in the forward field times the voltage across the part in the
adjoint field (Tellegen's theorem; Director and Rohrer, "The generalized adjoint network and network sensitivities",
1969). No part needs a solution of its own.

Implementation
--------------
The forward and adjoint fields of all readings are linear combinations of N + M basis fields. In a basis field one port
of the grid is at 1 V and all other ports are at 0 V. One LU factorisation gives all basis fields: a sparse one, or on a
small grid a dense one.

Parts in series with a line use the product of their currents instead of their voltages. The current of a line follows
from the sum of its cells' currents. The derivatives thus exist for lines of zero resistance as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..errors import InputError, SolverError
from ._board import Board
from ._design import Design
from ._grid import exact_ports, grid_network, islands
from ._parts import at_any, of_columns
from ._tuning import FEW_NODES, SHORT
from .readouts import Reading, SensitivityGroup
from .solvers import Network, reduce, siemens

LARGEST = 64 * 64
"""Largest number of cells: the derivatives then need 0.13 GB of memory per kind of part."""
_TOO_MANY_DECADES = (
    "the grid's parts span too many decades for sensitivities; give the smallest resistances as 0, "
    "or the largest as inf"
)
_CROSSING = ("row", "column"), ("column", "row")


@dataclass(frozen=True)
class Sensitivity:
    """Derivatives of the output volts.

    The first two axes (N, M) are those of the reading, and the remaining axes are those of the part.
    """

    volts: FloatArray
    """the readings themselves, (N, M) V"""
    conductance: FloatArray
    """(N, M) S of the cells without faults in parallel; a shorted cell has a very large finite conductance"""
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
    """(N, M, M) V/ohm; the last axis, here and below, counts the sensed lines, which are the columns or the rows"""
    inverse_gain: FloatArray
    """(N, M, M) V per unit of 1 / open_loop_gain, which is 0 for an ideal amplifier"""
    offset_voltage: FloatArray
    """(N, M, M) V/V"""
    bias_current: FloatArray
    """(N, M, M) V/A"""

    @property
    def cells(self) -> FloatArray:
        """(N, M, N, M) V/ohm: derivatives by the resistances of the cells."""
        return -self.cell_conductance * self.conductance**2


def sensitivity(design: Design, resistance: ArrayLike) -> Sensitivity:
    """Derivatives of all readings of a frame by all parts.

    An output at a supply limit has zero derivatives. The derivatives of the other outputs hold while this output stays
    at its limit.

    Args:
        design: with a sliced sheet, of at most 64 x 64 cells.
        resistance: (rows, columns) ohm.

    Raises:
        InputError: the cells do not fit, the sheet is continuous or the array too large.
        SolverError: the values of the parts span so many decades that the factorisation breaks down.

    """
    board = design.board
    found = board_sensitivity(board, board.transpose(design.resistance(resistance)))
    return _transposed_back(found) if board.transposed else found


def board_sensitivity(board: Board, cells: FloatArray) -> Sensitivity:
    """:func:`sensitivity` in line coordinates, for checked cells (N, M) in ohm."""
    solved = solve_fields(board, cells)
    reading, fields = solved.reading, solved.fields
    result = _empty(reading.volts, fields.conductance)
    for group in solved.groups():
        _write_derivatives(result, fields, group)
    return result


class SolvedFields(NamedTuple):
    """The readings of a frame with the basis fields that all their fields are made of."""

    board: Board
    ports: FloatArray
    """(P, P) S"""
    reading: Reading
    fields: BasisFields

    def groups(self) -> Iterator[SensitivityGroup]:
        """Forward and adjoint fields of all readings."""
        return self.board.circuit.sensitivity_groups(self.board, self.ports, self.reading)


def solve_fields(board: Board, cells: FloatArray) -> SolvedFields:
    """Solve a checked frame (N, M) in ohm in line coordinates, or one of each board of a stack.

    Raises:
        InputError, SolverError: as :func:`sensitivity`.

    """
    if board.continuous:
        raise InputError('sensitivities are for array.sheet = "sliced", not "continuous"')
    if (size := cells.shape[-2] * cells.shape[-1]) > LARGEST:
        raise InputError(f"sensitivities are for at most {LARGEST} cells, the design has {size}")
    ports = exact_ports(board, cells).value
    reading = board.circuit.read(board, ports)
    network = grid_network(board, cells)
    shorts = np.isinf(network.conductance)
    shorts &= ~(network.wire & shorts.all(axis=tuple(range(shorts.ndim - 1))))  # a wire of some boards is a part
    if shorts.any():
        at_ports = islands(network, np.isinf(network.conductance))[network.ports]
        network = _with_small_resistances(board, network, shorts)
        if len(np.unique(at_ports)) < len(at_ports):  # a short between two needs a voltage, which gives its current
            ports = reduce(network).value
    return SolvedFields(board, ports, reading, BasisFields.of(board, cells, network))


def _transposed_back(found: Sensitivity) -> Sensitivity:
    """Convert line coordinates to rows and columns of the array, on a board that senses rows."""

    def transposed(values: FloatArray) -> FloatArray:
        own = values.swapaxes(0, 1)[::-1, ::-1]
        if values.ndim == 4:
            return own.swapaxes(2, 3)[:, :, ::-1, ::-1]
        return own[..., ::-1] if values.ndim == 3 else own

    other = {f"{line}_{part}": f"{across}_{part}" for part in ("lead", "segment") for line, across in _CROSSING}
    return Sensitivity(
        **{each.name: transposed(getattr(found, other.get(each.name, each.name))) for each in fields(found)}
    )


def _with_small_resistances(board: Board, network: Network, shorts: BoolArray) -> Network:
    """Replace the branches ``shorts`` (branches,) by very small resistances; ideal lines stay ideal.

    The current through a short is then the voltage across it times its conductance.
    """
    behind = siemens(of_columns(board.column_lead + board.circuit.end_resistance(board)))
    largest = (
        np.max(values, axis=-1, keepdims=True, where=np.isfinite(values), initial=0.0)
        for values in (network.conductance, behind)
    )
    short = np.maximum(SHORT * np.maximum(*largest), 1e-300)
    return replace(network, conductance=np.where(shorts, short, network.conductance))


def basis_drops(board: Board, cells: FloatArray) -> FloatArray:
    """Voltages (ports, N, M) across the cells while one port of the grid is at 1 V and all other ports are at 0 V.

    Args:
        board: with a sliced sheet.
        cells: (N, M) ohm, none of them a short.

    """
    return BasisFields.of(board, cells, grid_network(board, cells)).drops


class BasisFields(NamedTuple):
    """Basis fields: one port of the grid at 1 V and all other ports at 0 V."""

    drops: FloatArray
    """(..., ports, N, M) V: voltage across each cell, from row to column"""
    conductance: FloatArray
    """(..., N, M) S"""
    leaving_row: FloatArray
    """(..., ports, N, M) A: current out of each crosspoint of a row line into its cell and bridges; with pull-downs one
    more crosspoint ahead of the cells"""
    entering_column: FloatArray
    """(..., ports, N, M) A: current into each crosspoint of a column line from its cell and bridges"""

    @classmethod
    def of(cls, board: Board, cells: FloatArray, network: Network) -> BasisFields:
        """Solve for the basis fields of ``network``, which is the board's grid with these cells and no shorts."""
        rows, columns = board.lines.row.shape[-2:]
        ahead_of_cells = columns - cells.shape[-1]
        cell_at = rows * columns + (rows - 1) * columns
        conductance = network.conductance
        wired = at_any(np.isinf(conductance), 1)
        node = islands(network, wired)  # the ends of an ideal wire are the same node
        a, b = node[network.ends[~wired]].T
        potential = _potentials(
            a, b, conductance[..., ~wired], node[network.ports].astype(np.intp), int(node.max()) + 1
        )
        first, second = np.moveaxis(np.moveaxis(potential[..., node[network.ends[cell_at:]], :], -1, -3), -1, 0)
        drops, siemens_at = first - second, conductance[..., None, cell_at:]
        ours = slice(rows * columns)
        current = drops * siemens_at
        places = (*current.shape[:-1], rows, columns)
        leaving = current[..., ours].reshape(places).copy()
        entering = leaving.copy()
        for bridge, fault in enumerate(board.bridges, start=rows * columns):
            here, there = ((..., row, column + ahead_of_cells) for row, column in fault.ends)
            if fault.kind == "bridged-rows":
                leaving[here] += current[..., bridge]
                leaving[there] -= current[..., bridge]
            else:
                entering[here] -= current[..., bridge]
                entering[there] += current[..., bridge]
        across = siemens_at[..., 0, ours].reshape(*cells.shape[:-1], columns)[..., ahead_of_cells:]
        own = np.minimum(siemens(cells + board.series_ohms), across)  # without faults in parallel
        of_cells = drops[..., ours].reshape(places)[..., ahead_of_cells:]
        return cls(of_cells, own, leaving, entering[..., ahead_of_cells:])


def of_readings(field: FloatArray, basis: FloatArray) -> FloatArray:
    """(..., R, C, N, M) of the fields (..., R, C, ports) of readings, by basis fields (..., ports, N, M)."""
    flat = basis.reshape(*basis.shape[:-2], -1)
    found = field.reshape(*field.shape[:-3], -1, field.shape[-1]) @ flat
    return found.reshape(*found.shape[:-2], *field.shape[-3:-1], *basis.shape[-2:])


def _potentials(a: IntArray, b: IntArray, value: FloatArray, port: IntArray, size: int) -> FloatArray:
    """Potentials (..., size, ports) of all nodes while one port after the other is at 1 V and all others are at 0 V.

    Args:
        a: one end of each branch, a node.
        b: its other end.
        value: (..., branches) its conductance in S.
        port: the nodes of the ports.
        size: number of nodes.

    Raises:
        SolverError: the factorisation breaks down.

    """
    felt = np.where(value > 0.0, value, np.nan)
    spanned = 10.0 * np.nanmax(felt, initial=0.0) / np.nanmin(felt, initial=np.inf)  # with a digit to spare
    few = size <= FEW_NODES and spanned <= SHORT
    potential = _dense_potentials(a, b, value, port, size) if few else None
    if potential is not None:
        return potential
    each = [_sparse_potentials(a, b, own, port, size) for own in value.reshape(-1, value.shape[-1])]
    return np.stack(each).reshape(*value.shape[:-1], size, len(port))


def _dense_potentials(a: IntArray, b: IntArray, value: FloatArray, port: IntArray, size: int) -> FloatArray | None:
    """As :func:`_potentials`, with dense matrices for few nodes; None if some node is connected to no port.

    On a small grid a single operation on a sparse matrix takes as long as this whole function.
    """
    graph = np.zeros((*value.shape[:-1], size, size))
    for here, there, siemens_of in zip(a.tolist(), b.tolist(), np.moveaxis(value, -1, 0), strict=True):
        graph[..., here, there] += siemens_of
    graph += np.swapaxes(graph, -1, -2)
    linked = np.asarray((graph > 0.0).all(axis=tuple(range(graph.ndim - 2))))
    reached = np.zeros(size, dtype=np.bool_)
    reached[port] = True
    count = 0
    while count < (count := int(np.count_nonzero(reached))):
        reached |= linked[:, reached].any(axis=1)
    if count < size:
        return None
    inner = np.setdiff1d(np.arange(size), port)
    potential = np.zeros((*value.shape[:-1], size, len(port)))
    potential[..., port, np.arange(len(port))] = 1.0
    matrix = -graph
    every = np.arange(size)
    matrix[..., every, every] += graph.sum(axis=-1)
    try:
        potential[..., inner, :] = np.linalg.solve(matrix[..., inner[:, None], inner], graph[..., inner[:, None], port])
    except np.linalg.LinAlgError as error:
        raise SolverError(_TOO_MANY_DECADES) from error
    return potential


def _sparse_potentials(a: IntArray, b: IntArray, value: FloatArray, port: IntArray, size: int) -> FloatArray:
    """As :func:`_potentials` of one network, by sparse factorisation."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.sparse.linalg import splu

    graph = coo_array((value, (a, b)), shape=(size, size)).tocsr()
    graph = graph + graph.T
    graph.eliminate_zeros()  # zero entries would count as connections
    inner = np.setdiff1d(np.arange(size), port)
    potential = np.zeros((size, len(port)))
    potential[port, np.arange(len(port))] = 1.0
    if not len(inner):
        return potential
    # The potential of an island without a port is undetermined and would make the matrix singular. We tie
    # one of its nodes to ground by 1 S, which sets the potential to 0.
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
    except RuntimeError as error:  # SuperLU reports a singular matrix like this
        raise SolverError(_TOO_MANY_DECADES) from error
    potential[inner] = factor.solve(graph[inner][:, port].toarray())
    return potential


def _empty(volts: FloatArray, conductance: FloatArray) -> Sensitivity:
    """All derivatives 0, for :func:`_write_derivatives` to fill."""
    rows, columns = volts.shape
    places = {"cell_conductance": (rows, columns), "row_lead": (rows,)}
    places |= {"row_segment": (rows, columns - 1), "column_segment": (rows - 1, columns)}
    kinds = [each.name for each in fields(Sensitivity)[2:]]
    zeros = {name: np.zeros((rows, columns, *places.get(name, (columns,)))) for name in kinds}
    return Sensitivity(volts, conductance, **zeros)


def _write_derivatives(result: Sensitivity, fields: BasisFields, group: SensitivityGroup) -> None:
    """Write the derivatives of one group of readings into ``result``."""
    at = np.ix_(group.rows, group.columns)
    forward = of_readings(group.forward, fields.drops)
    adjoint = of_readings(group.adjoint, fields.drops)
    result.cell_conductance[at] = -forward * adjoint
    # Kirchhoff's current law: a row segment carries the currents that leave the row beyond it, and a column segment
    # carries the currents that have entered the column before it.
    along, down = [], []
    for field in (group.forward, group.adjoint):
        leaving = of_readings(field, fields.leaving_row)
        along.append(np.cumsum(leaving[..., ::-1], axis=-1)[..., ::-1])
        down.append(np.cumsum(of_readings(field, fields.entering_column), axis=-2)[..., :-1, :])
    result.row_lead[at] = along[0][..., 0] * along[1][..., 0]
    segments = np.s_[..., along[0].shape[-1] - result.row_segment.shape[-1] :]
    result.row_segment[at] = along[0][segments] * along[1][segments]
    result.column_segment[at] = down[0] * down[1]
    result.column_lead[at] = group.lead_current * group.adjoint_lead_current
    for name, values in group.own_parts().items():
        getattr(result, name)[at] = values
