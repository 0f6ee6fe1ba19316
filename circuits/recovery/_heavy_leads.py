"""Cells of a grid whose leads take much of the voltage, from its transfer conductances by Kirchhoff's laws.

Rows end in leads R_i towards the drivers and columns in leads C_j towards the amplifiers; segments have no resistance.
T_ij is the current into amplifier j per volt on row i, all other rows at ground. Node potentials per volt in step i:

    columns   W_ij = C_j T_ij, measured;
    idle rows U_ki = R_k sum_j G_kj W_ij / (1 + R_k sum_j G_kj), a mean of what the columns feed into row k;
    row i     U_ii = 1 - R_i (sum_j T_ij + sum_k U_ki / R_k): its driver feeds amplifiers and idle rows.

The conductances of column j then solve N linear equations, T_ij = sum_k G_kj (U_ki - W_ij). All columns share the
matrix U up to a term of rank one, so one factorisation serves them (Sherman and Morrison). The U_ki depend on the
conductances only as means do, so a few rounds suffice however heavy the leads are. Line attenuation, whose terms are
losses of whole lines, does not converge there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dgesv

from ...arrays import FloatArray

ROUNDS = 8
"""at most, in one inversion"""
_SHORT = 1e4  # conductance over that of its leads, at which a cell is a short
_LEAST_OHM = 1e-6  # of a line, in that
_ENOUGH = 1e-6  # relative change of a line's conductance in the last round


class LeadFit(NamedTuple):
    """Cells of one set of transfer conductances. Arrays are (N, M)."""

    conductance: FloatArray
    """S"""
    gain: FloatArray
    """conductance per transfer conductance, as far as the leads take the cell's own current"""
    settled: bool
    """the last round has hardly changed anything"""


def invert_leads(
    transfer: FloatArray, row_ohm: FloatArray, column_ohm: FloatArray, start: FloatArray
) -> LeadFit | None:
    """The cells that give these transfer conductances.

    Args:
        transfer: (N, M) S.
        row_ohm: (N,) ohm of the rows' leads.
        column_ohm: (M,) ohm of the columns' leads and of what follows them.
        start: (N, M) S, conductances to begin with.

    Returns:
        None where no conductances give them, or the equations are singular.

    """
    count = len(row_ohm)
    column = transfer * column_ohm  # W, (steps, M)
    delivered = row_ohm * transfer.sum(axis=1)
    ratio = np.divide.outer(row_ohm, np.maximum(row_ohm, 1e-300))  # R_i / R_k
    most = _SHORT / np.maximum(np.add.outer(row_ohm, column_ohm), _LEAST_OHM)
    conductance, diagonal = start, np.arange(count)
    sides = np.concatenate([transfer, column], axis=1)
    for _ in range(ROUNDS):
        loads = conductance.sum(axis=1)
        rows = (conductance @ column.T) * (row_ohm / (1.0 + row_ohm * loads))[:, None]  # U, (rows, steps)
        rows[diagonal, diagonal] = 0.0
        own = 1.0 - delivered - np.einsum("ik,ki->i", ratio, rows)
        if (own <= 0.0).any():
            return None
        rows[diagonal, diagonal] = own
        _, _, solved, failed = dgesv(rows.T, sides)
        if failed:
            return None
        by_current, by_column = solved[:, : transfer.shape[1]], solved[:, transfer.shape[1] :]
        found = by_current + by_column * (by_current.sum(axis=0) / (1.0 - by_column.sum(axis=0)))
        found = np.clip(found, 0.0, most)
        moved = np.abs(found - conductance).sum(axis=1)
        conductance = found
        settled = bool((moved <= _ENOUGH * loads).all())
        if settled:
            break
    gain = (1.0 + column_ohm * conductance.sum(axis=0)) / own[:, None]
    return LeadFit(conductance, gain, settled)
