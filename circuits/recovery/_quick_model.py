"""Outputs of a grid with ideal lines and resistive leads, by nodal analysis with one node per column.

The rows' own nodes are eliminated in closed form: row i with the lead r_i and cells of the sum S_i passes

    D_ij = g_ij / (1 + r_i S_i)        from its terminal to column j,
    C_jk = sum_i r_i D_ij g_ik         from column to column.

What the readout makes of that network is the circuit's to say (:meth:`.ReadoutCircuit.quick_outputs`).
"""

from __future__ import annotations

import numpy as np

from ...arrays import FloatArray
from .._board import Board
from .._exact import read_exactly
from ..solvers import has_ideal_lines


class QuickModel:
    """A board's outputs for one frame of cells: quickly where the board allows it, else exactly."""

    def __init__(self, board: Board) -> None:
        """For a sliced sheet."""
        self._board = board
        lead = board.row_ohms[:, 0]
        finite = bool(np.isfinite(lead).all() and np.isfinite(board.column_lead).all())
        self._lead = lead
        self.is_quick = board.plain and finite and has_ideal_lines(board.lines)
        """whether the shortcut is taken"""
        self.is_quick = self.is_quick and self._quick(np.full(board.shape, 1e-4)) is not None

    def __call__(self, cells: FloatArray) -> FloatArray:
        """V (N, M) for ``cells`` (N, M) in ohm, in line coordinates.

        Raises:
            SolverError: parts of no resistance join sources that contradict each other.

        """
        if self.is_quick:
            try:
                volts = self._quick(self._board.cell_conductance(cells))
            except np.linalg.LinAlgError:  # parts of the grid that nothing is connected to
                volts = None
            if volts is not None and np.isfinite(volts).all():
                return volts
        return read_exactly(self._board, cells)[0].volts

    def _quick(self, conductance: FloatArray) -> FloatArray | None:
        driven = conductance / (1.0 + self._lead * conductance.sum(axis=1))[:, None]
        across = conductance.T @ (driven * self._lead[:, None])
        across.flat[:: len(across) + 1] = 0.0
        return self._board.circuit.quick_outputs(self._board, driven, across)
