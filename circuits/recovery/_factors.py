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

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...errors import SolverError
from ._law_kernels import move

EVALUATIONS, FIRST_EVALUATIONS = 4, 30
"""of the full model in one frame, and in the first one of all"""
OPEN = 1e-14
"""S, of an open cell in the model"""
FRESH = 0.2  # share of an uncertainty that a factor may be off by
_ROUGHLY = 0.5  # share of the law's error that a cell may be off by which is not valid and only loads others
_LEAST_FACTOR, _MOST_FACTOR = 0.2, 5.0  # beyond, a difference takes the place of the factor
_STRIDE = 1.0  # of the logarithm of a cell that is not valid, half of which a step takes
_EXPONENTS = -40.0, 7.0  # range of the logarithms of conductances
_REGULAR = 1e-12
_TINY = np.finfo(np.float64).tiny


class Factors:
    """The factors of one board's cells. Arrays are (N, M) in line coordinates."""

    def __init__(
        self,
        shape: tuple[int, int],
        law: Callable[[FloatArray], FloatArray],
        coupling: Callable[[FloatArray], FloatArray],
        evaluations: int,
    ) -> None:
        """Begin with factors of 1.

        Args:
            shape: of the board.
            law: law(F(G)) in S of cells G in S.
            coupling: (M,) factors by which columns may differ at cells in S, though they do not where cells are equal.
            evaluations: of ``law`` in a frame.

        """
        self._law, self._coupling_at, self._evaluations = law, coupling, evaluations
        self.rho, self._added, self.any_added = np.ones(shape), np.zeros(shape), False
        self.base: FloatArray | None = None
        self.beyond, self.coupling = np.zeros(shape), np.zeros(shape[1])
        self.row_sums, self.column_sums = np.ones(shape[0]), np.ones(shape[1])
        self.astray, self._begun = True, False
        self.renewed = False
        """whether the last frame has made the factors anew"""

    def __call__(
        self,
        by_law: FloatArray,
        uncertainty: Callable[[FloatArray], FloatArray],
        error: FloatArray,
        counted: BoolArray,
        limit: float,
    ) -> tuple[FloatArray, FloatArray, bool]:
        """Cells in S, their relative error by what the iteration has left, and whether they have settled.

        Args:
            by_law: S, law(y) of the frame's readings y.
            uncertainty: relative, of such cells.
            error: relative, of ``by_law``.
            counted: cells that have readings.
            limit: uncertainty up to which cells matter.

        """
        cells, self.renewed = self.estimate(by_law), False
        if self.base is not None and not self.astray:
            self.coupling = np.maximum(self.coupling, self._coupling_at(np.maximum(cells, 0.0)))
            allowed = uncertainty(cells)
            matters = counted & (allowed <= limit)
            left = self.moved(np.abs(cells - self.base), cells, matters)
            if not ((left > FRESH * allowed) & matters).any():
                return cells, left, True
        self.renewed = True
        return self._renewed(cells, by_law, uncertainty, error, counted, limit)

    def estimate(self, by_law: FloatArray) -> FloatArray:
        """Cells in S by the present factors."""
        cells: FloatArray = self.rho * by_law
        if self.any_added:
            cells += self._added
        return cells

    def moved(self, change: FloatArray, cells: FloatArray, matters: BoolArray) -> FloatArray:
        """Relative change of ``cells`` by their factors, to first order, by a ``change`` in S of these; 0 at first."""
        if self.base is None:
            return np.zeros(change.shape)
        off, differs = np.empty(change.shape), self._added != 0.0
        if self.any_added:
            matters = matters & ~differs
        sums = self.row_sums, self.column_sums
        move.unchecked(change, self.base, self.beyond, self.coupling, *sums, matters, np.empty(change.shape[1]), off)
        # What passes beside a cell does not fall with it.
        least = np.maximum(cells, OPEN)
        off += self.beyond * change * np.maximum(1.0 / least - 1.0 / self.base, 0.0)
        if self.any_added:
            most = np.maximum(self.base, np.abs(self._added))
            off = np.where(differs, off * np.maximum(most / least, 1.0), off)
        return off

    def _renewed(
        self,
        cells: FloatArray,
        by_law: FloatArray,
        uncertainty: Callable[[FloatArray], FloatArray],
        error: FloatArray,
        counted: BoolArray,
        limit: float,
    ) -> tuple[FloatArray, FloatArray, bool]:
        before: list[tuple[FloatArray, FloatArray]] = []
        evaluations = self._evaluations if self._begun else FIRST_EVALUATIONS
        self._begun = True
        for _ in range(evaluations):
            cells = np.maximum(cells, OPEN)
            try:
                again = self._law(cells)
            except (SolverError, np.linalg.LinAlgError):
                self.base, self.astray = None, True
                return cells, np.full(cells.shape, inf), False
            new = self._correct(cells, again, by_law)
            allowed = uncertainty(new)
            matters = counted & (allowed <= limit)
            change = np.abs(np.maximum(new, OPEN) - cells)  # a negative reading is that of an open cell
            left = self.moved(change * counted, new, matters)
            log = np.log(cells)
            step = np.log(np.maximum(new, 1e-3 * cells)) - log
            further = accelerated(log, step, before, matters)
            left = np.maximum(left, np.abs(np.expm1(np.clip(further - step, -_STRIDE, _STRIDE))))
            loads = change > _ROUGHLY * np.minimum(error, 1.0) * np.maximum(np.abs(by_law), cells)
            if not (counted & np.where(matters, left > FRESH * allowed, loads)).any():
                self.astray = not matters.any()
                return new, left, True
            further = np.where(matters, further, 0.5 * np.clip(step, -_STRIDE, _STRIDE))
            before.append((log, step))
            cells = np.where(counted, np.exp(np.clip(log + further, *_EXPONENTS)), new)
        self.astray = True
        return cells, np.full(cells.shape, inf), False

    def _correct(self, cells: FloatArray, again: FloatArray, by_law: FloatArray) -> FloatArray:
        """Make the factors at ``cells``, of which the law makes ``again`` in the model; the corrected cells."""
        ratio = cells / np.where(again > 0.0, again, inf)
        usual = (ratio > _LEAST_FACTOR) & (ratio < _MOST_FACTOR) & (by_law > 0.0)
        self.rho, self._added = np.where(usual, ratio, 1.0), np.where(usual, 0.0, cells - again)
        self.any_added = not usual.all()
        # What adds is as steep as a factor, if there is one, else as beside other cells.
        self.base, self.beyond = cells, np.abs(np.where((again > 0.0) & (by_law > 0.0), ratio, self.rho) - 1.0)
        if self.any_added:
            self.beyond[~usual] = np.maximum(self.beyond, self.beyond[usual].max(initial=0.0))[~usual]
        self.row_sums, self.column_sums = cells.sum(axis=1), cells.sum(axis=0)
        self.coupling = self._coupling_at(cells)
        corrected: FloatArray = self.rho * by_law + self._added
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
    square.flat[:: len(square) + 1] += _REGULAR * np.trace(square) + _TINY
    try:
        shares = np.clip(np.linalg.solve(square, weighted @ step.ravel()), -10.0, 10.0)
    except np.linalg.LinAlgError:
        return step
    better = step.copy()
    for share, (old, _), change in zip(shares, recent, changes, strict=True):
        better -= share * (place - old + change)
    return better
