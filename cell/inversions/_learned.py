"""Learned estimators: linear maps of random Fourier features; their tables in CELL.toml, and how they run."""

from __future__ import annotations

import math
from functools import cache, lru_cache
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Record, Records, zeros
from ...common.config import Finite, NotNegative, Positive, Section
from .._state import CellState
from ..estimation import Inversion
from ._features import Bank

Numbers = Annotated[tuple[Finite, ...], Field(strict=False, min_length=1, max_length=4000)]
"""a list in TOML, not empty"""
Positives = Annotated[tuple[Positive, ...], Field(strict=False, max_length=64)]

CLIP = 3.5
"""standard deviations at which a feature is clipped, since nothing was learned beyond"""
STEEPER = 2.0
"""largest slope of load over resistance outside the recording, over the mean slope"""
SATURATED = 5.0
"""largest slope at the end of a static curve, over the mean slope; a steeper end counts as this"""
BEYOND = 1.2
"""largest load that is answered, over the largest load learned from: calibration may have missed full scale"""
FADES = 0.25
"""distance beyond the recorded readings over which the share of the static curve fades, over their range"""
CREDIBLE = 3.0
"""largest distance of a credible reading from the readings learned from, over their range"""
STILL = 0.01
"""a cell is estimated afresh when a feature has moved by this many standard deviations since the last time"""
BLOCK = 512
"""cells mapped at once, so that the cosines stay in the processor's cache"""


class Limits(Section):
    """What a learned estimator may answer, as normalised load."""

    lowest: Finite
    highest: Finite


class Seen(Section):
    """The conditions of the calibration recording, under which the standard deviations hold."""

    noise: NotNegative = 0.0
    """noise of a reading from sample to sample, relative to the reading"""
    step_s: NotNegative = 0.0
    """usual time between samples"""
    speed_kpa_per_s: NotNegative = 0.0
    """rms change of the load in a second"""
    longest_load_s: NotNegative = 0.0
    """longest time for which the cell was loaded; 0: unknown"""


class Reached(Section):
    """Range of each feature in the data that a map was learned from, as normalised resistance.

    Beyond the range nothing is known of the cell. A feature that lies outside by some resistance may stand for a load
    of :data:`STEEPER` times what this resistance is at equilibrium, and the standard deviation grows by that load.
    """

    lowest: Numbers
    highest: Numbers

    def excess(self, features: FloatArray) -> FloatArray:
        """(m,) the largest distance of any of the features (m, count) from its range."""
        low, high = self.limits
        return np.asarray(np.maximum(np.maximum(low - features, features - high).max(axis=1), 0.0))

    @property
    def limits(self) -> tuple[FloatArray, FloatArray]:
        """The lowest and highest features as arrays (count,) that nobody may write to."""
        return _row(self.lowest), _row(self.highest)


class StaticCurve(Section):
    """A monotone curve from the reading to the load: of r, or of log(R0/R) where contact dominates."""

    readings: Numbers
    """increasing; the curve is straight between them, and beyond"""
    loads: Numbers
    """of the readings"""
    logarithmic: bool = False
    limits: Limits
    std_kpa: Positive

    @model_validator(mode="after")
    def _is_monotone(self) -> Self:
        if len(self.readings) != len(self.loads) or len(self.readings) < 2:
            raise ValueError(f"{len(self.readings)} readings and {len(self.loads)} loads; expected as many, at least 2")
        if not (np.diff(self.readings) > 0).all():
            raise ValueError("readings must increase")
        steps = np.diff(self.loads)
        if not ((steps >= 0).all() or (steps <= 0).all()):
            raise ValueError("loads must rise, or fall, all along")
        return self

    def load(self, r: FloatArray) -> FloatArray:
        """The normalised load for a normalised resistance, not limited; a straight line beyond what was recorded."""
        x = self.reading(r)
        reading, load = _row(self.readings), _row(self.loads)
        return np.asarray(np.interp(x, reading, load) + self._slope * (x - _clip(x, reading[0], reading[-1])))

    def doubt(self, r: FloatArray) -> FloatArray:
        """Standard deviation, as normalised load, that readings beyond the range of the recording add.

        Towards more load it grows with the slope of the curve at that end: where readings saturate, they tell little.
        """
        x, reading, load = self.reading(r), _row(self.readings), _row(self.loads)
        mean = self._slope
        at_end = (load[-1] - load[-2]) / (reading[-1] - reading[-2]) if mean > 0 else 0.0
        if mean <= 0:
            at_end = (load[1] - load[0]) / (reading[1] - reading[0])
        slope = min(max(abs(at_end), abs(mean)), SATURATED * abs(mean))
        above, below = np.maximum(x - reading[-1], 0.0), np.maximum(reading[0] - x, 0.0)
        more, less = (above, below) if mean > 0 else (below, above)
        return np.asarray(STEEPER * (slope * more + abs(mean) * less))

    @property
    def range(self) -> tuple[float, float]:
        """Least and largest reading that the curve was fitted to."""
        return self.readings[0], self.readings[-1]

    @property
    def _slope(self) -> float:
        """Mean slope."""
        return (self.loads[-1] - self.loads[0]) / (self.readings[-1] - self.readings[0])

    def reading(self, r: FloatArray) -> FloatArray:
        """The argument of the curve: r, or log(R0/R)."""
        return -np.log(np.maximum(1 + r, 1e-6)) if self.logarithmic else r


