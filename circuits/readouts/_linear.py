"""Outputs as a linear function of the grid's transfer conductances.

With grounded idle rows and amplifiers that all hold their inputs at one potential, a scan step is linear in the N x M
*transfer conductances* of the grid with the columns' ends attached: the current into each column for each row's volts.
Most frames are of this kind, and the fast solvers compute nothing else. All other frames go through the port network
(:meth:`._circuit.ReadoutCircuit.read`): dividers, floating rows, unequal offsets, and outputs that saturate.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import inf

import numpy as np

from ...arrays import BoolArray, FloatArray
from ..solvers import ULP, Attenuated, Lines, Wires


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

    def volts(self, transfer: FloatArray) -> FloatArray:
        """(..., N, M) V, had the amplifiers no limits."""
        volts = self.slope * self.drive * transfer
        if self.source:
            volts -= self.source / self.drive * volts.sum(axis=-2, keepdims=True)
        volts += self.output
        return volts

    def error(self, transfer_error: FloatArray, transfer: FloatArray) -> FloatArray:
        """How much the outputs (..., N, M) can be wrong, in V, for such errors of the transfer conductances.

        Rounding counts for what an output is the sum of, since its parts may cancel.
        """
        few = few_ulp(transfer.shape)
        error = self._gain[1] * (transfer_error + few * transfer)
        if self.source:
            error += abs(self.source / self.drive) * error.sum(axis=-2, keepdims=True)
        error += few * np.abs(self.output)
        return error

    def most_volts_per_siemens(self, rows: int) -> float:
        """V that no output is off by more than, per S that the transfer conductances of ``rows`` rows are off by."""
        return float(self._gain[1].max()) * (1.0 + abs(self.source / self.drive) * rows)

    def cannot_saturate(self, transfer: FloatArray, error: float) -> bool:
        """Whether one frame (N, M) in S, off by at most ``error``, stays within the supply.

        Transfer conductances are never negative. So an output without signal, which stands at a limit of the supply on
        many boards, is known to be on its right side.
        """
        bounds = np.stack([np.maximum(transfer - error, 0.0), transfer + error])
        signals = self._gain[0] * bounds
        low, high = signals.min(axis=0), signals.max(axis=0)
        others = -self.source / self.drive * signals.sum(axis=1)
        rounded = few_ulp(transfer.shape) * (high - low).max(initial=0.0)
        low = low + others.min(axis=0) + self.output - rounded
        high = high + others.max(axis=0) + self.output + rounded
        return bool((low >= self.supply[0]).all() and (high <= self.supply[1]).all())

    def read(self, known: Attenuated) -> tuple[FloatArray, FloatArray, FloatArray]:
        """:meth:`volts`; what none of a frame's (...,) is off by more than; and what its largest is no less than; V.

        The second is little more than the largest :meth:`error`, but without one for every output. The third follows
        from the transfer conductances being too low, if anything, where no output has another part.
        """
        gain, size, shift = self._gain
        volts = gain * known.transfer
        lifted = np.maximum.reduce(size * known.column, axis=-1)
        few = few_ulp(volts.shape)
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
        """V/S (M,) of what the selected row brings, its size, and the largest output in V without any current."""
        gain = self.slope * self.drive
        return gain, np.abs(gain), float(np.abs(self.output).max())

    def within_supply(self, volts: FloatArray, error: FloatArray | float = 0.0) -> BoolArray:
        """(...,) whether no output of a frame can have reached a limit."""
        low, high = self.supply
        if low == -inf and high == inf:
            return np.ones(volts.shape[:-2], dtype=np.bool_)
        return np.asarray(((volts - error >= low) & (volts + error <= high)).all(axis=(-2, -1)))


def few_ulp(shape: tuple[int, ...]) -> float:
    """Relative: the conversion of resistances (..., N, M), and the last steps from conductances to volts."""
    return (20.0 + sum(shape[-2:])) * ULP
