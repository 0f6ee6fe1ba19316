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
from typing import NamedTuple

import numpy as np

from ...common.arrays import FloatArray
from ...common.compiled import Row, Rows, SpacedRows, loop

_FOLLOWED = 1
"""index of the play whose motion the paths sum up"""


@dataclass(frozen=True)
class Bank:
    """The memories; a frame of cells of any shape has features (count, *shape)."""

    smoothing_s: float
    """time constant in seconds of the smoothed reading, which the other memories follow"""
    lags_s: tuple[float, ...]
    plays: tuple[float, ...]
    """half widths of the plays, as normalised resistance"""
    paths_s: tuple[float, ...] = ()
    """time constants with which path lengths fade; the path is that of the second narrowest play, since the narrowest
    one follows noise, too"""
    smoothed: bool = False
    """whether the first feature is the smoothed reading, as in earlier versions"""

    @cached_property
    def count(self) -> int:
        """Number of features."""
        return 2 + len(self.lags_s) + len(self.plays) + len(self.paths_s)

    @cached_property
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
        """Take the reading ``r``; a median of three skips a glitch of one sample. Changes ``memory``."""
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
        compiled = _run_each.machine_code()
        if compiled is None:
            for n in range(1, len(r)):
                self.advance(memory, float(dt_s[n]), r[n])
                found[n] = self.features(memory)
        else:
            of_steps = [_constants(self, dt, 0) for dt in dt_s[1:].tolist()]
            compiled(
                np.ascontiguousarray(r.reshape(len(r), -1)),
                np.array([float(step.smoothing) for step in of_steps]),
                _table([step.gone for step in of_steps], len(self.lags_s)),
                np.array(self.plays),
                _table([step.kept for step in of_steps], len(self.paths_s)),
                self.smoothed,
                memory.reshape(self.rows, -1),
                found.reshape(len(r) * self.count, -1),
            )
        return found


@loop
def _run_each(
    r: Rows, smoothing: Row, gone: Rows, width: Row, kept: Rows, smoothed: bool, memory: SpacedRows, found: Rows
) -> None:
    """:meth:`Bank.advance` and :meth:`Bank.features` for all readings ``r`` (n, m) but the first, cell by cell.

    Args:
        r: readings.
        smoothing: (n - 1,) share that the smoothed reading forgets in each step.
        gone: (n - 1, lags) share that the lags forget.
        width: (plays,) half widths of the plays.
        kept: (n - 1, paths) share that the paths keep.
        smoothed: :attr:`Bank.smoothed`.
        memory: (rows, m) is changed.
        found: (n count, m) written to from the second reading on.
    """
    samples, cells = r.shape
    lags, plays, paths = gone.shape[1], width.shape[0], kept.shape[1]
    count, first_play = 2 + lags + plays + paths, 4 + lags
    first_path = first_play + plays
    for n in range(1, samples):
        for i in range(cells):
            before, last, now = memory[1, i], memory[2, i], r[n, i]
            median = np.maximum(np.minimum(before, last), np.minimum(np.maximum(before, last), now))
            memory[0, i], memory[1, i], memory[2, i] = before, last, now
            smooth = memory[3, i] + (median - memory[3, i]) * smoothing[n - 1]
            memory[3, i] = smooth
            for j in range(lags):
                memory[4 + j, i] += (smooth - memory[4 + j, i]) * gone[n - 1, j]
            followed = memory[first_play + _FOLLOWED, i] if paths else 0.0
            for j in range(plays):
                play = np.maximum(memory[first_play + j, i], smooth - width[j])
                memory[first_play + j, i] = np.minimum(play, smooth + width[j])
            moved = abs(memory[first_play + _FOLLOWED, i] - followed) if paths else 0.0
            for j in range(paths):
                memory[first_path + j, i] = memory[first_path + j, i] * kept[n - 1, j] + moved
            at = n * count
            head, other = (smooth, now) if smoothed else (now, smooth)
            found[at, i], found[at + 1, i] = head, head - other
            for j in range(lags + plays):
                found[at + 2 + j, i] = head - memory[4 + j, i]
            for j in range(paths):
                found[at + count - paths + j, i] = memory[first_path + j, i]


def play_follow(signal: FloatArray, width: float) -> FloatArray:
    """A signal (n, m) through a play of half width ``width``: noise narrower than that is held still."""
    columns = []
    for column in signal.T.tolist():  # plain numbers are ten times as fast as operations on a few
        last, followed = column[0], []
        for value in column:
            last = min(max(last, value - width), value + width)
            followed.append(last)
        columns.append(followed)
    return np.ascontiguousarray(np.array(columns).T)


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


def _table(rows: list[FloatArray], columns: int) -> FloatArray:
    """Rows as an array (rows, columns), even without rows or columns."""
    return np.array(rows, dtype=np.float64).reshape(len(rows), columns)


def _gone(dt_s: float, seconds: FloatArray | float) -> FloatArray:
    return np.asarray(-np.expm1(-np.asarray(dt_s) / seconds))


def _column(values: tuple[float, ...], dimensions: int) -> FloatArray:
    return np.array(values, dtype=np.float64).reshape(-1, *(1,) * dimensions)
