"""Linear readout: amplifier outputs as a linear function of the grid's transfer conductances, with error bounds.

The N x M *transfer conductances* are the currents into each column for 1 V at each row, with all other terminals at
ground and the resistances at the columns' ends included. A readout is linear in the transfer conductances if idle rows
are grounded and all amplifiers hold their inputs at one potential. Most frames are of this kind, and the fast solvers
compute the transfer conductances only.

All other frames need the full port network (:meth:`._circuit.ReadoutCircuit.read`): voltage dividers, floating rows,
unequal offsets, and outputs that saturate.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import inf
from typing import Any

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ..solvers import ULP, Attenuated, Lines, Wires


@dataclass(frozen=True)
class LinearReadout:
    """Outputs V = output + slope * (drive * T - source * sum of T over all rows), with transfer conductances T in S.

    T has the shape (..., N, M): one frame of N scan steps and M outputs, or a batch of frames.
    """

    output: FloatArray
    """V (M,) of the outputs without input current"""
    slope: FloatArray
    """V/A (M,) of each output by the current into its column"""
    drive: float
    """V of the selected row"""
    source: Any
    """V at the columns' ends, relative to the potential of the idle rows; of a stack (S, 1, 1)"""
    supply: tuple[float, float]
    """V; lowest and highest output"""
    lines: Lines
    """wires of the grid, the resistances at the columns' ends included"""
    wires: Wires | None
    """resistances of the same wires, for line attenuation; None if a line is broken, or of a stack"""

    def volts(self, transfer: FloatArray) -> FloatArray:
        """Outputs (..., N, M) in V of amplifiers that never saturate."""
        volts = self.slope * self.drive * transfer
        if np.any(self.source):
            volts -= self.source / self.drive * volts.sum(axis=-2, keepdims=True)
        volts += self.output
        return volts

    def error(self, transfer_error: FloatArray, transfer: FloatArray) -> FloatArray:
        """Bound (..., N, M) in V on the errors of the outputs.

        The terms of an output may cancel. Rounding errors are therefore relative to the terms, not to the output.

        Args:
            transfer_error: (..., N, M) S, bound on the errors of the transfer conductances.
            transfer: (..., N, M) S, the transfer conductances.

        """
        few = output_rounding(transfer.shape)
        error = self._gain[1] * (transfer_error + few * transfer)
        if np.any(self.source):
            error += np.abs(self.source / self.drive) * error.sum(axis=-2, keepdims=True)
        error += few * np.abs(self.output)
        return error

    def read(self, known: Attenuated) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Outputs of frames by line attenuation, with bounds for each whole frame.

        Returns:
            Outputs (..., N, M) in V; an upper bound (...,) in V on the errors of each frame; a lower bound (...,) in V
            on the largest magnitude among the exact outputs of each frame. The upper bound is slightly larger than the
            maximum of :meth:`error`, but does not need an array of one error for each output. Where outputs are
            proportional to the transfer conductances, the lower bound is sharper: line attenuation overestimates these
            by at most ``rounded``.

        """
        gain, size, shift = self._gain
        volts = gain * known.transfer
        lifted = np.maximum.reduce(size * known.column, axis=-1)
        few = output_rounding(volts.shape)
        relative = known.rounded + few
        signal = np.abs(volts)
        largest = np.maximum.reduce(signal, axis=(-2, -1))
        sure = largest * (1.0 - np.maximum.reduce(relative, axis=(-2, -1)))
        signal *= relative
        worst = lifted * np.maximum.reduce(known.row, axis=-1) + np.maximum.reduce(signal, axis=(-2, -1))
        worst += few * shift
        if self.source:
            share = self.source / self.drive
            volts -= share * volts.sum(axis=-2, keepdims=True)
            worst += abs(share) * (lifted * known.row.sum(axis=-1) + signal.sum(axis=-2).max(axis=-1))
        volts += self.output
        if self.source or shift:
            sure = np.maximum.reduce(np.abs(volts), axis=(-2, -1)) - worst
        return volts, worst, sure

    @cached_property
    def _gain(self) -> tuple[FloatArray, FloatArray, float]:
        """V/S (M,) of output by transfer conductance, its magnitude, and the largest magnitude of ``output`` in V."""
        gain = self.slope * self.drive
        return gain, np.abs(gain), float(np.abs(self.output).max())

    def within_supply(self, volts: FloatArray, error: FloatArray | float = 0.0) -> BoolArray:
        """Whether no output of each frame (...,) can have reached a limit, for volts and errors (..., N, M) in V."""
        low, high = self.supply
        if low == -inf and high == inf:
            return np.ones(volts.shape[:-2], dtype=np.bool_)
        return np.asarray(((volts - error >= low) & (volts + error <= high)).all(axis=(-2, -1)))


def output_rounding(shape: tuple[int, ...]) -> float:
    """Bound on the relative rounding error of an output's terms, apart from that of the solver.

    The bound covers the conversion of resistances (..., N, M) to conductances, and the steps from transfer conductances
    to volts, which include a sum over the rows.
    """
    return (20.0 + sum(shape[-2:])) * ULP
