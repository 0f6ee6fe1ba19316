"""Conversion of resistances to conductances, common to all solvers."""

from __future__ import annotations

import numpy as np

from ...common.arrays import FloatArray
from ._tuning import LEAST_OHM


def siemens(ohms: FloatArray | float) -> FloatArray:
    """Conductances in S; resistances below :data:`LEAST_OHM` become inf."""
    if isinstance(ohms, np.ndarray) and ohms.size and ohms.item(ohms.argmin()) >= LEAST_OHM:  # nearly always
        ordinary: FloatArray = np.reciprocal(ohms)
        return ordinary
    with np.errstate(divide="ignore", over="ignore"):
        conductance = np.divide(1.0, ohms)
    most = 1.0 / LEAST_OHM
    return conductance if conductance.max(initial=0.0) <= most else np.where(conductance > most, np.inf, conductance)
