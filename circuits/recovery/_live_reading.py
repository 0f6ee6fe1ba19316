"""What a live recovery is given and gives: the readings of a frame, the rule for valid cells, and reasons."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import BoolArray, FloatArray
from ...common.checks import number
from ...common.measurement import NOISY, Measurement
from ...errors import InputError
from ._tuning import ACCURACY, MOST_NOISE


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
    averages: float = MOST_NOISE
    """the same up to which noisy readings serve for estimation, valid or not: where nobody asked for an accuracy"""

    def __post_init__(self) -> None:
        """Raises InputError if the limit is not between 0 and 1."""
        if not 0 < number("accuracy", self.limit) < 1:
            raise InputError(
                f"accuracy is {self.limit:g}; expected a relative uncertainty above 0 and below 1, or None"
            )

    @classmethod
    def of(cls, accuracy: float | None) -> ValidityRule:
        """The rule for an accuracy that a user asks for; None: :data:`ACCURACY`."""
        return cls() if accuracy is None else cls(accuracy, averages=0.0)


class Readings(NamedTuple):
    """Those of one frame. Arrays are (rows, columns)."""

    volts: FloatArray
    """V, the middle of each code; contiguous"""
    noise: float
    """V, standard deviation of the readings' noise before the converter that is rarely exceeded"""
    usual: float
    """V, the best guess"""
    each: FloatArray
    """V, the best guess of each reading; contiguous"""
    limited: BoolArray | None = None
    """readings at a limit; None: there are none"""
    under_range: BoolArray | None = None
    """readings at the limit that is also the reading of a cell without current: the output may lie anywhere beyond, and
    the cell conducts no more than the reading says; None: there are none"""

    @classmethod
    def of(cls, volts: FloatArray, noise: float = 0.0, **at_limit: BoolArray | None) -> Self:
        """A frame whose readings all have the same noise."""
        return cls(np.array(volts, dtype=np.float64, order="C"), noise, noise, np.full(volts.shape, noise), **at_limit)

    def in_lines(self, turn: Callable[[NDArray[Any]], NDArray[Any]]) -> Self:
        """The same in line coordinates, but for the noise of each reading."""
        limited, under_range = (
            None if cells is None else np.ascontiguousarray(turn(cells)) for cells in (self.limited, self.under_range)
        )
        volts = np.ascontiguousarray(turn(self.volts))
        return type(self)(volts, self.noise, self.usual, self.each, limited, under_range)


class LiveRecovery(Protocol):
    """Live recovery of one board, called with one frame after the other."""

    usual: Callable[[Readings], Measurement | None] | None
    """measures most frames at a fraction of the cost, and gives None for those that are to be recovered; None: no frame
    of this board can be measured so
    """

    def __call__(self, frame: Readings) -> Measurement:
        """Recover the cells from one frame of readings.

        Raises:
            SolverError: no cells give these readings.

        """
        ...
