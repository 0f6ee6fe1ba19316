"""Prior knowledge of an estimator: noise and systematic errors."""

from __future__ import annotations

from dataclasses import dataclass

from ...common.arrays import FloatArray


@dataclass(frozen=True)
class Conditions:
    """Prior knowledge of readings and errors, from a calibration recording or by default."""

    rest_slope_kpa: FloatArray
    """(m,) kPa per relative error of R0, at m pressures spaced evenly from 0 to full scale"""
    model_std_kpa: float = 0.0
    """standard deviation of estimates from noiseless readings: the error of the model"""
    noise: float | None = None
    """standard deviation of R/R0 at rest, from sample to sample: a first guess, until it has been measured. None:
    unknown. 0: readings are exact; nothing is measured, and no cell sleeps"""
    rest_error: float = 0.0
    """relative standard deviation of R0"""
