"""Inverse by Kirchhoff's laws of a grid whose leads take much of the voltage, with propagation of reading errors.

Rows end in leads R_i towards the drivers, columns in leads C_j towards sources s_j (the amplifiers' inputs); segments
have no resistance. I_ij is the current into amplifier j per volt on row i, all other rows at ground. Node potentials
per volt in step i:

    columns   W_ij = s_j + C_j I_ij, measured;
    idle rows U_ki = R_k sum_j G_kj W_ij / (1 + R_k sum_j G_kj), a mean of what the columns feed into row k;
    row i     U_ii = 1 - R_i (sum_j I_ij + sum_k U_ki / R_k): its driver feeds amplifiers and idle rows.

The conductances of column j then solve N linear equations, I_ij = sum_k G_kj (U_ki - W_ij). All columns share the
matrix U up to a term of rank one, so one factorisation serves them all (Sherman and Morrison). The U_ki depend on the
conductances only as means, so a few rounds suffice however heavy the leads are. Line attenuation, whose terms are the
losses of whole lines, does not converge there.

Errors of the readings propagate by the same equations, differentiated (:class:`Propagation`). If shorts join rows,
their potentials U are alike: the equations are nearly singular and the errors large, since other cells give the same
readings.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, cast

import numpy as np
from scipy.linalg.lapack import dgecon, dgesv, dlange, sgecon, sgesv, slange

from ...common.arrays import AnyArray, FloatArray

ROUNDS = 16
"""largest number in one frame; usually three to six"""
MOST_CELLS = 256
"""cells up to which all derivatives of all cells by all readings are made; beyond, bounds that neglect cancellation"""
MOST_IN_DOUBLE = 64
"""cells up to which derivatives are made in double precision; in single precision they take half as long"""
_LEAST_ACCURACY = 0.01  # largest relative rounding error of derivatives; with more they count as infinite
_SHORT = 1e4  # conductance over that of its leads, at which a cell is a short
_LEAST_OHM = 1e-6  # of a line, in _SHORT
_ENOUGH = 1e-6  # relative change of a line's conductance in the last round
_LEAST_VOLTS = 1e-3  # of a driven row, per volt
_LEAST_CHANGE = 1e-300  # S, avoids a division by zero


class LeadFit(NamedTuple):
    """The cells for one set of readings. Arrays are (N, M) unless stated."""

    conductance: FloatArray
    """S"""
    gain: FloatArray
    """conductance per transfer conductance: effect of the leads on the cell's own current"""
    settled: bool
    """whether the last round hardly changed anything"""
    row_ohm: FloatArray
    """(N,) ohm of the rows' leads"""
    column_ohm: FloatArray
    """(M,) ohm of the columns' leads and of the inputs behind them"""
    rows: FloatArray
    """(rows, steps) potentials U per volt"""
    columns: FloatArray
    """(steps, M) potentials W per volt"""
    rounds: int
    """number of rounds that the search has taken"""

    def propagation(self, *, exactly: bool) -> Propagation:
        """Propagation of errors of the readings: ``exactly`` to first order, or by wider bounds."""
        if exactly:
            return _Derivatives(np.abs(self._derivatives()), self.conductance.shape)
        inverse = self._inverses()
        across = self.columns - self.rows[:, :, None]
        return _Bounds(
            inverse=np.abs(inverse, out=inverse),
            into_column=1.0 + self.column_ohm * self.conductance.sum(axis=0),
            column_ohm=self.column_ohm,
            cells=self.conductance,
            row_ohm=self.row_ohm,
            divided=self._divided(),
            across=np.abs(across, out=across),
        )

    def _across(self) -> FloatArray:
        """V (steps, rows, M) across the cells."""
        drops: FloatArray = self.columns[:, None, :] - self.rows.T[:, :, None]
        return drops

    def _divided(self) -> FloatArray:
        """Share (N,) of a current into an idle row that returns through its lead."""
        share: FloatArray = 1.0 / (1.0 + self.row_ohm * self.conductance.sum(axis=1))
        return share

    def _derivatives(self) -> AnyArray:
        """Derivatives (NM, NM) of all conductances by all readings; inf if the readings do not separate the cells."""
        cells, row_ohm, column_ohm = self.conductance, self.row_ohm, self.column_ohm
        count, (steps, columns) = cells.size, cells.shape
        number = np.float64 if count <= MOST_IN_DOUBLE else np.float32
        across = self._across()
        # Effect of a current into idle row k on reading ij: it lifts row k, and takes from the driver of row i.
        lifts = (cells * row_ohm[:, None])[None] - (cells * row_ohm[:, None])[:, None]  # (steps, rows, M)
        lifts *= self._divided()[:, None]
        lifts[np.arange(steps), np.arange(steps)] = 0.0
        by_readings = -np.einsum("ikj,kl->ijl", lifts, cells * column_ohm)
        by_readings += (cells * row_ohm[:, None])[:, :, None]
        np.einsum("ijj->ij", by_readings)[...] += 1.0 + column_ohm * cells.sum(axis=0)
        # Transposed, since LAPACK takes matrices column by column: cell kl, then reading ij.
        lifted: AnyArray = lifts.transpose(1, 0, 2).astype(number)  # (rows, steps, M)
        driven: AnyArray = across.transpose(1, 2, 0).astype(number)  # (rows, M, steps)
        by_cells = lifted[:, None] * driven[..., None]
        own: AnyArray = np.einsum("kjij->kij", by_cells)
        own -= driven.transpose(0, 2, 1)
        sides = np.zeros((steps, columns, steps, columns), number)
        np.einsum("ilim->iml", sides)[...] = by_readings
        return _solution(by_cells.reshape(count, count).T, sides.reshape(count, count).T)

    def _inverses(self) -> FloatArray:
        """(M, rows, steps) of the equations of each column, by the formula of Sherman and Morrison."""
        count = len(self.row_ohm)
        _, _, shared, failed = dgesv(self.rows.T, np.eye(count))
        if failed:
            return np.full((len(self.column_ohm), count, count), np.inf)
        by_column = shared @ self.columns  # (rows, M)
        with np.errstate(divide="ignore"):
            scale = 1.0 / (1.0 - by_column.sum(axis=0))
        inverses: FloatArray = (by_column * scale).T[:, :, None] * shared.sum(axis=0)
        inverses += shared
        return inverses


