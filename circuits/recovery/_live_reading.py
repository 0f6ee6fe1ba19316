"""Result of a live recovery for one frame: resistances, uncertainties, validity, and reasons."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import BoolArray, FloatArray
from ...common.checks import number
from ...errors import InputError

ACCURACY = 0.5
"""default relative uncertainty of a conductance up to which a cell is valid. The uncertainty bounds the error, so a
resistance is never off by a factor of two; the root mean square of errors is about a sixth of the uncertainty
"""
SIGMAS = 3.0
"""standard deviations of the readings' noise that an uncertainty covers"""


class Reason(IntEnum):
    """Why a cell is not valid in a frame."""

    VALID = 0
    """the cell is valid"""
    NO_CURRENT = 1
    """the current cannot be told from zero: an open cell, or a resistance far above the resolution of the converter"""
    SATURATED = 2
    """the output or the converter stands at a limit"""
    UNCERTAIN = 3
    """ADC steps and noise leave the conductance less certain than the accuracy asked for"""
    DISTURBED = 4
    """cells of unknown value, at a limit or behind a fault, may shift the conductance by more than that accuracy"""
    HIDDEN = 5
    """a fault that the design names hides the cell"""
    UNSETTLED = 6
    """the readings changed by more than one frame's budget of computation can follow; the next frames continue"""
    UNSOLVED = 7
    """no cell resistances give readings like these: the design is not that of the board"""
    MISSING = 8
    """the board sent no reading of the cell"""


NO_CURRENT, SATURATED, UNCERTAIN, DISTURBED, HIDDEN, UNSETTLED = (
    int(reason)
    for reason in (
        Reason.NO_CURRENT,
        Reason.SATURATED,
        Reason.UNCERTAIN,
        Reason.DISTURBED,
        Reason.HIDDEN,
        Reason.UNSETTLED,
    )
)
"""reasons as plain integers: NumPy takes up to 10 us to convert a member of the enumeration"""


@dataclass(frozen=True)
class ValidityRule:
    """A cell is valid if the relative uncertainty of its conductance is at most ``limit``."""

    limit: float = ACCURACY

    def __post_init__(self) -> None:
        """Raises InputError if the limit is not between 0 and 1."""
        if not 0 < number("accuracy", self.limit) < 1:
            raise InputError(
                f"accuracy is {self.limit:g}; expected a relative uncertainty above 0 and below 1, or None"
            )

    @classmethod
    def of(cls, accuracy: float | None) -> ValidityRule:
        """The rule for an accuracy that a user asks for; None: :data:`ACCURACY`."""
        return cls() if accuracy is None else cls(accuracy)

    def accepts(self, uncertainty: FloatArray) -> BoolArray:
        """Where a relative uncertainty is at most the limit."""
        accepted: BoolArray = uncertainty <= self.limit
        return accepted

    def least_reading(self, own: FloatArray, others: FloatArray) -> FloatArray:
        """The least reading of a valid cell, if its uncertainty is ``own / reading + others``.

        Arguments and result broadcast; inf if no reading is large enough.
        """
        room = np.maximum(self.limit - others, 0.0)
        with np.errstate(divide="ignore"):
            return np.where(room > 0.0, own / room, np.inf)


