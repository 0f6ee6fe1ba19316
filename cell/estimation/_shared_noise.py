"""Common-mode rejection: noise that all cells of a column share is measured by cells at rest, and subtracted.

On a divider whose idle rows are driven, the currents of a whole column flow through one reference resistor. A
conductance is proportional to s / (1 - S): s is the cell's reading as a share of the supply, S the sum of all readings
of the column. 1 - S is small. Its errors scale all conductances of the column alike, and are several times larger than
the error of the cell's own reading.

Sleeping cells measure the shared part in every frame, since their resistance is that of rest. The mean of their
departures is subtracted from all cells of the column. A load on all cells of a column moves them alike, too. The mean
that wakes a sleeping cell is therefore taken of readings before the subtraction, so that such a load wakes the cells as
if nothing were subtracted.

A second hazard: another cell of the column may be held while a load comes to the sleeping cells. If that load were
subtracted as noise, the held cell would seem to be released. But noise is white from frame to frame, and a load is not.
A cumulative sum (Page's CUSUM) of the sleeping cells' mean departure, in the direction of loads, detects such a load
within a few frames. Subtraction then stops, and the cells wake. While the test is undecided, the subtraction may move
the reading of an awake cell back to its last reading, but not beyond: noise moves that cell, a load on others does not.
The variance meanwhile includes the load that the test suspects (:meth:`SharedNoise.doubt`). Its size is the mean
departure since the sum began to rise, the usual estimate of a change's size in Page's test.

Two numbers describe the circuit to the estimator: the standard deviations of a conductance by the quantisation steps of
its own reading, and by those of all readings (:meth:`._estimator.Estimator.resolve`). Noise propagates as quantisation
steps do. A test first verifies that the columns do share noise. Readings of a divider with floating rows depend on one
another as well, but in another way.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Flags, Row, Rows, loop
from . import _shared_steps as shared_steps
from ._noise import NoiseMeter

LEAST_CELLS = 3
"""least number of sleeping cells that measure the shared noise of a column; with fewer, a bad contact would count as
noise"""
SURE = 4.0
"""standard deviations at which a departure is clipped (winsorised): beyond, a bad contact or the begin of a load"""
REFERENCE_S = 3.0
"""time constant in seconds of the mean of a sleeping cell, from which its departures are counted"""
TESTED = 200
"""number of samples (one column in one frame each) in the test whether columns share noise"""
MOVED = 0.1
"""fraction of the variance by quantisation, by which readings must scatter to enter the test"""
REFUTED = 0.25
"""fraction of the expected shared variance (over own variance): if the test finds less, the readings depend on one
another in another way"""
ALLOWED = 0.75
"""allowance of the CUSUM: mean departures of sleeping cells below as many standard deviations do not add to the sum"""
LOADED = 6.0
"""threshold of the CUSUM in standard deviations: beyond, the cells are loaded; noise alone exceeds it once in 10 000
frames"""
DOUBTED, LIKELY = 0.5, 3.0
"""sums beyond which the cells may be loaded, and beyond which they most likely are. A load of 1.5 standard deviations
makes the second sum exp(1.5 LIKELY) times as probable as noise does (log-likelihood ratio)"""
AT_ONCE, CERTAIN = 5.0, 2.0 * LOADED
"""standard deviations of a single mean departure that proves a load, and the value to which it sets the sum"""

TESTS, OWN, SHARED = range(3)
"""indices of the test's sums"""
COUNTS, SUMS, FRAMES, UNTOLD = range(4)
"""rows of the state of each column, see :meth:`SharedNoise._name_rows`"""
WEIGHTS, PER_STD, LEFT = range(3)
"""rows of the tables by the number of telling cells, see :meth:`SharedNoise._name_rows`"""
LEAST_VARIANCE, NEAR, FAR, SHARE, SIDE_PER_NOISE = range(5)
"""indices of the parameters of a frame, see :func:`subtract_each`"""

