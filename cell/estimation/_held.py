"""Uncertainty by creep under loads that are held for longer than any load of the calibration recording."""

from __future__ import annotations

import numpy as np

from ...common.arrays import FloatArray

LOADED = 0.05
"""fraction of full scale above which a cell counts as loaded"""
COUNTS_OFF = 3.0
"""seconds of load that one second without load subtracts"""
LOOK_S = 1.0
"""seconds between two evaluations of the pressures"""
PER_DECADE = 0.2
"""standard deviation of the unknown creep over the load, per decade of time beyond the recording. Simulated specimens
of relays with fractional creep read 0.1 to 0.3 too much; few materials creep more"""


def longest_s(time_s: FloatArray, load: FloatArray) -> float:
    """Longest time that a cell was loaded in a recording (n,); time without load is subtracted as in :class:`Held`."""
    step_s = np.diff(time_s, prepend=time_s[0])
    walk = np.cumsum(np.where(load > LOADED, step_s, -COUNTS_OFF * step_s))
    return float(np.max(walk - np.minimum(np.minimum.accumulate(walk), 0.0)))


class Held:
    """Time for which each of n cells has been loaded, its mean load over that time, and the variance by creep.

    A cell under load creeps for longer than any recording lasts, and an estimator takes the further creep for load.
    Time without load is subtracted :data:`COUNTS_OFF` times as fast, so that short pauses do not end a long load.
    """

    def __init__(self, cells: int, full_scale_kpa: float, recorded_s: float) -> None:
        """``recorded_s``: longest time under load in the calibration; 0: unknown, and no variance is added."""
        self._loaded_kpa, self._recorded_s = LOADED * full_scale_kpa, recorded_s
        self._since_s = 0.0
        self._time_s, self._mean_kpa = np.zeros((2, cells))
        self.variance: FloatArray | None = None
        """(n,) kPa^2, replaced and never changed; None: zero"""

    def advance(self, dt_s: float, pressure_kpa: FloatArray) -> None:
        """Take the pressures (n,) of a frame, ``dt_s`` after the last one; NaN before a cell was read."""
        self._since_s += dt_s
        if self._since_s < LOOK_S or not self._recorded_s:
            return
        loaded = pressure_kpa > self._loaded_kpa
        self._time_s += np.where(loaded, self._since_s, -COUNTS_OFF * self._since_s)
        np.maximum(self._time_s, 0.0, out=self._time_s)
        share = self._since_s / np.maximum(self._time_s, self._since_s)
        self._mean_kpa += np.where(loaded, share * (pressure_kpa - self._mean_kpa), 0.0)
        self._since_s = 0.0
        self._renew()

    def _renew(self) -> None:
        beyond = self._time_s > self._recorded_s
        if not (self._recorded_s and beyond.any()):
            self.variance = None
            return
        decades = np.log10(np.where(beyond, self._time_s / self._recorded_s, 1.0))
        self.variance = (PER_DECADE * decades * self._mean_kpa) ** 2

    def state(self) -> dict[str, FloatArray]:
        """The state, by name."""
        return {"held_s": self._time_s, "held_kpa": self._mean_kpa, "held_since": np.array([self._since_s])}

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a saved :meth:`state`."""
        self._time_s, self._mean_kpa = state["held_s"], state["held_kpa"]
        self._since_s = float(state["held_since"][0])
        self._renew()
