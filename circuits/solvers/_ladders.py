"""Ladder networks solved by continued fractions: one line with its cells, exact up to rounding.

A line of the grid is a ladder: wire resistance in series, cells as shunts to ground. The admittance of a ladder is the
continued fraction (Cauer form) Y_k = g_k + 1 / (r_k+1 + 1 / Y_k+1), evaluated from the far end. All terms are
nonnegative, so no digits cancel.

Line attenuation (:mod:`._attenuation`) uses ladders where the lines are too heavy for its closed form.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...common.arrays import FloatArray
from ._elimination import ULP


class Ladders(NamedTuple):
    """Many ladders of equal length, solved together.

    Places count from the driven end of a row, or from the amplifier's end of a column. Arrays are (places, lines), so
    that one step along all lines is one contiguous slice.
    """

    admittance: FloatArray
    """S to ground of the cell at each place and of everything behind it"""
    profile: FloatArray
    """volts at each place for 1 V at the end where counting starts"""

    @classmethod
    def solve(cls, series: FloatArray, shunt: FloatArray) -> Ladders:
        """Solve ladders.

        Args:
            series: (places, lines) ohm of the wire between each place and the place before it.
            shunt: (places, lines) S of the cell at each place, from the line to ground.

        """
        admittance, drop = np.empty_like(shunt), np.empty_like(shunt)
        rest = np.zeros(shunt.shape[1:])
        ohms, branches, sums, drops = list(series), list(shunt), list(admittance), list(drop)
        for place in range(len(shunt) - 1, -1, -1):  # with out=: at 64 x 64, call overhead exceeds the arithmetic
            np.add(rest, branches[place], out=sums[place])
            np.multiply(ohms[place], sums[place], out=drops[place])
            np.add(drops[place], 1.0, out=drops[place])
            np.divide(sums[place], drops[place], out=rest)
        np.divide(1.0, drop, out=drop)
        return cls(admittance, np.multiply.accumulate(drop, axis=0, out=drop))


def profile_rounding(places: int, smallest: FloatArray) -> FloatArray:
    """Bound on the relative rounding error of the profiles of ladders.

    Each step back along a ladder adds 4 ulp to the relative error of the admittance Y, hence at most 4 n ulp over n
    places. A step of the profile multiplies by 1 / (1 + r Y). This step adds 3 ulp of its own. It also passes on the
    fraction r Y / (1 + r Y) of the error of Y. Summed over the steps these fractions are at most -ln(smallest).

    Args:
        places: number of places along each ladder.
        smallest: (...,) lowest value of the profiles.

    """
    with np.errstate(divide="ignore"):
        lost: FloatArray = ULP * places * (4.0 - 5.0 * np.log(smallest))
    return lost
