"""Node names and part values for the SPICE cards of a readout circuit."""

from __future__ import annotations

from collections.abc import Iterator

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

    def switched_end(self, j: int, node: str, read: str) -> Iterator[str]:
        """Cards of the end of column ``j`` where columns are read one by one.

        Args:
            j: number of the column.
            node: the end of its lead.
            read: SPICE expression of the volts at the node while the column is read, a function of ``i(Vend_j)``, the
                current out of the grid.

        """
        current = f"i(Vend_{j})"
        idle = {
            "float": f"v({node})+{current}",  # this equation sets the current of the source to 0
            "ground": "0",
            "load": f"{float(self.board.reference[j])!r}*{current}",
        }[self.board.idle_columns]
        yield f"Bend_{j} {node} end_of_{j} V = {self.chosen(j)} ? {read} : {idle}"
        yield f"Vend_{j} end_of_{j} {self.reference} DC 0"

    def amplifier_parts(self, j: int) -> tuple[float, float, float, float]:
        """Open-loop gain, Rref in ohm, offset voltage in V and bias current in A of column j's amplifier."""
        board = self.board
        return float(board.gain[j]), float(board.reference[j]), float(board.offset[j]), float(board.bias[j])