@lru_cache(maxsize=256)
def _row(values: tuple[float, ...]) -> FloatArray:
    row = np.array(values)
    row.flags.writeable = False
    return row


class Learned(Section):
    """A linear map of features, powers of the first one, and random Fourier features (cosines along random directions).

    The directions follow from ``seed``, so that all cells of a skin share them and the file stays short.
    """

    smoothing_s: Positive
    lags_s: Positives
    plays: Positives
    paths_s: Positives = ()
    """(): motion breaks no chains of this cell"""
    mean: Numbers
    scale: Positives
    seed: Annotated[int, Field(ge=0)] = 0
    directions: Annotated[int, Field(ge=0, le=3000)] = 0
    weights: Numbers
    """1, features, square and cube of the first feature, cosines -> normalised load"""
    error_weights: Numbers
    """the same terms -> expected absolute error of the load"""
    std_factor: Positive
    """standard deviation over expected absolute error, as confirmed by held-out data"""
    std_floor: NotNegative
    limits: Limits
    reached: Reached
    """range of the features that were learned from"""
    static_share: Annotated[float, Field(ge=0, le=1)] = 0.0
    """weight of the static curve in the answer; the rest is the map's"""
    beyond_recorded: bool = False
    """whether the map is followed to readings that were simulated and not recorded, since its model explains the
    resistance; otherwise a straight line goes on from the recorded ones"""

    @property
    def bank(self) -> Bank:
        """The memories from which the features are made."""
        return Bank(self.smoothing_s, self.lags_s, self.plays, self.paths_s)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.paths_s and len(self.plays) < 2:
            raise ValueError(f"paths_s needs two plays at least, got {len(self.plays)}")
        count = self.bank.count
        terms = 3 + count + self.directions
        for name, length in (("mean", count), ("scale", count), ("weights", terms), ("error_weights", terms)):
            if len(getattr(self, name)) != length:
                raise ValueError(f"{name} must have {length} entries, got {len(getattr(self, name))}")
        if {len(self.reached.lowest), len(self.reached.highest)} != {count}:
            raise ValueError(f"reached must have {count} entries each")
        return self