def _solution(matrix: AnyArray, sides: AnyArray) -> AnyArray:
    """Solution of linear equations, both in column-major order and overwritten; inf if rounding may spoil it."""
    routines = (dgesv, dgecon, dlange) if matrix.dtype == np.float64 else (sgesv, sgecon, slange)
    solve, condition, norm = cast("tuple[Callable[..., Any], ...]", routines)
    size = norm("1", matrix)
    factors, _, solved, failed = solve(matrix, sides, overwrite_a=True, overwrite_b=True)
    if failed or _LEAST_ACCURACY * condition(factors, size)[0] < np.finfo(matrix.dtype).eps:
        return np.full(sides.shape, np.inf)
    found: AnyArray = solved
    return found


class Propagation(Protocol):
    """Maps errors of readings to errors of cells."""

    def squared(self) -> Propagation:
        """The same for variances of independent errors."""
        ...

    def __call__(self, readings: FloatArray) -> FloatArray:
        """S (N, M), first-order error of conductances, in the worst case of all signs.

        Args:
            readings: (N, M) S, errors of the readings.

        Returns:
            inf if the readings do not separate the cells.

        """
        ...


class _Derivatives(NamedTuple):
    """All derivatives of all cells by all readings."""

    sizes: AnyArray
    """(NM, NM) absolute values"""
    shape: tuple[int, int]

    @np.errstate(over="ignore")  # in single precision
    def squared(self) -> Propagation:
        return _Derivatives(self.sizes * self.sizes, self.shape)

    @np.errstate(over="ignore", invalid="ignore")  # infinite derivatives by readings that are certain
    def __call__(self, readings: FloatArray) -> FloatArray:
        spread: FloatArray = (self.sizes @ readings.ravel().astype(self.sizes.dtype)).astype(np.float64)
        return np.nan_to_num(spread, nan=np.inf, posinf=np.inf).reshape(self.shape)


