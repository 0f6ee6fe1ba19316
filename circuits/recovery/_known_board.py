"""What every live recovery knows of a board before anything is read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import inf

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._board import Board, broken_off
from .._parts import LEAST_SHORT_OHM
from ._lines import LineResistance
from ._quick_model import QuickModel, with_resistance


@dataclass(frozen=True)
class KnownBoard:
    """A board and its known parts. Arrays are (N, M) in line coordinates."""

    board: Board
    exact: bool = False
    """whether the model is the exact one, at many times the cost, and any frame worth a fit"""
    least_short: float = LEAST_SHORT_OHM
    """ohm, the least of cells at a limit"""

    @cached_property
    def whole(self) -> Board:
        """Without supply limits, and with a resistance in each complete short."""
        return replace(self.board, supply=(-inf, inf), faults=tuple(map(with_resistance, self.board.faults)))

    @cached_property
    def sliced(self) -> Board:
        """The same without currents along the sheet."""
        return replace(self.whole, continuous=False)

    @cached_property
    def lines(self) -> LineResistance:
        """Shared wire of the lines."""
        return LineResistance(self.sliced)

    @cached_property
    def model(self) -> QuickModel:
        """Outputs of the sliced board."""
        return QuickModel(self.sliced, self.lines, exact=self.exact)

    @cached_property
    def wires(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Ohm from each cell to its row's driver and to its column's last crosspoint; (M,) from there to the end.

        Broken lines count as whole ones.
        """
        to_driver, to_end, lead = (
            np.where(np.isfinite(ohms), ohms, 0.0)
            for ohms in (self.lines.to_driver, self.lines.to_end, self.board.column_lead)
        )
        return to_driver, to_end, lead

    @cached_property
    def cut_off(self) -> BoolArray:
        """Cells beyond a complete break of their line."""
        return broken_off(self.board)

    @cached_property
    def shorted(self) -> BoolArray:
        """Cells beside a complete short."""
        shorted = np.zeros(self.board.shape, dtype=np.bool_)
        for fault in self.board.shorts:
            shorted[fault.place] |= fault.ohms == 0
        return shorted

    @cached_property
    def shunt(self) -> FloatArray:
        """S in parallel with each cell."""
        shunt = np.zeros(self.board.shape)
        for fault in self.whole.shorts:
            shunt[fault.place] += 1.0 / fault.ohms
        return shunt
