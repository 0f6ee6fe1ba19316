"""Gauss-Newton steps on boards with floating rows, by preconditioned conjugate gradients.

With floating idle rows a reading depends on all cells, but much more on its own cell and on those of its row and its
column than on the rest: every other path leads through at least three cells. Within one row or column the derivatives
by the cells' shares are nearly a product of two vectors, so that

    J ~ diag(d) + P Q',        P, Q (N M, N + M), with two numbers per row: one for its row, one for its column.

The normal matrix of a regularised step, J'J + w, is then a diagonal A = d^2 + w plus a product of rank 2 (N + M). By
Woodbury's identity its inverse takes one inversion of a matrix of that size,

    H^-1 = A^-1 - A^-1 V W V' A^-1,    V = (d P, Q),
    W^-1 = (-P' (w/A) P,  1 + P' (d/A) Q;  1 + Q' (d/A) P,  Q' (1/A) Q).

The posterior variances are the diagonal of this inverse. A step needs J itself: products with it
(:mod:`._port_derivatives`) within conjugate gradients, with the structured inverse as the preconditioner. They converge
in two to eight iterations, whatever the size, and the matrix J is never formed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...common.arrays import FloatArray
from .._board import Board, broken_off
from ._law_kernels import TINY
from ._port_derivatives import PortDerivatives
from ._quick_model import QuickModel
from ._tuning import BY_STEPS, ITERATIONS, LEAST_REST, LINE_FITS, PER_TIE, STRUCTURE_MARGIN, TOLERANCE

WITHIN = BY_STEPS**2
"""inverse of the variance of a share before anything is read: shares are from 0 to 1"""


class _Lines(NamedTuple):
    """A matrix (N M, N + M) with two numbers per row: for the cell's row and for its column; (N, M) each."""

    rows: FloatArray
    columns: FloatArray

    def times(self, each: FloatArray) -> FloatArray:
        """Product (N, M) with a vector (N + M,)."""
        count = len(self.rows)
        result: FloatArray = self.rows * each[:count, None] + self.columns * each[count:]
        return result

    def gathered(self, values: FloatArray) -> FloatArray:
        """Transposed product (N + M,) with (N, M)."""
        return np.concatenate([np.einsum("ij,ij->i", self.rows, values), np.einsum("ij,ij->j", self.columns, values)])

    def gram(self, weight: FloatArray, other: _Lines) -> FloatArray:
        """(N + M, N + M): self' diag(weight) other."""
        rows, columns = self.rows.shape
        here, there = self.rows * weight, self.columns * weight
        result = np.zeros((rows + columns, rows + columns))
        result[:rows, rows:] = here * other.columns
        result[rows:, :rows] = (there * other.rows).T
        result.flat[:: rows + columns + 1] = np.concatenate(
            [np.einsum("ij,ij->i", here, other.rows), np.einsum("ij,ij->j", there, other.columns)]
        )
        return result

    def quadratic(self, matrix: FloatArray, other: _Lines) -> FloatArray:
        """Diagonal (N, M) of self matrix other'."""
        count, own = len(self.rows), np.diagonal(matrix)
        result: FloatArray = self.rows * other.rows * own[:count, None] + self.columns * other.columns * own[count:]
        result += self.rows * other.columns * matrix[:count, count:]
        result += self.columns * other.rows * matrix[count:, :count].T
        return result


class NodeStep:
    """The regularised inverse of the derivatives at one point. Arrays of cells are (N, M)."""

    def __init__(
        self,
        derivatives: PortDerivatives,
        conductance: FloatArray,
        per_share: FloatArray,
        noise: float,
    ) -> None:
        """Invert the structured normal matrix.

        Args:
            derivatives: V/S of the readings.
            conductance: S of the crosspoints.
            per_share: S of a crosspoint by the share of its cell.
            noise: V, standard deviation of a reading.

        Raises:
            numpy.linalg.LinAlgError: the derivatives are not finite.

        """
        self._derivatives, self._noise = derivatives, noise
        self._scale = scale = per_share / noise  # of a derivative, to standard deviations per share
        along = derivatives.along_rows() * scale[:, None, :]
        down = derivatives.down_columns() * scale.T[:, None, :]
        by_row, by_column = _product_of_vectors(along), _product_of_vectors(down)
        first = _Lines(by_row[0], by_column[0].T)
        second = _Lines(by_row[1], by_column[1].T)
        own = np.einsum("ijj->ij", along) - first.rows * second.rows - first.columns * second.columns
        free = 1.0 / (own**2 + WITHIN)
        self._own, self._free, self._second = own, free, second
        self._own_first = _Lines(own * first.rows, own * first.columns)
        corner = np.eye(len(own) + len(own[0])) + first.gram(own * free, second)
        whole = np.block([[-first.gram(WITHIN * free, first), corner], [corner.T, second.gram(free, second)]])
        if not np.isfinite(whole).all():
            raise np.linalg.LinAlgError("derivatives that are not finite")
        self._inner = inner = np.linalg.inv(whole)
        information = np.einsum("iab,iab->ib", along, along) + np.einsum("jab,jab->jb", down, down).T
        information += WITHIN - np.einsum("ijj->ij", along) ** 2
        variance = np.maximum(free - free**2 * self._quadratic(inner), 1.0 / information)
        std = np.sqrt(variance)
        self.std: FloatArray = STRUCTURE_MARGIN * std * (1.0 + PER_TIE * tied(conductance))
        """posterior standard deviation of the shares"""

    def _quadratic(self, matrix: FloatArray) -> FloatArray:
        """Diagonal (N, M) of V matrix V', for a symmetric matrix."""
        half = len(matrix) // 2
        result = self._own_first.quadratic(matrix[:half, :half], self._own_first)
        result += 2.0 * self._own_first.quadratic(matrix[:half, half:], self._second)
        result += self._second.quadratic(matrix[half:, half:], self._second)
        return result

    def _preconditioned(self, normal: FloatArray) -> FloatArray:
        """The structured inverse of the normal matrix, times (N, M)."""
        free: FloatArray = self._free * normal
        half = len(self._inner) // 2
        along = self._inner @ np.concatenate([self._own_first.gathered(free), self._second.gathered(free)])
        free -= self._free * (self._own_first.times(along[:half]) + self._second.times(along[half:]))
        return free

    def _normal(self, change: FloatArray) -> FloatArray:
        """The normal matrix itself, times (N, M)."""
        readings = self._derivatives.times(self._scale * change)
        image: FloatArray = self._scale * self._derivatives.transposed_times(readings)
        image += WITHIN * change
        return image

    def solve(self, volts: FloatArray, longest: float) -> FloatArray:
        """Change (n,) of the shares for a difference (n,) of the readings in V, shortened to a limit."""
        apart = volts.reshape(self._scale.shape) / self._noise
        residual = self._scale * self._derivatives.transposed_times(apart)
        direction = preconditioned = self._preconditioned(residual)
        gain = begun = float(np.vdot(residual, preconditioned))
        change = np.zeros_like(residual)
        for _ in range(ITERATIONS):
            if gain <= TOLERANCE**2 * begun:
                break
            image = self._normal(direction)
            length = gain / float(np.vdot(direction, image))
            change += length * direction
            residual -= length * image
            preconditioned = self._preconditioned(residual)
            before, gain = gain, float(np.vdot(residual, preconditioned))
            direction = preconditioned + (gain / before) * direction
        flat: FloatArray = change.ravel() * min(1.0, longest / max(float(np.abs(change).max()), TINY))
        return flat


