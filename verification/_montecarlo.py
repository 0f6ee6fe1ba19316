"""Monte Carlo analysis: how many of the boards that will be built keep a limit (production yield).

The boards are drawn in blocks of :data:`BLOCK`. Each block has a random stream of its own, made of the seed and the
block's number, and is computed in one piece. The samples are therefore the same, bit for bit, whatever the number of
processes, the order in which blocks are done, or an interruption in between.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import beta

from ..circuits import apparent_resistance, scan_population
from ..common.arrays import BoolArray, FloatArray
from ._corner import Box

BLOCK = 100
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Samples:
    """One number per board and target, relative; NaN or inf is a board without a reading, which fails any limit."""

    reading_error: FloatArray
    """(boards,) largest magnitude over all cells, at rest and all pressed"""
    gain_error: FloatArray
    """(boards,) largest magnitude over all cells, from all at rest to all pressed"""
    crosstalk: FloatArray
    """(boards,) largest magnitude over the untouched cells of the given patterns"""

    @classmethod
    def joined(cls, blocks: list[Samples]) -> Samples:
        return cls(*(np.concatenate([getattr(b, name) for b in blocks]) for name in cls.__dataclass_fields__))


def blocks(samples: int) -> int:
    """How many blocks hold so many boards."""
    return -(-samples // BLOCK)


def sample_block(box: Box, patterns: list[BoolArray], seed: int, block: int) -> Samples:
    """One block of boards.

    Args:
        box: the design, its tolerances and its cells.
        patterns: pressed cells (N, M) of the frames in which crosstalk is judged.
        seed: of the run.
        block: number of the block, from 0.

    """
    random = np.random.default_rng(np.random.SeedSequence([seed, block]))
    population = box.factors.population(box.factors.sample(random, BLOCK))
    shape = box.design.array.shape
    scale = random.uniform(-1.0, 1.0, (BLOCK, *shape))

    def read(pressed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Apparent and true ohm; NaN where a reading clips or saturates."""
        cells = box.resistance(np.broadcast_to(pressed, scale.shape), scale)
        found = scan_population(box.design, population.boards, cells, resolve_saturation=False)
        volts = box.converted(found.volts, population.converter[:, None, None])
        lost = found.saturated | box.clipped(volts)
        if box.design.adc is not None:
            adc = box.design.adc
            volts = adc.range[0] + (np.floor((volts - adc.range[0]) / adc.step) + 0.5) * adc.step
        return np.where(lost, np.nan, apparent_resistance(box.design, volts)), cells

    rest, rest_true = read(np.zeros(shape))
    full, full_true = read(np.ones(shape))
    error = np.maximum(np.abs(rest / rest_true - 1.0), np.abs(full / full_true - 1.0))
    gain = np.abs((full - rest) / (full_true - rest_true) - 1.0)
    crosstalk = np.zeros(BLOCK)
    for pattern in patterns:
        pressed, _ = read(pattern.astype(np.float64))
        change = np.abs(pressed / rest - 1.0)
        crosstalk = np.maximum(crosstalk, change[:, ~pattern].max(axis=1, initial=0.0))
    return Samples(error.max(axis=(1, 2)), gain.max(axis=(1, 2)), crosstalk)


def proportion_bounds(kept: int, count: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Two-sided Clopper-Pearson bounds of a proportion (Biometrika 26, 1934): exact, for any count."""
    if count < 1:
        return 0.0, 1.0
    tail = (1.0 - confidence) / 2.0
    low = 0.0 if kept == 0 else float(beta.ppf(tail, kept, count - kept + 1))
    high = 1.0 if kept == count else float(beta.ppf(1.0 - tail, kept + 1, count - kept))
    return low, high


def boards_needed(wanted: float, share: float, *, most: int = 10_000_000) -> int | None:
    """The least number of boards whose lower bound reaches the wanted yield, if ``share`` of them keep the limit.

    Returns:
        The number, by bisection; None if even ``most`` boards would not do, as when ``share`` is below ``wanted``.
    """

    def proves(count: int) -> bool:
        return proportion_bounds(math.floor(share * count + 1e-9), count)[0] >= wanted

    if share <= wanted or not proves(most):
        return None
    low, high = 0, most
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if proves(middle) else (middle, high)
    return high
