"""Outputs of one frame by plain nodal analysis: one matrix inversion, without bounds on rounding errors.

:meth:`.ReadoutCircuit.read` works in positive arithmetic and certifies its digits. A live recovery compares the model
with readings in ADC steps, for which ten digits are plenty. The functions of this module give ten digits at a fraction
of the cost.

All functions take the network between the ports of a grid (:class:`QuickNetwork`), which :mod:`..recovery._quick_model`
computes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...common.arrays import FloatArray
from ...common.compiled import FixedRow, FixedRows, Rows, load, loop
from .._parts import Parts
from .._tuning import CONNECTED, LEAST_LEAD, MOST_COLUMNS
from ._ends import Ends


class QuickNetwork(NamedTuple):
    """Conductances between row terminals and columns, row leads included, column leads not."""

    driven: FloatArray
    """(N, M) S between row terminals and columns"""
    across: FloatArray
    """(M, M) S between columns, zero on the diagonal"""
    between: FloatArray | None
    """(N, N) S between row terminals, zero on the diagonal; None if all are zero"""
    to_reference: FloatArray | None = None
    """(N + M,) S from row terminals and columns to the reference, by way of pull-downs; None if all are zero"""
    compiled: bool = False
    """whether machine code inverts the columns' nodal matrix"""

    @classmethod
    def of_ideal_lines(cls, conductance: FloatArray, row_lead: FloatArray, *, compiled: bool) -> QuickNetwork:
        """The network of a grid (N, M) in S with ideal lines behind leads (N,) in ohm.

        ``compiled`` is the result of :meth:`load_loops`.
        """
        if compiled:
            driven, across = np.empty(conductance.shape), np.empty(conductance.shape[1:] * 2)
            network_behind_leads.code(np.ascontiguousarray(conductance), row_lead, driven, across)
            return cls(driven, across, None, compiled=True)
        driven = conductance / (1.0 + row_lead * conductance.sum(axis=1))[:, None]
        across = conductance.T @ (driven * row_lead[:, None])
        across.flat[:: len(across) + 1] = 0.0
        return cls(driven, across, None)

    @staticmethod
    def load_loops(columns: int) -> bool:
        """Whether there is machine code, and it is faster than array operations for this number of columns."""
        return columns <= MOST_COLUMNS and load(columns_impedance, network_behind_leads)


def terminated_outputs(board: Parts, network: QuickNetwork, ends: Ends) -> FloatArray:
    """V (N, M) where all columns end in resistances and sources at once."""
    driven = network.driven
    into_end = 1.0 / (ends.resistance + board.column_lead)  # S (M,)
    rows = len(driven)
    if board.floating:
        impedance = np.linalg.inv(_floating(network, into_end))
        by_sources = impedance[:, rows:] @ (into_end * ends.source)
        raised = (board.drive - by_sources[:rows]) / np.diagonal(impedance)[:rows]
        columns = by_sources[rows:] + impedance[:rows, rows:] * raised[:, None]
    else:
        columns = (board.drive * driven + into_end * ends.source) @ _impedance(network, into_end)
    volts: FloatArray = ends.output + ends.slope * into_end * (columns - ends.source)
    return volts


class _Alone(NamedTuple):
    """Norton equivalent of each column, (N, M) or (M,), while all other columns end as idle ones do."""

    current: FloatArray
    """(N, M) A into a column held at the reference"""
    admittance: FloatArray
    """S of the column to the reference, its lead not included"""
    impedance: FloatArray
    """ohm between the nodes of the base network: columns (M, M), or row terminals and columns (N + M, N + M)"""
    own: FloatArray
    """ohm of each column in the base network"""
    idle: FloatArray
    """(M,) S of the idle ends, which the base network contains"""


def _alone(board: Parts, network: QuickNetwork) -> _Alone:
    """Each column alone: the base network, in which all columns end as idle ones do, without the column's idle end.

    Raises:
        numpy.linalg.LinAlgError: parts of the grid have no connection.

    """
    rows = len(network.driven)
    idle = 1.0 / np.maximum(board.idle_resistance + board.column_lead, LEAST_LEAD)
    if not board.floating:
        impedance = _impedance(network, idle)
        own, open_circuit = np.diagonal(impedance), board.drive * (network.driven @ impedance)
        return _Alone(open_circuit / own, 1.0 / own - idle, impedance, own, idle)
    laplacian = _floating(network, idle)
    if network.to_reference is not None or idle.any():
        impedance = np.asarray(np.linalg.inv(laplacian), dtype=np.float64)
        gain = impedance[:rows, rows:] / np.diagonal(impedance)[:rows, None]
        own = np.diagonal(impedance)[rows:] - gain * impedance[:rows, rows:]
        return _Alone(board.drive * gain / own, 1.0 / own - idle, impedance, own, idle)
    # Adding a constant to all entries makes the matrix invertible, and changes no resistance between two nodes.
    laplacian += np.trace(laplacian) / len(laplacian) ** 2
    impedance = np.asarray(np.linalg.inv(laplacian), dtype=np.float64)
    diagonal = np.diagonal(impedance)
    if not float(np.abs(diagonal).max()) * np.trace(laplacian) < CONNECTED * len(laplacian):
        raise np.linalg.LinAlgError("parts of the grid have no connection")
    own = diagonal[:rows, None] + diagonal[rows:] - 2.0 * impedance[:rows, rows:]
    return _Alone(board.drive / own, 1.0 / own, impedance, own, idle)


