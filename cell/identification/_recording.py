"""Calibration recordings: pressure and resistance over time; validation, smoothing, removal of outliers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...common.tables import TIME
from ...errors import InputError
from ..materials import smoothed, smoothing_s, white_noise

COLUMNS = ("time_s", "pressure_kpa", "resistance_ohm")
SHORTEST_S, FEWEST = 20.0, 100
SPARK, SPARK_SIGMAS = 0.08, 8.0
"""least jump of a single reading that counts as a bad contact: over the range of the readings, and in standard
deviations of noise"""
MOST_REPEATED = 0.01
"""largest share of rows that may repeat the time of the row before, as clocks of coarse steps do"""
LONGEST_PRESS_S = 3600.0
"""median length of a press beyond which the time column can hardly be in seconds"""
PRESSURES_KPA, RESISTANCES_OHM = (0.01, 2e3), (0.1, 1e10)
"""accepted ranges of the largest pressure and of the median resistance; values outside must be in another unit"""
MOST_COUNTS = 4095.0
"""whole numbers up to this are perhaps counts of a converter"""


@dataclass(frozen=True)
class Applied:
    """The load in all rows of a recording (m,), including rows without a reading of the resistance."""

    time_s: FloatArray
    pressure_kpa: FloatArray

    @property
    def step_s(self) -> float:
        """The usual time between rows."""
        return float(np.median(np.diff(self.time_s)))


@dataclass(frozen=True)
class Recording:
    """Columns of equal length (n,), time increasing, every value finite, resistance positive."""

    time_s: FloatArray
    pressure_kpa: FloatArray
    resistance_ohm: FloatArray
    name: str = "recording"
    applied: Applied | None = None
    """the load including rows without a resistance; None: there are no such rows"""

    @property
    def step_s(self) -> float:
        """The usual time between samples."""
        return float(np.median(np.diff(self.time_s)))

    @property
    def loads(self) -> Applied:
        """All that is known of the load."""
        return self.applied or Applied(self.time_s, self.pressure_kpa)

    @property
    def quiet(self) -> Recording:
        """The recording with both signals smoothed alike if its pressure is noisy; this hardly affects a model fit."""
        seconds = smoothing_s(self.pressure_kpa, self.step_s)
        applied = self.applied
        if applied is not None:
            applied = replace(applied, pressure_kpa=smoothed(applied.pressure_kpa, applied.step_s, seconds))
        return replace(
            self,
            pressure_kpa=smoothed(self.pressure_kpa, self.step_s, seconds),
            resistance_ohm=smoothed(self.resistance_ohm, self.step_s, seconds),
            applied=applied,
        )

    def near_reading(self, time_s: FloatArray, within_s: float) -> BoolArray:
        """(m,) whether the resistance was read at most ``within_s`` from each time (m,)."""
        after = np.searchsorted(self.time_s, time_s).clip(1, len(self.time_s) - 1)
        nearest = np.minimum(np.abs(self.time_s[after] - time_s), np.abs(time_s - self.time_s[after - 1]))
        return np.asarray(nearest <= within_s)

    @property
    def without_sparks(self) -> Recording:
        """The recording without bad contacts: single readings that jump while the load does not (median filter).

        A jump must exceed :data:`SPARK` of the range of the readings, and :data:`SPARK_SIGMAS` standard deviations of
        their noise.
        """
        from scipy.ndimage import median_filter

        log_ohm = np.log(self.resistance_ohm)
        low, high = np.percentile(log_ohm, [0.5, 99.5])
        clear = max(SPARK * (high - low), SPARK_SIGMAS * white_noise(log_ohm))
        steady = SPARK * float(np.ptp(self.pressure_kpa))
        jumps = np.abs(log_ohm - median_filter(log_ohm, 3)) > clear
        moves = np.abs(self.pressure_kpa - median_filter(self.pressure_kpa, 3)) > steady
        kept = ~jumps | moves
        return replace(
            self,
            time_s=self.time_s[kept],
            pressure_kpa=self.pressure_kpa[kept],
            resistance_ohm=self.resistance_ohm[kept],
        )


def unrepeated(
    path: str, columns: dict[str, FloatArray], line: FloatArray | None, note: Callable[[str], None]
) -> dict[str, FloatArray]:
    """Columns without the few rows that repeat a time; InputError, naming the line (n,), unless times increase."""
    time = columns[TIME]
    repeats = np.diff(time, prepend=-np.inf) == 0
    if 0 < repeats.sum() <= MOST_REPEATED * len(time):
        at = int(np.argmax(repeats))
        where = f"sample {at + 1}" if line is None else f"line {int(line[at])}"
        more = f", and {repeats.sum() - 1} more like it" if repeats.sum() > 1 else ""
        note(f"{path}: {where} repeats the time of the line before, and is left out{more}")
        columns = {name: values[~repeats] for name, values in columns.items()}
        line = None if line is None else line[~repeats]
    _check_times(columns[TIME], path, line)
    return columns


def _check_times(time_s: FloatArray, name: str, line: FloatArray | None = None) -> None:
    """InputError, naming the sample or its line (n,), unless times (n,) are finite and increase."""
    follows = np.isfinite(time_s) & (np.diff(time_s, prepend=-np.inf) > 0)
    if not follows.all():
        at = int(np.argmin(follows))
        after = f" after {float(time_s[at - 1])} s" if at else ""
        where = f"sample {at + 1}" if line is None else f"line {int(line[at])}"
        raise InputError(f"{name}: time_s must increase and be finite, but {where} is at {float(time_s[at])} s{after}")


def check_resistances(resistance_ohm: FloatArray, name: str) -> None:
    """InputError, naming the sample, unless resistances (n,) are positive, or NaN where there is no reading."""
    wrong = np.flatnonzero(resistance_ohm <= 0)
    if wrong.size:
        at = int(wrong[0])
        raise InputError(
            f"{name}: resistance_ohm of sample {at + 1} is {resistance_ohm[at]:g}, expected more than 0; "
            "are the columns exchanged?"
        )


def checked_recording(
    time_s: FloatArray,
    pressure_kpa: FloatArray,
    resistance_ohm: FloatArray,
    *,
    name: str = "recording",
    trust_units: bool = False,
) -> Recording:
    """A recording that a cell can be identified from.

    Args:
        time_s: (n,) seconds.
        pressure_kpa: (n,) applied.
        resistance_ohm: (n,); where it is NaN or infinite, only the load is used.
        name: name of the recording, for messages.
        trust_units: accept numbers that seem to be in other units.

    Raises:
        InputError: time does not increase, resistance is not positive, the columns look exchanged, too few samples,
            too short, a pressure that does not change or is never released, or numbers that look like other units.
    """
    _check_times(time_s, name)
    if not np.isfinite(pressure_kpa).all():
        at = int(np.flatnonzero(~np.isfinite(pressure_kpa))[0])
        raise InputError(f"{name}: pressure_kpa of sample {at + 1} is {pressure_kpa[at]}; expected a number")
    check_resistances(resistance_ohm, name)
    read = np.isfinite(resistance_ohm)
    applied = None if read.all() else Applied(time_s, pressure_kpa)
    found = Recording(time_s[read], pressure_kpa[read], resistance_ohm[read], name, applied)
    length = found.time_s[-1] - found.time_s[0] if read.any() else 0.0
    if len(found.time_s) < FEWEST or length < SHORTEST_S:
        raise InputError(
            f"{name}: {len(found.time_s)} readings over {length:.3g} s are too short to identify a cell; "
            f"expected at least {FEWEST} readings and {SHORTEST_S:g} s (see ohmskin fit --protocol)"
        )
    pressure = found.quiet.pressure_kpa
    low, high = float(pressure.min()), float(pressure.max())
    if not high > 0 and low < 0:
        raise InputError(
            f"{name}: pressure_kpa goes from {low:g} to {high:g}; expected pressure above 0: is its sign turned round?"
        )
    if not high > 0 or high - low < 1e-6 * high:
        raise InputError(f"{name}: pressure_kpa stays at {high:g}; expected presses and releases")
    if low > 0.3 * high:
        raise InputError(
            f"{name}: pressure_kpa goes from {low:g} to {high:g} and is never released; expected a recording that "
            "includes the unloaded cell, or are the columns exchanged?"
        )
    if not trust_units:
        _check_units(found, high)
    resistance = found.resistance_ohm
    if np.ptp(resistance) < 1e-9 * resistance.max():
        raise InputError(f"{name}: resistance_ohm stays at {resistance[0]:g}; expected it to follow the pressure")
    return found


def _check_units(recording: Recording, highest_kpa: float) -> None:
    """Raise InputError for a column whose numbers can hardly be in the unit that its name states."""
    median_ohm = float(np.median(recording.resistance_ohm))
    pressed = recording.pressure_kpa > 0.5 * highest_kpa
    edges = np.flatnonzero(np.diff(pressed.astype(int), prepend=0, append=0))
    time = np.append(recording.time_s, recording.time_s[-1])
    press_s = float(np.median(time[edges[1::2]] - time[edges[::2]]))
    ohm = recording.resistance_ohm
    whole = bool((ohm == np.round(ohm)).all()) and float(ohm.max()) <= MOST_COUNTS
    doubts = (
        (whole, f"resistance_ohm has whole numbers up to {ohm.max():.4g}; are they counts of a converter?"),
        (press_s > LONGEST_PRESS_S, f"time_s: a press lasts {press_s:.3g} s; is it in milliseconds or microseconds?"),
        (highest_kpa < PRESSURES_KPA[0], f"pressure_kpa reaches {highest_kpa:.3g}; is it in MPa or bar?"),
        (highest_kpa > PRESSURES_KPA[1], f"pressure_kpa reaches {highest_kpa:.3g}; is it in Pa, or a force?"),
        (median_ohm < RESISTANCES_OHM[0], f"resistance_ohm is about {median_ohm:.3g}; is it in kohm or Mohm?"),
        (median_ohm > RESISTANCES_OHM[1], f"resistance_ohm is about {median_ohm:.3g}; is it in mohm?"),
    )
    for doubtful, question in doubts:
        if doubtful:
            raise InputError(
                f"{recording.name}: {question} Expected seconds, kPa and ohm (--trust-units takes them as they are)"
            )
