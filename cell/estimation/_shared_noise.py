"""Noise that all cells of a column share, taken out of their readings (common-mode rejection).

On a divider whose idle rows are driven, the currents of a whole column flow through one reference resistor. How much
of the supply is left for it is the small difference that all readings of the column leave. Errors of that difference
scale all conductances of the column alike, and are several times larger than what the reading of a cell adds itself.

Cells that sleep tell the shared part in every frame: their resistance is that of rest. What they have in common is
subtracted from all cells of the column. A load on all cells of a column moves them alike, too. So the mean of a
sleeping cell is taken of readings from which nothing was subtracted, and such a load wakes the cells as if nobody had
known of shared noise.

The estimator is told of the circuit by two numbers only: the deviations of a conductance by the steps of its own
reading, and by those of all readings (:meth:`._estimator.Estimator.resolve`). Noise takes the same ways as steps. That
the columns do share it is tested first. Readings of a divider with floating rows depend on one another as well, but in
other ways.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...arrays import BoolArray, FloatArray, IntArray
from ...compiled import Flags, Row, loop
from ._noise import NoiseMeter

LEAST_CELLS = 3
"""sleeping cells of a column that tell its shared noise; of fewer, a bad contact would be taken for noise"""
SURE = 4.0
"""standard deviations beyond which a reading counts for no more: a bad contact, or a load that begins"""
REFERENCE_S = 3.0
"""time over which the mean of a sleeping cell is taken, from which its departures are counted"""
TESTED = 200
"""columns, summed over frames, that tell whether the columns do share noise"""
MOVED = 0.1
"""of the variance of a step of the ADC, by which readings must scatter for the test"""
REFUTED = 0.25
"""of the variance that is supposed to be shared, over own: if less is found, the readings depend on one another in
another way"""

TESTS, OWN, SHARED = range(3)
"""places of the test's sums"""

_ONE = np.array(1.0)


class _Tellers(NamedTuple):
    """Sleeping cells that were read, for the array operations."""

    counted: FloatArray
    """(rows, columns) 1 where a cell tells"""
    number: FloatArray
    """(columns,) cells of a column that tell"""
    others: IntArray
    """(rows, columns) cells of the column that tell, without the cell itself"""
    divisor: FloatArray
    """(columns,) the number, at least 1"""
    others_divisor: FloatArray
    """(rows, columns) the others, at least 1"""


