"""A board's passive grid between its row drivers and its column leads, reduced to its ports (Kron reduction)."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ..arrays import FloatArray
from ..errors import SolverError
from . import _sheet as sheet
from ._board import Board
from .solvers import Element, Network, Rounded, port_conductances, reduce, siemens


def exact_ports(board: Board, cells: FloatArray) -> Rounded:
    """Port conductances (..., N + M, N + M) in S of the board's grid, row leads included, and their relative error.

    Args:
        board: the lines and their faults.
        cells: (..., N, M) ohm, in line coordinates.

    Raises:
        SolverError: parts of no resistance join sources that contradict each other.

    """
    if board.plain:
        if (cells == 0).any():
            refuse_contradictions(board, cells)
        return port_conductances(board.cell_conductance(cells), board.lines)
    refuse_contradictions(board, cells)
    return reduce(grid_network(board, cells))


def grid_network(board: Board, cells: FloatArray) -> Network:
    """All nodes and branches. Nodes: N row terminals, then the row lines' crosspoints (row by row), then the column
    lines', then the faces between the cells of a continuous sheet. Branches: row lines, column lines (from row 1), the
    cells of a sliced sheet, bridges. Ports: row terminals, then the column lines' last crosspoints.
    """
    rows, columns = board.shape
    batch = cells.shape[:-2]
    row_node = rows + np.arange(rows * columns).reshape(rows, columns)
    column_node = row_node + rows * columns
    line = board.lines
    ahead = np.column_stack([np.arange(rows), row_node[:, :-1]])
    ends = [np.stack([ahead, row_node], axis=-1), np.stack([column_node[:-1], column_node[1:]], axis=-1)]
    values = [np.broadcast_to(part, (*batch, *part.shape)) for part in (line.row, line.column[1:])]
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
        faces, elements = sheet.pieces(board.sheet, cells, row_node, column_node, rows + 2 * rows * columns)
        place.append(faces)
    extra = board.bridges + (board.shorts if board.continuous else ())
    for fault in extra:
        first, second = (
            (row_node[fault.place], column_node[fault.place])
            if fault.kind == "shorted-cell"
            else ((row_node if fault.kind == "bridged-rows" else column_node)[end] for end in fault.ends)
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


def refuse_contradictions(board: Board, cells: FloatArray) -> None:
    """Raise SolverError where parts of 0 ohm alone join two row drivers, or two ideal amplifiers, with each other.

    Such sources contradict each other, or leave it open how they share a current. Floating idle rows have no drivers.
    One driver joined with one ideal amplifier is not refused: its reading is infinite.

    Args:
        board: the lines and their faults.
        cells: (..., N, M) ohm; a cell shorted in any frame counts as shorted.

    """
    row, column = board.row_ohms, board.column_ohms
    rows, columns = board.shape
    drivers, ends = np.arange(rows), rows + np.arange(columns)
    on_row = rows + columns + np.arange(rows * columns).reshape(rows, columns)
    on_column = on_row + rows * columns
    ideal = board.circuit.ideal_inputs(board)
    joints = [
        (np.column_stack([drivers, on_row[:, :-1]])[row == 0], on_row[row == 0]),
        (on_column[:-1][column[1:] == 0], on_column[1:][column[1:] == 0]),
        (on_column[-1][ideal], ends[ideal]),
    ]
    shorted = (cells == 0).any(axis=tuple(range(cells.ndim - 2)))
    for fault in board.faults:
        if fault.kind == "open-cell" and fault.ohms > 0:
            shorted[fault.place] = False
    for fault in board.faults:
        if fault.kind == "shorted-cell" and fault.ohms == 0:
            shorted[fault.place] = True
        elif fault.bridge and fault.ohms == 0:
            line = on_row if fault.kind == "bridged-rows" else on_column
            here, there = fault.ends
            joints.append((np.array([line[here]]), np.array([line[there]])))
    joints.append((on_row[shorted], on_column[shorted]))
    first_nodes, second_nodes = (np.concatenate(side) for side in zip(*joints, strict=True))
    size = rows + columns + 2 * rows * columns
    links = coo_array((np.ones(len(first_nodes)), (first_nodes, second_nodes)), shape=(size, size))
    _, island = connected_components(links, directed=False)
    driven = drivers[:1] if board.floating else drivers
    of_rows, of_columns = board.line_kinds
    for what, nodes, number, remedy in (
        (f"{of_rows} drivers", driven, board.driven_line, f"array.{of_rows}_lead"),
        (
            f"ideal amplifiers of {of_columns}s",
            ends,
            board.sensed_line,
            f"array.{of_columns}_lead, or readout.open_loop_gain a finite value",
        ),
    ):
        _, first, count = np.unique(island[nodes], return_index=True, return_counts=True)
        if (count > 1).any():
            one = int(first[count > 1][0])
            other = int(np.flatnonzero(island[nodes] == island[nodes[one]])[1])
            low, high = sorted((number(one), number(other)))
            raise SolverError(
                f"the {what} {low} and {high} are joined by parts of 0 ohm; "
                f"give what joins them, or {remedy}, a resistance"
            )
