"""Clock alignment of a reference sensor with the skin (cross-correlation, then least squares), and loads by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import correlate, correlation_lags

from ..common.arrays import FloatArray
from ..common.tables import read_columns
from ..errors import InputError
from ._presses import Press
from ._tuning import LEAST_CORRELATION, LONGEST_DRIFT_PPM, RASTER_S, STEADY, SURE_STDS

MOST_SAMPLES = 10_000_000
"""largest length of the common raster: two days"""


@dataclass(frozen=True, slots=True)
class Alignment:
    """Clock model: skin time = t + ``offset_s`` + 1e-6 ``drift_ppm`` (t - ``middle_s``), t: reference time in s."""

    offset_s: float
    middle_s: float
    """reference time at which the offset holds"""
    drift_ppm: float
    """rate by which the reference's clock is slow"""
    correlation: float
    """correlation of the two loads after alignment; at most 1"""

    def skin_time_s(self, reference_s: FloatArray) -> FloatArray:
        """Times of the reference on the skin's clock."""
        drift: FloatArray = 1e-6 * self.drift_ppm * (reference_s - self.middle_s)
        return reference_s + self.offset_s + drift

    def text(self) -> str:
        """One line for people."""
        return (
            f"the reference's clock is {self.offset_s:.3f} s behind the skin's and drifts by {self.drift_ppm:.0f} ppm "
            f"(correlation {self.correlation:.3f})"
        )


def read_reference(path: str | Path) -> tuple[FloatArray, FloatArray]:
    """Times in s and pressures in kPa from a CSV file with the columns ``time_s,pressure_kpa``. Raises InputError."""
    columns = read_columns(path, ("time_s", "pressure_kpa"))
    known = np.isfinite(columns["pressure_kpa"]) & np.isfinite(columns["time_s"])
    time_s, kpa = columns["time_s"][known], columns["pressure_kpa"][known]
    if len(time_s) < 10 or not (np.diff(time_s) > 0).all():
        raise InputError(f"{path}: expected at least 10 readings whose time_s increases")
    return time_s, kpa


def align(skin_s: FloatArray, skin_kpa: FloatArray, reference_s: FloatArray, reference_kpa: FloatArray) -> Alignment:
    """Find the reference's offset and drift.

    Args:
        skin_s: (n,) increasing times on the skin's clock.
        skin_kpa: (n,) load estimated by the skin, in any unit.
        reference_s: (m,) increasing times on the reference's clock.
        reference_kpa: (m,) load by the reference.

    Raises:
        InputError: the two loads do not show the same presses, the drift is implausible, or a recording is too long.

    """
    length = max(np.ptp(skin_s), np.ptp(reference_s))
    if length / RASTER_S > MOST_SAMPLES:
        raise InputError(f"the reference or the skin was recorded for {length:.3g} s; are the times in seconds?")
    skin, reference = _raster(skin_s, skin_kpa), _raster(reference_s, reference_kpa)
    lag, correlation = _best_lag(skin, reference)
    offset_s = skin_s[0] - reference_s[0] + lag * RASTER_S
    if correlation < LEAST_CORRELATION:
        raise InputError(
            f"the reference does not show the presses that the skin felt: correlation {correlation:.2f}; "
            f"expected at least {LEAST_CORRELATION:g}"
        )
    # Interval in which both recordings overlap, on the reference's clock.
    first, last = max(reference_s[0], skin_s[0] - offset_s), min(reference_s[-1], skin_s[-1] - offset_s)
    middle = (first + last) / 2
    inside = (reference_s >= first) & (reference_s <= last)
    since, shown = reference_s[inside] - middle, reference_kpa[inside]

    def difference(unknowns: FloatArray) -> FloatArray:
        shift_s, drift, scale, zero = unknowns
        felt = np.interp(since + middle + offset_s + shift_s + drift * since, skin_s, skin_kpa)
        missed: FloatArray = shown - scale * felt - zero
        return missed

    scale = float(np.std(shown) / max(float(np.std(skin_kpa)), 1e-12))
    spread = np.array([0.1, 0.1 / max(last - middle, 1e-9), scale, max(float(np.std(shown)), 1e-12)])
    start = np.array([0.0, 0.0, scale, float(shown.min())])
    found = least_squares(difference, start, x_scale=spread)
    jacobian = np.asarray(found.jac, dtype=np.float64)
    shift_s, drift = found.x[:2]
    variance = 2 * found.cost / max(len(shown) - 4, 1)
    drift_std = float(np.sqrt(variance * np.linalg.pinv(jacobian.T @ jacobian)[1, 1]))
    if abs(drift) > 1e-6 * LONGEST_DRIFT_PPM + 4 * drift_std:
        raise InputError(f"the reference's clock seems to drift by {drift * 1e6:.0f} ppm; no clock does")
    return Alignment(offset_s + float(shift_s), float(middle), float(drift * 1e6), correlation)


def with_reference(
    presses: Sequence[Press], alignment: Alignment, reference_s: FloatArray, reference_kpa: FloatArray
) -> list[Press]:
    """Presses with loads by the reference, relative to its reading just before each press.

    A press gets a fault if the reference does not cover it, or if the reference moves during the hold.
    """
    time_s = alignment.skin_time_s(reference_s)
    found = []
    for press in presses:
        start, there, falls, _ = press.time_s
        before = reference_kpa[(time_s > start - 1.0) & (time_s < start - 0.1)]
        held = reference_kpa[(time_s > there + 0.5 * (falls - there)) & (time_s < falls - 0.05 * (falls - there))]
        if press.fault or not (before.size and held.size):
            fault = press.fault or "the reference has no readings there"
            found.append(replace(press, fault=fault))
            continue
        load = float(held.mean() - before.mean())
        noise = float(np.sqrt((np.diff(held) ** 2).mean() / 2)) if held.size > 1 else 0.0
        fault = ""
        if not load > 0 or np.abs(held - held.mean()).max() > STEADY * load + SURE_STDS * noise:
            fault = "the reference did not hold still"
        levels = np.array([0.0, max(load, 1e-9), max(load, 1e-9), 0.0])
        found.append(replace(press, load_kpa=levels, fault=fault))
    return found


def _raster(time_s: FloatArray, values: FloatArray) -> FloatArray:
    even = np.interp(np.arange(time_s[0], time_s[-1], RASTER_S), time_s, values)
    centred: FloatArray = even - even.mean()
    return centred


def _best_lag(skin: FloatArray, reference: FloatArray) -> tuple[int, float]:
    """Delay of the reference in samples for the best fit to the skin, and the normalised correlation at that delay."""
    product = correlate(skin, reference, mode="full", method="fft")
    lags = correlation_lags(len(skin), len(reference), mode="full")
    best = int(np.argmax(product))
    low, high = max(int(lags[best]), 0), min(int(lags[best]) + len(reference), len(skin))
    overlap_skin = skin[low:high]
    overlap_reference = reference[low - int(lags[best]) : high - int(lags[best])]
    scale = np.sqrt((overlap_skin**2).sum() * (overlap_reference**2).sum())
    correlation = float(product[best] / scale) if scale > 0 else 0.0
    return int(lags[best]), correlation
