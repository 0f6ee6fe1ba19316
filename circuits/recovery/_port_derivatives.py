"""Products with the derivatives of all readings by all crosspoints, without the matrix of these derivatives.

By the adjoint method the derivative of reading (r, c) by the conductance (i, j) is minus the product of the voltages
that a forward and an adjoint field make across that crosspoint. Both are linear in the potentials of the N + M ports.
With D_ij the voltage across a crosspoint per volt at each port, a product with the derivatives is

    (J v)_rc = -f_rc' L(v) a_rc,      L(v) = sum_ij v_ij D_ij D_ij',

and L is the nodal matrix of a grid with the conductances v. The transposed product is

    (J'w)_ij = -D_ij' (sum_rc w_rc f_rc a_rc') D_ij.

Each takes a few products of matrices with N + M rows; the matrix J has N M rows.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ...common.arrays import FloatArray
from ..readouts import PortFields, QuickFields


class Branches(Protocol):
    """Voltages across the crosspoints of a grid for potentials of its ports."""

    def across(self, field: FloatArray) -> FloatArray:
        """V (K, N, M) across the crosspoints for potentials (K, N + M)."""
        ...

    def inside(self, field: PortFields) -> PortFields:
        """The field as the other methods take it."""
        ...

    def nodal(self, conductance: FloatArray) -> FloatArray:
        """The matrix L (N + M, N + M) of conductances (N, M)."""
        ...

    def gathered(self, matrix: FloatArray) -> FloatArray:
        """D_ij' matrix D_ij (N, M) of a matrix (N + M, N + M)."""
        ...

    def along_rows(self, field: PortFields) -> FloatArray:
        """V (N, M, M) of the field of reading [r, c] across the crosspoint (r, j)."""
        ...

    def down_columns(self, field: PortFields) -> FloatArray:
        """V (M, N, N) of the field of reading (r, c), at [c, r, i], across the crosspoint (i, c)."""
        ...


class IdealLines:
    """Crosspoints between one node per row, behind its lead, and one node per column."""

    def __init__(self, conductance: FloatArray, row_lead: FloatArray) -> None:
        """Take conductances (N, M) in S and leads (N,) in ohm."""
        self._rows = len(conductance)
        self._share = 1.0 / (1.0 + row_lead * conductance.sum(axis=1))
        self._lift = (conductance * (row_lead * self._share)[:, None]).T  # of the rows' nodes, by the columns

    def _nodes(self, field: FloatArray) -> FloatArray:
        """Potentials (K, N + M) of the nodes for those of the ports."""
        nodes = field.copy()
        nodes[:, : self._rows] *= self._share
        nodes[:, : self._rows] += field[:, self._rows :] @ self._lift
        return nodes

    def across(self, field: FloatArray) -> FloatArray:
        nodes = self._nodes(field)
        drop: FloatArray = nodes[:, : self._rows, None] - nodes[:, None, self._rows :]
        return drop

    def inside(self, field: PortFields) -> PortFields:
        return field._replace(of_rows=self._nodes(field.of_rows), of_columns=self._nodes(field.of_columns))

    def nodal(self, conductance: FloatArray) -> FloatArray:
        rows, ports = self._rows, sum(conductance.shape)
        matrix = np.zeros((ports, ports))
        matrix[:rows, rows:] = -conductance
        matrix[rows:, :rows] = -conductance.T
        matrix.flat[:: ports + 1] = np.concatenate([conductance.sum(axis=1), conductance.sum(axis=0)])
        return matrix

    def gathered(self, matrix: FloatArray) -> FloatArray:
        rows, own = self._rows, np.diagonal(matrix)
        result: FloatArray = own[:rows, None] + own[rows:] - matrix[:rows, rows:] - matrix[rows:, :rows].T
        return result

    def along_rows(self, field: PortFields) -> FloatArray:
        rows = self._rows
        by_row = np.diagonal(field.of_rows)[:, None] - field.of_rows[:, rows:]
        by_column = field.of_columns[:, :rows].T[:, :, None] - field.of_columns[:, rows:]
        drops: FloatArray = field.row_share[:, :, None] * by_row[:, None]
        drops += field.column_share[:, :, None] * by_column
        return drops

    def down_columns(self, field: PortFields) -> FloatArray:
        rows = self._rows
        by_row = field.of_rows[:, :rows] - field.of_rows[:, rows:].T[:, :, None]
        by_column = field.of_columns[:, :rows] - np.diagonal(field.of_columns[:, rows:])[:, None]
        drops: FloatArray = field.row_share.T[:, :, None] * by_row
        drops += field.column_share.T[:, :, None] * by_column[:, None]
        return drops


