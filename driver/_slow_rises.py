"""Slow presses on coarse boards: rises of means over blocks of frames (averaging with dither), in standard deviations.

On a board with few ADC steps a single frame hardly tells a press that takes a second from noise. Means over blocks of
frames do, if noise carries the reading over the edges of the steps (dither). The scatter of a cell's readings within
the blocks shows how far noise does so. The part of the stated noise that does not scatter is not reduced by averaging.

Each block is compared with blocks seconds before it. Meanwhile a rest resistance may have drifted, and a load that has
gone has left something in the material, which is less than the load itself.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..common.arrays import FloatArray, scatter

BLOCK_S, BLOCKS_OF_LONG = 0.08, 5
"""s, length of a short block; number of short blocks in a long one"""
APART, BEFORE = 2, 6
"""blocks skipped before the last one, and blocks before these for comparison: within two blocks a press of some blocks
has come down for the most part"""
BLOCKS = BEFORE + APART + 1
JUST_BEFORE = slice(BLOCKS - 1 - APART, BLOCKS - APART)
"""the block with which the last one is compared to see whether a tap has ended"""
LEFT = 0.7
"""fraction of the largest rise of an earlier block: with less, an earlier load has gone"""
CHANCE = 2.0
"""standard deviations by which the scatter of few readings may be too small"""
DRIFT_PER_S = 0.003
"""relative change of a rest resistance per second: warming up takes minutes. A finger presses much faster"""
ROUNDING_S = 1e-9
"""rounding error of frame times; a frame that is a whole block later belongs to the next block"""


class SlowRise(NamedTuple):
    """Difference between a block of frames and the blocks seconds before it."""

    since_s: float
    """time after which no release may have happened: the end of the blocks used for comparison"""
    rise: FloatArray
    """(rows, columns) in standard deviations: of the noise, or of all cells if these scatter by more; 0 if the cell was
    not read in each of the frames"""


class SlowChanges(NamedTuple):
    """Changes found when a block ends."""

    lately: FloatArray
    """(rows, columns) change from the short block but one before it, in standard deviations as in :class:`SlowRise`"""
    rises: list[SlowRise]
    """of the short block, and of the long block if it has ended, too"""


class SlowRises:
    """Keeps the last blocks of two lengths."""

    def __init__(self, shape: tuple[int, int]) -> None:
        """Start without blocks."""
        self._sum, self._squares = np.zeros((2, *shape))
        self._frames, self._start_s = 0, 0.0
        self._short, self._long = _Blocks(shape), _Blocks(shape)

    def forget(self) -> None:
        """Begin anew: rest resistances have changed."""
        self._frames = self._short.ended = self._long.ended = 0

    def take(self, time_s: float, reading: FloatArray, noise: FloatArray) -> SlowChanges | None:
        """Take the next frame, and compare blocks that ended before it; None: no block has ended, or too few have.

        Args:
            time_s: of the frame, increasing.
            reading: (rows, columns) relative changes of conductance, positive in the direction of a load; NaN where
                the cell was not read.
            noise: (rows, columns) standard deviation of one reading, by noise and by the steps of the ADC.

        """
        found = None
        if self._frames and time_s - self._start_s >= BLOCK_S - ROUNDING_S:
            found = self._end_block(noise)
        if not self._frames:
            self._start_s = time_s
            self._sum.fill(0.0)
            self._squares.fill(0.0)
        self._frames += 1
        self._sum += reading
        self._squares += reading * reading
        return found

    def _end_block(self, noise: FloatArray) -> SlowChanges | None:
        short, long, frames, self._frames = self._short, self._long, self._frames, 0
        mean = self._sum / frames
        squares = np.maximum(self._squares - mean * self._sum, 0.0)
        short.add(self._start_s, frames, frames - 1, mean, squares)
        ended = [short]
        if short.ended % BLOCKS_OF_LONG == 0:
            long.add(*short.last())
            ended.append(long)
        if short.ended < BLOCKS:
            return None
        return SlowChanges(
            short.compare(noise, JUST_BEFORE), [blocks.rise(noise) for blocks in ended if blocks.ended >= BLOCKS]
        )


class _Blocks:
    """The last blocks of one length, the oldest first."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.ended = 0
        """number of blocks that have ended so far"""
        self._start_s = np.zeros(BLOCKS)
        self._frames, self._degrees = np.zeros((2, BLOCKS), dtype=np.int64)
        """frames in each block; degrees of freedom of its squares"""
        self._means, self._squares = np.zeros((2, BLOCKS, *shape))
        """means of readings, NaN if a cell was not read in every frame; sums of squared deviations from these means"""

    def add(self, start_s: float, frames: int, degrees: int, mean: FloatArray, squares: FloatArray) -> None:
        """Add the next block."""
        for kept in (self._start_s, self._frames, self._degrees, self._means, self._squares):
            kept[:-1] = kept[1:]
        self._start_s[-1], self._frames[-1], self._degrees[-1] = start_s, frames, degrees
        self._means[-1], self._squares[-1] = mean, squares
        self.ended += 1

    def last(self) -> tuple[float, int, int, FloatArray, FloatArray]:
        """The last blocks as one long block, as :meth:`add` takes it; differences of their means are no scatter."""
        last = slice(-BLOCKS_OF_LONG, None)
        frames, degrees, squares = self._frames[last], self._degrees[last].sum(), self._squares[last].sum(axis=0)
        return self._start_s[-BLOCKS_OF_LONG], int(frames.sum()), int(degrees), self._mean(last), squares

    def _mean(self, blocks: slice) -> FloatArray:
        """(rows, columns) mean over all frames of the blocks."""
        frames = self._frames[blocks]
        return np.tensordot(frames / frames.sum(), self._means[blocks], 1)

    def rise(self, noise: FloatArray) -> SlowRise:
        """Rise of the last block; ``noise`` as for :meth:`SlowRises.take`."""
        return SlowRise(float(self._start_s[BEFORE]), self.compare(noise, slice(0, BEFORE)))

    def compare(self, noise: FloatArray, before: slice) -> FloatArray:
        """(rows, columns) change of the last block from blocks ``before``, beyond drift, in standard deviations."""
        frames = int(self._frames[before].sum())
        scatters, degrees = self._squares.sum(axis=0), max(int(self._degrees.sum()), 1)
        scatters /= degrees
        # Errors that do not scatter within a block may differ in the next block.
        variance = 2.0 * np.maximum(noise * noise - scatters * (1.0 + CHANCE * math.sqrt(2.0 / degrees)), 0.0)
        variance += scatters * (1.0 / int(self._frames[-1]) + 1.0 / frames)
        mean = self._mean(before)
        std = np.sqrt(variance)
        change: FloatArray = self._means[-1] - mean
        std *= max(scatter(change / std), 1.0)
        gone = change < LEFT * (self._means[before].max(axis=0) - mean)
        drift = DRIFT_PER_S * (self._start_s[-1] - self._start_s[(before.start + before.stop) // 2])
        change -= np.minimum(np.maximum(change, -drift), drift)
        change /= std
        change[(gone & (change > 0.0)) | np.isnan(scatters)] = 0.0
        return change
