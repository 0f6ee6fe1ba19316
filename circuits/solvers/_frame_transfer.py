"""Line attenuation and exact port conductances of one grid, frame by frame, for live recovery.

On one small grid, array operations spend most of their time on call overhead. Both models therefore also exist as
loops over the nodes, which :mod:`ohmskin.common.compiled` turns into machine code. A loop and the array operations of
the same formula agree up to rounding, because neither subtracts.

* Line attenuation takes its profiles from ladders (:func:`.by_ladders`). Without machine code, large grids take the
  closed form instead, as in :func:`.attenuate`: its error is about 1e-7, and its cost a fraction.
* Exact port conductances of small grids come from star-mesh transformations (:func:`_star_mesh`), as machine code only.
  All others come from the array operations of :mod:`._exact` and :mod:`._ports`.
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import numpy as np

from ...common.arrays import FloatArray, read_only
from ...common.compiled import FixedRows, Rows, loop
from ._attenuation import CLOSED_FORM_LIMIT, LARGEST_IN_SINGLE, SLACK, Wires, by_ladders, closed_form
from ._elimination import ULP
from ._exact import exact_transfer
from ._ports import Lines, capped, has_ideal_lines, port_conductances, transfer_conductances

_BY_LADDERS = 256
"""cells up to which array operations take profiles from ladders"""
_LARGEST = 500_000
"""multiplications of a star-mesh solution, up to which the compiled loop is faster than array operations"""
_LARGEST_WITH_IDEAL_LINES = 100_000
"""the same for ideal lines, where array operations eliminate only one node for each line"""
_ABREAST = 8
"""rows whose ladders are solved together, since within one ladder each place waits for the quotient of the next one"""


class AttenuatedFrame(NamedTuple):
    """Line attenuation of one frame. Arrays are (N, M) in S."""

    transfer: FloatArray
    """transfer conductances"""
    error: FloatArray
    """certified bound on their error"""


class FrameTransfer:
    """Evaluates the two models of one grid."""

    def __init__(self, lines: Lines) -> None:
        """For lines with exits."""
        assert lines.exit is not None
        self._lines, self._wires = lines, Wires.of(lines)
        self._shape = rows, columns = lines.row.shape
        few, many = sorted((rows, columns))
        self.products = rows * columns * few * (2 * few + many)
        """multiplications of an exact solution by star-mesh transformations"""
        self._has_ideal_lines = has_ideal_lines(lines)
        self.is_small = self.products <= (_LARGEST_WITH_IDEAL_LINES if self._has_ideal_lines else _LARGEST)
        """whether exact solutions use star-mesh transformations, provided that there is machine code"""
        self._turned = columns > rows  # rows and columns then change places, so that a node has fewer neighbours
        self._star_mesh = _star_mesh.machine_code() if self.is_small else None
        self._attenuate = None
        self._uniform = None  # wires for the closed form of array operations; None: always by ladders
        if self._wires is not None:
            self._attenuate = _attenuate.machine_code()
            parts = self._wires.row, self._wires.column, self._wires.to_driver, self._wires.to_amplifier
            self._fixed_wires = tuple(read_only(part) for part in parts)
            if self._attenuate is None and rows * columns > _BY_LADDERS:
                self._uniform = self._wires.uniform

    @property
    def is_compiled(self) -> bool:
        """Whether exact port conductances come from machine code."""
        return self._star_mesh is not None

    def attenuated(self, conductance: FloatArray) -> AttenuatedFrame | None:
        """Line attenuation at finite cells (N, M) in S; None where a line is broken or the drive underflows on one."""
        if self._wires is None:
            return None
        if self._attenuate is None:
            return self._attenuated_by_arrays(conductance, self._wires)
        row, column, to_driver, to_amplifier = self._fixed_wires
        cells, transfer, error = np.ascontiguousarray(conductance), np.empty(self._shape), np.empty(self._shape)
        is_known = self._attenuate(cells, row, column, to_driver, to_amplifier, transfer, error)
        return AttenuatedFrame(transfer, error) if is_known else None

    def _attenuated_by_arrays(self, conductance: FloatArray, wires: Wires) -> AttenuatedFrame | None:
        """As :meth:`attenuated`, by array operations."""
        returned = inf
        if self._uniform is not None and conductance.max() <= LARGEST_IN_SINGLE:
            close, bound = closed_form(conductance, self._uniform)
            returned = float(bound)
            if returned <= CLOSED_FORM_LIMIT:
                return AttenuatedFrame(close.transfer, close.error)
        known = by_ladders(conductance[None], wires, returned=np.array([returned]))
        if not np.isfinite(known.rounded).all():
            return None
        return AttenuatedFrame(known.transfer[0], known.error[0])

    def exact(self, conductance: FloatArray) -> FloatArray:
        """Exact transfer conductances (N, M) in S of cells (N, M) in S."""
        if self._star_mesh is not None:
            return self.ports(conductance)[: len(conductance), len(conductance) :]
        if self._has_ideal_lines:  # as `exact_transfer`, without its bound, which costs half as much again
            return transfer_conductances(conductance, self._lines).value
        transfer, _ = exact_transfer(conductance, self._lines)
        return transfer

    def ports(self, conductance: FloatArray) -> FloatArray:
        """Exact port conductances (N + M, N + M) in S, rows' terminals first, of cells (N, M) in S."""
        if self._star_mesh is None:
            network, _ = port_conductances(conductance, self._lines)
            return network
        cells, row, column = capped(conductance, self._lines)
        behind = np.concatenate([column[1:][::-1], column[:1]])
        if self._turned:
            cells, row, behind = (part[::-1, ::-1].T for part in (cells, behind, row))
        cells, row, behind = (np.ascontiguousarray(part) for part in (cells, row, behind))
        network = np.zeros((sum(cells.shape),) * 2)
        self._star_mesh(cells, row, behind, network)
        return network[::-1, ::-1] if self._turned else network


