"""Calibration of the learned estimators: ridge regressions on the recording and on variations of the identified cell.

The identified model, not trusted to be exact, is run through loads the recording does not have (random ones, and
variations of its own), with its parameters jittered and its unexplained error added as slow noise; the recording
itself weighs as much as all of that. An estimator thus knows what the material does under loads that nobody applied,
but is not asked to believe the model to the last digit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...arrays import FloatArray
from ..inversions import BEYOND, DRIFT, UNKNOWN_DRIFT, Bank, Learned, Limits, Reached, StaticCurve, Terms
from ..materials import simulate
from ._fitted import Simulation
from ._judged import Judged

LAGS_S = (0.5, 2.0, 8.0, 30.0, 120.0)
"""of the distilled estimator; longer ones are memories of how the recording began"""
PATHS_S = (5.0, 20.0, 80.0)
"""of the distilled estimator of a cell whose conductive chains break under motion, and heal in seconds to minutes"""
SMOOTHING_S = 0.1
DIRECTIONS = 600
CELLS, SECONDS = 96, 400.0
STATIC_CELLS = 12
"""simulated to see what a static curve is worth at other speeds"""
MOST_STEPS, FEWEST_SAMPLES = 50000, 500
"""time steps that a recording may have on the grid of the simulations, and samples that a simulated cell has"""
R0_ERROR = 0.03
"""standard deviation of R0, relative, that an estimator must live with. It is larger than the error of an R0 that was
just read (``REST_ERROR``): R0 drifts after a calibration, and no stated deviation counts that drift"""
CREEP = 0.08
"""of the range of r: what creep too slow for the recording, and loads before it, may add"""
CREEP_LENGTH = (0.08, 1.33)
"""its time constants, in lengths of the recording"""
TELLING = 2
"""folds, of those at the end, that the standard deviations of learned estimators are calibrated on"""
NARROWEST, WIDEST = 0.5, 3.0
"""factors by which held-out folds may change a learned standard deviation"""
FLOOR, SUREST = 0.5, 0.02
"""least standard deviation: share of the rms error of a fold, and normalised load"""
AT_REST = 3.0
"""weight of a cell that has always read R0, for which no load is to be answered"""
UNEXPLAINED = ((3.0, 0.5), (60.0, 0.7))
"""over how many seconds the model's error wanders, and how much of it does"""
OUTLIERS = 1e-3
"""share of the rows at either end that the range of a feature leaves out"""
ROWS = 20000
"""of synthetic samples that enter the regression"""
TOGETHER = 512
"""rows of the regression whose terms are worked out at once"""


@dataclass(frozen=True)
class NormalisedRecording:
    """A recording in normalised units, and the cell it was found to be."""

    time_s: FloatArray
    r: FloatArray
    load: FloatArray
    rest_resistance_ohm: float
    simulation: Simulation
    unexplained: float
    """rms of r that the identified model leaves"""

    @property
    def seconds(self) -> float:
        """Length of the recording."""
        return float(self.time_s[-1] - self.time_s[0])

    @property
    def spread(self) -> float:
        """Range of r, without its outliers."""
        low, high = np.percentile(self.r, [0.5, 99.5])
        return float(high - low)

    @property
    def limits(self) -> Limits:
        """Loads worth answering: from the least seen to a fifth beyond full scale, which calibration may miss."""
        low, high = np.percentile(self.load, [0.1, 99.9])
        return Limits(lowest=min(float(low), 0.0), highest=max(float(high), 1.0) * BEYOND)

    def until(self, time_s: float) -> NormalisedRecording:
        """The part of the recording before ``time_s``."""
        part = self.time_s < time_s
        return replace(self, time_s=self.time_s[part], r=self.r[part], load=self.load[part])


@dataclass(frozen=True)
class Rows:
    """Features (rows, count) and loads (rows,), of the recording and of the simulated variations of it."""

    real: FloatArray
    real_load: FloatArray
    simulated: FloatArray
    simulated_load: FloatArray


