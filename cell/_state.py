"""The state of a cell that inversions share with the estimator, by name."""

from __future__ import annotations

from ..common.compiled import Record


class CellState(Record):
    """One cell: the reading that the filter has cleaned, and what an inversion says of it."""

    level: float
    """filtered r; of an inversion with dynamics of its own the load over full scale"""
    pressure_kpa: float
    gain_kpa: float
    """kPa per unit of ``level``, by which its errors enter the pressure"""
    variance_kpa2: float
    """by the uncertainty of the inversion itself"""
