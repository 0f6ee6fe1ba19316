"""Noise of readings, measured from frame to frame while the skin may be pressed.

The mean absolute change of the readings between two frames is 1.13 sigma, with sigma the standard deviation of the
noise. A press enlarges it. If it exceeds the noise so far, motion is therefore removed first, by noise-subspace
estimation (Pisarenko 1973). Every weighted sum of the last changes has a known variance by noise. Motion that follows
one pattern over the readings, whatever its course in time, vanishes from one of these sums: from

* the second difference, while a press grows steadily;
* the change over two frames, after a spark or a tap that lasted one frame;
* the newest or the last but one change, before or after a jump;
* some sum in between, while a press accelerates.

The weights of the quietest sum are the eigenvector to the smallest eigenvalue of the changes' second moments, taken
relative to those of noise (:func:`_quietest_of_two`). The scatter of this sum over the readings is the noise. Its
median limits how much each reading counts: motion of other patterns hardly does where it moves less than half of the
readings. Noise that seems to have grown has to be in three changes as well (:func:`_quietest`), among which two
patterns of motion vanish. A noise that has begun is thus known in its third frame, in motion too.

A noise is remembered for as long as it was seen, up to twenty frames: what has been mistaken for noise in one frame is
soon forgotten. Frames whose readings move so little that the noise cannot be there shorten this memory, one after
another: a pause of five frames is bridged, and after twenty the noise is gone. While readings stand at their limits,
they show no noise, and it is not forgotten.

Few readings have no quietest sum that is not quiet by chance. Their measure is the alternating part of two successive
changes: noise goes back and forth, and of three readings in a row the middle one is beyond both others twice in three
times. A press moves a reading once, or goes on in one direction, and lowers this estimate.

Few readings also say little. The estimate is therefore enlarged by what they leave open (:func:`_left_open`): 3 % with
64 readings after twenty frames, a factor of 2.4 with four readings in the first change.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from scipy.linalg.lapack import dsyev
from scipy.special import chdtri

from ..arrays import FloatArray, median
from ..compiled import Rows, loop

FORGET = 0.95
"""share of a noise that is still assumed a frame later, once it has been seen for long"""
BARELY_SEEN = 1.5
"""frames that a noise counts as seen for in its first frame: 0.6 of it is assumed a frame later"""
FEW = 6
"""readings up to which alternation is the measure"""
FADING = 0.8
"""share of the frames in which a noise was seen that still counts after a frame which contradicts the noise"""
CONTRADICTED = 0.5
"""of a noise that is assumed, from which on it is worth while to ask whether a frame contradicts it"""
TELLING = 8
"""readings that can change from which on a noise that they no longer show is forgotten as quickly as it may be"""
MOST_CHANGE = 1.5
"""standard deviations of a reading up to which its change counts"""
MEAN_CHANGE, ALTERNATING = 0.918, 0.438
"""mean in sigma, and alternating part in sigma^2, of changes that are cut off there (normal distribution)"""
AT_FIRST = 4.0
"""ADC steps, the most that is seen in the first two frames: they may also differ because all cells were pressed"""
MEDIAN_CHANGE = 0.954
"""median of the absolute change in sigma (normal distribution)"""
QUIET_OF_TWO, QUIET_OF_THREE = 0.8, 1.4
"""times 1/sqrt(n): by how much the quietest sum of two or three changes of n readings lies below the noise by chance;
about the lower third of simulated noise of 6 to 256 readings (its medians: 0.6 and 1.1)"""
ABOVE = 1.1
"""ratio to the noise so far, from which on motion may be the reason"""
GROWING = 1.3
"""ratio to the noise so far, from which on the noise may have become another one"""
ROUNDED = 1.0 + 1e-9
"""so that changes of the sizes of before are not more than those by the order in which they are added up"""
DOUBT = 0.05
"""probability of readings as quiet as those that were seen, with the noise that is stated"""
RARE = 0.01
"""probability of changes so small that the noise must have been smaller"""
DEVIATIONS = 1.645
"""of a mean over the readings, which leave as much open; normal distribution"""
ASSUMED = 0.5
"""ADC steps, before anything is measured"""

_MEMORY = 1.0 / (1.0 - FORGET)  # frames
_THREE = 2.0 * np.eye(3) - np.eye(3, k=1) - np.eye(3, k=-1)  # covariance of three changes by noise, over sigma^2
_WHITENED = np.linalg.inv(np.linalg.cholesky(_THREE))
_ROOT_2, _ROOT_3 = math.sqrt(2.0), math.sqrt(3.0)


class Scatter:
    """Standard deviation of the readings of one board, in V."""

    def __init__(self, step: float, *, assumed: bool) -> None:
        """For a converter's step in V.

        Args:
            step: V.
            assumed: begin with :data:`ASSUMED` steps rather than with none.

        """
        self._step = step
        self._assumed = ASSUMED * step if assumed else 0.0
        self._cut_sum = _cut_sum.machine_code(unchecked=True) or cut_sum
        self._changes_of = _changes_of.machine_code(unchecked=True)
        self._quietest = np.zeros((0, 0))
        """V, the quietest sum that the loop has found last; written anew in each frame"""
        self.before: FloatArray | None = None
        """V, the last frame's readings"""
        self.frames = 0
        """changes seen so far, and one"""
        self._change: FloatArray | None = None  # V, from the last frame but one to the last
        self._largest: float | None = None  # V, of any reading in that change; None: not looked for
        self._older: FloatArray | None = None  # V, the change before
        self.forget()

    @property
    def std(self) -> float:
        """V, with what few readings leave open."""
        return self._seen + self._open * max(self._seen, self._assumed)

    @property
    def change(self) -> FloatArray:
        """V (N, M), how the readings have changed since the last frame; nothing where none is known."""
        if self._change is not None:
            return self._change
        return np.zeros(() if self.before is None else self.before.shape)

    @property
    def largest_change(self) -> float:
        """V, of any reading since the last frame."""
        change = self._change
        if change is None:
            return 0.0
        if self._largest is not None:
            return self._largest
        return max(change.item(change.argmax()), -change.item(change.argmin()))

    @property
    def possible(self) -> float:
        """V, the noise if the readings' last change is all noise: one change does not tell noise from motion."""
        if self._change is None:
            return 0.0
        return _median(np.abs(self._change), self._change.size - max(self._free, 1))

    def forget(self) -> None:
        """Take the next frame for the first one."""
        self.resume(self._assumed, None)

    def resume(self, std: float, before: FloatArray | None) -> None:
        """Go on after a frame ``before`` and with what was measured until then."""
        self._seen, self.before = std, before
        self.frames = 0 if before is None else 2
        self._change = self._older = None
        self._confirmed = 0 if before is None else _MEMORY  # frames that the noise was seen in
        self._free = 0  # readings that can change: those at a limit cannot
        self._open = 0.0  # share of the noise seen that may be missing in it
        self._changes = 0.0 if before is None else math.inf  # that the noise was seen in

    def update(self, volts: FloatArray, silent: int) -> None:
        """Take the readings (N, M) in V of a frame, in whose predecessor ``silent`` ones stood at a limit."""
        before, self.before = self.before, volts
        self.frames += 1
        self._free = volts.size - silent
        if before is None:
            return
        moving = max(self._free, 1)
        cut = self._largest = None
        if self._changes_of is None or self._change is None:
            change = volts - before
        else:
            if self._quietest.shape != volts.shape:
                self._quietest = np.empty(volts.shape)
            change, most = np.empty(volts.shape), self._most(self._seen)
            *cut, self._largest = self._changes_of(volts, before, self._change, most, change, self._quietest)
        if self.frames == 2:
            expected = max(self._seen, min(_median(np.abs(change)), AT_FIRST * self._step))
            self._seen, self._confirmed = self._by_mean(change, expected, moving), 1
        else:
            shown, assumed = self._shown_by(change, moving, cut), self._assumed_next
            if shown > GROWING * self._seen:
                self._changes = 0.0  # what was seen before was another noise
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
        """Take a frame whose readings are those of the last one, in which ``silent`` ones stood at a limit."""
        assert self.before is not None
        self.frames += 1
        self._free = self.before.size - silent
        self._change = self._older = None  # nothing goes back to before
        if self._free and _most_of(0.0, self._free, self._step) < self._seen:
            self._confirmed *= FADING
        self._seen = self._assumed_next
        self._count()

    @property
    def _assumed_next(self) -> float:
        """V, noise that is still assumed in the next frame; readings at their limits would not show it."""
        assert self.before is not None
        told = min(1.0, self._free / min(TELLING, self.before.size))
        return self._seen * (1.0 - told / min(self._confirmed + BARELY_SEEN, _MEMORY))

    def _count(self) -> None:
        """Count the changes of one more frame. They are forgotten as the noise that they have shown is."""
        assert self.before is not None
        most = self.before.size / (1.0 - FORGET)
        self._changes = FORGET * min(self._changes, most) + self._free
        self._open = _left_open(max(round(self._changes), 1))

    def _shown_by(self, change: FloatArray, moving: int, cut: list[float] | None) -> float:
        """V, by this change (N, M) in V and those before.

        Args:
            change: V, since the last frame.
            moving: readings that can change.
            cut: V, cut sums of that, and of the quietest sum of it and the change before, where a loop has found them.

        """
        mean = self._by_mean(change, self._seen, moving) if cut is None else cut[0] / (moving * MEAN_CHANGE)
        if mean <= ROUNDED * self._seen:  # whatever moves
            return mean
        if self._change is None:
            return 0.0
        if moving < FEW:
            return self._shown_by_few(change, mean)
        if cut is None:
            shown = self._by_quietest(_quietest_of_two(change, self._change), QUIET_OF_TWO, moving)
        else:
            shown = self._by_quietest(self._quietest, QUIET_OF_TWO, moving, cut[1])
        if shown > ABOVE * self._seen and self._older is not None:
            of_three = _quietest(np.concatenate((change, self._change, self._older)).reshape(3, -1))[None]
            shown = min(shown, self._by_quietest(of_three, QUIET_OF_THREE, moving))
        return shown

    def _by_quietest(self, quietest: FloatArray, quiet: float, moving: int, cut: float | None = None) -> float:
        """V, by the scatter over the readings of the quietest sum of some changes.

        Args:
            quietest: (N, M) or (1, N M) V, the sum, with the variance of one change by noise.
            quiet: :data:`QUIET_OF_TWO` or :data:`QUIET_OF_THREE`.
            moving: readings that can change.
            cut: V, its cut sum with the noise so far, where that is known.

        """
        mean = self._by_mean(quietest, self._seen, moving) if cut is None else cut / (moving * MEAN_CHANGE)
        if mean > GROWING * self._seen:  # noise so far cuts off too much of a larger one
            expected = _median(np.abs(quietest), quietest.size - moving)
            mean = self._by_mean(quietest, max(self._seen, expected), moving)
        return mean / (1.0 - quiet / math.sqrt(moving))

    def _shown_by_few(self, change: FloatArray, mean: float) -> float:
        """V, by the alternation of this change (N, M) in V and the one before.

        Args:
            change: V.
            mean: V, noise by the mean size of ``change``.

        """
        assert self._change is not None
        moving = max(self._free, 1)
        alternating = self._alternating(change, self._seen, moving)
        if min(mean, alternating) <= GROWING * self._seen:
            return min(mean, alternating)
        # Noise so far cuts off too much of a larger one. Either median is of noise unless half of the cells move; that
        # of both changes together also where all of them come and go.
        expected = min(_median(np.abs(change)), _median(np.abs(self._change)), _median(np.abs(change + self._change)))
        expected = max(self._seen, expected)
        return min(self._by_mean(change, expected, moving), self._alternating(change, expected, moving))

    def _most_by(self, change: FloatArray, moving: int) -> float:
        """V, a noise with which changes (N, M) as small as these would be rare: they end what a jump has shown."""
        each = change.ravel()
        return _most_of(float(each.dot(each)), moving, self._step)

    def _alternating(self, change: FloatArray, expected: float, moving: int) -> float:
        """V, the most that the alternating part of this change (N, M) in V and the one before lets the noise be.

        The smaller one of both changes counts, so that a jump before or after a quiet frame is no noise. Arguments as
        in :meth:`_by_mean`.
        """
        assert self._change is not None
        back = np.minimum(np.abs(change), np.abs(self._change))
        np.minimum(back, max(self._step, MOST_CHANGE * expected), out=back)
        back *= back
        each = back.ravel()
        # A sample of few cells may alternate less than its noise.
        chance = DEVIATIONS * math.sqrt(each.dot(each))
        onward = np.copysign(back, change * self._change, out=back)
        part = chance - float(np.add.reduce(onward, axis=None))
        return math.sqrt(max(part, 0.0) / (moving * ALTERNATING))

    def _by_mean(self, change: FloatArray, expected: float, moving: int) -> float:
        """V, standard deviation by the mean absolute change.

        Args:
            change: (N, M) V, since the last frame.
            expected: V, standard deviation that is expected; larger changes are cut off.
            moving: readings that can change.

        """
        return self._cut_sum(change, self._most(expected)) / (moving * MEAN_CHANGE)

    def _most(self, expected: float) -> float:
        """V, the largest change that counts where a standard deviation in V is expected."""
        return max(self._step, MOST_CHANGE * expected)


