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
from copy import copy
from dataclasses import replace
from enum import Enum, auto

import numpy as np

from ...common.arrays import FloatArray
from .._board import Board
from .._exact import read_exactly
from .._sensitivity import basis_drops
from ..readouts import QuickFields, QuickNetwork
from ..solvers import has_ideal_lines, port_conductances
from ._lines import LineResistance
from ._port_derivatives import AnyLines, Branches, IdealLines, PortDerivatives

_AT_ONCE = 4096  # derivatives that are computed together, if those of one row are fewer
_SOME_OHM = 1e4
_LIGHT = 0.25  # largest loss in the lines for which sweeps are accurate to a percent
_BREAK_OHM = 1e9  # of a broken wire: far above cells, and such that a dense system keeps ten digits beside it


class _Way(Enum):
    """Ways to compute the voltages across all crosspoints."""

    IDEAL = auto()
    DENSE = auto()
    SWEPT = auto()
    SPARSE = auto()


class QuickModel:
    """A board's outputs for one frame of cells: fast where the board allows it, else exact."""

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
        """whether plain nodal analysis of the network's ports gives the outputs"""
        if self.has_network:
            some = board.cell_conductance(np.full(board.shape, _SOME_OHM))
            self.has_network = self._quick(some) is not None
        self.is_quick = self.is_quick and self.has_network
        self._compiled = self.is_quick and QuickNetwork.load_loops(board.shape[1])
        usual = np.full(board.shape, _SOME_OHM)
        varies = self.has_network and not self.is_quick and self._small(board.cell_conductance(usual))
        self.usual_price = self.price(usual)
        """price of the readings of usual cells"""
        self.fixed_price = None if varies else self.usual_price
        """price of the readings of any cells; None: it depends on the cells"""

    def broken(self, row_ohms: FloatArray, column_ohms: FloatArray, column_lead: FloatArray) -> QuickModel:
        """The model of the same board with other wires, as :class:`.Parts` has them; inf is a break.

        If lines break only at their driver or end, a grid with ideal lines stays one.
        """
        other = copy(self)
        other._board = replace(
            self._board,
            row_ohms=np.minimum(row_ohms, _BREAK_OHM),
            column_ohms=np.minimum(column_ohms, _BREAK_OHM),
            column_lead=np.minimum(column_lead, _BREAK_OHM),
        )
        other._lead = np.ascontiguousarray(other._board.row_ohms[:, 0])
        other.is_quick = self.is_quick and has_ideal_lines(other._board.lines)
        if not other.is_quick:
            other._lines, other.fixed_price = LineResistance(other._board), None
        return other

    def price(self, cells: FloatArray) -> float:
        """Price of the readings of ``cells`` (N, M) in ohm, see :mod:`._frame_account`."""
        size = cells.size
        if not self.has_network:
            return self.exact_price(size)
        if self.is_quick:
            return 45.0 + 0.13 * size if self._board.floating else 20.0 + 0.06 * size
        if self._small(self._board.cell_conductance(cells)):
            return 45.0 + 0.5 * size + 0.01 * size**2
        return self._dissection_price(size)

    def most_price(self, size: int) -> float:
        """Largest price of the readings of any ``size`` cells, also after a line has broken."""
        return self._dissection_price(size) if self.has_network else self.exact_price(size)

    def exact_price(self, size: int) -> float:
        """Price of an exact solution with ``size`` cells."""
        if self._board.floating:
            return 600.0 + 11.0 * size
        return 350.0 + 0.3 * size + (0.0 if has_ideal_lines(self._board.lines) else self._dissection_price(size))

    def sparse_price(self, size: int) -> float:
        """Price of a sparse factorisation with ``size`` cells, the dearest way of :meth:`branches`."""
        return 800.0 + 8.0 * size

    def branch_price(self, cells: FloatArray) -> float:
        """Price of :meth:`branches`."""
        size, way = cells.size, self._way(self._board.cell_conductance(cells))
        if way is _Way.SPARSE:
            return self.sparse_price(size)
        if way is _Way.SWEPT:
            return 160.0 + 0.12 * size * float(np.sqrt(size))
        return 15.0 if way is _Way.IDEAL else 15.0 + 0.5 * size + 0.01 * size**2

    @staticmethod
    def _dissection_price(size: int) -> float:
        return 280.0 + 1.1 * size

    def __call__(self, cells: FloatArray) -> FloatArray:
        """V (N, M) for ``cells`` (N, M) in ohm, in line coordinates.

        Raises:
            SolverError: parts of no resistance join sources that contradict each other.

        """
        if self.has_network:
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
            and self._lines.loss(conductance) <= _LIGHT
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
        some = max(1, _AT_ONCE // (rows * columns**2))
        for row in range(0, rows, some):
            forward, adjoint = (branches.across(each.of_some(slice(row, row + some))) for each in fields)
            derivative = forward * adjoint
            yield np.negative(derivative, out=derivative)

    def _quick(self, conductance: FloatArray) -> FloatArray | None:
        return self._board.circuit.quick_outputs(self._board, self._network(conductance))
