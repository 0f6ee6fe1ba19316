"""Features of a learned estimator: the reading, and how it differs from a bank of memories of it.

The first feature is the last reading as it is, so that a fast press is answered at once. There are two kinds of
memories. Lags hold the reading some seconds ago, smoothed; they tell of creep and recovery. Plays leave a slack of some
width between the reading and its follower; they tell of hysteresis, that is, which way the reading was last going. Both
are cheap, stable for any input, and at zero for a cell that has been read at one value for ever.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..arrays import FloatArray


@dataclass(frozen=True)
class Bank:
    """The memories; a frame of cells of any shape has features (count, *shape)."""

    smoothing_s: float
    """lag of the smoothed reading, which the other memories follow"""
    lags_s: tuple[float, ...]
    plays: tuple[float, ...]
    """half widths of the slacks, as normalised resistance"""
    smoothed: bool = False
    """whether the first feature is the smoothed reading, as earlier versions learned from"""

    @property
    def count(self) -> int:
        """Number of features."""
        return 2 + len(self.lags_s) + len(self.plays)

    @property
    def rows(self) -> int:
        """Number of rows of the memory: the last three readings, the smoothed one, lags, plays."""
        return 4 + len(self.lags_s) + len(self.plays)

    def begin(self, r: FloatArray) -> FloatArray:
        """The memory (rows, *shape) of cells that have always read ``r`` (*shape)."""
        return np.repeat(r[None], self.rows, axis=0)

    def lags(self, memory: FloatArray) -> FloatArray:
        """The smoothed reading and its lags (1 + lags, *shape)."""
        return memory[3 : 4 + len(self.lags_s)]

    def advance(self, memory: FloatArray, dt_s: float, r: FloatArray) -> None:
        """Let the reading go to ``r``; a glitch of one sample is passed over (median of three). Changes ``memory``."""
        before, last = memory[1], memory[2]
        median = np.maximum(np.minimum(before, last), np.minimum(np.maximum(before, last), r))
        memory[0:2] = memory[1:3].copy()
        memory[2] = r
        smooth = memory[3]
        smoothing, gone, width = _constants(self, dt_s, r.ndim)
        smooth += (median - smooth) * smoothing
        lags, plays = self.lags(memory)[1:], memory[4 + len(self.lags_s) :]
        lags += (smooth - lags) * gone
        np.maximum(plays, smooth - width, out=plays)
        np.minimum(plays, smooth + width, out=plays)

    def features(self, memory: FloatArray) -> FloatArray:
        """(count, *shape): the last reading, and its distance from the smoothed one and from each memory.

        The last and the smoothed reading are exchanged where the bank is :attr:`smoothed`.
        """
        last, smooth = memory[2:3], memory[3:4]
        if self.smoothed:
            return np.concatenate([smooth, smooth - last, smooth - memory[4:]])
        return np.concatenate([last, last - memory[3:]])

    def run(self, dt_s: FloatArray, r: FloatArray) -> FloatArray:
        """Features (n, count, *shape) of recordings (n, *shape) that start from a long-held reading."""
        memory = self.begin(r[0])
        found = np.empty((len(r), self.count, *r.shape[1:]))
        found[0] = self.features(memory)
        for n in range(1, len(r)):
            self.advance(memory, float(dt_s[n]), r[n])
            found[n] = self.features(memory)
        return found


def play_follow(signal: FloatArray, width: float) -> FloatArray:
    """A signal (n, m) through a play of half width ``width``: noise narrower than that is held still."""
    followed = np.empty_like(signal)
    last = followed[0] = signal[0]
    for n in range(1, len(signal)):
        last = followed[n] = np.clip(last, signal[n] - width, signal[n] + width)
    return followed


@lru_cache(maxsize=1024)
def _constants(bank: Bank, dt_s: float, dimensions: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Share that the smoothing and the lags forget in a step, and the half widths of the plays, as columns."""
    gone = _gone(dt_s, _column(bank.lags_s, dimensions))
    return _gone(dt_s, bank.smoothing_s), gone, _column(bank.plays, dimensions)


def _gone(dt_s: float, seconds: FloatArray | float) -> FloatArray:
    return np.asarray(-np.expm1(-np.asarray(dt_s) / seconds))


def _column(values: tuple[float, ...], dimensions: int) -> FloatArray:
    return np.array(values, dtype=np.float64).reshape(-1, *(1,) * dimensions)
