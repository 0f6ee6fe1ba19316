"""Noise of the readings, estimated from frame to frame while the skin may be pressed (noise-subspace estimation).

The mean absolute change of the readings between two frames is 1.13 sigma, with sigma the standard deviation of the
noise. A press enlarges this mean. If the mean exceeds the noise so far, motion is therefore removed first, by
noise-subspace estimation (Pisarenko 1973). Under noise alone every weighted sum of the last changes has a known
variance. Motion that follows one pattern over the readings, whatever its course in time, vanishes from one of these
sums:

* from the second difference, while a press grows steadily;
* from the change over two frames, after a spark or a tap that lasted one frame;
* from the newest or the last but one change, before or after a jump;
* from some sum in between, while a press accelerates.

The weights of the quietest sum are the eigenvector to the smallest eigenvalue of the changes' second moments, relative
to the second moments of noise (:func:`_changes_of`). The scatter of this sum over the readings is the noise. Each
reading is clipped in relation to the median, so that motion of other patterns hardly counts as long as it moves less
than half of the readings. Noise that seems to have grown must also show in the quietest sum of three changes
(:func:`_quietest`), from which two patterns of motion vanish. Noise that begins is thus known in its third frame, even
during motion.

An estimate is kept for as many frames as have shown the noise, up to twenty. Motion that was mistaken for noise in one
frame is thus soon forgotten. Each frame whose readings move too little for this noise shortens the memory: a pause of
five frames is bridged, and after twenty the noise is gone. Readings at their limits show no noise; while they stand
there, the noise is not forgotten.

With few readings the quietest sum is quiet by chance. Their measure is the alternating part of two successive changes.
Noise goes back and forth: of three readings in a row the middle one is beyond both others twice in three times. A press
moves a reading once, or goes on in one direction, and lowers this estimate.

Few readings also leave a large sampling error. The estimate is enlarged by this error (:func:`_left_open`): by 3 % with
64 readings after twenty frames, by a factor of 2.4 with four readings in the first change.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from scipy.linalg.lapack import dsyev
from scipy.special import chdtri

from ..common.arrays import FloatArray, median
from ..common.compiled import Rows, loop

FORGET = 0.95
"""share of the noise that is still assumed a frame later, once the noise has been seen for long"""
BARELY_SEEN = 1.5
"""frames added to those in which a noise was seen: after its first frame, 0.6 of it is assumed a frame later"""
FEW = 6
"""with fewer readings the alternating part is the measure"""
FADING = 0.8
"""factor on the number of frames in which a noise was seen, for each frame that contradicts the noise"""
CONTRADICTED = 0.5
"""fraction of the assumed noise: only a frame that shows less is tested for contradicting the noise"""
TELLING = 8
"""readings free to change from which on a noise that has vanished is forgotten as fast as possible"""
MOST_CHANGE = 1.5
"""standard deviations of a reading at which its change is clipped"""
MEAN_CHANGE, ALTERNATING = 0.918, 0.438
"""mean in sigma, and alternating part in sigma^2, of changes that are clipped there (normal distribution)"""
AT_FIRST = 4.0
"""ADC steps, the largest noise accepted from the first two frames, which may also differ because all cells were
pressed"""
MEDIAN_CHANGE = 0.954
"""median of the absolute change in sigma (normal distribution)"""
QUIET_OF_TWO, QUIET_OF_THREE = 0.8, 1.4
"""times 1/sqrt(n): how far the quietest sum of two or three changes of n readings lies below the noise by chance; about
the lower third of simulated noise of 6 to 256 readings (its medians: 0.6 and 1.1)"""
ABOVE = 1.1
"""ratio to the noise so far above which motion may be the cause"""
GROWING = 1.3
"""ratio to the noise so far above which the noise may have changed"""
ROUNDED = 1.0 + 1e-9
"""tolerance for rounding: the order of summation must not make equal changes exceed the earlier ones"""
DOUBT = 0.05
"""probability that the stated noise gives readings as quiet as those seen"""
RARE = 0.01
"""probability of changes so small, below which the noise must have been smaller"""
DEVIATIONS = 1.645
"""standard deviations of a mean over the readings with the same probability as :data:`DOUBT`; normal distribution"""
ASSUMED = 0.5
"""ADC steps of noise before anything is measured"""

_MEMORY = 1.0 / (1.0 - FORGET)  # frames
_THREE = 2.0 * np.eye(3) - np.eye(3, k=1) - np.eye(3, k=-1)  # covariance of three changes by noise, over sigma^2
_WHITENED = np.linalg.inv(np.linalg.cholesky(_THREE))
_ROOT_2, _ROOT_3 = math.sqrt(2.0), math.sqrt(3.0)


class Scatter:
    """Estimates the standard deviation of the readings of one board, in V."""

    def __init__(self, step: float, *, assumed: bool) -> None:
        """Start without a frame.

        Args:
            step: step of the converter in V.
            assumed: start with a noise of :data:`ASSUMED` steps rather than with none.

        """
        self._step = step
        self._assumed = ASSUMED * step if assumed else 0.0
        self._quietest = np.zeros((0, 0))
        """V, the quietest sum found last by the compiled loop; overwritten in each frame"""
        self.before: FloatArray | None = None
        """V, the last frame's readings"""
        self.frames = 0
        """number of frames: changes seen so far, plus one"""
        self._change: FloatArray | None = None  # V, from the last frame but one to the last
        self._largest: float | None = None  # V, of any reading in that change; None: not computed
        self._older: FloatArray | None = None  # V, the change before
        self.forget()

    @property
    def std(self) -> float:
        """V, enlarged by the sampling error of few readings."""
        return self._seen + self._open * max(self._seen, self._assumed)

    @property
    def change(self) -> FloatArray:
        """V (N, M), change of the readings since the last frame; 0 if none is known."""
        if self._change is not None:
            return self._change
        return np.zeros(() if self.before is None else self.before.shape)

    @property
    def largest_change(self) -> float:
        """V, largest absolute change of a reading since the last frame."""
        change = self._change
        if change is None:
            return 0.0
        if self._largest is not None:
            return self._largest
        return max(change.item(change.argmax()), -change.item(change.argmin()))

    @property
    def possible(self) -> float:
        """V, the noise if the last change were all noise: a single change does not tell noise from motion."""
        if self._change is None:
            return 0.0
        return _median(np.abs(self._change), self._change.size - max(self._free, 1))

    def forget(self) -> None:
        """Treat the next frame as the first one."""
        self.resume(self._assumed, None)

    def resume(self, std: float, before: FloatArray | None) -> None:
        """Continue after the frame ``before`` with the noise ``std`` measured until then, both in V."""
        self._seen, self.before = std, before
        self.frames = 0 if before is None else 2
        self._change = self._older = None
        self._confirmed = 0 if before is None else _MEMORY  # frames in which the noise was seen
        self._free = 0  # readings that can change: those at a limit cannot
        self._open = 0.0  # relative sampling error by which the noise may be larger than seen
        self._changes = 0.0 if before is None else math.inf  # changes in which the noise was seen

    def update(self, volts: FloatArray, silent: int) -> None:
        """Take a frame of readings (N, M) in V; in the frame before, ``silent`` of them stood at a limit."""
        before, self.before = self.before, volts
        self.frames += 1
        self._free = volts.size - silent
        if before is None:
            return
        moving = max(self._free, 1)
        cut = self._largest = None
        if self._change is None:
            change = volts - before
        else:
            if self._quietest.shape != volts.shape:
                self._quietest = np.empty(volts.shape)
            change, most = np.empty(volts.shape), self._most(self._seen)
            *cut, self._largest = _changes_of.unchecked(volts, before, self._change, most, change, self._quietest)
        if self.frames == 2:
            expected = max(self._seen, min(_median(np.abs(change)), AT_FIRST * self._step))
            self._seen, self._confirmed = self._by_mean(change, expected, moving), 1
        else:
            shown, assumed = self._shown_by(change, moving, cut), self._assumed_next
            if shown > GROWING * self._seen:
                self._changes = 0.0  # the earlier changes showed another noise
                self._confirmed = 0
            if shown > assumed:
                self._confirmed += 1
            elif shown < CONTRADICTED * assumed and self._most_by(change, moving) < assumed:
                self._confirmed *= FADING
            if 0 < self._free < FEW:
                assumed = min(FORGET * self._seen, self._most_by(change, moving))
            self._seen = max(assumed, shown)
        self._change, self._older = change, self._change
        self._count()

    def still(self, silent: int) -> None:
        """Take a frame equal to the last one, in which ``silent`` readings stood at a limit."""
        assert self.before is not None
        self.frames += 1
        self._free = self.before.size - silent
        self._change = self._older = None  # an unchanged frame shows no alternation
        if self._free and _most_of(0.0, self._free, self._step) < self._seen:
            self._confirmed *= FADING
        self._seen = self._assumed_next
        self._count()

    @property
    def _assumed_next(self) -> float:
        """V, noise that is still assumed in the next frame; kept while readings stand at limits and show no noise."""
        assert self.before is not None
        told = min(1.0, self._free / min(TELLING, self.before.size))
        return self._seen * (1.0 - told / min(self._confirmed + BARELY_SEEN, _MEMORY))

    def _count(self) -> None:
        """Count the changes of one more frame; they are forgotten at the rate of the noise that they have shown."""
        assert self.before is not None
        most = self.before.size / (1.0 - FORGET)
        self._changes = FORGET * min(self._changes, most) + self._free
        self._open = _left_open(max(round(self._changes), 1))

    def _shown_by(self, change: FloatArray, moving: int, cut: list[float] | None) -> float:
        """V, the noise shown by this change (N, M) in V and by those before.

        Args:
            change: V, since the last frame.
            moving: readings that can change.
            cut: V, clipped sums of ``change``, and of its quietest sum with the change before, if a loop has computed
                them.

        """
        mean = self._by_mean(change, self._seen, moving) if cut is None else cut[0] / (moving * MEAN_CHANGE)
        if mean <= ROUNDED * self._seen:  # motion only adds to the mean
            return mean
        if self._change is None or cut is None:
            return 0.0
        if moving < FEW:
            return self._shown_by_few(change, mean)
        shown = self._by_quietest(self._quietest, QUIET_OF_TWO, moving, cut[1])
        if shown > ABOVE * self._seen and self._older is not None:
            of_three = _quietest(np.concatenate((change, self._change, self._older)).reshape(3, -1))[None]
            shown = min(shown, self._by_quietest(of_three, QUIET_OF_THREE, moving))
        return shown

    def _by_quietest(self, quietest: FloatArray, quiet: float, moving: int, cut: float | None = None) -> float:
        """V, noise by the scatter over the readings of the quietest sum of some changes.

        Args:
            quietest: (N, M) or (1, N M) V, the sum, scaled to the variance of one change by noise.
            quiet: :data:`QUIET_OF_TWO` or :data:`QUIET_OF_THREE`.
            moving: readings that can change.
            cut: V, its sum clipped by the noise so far, if known.

        """
        mean = self._by_mean(quietest, self._seen, moving) if cut is None else cut / (moving * MEAN_CHANGE)
        if mean > GROWING * self._seen:  # clipping by the noise so far removes too much of a larger noise
            expected = _median(np.abs(quietest), quietest.size - moving)
            mean = self._by_mean(quietest, max(self._seen, expected), moving)
        return mean / (1.0 - quiet / math.sqrt(moving))

    def _shown_by_few(self, change: FloatArray, mean: float) -> float:
        """V, noise by the alternation of this change (N, M) in V and the one before.

        Args:
            change: V.
            mean: V, noise by the mean size of ``change``.

        """
        assert self._change is not None
        moving = max(self._free, 1)
        alternating = self._alternating(change, self._seen, moving)
        if min(mean, alternating) <= GROWING * self._seen:
            return min(mean, alternating)
        # Clipping by the noise so far removes too much of a larger noise. The median of either change is that of noise
        # unless half of the cells move. The median of both together also is where all cells come and go.
        expected = min(_median(np.abs(change)), _median(np.abs(self._change)), _median(np.abs(change + self._change)))
        expected = max(self._seen, expected)
        return min(self._by_mean(change, expected, moving), self._alternating(change, expected, moving))

    def _most_by(self, change: FloatArray, moving: int) -> float:
        """V, a noise with which changes (N, M) as small as these would be rare. It limits what a jump leaves behind."""
        each = change.ravel()
        return _most_of(float(each.dot(each)), moving, self._step)

    def _alternating(self, change: FloatArray, expected: float, moving: int) -> float:
        """V, upper estimate of the noise by the alternating part of this change (N, M) in V and the one before.

        The smaller one of both changes counts, so that a jump before or after a quiet frame is no noise. Arguments as
        in :meth:`_by_mean`.
        """
        assert self._change is not None
        back = np.minimum(np.abs(change), np.abs(self._change))
        np.minimum(back, max(self._step, MOST_CHANGE * expected), out=back)
        back *= back
        each = back.ravel()
        # By chance, few cells may alternate less than their noise does.
        chance = DEVIATIONS * math.sqrt(each.dot(each))
        onward = np.copysign(back, change * self._change, out=back)
        part = chance - float(np.add.reduce(onward, axis=None))
        return math.sqrt(max(part, 0.0) / (moving * ALTERNATING))

    def _by_mean(self, change: FloatArray, expected: float, moving: int) -> float:
        """V, standard deviation by the mean absolute change.

        Args:
            change: (N, M) V, since the last frame.
            expected: V, expected standard deviation, at a multiple of which changes are clipped.
            moving: readings that can change.

        """
        return _cut_sum.unchecked(change, self._most(expected)) / (moving * MEAN_CHANGE)

    def _most(self, expected: float) -> float:
        """V, the largest change that counts for an expected standard deviation in V."""
        return max(self._step, MOST_CHANGE * expected)


