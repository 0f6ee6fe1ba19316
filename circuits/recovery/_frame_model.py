"""Forward model of the inverse problem: readings as a function of conductances, split into signal and offsets."""

from __future__ import annotations

from math import inf

import numpy as np

from ...common.arrays import FloatArray
from .._design import Design
from .._exact import read_exactly
from .._sensitivity import LARGEST


class Model:
    """Forward model: readings as a function of conductances.

    A reading is the sum of a signal, which is proportional to the drive, and a rest from the reference and the offsets.
    """

    def __init__(self, design: Design) -> None:
        """Prepare the model of ``design``. Only :meth:`limited` applies its supply limits."""
        self.limited_board = design.board
        unlimited = design.replace(readout={"supply": (-inf, inf)})
        self.board = board = unlimited.board
        self.circuit = board.circuit
        self.has_derivatives = not board.continuous and board.shape[0] * board.shape[1] <= LARGEST
        self.couples = board.circuit.mixes_cells or board.floating or not board.plain or bool(board.shorts)
        """whether crosstalk may be large even if the line resistances are small"""
        self.level, self.drive = board.level, board.drive
        ends = None if board.floating else board.circuit.ends(board)
        self._ends = ends if ends is not None and np.ptp(ends.source) == 0 else None
        self._opposite_drive = unlimited.replace(drive={"voltage": -self.drive}).board
        self._has_rest = board.circuit.has_amplifiers and bool(
            board.offset.any() or board.bias.any() or (self.level and np.isfinite(board.gain).any())
        )

    def split(self, conductance: FloatArray) -> tuple[FloatArray, FloatArray | float]:
        """Signal (N, M) in V, and rest (N, M) or a number in V, without supply limits."""
        with np.errstate(divide="ignore"):
            cells = 1.0 / conductance
        volts = read_exactly(self.board, cells)[0].volts
        if not self._has_rest:
            return volts - self.level, self.level
        if self._ends is None:
            other = read_exactly(self._opposite_drive, cells)[0].volts
            return (volts - other) / 2, (volts + other) / 2
        # Superposition: a cell is driven in the step of its own row only, while the sources of its column act in every
        # step. The sum over the rows gives the part of these sources.
        above, source = volts - self._ends.output, float(self._ends.source[0])
        signal = above + source * (above.sum(axis=0) / (self.drive - len(volts) * source))
        return signal, volts - signal

    def limited(self, conductance: FloatArray, volts: FloatArray) -> FloatArray:
        """Output volts (N, M) with supply limits, given the ``volts`` (N, M) without limits."""
        low, high = self.limited_board.supply
        if (volts >= low).all() and (volts <= high).all():
            return volts
        with np.errstate(divide="ignore"):
            return read_exactly(self.limited_board, 1.0 / conductance)[0].volts

    def apparent(self, signal: FloatArray) -> FloatArray:
        """Conductances in S (N, M) with which an ideal circuit has this signal (N, M) in V; 0 where the signal is 0."""
        return self.circuit.apparent_conductance(self.board, signal)

    def slope(self, signal: FloatArray) -> FloatArray:
        """d(apparent conductance)/d(signal), S/V."""
        return self.circuit.conductance_slope(self.board, signal)

    def log_slope(self, signal: FloatArray) -> FloatArray:
        """d(log apparent conductance)/d(signal), 1/V; 0 where there is no signal."""
        return self.circuit.log_conductance_slope(self.board, signal)
