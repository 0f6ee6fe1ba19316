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

The parts are the cell's own, its column's and its row's. Errors by which a drive may vanish are no such changes
(:meth:`Law.in_question`, :meth:`Law.may_follow`).
"""

from __future__ import annotations

from math import hypot
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._parts import LEAST_SHORT_OHM
from .._sections import Fault
from ..readouts import PortLaw
from ..solvers import siemens
from ._law_kernels import LEAST, columns_of, rows_of

_TIES = 10.0  # cell over the usual one of its column from which on it may be a short
_MOST_BRIDGE = 1e9  # S
_SHORTED = 0.3  # ohm, of all cells of a column in parallel, if they are shorts
_TIED_DOWN = 1.1  # margin for segments
_ROUNDS = 3  # of narrowing bounds


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
        absent: BoolArray,
        shorts: FloatArray,
        bridges: tuple[Fault, ...],
        error: float,
        *,
        one_by_one: bool,
        floating: bool,
        virtual_ground: bool,
        grounded: bool,
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
            bridges: between lines.
            error: V, of a reading.
            one_by_one: whether idle columns carry no load.
            floating: whether idle rows float.
            virtual_ground: whether amplifiers hold the columns.
            grounded: whether idle columns of a divider are grounded.

        """
        self.law = PortLaw(*(np.array(np.broadcast_to(part, (2, len(wire))), order="C") for part in law))
        self.lead, self.wire, self.one_by_one = np.array(lead), wire, one_by_one
        (_, i1), (_, c1), (_, w1) = self.law
        self.has_potential = bool(law.potential.any())
        """whether columns leave the potential of the idle lines, so that a cell depends on its whole column"""
        self.has_leads = bool(lead.any())
        self.follows = bool(w1.any()) and self.has_potential
        """whether a follower drives the idle lines"""
        self.cancels = virtual_ground and not floating
        """whether columns stand next to the idle lines, so that offsets alone drive currents into their shorts"""
        self.ties_down = grounded and self.has_leads
        """whether a short ties its row to the ground while its column is idle"""
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
        self._shorts = np.array(shorts, order="C")

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

    def may_tie_down(self, ports: Ports, of_left: FloatArray) -> BoolArray:
        """Columns (M,) with a cell that may tie its row down to a grounded idle column more than the laws count.

        While its column j is idle, cell (i, j) leaves row i the share x = 1 - r_i D_ij of the drive: at least that of a
        short, and what the readings of other columns l demand, C_il / W_il <= x (1 - sum of the others' C / W). The
        row's other cells are then D_il / x. While column j is read, they take r_i sum_l D_il / x of its drive. Where a
        short explains all that is missing in column j, two scales give the same readings. ``of_left`` is the error of
        what is left of the drive at the columns.
        """
        lead, share = self.lead[:, None], np.maximum(ports.share, 0.0)
        demanded = share / np.maximum(share + np.maximum(ports.left, 0.0), LEAST)
        highest = np.argmax(demanded, axis=1)
        others = np.repeat(demanded.max(axis=1)[:, None], len(self.wire), axis=1)
        rest = demanded.copy()
        rest[np.arange(len(rest)), highest] = 0.0
        others[np.arange(len(rest)), highest] = rest.max(axis=1)
        least = np.maximum(self.wire / np.maximum(lead + self.wire, LEAST), others)
        beside = np.maximum(ports.driven, 0.0)
        beside = beside.sum(axis=1)[:, None] - beside
        missing = ports.apart * lead / np.maximum(1.0 - least, LEAST) + share * lead * beside / np.maximum(least, LEAST)
        tied: BoolArray = (_TIED_DOWN * missing).max(axis=0) > ports.left - of_left
        return tied

    def may_follow(self, ports: Ports, volts: FloatArray, error: float, share: float) -> BoolArray:
        """Cells (N, M) whose row, or column, a follower's own error may lift by this ``share`` of the drive.

        Readings have an ``error`` in V. The end of a column stands e above the idle lines by the follower's error, and
        S to all other lines: then W D = I + S e. Where e is positive, S and D may grow together, up to a short of the
        whole skin. Where it is negative, D is at most I / W, and S at most I / -e.
        """
        (i0, i1), (c0, c1), _ = self.law
        current = i0 + i1 * volts
        above = ((c0 + c1 * volts) - self.wire * current) / ports.drive
        most = 1.0 / (self.wire + self._beside_end.min(axis=0) + _SHORTED)
        lead, lifts = self.lead[:, None], np.abs(above)
        if self.lead.any() and float((self.lead * (most * lifts).sum(axis=1)).max()) > share:
            own = np.maximum(current / ports.drive, 0.0) + error * np.abs(i1 / ports.drive)
            most = np.minimum(most, (own / np.maximum(-above, LEAST * own)).min(axis=0))
            for _ in range(_ROUNDS):
                ends = own + most * np.maximum(above, 0.0)  # S, upper bounds of D between rows and columns' ends
                nodes = ends / np.maximum(1.0 - self.wire * ends.sum(axis=0), LEAST)
                left = np.maximum(1.0 - (lead * nodes).sum(axis=1), LEAST)[:, None]
                most = np.minimum(most, (nodes / left).sum(axis=0))
        lifted = (lead * most * lifts).sum(axis=1)[:, None]
        follows: BoolArray = (lifted > share) | (np.abs(ports.share).sum(axis=0) > share)
        # Two shorts of a row join their columns. Where the follower's error exceeds the drop along a column, they
        # divide all other readings of both, and read like ordinary cells themselves.
        loose = np.abs(c1 - self.wire * i1) > self.wire * np.abs(i1)
        usual = np.sort(ports.driven, axis=0)[(len(ports.driven) - 1) // 2]
        ties = (ports.driven > _TIES * np.maximum(usual, 0.0)) & loose
        ties &= (np.count_nonzero(ties, axis=1) > 1)[:, None]
        if ties.any():
            follows = follows | ties.any(axis=0) | ties.any(axis=1)[:, None]
        return follows

    def feeds(self, ports: Ports, volts: FloatArray, share: float) -> BoolArray:
        """Cells (N, M) of which a short elsewhere in the column may bring, or take, this ``share`` of the current."""
        (i0, i1), (c0, c1), _ = self.law
        above = (c0 + c1 * volts) - self.wire * (i0 + i1 * volts)
        most = 1.0 / (self.wire + self._beside_end.min(axis=0) + _SHORTED)
        fed: BoolArray = most * np.abs(above) > share * np.abs(i0 + i1 * volts)
        return fed

    def at_end(self, ports: Ports, error: float) -> BoolArray:
        """Cells (N, M) of readings whose ``error`` in V may hide the whole drive of their rows."""
        (w0, w1) = self.law.drive
        hidden: BoolArray = (np.abs(ports.drive) < error * np.abs(w1)) | (ports.drive * w0 < 0.0)
        return hidden
