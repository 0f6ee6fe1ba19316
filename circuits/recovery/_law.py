"""Cells from readings by Kirchhoff's laws of columns and rows, in closed form, with the errors of the readings.

A circuit states for each reading its current I, its column's potential C and its row's drive W
(:mod:`..readouts._port_law`). The port conductances D between row drivers and columns, their sums T over a column, and
the cells G behind rows of resistance r then follow from two laws:

    W_ij D_ij = I_ij + T_j C_ij,     T_j = sum_i I_ij / W_ij / (1 - sum_i C_ij / W_ij),
    G_ij = D_ij / (1 - r_i sum_l D_il).

Along a row with segments the sum counts those currents only that pass a segment before the cell.
Both are exact where columns have no segments and no current passes from column to column by way of an idle row;
:mod:`._live_law` counts the rest. The laws are linear in D, so that zeros and negative values do no harm.

With kappa_ij = (I' + T C' - W' D) / W (a prime is a derivative by the reading), an error e of the readings changes

    D_ij  by  kappa_ij e_ij + c_ij sum_k kappa_kj e_kj,   c_ij = C_ij / W_ij / (1 - sum_k C_kj / W_kj),
    G_ij / G_ij  by  dD_ij / D_ij + rho_i sum_l dD_il,    rho_i = r_i / (1 - r_i sum_l D_il).

The parts are the cell's own, its column's and its row's. Where several answers give the same
readings, :meth:`Law.answers` encloses them all.
"""

from __future__ import annotations

from math import hypot
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._board import Board
from .._parts import LEAST_SHORT_OHM
from .._sections import Fault
from ..readouts import PortLaw
from ..solvers import siemens
from ._law_kernels import LEAST, answers, columns_of, rows_of

_MOST_BRIDGE = 1e9  # S
_STANDS_OUT = 10.0  # port conductance over the usual one of its column, from which on a cell may be a short
_SHORTED = 0.3  # ohm, of all cells of a column in parallel, if they are shorts


def several_answers(board: Board) -> bool:
    """Whether two sets of cells may give the same readings, however small their errors.

    The determinant of the derivatives of all readings by all cells is positive for all cells where no line conducts
    more to the reference while it is idle than while it is selected or read (``tests/test_answers.py``): then there is
    one answer at most. An idle column that conducts more ties the rows, behind their leads, to the reference.
    """
    circuit = board.circuit
    if board.line_ends is not None and board.described is None:
        return False  # not linear: the circuit itself refuses what is ambiguous
    more = circuit.drives_idle_lines
    if not more and (read := circuit.read_ends(board)) is not None:
        more = bool((board.idle_resistance < read.resistance).any())
    leads = np.where(np.isfinite(board.row_ohms), board.row_ohms, 0.0)
    return circuit.columns_one_by_one(board) and more and bool(leads.any())


class Ports(NamedTuple):
    """Port conductances of one frame. Arrays are (N, M) unless stated."""

    apart: FloatArray
    """S, I / W: the conductance if the column had no potential"""
    share: FloatArray
    """C / W"""
    drive: FloatArray
    """V, W"""
    left: FloatArray
    """(M,) 1 - sum(C / W): share of the drive at a column while all rows are driven"""
    total: FloatArray
    """(M,) S, T"""
    driven: FloatArray
    """(N, M) S, D"""
    row_left: FloatArray
    """(N,) 1 - r sum(D): share of the drive at a row while all columns are at its foot"""
    cells: FloatArray
    """(N, M) S, G"""


