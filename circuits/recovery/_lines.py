"""Potentials inside a plain grid by the equations of its lines, with the shared wire of each line.

The equations are

    u = e_row - (G (u - w)) K_row,        w = e_column + K_column (G (u - w)),

with the potentials u along the rows and w along the columns, the potentials e of the ports, and the resistances K of
shared wire. For the voltages d = u - w across the crosspoints they are one system, (I + K G) d = e_row - e_column. This
system needs no node per crosspoint and takes wires of 0 ohm as they are. Small grids solve it with a dense matrix, at a
fraction of the cost of a sparse factorisation or of a nested dissection.

On larger grids Newton's method needs no exact derivatives. If their lines are light, a few sweeps of the equations give
the potentials. Each sweep reduces the error by a factor equal to the lines' losses.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ...common.arrays import FloatArray
from .._board import Board
from ._tuning import MOST_LOST, SMALL_DENSE, SWEEPS


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

    @cached_property
    def _shared(self) -> FloatArray:
        """K (N M, N M) in ohm."""
        rows, columns = self.to_ends.shape
        shared = np.zeros((rows, columns, rows, columns))
        row, column = np.arange(rows), np.arange(columns)
        shared[row, :, row, :] = self.row
        shared[:, column, :, column] += self.column
        return shared.reshape(rows * columns, -1)

    @cached_property
    def _from_ports(self) -> FloatArray:
        """(N M, N + M): e_row - e_column per volt at each port."""
        rows, columns = self.to_ends.shape
        drops = np.zeros((rows, columns, rows + columns))
        drops[np.arange(rows), :, np.arange(rows)] = 1.0
        drops[:, np.arange(columns), rows + np.arange(columns)] = -1.0
        return drops.reshape(rows * columns, -1)

    def can_solve(self, conductance: FloatArray) -> bool:
        """Whether :meth:`drops` and :meth:`ports` serve, at cells (N, M) in S."""
        return (
            self.finite and conductance.size <= SMALL_DENSE and float((self.to_ends * conductance).max()) <= MOST_LOST
        )

    def drops(self, conductance: FloatArray) -> FloatArray:
        """As :func:`.basis_drops`, for crosspoints (N, M) in S."""
        drops = self._drops(conductance)
        return drops.T.reshape(-1, *conductance.shape)

    def ports(self, conductance: FloatArray) -> FloatArray:
        """Conductances (N + M, N + M) in S between the ports, zero on the diagonal, for crosspoints (N, M) in S."""
        between = -self._from_ports.T @ (conductance.reshape(-1, 1) * self._drops(conductance))
        between.flat[:: len(between) + 1] = 0.0
        ports: FloatArray = np.maximum(between, 0.0, out=between)
        return ports

    def _drops(self, conductance: FloatArray) -> FloatArray:
        """(N M, N + M): voltages across the crosspoints per volt at each port."""
        system = self._shared * conductance.ravel()
        system.flat[:: len(system) + 1] += 1.0
        return np.asarray(np.linalg.solve(system, self._from_ports), dtype=np.float64)

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
        for _ in range(SWEEPS):
            current = conductance * drops
            along = np.einsum("fij,ijk->fik", current, self.row, optimize=True)
            down = np.einsum("fij,jik->fkj", current, self.column, optimize=True)
            drops = at_rows - along - at_columns - down
        return drops
