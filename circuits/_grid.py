"""Kron reduction of a board's passive grid, from the row drivers to the column leads, to its ports."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..errors import SolverError
from . import _sheet as sheet
from ._board import Board
from ._parts import at_any
from .solvers import LEAST_OHM, Element, Network, Rounded, port_conductances, reduce, siemens


def exact_ports(board: Board, cells: FloatArray) -> Rounded:
    """Port conductances (..., P, P) in S of the board's grid, row leads included, with their rounding bound.

    The ports are N row terminals, the reference if rows have pull-downs, and M column terminals.

    Args:
        board: the lines and their faults.
        cells: (..., N, M) ohm, in line coordinates.

    Raises:
        SolverError: parts of no resistance join sources that contradict each other.

    """
    refuse_contradictions(board, cells)
    if board.plain:
        return port_conductances(board.cell_conductance(cells), board.lines)
    return reduce(grid_network(board, cells))


def grid_network(board: Board, cells: FloatArray) -> Network:
    """All nodes and branches. Nodes: N row terminals, then the row lines' crosspoints (row by row), then the column
    lines', then the faces between the cells of a continuous sheet. Branches: row lines, column lines (from row 1), the
    cells of a sliced sheet, bridges. Ports: row terminals, then the column lines' last crosspoints. Pull-downs are one
    more column, ahead of the others.
    """
    rows, columns = board.lines.row.shape[-2:]
    ahead_of_cells = int(board.pulled)
    batch = cells.shape[:-2]
    row_node = rows + np.arange(rows * columns).reshape(rows, columns)
    column_node = row_node + rows * columns
    line = board.lines
    ahead = np.column_stack([np.arange(rows), row_node[:, :-1]])
    ends = [np.stack([ahead, row_node], axis=-1), np.stack([column_node[:-1], column_node[1:]], axis=-1)]
    along = line.row, line.column[..., 1:, :]
    values = [np.broadcast_to(part, (*batch, *part.shape[-2:])) for part in along]
    row_at, column_at = np.indices((rows, columns)).reshape(2, -1)
    crosspoints = np.column_stack([row_at, column_at]).astype(np.float64)
    terminals = np.column_stack([np.arange(rows), np.full(rows, -1)]).astype(np.float64)
    place = [terminals, crosspoints, crosspoints]
    elements: tuple[Element, ...] = ()
    if not board.continuous:
        ends.append(np.stack([row_node, column_node], axis=-1))
        values.append(board.cell_conductance(cells))
    else:
        cells = cells + board.series_ohms
        of_sheet = row_node[:, ahead_of_cells:], column_node[:, ahead_of_cells:]
        faces, elements = sheet.pieces(board.sheet, cells, *of_sheet, rows + 2 * rows * columns)
        place.append(faces)
        if board.pulled:
            ends.append(np.stack([row_node[:, 0], column_node[:, 0]], axis=-1))
            values.append(np.full((*batch, rows), 1.0 / board.pull))
    extra = board.bridges + (board.shorts if board.continuous else ())
    for fault in extra:
        of_row, of_column = row_node[:, ahead_of_cells:], column_node[:, ahead_of_cells:]
        first, second = (
            (of_row[fault.place], of_column[fault.place])
            if fault.kind == "shorted-cell"
            else ((of_row if fault.kind == "bridged-rows" else of_column)[end] for end in fault.ends)
        )
        ends.append(np.array([[first, second]]))
        values.append(np.full((*batch, 1), siemens(fault.ohms)))
    wires = rows * columns + (rows - 1) * columns
    flat = np.concatenate([value.reshape(*batch, -1) for value in values], axis=-1)
    return Network(
        place=np.concatenate(place),
        ends=np.concatenate([end.reshape(-1, 2) for end in ends]),
        conductance=flat,
        wire=np.arange(flat.shape[-1]) < wires,
        ports=np.concatenate([np.arange(rows), column_node[-1]]),
        elements=elements,
    )


def refuse_contradictions(board: Board, cells: FloatArray) -> BoolArray | None:
    """Raise SolverError where parts of 0 ohm connect ideal sources that contradict each other.

    The circuit defines its ideal sources, and which of them contradict each other
    (:meth:`.ReadoutCircuit.contradiction`).

    Args:
        board: the lines and their faults.
        cells: (..., N, M) ohm; a cell that is a short in any frame counts as a short in all frames.

    Returns:
        (..., N, M) outputs that parts of 0 ohm leave undetermined; None if there are none.

    """
    if cells.min() > LEAST_OHM and not any(fault.ohms <= LEAST_OHM for fault in board.faults):
        return None
    rows, columns = board.shape
    network = grid_network(replace(board, continuous=False), cells)
    island = islands(network, np.isinf(network.conductance))[network.ports]
    apart = len(network.place) + np.arange(columns)  # behind what is no ideal source
    drivers, ends = island[:rows], np.where(at_any(board.circuit.ideal_inputs(board), 1), island[-columns:], apart)
    found = board.circuit.contradiction(board, drivers, ends)
    if found is not None:
        raise SolverError(
            f"{found.what} are joined by parts of 0 ohm; give what joins them, or {found.remedy}, a resistance"
        )
    undetermined = board.circuit.undetermined(board, drivers, ends)
    if undetermined is None:
        return None
    frames = np.asarray(np.isinf(board.cell_conductance(cells)).any(axis=(-2, -1)))
    some = np.asarray(frames | bool(board.bridges))
    return np.asarray(some[..., None, None] & undetermined)


def islands(network: Network, joining: BoolArray) -> IntArray:
    """(nodes,) number of the island of each node: a set of nodes that some branches (..., branches) join."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    a, b = network.ends[at_any(joining, 1)].T
    links = coo_array((np.ones(len(a)), (a, b)), shape=(len(network.place),) * 2)
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.intp)