def cut_sum(change: FloatArray, most: float) -> float:
    """Sum of the absolute values (N, M), each cut off at ``most``."""
    return float(np.add.reduce(np.minimum(np.abs(change), most), axis=None))


@loop
def _cut_sum(change: Rows, most: float) -> float:
    """As :func:`cut_sum`."""
    rows, columns = change.shape
    total = 0.0
    for i in range(rows):
        for j in range(columns):
            total += min(abs(change[i, j]), most)
    return total


def _quietest_of_two(change: FloatArray, before: FloatArray) -> FloatArray:
    """The weighted sum of two successive changes that varies least over the readings, relative to noise.

    Second difference and change over two frames are independent under noise, with 6 and 2 sigma^2. In these two
    coordinates, scaled to the same variance, the weights are the minor axis of the readings' ellipse of inertia.

    Args:
        change: V, the newer one.
        before: V, the one before.

    Returns:
        V, shaped like both, with the variance 2 sigma^2 of one change by noise.

    """
    new, old = change.ravel(), before.ravel()
    newer, mixed, older = float(new.dot(new)), float(new.dot(old)), float(old.dot(old))
    second = (newer - 2.0 * mixed + older) / 3.0
    across = newer + 2.0 * mixed + older
    angle = 0.5 * math.atan2(2.0 * (newer - older) / _ROOT_3, second - across)
    sine, cosine = math.sin(angle) / _ROOT_3, math.cos(angle)
    quietest: FloatArray = change * (cosine - sine)
    quietest += before * (cosine + sine)
    return quietest


