"""Noise of readings, measured from frame to frame while the skin may be pressed.

Two estimates of the standard deviation s are made, both from changes of readings between successive frames:

* the mean absolute change, of which noise makes 1.13 s. A press enlarges the changes of the readings it reaches;
* the lag-one autocovariance of the changes, -s^2 for noise. A press that lasts for more than a frame moves a reading in
  one direction, or once, and adds nothing to it.

Changes count up to 1.5 s, so cells that are pressed weigh little in the first estimate: 30 % of them raise it by 60 %.
That is enough where a press changes its own readings only. On a board whose readings share their current a finger moves
all of them; there the smaller estimate of the two counts, which notices a growing noise one frame later.
"""

from __future__ import annotations

import math

import numpy as np

from ..arrays import FloatArray

FORGET = 0.95
"""share of a noise that is still assumed a frame later"""
MOST_CHANGE = 1.5
"""standard deviations of a reading up to which its change counts"""
MEAN_CHANGE, AUTOCOVARIANCE = 0.918, 0.516
"""of normally distributed readings, changes cut off so: mean change in their s, and minus the autocovariance in s^2"""
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
        self._change: FloatArray | None = None  # V, cut off, from the last frame but one to the last
        self._ones = np.ones(0)
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
        most = max(self._step, MOST_CHANGE * self.std)
        np.clip(change, -most, most, out=change)
        if self._ones.shape != change.shape:
            self._ones = np.ones(change.shape)
        moving = max(change.size - silent, 1)  # readings at a limit do not move
        fresh = float(np.vdot(np.abs(change), self._ones)) / (moving * MEAN_CHANGE)
        if self._shared:
            if self._change is not None:
                covariance = float(np.vdot(change, self._change)) / moving
                fresh = min(fresh, math.sqrt(max(-covariance, 0.0) / AUTOCOVARIANCE))
            elif self.frames > 2:  # the change before is not known
                fresh = 0.0
            self._change = change
        if self.frames == 2:  # a sample of few cells may be smaller than its deviation
            self.std = fresh * (1.0 + CAUTION / math.sqrt(moving))
        else:
            self.std = max(FORGET * self.std, fresh)
