"""Noise measured from the readings themselves, by their third differences (a difference-based variance estimator).

A load that moves smoothly leaves almost nothing in the third difference of successive readings; white noise of
variance v leaves 20 v, the sum of the squared coefficients 1, -3, 3, -1. Boards measure currents, so that noise is
about constant in conductance: the noise of the normalised resistance r is kept relative to (1 + r)^2.

One cell that moves fast looks noisy. Differences across an edge of the load, which the smoothing has noticed, and
those far beyond the noise are therefore passed over (a redescending M-estimator), unless nearly all of them are such:
then the noise has risen. In an array most cells are at rest. There it is the median cell that tells whether noise has
risen, and no cell is taken to be much noisier than that one.

Other noise scales with the conductance: that of a supply, of a resistive divider, of the cell itself. Its standard
deviation in r is proportional to 1 + r. Readings of pressed cells tell how much of a board's noise is of this kind (a
variance function with an additive and a multiplicative component; Davidian and Carroll 1987). Taken for additive, noise
of 1 % at rest would be 2.5 % at 2.5 times the resistance at rest. So no more is taken for multiplicative than is clear.

Third differences of successive frames overlap, and tell nearly the same. Those of every third frame are all but
independent: averaging only these costs a quarter of the accuracy and a third of the time.
"""

from __future__ import annotations

import math

import numpy as np

from ...arrays import BoolArray, FloatArray, IntArray, median
from ...compiled import Places, Row, Rows, loop

READINGS = 200
"""over which the variance is averaged"""
EVERY = 3
"""readings between two looks at the third difference, once the noise is known roughly"""
SOON = READINGS // EVERY // 8
"""looks after which the noise is known roughly"""
FIRST = 9
"""looks after which the median of so many differences tells the noise of few cells; they are in one :data:`WINDOW`"""
OUTLIER = 9.0
"""times the variance, from which a squared third difference is an outlier: three standard deviations"""
ACROSS = 3.0
"""readings since the smoothing noticed an edge of the load. With fewer, the edge lies within the four readings of a
third difference, which is then an outlier, however small"""
UNCUT = 1.0274
"""variance of a normal variable over that of its values within three standard deviations"""
CROWD_LOOKS = 24
"""looks over which the share of outliers is averaged"""
CROWDED, ALL_CROWDED = 0.75, 0.5
"""share of outliers from which they tell of noise that has risen: of one cell, since taps at three hertz that a slow
board reads leave half of the readings clean; and of the median cell of an array, since few cells move at a time"""
LEAST = 1e-6
"""standard deviation of r below which readings are taken for exact"""
POOL = 6
"""looks between two of the median cell"""
ABOVE_POOL = 4.0
"""times the median variance of the array that a single cell may have"""
MANY = 9
"""cells from which the median of the array is trusted"""
SHARED_LOOKS = 16
"""looks at one cell that the median of a large array is worth at the beginning. By themselves the first differences of
a cell may be near zero by chance, and any reading after them would seem to jump"""
ENOUGH = 500
"""cells whose median stands for that of more"""
KNOWN = 24
"""looks from which the median cell tells how quiet the board is"""
EXPECTED_LOOKS = 4
"""looks that the noise of an earlier recording is worth to few cells, until theirs is known; many tell it at once"""
FORGET = 1.002
"""by which the least noise of the median cell grows from one look at it to the next, so that noise may rise for good"""
MEDIAN_OF_SQUARES = 0.4549
"""median of the square of a normal variable of variance 1"""
WINDOW = 12
"""readings that are kept, and compared with a parabola through them"""
RECENT = 4
"""frames between two looks at the window"""
HALF_STEP = math.sqrt(3.0)
"""half a step of an ADC over the standard deviation of an evenly distributed error, the resolution: no more is the
standard deviation of readings that flip between two codes, and such readings show no motion"""
PRESSED = 0.2
"""of r: from there on readings tell additive noise from multiplicative"""
DITHERED = 4.0
"""times the variance of the steps of the ADC, from which they are noise as any other: cells with less stay at one code
when they are pressed, and would seem to have no noise"""
CLEAR = 3.0
"""standard deviations by which the multiplicative share of the noise must exceed none"""
LONGEST = 800.0
"""information about that share, as of so many readings, beyond which older readings count for less"""
CROSSED = 10.0
"""times the variance of noise: a window that has more is crossed by an edge, which smoothing notices"""


