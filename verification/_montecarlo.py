"""Monte Carlo analysis: how many of the boards that will be built keep a limit (production yield).

The boards are drawn in blocks of :data:`BLOCK`. Each block has a random stream of its own, made of the seed and the
block's number, and is computed in one piece. The samples are therefore the same, bit for bit, whatever the number of
processes, the order in which blocks are done, or an interruption in between. Each board is judged as the worst-case
search judges its corners, by the same target, under presses that this search has found to be hard.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.stats import beta

from ..common.arrays import FloatArray
from ._targets import Box, Corners, Press, Target, values_of_boards

BLOCK = 100
CONFIDENCE = 0.95
MOST_BOARDS = 10_000_000


def blocks(samples: int) -> int:
    """How many blocks hold so many boards."""
    return -(-samples // BLOCK)


def _drawn(box: Box, seed: int, block: int) -> FloatArray:
    """Coordinates (boards, D) of one block of boards, their cells at rest."""
    random = np.random.default_rng(np.random.SeedSequence([seed, block]))
    factors = box.factors.sample(random, BLOCK)
    scale = random.uniform(-1.0, 1.0, (BLOCK, box.cells))
    return np.concatenate([factors, np.full(scale.shape, -1.0), scale], axis=1)


def sample_block(target: Target, box: Box, presses: Sequence[Press], seed: int, block: int) -> FloatArray:
    """One block of boards: the largest value of the target under any of the presses, (boards,).

    Args:
        target: what is judged.
        box: the design, its tolerances and its cells.
        presses: under which each board is judged.
        seed: of the run.
        block: number of the block, from 0.

    """
    values, _ = values_of_boards(target, box, _drawn(box, seed, block), presses)
    worst: FloatArray = values.max(axis=1)
    return worst


def worst_board(target: Target, box: Box, presses: Sequence[Press], seed: int, values: FloatArray) -> Corners:
    """Where the largest of the values of all blocks is: one board, its press and its judged cell."""
    block, number = divmod(int(np.argmax(values)), BLOCK)
    x = _drawn(box, seed, block)[number : number + 1]
    found, places = values_of_boards(target, box, x, presses)
    worst = int(np.argmax(found[0]))
    place = int(places[0, worst])
    sign, cell = (1.0, place) if place >= 0 else (-1.0, -1 - place)
    row, column = divmod(cell, box.design.array.columns)
    x[0, len(box.factors) : len(box.factors) + box.cells] = 2.0 * presses[worst][0].ravel() - 1.0
    return Corners(np.array([row]), np.array([column]), np.array([sign]), x)


def proportion_bounds(kept: int, count: int) -> tuple[float, float]:
    """Two-sided Clopper-Pearson bounds of a proportion (Biometrika 26, 1934): exact, for any count."""
    if count < 1:
        return 0.0, 1.0
    tail = (1.0 - CONFIDENCE) / 2.0
    low = 0.0 if kept == 0 else float(beta.ppf(tail, kept, count - kept + 1))
    high = 1.0 if kept == count else float(beta.ppf(1.0 - tail, kept + 1, count - kept))
    return low, high


def boards_needed(wanted: float, share: float) -> int | None:
    """The least number of boards whose lower bound reaches the wanted yield, if ``share`` of them keep the limit.

    Returns:
        The number, by bisection; None if even :data:`MOST_BOARDS` would not do, as when ``share`` is below ``wanted``.
    """

    def proves(count: int) -> bool:
        return proportion_bounds(math.floor(share * count + 1e-9), count)[0] >= wanted

    if share <= wanted or not proves(MOST_BOARDS):
        return None
    low, high = 0, MOST_BOARDS
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if proves(middle) else (middle, high)
    return high
