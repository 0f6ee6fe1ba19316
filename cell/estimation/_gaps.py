"""Gaps: cells that were not read for a while, and the uncertainty of loads that nobody saw.

While a cell is not read, its load may change: the variance of its pressure grows from that of the last reading to that
of a load of which nothing is known. After the gap the reading is known again, but loads within the gap may have left
the cell with another memory. That doubt fades within :data:`AFTER_GAP_S`.
"""

from __future__ import annotations

import math

import numpy as np

from ...arrays import BoolArray, FloatArray, IntArray
from ._conditions import Conditions

AFTER_GAP, AFTER_GAP_S = 0.3, 10.0
"""fraction of the uncertainty from a gap that remains after the first new reading, and the time in which that falls to
1/e"""
CHANGED_IN_GAP = 0.4
"""share of a pressure's change over a long gap that is in doubt: presses that came and went may have left it behind"""
USUAL_STEPS = 3.0
"""times the usual time between frames, up to which a frame counts as following the last one"""
SMALL = 1e-3
"""of a load of which nothing is known: a smaller standard deviation no longer counts"""


class Gaps:
    """How long each of n cells has not been read, and the variance in kPa^2 that this adds."""

    def __init__(self, cells: int, full_scale_kpa: float, conditions: Conditions) -> None:
        self._unknown_kpa = full_scale_kpa / 2  # standard deviation of a load of which nothing is known
        self._speed_kpa_per_s = conditions.speed_kpa_per_s or full_scale_kpa
        self.unread_s = np.zeros(cells)
        self._left = np.zeros(cells)
        """(n,) kPa^2 that gaps which have ended left behind; it fades"""
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
        """Take a frame that gaps do not :meth:`concern`: what earlier ones left behind fades."""
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
        """Doubt the memory of cells whose gap has just ended: loads that nobody saw may have changed it.

        A reading is the sum of load and memory, both on the same side of rest. So neither is larger than the whole
        reading, and a cell that reads as at rest is at rest.

        Args:
            hidden_kpa: (n,) what :meth:`advance` returned.
            whole_kpa: (n,) pressure at equilibrium for the present reading.
            change_kpa: (n,) by which the pressure differs from that before the gap.
        """
        cells = np.flatnonzero(hidden_kpa > 0)
        hidden = hidden_kpa[cells]
        held = AFTER_GAP * np.minimum(hidden, whole_kpa[cells])
        left_behind = CHANGED_IN_GAP * change_kpa[cells] * (hidden / self._unknown_kpa)
        self.doubt(cells, np.hypot(held, left_behind))

    def doubt(self, cells: IntArray, std_kpa: FloatArray) -> None:
        """Add standard deviations (m,) in kPa for ``cells`` (m,), which fade as those after a gap."""
        self._left[cells] += std_kpa**2
        self.variance = self.variance.copy()
        self.variance[cells] += std_kpa**2
        self._renew()

    def _end_if_small(self) -> None:
        """End doubts that hardly count any more."""
        if self.variance.item(self.variance.argmax()) < (SMALL * self._unknown_kpa) ** 2:
            self._left[:] = 0.0
            self.doubtful = self.open

    def _renew(self) -> None:
        self.open = bool(self.unread_s.any())
        self.doubtful = self.open or bool(self._left.any())

    def state(self) -> dict[str, FloatArray]:
        """What is remembered, by name."""
        return {"unread_s": self.unread_s, "gap_variance": self._left, "gap_shown": self.variance}

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a saved :meth:`state`."""
        self.unread_s, self._left, self.variance = (state[n] for n in ("unread_s", "gap_variance", "gap_shown"))
        self._renew()


def _fade(dt: float) -> float:
    """Fraction of a variance that is left after ``dt``."""
    return math.exp(-2 * dt / AFTER_GAP_S)
