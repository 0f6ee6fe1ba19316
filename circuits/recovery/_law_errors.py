"""Errors of one frame's cells by ADC steps and noise, by the derivatives of the laws (:mod:`._law`)."""

from __future__ import annotations

from collections.abc import Callable
from math import hypot, nan, sqrt
from typing import NamedTuple, Self

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._adc import adc_error
from .._board import Board
from ._law import Law, Ports
from ._law_kernels import errors_of, relative_to
from ._live_reading import SIGMAS, Errors

ALIKE = 2.0  # measured where cells at rest are alike; 1.8 in a pressed column of equal cells
BY_STEPS, BY_NOISE = 4.5, 3.5  # standard deviations of other readings' steps and noise that are covered


class Steps(NamedTuple):
    """Errors of the converter in V."""

    half: float
    """largest error of a reading"""
    random: float
    """the part that differs from reading to reading"""
    shared: float
    """the part by offset and gain, which all readings share"""
    alike: bool
    """whether equal readings of a column add up, as in dividers"""

    @classmethod
    def of(cls, board: Board) -> Self:
        """The errors of a board with a converter."""
        adc, half = board.adc, adc_error(board)
        assert adc is not None
        random = (0.5 + abs(adc.inl_steps)) * adc.step
        return cls(half, random, half - random, not board.circuit.has_amplifiers)


class LawErrors:
    """Errors of one frame's cells. Arrays broadcast to (N, M) unless stated."""

    def __init__(
        self,
        law: Law,
        steps: Steps,
        ports: Ports,
        volts: FloatArray,
        noise: float,
        unknown: BoolArray | None,
    ) -> None:
        """Errors of the conductances behind a frame's readings.

        Args:
            law: of the board.
            steps: errors of its converter.
            ports: the conductances.
            volts: (N, M) V, the readings.
            noise: V, standard deviation of each.
            unknown: (N, M) readings that state bounds only.

        """
        self.cells, self._steps = ports.cells, steps
        by_steps, by_noise = steps.random * BY_STEPS / sqrt(3.0), BY_NOISE * noise
        random = hypot(by_steps, by_noise)
        self.error = steps.half + SIGMAS * noise
        """V, of a reading"""
        shape = rows, columns = volts.shape
        self.of_driven, own_per_volt, beside, self.own, self.linear, self._std = np.empty((6, *shape))
        self.of_left, self.column_open = np.empty((2, columns))
        self.of_sums, self.row_open = np.empty((2, rows))
        middle = np.full(columns, nan)
        if steps.alike and 3.0 * rows > BY_STEPS**2 and noise <= steps.half:
            middle = np.sort(volts, axis=0)[rows // 2]
        self.opens: bool = errors_of.unchecked(
            *(volts, middle, *law.law, law.lead, law.present, law.nowhere if unknown is None else unknown),
            *(ports.apart, ports.share, ports.drive, ports.left, ports.total, ports.driven, ports.row_left),
            *(self.error, random, by_steps, by_noise, steps.random, steps.shared),
            *(law.has_potential, law.has_leads, steps.alike, law.one_by_one),
            *(self.of_driven, own_per_volt, beside, self.own, self.linear, self._std),
            *(self.of_left, self.column_open, self.of_sums, self.row_open, np.empty((3, columns))),
        )
        self._of_own, self._of_column = own_per_volt, beside

    def relative(self, cells: FloatArray) -> FloatArray:
        """Relative uncertainty (N, M) of ``cells`` in S, which the laws gave before they were corrected."""
        uncertainty = np.empty(cells.shape)
        of_law = self.cells, self.own, self.linear, self.column_open, self.row_open
        relative_to.unchecked(cells, *of_law, uncertainty)
        return uncertainty

    def per_volt(self, turn: Callable[[FloatArray], FloatArray], grown: FloatArray) -> Errors:
        """The errors in the coordinates of the array, ``grown`` by faults beside or before the cells."""
        grown = np.broadcast_to(grown, self._std.shape)  # infinite where a fault hides the cell
        own, column, every = (
            turn(np.multiply(each, grown, out=np.zeros(each.shape), where=each != 0.0))
            for each in (np.abs(self._of_own), self._of_column, self._std)
        )
        return Errors(own, column, every, ALIKE if self._steps.alike else 1.0)