class SharedNoise:
    """Takes shared noise out of the readings of n cells, and tells the noise meter what is left of it."""

    def __init__(self, shape: tuple[int, ...], noise: NoiseMeter) -> None:
        """``shape`` is (rows, columns). Cells of an array with another number of axes share nothing."""
        cells, self._has_columns = math.prod(shape), len(shape) == 2
        self._shape = (shape[0], shape[1]) if self._has_columns else (cells, 1)
        self._noise = noise
        self.ratio = 0.0
        """variance of the shared noise over that of the own noise of a cell at rest; 0: nothing is shared"""
        self._test = np.zeros(3)
        """columns that have been tested so far, and sums of their variances: of own noise, and of shared noise"""
        self._reference = np.zeros(cells)
        """(n,) mean of the readings of sleeping cells"""
        self._counts = np.full(self._shape[1], -1.0)
        """(columns,) sleeping cells in the last frame; negative: not known"""
        self._weights = np.zeros(0)
        """by number of cells: share of their mean that is shared noise"""
        self._tell_now = np.zeros(0, dtype=np.bool_)
        """(n,) the cells that ``_tellers`` are made of"""
        self._left = np.zeros(0)
        """by number of cells: what is left of the ratio if that is taken out"""
        self._tellers = self._tellers_of(np.zeros(cells, dtype=np.bool_))
        self._all_read = np.ones(cells, dtype=np.bool_)
        self.mean_std = np.ones(cells)
        """(n,) noise of the readings whose mean is watched, over that of the readings that wake a cell at once"""
        self.compiled = False
        """whether the loop is there as machine code"""

    def suppose(self, own_std: float, all_std: float) -> None:
        """Take the deviations of r at rest by the steps of own readings, and by those of all; of none: 0."""
        if self._has_columns and not self._test[TESTS] and all_std > own_std:
            self._share(all_std * all_std / (own_std * own_std) - 1.0)

    def _share(self, ratio: float) -> None:
        """Let shared noise have a variance of ``ratio`` times that of own noise."""
        self._noise.share(ratio)
        self._begin(ratio)

    def _begin(self, ratio: float) -> None:
        self.ratio = ratio
        cells = np.arange(self._shape[0] + 1.0)
        trusted = (cells >= LEAST_CELLS) & (self._test[TESTS] >= TESTED)
        self._weights = np.where(trusted, cells * ratio / (cells * ratio + 1.0), 0.0)
        self._left = np.where(trusted, ratio / (cells * ratio + 1.0), ratio)
        self._counts[:] = -1.0

    def sleep(self, cells: IntArray, mean: FloatArray) -> None:
        """Take the mean readings (m,) of ``cells`` (m,) that are put to sleep."""
        self._reference[cells] = mean

    def subtract(
        self, dt_s: float, r: FloatArray, known: BoolArray | None, awake: BoolArray
    ) -> tuple[FloatArray, FloatArray]:
        """Take the shared noise out of readings.

        Args:
            dt_s: seconds since the last frame.
            r: (n,) normalised resistances, which are not changed.
            known: (n,) which of them were read; None: all.
            awake: (n,) which cells do not sleep.

        Returns:
            (n,) readings without shared noise; and (n,) the same, but those of sleeping cells as they were read.
        """
        read = self._all_read if known is None else known
        own = self._noise.own
        near, far = SURE * own, SURE * own * math.sqrt(1.0 + self.ratio)
        share = -math.expm1(-dt_s / REFERENCE_S)
        testing = self._test[TESTS] < TESTED
        by = self._by_machine_code if self.compiled else self._by_array_operations
        changed, without, watched = by(r, read, awake, testing, near, far, share)
        if testing and self._test[TESTS] >= TESTED:
            refuted = self._test[SHARED] < REFUTED * self.ratio * self._test[OWN]
            self._share(0.0 if refuted else self.ratio)
        elif changed:
            self._tell(read, awake)
        return without, watched

    def _by_machine_code(
        self, r: FloatArray, read: BoolArray, awake: BoolArray, testing: bool, near: float, far: float, share: float
    ) -> tuple[bool, FloatArray, FloatArray]:
        without, watched = np.empty((2, r.size))
        least_variance = self._least_variance if testing else math.inf
        kept = self._reference, self._weights, self._counts, self._test
        changed = subtract_each.code(r, read, awake, *kept, least_variance, near, far, share, without, watched)
        return changed, without, watched

    @property
    def _least_variance(self) -> float:
        """Of the readings of a column that tell something: others stay at one code of the ADC."""
        return MOVED * self._noise.typical_resolution**2

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
        # What others tell of a sleeping cell: with its own reading in the mean, its own load would seem smaller.
        common = total - second
        common /= of.others_divisor
        common *= self._weights.take(of.others)
        first *= share
        self._reference += first.ravel()
        without = r + _ONE
        without *= common.ravel()
        np.subtract(r, without, out=without)
        if read is not self._all_read:
            np.copyto(without, r, where=~read)
        if testing:
            self._take_test(of.counted > 0.0, of.number, second, total / of.divisor)
        changed = not np.array_equal(of.number, self._counts)
        self._counts[:] = of.number
        return changed, without, np.where(awake, without, r)

    def _tellers_of(self, tell: BoolArray) -> _Tellers:
        """The cells (n,) that tell of shared noise, and what follows from which they are."""
        if not np.array_equal(tell, self._tell_now):
            counted = tell.reshape(self._shape).astype(np.float64)
            count = np.add.accumulate(counted)[-1]
            others = count - counted
            divisors = np.maximum(count, 1.0), np.maximum(others, 1.0)
            self._tell_now, self._tellers = tell, _Tellers(counted, count, others.astype(np.intp), *divisors)
        return self._tellers

    def _take_test(self, tells: BoolArray, count: FloatArray, off: FloatArray, mean: FloatArray) -> None:
        """Take the departures ``off`` (rows, columns) of sleeping cells into the test; ``mean`` (columns,) of them."""
        apart = np.where(tells, off - mean, 0.0)
        own = np.add.accumulate(apart * apart)[-1] / np.maximum(count - 1.0, 1.0)
        shared = mean * mean
        tell = (count > LEAST_CELLS) & (own + shared > self._least_variance)
        shared -= own / np.maximum(count, 1.0)
        for column in np.flatnonzero(tell):
            self._test += 1.0, own[column], shared[column]

    def _tell(self, read: BoolArray, awake: BoolArray) -> None:
        """Tell the noise meter what is left of the shared noise."""
        tells = (~awake & read).reshape(self._shape)
        others = (self._counts - tells).ravel().astype(np.intp)
        left = self._left.take(others)
        self.mean_std = np.sqrt((1.0 + self.ratio) / (1.0 + left))
        self._noise.leave(left)

    def state(self) -> dict[str, FloatArray]:
        """What is remembered, by name."""
        return {
            "shared_reference": self._reference,
            "shared_counts": self._counts,
            "shared_of_array": np.array([self.ratio, *self._test]),
        }

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a saved :meth:`state`."""
        self._reference = state["shared_reference"]
        ratio, self._test = float(state["shared_of_array"][0]), state["shared_of_array"][1:].copy()
        self._begin(ratio)
        self._counts = state["shared_counts"]
        self.mean_std = np.sqrt((1.0 + ratio) / (1.0 + self._noise.excess))


@loop
def subtract_each(
    r: Row,
    read: Flags,
    awake: Flags,
    reference: Row,
    weights: Row,
    counts: Row,
    test: Row,
    least_variance: float,
    near: float,
    far: float,
    share: float,
    without: Row,
    watched: Row,
) -> bool:
    """:meth:`SharedNoise.subtract` as a loop over cells, into ``without`` and ``watched`` (n,).

    Args:
        r: (n,) readings.
        read: (n,) which of them are.
        awake: (n,) which cells do not sleep.
        reference: (n,) mean of the readings of sleeping cells, changed.
        weights: (rows + 1,) by number of cells, share of their mean that is shared noise.
        counts: (columns,) sleeping cells in the last frame, changed.
        test: (3,) the test's sums, changed.
        least_variance: of readings of a column that are tested; infinite: none are.
        near: departure from the mean beyond which a reading counts for no more.
        far: the same, from the reference.
        share: of a reading in the reference.
        without: (n,) readings without shared noise.
        watched: (n,) the same, but of sleeping cells as they were read.

    Returns:
        Whether other numbers of cells sleep than in the last frame.
    """
    columns, changed = counts.size, False
    for column in range(columns):
        count, total = 0, 0.0
        for i in range(column, r.size, columns):
            if read[i] and not awake[i]:
                count += 1
                total += min(max(r[i] - reference[i], -far), far)
        centre = total / max(count, 1)
        low, high, total = centre - near, centre + near, 0.0
        for i in range(column, r.size, columns):
            if read[i] and not awake[i]:
                total += min(max(r[i] - reference[i], low), high)
        mean, own_variance = total / max(count, 1), 0.0
        for i in range(column, r.size, columns):
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
            if read[i]:
                own -= (r[i] + 1.0) * (rest / max(others, 1) * weights[others])
            without[i] = own
            watched[i] = r[i] if asleep else own
        own_variance /= max(count - 1, 1)
        if count > LEAST_CELLS and own_variance + mean * mean > least_variance:
            test[TESTS] += 1.0
            test[OWN] += own_variance
            test[SHARED] += mean * mean - own_variance / count
        changed |= counts[column] != count
        counts[column] = count
    return changed


LOOPS = (subtract_each,)
