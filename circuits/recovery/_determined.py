"""Which cells the readings of a board determine at all, judged by the Jacobian at equal cells or at recovered ones."""

from __future__ import annotations

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._board import Board
from .._sensitivity import LARGEST, board_sensitivity

LARGEST_MATRIX = 1024  # cells: above this size a singular value decomposition of the Jacobian takes too long
TYPICAL_CONDUCTANCE = 1e-4  # S of every cell when the design alone is tested for determined cells
_INSENSITIVE = 1e-6  # sensitivity of a reading to its own cell over the ideal one, below which it is rounding


def insensitive(board: Board, conductance: FloatArray) -> BoolArray:
    """(N, M) cells that their own readings do not depend on, because parts of 0 ohm fix both of their lines.

    All False where no derivatives are available: continuous sheets, and more than 64 x 64 cells.
    """
    if board.continuous or conductance.size > LARGEST:
        return np.zeros(board.shape, dtype=np.bool_)
    with np.errstate(divide="ignore"):
        found = board_sensitivity(board, 1.0 / conductance)
    own = np.einsum("ijij->ij", found.cell_conductance)
    ideal = np.abs(board.circuit.conductance_slope(board, found.volts - board.level))
    return np.asarray(np.abs(own) * ideal < _INSENSITIVE)


def is_singular(board: Board, live: BoolArray) -> bool:
    """Whether the Jacobian of the readings by the cells ``live`` (N, M) is singular.

    The Jacobian is taken at equal cells, and judged by its singular values. False where it is not available.
    """
    if board.continuous or live.size > LARGEST_MATRIX:
        return False
    found = board_sensitivity(board, np.full(board.shape, 1.0 / TYPICAL_CONDUCTANCE))
    some = live.ravel()
    jacobian = found.cell_conductance.reshape(live.size, live.size)[np.ix_(some, some)]
    values = np.linalg.svd(jacobian, compute_uv=False)
    return bool(len(values) and values[-1] <= _INSENSITIVE * values[0])
