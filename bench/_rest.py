"""Rest between taps: what the default estimator shows, and the Cramer-Rao bound of an estimate that knows every turn.

``ohmskin bench --estimators`` prints the table. The bound is that of least squares on all readings so far. It knows the
cell, the noise, and when the load turned and began to be held; it does not know the loads that were held, nor that a
released cell bears none. No estimator without that last assumption does better.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from ..cell import Cell, PaperModel
from ..common.arrays import FloatArray
from ._hard_cases import TAP_KPA
from ._honesty import CELLS, VOLTS_AT_REST, estimated, readings

TAPS = 12
EDGE_S = 0.03
BEGIN_S = 1.0
JUDGED = 0.3
"""of a period before the last tap, in which the rest is looked at"""
SUBSTEPS = 4
"""in which a frame is simulated"""
SEEDS = 10
CASES = ((50.0, 1.0, 1.0), (50.0, 1.0, 10.0), (100.0, 1.0, 10.0), (250.0, 1.0, 10.0), (50.0, 3.0, 10.0))
"""frames per second, taps per second, noise in mV"""


@dataclass(frozen=True)
class Rest:
    """Twelve taps on the shipped example cell, eight cells, with so much noise."""

    rate_hz: float
    taps_hz: float
    noise_mv: float
    median_kpa: float
    """of the seeds: the largest pressure of any cell and frame shown at rest before the last tap"""
    largest_kpa: float
    """of all seeds"""
    bound_kpa: float
    """standard deviation of the best estimate that does not take a released cell for one without load"""
    worst: float
    """largest error over its stated deviation, of all frames and seeds"""


def levels(time_s: FloatArray, taps_hz: float) -> FloatArray:
    """(n, 2 TAPS + 1) shares of the loads that are held in turn, rests first and last: edges are straight."""
    period_s = 1.0 / taps_hz
    corners_s, held = [0.0, BEGIN_S], [0, 0]
    for tap in range(TAPS):
        start_s = BEGIN_S + tap * period_s
        half_s = start_s + 0.5 * period_s
        corners_s += [start_s + EDGE_S, half_s, half_s + EDGE_S, start_s + period_s]
        held += [2 * tap + 1] * 2 + [2 * tap + 2] * 2
    shares = (np.array(held)[:, None] == np.arange(2 * TAPS + 1)).astype(np.float64)
    return np.stack([np.interp(time_s, corners_s, share) for share in shares.T], axis=1)


def taps(time_s: FloatArray, taps_hz: float) -> FloatArray:
    """(n,) loads in kPa."""
    pressed: FloatArray = levels(time_s, taps_hz)[:, 1::2].sum(axis=1)
    return TAP_KPA * pressed


def bound_kpa(cell: Cell, rate_hz: float, taps_hz: float, noise_mv: float) -> float:
    """Standard deviation in kPa of the load at the end of the last rest but one, by least squares; see the module."""
    if not isinstance(cell.model, PaperModel):
        raise TypeError("the bound is worked out for cells of kind paper")
    frames = round((BEGIN_S + (TAPS - 1) / taps_hz) * rate_hz)
    step_s = 1.0 / rate_hz / SUBSTEPS
    time_s = step_s * np.arange(1.0, frames * SUBSTEPS + 1)
    held = levels(time_s, taps_hz)[:, 1 : 2 * TAPS - 1]
    loads = taps(time_s, taps_hz)

    def r(kpa: FloatArray) -> FloatArray:
        ohm = cell.forward(kpa.shape[1:]).run(np.full(len(kpa), step_s), kpa)
        return np.asarray(ohm[SUBSTEPS - 1 :: SUBSTEPS] / cell.rest_resistance_ohm - 1.0)

    # The loads turn at the same times if one of them is a little larger. The cell is linear between turns.
    little = 1e-4 * TAP_KPA
    slopes = (r(loads[:, None] + little * held) - r(loads[:, None])) / little
    noise = 1e-3 * noise_mv / VOLTS_AT_REST * (1.0 + r(loads[:, None])) ** 2
    scaled = slopes / noise
    return float(np.sqrt(np.linalg.inv(scaled.T @ scaled)[-1, -1]))


def rests(cases: Iterable[tuple[float, float, float]] = CASES, *, seeds: int = SEEDS) -> Iterator[Rest]:
    """One row for each frame rate, rate of taps, and noise."""
    cell = Cell.example()
    for rate_hz, taps_hz, noise_mv in cases:
        frames = round((BEGIN_S + (TAPS + 2) / taps_hz) * rate_hz)
        time_s = np.arange(1.0, frames * SUBSTEPS + 1) / rate_hz / SUBSTEPS
        load = np.repeat(taps(time_s, taps_hz)[:, None], CELLS, axis=1) / cell.full_scale_kpa
        true = load[SUBSTEPS - 1 :: SUBSTEPS] * cell.full_scale_kpa
        frame_s = time_s[SUBSTEPS - 1 :: SUBSTEPS]
        last_s = BEGIN_S + (TAPS - 1) / taps_hz
        judged = (frame_s > last_s - JUDGED / taps_hz) & (frame_s < last_s - 0.5 / rate_hz)
        shown, over = [], []
        for seed in range(seeds):
            random = np.random.default_rng(seed)
            read = readings(cell, load, 1.0 / rate_hz, noise_mv, random, substeps=SUBSTEPS)
            pressure, std = estimated(cell, read, np.ones(frames, dtype=np.bool_), 1.0 / rate_hz, bits=12)
            shown.append(float(np.abs(pressure[judged]).max()))
            known = frame_s > 0.5 * BEGIN_S
            over.append(float((np.abs(pressure - true) / std)[known].max()))
        yield Rest(
            rate_hz=rate_hz,
            taps_hz=taps_hz,
            noise_mv=noise_mv,
            median_kpa=float(np.median(shown)),
            largest_kpa=max(shown),
            bound_kpa=bound_kpa(cell, rate_hz, taps_hz, noise_mv),
            worst=max(over),
        )


def table(rows: Iterable[Rest]) -> str:
    """The rows as text."""
    head = (
        f"rest before the last of twelve taps of 9 kPa, kPa; example cell, {CELLS} cells, {SEEDS} seeds\n"
        f"{'frames/s':>9}{'taps/s':>8}{'noise, mV':>11}{'median':>9}{'largest':>9}{'bound (sd)':>12}"
        f"{'worst error, sd':>17}"
    )
    lines = (
        f"{row.rate_hz:>9g}{row.taps_hz:>8g}{row.noise_mv:>11g}{row.median_kpa:>9.2f}{row.largest_kpa:>9.2f}"
        f"{row.bound_kpa:>12.2f}{row.worst:>17.1f}"
        for row in rows
    )
    return "\n".join([head, *lines])