_ZERO, _ONE = np.array(0.0), np.array(1.0)


class _Tellers(NamedTuple):
    """The telling cells of a frame (sleeping cells that were read, and measure shared noise), for array operations."""

    counted: FloatArray
    """(rows, columns) 1 where a cell tells, else 0"""
    number: FloatArray
    """(columns,) number of telling cells"""
    others: IntArray
    """(rows, columns) number of telling cells in the column, without the cell itself"""
    divisor: FloatArray
    """(columns,) ``number``, at least 1"""
    others_divisor: FloatArray
    """(rows, columns) ``others``, at least 1"""
    per_std: FloatArray
    """(columns,) own noise over the noise of the telling cells' mean"""
    allowed: FloatArray
    """(columns,) :data:`ALLOWED`, infinite where the mean is not trusted"""


class SharedNoise:
    """Subtracts shared noise from the readings of n cells, and passes the remaining part to the noise meter."""

    def __init__(self, shape: tuple[int, ...], noise: NoiseMeter, side: float = 1.0) -> None:
        """``shape`` is (rows, columns). Cells of an array with another number of axes share nothing.

        ``side`` is the sign of r under a load.
        """
        cells, self._has_columns = math.prod(shape), len(shape) == 2
        self._shape = (shape[0], shape[1]) if self._has_columns else (cells, 1)
        self._noise, self._side = noise, side
        self.ratio = 0.0
        """variance of the shared noise over that of the own noise of a cell at rest; 0: nothing is shared"""
        self._held_s = np.zeros(cells)
        """(n,) seconds for which cells have been held, see :mod:`._shared_steps`"""
        self._scales_columns = False
        """whether errors of readings scale all conductances of a column alike in this circuit"""
        self._test = np.zeros(3)
        """number of samples in the test so far, and the sums of their variances of own noise and of shared noise"""
        self._reference = np.zeros(cells)
        """(n,) mean of the readings of sleeping cells"""
        self._columns, self._by_number = np.zeros((4, self._shape[1])), np.zeros((3, self._shape[0] + 1))
        self._name_rows()
        self._counts[...] = -1.0
        self._numbers = np.zeros(5)
        """parameters of the present frame, for compiled loops"""
        self._tell_now = np.zeros(0, dtype=np.bool_)
        """(n,) the telling cells for which ``_tellers`` was computed"""
        self._tellers = self._tellers_of(np.zeros(cells, dtype=np.bool_))
        self._all_read = np.ones(cells, dtype=np.bool_)
        self.mean_std = np.ones(cells)
        """(n,) noise of readings with shared noise (whose mean is monitored) over that of readings without"""
        self.compiled = False
        """whether the compiled loop is in use"""

    def _name_rows(self) -> None:
        self._counts, self._sums, self._frames, self._untold = self._columns
        """rows (columns,), views of one array that the loops take.

        ``_counts``: number of telling cells in the last frame, negative: not known. ``_sums``: CUSUM of their mean
        departure in the direction of loads, in standard deviations of its noise; beyond :data:`LOADED` the cells wake.
        ``_frames``: frames since the sum was zero. ``_untold``: 1 where the telling cells are too few, else 0; written
        by compiled loops only."""
        self._weights, self._per_std, self._left = self._by_number
        """rows (rows + 1,), tables by the number of telling cells.

        ``_weights``: share of their mean that is shared noise. ``_per_std``: own noise over the noise of their mean, 0
        where the mean is not trusted. ``_left``: the part of :attr:`ratio` that remains after the subtraction."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue from a pickle or a copy; the rows have to be made views of one array again."""
        self.__dict__.update(state)
        self._name_rows()

    def suppose(self, own_std: float, all_std: float, *, scales_columns: bool = False) -> None:
        """Set the standard deviations of r at rest by the quantisation of own readings, and of all (0: no more).

        ``scales_columns``: whether steps of other readings scale all conductances of a column alike.
        """
        self._scales_columns = scales_columns
        if self._has_columns and not self._test[TESTS] and all_std > own_std:
            self._share(all_std * all_std / (own_std * own_std) - 1.0)

    def _share(self, ratio: float) -> None:
        """Set the variance of shared noise over that of own noise."""
        self._noise.share(ratio)
        self._begin(ratio)

    def _begin(self, ratio: float) -> None:
        self.ratio = ratio
        cells = np.arange(self._shape[0] + 1.0)
        trusted = (cells >= LEAST_CELLS) & (self._test[TESTS] >= TESTED)
        self._weights[...] = np.where(trusted, cells * ratio / (cells * ratio + 1.0), 0.0)
        self._left[...] = np.where(trusted, ratio / (cells * ratio + 1.0), ratio)
        self._per_std[...] = np.where(trusted, np.sqrt(cells / np.maximum(cells * ratio + 1.0, 1.0)), 0.0)
        self._tell_now = np.zeros(0, dtype=np.bool_)  # forces _tellers to be computed anew
        self._counts[:] = -1.0

    def sleep(self, cells: IntArray, mean: FloatArray) -> None:
        """Take the mean readings (m,) of ``cells`` (m,) that are put to sleep."""
        self._reference[cells] = mean

    def subtract(
        self,
        dt_s: float,
        r: FloatArray,
        known: BoolArray | None,
        awake: BoolArray,
        left_over: Callable[[], FloatArray] | None = None,
    ) -> tuple[FloatArray, FloatArray, IntArray | None]:
        """Subtract the shared noise from readings.

        Args:
            dt_s: seconds since the last frame.
            r: (n,) normalised resistances, not changed.
            known: (n,) which cells were read; None: all.
            awake: (n,) which cells do not sleep.
            left_over: returns the part of r (n,) that earlier loads have left; None: zero.

        Returns:
            (n,) readings without shared noise; (n,) the same, but readings of sleeping cells unchanged; and (m,)
            sleeping cells that are to wake, since their common departure is a load. None: no cells.
        """
        read = self._all_read if known is None else known
        own = self._noise.own
        near, far = SURE * own, SURE * own * math.sqrt(1.0 + self.ratio)
        share = -math.expm1(-dt_s / REFERENCE_S)
        testing = self._test[TESTS] < TESTED
        by = self._by_machine_code if self.compiled else self._by_array_operations
        changed, without, watched = by(r, read, awake, testing, near, far, share)
        if self._scales_columns:
            reference = self._reference if left_over is None else self._reference + left_over()
            self._keep_held(dt_s, without, watched, reference, read, awake)
        loaded = None
        if testing and self._test[TESTS] >= TESTED:
            refuted = self._test[SHARED] < REFUTED * self.ratio * self._test[OWN]
            self._share(0.0 if refuted else self.ratio)
        elif changed:
            tell = ~awake & read
            beyond = self._sums > LOADED
            if np.count_nonzero(beyond):
                of_column = np.tile(beyond, self._shape[0])
                loaded = np.flatnonzero(tell & of_column)
                tell &= ~of_column
            self._tell(tell)
        return without, watched, loaded

    def _keep_held(
        self,
        dt_s: float,
        without: FloatArray,
        watched: FloatArray,
        reference: FloatArray,
        read: BoolArray,
        awake: BoolArray,
    ) -> None:
        """Remove steps that no sleeping cells measure from the readings of held cells, see :mod:`._shared_steps`."""
        resolution = self._noise.typical_resolution
        if not resolution > 0.0:
            return
        own = max(self._noise.own, resolution)
        steps = resolution * math.sqrt(1.0 + self.ratio) * shared_steps.constant(own / resolution)
        scales = own, steps, self._side, dt_s
        kept = without, self._last, reference, self._held_s, read, awake
        if self.compiled:
            shared_steps.keep_each.unchecked(*kept, self._untold, *scales, watched)
            return
        untold = self._per_std.take(self._counts.astype(np.intp)) == 0.0
        cells = shared_steps.keep(*kept, untold, *scales)
        watched[cells] = without[cells]

    def _by_machine_code(
        self, r: FloatArray, read: BoolArray, awake: BoolArray, testing: bool, near: float, far: float, share: float
    ) -> tuple[bool, FloatArray, FloatArray]:
        found, numbers = np.empty((2, r.size)), self._numbers
        numbers[LEAST_VARIANCE] = self._least_variance if testing else math.inf
        numbers[NEAR], numbers[FAR], numbers[SHARE], numbers[SIDE_PER_NOISE] = near, far, share, self._side_per_noise
        kept = self._reference, self._columns, self._by_number, self._test
        changed = subtract_each.unchecked(r, read, awake, self._last, *kept, numbers, found)
        without, watched = found
        return changed, without, watched

    @property
    def _least_variance(self) -> float:
        """Least variance of the readings of a column in the test; with less, readings stay at one code of the ADC."""
        return MOVED * self._noise.typical_resolution**2

    @property
    def _side_per_noise(self) -> float:
        """Sign of r under a load, over own noise; own noise is at least the quantisation error."""
        return self._side / max(self._noise.own, self._noise.typical_resolution)

    @property
    def _last(self) -> FloatArray:
        """(n,) readings of the last frame, without shared noise."""
        return self._noise.window.reading()

    def _by_array_operations(
        self, r: FloatArray, read: BoolArray, awake: BoolArray, testing: bool, near: float, far: float, share: float
    ) -> tuple[bool, FloatArray, FloatArray]:
        of = self._tellers_of(~awake & read)
        near_, far_ = np.array(near), np.array(far)  # NumPy makes an array of a float in every call
        off = (r - self._reference).reshape(self._shape)
        first = np.minimum(np.maximum(off, -far_), far_)
        first *= of.counted
        centre = np.add.accumulate(first)[-1]
        centre /= of.divisor
        second = np.minimum(np.maximum(off, centre - near_), centre + near_)
        second *= of.counted
        total = np.add.accumulate(second)[-1]
        # A sleeping cell is corrected by the mean of the others: its own reading in the mean would shrink its own load.
        common = total - second
        common /= of.others_divisor
        common *= self._weights.take(of.others)
        first *= share
        self._reference += first.ravel()
        without = r + _ONE
        without *= common.ravel()
        np.subtract(r, without, out=without)
        mean = total / of.divisor
        most = self._add_up(mean, of)
        if most > DOUBTED:
            self._keep(without, r, awake)
        if most > LOADED:
            np.copyto(without.reshape(self._shape), r.reshape(self._shape), where=self._sums > LOADED)
        if read is not self._all_read:
            np.copyto(without, r, where=~read)
        if testing:
            self._take_test(of.counted > 0.0, of.number, second, mean)
        changed = most > LOADED or not np.array_equal(of.number, self._counts)
        self._counts[:] = of.number
        return changed, without, np.where(awake, without, r)

    def _add_up(self, mean: FloatArray, of: _Tellers) -> float:
        """Add the ``mean`` departure (columns,) of sleeping cells to the CUSUMs; returns the largest sum."""
        off = mean * of.per_std
        off *= self._side_per_noise
        self._sums += off
        self._sums -= of.allowed
        np.maximum(self._sums, _ZERO, out=self._sums)
        self._frames += _ONE
        self._frames *= self._sums > _ZERO
        most = self._sums.item(self._sums.argmax())
        if most > AT_ONCE - ALLOWED:
            np.copyto(self._sums, CERTAIN, where=off > AT_ONCE)
            most = self._sums.item(self._sums.argmax())
        return most

    def _keep(self, without: FloatArray, r: FloatArray, awake: BoolArray) -> None:
        """Keep the last readings of cells that are ``awake`` (n,) where sleeping cells of the column may be loaded.

        Last readings are clipped to the interval between the readings ``r`` (n,) and ``without`` (n,) shared noise.
        Changes ``without``.
        """
        cells = (awake.reshape(self._shape) & (self._sums > DOUBTED)).ravel().nonzero()[0]
        if cells.size:
            own, read = without.take(cells), r.take(cells)
            kept = np.maximum(self._last.take(cells), np.minimum(own, read))
            without[cells] = np.minimum(kept, np.maximum(own, read))

    def doubt(self, r: FloatArray, awake: BoolArray) -> tuple[IntArray, FloatArray] | None:
        """Uncertainty of readings from which an undetected load on sleeping cells may have been subtracted.

        Args:
            r: (n,) readings of the last frame, without shared noise.
            awake: (n,) which cells do not sleep.

        Returns:
            (m,) cells, and (m,) standard deviations of their r; None: no cells.
        """
        undecided = (self._sums > DOUBTED) & (self._sums <= LOADED)
        if not np.count_nonzero(undecided):
            return None
        cells = (awake.reshape(self._shape) & undecided).ravel().nonzero()[0]
        if not cells.size:
            return None
        column = cells % self._shape[1]
        sums = self._sums.take(column)
        noises = sums / self._frames.take(column) + ALLOWED
        noises *= np.minimum(sums * (1.0 / LIKELY), _ONE) / abs(self._side_per_noise)
        noises /= self._per_std.take(self._counts.take(column).astype(np.intp))
        noises *= r.take(cells) + 1.0
        return cells, noises

    def _tellers_of(self, tell: BoolArray) -> _Tellers:
        """The telling cells ``tell`` (n,), with the quantities derived from them."""
        if not np.array_equal(tell, self._tell_now):
            counted = tell.reshape(self._shape).astype(np.float64)
            count = np.add.accumulate(counted)[-1]
            others = count - counted
            divisors = np.maximum(count, 1.0), np.maximum(others, 1.0)
            per_std = self._per_std.take(count.astype(np.intp))
            noise = per_std, np.where(per_std > 0.0, ALLOWED, np.inf)
            self._tell_now, self._tellers = tell, _Tellers(counted, count, others.astype(np.intp), *divisors, *noise)
        return self._tellers

    def _take_test(self, tells: BoolArray, count: FloatArray, off: FloatArray, mean: FloatArray) -> None:
        """Add the departures ``off`` (rows, columns) of sleeping cells, with ``mean`` (columns,), to the test."""
        apart = np.where(tells, off - mean, 0.0)
        own = np.add.accumulate(apart * apart)[-1] / np.maximum(count - 1.0, 1.0)
        shared = mean * mean
        tell = (count > LEAST_CELLS) & (own + shared > self._least_variance)
        shared -= own / np.maximum(count, 1.0)
        for column in np.flatnonzero(tell):
            self._test += 1.0, own[column], shared[column]

    def _tell(self, tell: BoolArray) -> None:
        """Pass the shared noise that remains to the noise meter, if ``tell`` (n,) are the telling cells."""
        tells = tell.reshape(self._shape)
        others = (np.count_nonzero(tells, axis=0) - tells).ravel()
        left = self._left.take(others)
        self.mean_std = np.sqrt((1.0 + self.ratio) / (1.0 + left))
        self._noise.leave(left)

    def state(self) -> dict[str, FloatArray]:
        """The state, by name."""
        return {
            "shared_reference": self._reference,
            "shared_held_s": self._held_s,
            "shared_counts": self._counts,
            "shared_sums": self._sums,
            "shared_frames": self._frames,
            "shared_of_array": np.array([self.ratio, self._scales_columns, *self._test]),
        }

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a saved :meth:`state`."""
        self._reference, self._held_s = state["shared_reference"], state["shared_held_s"]
        ratio, scales_columns = state["shared_of_array"][:2].tolist()
        self._scales_columns, self._test = bool(scales_columns), state["shared_of_array"][2:].copy()
        self._begin(ratio)
        for row, name in ((COUNTS, "counts"), (SUMS, "sums"), (FRAMES, "frames")):
            self._columns[row] = state[f"shared_{name}"]
        self.mean_std = np.sqrt((1.0 + ratio) / (1.0 + self._noise.excess))


@loop
def subtract_each(
    r: Row,
    read: Flags,
    awake: Flags,
    last: Row,
    reference: Row,
    columns: Rows,
    by_number: Rows,
    test: Row,
    numbers: Row,
    found: Rows,
) -> bool:
    """:meth:`SharedNoise.subtract` as a loop over cells.

    Args:
        r: (n,) readings.
        read: (n,) which cells were read.
        awake: (n,) which cells do not sleep.
        last: (n,) readings of the last frame without shared noise.
        reference: (n,) mean of the readings of sleeping cells, changed.
        columns: (4, columns) rows of :meth:`SharedNoise._name_rows`, changed.
        by_number: (3, rows + 1) rows of :meth:`SharedNoise._name_rows`.
        test: (3,) the test's sums, changed.
        numbers: (5,) least variance of a column's readings in the test (infinite: no test); distance from the mean at
            which departures are clipped; the same from the reference; weight of a reading in the reference; and sign
            of r under a load, over own noise.
        found: (2, n) readings without shared noise; and the same, but readings of sleeping cells unchanged; written.

    Returns:
        Whether the numbers of sleeping cells differ from the last frame's, or some cells are to wake.
    """
    changed, side_per_noise = False, numbers[SIDE_PER_NOISE]
    near, far, share = numbers[NEAR], numbers[FAR], numbers[SHARE]
    for column in range(columns.shape[1]):
        count, total = 0, 0.0
        for i in range(column, r.size, columns.shape[1]):
            if read[i] and not awake[i]:
                count += 1
                total += min(max(r[i] - reference[i], -far), far)
        centre = total / max(count, 1)
        low, high, total = centre - near, centre + near, 0.0
        for i in range(column, r.size, columns.shape[1]):
            if read[i] and not awake[i]:
                total += min(max(r[i] - reference[i], low), high)
        mean, own_variance = total / max(count, 1), 0.0
        per_std = by_number[PER_STD, count]
        off = mean * per_std * side_per_noise
        summed = max(columns[SUMS, column] + off - ALLOWED, 0.0) if per_std > 0.0 else 0.0
        columns[FRAMES, column] = columns[FRAMES, column] + 1.0 if summed > 0.0 else 0.0
        if off > AT_ONCE:
            summed = CERTAIN
        columns[SUMS, column], columns[UNTOLD, column] = summed, 1.0 if per_std == 0.0 else 0.0
        doubted, loaded = summed > DOUBTED, summed > LOADED
        for i in range(column, r.size, columns.shape[1]):
            others, rest, asleep = count, total, not awake[i]
            if asleep and read[i]:
                off = r[i] - reference[i]
                reference[i] += min(max(off, -far), far) * share
                off = min(max(off, low), high)
                others -= 1
                rest -= off
                off -= mean
                own_variance += off * off
            own = r[i]
            if read[i] and not loaded:
                own -= (r[i] + 1.0) * (rest / max(others, 1) * by_number[WEIGHTS, others])
                if doubted and not asleep:
                    own = min(max(last[i], min(own, r[i])), max(own, r[i]))
            found[0, i] = own
            found[1, i] = r[i] if asleep else own
        own_variance /= max(count - 1, 1)
        if count > LEAST_CELLS and own_variance + mean * mean > numbers[LEAST_VARIANCE]:
            test[TESTS] += 1.0
            test[OWN] += own_variance
            test[SHARED] += mean * mean - own_variance / count
        changed |= loaded or columns[COUNTS, column] != count
        columns[COUNTS, column] = count
    return changed


LOOPS = (subtract_each, *shared_steps.LOOPS)