class Terms:
    """Features (m, count) to the terms of the linear map (m, 3 + count + directions)."""

    def __init__(
        self, mean: FloatArray, scale: FloatArray, seed: int, directions: int, dtype: type[np.floating] = np.float64
    ) -> None:
        from scipy.special import ndtri

        self.mean, self.scale = mean, scale
        raw = np.random.PCG64(seed).random_raw((len(mean) + 1) * directions)  # a stream that numpy keeps for ever
        uniform = ((raw >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53
        uniform = uniform.reshape(len(mean) + 1, directions)
        self._directions = (ndtri(uniform[1:]) / np.sqrt(len(mean))).astype(dtype)
        self._phases = (2 * np.pi * uniform[0]).astype(dtype)
        self._amplitude = dtype(np.sqrt(2.0 / max(directions, 1)))
        self._dtype = dtype

    def standardised(self, features: FloatArray) -> FloatArray:
        """Features in standard deviations."""
        return (features - self.mean) / self.scale

    def __call__(self, standardised: FloatArray) -> NDArray[np.floating]:
        """All terms of standardised features, which are clipped at :data:`CLIP`."""
        z = _clip(standardised, -CLIP, CLIP).astype(self._dtype)
        first = z[:, :1]
        cosines = self._amplitude * np.cos(z @ self._directions + self._phases)
        return np.concatenate([np.ones_like(first), z, first**2, first**3, cosines], axis=1)


def _clip(values: FloatArray, low: FloatArray | float, high: FloatArray | float) -> FloatArray:
    """As numpy.clip, which takes several times as long for a few values."""
    return np.asarray(np.minimum(np.maximum(values, low), high))


def _followed_between(learned: Learned, curve: StaticCurve) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest features (count,) to which a map is followed.

    The map knows little beyond the recorded readings, and nothing beyond the range of the other features. Beyond these
    limits the answer goes on with the slope at equilibrium.
    """
    low, high = (limit.copy() for limit in learned.reached.limits)
    if not learned.beyond_recorded:
        low[0], high[0] = max(low[0], curve.range[0]), min(high[0], curve.range[1])
    return low, high


def credible_range(low: float, high: float) -> tuple[float, float]:
    """Range of credible r: up to :data:`CREDIBLE` times the range of the readings learned from, beyond this range."""
    span = CREDIBLE * max(high - low, 1e-9)
    return max(low - span, -1.0), high + span


class LearnedInversion(Inversion):
    """Runs a :class:`Learned` map and the static curve; a cell whose features have not moved keeps its last answer."""

    def __init__(
        self, learned: Learned, curve: StaticCurve, full_scale_kpa: float, full_scale_r: float, *, exact: bool
    ) -> None:
        self.learned, self._curve, self._bank = learned, curve, learned.bank
        self.memory = _memory_of(self._bank.rows, self._bank.count)
        self._terms = Terms(
            np.array(learned.mean), np.array(learned.scale), learned.seed, learned.directions, np.float32
        )
        self._weights = np.array([learned.weights, learned.error_weights], dtype=np.float32).T
        self._slope = math.copysign(1 / max(abs(full_scale_r), 1e-9), full_scale_r)
        """normalised load per r, at equilibrium"""
        self._within = _followed_between(learned, curve)
        credible = credible_range(learned.reached.lowest[0], learned.reached.highest[0])
        super().__init__(full_scale_kpa, full_scale_r, credible=credible, exact=exact)

    def begin(self, cells: Records[CellState], memory: Records[Record], places: IntArray, r: FloatArray) -> None:
        begun = zeros(self.memory, places.size)
        begun["bank"] = bank = self._bank.begin(r)
        begun["features"] = self._terms.standardised(self._bank.advance(bank, 1.0, r))
        memory[places] = begun
        cells["gain_kpa"][places] = self.full_scale_kpa * abs(self._slope)
        self._answer(cells, places, begun["features"])

    def advance(self, cells: Records[CellState], memory: Records[Record], awake: IntArray, dt_s: float) -> None:
        banks, features = memory["bank"], memory["features"]
        bank = banks[awake]
        now = self._terms.standardised(self._bank.advance(bank, dt_s, cells["level"][awake]))
        banks[awake] = bank
        moved = np.abs(now - features[awake]).max(axis=1) > STILL
        if not moved.any():
            return
        features[awake[moved]] = now[moved]
        self._answer(cells, awake[moved], now[moved])

    def _answer(self, cells: Records[CellState], places: IntArray, standardised: FloatArray) -> None:
        """Map features (k, count) of the cells at ``places`` (k,)."""
        load, std = self._map(standardised)
        cells["pressure_kpa"][places] = load * self.full_scale_kpa
        cells["variance_kpa2"][places] = (std * self.full_scale_kpa) ** 2

    def settled(self, cells: Records[CellState], memory: Records[Record], places: IntArray, band: float) -> BoolArray:
        return np.asarray(self._bank.unrest(memory["bank"][places]) < 2 * band)

    def _map(self, standardised: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Normalised load and its standard deviation (m,) for standardised features (m, count)."""
        load, expected, beyond = self.parts(standardised * self._terms.scale + self._terms.mean)
        std = np.maximum(expected * self.learned.std_factor, self.learned.std_floor)
        return load, np.hypot(std, beyond)

    def parts(self, features: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Normalised loads (m,) of features (m, count), the errors expected, and the deviation beyond what is known."""
        learned, curve = self.learned, self._curve
        reading, (low, high) = features[:, 0], self._within
        inside, outside = self._terms.standardised(_clip(features, low, high)), learned.reached.excess(features)
        found = np.empty((len(features), 2))
        for start in range(0, len(found), BLOCK):
            block = slice(start, start + BLOCK)
            found[block] = self._terms(inside[block]) @ self._weights
        load = found[:, 0] + self._slope * (reading - _clip(reading, low[0], high[0]))
        if learned.static_share:
            load = load + self._static_share(reading) * (curve.load(reading) - load)
        beyond = np.maximum(STEEPER * outside * abs(self._slope), curve.doubt(reading))
        beyond = np.hypot(beyond, STEEPER * np.maximum(load - learned.limits.highest / BEYOND, 0.0))
        return _clip(load, learned.limits.lowest, learned.limits.highest), found[:, 1], beyond

    def run(self, dt_s: FloatArray, r: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """:meth:`parts` of a whole recording (n,) that starts from a long-held reading."""
        return self.parts(self._bank.run(dt_s, r[:, None])[:, 0])

    def _static_share(self, reading: FloatArray) -> FloatArray | float:
        """Weight of the static curve; it fades beyond the recorded readings if the map is followed there."""
        learned, (low, high) = self.learned, self._curve.range
        if not learned.beyond_recorded:
            return learned.static_share
        beyond = np.abs(reading - _clip(reading, low, high))
        return learned.static_share * np.maximum(1 - beyond / (FADES * max(high - low, 1e-9)), 0.0)


@cache
def _memory_of(rows: int, count: int) -> type[Record]:
    """The memory of a learned estimator: its bank, and the features of its last answer in standard deviations."""
    fields = {"bank": Annotated[FloatArray, rows], "features": Annotated[FloatArray, count]}
    return type("LearnedState", (Record,), {"__annotations__": fields})
