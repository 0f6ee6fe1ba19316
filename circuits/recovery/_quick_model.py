"""Outputs and derivatives of a plain grid by nodal analysis of its ports, without bounds on rounding errors.

With ideal lines and resistive leads there is one node per row and one per column. The rows' own nodes are eliminated in
closed form: row i, with the lead r_i and the sum S_i of its cells, conducts

    D_ij = g_ij / (1 + r_i S_i)        from its terminal to column j,
    C_jk = sum_i r_i D_ij g_ik         from column to column.

Small grids with other lines take one dense system of equations (:meth:`.LineResistance.ports`). Larger ones are reduced
to their ports by nested dissection (:func:`..solvers.port_conductances`), at about ten times the cost of ideal lines.
The circuit computes the readings from either network (:meth:`.ReadoutCircuit.quick_outputs`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from enum import Enum, auto

import numpy as np

from ...common.arrays import FloatArray
from .._board import Board
from .._exact import read_exactly
from .._sections import Fault
from .._sensitivity import basis_drops
from ..readouts import QuickFields, QuickNetwork
from ..solvers import has_ideal_lines, port_conductances
from ._lines import LineResistance
from ._port_derivatives import AnyLines, Branches, IdealLines, PortDerivatives
from ._tuning import AT_ONCE, COMPLETE_SHORT, LIGHT, SOME_OHM


def with_resistance(fault: Fault) -> Fault:
    """The fault, with a resistance far below that of any wire where it has none."""
    return fault.replace(resistance=COMPLETE_SHORT) if fault.kind == "shorted-cell" and fault.ohms == 0 else fault


class _Way(Enum):
    """Ways to compute the voltages across all crosspoints."""

    IDEAL = auto()
    DENSE = auto()
    SWEPT = auto()
    SPARSE = auto()


class QuickModel:
    """A board's outputs for one frame of cells: fast where the board allows it, else exact."""

    def __init__(self, board: Board, lines: LineResistance, *, exact: bool = False) -> None:
        """For a sliced sheet, and the shared wire of its lines; ``exact``: outputs to the last digits."""
        self._exact = exact
        self.evaluations = 0
        """outputs that were computed"""
        self._board, self._lines = board, lines
        lead = board.row_ohms[:, 0]
        self._lead = np.ascontiguousarray(lead)
        self._compiled = False
        finite = lines.finite and bool(np.isfinite(board.column_lead).all())
        self.is_quick = board.plain and finite and has_ideal_lines(board.lines)
        """whether the network is known in closed form"""
        self.has_network = board.plain
        """whether plain nodal analysis of the network's ports gives the outputs"""
        if self.has_network:
            # Not with the faults: an open cell alone on its line leaves it no potential.
            sound = replace(board, series_ohms=np.zeros(board.shape))
            try:
                self.has_network = self._quick(sound.cell_conductance(np.full(board.shape, SOME_OHM))) is not None
            except np.linalg.LinAlgError:  # a line that is cut off
                self.has_network = False
        self.is_quick = self.is_quick and self.has_network
        self._compiled = self.is_quick and QuickNetwork.load_loops(board.shape[1])

    def __call__(self, cells: FloatArray) -> FloatArray:
        """V (N, M) for ``cells`` (N, M) in ohm, in line coordinates.

        Raises:
            SolverError: parts of no resistance join sources that contradict each other.

        """
        self.evaluations += 1
        if self.has_network and not self._exact:
            try:
                volts = self._quick(self._board.cell_conductance(cells))
            except np.linalg.LinAlgError:  # parts of the grid without a connection
                volts = None
            if volts is not None and np.count_nonzero(np.isfinite(volts)) == volts.size:
                return volts
        return read_exactly(self._board, cells)[0].volts

    def derivatives(self, cells: FloatArray) -> Iterator[FloatArray] | None:
        """Derivatives (K M, N, M) in V/S of the readings of the next K selected rows by all crosspoints.

        Args:
            cells: (N, M) ohm.

        Returns:
            None if there is no fast way, for example because parts of the grid have no connection.

        """
        if not self.has_network:
            return None
        conductance = self._board.cell_conductance(cells)
        try:
            fields = self._board.circuit.quick_fields(self._board, self._network(conductance))
        except np.linalg.LinAlgError:
            return None
        return None if fields is None else self._products(fields, cells)

    def products(self, cells: FloatArray) -> PortDerivatives | None:
        """The same derivatives without their matrix.

        Raises:
            numpy.linalg.LinAlgError: parts of the grid have no connection.

        """
        if not self.has_network:
            return None
        conductance = self._board.cell_conductance(cells)
        fields = self._board.circuit.quick_fields(self._board, self._network(conductance))
        return None if fields is None else PortDerivatives(fields, self.branches(cells))

    def branches(self, cells: FloatArray) -> Branches:
        """Voltages across the crosspoints for potentials of the grid's ports, for ``cells`` (N, M) in ohm, no shorts.

        The method is a closed form with ideal lines, a dense system on small grids, sweeps over light lines, and a
        sparse factorisation elsewhere.
        """
        conductance = self._board.cell_conductance(cells)
        if self._board.pulled:
            return AnyLines(self._drops_with_pulls(conductance, cells))
        match self._way(conductance):
            case _Way.IDEAL:
                return IdealLines(conductance, self._lead)
            case _Way.DENSE:
                return AnyLines(self._lines.drops(conductance))
            case _Way.SWEPT:
                return AnyLines(self._lines.swept_drops(conductance))
            case _Way.SPARSE:
                return AnyLines(basis_drops(self._board, cells))

    def _drops_with_pulls(self, conductance: FloatArray, cells: FloatArray) -> FloatArray:
        """Voltages (N + M, N, M) across the cells per volt at each port but the reference, which is at 0 V."""
        rows = len(conductance)
        if self.is_quick:
            every = IdealLines(conductance, self._lead).across(np.eye(rows + conductance.shape[1]))[..., 1:]
        else:
            every = basis_drops(self._board, cells)
        return np.delete(every, rows, axis=0)

    def _small(self, conductance: FloatArray) -> bool:
        """Whether one dense system of the lines' equations gives the network; it has no pull-downs."""
        return not self._board.pulled and self._lines.can_solve(conductance)

    def _way(self, conductance: FloatArray) -> _Way:
        """The method of :meth:`branches` at cells (N, M) in S."""
        if self.is_quick:
            return _Way.IDEAL
        if self.has_network and self._small(conductance):
            return _Way.DENSE
        light = (
            self.has_network
            and not self._board.pulled
            and self._lines.finite
            and self._lines.loss(conductance) <= LIGHT
        )
        return _Way.SWEPT if light else _Way.SPARSE

    def _network(self, conductance: FloatArray) -> QuickNetwork:
        rows = len(conductance)
        if self.is_quick:
            network = QuickNetwork.of_ideal_lines(conductance, self._lead, compiled=self._compiled)
        else:
            if self._small(conductance):
                ports = self._lines.ports(conductance)
            else:
                ports = port_conductances(conductance, self._board.lines).value
            network = QuickNetwork(ports[:rows, rows:], ports[rows:, rows:], ports[:rows, :rows])
        if not self._board.pulled:
            return network
        driven, across = network.driven, network.across  # the first of their columns is the reference
        held = np.concatenate([driven[:, 0], across[1:, 0]])
        return QuickNetwork(driven[:, 1:], across[1:, 1:], network.between, held)

    def _products(self, fields: QuickFields, cells: FloatArray) -> Iterator[FloatArray]:
        branches = self.branches(cells)
        rows, columns = fields.forward.row_share.shape
        some = max(1, AT_ONCE // (rows * columns**2))
        for row in range(0, rows, some):
            forward, adjoint = (branches.across(each.of_some(slice(row, row + some))) for each in fields)
            derivative = forward * adjoint
            yield np.negative(derivative, out=derivative)

    def _quick(self, conductance: FloatArray) -> FloatArray | None:
        return self._board.circuit.quick_outputs(self._board, self._network(conductance))
