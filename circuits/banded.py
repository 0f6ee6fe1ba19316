"""Transfer conductances of one small grid by banded Cholesky: for a few crosspoints, dissection is all overhead.

The nodal matrix, row by row of the grid, has a band of twice the number of columns. Unlike :mod:`.ports` this
subtracts, and loses digits where lines are stiff against cells; how many is bounded for each frame, and frames that
would lose too many are left to dissection.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbsv

from .ports import Lines

FloatArray = NDArray[np.float64]

LARGEST = 81  # crosspoints; beyond, dissection is faster
_ULP = float(np.finfo(np.float64).eps) / 2.0
_ACCEPTED = 1e-11  # relative error of a reading


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
    diagonal = total.ravel().copy()
    injected = np.zeros((rows + columns, nodes))
    into = injected.reshape(rows + columns, rows, columns, 2)
    i, j = np.arange(rows), np.arange(columns)
    into[i, i, 0, 0] = row[:, 0]
    into[rows + j, -1, j, 1] = column[-1]
    _, volts, failed = dpbsv(band.T, injected.T, lower=1, overwrite_ab=1, overwrite_b=1)
    if failed:
        return None
    result = column[-1] * volts.T.reshape(rows + columns, rows, columns, 2)[:rows, -1, :, 1]
    # Cholesky and two triangular solves err by at most 3 gamma |L||L^T|, see ports._rounding; in between stand the
    # volts for a drive from the one end and from the other.
    lost = (volts[:, :rows] * diagonal[:, None]).T @ volts[:, rows:]
    error = _ULP * ((9.0 * (width + 1) + 4.0) * lost + 4.0 * result)
    return (result, error) if (error <= _ACCEPTED * result).all() else None
