"""Noise that all cells of a column share, taken out of their readings (common-mode rejection).

On a divider whose idle rows are driven, the currents of a whole column flow through one reference resistor. How much
of the supply is left for it is the small difference that all readings of the column leave. Errors of that difference
scale all conductances of the column alike, and are several times larger than what the reading of a cell adds itself.

Cells that sleep tell the shared part in every frame: their resistance is that of rest. What they have in common is
subtracted from all cells of the column. A load on all cells of a column moves them alike, too. So the mean of a
sleeping cell is taken of readings from which nothing was subtracted, and such a load wakes the cells as if nobody had
known of shared noise.

A press wakes its column where the steps of the ADC are coarse: a step of the reading of one cell moves them all. Cells
that have borne no load since they last slept then tell the shared part, too, asleep or not, while another cell of their
column is clearly loaded. Loads move cells one way only, so the three that moved least in that way say where the rest
is, and only cells that agree with them count. A column that is loaded as a whole has no cell that stands out. For the
first moment of a press nothing is changed: taps are over before cells that were just woken can be trusted.

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
from ...compiled import Flags, Row, Rows, loop
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

STANDS_OUT = 8.0
"""standard deviations of own noise from cells without load, beyond which a cell is loaded"""
LEAST_LOAD = 0.02
"""of full scale, the least pressure of a cell that is loaded; what it remembers may stand out for minutes"""
BOUND = 8.0
"""standard deviations of shared noise that a column moves together in the direction of loads; more is a load on all
cells. The steps of equal cells come together, and move a column by up to as many deviations."""
HELD_S = 0.16
"""time for which a cell must have been loaded before others of its column tell that are awake"""
BEFORE_S = 1.0
"""time over which the mean of a column is taken before one of its cells is loaded"""

TESTS, OWN, SHARED = range(3)
"""places of the test's sums"""
BEFORE, SINCE = range(2)
"""places of what is kept of columns: mean departure of cells without load before the press, and seconds of the press"""

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


class _Limits(NamedTuple):
    """Numbers of a frame, in the order in which :func:`subtract_each` takes them."""

    side: float
    """sign of r under a load"""
    least_variance: float
    """of readings of a column that are tested; infinite: none are"""
    near: float
    """departure from the mean beyond which a reading counts for no more"""
    far: float
    """the same, from the reference"""
    share: float
    """of a reading in the reference"""
    dt_s: float
    """seconds since the last frame"""
    share_before: float
    """of a column's mean in that before a press"""
    agree: float
    """departure from the cells that moved least, up to which a cell tells beside a load"""
    stands_out: float
    """departure at rest from which a cell is loaded"""
    bound: float
    """departure of a column in the direction of loads, from which all its cells are loaded"""
    least_kpa: float
    """pressure of a cell that is loaded"""


class _Held(NamedTuple):
    """What cells without load tell beside others that are loaded."""

    columns: BoolArray
    """(columns,) where they do"""
    others: IntArray
    """(rows, columns) how many tell of each cell"""
    common: FloatArray
    """(rows, columns) what they say"""
    moved: FloatArray
    """(rows, columns) how far each has moved by itself"""


