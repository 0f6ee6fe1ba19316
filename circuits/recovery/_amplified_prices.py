"""What the steps of a frame of an amplifiers' board cost, see :mod:`._frame_account`."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from ...arrays import BoolArray
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
        """a usual frame on light lines; of a large array, with half of what its estimate costs"""
        self.reading = 80.0 + 0.04 * cells
        """what every frame does that is not done by the loops for usual ones"""
        self.attenuation = 25.0 + 0.03 * cells + (50.0 if cells > _LARGE else 0.0)
        """a base by line attenuation"""
        models = board.models
        self.exact = 15.0 + 1e-3 * models.products if models.is_small else 250.0 + 0.9 * cells
        """exact transfer conductances; with and without machine code, so that both do the same"""
        self.leads, self.round = 30.0 + 0.02 * cells, 18.0 + 0.045 * cells
        """Kirchhoff's laws, but for their rounds; one of these"""
        self.propagated = 50.0 + 0.18 * cells
        """what a set of errors becomes behind heavy leads"""
        self.bounds = 25.0 + 0.0075 * cells * sqrt(cells) + 3.0 * self.propagated
        """how errors of readings come through, by bounds, and how well readings are known then"""
        self.derivatives = 100.0 + 0.036 * cells**2 if cells <= MOST_CELLS else inf
        """the same by all derivatives"""
        self.heavy = self.reading + self.leads + 3.0 * self.round + self.exact + self.propagated
        """a usual frame there"""
        self.first = FIRST_FRAMES * self.light
        """what the first frame of all may cost"""

    def most(self, *, heavy: bool) -> float:
        """What any other frame may cost on a board whose usual frames are such ones."""
        if heavy:
            return USUAL_FRAMES * self.heavy
        # No step is dearer than a frame, or what waits for it would wait for ever.
        return max(USUAL_FRAMES * self.light, self.heavy + max(self.exact, self.bounds))

    def shorts(self, where: BoolArray) -> float:
        """What cells (N, M) that may be shorts make of the others."""
        in_row = np.count_nonzero(where, axis=1)
        pairs = float(in_row @ in_row) * self._rows
        return 40.0 + 0.05 * self._cells + 0.0018 * np.count_nonzero(in_row) * self._cells + 0.0013 * pairs
