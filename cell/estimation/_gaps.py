"""Gaps in the readings: the uncertainty while a cell is not read, and afterwards.

While a cell is not read, its load may change. The variance of its pressure grows from that of the last reading towards
that of an unknown load. After the gap the reading is known again, but unseen loads within the gap may have changed the
memory of the cell. This second uncertainty falls to 1/e within :data:`AFTER_GAP_S`. So does that of a memory that has
followed the least load of an interval.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ._conditions import Conditions

AFTER_GAP, AFTER_GAP_S = 0.3, 10.0
"""fraction of the uncertainty from a gap that remains after the first new reading, and the time in which that falls to
1/e"""
AFTER_INTERVAL = 0.7
"""fraction of the standard deviation of a load of which an interval was known that remains after it, and falls as
quickly. Paper cells whose load has been followed at the wrong height show 0.6 to 0.8 of that error after the release"""
CHANGED_IN_GAP = 0.4
"""standard deviation after a long gap over the change of pressure across it: presses that came and went in the gap may
have left that change behind"""
USUAL_STEPS = 3.0
"""multiple of the usual time between frames; a longer pause is a gap"""
SMALL = 1e-3
"""fraction of the standard deviation of an unknown load, below which the doubt is set to zero"""


class Gaps:
    """Time for which each of n cells has not been read, and the variance in kPa^2 that gaps add."""

    def __init__(self, cells: int, full_scale_kpa: float, conditions: Conditions) -> None:
        self._unknown_kpa = full_scale_kpa / 2  # standard deviation of an unknown load
        self._speed_kpa_per_s = conditions.speed_kpa_per_s or full_scale_kpa
        self.unread_s = np.zeros(cells)
        self._left = np.zeros(cells)
        """(n,) kPa^2 that remain from gaps which have ended; decays"""
        self.variance = np.zeros(cells)
        """(n,) kPa^2, replaced and never changed"""
        self.open = False
        """whether a cell was not read in the last frame"""
        self.doubtful = False
        """whether the variance is not zero"""

    def concern(self, dt: float, usual_s: float, known: BoolArray | None) -> bool:
        """Whether a frame ``dt`` after the last one lies within a gap of some cell, or ends one.

        Args:
            dt: seconds since the last frame.
            usual_s: usual time between frames.
            known: (n,) the cells that the frame has read; None: all.
        """
        return known is not None or self.open or dt > USUAL_STEPS * usual_s

    def pass_by(self, dt: float) -> None:
        """Take a frame that gaps do not :meth:`concern`: the variance from earlier gaps decays."""
        if self.doubtful:
            self._left *= _fade(dt)
            self.variance = self._left.copy()
            self._end_if_small()

    def advance(self, dt: float, usual_s: float, known: BoolArray | None) -> FloatArray:
        """Take a frame that gaps :meth:`concern`, with the same arguments.

        Returns:
            (n,) kPa by which a load may have changed in the gap that this frame ends; 0 for cells without one.
        """
        self._left *= _fade(dt)
        self.unread_s += dt
        gap = np.maximum(self.unread_s - usual_s, 0.0)
        hidden = -self._unknown_kpa * np.expm1(-self._speed_kpa_per_s * gap / self._unknown_kpa)
        read: BoolArray | slice = slice(None) if known is None else known
        ended = np.zeros(len(hidden))
        ended[read] = hidden[read]
        hidden[read] = 0.0
        self.unread_s[read] = 0.0
        self.variance = self._left + hidden**2
        self._renew()
        if self.doubtful:
            self._end_if_small()
        return ended

    def doubt_memory(self, hidden_kpa: FloatArray, whole_kpa: FloatArray, change_kpa: FloatArray) -> None:
        """Add uncertainty to cells whose gap has just ended: unseen loads may have changed their memory.

        A reading is the sum of load and memory, both on the same side of rest. Hence neither is larger than the
        reading, and a cell that reads as at rest is at rest.

        Args:
            hidden_kpa: (n,) what :meth:`advance` returned.
            whole_kpa: (n,) pressure at equilibrium for the present reading.
            change_kpa: (n,) absolute change of the pressure across the gap.
        """
        cells = np.flatnonzero(hidden_kpa > 0)
        hidden = hidden_kpa[cells]
        held = AFTER_GAP * np.minimum(hidden, whole_kpa[cells])
        left_behind = CHANGED_IN_GAP * change_kpa[cells] * (hidden / self._unknown_kpa)
        self.doubt(cells, np.hypot(held, left_behind))

    def doubt_within(self, variance: FloatArray) -> None:
        """Take a frame that limits loads to intervals, with (n,) kPa^2: memories have followed a wrong load."""
        np.maximum(self._left, AFTER_INTERVAL**2 * variance, out=self._left)
        self._renew()

    def doubt(self, cells: IntArray, std_kpa: FloatArray) -> None:
        """Add standard deviations (m,) in kPa to ``cells`` (m,); they decay as those after a gap."""
        self._left[cells] += std_kpa**2
        self.variance = self.variance.copy()
        self.variance[cells] += std_kpa**2
        self._renew()

    def _end_if_small(self) -> None:
        """Set the variances to zero once all of them are negligible."""
        if self.variance.item(self.variance.argmax()) < (SMALL * self._unknown_kpa) ** 2:
            self._left[:] = 0.0
            self.doubtful = self.open

    def _renew(self) -> None:
        self.open = bool(self.unread_s.any())
        self.doubtful = self.open or bool(self._left.any())

    def state(self) -> dict[str, FloatArray]:
        """The state, by name."""
        return {"unread_s": self.unread_s, "gap_variance": self._left, "gap_shown": self.variance}

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a saved :meth:`state`."""
        self.unread_s, self._left, self.variance = (state[n] for n in ("unread_s", "gap_variance", "gap_shown"))
        self._renew()


def _fade(dt: float) -> float:
    """Fraction of a variance that remains after ``dt`` seconds."""
    return math.exp(-2 * dt / AFTER_GAP_S)
