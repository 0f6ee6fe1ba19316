"""Held-out errors of estimators, and all that is decided by them: the choice, the mixture, the deviation.

An estimator that has learned what comes before a fold is judged on this fold and on all later ones. The errors are
pooled over these pairs, each with the same weight. Models and simulations decide nothing here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...common.arrays import FloatArray

COVERED = 0.95
"""share of the errors that two deviations shall cover"""
SUREST = 0.002
"""least standard deviation, as normalised load"""
MOST_GROWTH = 3.0
"""largest factor by which errors are believed to grow after the calibration"""
FACTORS = np.concatenate([[0.0], np.geomspace(0.3, 3.0, 11)])
"""standard deviations over the learned error that are tried"""


@dataclass(frozen=True)
class Judged:
    """Errors of an estimator on one fold, over full scale. Arrays are (n,)."""

    before: int
    """it has learned what comes before this fold"""
    fold: int
    error: FloatArray
    expected: FloatArray
    """the error that the estimator expects; 0 if it expects none"""
    beyond: FloatArray
    """deviation that is stated in any case, of readings beyond what was learned"""


def representative(judged: Sequence[Judged]) -> list[Judged]:
    """The errors without those of the estimator that has learned least, if there are others.

    They show how little data an estimator needs, and not how well it does after all of the recording.
    """
    return [part for part in judged if part.before > 0 or all(other.before == 0 for other in judged)]


def pooled_rms(judged: Sequence[Judged]) -> float:
    """Rms error over all pairs, each with the same weight."""
    return float(np.sqrt(np.mean([np.mean(part.error**2) for part in judged])))


def by_fold(judged: Sequence[Judged]) -> tuple[float, ...]:
    """Rms error on each fold after learning what comes right before it, in %."""
    return tuple(100 * float(np.sqrt(np.mean(part.error**2))) for part in judged if part.before == part.fold)


def best_share(judged: Sequence[Judged], reference: Sequence[Judged]) -> float:
    """The weight from 0 to 1 of an estimator in a mixture with a reference that minimises pooled errors (stacking)."""
    products = squares = 0.0
    for one, other in zip(judged, reference, strict=True):
        difference = other.error - one.error
        products += float(np.mean(other.error * difference))
        squares += float(np.mean(difference**2))
    return float(np.clip(products / max(squares, 1e-30), 0.0, 1.0))


def mixed(judged: Sequence[Judged], reference: Sequence[Judged], share: float) -> list[Judged]:
    """Errors of the mixture ``share`` * estimator + (1 - ``share``) * reference."""
    return [
        replace(one, error=share * one.error + (1 - share) * other.error)
        for one, other in zip(judged, reference, strict=True)
    ]


def interval_score(error: FloatArray, std: FloatArray) -> FloatArray:
    """(n,) interval score of 95 % intervals of two deviations (Gneiting and Raftery 2007, equation 43)."""
    return np.asarray(4 * std + 2 / (1 - COVERED) * np.maximum(np.abs(error) - 2 * std, 0))


def growth(judged: Sequence[Judged]) -> float:
    """Factor by which errors grow while a time as long as the recording passes after the calibration.

    Estimators that have learned what comes before different folds are compared on the same folds. Creep goes on with
    the logarithm of time: the mean growth per doubling of the age, in folds, is continued by the doubling that the
    folds do not reach.
    """
    fresh = {part.fold: part for part in judged if part.before == part.fold}
    ratios = [
        np.log(_rms(part) / _rms(fresh[part.fold])) / np.log2(1 + part.fold - part.before)
        for part in judged
        if part.before < part.fold
    ]
    return float(np.clip(np.exp(np.mean(ratios)), 1.0, MOST_GROWTH)) if ratios else 1.0


def _rms(part: Judged) -> float:
    return max(float(np.sqrt(np.mean(part.error**2))), SUREST)


def conformal(judged: Sequence[Judged]) -> tuple[float, float]:
    """Factor on the error that an estimator expects, and the least deviation, as normalised load.

    The deviation is the larger of the two. Of all pairs that cover :data:`COVERED` of the pooled errors within two
    deviations (split conformal prediction), the one with the least interval score is taken.
    """
    error = np.concatenate([np.abs(part.error) for part in judged])
    expected = np.concatenate([part.expected for part in judged])
    beyond = np.concatenate([part.beyond for part in judged])
    weight = np.concatenate([np.full(part.error.size, 1 / part.error.size) for part in judged])
    weight /= weight.sum()
    needed = np.sqrt(np.maximum((error / 2) ** 2 - beyond**2, 0.0))
    """the least deviation, beside the one beyond what was learned, that covers each error"""
    best, found = np.inf, (0.0, SUREST)
    for factor in FACTORS if expected.any() else FACTORS[:1]:
        floor = max(_quantile(np.where(factor * expected >= needed, 0.0, needed), weight), SUREST)
        std = np.hypot(np.maximum(factor * expected, floor), beyond)
        score = float(weight @ interval_score(error, std))
        if score < best:
            best, found = score, (float(factor), floor)
    return found


def _quantile(values: FloatArray, weight: FloatArray) -> float:
    """The value that the share :data:`COVERED` of the weight does not exceed."""
    order = np.argsort(values)
    place = int(np.searchsorted(np.cumsum(weight[order]), COVERED))
    return float(values[order[min(place, len(values) - 1)]])
