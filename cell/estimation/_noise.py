"""Noise measured from the readings themselves, by their third differences (a difference-based variance estimator).

Smooth motion of a load contributes almost nothing to the third difference of successive readings. White noise of
variance v contributes 20 v, since 20 is the sum of the squared coefficients 1, -3, 3, -1. Boards measure currents, so
that noise is about constant in conductance. The noise of the normalised resistance r is therefore stored relative to
(1 + r)^2.

A cell under a fast load looks noisy. Two kinds of differences are therefore rejected (a redescending M-estimator):
those across an edge of the load that the smoothing has noticed, and those far beyond the noise. If nearly all
differences are outliers, the noise has risen, and they count. In an array most cells are at rest. There the median cell
decides whether noise has risen, and no cell may be much noisier than the median cell.

Third differences of successive frames overlap and carry nearly the same information. Those of every third frame are
almost independent: averaging only these costs a quarter of the accuracy and a third of the time.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray, median
from ...common.compiled import Places, Records, Row, Rows, loop, values, zeros
from .._state import NoiseState

WINDOW = 12
"""number of readings that are kept, and to which parabolas are fitted"""
RECENT = 4
"""frames between two evaluations of the window"""

READINGS = 200
"""number of readings over which the variance is averaged"""
EVERY = 3
"""frames between two looks (evaluations of the third difference), once the noise is known roughly"""
SOON = READINGS // EVERY // 8
"""looks after which the noise is known roughly"""
FIRST = 9
"""looks after which arrays of few cells take the median of as many differences; these lie in one :data:`WINDOW`"""
OUTLIER = 9.0
"""multiple of the variance beyond which a squared third difference is an outlier: three standard deviations"""
ACROSS = 3.0
"""least number of readings since the smoothing noticed an edge of the load. With fewer, the edge lies within the four
readings of the third difference, which then counts as an outlier, however small"""
UNCUT = 1.0274
"""variance of a normal variable over that of its values within three standard deviations"""
CROWD_LOOKS = 24
"""looks over which the fraction of outliers is averaged"""
CROWDED, ALL_CROWDED = 0.75, 0.5
"""fraction of outliers beyond which the noise has risen. First: of one cell, since taps at three hertz, read by a slow
board, leave half of the readings clean. Second: of the median cell of an array, since few cells move at a time"""
LEAST = 1e-6
"""standard deviation of r below which readings count as exact"""
POOL = 6
"""looks between two updates of the median cell"""
ABOVE_POOL = 4.0
"""largest variance of a single cell, over the median of the array"""
MANY = 9
"""least number of cells for which the median of the array is trusted"""
SHARED_LOOKS = 16
"""weight, in looks, of the first median of a large array as prior of each cell. Without this prior, the first
differences of a cell may be near zero by chance, and any reading after them would seem to jump"""
ENOUGH = 500
"""medians of larger arrays are taken over about this many cells"""
KNOWN = 24
"""looks after which the noise of the median cell is known well enough for :attr:`NoiseMeter.quiet`"""
EXPECTED_LOOKS = 4
"""weight, in looks, of the noise of an earlier recording as prior for few cells, until their noise is known; many cells
need no such prior"""
FORGET = 1.002
"""growth of the least noise of the median cell from one update to the next, so that noise may rise for good"""
MEDIAN_OF_SQUARES = 0.4549
"""median of the square of a normal variable of variance 1"""
HALF_STEP = math.sqrt(3.0)
"""half a quantisation step over the standard deviation of a uniformly distributed rounding error (the resolution). Half
a step is the largest standard deviation of readings that flip between two codes; such readings show no motion"""
CROSSED = 10.0
"""multiple of the variance of noise: a window with more contains an edge of the load, which the smoothing notices"""
INCOMPLETE = WINDOW - 4.0
"""a cell that stays blind for more frames than this has a substituted reading among its last four"""

LEAST_VARIANCE = LEAST**2


def _rolled(rows: FloatArray) -> list[FloatArray]:
    """Coefficients (k, WINDOW) of readings from the oldest on, for a ring whose oldest is in row 0, 1, ..."""
    return [np.roll(rows, shift, axis=-1) for shift in range(WINDOW)]


_THIRD = np.zeros(WINDOW)
_THIRD[-4:] = np.array([1.0, -3.0, 3.0, -1.0]) / np.sqrt(20.0)
_THIRD_DIFFERENCE = _rolled(_THIRD)
"""of white noise it has the variance of the noise"""
_POWERS = np.vander(np.linspace(-1.0, 1.0, WINDOW), WINDOW, increasing=True)
_BESIDE_PARABOLA = _rolled(np.linalg.qr(_POWERS)[0][:, 3:].T.copy())
"""orthonormal rows, orthogonal to all parabolas; white noise keeps its variance in each row"""


class NoiseMeter:
    """Standard deviation of the readings of n cells, from one reading to the next.

    Noise below a quantisation step is not visible in the readings, and the step itself is visible only while they
    change. The resolution (:meth:`resolve`) is therefore a lower bound of the stated noise.
    """

    def __init__(self, cells: int, expected: float = 0.0) -> None:
        """``expected``: standard deviation of r at rest in an earlier recording; 0: unknown."""
        self._ring, self._seen = np.zeros((WINDOW, cells)), 0
        """(WINDOW, n) the last readings, and the number of frames that have been taken"""
        self.cells = zeros(NoiseState, cells)
        self.cells["variance"], self.cells["on_line"] = expected**2, np.inf
        self.at_rest = np.sqrt(self.cells["variance"] + LEAST**2)
        """(n,) standard deviation of r of a cell at rest; renewed in place"""
        self._passes_below = -1.0
        """fraction of outliers below which a cell's outliers are rejected; negative: they count, clipped to three
        standard deviations"""
        self._looks = 0
        self._expected = expected**2 if cells < MANY else 0.0
        # The median of few cells is itself uncertain, and gets less weight.
        self._shared_looks = EXPECTED_LOOKS if self._expected else min(cells // MANY, SHARED_LOOKS)
        self._any_blind = 0
        """number of further frames for which the window of any cell contains a substituted reading"""
        self._squares = np.empty(cells)
        self.typical = expected
        """standard deviation of the median cell at rest"""
        self.own = expected
        """the part of :attr:`typical` that is not shared with other cells of a column"""
        self._shared = 0.0
        """variance of shared noise before its subtraction, over that of own noise at rest; 0: no noise is shared"""
        self.quiet = np.inf
        """least recent noise of the median cell; an excess over it may be motion of the load; infinite: not known"""
        self.typical_resolution = 0.0
        """standard deviation of the median cell's r at rest by the quantisation of its own reading; 0: not known"""

    def reading(self, age: int = 0) -> FloatArray:
        """(n,) readings of ``age`` frames ago; a view."""
        reading: FloatArray = self._ring[(self._seen - 1 - age) % WINDOW]
        return reading

    def mean_of_recent(self, places: IntArray, count: int) -> FloatArray:
        """(k,) mean of the last ``count`` readings of cells; ``count`` is at most :data:`WINDOW`."""
        mean = np.empty(places.size)
        recent_means_each.unchecked(self._ring, (self._seen - 1) % WINDOW, places, count, mean)
        return mean

    def resolve(self, resolution: FloatArray) -> None:
        """Set the standard deviation (n,) of r at rest by the quantisation of each cell's own reading."""
        self.cells["resolution"] = resolution
        self.typical_resolution = float(np.median(resolution))
        np.maximum(self.at_rest, resolution, out=self.at_rest)

    def share(self, ratio: float) -> None:
        """Set the variance of shared noise over that of own noise at rest; 0: no noise is shared.

        Shared noise scales conductances: in r it is proportional to 1 + r. Own noise is proportional to (1 + r)^2.
        """
        scale = (1.0 + self._shared) / (1.0 + ratio)
        self.cells["variance"] *= scale
        self._expected *= scale
        self.own, self.quiet = self.own * scale**0.5, self.quiet * scale**0.5
        self._shared = ratio
        self.leave(ratio)

    def leave(self, excess: FloatArray | float) -> None:
        """Set the variance (n,) of shared noise that remains in the readings from now on."""
        self.cells["excess"] = excess
        if self._looks:
            self._find_typical()
            self._state_std()

    def update(self, r: FloatArray, known: BoolArray | None) -> None:
        """Take normalised resistances (n,); ``known`` (n,) marks those that were read, None: all."""
        self._ring[self._seen % WINDOW] = r
        self._seen += 1
        if known is not None:
            self.cells["blind"][~known] = WINDOW  # the window contains this reading for as many frames
            self._any_blind = WINDOW
        due = self._looks < SOON or self._seen % EVERY == 0
        if due and self._seen > 3:
            self._look(r)
        elif 1 < self._seen <= 3 and not self._looks and known is None and r.size >= MANY:
            self._guess(r)
        if self._any_blind:
            self.cells["blind"] -= 1.0
            self._any_blind -= 1

    def _guess(self, r: FloatArray) -> None:
        """Estimate the noise by the median change since the last frame, until there are four readings."""
        changes = (r - self.reading(1)) / (r + 1.0) ** 2
        self.typical = float(np.median(np.abs(changes))) / (2 * MEDIAN_OF_SQUARES) ** 0.5
        np.maximum(np.hypot(self.typical, LEAST), self.cells["resolution"], out=self.at_rest)

    def _look(self, r: FloatArray) -> None:
        """Average the square of the third difference that ends with ``r``."""
        squares = self._squares
        _THIRD_DIFFERENCE[self._seen % WINDOW].dot(self._ring, squares)
        square_each.unchecked(squares, r, self.cells)
        if not self._looks:
            self._begin(squares)
        self._looks += 1
        share = max(1 / (self._looks + self._shared_looks), EVERY / READINGS)
        average.unchecked(squares, self.cells, share, 1.0 / min(self._looks, CROWD_LOOKS), self._passes_below)
        self._renew()

    def _begin(self, squares: FloatArray) -> None:
        """Set the variances by the first squared differences (n,)."""
        variance = self.cells["variance"]
        if squares.size >= MANY:
            variance[...] = float(np.median(squares)) / MEDIAN_OF_SQUARES
        elif not self._expected:
            variance[...] = squares
        np.maximum(variance, LEAST**2, out=variance)

    def _renew(self) -> None:
        """Update all that depends on the variances, after a look."""
        variance = self.cells["variance"]
        if self._looks == FIRST and variance.size < MANY:
            self._raise()
        if self._expected and self._looks == KNOWN:  # remove the prior from the average
            variance += EXPECTED_LOOKS / KNOWN * (variance - self._expected)
            np.maximum(variance, LEAST**2, out=variance)
        if self._looks % POOL == 1:
            self._pool()
        self._state_std()

    def _state_std(self) -> None:
        """Update the standard deviations :attr:`at_rest`."""
        std_at_rest.unchecked(self.cells, self.reading(), self.at_rest)

    def _raise(self) -> None:
        """Raise variances whose first look was small by chance, so that later readings seemed to be outliers."""
        by_age = np.array([_THIRD_DIFFERENCE[(self._seen - age) % WINDOW] for age in range(FIRST)])
        squares = by_age @ self._ring
        for row in squares:
            square_each.unchecked(row, self.reading(), self.cells)
        middle, variance = np.median(squares, axis=0) / MEDIAN_OF_SQUARES, self.cells["variance"]
        np.copyto(variance, np.maximum(variance, middle), where=self.cells["blind"] <= 0.0)

    def _pool(self) -> None:
        variance, some = self.cells["variance"], slice(None, None, 1 + self.cells.size // ENOUGH)
        middle = median(variance[some])
        if variance.size >= MANY:
            np.minimum(variance, ABOVE_POOL * middle + LEAST**2, out=variance)
        self.own = middle**0.5
        self._find_typical()
        if self._looks > SOON:
            risen = variance.size >= MANY and median(self.cells["crowd"][some]) > ALL_CROWDED
            self._passes_below = -1.0 if risen else CROWDED
        if self._looks > KNOWN:
            least = max(self.own, self.typical_resolution, LEAST)
            self.quiet = min(FORGET * self.quiet, least)

    def _find_typical(self) -> None:
        """Update the noise of the median cell: its own, and the remaining shared noise."""
        self.typical = self.own
        if self._shared:
            self.typical *= (1.0 + median(self.cells["excess"][:: 1 + self.cells.size // ENOUGH])) ** 0.5

    def beside_parabola(self, places: IntArray) -> FloatArray:
        """(k,) variance of the last :data:`WINDOW` readings of cells about parabola fits, over the board's noise.

        A vibration within the noise looks like noise, but raises this ratio above 1. Parabolas absorb smooth motion.
        0 where the ratio is not known.
        """
        present = np.zeros(places.size)
        if self._seen >= WINDOW and math.isfinite(self.quiet):
            ring = self._ring.take(places, axis=1)
            beside = _BESIDE_PARABOLA[self._seen % WINDOW].dot(ring)
            beside_each.unchecked(places, beside, ring[(self._seen - 1) % WINDOW], self.cells, self.quiet, present)
        return present

    def state(self) -> dict[str, FloatArray]:
        """The state, by name."""
        of_array = [self.typical, self.own, self._shared, self.quiet, self._passes_below]
        return {
            "noise_ring": self._ring,
            "noise_cells": values(self.cells),
            "noise_at_rest": self.at_rest,
            "noise_of_array": np.array([*of_array, self._looks, self._seen, self._any_blind]),
        }

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a :meth:`state`."""
        self._ring, self.at_rest = state["noise_ring"], state["noise_at_rest"]
        values(self.cells)[...] = state["noise_cells"]
        of_array = state["noise_of_array"].tolist()
        self.typical, self.own, self._shared, self.quiet, self._passes_below = of_array[:5]
        self._looks, self._seen, self._any_blind = (int(count) for count in of_array[5:])
        self.typical_resolution = float(np.median(self.cells["resolution"]))


@loop
def recent_means_each(ring: Rows, newest: int, places: Places, count: int, mean: Row) -> None:
    """Write the mean of the last ``count`` readings of cells into ``mean`` (k,); ``newest`` is a row of the ring."""
    for k in range(places.size):
        total = ring[newest, places[k]]
        for age in range(1, count):
            total += ring[(newest - age) % ring.shape[0], places[k]]
        mean[k] = total * (1.0 / count)


@loop
def square_each(differences: Row, r: Row, cells: Records[NoiseState]) -> None:
    """Make third differences (n,) of readings ``r`` (n,) squares of differences at rest."""
    for i in range(r.size):
        cell, scale = cells[i], r[i] + 1.0
        square = differences[i] / (scale * math.sqrt(scale * scale + cell.excess))
        differences[i] = cell.variance if cell.blind > INCOMPLETE else square * square


@loop
def average(squares: Row, cells: Records[NoiseState], share: float, share_of_crowd: float, passes_below: float) -> None:
    """Take squared third differences (n,) at rest into the variances.

    ``share`` and ``share_of_crowd`` are their weights in the averages of the variance, and of the fraction of outliers.
    """
    uncut = UNCUT if passes_below > 0.0 else 1.0
    for i in range(squares.size):
        cell = cells[i]
        limit = cell.variance * OUTLIER + LEAST_VARIANCE
        outlies = squares[i] > limit or cell.on_line < ACROSS
        cell.crowd *= 1.0 - share_of_crowd
        if outlies:
            cell.crowd += share_of_crowd
        if cell.blind > INCOMPLETE or (outlies and cell.crowd < passes_below):
            continue
        cell.variance += (min(squares[i], limit) * uncut - cell.variance) * share


@loop
def std_at_rest(cells: Records[NoiseState], r: Row, std: Row) -> None:
    """Write the standard deviations ``std`` (n,) of r at rest; ``r`` (n,) are the present readings.

    Relative to (1 + r)^2, shared noise decreases with r.
    """
    for i in range(std.size):
        cell = cells[i]
        std[i] = math.sqrt(cell.variance + LEAST_VARIANCE)
        if cell.excess > 0.0:
            scale = r[i] + 1.0
            std[i] *= math.sqrt(cell.excess / (scale * scale) + 1.0)
        std[i] = max(std[i], cell.resolution)


@loop
def beside_each(
    places: Places, beside: Rows, last: Row, cells: Records[NoiseState], quiet: float, present: Row
) -> None:
    """Write the variance of readings about parabolas, over that of noise, into ``present`` (k,).

    ``beside`` (j, k) are the components of the readings orthogonal to parabolas, ``last`` (k,) the present readings.
    """
    for k in range(places.size):
        cell, scale = cells[places[k]], last[k] + 1.0
        scale *= math.sqrt(scale * scale + cell.excess)
        scale *= max(quiet, HALF_STEP * cell.resolution)
        total = 0.0
        for row in range(beside.shape[0]):
            part = beside[row, k] / scale
            total += part * part
        present[k] = 0.0 if cell.blind > 0.0 else total / beside.shape[0]


@loop
def noise_of(r: float, at_rest: float) -> float:
    """Standard deviation of a reading ``r`` by noise ``at_rest``, which is constant in conductance."""
    scale = max(r, -0.9) + 1.0
    return scale * scale * at_rest
