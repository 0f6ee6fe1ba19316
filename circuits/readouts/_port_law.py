"""What one reading says of its own conductance and of its column: three numbers that are affine in the reading.

Let D_ij be the conductance between the driver of row i and column j while all other lines stand at one potential, and
T_j the sum of column j. Row i is driven W above the other lines, column j stands C above them, and the current I leaves
column j for its end. Kirchhoff's current law of column j is

    W D_ij = I_ij + T_j C_ij.

W, I and C are affine in the reading y_ij. Hence all D follow from the readings in closed form: summed over a column,
the law gives T_j = sum(I / W) / (1 - sum(C / W)) (Sherman and Morrison 1950).

A circuit that states these numbers can be inverted (:mod:`..recovery._law`).
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np

from ...common.arrays import FloatArray
from ._ends import Ends


class PortLaw(NamedTuple):
    """I, C and W of every column: (2, M) each, the constant and the change per volt of the reading."""

    current: FloatArray
    """A and A/V, current I into the column's end"""
    potential: FloatArray
    """V and V/V, potential C of the column above the idle lines"""
    drive: FloatArray
    """V and V/V, potential W of the selected row above the idle lines"""

    @classmethod
    def of_ends(cls, ends: Ends, wire: FloatArray, drive: float, *, floating: bool) -> Self:
        """The law of columns that end in Thevenin equivalents, behind ``wire`` (M,) in ohm.

        Idle rows stand at the reference. Where they float, they take no current: the column passes all of it.
        """
        per_volt = 1.0 / ends.slope
        current = np.array([-ends.output * per_volt, per_volt])
        potential = current * (ends.resistance + wire)
        potential[0] += ends.source
        full = np.array([np.full(per_volt.shape, drive), np.zeros(per_volt.shape)])
        if floating:
            return cls(current, np.zeros_like(potential), full - potential)
        return cls(current, potential, full)
