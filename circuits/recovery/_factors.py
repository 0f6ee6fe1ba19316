"""Factors between the cells and what the laws of columns and rows make of their readings in the full model.

G = rho law(y), with rho = G / law(F(G)) for the full model F of a board: segments, faults, sheets, currents
that return by way of idle rows. To first order rho depends on the sums of a cell's row and column. Its error after a
change of the cells is estimated from these sums. When the estimate exceeds a share of the uncertainty, rho is made
anew, by a fixed-point iteration with the acceleration of Anderson (1965) of depth two and a fixed number of evaluations
of F in a frame.

It ends by its error, not by its step. Cells that differ by e from those that give the readings leave a residual K e of
the logarithms, with the derivatives K of law(F(G)), which are far below 1 where heavy leads take most of a drive. The
error of a step is estimated twice, and the larger estimate counts: from the first-order change of rho, and from the
secants of the iteration, whose accelerated step solves for e. It is part of the stated uncertainty.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...errors import SolverError
from ._law import Law
from ._law_kernels import couple, move
from ._tuning import EXPONENTS, FIRST_EVALUATIONS, FRESH, LEAST_FACTOR, MOST_FACTOR, OPEN, REGULAR, ROUGHLY, STRIDE

_TINY = np.finfo(np.float64).tiny


class Kept(NamedTuple):
    """The factors of one board's cells, and where they were made. Arrays are (N, M) in line coordinates."""

    rho: FloatArray
    added: FloatArray
    """S, what takes the place of a factor far from 1"""
    base: FloatArray
    """S, cells at which they were made"""
    beyond: FloatArray
    """how far above 1 they were there"""
    row_sums: FloatArray
    """(N,) S of the base"""
    column_sums: FloatArray
    """(M,) S"""
    coupling: FloatArray
    """(M,) factors by which columns may differ, though they do not where cells are equal"""


class Factors:
    """Makes the factors of one board."""

    def __init__(
        self, kept: Kept, law: Law, law_of_model: Callable[[FloatArray], FloatArray], evaluations: int
    ) -> None:
        """Begin with factors of 1.

        Args:
            kept: written whenever factors are made.
            law: of the board.
            law_of_model: law(F(G)) in S of cells G in S.
            evaluations: of ``law_of_model`` in a frame.

        """
        self.kept, self._law, self._evaluations = kept, law_of_model, evaluations
        self._lines = law.lead, law.behind, law.floating
        kept.rho[...], kept.added[...], kept.coupling[...] = 1.0, 0.0, 0.0
        self.known = False
        """whether factors have been made"""
        self._astray, self._begun = True, False

    @property
    def hold(self) -> bool:
        """Whether they serve for other frames."""
        return self.known and not self._astray

    def __call__(
        self,
        by_law: FloatArray,
        uncertainty: Callable[[FloatArray], FloatArray],
        error: FloatArray,
        counted: BoolArray,
        limit: float,
    ) -> tuple[FloatArray, FloatArray, bool]:
        """Make the factors anew: cells in S, their relative error by what is left, and whether they have settled.

        Args:
            by_law: S, law(y) of the frame's readings y.
            uncertainty: relative, of such cells.
            error: relative, of ``by_law``.
            counted: cells that have readings.
            limit: uncertainty up to which cells matter.

        """
        kept = self.kept
        cells, before = kept.rho * by_law + kept.added, list[tuple[FloatArray, FloatArray]]()
        evaluations = self._evaluations if self._begun else FIRST_EVALUATIONS
        self._begun = True
        for _ in range(evaluations):
            cells = np.maximum(cells, OPEN)
            try:
                again = self._law(cells)
            except (SolverError, np.linalg.LinAlgError):
                self.known, self._astray = False, True
                return cells, np.full(cells.shape, inf), False
            new = self._correct(cells, again, by_law)
            allowed = uncertainty(new)
            matters = counted & (allowed <= limit)
            change = np.abs(np.maximum(new, OPEN) - cells)  # a negative reading is that of an open cell
            left, scratch = np.empty(cells.shape), np.empty(cells.shape[1])
            sums = kept.coupling, kept.row_sums, kept.column_sums
            move.unchecked(change * counted, new, kept.base, kept.beyond, kept.added, *sums, matters, scratch, left)
            log = np.log(cells)
            step = np.log(np.maximum(new, 1e-3 * cells)) - log
            further = accelerated(log, step, before, matters)
            left = np.maximum(left, np.abs(np.expm1(np.clip(further - step, -STRIDE, STRIDE))))
            loads = change > ROUGHLY * np.minimum(error, 1.0) * np.maximum(np.abs(by_law), cells)
            if not (counted & np.where(matters, left > FRESH * allowed, loads)).any():
                self._astray = not matters.any()
                return new, left, True
            further = np.where(matters, further, 0.5 * np.clip(step, -STRIDE, STRIDE))
            before.append((log, step))
            cells = np.where(counted, np.exp(np.clip(log + further, *EXPONENTS)), new)
        self._astray = True
        return cells, np.full(cells.shape, inf), False

    def _correct(self, cells: FloatArray, again: FloatArray, by_law: FloatArray) -> FloatArray:
        """Make the factors at ``cells``, of which the law makes ``again`` in the model; the corrected cells."""
        kept = self.kept
        ratio = cells / np.where(again > 0.0, again, inf)
        usual = (ratio > LEAST_FACTOR) & (ratio < MOST_FACTOR) & (by_law > 0.0)
        kept.rho[...], kept.added[...] = np.where(usual, ratio, 1.0), np.where(usual, 0.0, cells - again)
        # What adds is as steep as a factor, if there is one, else as beside other cells.
        kept.base[...] = cells
        kept.beyond[...] = np.where((again > 0.0) & (by_law > 0.0), ratio, kept.rho) - 1.0
        if not usual.all():
            size = np.abs(kept.beyond)
            kept.beyond[~usual] = np.maximum(size, size[usual].max(initial=0.0))[~usual]
        kept.row_sums[...], kept.column_sums[...] = cells.sum(axis=1), cells.sum(axis=0)
        kept.coupling[...] = 0.0
        couple.unchecked(cells, *self._lines, kept.coupling)
        self.known = True
        corrected: FloatArray = kept.rho * by_law + kept.added
        return corrected


def accelerated(
    place: FloatArray, step: FloatArray, before: list[tuple[FloatArray, FloatArray]], counted: BoolArray
) -> FloatArray:
    """The step of a fixed-point iteration at a ``place``, by the places and steps ``before``."""
    recent = before[-2:]
    if not recent:
        return step
    changes = [step - old for _, old in recent]
    weighted = np.array([np.where(counted, change, 0.0).ravel() for change in changes])
    square = weighted @ weighted.T
    square.flat[:: len(square) + 1] += REGULAR * np.trace(square) + _TINY
    try:
        shares = np.clip(np.linalg.solve(square, weighted @ step.ravel()), -10.0, 10.0)
    except np.linalg.LinAlgError:
        return step
    better = step.copy()
    for share, (old, _), change in zip(shares, recent, changes, strict=True):
        better -= share * (place - old + change)
    return better
