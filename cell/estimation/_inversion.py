"""Interface of a material to :class:`._estimator.Estimator`: from what the filter follows to a pressure.

An :class:`Inversion` either has dynamics that the filter itself follows (:attr:`Inversion.material`: the filter inverts
the cell), or it maps readings that the filter has cleaned. It stores no cells: the estimator passes the states of all
cells, and the places of those that are concerned.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Record, Records
from .._state import CellState
from ._modes import Material

LOADS = (-0.5, 3.0)
"""range of loads that an inversion searches, in multiples of full scale"""
USUAL = 1.1
"""multiple of full scale that usual loads do not exceed"""
UNKNOWN = 0.6
"""fraction of full scale: standard deviation of an unknown load that is at most :data:`USUAL`; two standard deviations
cover all such loads"""
MEMORIES = 30.0
"""multiple of the fast response to full scale that r may reach, since presses in quick succession add up"""


class Inversion:
    """Pressures of cells. Methods take the states ``cells`` (n,) and ``memory`` (n,) of all and change those at places.

    ``cells["level"]`` is what the filter follows: r, or the load over full scale if there is a :attr:`material`.
    """

    memory: type[Record] = Record
    """what the inversion remembers of a cell"""
    material: Material | None = None
    """dynamics of the cell that the filter follows; None: it only cleans the readings"""
    knows_errors = True
    """False: only a calibration can state the errors of the pressures"""
    usual_level = USUAL
    """level of the heaviest usual load, over that of full scale"""
    filtered = True
    """False: readings pass as they are"""
    remembers = True
    """False: the resistance depends on the present load alone"""

    def __init__(
        self,
        full_scale_kpa: float,
        full_scale_r: float,
        *,
        credible: tuple[float, float] = (-1.0, np.inf),
        exact: bool,
    ) -> None:
        """Set the properties common to all inversions.

        Args:
            full_scale_kpa: the largest pressure that the cell is meant for.
            full_scale_r: r at equilibrium under full scale; negative where a load lowers the resistance.
            credible: range of r that loads can cause; readings beyond it are treated as missing.
            exact: whether readings are taken as exact.
        """
        self.full_scale_kpa, self.credible, self.exact = full_scale_kpa, credible, exact
        self.full_scale_r, self.side = abs(full_scale_r), math.copysign(1.0, full_scale_r)

    def begin(self, cells: Records[CellState], memory: Records[Any], places: IntArray, r: FloatArray) -> None:
        """Set the memory, if there is one, of cells whose reading has been ``r`` (k,) for ever."""

    def advance(self, cells: Records[CellState], memory: Records[Any], places: IntArray, dt_s: float) -> None:
        """Take the levels of cells, which are ``dt_s`` after the last ones; not called where there is a material.

        Without a memory, ``places`` may be those of many frames.
        """

    def hold(self, cells: Records[CellState], memory: Records[Any], places: IntArray, dt_s: FloatArray) -> None:
        """Let times ``dt_s`` (k,) pass at constant pressure."""

    def settled(self, cells: Records[CellState], memory: Records[Any], places: IntArray, band: float) -> BoolArray:
        """(k,) whether the memory is that of a cell at rest, within ``band`` of r."""
        return np.ones(places.size, dtype=bool)


def credible_readings(steepest: float) -> tuple[float, float]:
    """Credible range of r, for a fast response ``steepest`` to full scale: see :data:`LOADS` and :data:`MEMORIES`."""
    return LOADS[0] * steepest, MEMORIES * steepest
