"""Derivatives of all readings by all cells, in instalments: the adjoint method with fields that are good enough.

A live recovery renews its derivatives while frames come in, and no frame may wait for all of them. So the work is an
iterator, and each frame takes one instalment of it. The method is that of :mod:`.._sensitivity`, for the cells alone.

Newton's method needs no exact derivatives. On light lines the fields inside the grid therefore come from a few sweeps
of the lines' equations, instead of a sparse factorisation:

    u = e_row - (G (u - w)) K_row,        w = e_column + K_column (G (u - w)),

with u and w the potentials along the rows and the columns, e those of the ports, and K the resistances of shared wire.
Each sweep gains the factor that the lines' losses are.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...arrays import FloatArray
from .._board import Board
from .._grid import exact_ports
from .._sensitivity import basis_drops

_SWEEPS = 4
_LIGHT = 0.25  # largest loss in the lines for which that many sweeps are good to a percent
_LEAST_GROUPS = 8  # groups of readings per instalment, at least
_INSTALMENTS = 4  # of groups, at most


class LineResistance:
    """Shared wire of all lines of a plain grid, for :func:`derivatives`."""

    def __init__(self, board: Board) -> None:
        """Sum up the board's lines."""
        to_driver = np.cumsum(board.row_ohms, axis=1)
        to_end = np.zeros(board.shape)  # to the last crosspoint; column leads are outside of the grid's ports
        to_end[:-1] = np.cumsum(board.column_ohms[:0:-1], axis=0)[::-1]
        self.finite = bool(np.isfinite(to_driver).all() and np.isfinite(to_end).all())
        self.row = np.minimum(to_driver[:, :, None], to_driver[:, None, :])
        """(N, M, M) ohm"""
        self.column = np.minimum(to_end.T[:, :, None], to_end.T[:, None, :])
        """(M, N, N) ohm"""
        self._to_driver, self._to_end = to_driver, to_end
        self.to_ends = to_driver + to_end
        """(N, M) ohm of wire in series with each cell, up to the grid's ports"""

    def loss(self, conductance: FloatArray) -> float:
        """Largest share of a voltage that is lost along a line with cells (N, M) in S, to first order."""
        along = (self._to_driver * conductance).sum(axis=1).max()
        return float(along + (self._to_end * conductance).sum(axis=0).max())


def derivatives(board: Board, cells: FloatArray, lines: LineResistance) -> Iterator[FloatArray | None]:
    """Derivatives of the readings by the conductances of the crosspoints' branches.

    Args:
        board: with a sliced sheet and no complete short.
        cells: (N, M) ohm.
        lines: of the board.

    Yields:
        None after each instalment of the work, and last the derivatives (N, M, N, M) in V/S.

    """
    ports = exact_ports(board, cells).value
    reading = board.circuit.read(board, ports)
    conductance = board.cell_conductance(cells)
    light = board.plain and lines.finite and lines.loss(conductance) <= _LIGHT
    drops = _swept_drops(conductance, lines) if light else basis_drops(board, cells)
    yield None
    rows, columns = board.shape
    result = np.zeros((rows, columns, rows, columns))
    groups = board.circuit.sensitivity_groups(board, ports, reading)
    count = (rows if board.floating else 1) * (columns if board.circuit.columns_one_by_one(board) else 1)
    instalment = max(_LEAST_GROUPS, -(-count // _INSTALMENTS))
    for number, group in enumerate(groups, start=1):
        forward = np.tensordot(group.forward, drops, axes=1)
        adjoint = np.tensordot(group.adjoint, drops, axes=1)
        result[np.ix_(group.rows, group.columns)] = -forward * adjoint
        if number % instalment == 0:
            yield None
    yield result


def _swept_drops(conductance: FloatArray, lines: LineResistance) -> FloatArray:
    """As :func:`.basis_drops`, by sweeps over the lines."""
    rows, columns = conductance.shape
    at_rows, at_columns = (np.zeros((rows + columns, rows, columns)) for _ in range(2))
    at_rows[np.arange(rows), np.arange(rows)] = 1.0
    at_columns[rows + np.arange(columns), :, np.arange(columns)] = 1.0
    drops: FloatArray = at_rows - at_columns
    for _ in range(_SWEEPS):
        current = conductance * drops
        along = np.einsum("fij,ijk->fik", current, lines.row, optimize=True)
        down = np.einsum("fij,jik->fkj", current, lines.column, optimize=True)
        drops = at_rows - along - at_columns - down
    return drops
