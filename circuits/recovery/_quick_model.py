"""Outputs and derivatives of a plain grid by nodal analysis of its ports, without bounds on rounding errors.

With ideal lines and resistive leads there is one node per row and one per column. The rows' own nodes are eliminated in
closed form: row i with the lead r_i and cells of the sum S_i passes

    D_ij = g_ij / (1 + r_i S_i)        from its terminal to column j,
    C_jk = sum_i r_i D_ij g_ik         from column to column.

Small grids with other lines take one dense system of equations (:meth:`.LineResistance.ports`). Larger ones are reduced
to their ports by nested dissection (:func:`..solvers.port_conductances`), at about ten times the cost of ideal lines.
What the readout makes of either network is the circuit's to say (:meth:`.ReadoutCircuit.quick_outputs`).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...arrays import FloatArray
from .._board import Board
from .._exact import read_exactly
from .._sensitivity import basis_drops
from ..readouts import QuickFields, QuickNetwork
from ..solvers import has_ideal_lines, port_conductances
from ._lines import LineResistance
from ._port_derivatives import AnyLines, Branches, IdealLines, PortDerivatives

_AT_ONCE = 4096  # derivatives that are made together, if those of one row are fewer
_LIGHT = 0.25  # largest loss in the lines for which sweeps are good to a percent


class QuickModel:
    """A board's outputs for one frame of cells: quickly where the board allows it, else exactly."""

    def __init__(self, board: Board, lines: LineResistance) -> None:
        """For a sliced sheet, and the shared wire of its lines."""
        self._board, self._lines = board, lines
        lead = board.row_ohms[:, 0]
        self._lead = np.ascontiguousarray(lead)
        self._compiled = False
        finite = lines.finite and bool(np.isfinite(board.column_lead).all())
        self.is_quick = board.plain and finite and has_ideal_lines(board.lines)
        """whether the network is known in closed form"""
        self.has_network = board.plain
        """whether the network's ports give the outputs by plain nodal analysis"""
        if self.has_network:
            some = np.full(board.shape, 1e-4)
            self.has_network = self._quick(some) is not None
        self.is_quick = self.is_quick and self.has_network
        self._compiled = self.is_quick and QuickNetwork.load_loops(board.shape[1])

    def __call__(self, cells: FloatArray) -> FloatArray:
        """V (N, M) for ``cells`` (N, M) in ohm, in line coordinates.

        Raises:
            SolverError: parts of no resistance join sources that contradict each other.

        """
        if self.has_network:
            try:
                volts = self._quick(self._board.cell_conductance(cells))
            except np.linalg.LinAlgError:  # parts of the grid that nothing is connected to
                volts = None
            if volts is not None and np.count_nonzero(np.isfinite(volts)) == volts.size:
                return volts
        return read_exactly(self._board, cells)[0].volts

    def derivatives(self, cells: FloatArray) -> Iterator[FloatArray] | None:
        """Derivatives (K M, N, M) in V/S of the readings of the next K selected rows by all crosspoints.

        Args:
            cells: (N, M) ohm.

        Returns:
            None where there is no short way.

        """
        if not self.has_network:
            return None
        conductance = self._board.cell_conductance(cells)
        fields = self._board.circuit.quick_fields(self._board, self._network(conductance))
        if fields is None:
            return None
        return _products(fields, self.branches(cells))

    def products(self, cells: FloatArray) -> PortDerivatives | None:
        """The same derivatives without their matrix.

        Raises:
            numpy.linalg.LinAlgError: parts of the grid are connected to nothing.

        """
        if not self.has_network:
            return None
        conductance = self._board.cell_conductance(cells)
        fields = self._board.circuit.quick_fields(self._board, self._network(conductance))
        return None if fields is None else PortDerivatives(fields, self.branches(cells))

    def branches(self, cells: FloatArray) -> Branches:
        """Voltages across the crosspoints for potentials of the grid's ports, for ``cells`` (N, M) in ohm, no shorts.

        They are in closed form with ideal lines, by a dense system on small grids, by sweeps over light lines, and by
        a sparse factorisation elsewhere.
        """
        conductance = self._board.cell_conductance(cells)
        if self.is_quick:
            return IdealLines(conductance, self._lead)
        if self.has_network and self._lines.can_solve(conductance):
            return AnyLines(self._lines.drops(conductance))
        light = self.has_network and self._lines.finite and self._lines.loss(conductance) <= _LIGHT
        return AnyLines(self._lines.swept_drops(conductance) if light else basis_drops(self._board, cells))

    def _network(self, conductance: FloatArray) -> QuickNetwork:
        if self.is_quick:
            return QuickNetwork.of_ideal_lines(conductance, self._lead, compiled=self._compiled)
        rows = len(conductance)
        if self._lines.can_solve(conductance):
            ports = self._lines.ports(conductance)
        else:
            ports = port_conductances(conductance, self._board.lines).value
        return QuickNetwork(ports[:rows, rows:], ports[rows:, rows:], ports[:rows, :rows])

    def _quick(self, conductance: FloatArray) -> FloatArray | None:
        return self._board.circuit.quick_outputs(self._board, self._network(conductance))


def _products(fields: QuickFields, branches: Branches) -> Iterator[FloatArray]:
    rows, columns = fields.forward.row_share.shape
    some = max(1, _AT_ONCE // (rows * columns**2))
    for row in range(0, rows, some):
        forward, adjoint = (branches.across(each.of_some(slice(row, row + some))) for each in fields)
        derivative = forward * adjoint
        yield np.negative(derivative, out=derivative)
