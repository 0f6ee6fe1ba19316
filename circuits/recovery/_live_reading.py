"""Result of a live recovery for one frame: resistances, uncertainties, validity, and reasons."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import BoolArray, FloatArray
from ...common.checks import number
from ...common.measurement import NOISY, Measurement
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
    UNCERTAIN = NOISY
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
    BEYOND_MODEL = 9
    """the resistance is known, but the cell's model knows no pressure for it: a tare or cell data of another skin"""
    NO_CELL = 10
    """there is no cell: the design's ``[shape]`` has a hole there"""


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
    averages: bool = True
    """whether noisy readings serve for estimation, valid or not: where nobody asked for an accuracy"""

    def __post_init__(self) -> None:
        """Raises InputError if the limit is not between 0 and 1."""
        if not 0 < number("accuracy", self.limit) < 1:
            raise InputError(
                f"accuracy is {self.limit:g}; expected a relative uncertainty above 0 and below 1, or None"
            )

    @classmethod
    def of(cls, accuracy: float | None) -> ValidityRule:
        """The rule for an accuracy that a user asks for; None: :data:`ACCURACY`."""
        return cls() if accuracy is None else cls(accuracy, averages=False)

    def accepts(self, uncertainty: FloatArray) -> BoolArray:
        """Where a relative uncertainty is at most the limit."""
        accepted: BoolArray = uncertainty <= self.limit
        return accepted


class Errors(NamedTuple):
    """Relative changes of one frame's conductances by errors of the readings. Arrays are (rows, columns), 1/V."""

    own: FloatArray
    """per volt of the cell's own reading, at a constant sum of its column"""
    column: FloatArray
    """per volt of independent errors of all readings of a column, whose cells they scale by one number; signed"""
    all: FloatArray
    """per volt of independent errors of all readings of the board"""
    alike: float = 1.0
    """by how much rounding of equal readings, which errs alike, exceeds independent errors in the sum of a column"""


class LiveReading:
    """The cells in one frame. Arrays are (rows, columns)."""

    def __init__(
        self,
        resistance: FloatArray,
        valid: BoolArray,
        reason: NDArray[np.int8],
        uncertainty: Callable[[], FloatArray],
        errors: Callable[[], Errors] | None = None,
        *,
        every: bool | None = None,
        bounds: tuple[FloatArray, FloatArray] | None = None,
    ) -> None:
        """Keep the values, and the functions that compute :attr:`uncertainty` and :attr:`errors` on demand.

        ``errors`` is None where no cell is known. ``every`` says whether every cell is valid, if that is known.
        """
        self.resistance = resistance
        """ohm; inf for open cells, NaN where nothing is known"""
        self.valid = valid
        """cells whose ``resistance`` satisfies the :class:`ValidityRule`"""
        self.reason = reason
        """a :class:`Reason` each"""
        self.bounds = bounds
        """S, lower and upper bounds on cells whose readings state no more; None: there are none"""
        self._every, self._uncertainty, self._errors = every, uncertainty, errors

    @property
    def every(self) -> bool:
        """Whether every cell is valid."""
        return bool(np.count_nonzero(self.valid) == self.valid.size) if self._every is None else self._every

    @cached_property
    def uncertainty(self) -> FloatArray:
        """Relative half-width of the interval of the conductance; inf where nothing is known.

        The interval covers half an ADC step and :data:`SIGMAS` standard deviations of the noise of every reading, the
        error of the computation, and the influence of cells whose conductance is unknown.
        """
        return self._uncertainty()

    @cached_property
    def errors(self) -> Errors:
        """What errors of the readings change; infinite where no cell is known."""
        if self._errors is None:
            unknown = np.full(self.resistance.shape, np.inf)
            return Errors(unknown, np.zeros(unknown.shape), unknown)
        return self._errors()


def undetermined(reason: NDArray[np.int8]) -> LiveReading:
    """The reading of a frame that determines no cell, for these reasons (rows, columns)."""
    unknown = np.full(reason.shape, np.inf)
    return LiveReading(np.full(reason.shape, np.nan), np.zeros(reason.shape, dtype=np.bool_), reason, lambda: unknown)


class UsualReading(Protocol):
    """Measures most frames at a fraction of the cost; see :mod:`._usual_frames` and :mod:`._usual_fits`."""

    def __call__(
        self,
        volts: FloatArray,
        surely: float,
        usual: float,
        noise: FloatArray,
        limited: BoolArray | None = None,
        under_range: BoolArray | None = None,
    ) -> Measurement | None:
        """The measurement of a frame; None if it is to be recovered.

        Args:
            volts: (rows, columns) V, contiguous.
            surely: V, standard deviation of noise that is rarely exceeded.
            usual: V, the best guess.
            noise: (rows, columns) V, the best guess of each reading, contiguous.
            limited: as in :class:`LiveRecovery`, and ``under_range``.

        """
        ...


class LiveRecovery(Protocol):
    """Live recovery of one board, called with one frame after the other."""

    usual: UsualReading | None
    """for frames without readings at a limit, if this circuit has such a way"""
    scales_columns: bool
    """whether errors of readings scale all conductances of their column by one factor. This is so in dividers whose
    idle rows are driven: all readings of a column together determine the drive that is left for it"""

    def __call__(
        self,
        volts: FloatArray,
        limited: BoolArray | None = None,
        noise: float = 0.0,
        *,
        under_range: BoolArray | None = None,
    ) -> LiveReading:
        """Recover the cells from one frame of readings.

        Args:
            volts: (rows, columns) V, the middle of each code.
            limited: (rows, columns) where a reading is at a limit; None: nowhere.
            noise: V, standard deviation of the readings' noise before the converter.
            under_range: (rows, columns) where a reading is at the limit that is also the reading of a cell without
                current: the output may lie anywhere beyond, and the cell conducts no more than the reading says; None:
                nowhere.

        Raises:
            SolverError: no cells give these readings.

        """
        ...
