"""The result of an inversion: resistance, status and uncertainty of each cell."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import FloatArray


class Status(IntEnum):
    """How well a recovered cell is known."""

    READ = 0
    OPEN = 1
    """The cell carries no current; its resistance is inf."""
    SATURATED = 2
    """The output or the converter is at a limit; the resistance is unknown and NaN."""
    DISTURBED = 3
    """The error bound :attr:`Recovery.uncertainty` exceeds 10,000 times the requested accuracy; NaN where it is inf."""
    HIDDEN = 4
    """A fault of the design hides the cell from all readings; the resistance is NaN."""


@dataclass(frozen=True)
class Recovery:
    """Cells recovered from one frame. Arrays are (rows, columns)."""

    resistance: FloatArray
    """ohm"""
    status: NDArray[np.int8]
    """:class:`Status` of each cell"""
    uncertainty: FloatArray
    """Relative half-width of the interval of each cell's conductance.

    ``resistance`` belongs to the middle of this interval; inf means that nothing is known about the cell.
    """
    iterations: int
    """evaluations of the model that led to the solution; 0 for the closed form"""
