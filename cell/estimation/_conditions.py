"""Prior knowledge of an estimator: noise, speed of the loads, and systematic errors, from calibration or by default."""

from __future__ import annotations

from dataclasses import dataclass

from ...arrays import FloatArray


@dataclass(frozen=True)
class Conditions:
    """What is known beforehand of readings, loads and errors: from a calibration recording, or by default."""

    model_std_kpa: float = 0.0
    """standard deviation of estimates that even noiseless readings leave"""
    noise: float | None = None
    """standard deviation of r, sample to sample, at rest; it is measured anew. None: unknown. 0: readings are exact,
    nothing is measured, smoothed or put to sleep"""
    speed_kpa_per_s: float = 0.0
    """by which a load changes in a second, rms; 0: full scale"""
    rest_std_kpa: FloatArray | None = None
    """(n,) standard deviation that the uncertainty of R0 gives to pressures evenly from 0 to full scale; None: none"""
    longest_load_s: float = 0.0
    """how long the load of the calibration recording lasted at most; 0: unknown"""
