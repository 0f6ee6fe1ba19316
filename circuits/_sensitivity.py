"""d(reading)/d(every part) by the adjoint: no re-solve per part.

In a resistive network a part's drop in the *forward* field (the scan step as it is) times its drop in the *adjoint*
field (the step's sources off, a unit source where the reading is taken) is, up to sign, the derivative of the reading
by the part's conductance (Tellegen; Director and Rohrer 1969). Forward and adjoint fields of all readings are
combinations of N + M fields, one for each port of the grid at 1 V; those are solved for once, by one sparse
factorisation. Parts in series with a line go by their current instead, which the cells' currents add up to, so that
a line without resistance has its sensitivities too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from ..arrays import BoolArray, FloatArray
from ..errors import InputError, SolverError
from ._board import Board
from ._design import Design
from ._grid import exact_ports, grid_network
from .readouts import SensitivityGroup
from .solvers import Network, reduce, siemens

LARGEST = 64 * 64
"""cells for which all readings' derivatives by all parts fit into memory (0.13 GB per kind of part)"""
_SHORT = 1e8  # conductance of a shorted cell, relative to the largest other one


@dataclass(frozen=True)
class Sensitivity:
    """Derivatives of the output volts. The first two axes are the reading's (N, M), the last ones the part's."""

    volts: FloatArray
    """the readings themselves, (N, M) V"""
    conductance: FloatArray
    """(N, M) S of the cells, without what a fault puts across them; shorted ones stand for very small resistances"""
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
    """(N, M, M) V/ohm; here and below the last axis counts the sensed lines: columns, or rows where those are sensed"""
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
    board = design.board
    found = board_sensitivity(board, board.turn(design.resistance(resistance)))
    return _turned_back(found) if board.turned else found


def board_sensitivity(board: Board, cells: FloatArray) -> Sensitivity:
    """:func:`sensitivity` in line coordinates, for checked cells (N, M) in ohm."""
    if board.continuous:
        raise InputError('sensitivities are for array.sheet = "sliced", not "continuous"')
    if cells.size > LARGEST:
        raise InputError(f"sensitivities are for at most {LARGEST} cells, the design has {cells.size}")
    ports = exact_ports(board, cells).value
    reading = board.circuit.read(board, ports)
    network = grid_network(board, cells)
    shorts = ~np.isfinite(network.conductance) & ~network.wire
    if shorts.any():
        joined = _joins_ports(network, shorts)
        network = _with_small_resistances(board, network, shorts)
        if joined:  # the current through the short is the difference of two ports' potentials, which must not vanish
            ports = reduce(network).value
    fields = _Fields.of(board, cells, network)
    result = _empty(reading.volts, fields.conductance)
    for group in board.circuit.sensitivity_groups(board, ports, reading):
        _collect(result, fields, group)
    return result


def _turned_back(found: Sensitivity) -> Sensitivity:
    """From the line coordinates of a board that senses rows to the array's rows and columns."""

    def by_reading(values: FloatArray) -> FloatArray:
        return values.swapaxes(0, 1)[::-1, ::-1]

    def by_line(values: FloatArray) -> FloatArray:
        return by_reading(values)[..., ::-1]

    def by_place(values: FloatArray) -> FloatArray:
        return by_reading(values).swapaxes(-1, -2)[..., ::-1, ::-1]

    return Sensitivity(
        volts=by_reading(found.volts),
        conductance=by_reading(found.conductance),
        cell_conductance=by_place(found.cell_conductance),
        row_lead=by_line(found.column_lead),
        row_segment=by_place(found.column_segment),
        column_lead=by_line(found.row_lead),
        column_segment=by_place(found.row_segment),
        reference_resistance=by_line(found.reference_resistance),
        inverse_gain=by_line(found.inverse_gain),
        offset_voltage=by_line(found.offset_voltage),
        bias_current=by_line(found.bias_current),
    )


def _joins_ports(network: Network, shorts: BoolArray) -> bool:
    """Whether ideal lines and shorts alone connect two ports."""
    a, b = network.ends[shorts | np.isinf(network.conductance)].T
    size = len(network.place)
    links = coo_array((np.ones(len(a)), (a, b)), shape=(size, size))
    _, island = connected_components(links, directed=False)
    return len(np.unique(island[network.ports])) < len(network.ports)


def _with_small_resistances(board: Board, network: Network, shorts: BoolArray) -> Network:
    """The network with very small resistances in place of ``shorts`` (branches,), which are no ideal lines.

    The current through a short is the drop across it times its conductance. A short of 1e8 times the largest other
    conductance moves a reading by 1e-8 or so, and leaves enough digits of its drop for four of a derivative.
    """
    behind = siemens(board.column_lead + board.circuit.end_resistance(board))
    others = np.concatenate([network.conductance, behind])
    short = _SHORT * float(others[np.isfinite(others)].max(initial=0.0)) or 1.0
    return replace(network, conductance=np.where(shorts, short, network.conductance))


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
    def of(cls, board: Board, cells: FloatArray, network: Network) -> _Fields:
        """``network`` is the board's with these cells, and without shorts."""
        rows, columns = cells.shape
        cell_at = rows * columns + (rows - 1) * columns
        conductance = network.conductance
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
        for bridge, fault in enumerate(board.bridges, start=cells.size):
            here, there = fault.ends
            if fault.kind == "bridged-rows":
                leaving[:, *here] += current[:, bridge]
                leaving[:, *there] -= current[:, bridge]
            else:
                entering[:, *here] -= current[:, bridge]
                entering[:, *there] += current[:, bridge]
        across = siemens_at[ours].reshape(rows, columns)
        own = np.minimum(siemens(cells + board.series_ohms), across)  # a fault across a cell is no part of it
        return cls(drops[:, ours].reshape(-1, rows, columns), own, leaving, entering)


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


def _collect(result: Sensitivity, fields: _Fields, group: SensitivityGroup) -> None:
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
    for name, values in group.own_parts.items():
        getattr(result, name)[at] = values
