"""Uncertainty propagation: standard deviation of the estimated pressures as a sum of variances; shrinkage towards 0.

The variance of a followed cell sums several parts: noise, changes that the smoothing may not have noticed yet, the
inversion's memory, motion within the frame, the model, R0, bad contacts, and motion within the noise. A sleeping cell
may carry any load that its reading does not exclude. Small pressures that noise alone could cause are shown closer
to 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Places, Record, Records, Row, loop, record
from .._state import CellState
from ._conditions import Conditions
from ._inversion import DOUBT, USUAL, Inversion
from ._smoothing import HIDDEN, SIGMAS
from ._sparks import doubted_jump
from ._tremor import doubted_rise

TINY = 1e-30
"""avoids 0/0"""
MODEL_ERROR = 0.005
"""fraction of full scale: the least standard deviation without a calibration. It covers loads that an estimator
neglects: loads so small that a cell sleeps under them, and turning points below a percent. It does not estimate the
error of a model, which only a comparison with a recording can"""
NO_LOAD_SIGMAS = 2.0
"""standard deviations of the noise at which a load and no load are equally likely"""

LIGHT_LOAD = 0.02
"""fraction of full scale: larger loads of a released cell are not attributed to the memory's error, unless the cell has
been classified as at rest"""
DOUBTED_LOAD = 0.2
"""fraction of full scale: larger loads are not attributed to noise or to the memory's error while their rise is
unconfirmed"""


class Limits(Record):
    """Parameters of :func:`show_each`."""

    full_kpa: float
    most_kpa: float
    """pressure beyond which it is limited where its variance exceeds ``doubt_kpa2``"""
    doubt_kpa2: float
    light_kpa: float
    """:data:`LIGHT_LOAD` in kPa"""
    doubted_kpa2: float
    """square of :data:`DOUBTED_LOAD` in kPa"""
    rise_kpa: float
    """:attr:`._inversion.Inversion.steepness_kpa`: of a fast rise, and of a fast fall"""
    fall_kpa: float
    rests: float
    """as of :class:`._inversion.Inversion`, also the next ones"""
    seeming: float
    per_bend: float
    sure: float
    model_kpa2: float
    """variance by the model"""
    exact: float
    """1 where readings are exact, so that nothing is limited or shrunk, else 0"""
    stated: float
    """1 if a standard deviation is stated, else 0"""


class Deviation:
    """The variances of n cells in kPa^2. Those of gaps and creep are added when the variances are read."""

    def __init__(self, inversion: Inversion, conditions: Conditions, cells: int, at_rest: Records[CellState]) -> None:
        """``at_rest`` (1,) is the state of a sleeping cell."""
        full_kpa = inversion.full_scale_kpa
        self.stated = inversion.knows_errors or conditions.model_std_kpa > 0
        """whether a standard deviation is stated; else all are NaN"""
        rest_std_kpa = np.zeros(0) if conditions.rest_std_kpa is None else conditions.rest_std_kpa
        self._rest_kpa2 = rest_std_kpa**2
        self._rest_at_kpa = np.linspace(0, full_kpa, rest_std_kpa.size)
        self._limits = record(
            Limits,
            full_kpa=full_kpa,
            most_kpa=USUAL * full_kpa,
            doubt_kpa2=(DOUBT * full_kpa) ** 2,
            light_kpa=LIGHT_LOAD * full_kpa,
            doubted_kpa2=(DOUBTED_LOAD * full_kpa) ** 2,
            rise_kpa=float(inversion.steepness_kpa[0]),
            fall_kpa=float(inversion.steepness_kpa[1]),
            rests=inversion.rests,
            seeming=inversion.seeming,
            per_bend=inversion.bends[0],
            sure=inversion.bends[1],
            model_kpa2=(conditions.model_std_kpa or MODEL_ERROR * full_kpa) ** 2,
            exact=float(inversion.exact),
            stated=float(self.stated),
        )
        self._variance = np.full(cells, np.nan)
        """(n,) kPa^2 without gaps; replaced, never changed"""
        self._at_rest = at_rest
        self._hidden_kpa = np.full(cells, np.nan)
        """(n,) standard deviation of a load that the noise of a sleeping cell may hide; NaN where a cell is awake;
        replaced, never changed"""

    def show(self, cells: Records[CellState], places: IntArray, pressure_kpa: FloatArray) -> None:
        """Take a frame: write the pressures (n,) to show of followed cells, and renew their variances."""
        variance = self._variance.copy()
        of_rest = self._rest_at_kpa, self._rest_kpa2
        show_each.unchecked(cells, places, self._limits, *of_rest, pressure_kpa, variance)
        self._variance = variance

    def wake(self, awake: BoolArray) -> None:
        """Note which cells are ``awake`` (n,) now."""
        self._hidden_kpa = np.where(awake, np.nan, self._hidden_kpa)

    def renew(self, asleep: IntArray, noise: FloatArray) -> None:
        """Renew the variances of sleeping cells by their ``noise`` (m,)."""
        cell, variance, hidden_kpa = self._at_rest[0], self._variance.copy(), self._hidden_kpa.copy()
        own = own_kpa2.unchecked(cell, 0.0, self._limits, self._rest_at_kpa, self._rest_kpa2)
        variance[asleep] = own + cell.pressure_kpa * cell.pressure_kpa if self.stated else np.nan
        hidden_kpa[asleep] = cell.gain_kpa * (HIDDEN / SIGMAS) * noise
        self._variance, self._hidden_kpa = variance, hidden_kpa

    def of_last_step(
        self, shape: tuple[int, ...], reading: FloatArray, *more: FloatArray | None
    ) -> Callable[[], FloatArray]:
        """A function that returns the variances (shape) in kPa^2 of the last frame, at any time and in any thread.

        Args:
            shape: shape of a frame.
            reading: (n,) r of the frame; never changes again.
            more: (n,) further variances in kPa^2, which never change again; None: zero.
        """
        asleep = self._hidden_kpa, self._at_rest[0].gain_kpa / SIGMAS
        return partial(_total, shape, self._variance, asleep, reading, more)

    def state(self) -> dict[str, FloatArray]:
        """The state, by name."""
        return {"variance": self._variance, "hidden_kpa": self._hidden_kpa}

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a saved :meth:`state`."""
        self._variance, self._hidden_kpa = state["variance"], state["hidden_kpa"]


