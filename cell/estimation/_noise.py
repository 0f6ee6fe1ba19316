"""Noise measured from the readings themselves, by their third differences (a difference-based variance estimator).

Smooth motion of a load contributes almost nothing to the third difference of successive readings. White noise of
variance v contributes 20 v, since 20 is the sum of the squared coefficients 1, -3, 3, -1. Boards measure currents, so
that noise is about constant in conductance. The noise of the normalised resistance r is therefore stored relative to
(1 + r)^2.

A cell under a fast load looks noisy. Two kinds of differences are therefore rejected (a redescending M-estimator):
those across an edge of the load that the smoothing has noticed, and those far beyond the noise. If nearly all
differences are outliers, the noise has risen, and they count. In an array most cells are at rest. There the median cell
decides whether noise has risen, and no cell may be much noisier than the median cell.

Other noise scales with the conductance. Its share is estimated from readings of pressed cells
(:mod:`._multiplicative`).

Third differences of successive frames overlap and carry nearly the same information. Those of every third frame are
almost independent: averaging only these costs a quarter of the accuracy and a third of the time.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray, median
from ...common.compiled import Places, Row, Rows, loop
from ._multiplicative import COMMON, FOUND, WEIGHT, MultiplicativeNoise, additive, additive_of
from ._window import WINDOW, Window

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
PRESSED = 0.2
"""r beyond which readings can distinguish additive from multiplicative noise"""
DITHERED = 4.0
"""multiple of the variance by quantisation, beyond which the steps of the ADC act as ordinary noise. Cells with less
noise stay at one code when they are pressed, and would seem to have no noise"""
INCOMPLETE = WINDOW - 4.0
"""a cell that stays blind for more frames than this has a substituted reading among its last four"""

VARIANCE, CROWD, ON_LINE, BLIND, EXCESS, RESOLUTION = range(6)
"""rows of the state of each cell, see :meth:`NoiseMeter._name_rows`"""
LEAST_VARIANCE = LEAST**2
_ZERO, _ONE, _OUTLIER, _LEAST_VARIANCE = (np.array(x) for x in (0.0, 1.0, OUTLIER, LEAST_VARIANCE))
_ACROSS, _UNCUT = np.array(ACROSS), np.array(UNCUT)
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


class NoiseMeter:
    """Standard deviation of the readings of n cells, from one reading to the next.

    Noise below a quantisation step is not visible in the readings, and the step itself is visible only while they
    change. The resolution (:meth:`resolve`) is therefore a lower bound of the stated noise.
    """

    def __init__(self, cells: int, expected: float = 0.0) -> None:
        """``expected``: standard deviation of r at rest in an earlier recording; 0: unknown."""
        self.window = Window(cells)
        """the last readings"""
        self._cells = np.zeros((6, cells))
        self._name_rows()
        self._variance[...] = expected**2
        self.on_line[...] = np.inf
        self._passes_below = -1.0
        """fraction of outliers below which a cell's outliers are rejected; negative: they count, clipped to three
        standard deviations"""
        self._looks = 0
        self._expected = expected**2 if cells < MANY else 0.0
        # The median of few cells is itself uncertain, and gets less weight.
        self._shared_looks = EXPECTED_LOOKS if self._expected else min(cells // MANY, SHARED_LOOKS)
        self._any_blind = 0
        self._squares, self._limit = np.empty((2, cells))
        self._flags = np.empty((2, cells), dtype=np.bool_)
        self.typical = expected
        """standard deviation of the median cell at rest"""
        self.at_rest = np.sqrt(self._variance + LEAST**2)
        """(n,) standard deviation of r of a cell at rest; renewed in place"""
        self.own = expected
        """the part of :attr:`typical` that is not shared with other cells of a column"""
        self._shared = 0.0
        """variance of shared noise before its subtraction, over that of own noise at rest; 0: no noise is shared"""
        self.quiet = np.inf
        """least recent noise of the median cell; an excess over it may be motion of the load; infinite: not known"""
        self._multiplicative = MultiplicativeNoise()
        self.typical_resolution = 0.0
        """standard deviation of the median cell's r at rest by the quantisation of its own reading; 0: not known"""
        self.resolution_by_all = 0.0
        """the same by the quantisation of all readings that its resistance is computed from; 0: not known"""
        self.compiled = False
        """whether compiled loops are in use"""

    def _name_rows(self) -> None:
        self._variance, self._crowd, self.on_line, self._blind, self.excess, self.resolution = self._cells
        """rows (n,), views of one array that the loops take.

        ``_variance``: variance of own noise at rest. ``_crowd``: recent fraction of outliers among the differences.
        ``on_line``: readings since the smoothing of a cell last noticed a change; written by the smoothing. ``_blind``:
        number of further frames for which the window contains substituted readings. ``excess``: variance at rest of the
        remaining shared noise over that of own noise, see :mod:`._shared_noise`. ``resolution``: part of
        :attr:`at_rest` by quantisation, 0: not known."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue from a pickle or a copy; the rows have to be made views of ``_cells`` again."""
        self.__dict__.update(state)
        self._name_rows()

    @property
    def multiplicative(self) -> float:
        """Share of the variance of own noise at rest that scales with the conductance; 0 while it is not clear."""
        return self._multiplicative.share

    def resolve(self, resolution: FloatArray, by_all: float) -> None:
        """Set the standard deviation of r at rest by quantisation: (n,) of own readings, and one number ``by_all``."""
        self.resolution[...], self.resolution_by_all = resolution, by_all
        self.typical_resolution = float(np.median(resolution))
        np.maximum(self.at_rest, resolution, out=self.at_rest)

    def share(self, ratio: float) -> None:
        """Set the variance of shared noise over that of own noise at rest; 0: no noise is shared.

        Shared noise scales conductances: in r it is proportional to 1 + r. Own noise is proportional to (1 + r)^2.
        """
        scale = (1.0 + self._shared) / (1.0 + ratio)
        self._variance *= scale
        self._expected *= scale
        self.own, self.quiet = self.own * scale**0.5, self.quiet * scale**0.5
        self._shared = ratio
        self.leave(ratio)

    def leave(self, excess: FloatArray | float) -> None:
        """Set :attr:`excess` (n,): the variance of shared noise that remains in the readings from now on."""
        self.excess[...] = excess
        if self._looks:
            self._find_typical()
            self._state_std()

    def _blurred(self, r: FloatArray) -> FloatArray:
        """(n,) or (rows, n) standard deviation of readings ``r`` of all cells, over that of own noise at rest."""
        scale: FloatArray = r + _ONE
        scale *= self._blurred_more(scale, self.excess)
        return scale

    def _blurred_more(self, scale: FloatArray, excess: FloatArray) -> FloatArray:
        """The same divided by ``scale`` (m,) = 1 + r; ``excess`` (m,) belongs to the same cells."""
        if not (self._shared or self.multiplicative):
            return scale
        squares = scale * scale
        more: FloatArray = np.sqrt(squares * additive(squares, self.multiplicative) + excess)
        return more

    def update(self, r: FloatArray, known: BoolArray | None) -> None:
        """Take normalised resistances (n,); ``known`` (n,) marks those that were read, None: all."""
        self.window.take(r)
        if known is not None:
            self._blind[~known] = WINDOW  # the window contains this reading for as many frames
            self._any_blind = WINDOW
        seen = self.window.seen
        due = self._looks < SOON or seen % EVERY == 0
        if due and seen > 3:
            self._look(r)
        elif 1 < seen <= 3 and not self._looks and known is None and r.size >= MANY:
            self._guess(r)
        if self._any_blind:
            self._blind -= 1.0
            self._any_blind -= 1

    @property
    def looks_next(self) -> bool:
        """Whether the noise is measured again in the next frame."""
        return self._looks < SOON or (self.window.seen + 1) % EVERY == 0

    def _guess(self, r: FloatArray) -> None:
        """Estimate the noise by the median change since the last frame, until there are four readings."""
        changes = (r - self.window.reading(1)) / (r + 1.0) ** 2
        self.typical = float(np.median(np.abs(changes))) / (2 * MEDIAN_OF_SQUARES) ** 0.5
        self.at_rest[:] = np.hypot(self.typical, LEAST)
        np.maximum(self.at_rest, self.resolution, out=self.at_rest)

    def _look(self, r: FloatArray) -> None:
        """Average the square of the third difference that ends with ``r``."""
        squares = self._squares
        self.window.third_difference(squares)
        if self.compiled and self._looks:
            self._looks += 1
            shares = self._share, self._share_of_crowd, self._passes_below
            average.unchecked(squares, r, self._cells, self._multiplicative.sums, self.multiplicative, *shares)
            self._renew()
            return
        squares /= self._blurred(r)
        squares *= squares
        if self._any_blind:
            np.copyto(squares, self._variance, where=self._blind > INCOMPLETE)
        self._average(squares, r)

    def _average(self, squares: FloatArray, r: FloatArray) -> None:
        if not self._looks:
            if squares.size >= MANY:
                self._variance[...] = float(np.median(squares)) / MEDIAN_OF_SQUARES
            elif not self._expected:
                self._variance[...] = squares
            np.maximum(self._variance, LEAST**2, out=self._variance)
        self._looks += 1
        np.multiply(self._variance, _OUTLIER, self._limit)
        self._limit += _LEAST_VARIANCE
        outlies, flags = self._flags
        np.greater(squares, self._limit, outlies)
        np.less(self.on_line, _ACROSS, flags)
        outlies |= flags
        np.minimum(squares, self._limit, out=squares)
        share = self._share_of_crowd
        self._crowd *= 1.0 - share
        np.add(self._crowd, share, out=self._crowd, where=outlies)
        if self._passes_below > 0.0:
            squares *= _UNCUT
            np.less(self._crowd, self._passes_below, flags)
            outlies &= flags
            if self._any_blind:
                outlies |= self._blind > INCOMPLETE
            self._tell(squares, r, ~outlies)
            np.copyto(squares, self._variance, where=outlies)
        squares -= self._variance
        squares *= self._share
        self._variance += squares
        self._renew()

    def _tell(self, squares: FloatArray, r: FloatArray, counted: BoolArray) -> None:
        """Use squared third differences of ``r`` to estimate the multiplicative share of the noise; all (n,)."""
        tells = np.greater(r, PRESSED)
        if not np.count_nonzero(tells):
            return
        tells &= counted & (squares > _LEAST_VARIANCE) & (self._variance > DITHERED * self.resolution * self.resolution)
        cells = tells.nonzero()[0]
        if cells.size:
            ratio = squares.take(cells) / self._variance.take(cells)
            self._multiplicative.tell(ratio, r.take(cells), self.excess.take(cells))

    @property
    def _share(self) -> float:
        """Weight of a look in the average of the variance."""
        return max(1 / (self._looks + self._shared_looks), EVERY / READINGS)

    @property
    def _share_of_crowd(self) -> float:
        """Weight of a look in the average of the fraction of outliers."""
        return 1.0 / min(self._looks, CROWD_LOOKS)

    def _renew(self) -> None:
        """Update all that depends on the variances, after a look."""
        if self._looks == FIRST and self._variance.size < MANY:
            self._raise()
        if self._expected and self._looks == KNOWN:  # remove the prior from the average
            self._variance += EXPECTED_LOOKS / KNOWN * (self._variance - self._expected)
            np.maximum(self._variance, LEAST**2, out=self._variance)
        if self._looks % POOL == 1:
            self._multiplicative.find(self._share, POOL)
            self._pool()
        self._state_std()

    def _state_std(self) -> None:
        """Update the standard deviations :attr:`at_rest`."""
        if self.compiled:
            resolved, last = self.typical_resolution > 0.0, self.window.reading()
            std_at_rest.unchecked(self._cells, resolved, last, self.multiplicative, self.at_rest)
            return
        np.add(self._variance, _LEAST_VARIANCE, self.at_rest)
        np.sqrt(self.at_rest, self.at_rest)
        if self._shared or self.multiplicative:
            scale = self.window.reading() + _ONE
            scale *= scale
            self.at_rest *= np.sqrt(self.excess / scale + additive(scale, self.multiplicative))
        if self.typical_resolution:
            np.maximum(self.at_rest, self.resolution, out=self.at_rest)

    def _raise(self) -> None:
        """Raise variances whose first look was small by chance, so that later readings seemed to be outliers."""
        differences = self.window.third_differences(FIRST)
        differences /= self._blurred(self.window.reading())
        middle = np.median(differences**2, axis=0) / MEDIAN_OF_SQUARES
        np.copyto(self._variance, np.maximum(self._variance, middle), where=self._blind <= 0.0)

    def _pool(self) -> None:
        middle = median(self._variance[:: 1 + self._variance.size // ENOUGH])
        if self._variance.size >= MANY:
            np.minimum(self._variance, ABOVE_POOL * middle + LEAST**2, out=self._variance)
        self.own = middle**0.5
        self._find_typical()
        if self._looks > SOON:
            risen = self._variance.size >= MANY and median(self._crowd[:: 1 + self._crowd.size // ENOUGH]) > ALL_CROWDED
            self._passes_below = -1.0 if risen else CROWDED
        if self._looks > KNOWN:
            least = max(self.own, self.typical_resolution, LEAST)
            self.quiet = min(FORGET * self.quiet, least)

    def _find_typical(self) -> None:
        """Update the noise of the median cell: its own, and the remaining shared noise."""
        self.typical = self.own
        if self._shared:
            self.typical *= (1.0 + median(self.excess[:: 1 + self.excess.size // ENOUGH])) ** 0.5

    def beside_parabola(self, cells: IntArray) -> FloatArray:
        """(m,) variance of the last :data:`WINDOW` readings of ``cells`` about parabola fits, over the board's noise.

        A vibration within the noise looks like noise, but raises this ratio above 1. Parabolas absorb smooth motion.
        0 where the ratio is not known.
        """
        present: FloatArray
        if self.window.seen < WINDOW or not math.isfinite(self.quiet):
            return np.zeros(cells.size)
        beside, last = self.window.beside_parabola(cells)
        if self.compiled:
            present = np.empty(cells.size)
            beside_each.unchecked(cells, beside, last, self._cells, self.quiet, self.multiplicative, present)
            return present
        scale = last + _ONE
        scale *= self._blurred_more(scale, self.excess[cells])
        scale *= np.maximum(self.quiet, HALF_STEP * self.resolution[cells])
        beside /= scale
        beside *= beside
        present = np.add.accumulate(beside)[-1] / len(beside)
        if self._any_blind:
            present[self._blind[cells] > 0] = 0.0
        return present

    def std(self, r: FloatArray, cells: slice | IntArray = slice(None)) -> FloatArray:
        """Standard deviation of the readings ``r`` of ``cells``."""
        scale = np.maximum(r, -0.9)
        scale += 1.0
        scale *= scale
        scale *= self.at_rest[cells]
        return np.asarray(scale)

    def state(self) -> dict[str, FloatArray]:
        """The state, by name."""
        return {
            "noise_ring": self.window.ring,
            "noise_blind": self._blind,
            "noise_variance": self._variance,
            "noise_at_rest": self.at_rest,
            "noise_resolution": self.resolution,
            "noise_crowd": self._crowd,
            "noise_on_line": self.on_line,
            "noise_counts": np.array([self._looks, self.window.seen, self._any_blind], dtype=np.float64),
            "noise_excess": self.excess,
            "noise_of_array": np.array(
                [self.typical, self.own, self._shared, self.quiet, self._passes_below, self.resolution_by_all]
            ),
            "noise_multiplicative": self._multiplicative.state(),
        }

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a :meth:`state`."""
        for row, name in ((VARIANCE, "variance"), (CROWD, "crowd"), (ON_LINE, "on_line"), (BLIND, "blind")):
            self._cells[row] = state[f"noise_{name}"]
        looks, seen, any_blind = state["noise_counts"].tolist()
        self.excess[...] = state["noise_excess"]
        of_array = state["noise_of_array"].tolist()
        self.typical, self.own, self._shared, self.quiet, self._passes_below, by_all = of_array
        self._looks, self._any_blind = int(looks), int(any_blind)
        self.window.ring, self.window.seen = state["noise_ring"], int(seen)
        self._multiplicative.restore(state["noise_multiplicative"])
        self.at_rest = state["noise_at_rest"]
        self.resolve(state["noise_resolution"], by_all)


@loop
def average(
    squares: Row,
    r: Row,
    cells: Rows,
    told: Row,
    multiplicative: float,
    share: float,
    share_of_crowd: float,
    passes_below: float,
) -> None:
    """:meth:`NoiseMeter._average` as a loop over cells, for third differences ``squares`` (n,) not squared yet.

    ``cells`` (6, n) has the rows of :meth:`NoiseMeter._name_rows`. Adds to the sums ``told`` (5,) of multiplicative
    noise, as :meth:`.MultiplicativeNoise.tell` does.
    """
    uncut = UNCUT if passes_below > 0.0 else 1.0
    tell, weights, found, common = 0, 0.0, 0.0, 0.0
    for i in range(r.size):
        variance = cells[VARIANCE, i]
        scale = r[i] + 1.0
        more = scale * scale * additive_of(scale * scale, multiplicative) + cells[EXCESS, i]
        square = squares[i] / (scale * math.sqrt(more))
        square *= square
        is_blind = cells[BLIND, i] > INCOMPLETE
        if is_blind:
            square = variance
        limit = variance * OUTLIER + LEAST_VARIANCE
        outlies = square > limit or cells[ON_LINE, i] < ACROSS
        cells[CROWD, i] *= 1.0 - share_of_crowd
        if outlies:
            cells[CROWD, i] += share_of_crowd
        if is_blind or (outlies and cells[CROWD, i] < passes_below):
            continue
        square = min(square, limit) * uncut
        tells = passes_below > 0.0 and r[i] > PRESSED and square > LEAST_VARIANCE
        if tells and variance > DITHERED * cells[RESOLUTION, i] * cells[RESOLUTION, i]:
            slope = (scale * scale - 1.0) / more
            weight = slope / (slope * slope + 1.0)
            tell += 1
            weights += weight * slope
            found += weight * (slope * multiplicative + 1.0 - square / variance)
            common += weight
        cells[VARIANCE, i] += (square - variance) * share
    told[WEIGHT] += weights
    told[FOUND] += found
    told[COMMON] += common / math.sqrt(max(tell, 1))


@loop
def std_at_rest(cells: Rows, resolved: bool, r: Row, multiplicative: float, std: Row) -> None:
    """Write the standard deviations ``std`` (n,) of r at rest, from the variances of the noise, as a loop over cells.

    ``cells`` (6, n) has the rows of :meth:`NoiseMeter._name_rows`; ``r`` (n,) are the present readings. Relative to
    (1 + r)^2, ``multiplicative`` and shared noise decrease with r.
    """
    for i in range(std.size):
        std[i] = math.sqrt(cells[VARIANCE, i] + LEAST_VARIANCE)
        if cells[EXCESS, i] > 0.0 or multiplicative > 0.0:
            scale = r[i] + 1.0
            scale *= scale
            std[i] *= math.sqrt(cells[EXCESS, i] / scale + additive_of(scale, multiplicative))
        if resolved:
            std[i] = max(std[i], cells[RESOLUTION, i])


@loop
def beside_each(
    places: Places, beside: Rows, last: Row, cells: Rows, quiet: float, multiplicative: float, present: Row
) -> None:
    """The second part of :meth:`NoiseMeter.beside_parabola` as a loop over cells.

    Args:
        places: (m,) indices of the cells.
        beside: (k, m) components of the readings orthogonal to parabolas.
        last: (m,) the present readings.
        cells: (6, n) rows of :meth:`NoiseMeter._name_rows`.
        quiet: the board's noise.
        multiplicative: multiplicative share of own noise.
        present: (m,) the result; written.
    """
    rows = beside.shape[0]
    for i in range(places.size):
        cell = places[i]
        scale = last[i] + 1.0
        scale *= math.sqrt(scale * scale * additive_of(scale * scale, multiplicative) + cells[EXCESS, cell])
        scale *= max(quiet, HALF_STEP * cells[RESOLUTION, cell])
        total = 0.0
        for row in range(rows):
            part = beside[row, i] / scale
            total += part * part
        present[i] = 0.0 if cells[BLIND, cell] > 0.0 else total / rows


LOOPS = average, std_at_rest, beside_each
