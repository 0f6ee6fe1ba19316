"""Features of a learned estimator: the reading, and a bank of lags, plays (backlash) and path lengths.

The first feature is the last reading as it is, so that a fast press is answered at once. There are three kinds of
memories:

- Lags are low-pass filters of the reading; they tell of creep and recovery.
- Plays follow the reading with a backlash of some width (play operators); they tell of hysteresis, that is, in which
  direction the reading last moved.
- Paths sum up how far the reading has moved, up or down, and fade; they tell how many conductive chains motion broke.

All are cheap and stable for any input. Their features are zero for a cell that has had one reading for ever.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from ...common.arrays import FloatArray
from ...common.compiled import Row, Rows, loop

_FOLLOWED = 1
"""index of the play whose motion the paths sum up: the second narrowest, since the narrowest one follows noise, too"""


@dataclass(frozen=True)
class Bank:
    """The memories of m cells are an array (m, rows), their features one (m, count)."""

    smoothing_s: float
    """time constant in seconds of the smoothed reading, which the other memories follow"""
    lags_s: tuple[float, ...]
    plays: tuple[float, ...]
    """half widths of the plays, as normalised resistance"""
    paths_s: tuple[float, ...] = ()
    """time constants with which path lengths fade"""

    @cached_property
    def count(self) -> int:
        """Number of features: the last reading, its distance from the smoothed one, each lag and play; the paths."""
        return 2 + len(self.lags_s) + len(self.plays) + len(self.paths_s)

    @cached_property
    def rows(self) -> int:
        """Numbers remembered of a cell: the last three readings, the smoothed one, lags, plays, paths."""
        return 2 + self.count

    def begin(self, r: FloatArray) -> FloatArray:
        """The memory of cells that have always read ``r`` (m,)."""
        memory = np.repeat(r[:, None], self.rows, axis=1)
        memory[:, self.rows - len(self.paths_s) :] = 0.0
        return memory

    def unrest(self, memory: FloatArray) -> FloatArray:
        """(m,) the largest of the smoothed reading, its lags, and the paths."""
        lags, paths = memory[:, 3 : 4 + len(self.lags_s)], memory[:, self.rows - len(self.paths_s) :]
        found: FloatArray = np.abs(np.concatenate([lags, paths], axis=1)).max(axis=1)
        return found

    def advance(self, memory: FloatArray, dt_s: float, r: FloatArray) -> FloatArray:
        """Take readings ``r`` (m,), changing ``memory``; returns the features."""
        return self._taken(memory, [dt_s], r[None])

    def run(self, dt_s: FloatArray, r: FloatArray) -> FloatArray:
        """Features (n, m, count) of recordings (n, m) that start from a long-held reading."""
        steps = [1.0, *dt_s[1:].tolist()]  # the first reading changes nothing
        return self._taken(self.begin(r[0]), steps, r).reshape(*r.shape, self.count)

    def _taken(self, memory: FloatArray, dt_s: list[float], r: FloatArray) -> FloatArray:
        weights = np.concatenate([_weights(self, dt) for dt in dt_s])
        found = np.empty((r.size, self.count))
        take.unchecked(
            *(np.ascontiguousarray(r), weights, np.array(self.plays), len(self.lags_s), len(self.paths_s)),
            *(memory, found),
        )
        return found


@loop
def take(r: Rows, weights: Rows, width: Row, lags: int, paths: int, memory: Rows, found: Rows) -> None:
    """Take readings ``r`` (n, m) into the ``memory``; writes features to ``found`` (n m, count).

    ``weights`` (n, 1 + lags + paths) are the shares that the smoothed reading and the lags forget in each step, and
    that the paths keep. A median of three skips a glitch of one sample.
    """
    samples, cells, plays = r.shape[0], r.shape[1], width.size
    first_play = 4 + lags
    first_path = first_play + plays
    for n in range(samples):
        for i in range(cells):
            before, last, now = memory[i, 1], memory[i, 2], r[n, i]
            median = max(min(before, last), min(max(before, last), now))
            memory[i, 0], memory[i, 1], memory[i, 2] = before, last, now
            smooth = memory[i, 3] + (median - memory[i, 3]) * weights[n, 0]
            memory[i, 3] = smooth
            for j in range(lags):
                memory[i, 4 + j] += (smooth - memory[i, 4 + j]) * weights[n, 1 + j]
            followed = memory[i, first_play + _FOLLOWED] if paths else 0.0
            for j in range(plays):
                memory[i, first_play + j] = min(max(memory[i, first_play + j], smooth - width[j]), smooth + width[j])
            moved = abs(memory[i, first_play + _FOLLOWED] - followed) if paths else 0.0
            for j in range(paths):
                memory[i, first_path + j] = memory[i, first_path + j] * weights[n, 1 + lags + j] + moved
            row = n * cells + i
            found[row, 0], found[row, 1] = now, now - smooth
            for j in range(lags + plays):
                found[row, 2 + j] = now - memory[i, 4 + j]
            for j in range(paths):
                found[row, 2 + lags + plays + j] = memory[i, first_path + j]


@lru_cache(maxsize=1024)
def _weights(bank: Bank, dt_s: float) -> FloatArray:
    """(1, 1 + lags + paths) as :func:`take` needs them."""
    forgets = -np.expm1(-dt_s / np.array([bank.smoothing_s, *bank.lags_s, *bank.paths_s]))
    forgets[1 + len(bank.lags_s) :] = 1.0 - forgets[1 + len(bank.lags_s) :]
    return forgets[None]


def play_follow(signal: FloatArray, width: float) -> FloatArray:
    """A signal (n, m) through a play of half width ``width``: noise narrower than that is held still."""
    followed = np.ascontiguousarray(signal).copy()
    follow.unchecked(followed, width)
    return followed


@loop
def follow(signal: Rows, width: float) -> None:
    """:func:`play_follow` in place."""
    for n in range(1, signal.shape[0]):
        for i in range(signal.shape[1]):
            last = signal[n - 1, i]
            signal[n, i] = min(max(last, signal[n, i] - width), signal[n, i] + width)
