"""Held-out errors of an estimator on one fold, by regime of the load, and a paired comparison of two estimators."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...arrays import FloatArray, IntArray
from ._folds import Fold, pressing
from ._recording import Recording

REST, HELD, MOVING = range(3)
"""regimes of a sample: hardly any load; a load that stays; a load that changes"""
LIGHT, MOVES, WITHIN_S = 0.05, 0.05, 1.0
"""of full scale: a load below which a cell counts as at rest, and a change within that many seconds that is motion"""
FEWEST = 20
"""samples of a regime in a fold that are enough to judge it by"""
BLOCKS = 4
"""parts of a fold with equal shares of its pressing, which count as independent in a paired comparison"""
NEITHER = 0.002
"""of full scale: a part in which both estimators err less says nothing about which is better"""


@dataclass(frozen=True)
class Regimes:
    """What a recording does at each sample, (n,)."""

    regime: IntArray
    """:data:`REST`, :data:`HELD` or :data:`MOVING`"""
    pressing: FloatArray
    """path of the normalised load up to the sample, which increases"""

    @classmethod
    def of(cls, recording: Recording, full_scale_kpa: float) -> Regimes:
        """Of each sample of a recording."""
        time, load = recording.time_s, recording.quiet.pressure_kpa / full_scale_kpa
        before, after = np.interp(time - WITHIN_S / 2, time, load), np.interp(time + WITHIN_S / 2, time, load)
        regime = np.where(np.abs(load) < LIGHT, REST, HELD)
        regime[np.abs(after - before) > MOVES] = MOVING
        path = pressing(recording, full_scale_kpa) + 1e-9 * np.arange(len(time))
        return cls(regime, path)

    def part(self, place: slice) -> Regimes:
        """Of some of the samples."""
        return Regimes(self.regime[place], self.pressing[place])


@dataclass(frozen=True)
class Judged:
    """How an estimator does on a fold that it has not learned from. Arrays are (n,), in shares of full scale."""

    fold: Fold
    error: FloatArray
    std: FloatArray
    """standard deviations stated with the estimates; infinite where none is"""
    samples: Regimes

    @property
    def rms(self) -> float:
        """Rms error of the whole fold."""
        return float(np.sqrt(np.mean(self.error**2)))

    @property
    def pressed(self) -> FloatArray:
        """Errors while the cell is loaded, or all errors if that is hardly ever so: rest is easy."""
        loaded = self.samples.regime != REST
        return self.error[loaded] if np.count_nonzero(loaded) >= FEWEST else self.error

    @property
    def pressed_rms(self) -> float:
        """Their rms."""
        return float(np.sqrt(np.mean(self.pressed**2)))

    def regimes(self) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Sizes of the errors and deviations of each regime that the fold has enough of; of all if of none."""
        size = np.abs(self.error)
        parts = [self.samples.regime == regime for regime in (REST, HELD, MOVING)]
        enough = [part for part in parts if np.count_nonzero(part) >= FEWEST]
        for part in enough or [np.ones(len(size), dtype=np.bool_)]:
            yield size[part], self.std[part]

    def blocks(self) -> FloatArray:
        """(:data:`BLOCKS`,) rms error of each part with the same share of the fold's pressing; NaN: no samples."""
        path = self.samples.pressing - self.samples.pressing[0]
        place = np.minimum(BLOCKS * path / path[-1] if path[-1] > 0 else 0 * path, BLOCKS - 1).astype(np.intp)
        count = np.bincount(place, minlength=BLOCKS)
        squares = np.bincount(place, self.error**2, minlength=BLOCKS)
        return np.asarray(np.sqrt(np.divide(squares, count, out=np.full(BLOCKS, np.nan), where=count > 0)))


def mixed(judged: Sequence[Judged], reference: Sequence[Judged], share: float) -> list[Judged]:
    """Of the estimator whose answers are a share of one's and the rest of a reference's; deviations stay."""
    return [
        replace(one, error=share * one.error + (1 - share) * other.error)
        for one, other in zip(judged, reference, strict=True)
    ]


def best_share(judged: Sequence[Judged], reference: Sequence[Judged]) -> float:
    """The share from 0 to 1 of an estimator, beside a reference, that makes the held-out errors least (stacking).

    Least squares over the folds, each with the same weight.
    """
    products = squares = 0.0
    for one, other in zip(judged, reference, strict=True):
        difference = other.error - one.error
        products += float(np.mean(other.error * difference))
        squares += float(np.mean(difference**2))
    return float(np.clip(products / max(squares, 1e-30), 0.0, 1.0))


def rms_by_press(judged: Sequence[Judged], press: float) -> FloatArray:
    """(n,) rms error of one whole press after the other, over all folds; what is left at the end does not count.

    Presses that are all alike have equal errors, wherever in a press the first fold begins. Shorter parts would differ
    nevertheless, as a rise differs from a fall.

    Args:
        judged: one fold after the other.
        press: path of the normalised load in a press, a rise and a fall.
    """
    path = np.concatenate([part.samples.pressing for part in judged])
    error = np.concatenate([part.error for part in judged])
    place = ((path - path[0]) / press).astype(np.intp)
    whole = place < place[-1]
    count = np.bincount(place[whole])
    return np.asarray(np.sqrt(np.bincount(place[whole], error[whole] ** 2)[count > 0] / count[count > 0]))


def standard_errors_better(judged: Sequence[Judged], reference: Sequence[Judged]) -> float:
    """By how many of its own standard errors the mean rms error is below that of a reference (paired t statistic).

    Both are compared part by part on the same folds, so that what is hard for both does not blur the comparison.

    Args:
        judged: one fold after the other.
        reference: of another estimator, on the same folds.
    """
    found = [(one.blocks(), other.blocks()) for one, other in zip(judged, reference, strict=True)]
    own, other = (np.concatenate(blocks) for blocks in zip(*found, strict=True))
    counted = np.isfinite(own) & (np.maximum(own, other) > NEITHER)
    gain = (other - own)[counted]
    if gain.size < 2:
        return 0.0
    error = float(gain.std(ddof=1)) / np.sqrt(gain.size)
    return float(gain.mean() / max(error, 1e-12))
