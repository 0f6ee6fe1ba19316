"""The unit that errors of readings are stated in: relative resistance, or the share of full scale.

A cell that is open at rest has no relative error at rest, and one whose resistance spans decades has errors of many
percent that nobody would see in its pressure. What counts there is the error as a share of full scale: the error of
the conductance over its span or, where the cell's pressure is known, the error of the pressure over full scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..cell import Cell
from ..common.arrays import FloatArray

DECADE = 10.0
"""ratio of a cell's resistances from which on its errors are judged as shares of full scale"""
_POINTS = 129
"""of the curve from resistance to share"""


@dataclass(frozen=True)
class Scale:
    """Errors of a resistance, relative to it."""

    unit: str = "%"
    open_is_rest: bool = False
    """whether a reading of an open cell means that it bears no load; else such a reading is lost"""

    def of(self, ohms: FloatArray) -> FloatArray:
        """What is displayed for resistances in ohm."""
        return ohms

    def difference(self, value: FloatArray, other: FloatArray) -> FloatArray:
        """How far a displayed value is from another one, of 1."""
        return value / other - 1.0

    def gain_error(self, change: FloatArray, true: FloatArray) -> FloatArray:
        """How far a displayed change is from the true one, of 1."""
        return change / true - 1.0


@dataclass(frozen=True)
class ShareScale(Scale):
    """Errors as shares of full scale: a monotone curve, continued beyond its ends along its last piece."""

    unit: str = "% FS"
    falls: bool = True
    """whether a load lowers the resistance: the curve is then one of the conductance"""
    abscissa: FloatArray | None = None
    """(points,) S, or ohm of cells whose resistance rises; increasing"""
    share: FloatArray | None = None
    """(points,) of full scale"""

    @classmethod
    def of_cell(cls, cell: Cell, pressed_ohm: float, *, knows_pressure: bool) -> ShareScale:
        """The scale of a cell with its pressure if that is known, else with the span of its resistance."""
        falls = pressed_ohm < cell.rest_resistance_ohm
        share = np.linspace(0.0, 1.0, _POINTS)
        if knows_pressure:
            ohms = cell.equilibrium_ohm(share)
            abscissa = 1.0 / ohms if falls else ohms
            rising = np.concatenate([[True], np.diff(np.maximum.accumulate(abscissa)) > 0])
            abscissa, share = abscissa[rising], share[rising]
        else:
            ends = np.array([cell.rest_resistance_ohm, pressed_ohm])
            abscissa, share = (1.0 / ends if falls else ends), np.array([0.0, 1.0])
        return cls(open_is_rest=falls, falls=falls, abscissa=abscissa, share=share)

    def of(self, ohms: FloatArray) -> FloatArray:
        assert self.abscissa is not None
        assert self.share is not None
        # Beyond the open end of the circuit's law the host's resistance is negative: such a cell is open.
        with np.errstate(divide="ignore", invalid="ignore"):
            value = np.maximum(1.0 / ohms, 0.0) if self.falls else ohms
        piece = np.clip(np.searchsorted(self.abscissa, value) - 1, 0, len(self.abscissa) - 2)
        low, span = self.abscissa[piece], self.abscissa[piece + 1] - self.abscissa[piece]
        rise = self.share[piece + 1] - self.share[piece]
        result: FloatArray = self.share[piece] + rise * (value - low) / span
        return result

    def difference(self, value: FloatArray, other: FloatArray) -> FloatArray:
        return value - other

    def gain_error(self, change: FloatArray, true: FloatArray) -> FloatArray:
        return change - true
