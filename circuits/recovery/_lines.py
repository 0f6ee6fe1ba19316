"""Shared wire of a plain grid's lines, and the fields inside the grid by sweeps over them.

Newton's method needs no exact derivatives. On light lines the fields inside the grid therefore come from a few sweeps
of the lines' equations, instead of a sparse factorisation:

    u = e_row - (G (u - w)) K_row,        w = e_column + K_column (G (u - w)),

with u and w the potentials along the rows and the columns, e those of the ports, and K the resistances of shared wire.
Each sweep gains the factor that the lines' losses are.
"""

from __future__ import annotations

import numpy as np

from ...arrays import FloatArray
from .._board import Board

_SWEEPS = 4


class LineResistance:
    """Shared wire of all lines of a plain grid, for derivatives."""

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
        self.to_driver, self.to_end = to_driver, to_end
        """(N, M) ohm of wire between a crosspoint and its row's driver, or its column's last crosspoint"""
        self.to_ends = to_driver + to_end
        """(N, M) ohm of wire in series with each cell, up to the grid's ports"""

    def loss(self, conductance: FloatArray) -> float:
        """Largest share of a voltage that is lost along a line with cells (N, M) in S, to first order."""
        along = (self.to_driver * conductance).sum(axis=1).max()
        return float(along + (self.to_end * conductance).sum(axis=0).max())

    def swept_drops(self, conductance: FloatArray) -> FloatArray:
        """As :func:`.basis_drops`, for crosspoints (N, M) in S, by a few sweeps over the lines."""
        rows, columns = conductance.shape
        at_rows, at_columns = (np.zeros((rows + columns, rows, columns)) for _ in range(2))
        at_rows[np.arange(rows), np.arange(rows)] = 1.0
        at_columns[rows + np.arange(columns), :, np.arange(columns)] = 1.0
        drops: FloatArray = at_rows - at_columns
        for _ in range(_SWEEPS):
            current = conductance * drops
            along = np.einsum("fij,ijk->fik", current, self.row, optimize=True)
            down = np.einsum("fij,jik->fkj", current, self.column, optimize=True)
            drops = at_rows - along - at_columns - down
        return drops
