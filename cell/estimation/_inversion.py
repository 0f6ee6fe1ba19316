"""Interface of a material to :class:`._estimator.Estimator`: inversion of a cell's hysteresis and creep, with memory.

The estimator handles everything that is common to all materials: missing readings, noise, sleep, bad contacts, standard
deviations. An :class:`Inversion` holds all that depends on the material or the method. Missing readings and sleeping
cells never reach an inversion. An inversion stores no cells itself: the estimator passes the memory of the cells that
have just been read.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray, columns, put_columns
from ...common.compiled import Loop
from ._rows import GAIN, NOISE, PRESSURE, READING, SMOOTHED, STD
from ._smoothing import Looked
from ._window import RECENT

LOADS = (-0.5, 3.0)
"""range of loads that an inversion searches, in multiples of full scale"""
USUAL, DOUBT = 1.1, 0.1
"""multiples of full scale: pressures are limited to the first while their standard deviation exceeds the second"""
UNKNOWN = 0.6
"""fraction of full scale: standard deviation of an unknown load that is at most :data:`USUAL`; two standard deviations
cover all such loads"""
MEMORIES = 30.0
"""multiple of the fast response to full scale that r may reach, since presses in quick succession add up"""

NO_LOAD_SIGMAS = 2.0
"""standard deviations of the noise at which a load and no load are equally likely"""
LIGHT_LOAD = 0.02
"""fraction of full scale: larger loads of a released cell are not attributed to the memory's error, unless the cell has
been classified as at rest"""
DOUBTED_LOAD = 0.2
"""fraction of full scale: larger loads are not attributed to noise or to the memory's error while their rise is
unconfirmed"""

_NO_VARIANCE = np.zeros(1)
_NO_LOAD_SIGMAS = np.array(NO_LOAD_SIGMAS)
# As an array: NumPy makes an array of a float in every call, which takes as long as the operation itself.


class RecentReadings(NamedTuple):
    """The last readings of m cells: those of all frames since the last call of the same method."""

    dt_s: float
    """time between frames"""
    mean: FloatArray
    """(m,) mean of these readings"""
    noise: FloatArray
    """(m,) standard deviation of a single reading"""
    on_line: FloatArray
    """(m,) number of readings since the smoothing last noticed a change"""
    near: IntArray
    """(k, m) indices of the neighbours of each cell, see :meth:`._neighbours.Neighbours.among`"""


class Inversion(ABC):
    """Turns normalised resistances r = R/R0 - 1 of cells into their pressures.

    The memory of m cells is an array (rows, m). Its first three rows are those of :mod:`._rows`: the pressure, its gain
    (pressure per r, by which noise enters), and its variance by the uncertainty of the memory.
    """

    rows: tuple[str, ...] = ("pressure", "gain", "variance")
    """names of the memory's rows; the first three are common to all inversions"""
    knows_errors = True
    """False: only a calibration can state the errors of the pressures"""
    remembers = True
    """False: the resistance depends on the present load alone, so that loads within a gap leave nothing behind"""
    bends = 0.0, 0.0
    """for turning points within a frame: standard deviation of r per kPa of the load's second difference; and the least
    second difference that counts, in standard deviations of noise; 0: no such variance. :meth:`within_frame` is the
    same for array operations"""
    steepness_kpa = np.zeros(2)
    """pressure in kPa per r of a fast rise of the load, and of a fast fall; 0: the memory's gain"""
    recovers = False
    """whether :meth:`recover` does anything"""
    recent = RECENT
    """frames from one call of :meth:`recover` to the next"""
    rests = 0.0
    """squared standard deviations at which a load and no load are equally likely in cells classified as at rest; 0: no
    cell is so classified. :meth:`hides_kpa2` is the same for array operations"""
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
    def begin(self, r: FloatArray) -> FloatArray:
        """The memory (rows, m) of cells whose reading has been ``r`` (m,) for ever."""

    @abstractmethod
    def advance(
        self, memory: FloatArray, dt_s: float, r: FloatArray, std: FloatArray, doubt: Callable[[], FloatArray]
    ) -> FloatArray:
        """The memory (rows, m) after the reading went to ``r`` (m,) in ``dt_s``.

        ``std`` (m,) is the standard deviation of ``r`` by noise. ``doubt()`` (m,) also covers changes that the
        smoothing may not have noticed yet. May change ``memory`` itself.
        """

    # -- optional methods --------------------------------------------------------------------------------------------

    def held_kpa(self, r: FloatArray) -> FloatArray:
        """(m,) pressure of cells whose reading has been ``r`` (m,) for ever."""
        pressure: FloatArray = self.begin(r)[PRESSURE]
        return pressure

    def hold(self, memory: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """The memory (rows, m) after ``dt_s``, one number or (m,), at constant pressure."""
        return memory

    def hold_compiled(self, memory: FloatArray, places: IntArray, dt_s: FloatArray) -> None:
        """:meth:`hold` for the columns ``places`` (k,) of ``memory`` (rows, m), which changes; ``dt_s`` (k,).

        Inversions override this method with loops where it may concern a whole skin at once.
        """
        put_columns(memory, places, self.hold(columns(memory, places), dt_s))

    @property
    def held_rows(self) -> IntArray:
        """Rows of the memory that :meth:`hold` and :meth:`advance` read, the pressure first.

        :meth:`hold` overwrites the other rows, :meth:`advance` leaves them unchanged.
        """
        return np.arange(len(self.rows))

    def settled(self, memory: FloatArray, band: float) -> BoolArray:
        """(m,) whether the memory is that of a cell at rest, within ``band`` of r."""
        return np.ones(memory.shape[1], dtype=bool)

    def recover(  # noqa: B027 - without a memory nothing is remembered wrong
        self, memory: FloatArray, recent: RecentReadings
    ) -> None:
        """Correct the memory (rows, m), in place, by the recent readings; called after :meth:`advance`."""

    def sways_in(self, dt_s: float) -> int:
        """Frames from one call of :meth:`sway` to the next, for frames every ``dt_s``; 0: no calls."""
        return 0

    def sway(  # noqa: B027 - without a memory nothing of a way is kept
        self, memory: FloatArray, recent: RecentReadings
    ) -> None:
        """Remove from ``memory`` what loads that oscillate unnoticed have left; called after :meth:`recover`."""

    def left_over(self, memory: FloatArray) -> FloatArray:
        """(m,) excess of r, by earlier loads, over the equilibrium r of the present load; 0 where unknown."""
        return np.zeros(memory.shape[1])

    def released(self, memory: FloatArray) -> BoolArray | None:
        """(m,) whether the last change of a cell's load was a fall, so that memory may look like a load; None: none."""
        return None

    def hides_kpa2(self, memory: FloatArray, noise_kpa: FloatArray) -> FloatArray:
        """(m,) squared kPa at which a load and no load are equally likely, for a standard deviation by noise (m,)."""
        hides: FloatArray = noise_kpa * _NO_LOAD_SIGMAS
        hides *= hides
        return hides

    def most_seeming(self, memory: FloatArray, noise: FloatArray) -> FloatArray:
        """(m,) largest apparent rise of the pressure in kPa by motion as large as the ``noise`` (m,)."""
        gain = memory[GAIN]
        most: FloatArray = noise * self.seeming
        most *= gain * gain
        return most

    def miss(self, memory: FloatArray, rise_kpa: FloatArray) -> None:  # noqa: B027 - without a memory nothing is missed
        """Add to ``memory`` the uncertainty of rises ``rise_kpa`` (m,) that may be apparent only."""

    def take_steps(self, std: float, own: float) -> None:  # noqa: B027 - without a memory no turn is looked for
        """Set the standard deviation ``std`` of r at rest by the quantisation of all readings that r is computed from.

        ``own`` is the standard deviation by the quantisation of the cell's own reading. 0: unknown.
        """

    def within_frame(self, memory: FloatArray, noise_kpa: FloatArray) -> FloatArray:
        """(m,) variance in kPa^2 by motion of the load since the last frame.

        ``memory`` has only the first :data:`._rows.SHARED` rows; ``noise_kpa`` (m,) is the standard deviation by noise.
        """
        return _NO_VARIANCE

    # -- compiled loops ----------------------------------------------------------------------------------------------

    def recover_compiled(self, memory: FloatArray, recent: RecentReadings) -> None:
        """:meth:`recover` by compiled loops, in inversions that have them."""
        self.recover(memory, recent)

    def sway_compiled(self, memory: FloatArray, recent: RecentReadings) -> None:
        """:meth:`sway` by compiled loops, in inversions that have them."""
        self.sway(memory, recent)

    def loops_used(self) -> tuple[Loop[..., Any], ...]:
        """All loops that :meth:`advance_compiled` calls."""
        return ()

    def advance_compiled(self, memory: FloatArray, taken: FloatArray, line: FloatArray, dt_s: float) -> FloatArray:
        """:meth:`advance` by compiled loops, in inversions that have them.

        Args:
            memory: (rows, m) of the cells.
            taken: (4, m) readings of the frame, rows as in :mod:`._rows`.
            line: (ROWS, m) memory of the smoothing after the readings.
            dt_s: seconds since the last frame.
        """
        std = taken[STD]
        doubt = Looked(taken[READING], taken[NOISE], std, line).doubt
        return self.advance(memory, dt_s, taken[SMOOTHED], std, doubt)


def credible_readings(steepest: float) -> tuple[float, float]:
    """Credible range of r, for a fast response ``steepest`` to full scale: see :data:`LOADS` and :data:`MEMORIES`."""
    return LOADS[0] * steepest, MEMORIES * steepest
