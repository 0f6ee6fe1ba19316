"""The ideal readout: equation (10) of the paper and its inverse, for every circuit."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import FloatArray
from ._design import Design


def apparent_resistance(design: Design, volts: ArrayLike) -> FloatArray:
    """Cell resistances (..., rows, columns) in ohm that would give these outputs in the ideal circuit, equation (10).

    Infinite where the output stands at the reference. An offset can make the value negative for an open cell: the value
    follows from the reading alone, without limits of what a cell can be.
    """
    board = design.board
    ohms = board.circuit.apparent_resistance(board, board.transpose(np.asarray(volts, dtype=np.float64)))
    return board.transpose(np.where(np.isinf(ohms), np.inf, ohms))


def ideal_volts(design: Design, resistance: ArrayLike) -> FloatArray:
    """Outputs (..., rows, columns) in V if each cell were alone with ideal parts: equation (10), or a single divider.

    Shorts give an infinite amplifier output.
    """
    board = design.board
    return board.transpose(board.circuit.ideal_volts(board, board.transpose(np.asarray(resistance, dtype=np.float64))))