@loop
def _star_mesh(cells: Rows, row: Rows, behind: Rows, network: Rows) -> None:
    """Write the port conductances of a grid, by star-mesh transformations.

    A star-mesh transformation removes one node. Each pair of its neighbours is then joined by the product of their
    conductances to the node over the sum of all conductances to the node. Nothing is subtracted, so no digits cancel,
    and an ideal wire may be a very large conductance.

    The nodes are numbered row by row of the grid; at each crosspoint the row line's node comes before the column
    line's. A node then connects to at most 2 M later nodes, to the terminals of the rows up to its own and, in the
    grid's last row, to the terminals of the columns.

    Args:
        cells: (N, M) S.
        row: (N, M) S of the wire ahead of each crosspoint, towards the row's terminal.
        behind: (N, M) S of the wire behind each crosspoint, towards the column's terminal.
        network: (N + M, N + M) zeros, written to. The diagonal has no meaning.

    """
    rows, columns = cells.shape
    width = 2 * columns
    nodes = width * rows
    last = nodes - width  # first node of the grid's last row
    ahead = np.zeros((nodes, width + 1))  # S to the node that comes so many places later
    to_row, to_column = np.zeros((nodes, rows)), np.zeros((width, columns))
    for i in range(rows):
        for j in range(columns):
            node = i * width + 2 * j
            ahead[node, 1] = cells[i, j]
            if j == 0:
                to_row[node, i] = row[i, 0]
            if j + 1 < columns:
                ahead[node, 2] += row[i, j + 1]
            if i + 1 < rows:
                ahead[node + 1, width] = behind[i, j]
            else:
                to_column[2 * j + 1, j] = behind[i, j]
    for node in range(nodes):
        seen = node // width + 1  # rows whose terminals the node can connect to
        reach = min(width, nodes - 1 - node)
        total = 0.0
        for place in range(1, reach + 1):
            total += ahead[node, place]
        for i in range(seen):
            total += to_row[node, i]
        if node >= last:
            for j in range(columns):
                total += to_column[node - last, j]
        if total == 0.0:
            continue
        for place in range(1, reach + 1):
            if ahead[node, place] == 0.0:
                continue
            share = ahead[node, place] / total
            for other in range(place + 1, reach + 1):
                ahead[node + place, other - place] += share * ahead[node, other]
            for i in range(seen):
                to_row[node + place, i] += share * to_row[node, i]
            if node >= last:
                for j in range(columns):
                    to_column[node + place - last, j] += share * to_column[node - last, j]
        for i in range(seen):
            share = to_row[node, i] / total
            for k in range(i):
                network[i, k] += share * to_row[node, k]
        if node >= last:
            for j in range(columns):
                share = to_column[node - last, j] / total
                for i in range(rows):
                    network[rows + j, i] += share * to_row[node, i]
                for k in range(j):
                    network[rows + j, rows + k] += share * to_column[node - last, k]
    for one in range(rows + columns):
        for other in range(one):
            network[other, one] = network[one, other]