def _total(
    shape: tuple[int, ...],
    own: FloatArray,
    asleep: tuple[FloatArray, float],
    reading: FloatArray,
    added: tuple[FloatArray | None, ...],
) -> FloatArray:
    """(shape) kPa^2: variances (n,) of cells by themselves, by readings of sleeping ones, and ``added`` ones."""
    variance = own.copy()
    add_asleep_each.unchecked(variance, reading, *asleep)
    for more in added:
        if more is not None:
            variance += more
    return variance.reshape(shape)


@loop
def add_asleep_each(variance: Row, reading: Row, hidden_kpa: Row, kpa_per_r: float) -> None:
    """Add the variances of sleeping cells to ``variance`` (n,): a load that the noise hides, ``hidden_kpa`` (n,).

    Their readings (n,) may be due to a load as well, although none is shown. ``hidden_kpa`` is NaN elsewhere.
    """
    for i in range(variance.size):
        if not math.isnan(hidden_kpa[i]):
            std_kpa = abs(reading[i]) * kpa_per_r + hidden_kpa[i]
            variance[i] += std_kpa * std_kpa


@loop
def show_each(
    cells: Records[CellState],
    places: Places,
    limits: Limits,
    rest_at_kpa: Row,
    rest_kpa2: Row,
    pressure_kpa: Row,
    variance_kpa2: Row,
) -> None:
    """Write the pressures to show of cells to ``pressure_kpa`` (n,), and their variances to ``variance_kpa2`` (n,).

    ``rest_kpa2`` (m,) is the variance by R0 at the pressures ``rest_at_kpa`` (m,).
    """
    for k in range(places.size):
        cell = cells[places[k]]
        shown, off, slope = cell.pressure_kpa, cell.reading - cell.level, cell.gain_kpa
        if limits.fall_kpa != 0.0:
            slope = limits.fall_kpa if off < 0.0 else limits.rise_kpa
        doubt = (abs(off) * slope + cell.noise * cell.gain_kpa * HIDDEN) * (1.0 / SIGMAS)
        std_kpa = max(doubt, cell.level_std * cell.gain_kpa)
        by_rise, by_jump = doubted_rise(cell, limits.seeming), doubted_jump(cell)
        added = by_rise * by_rise + by_jump * by_jump
        if limits.exact == 0.0:
            # A pressure beyond full scale may just as well be an error of the memory.
            if cell.variance_kpa2 + added + std_kpa * std_kpa > limits.doubt_kpa2:
                shown = min(shown, limits.most_kpa)
            excess = max(cell.pressure_kpa - limits.full_kpa, 0.0)
            likely = shrunk(cell, shown, limits)
            added += excess * excess + (shown - likely) * (shown - likely)
            shown = likely
        pressure_kpa[places[k]] = shown
        own = own_kpa2(cell, std_kpa, limits, rest_at_kpa, rest_kpa2)
        variance_kpa2[places[k]] = own + added if limits.stated > 0.0 else math.nan


