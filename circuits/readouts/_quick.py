"""Outputs of one frame by plain nodal analysis: one matrix inversion, rounding errors not bounded.

:meth:`.ReadoutCircuit.read` works in positive arithmetic and certifies its digits. A live recovery compares the model
with readings in ADC steps, so that ten digits are plenty. The functions here give them at a fraction of the cost.

All take the network of a grid with ideal lines, whose row terminals are joined with each other by nothing
(:class:`..recovery._quick_model.QuickModel`):

* ``driven`` (N, M) S between row terminals and columns;
* ``across`` (M, M) S between columns, zero on the diagonal.
"""

from __future__ import annotations

import numpy as np

from ...arrays import FloatArray
from .._parts import Parts
from ._ends import Ends


def terminated_outputs(board: Parts, driven: FloatArray, across: FloatArray, ends: Ends) -> FloatArray:
    """V (N, M) where all columns end in resistances and sources at once."""
    into_end = 1.0 / (ends.resistance + board.column_lead)  # S (M,)
    rows = len(driven)
    if board.floating:
        impedance = np.linalg.inv(_floating(driven, across, into_end))
        by_sources = impedance[:, rows:] @ (into_end * ends.source)
        raised = (board.drive - by_sources[:rows]) / np.diagonal(impedance)[:rows]
        columns = by_sources[rows:] + impedance[:rows, rows:] * raised[:, None]
    else:
        columns = (board.drive * driven + into_end * ends.source) @ np.linalg.inv(_grounded(driven, across, into_end))
    volts: FloatArray = ends.output + ends.slope * into_end * (columns - ends.source)
    return volts


def open_column_outputs(board: Parts, driven: FloatArray, across: FloatArray) -> FloatArray:
    """V (N, M) of a divider whose columns are open while they are not read: Thevenin equivalents of all columns."""
    rows, load = len(driven), board.reference
    if board.floating:
        nothing = np.zeros(len(load))
        laplacian = _floating(driven, across, nothing)
        # Adding a constant to all entries gives potentials a zero, and changes no resistance between two nodes.
        laplacian += np.trace(laplacian) / len(laplacian) ** 2
        impedance = np.linalg.inv(laplacian)
        own = np.diagonal(impedance)
        inside = own[:rows, None] + own[rows:] - 2.0 * impedance[:rows, rows:]
        source: FloatArray | float = board.drive
    else:
        impedance = np.linalg.inv(_grounded(driven, across, 0.0))
        inside, source = np.diagonal(impedance), board.drive * (driven @ impedance)
    volts: FloatArray = board.level + source * load / (load + board.column_lead + inside)
    return volts


def behind_leads(driven: FloatArray, across: FloatArray, lead: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``driven`` and ``across`` of the network with ``lead`` (M,) ohm behind each column."""
    if not lead.any():
        return driven, across
    into_lead = 1.0 / np.maximum(lead, _LEAST_LEAD)
    impedance = np.linalg.inv(_grounded(driven, across, into_lead))
    impedance *= into_lead
    across = into_lead[:, None] * impedance
    across.flat[:: len(across) + 1] = 0.0
    return driven @ impedance, across


_LEAST_LEAD = 1e-5  # ohm: stands for an ideal lead beside others that are not


def _grounded(driven: FloatArray, across: FloatArray, to_ground: FloatArray | float) -> FloatArray:
    """Nodal matrix (M, M) in S of the columns, row terminals at ground."""
    matrix = -across
    matrix.flat[:: len(matrix) + 1] += across.sum(axis=0) + driven.sum(axis=0) + to_ground
    return matrix


def _floating(driven: FloatArray, across: FloatArray, to_ground: FloatArray) -> FloatArray:
    """Nodal matrix (N + M, N + M) in S of row terminals and columns."""
    rows, columns = driven.shape
    matrix = np.zeros((rows + columns, rows + columns))
    matrix[:rows, rows:] = -driven
    matrix[rows:, :rows] = -driven.T
    matrix[rows:, rows:] = -across
    total = np.concatenate([driven.sum(axis=1), driven.sum(axis=0) + across.sum(axis=0) + to_ground])
    matrix.flat[:: len(matrix) + 1] += total
    return matrix
