"""Cells from readings by Kirchhoff's laws of columns and rows, in closed form, with the errors of the readings.

A circuit states for each reading its current I, its column's potential C and its row's drive W
(:mod:`..readouts._port_law`). The port conductances D between row drivers and columns, their sums T over a column, and
the cells G behind rows of resistance r then follow from two laws:

    W_ij D_ij = I_ij + T_j C_ij,     T_j = sum_i I_ij / W_ij / (1 - sum_i C_ij / W_ij),
    G_ij = D_ij / (1 - r_i sum_l D_il).

Along a row with segments the sum counts those currents only that pass a segment before the cell.
Where rows float, the columns of a step differ in their drives, and each D counts with its W over that of the cell.
Both are exact where columns have no segments and no current passes from column to column by way of an idle row;
:mod:`._live_law` counts the rest. The laws are linear in D, so that zeros and negative values do no harm.

With kappa_ij = (I' + T C' - W' D) / W (a prime is a derivative by the reading), an error e of the readings changes

    D_ij  by  kappa_ij e_ij + c_ij sum_k kappa_kj e_kj,   c_ij = C_ij / W_ij / (1 - sum_k C_kj / W_kj),
    G_ij / G_ij  by  dD_ij / D_ij + rho_i sum_l dD_il,    rho_i = r_i / (1 - r_i sum_l D_il).

The parts are the cell's own, its column's and its row's. Where several answers give the same
readings, :mod:`._answers` encloses them all.
"""

from __future__ import annotations

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._parts import LEAST_SHORT_OHM
from ..readouts import PortLaw
from ._law_kernels import columns_of, rows_of
from ._tuning import LEAST


class Law:
    """The two laws of one board."""

    def __init__(
        self,
        law: PortLaw,
        lead: FloatArray,
        segments: FloatArray,
        wire: FloatArray,
        beside_end: FloatArray,
        absent: BoolArray,
        shorts: FloatArray,
        error: float,
        *,
        one_by_one: bool,
        floating: bool,
        virtual_ground: bool,
    ) -> None:
        """The laws of a board.

        Args:
            law: of the circuit.
            lead: (N,) ohm, mean of each row from its driver to its cells.
            segments: (N, M) ohm of the rows, up to the first cell and from cell to cell.
            wire: (M,) ohm, mean of each column from its cells to its end.
            beside_end: (N, M) ohm, wire from each cell to its column's end in excess of that mean.
            absent: (N, M) cells that take no part.
            shorts: (N, M) S, D of complete shorts, which are known without a reading; 0 at all other cells.
            error: V, of a reading.
            one_by_one: whether idle columns carry no load.
            floating: whether idle rows float.
            virtual_ground: whether amplifiers hold the columns.

        """
        self.law = PortLaw(*(np.array(np.broadcast_to(part, (2, len(wire))), order="C") for part in law))
        self.lead, self.wire, self.one_by_one = np.array(lead), wire, one_by_one
        (_, i1), (_, c1), (_, w1) = self.law
        self.has_potential = bool(law.potential.any())
        """whether columns leave the potential of the idle lines, so that a cell depends on its whole column"""
        self.has_leads = bool(lead.any())
        self.floating = floating
        self.cancels = virtual_ground and not floating
        """whether columns stand next to the idle lines, so that offsets alone drive currents into their shorts"""
        self.behind: FloatArray = np.abs((c1 - w1 * (not self.has_potential)) / i1)
        """(M,) ohm, potential of a column above the idle lines per current into its end"""
        rows, columns = absent.shape
        self._most = 1.0 / (self.lead + LEAST_SHORT_OHM)  # S, D of a short
        by_reading = np.abs(c1 - w1) / np.abs(self.law.drive[0])
        self._least_left = np.maximum(error * np.sqrt(rows) * by_reading, LEAST)
        per_reading = float(np.abs(i1 / self.law.drive[0]).max())
        self._least_row_left = np.maximum(error * np.sqrt(columns) * per_reading * self.lead, LEAST)
        self._segments, self._beside_end = (np.array(part, order="C") for part in (segments, beside_end))
        self.present = np.ascontiguousarray(~(absent | (shorts > 0.0)))
        self.nowhere: BoolArray = np.zeros(absent.shape, dtype=np.bool_)
        self._shorts = np.array(shorts, order="C")

    def __call__(self, volts: FloatArray) -> FloatArray:
        """Cells (N, M) in S behind readings in V."""
        cells, row_left = np.empty(volts.shape), np.empty(len(volts))
        apart, share, drive, driven = (np.empty(volts.shape) for _ in range(4))
        left, total = (np.empty(volts.shape[1]) for _ in range(2))
        given = np.ascontiguousarray(volts), *self.law, self.present, self.nowhere, self._shorts, self._most
        columns_of.unchecked(*given, self._least_left, apart, share, drive, left, total, driven)
        lines = self.lead, self._segments, self._beside_end, self._least_row_left, self.floating
        rows_of.unchecked(driven, drive, *lines, row_left, cells)
        return cells

    def given(self) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, ...], tuple[FloatArray, ...]]:
        """What the kernels are given of each column (M,), of each row (N,) and of each cell (N, M)."""
        of_rows = self.lead, self._most, self._least_row_left
        return (self._least_left, self.behind), of_rows, (self._shorts, self._segments, self._beside_end)
