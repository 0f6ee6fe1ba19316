"""Rolling-origin cross-validation: folds of a recording. Models are fitted before each fold, and tested on the fold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...common.arrays import FloatArray
from ...errors import InputError
from ..inversions import play_follow
from ._recording import Recording

FIRST, TAUGHT, MOST_FOLDS = 0.45, 2.0, 3
"""the first fold begins when this fraction of the load's total path length (:func:`pressing`) is done, and that many
usual presses; and the largest number of folds. With fewer presses before it, the error on a fold shows how little data
a model needs, and not how well it describes the cell"""
WHOLE = 0.9
"""least path length of a fold, in presses. A part of a press may suit a model that misses the rest of it"""
PRESSED = 0.05
"""half width, over full scale, of the play operator that removes noise from the load"""
HEIGHTS_DIFFER, DURATIONS_DIFFER = 0.2, 0.35
"""interquartile ranges above which strokes differ: of their heights, over the median; and of the logarithm of their
durations. Quartiles ignore a single stroke that is cut off"""
FEWEST = 30
"""least number of readings before a fold for a fit"""


@dataclass(frozen=True)
class Fold:
    """A test part of a recording, in seconds of its time; models are fitted to the part before it."""

    start_s: float
    end_s: float


@dataclass(frozen=True)
class Strokes:
    """Strokes of a recorded load, each from one turning point to the next. Arrays are (n,)."""

    height: FloatArray
    """change of the normalised load; falls, too, count as positive"""
    seconds: FloatArray

    @property
    def press(self) -> float:
        """Path of the normalised load in a usual press: a rise and a fall; 0 without any."""
        return 2 * float(np.median(self.height)) if self.height.size else 0.0

    @property
    def short_s(self) -> float:
        """Lower quartile of the durations of strokes that are at least half as high as usual; 0 without any."""
        usual = self.seconds[self.height > 0.25 * self.press]
        return float(np.quantile(usual, 0.25)) if usual.size else 0.0

    @property
    def vary(self) -> bool:
        """Whether strokes differ clearly, both in height and in duration."""
        if not self.height.size:
            return False
        heights = _interquartile(self.height) > HEIGHTS_DIFFER * float(np.median(self.height))
        return heights and _interquartile(np.log(self.seconds)) > DURATIONS_DIFFER


def _interquartile(values: FloatArray) -> float:
    low, high = np.percentile(values, [25, 75])
    return float(high - low)


def _followed(pressure_kpa: FloatArray, full_scale_kpa: float) -> FloatArray:
    """(n,) the normalised load after Prandtl's play operator of half width :data:`PRESSED`, which removes noise."""
    followed: FloatArray = play_follow(pressure_kpa[:, None] / full_scale_kpa, PRESSED)[:, 0]
    return followed


def strokes(recording: Recording, full_scale_kpa: float) -> Strokes:
    """The strokes of a recorded load, between turning points after a play of :data:`PRESSED`."""
    loads = recording.quiet.loads
    followed = _followed(loads.pressure_kpa, full_scale_kpa)
    moves = np.flatnonzero(np.diff(followed))
    ways = np.sign(np.diff(followed))[moves]
    turns = moves[np.flatnonzero(np.diff(ways)) + 1]  # samples at which the load reverses
    ends = np.concatenate([moves[:1], turns, moves[-1:] + 1])
    return Strokes(np.abs(np.diff(followed[ends])), np.diff(loads.time_s[ends]))


def pressing(recording: Recording, full_scale_kpa: float) -> FloatArray:
    """(n,) path length of the normalised load up to each sample: a press to full scale and its release add 2.

    The path is that of the load after a play of :data:`PRESSED`, so that noise does not add to it.
    """
    followed = _followed(recording.quiet.pressure_kpa, full_scale_kpa)
    path: FloatArray = np.cumsum(np.abs(np.diff(followed, prepend=followed[0])))
    return path


def folds(recording: Recording, full_scale_kpa: float) -> tuple[Fold, ...]:
    """Consecutive folds with equal path lengths of the load (:func:`pressing`), however long the rests between presses.

    Each holds a whole press, and follows on presses to learn from (:data:`TAUGHT`). A recording of few presses has
    fewer folds than :data:`MOST_FOLDS`, and one of fewer than three has none.

    Raises:
        InputError: there are hardly any readings before the first fold, or gaps take up most of the recording.
    """
    moved = pressing(recording, full_scale_kpa)
    moved += 1e-9 * np.arange(len(moved))
    press = strokes(recording, full_scale_kpa).press
    first = max(FIRST * moved[-1], TAUGHT * press)
    count = min(int((moved[-1] - first) / (WHOLE * press)), MOST_FOLDS) if press > 0 else 0
    at = np.searchsorted(moved, np.linspace(first, moved[-1], max(count, 0), endpoint=False)).clip(1, len(moved) - 1)
    time = recording.time_s
    step = recording.step_s
    starts = time[at]
    ends = np.append(starts[1:], time[-1] + step)
    found = tuple(Fold(float(a), float(b)) for a, b in zip(starts, ends, strict=False) if b > a)
    expected = (time[-1] - time[0]) / step
    before = int(np.count_nonzero(time < found[0].start_s)) if found else len(time)
    longest = float(np.diff(time).max())
    if before < FEWEST or longest > 0.5 * (time[-1] - time[0]) or len(time) < 0.1 * expected:
        raise InputError(
            f"{recording.name}: {before} of {len(time)} readings come before the last half of its presses, and the "
            f"longest gap is {longest:.3g} s of {time[-1] - time[0]:.3g} s; expected presses throughout the recording, "
            "without a gap that takes up most of it"
        )
    return found
