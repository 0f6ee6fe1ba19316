"""Cells from readings by Kirchhoff's laws of columns and rows, in closed form, with the errors of the readings.

A circuit states for each reading its current I, its column's potential C and its row's drive W
(:mod:`..readouts._port_law`). The port conductances D between row drivers and columns, their sums T over a column, and
the cells G behind rows of resistance r then follow from two laws:

    W_ij D_ij = I_ij + T_j C_ij,     T_j = sum_i I_ij / W_ij / (1 - sum_i C_ij / W_ij),
    G_ij = D_ij / (1 - r_i sum_l D_il).

Both are exact where lines have no segments and no current passes from column to column by way of an idle row; the rest
is left to :mod:`._live_law`. The laws are linear in D, so that zeros and negative values do no harm.

With kappa_ij = (I' + T C' - W' D) / W (a prime is a derivative by the reading), an error e of the readings changes

    D_ij  by  kappa_ij e_ij + c_ij sum_k kappa_kj e_kj,   c_ij = C_ij / W_ij / (1 - sum_k C_kj / W_kj),
    G_ij / G_ij  by  dD_ij / D_ij + rho_i sum_l dD_il,    rho_i = r_i / (1 - r_i sum_l D_il).

The parts are the cell's own, its column's and its row's.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ..readouts import PortLaw

LEAST = 1e-12
"""share of a voltage that counts as none"""
_TINY = np.finfo(np.float64).tiny


class Ports(NamedTuple):
    """Port conductances of one frame. Arrays broadcast to (N, M) unless stated."""

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


class Sensitivity(NamedTuple):
    """Change of a frame's conductances by errors of the readings. Arrays broadcast to (N, M) unless stated."""

    slope: FloatArray
    """S/V, kappa"""
    by_column: FloatArray
    """c: change of D by a column's sum of all changes"""
    by_row: FloatArray
    """(N, 1) ohm, rho: relative change of G by a row's sum of all changes"""


class Law:
    """The two laws of one board."""

    def __init__(self, law: PortLaw, lead: FloatArray, absent: BoolArray, error: float) -> None:
        """For a circuit, rows behind ``lead`` (N,) in ohm, cells (N, M) that are ``absent``, and readings' error in V."""
        rows, columns = absent.shape
        by_reading = np.abs(law.potential[1] - law.drive[1]) / np.abs(law.drive[0])
        self._least_left = np.maximum(error * np.sqrt(rows) * by_reading, LEAST)
        per_reading = float(np.abs(law.current[1] / law.drive[0]).max())
        self._least_row_left = np.maximum(error * np.sqrt(columns) * per_reading * lead, LEAST)
        self.law, self.lead = law, lead
        self._present = None if not absent.any() else ~absent
        self._fixed = not law.drive[1].any()
        self.has_potential = bool(law.potential.any())
        """whether columns leave the potential of the idle lines, so that a cell depends on its whole column"""
        self.has_leads = bool(lead.any())
        drive = law.drive[0] if self._fixed else np.ones(len(law.drive[0]))
        self._current, self._potential = law.current / drive, law.potential / drive

    def __call__(self, volts: FloatArray) -> Ports:
        """The conductances behind readings (N, M) in V."""
        (i0, i1), (c0, c1), (w0, w1) = self._current, self._potential, self.law.drive
        apart = volts * i1
        apart += i0
        drive = w0
        if not self._fixed:
            drive = w0 + w1 * volts
            apart /= drive
        if self._present is not None:
            apart *= self._present
        if self.has_potential:
            share = volts * c1
            share += c0
            if not self._fixed:
                share /= drive
            if self._present is not None:
                share *= self._present
            left = 1.0 - share.sum(axis=0)
            total = apart.sum(axis=0) / np.maximum(left, self._least_left)
            driven = share * total
            driven += apart
        else:
            share, left, total, driven = c0, np.ones_like(c0), apart.sum(axis=0), apart
        if not self.has_leads:
            return Ports(apart, share, drive, left, total, driven, np.ones(len(volts)), driven)
        row_left = 1.0 - self.lead * driven.sum(axis=1)
        return Ports(
            apart, share, drive, left, total, driven, row_left, driven / np.maximum(row_left, self._least_row_left)[:, None]
        )

    def sensitivity(self, ports: Ports) -> Sensitivity:
        """Derivatives of a frame's conductances."""
        (_, i1), (_, c1), (_, w1) = self.law
        slope = (i1 + ports.total * c1) if self._fixed else (i1 + ports.total * c1 - w1 * ports.driven)
        return Sensitivity(
            np.abs(slope / ports.drive),
            ports.share / np.maximum(ports.left, LEAST),
            (self.lead / np.maximum(ports.row_left, LEAST))[:, None],
        )