def _rolled(rows: FloatArray) -> list[FloatArray]:
    """Coefficients (k, WINDOW) of readings from the oldest on, for a ring whose oldest is in row 0, 1, ..."""
    return [np.roll(rows, shift, axis=-1) for shift in range(WINDOW)]


_THIRD = np.zeros(WINDOW)
_THIRD[-4:] = np.array([1.0, -3.0, 3.0, -1.0]) / np.sqrt(20.0)
_THIRD_DIFFERENCE = _rolled(_THIRD)
_POWERS = np.vander(np.linspace(-1.0, 1.0, WINDOW), WINDOW, increasing=True)
_BESIDE_PARABOLA = _rolled(np.linalg.qr(_POWERS)[0][:, 3:].T.copy())
"""orthonormal rows; parabolas have no part in them, white noise has its variance in each"""
LEAST_VARIANCE = LEAST**2
WEIGHT, FOUND, COMMON, LATELY, BY_REST = range(5)
"""places of the sums that tell multiplicative noise: weights of readings; the same times the share that each tells; by
how much an error of the noise at rest would change the latter, since the last time; the same of late, as long as that
error lasts; and the variance that follows"""
_ZERO, _ONE, _OUTLIER, _LEAST_VARIANCE = (np.array(x) for x in (0.0, 1.0, OUTLIER, LEAST_VARIANCE))
_ACROSS, _UNCUT = np.array(ACROSS), np.array(UNCUT)
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