class Law:
    """The two laws of one board."""

    def __init__(
        self,
        law: PortLaw,
        lead: FloatArray,
        segments: FloatArray,
        wire: FloatArray,
        beside_end: FloatArray,
        cell_most: FloatArray,
        absent: BoolArray,
        shorts: FloatArray,
        bridges: tuple[Fault, ...],
        error: float,
        *,
        one_by_one: bool,
        floating: bool,
        virtual_ground: bool,
        several: bool,
    ) -> None:
        """The laws of a board.

        Args:
            law: of the circuit.
            lead: (N,) ohm, mean of each row from its driver to its cells.
            segments: (N, M) ohm of the rows, up to the first cell and from cell to cell.
            wire: (M,) ohm, mean of each column from its cells to its end.
            beside_end: (N, M) ohm, wire from each cell to its column's end in excess of that mean.
            cell_most: (N, M) S, largest conductance of a cell that a reading can tell from a short.
            absent: (N, M) cells that take no part.
            shorts: (N, M) S, D of complete shorts, which are known without a reading; 0 at all other cells.
            bridges: between lines.
            error: V, of a reading.
            one_by_one: whether idle columns carry no load.
            floating: whether idle rows float.
            virtual_ground: whether amplifiers hold the columns.
            several: whether idle columns conduct more than the one that is read.

        """
        self.law = PortLaw(*(np.array(np.broadcast_to(part, (2, len(wire))), order="C") for part in law))
        self.lead, self.wire, self.one_by_one = np.array(lead), wire, one_by_one
        (_, i1), (_, c1), (_, w1) = self.law
        self.has_potential = bool(law.potential.any())
        """whether columns leave the potential of the idle lines, so that a cell depends on its whole column"""
        self.has_leads = bool(lead.any())
        self.cancels = virtual_ground and not floating
        """whether columns stand next to the idle lines, so that offsets alone drive currents into their shorts"""
        self.several = several and self.has_potential
        """whether idle columns conduct more than the one that is read, so that there may be several answers"""
        self.behind: FloatArray = np.abs((c1 - w1 * (not self.has_potential)) / i1)
        """(M,) ohm, potential of a column above the idle lines per current into its end"""
        rows, columns = absent.shape
        self._most = 1.0 / (self.lead + LEAST_SHORT_OHM)  # S, D of a short
        by_reading = np.abs(c1 - w1) / np.abs(self.law.drive[0])
        self._least_left = np.maximum(error * np.sqrt(rows) * by_reading, LEAST)
        per_reading = float(np.abs(i1 / self.law.drive[0]).max())
        self._least_row_left = np.maximum(error * np.sqrt(columns) * per_reading * self.lead, LEAST)
        self._bridges, self._held = bridges, not floating
        self._segments, self._beside_end = (np.array(part, order="C") for part in (segments, beside_end))
        self.present = np.ascontiguousarray(~(absent | (shorts > 0.0)))
        self.nowhere = np.zeros(absent.shape, dtype=np.bool_)
        self._column_most: FloatArray = 1.0 / (wire + beside_end.min(axis=0) + _SHORTED)
        self._shorts, self._cell_most = (np.array(part, order="C") for part in (shorts, cell_most))

    def __call__(self, volts: FloatArray, unknown: BoolArray | None = None) -> Ports:
        """The conductances behind readings (N, M) in V, of which ``unknown`` ones state bounds only."""
        shape = rows, columns = volts.shape
        ports = Ports(
            *(np.empty(shape), np.empty(shape), np.empty(shape), np.empty(columns), np.empty(columns)),
            *(np.empty(shape), np.empty(rows), np.empty(shape)),
        )
        nowhere = self.nowhere if unknown is None else unknown
        columns_of.unchecked(
            volts, *self.law, self.present, nowhere, self._shorts, self._most, self._least_left, *ports[:6]
        )
        lines = self.lead, self._segments, self._beside_end, self._least_row_left
        rows_of.unchecked(ports.driven, *lines, ports.row_left, ports.cells)
        return ports

    def given(self) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, ...], tuple[FloatArray, ...]]:
        """What the kernels are given of each column (M,), of each row (N,) and of each cell (N, M)."""
        of_rows = self.lead, self._most, self._least_row_left
        return (self._least_left, self.behind), of_rows, (self._shorts, self._segments, self._beside_end)

    def potential(self, volts: FloatArray) -> FloatArray:
        """V (N, M), of each column above the idle lines at readings ``volts``."""
        potential: FloatArray = self.law.potential[0] + self.law.potential[1] * volts
        return potential

    def share_slope(self, ports: Ports) -> FloatArray:
        """1/V, size of the derivative of C / W by the reading; broadcasts to (N, M)."""
        (_, c1), (_, w1) = self.law.potential, self.law.drive
        slope: FloatArray = np.abs((c1 - w1 * ports.share) / ports.drive)
        return slope

    def apart(self, ports: Ports) -> FloatArray | None:
        """Factor (N, M) by which errors of readings grow where bridges mix two lines; None: there are no bridges.

        A bridge of b siemens joins two nodes of Y siemens each. The currents of two columns follow from their
        potentials by Y [[1 + B, -B], [-B, 1 + B]] with B = b / Y, which enlarges independent errors by the root of
        (1 + B)^2 + B^2. Of the potential of a driven row the other one has the share A = b / (b + Y); the inverse of
        [[1, A], [A, 1]] enlarges errors by the root of 1 + A^2, over 1 - A^2.
        """
        if not self._bridges:
            return None
        factor = np.ones(ports.driven.shape)
        of_column = 1.0 / np.maximum(self.behind, LEAST) + ports.total
        of_row = 1.0 / np.maximum(self.lead, LEAST) * self._held + ports.driven.sum(axis=1)
        for fault in self._bridges:
            (rows, columns), bridge = zip(*fault.ends, strict=True), min(float(siemens(fault.ohms)), _MOST_BRIDGE)
            if fault.kind == "bridged-columns":
                for column in columns:
                    share = bridge / max(of_column[column], LEAST)
                    factor[:, column] *= hypot(1.0 + share, share)
            else:
                share = max(bridge / (bridge + max(of_row[row], LEAST)) for row in rows)
                factor[list(rows)] *= hypot(1.0, share) / max(1.0 - share**2, LEAST)
        return factor

    def answers(
        self, volts: FloatArray, ports: Ports, at_limit: tuple[BoolArray, BoolArray], error: float
    ) -> tuple[FloatArray, FloatArray]:
        """Bounds (N, M) in S on all cells that give readings ``volts`` within their ``error`` in V.

        Where idle columns conduct more than the one that is read, another set of cells far away may give the same
        readings. With idle columns at the potential of the idle rows, column j conducts

            S_j = sum_i D_ij (1 - r_i D_ij) / (1 - r_i sum_l D_il)

        to all lines, and W D = I + S C. Both are increasing in all D where C/W is positive: hence rounds that begin at
        the bounds of the cells enclose every answer, and meet if there is only one. No cell is taken to conduct more
        than its wires, and no column together than a short of 0.3 ohm, but cells at a limit
        and several of one row that stand out from their columns: these may be shorts that join columns. ``at_limit``
        has cells that conduct at least, and at most, what their readings say.
        """
        rows, columns = volts.shape
        usual = np.sort(ports.driven, axis=0)[(len(volts) - 1) // 2]
        short = ports.driven > _STANDS_OUT * np.maximum(usual, 0.0)
        short &= (np.count_nonzero(short, axis=1) > 1)[:, None]
        limited, faint = np.ascontiguousarray(at_limit[0] | short), np.ascontiguousarray(at_limit[1])
        most = np.where(limited, 1.0 / LEAST_SHORT_OHM, self._cell_most)
        below, above, low, high = np.empty((4, rows, columns))
        sums = np.empty((3, max(rows, columns)))
        answers.unchecked(
            volts,
            *self.law,
            self.present,
            limited,
            faint,
            self.lead,
            most,
            self._column_most,
            error,
            below,
            above,
            sums,
            low,
            high,
        )
        return low, high
