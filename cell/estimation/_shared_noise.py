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

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Flags, Places, Records, Row, loop, values, zeros
from .._state import CellState, ColumnState
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
"""places of the test's sums"""


class SharedNoise:
    """Subtracts shared noise from the readings of n cells, and passes the remaining part to the noise meter."""

    def __init__(self, shape: tuple[int, ...], noise: NoiseMeter, side: float = 1.0) -> None:
        """``shape`` is (rows, columns). Cells of an array with another number of axes share nothing.

        ``side`` is the sign of r under a load.
        """
        cells, self._has_columns = math.prod(shape), len(shape) == 2
        self._rows, columns = (shape[0], shape[1]) if self._has_columns else (cells, 1)
        self._noise, self._side = noise, side
        self.ratio = 0.0
        """variance of the shared noise over that of the own noise of a cell at rest; 0: nothing is shared"""
        self._scales_columns = False
        """whether errors of readings scale all conductances of a column alike in this circuit"""
        self._test = np.zeros(3)
        """number of samples in the test so far, and the sums of their variances of own noise and of shared noise"""
        self._reference, self._held_s = np.zeros((2, cells))
        """(n,) mean of the readings of sleeping cells; and seconds for which cells have been held, see
        :mod:`._shared_steps`"""
        self._columns = zeros(ColumnState, columns)
        self._columns["telling"] = -1.0
        self._weights, self._per_std, self._left = np.zeros((3, self._rows + 1))
        """(rows + 1,) by the number of telling cells: share of their mean that is shared noise; own noise over the
        noise of their mean, 0 where the mean is not trusted; and the part of :attr:`ratio` that remains"""
        self._all_read = np.ones(cells, dtype=np.bool_)
        self.mean_std = np.ones(cells)
        """(n,) noise of readings with shared noise (whose mean is monitored) over that of readings without"""

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
        cells = np.arange(self._rows + 1.0)
        trusted = (cells >= LEAST_CELLS) & (self._test[TESTS] >= TESTED)
        self._weights[...] = np.where(trusted, cells * ratio / (cells * ratio + 1.0), 0.0)
        self._left[...] = np.where(trusted, ratio / (cells * ratio + 1.0), ratio)
        self._per_std[...] = np.where(trusted, np.sqrt(cells / np.maximum(cells * ratio + 1.0, 1.0)), 0.0)
        self._columns["telling"] = -1.0

    def sleep(self, places: IntArray, mean: FloatArray) -> None:
        """Take the mean readings (k,) of cells that are put to sleep."""
        self._reference[places] = mean

    def subtract(
        self, dt_s: float, r: FloatArray, known: BoolArray | None, awake: BoolArray, left_over: FloatArray
    ) -> tuple[FloatArray, FloatArray, IntArray | None]:
        """Subtract the shared noise from readings.

        Args:
            dt_s: seconds since the last frame.
            r: (n,) normalised resistances, not changed.
            known: (n,) which cells were read; None: all.
            awake: (n,) which cells do not sleep.
            left_over: (n,) part of r that earlier loads have left.

        Returns:
            (n,) readings without shared noise; (n,) the same, but readings of sleeping cells unchanged; and (k,)
            sleeping cells that are to wake, since their common departure is a load. None: no cells.
        """
        read, own = self._all_read if known is None else known, self._noise.own
        testing = self._test[TESTS] < TESTED
        without, watched = np.empty((2, r.size))
        changed = subtract_each.unchecked(
            *(r, read, awake, self._noise.reading(), self._reference, self._columns, self._weights, self._per_std),
            self._test,
            self._least_variance if testing else math.inf,
            SURE * own,
            SURE * own * math.sqrt(1.0 + self.ratio),
            -math.expm1(-dt_s / REFERENCE_S),
            self._side_per_noise,
            *(without, watched),
        )
        if self._scales_columns:
            self._keep_held(dt_s, without, watched, self._reference + left_over, read, awake)
        loaded = None
        if testing and self._test[TESTS] >= TESTED:
            refuted = self._test[SHARED] < REFUTED * self.ratio * self._test[OWN]
            self._share(0.0 if refuted else self.ratio)
        elif changed:
            tell = ~awake & read
            of_column = np.tile(self._columns["load_sum"] > LOADED, self._rows)
            if of_column.any():
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
        if resolution > 0.0:
            own = max(self._noise.own, resolution)
            steps = resolution * math.sqrt(1.0 + self.ratio) * shared_steps.constant(own / resolution)
            kept = without, self._noise.reading(), reference, self._held_s, read, awake, self._columns
            shared_steps.keep_each.unchecked(*kept, own, steps, self._side, dt_s, watched)

    @property
    def _least_variance(self) -> float:
        """Least variance of the readings of a column in the test; with less, readings stay at one code of the ADC."""
        return MOVED * self._noise.typical_resolution**2

    @property
    def _side_per_noise(self) -> float:
        """Sign of r under a load, over own noise; own noise is at least the quantisation error."""
        return self._side / max(self._noise.own, self._noise.typical_resolution)

    def doubt_kpa2(self, cells: Records[CellState], places: IntArray) -> FloatArray | None:
        """(n,) variance by loads on sleeping cells that may have been subtracted from followed ones; None: zero."""
        sums = self._columns["load_sum"]
        if not ((sums > DOUBTED) & (sums <= LOADED)).any():
            return None
        variance = np.zeros(cells.size)
        doubt_each.unchecked(cells, places, self._columns, self._per_std, abs(self._side_per_noise), variance)
        return variance

    def _tell(self, tell: BoolArray) -> None:
        """Pass the shared noise that remains to the noise meter, if ``tell`` (n,) are the telling cells."""
        tells = tell.reshape(self._rows, -1)
        others = (np.count_nonzero(tells, axis=0) - tells).ravel()
        left = self._left.take(others)
        self.mean_std = np.sqrt((1.0 + self.ratio) / (1.0 + left))
        self._noise.leave(left)

    def state(self) -> dict[str, FloatArray]:
        """The state, by name."""
        return {
            "shared_reference": self._reference,
            "shared_held_s": self._held_s,
            "shared_columns": values(self._columns),
            "shared_of_array": np.array([self.ratio, self._scales_columns, *self._test]),
        }

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a saved :meth:`state`."""
        self._reference, self._held_s = state["shared_reference"], state["shared_held_s"]
        ratio, scales_columns = state["shared_of_array"][:2].tolist()
        self._scales_columns, self._test = bool(scales_columns), state["shared_of_array"][2:].copy()
        self._begin(ratio)
        values(self._columns)[...] = state["shared_columns"]
        self.mean_std = np.sqrt((1.0 + ratio) / (1.0 + self._noise.cells["excess"]))


@loop
def subtract_each(
    r: Row,
    read: Flags,
    awake: Flags,
    last: Row,
    reference: Row,
    columns: Records[ColumnState],
    weights: Row,
    per_std: Row,
    test: Row,
    least_variance: float,
    near: float,
    far: float,
    share: float,
    side_per_noise: float,
    without: Row,
    watched: Row,
) -> bool:
    """Subtract the shared noise of each column.

    Args:
        r: (n,) readings.
        read: (n,) which cells were read.
        awake: (n,) which cells do not sleep.
        last: (n,) readings of the last frame without shared noise.
        reference: (n,) mean of the readings of sleeping cells, changed.
        columns: (columns,) their states, changed.
        weights: (rows + 1,) share of the telling cells' mean that is shared noise, by their number.
        per_std: (rows + 1,) own noise over the noise of their mean; 0 where the mean is not trusted.
        test: (3,) the test's sums, changed.
        least_variance: of a column's readings in the test; infinite: no test.
        near: distance from the mean at which departures are clipped.
        far: the same from the reference.
        share: weight of a reading in the reference.
        side_per_noise: sign of r under a load, over own noise.
        without: (n,) readings without shared noise; written.
        watched: (n,) the same, but readings of sleeping cells unchanged; written.

    Returns:
        Whether the numbers of sleeping cells differ from the last frame's, or some cells are to wake.
    """
    changed, count_of_columns = False, columns.size
    for c in range(count_of_columns):
        column, count, total = columns[c], 0, 0.0
        for i in range(c, r.size, count_of_columns):
            if read[i] and not awake[i]:
                count += 1
                total += min(max(r[i] - reference[i], -far), far)
        centre = total / max(count, 1)
        low, high, total = centre - near, centre + near, 0.0
        for i in range(c, r.size, count_of_columns):
            if read[i] and not awake[i]:
                total += min(max(r[i] - reference[i], low), high)
        mean, own_variance = total / max(count, 1), 0.0
        trusts = per_std[count]
        off = mean * trusts * side_per_noise
        column.load_sum = max(column.load_sum + off - ALLOWED, 0.0) if trusts > 0.0 else 0.0
        column.frames = column.frames + 1.0 if column.load_sum > 0.0 else 0.0
        if off > AT_ONCE:
            column.load_sum = CERTAIN
        column.untold = 1.0 if trusts == 0.0 else 0.0
        doubted, loaded = column.load_sum > DOUBTED, column.load_sum > LOADED
        for i in range(c, r.size, count_of_columns):
            # A sleeping cell is corrected by the mean of the others: its own reading would shrink its own load.
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
                own -= (r[i] + 1.0) * (rest / max(others, 1) * weights[others])
                if doubted and not asleep:
                    own = min(max(last[i], min(own, r[i])), max(own, r[i]))
            without[i] = own
            watched[i] = r[i] if asleep else own
        own_variance /= max(count - 1, 1)
        if count > LEAST_CELLS and own_variance + mean * mean > least_variance:
            test[TESTS] += 1.0
            test[OWN] += own_variance
            test[SHARED] += mean * mean - own_variance / count
        changed |= loaded or column.telling != count
        column.telling = count
    return changed


@loop
def doubt_each(
    cells: Records[CellState],
    places: Places,
    columns: Records[ColumnState],
    per_std: Row,
    per_noise: float,
    variance: Row,
) -> None:
    """Write variances in kPa^2 by loads that may have been subtracted into ``variance`` (n,).

    ``per_noise`` is one over own noise. The size of the load is the mean departure since the sum began to rise, the
    usual estimate of a change's size in Page's test.
    """
    for k in range(places.size):
        cell, column = cells[places[k]], columns[places[k] % columns.size]
        if column.load_sum <= DOUBTED or column.load_sum > LOADED:
            continue
        noises = column.load_sum / column.frames + ALLOWED
        noises *= min(column.load_sum * (1.0 / LIKELY), 1.0) / per_noise
        noises /= per_std[int(column.telling)]
        noises *= cell.reading + 1.0
        variance[places[k]] = (noises * cell.gain_kpa) * (noises * cell.gain_kpa)
