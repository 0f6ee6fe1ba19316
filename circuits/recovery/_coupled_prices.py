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
        ideal = parts.quick.is_quick
        self.reading = 70.0 + 0.06 * cells
        """what every frame does beside evaluations and steps"""
        self.start = 25.0 + 0.05 * cells
        """closed formulas"""
        self.lines = 300.0 + (3.3 if ideal else 7.0) * cells if by_nodes else 250.0 + 0.15 * cells
        """derivatives by what is special about the cells of one line, beside potentials within the lines"""
        self.by_matrix = 45.0 + cells**2 / 1200.0
        """a step, and what tells whether it was the last one, by all derivatives"""
        self.by_lines = 45.0 + 0.03 * cells
        """the same by :attr:`lines`"""
        if by_nodes:
            self.by_lines = 100.0 + 0.3 * cells if ideal else 150.0 + cells
        self.lost, self.each_lost = 80.0 + 0.05 * cells, 15.0
        """what columns that are left out may change, beside each of them; each of them"""
        self.lost_rows = 190.0 + 0.1 * cells
        """what rows that are left out may change"""
        self.imitated = 300.0 + 0.5 * cells
        """a round of the search for shorts that a follower's readings may be of as well"""
        self.compare = 200.0 + 0.3 * cells
        """what lines that broke make of the readings, beside an evaluation each of the sound and of the broken board"""
        self.told, self.scales, self.narrow = 100.0 + 0.1 * cells, 200.0 + 0.2 * cells, 180.0 + 0.3 * cells
        """what readings tell of the columns' scales; what these change; to narrow one of them"""
        self.solutions = 100.0 + 2.0 * cells
        """an enclosure of other sets of cells behind followers"""
        step = self.by_lines if by_nodes or by_columns else self.by_matrix
        steps = 2.0 if by_nodes else 1.0  # by which a moving finger is followed, as a rule
        usual = self.reading + steps * parts.quick.usual_price + (1.0 + steps) * step
        dearest = self.compare + 2.0 * parts.quick.most_price(cells)
        if not ideal:
            dearest = max(parts.quick.sparse_price(cells) + self.lines, dearest)
        self._usual, self._dearest = usual, dearest

    def most(self, *, looks: bool) -> float:
        """What a frame may cost on a board whose usual frames ``look`` for imitations."""
        usual = self._usual + (self.imitated if looks else 0.0)
        # No step is dearer than a frame, or what waits for it would wait for ever.
        return max(USUAL_FRAMES * usual, self._dearest + 2.0 * usual)
