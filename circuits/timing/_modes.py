"""What :class:`._settling.Settling` asks of a repeated scan: deviations of its samples, and modes that bound them."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from ...common.arrays import ComplexArray, FloatArray

_NEGLIGIBLE = 1e-3  # of the limit: sum of all modes that are neglected


class Deviations(NamedTuple):
    """Deviations in V from the settled readings, (N, M) in line coordinates."""

    repeated: FloatArray
    """of a scan that repeats endlessly over the same cells"""
    from_rest: FloatArray
    """of rows that each follow a row without signal"""

    @property
    def largest(self) -> float:
        """V, of both scans."""
        return float(max(np.abs(self.repeated).max(), np.abs(self.from_rest).max()))


class Modes(NamedTuple):
    """Exponential modes whose sum is the deviation of a sample."""

    rate: ComplexArray
    """1/s, eigenvalues"""
    size: FloatArray
    """V, largest amplitude at the start of a step"""

    def envelope(self, waiting: float) -> FloatArray:
        """Bound in V on each mode in a sample taken ``waiting`` s after a row switch, earlier steps included."""
        decay = self.rate.real * waiting
        envelope: FloatArray = self.size * np.exp(decay) / np.maximum(-np.expm1(decay), 1e-300)
        return envelope

    def settled_after(self, allowed: float) -> float:
        """Seconds after which the sum of all modes stays within ``allowed`` V."""
        least = 1.0 / float(np.abs(self.rate).max())
        while self.envelope(least).sum() > allowed:
            least *= 1.2
        return least

    def step(self, waiting: float, allowed: float) -> float:
        """Step in s of the search, short enough that the sum of the modes that still matter is nearly straight."""
        matter = self.envelope(waiting) > _NEGLIGIBLE * allowed / len(self.rate)
        fastest = float(np.abs(self.rate[matter]).max(initial=0.0))
        return min(0.1 * waiting, 0.25 / fastest) if fastest else 0.1 * waiting


class RepeatedScan(Protocol):
    """Constant cells that a circuit scans again and again; prepared once, then evaluated for any row period."""

    @property
    def briefest(self) -> float:
        """Shortest row period in s: the acquisitions of all columns, if one sampling capacitor serves them."""

    @property
    def unhurried(self) -> float:
        """V of deviation that remains at any row period: a shared capacitor's memory of the previous conversion."""

    def deviations(self, period: float) -> Deviations:
        """Deviations of the samples if each row is selected for ``period`` s, which is at least :attr:`briefest`."""

    def modes(self) -> Modes:
        """Modes of :meth:`deviations` after the waiting time, which is the row period less :attr:`briefest`."""
