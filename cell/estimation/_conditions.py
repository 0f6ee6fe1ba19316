"""Prior knowledge of an estimator: noise, speed of the loads, and systematic errors."""

from __future__ import annotations

from dataclasses import dataclass

from ...common.arrays import FloatArray


@dataclass(frozen=True)
class Conditions:
    """Prior knowledge of readings, loads and errors, from a calibration recording or by default."""

    model_std_kpa: float = 0.0
    """standard deviation of estimates from noiseless readings: the error of the model"""
    noise: float | None = None
    """standard deviation of r at rest, from sample to sample: a first guess, until it has been measured. None: unknown.
    0: readings are exact; nothing is measured or smoothed, and no cell sleeps"""
    speed_kpa_per_s: float = 0.0
    """rms change of the load in a second; 0: full scale"""
    rest_std_kpa: FloatArray | None = None
    """(n,) standard deviation of pressures by the uncertainty of R0, at n pressures spaced evenly from 0 to full scale;
    None: R0 is certain"""
    longest_load_s: float = 0.0
    """longest time under load in the calibration recording; 0: unknown"""
