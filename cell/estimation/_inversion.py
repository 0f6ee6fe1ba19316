"""The interface between :class:`._estimator.Estimator` and a material: readings of cells to pressures, with a memory.

An estimator treats all materials alike: missing readings, noise, sleep, bad contacts, standard deviations. What differs
from one material or method to the next is an :class:`Inversion`. It knows nothing of missing readings or of cells that
sleep, and keeps no cells itself: the estimator hands it the memory of those cells that have just been read.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ...arrays import BoolArray, FloatArray, IntArray, columns, put_columns
from ...compiled import Loop
from . import _loops as loops
from ._rows import GAIN, NOISE, PRESSURE, READING, SMOOTHED, STD
from ._smoothing import Looked
from ._window import RECENT

LOADS = (-0.5, 3.0)
"""times full scale beyond which no load is looked for"""
USUAL, DOUBT = 1.1, 0.1
"""times full scale: no larger pressure is believed while its standard deviation by the memory is above the second"""
UNKNOWN = 0.6
"""of full scale: standard deviation of a load of which nothing is known but that it is no more than usual; two of it
cover all such loads"""
MEMORIES = 30.0
"""times the fast answer to full scale that r may reach: presses in quick succession add up"""

NO_LOAD_SIGMAS = 2.0
"""standard deviations of the noise at which a load and none are as likely"""
LIGHT_LOAD = 0.02
"""of full scale: no larger load of a released cell is taken for the memory's error, unless the cell has been taken for
one at rest"""
DOUBTED_LOAD = 0.2
"""of full scale: no larger load is taken for noise or for the memory's error while its rise is unconfirmed"""

_NO_VARIANCE = np.zeros(1)
_ONE, _NO_LOAD_SIGMAS = np.array(1.0), np.array(NO_LOAD_SIGMAS)
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


class RecentReadings(NamedTuple):
    """The last readings of m cells: as many as there were frames since the last call that took them."""

    dt_s: float
    """between frames"""
    mean: FloatArray
    """(m,) of these readings"""
    noise: FloatArray
    """(m,) standard deviation of one of them"""
    on_line: FloatArray
    """(m,) readings since the smoothing last noticed a change"""
    near: IntArray
    """(k, m) places of the neighbours of each cell, see :meth:`._neighbours.Neighbours.among`"""


