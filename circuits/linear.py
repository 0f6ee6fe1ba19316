"""Amplifier frames that need no more of the grid than the conductance from each row to each column.

With grounded idle rows and amplifiers that all hold their inputs at one potential, a scan step is linear in the N x M
*transfer conductances* of the grid with what the columns end in attached to it. That is most scans; the fast methods
(:mod:`.attenuation`, :func:`.ports.transfer_conductances`) compute nothing else. The others go through
:mod:`.readout`: dividers, floating rows, unequal offsets, and frames in which an output saturates.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .attenuation import Wires
from .design import Design
from .grid import is_plain
from .parts import Parts, lines
from .ports import Lines
from .readout import amplifier_ends

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class LinearReadout:
    """Outputs as a linear function of the transfer conductances (..., N, M)."""

    output: FloatArray
    """V (M,) without current"""
    slope: FloatArray
    """V/A (M,)"""
    drive: float
    """V of the selected row"""
    source: float
    """V behind the columns' ends, against the reference"""
    supply: tuple[float, float]
    lines: Lines
    """of the grid, the columns' ends attached"""
    wires: Wires | None
    """the same for line attenuation; None where a line is broken"""

    @classmethod
    def of(cls, design: Design) -> LinearReadout | None:
        """None where the design's frames are not of this kind."""
        if _recent.design is not design:  # frame after frame comes from one design, and is as quick as this is to make
            _recent.design, _recent.readout = design, cls._of(design)
        return _recent.readout

    @classmethod
    def _of(cls, design: Design) -> LinearReadout | None:
        ordinary = design.readout.circuit == "inverting-amplifier" and design.drive.idle_rows == "ground"
        if not (ordinary and is_plain(design)):
            return None
        ends = amplifier_ends(design)
        source = ends.source
        resistance = ends.resistance + Parts.of(design).column_lead
        if (source != source[0]).any() or np.isinf(resistance).any():
            return None
        grid = lines(design)
        with np.errstate(divide="ignore"):
            ended = Lines(grid.row, grid.column, 1.0 / resistance)
        return cls(
            output=ends.output,
            slope=ends.slope,
            drive=design.drive.voltage,
            source=float(source[0]),
            supply=design.readout.supply,
            lines=ended,
            wires=Wires.of(ended),
        )

    def volts(self, transfer: FloatArray) -> FloatArray:
        """(..., N, M) V, had the amplifiers no limits."""
        return self.output + self.slope * self._currents(transfer, self.drive, -self.source)

    def error(self, transfer_error: FloatArray) -> FloatArray:
        """How much the outputs (..., N, M) can be wrong, in V, for such errors of the transfer conductances."""
        return np.abs(self.slope) * self._currents(transfer_error, abs(self.drive), abs(self.source))

    def within_supply(self, volts: FloatArray, error: FloatArray | float = 0.0) -> NDArray[np.bool_]:
        """(...,) whether no output of a frame can have reached a limit."""
        low, high = self.supply
        return np.asarray(((volts - error >= low) & (volts + error <= high)).all(axis=(-2, -1)))

    @staticmethod
    def _currents(transfer: FloatArray, drive: float, source: float) -> FloatArray:
        currents = drive * transfer
        if source:
            currents += source * transfer.sum(axis=-2, keepdims=True)
        return currents


class _Recent(threading.local):
    """What was made of the design that this thread used last."""

    design: Design | None = None
    readout: LinearReadout | None = None


_recent = _Recent()
