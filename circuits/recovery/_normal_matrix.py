"""Regularised Gauss-Newton steps with the derivatives of all readings by all cells, in instalments of bounded work.

J (n, n) are the derivatives in standard deviations of a reading, s the prior's standard deviations. The inverse of the
normal matrix, P = (J'J + 1/s^2)^-1, is the posterior covariance, and a step is P J' r. P is computed by sweeping (block
Gauss-Jordan elimination, which needs no pivoting for positive definite matrices). All work is done on panels of a few
rows, so that it can be interrupted anywhere. If all of it fits into one instalment, Cholesky's method does it at once,
in a third to a half of that time.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotri

from ...common.arrays import FloatArray

_LEAST = 2**23  # least limit of multiplications in one instalment
_PER_ENTRY = 32  # the same per entry of the matrix, where each step reads all of them anyway
_BLOCK = 32  # unknowns that are swept together
_PER_INSTALMENT, _PER_PRICE = 250.0, 13000.0  # price of an instalment, and multiplications for one unit more
_ROUNDING = 1e-13  # relative rounding error of a sum of products, per unknown: beside shorts, more than the prior adds

DEAR = 300.0
"""price above which a piece of work is an instalment of its own"""
PER_DERIVATIVE = 256
"""multiplications of a matrix product that take as long as one entry of the derivatives"""


class Meter:
    """Counts the work of an instalment in multiplications of matrix products, so that no clock decides."""

    def __init__(self, size: int, *, beside: bool = False) -> None:
        """For a matrix of ``size`` rows, made ``beside`` usual steps that do without it."""
        self.limit = _LEAST if beside else max(_LEAST, _PER_ENTRY * size**2)
        """multiplications in one instalment"""
        self._spent = 0
        self._usual = _PER_INSTALMENT + min(self.limit, (PER_DERIVATIVE + 2 * size) * size**2) / _PER_PRICE
        self._ahead = 0.0

    @property
    def price(self) -> float:
        """Price of the next instalment, see :mod:`._frame_account`."""
        return _PER_INSTALMENT + self._ahead if self._ahead else self._usual

    def is_dear(self, price: float) -> bool:
        """Whether the next piece of work, which is no product, needs an instalment of its own for its price.

        A cheap piece is not counted.
        """
        dear = price > DEAR
        if dear:
            self._ahead, self._spent = price, self.limit
        return dear

    def is_full(self, work: int) -> bool:
        """Whether the instalment ends before ``work`` further multiplications, which then belong to the next one."""
        self._ahead = 0.0
        self._spent += work
        full = self._spent > self.limit and self._spent > work
        if full:
            self._spent = work
        return full


class NormalMatrix:
    """The inverse of the normal matrix, complete after all :meth:`instalments`."""

    def __init__(self, jacobian: FloatArray, prior: FloatArray) -> None:
        """Take J (n, n) and s (n,)."""
        self._jacobian, self._prior = jacobian, prior
        self.inverse = np.zeros_like(jacobian)
        """(n, n): P"""

    def instalments(self, meter: Meter) -> Iterator[None]:
        """Do the work, with a yield whenever an instalment is full."""
        size, matrix = len(self._prior), self.inverse
        at_once = 2 * size**3
        if at_once <= meter.limit:
            if meter.is_full(at_once):
                yield
            if self._invert():
                return
        for block in _slices(size, _BLOCK):
            some = self._jacobian[block]
            yield from _add_product(matrix, some.T, some, meter)
        matrix.flat[:: size + 1] += self._prior**-2.0
        rounding = _ROUNDING * size * np.diagonal(matrix)
        for block in _slices(size, _BLOCK):
            # One block of the sweep; after all blocks the matrix is minus its inverse.
            inner = _inverse(matrix[block, block], rounding[block])
            inner = 0.5 * (inner + inner.T)
            across = matrix[block].copy()
            beside = across.T @ inner
            yield from _add_product(matrix, -beside, across, meter)
            matrix[:, block] = beside
            matrix[block] = beside.T
            matrix[block, block] = -inner
        np.negative(matrix, out=matrix)

    def _invert(self) -> bool:
        """Do all of the work by Cholesky's method. False if rounding has made the matrix indefinite."""
        matrix = self._jacobian.T @ self._jacobian
        matrix.flat[:: len(matrix) + 1] += self._prior**-2.0
        factor, failed = dpotrf(matrix.T, clean=False, overwrite_a=True)
        if not failed:
            inverse, failed = dpotri(factor, overwrite_c=True)
        if failed:
            return False
        # LAPACK writes one triangle of a symmetric matrix.
        self.inverse = np.triu(inverse)
        self.inverse += np.triu(inverse, 1).T
        return True

    def step(self, residual: FloatArray) -> FloatArray:
        """Change (n,) of the unknowns for residuals (n,) in standard deviations."""
        change: FloatArray = self.inverse @ (residual @ self._jacobian)
        return change


def _inverse(matrix: FloatArray, rounding: FloatArray) -> FloatArray:
    """The inverse of a positive definite matrix; where ``rounding`` has made it another one, with that added to it."""
    try:
        inverse = np.linalg.inv(matrix)
    except np.linalg.LinAlgError:
        definite = False
    else:
        definite = bool((np.diagonal(inverse) > 0.0).all())
    return np.asarray(inverse if definite else np.linalg.inv(matrix + np.diag(rounding)), dtype=np.float64)


def _add_product(matrix: FloatArray, left: FloatArray, right: FloatArray, meter: Meter) -> Iterator[None]:
    """Add ``left @ right`` panel by panel."""
    for panel in _slices(len(matrix), max(1, meter.limit // (2 * right.size))):
        if meter.is_full(right.size * (panel.stop - panel.start)):
            yield
        matrix[panel] += left[panel] @ right


def _slices(size: int, length: int) -> Iterator[slice]:
    for start in range(0, size, length):
        yield slice(start, min(start + length, size))