class NodeBlocks:
    """Makes a :class:`NodeStep` for a board at any cells."""

    def __init__(self, board: Board, model: QuickModel, noise: float) -> None:
        """Take the board, its model, and V of noise of a reading."""
        self._board, self._model, self._noise = board, model, noise
        # Beside a complete break, parts of the grid have no connection.
        self.applies = bool(board.plain and board.floating and not broken_off(board).any())
        if self.applies:
            self.applies = model.products(np.full(board.shape, 1e4)) is not None
        """whether there is a fast way to products with the derivatives"""

    def at(self, cells: FloatArray, per_share: FloatArray) -> NodeStep:
        """The step at cells (N, M) in ohm, whose crosspoints change by ``per_share`` (N, M) in S with their shares."""
        derivatives = self._model.products(cells)
        assert derivatives is not None
        conductance = self._board.cell_conductance(cells)[:, -cells.shape[1] :]  # without the pull-downs
        return NodeStep(derivatives, conductance, per_share, self._noise)


def tied(conductance: FloatArray) -> FloatArray:
    """How strongly each crosspoint (N, M) is in parallel with another one with which it shares at most one line.

    A crosspoint that conducts much more than the rest of its lines ties these lines to each other. Two such crosspoints
    put others in parallel: (r, j) and (i, c) do so with (r, c) and (i, j); (r, j) and (i, j) with (r, c) and (i, c) for
    every c; and likewise for columns. The measure is the conductance of the ties over that of the rest of their lines:
    for ties of 30 and a rest of 1, the structure gives a sixth of the true standard deviation.
    """
    along, down = conductance.sum(axis=1, keepdims=True), conductance.sum(axis=0)
    tie = conductance / np.maximum(np.minimum(along, down) - conductance, LEAST_REST * conductance)
    in_row, in_column = _most_of_others(tie), _most_of_others(tie.T).T
    crossed: FloatArray = np.minimum(in_row, in_column)
    np.maximum(crossed, np.minimum(tie, in_column).max(axis=1, keepdims=True), out=crossed)
    np.maximum(crossed, np.minimum(tie, in_row).max(axis=0), out=crossed)
    return crossed


def _most_of_others(values: FloatArray) -> FloatArray:
    """Largest of the other values in each row (K, a), 0 if there is none."""
    most = values.argmax(axis=1, keepdims=True)
    largest = np.take_along_axis(values, most, axis=1)
    others = np.repeat(largest, values.shape[1], axis=1)
    rest = values.copy()
    np.put_along_axis(rest, most, 0.0, axis=1)
    np.put_along_axis(others, most, rest.max(axis=1, keepdims=True), axis=1)
    return others


def _product_of_vectors(blocks: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Vectors p and q (K, a) with p q' close to the matrices (K, a, a), whose diagonals do not count."""
    beside = blocks.copy()
    np.einsum("kaa->ka", beside)[:] = 0.0
    first = np.ones(blocks.shape[:2])
    for _ in range(LINE_FITS):
        second = _divided(np.einsum("kab,ka->kb", beside, first), _of_others(first))
        first = _divided(np.einsum("kab,kb->ka", beside, second), _of_others(second))
    return first, second


def _of_others(values: FloatArray) -> FloatArray:
    """Sums of squares (K, a) of all values but the own one."""
    squares = values**2
    others: FloatArray = squares.sum(axis=1, keepdims=True) - squares
    return others


def _divided(values: FloatArray, by: FloatArray) -> FloatArray:
    """Quotients, 0 where there is nothing to divide by."""
    return np.divide(values, by, out=np.zeros_like(values), where=by > 0)