@loop
def _changes_of(
    volts: Rows, last: Rows, before: Rows, most: float, change: Rows, quietest: Rows
) -> tuple[float, float, float]:
    """Write the change (N, M) of the readings, and its quietest sum with the one ``before``.

    As array operations, :func:`_quietest_of_two` and :func:`cut_sum`.

    Returns:
        The cut sums of both, and the largest change.
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
    """As :func:`_quietest_of_two`, of three changes (3, n) in V: (n,) V."""
    white = _WHITENED.dot(changes)
    least: FloatArray = dsyev(white.dot(white.T))[1][:, 0]  # eigh() of NumPy takes three times as long
    quietest: FloatArray = (_ROOT_2 * least).dot(white)
    return quietest


@cache
def _left_open(changes: int) -> float:
    """The relative error of a standard deviation that was seen in so many changes: by how much it may be larger.

    The variance of n normally distributed changes, over that of the noise, is chi-square with n degrees of freedom,
    over n. It is below the quantile of :data:`DOUBT` with this probability.
    """
    return math.sqrt(changes / float(chdtri(changes, 1.0 - DOUBT))) - 1.0


def _most_of(square: float, moving: int, step: float) -> float:
    """A noise with which a sum of squares of changes as small as this one would be rare; in units of ``step``."""
    return math.sqrt((square + moving * step**2) / (2.0 * _rarely_less(moving)))


@cache
def _rarely_less(changes: int) -> float:
    """The sum of squares of so many normally distributed numbers that is undercut with probability :data:`RARE`."""
    return float(chdtri(changes, 1.0 - RARE))


def _median(size: FloatArray, silent: int = 0) -> float:
    """V, standard deviation by the median of absolute changes in V, ``silent`` of which cannot be but 0."""
    if not silent:
        return median(size) / MEDIAN_CHANGE
    middle = silent + (size.size - silent) // 2
    return float(np.partition(size, middle, axis=None)[middle]) / MEDIAN_CHANGE
