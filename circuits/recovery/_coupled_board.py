"""A coupled board for live recovery: the parts that stay constant from frame to frame, and the circuit model.

Cells are (N, M) in line coordinates. Unknowns are the logarithms of their conductances, flattened to n = N M.
"""

from __future__ import annotations

from dataclasses import replace
from math import hypot, inf, sqrt
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._adc import adc_error
from .._board import Board, broken_off
from .._sections import Fault
from ._lines import LineResistance
from ._live_reading import SIGMAS
from ._quick_model import QuickModel
from ._sheet_model import SheetModel

_COMPLETE_SHORT = 1e-5  # ohm that stands for a short of 0 ohm


class Known(NamedTuple):
    """Cells at which the model has been evaluated."""

    log: FloatArray
    """(n,) logarithms of the conductances"""
    cells: FloatArray
    """(N, M) ohm, the same cells"""
    volts: FloatArray
    """(n,) V, the readings of the model for these cells"""


class Compared(NamedTuple):
    """Cells, and their misfit with the readings of a frame."""

    known: Known
    """the cells"""
    apart: FloatArray
    """V (n,) between readings and model, where the readings count"""
    half_steps: float
    """misfit: root mean square of ``apart``, or half of the largest if that is more, over the converter's half step"""


class Frame(NamedTuple):
    """One frame of readings, and which of them count."""

    volts: FloatArray
    """(N, M) V"""
    signal: FloatArray
    """(N, M) V, distance of the readings from the reference voltage"""
    slope: FloatArray
    """(n,) 1/V: change of a cell's logarithm per volt of its reading if the cell were alone"""
    noise: float
    """V, standard deviation"""
    half_step: float
    """V, the converter's error"""
    error: float
    """V, half a step and :data:`.SIGMAS` standard deviations of the noise"""
    coarser: float
    """standard deviation of the readings by rounding and noise, over that by rounding alone"""
    bottom: BoolArray | None
    """(n,) readings at the lower end of the range, whose voltages may lie below; None: there are none"""
    ignored: BoolArray | None
    """(n,) readings that do not count; None: all do"""

    @property
    def measured(self) -> FloatArray:
        """(n,) V, the readings."""
        return self.volts.ravel()

    def compared(self, known: Known) -> Compared:
        """Compare the readings with those of the model."""
        apart = self.volts.ravel() - known.volts
        if self.bottom is not None:
            apart[self.bottom & (apart > 0.0)] = 0.0
        if self.ignored is not None:
            apart[self.ignored] = 0.0
        # argmax() and argmin() are several times as fast as max() and min().
        most = max(apart.item(apart.argmax()), -apart.item(apart.argmin()))
        root_mean_square = sqrt(float(apart @ apart) / len(apart))
        return Compared(known, apart, max(root_mean_square, 0.5 * most) / self.half_step)


class CoupledBoard:
    """Constant parts of a board with a converter, and its circuit model without limits."""

    def __init__(self, board: Board) -> None:
        """For a board with a converter."""
        # Readings at a limit are not fitted. A model without limits has derivatives wherever the fit passes through.
        whole = replace(board, supply=(-inf, inf))
        self.board = replace(whole, continuous=False, faults=tuple(map(_with_resistance, board.faults)))
        self.shape = board.shape
        self.half_step = adc_error(self.board)
        """V"""
        self.noise = float(self.half_step / np.sqrt(3.0))
        """V, standard deviation of an error within a step"""
        self.mixes = board.circuit.mixes_cells or board.floating
        """whether readings depend on cells of other rows and other columns"""
        self.hidden = (broken_off(self.board) | np.isinf(board.series_ohms)).ravel()
        """(n,) cells that a fault disconnects from the circuit"""
        self.any_hidden = bool(self.hidden.any())
        self.shorted = np.zeros(board.shape, dtype=np.bool_)
        """(N, M) cells beside a fault of 0 ohm"""
        for fault in whole.shorts:
            self.shorted[fault.place] |= fault.ohms == 0
        self.gone = self.hidden | self.shorted.ravel()
        """(n,) cells that no reading determines"""
        self.lines = LineResistance(self.board)
        self.leads = self.lines.to_ends + board.column_lead
        """(N, M) ohm in series with each cell"""
        self.quick = QuickModel(self.board, self.lines)
        """outputs of a sliced sheet"""
        self.sheet = SheetModel(whole, self.quick) if whole.continuous else None
        """outputs of a continuous sheet; None for a sliced one"""
        self._model = self.quick if self.sheet is None else self.sheet
        # An offset may push the output of an open cell below the converter's range, however far.
        self._lowest = -inf
        if board.circuit.has_amplifiers and board.adc is not None:
            self._lowest = board.adc.range[0] + board.adc.step

    def price(self, log: FloatArray) -> float:
        """Price of an evaluation of the model for the logarithms (n,) of conductances."""
        known = self.quick.fixed_price
        return self.quick.price(np.exp(-log).reshape(self.shape)) if known is None else known

    def at(self, log: FloatArray) -> Known:
        """Evaluate the model for the logarithms (n,) of the conductances."""
        cells = np.exp(-log).reshape(self.shape)
        return Known(log, cells, self._model(cells).ravel())

    def slope(self, volts: FloatArray) -> FloatArray:
        """Change (n,) of each cell's logarithm per volt if it were alone, in 1/V, at readings in V; 0 for no change."""
        shaped = volts.reshape(self.shape)
        slope = self.board.circuit.log_conductance_slope(self.board, shaped - self.board.level)
        return np.abs(slope).ravel()

    def frame(self, volts: FloatArray, signal: FloatArray, noise: float, ignored: BoolArray | None) -> Frame:
        """Make the :class:`Frame` of readings (N, M) in V."""
        bottom = None if self._lowest == -inf else volts.ravel() < self._lowest
        return Frame(
            volts=volts,
            signal=signal,
            slope=self.slope(volts),
            noise=noise,
            half_step=self.half_step,
            error=self.half_step + SIGMAS * noise,
            coarser=hypot(1.0, noise / self.noise),
            bottom=bottom if bottom is not None and np.count_nonzero(bottom) else None,
            ignored=ignored,
        )


def _with_resistance(fault: Fault) -> Fault:
    """The fault, with a resistance far below that of any wire where it has none."""
    return fault.replace(resistance=_COMPLETE_SHORT) if fault.kind == "shorted-cell" and fault.ohms == 0 else fault