@loop
def _cut_sum(change: Rows, most: float) -> float:
    """Sum of the absolute values (N, M), each clipped at ``most``."""
    rows, columns = change.shape
    total = 0.0
    for i in range(rows):
        for j in range(columns):
            total += min(abs(change[i, j]), most)
    return total


@loop
def _changes_of(
    volts: Rows, last: Rows, before: Rows, most: float, change: Rows, quietest: Rows
) -> tuple[float, float, float]:
    """Write the change (N, M) of the readings, and the quietest sum of it and the change ``before``.

    That sum varies least over the readings, relative to noise. The second difference and the change over two frames are
    independent under noise, with variances of 6 and 2 sigma^2. In these two coordinates, scaled to the same variance,
    the weights are the minor axis of the readings' ellipse of inertia. The sum is scaled to the variance 2 sigma^2 of
    one change by noise.

    Returns:
        The sums of both, clipped at ``most``, and the largest change.
    """
    rows, columns = volts.shape
    newer = mixed = older = cut = largest = 0.0
    for i in range(rows):
        for j in range(columns):
            change[i, j] = volts[i, j] - last[i, j]
            newer += change[i, j] * change[i, j]
            mixed += change[i, j] * before[i, j]
            older += before[i, j] * before[i, j]
            cut += min(abs(change[i, j]), most)
            largest = max(largest, abs(change[i, j]))
    second = (newer - 2.0 * mixed + older) / 3.0
    across = newer + 2.0 * mixed + older
    angle = 0.5 * math.atan2(2.0 * (newer - older) / _ROOT_3, second - across)
    sine, cosine = math.sin(angle) / _ROOT_3, math.cos(angle)
    cut_of_two = 0.0
    for i in range(rows):
        for j in range(columns):
            quietest[i, j] = change[i, j] * (cosine - sine) + before[i, j] * (cosine + sine)
            cut_of_two += min(abs(quietest[i, j]), most)
    return cut, cut_of_two, largest


