"""Closed-form inverse of boards whose columns are independent of each other.

Columns are independent if the row lines have no resistance and the column lines have none between their cells. An
output then fixes the potential at the cells of its column, and the remaining equations are linear.
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._board import Board
from ..solvers import ULP
from ._inversion import Found
from ._unknown import Unknown


def columns_are_independent(board: Board) -> bool:
    """Whether the row lines have no resistance and the column lines have none between their cells."""
    if not board.circuit.virtual_ground or board.floating or not board.plain:
        return False
    if any(fault.ohms == 0 for fault in board.shorts):
        return False  # a complete short holds its column
    return not (board.row_ohms.any() or board.column_ohms.any())


class Columns(NamedTuple):
    """Closed-form solution for independent columns.

    An output determines the current i of its column and the potential w at the column end of its cells. The selected
    row is at the drive and the other rows are at the reference, so ``i = G drive - w sum(G)`` for each cell G. The sum
    of these equations over the rows gives sum(G), and each equation then gives its own G.
    """

    drive: float
    current: FloatArray
    """(N, M) A"""
    potential: FloatArray
    """(N, M) V against the reference"""
    uncertain: FloatArray
    """(N, M) V: rounding error of ``potential``"""
    rounding: FloatArray
    """(N, M) A: rounding error of ``current``"""
    broken: BoolArray
    """(M,) True where the column's lead is broken"""

    @classmethod
    def of(cls, board: Board, measured: FloatArray) -> Columns:
        level, offset, gain, reference = board.level, board.offset, board.gain, board.reference
        current = (level + offset) / reference + board.bias - measured / (board.loop_share * reference)
        broken = np.isinf(board.column_lead)
        lead = np.where(broken, 0.0, board.column_lead)
        potential = offset - measured / gain + lead * current
        uncertain = 8 * ULP * (np.abs(offset) + np.abs(measured) / gain + np.abs(lead * current))
        noise = np.abs(measured) + np.abs(level) + np.abs(offset) + np.abs(board.lift)
        rounding = 16 * ULP * noise / reference
        return cls(board.drive, current, potential, uncertain, rounding, broken)

    def found(self, limited: BoolArray) -> Found:
        """Solve for all conductances.

        Cells without current get 0. Cells of columns whose readings do not determine them get NaN.

        ``limited`` (N, M) marks readings at a limit. If such a cell would need a negative conductance, the true output
        lies beyond the limit and the apparent current is wrong. Such cells are set to 0 and the others solved again.
        """
        conductance, lost = self._solve(np.zeros_like(limited))
        beyond = limited & (conductance < 0)
        if beyond.any():
            conductance, lost = self._solve(beyond)
        with np.errstate(invalid="ignore"):
            none = conductance <= self.rounding / abs(self.drive)
        conductance[none | self.broken | beyond] = 0.0
        error = np.where(conductance > 0, lost / abs(self.drive), 0.0)
        return Found(conductance, np.abs(self.current) / abs(self.drive), error, beyond, 0.0, 0, 0)

    def _solve(self, without: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Conductances in S with the cells ``without`` open, and the rounding errors in A of their currents."""
        potential = np.where(without, 0.0, self.potential)
        drive, along = abs(self.drive), np.abs(potential).sum(axis=0)
        left = self.drive - potential.sum(axis=0)
        # A short holds its column at the drive potential. The equation for sum(G) is then singular.
        left[np.abs(left) <= 1e-9 * (drive + along)] = np.nan
        back = self.potential * (np.where(without, 0.0, self.current).sum(axis=0) / left)
        lost = self.rounding + 8 * ULP * np.abs(back) * (1.0 + (drive + along) / np.abs(left))
        return (self.current + back) / self.drive, lost

    def spread(self, found: Found, unknown: Unknown, most: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distances in S (N, M) from ``found`` to the lower and the upper end of each interval.

        Unknown cells change the sum of conductances of their column. Each known cell of the column then changes in
        proportion to its potential. ``most`` (N, M) in S is the largest conductance of the unknown cells.
        """
        left = 1.0 - np.sum(self.potential, axis=0, where=~unknown.any) / self.drive
        share = np.divide(1.0, left, out=np.full_like(left, inf), where=left > 0)
        per_sum = np.where(unknown.any, 0.0, self.potential / self.drive)
        either = np.where(unknown.any, 0.0, self.uncertain / abs(self.drive))
        change = [
            np.where(part.any(axis=0), np.sum(by, axis=0, where=part) * share, 0.0)
            for part, by in (
                (unknown.at_least, np.maximum(most - found.conductance, 0.0)),
                (unknown.at_most, found.conductance),
            )
        ]
        up, down = np.maximum(per_sum, 0.0) + either, np.maximum(-per_sum, 0.0) + either
        with np.errstate(invalid="ignore"):  # 0 times inf: at zero potential the sum has no effect
            less, more = (
                np.nan_to_num(a * change[0] + b * change[1], nan=0.0, posinf=inf) for a, b in ((down, up), (up, down))
            )
        return less, more