class Inversion(ABC):
    """Normalised resistances r = R/R0 - 1 of cells to their pressures.

    The memory of m cells is an array (rows, m). Its first three rows are those of :mod:`._rows`: the pressure, the gain
    by which noise enters it, and the variance by which the rest of the memory adds to it.
    """

    rows: tuple[str, ...] = ("pressure", "gain", "variance")
    """names of the memory's rows, the first three in every inversion"""
    knows_errors = True
    """False: only a calibration can say how far the pressures are off"""
    remembers = True
    """False: the resistance follows from the present load alone, so what came in a gap left nothing behind"""
    bends = 0.0, 0.0
    """standard deviation of r by a turn within the frame, per kPa by which the load bent, and by how many standard
    deviations of noise the load must have bent; 0: none. :meth:`within_frame` says the same to array operations"""
    steepness_kpa = np.zeros(2)
    """kPa per r by which a fast rise of the load and a fast fall are answered; 0: by the memory's gain"""
    recovers = False
    """whether :meth:`recover` does anything"""
    recent = RECENT
    """frames from one call of it to the next"""
    rests = 0.0
    """squared standard deviations at which a load and none are as likely in cells that are taken for cells at rest; 0:
    none are. :meth:`hides_kpa2` says the same to array operations"""
    seeming = 0.0
    """kPa by which motion as large as the noise may let a pressure seem to rise in a window of the noise meter, per
    standard deviation of a reading and per squared gain; 0: it does not"""

    def __init__(
        self,
        full_scale_kpa: float,
        full_scale_r: float,
        *,
        credible: tuple[float, float] = (-1.0, np.inf),
        exact: bool,
    ) -> None:
        """Say what every inversion must.

        Args:
            full_scale_kpa: the largest pressure that the cell is meant for.
            full_scale_r: r at equilibrium under full scale; negative where a load lowers the resistance.
            credible: r beyond which no load can be the cause of a reading.
            exact: whether readings are to be taken as they are, whatever their noise.
        """
        self.full_scale_kpa, self.credible, self.exact = full_scale_kpa, credible, exact
        self.full_scale_r, self.side = abs(full_scale_r), math.copysign(1.0, full_scale_r)

    # -- what an inversion must say ----------------------------------------------------------------------------------

    @abstractmethod
    def begin(self, r: FloatArray) -> FloatArray:
        """The memory (rows, m) of cells whose reading has been ``r`` (m,) for ever."""

    @abstractmethod
    def advance(
        self, memory: FloatArray, dt_s: float, r: FloatArray, std: FloatArray, doubt: Callable[[], FloatArray]
    ) -> FloatArray:
        """The memory (rows, m) after the reading went to ``r`` (m,) in ``dt_s``.

        ``std`` (m,) is what noise leaves in the reading, ``doubt()`` (m,) also what the smoothing may not have noticed
        yet. May change ``memory`` itself.
        """

    # -- what an inversion may say -----------------------------------------------------------------------------------

    def held_kpa(self, r: FloatArray) -> FloatArray:
        """(m,) pressure of cells whose reading has been ``r`` (m,) for ever."""
        pressure: FloatArray = self.begin(r)[PRESSURE]
        return pressure

    def hold(self, memory: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """The memory (rows, m) after ``dt_s``, one number or (m,), in which the pressure stayed."""
        return memory

    def hold_compiled(self, memory: FloatArray, places: IntArray, dt_s: FloatArray) -> None:
        """:meth:`hold` for the cells at ``places`` (k,) of a ``memory`` (rows, m), which changes; ``dt_s`` (k,).

        By loops where a whole skin may be concerned at once.
        """
        put_columns(memory, places, self.hold(columns(memory, places), dt_s))

    @property
    def held_rows(self) -> IntArray:
        """Rows of the memory that :meth:`hold` and :meth:`advance` need, the pressure first.

        The former writes the others anew, and the latter leaves them.
        """
        return np.arange(len(self.rows))

    def settled(self, memory: FloatArray, band: float) -> BoolArray:
        """(m,) whether the memory is that of a cell at rest, within ``band`` of r."""
        return np.ones(memory.shape[1], dtype=bool)

    def recover(  # noqa: B027 - without a memory nothing is remembered wrong
        self, memory: FloatArray, recent: RecentReadings
    ) -> None:
        """Correct what cells remember by their readings of late; changes ``memory`` (rows, m) after :meth:`advance`."""

    def sways_in(self, dt_s: float) -> int:
        """Frames from one call of :meth:`sway` to the next, where frames follow each other after ``dt_s``; 0: none."""
        return 0

    def sway(  # noqa: B027 - without a memory nothing of a way is kept
        self, memory: FloatArray, recent: RecentReadings
    ) -> None:
        """Take back what is kept of loads that go to and fro unnoticed; changes ``memory`` after :meth:`recover`."""

    def left_over(self, memory: FloatArray) -> FloatArray:
        """(m,) r that earlier loads have left, beyond what the present load leads to if it stays; 0 where unknown."""
        return np.zeros(memory.shape[1])

    def released(self, memory: FloatArray) -> BoolArray | None:
        """(m,) whether the load of a cell went down last, so that its memory may show as a load; None: of none."""
        return None

    def hides_kpa2(self, memory: FloatArray, noise_kpa: FloatArray) -> FloatArray:
        """(m,) squared kPa at which a load and none are as likely, for a standard deviation by noise (m,)."""
        hides: FloatArray = noise_kpa * _NO_LOAD_SIGMAS
        hides *= hides
        return hides

    def most_seeming(self, memory: FloatArray, noise: FloatArray) -> FloatArray:
        """(m,) kPa by which motion as large as the ``noise`` (m,) may at most let pressures seem to rise."""
        gain = memory[GAIN]
        most: FloatArray = noise * self.seeming
        most *= gain * gain
        return most

    def miss(self, memory: FloatArray, rise_kpa: FloatArray) -> None:  # noqa: B027 - without a memory nothing is missed
        """Count what cells may remember wrong where a rise (m,) may only have seemed to be one; changes ``memory``."""

    def take_steps(self, std: float, own: float) -> None:  # noqa: B027 - without a memory no turn is looked for
        """Take the standard deviation of r at rest by the steps of all readings that r follows from; 0: unknown.

        ``own`` is that by the steps of the cell's own reading.
        """

    def within_frame(self, memory: FloatArray, noise_kpa: FloatArray) -> FloatArray:
        """(m,) variance in kPa^2 by what the load may have done since the last frame.

        ``memory`` has the first rows only, :data:`._rows.SHARED`; ``noise_kpa`` (m,) is the standard deviation by
        noise.
        """
        return _NO_VARIANCE

    def normalise(self, resistance_ohm: FloatArray, per_ohm: FloatArray, r: FloatArray, *, compiled: bool) -> bool:
        """Write the normalised resistances of all cells (n,) into ``r`` (n,).

        Returns:
            Whether all of them were found to be credible. False says nothing: they are to be looked at.
        """
        if compiled:
            return loops.read.unchecked(resistance_ohm, per_ohm, r, *self.credible)
        np.multiply(resistance_ohm, per_ohm, out=r)
        r -= _ONE
        return False

    # -- machine code ------------------------------------------------------------------------------------------------

    def recover_compiled(self, memory: FloatArray, recent: RecentReadings) -> None:
        """:meth:`recover` by machine code, where an inversion has loops for that."""
        self.recover(memory, recent)

    def sway_compiled(self, memory: FloatArray, recent: RecentReadings) -> None:
        """:meth:`sway` by machine code, where an inversion has loops for that."""
        self.sway(memory, recent)

    def loops_used(self) -> tuple[Loop[..., Any], ...]:
        """All loops that :meth:`advance_compiled` calls."""
        return ()

    def advance_compiled(self, memory: FloatArray, taken: FloatArray, line: FloatArray, dt_s: float) -> FloatArray:
        """:meth:`advance` by machine code, where an inversion has loops for that.

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
    """r beyond which no load that is looked for is the cause, for a fast answer of ``steepest`` to full scale."""
    return LOADS[0] * steepest, MEMORIES * steepest