@loop
def shrunk(cell: CellState, shown_kpa: float, limits: Limits) -> float:
    """Pressure p, shrunk to p / (1 + (h / p^2)^2), as noise and the error of the memory alone may be the cause.

    Most cells carry no load. Where p^2 < h, no load is more likely than a load. The state of the cell is unchanged.
    """
    noise_kpa = cell.level_std * cell.gain_kpa
    hides = NO_LOAD_SIGMAS * noise_kpa
    hides *= hides
    light_kpa2 = limits.light_kpa * limits.light_kpa
    if cell.released > 0.0:
        # Low noise now does not help: the error of the memory comes from the noise of all taps so far.
        by_memory = (noise_kpa * noise_kpa + cell.rest_variance_kpa2) * limits.rests
        at_rest = cell.rested > 0.0 or shown_kpa < 0.0
        hides = by_memory if at_rest else max(hides, min(by_memory, light_kpa2))
    elif cell.unconfirmed > 0.0:
        # The rise is in doubt. A load that was clearly shown before the rise is not.
        by_memory = (noise_kpa * noise_kpa + cell.turn_variance_kpa2) * limits.rests
        loaded = cell.left_kpa < -(noise_kpa * math.sqrt(limits.rests) + limits.light_kpa)
        hides = max(hides, min(by_memory, light_kpa2 if loaded else limits.doubted_kpa2))
    squared = shown_kpa * shown_kpa
    squared *= squared
    return shown_kpa * (squared / (squared + hides * hides + TINY))


@loop
def own_kpa2(cell: CellState, std_kpa: float, limits: Limits, rest_at_kpa: Row, rest_kpa2: Row) -> float:
    """Variance of a cell whose readings leave a standard deviation ``std_kpa`` of the pressure."""
    own = std_kpa * std_kpa
    if limits.per_bend != 0.0:
        # A load whose rate has changed may have turned within the frame: no reading shows the turn yet.
        bend = abs(cell.pressure_kpa - 2.0 * cell.last_kpa + cell.before_last_kpa)
        bend = limits.per_bend * max(bend - limits.sure * math.sqrt(own), 0.0) * cell.gain_kpa
        own += bend * bend
    own += cell.variance_kpa2
    own += limits.model_kpa2
    if rest_at_kpa.size > 0:
        own += interpolated(cell.pressure_kpa, rest_at_kpa, rest_kpa2)
    return own


@loop
def interpolated(x: float, at: Row, values: Row) -> float:
    """:func:`numpy.interp` for a single number and evenly spaced places ``at`` (m,)."""
    place = (x - at[0]) / (at[1] - at[0])
    low = min(max(int(place), 0), at.size - 2)
    share = min(max(place - low, 0.0), 1.0)
    return float(values[low] + share * (values[low + 1] - values[low]))
