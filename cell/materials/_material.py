"""The change of R0 with temperature and age. For mixtures see :mod:`._percolation`."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import FloatArray


def drifted_rest_resistance(
    rest_resistance_ohm: ArrayLike,
    *,
    temperature_change_c: float = 0.0,
    per_degree: float = 0.07,
    age_s: float = 0.0,
    per_decade: float = 0.0,
) -> FloatArray:
    """R0 in ohm of a calibrated cell after a change of temperature, and after ageing.

    R0 grows by the factor (1 + ``per_degree``)^dT (7 % per degree is published for one rubber with 50 phr carbon
    black), and by the factor 1 + ``per_decade`` log10(1 + age in hours). Pass the result to ``Cell.forward`` or
    ``Cell.estimator``.
    """
    warm = np.exp(np.log1p(per_degree) * temperature_change_c)
    aged = 1 + per_decade * np.log10(1 + age_s / 3600)
    drifted: FloatArray = np.asarray(rest_resistance_ohm, dtype=np.float64) * warm * aged
    return drifted