class _Bounds(NamedTuple):
    """Sizes of the terms of Kirchhoff's laws, differentiated; terms that cancel are counted twice."""

    inverse: FloatArray
    """(M, rows, steps) 1/V of each column's equations"""
    into_column: FloatArray
    """(M,) current into a column's cells over that into its amplifier"""
    column_ohm: FloatArray
    """(M,)"""
    cells: FloatArray
    """S (N, M)"""
    row_ohm: FloatArray
    """(N,)"""
    divided: FloatArray
    """(N,) share of a current into an idle row that returns through its lead"""
    across: FloatArray
    """V (rows, steps, M) across the cells"""

    def squared(self) -> Propagation:
        return _Bounds(*(part * part for part in self))

    def __call__(self, readings: FloatArray) -> FloatArray:
        into_rows = (readings * self.column_ohm) @ self.cells.T  # (steps, rows)
        first = self._solved(readings * self.into_column + self._by_rows(into_rows, readings.sum(axis=1)))
        # The conductances' errors move the idle rows, and these move the conductances: a geometric series.
        second = self._solved(self._by_rows(self._into_idle_rows(first)))
        third = self._solved(self._by_rows(self._into_idle_rows(second)))
        with np.errstate(invalid="ignore"):
            ratio = float((third / np.maximum(second, _LEAST_CHANGE)).max())
        if not ratio < 1.0:
            return np.full(readings.shape, np.inf)
        spread: FloatArray = first + second + third / (1.0 - ratio)
        return spread

    def _solved(self, sides: FloatArray) -> FloatArray:
        """S (N, M) for right sides (steps, M) of the columns' equations."""
        solved: FloatArray = (self.inverse @ np.ascontiguousarray(sides.T)[:, :, None])[:, :, 0].T
        return solved

    def _into_idle_rows(self, change: FloatArray) -> FloatArray:
        """A (steps, rows) per volt that changed conductances (N, M) in S feed into the rows."""
        into: FloatArray = (self.across @ np.ascontiguousarray(change)[:, :, None])[:, :, 0].T
        return into

    def _by_rows(self, into_rows: FloatArray, delivered: FloatArray | float = 0.0) -> FloatArray:
        """S (N, M): right sides of the columns' equations where the rows' potentials move.

        Args:
            into_rows: (steps, rows) A per volt, change of what cells feed into each row.
            delivered: (steps,) A per volt, change of the currents into all amplifiers.

        """
        returned = into_rows * self.divided
        np.fill_diagonal(returned, 0.0)
        lifted = returned * self.row_ohm
        np.fill_diagonal(lifted, self.row_ohm * (delivered + returned.sum(axis=1)))
        by_rows: FloatArray = lifted @ self.cells
        return by_rows


def invert_leads(
    current: FloatArray,
    column: FloatArray,
    row_ohm: FloatArray,
    column_ohm: FloatArray,
    start: FloatArray,
    most_rounds: int = ROUNDS,
) -> LeadFit | None:
    """Find the cells with these readings.

    Args:
        current: (N, M) A into the amplifiers per volt of drive.
        column: (N, M) V of the columns per volt of drive.
        row_ohm: (N,) ohm of the rows' leads.
        column_ohm: (M,) ohm of the columns' leads and of the inputs behind them.
        start: (N, M) S, initial conductances.
        most_rounds: rounds after which the search ends, settled or not; at least 1.

    Returns:
        None if no conductances give the readings, or the equations are singular.

    """
    count, columns = current.shape
    delivered = row_ohm * current.sum(axis=1)
    ratio = np.divide.outer(row_ohm, np.maximum(row_ohm, 1e-300))  # R_i / R_k
    most = _SHORT / np.maximum(np.add.outer(row_ohm, column_ohm), _LEAST_OHM)
    conductance, diagonal = start, np.arange(count)
    sides = np.concatenate([current, column], axis=1)
    rounds, settled = 0, False
    while rounds < most_rounds and not settled:
        rounds += 1
        loads = conductance.sum(axis=1)
        rows = (conductance @ column.T) * (row_ohm / (1.0 + row_ohm * loads))[:, None]  # U, (rows, steps)
        rows[diagonal, diagonal] = 0.0
        own = 1.0 - delivered - np.einsum("ik,ki->i", ratio, rows)
        np.maximum(own, _LEAST_VOLTS, out=own)  # the first rounds may ask for more current than there is
        rows[diagonal, diagonal] = own
        _, _, solved, failed = dgesv(rows.T, sides)
        if failed:
            return None
        by_current, by_column = solved[:, :columns], solved[:, columns:]
        with np.errstate(divide="ignore", invalid="ignore"):
            found = by_current + by_column * (by_current.sum(axis=0) / (1.0 - by_column.sum(axis=0)))
        if not np.isfinite(found).all():
            return None
        found = np.clip(found, 0.0, most)
        moved = np.abs(found - conductance).sum(axis=1)
        conductance = found
        settled = bool((moved <= _ENOUGH * loads).all())
    gain = (1.0 + column_ohm * conductance.sum(axis=0)) / own[:, None]
    return LeadFit(conductance, gain, settled, row_ohm, column_ohm, rows, column, rounds)
