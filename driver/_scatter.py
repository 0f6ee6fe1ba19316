"""Noise of readings, measured from frame to frame while the skin may be pressed.

Two estimates of the standard deviation sigma are made, both from changes of readings between successive frames:

* the mean absolute change, 1.13 sigma for noise. A press enlarges the changes of the readings it reaches;
* the alternating part of two successive changes. Noise goes back and forth: of three readings in a row the middle
  one is beyond both others twice in three times. A press moves a reading once, or goes on in one direction, and
  lowers this estimate. What comes and goes within a frame (a spark, a tap) alternates as well, but leaves no change
  from the frame before it to the one after it.

A mean change above the noise so far counts as noise up to what the alternating part confirms: a press of all cells is
no noise, and a noise that has begun is known in its second or third frame.

Few readings say little. The estimate is therefore enlarged by what they leave open (:func:`_left_open`): 3 % with 64
readings after twenty frames, a factor of 2.4 with four readings in the first change.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from scipy.special import chdtri

from ..arrays import FloatArray, median

FORGET = 0.95
"""share of a noise that is still assumed a frame later"""
MOST_CHANGE = 1.5
"""standard deviations of a reading up to which its change counts"""
MEAN_CHANGE, ALTERNATING = 0.918, 0.438
"""mean in sigma, and alternating part in sigma^2, of changes that are cut off there (normal distribution)"""
AT_FIRST = 4.0
"""ADC steps, the most that is seen in the first two frames: they may also differ because all cells were pressed"""
MEDIAN_CHANGE = 0.954
"""median of the absolute change in sigma (normal distribution)"""
GROWING = 1.3
"""ratio to the noise so far, from which on the noise may have become another one"""
DOUBT = 0.05
"""probability of readings as quiet as those that were seen, with the noise that is stated"""
DEVIATIONS = 1.645
"""of a mean over the readings, which leave as much open; normal distribution"""
ASSUMED = 0.5
"""ADC steps, before anything is measured"""


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
        self.before: FloatArray | None = None
        """V, the last frame's readings"""
        self.frames = 0
        """changes seen so far, and one"""
        self._change: FloatArray | None = None  # V, from the last frame but one to the last
        self.forget()

    @property
    def std(self) -> float:
        """V, with what few readings leave open."""
        return self._seen + self._open * max(self._seen, self._assumed)

    def forget(self) -> None:
        """Take the next frame for the first one."""
        self.resume(self._assumed, None)

    def resume(self, std: float, before: FloatArray | None) -> None:
        """Go on after a frame ``before`` and with what was measured until then."""
        self._seen, self.before = std, before
        self.frames, self._change = 0 if before is None else 2, None
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
        change = volts - before
        moving = max(self._free, 1)
        if self.frames == 2:
            size = np.abs(change)
            expected = max(self._seen, min(_median(size), AT_FIRST * self._step))
            self._seen = self._by_mean(size, expected, moving)
        else:
            shown = self._shown_by(change, moving)
            if shown > GROWING * self._seen:
                self._changes = 0.0  # what was seen before was another noise
            self._seen = max(FORGET * self._seen, shown)
        self._change = change
        self._count()

    def still(self) -> None:
        """Take a frame whose readings are those of the last one."""
        self.frames += 1
        self._change = None  # nothing goes back to before
        self._seen *= FORGET
        self._count()

    def _count(self) -> None:
        """Count the changes of one more frame. They are forgotten as the noise that they have shown is."""
        assert self.before is not None
        most = self.before.size / (1.0 - FORGET)
        self._changes = FORGET * min(self._changes, most) + self._free
        self._open = _left_open(max(round(self._changes), 1))

    def _shown_by(self, change: FloatArray, moving: int) -> float:
        """V, by this change (N, M) in V and the one before; ``moving`` readings can change."""
        size = np.abs(change)
        mean = self._by_mean(size, self._seen, moving)
        if mean <= FORGET * self._seen:  # no more than what is still assumed
            return mean
        if self._change is None:
            return 0.0
        alternating = self._alternating(change, self._seen, moving)
        if min(mean, alternating) <= GROWING * self._seen:
            return min(mean, alternating)
        # Noise so far cuts off too much of a larger one. Either median is of noise unless half of the cells move; that
        # of both changes together also where all of them come and go.
        expected = min(_median(size), _median(np.abs(self._change)), _median(np.abs(change + self._change)))
        expected = max(self._seen, expected)
        return min(self._by_mean(size, expected, moving), self._alternating(change, expected, moving))

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

    def _by_mean(self, size: FloatArray, expected: float, moving: int) -> float:
        """V, standard deviation by the mean absolute change.

        Args:
            size: (N, M) V, absolute changes since the last frame.
            expected: V, standard deviation that is expected; larger changes are cut off.
            moving: readings that can change.

        """
        most = max(self._step, MOST_CHANGE * expected)
        return float(np.add.reduce(np.minimum(size, most), axis=None)) / (moving * MEAN_CHANGE)


@cache
def _left_open(changes: int) -> float:
    """The relative error of a standard deviation that was seen in so many changes: by how much it may be larger.

    The variance of n normally distributed changes, over that of the noise, is chi-square with n degrees of freedom,
    over n. It is below the quantile of :data:`DOUBT` with this probability.
    """
    return math.sqrt(changes / float(chdtri(changes, 1.0 - DOUBT))) - 1.0


def _median(size: FloatArray) -> float:
    """V, standard deviation by the median of absolute changes in V."""
    return median(size) / MEDIAN_CHANGE
