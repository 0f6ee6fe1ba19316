"""Second solutions of loaded dividers: a column of good conductors that also feeds a row through that row's lead.

The readings of a divider's column c are to each other as the conductances D_kc between the rows' drivers and the column
are; the column's load tells their scale. A row i with a resistance r_i between driver and crosspoints hangs on the
column the more, the better its cell in the column conducts. If the columns' loads take so much from row i that the row
lies below the column while all rows are driven, the column's deficit d_c from the drive has two parts: what its load
takes, and what it gives to the row. The first falls with the scale and the second rises, so two scales F may give the
same readings, to the last digit.

For a scale F, all other readings stay what they are with

    y_k = (1 - b_k) G_kj + w_k sum_i b_i G_ij,    b_k = F r_k D_kc,    w_k = D_kc / sum D,

y being kept. Then Kirchhoff's current law at column c, all rows driven, is left as one equation for F, whose left side
is concave in F:

    F d_c sum D - sum_j (d_j - d_c) sum_i b_i G_ij(F) - current of the load = 0.

It has the root F = 1, the cells that have been found, and at most one more. Loads of other columns on a row, beside
that of column c, count to first order.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from ...arrays import FloatArray, IntArray
from ._coupled_board import CoupledBoard, Frame, Known
from ._linearised import Base

_NEAR = 4.0  # margin of the quick condition, so that it holds for all cells for which a base serves
_LEAST_SCALE = 1e-6
_NEXT_TO = 0.02  # relative distance of a scale from the present one that linear uncertainties cover
_TO_SHORT = 1e-9  # relative distance from the largest scale, that of a short
_FIRST_ORDER = 1.25  # of what a reading tells, by which the first order may put a cell below zero
_MARGIN = 1.5  # for what the first order leaves out


class SecondScales:
    """Columns of one board that have two scales; dividers whose idle rows are driven and whose idle columns are loaded.

    Columns that float while they are not read take nothing from the rows, so that no row lies below a column.
    """

    def __init__(self, parts: CoupledBoard) -> None:
        """For a board."""
        board = parts.board
        to_driver = parts.lines.to_driver
        self._parts = parts
        self._lead = np.where(np.isfinite(to_driver), to_driver, 0.0)  # (N, M) ohm
        behind = board.reference + board.column_lead
        self._per_reading = np.broadcast_to(behind / board.reference / abs(board.drive), parts.shape[1:])  # 1/V
        per_volt = np.abs(board.circuit.conductance_slope(board, np.zeros(parts.shape)))
        self._per_volt = np.broadcast_to(per_volt, parts.shape)  # S/V
        divides = not (board.floating or board.circuit.has_amplifiers)
        self.applies = divides and board.idle_columns == "load" and bool(self._lead.any())
        """whether there may be second scales"""
        self._kept: tuple[Base | None, bool] = None, False  # whether there may be second scales while a base serves

    def disturb(self, frame: Frame, known: Known, base: Base) -> FloatArray | None:
        """Relative change (n,) of the cells from the set that has been found to others that give the same readings.

        Args:
            frame: the readings.
            known: the cells that have been found for them.
            base: the linear model that served for this.

        Returns:
            None where there are no other sets, as in nearly all frames.

        """
        if self._kept[0] is not base:
            self._kept = base, self._may_lie_below(known)
        if not self._kept[1]:
            return None
        changed: FloatArray | None = None
        for column in self._doubtful(frame, known).tolist():
            other = self._other_sets(frame, known, column)
            if other is not None:
                changed = other if changed is None else np.maximum(changed, other)
        return None if changed is None else _MARGIN * changed.ravel()

    def _other_sets(self, frame: Frame, known: Known, number: int) -> FloatArray | None:
        """Relative change (N, M) of the cells to those that a second scale of a column gives; None: there is none."""
        conductance = self._parts.board.cell_conductance(known.cells)
        column = _Column.at(conductance, self._deficits(known), self._lead, number)
        scales = column.second_scales(float(self._errors(frame)[number]))
        if scales is None:
            return None
        # A row that hangs on the column follows it, and no longer the other columns that lift it through its cells.
        shares = np.delete(self._per_reading * self._signal(known), number, axis=1)
        fed = (self._lead[:, number, None] * column.told) @ shares.T
        np.fill_diagonal(fed, 0.0)
        if not column.allows(scales[0], fed, np.delete(frame.error * self._per_volt, number, axis=1)):
            return None
        return np.maximum(*(column.change(scale, fed) for scale in scales))

    def _signal(self, known: Known) -> FloatArray:
        """(N, M) V, distance of the readings that the model gives for cells from the reference voltage."""
        signal: FloatArray = np.abs(known.volts.reshape(self._parts.shape) - self._parts.board.level)
        return signal

    def _deficits(self, known: Known) -> FloatArray:
        """(M,) by which the columns lie below the drive while all rows are driven, in shares of the drive."""
        deficits: FloatArray = 1.0 - self._per_reading * self._signal(known).sum(axis=0)
        return deficits

    def _may_lie_below(self, known: Known) -> bool:
        """Whether rows may lie below a column while all rows are driven, for cells about these: a quick condition."""
        deficits = self._deficits(known)
        lost = (self._lead / known.cells) @ np.maximum(deficits, 0.0)  # (N,) by the rows' leads, of the drive
        return bool((deficits < _NEAR * lost.sum()).any())

    def _errors(self, frame: Frame) -> FloatArray:
        """(M,) by which the deficits may be off. The errors of a column's readings add up as independent ones do."""
        errors: FloatArray = sqrt(len(self._lead)) * frame.error * self._per_reading
        return errors

    def _doubtful(self, frame: Frame, known: Known) -> IntArray:
        """Numbers of the columns that a short in place of their best conductor would leave with too little current.

        This is :meth:`_Column._excess` at the largest scale, for all columns at once, as if rows had no segments. All
        other columns have one scale, since the excess is concave.
        """
        conductance = self._parts.board.cell_conductance(known.cells)
        driven = conductance / (1.0 + self._lead * conductance)
        total, hangs = driven.sum(axis=0), (self._lead * driven).T
        scale = (1.0 - _TO_SHORT) / np.maximum(hangs.max(axis=1), _TO_SHORT)
        per_own = scale[:, None] * hangs / (1.0 - scale[:, None] * hangs)
        follows = (per_own * driven.T).sum(axis=1) / total
        now = hangs @ conductance  # (M, M) S, what rows that hang on one column bring into the others
        then = ((per_own * (1.0 - hangs)) @ conductance + follows[:, None] * now) / (1.0 + follows)[:, None]
        deficits = self._deficits(known)
        given = ((then - now) * (deficits - deficits[:, None])).sum(axis=1)
        left = ((scale - 1.0) * deficits - scale * self._errors(frame)) * total
        return np.flatnonzero(left < given)