def static_curve(calibration: NormalisedRecording, full_scale_kpa: float, *, logarithmic: bool = False) -> StaticCurve:
    """The cubic that fits the recording best."""
    r, load = calibration.r, calibration.load
    x = -np.log(np.maximum(1 + r, 1e-6)) if logarithmic else r
    # Few different readings leave a cubic open, of which this is the least; `full` says that without a warning.
    polynomial, _ = np.polynomial.Polynomial.fit(x, load, 3, full=True)
    coefficients = polynomial.convert().coef
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
    """Rms error of a static curve, normalised load, on loads and speeds that the recording does not have.

    The identified cell is simulated under random ramps and holds. A curve does not know what the cell remembers.
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
    """Loads and readings (n, m) of simulated cells, and their time step."""
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
    """Readings (n, m) with what a model of the cell does not know: its own error, noise, creep, and an error of R0."""
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
    """Features of the recording and of its variations, thinned.

    The recording enters as it is, as if R0 were lower or higher, and as if creep went on in it for longer.
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
        real=real.transpose(0, 2, 1).reshape(-1, bank.count),
        real_load=np.repeat(calibration.load, real.shape[2]),
        simulated=found[::thin].transpose(0, 2, 1).reshape(-1, bank.count),
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
    """Ridge regression of the load on the terms of :class:`~.learned.Learned`, then of its absolute error.

    ``plays`` are half widths over the range of r. The standard deviation is only a proportion here; see
    :func:`calibrated`.
    """
    widths = tuple(float(width) * calibration.spread for width in plays)
    bank = Bank(smoothing_s=SMOOTHING_S, lags_s=lags_s, plays=widths, paths_s=paths_s)
    data = rows(calibration, bank, simulated)
    mean = data.simulated.mean(axis=0)
    scale = np.maximum(data.simulated.std(axis=0), 1e-6 * max(calibration.spread, 1e-9))
    terms = Terms(mean, scale, seed, directions, np.float32)  # cosines cost most; sums are in float64
    at_rest = bank.features(bank.begin(np.zeros(1)))
    rest = np.asarray(terms(terms.standardised(at_rest)), dtype=np.float64)
    penalty = ridge * np.eye(rest.shape[1])
    penalty[0, 0] = 0.0
    sets = (data.simulated, data.simulated_load), (data.real, data.real_load)
    normal = penalty + AT_REST * rest.T @ rest
    moments = np.zeros(len(normal))
    for features, load in sets:
        squares, products = np.zeros_like(normal), np.zeros_like(moments)
        for place, block in _blocks(terms, features):
            squares += block.T @ block
            products += block.T @ load[place]
        normal += squares / len(features)
        moments += products / len(features)
    weights = np.linalg.solve(normal, moments)

    error_moments = np.zeros_like(moments)
    for features, load in sets:
        products = np.zeros_like(moments)
        for place, block in _blocks(terms, features):
            products += block.T @ np.abs(block @ weights - load[place])
        error_moments += products / len(features)
    errors = np.linalg.solve(normal, error_moments)
    return Learned(
        smoothing_s=SMOOTHING_S,
        smoothed=False,
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
    """Range of features in sets of rows (rows, count), but for the :data:`OUTLIERS` at either end of each set."""
    ranges = np.array([np.quantile(features, [OUTLIERS, 1 - OUTLIERS], axis=0) for features in sets])
    return Reached(
        lowest=tuple(map(float, ranges[:, 0].min(axis=0))), highest=tuple(map(float, ranges[:, 1].max(axis=0)))
    )


def _blocks(terms: Terms, features: FloatArray) -> Iterator[tuple[slice, FloatArray]]:
    """All terms (rows, terms) of features (rows, count) in float64, in blocks that stay in the processor's cache."""
    for start in range(0, len(features), TOGETHER):
        place = slice(start, start + TOGETHER)
        yield place, np.asarray(terms(terms.standardised(features[place].T)), dtype=np.float64)


def play(calibration: NormalisedRecording, simulated: tuple[FloatArray, FloatArray, float]) -> Learned:
    """A Prandtl-Ishlinskii inverse: ten plays and a cubic, linear in everything."""
    plays = tuple(np.linspace(0.03, 0.6, 10))
    return learn(calibration, simulated, lags_s=(), plays=plays, directions=0, ridge=1e-4, seed=0)


def distilled(
    calibration: NormalisedRecording,
    simulated: tuple[FloatArray, FloatArray, float],
    *,
    paths_s: tuple[float, ...] = (),
    seed: int = 1,
) -> Learned:
    """Lags, plays, paths and cosines of them: the inverse of the identified model, distilled into a map."""
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


def calibrated(learned: Learned, judged: Sequence[Judged], *, drift: float, elsewhere: float, most: float) -> Learned:
    """``learned`` with a standard deviation that held-out folds bear out (split conformal prediction by regime).

    On each of the last :data:`TELLING` folds, 95 % of the errors at rest, of those under a load that is held, and of
    those while the load changes, lie within two of the deviations before these are multiplied by ``DRIFT``. A fold that
    is mostly rest thus says no less about presses. What comes before an earlier fold may have been too little to learn
    from. The deviation is the learned one times a factor, but not below a floor. If a factor of :data:`WIDEST` is not
    enough, the floor rises.

    Args:
        learned: what is to get the deviation.
        judged: one fold after the other, with the deviations that ``learned`` states as it is.
        drift: mean error of the static curve on the fold where that was largest, normalised load. The estimator makes
            up for this drift from its memory, but cannot know a drift that goes on for longer than the recording.
        elsewhere: rms error on simulated cells under random loads, normalised load, where the recorded presses are all
            alike, or few, and say little of others; else 0.
        most: what the floor never exceeds, normalised load: the rms error of the static curve.
    """
    last = judged[-TELLING:]
    regimes = [part for fold in last for part in fold.regimes()]
    floor = max(FLOOR * max(fold.pressed_rms for fold in last), UNKNOWN_DRIFT * drift, SUREST)
    needed = [np.where(error > 2 * floor, error / (2 * np.maximum(std, 1e-9)), 0.0) for error, std in regimes]
    widen = float(np.clip(max(np.quantile(factor, 0.95, method="higher") for factor in needed), NARROWEST, WIDEST))
    for error, std in regimes:
        if np.mean(error <= 2 * np.maximum(widen * std, floor)) < 0.95:
            floor = max(floor, float(np.quantile(error, 0.95, method="higher")) / 2)
    floor = max(min(max(floor, elsewhere), most), SUREST)
    return learned.replace(std_factor=learned.std_factor * DRIFT * widen, std_floor=DRIFT * floor)