def alone_outputs(board: Parts, network: QuickNetwork, ends: Ends) -> FloatArray:
    """V (N, M) of columns that are read one by one; ``ends`` are those of the columns while they are read."""
    alone, behind = _alone(board, network), ends.resistance + board.column_lead
    current = (alone.current - ends.source * alone.admittance) / (1.0 + behind * alone.admittance)
    volts: FloatArray = ends.output + ends.slope * current
    return volts


def alone_fields(board: Parts, network: QuickNetwork, ends: Ends) -> QuickFields:
    """Fields of the readings of :func:`alone_outputs`."""
    alone, behind = _alone(board, network), ends.resistance + board.column_lead
    (rows, columns), impedance = network.driven.shape, alone.impedance
    current = (alone.current - ends.source * alone.admittance) / (1.0 + behind * alone.admittance)
    drawn = current - alone.idle * (ends.source + behind * current)  # A, beyond the idle end's
    unit = ends.slope / (alone.own * (1.0 + behind * alone.admittance))
    if not board.floating:
        at_columns, selected = np.zeros((columns, rows + columns)), np.zeros((rows, rows + columns))
        at_columns[:, rows:] = impedance
        selected[:, rows:] = board.drive * (network.driven @ impedance)
        selected[:, :rows].flat[:: rows + 1] = board.drive
        one, none = np.ones((rows, columns)), np.zeros((rows, columns))
        return QuickFields(
            PortFields(selected, at_columns, one, -drawn),
            PortFields(np.zeros_like(selected), at_columns, none, np.broadcast_to(unit, (rows, columns))),
        )
    of_rows, of_columns = impedance[:rows], impedance[rows:]
    if network.to_reference is None and not alone.idle.any():  # what enters by the row leaves by the column
        into_row, gain = drawn, np.ones((rows, columns))
    else:
        own = np.diagonal(impedance)[:rows, None]
        gain = impedance[:rows, rows:] / own
        into_row = board.drive / own + gain * drawn
    return QuickFields(
        PortFields(of_rows, of_columns, into_row, -drawn), PortFields(of_rows, of_columns, -unit * gain, unit)
    )


class PortFields(NamedTuple):
    """One field of every reading (r, c), as potentials of the N + M ports: row terminals, then columns.

    The field of a reading is ``row_share[r, c] of_rows[r] + column_share[r, c] of_columns[c]``.
    """

    of_rows: FloatArray
    """(N, N + M)"""
    of_columns: FloatArray
    """(M, N + M)"""
    row_share: FloatArray
    """(N, M)"""
    column_share: FloatArray
    """(N, M)"""

    def of_some(self, rows: slice) -> FloatArray:
        """(K M, N + M) fields of the readings of K selected rows."""
        fields: FloatArray = self.row_share[rows, :, None] * self.of_rows[rows, None]
        fields += self.column_share[rows, :, None] * self.of_columns
        return fields.reshape(-1, fields.shape[-1])


class QuickFields(NamedTuple):
    """Forward and adjoint fields (:mod:`._adjoint`) of all readings."""

    forward: PortFields
    """V at the ports"""
    adjoint: PortFields
    """V at the ports per unit of the reading"""


def terminated_fields(board: Parts, network: QuickNetwork, ends: Ends) -> QuickFields:
    """Fields of the readings of :func:`terminated_outputs`."""
    driven = network.driven
    into_end = 1.0 / (ends.resistance + board.column_lead)  # S (M,)
    (rows, columns), ports = driven.shape, sum(driven.shape)
    per_volt = ends.slope * into_end
    one, none = np.ones((rows, columns)), np.zeros((rows, columns))
    no_columns = np.zeros((columns, ports))
    if not board.floating:
        impedance = _impedance(network, into_end)
        selected, adjoint = np.zeros((rows, ports)), np.zeros((columns, ports))
        selected[:, rows:] = (board.drive * driven + into_end * ends.source) @ impedance
        selected[:, :rows].flat[:: rows + 1] = board.drive
        adjoint[:, rows:] = per_volt[:, None] * impedance
        no_rows = np.zeros((rows, ports))
        return QuickFields(PortFields(selected, no_columns, one, none), PortFields(no_rows, adjoint, none, one))
    impedance = np.asarray(np.linalg.inv(_floating(network, into_end)), dtype=np.float64)
    by_sources = impedance[:, rows:] @ (into_end * ends.source)
    by_columns = per_volt[:, None] * impedance[rows:]
    # Potentials with each row's terminal at 1 V, sources off.
    held = impedance[:rows] / np.diagonal(impedance)[:rows, None]
    selected = by_sources + (board.drive - by_sources[:rows, None]) * held
    return QuickFields(
        PortFields(selected, no_columns, one, none), PortFields(held, by_columns, -by_columns[:, :rows].T, one)
    )


