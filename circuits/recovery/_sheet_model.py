"""Outputs of a continuous sheet: those of the sliced sheet, plus the difference at cells nearby (deferred correction).

A continuous sheet couples neighbours weakly: readings change with their own cell by 0.97 to 1.0 times as much as those
of the sliced sheet. A solution of the continuous sheet costs a thousand times as much, though. The live recovery
therefore solves it at most once per frame. The readings are those of the sliced sheet, plus the difference between the
two sheets at the last solution.
"""

from __future__ import annotations

import numpy as np

from ...common.arrays import FloatArray
from .._board import Board
from .._exact import read_exactly
from ._quick_model import QuickModel
from ._tuning import SHEET_SERVES, SHEET_SHARE


class SheetModel:
    """Difference between the readings of a continuous sheet and those of the sliced sheet."""

    def __init__(self, board: Board, sliced: QuickModel) -> None:
        """For a continuous sheet without limits, and the model of the sliced one."""
        self._board, self._sliced = board, sliced
        self._missing: FloatArray = np.zeros(board.shape)  # V
        self._at: FloatArray | None = None  # logarithms of the conductances

    def __call__(self, cells: FloatArray) -> FloatArray:
        """V (N, M) for cells (N, M) in ohm."""
        volts: FloatArray = self._sliced(cells) + self._missing
        return volts

    def serves(self, log: FloatArray, spread: FloatArray) -> bool:
        """Whether the difference is accurate enough at logarithms (n,) of conductances known within ``spread``."""
        return self._at is not None and bool((np.abs(log - self._at) <= np.maximum(SHEET_SERVES, spread)).all())

    def solve(self, log: FloatArray) -> None:
        """Compute the difference anew, at logarithms (n,) of conductances."""
        cells = np.exp(-log).reshape(self._board.shape)
        self._missing = read_exactly(self._board, cells)[0].volts - self._sliced(cells)
        self._at = log

    def doubt(self, log: FloatArray) -> float:
        """Relative error of a conductance by the difference."""
        return np.inf if self._at is None else SHEET_SHARE * float(np.abs(log - self._at).max())