class NoiseMeter:
    """Standard deviation of the readings of n cells, from one reading to the next.

    Noise below the step of an ADC does not show in the readings, and the step itself does only while they change.
    Where the step is known it is therefore the least that is stated (:meth:`resolve`).
    """

    def __init__(self, cells: int, expected: float = 0.0) -> None:
        """``expected``: standard deviation of r at rest that an earlier recording had; 0 if there is none."""
        self._ring = np.zeros((WINDOW, cells))
        self._variance = np.full(cells, expected**2)
        self._crowd = np.zeros(cells)
        """(n,) share of outliers among the differences of late"""
        self._passes_below = -1.0
        """share of outliers below which those of a cell are passed over; negative: they count, as three deviations"""
        self._looks = 0
        self.on_line = np.full(cells, np.inf)
        """(n,) readings since the smoothing of a cell last noticed a change; whoever smooths sets it, in every frame"""
        self._expected = expected**2 if cells < MANY else 0.0
        # The median of few cells is itself uncertain, and counts for less.
        self._shared_looks = EXPECTED_LOOKS if self._expected else min(cells // MANY, SHARED_LOOKS)
        self._seen = 0
        self._blind = np.zeros(cells)
        self._any_blind = 0
        self._squares, self._limit = np.empty((2, cells))
        self._flags = np.empty((2, cells), dtype=np.bool_)
        self.typical = expected
        """standard deviation of the median cell at rest"""
        self.at_rest = np.sqrt(self._variance + LEAST**2)
        """(n,) standard deviation of r of a cell at rest; renewed in place"""
        self.own = expected
        """the part of it that no other cell of a column shares"""
        self.excess = np.zeros(cells)
        """(n,) variance at rest of what is left of shared noise, over that of own noise; see :mod:`._shared_noise`"""
        self._shared = 0.0
        """the same where nothing of it is taken out of the readings; 0: no noise is shared"""
        self.quiet = np.inf
        """the least that the median cell has had of late: what is more may be the load; infinite: not known"""
        self.multiplicative = 0.0
        """share of the variance of own noise at rest that scales with the conductance, as far as it is clear"""
        self._told = np.zeros(5)
        """sums that tell it, see :data:`WEIGHT`"""
        self.resolution = np.zeros(cells)
        """(n,) the part of it that the steps of the ADC make; 0: not known"""
        self.typical_resolution = 0.0
        """that of the median cell"""
        self.resolution_by_all = 0.0
        """the same by the steps of all readings that the median cell's resistance follows from; 0: not known"""
        self.compiled = False
        """whether the loops are there as machine code"""

    def resolve(self, resolution: FloatArray, by_all: float) -> None:
        """Take the standard deviation (n,) of r at rest that the steps of the ADC make: of own readings, and of all."""
        self.resolution, self.resolution_by_all = resolution, by_all
        self.typical_resolution = float(np.median(resolution))
        np.maximum(self.at_rest, resolution, out=self.at_rest)

    def share(self, ratio: float) -> None:
        """Let all cells share noise of ``ratio`` times the variance of own noise at rest; 0: none is shared.

        Shared noise scales conductances: in r it is proportional to 1 + r, where own noise is to (1 + r)^2.
        """
        scale = (1.0 + self._shared) / (1.0 + ratio)
        self._variance *= scale
        self._expected *= scale
        self.own, self.quiet = self.own * scale**0.5, self.quiet * scale**0.5
        self._shared = ratio
        self.leave(np.full(self.excess.size, ratio))

    def leave(self, excess: FloatArray) -> None:
        """Take the part (n,) of shared noise that the readings have from now on, as :attr:`excess`."""
        self.excess = excess
        if self._looks:
            self._find_typical()
            self._state_std()

    def _blurred(self, r: FloatArray) -> FloatArray:
        """(n,) or (rows, n) standard deviation of readings ``r`` of all cells, over that of own noise at rest."""
        scale: FloatArray = r + _ONE
        scale *= self._blurred_more(scale, self.excess)
        return scale

    def _blurred_more(self, scale: FloatArray, excess: FloatArray) -> FloatArray:
        """The same, over ``scale`` (m,), which is 1 + r; ``excess`` (m,) of the same cells."""
        if not (self._shared or self.multiplicative):
            return scale
        squares = scale * scale
        more: FloatArray = np.sqrt(squares * additive(squares, self.multiplicative) + excess)
        return more

    def update(self, r: FloatArray, known: BoolArray | None) -> None:
        """Take normalised resistances (n,); ``known`` (n,) marks those that were read, None: all."""
        self._ring[self._seen % WINDOW] = r
        self._seen += 1
        if known is not None:
            self._blind[~known] = WINDOW  # so many frames contain this reading
            self._any_blind = WINDOW
        due = self._looks < SOON or self._seen % EVERY == 0
        if due and self._seen > 3:
            self._look(r)
        elif 1 < self._seen <= 3 and not self._looks and known is None and r.size >= MANY:
            self._guess(r)
        if self._any_blind:
            self._blind -= 1.0
            self._any_blind -= 1

    @property
    def looks_next(self) -> bool:
        """Whether the noise is measured again in the next frame."""
        return self._looks < SOON or (self._seen + 1) % EVERY == 0

    def _guess(self, r: FloatArray) -> None:
        """Take the median cell's change from the last reading for noise, until there are four readings."""
        changes = (r - self._ring[(self._seen - 2) % WINDOW]) / (r + 1.0) ** 2
        self.typical = float(np.median(np.abs(changes))) / (2 * MEDIAN_OF_SQUARES) ** 0.5
        self.at_rest[:] = np.hypot(self.typical, LEAST)
        np.maximum(self.at_rest, self.resolution, out=self.at_rest)

    def _look(self, r: FloatArray) -> None:
        """Average the square of the third difference that ends with ``r``."""
        squares = self._squares
        _THIRD_DIFFERENCE[self._seen % WINDOW].dot(self._ring, squares)
        if self.compiled and self._looks:
            self._looks += 1
            kept = self._variance, self._crowd, self.on_line, self._blind
            shares = self._share, self._share_of_crowd
            law = self.excess, self.multiplicative, self.resolution, self._told
            average.unchecked(squares, r, *law, *kept, WINDOW - 4.0, *shares, self._passes_below)
            self._renew()
            return
        squares /= self._blurred(r)
        squares *= squares
        if self._any_blind:
            np.copyto(squares, self._variance, where=self._blind > WINDOW - 4)
        self._average(squares, r)

    def _average(self, squares: FloatArray, r: FloatArray) -> None:
        if not self._looks:
            if squares.size >= MANY:
                self._variance = np.full(squares.size, float(np.median(squares)) / MEDIAN_OF_SQUARES)
            elif not self._expected:
                self._variance = squares.copy()
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
                outlies |= self._blind > WINDOW - 4
            self._tell(squares, r, ~outlies)
            np.copyto(squares, self._variance, where=outlies)
        squares -= self._variance
        squares *= self._share
        self._variance += squares
        self._renew()

    def _tell(self, squares: FloatArray, r: FloatArray, counted: BoolArray) -> None:
        """Let squared third differences over the variance of ``r`` tell how much noise is multiplicative; all (n,).

        Weighted least squares: a square over its variance is 1 - (s - m) x, where s is the share, m what was taken for
        it, and x the derivative. A single reading weighs no more than 1.
        """
        tells = np.greater(r, PRESSED)
        if not np.count_nonzero(tells):
            return
        tells &= counted & (squares > _LEAST_VARIANCE) & (self._variance > DITHERED * self.resolution * self.resolution)
        cells = tells.nonzero()[0]
        if not cells.size:
            return
        ratio = squares.take(cells) / self._variance.take(cells)
        scale = r.take(cells) + _ONE
        scale *= scale
        slope = (scale - _ONE) / (scale * additive(scale, self.multiplicative) + self.excess.take(cells))
        weight = slope / (slope * slope + _ONE)
        found = slope * self.multiplicative + _ONE - ratio
        sums = np.add.accumulate([weight * slope, weight * found, weight], axis=1)[:, -1]
        sums[COMMON] /= math.sqrt(cells.size)  # errors of several cells
        self._told[: COMMON + 1] += sums

    def _find_multiplicative(self) -> None:
        """Renew the multiplicative share: none, where chance or an error of the noise at rest may be the cause."""
        weight, found, common, lately, by_rest = self._told.tolist()
        if not weight:
            return
        lately = lately * (1.0 - self._share) ** POOL + common
        by_rest += 2.0 * self._share * common * (2.0 * lately - common)
        share, doubt = found / weight, math.sqrt(2.0 * weight + by_rest) / weight
        self.multiplicative = min(share, 1.0) if share > CLEAR * doubt else 0.0
        less = min(LONGEST / weight, 1.0)
        self._told[:] = weight * less, found * less, 0.0, lately * less, by_rest * less * less

    @property
    def _share(self) -> float:
        """Of a look in the average."""
        return max(1 / (self._looks + self._shared_looks), EVERY / READINGS)

    @property
    def _share_of_crowd(self) -> float:
        """Of a look in the share of outliers."""
        return 1.0 / min(self._looks, CROWD_LOOKS)

    def _renew(self) -> None:
        """Renew the standard deviations after a look."""
        if self._looks == FIRST and self._variance.size < MANY:
            self._raise()
        if self._expected and self._looks == KNOWN:  # what was expected leaves the average again
            self._variance += EXPECTED_LOOKS / KNOWN * (self._variance - self._expected)
            np.maximum(self._variance, LEAST**2, out=self._variance)
        if self._looks % POOL == 1:
            self._find_multiplicative()
            self._pool()
        self._state_std()

    def _state_std(self) -> None:
        """Renew the standard deviations."""
        if self.compiled:
            resolved, last = self.typical_resolution > 0.0, self._ring[(self._seen - 1) % WINDOW]
            law = self.excess, self.multiplicative
            std_at_rest.unchecked(self._variance, self.resolution, resolved, last, *law, self.at_rest)
            return
        np.add(self._variance, _LEAST_VARIANCE, self.at_rest)
        np.sqrt(self.at_rest, self.at_rest)
        if self._shared or self.multiplicative:
            scale = self._ring[(self._seen - 1) % WINDOW] + _ONE
            scale *= scale
            self.at_rest *= np.sqrt(self.excess / scale + additive(scale, self.multiplicative))
        if self.typical_resolution:
            np.maximum(self.at_rest, self.resolution, out=self.at_rest)

    def _raise(self) -> None:
        """Raise a variance whose first look was small by chance, so that readings after it seemed to be outliers."""
        last = self._seen % WINDOW
        differences = np.array([_THIRD_DIFFERENCE[(last - age) % WINDOW] for age in range(FIRST)]) @ self._ring
        differences /= self._blurred(self._ring[last - 1])
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
        """Renew the noise of the median cell, with what shared noise adds to its own."""
        self.typical = self.own
        if self._shared:
            self.typical *= (1.0 + median(self.excess[:: 1 + self.excess.size // ENOUGH])) ** 0.5

    def beside_parabola(self, cells: IntArray) -> FloatArray:
        """(m,) variance of the last :data:`WINDOW` readings of ``cells`` about parabolas, over the board's noise.

        A vibration within the noise looks like noise, but the board has less. Parabolas take up what moves smoothly.
        0 where that is not known.
        """
        present: FloatArray
        if self._seen < WINDOW or not math.isfinite(self.quiet):
            return np.zeros(cells.size)
        ring = self._ring.take(cells, axis=1)
        beside = np.dot(_BESIDE_PARABOLA[self._seen % WINDOW], ring)
        if self.compiled:
            present = np.empty(cells.size)
            last = (self._seen - 1) % WINDOW
            of_cells = self.resolution, self.excess, self.multiplicative, self._blind
            beside_each.unchecked(cells, beside, ring, last, self.quiet, *of_cells, present)
            return present
        scale = ring[(self._seen - 1) % WINDOW] + 1.0
        scale *= self._blurred_more(scale, self.excess[cells])
        scale *= np.maximum(self.quiet, HALF_STEP * self.resolution[cells])
        beside /= scale
        beside *= beside
        present = np.add.accumulate(beside)[-1] / len(beside)
        if self._any_blind:
            present[self._blind[cells] > 0] = 0.0
        return present

    @property
    def window(self) -> tuple[FloatArray, int]:
        """(WINDOW, n) the last readings, and which row is the newest."""
        return self._ring, (self._seen - 1) % WINDOW

    def mean_of_recent(self, cells: IntArray, count: int) -> FloatArray:
        """(m,) mean of the last ``count`` readings of ``cells``, no more than :data:`WINDOW`."""
        if self.compiled:
            mean = np.empty(cells.size)
            recent_means_each.unchecked(*self.window, cells, count, mean)
            return mean
        return recent_means(*self.window, cells, count)

    def std(self, r: FloatArray, cells: slice | IntArray = slice(None)) -> FloatArray:
        """Standard deviation of the readings ``r`` of ``cells``."""
        scale = np.maximum(r, -0.9)
        scale += 1.0
        scale *= scale
        scale *= self.at_rest[cells]
        return np.asarray(scale)

    def change_before(self, cells: IntArray) -> FloatArray:
        """Change of the readings of ``cells`` from the last but two to the last but one."""
        before, last = self._ring[(self._seen - 3) % WINDOW], self._ring[(self._seen - 2) % WINDOW]
        return np.asarray(last[cells] - before[cells])

    def last_but_one(self) -> FloatArray:
        """(n,) readings of the frame before this one; the array is the caller's."""
        return np.asarray(self._ring[(self._seen - 2) % WINDOW].copy())

    def state(self) -> dict[str, FloatArray]:
        """All that is remembered."""
        return {
            "noise_ring": self._ring,
            "noise_blind": self._blind,
            "noise_variance": self._variance,
            "noise_at_rest": self.at_rest,
            "noise_resolution": self.resolution,
            "noise_crowd": self._crowd,
            "noise_on_line": self.on_line,
            "noise_counts": np.array([self._looks, self._seen, self._any_blind], dtype=np.float64),
            "noise_excess": self.excess,
            "noise_of_array": np.array(
                [self.typical, self.own, self._shared, self.quiet, self._passes_below, self.resolution_by_all]
            ),
            "noise_multiplicative": np.array([self.multiplicative, *self._told]),
        }

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a :meth:`state`."""
        self._ring, self._blind, self._variance = (state[f"noise_{name}"] for name in ("ring", "blind", "variance"))
        self._crowd, self.on_line = state["noise_crowd"], state["noise_on_line"]
        looks, seen, any_blind = state["noise_counts"].tolist()
        self.excess = state["noise_excess"]
        of_array = state["noise_of_array"].tolist()
        self.typical, self.own, self._shared, self.quiet, self._passes_below, by_all = of_array
        self._looks, self._seen, self._any_blind = int(looks), int(seen), int(any_blind)
        self._told = state["noise_multiplicative"].copy()
        self.multiplicative, self._told = self._told.item(0), self._told[1:]
        self.at_rest = state["noise_at_rest"]
        self.resolve(state["noise_resolution"], by_all)


def additive(squares: FloatArray, multiplicative: float) -> FloatArray:
    """(m,) variance of noise of which a share is ``multiplicative``, over what it would be if all were additive.

    Args:
        squares: (m,) of 1 + r. Cells that read below rest have the noise of rest.
        multiplicative: share of the variance at rest.
    """
    part: FloatArray = multiplicative / np.maximum(squares, _ONE)
    part += 1.0 - multiplicative
    return part


@loop
def additive_of(square: float, multiplicative: float) -> float:
    """:func:`additive` of one cell."""
    return multiplicative / max(square, 1.0) + (1.0 - multiplicative)


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


@loop
def average(
    squares: Row,
    r: Row,
    excess: Row,
    multiplicative: float,
    resolution: Row,
    told: Row,
    variance: Row,
    crowd: Row,
    on_line: Row,
    blind: Row,
    since: float,
    share: float,
    share_of_crowd: float,
    passes_below: float,
) -> None:
    """:meth:`NoiseMeter._average`, of third differences (n,) that are not squared yet, as a loop over cells.

    Cells keep their variance that are ``blind`` (n,) for more than ``since`` frames to come. Adds to what is ``told``
    (5,) of multiplicative noise, as :meth:`NoiseMeter._tell`.
    """
    uncut = UNCUT if passes_below > 0.0 else 1.0
    tell, weights, found, common = 0, 0.0, 0.0, 0.0
    for i in range(r.size):
        scale = r[i] + 1.0
        more = scale * scale * additive_of(scale * scale, multiplicative) + excess[i]
        square = squares[i] / (scale * math.sqrt(more))
        square *= square
        is_blind = blind[i] > since
        if is_blind:
            square = variance[i]
        limit = variance[i] * OUTLIER + LEAST_VARIANCE
        outlies = square > limit or on_line[i] < ACROSS
        crowd[i] *= 1.0 - share_of_crowd
        if outlies:
            crowd[i] += share_of_crowd
        if is_blind or (outlies and crowd[i] < passes_below):
            continue
        square = min(square, limit) * uncut
        tells = passes_below > 0.0 and r[i] > PRESSED and square > LEAST_VARIANCE
        if tells and variance[i] > DITHERED * resolution[i] * resolution[i]:
            slope = (scale * scale - 1.0) / more
            weight = slope / (slope * slope + 1.0)
            tell += 1
            weights += weight * slope
            found += weight * (slope * multiplicative + 1.0 - square / variance[i])
            common += weight
        variance[i] += (square - variance[i]) * share
    told[WEIGHT] += weights
    told[FOUND] += found
    told[COMMON] += common / math.sqrt(max(tell, 1))


@loop
def std_at_rest(
    variance: Row, resolution: Row, resolved: bool, r: Row, excess: Row, multiplicative: float, std: Row
) -> None:
    """Standard deviations (n,) of r at rest from the variances of the noise, as a loop over cells.

    ``excess`` (n,) is what shared noise adds to them, where the cells read ``r`` (n,). Of a reading, ``multiplicative``
    noise makes the less, the larger it is.
    """
    for i in range(std.size):
        std[i] = math.sqrt(variance[i] + LEAST_VARIANCE)
        if excess[i] > 0.0 or multiplicative > 0.0:
            scale = r[i] + 1.0
            scale *= scale
            std[i] *= math.sqrt(excess[i] / scale + additive_of(scale, multiplicative))
        if resolved:
            std[i] = max(std[i], resolution[i])


@loop
def beside_each(
    cells: Places,
    beside: Rows,
    ring: Rows,
    last: int,
    quiet: float,
    resolution: Row,
    excess: Row,
    multiplicative: float,
    blind: Row,
    present: Row,
) -> None:
    """The rest of :meth:`NoiseMeter.beside_parabola` as a loop over cells, into ``present`` (m,).

    Args:
        cells: (m,) indices.
        beside: (k, m) parts of the readings that parabolas do not take up.
        ring: (WINDOW, m) readings, of which those in row ``last`` are the present ones.
        last: that row.
        quiet: the board's noise.
        resolution: (n,) what the steps of the ADC add.
        excess: (n,) variance of shared noise at rest, over that of own noise.
        multiplicative: share of own noise that is.
        blind: (n,) frames for which a cell's readings are not complete.
        present: (m,), changed.
    """
    rows = beside.shape[0]
    for i in range(cells.size):
        scale = ring[last, i] + 1.0
        scale *= math.sqrt(scale * scale * additive_of(scale * scale, multiplicative) + excess[cells[i]])
        scale *= max(quiet, HALF_STEP * resolution[cells[i]])
        total = 0.0
        for row in range(rows):
            part = beside[row, i] / scale
            total += part * part
        present[i] = 0.0 if blind[cells[i]] > 0.0 else total / rows


LOOPS = average, std_at_rest, beside_each