class _Column(NamedTuple):
    """One column, c, and what rows that hang on it bring into the others. Arrays over its N rows or M - 1 others."""

    number: int
    own: FloatArray
    """(N,) S, the column's cells"""
    others: FloatArray
    """(N, M - 1) S, the cells of the other columns"""
    total: float
    """S between the rows' drivers and the column"""
    follows: FloatArray
    """(N,) share of each row's driver in the column's potential, w"""
    hangs: FloatArray
    """(N,) share of the column in each row's potential at the column, b at the present scale"""
    hang: FloatArray
    """(N, M - 1) the same at the other columns, which share a part of the row's wire with this one"""
    told: FloatArray
    """(N, M - 1) S, what readings tell of the other columns' rows, y"""
    deficit: float
    """of the column"""
    rise: FloatArray
    """(M - 1,) from the others' deficits to that of the column"""

    @classmethod
    def at(cls, conductance: FloatArray, deficits: FloatArray, lead: FloatArray, number: int) -> _Column:
        """The column of cells (N, M) in S, given the deficits (M,) and the ohm (N, M) to the rows' drivers."""
        own, others = conductance[:, number], np.delete(conductance, number, axis=1)
        driven = own / (1.0 + lead[:, number] * own)
        total = max(float(driven.sum()), np.finfo(np.float64).tiny)
        shared = np.minimum(lead[:, number, None], np.delete(lead, number, axis=1))
        follows, hangs, hang = driven / total, lead[:, number] * driven, shared * driven[:, None]
        told = (1.0 - hang) * others + follows[:, None] * (hang * others).sum(axis=0)
        deficit = float(deficits[number])
        rise = np.delete(deficits, number) - deficit
        return cls(number, own, others, total, follows, hangs, hang, told, deficit, rise)

    def _brought(self, scale: float, told: FloatArray | None = None) -> FloatArray:
        """S (M - 1,), sum of b_i G_ij over the rows at a scale, for what readings tell (N, M - 1) in S; None: these."""
        told = self.told if told is None else told
        hang = scale * self.hang
        per_own = hang / (1.0 - hang)
        brought: FloatArray = (per_own * told).sum(axis=0) / (1.0 + self.follows @ per_own)
        return brought

    def _excess(self, scale: float, error: float = 0.0) -> float:
        """S: current into the column, by its deficit less an error, beyond that out of it; 0 at a solution."""
        given = float((self._brought(scale) - self._brought(1.0)) @ self.rise)
        return ((scale - 1.0) * self.deficit - scale * error) * self.total - given

    def second_scales(self, error: float) -> tuple[float, float] | None:
        """The nearest and the likeliest other scale with the same readings, where the deficit may be off by ``error``.

        Returns:
            None if there is none up to that of a short.

        """
        most = float(self.hangs.max())
        if most <= 0.0:
            return None
        largest, above, below = (1.0 - _TO_SHORT) / most, 1.0 + _NEXT_TO, 1.0 - _NEXT_TO
        if largest > above and self._excess(above) > 0.0:
            if self._excess(largest, error) > 0.0:
                return None
            return self._root(above, largest, error), self._root(above, largest)
        if self._excess(below) > 0.0 > self._excess(_LEAST_SCALE):
            return self._root(below, _LEAST_SCALE, error), self._root(below, _LEAST_SCALE)
        return None

    def _root(self, near: float, far: float, error: float = 0.0) -> float:
        """The scale between two at which the excess is no more than an error of the deficit makes, or the end there."""
        if self._excess(near, error) <= 0.0:
            return near
        if self._excess(far, error) >= 0.0:
            return far
        return float(brentq(self._excess, near, far, args=(error,)))

    def allows(self, scale: float, fed: FloatArray, error: FloatArray) -> bool:
        """Whether no cell would have to conduct less than nothing.

        Args:
            scale: the other scale.
            fed: as for :meth:`change`.
            error: (N, M - 1) S by which readings may be off.

        """
        brought, by_error = self._brought(scale), self._brought(scale, error)
        by_columns = fed.T @ (self._others(scale) + self.others)
        allowed = _FIRST_ORDER * self.told + error + self.follows[:, None] * by_error + by_columns
        return bool((self.follows[:, None] * brought <= allowed).all())

    def change(self, scale: float, fed: FloatArray) -> FloatArray:
        """Relative change (N, M) of the cells at another scale.

        Args:
            scale: the other scale.
            fed: (N, N) potential of each row, over that of the drive, to which columns lift it while another is driven.

        """
        others = self._others(scale)
        changed = np.abs(others - self.others) + fed.T @ (others + self.others)
        beside = changed / np.maximum(self.others, np.finfo(np.float64).tiny)
        own = scale * (1.0 - self.hangs) / (1.0 - scale * self.hangs)
        return np.insert(beside, self.number, np.abs(own - 1.0), axis=1)

    def _others(self, scale: float) -> FloatArray:
        """S (N, M - 1), cells of the other columns at a scale."""
        own_part = self.told - self.follows[:, None] * self._brought(scale)
        others: FloatArray = np.maximum(own_part, 0.0) / (1.0 - scale * self.hang)
        return others
