"""Errors of one frame's cells by ADC steps and noise, by the derivatives of the laws (:mod:`._law`)."""

from __future__ import annotations

from math import hypot, inf, sqrt
from typing import NamedTuple, Self

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._adc import adc_error
from .._board import Board
from ._law import LEAST, Law, Ports
from ._live_reading import SIGMAS

OPEN_SCALE, OPEN_ROW = 0.2, 0.3
"""error of what is left of a column's drive or of a row's, relative to it, from which on its scale is open"""
ALIKE = 1.3
"""standard deviation of a divider's cell by ADC steps over that by independent errors: equal cells are rounded alike"""
_BY_STEPS, _BY_NOISE = 4.5, 3.5  # standard deviations of other readings' steps and noise that are covered
_OPENED = 0.7  # the same from which on nothing is known
_LARGEST = 50.0  # logarithm that is as good as infinite
_FOLLOWS = 0.25  # share of a row's drive that a follower's own error may reach
_WITHIN = 3.0  # errors of a reading, from the upper end of what it can be, within which it tells nothing
_TINY = np.finfo(np.float64).tiny


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
        unknown: BoolArray | None = None,
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
        self._cells, self._steps = ports.cells, steps
        self._by_steps, self._by_noise = steps.random * _BY_STEPS / sqrt(3.0), _BY_NOISE * noise
        random = hypot(self._by_steps, self._by_noise)
        self.error = steps.half + SIGMAS * noise
        """V, of a reading"""
        slope, by_column, by_row = law.sensitivity(ports, unknown)
        self.of_driven = np.broadcast_to(self.error * slope, ports.driven.shape)
        """S, error of D by its own reading at a constant sum of the column"""
        size = np.maximum(np.abs(ports.driven), _TINY)
        weight = 1.0 / size + by_row  # relative change of a cell per change of its own D
        per_volt: FloatArray = np.broadcast_to(slope * (1.0 + by_column), size.shape) * weight
        self.own: FloatArray = self.error * np.abs(per_volt)
        """relative error by the cell's own reading"""
        squares = np.broadcast_to(slope * slope, size.shape)
        in_column = squares.sum(axis=0)
        moved = squares  # squared change of D, per squared error of all readings
        others, shared = np.zeros(size.shape), np.zeros(size.shape)
        self.of_left = np.zeros(size.shape[1])
        """(M,) error of what is left of a column's drive; inf: nothing is known of it"""
        beside = by_column * weight
        if law.has_potential:
            per_reading = self._per_reading(volts, noise)
            np.maximum(beside * beside * (in_column * per_reading - squares * random**2), 0.0, out=others)
            moved = squares * (1.0 + 2.0 * np.abs(by_column)) + by_column**2 * in_column
            shared += np.abs(beside) * np.broadcast_to(slope, size.shape).sum(axis=0) * steps.shared
            of_share = np.broadcast_to(law.share_slope(ports), size.shape)
            self.of_left = np.sqrt((of_share**2).sum(axis=0) * per_reading) + of_share.sum(axis=0) * steps.shared
            if steps.alike:
                self.of_left = np.where(law.in_question(ports, self.of_left), inf, self.of_left)
        self.of_sums: FloatArray = np.sqrt(moved.sum(axis=1)) * random
        """(N,) S, error of a row's sum of D"""
        self.row_open: FloatArray = self.of_sums * law.lead / np.maximum(ports.row_left, LEAST)
        """(N,) error of what is left of a row's drive, relative to it"""
        if law.has_leads:
            if steps.alike:  # a row stands between the drive and the highest of its columns
                height = np.clip(np.broadcast_to(ports.share, size.shape).max(axis=1), LEAST, 1.0)
                known = np.minimum((1.0 - height) / height / np.maximum(self.row_open, LEAST), 1.0)
                self.row_open, by_row = known * self.row_open, known[:, None] * by_row
                self.of_sums = known * self.of_sums
            others += by_row**2 * np.maximum(moved.sum(axis=1)[:, None] - moved, 0.0) * random**2
            each = np.broadcast_to(slope * np.abs(1.0 + by_column), size.shape)
            shared += by_row * each.sum(axis=1)[:, None] * steps.shared
        own_random = np.abs(per_volt) * random
        self._std = np.sqrt(own_random**2 + others) / random
        # Two bounds: what the cell's own reading may be off, and what all readings are off together.
        self.linear = np.minimum(self.own + np.sqrt(others), np.maximum(self.own, np.sqrt(own_random**2 + others)))
        """relative error, to first order"""
        self.linear += shared
        self.column_open: FloatArray = self.of_left / np.maximum(ports.left, LEAST)
        """(M,) error of what is left of a column's drive, relative to it"""
        self.opens = bool(self.row_open.max() > OPEN_ROW) or bool(np.isinf(self.of_left).any())
        """whether the error of a column or a row may change cells of others"""
        self.opens = self.opens or (law.has_leads and bool(self.column_open.max() > OPEN_SCALE))
        self.at_end: BoolArray | None = None
        """readings within their error of a short's; None: there are none"""
        if law.follows:
            at_end = law.at_end(ports, _WITHIN * self.error)
            lost = law.may_follow(ports, volts, _FOLLOWS) | at_end
            if lost.any():
                self.at_end = at_end if at_end.any() else None
                self.opens, self.linear = True, np.where(lost, inf, self.linear)
        self.per_volt = per_volt, np.broadcast_to(beside * np.sqrt(in_column), size.shape)
        """relative change of a cell per volt of its own reading, and per volt of independent errors of its column"""

    def _per_reading(self, volts: FloatArray, noise: float) -> FloatArray | float:
        """V^2 (M,), squared error of a reading that counts in its column: equal readings are rounded alike."""
        rows, random = len(volts), self._steps.random
        if not self._steps.alike or 3.0 * rows <= _BY_STEPS**2 or noise > self._steps.half:
            return self._by_steps**2 + self._by_noise**2
        alike = np.count_nonzero(volts == np.sort(volts, axis=0)[rows // 2], axis=0)
        counted = np.maximum((3.0 * alike**2 + _BY_STEPS**2 * (rows - alike)) / rows, _BY_STEPS**2)
        per_reading: FloatArray = counted * random**2 / 3.0 + self._by_noise**2
        return per_reading

    def relative(self, cells: FloatArray) -> FloatArray:
        """Relative uncertainty (N, M) of ``cells`` in S, which the laws gave before they were corrected."""
        beyond = np.expm1(np.minimum(self.linear - self.own, _LARGEST))  # errors of others are errors of a factor
        opened = self.column_open + self.row_open[:, None]
        uncertainty = np.where(opened < _OPENED, self.own + beyond, inf)
        more: FloatArray = np.maximum(self._cells / np.where(cells > 0.0, cells, _TINY), 1.0)
        more *= uncertainty
        return more

    def by_readings(self, total: FloatArray) -> FloatArray:
        """Relative change (N, M) by random errors of all readings, :attr:`error` each; at most ``total``, or 1."""
        at_most = np.minimum(np.minimum(self._std * self.error, total), 1.0)
        changed: FloatArray = np.maximum(at_most, np.minimum(self.own, 1.0))
        return changed
