"""A design's whole passive grid between its row drivers and its column leads, reduced to the ports."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import DisjointSet

from ..errors import SolverError
from . import sheet
from .design import Design
from .network import Network, reduce
from .parts import Parts, cell_conductance, line_ohms, lines, series_faults, siemens
from .ports import port_conductances

FloatArray = NDArray[np.float64]


def is_plain(design: Design) -> bool:
    """Whether the grid is nothing but cells between lines, so that the fast solvers may be used."""
    return design.array.sheet == "sliced" and not any(fault.bridge for fault in design.fault)


def exact_ports(design: Design, resistance: FloatArray) -> FloatArray:
    """Port conductances (..., N + M, N + M) in S of the design's grid, row leads included.

    Args:
        design: the array and its faults.
        resistance: (..., rows, columns) ohm.

    Raises:
        SolverError: bridged lines of no resistance leave it open what is read.

    """
    if is_plain(design):
        return port_conductances(cell_conductance(design, resistance), lines(design))
    _refuse_undetermined(design)
    return reduce(grid_network(design, resistance))


def grid_network(design: Design, resistance: FloatArray) -> Network:
    """All nodes and branches. Nodes: N row terminals, then the row lines' crosspoints (row by row), then the column
    lines', then the boxes of a continuous sheet. Branches: row lines, column lines (from row 1), cells or boxes,
    bridges. Ports: row terminals, then the column lines' last crosspoints.
    """
    rows, columns = design.array.shape
    batch = resistance.shape[:-2]
    row_node = rows + np.arange(rows * columns).reshape(rows, columns)
    column_node = row_node + rows * columns
    line = lines(design)
    ahead = np.column_stack([np.arange(rows), row_node[:, :-1]])
    ends = [np.stack([ahead, row_node], axis=-1), np.stack([column_node[:-1], column_node[1:]], axis=-1)]
    values = [np.broadcast_to(part, (*batch, *part.shape)) for part in (line.row, line.column[1:])]
    row_at, column_at = np.indices((rows, columns)).reshape(2, -1)
    crosspoints = np.column_stack([row_at, column_at]).astype(np.float64)
    terminals = np.column_stack([np.arange(rows), np.full(rows, -1)]).astype(np.float64)
    place = [terminals, crosspoints, crosspoints]
    conductance = cell_conductance(design, resistance)
    if design.array.sheet == "sliced":
        ends.append(np.stack([row_node, column_node], axis=-1))
        values.append(conductance)
    else:
        resistivity = (resistance + series_faults(design, "open-cell")) / sheet.unit_resistance(design.sheet)
        boxes, box_ends, box_values = sheet.branches(
            design.sheet, resistivity, row_node, column_node, rows + 2 * rows * columns
        )
        place.append(boxes)
        ends.append(box_ends)
        values.append(box_values)
    extra = [fault for fault in design.fault if fault.bridge]
    if design.array.sheet == "continuous":
        extra += [fault for fault in design.fault if fault.kind == "shorted-cell"]
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
    )


def _refuse_undetermined(design: Design) -> None:
    """Two drivers, or two ideal amplifiers, joined by nothing but parts of 0 ohm contradict each other."""
    parts = Parts.of(design)
    row, column = line_ohms(design)
    rows, columns = design.array.shape
    joined: DisjointSet = DisjointSet()
    for i in range(rows):
        for j in range(columns):
            for node in (("drive", i, 0), ("end", 0, j), ("row", i, j), ("column", i, j)):
                joined.add(node)
    for i in range(rows):
        for j in range(columns):
            if row[i, j] == 0:
                joined.merge(("row", i, j - 1) if j else ("drive", i, 0), ("row", i, j))
            if i and column[i, j] == 0:
                joined.merge(("column", i - 1, j), ("column", i, j))
    ideal = np.isinf(parts.gain) & (design.readout.circuit == "inverting-amplifier")
    for j in np.flatnonzero((parts.column_lead == 0) & ideal).tolist():
        joined.merge(("column", rows - 1, j), ("end", 0, j))
    for fault in design.fault:
        if fault.bridge and fault.ohms == 0:
            line = "row" if fault.kind == "bridged-rows" else "column"
            first, second = ((line, *end) for end in fault.ends)
            joined.merge(first, second)
    for kind, remedy in (
        ("drive", "array.row_lead"),
        ("end", "array.column_lead, or readout.open_loop_gain a finite value"),
    ):
        roots: dict[object, int] = {}
        for line_number in range(rows if kind == "drive" else columns):
            node = (kind, line_number, 0) if kind == "drive" else (kind, 0, line_number)
            other = roots.setdefault(joined[node], line_number)
            if other != line_number:
                what = "row drivers" if kind == "drive" else "ideal amplifiers of columns"
                raise SolverError(
                    f"the {what} {other} and {line_number} are joined by parts of 0 ohm; "
                    f"give the bridge (fault.resistance) or {remedy} a resistance"
                )
