"""Transfer conductances of one small grid by banded Cholesky: for a few crosspoints, dissection is all overhead.

The nodal matrix, row by row of the grid, has a band of twice the number of columns. Unlike :mod:`._ports` this
subtracts, and loses digits where lines are stiff against cells; how many is bounded for each frame, and frames that
would lose too many are left to dissection.
"""

from __future__ import annotations

from functools import lru_cache
from math import inf

import numpy as np
from scipy.linalg.lapack import dpbtrf, dtbtrs, dtrtrs

from ...arrays import FloatArray, IntArray
from ._elimination import ULP
from ._ports import Lines

LARGEST = 324  # crosspoints; beyond, dissection is as fast and its bound is sharper
_AT_ONCE = 8  # rows solved for together
_SLACK = 1.0 + 1e-6  # for the rounding errors in the bounds themselves
_ACCEPTED = 1e-9  # certified relative error of a reading; the true one is a thousandth of it
_SHARP = 2e-11  # and so good that a closer look is not worth the time


def transfer(conductance: FloatArray, lines: Lines) -> tuple[FloatArray, FloatArray] | None:
    """Transfer conductances (N, M) in S and a bound on the rounding error of each.

    Args:
        conductance: (N, M) S of the cells.
        lines: the wires, with exits.

    Returns:
        None where there are ideal or broken parts, or digits would be lost.

    """
    rows, columns = conductance.shape
    assert lines.exit is not None
    row = lines.row
    column = np.concatenate([lines.column[1:], lines.exit[None]])  # behind each crosspoint
    if not all(part.min() > 0.0 and part.max() < np.inf for part in (row, column)) or conductance.max() == np.inf:
        return None
    nodes, width = 2 * rows * columns, 2 * columns
    band = np.zeros((nodes, width + 1))  # as LAPACK's (width + 1, nodes) in its order of memory
    at = band.reshape(rows, columns, 2, width + 1)
    total = at[..., 0]
    total[..., 0] = conductance + row
    total[:, :-1, 0] += row[:, 1:]
    total[..., 1] = conductance + column
    total[1:, :, 1] += column[:-1]
    at[..., 0, 1] = -conductance
    at[:, :-1, 0, 2] = -row[:, 1:]
    at[:-1, :, 1, width] = -column[:-1]
    # Cholesky and two triangular solves are exact for a matrix within 3 gamma |L||L^T|, at most 4 diag(A) in effect,
    # see elimination._rounding. That moves an entry of the inverse, relative to it, by no more than the sum over the
    # nodes of total times own impedance, and that impedance is less than what the wire to the end of the line has.
    along_row, along_column = np.cumsum(1.0 / row, axis=1), np.cumsum(1.0 / column[::-1], axis=0)[::-1]
    step = ULP * (12.0 * (width + 1) + 4.0)
    relative = step * ((total[..., 0] * along_row).sum() + (total[..., 1] * along_column).sum()) + 4.0 * ULP
    if not relative <= _ACCEPTED:
        return None
    lifted = inf
    if relative > _SHARP:
        lifted = _lifted(conductance, total, along_row, along_column)
        if lifted == inf:  # lines so heavy that dissection's bound is far better
            return None
    factor, failed = dpbtrf(band.T, lower=1, overwrite_ab=1)
    if failed:
        return None
    # Nothing is there ahead of the row that is driven, and only the last row of the grid meets the exits: of their side
    # of the factor the last block is enough.
    driven = np.empty((rows, width))
    for first in range(0, rows, _AT_ONCE):
        ahead, steps = width * first, np.arange(min(_AT_ONCE, rows - first))
        injected = np.zeros((len(steps), nodes - ahead))
        injected[steps, width * steps] = row[first + steps, 0]
        volts, _ = dtbtrs(factor[:, ahead:], injected.T, uplo="L", overwrite_b=1)
        driven[first + steps] = volts[-width:].T
    at_end = np.zeros((width, width))
    down, along = _lower(width)
    at_end[down, along] = factor[down - along, nodes - width + along]
    out = np.zeros((width, columns))
    out[1::2][np.arange(columns), np.arange(columns)] = column[-1]
    reached, _ = dtrtrs(at_end, out, lower=1)
    result: FloatArray = driven @ reached
    return result, np.minimum(relative * result, step * lifted + 2.0 * (width + 4) * ULP * result)


def _lifted(conductance: FloatArray, total: FloatArray, along_row: FloatArray, along_column: FloatArray) -> float:
    """Bound in S, for any row and column, on the sum over all nodes of their diagonal entry, their volts for 1 V at the
    row, and their volts for 1 V at the column: so much can a change of the matrix by its own diagonal do.

    Volts along the driven line are at most 1. What stands on others is bounded as in :mod:`._attenuation`: the current
    of a cell lifts the crossing line by no more than over that line's wire, and what comes back of such a lift is at
    most ``returned`` of it.
    """
    rows, columns = conductance.shape
    dropped, raised = float((conductance * along_row).max()), float((conductance * along_column).max())
    returned = columns * dropped * rows * raised
    if not returned < 0.5:
        return inf
    off_row, off_column = raised / (1.0 - returned), dropped / (1.0 - returned)  # for 1 V at the row, at the column
    on_row, on_column = total[..., 0].sum(axis=1), total[..., 1].sum(axis=0)
    lifted = (
        on_row.max() * off_column + on_column.max() * off_row + (on_row.sum() + on_column.sum()) * off_row * off_column
    )
    return _SLACK * float(lifted)


@lru_cache(maxsize=32)
def _lower(width: int) -> tuple[IntArray, IntArray]:
    return np.tril_indices(width)
