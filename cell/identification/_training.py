"""Training of the learned estimators: ridge regression on the recording and on simulated cells (data augmentation).

The identified model is simulated under loads that the recording lacks: random ones, and variations of the recorded
load. The model is not exact. Its parameters are therefore varied at random, and its error is added as slow noise. The
recording has the same weight as all simulations together. An estimator thus learns the response to loads that were not
recorded, without relying on the exact model.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import FloatArray
from ..inversions import BEYOND, DRIFT, UNKNOWN_DRIFT, Bank, Learned, Limits, Reached, StaticCurve, Terms
from ..materials import simulate
from ._fitted import Simulation
from ._fold_errors import FoldErrors

LAGS_S = (0.5, 2.0, 8.0, 30.0, 120.0)
"""time constants of the distilled estimator; longer lags would only remember how the recording began"""
PATHS_S = (5.0, 20.0, 80.0)
"""time constants of path lengths in the distilled estimator, for cells whose conductive chains break by motion and heal
in seconds to minutes"""
SMOOTHING_S = 0.1
DIRECTIONS = 600
CELLS, SECONDS = 96, 400.0
STATIC_CELLS = 12
"""simulated cells for the error of a static curve at other speeds"""
MOST_STEPS, FEWEST_SAMPLES = 50000, 500
"""largest number of time steps of a recording on the grid of the simulations; least number of samples of a simulated
cell"""
R0_ERROR = 0.03
"""relative standard deviation of R0 in training. It is larger than the error of an R0 that has just been measured
(``REST_ERROR``): R0 drifts after a calibration, and no stated deviation includes this drift"""
CREEP = 0.08
"""contribution to r, over its range, of creep that is too slow for the recording and of loads before it"""
CREEP_LENGTH = (0.08, 1.33)
"""range of the time constants of such creep, over the length of the recording"""
CALIBRATION_FOLDS = 2
"""number of folds, counted from the last, on which the standard deviations of learned estimators are calibrated"""
NARROWEST, WIDEST = 0.5, 3.0
"""limits of the factor by which held-out folds change a learned standard deviation"""
FLOOR, SUREST = 0.5, 0.02
"""least standard deviation: over the rms error of a fold, and as normalised load"""
AT_REST = 3.0
"""weight in the regression of a cell that has always read R0, whose load is 0"""
UNEXPLAINED = ((3.0, 0.5), (60.0, 0.7))
"""correlation times in seconds of the simulated model error, and the fraction of its standard deviation with each"""
OUTLIERS = 1e-3
"""fraction of the rows at either end that the range of a feature excludes"""
ROWS = 20000
"""number of simulated samples in the regression"""
TOGETHER = 512
"""rows of the regression whose terms are computed at once"""


@dataclass(frozen=True)
class NormalisedRecording:
    """A recording in normalised units, and the identified cell."""

    time_s: FloatArray
    r: FloatArray
    load: FloatArray
    rest_resistance_ohm: float
    simulation: Simulation
    unexplained: float
    """rms residual of r of the identified model"""

    @property
    def seconds(self) -> float:
        """Length of the recording."""
        return float(self.time_s[-1] - self.time_s[0])

    @property
    def spread(self) -> float:
        """Range of r without outliers."""
        low, high = np.percentile(self.r, [0.5, 99.5])
        return float(high - low)

    @property
    def limits(self) -> Limits:
        """Limits of estimates: the least recorded load (at most 0), and a fifth more than the largest (at least 1).

        The margin allows for a calibration that has missed full scale.
        """
        low, high = np.percentile(self.load, [0.1, 99.9])
        return Limits(lowest=min(float(low), 0.0), highest=max(float(high), 1.0) * BEYOND)

    def until(self, time_s: float) -> NormalisedRecording:
        """The part of the recording before ``time_s``."""
        part = self.time_s < time_s
        return replace(self, time_s=self.time_s[part], r=self.r[part], load=self.load[part])


@dataclass(frozen=True)
class Rows:
    """Features (rows, count) and loads (rows,) of the recording, and of the simulated cells."""

    real: FloatArray
    real_load: FloatArray
    simulated: FloatArray
    simulated_load: FloatArray


def cubic(x: FloatArray, load: FloatArray) -> np.polynomial.Polynomial:
    """The cubic of ``x`` (n,) that fits ``load`` (n,) best by least squares."""
    # With few different readings the cubic is not unique, and the minimum-norm one is found; `full` avoids a warning.
    polynomial, _ = np.polynomial.Polynomial.fit(x, load, 3, full=True)
    return polynomial


def static_curve(calibration: NormalisedRecording, full_scale_kpa: float, *, logarithmic: bool = False) -> StaticCurve:
    """The cubic of r (or of log(R0/R)) that fits the recording best by least squares."""
    r, load = calibration.r, calibration.load
    x = -np.log(np.maximum(1 + r, 1e-6)) if logarithmic else r
    coefficients = cubic(x, load).convert().coef
    curve = StaticCurve(
        coefficients=tuple(map(float, coefficients)),
        logarithmic=logarithmic,
        limits=calibration.limits,
        std_kpa=1.0,
        reached=_reached(x[:, None]),
    )
    error = np.clip(curve.load(r), curve.limits.lowest, curve.limits.highest) - load
    std = max(float(np.sqrt(np.mean(error**2))), 1e-6) * full_scale_kpa
    return curve.replace(std_kpa=std)


def error_on_other_loads(calibration: NormalisedRecording, curve: StaticCurve) -> float:
    """Rms error of a static curve, as normalised load, under loads and speeds that the recording lacks.

    The identified cell is simulated under random ramps and holds. A static curve ignores the memory of the cell.
    """
    rng = np.random.default_rng(0)
    dt = max(float(np.median(np.diff(calibration.time_s))), calibration.seconds / MOST_STEPS)
    load = simulate.random_loads(rng, max(round(SECONDS / dt), FEWEST_SAMPLES), STATIC_CELLS, dt)
    r = calibration.simulation(rng, load, dt) / calibration.rest_resistance_ohm - 1
    error = np.clip(curve.load(r), curve.limits.lowest, curve.limits.highest) - load
    return float(np.sqrt(np.mean(error**2)))


def variations(
    calibration: NormalisedRecording, rng: np.random.Generator, cells: int = CELLS
) -> tuple[FloatArray, FloatArray, float]:
    """Loads (n, m) and readings (n, m) of simulated cells, and their time step in seconds."""
    step = float(np.median(np.diff(calibration.time_s)))
    dt = max(float(np.clip(step, 0.1, 0.2)), calibration.seconds / MOST_STEPS)
    samples, half = max(round(SECONDS / dt), FEWEST_SAMPLES), cells // 2
    recorded = simulate.smoothed(calibration.load, step, simulate.smoothing_s(calibration.load, step))
    load = np.concatenate(
        [
            simulate.random_loads(rng, samples, cells - half, dt),
            simulate.varied_loads(rng, samples, half, dt, recorded, step),
        ],
        axis=1,
    )
    r = calibration.simulation(rng, load, dt) / calibration.rest_resistance_ohm - 1
    return load, disturbed(calibration, rng, load, r, dt), dt


def disturbed(
    calibration: NormalisedRecording, rng: np.random.Generator, load: FloatArray, r: FloatArray, dt_s: float
) -> FloatArray:
    """Readings ``r`` (n, m) with errors that the model lacks: model error, noise, slow creep, and an error of R0."""
    samples, cells = len(r), int(r.shape[1])
    unexplained = max(calibration.unexplained, 0.005 * calibration.spread)
    for seconds, share in UNEXPLAINED:
        r = r + simulate.wandering(rng, samples, cells, dt_s, seconds, share * unexplained)
    r = r + simulate.white_noise(calibration.r) * rng.standard_normal(r.shape)
    creep = CREEP * calibration.spread * np.abs(rng.standard_normal(cells))
    shortest, longest = calibration.seconds * np.array(CREEP_LENGTH)
    seconds_of = np.exp(rng.uniform(np.log(shortest), np.log(longest), cells))
    r = r + creep * simulate.lagging(load, dt_s, seconds_of, rng.uniform(0, 0.6, cells))
    return np.asarray((1 + r) * (1 + R0_ERROR * rng.standard_normal(cells)) - 1)


def rows(calibration: NormalisedRecording, bank: Bank, simulated: tuple[FloatArray, FloatArray, float]) -> Rows:
    """Features of the recording, and thinned features of the simulated cells.

    The recording enters in several versions: unchanged, with a lower and a higher R0, and with additional slow creep.
    """
    load, r, dt = simulated
    steps = np.diff(calibration.time_s, prepend=calibration.time_s[0])
    found = bank.run(np.full(len(r), dt), r)
    thin = max(1, round(load.size / ROWS))
    shifts = 1 + R0_ERROR * np.array([-1.5, 0.0, 0.0, 1.5])
    slow = calibration.seconds * np.array([0.133, 0.667])
    lagged = np.repeat(calibration.load[:, None], len(slow), axis=1)
    lagged = simulate.lagging(lagged, float(np.median(steps)), slow, np.array([0.2, 0.5]))
    r_of = calibration.r[:, None]
    real = bank.run(
        steps, np.concatenate([(1 + r_of) * shifts - 1, r_of + CREEP * calibration.spread * lagged], axis=1)
    )
    return Rows(
        real=real.reshape(-1, bank.count),
        real_load=np.repeat(calibration.load, real.shape[1]),
        simulated=found[::thin].reshape(-1, bank.count),
        simulated_load=load[::thin].ravel(),
    )


def learn(
    calibration: NormalisedRecording,
    simulated: tuple[FloatArray, FloatArray, float],
    *,
    lags_s: tuple[float, ...],
    plays: tuple[float, ...],
    paths_s: tuple[float, ...] = (),
    directions: int,
    ridge: float,
    seed: int,
) -> Learned:
    """Ridge regression of the load, then of its absolute error, on the terms of :class:`..inversions.Learned`.

    ``plays`` are half widths over the range of r. The scale of the standard deviation is preliminary; see
    :func:`with_calibrated_std`.
    """
    widths = tuple(float(width) * calibration.spread for width in plays)
    bank = Bank(smoothing_s=SMOOTHING_S, lags_s=lags_s, plays=widths, paths_s=paths_s)
    data = rows(calibration, bank, simulated)
    mean = data.simulated.mean(axis=0)
    scale = np.maximum(data.simulated.std(axis=0), 1e-6 * max(calibration.spread, 1e-9))
    terms = Terms(mean, scale, seed, directions, np.float32)  # cosines cost most; sums are in float64
    rest = np.asarray(terms(terms.standardised(np.zeros((1, bank.count)))), dtype=np.float64)
    penalty = ridge * np.eye(rest.shape[1])
    penalty[0, 0] = 0.0
    sets = [
        (list(_blocks(terms, features, load)), len(features))
        for features, load in ((data.simulated, data.simulated_load), (data.real, data.real_load))
    ]
    normal = penalty + AT_REST * rest.T @ rest
    moments, error_moments = np.zeros((2, len(normal)))
    for blocks, count in sets:
        normal += _squares([block for block, _ in blocks]) / count
        moments += sum(block.T @ load for block, load in blocks) / count
    weights = np.linalg.solve(normal, moments)
    single = weights.astype(np.float32)
    for blocks, count in sets:
        error_moments += sum(block.T @ np.abs(block @ single - load) for block, load in blocks) / count
    errors = np.linalg.solve(normal, error_moments)
    return Learned(
        smoothing_s=SMOOTHING_S,
        lags_s=lags_s,
        plays=widths,
        paths_s=paths_s,
        mean=tuple(map(float, mean)),
        scale=tuple(map(float, scale)),
        seed=seed,
        directions=directions,
        weights=tuple(map(float, weights)),
        error_weights=tuple(map(float, errors)),
        std_factor=1.25,
        std_floor=0.005,
        limits=calibration.limits,
        reached=_reached(data.real, data.simulated),
    )


def _reached(*sets: FloatArray) -> Reached:
    """Range of the features in sets of rows (rows, count), without :data:`OUTLIERS` at either end of each set."""
    ranges = np.array([np.quantile(features, [OUTLIERS, 1 - OUTLIERS], axis=0) for features in sets])
    return Reached(
        lowest=tuple(map(float, ranges[:, 0].min(axis=0))), highest=tuple(map(float, ranges[:, 1].max(axis=0)))
    )


Single = NDArray[np.float32]


def _blocks(terms: Terms, features: FloatArray, load: FloatArray) -> Iterator[tuple[Single, Single]]:
    """Terms (rows, terms) of features (rows, count), and their loads, in blocks that fit the processor's cache."""
    for start in range(0, len(features), TOGETHER):
        place = slice(start, start + TOGETHER)
        block = np.asarray(terms(terms.standardised(features[place])), dtype=np.float32)
        yield block, load[place].astype(np.float32)


