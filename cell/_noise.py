"""Noise measured from the readings themselves, by their third differences (a difference-based variance estimator).

A load that moves smoothly leaves almost nothing in the third difference of successive readings; white noise of
variance v leaves 20 v, the sum of the squared coefficients 1, -3, 3, -1. Boards measure currents, so that noise is
about constant in conductance: the noise of the normalised resistance r is kept relative to (1 + r)^2.

One cell that moves fast looks noisy. In an array most cells are at rest, and no cell is therefore taken to be much
noisier than the median one.
"""

from __future__ import annotations

import numpy as np

from ..arrays import BoolArray, FloatArray

READINGS = 200
"""over which the variance is averaged"""
OUTLIER = 16.0
"""times the variance: no squared difference counts for more, so that steps of the load hardly count"""
LEAST = 1e-6
"""standard deviation of r below which readings are taken for exact"""
POOL = 16
"""readings between two looks at the median cell"""
ABOVE_POOL = 4.0
"""times the median variance of the array that a single cell may have"""
MANY = 9
"""cells from which the median of the array is trusted"""


class NoiseMeter:
    """Standard deviation of the readings of n cells, from one reading to the next."""

    def __init__(self, cells: int, expected: float = 0.0) -> None:
        """``expected``: standard deviation of r at rest that an earlier recording had; 0 if there is none."""
        self._last = np.zeros(cells)
        self._change = np.zeros(cells)
        self._second = np.zeros(cells)
        self._variance = np.full(cells, expected**2)
        self._readings = READINGS // 8 if expected else 0
        self._seen = 0
        self.typical = expected
        """standard deviation of the median cell at rest"""

    def update(self, r: FloatArray, known: BoolArray | None) -> None:
        """Take normalised resistances (n,); ``known`` (n,) marks those that were read, None: all."""
        change = r - self._last
        second = change - self._change
        third = second - self._second
        self._seen += 1
        if self._seen > 3:
            scale = r + 1.0
            scale *= scale
            third /= scale
            third *= third
            third /= 20.0
            if known is not None:
                third[~known] = self._variance[~known]
            self._average(third)
        self._last, self._change, self._second = r, change, second

    def _average(self, squares: FloatArray) -> None:
        if not self._readings:
            middle = float(np.median(squares)) / 0.4549 if squares.size >= MANY else 0.0
            self._variance = np.maximum(squares if squares.size < MANY else np.full(squares.size, middle), LEAST**2)
        self._readings += 1
        limit = self._variance * OUTLIER
        limit += LEAST**2
        np.minimum(squares, limit, out=squares)
        squares -= self._variance
        squares *= max(1 / self._readings, 1 / READINGS)
        self._variance += squares
        if self._readings % POOL == 1:
            self._pool()

    def _pool(self) -> None:
        middle = float(np.median(self._variance))
        if self._variance.size >= MANY:
            np.minimum(self._variance, ABOVE_POOL * middle + LEAST**2, out=self._variance)
        self.typical = middle**0.5

    def std(self, r: FloatArray, cells: slice | np.ndarray = slice(None)) -> FloatArray:
        """Standard deviation of the readings ``r`` of ``cells``."""
        found: FloatArray = np.sqrt(self._variance[cells] + LEAST**2)
        scale = np.maximum(r, -0.9)
        scale += 1.0
        found *= scale
        found *= scale
        return found

    def state(self) -> dict[str, FloatArray]:
        """All that is remembered."""
        return {
            "noise_last": self._last,
            "noise_change": self._change,
            "noise_second": self._second,
            "noise_variance": self._variance,
            "noise_counts": np.array([self._readings, self._seen, self.typical], dtype=np.float64),
        }

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a :meth:`state`."""
        self._last, self._change, self._second = (state[f"noise_{name}"] for name in ("last", "change", "second"))
        self._variance = state["noise_variance"]
        readings, seen, self.typical = state["noise_counts"].tolist()
        self._readings, self._seen = int(readings), int(seen)
