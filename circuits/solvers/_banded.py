"""Banded Cholesky factorisation of the nodal matrix, for the transfer conductances of one small grid.

With the nodes numbered row by row of the grid, the nodal matrix has a half bandwidth of twice the number of columns.
For a few hundred crosspoints LAPACK's banded routines are faster than nested dissection (:mod:`._dissection`), whose
bookkeeping dominates there.

Unlike the positive arithmetic of :mod:`._elimination`, Cholesky factorisation subtracts. Digits cancel where the
conductances of the wires far exceed those of the cells. We bound the rounding error of each frame beforehand, and leave
frames with too large a bound to nested dissection.
"""

from __future__ import annotations

from functools import lru_cache
from math import inf

import numpy as np

from ...common.arrays import FloatArray, IntArray
from ._elimination import ULP
from ._ports import Lines

LARGEST = 324  # crosspoints; for larger grids dissection is as fast, and its error bound is sharper
_ROWS_AT_ONCE = 8  # driven rows that are solved together
_SLACK = 1.0 + 1e-6  # covers the rounding errors of the bounds themselves
_ACCEPTED_ERROR = 1e-9  # largest acceptable bound on the relative error; true errors are about a thousand times smaller
_SHARP_ERROR = 2e-11  # below this bound on the relative error, a sharper bound is not worth the time


def transfer(conductance: FloatArray, lines: Lines) -> tuple[FloatArray, FloatArray] | None:
    """Transfer conductances of one frame by banded Cholesky factorisation.

    Args:
        conductance: (N, M) S of the cells.
        lines: the wires, with exits.

    Returns:
        (N, M) S, and a bound (N, M) in S on the rounding errors. None if a part is ideal or broken, or if too many
        digits would cancel.

    """
    from scipy.linalg.lapack import dpbtrf, dtbtrs, dtrtrs

    rows, columns = conductance.shape
    assert lines.exit is not None
    row = lines.row
    column = np.concatenate([lines.column[1:], lines.exit[None]])  # segment behind each crosspoint
    if not all(part.min() > 0.0 and part.max() < np.inf for part in (row, column)) or conductance.max() == np.inf:
        return None
    nodes, width = 2 * rows * columns, 2 * columns
    band = np.zeros((nodes, width + 1))  # its transpose is LAPACK's lower band storage
    at = band.reshape(rows, columns, 2, width + 1)
    total = at[..., 0]
    total[..., 0] = conductance + row
    total[:, :-1, 0] += row[:, 1:]
    total[..., 1] = conductance + column
    total[1:, :, 1] += column[:-1]
    at[..., 0, 1] = -conductance
    at[:, :-1, 0, 2] = -row[:, 1:]
    at[:-1, :, 1, width] = -column[:-1]
    # Cholesky factorisation and two triangular solves give the exact solution for a matrix within 3 gamma |L||L^T| of
    # the given one (Higham, Accuracy and Stability of Numerical Algorithms, theorem 10.4). As in
    # _elimination._lu_rounding, this changes the inverse no more than a change of the diagonal by 12 gamma does. An
    # entry of the inverse changes, relative to itself, by at most the sum of total times impedance over all nodes. The
    # impedance of a node is below the resistance of the wire to the end of its line.
    along_row, along_column = np.cumsum(1.0 / row, axis=1), np.cumsum(1.0 / column[::-1], axis=0)[::-1]
    step = ULP * (12.0 * (width + 1) + 4.0)
    relative = step * ((total[..., 0] * along_row).sum() + (total[..., 1] * along_column).sum()) + 4.0 * ULP
    if not relative <= _ACCEPTED_ERROR:
        return None
    sensitivity = inf
    if relative > _SHARP_ERROR:
        sensitivity = _diagonal_sensitivity(conductance, total, along_row, along_column)
        if sensitivity == inf:  # heavy lines: the bound of dissection is far sharper
            return None
    factor, failed = dpbtrf(band.T, lower=1, overwrite_ab=1)
    if failed:
        return None
    # The right-hand side is zero ahead of the driven row, so that the forward substitution starts there. Only the last
    # row of the grid connects to the exits, so that only the last block of the factor is needed for the columns.
    driven = np.empty((rows, width))
    for first in range(0, rows, _ROWS_AT_ONCE):
        ahead, steps = width * first, np.arange(min(_ROWS_AT_ONCE, rows - first))
        injected = np.zeros((len(steps), nodes - ahead))
        injected[steps, width * steps] = row[first + steps, 0]
        volts, _ = dtbtrs(factor[:, ahead:], injected.T, uplo="L", overwrite_b=1)
        driven[first + steps] = volts[-width:].T
    at_end = np.zeros((width, width))
    down, along = _lower_triangle(width)
    at_end[down, along] = factor[down - along, nodes - width + along]
    out = np.zeros((width, columns))
    out[1::2][np.arange(columns), np.arange(columns)] = column[-1]
    reached, _ = dtrtrs(at_end, out, lower=1)
    result: FloatArray = driven @ reached
    return result, np.minimum(relative * result, step * sensitivity + 2.0 * (width + 4) * ULP * result)


def _diagonal_sensitivity(
    conductance: FloatArray, total: FloatArray, along_row: FloatArray, along_column: FloatArray
) -> float:
    """Bound in S on the sensitivity of transfer conductances to a relative change of the nodal matrix's diagonal.

    The sensitivity is the sum over all nodes of three factors: the diagonal entry, the volts for 1 V at the row, and
    the volts for 1 V at the column (Tellegen's theorem).

    Volts along the driven line are at most 1. Volts on other lines are bounded as in :mod:`._attenuation`. The current
    of a cell lifts the crossing line by at most that current times the resistance of the line's wire. Of this lift at
    most the fraction ``returned`` comes back to lift the line again.

    Args:
        conductance: (N, M) S of the cells.
        total: (N, M, 2) S, the diagonal of the nodal matrix: row nodes and column nodes.
        along_row: (N, M) ohm from each crosspoint to the row's driver.
        along_column: (N, M) ohm from each crosspoint to the column's amplifier.

    Returns:
        inf where ``returned`` is not below one half.

    """
    rows, columns = conductance.shape
    dropped, raised = float((conductance * along_row).max()), float((conductance * along_column).max())
    returned = columns * dropped * rows * raised
    if not returned < 0.5:
        return inf
    off_row, off_column = (
        raised / (1.0 - returned),
        dropped / (1.0 - returned),
    )  # V for 1 V at the row, and at the column
    on_row, on_column = total[..., 0].sum(axis=1), total[..., 1].sum(axis=0)
    sensitivity = (
        on_row.max() * off_column + on_column.max() * off_row + (on_row.sum() + on_column.sum()) * off_row * off_column
    )
    return _SLACK * float(sensitivity)


@lru_cache(maxsize=32)
def _lower_triangle(width: int) -> tuple[IntArray, IntArray]:
    """Indices of the lower triangle, diagonal included."""
    return np.tril_indices(width)
