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
from ..inversions import BEYOND, Bank, Learned, Limits, Reached, Terms
from ..materials import simulate
from ._fitted import Simulation

LAGS_S = (0.5, 2.0, 8.0, 30.0, 120.0)
"""time constants of the distilled estimator; longer lags would only remember how the recording began"""
PATHS_S = (1.0, 5.0, 20.0, 80.0)
"""time constants of path lengths in the distilled estimator, for cells whose conductive chains break by motion and heal
in seconds to minutes"""
PLAYS = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5)
"""half widths of the plays, over the range of r"""
SMOOTHING_S = 0.1
DIRECTIONS, RIDGE = 600, 1.5e-5
CELLS, SECONDS = 96, 400.0
MOST_STEPS, FEWEST_SAMPLES = 50000, 500
"""largest number of time steps of a recording on the grid of the simulations; least number of samples of a simulated
cell"""
R0_ERROR = 0.03
"""relative standard deviation of R0 in training. It is larger than the error of an R0 that has just been measured
(``REST_ERROR``): R0 drifts after a calibration, and no stated deviation includes this drift"""
CREEP = 0.04
"""contribution to r, over its range, of creep that is too slow for the recording and of loads before it"""
CREEP_LENGTH = (0.08, 1.33)
"""range of the time constants of such creep, over the length of the recording"""
AT_REST = 3.0
"""weight in the regression of a cell that has always read R0, whose load is 0"""
UNEXPLAINED = ((3.0, 0.75), (60.0, 1.0))
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


def rows(
    calibration: NormalisedRecording, bank: Bank, simulated: tuple[FloatArray, FloatArray, float], *, exact: bool
) -> Rows:
    """Features of the recording, and thinned features of the simulated cells.

    The recording enters in several versions: unchanged, with a lower and a higher R0, and with additional slow creep.
    ``exact``: only unchanged.
    """
    load, r, dt = simulated
    steps = np.diff(calibration.time_s, prepend=calibration.time_s[0])
    found = bank.run(np.full(len(r), dt), r)
    thin = max(1, round(load.size / ROWS))
    if exact:
        real = bank.run(steps, calibration.r[:, None])
        return Rows(
            real=real.reshape(-1, bank.count),
            real_load=calibration.load,
            simulated=found[::thin].reshape(-1, bank.count),
            simulated_load=load[::thin].ravel(),
        )
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
    exact: bool = False,
) -> Learned:
    """Ridge regression of the load, then of its absolute error, on the terms of :class:`..inversions.Learned`.

    ``plays`` are half widths over the range of r. The scale of the standard deviation is preliminary; see
    :func:`._held_out.conformal`.
    """
    widths = tuple(float(width) * calibration.spread for width in plays)
    bank = Bank(smoothing_s=SMOOTHING_S, lags_s=lags_s, plays=widths, paths_s=paths_s)
    data = rows(calibration, bank, simulated, exact=exact)
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


def distilled(
    calibration: NormalisedRecording,
    simulated: tuple[FloatArray, FloatArray, float],
    *,
    exact: bool = False,
) -> Learned:
    """The inverse of the identified model, distilled into a regression on lags, plays, paths and cosines of these.

    ``exact``: the model is taken to be right, and R0 to be known.
    """
    return learn(
        calibration,
        simulated,
        lags_s=LAGS_S,
        plays=PLAYS,
        paths_s=PATHS_S,
        directions=DIRECTIONS,
        ridge=RIDGE,
        seed=1,
        exact=exact,
    )