def _quietest(changes: FloatArray) -> FloatArray:
    """The quietest sum of three changes (3, n) in V, as :func:`_changes_of` has it of two; returns (n,) V."""
    white = _WHITENED.dot(changes)
    least: FloatArray = dsyev(white.dot(white.T))[1][:, 0]  # eigh() of NumPy takes three times as long
    quietest: FloatArray = (_ROOT_2 * least).dot(white)
    return quietest


@cache
def _left_open(changes: int) -> float:
    """Relative error by which a standard deviation estimated from so many changes may be too small.

    The variance of n normally distributed changes, relative to that of the noise, is chi-square with n degrees of
    freedom, divided by n. It lies below its :data:`DOUBT` quantile with this probability.
    """
    return math.sqrt(changes / float(chdtri(changes, 1.0 - DOUBT))) - 1.0


def _most_of(square: float, moving: int, step: float) -> float:
    """A noise with which a sum of squared changes as small as this one would be rare; in the unit of ``step``."""
    return math.sqrt((square + moving * step**2) / (2.0 * _rarely_less(moving)))


@cache
def _rarely_less(changes: int) -> float:
    """The :data:`RARE` quantile of the sum of squares of so many standard normal numbers (chi-square)."""
    return float(chdtri(changes, 1.0 - RARE))


def _median(size: FloatArray, silent: int = 0) -> float:
    """V, standard deviation by the median of absolute changes in V, of which ``silent`` are always 0."""
    if not silent:
        return median(size) / MEDIAN_CHANGE
    middle = silent + (size.size - silent) // 2
    return float(np.partition(size, middle, axis=None)[middle]) / MEDIAN_CHANGE
