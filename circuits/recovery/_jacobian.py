"""LU factorisation of the Jacobian of all readings by all cells, and the errors that its inverse propagates.

The error of a cell is the error of the readings times an amplification: the norm of the cell's row of the inverse. We
estimate this norm from solutions whose right-hand sides are random vectors of +1 and -1, as in Hutchinson's trace
estimator (1990). The mean square of a cell's solutions has the square of the norm as its expectation.
"""

from __future__ import annotations

import warnings
from math import inf

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...errors import SolverError
from .._board import Board
from .._sensitivity import board_sensitivity

_SIGNS = 16  # random sign vectors for the amplification; they give the norm to about a quarter


class Factor:
    """LU factorisation of the Jacobian of all readings by all cells, in scaled units. Cells may be left out."""

    def __init__(
        self, board: Board, conductance: FloatArray, unit: FloatArray, per_volt: FloatArray, live: BoolArray
    ) -> None:
        """Compute the Jacobian and factor it. All arrays are (N, M).

        Args:
            board: the board, without supply limits or with outputs at them.
            conductance: S, where the derivatives are taken.
            unit: S, the unit of each cell's change.
            per_volt: units of each reading per volt.
            live: True for the cells of the Jacobian.

        """
        from scipy.linalg import LinAlgWarning, lu_factor

        with np.errstate(divide="ignore"):
            found = board_sensitivity(board, 1.0 / conductance)
        used = live.ravel()
        self.shape = live.shape
        jacobian = (found.cell_conductance * unit * per_volt[..., None, None]).reshape(used.size, used.size)
        jacobian[~used] = 0.0
        jacobian[:, ~used] = 0.0
        jacobian[~used, ~used] = 1.0
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LinAlgWarning)  # solve() recognises a singular matrix
            self._lu = lu_factor(jacobian, overwrite_a=True, check_finite=False)

    def solve(self, off: FloatArray, live: BoolArray) -> FloatArray:
        """Changes (N, M) of the live cells for the differences ``off`` (N, M) of the readings.

        Raises:
            SolverError: the Jacobian is singular.

        """
        step = self._back_substitute(off.ravel()).reshape(off.shape)
        if not np.isfinite(step).all():
            raise SolverError("the readings do not determine the cells: other resistances would give the same ones")
        return np.where(live, step, 0.0)

    def inverse(self) -> FloatArray:
        """Inverse Jacobian (NM, NM); inf where the matrix is singular."""
        inverse = self._back_substitute(np.eye(len(self._lu[0])))
        return np.where(np.isfinite(inverse), inverse, inf)

    def spread(self, errors: FloatArray) -> FloatArray:
        """Estimate the standard deviations of the cells for independent errors of the readings.

        The estimate uses random sign vectors, see the module docstring.

        Args:
            errors: (K, N, M), standard deviations of the readings for each of K kinds of error.

        Returns:
            (K, N, M); inf where the Jacobian is singular.

        """
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (len(errors), _SIGNS, len(self._lu[0])))
        right = (signs * errors.reshape(len(errors), 1, -1)).reshape(-1, len(self._lu[0])).T
        size: FloatArray = np.sqrt((self._back_substitute(right).reshape(-1, len(errors), _SIGNS) ** 2).mean(axis=-1))
        return np.where(np.isfinite(size), size, inf).T.reshape(errors.shape)

    def _back_substitute(self, right: FloatArray) -> FloatArray:
        from scipy.linalg import lu_solve

        with np.errstate(all="ignore"):
            answers: FloatArray = lu_solve(self._lu, right, check_finite=False)
        return answers
