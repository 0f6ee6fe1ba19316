"""Node names and part values for the SPICE cards of a readout circuit."""

from __future__ import annotations

from .._parts import Parts

REFERENCE = "0"  # SPICE's node 0
FOLLOWER = "follower"
ROW_INDEX, COLUMN_INDEX = "row_index", "column_index"


class CardWriter:
    """The netlist as a circuit sees it while writing its cards; :class:`..spice.DeckWriter` writes all other cards."""

    reference = REFERENCE
    follower = FOLLOWER
    board: Parts
    row: int | None
    """the selected row; None: the netlist sweeps over all rows"""
    columns: int
    """M, sensed lines"""
    one_by_one: bool
    """whether the columns of a row are read one after the other"""
    ground: str
    """node of board ground"""
    name: dict[str, str]
    """name of each node in the cards, after parts of 0 ohm have merged nodes"""
    drivers: dict[str, int]
    """row number by the name of its driving node"""

    def chosen(self, j: int) -> str:
        """SPICE condition that is true while column ``j`` is read."""
        return f"abs(v({COLUMN_INDEX})-{j})<0.5"

    def amplifier_parts(self, j: int) -> tuple[float, float, float, float]:
        """Open-loop gain, Rref in ohm, offset voltage in V and bias current in A of column j's amplifier."""
        board = self.board
        return float(board.gain[j]), float(board.reference[j]), float(board.offset[j]), float(board.bias[j])
