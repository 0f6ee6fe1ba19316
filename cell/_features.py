"""What a learned estimator looks at: the reading, and how it differs from a bank of memories of it.

Two kinds of memory: lags (the reading some seconds ago, smoothed: creep, recovery) and plays (a slack of some width
between the reading and its follower: hysteresis, which way it was last going). Both are cheap, stable for any input,
and at zero for a cell that has been read at one value for ever.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray

Memory = dict[str, FloatArray]


@dataclass(frozen=True)
class Bank:
    """The memories; a frame of cells of any shape has features (count, *shape)."""

    smoothing_s: float
    """lag of the reading itself, against noise"""
    lags_s: tuple[float, ...]
    plays: tuple[float, ...]
    """half widths of the slacks, as normalised resistance"""

    @property
    def count(self) -> int:
        """Number of features."""
        return 2 + len(self.lags_s) + len(self.plays)

    def begin(self, r: FloatArray) -> Memory:
        """The memory of cells that have always read ``r``."""
        return {
            "recent": np.stack([r, r, r]),
            "smooth": r.copy(),
            "lags": np.repeat(r[None], len(self.lags_s), axis=0),
            "plays": np.repeat(r[None], len(self.plays), axis=0),
        }

    def advance(self, memory: Memory, dt_s: FloatArray | float, r: FloatArray) -> Memory:
        """The memory after the reading went to ``r``; a glitch of one sample is passed over (median of three)."""
        _, before, last = memory["recent"]
        median = np.maximum(np.minimum(before, last), np.minimum(np.maximum(before, last), r))
        smooth = memory["smooth"] + (median - memory["smooth"]) * _gone(dt_s, self.smoothing_s)
        constants = _column(self.lags_s, r.ndim)
        width = _column(self.plays, r.ndim)
        return {
            "recent": np.stack([before, last, r]),
            "smooth": smooth,
            "lags": memory["lags"] + (smooth - memory["lags"]) * _gone(dt_s, constants),
            "plays": np.clip(memory["plays"], smooth - width, smooth + width),
        }

    def features(self, memory: Memory) -> FloatArray:
        """(count, *shape): the smoothed reading, its distance from the last raw one, and from each memory."""
        smooth = memory["smooth"]
        newest = memory["recent"][-1:]
        return np.concatenate([smooth[None], smooth - newest, smooth - memory["lags"], smooth - memory["plays"]])

    def run(self, dt_s: FloatArray, r: FloatArray) -> FloatArray:
        """Features (n, count, *shape) of recordings (n, *shape) that start from a long-held reading."""
        memory = self.begin(r[0])
        found = np.empty((len(r), self.count, *r.shape[1:]))
        found[0] = self.features(memory)
        for n in range(1, len(r)):
            memory = self.advance(memory, float(dt_s[n]), r[n])
            found[n] = self.features(memory)
        return found


def play_follow(signal: FloatArray, width: float) -> FloatArray:
    """A signal (n, m) through a play of half width ``width``: noise narrower than that is held still."""
    followed = np.empty_like(signal)
    last = followed[0] = signal[0]
    for n in range(1, len(signal)):
        last = followed[n] = np.clip(last, signal[n] - width, signal[n] + width)
    return followed


def _gone(dt_s: FloatArray | float, seconds: FloatArray | float) -> FloatArray:
    return np.asarray(-np.expm1(-np.asarray(dt_s) / seconds))


def _column(values: tuple[float, ...], dimensions: int) -> FloatArray:
    return np.array(values, dtype=np.float64).reshape(-1, *(1,) * dimensions)
