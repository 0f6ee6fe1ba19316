"""``Measurement``: conductances of one frame with what is known of their errors, from the circuit's law to contacts."""

from __future__ import annotations

import math
from typing import Self

import numpy as np
from numpy.typing import NDArray

from .arrays import BoolArray, FloatArray
from .compiled import Blocks, FixedReasons, FixedRows, FlagRows, Rows, loop

CONDUCTANCE, NOISE_VARIANCE, COLUMN_STD, HALF_STEP, COLUMN_HALF_STEP, LEAST, GREATEST, UNCERTAINTY = range(8)
"""places of the fields in :attr:`Measurement.block`"""
FIELDS = 8
NOISY = 3
"""the :class:`ohmskin.circuits.Reason` of a cell that was read, but not as surely as was asked for"""
STEP_STD = 3.0**-0.5
"""standard deviation of an error that is evenly distributed up to half a step, over that half step"""


class _Field:
    """A field of a measurement: its (rows, columns) in the block."""

    def __init__(self, place: int) -> None:
        self.place = place

    def __get__(self, measured: Measurement, owner: type[Measurement]) -> FloatArray:
        values: FloatArray = measured.block[self.place]
        return values


class Measurement:
    """One frame of cells. Arrays are (rows, columns), in siemens unless stated, and never change again.

    A cell's conductance is ``conductance + noise + column_std * z + half_step * u + column_half_step * v``: noise of
    its own with variance ``noise_variance``, independent from frame to frame; one standard normal ``z`` per column and
    frame, which all cells of the column share; quantisation errors with ``u`` of each cell and ``v`` of each column
    evenly distributed from -1 to 1, which stay while the counts stay. Independently of these, the true conductance lies
    between ``least`` and ``greatest``.

    A reading at a limit of the converter is an interval, not a gap: its ``conductance`` is NaN and ``least`` or
    ``greatest`` is finite. A cell of which nothing is known has NaN, 0 and infinity. A cell that is not valid since its
    reading is noisy has a conductance nevertheless: filters average noise.
    """

    __slots__ = ("block", "reason")

    def __init__(self, block: FloatArray, reason: NDArray[np.int8]) -> None:
        """``block`` (:data:`FIELDS`, rows, columns) holds all fields, so that a kernel takes them as one argument."""
        self.block = block
        self.reason = reason
        """why a cell is not valid: a :class:`ohmskin.circuits.Reason` each, 0 for valid cells"""

    @classmethod
    def unknown(cls, shape: tuple[int, ...], reason: int = 0) -> Self:
        """A frame of which nothing is known, for this reason; to be filled by who makes it."""
        block = np.zeros((FIELDS, *shape))
        block[CONDUCTANCE], block[GREATEST], block[UNCERTAINTY] = np.nan, np.inf, np.inf
        return cls(block, np.full(shape, reason, dtype=np.int8))

    @classmethod
    def of(cls, **fields: FloatArray) -> Self:
        """A frame of the fields that are given by name; the others say that nothing is known."""
        shape = np.shape(fields["conductance"])
        made = cls.unknown(shape)
        for name, values in fields.items():
            made.block[_PLACES[name]] = values
        return made

    conductance = _Field(CONDUCTANCE)
    """NaN where only the bounds are known"""
    noise_variance = _Field(NOISE_VARIANCE)
    """S^2, by noise that no other cell shares"""
    column_std = _Field(COLUMN_STD)
    """by noise that the cells of a column share; signed: one ``z`` moves cells by the signs of their entries"""
    half_step = _Field(HALF_STEP)
    """half a step of the ADC that noise does not randomise, as far as no other cell shares it"""
    column_half_step = _Field(COLUMN_HALF_STEP)
    """likewise, as far as the cells of a column share it; signed like :attr:`column_std`"""
    least = _Field(LEAST)
    """lower bound on the conductance; 0 where there is none"""
    greatest = _Field(GREATEST)
    """upper bound on the conductance; infinity where there is none"""
    uncertainty = _Field(UNCERTAINTY)
    """relative half-width of the conductance's interval (1); infinity where nothing is known. It covers half an ADC
    step and three standard deviations of the noise of every reading, and what cells of unknown conductance do to it"""

    @property
    def valid(self) -> BoolArray:
        """Cells whose uncertainty is at most the accuracy asked for."""
        valid: BoolArray = self.reason == 0
        return valid

    def shown(self, pressure: FloatArray) -> tuple[BoolArray, FloatArray, BoolArray, bool]:
        """Where cells are valid, their resistances in ohm (NaN elsewhere), where nothing was read, and a verdict.

        Args:
            pressure: (rows, columns) by an estimator, contiguous and not to be written to.

        Returns:
            Three arrays (rows, columns), and whether a valid cell has no pressure.

        """
        shape = self.reason.shape
        flags, ohm = np.empty((2, *shape), dtype=np.bool_), np.empty(shape)
        self.reason.setflags(write=False)
        beyond = show_each.unchecked(self.block, self.reason, pressure, flags[0], flags[1], ohm)
        flags.setflags(write=False)  # half of the time that array.flags takes
        ohm.setflags(write=False)
        return flags[0], ohm, flags[1], beyond

    @property
    def resistance(self) -> FloatArray:
        """Ohm; NaN where not valid."""
        ohm: FloatArray = 1.0 / np.where(self.reason == 0, self.block[CONDUCTANCE], np.nan)
        return ohm

    @property
    def noise_std(self) -> FloatArray:
        """Standard deviation by all noise, relative to the conductance (1); NaN where that is not known."""
        std: FloatArray = np.sqrt(self.noise_variance + self.column_std**2) / self.conductance
        return std

    @property
    def steps_std(self) -> FloatArray:
        """Likewise by the quantisation errors that noise does not randomise."""
        std: FloatArray = STEP_STD * np.hypot(self.half_step, self.column_half_step) / self.conductance
        return std

    def without(self, cells: BoolArray, reason: int) -> Measurement:
        """The same frame without any knowledge of ``cells`` (rows, columns), which are not valid for this reason."""
        other = self.unknown(cells.shape, reason)
        return Measurement(
            np.where(cells, other.block, self.block),
            np.where(cells & (self.reason == 0), other.reason, self.reason),
        )


@loop
def show_each(
    block: Blocks, reason: FixedReasons, pressure: FixedRows, valid: FlagRows, unread: FlagRows, ohm: Rows
) -> bool:
    """Write what :meth:`Measurement.shown` returns."""
    beyond = False
    for i in range(ohm.shape[0]):
        for j in range(ohm.shape[1]):
            why = reason[i, j]
            valid[i, j] = why == 0
            unread[i, j] = why not in (0, NOISY)
            ohm[i, j] = 1.0 / block[CONDUCTANCE, i, j] if why == 0 else math.nan
            beyond = beyond or (why == 0 and math.isnan(pressure[i, j]))
    return beyond


_PLACES = {name: field.place for name, field in vars(Measurement).items() if isinstance(field, _Field)}
