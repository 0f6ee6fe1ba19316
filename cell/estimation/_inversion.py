"""Interface of a material to :class:`._estimator.Estimator`: inversion of a cell's hysteresis and creep, with memory.

The estimator handles everything that is common to all materials: missing readings, noise, sleep, bad contacts, standard
deviations. An :class:`Inversion` holds all that depends on the material or the method. Missing readings and sleeping
cells never reach an inversion. An inversion stores no cells itself: the estimator passes the states of all cells, and
the places of those that are concerned.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Record, Records, zeros
from .._state import CellState

LOADS = (-0.5, 3.0)
"""range of loads that an inversion searches, in multiples of full scale"""
USUAL, DOUBT = 1.1, 0.1
"""multiples of full scale: pressures are limited to the first while their standard deviation exceeds the second"""
UNKNOWN = 0.6
"""fraction of full scale: standard deviation of an unknown load that is at most :data:`USUAL`; two standard deviations
cover all such loads"""
MEMORIES = 30.0
"""multiple of the fast response to full scale that r may reach, since presses in quick succession add up"""


class Inversion(ABC):
    """Turns normalised resistances r = R/R0 - 1 of cells into their pressures.

    Methods take the states ``cells`` (n,) and ``memory`` (n,) of all cells and change those at ``places`` (k,).
    """

    memory: type[Record]
    """what the inversion remembers of a cell beside its :class:`.._state.CellState`"""
    knows_errors = True
    """False: only a calibration can state the errors of the pressures"""
    remembers = True
    """False: the resistance depends on the present load alone, so that loads within a gap leave nothing behind"""
    bends = 0.0, 0.0
    """for turning points within a frame: standard deviation of r per kPa of the load's second difference; and the least
    second difference that counts, in standard deviations of noise; 0: no such variance"""
    steepness_kpa = np.zeros(2)
    """pressure in kPa per r of a fast rise of the load, and of a fast fall; 0: the gain of the cell"""
    means_every = 0
    """frames from one call of :meth:`check_means` to the next; 0: no calls"""
    rests = 0.0
    """squared standard deviations at which a load and no load are equally likely in cells classified as at rest; 0: no
    cell is so classified"""
    seeming = 0.0
    """apparent rise of the pressure in kPa by motion as large as the noise, in a window of the noise meter, per
    standard deviation of a reading and per squared gain; 0: no apparent rise"""

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
            exact: whether readings are taken as exact, without smoothing.
        """
        self.full_scale_kpa, self.credible, self.exact = full_scale_kpa, credible, exact
        self.full_scale_r, self.side = abs(full_scale_r), math.copysign(1.0, full_scale_r)

    # -- required methods --------------------------------------------------------------------------------------------

    @abstractmethod
    def begin(self, cells: Records[CellState], memory: Records[Any], places: IntArray, r: FloatArray) -> None:
        """Set cells whose reading has been ``r`` (k,) for ever."""

    @abstractmethod
    def advance(self, cells: Records[CellState], memory: Records[Any], places: IntArray, dt_s: float) -> None:
        """Take the present readings of cells, which are ``dt_s`` after the last ones."""

    # -- optional methods --------------------------------------------------------------------------------------------

    def held_kpa(self, r: FloatArray) -> FloatArray:
        """(m,) pressure of cells whose reading has been ``r`` (m,) for ever."""
        cells, memory = zeros(CellState, r.size), zeros(self.memory, r.size)
        self.begin(cells, memory, np.arange(r.size), r)
        return cells["pressure_kpa"].copy()

    def hold(  # noqa: B027 - of a memory that some inversions do not have
        self, cells: Records[CellState], memory: Records[Any], places: IntArray, dt_s: FloatArray
    ) -> None:
        """Let times ``dt_s`` (k,) pass at constant pressure."""

    def settled(self, cells: Records[CellState], memory: Records[Any], places: IntArray, band: float) -> BoolArray:
        """(k,) whether the memory is that of a cell at rest, within ``band`` of r."""
        return np.ones(places.size, dtype=bool)

    def check_means(  # noqa: B027 - of a memory that some inversions do not have
        self, cells: Records[CellState], memory: Records[Any], places: IntArray, dt_s: float, mean: FloatArray
    ) -> None:
        """Correct the memory by the readings since the last call, with ``mean`` (k,); called after :meth:`advance`."""

    def tremor_every(self, dt_s: float) -> int:
        """Frames from one call of :meth:`correct_tremor` to the next, for frames every ``dt_s``; 0: no calls."""
        return 0

    def correct_tremor(  # noqa: B027 - of a memory that some inversions do not have
        self, cells: Records[CellState], memory: Records[Any], places: IntArray, dt_s: float, mean: FloatArray
    ) -> None:
        """Subtract what a tremor within the noise has left; called after :meth:`check_means`, with its arguments."""

    def left_over(self, cells: Records[CellState], memory: Records[Any], places: IntArray) -> FloatArray:
        """(k,) excess of r, by earlier loads, over the equilibrium r of the present load; 0 where unknown."""
        return np.zeros(places.size)

    def doubt_rises(  # noqa: B027 - of a memory that some inversions do not have
        self, cells: Records[CellState], memory: Records[Any], places: IntArray, rise_kpa: FloatArray
    ) -> None:
        """Add the uncertainty of rises ``rise_kpa`` (k,) that may be apparent only."""


def credible_readings(steepest: float) -> tuple[float, float]:
    """Credible range of r, for a fast response ``steepest`` to full scale: see :data:`LOADS` and :data:`MEMORIES`."""
    return LOADS[0] * steepest, MEMORIES * steepest
