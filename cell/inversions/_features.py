"""Features of a learned estimator: the reading, and how it differs from a bank of memories of it.

The first feature is the last reading as it is, so that a fast press is answered at once. There are three kinds of
memories. Lags hold the reading some seconds ago, smoothed; they tell of creep and recovery. Plays leave a slack of some
width between the reading and its follower; they tell of hysteresis, that is, which way the reading was last going.
Paths add up how far the reading has moved, either way, and fade; they tell how many conductive chains motion broke. All
are cheap, stable for any input, and at zero for a cell that has been read at one value for ever.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ...arrays import FloatArray

_FOLLOWED = 1
"""the play whose movement is the path"""


@dataclass(frozen=True)
class Bank:
    """The memories; a frame of cells of any shape has features (count, *shape)."""

    smoothing_s: float
    """lag of the smoothed reading, which the other memories follow"""
    lags_s: tuple[float, ...]
    plays: tuple[float, ...]
    """half widths of the slacks, as normalised resistance"""
    paths_s: tuple[float, ...] = ()
    """times in which the path length of the follower behind the narrowest slack but one fades; narrower ones follow
    noise, too"""
    smoothed: bool = False
    """whether the first feature is the smoothed reading, as earlier versions learned from"""

    @property
    def count(self) -> int:
        """Number of features."""
        return 2 + len(self.lags_s) + len(self.plays) + len(self.paths_s)

    @property
    def rows(self) -> int:
        """Number of rows of the memory: the last three readings, the smoothed one, lags, plays, paths."""
        return 4 + len(self.lags_s) + len(self.plays) + len(self.paths_s)

    def begin(self, r: FloatArray) -> FloatArray:
        """The memory (rows, *shape) of cells that have always read ``r`` (*shape)."""
        memory = np.repeat(r[None], self.rows, axis=0)
        self.paths(memory)[:] = 0.0
        return memory

    def lags(self, memory: FloatArray) -> FloatArray:
        """The smoothed reading and its lags (1 + lags, *shape)."""
        return memory[3 : 4 + len(self.lags_s)]

    def paths(self, memory: FloatArray) -> FloatArray:
        """The path lengths (paths, *shape)."""
        return memory[self.rows - len(self.paths_s) :]

    def advance(self, memory: FloatArray, dt_s: float, r: FloatArray) -> None:
        """Let the reading go to ``r``; a glitch of one sample is passed over (median of three). Changes ``memory``."""
        before, last = memory[1], memory[2]
        median = np.maximum(np.minimum(before, last), np.minimum(np.maximum(before, last), r))
        memory[0:2] = memory[1:3].copy()
        memory[2] = r
        smooth = memory[3]
        constants = _constants(self, dt_s, r.ndim)
        smooth += (median - smooth) * constants.smoothing
        lags, paths = self.lags(memory)[1:], self.paths(memory)
        plays = memory[4 + len(self.lags_s) : self.rows - len(self.paths_s)]
        lags += (smooth - lags) * constants.gone
        followed = plays[_FOLLOWED].copy() if self.paths_s else None
        np.maximum(plays, smooth - constants.width, out=plays)
        np.minimum(plays, smooth + constants.width, out=plays)
        if followed is not None:
            paths *= constants.kept
            paths += np.abs(plays[_FOLLOWED] - followed)

    def features(self, memory: FloatArray) -> FloatArray:
        """(count, *shape): the last reading, its distance from the smoothed one, each lag and each play, and the paths.

        The last and the smoothed reading are exchanged where the bank is :attr:`smoothed`.
        """
        last, smooth = memory[2:3], memory[3:4]
        held, paths = memory[4 : self.rows - len(self.paths_s)], self.paths(memory)
        if self.smoothed:
            return np.concatenate([smooth, smooth - last, smooth - held, paths])
        return np.concatenate([last, last - smooth, last - held, paths])

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


class _Constants(NamedTuple):
    """Of a bank and a time step, as columns."""

    smoothing: FloatArray
    """share that the smoothed reading forgets in a step"""
    gone: FloatArray
    """share that the lags forget"""
    width: FloatArray
    """half widths of the plays"""
    kept: FloatArray
    """share that the paths keep"""


@lru_cache(maxsize=1024)
def _constants(bank: Bank, dt_s: float, dimensions: int) -> _Constants:
    return _Constants(
        smoothing=_gone(dt_s, bank.smoothing_s),
        gone=_gone(dt_s, _column(bank.lags_s, dimensions)),
        width=_column(bank.plays, dimensions),
        kept=1 - _gone(dt_s, _column(bank.paths_s, dimensions)),
    )


def _gone(dt_s: float, seconds: FloatArray | float) -> FloatArray:
    return np.asarray(-np.expm1(-np.asarray(dt_s) / seconds))


def _column(values: tuple[float, ...], dimensions: int) -> FloatArray:
    return np.array(values, dtype=np.float64).reshape(-1, *(1,) * dimensions)