def behind_leads(network: QuickNetwork, lead: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``driven`` and ``across`` of the network with ``lead`` (M,) ohm behind each column."""
    if not lead.any():
        return network.driven, network.across
    into_lead = 1.0 / np.maximum(lead, LEAST_LEAD)
    impedance = _impedance(network, into_lead)
    impedance *= into_lead
    across = into_lead[:, None] * impedance
    across.flat[:: len(across) + 1] = 0.0
    return network.driven @ impedance, across


def _impedance(network: QuickNetwork, to_ground: FloatArray | float) -> FloatArray:
    """Inverse (M, M) in ohm of :func:`_grounded`.

    Raises:
        numpy.linalg.LinAlgError: columns are connected to nothing.

    """
    if not network.compiled:
        return np.asarray(np.linalg.inv(_grounded(network, to_ground)), dtype=np.float64)
    impedance = np.empty(network.across.shape)
    ends = np.full(len(impedance), to_ground)
    if not columns_impedance.code(network.driven, network.across, ends, impedance):
        raise np.linalg.LinAlgError("columns are connected to nothing")
    return impedance


@loop
def columns_impedance(driven: FixedRows, across: FixedRows, to_ground: FixedRow, impedance: Rows) -> bool:
    """Invert :func:`_grounded` into ``impedance`` (M, M) by Gauss-Jordan elimination; whether there is an inverse.

    No pivoting is needed: the matrix is symmetric and diagonally dominant.
    """
    rows, columns = driven.shape
    for j in range(columns):
        total = to_ground[j]
        for k in range(columns):
            total += across[k, j]
            impedance[j, k] = -across[j, k]
        for i in range(rows):
            total += driven[i, j]
        impedance[j, j] += total
    for k in range(columns):
        pivot = impedance[k, k]
        if not 0.0 < pivot < math.inf:
            return False
        impedance[k, k] = 1.0
        for j in range(columns):
            impedance[k, j] /= pivot
        for i in range(columns):
            if i != k:
                factor = impedance[i, k]
                impedance[i, k] = 0.0
                for j in range(columns):
                    impedance[i, j] -= factor * impedance[k, j]
    return True


@loop
def network_behind_leads(conductance: FixedRows, row_lead: FixedRow, driven: Rows, across: Rows) -> None:
    """``driven`` (N, M) and ``across`` (M, M) of a grid (N, M) in S with ideal lines behind leads (N,) in ohm."""
    rows, columns = conductance.shape
    across[:] = 0.0
    for i in range(rows):
        total = 0.0
        for j in range(columns):
            total += conductance[i, j]
        through = 1.0 + row_lead[i] * total
        for j in range(columns):
            driven[i, j] = conductance[i, j] / through
        for j in range(columns):
            passed = driven[i, j] * row_lead[i]
            for k in range(columns):
                across[k, j] += conductance[i, k] * passed
    for j in range(columns):
        across[j, j] = 0.0


def _grounded(network: QuickNetwork, to_ground: FloatArray | float) -> FloatArray:
    """Nodal matrix (M, M) in S of the columns, row terminals at ground."""
    driven, across = network.driven, network.across
    matrix = -across
    matrix.flat[:: len(matrix) + 1] += across.sum(axis=0) + driven.sum(axis=0) + to_ground
    return matrix


def _floating(network: QuickNetwork, to_ground: FloatArray) -> FloatArray:
    """Nodal matrix (N + M, N + M) in S of row terminals and columns."""
    driven, across, between = network.driven, network.across, network.between
    rows, columns = driven.shape
    matrix = np.zeros((rows + columns, rows + columns))
    matrix[:rows, rows:] = -driven
    matrix[rows:, :rows] = -driven.T
    matrix[rows:, rows:] = -across
    total = np.concatenate([driven.sum(axis=1), driven.sum(axis=0) + across.sum(axis=0) + to_ground])
    if between is not None:
        matrix[:rows, :rows] = -between
        total[:rows] += between.sum(axis=1)
    if network.to_reference is not None:
        total += network.to_reference
    matrix.flat[:: len(matrix) + 1] += total
    return matrix
