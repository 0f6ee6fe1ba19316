"""Lines with cells along them, solved place by place: continued fractions in positive numbers, exact but for rounding.

What line attenuation (:mod:`._attenuation`) has in closed form while lines are light, and what further terms of its
series (:mod:`._series`) are made of.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...arrays import FloatArray
from ._elimination import ULP


@dataclass(frozen=True)
class Ladders:
    """Lines with the cells along them, in their order from the driven end (rows) or the amplifier (columns).

    Arrays are (places, lines): a step along all lines at once is then one contiguous slice.
    """

    series: FloatArray
    """ohm ahead of each place"""
    shunt: FloatArray
    """S to ground at each place"""
    admittance: FloatArray
    """S into the rest of the line, from each place on"""
    profile: FloatArray
    """volts at each place for 1 V at the end"""

    @classmethod
    def solve(cls, series: FloatArray, shunt: FloatArray) -> Ladders:
        """Both (places, lines)."""
        admittance, drop = np.empty_like(shunt), np.empty_like(shunt)
        rest = np.zeros(shunt.shape[1:])
        ohms, branches, sums, drops = list(series), list(shunt), list(admittance), list(drop)
        for place in range(len(shunt) - 1, -1, -1):  # in place: at 64 x 64 the calls cost more than the arithmetic
            np.add(rest, branches[place], out=sums[place])
            np.multiply(ohms[place], sums[place], out=drops[place])
            np.add(drops[place], 1.0, out=drops[place])
            np.divide(sums[place], drops[place], out=rest)
        np.divide(1.0, drop, out=drop)
        return cls(series, shunt, admittance, np.multiply.accumulate(drop, axis=0, out=drop))


def rounding(places: int, smallest: FloatArray) -> FloatArray:
    """Relative error of profiles that go down to ``smallest`` along ladders of so many places.

    Each step back along a ladder adds 4 ulp to the relative error of its admittance Y, at most 4 n in all. A step of
    the profile is 1 / (1 + r Y): 3 ulp of its own, and of Y's error the part r Y / (1 + r Y), which summed over the
    steps is at most -ln of the whole profile.
    """
    with np.errstate(divide="ignore"):
        lost: FloatArray = ULP * places * (4.0 - 5.0 * np.log(smallest))
    return lost