def _squares(blocks: Sequence[Single]) -> FloatArray:
    """(terms, terms) sums of squares and products of the terms, each block's in single precision.

    What single precision loses is far below the ridge.
    """
    from scipy.linalg.blas import ssyrk

    upper = np.zeros((blocks[0].shape[1],) * 2)
    for block in blocks:
        upper += ssyrk(1.0, block.T)
    return np.asarray(np.triu(upper) + np.triu(upper, 1).T)


def play(calibration: NormalisedRecording, simulated: tuple[FloatArray, FloatArray, float]) -> Learned:
    """A Prandtl-Ishlinskii inverse: linear regression on ten play operators and a cubic."""
    plays = tuple(np.linspace(0.03, 0.6, 10))
    return learn(calibration, simulated, lags_s=(), plays=plays, directions=0, ridge=1e-4, seed=0)


def distilled(
    calibration: NormalisedRecording,
    simulated: tuple[FloatArray, FloatArray, float],
    *,
    paths_s: tuple[float, ...] = (),
    seed: int = 1,
) -> Learned:
    """The inverse of the identified model, distilled into a regression on lags, plays, paths and cosines of these."""
    plays = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5)
    return learn(
        calibration,
        simulated,
        lags_s=LAGS_S,
        plays=plays,
        paths_s=paths_s,
        directions=DIRECTIONS,
        ridge=5e-5,
        seed=seed,
    )


