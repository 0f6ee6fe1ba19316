"""Noise of readings, measured from frame to frame while the skin may be pressed.

Two estimates of the standard deviation sigma are made, both from changes of readings between successive frames:

* the mean absolute change, 1.13 sigma for noise. A press enlarges the changes of the readings it reaches;
* the lag-one autocovariance of the changes, -sigma^2 for noise. A press that lasts for more than a frame moves a
  reading in one direction, or once, and adds nothing to it. What comes and goes within a frame (a spark, a tap) looks
  like noise there, but leaves no change from the frame before it to the one after it.

Changes count up to 1.5 sigma, so cells that are pressed weigh little in the first estimate: 30 % of them raise it by
60 %. That is enough where a press changes its own readings only. On a board whose readings share their current a finger
moves all of them; there the smaller estimate of the two counts, which notices a growing noise one frame later.
"""

from __future__ import annotations

import math

import numpy as np

from ..arrays import FloatArray, median

FORGET = 0.95
"""share of a noise that is still assumed a frame later"""
MOST_CHANGE = 1.5
"""standard deviations of a reading up to which its change counts"""
MEAN_CHANGE, AUTOCOVARIANCE = 0.918, 0.516
"""mean in sigma, and minus the autocovariance in sigma^2, of changes that are cut off there (normal distribution)"""
AT_FIRST = 4.0
"""ADC steps, the most that is seen in the first two frames: they may also differ because all cells were pressed"""
MEDIAN_CHANGE = 0.954
"""median of the absolute change in sigma (normal distribution)"""
GROWING = 1.3
"""ratio to the noise so far, from which on the noise has become another one"""
CAUTION = 1.5
"""standard deviations by which the first measurement of the noise may be too small"""
ASSUMED = 0.5
"""ADC steps, before anything is measured"""


class Scatter:
    """Standard deviation of the readings of one board, in V."""

    def __init__(self, step: float, *, assumed: bool, shared: bool) -> None:
        """For a converter's step in V.

        Args:
            step: V.
            assumed: begin with :data:`ASSUMED` steps rather than with none.
            shared: a press changes readings of other cells as well.

        """
        self._step, self._shared, self._assumed = step, shared, assumed
        self.std = 0.0
        """V"""
        self.before: FloatArray | None = None
        """V, the last frame's readings"""
        self.frames = 0
        """changes seen so far, and one"""
        self._change: FloatArray | None = None  # V, from the last frame but one to the last
        self.forget()

    def forget(self) -> None:
        """Take the next frame for the first one."""
        self.std = ASSUMED * self._step if self._assumed else 0.0
        self.before, self.frames, self._change = None, 0, None

    def resume(self, std: float, before: FloatArray | None) -> None:
        """Go on after a frame ``before`` and with what was measured until then."""
        self.std, self.before = std, before
        self.frames, self._change = 0 if before is None else 2, None

    def update(self, volts: FloatArray, silent: int) -> None:
        """Take the readings (N, M) in V of a frame, in whose predecessor ``silent`` ones stood at a limit."""
        before, self.before = self.before, volts
        self.frames += 1
        if before is None:
            return
        change = volts - before
        moving = max(change.size - silent, 1)  # readings at a limit do not move
        if self.frames == 2:
            size = np.abs(change)
            expected = max(self.std, min(_median(size), AT_FIRST * self._step))
            # A sample of few cells may be smaller than its deviation.
            self.std = self._by_mean(size, expected, moving) * (1.0 + CAUTION / math.sqrt(moving))
        else:
            self.std = max(FORGET * self.std, self._shown_by(change, moving))
        self._change = change

    def _shown_by(self, change: FloatArray, moving: int) -> float:
        """V, by this change (N, M) in V and the one before; ``moving`` readings can change."""
        size = np.abs(change)
        mean = self._by_mean(size, self.std, moving)
        if not self._shared and mean <= GROWING * self.std:
            return mean
        alternating = self._by_autocovariance(change, self.std, moving)
        if alternating > self.std:
            # What was known so far cuts too much off. The median is of noise unless half of the cells move.
            expected = _median(size)
            if self._shared and self._change is not None:
                expected = min(expected, _median(np.abs(change + self._change)))
            expected = max(self.std, expected)
            alternating = self._by_autocovariance(change, expected, moving)
            if self._shared:
                mean = self._by_mean(size, expected, moving)
        # On boards whose cells are read apart, a press raises the mean of few cells only.
        return min(mean, alternating) if self._shared else max(mean, alternating)

    def still(self) -> None:
        """Take a frame whose readings are those of the last one."""
        self.frames += 1
        self._change = None  # the next product of two changes is 0
        self.std *= FORGET

    def _by_mean(self, size: FloatArray, expected: float, moving: int) -> float:
        """V, standard deviation by the mean absolute change.

        Args:
            size: (N, M) V, absolute changes since the last frame.
            expected: V, standard deviation that is expected; larger changes are cut off.
            moving: readings that can change.

        """
        most = max(self._step, MOST_CHANGE * expected)
        return float(np.add.reduce(np.minimum(size, most), axis=None)) / (moving * MEAN_CHANGE)

    def _by_autocovariance(self, change: FloatArray, expected: float, moving: int) -> float:
        """V, by this change (N, M) in V and the one before; 0 if that was not kept. Else as :meth:`_by_mean`."""
        if self._change is None:
            return 0.0
        most = max(self._step, MOST_CHANGE * expected)
        covariance = float(np.vdot(_cut(change, most), _cut(self._change, most))) / moving
        return math.sqrt(max(-covariance, 0.0) / AUTOCOVARIANCE)


def _cut(change: FloatArray, most: float) -> FloatArray:
    """As numpy.clip, which takes several times as long on a small array."""
    return np.minimum(np.maximum(change, -most), most)


def _median(size: FloatArray) -> float:
    """V, standard deviation by the median of absolute changes in V."""
    return median(size) / MEDIAN_CHANGE
