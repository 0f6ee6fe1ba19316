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

The parts are the cell's own, its column's and its row's. Errors by which a drive may vanish are no such changes
(:meth:`Law.in_question`, :meth:`Law.may_follow`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._parts import LEAST_SHORT_OHM
from ..readouts import PortLaw

LEAST = 1e-12
"""share of a voltage that counts as none"""
_TIES = 10.0  # cell over the usual one of its column from which on it may be a short
_LEAST_WIRE = 1.0  # ohm of a column between its end and a row that it may lift


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

    def __init__(
        self, law: PortLaw, lead: FloatArray, wire: FloatArray, absent: BoolArray, error: float, *, one_by_one: bool
    ) -> None:
        """The laws of a board.

        Args:
            law: of the circuit.
            lead: (N,) ohm of each row.
            wire: (M,) ohm of each column.
            absent: (N, M) cells that take no part.
            error: V, of a reading.
            one_by_one: whether idle columns carry no load.

        """
        self.wire, self._one_by_one = wire, one_by_one
        (_, i1), (_, c1), (_, w1) = law
        self.behind: FloatArray = np.abs((c1 - w1 * (not law.potential.any())) / i1)
        """(M,) ohm, potential of a column above the idle lines per current into its end"""
        rows, columns = absent.shape
        by_reading = np.abs(law.potential[1] - law.drive[1]) / np.abs(law.drive[0])
        self._least_left = np.maximum(error * np.sqrt(rows) * by_reading, LEAST)
        per_reading = float(np.abs(law.current[1] / law.drive[0]).max())
        self._most = 1.0 / (lead[:, None] + LEAST_SHORT_OHM)  # S, D of a short
        self._least_row_left = np.maximum(error * np.sqrt(columns) * per_reading * lead, LEAST)
        self.law, self.lead = law, lead
        self._present = None if not absent.any() else ~absent
        self._fixed = not law.drive[1].any()
        self.follows = not self._fixed and self.law.potential.any()
        """whether a follower drives the idle lines"""
        self.has_potential = bool(law.potential.any())
        """whether columns leave the potential of the idle lines, so that a cell depends on its whole column"""
        self.has_leads = bool(lead.any())
        drive = law.drive[0] if self._fixed else np.ones(len(law.drive[0]))
        self._current, self._potential = law.current / drive, law.potential / drive

    def __call__(self, volts: FloatArray, unknown: BoolArray | None = None) -> Ports:
        """The conductances behind readings (N, M) in V, of which ``unknown`` ones state bounds only."""
        (i0, i1), (c0, c1), (w0, w1) = self._current, self._potential, self.law.drive
        apart = volts * i1
        apart += i0
        drive = w0
        if not self._fixed:
            drive = w0 + w1 * volts
            apart /= drive
        if self._present is not None:
            apart *= self._present
        if unknown is not None:  # the column's potential counts for no unknown cell, nor more than a short does
            apart = np.where(unknown, np.clip(apart, 0.0, self._most), apart)
        if self.has_potential:
            share = volts * c1
            share += c0
            if not self._fixed:
                share /= drive
            if self._present is not None:
                share *= self._present
            if unknown is not None:
                share = np.where(unknown, 0.0, share)
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
            apart,
            share,
            drive,
            left,
            total,
            driven,
            row_left,
            driven / np.maximum(row_left, self._least_row_left)[:, None],
        )

    def sensitivity(self, ports: Ports, unknown: BoolArray | None = None) -> Sensitivity:
        """Derivatives of a frame's conductances; 0 by ``unknown`` readings (N, M)."""
        (_, i1), (_, c1), (_, w1) = self.law
        slope = (i1 + ports.total * c1) if self._fixed else (i1 + ports.total * c1 - w1 * ports.driven)
        slope = np.abs(slope / ports.drive)
        if unknown is not None:
            slope = np.where(unknown, 0.0, slope)
        return Sensitivity(
            slope,
            ports.share / np.maximum(ports.left, LEAST),
            (self.lead / np.maximum(ports.row_left, LEAST))[:, None],
        )

    def share_slope(self, ports: Ports) -> FloatArray:
        """1/V, size of the derivative of C / W by the reading; broadcasts to (N, M)."""
        (_, c1), (_, w1) = self.law.potential, self.law.drive
        slope: FloatArray = np.abs((c1 - w1 * ports.share) / ports.drive)
        return slope

    def in_question(self, ports: Ports, of_left: FloatArray) -> BoolArray:
        """Columns (M,) of dividers whose scale the readings leave open: more than one may give them.

        While all rows are driven, a column lies ``left`` below the drive, with an error ``of_left``. By reciprocity a
        row then lies r sum(I) below it, per volt, if all columns are loaded at once. The scale of a column is unique if
        the column lies below all rows; else a row may follow it.
        """
        if self._one_by_one:
            return np.zeros(len(of_left), dtype=np.bool_)
        below = float((self.lead * ports.apart.sum(axis=1)).max())
        question: BoolArray = ports.left - of_left < below
        return question

    def may_follow(self, ports: Ports, volts: FloatArray, share: float) -> BoolArray:
        """Cells (N, M) whose row, or column, a follower's own error may lift by this ``share`` of the drive."""
        (i0, i1), (c0, c1), _ = self.law
        above = np.abs((c0 + c1 * volts) - self.wire * (i0 + i1 * volts))  # V, of the column's end above idle lines
        lifted = (self.lead * (above / (self.wire + _LEAST_WIRE)).sum(axis=1))[:, None]
        follows: BoolArray = (lifted > share * np.abs(ports.drive)) | (np.abs(ports.share).sum(axis=0) > share)
        # Two shorts of a row join their columns. Where the follower's error exceeds the drop along a column, they
        # divide all other readings of both, and read like ordinary cells themselves.
        loose = np.abs(c1 - self.wire * i1) > self.wire * np.abs(i1)
        usual = np.sort(ports.driven, axis=0)[(len(ports.driven) - 1) // 2]
        ties = (ports.driven > _TIES * np.maximum(usual, 0.0)) & loose
        ties &= (np.count_nonzero(ties, axis=1) > 1)[:, None]
        if ties.any():
            follows = follows | ties.any(axis=0) | ties.any(axis=1)[:, None]
        return follows

    def at_end(self, ports: Ports, error: float) -> BoolArray:
        """Cells (N, M) of readings whose ``error`` in V may hide the whole drive of their rows."""
        (w0, w1) = self.law.drive
        hidden: BoolArray = (np.abs(ports.drive) < error * np.abs(w1)) | (ports.drive * w0 < 0.0)
        return hidden
