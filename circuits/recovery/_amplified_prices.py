"""Prices of the steps of a frame on an amplifiers' board, see :mod:`._frame_account`."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from ...common.arrays import BoolArray
from ._amplified_board import AmplifiedBoard
from ._frame_account import FIRST_FRAMES, USUAL_FRAMES
from ._heavy_leads import MOST_CELLS

# Cells above which line attenuation is worked out by ladders with the extra fast, and in closed form without it.
# One price serves both, so that what a frame finds does not depend on the extra.
_LARGE = 256


class AmplifiedPrices:
    """Prices of one board's steps."""

    def __init__(self, board: AmplifiedBoard) -> None:
        """For a board of so many cells."""
        rows, _ = board.board.shape
        cells = board.board.shape[0] * board.board.shape[1]
        self._rows, self._cells = rows, cells
        self.light = 100.0 + 0.15 * cells
        """a usual frame on light lines; on a large array with half of the estimator's cost"""
        self.reading = 80.0 + 0.04 * cells
        """fixed work of every frame that the loops for usual frames do not handle"""
        self.attenuation = 25.0 + 0.03 * cells + (50.0 if cells > _LARGE else 0.0)
        """a base by line attenuation"""
        models = board.models
        self.exact = 15.0 + 1e-3 * models.products if models.is_small else 250.0 + 0.9 * cells
        """exact transfer conductances; with and without machine code, so that both do the same"""
        self.leads, self.round = 30.0 + 0.02 * cells, 18.0 + 0.045 * cells
        """Kirchhoff's laws without their rounds; one round"""
        self.propagated = 50.0 + 0.18 * cells
        """propagation of one set of errors behind heavy leads"""
        self.bounds = 25.0 + 0.0075 * cells * sqrt(cells) + 3.0 * self.propagated
        """error propagation by bounds, and the errors of the readings with it"""
        self.derivatives = 100.0 + 0.036 * cells**2 if cells <= MOST_CELLS else inf
        """the same by all derivatives"""
        self.heavy = self.reading + self.leads + 3.0 * self.round + self.exact + self.propagated
        """a usual frame behind heavy leads"""
        self.first = FIRST_FRAMES * self.light
        """limit of the first frame of all"""

    def most(self, *, heavy: bool) -> float:
        """Limit of any other frame, on a board whose usual frames are ``heavy`` or light."""
        if heavy:
            return USUAL_FRAMES * self.heavy
        # No step is dearer than a frame; otherwise it would never be paid for.
        return max(USUAL_FRAMES * self.light, self.heavy + max(self.exact, self.bounds))

    def shorts(self, where: BoolArray) -> float:
        """Price of the effect of cells (N, M) that may be shorts on the others."""
        in_row = np.count_nonzero(where, axis=1)
        pairs = float(in_row @ in_row) * self._rows
        return 40.0 + 0.05 * self._cells + 0.0018 * np.count_nonzero(in_row) * self._cells + 0.0013 * pairs
