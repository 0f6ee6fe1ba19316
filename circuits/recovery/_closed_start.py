"""Start of a coupled board's first frame: conductances from the readings by closed formulas.

Columns that hardly load each other are separated exactly, and row leads as in :mod:`._column_blocks`. On other boards
each reading is taken as that of a cell alone.
"""

from __future__ import annotations

import numpy as np

from ...common.arrays import FloatArray
from .._board import cell_alone
from ..solvers import siemens
from ._column_blocks import ColumnBlocks
from ._coupled_board import CoupledBoard

_NEARLY_OPEN = 1e-3  # share of the median conductance below which a formula's result counts as zero
_FOR_OPEN = 0.1  # initial conductance of an open cell, as a share of the median
_LARGEST = 1e3  # largest initial conductance of a cell beside a short, over the largest apparent conductance
_NO_CELLS = 1e-5  # S, the median if no reading shows a conductance


class ClosedStart:
    """The closed formulas of one board."""

    def __init__(self, parts: CoupledBoard, columns: ColumnBlocks) -> None:
        """For a board, and its formulas for separated columns."""
        self._board, self._columns = parts.board, columns
        self._shunt = np.zeros(parts.shape)  # S, beside the cells
        for fault in self._board.shorts:
            self._shunt[fault.place] += siemens(fault.ohms)

    def __call__(self, volts: FloatArray) -> FloatArray:
        """Logarithms (n,) of the conductances behind readings (N, M) in V."""
        signal = volts - self._board.level
        if self._columns.applies:
            apparent = self._columns.crosspoints(signal)
        else:
            apparent = self._board.circuit.apparent_conductance(self._board, signal)
        conducting = np.sort(apparent[apparent > 0])
        middle = conducting[(conducting.size - 1) // 2 : conducting.size // 2 + 1]  # np.median takes ten times as long
        typical = float(middle.sum()) / middle.size if middle.size else _NO_CELLS
        most = _LARGEST * float(apparent.max(initial=0.0)) or 1.0
        apparent = np.minimum(cell_alone(self._board, apparent, self._shunt), most)
        seen = apparent > _NEARLY_OPEN * typical
        start: FloatArray = np.log(np.where(seen, apparent, _FOR_OPEN * typical)).ravel()
        return start
