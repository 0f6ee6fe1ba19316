"""Conversion of resistances to conductances, common to all solvers."""

from __future__ import annotations

import numpy as np

from ...common.arrays import FloatArray

_WIRE = 1e60  # S


def siemens(ohms: FloatArray | float) -> FloatArray:
    """Conductances in S; resistances below 1e-60 ohm become inf, because products of 1e60 S and more could overflow."""
    if isinstance(ohms, np.ndarray) and ohms.size and ohms.item(ohms.argmin()) >= 1.0 / _WIRE:  # nearly always
        ordinary: FloatArray = np.reciprocal(ohms)
        return ordinary
    with np.errstate(divide="ignore", over="ignore"):
        conductance = np.divide(1.0, ohms)
    return conductance if conductance.max(initial=0.0) <= _WIRE else np.where(conductance > _WIRE, np.inf, conductance)
