"""Prices of the steps of a frame on a coupled board, see :mod:`._frame_account`."""

from __future__ import annotations

from ._coupled_board import CoupledBoard
from ._frame_account import USUAL_FRAMES


class CoupledPrices:
    """Prices of one board's steps."""

    def __init__(self, parts: CoupledBoard, *, by_nodes: bool, by_columns: bool) -> None:
        """For a board, and the kind of its derivatives.

        Args:
            parts: the board.
            by_nodes: derivatives by the structure of single lines, and steps by conjugate gradients.
            by_columns: derivatives in closed form, column by column.

        """
        cells = parts.shape[0] * parts.shape[1]
        ideal = parts.quick.is_quick
        self.reading = 70.0 + 0.06 * cells
        """fixed work of every frame beside evaluations and steps"""
        self.start = 25.0 + 0.05 * cells
        """closed formulas"""
        self.lines = 300.0 + (3.3 if ideal else 7.0) * cells if by_nodes else 250.0 + 0.15 * cells
        """derivatives by the structure of single lines, without the potentials within the lines"""
        self.by_matrix = 45.0 + cells**2 / 1200.0
        """a step by all derivatives, and the test whether it was the last one"""
        self.by_lines = 45.0 + 0.03 * cells
        """the same by :attr:`lines`"""
        if by_nodes:
            self.by_lines = 100.0 + 0.3 * cells if ideal else 150.0 + cells
        self.lost, self.each_lost = 80.0 + 0.05 * cells, 15.0
        """effect of columns that are left out: fixed part, and part for each of them"""
        self.lost_rows = 190.0 + 0.1 * cells
        """effect of rows that are left out"""
        self.imitated = 300.0 + 0.5 * cells
        """a round of the search for shorts that could also explain a follower's readings"""
        self.compare = 200.0 + 0.3 * cells
        """effect of broken lines on the readings, without one evaluation each of the sound and of the broken board"""
        self.told, self.scales, self.narrow = 100.0 + 0.1 * cells, 200.0 + 0.2 * cells, 180.0 + 0.3 * cells
        """deficits of the columns by the readings; effect of their scales; a search that narrows one scale"""
        self.solutions = 100.0 + 2.0 * cells
        """an enclosure of other sets of cells behind followers"""
        step = self.by_lines if by_nodes or by_columns else self.by_matrix
        steps = 2.0 if by_nodes else 1.0  # that usually follow a moving finger
        usual = self.reading + steps * parts.quick.usual_price + (1.0 + steps) * step
        dearest = self.compare + 2.0 * parts.quick.most_price(cells)
        if not ideal:
            dearest = max(parts.quick.sparse_price(cells) + self.lines, dearest)
        self._usual, self._dearest = usual, dearest

    def most(self, *, looks: bool) -> float:
        """Limit of a frame on a board whose usual frames search for imitations (``looks``)."""
        usual = self._usual + (self.imitated if looks else 0.0)
        # No step is dearer than a frame; otherwise it would never be paid for.
        return max(USUAL_FRAMES * usual, self._dearest + 2.0 * usual)