@loop
def _attenuate(
    cells: Rows,
    row: FixedRows,
    column: FixedRows,
    to_driver: FixedRows,
    to_amplifier: FixedRows,
    transfer: Rows,
    error: Rows,
) -> bool:
    """Write transfer conductances and error bounds, (N, M) in S, as :func:`.by_ladders`; False if the drive underflows.

    Args:
        cells: (N, M) S.
        row: (N, M) ohm of the wire ahead of each crosspoint.
        column: (N, M) ohm of the wire behind each crosspoint.
        to_driver: (N, M) ohm from each crosspoint to the row's driver.
        to_amplifier: (N, M) ohm from each crosspoint to the column's amplifier.
        transfer: (N, M), written to.
        error: (N, M), written to.

    """
    rows, columns = cells.shape
    profile, beyond = np.empty((rows, columns)), np.empty((rows, columns))
    gain, above = np.empty((rows, columns)), np.empty((rows, columns))
    lowest = least = 1.0
    for first in range(0, rows, _ABREAST):
        after = min(first + _ABREAST, rows)
        for j in range(columns - 1, -1, -1):
            for i in range(first, after):
                rest = beyond[i, j + 1] * profile[i, j + 1] if j + 1 < columns else 0.0
                beyond[i, j] = rest + cells[i, j]
                profile[i, j] = 1.0 / (row[i, j] * beyond[i, j] + 1.0)
        for j in range(1, columns):
            for i in range(first, after):
                profile[i, j] *= profile[i, j - 1]
        for i in range(first, after):
            lowest = min(lowest, profile[i, columns - 1])
    for i in range(rows):  # all columns abreast, as they lie in memory
        for j in range(columns):
            above[i, j] = cells[i, j]
            if i > 0:
                above[i, j] += above[i - 1, j] * gain[i - 1, j]
            gain[i, j] = 1.0 / (column[i, j] * above[i, j] + 1.0)
    for i in range(rows - 2, -1, -1):
        for j in range(columns):
            gain[i, j] *= gain[i + 1, j]
    for j in range(columns):
        least = min(least, gain[0, j])
    if not (lowest > 0.0 and least > 0.0):
        return False
    relative = ULP * columns * (4.0 - 5.0 * np.log(lowest)) + ULP * rows * (4.0 - 5.0 * np.log(least)) + 4.0 * ULP
    returned = (1.0 + relative - lowest) * (1.0 + relative - least)
    certain = SLACK * (1.0 + relative) ** 2 / max(1.0 - returned, 1e-60)
    upper_factor = 1.0 + relative
    row_square, column_square = np.zeros(rows), np.zeros(columns)
    for i in range(rows):
        for j in range(columns):
            into, out = cells[i, j] * profile[i, j], cells[i, j] * gain[i, j]
            transfer[i, j] = into * gain[i, j]
            lift = to_amplifier[i, j] / (1.0 + to_amplifier[i, j] * above[i, j])
            row_square[i] += into * (into * upper_factor - transfer[i, j]) * lift
            lift = to_driver[i, j] / (1.0 + to_driver[i, j] * beyond[i, j])
            column_square[j] += out * (out * upper_factor - transfer[i, j]) * lift
    for i in range(rows):
        bound = certain * np.sqrt(row_square[i])
        for j in range(columns):
            error[i, j] = bound * np.sqrt(column_square[j]) + (upper_factor - 1.0) * transfer[i, j]
    return True
