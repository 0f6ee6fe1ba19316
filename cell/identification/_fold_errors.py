"""Held-out errors of an estimator by fold and by regime of the load; paired t test and stacking of two estimators."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...common.arrays import FloatArray, IntArray
from ._folds import Fold, pressing
from ._recording import Recording

REST, CONSTANT, CHANGING = range(3)
"""regimes of a sample: at rest, under a constant load, under a changing load"""
NEARLY_UNLOADED, CHANGES, WITHIN_S = 0.05, 0.05, 1.0
"""fractions of full scale: load below which a cell counts as at rest; and change within ``WITHIN_S`` seconds that
counts as motion"""
FEWEST = 20
"""least number of samples of a regime in a fold for separate statistics"""
BLOCKS = 12
"""number of parts of all folds together, with equal path lengths of the load in a fold; they count as independent in a
paired comparison"""
BOTH_EXACT = 0.002
"""fraction of full scale; parts in which both estimators err less do not enter the comparison"""


@dataclass(frozen=True)
class Regimes:
    """Regime and path length of the load at each sample of a recording, (n,)."""

    regime: IntArray
    """:data:`REST`, :data:`CONSTANT` or :data:`CHANGING`"""
    pressing: FloatArray
    """path of the normalised load up to the sample, which increases"""

    @classmethod
    def of(cls, recording: Recording, full_scale_kpa: float) -> Regimes:
        """The regimes of all samples of a recording."""
        time, load = recording.time_s, recording.quiet.pressure_kpa / full_scale_kpa
        before, after = np.interp(time - WITHIN_S / 2, time, load), np.interp(time + WITHIN_S / 2, time, load)
        regime = np.where(np.abs(load) < NEARLY_UNLOADED, REST, CONSTANT)
        regime[np.abs(after - before) > CHANGES] = CHANGING
        path = pressing(recording, full_scale_kpa) + 1e-9 * np.arange(len(time))
        return cls(regime, path)

    def part(self, place: slice) -> Regimes:
        """The regimes of the samples ``place``."""
        return Regimes(self.regime[place], self.pressing[place])


@dataclass(frozen=True)
class FoldErrors:
    """Held-out errors of an estimator on one fold. Arrays are (n,), over full scale."""

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
        """Errors while the cell is loaded (rest is easy); all errors if the cell is hardly ever loaded."""
        loaded = self.samples.regime != REST
        return self.error[loaded] if np.count_nonzero(loaded) >= FEWEST else self.error

    @property
    def pressed_rms(self) -> float:
        """Rms of :attr:`pressed`."""
        return float(np.sqrt(np.mean(self.pressed**2)))

    def regimes(self) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Absolute errors and stated deviations, for each regime with enough samples; else for all samples together."""
        size = np.abs(self.error)
        parts = [self.samples.regime == regime for regime in (REST, CONSTANT, CHANGING)]
        enough = [part for part in parts if np.count_nonzero(part) >= FEWEST]
        for part in enough or [np.ones(len(size), dtype=np.bool_)]:
            yield size[part], self.std[part]

    def blocks(self, number: int) -> FloatArray:
        """(number,) rms error of the fold's parts with equal path lengths of the load; NaN: no samples."""
        path = self.samples.pressing - self.samples.pressing[0]
        place = np.minimum(number * path / path[-1] if path[-1] > 0 else 0 * path, number - 1).astype(np.intp)
        count = np.bincount(place, minlength=number)
        squares = np.bincount(place, self.error**2, minlength=number)
        return np.asarray(np.sqrt(np.divide(squares, count, out=np.full(number, np.nan), where=count > 0)))


def mixed(judged: Sequence[FoldErrors], reference: Sequence[FoldErrors], share: float) -> list[FoldErrors]:
    """Errors of the mixture ``share`` * estimator + (1 - ``share``) * reference; stated deviations stay."""
    return [
        replace(one, error=share * one.error + (1 - share) * other.error)
        for one, other in zip(judged, reference, strict=True)
    ]


def best_share(judged: Sequence[FoldErrors], reference: Sequence[FoldErrors]) -> float:
    """The weight from 0 to 1 of an estimator in a mixture with a reference that minimises held-out errors (stacking).

    Least squares over the folds, each with the same weight.
    """
    products = squares = 0.0
    for one, other in zip(judged, reference, strict=True):
        difference = other.error - one.error
        products += float(np.mean(other.error * difference))
        squares += float(np.mean(difference**2))
    return float(np.clip(products / max(squares, 1e-30), 0.0, 1.0))


def rms_by_press(judged: Sequence[FoldErrors], press: float) -> FloatArray:
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


def standard_errors_better(judged: Sequence[FoldErrors], reference: Sequence[FoldErrors]) -> float:
    """Improvement of the mean rms error over a reference, in standard errors (paired t statistic).

    The two are compared part by part on the same folds, so that parts that are hard for both add no scatter.

    Args:
        judged: errors of the estimator, fold by fold.
        reference: errors of the reference on the same folds.
    """
    number = BLOCKS // len(judged)
    found = [(one.blocks(number), other.blocks(number)) for one, other in zip(judged, reference, strict=True)]
    own, other = (np.concatenate(blocks) for blocks in zip(*found, strict=True))
    counted = np.isfinite(own) & (np.maximum(own, other) > BOTH_EXACT)
    gain = (other - own)[counted]
    if gain.size < 2:
        return 0.0
    error = float(gain.std(ddof=1)) / np.sqrt(gain.size)
    return float(gain.mean() / max(error, 1e-12))
