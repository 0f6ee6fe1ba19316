"""Ring buffer of the last readings of all cells, and linear filters of it: third differences, means, parabola fits."""

from __future__ import annotations

import numpy as np

from ...common.arrays import FloatArray, IntArray
from ...common.compiled import Places, Row, Rows, loop

WINDOW = 12
"""number of readings that are kept, and to which parabolas are fitted"""
RECENT = 4
"""frames between two evaluations of the window"""


def _rolled(rows: FloatArray) -> list[FloatArray]:
    """Coefficients (k, WINDOW) of readings from the oldest on, for a ring whose oldest is in row 0, 1, ..."""
    return [np.roll(rows, shift, axis=-1) for shift in range(WINDOW)]


_THIRD = np.zeros(WINDOW)
_THIRD[-4:] = np.array([1.0, -3.0, 3.0, -1.0]) / np.sqrt(20.0)
_THIRD_DIFFERENCE = _rolled(_THIRD)
_POWERS = np.vander(np.linspace(-1.0, 1.0, WINDOW), WINDOW, increasing=True)
_BESIDE_PARABOLA = _rolled(np.linalg.qr(_POWERS)[0][:, 3:].T.copy())
"""orthonormal rows, orthogonal to all parabolas; white noise keeps its variance in each row"""


class Window:
    """The last :data:`WINDOW` readings of n cells."""

    def __init__(self, cells: int) -> None:
        self.ring = np.zeros((WINDOW, cells))
        self.seen = 0
        """number of frames that have been taken"""
        self.compiled = False
        """whether the compiled loop is in use"""

    def take(self, r: FloatArray) -> None:
        """Take the readings (n,) of a frame."""
        self.ring[self.seen % WINDOW] = r
        self.seen += 1

    def reading(self, age: int = 0) -> FloatArray:
        """(n,) readings of ``age`` frames ago; a view of the ring."""
        reading: FloatArray = self.ring[(self.seen - 1 - age) % WINDOW]
        return reading

    def third_difference(self, out: FloatArray) -> None:
        """Write the third difference of the last four readings into ``out`` (n,); white noise keeps its variance."""
        _THIRD_DIFFERENCE[self.seen % WINDOW].dot(self.ring, out)

    def third_differences(self, count: int) -> FloatArray:
        """(count, n) third differences that end at each of the last ``count`` frames, at most WINDOW - 3."""
        by_age = np.array([_THIRD_DIFFERENCE[(self.seen - age) % WINDOW] for age in range(count)])
        differences: FloatArray = by_age @ self.ring
        return differences

    def beside_parabola(self, cells: IntArray) -> tuple[FloatArray, FloatArray]:
        """Residuals of the readings of ``cells`` (m,) about fitted parabolas.

        Returns:
            (k, m) components of the readings orthogonal to all parabolas, in each of which white noise keeps its
            variance; and (m,) the last readings.
        """
        ring = self.ring.take(cells, axis=1)
        return _BESIDE_PARABOLA[self.seen % WINDOW].dot(ring), ring[(self.seen - 1) % WINDOW]

    def change_before(self, cells: IntArray) -> FloatArray:
        """(m,) change of the readings of ``cells`` from two frames ago to the previous frame."""
        change: FloatArray = self.reading(1)[cells] - self.reading(2)[cells]
        return change

    def mean_of_recent(self, cells: IntArray, count: int) -> FloatArray:
        """(m,) mean of the last ``count`` readings of ``cells``; ``count`` is at most :data:`WINDOW`."""
        newest = (self.seen - 1) % WINDOW
        if self.compiled:
            mean = np.empty(cells.size)
            recent_means_each.unchecked(self.ring, newest, cells, count, mean)
            return mean
        return recent_means(self.ring, newest, cells, count)


def recent_means(ring: FloatArray, newest: int, cells: IntArray, count: int) -> FloatArray:
    """(m,) mean of the last ``count`` readings of ``cells``; the last is in row ``newest`` of ``ring`` (k, n)."""
    total: FloatArray = ring[newest].take(cells)
    for age in range(1, count):
        total += ring[(newest - age) % len(ring)].take(cells)
    total *= 1.0 / count
    return total


@loop
def recent_mean(ring: Rows, newest: int, cell: int, count: int) -> float:
    """:func:`recent_means` of one cell."""
    total = ring[newest, cell]
    for age in range(1, count):
        total += ring[(newest - age) % ring.shape[0], cell]
    return float(total * (1.0 / count))


@loop
def recent_means_each(ring: Rows, newest: int, cells: Places, count: int, mean: Row) -> None:
    """Write :func:`recent_means` into ``mean`` (m,)."""
    for i in range(cells.size):
        mean[i] = recent_mean(ring, newest, cells[i], count)