class SharedNoise:
    """Takes shared noise out of the readings of n cells, and tells the noise meter what is left of it."""

    def __init__(
        self, shape: tuple[int, ...], noise: NoiseMeter, side: float = 1.0, full_scale_kpa: float = 1.0
    ) -> None:
        """``shape`` is (rows, columns). Cells of an array with another number of axes share nothing.

        ``side`` is the sign of r under a load.
        """
        cells, self._has_columns = math.prod(shape), len(shape) == 2
        self._shape = (shape[0], shape[1]) if self._has_columns else (cells, 1)
        self._noise = noise
        self.ratio = 0.0
        """variance of the shared noise over that of the own noise of a cell at rest; 0: nothing is shared"""
        self._test = np.zeros(3)
        """columns that have been tested so far, and sums of their variances: of own noise, and of shared noise"""
        self._reference = np.zeros(cells)
        """(n,) mean of the readings of sleeping cells"""
        self._told = np.full(cells, -1.0)
        """(n,) cells that told the shared noise of each in the last frame; negative: not known"""
        self._side, self._least_kpa = side, LEAST_LOAD * full_scale_kpa
        self._rested = np.zeros(cells, dtype=np.bool_)
        """(n,) cells that have borne no load since they last slept"""
        self._of_columns = np.zeros((2, self._shape[1]))
        """(2, columns) see :data:`BEFORE`"""
        self._trusted = False
        """whether the test has shown that columns share noise"""
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
        self._trusted = bool(self._test[TESTS] >= TESTED)
        trusted = cells >= LEAST_CELLS
        self._weights = np.where(trusted, cells * ratio / (cells * ratio + 1.0), 0.0)
        self._left = np.where(trusted, ratio / (cells * ratio + 1.0), ratio)
        self._told[:] = -1.0

    def begin(self, cells: IntArray, mean: FloatArray) -> None:
        """Take the mean first readings (m,) of ``cells`` (m,), which have never slept yet."""
        self._reference[cells] = mean
        self._rested[cells] = np.abs(mean) < SURE * self._noise.typical_resolution * math.sqrt(1.0 + self.ratio)

    def sleep(self, cells: IntArray, mean: FloatArray) -> None:
        """Take the mean readings (m,) of ``cells`` (m,) that are put to sleep."""
        self._reference[cells] = mean
        self._rested[cells] = True

    def subtract(
        self, dt_s: float, r: FloatArray, known: BoolArray | None, awake: BoolArray, pressure: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Take the shared noise out of readings.

        Args:
            dt_s: seconds since the last frame.
            r: (n,) normalised resistances, which are not changed.
            known: (n,) which of them were read; None: all.
            awake: (n,) which cells do not sleep.
            pressure: (n,) in kPa, of the last frame.

        Returns:
            (n,) readings without shared noise; and (n,) the same, but those of sleeping cells as they were read, unless
            another cell of their column is loaded.
        """
        read = self._all_read if known is None else known
        own = self._noise.own
        near, far = SURE * own, SURE * own * math.sqrt(1.0 + self.ratio)
        share, share_before = -math.expm1(-dt_s / REFERENCE_S), -math.expm1(-dt_s / BEFORE_S)
        testing = self._test[TESTS] < TESTED
        least_variance = self._least_variance if testing else math.inf
        coarse = max(own, self._noise.typical_resolution)  # readings between two steps show no noise
        bound = BOUND * coarse * math.sqrt(self.ratio)
        held = dt_s, share_before, SURE * coarse, STANDS_OUT * coarse, bound, self._least_kpa
        limits = _Limits(self._side, least_variance, near, far, share, *held)
        by = self._by_machine_code if self.compiled else self._by_array_operations
        changed, without, watched = by(r, read, awake, pressure, limits)
        if testing and self._test[TESTS] >= TESTED:
            refuted = self._test[SHARED] < REFUTED * self.ratio * self._test[OWN]
            self._share(0.0 if refuted else self.ratio)
        elif changed:
            self._tell()
        return without, watched

    def _by_machine_code(
        self, r: FloatArray, read: BoolArray, awake: BoolArray, pressure: FloatArray, limits: _Limits
    ) -> tuple[bool, FloatArray, FloatArray]:
        without, watched = np.empty((2, r.size))
        kept = self._rested, self._reference, self._of_columns, self._told, self._test
        given = self._weights, self._trusted, np.array(limits)
        changed = subtract_each.code(r, read, awake, pressure, *kept, *given, without, watched)
        return changed, without, watched

    @property
    def _least_variance(self) -> float:
        """Of the readings of a column that tell something: others stay at one code of the ADC."""
        return MOVED * self._noise.typical_resolution**2

    def _by_array_operations(
        self, r: FloatArray, read: BoolArray, awake: BoolArray, pressure: FloatArray, limits: _Limits
    ) -> tuple[bool, FloatArray, FloatArray]:
        of = self._tellers_of(~awake & read)
        # NumPy makes an array of a float in every call.
        near, far, share = np.array(limits.near), np.array(limits.far), np.array(limits.share)
        off = (r - self._reference).reshape(self._shape)
        first = np.minimum(np.maximum(off, -far), far)
        first *= of.counted
        centre = np.add.accumulate(first)[-1]
        centre /= of.divisor
        second = np.minimum(np.maximum(off, centre - near), centre + near)
        second *= of.counted
        total = np.add.accumulate(second)[-1]
        # What others tell of a sleeping cell: with its own reading in the mean, its own load would seem smaller.
        common = total - second
        common /= of.others_divisor
        others = of.others if self._trusted else np.zeros_like(of.others)
        first *= share
        held = self._beside_loads(off, r, read, awake, pressure, limits)
        if held is not None:
            np.copyto(common, held.common, where=held.columns)
            others = np.where(held.columns, held.others, others)
            np.copyto(first, held.moved * of.counted * share, where=held.columns)
        common *= self._weights.take(others)
        self._reference += first.ravel()
        common += _ONE
        without = r + _ONE
        without /= common.ravel()
        without -= _ONE
        if read is not self._all_read:
            np.copyto(without, r, where=~read)
        if limits.least_variance < math.inf:
            tested = of.number if held is None else np.where(held.columns, 0.0, of.number)
            self._take_test(of.counted > 0.0, tested, second, total / of.divisor)
        changed = not np.array_equal(others.ravel(), self._told)
        self._told[:] = others.ravel()
        as_read = ~awake if held is None else (~awake.reshape(self._shape) & ~held.columns).ravel()
        return changed, without, np.where(as_read, r, without)

    def _beside_loads(
        self, off: FloatArray, r: FloatArray, read: BoolArray, awake: BoolArray, pressure: FloatArray, limits: _Limits
    ) -> _Held | None:
        """What cells without load tell, in columns where another cell is loaded; None: in no column.

        ``off`` (rows, columns) are the departures from the references. Changes ``_rested`` and ``_of_columns``.
        """
        of_columns, shape, side = self._of_columns, self._shape, limits.side
        some_awake = awake.reshape(shape).any(axis=0)
        of_columns[:, ~some_awake] = 0.0
        if shape[0] < LEAST_CELLS or not some_awake.any():
            return None
        rested = (self._rested & read).reshape(shape)
        moved = np.where(rested, side * off, np.inf)
        base = side * np.partition(moved, LEAST_CELLS - 1, axis=0)[LEAST_CELLS - 1]
        tell = rested & (np.abs(off - base) <= limits.agree)
        number = np.count_nonzero(tell, axis=0)
        total = np.add.accumulate(np.where(tell, off, 0.0))[-1]
        mean, enough = total / np.maximum(number, 1), (number >= LEAST_CELLS) & some_awake
        loaded = side * (off - mean) > limits.stands_out * np.square(r + 1.0).reshape(shape)
        loaded &= (awake & read & (self._rested | (pressure > limits.least_kpa))).reshape(shape) & enough
        self._rested[loaded.ravel()] = False
        beside = loaded.any(axis=0)
        before = of_columns[BEFORE].copy()
        of_columns[SINCE] = np.where(beside, of_columns[SINCE] + limits.dt_s, 0.0)
        of_columns[BEFORE] += np.where(enough & ~beside, (mean - before) * limits.share_before, 0.0)
        columns = enough & (side * (mean - before) < limits.bound) & (of_columns[SINCE] > HELD_S)
        if not columns.any():
            return None
        tell &= ~loaded
        others = number - tell
        common = (total - np.where(tell, off, 0.0)) / np.maximum(others, 1) - before
        return _Held(columns, others, common, np.minimum(np.maximum(off - mean, -limits.near), limits.near))

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

    def _tell(self) -> None:
        """Tell the noise meter what is left of the shared noise."""
        left = self._left.take(self._told.astype(np.intp))
        self.mean_std = np.sqrt((1.0 + self.ratio) / (1.0 + left))
        self._noise.leave(left)

    def state(self) -> dict[str, FloatArray | BoolArray]:
        """What is remembered, by name."""
        return {
            "shared_reference": self._reference,
            "shared_told": self._told,
            "shared_rested": self._rested,
            "shared_of_columns": self._of_columns,
            "shared_of_array": np.array([self.ratio, *self._test]),
        }

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a saved :meth:`state`."""
        self._reference, self._rested = state["shared_reference"], state["shared_rested"] > 0
        self._of_columns = state["shared_of_columns"]
        ratio, self._test = float(state["shared_of_array"][0]), state["shared_of_array"][1:].copy()
        self._begin(ratio)
        self._told = state["shared_told"]
        self.mean_std = np.sqrt((1.0 + ratio) / (1.0 + self._noise.excess))


@loop
def subtract_each(
    r: Row,
    read: Flags,
    awake: Flags,
    pressure: Row,
    rested: Flags,
    reference: Row,
    of_columns: Rows,
    told: Row,
    test: Row,
    weights: Row,
    trusted: bool,
    limits: Row,
    without: Row,
    watched: Row,
) -> bool:
    """:meth:`SharedNoise.subtract` as a loop over cells, into ``without`` and ``watched`` (n,).

    Args:
        r: (n,) readings.
        read: (n,) which of them are.
        awake: (n,) which cells do not sleep.
        pressure: (n,) in kPa, of the last frame.
        rested: (n,) which cells have borne no load since they slept, changed.
        reference: (n,) mean of the readings of cells without load, changed.
        of_columns: (2, columns) see :data:`BEFORE`, changed.
        told: (n,) cells that tell of each, changed.
        test: (3,) the test's sums, changed.
        weights: (rows + 1,) by number of cells, share of their mean that is shared noise.
        trusted: whether sleeping cells tell where no cell is loaded.
        limits: see :class:`_Limits`.
        without: (n,) readings without shared noise.
        watched: (n,) the same, but of sleeping cells as they were read, unless another cell of the column is loaded.

    Returns:
        Whether other numbers of cells tell than in the last frame.
    """
    side, least_variance, near, far, share = limits[0], limits[1], limits[2], limits[3], limits[4]
    dt_s, share_before, agree, stands_out = limits[5], limits[6], limits[7], limits[8]
    bound, least_kpa = limits[9], limits[10]
    columns, changed = of_columns.shape[1], False
    for column in range(columns):
        count, total, some_awake = 0, 0.0, False
        least = second = third = math.inf  # of the departures of cells without load, in the direction of loads
        for i in range(column, r.size, columns):
            some_awake |= awake[i]
            if read[i]:
                off = r[i] - reference[i]
                if not awake[i]:
                    count += 1
                    total += min(max(off, -far), far)
                if rested[i]:
                    off *= side
                    if off < least:
                        least, second, third = off, least, second
                    elif off < second:
                        second, third = off, second
                    elif off < third:
                        third = off
        base, tellers, sum_told = side * third, 0, 0.0
        centre = total / max(count, 1)
        low, high, total = centre - near, centre + near, 0.0
        for i in range(column, r.size, columns):
            if read[i]:
                off = r[i] - reference[i]
                if rested[i] and abs(off - base) <= agree:
                    tellers += 1
                    sum_told += off
                if not awake[i]:
                    total += min(max(off, low), high)
        common, beside, enough = sum_told / max(tellers, 1), False, tellers >= LEAST_CELLS and some_awake
        if enough:
            for i in range(column, r.size, columns):
                if read[i] and awake[i]:
                    scale = 1.0 + r[i]
                    loaded = side * (r[i] - reference[i] - common) > stands_out * scale * scale
                    if loaded and (rested[i] or pressure[i] > least_kpa):
                        beside = True
                        rested[i] = False
        if not some_awake:
            of_columns[BEFORE, column] = 0.0
        before = of_columns[BEFORE, column]
        of_columns[SINCE, column] = of_columns[SINCE, column] + dt_s if beside else 0.0
        held = enough and side * (common - before) < bound and of_columns[SINCE, column] > HELD_S
        if enough and not beside:
            of_columns[BEFORE, column] += (common - before) * share_before
        mean, own_variance = total / max(count, 1), 0.0
        for i in range(column, r.size, columns):
            asleep, off = not awake[i], r[i] - reference[i]
            others, rest = 0, 0.0
            if held:
                others, rest = tellers, sum_told
                if read[i] and rested[i] and abs(off - base) <= agree:
                    others -= 1
                    rest -= off
                rest = rest / max(others, 1) - before
                if asleep and read[i]:
                    reference[i] += min(max(off - common, -near), near) * share
            else:
                if trusted:
                    others, rest = count, total
                if asleep and read[i]:
                    reference[i] += min(max(off, -far), far) * share
                    off = min(max(off, low), high)
                    if trusted:
                        others -= 1
                        rest -= off
                    off -= mean
                    own_variance += off * off
                rest /= max(others, 1)
            own = r[i]
            if read[i]:
                own = (r[i] + 1.0) / (1.0 + rest * weights[others]) - 1.0
            without[i] = own
            watched[i] = r[i] if asleep and not held else own
            changed |= told[i] != others
            told[i] = others
        own_variance /= max(count - 1, 1)
        if not held and count > LEAST_CELLS and own_variance + mean * mean > least_variance:
            test[TESTS] += 1.0
            test[OWN] += own_variance
            test[SHARED] += mean * mean - own_variance / count
    return changed


LOOPS = (subtract_each,)