def with_calibrated_std(
    learned: Learned, judged: Sequence[FoldErrors], *, drift: float, simulated_error: float, most: float
) -> Learned:
    """``learned`` with a standard deviation calibrated on held-out folds (split conformal prediction by regime).

    The deviation is the learned one times a factor, but at least a floor. Factor and floor are chosen such that 95 % of
    the errors lie within two deviations, before the final multiplication by ``DRIFT``. This holds for each of the last
    :data:`CALIBRATION_FOLDS` folds, and separately at rest, under a held load, and under a changing load, so that long
    rests do not mask errors under presses. Earlier folds are left out, since too little training data may precede them.
    If a factor of :data:`WIDEST` is not enough, the floor rises. The floor never exceeds ``most``.

    Args:
        learned: the estimator.
        judged: held-out errors fold by fold, with the deviations that ``learned`` states so far.
        drift: mean error of the static curve on the fold where that error is largest, normalised load. The estimator
            compensates this drift by its memory, but cannot know a drift that outlasts the recording.
        simulated_error: rms error on simulated cells under random loads, normalised load, if the recorded presses are
            few or all alike, and thus represent no others; else 0.
        most: largest floor, normalised load: the rms error of the static curve.
    """
    last = judged[-CALIBRATION_FOLDS:]
    regimes = [part for fold in last for part in fold.regimes()]
    floor = max(FLOOR * max(fold.pressed_rms for fold in last), UNKNOWN_DRIFT * drift, SUREST)
    needed = [np.where(error > 2 * floor, error / (2 * np.maximum(std, 1e-9)), 0.0) for error, std in regimes]
    widen = float(np.clip(max(np.quantile(factor, 0.95, method="higher") for factor in needed), NARROWEST, WIDEST))
    for error, std in regimes:
        if np.mean(error <= 2 * np.maximum(widen * std, floor)) < 0.95:
            floor = max(floor, float(np.quantile(error, 0.95, method="higher")) / 2)
    floor = max(min(max(floor, simulated_error), most), SUREST)
    return learned.replace(std_factor=learned.std_factor * DRIFT * widen, std_floor=DRIFT * floor)
