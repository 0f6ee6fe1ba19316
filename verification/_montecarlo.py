"""Monte Carlo analysis: how many of the boards that will be built keep a limit (production yield).

Each board is judged as the worst-case search judges its corners, by the same target, over all cells that the search
covers. The derivatives that name the search's corners rank every cell, sign and press pattern for each board; those
that promise most are solved, until none that is left promises more than what was found. Which press hurts depends on
the board's own parts: from the worst one presses are changed, alone or as whole lines, while that makes it worse.

The boards are drawn in blocks of :data:`BLOCK`. Each block has a random stream of its own, made of the seed and the
block's number, and is computed in one piece. The samples are therefore the same, bit for bit, whatever the number of
processes, the order in which blocks are done, or an interruption in between.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass
from math import inf

import numpy as np
from scipy.stats import binomtest

from ..common.arrays import FloatArray, IntArray
from ._box import Box, Corners
from ._readings import ReadingTarget, named_corners
from ._search import Target, WorstCase, with_worse_presses
from ._tuning import BLOCK, FEW, MOST_BOARDS, MOST_TRIES, ROOM, WORK

CONFIDENCE = 0.95


def blocks(samples: int) -> int:
    """How many blocks hold so many boards."""
    return -(-samples // BLOCK)


def blocks_beside(target: Target, box: Box, tries: int, samples: int) -> int:
    """Blocks of boards that are judged beside a worst case: as many as are drawn, fewer of large arrays."""
    return min(blocks(samples), max(1, int(WORK / (BLOCK * tries * target.cost(box)))))


@dataclass(frozen=True)
class Sampler:
    """What judges random boards, made once from the worst-case search of the same quantity."""

    target: Target
    box: Box
    found: Corners
    """presses of the search's own worst corners, with their judged cells"""
    named: Corners
    """(K) judged cells, signs and presses that derivatives name; none of targets without"""
    fixed: FloatArray
    """(K,) their values on nominal boards, to first order"""
    slopes: FloatArray
    """(K, F + cells) by the factors and by the deviations of the cells"""

    @classmethod
    def of(cls, worst: WorstCase) -> Sampler:
        """The judge of a quantity's boards."""
        box, target, others = worst.box, worst.target, worst.others
        parts, cells = len(box.factors), box.cells
        pressed = slice(parts, parts + cells)
        if not isinstance(target, ReadingTarget):
            patterns = others.x[:, pressed]
            _, first = np.unique(np.sign(patterns), axis=0, return_index=True)
            nothing = np.zeros(0)
            some = others.some(np.sort(first)[: FEW // 2])
            return cls(target, box, some, others.some(slice(0, 0)), nothing, np.zeros((0, parts + cells)))
        fixed, slopes = [], []
        named = named_corners(target, box)
        for number, one in enumerate(named):
            state = 2.0 * (number // 2) - 1.0  # at rest and pressed, of two signs each
            moved = (one.slopes[:, pressed] * (one.corners.x[:, pressed] - state)).sum(axis=1)
            fixed.append(np.nan_to_num(one.centre + moved, nan=inf))
            slopes.append(np.nan_to_num(np.delete(one.slopes, np.r_[pressed], axis=1)))
        judged = np.stack([others.row, others.column, others.sign.astype(np.intp)])
        _, first = np.unique(judged, axis=1, return_index=True)
        return cls(
            target,
            box,
            others.some(np.sort(first)[:FEW]),
            Corners.joined([one.corners for one in named]),
            np.concatenate(fixed),
            np.concatenate(slopes),
        )

    @property
    def tries(self) -> int:
        """Points that a board takes at least."""
        return len(self.found) + (FEW if len(self.named) else 0)

    def block(self, seed: int, block: int) -> FloatArray:
        """The largest value (boards,) of the target over all cells and presses, of one block of boards."""
        random = np.random.default_rng(np.random.SeedSequence([seed, block]))
        factors = self.box.factors.sample(random, BLOCK)
        return self.judged(np.concatenate([factors, random.uniform(-1.0, 1.0, (BLOCK, self.box.cells))], axis=1))

    def judged(self, boards: FloatArray) -> FloatArray:
        """As :meth:`block`, of boards with factors and deviations of cells (S, F + cells)."""
        own = np.tile(np.arange(len(self.found)), (len(boards), 1))
        worst, best = self._solved(boards, self.found, own)
        promised = self.fixed + boards @ self.slopes.T
        count = min(FEW * MOST_TRIES, promised.shape[1])
        order = np.argsort(-promised, axis=1, kind="stable")[:, :count]
        for first in range(0, count, FEW):
            chosen = order[:, first : first + FEW]
            next_value = np.take_along_axis(promised, chosen[:, :1], axis=1)[:, 0]
            open_ones = np.isfinite(best)
            worth = np.where(open_ones, best, 0.0) * (1.0 - ROOM)
            active = np.flatnonzero(open_ones & ((next_value > worth) | (first == 0)))
            if not len(active):
                break
            solved, values = self._solved(boards[active], self.named, chosen[active])
            higher = values > best[active]
            which = np.arange(len(boards))
            which[active[higher]] = len(boards) + np.flatnonzero(higher)
            worst = Corners.joined([worst, solved]).some(which)
            best[active] = np.maximum(best[active], values)
        if len(self.named):
            best = with_worse_presses(self.target, self.box, worst, best)
        return np.where(best > -inf, best, inf)  # a board of which nothing can be said has failed

    def _solved(self, boards: FloatArray, corners: Corners, chosen: IntArray) -> tuple[Corners, FloatArray]:
        """The worst (S,) of T of the corners' cells and presses, chosen (S, T) for each board; and their values."""
        parts, cells = len(self.box.factors), self.box.cells
        named = corners.some(chosen.ravel())
        own = np.repeat(boards, chosen.shape[1], axis=0)
        x = np.concatenate([own[:, :parts], named.x[:, parts : parts + cells], own[:, parts:]], axis=1)
        tried = named.at(x)
        values = self.target.evaluate(self.box, tried).reshape(chosen.shape)
        top = np.arange(len(boards)) * chosen.shape[1] + values.argmax(axis=1)
        return tried.some(top), values.max(axis=1)


def proportion_bounds(kept: int, count: int) -> tuple[float, float]:
    """Two-sided Clopper-Pearson bounds of a proportion (Biometrika 26, 1934): exact, for any count."""
    if count < 1:
        return 0.0, 1.0
    interval = binomtest(kept, count).proportion_ci(CONFIDENCE, "exact")
    return float(interval.low), float(interval.high)


def boards_needed(wanted: float, share: float) -> int | None:
    """The least number of boards whose lower bound reaches the wanted yield, if ``share`` of them keep the limit.

    Returns:
        The number, by bisection; None if even :data:`MOST_BOARDS` would not do, as when ``share`` is below ``wanted``.
    """

    def proves(count: int) -> bool:
        return proportion_bounds(math.floor(share * count + 1e-9), count)[0] >= wanted

    count = bisect_left(range(MOST_BOARDS + 1), True, key=proves) if share > wanted else MOST_BOARDS + 1
    return count if count <= MOST_BOARDS else None