class AnyLines:
    """Crosspoints of any linear grid."""

    def __init__(self, drops: FloatArray) -> None:
        """Take the voltages (N + M, N, M) across the crosspoints per volt at each port."""
        self._drops = drops
        self._flat = drops.reshape(len(drops), -1)

    def across(self, field: FloatArray) -> FloatArray:
        drop: FloatArray = np.tensordot(field, self._drops, axes=1)
        return drop

    def inside(self, field: PortFields) -> PortFields:
        return field

    def nodal(self, conductance: FloatArray) -> FloatArray:
        matrix: FloatArray = (self._flat * conductance.ravel()) @ self._flat.T
        return matrix

    def gathered(self, matrix: FloatArray) -> FloatArray:
        result: FloatArray = np.einsum("pij,pij->ij", np.tensordot(matrix, self._drops, axes=1), self._drops)
        return result

    def along_rows(self, field: PortFields) -> FloatArray:
        by_row = np.einsum("rp,prj->rj", field.of_rows, self._drops)
        by_column = self.across(field.of_columns).swapaxes(0, 1)
        drops: FloatArray = field.row_share[:, :, None] * by_row[:, None]
        drops += field.column_share[:, :, None] * by_column
        return drops

    def down_columns(self, field: PortFields) -> FloatArray:
        by_row = self.across(field.of_rows).transpose(2, 0, 1)
        by_column = np.einsum("cp,pic->ci", field.of_columns, self._drops)
        drops: FloatArray = field.row_share.T[:, :, None] * by_row
        drops += field.column_share.T[:, :, None] * by_column[:, None]
        return drops


class PortDerivatives:
    """Derivatives in V/S of all readings (N, M) by all crosspoints (N, M)."""

    def __init__(self, fields: QuickFields, branches: Branches) -> None:
        """Take the fields of the readings, as potentials of the ports, and what these make across the crosspoints."""
        self._branches = branches
        self._forward, self._adjoint = (branches.inside(field) for field in fields)
        forward, adjoint = self._forward, self._adjoint
        self._row_row = forward.row_share * adjoint.row_share
        self._row_column = forward.row_share * adjoint.column_share
        self._column_row = forward.column_share * adjoint.row_share
        self._column_column = forward.column_share * adjoint.column_share
        self._by_columns = bool(forward.column_share.any())

    def times(self, change: FloatArray) -> FloatArray:
        """V (N, M) by which the readings change if the crosspoints change by ``change`` (N, M) in S."""
        nodal = self._branches.nodal(change)
        forward, adjoint = self._forward, self._adjoint
        current = forward.of_rows @ nodal
        volts: FloatArray = self._row_row * np.einsum("rp,rp->r", current, adjoint.of_rows)[:, None]
        volts += self._row_column * (current @ adjoint.of_columns.T)
        if self._by_columns:
            current = forward.of_columns @ nodal
            volts += self._column_row * (adjoint.of_rows @ current.T)
            volts += self._column_column * np.einsum("cp,cp->c", current, adjoint.of_columns)
        return np.negative(volts, out=volts)

    def transposed_times(self, weight: FloatArray) -> FloatArray:
        """Derivative (N, M) by the crosspoints of the readings' sum with a ``weight`` (N, M) each."""
        forward, adjoint = self._forward, self._adjoint
        by_rows = (weight * self._row_row).sum(axis=1)[:, None] * adjoint.of_rows
        by_rows += (weight * self._row_column) @ adjoint.of_columns
        matrix = forward.of_rows.T @ by_rows
        if self._by_columns:
            by_columns = (weight * self._column_row).T @ adjoint.of_rows
            by_columns += (weight * self._column_column).sum(axis=0)[:, None] * adjoint.of_columns
            matrix += forward.of_columns.T @ by_columns
        result = self._branches.gathered(matrix)
        return np.negative(result, out=result)

    def along_rows(self) -> FloatArray:
        """Derivatives (N, M, M) of reading [r, c] by the crosspoints (r, j) of its row."""
        product = self._branches.along_rows(self._forward) * self._branches.along_rows(self._adjoint)
        return np.negative(product, out=product)

    def down_columns(self) -> FloatArray:
        """Derivatives (M, N, N) of reading (r, c), at [c, r, i], by the crosspoints (i, c) of its column."""
        product = self._branches.down_columns(self._forward) * self._branches.down_columns(self._adjoint)
        return np.negative(product, out=product)
