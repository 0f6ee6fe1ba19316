"""Outputs of one frame by plain nodal analysis: one matrix inversion, rounding errors not bounded.

:meth:`.ReadoutCircuit.read` works in positive arithmetic and certifies its digits. A live recovery compares the model
with readings in ADC steps, so that ten digits are plenty. The functions here give them at a fraction of the cost.

All take the network between the ports of a grid (:class:`QuickNetwork`), as :mod:`..recovery._quick_model` makes it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ...arrays import FloatArray
from .._parts import Parts
from ._ends import Ends


class QuickNetwork(NamedTuple):
    """Conductances between row terminals and columns, row leads inside, column leads not."""

    driven: FloatArray
    """(N, M) S between row terminals and columns"""
    across: FloatArray
    """(M, M) S between columns, zero on the diagonal"""
    between: FloatArray | None
    """(N, N) S between row terminals, zero on the diagonal; None where nothing joins them"""


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
        columns = (board.drive * driven + into_end * ends.source) @ np.linalg.inv(_grounded(network, into_end))
    volts: FloatArray = ends.output + ends.slope * into_end * (columns - ends.source)
    return volts


def open_column_outputs(board: Parts, network: QuickNetwork) -> FloatArray:
    """V (N, M) of a divider whose columns are open while they are not read: Thevenin equivalents of all columns."""
    driven = network.driven
    rows, load = len(driven), board.reference
    if board.floating:
        nothing = np.zeros(len(load))
        laplacian = _floating(network, nothing)
        # Adding a constant to all entries gives potentials a zero, and changes no resistance between two nodes.
        laplacian += np.trace(laplacian) / len(laplacian) ** 2
        impedance = np.linalg.inv(laplacian)
        own = np.diagonal(impedance)
        inside = own[:rows, None] + own[rows:] - 2.0 * impedance[:rows, rows:]
        source: FloatArray | float = board.drive
    else:
        impedance = np.linalg.inv(_grounded(network, 0.0))
        inside, source = np.diagonal(impedance), board.drive * (driven @ impedance)
    volts: FloatArray = board.level + source * load / (load + board.column_lead + inside)
    return volts


class QuickFields(NamedTuple):
    """Forward and adjoint fields (:mod:`._adjoint`) of the readings of one selected row, as potentials of N + M ports.

    The ports are the row terminals and the columns.
    """

    forward: FloatArray
    """(M or 1, N + M) V of each column's reading, or of all of them"""
    adjoint: FloatArray
    """(M, N + M) V at the ports per unit of the reading"""


def terminated_fields(board: Parts, network: QuickNetwork, ends: Ends) -> Iterator[QuickFields]:
    """Fields of the readings of :func:`terminated_outputs`, row by row."""
    driven = network.driven
    into_end = 1.0 / (ends.resistance + board.column_lead)  # S (M,)
    rows, columns = driven.shape
    per_volt = ends.slope * into_end
    if not board.floating:
        impedance = np.linalg.inv(_grounded(network, into_end))
        forward, adjoint = np.zeros((rows, rows + columns)), np.zeros((columns, rows + columns))
        forward[:, rows:] = (board.drive * driven + into_end * ends.source) @ impedance
        forward[:, :rows].flat[:: rows + 1] = board.drive
        adjoint[:, rows:] = per_volt[:, None] * impedance
        for row in range(rows):
            yield QuickFields(forward[row : row + 1], adjoint)
        return
    impedance = np.linalg.inv(_floating(network, into_end))
    by_sources = impedance[:, rows:] @ (into_end * ends.source)
    by_columns = per_volt[:, None] * impedance[rows:]
    for row in range(rows):
        held = impedance[row] / impedance[row, row]  # potentials with this row's terminal at 1 V, sources off
        field = by_sources + (board.drive - by_sources[row]) * held
        yield QuickFields(field[None], by_columns - by_columns[:, row, None] * held)


def open_column_fields(board: Parts, network: QuickNetwork) -> Iterator[QuickFields]:
    """Fields of the readings of :func:`open_column_outputs`, row by row."""
    driven = network.driven
    (rows, columns), load = driven.shape, board.reference
    behind = load + board.column_lead
    if not board.floating:
        impedance = np.linalg.inv(_grounded(network, 0.0))
        share = 1.0 / (behind + np.diagonal(impedance))
        adjoint = np.zeros((columns, rows + columns))
        adjoint[:, rows:] = (load * share)[:, None] * impedance
        open_circuit = board.drive * (driven @ impedance)
        for row in range(rows):
            forward = np.zeros((columns, rows + columns))
            forward[:, row] = board.drive
            forward[:, rows:] = open_circuit[row] - (open_circuit[row] * share)[:, None] * impedance
            yield QuickFields(forward, adjoint)
        return
    laplacian = _floating(network, np.zeros(columns))
    laplacian += np.trace(laplacian) / len(laplacian) ** 2
    impedance = np.linalg.inv(laplacian)
    for row in range(rows):
        between = impedance[row] - impedance[rows:]  # V at the ports for 1 A from the row to each column
        inside = between[:, row] - np.diagonal(between[:, rows:])
        current = 1.0 / (behind + inside)
        yield QuickFields((board.drive * current)[:, None] * between, -(load * current)[:, None] * between)


def behind_leads(network: QuickNetwork, lead: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``driven`` and ``across`` of the network with ``lead`` (M,) ohm behind each column."""
    if not lead.any():
        return network.driven, network.across
    into_lead = 1.0 / np.maximum(lead, _LEAST_LEAD)
    impedance = np.linalg.inv(_grounded(network, into_lead))
    impedance *= into_lead
    across = into_lead[:, None] * impedance
    across.flat[:: len(across) + 1] = 0.0
    return network.driven @ impedance, across


_LEAST_LEAD = 1e-5  # ohm: stands for an ideal lead beside others that are not


def _grounded(network: QuickNetwork, to_ground: FloatArray | float) -> FloatArray:
    """Nodal matrix (M, M) in S of the columns, row terminals at ground."""
    driven, across, _ = network
    matrix = -across
    matrix.flat[:: len(matrix) + 1] += across.sum(axis=0) + driven.sum(axis=0) + to_ground
    return matrix


def _floating(network: QuickNetwork, to_ground: FloatArray) -> FloatArray:
    """Nodal matrix (N + M, N + M) in S of row terminals and columns."""
    driven, across, between = network
    rows, columns = driven.shape
    matrix = np.zeros((rows + columns, rows + columns))
    matrix[:rows, rows:] = -driven
    matrix[rows:, :rows] = -driven.T
    matrix[rows:, rows:] = -across
    total = np.concatenate([driven.sum(axis=1), driven.sum(axis=0) + across.sum(axis=0) + to_ground])
    if between is not None:
        matrix[:rows, :rows] = -between
        total[:rows] += between.sum(axis=1)
    matrix.flat[:: len(matrix) + 1] += total
    return matrix