class LiveReading:
    """The cells in one frame. Arrays are (rows, columns)."""

    sigmas: ClassVar[float] = SIGMAS
    """standard deviations of the noise in :attr:`uncertainty` and in :attr:`own`, added to half an ADC step"""

    def __init__(
        self,
        resistance: FloatArray,
        valid: BoolArray,
        reason: NDArray[np.int8],
        uncertainties: Callable[[], tuple[FloatArray, FloatArray]],
        covered: float | None = None,
        alike: float = 1.0,
        by_readings: Callable[[], FloatArray] | None = None,
        *,
        every: bool | None = None,
        per_volt: Callable[[], tuple[FloatArray, FloatArray]] | None = None,
        bounds: tuple[FloatArray, FloatArray] | None = None,
    ) -> None:
        """Keep the values, and the functions that compute uncertainties on demand.

        ``by_readings`` computes :attr:`by_readings`; None: other readings do not count, as behind virtual grounds.
        ``every`` says whether every cell is valid, if that is known beforehand. ``per_volt`` computes
        :attr:`per_volt`; None: errors of other readings do not count.
        """
        self._every, self._per_volt = every, per_volt
        self.bounds = bounds
        """S, lower and upper bounds on cells whose readings state no more; None: there are none"""
        self._by_readings = by_readings
        self.alike = alike
        """standard deviation by ADC steps, which may err alike in many readings, over that by independent errors"""
        self.covered = covered
        """V: random errors of all readings with this standard deviation have :attr:`uncertainty` and :attr:`own` as
        theirs; None: half an ADC step and :data:`SIGMAS` standard deviations of the noise
        """
        self.resistance = resistance
        """ohm; inf for open cells, NaN where nothing is known"""
        self.valid = valid
        """cells whose ``resistance`` satisfies the :class:`ValidityRule`"""
        self.reason = reason
        """a :class:`Reason` each"""
        self._uncertainties = uncertainties
        self._known: tuple[FloatArray, FloatArray] | None = None

    @property
    def every(self) -> bool:
        """Whether every cell is valid."""
        return bool(np.count_nonzero(self.valid) == self.valid.size) if self._every is None else self._every

    @property
    def uncertainties(self) -> tuple[FloatArray, FloatArray]:
        """:attr:`uncertainty` and :attr:`own`."""
        if self._known is None:
            self._known = self._uncertainties()
        return self._known

    @property
    def uncertainty(self) -> FloatArray:
        """Relative half-width of the interval of the conductance; inf where nothing is known.

        The interval covers half an ADC step and :data:`SIGMAS` standard deviations of the noise of every reading, the
        error of the computation, and the influence of cells whose conductance is unknown.
        """
        return self.uncertainties[0]

    @property
    def own(self) -> FloatArray:
        """The part of :attr:`uncertainty` from the cell's own reading, which no other reading can reduce."""
        return self.uncertainties[1]

    def per_volt(self, error: float) -> tuple[FloatArray, FloatArray]:
        """Relative change of the conductance per volt of the cell's own reading, and of errors that its column shares.

        The second is signed: independent errors of 1 V in all readings of a column change its cells by one standard
        normal number times these entries.

        Args:
            error: V, error of a reading that gives :attr:`own`.

        """
        if self._per_volt is not None:
            return self._per_volt()
        own = self.own / error
        return own, np.zeros(own.shape)

    @property
    def by_readings(self) -> FloatArray:
        """Relative change of the conductance by random errors of all readings, :attr:`covered` each; at least ``own``.

        In a column of a divider all readings together determine the drive that is left for each cell. When the code of
        another cell of the column changes, the conductance changes as well.
        """
        return self.own if self._by_readings is None else self._by_readings()


class LiveRecovery(Protocol):
    """Live recovery of one board, called with one frame after the other."""

    scales_columns: bool
    """whether errors of readings scale all conductances of their column by one factor. This is so in dividers whose
    idle rows are driven: all readings of a column together determine the drive that is left for it"""

    def __call__(
        self,
        volts: FloatArray,
        limited: BoolArray | None = None,
        noise: float = 0.0,
        *,
        faint: BoolArray | None = None,
    ) -> LiveReading:
        """Recover the cells from one frame of readings.

        Args:
            volts: (rows, columns) V, the middle of each code.
            limited: (rows, columns) where a reading is at a limit; None: nowhere.
            noise: V, standard deviation of the readings' noise before the converter.
            faint: (rows, columns) where a reading is at the limit that is also the reading of a cell without current:
                the output may lie anywhere beyond, and the cell conducts no more than the reading says; None: nowhere.

        Raises:
            SolverError: no cells give these readings.

        """
        ...
