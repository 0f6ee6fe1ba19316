"""Voltage dividers: each column ends in a load resistor (paper, VII and figure 13).

The other cells change each reading (crosstalk). Idle rows are grounded or open. Idle columns are open, or end in their
loads as well.
"""

from __future__ import annotations

import numpy as np

from .._parts import Parts
from ._circuit import Alone
from ._ends import EndParts, Ends
from ._terminated import SignArray, Terminated


class VoltageDivider(Terminated):
    """A load resistor on each column, and nothing else."""

    name = "voltage-divider"

    def ends_of(self, board: Parts, parts: EndParts, state: SignArray | None = None) -> Ends:
        nothing = np.zeros_like(parts.reference)
        return Ends(parts.reference, source=nothing, output=nothing + parts.level, slope=parts.reference)

    def ends(self, board: Parts) -> Ends | None:
        return None  # no virtual grounds

    def alone(self, board: Parts) -> Alone:
        return Alone(board.drive * board.reference, board.reference)
