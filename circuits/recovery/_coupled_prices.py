"""What the steps of a frame of a coupled board cost, see :mod:`._frame_account`."""

from __future__ import annotations

from ._coupled_board import CoupledBoard
from ._frame_account import USUAL_FRAMES


class CoupledPrices:
    """Prices of one board's steps."""

    def __init__(self, parts: CoupledBoard, *, by_nodes: bool, by_columns: bool) -> None:
        """For a board, and the kind of its derivatives.

        Args:
            parts: the board.
            by_nodes: of each line, and steps by conjugate gradients.
            by_columns: in closed form.

        """
        cells = parts.shape[0] * parts.shape[1]
        evaluation = parts.quick.usual_price
        self.reading = 130.0 + 0.1 * cells
        """what every frame does beside evaluations and steps"""
        self.start = 90.0 + 0.1 * cells
        """closed formulas"""
        self.lines = 200.0 + 12.0 * cells if by_nodes else 250.0 + 0.15 * cells
        """derivatives by what is special about the cells of one line"""
        self.compare = 150.0 + 0.1 * cells
        """what lines that broke make of the readings, beside an evaluation each of the sound and of the broken board"""
        self.told, self.scales, self.narrow = 100.0 + 0.1 * cells, 200.0 + 0.2 * cells, 100.0 + 0.3 * cells
        """what readings tell of the columns' scales; what these change; to narrow one of them"""
        self.solutions = 300.0 + 3.0 * cells
        """an enclosure of other sets of cells behind followers"""
        whole = 15.0 + 0.05 * cells if by_columns else 10.0 + cells**2 / 2000.0  # a step
        usual = self.reading + evaluation + (400.0 + 3.0 * cells if by_nodes else whole)
        dearest = self.compare + 2.0 * parts.quick.most_price(cells)
        if not parts.quick.is_quick:
            dearest = max(parts.quick.sparse_price(cells) + self.lines, dearest)
        # No step is dearer than a frame, or what waits for it would wait for ever.
        self.most = max(USUAL_FRAMES * usual, dearest + 2.0 * usual)
        """what a frame may cost"""
