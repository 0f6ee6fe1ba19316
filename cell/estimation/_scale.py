"""Scales of readings: how a resistance becomes r, the number that models of cells describe.

The choice of a scale is part of what is known of a cell. Carbon-filled silicone is described by r = R/R0 - 1. Velostat
and other cells whose resistance falls under load follow a model with memory on a logarithmic scale. Electrodes that
touch conduct in parallel with the cell at rest, so that their scale begins at the conductance at rest.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from ...common.arrays import FloatArray

BELOW = 0.1
"""least r on scales of cells whose resistance falls under load: at rest their resistance may be anything above R0"""


class Scale(ABC):
    """Turns resistances of n cells into r."""

    falls = False
    """whether a load lowers the resistance"""
    open_at_rest = False
    """whether a cell at rest may read no current; otherwise a cell that does is not connected"""

    @abstractmethod
    def read(self, resistance_ohm: FloatArray, r: FloatArray) -> None:
        """Write r (n,) of resistances (n,); NaN where no cell has such a resistance."""

    @abstractmethod
    def slope(self, conductance: FloatArray) -> FloatArray:
        """(n,) dr/dG at conductances G (n,) in siemens."""


class Ratio(Scale):
    """r = R/R0 - 1, of cells with rest resistances R0 (n,)."""

    def __init__(self, rest_resistance_ohm: FloatArray, *, falls: bool = False, open_at_rest: bool = False) -> None:
        self._per_ohm, self.falls, self.open_at_rest = 1.0 / rest_resistance_ohm, falls, open_at_rest

    def read(self, resistance_ohm: FloatArray, r: FloatArray) -> None:
        np.multiply(resistance_ohm, self._per_ohm, out=r)
        r -= 1.0

    def slope(self, conductance: FloatArray) -> FloatArray:
        return np.asarray(-self._per_ohm / conductance**2)


class Logarithm(Scale):
    """r = ln(R0/R)/span, of cells with rest resistances R0 (n,) whose resistance falls under load."""

    falls = open_at_rest = True

    def __init__(self, rest_resistance_ohm: FloatArray, span: float) -> None:
        self._rest_ohm, self._span = rest_resistance_ohm, span

    def read(self, resistance_ohm: FloatArray, r: FloatArray) -> None:
        np.copyto(r, np.nan)
        np.log(self._rest_ohm / resistance_ohm, out=r, where=resistance_ohm > 0)
        r /= self._span
        np.maximum(r, -BELOW, out=r)

    def slope(self, conductance: FloatArray) -> FloatArray:
        return np.asarray(1.0 / (self._span * conductance))


class Contact(Scale):
    """r = g/(G - G0 + g) - 1 by the conductance G of touching electrodes beyond that at rest, G0 (n,).

    A contact's conductance at rest may be far below what a board resolves. The conductance ``g``, a small part of that
    under full scale, stands for it, so that noise and ADC steps are small in r. r falls under load, as R/R0 - 1 does.
    """

    falls = True

    def __init__(self, rest_resistance_ohm: FloatArray, scale_ohm: float, *, open_at_rest: bool) -> None:
        """``scale_ohm`` is 1/g."""
        self.open_at_rest = open_at_rest
        self._scale_ohm = scale_ohm
        self._shift = 1.0 / scale_ohm - 1.0 / rest_resistance_ohm

    def read(self, resistance_ohm: FloatArray, r: FloatArray) -> None:
        with np.errstate(divide="ignore"):
            np.divide(1.0, resistance_ohm, out=r)
            r += self._shift
            r *= self._scale_ohm
            np.copyto(r, np.nan, where=~(np.isfinite(resistance_ohm) & (r > 0)))  # no contact or cell conducts so
            np.divide(1.0, r, out=r)
        r -= 1.0

    def slope(self, conductance: FloatArray) -> FloatArray:
        scaled = (conductance + self._shift) * self._scale_ohm
        return np.asarray(-self._scale_ohm / scaled**2)
