"""What kinds of cells are fitted to: a recording, normalised, on a uniform and thinned grid of times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray
from ._folds import Fold, pressing
from ._recording import Recording

POINTS, POINTS_BEFORE_FOLDS = 2000, 1000
"""samples that enter the least squares, of the whole and of a fold with what comes before it; more are thinned"""
TAUGHT = 1.2
"""full presses before a fold from which on it tells how well a kind describes the cell, and not how little it needs"""
SEEN_AT_REST, NEVER_AT_REST = 0.15, 0.7
"""share by which the true R0 may be below what was read before the first press, or below the least reading"""


@dataclass(frozen=True)
class Grid:
    """A recording on a uniform, thinned time grid, normalised."""

    dt_s: float
    load: FloatArray
    r: FloatArray
    fitted: int
    """samples that count in the fit; the ones after it are predicted"""


@dataclass(frozen=True)
class Task:
    """What every kind is fitted to."""

    recording: Recording
    full_scale_kpa: float
    rest_ohm: float
    lower: float
    """share by which R0 may be below ``rest_ohm``"""
    folds: tuple[Fold, ...]

    @property
    def first_telling(self) -> int:
        """The first fold that :data:`TAUGHT` presses precede, or the last one."""
        before = np.interp(
            [fold.start_s for fold in self.folds],
            self.recording.time_s,
            pressing(self.recording, self.full_scale_kpa) / 2,
        )
        return min(int(np.count_nonzero(before < TAUGHT)), len(self.folds) - 1)

    def grid(self, until_s: float, end_s: float) -> Grid:
        """The recording before ``end_s``, of which the part before ``until_s`` counts as fitted."""
        recording = self.recording
        time = recording.time_s
        last = min(end_s, float(time[-1]))
        points = POINTS if until_s >= time[-1] else POINTS_BEFORE_FOLDS
        dt = max(recording.step_s, (last - time[0]) / points)
        at = np.arange(time[0], last + 1e-9 * dt, dt)
        quiet = recording.quiet
        load, r = quiet.pressure_kpa / self.full_scale_kpa, quiet.resistance_ohm / self.rest_ohm - 1
        fitted = int(np.searchsorted(at, until_s))
        return Grid(dt, np.interp(at, time, load), np.interp(at, time, r), max(2, min(fitted, len(at))))


def rest_resistance(recording: Recording, full_scale_kpa: float) -> tuple[float, float]:
    """R0, and by which share of it the truth may be lower.

    The median before the first press, if that lasts a second; else the lowest resistance while hardly loaded, and
    then the cell may never have been seen at rest.
    """
    pressure = np.abs(recording.quiet.pressure_kpa)
    pressed = np.flatnonzero(pressure > 0.03 * full_scale_kpa)
    first = int(pressed[0]) if pressed.size else len(pressure)
    if first > 2 and recording.time_s[first] - recording.time_s[0] >= 1.0:
        return float(np.median(recording.resistance_ohm[:first])), SEEN_AT_REST
    light = pressure <= max(0.05 * full_scale_kpa, float(np.quantile(pressure, 0.02)))
    return float(np.min(recording.resistance_ohm[light])), NEVER_AT_REST
