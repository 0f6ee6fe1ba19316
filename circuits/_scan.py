"""One frame through the readout: ``scan(design, resistance) -> ScanResult``."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import BoolArray, FloatArray
from ..errors import InputError, SolverError
from ._board import Board
from ._design import Design
from ._exact import read_exactly
from ._ideal import apparent_resistance
from .solvers import attenuate

_SMALL = 64  # cells up to which the exact method costs less than two tries: 85 us against 45 us at 8 x 8

METHODS = ("attenuation", "exact")
"""Values of ``scan(..., method=...)``, from the cheapest to the most accurate"""


@dataclass(frozen=True)
class ScanResult:
    """Result of a scan, with a certified error bound. Arrays are (rows, columns)."""

    volts: FloatArray
    """V at the amplifier outputs, or across the divider's load"""
    saturated: BoolArray
    """outputs at a supply limit"""
    method: str
    """the method that gave ``volts``: one of :data:`METHODS`"""
    error_bound: float
    """certified bound on the error of ``volts``, relative to the largest \\|volt\\|"""
    seconds: float
    """wall time of the solve"""
    design: Design = field(repr=False)
    cells: FloatArray = field(repr=False)
    """(rows, columns) ohm of the cells that were scanned"""

    @cached_property
    def resistance(self) -> FloatArray:
        """Apparent resistances (rows, columns) in ohm of ``volts`` by equation (10); inf where no current flows."""
        return apparent_resistance(self.design, self.volts)


def scan(
    design: Design, resistance: ArrayLike, *, tolerance: float | None = None, method: str | None = None
) -> ScanResult:
    """Read one frame of cells.

    Args:
        design: the board that reads the cells.
        resistance: (rows, columns) ohm; inf is an open cell, 0 a short.
        tolerance: largest acceptable error of any output, relative to the largest output. The scan takes the cheapest
            method that certifies this error. None: a quarter of an ADC step if the design has an ADC, otherwise the
            exact method.
        method: one of :data:`METHODS`, whatever its cost and error. Frames that line attenuation cannot express
            (dividers, shorted cells, saturated outputs ...) are read exactly even so.

    Raises:
        InputError: the array is not of the design's shape, or has NaN or negative entries; an unknown method; a
            tolerance that is not positive, or given together with a method.
        SolverError: no method can certify the tolerance.

    """
    demand = Demand.of(design, tolerance, method)
    cells = design.resistance(resistance)
    start = time.perf_counter()
    board = design.board
    answer = _cheapest(board, board.turn(cells), demand, method)
    seconds = time.perf_counter() - start
    return ScanResult(
        volts=board.turn(answer.volts),
        saturated=board.turn(answer.saturated),
        method=answer.method,
        error_bound=answer.bound,
        seconds=seconds,
        design=design,
        cells=cells,
    )


class Demand(NamedTuple):
    """Largest acceptable errors of a reading."""

    relative: float
    """of any output, relative to the largest output"""
    volts: float
    """of any output, in V"""

    @classmethod
    def of(cls, design: Design, tolerance: float | None, method: str | None) -> Demand | None:
        """Largest errors by the arguments of :func:`scan`; None if a method is given, or neither tolerance nor ADC.

        Raises:
            InputError: an unknown method, a tolerance that is not positive, or both a tolerance and a method.

        """
        if method is not None and method not in METHODS:
            raise InputError(f"unknown method '{method}'; expected one of {', '.join(METHODS)}")
        if tolerance is not None and not tolerance > 0:
            raise InputError(f"tolerance is {tolerance}; expected a number above 0")
        if tolerance is not None and method is not None:
            raise InputError("give a tolerance or a method, not both")
        if tolerance is not None:
            return cls(tolerance, inf)
        return cls(inf, design.adc.step / 4.0) if method is None and design.adc is not None else None

    def is_met(self, worst: float, bound: float) -> bool:
        """Whether outputs with errors of at most ``worst`` V, and ``bound`` relative to the largest, are acceptable."""
        return worst <= self.volts and bound <= self.relative


class _Answer(NamedTuple):
    volts: FloatArray
    saturated: BoolArray
    worst: float
    """bound in V on the error of any output"""
    bound: float
    """the same bound relative to the largest output"""
    method: str


def _cheapest(board: Board, cells: FloatArray, demand: Demand | None, method: str | None) -> _Answer:
    """Result of the cheapest method that meets the demand, for cells in line coordinates."""
    if method == "attenuation" or (demand is not None and cells.size > _SMALL):
        fast = _by_attenuation(board, cells)
        if fast is not None and (demand is None or demand.is_met(fast.worst, fast.bound)):
            return fast
    reading, error = read_exactly(board, cells)
    volts = board.circuit.in_the_limit(board, cells, reading.volts)
    exact = _Answer(volts, reading.saturated, float(error.max()), relative_bound(error, volts), "exact")
    if demand is None or demand.relative == inf or demand.is_met(exact.worst, exact.bound):
        return exact
    raise SolverError(
        f"no method certifies a tolerance of {demand.relative:g} here; method 'exact' certifies "
        f"{exact.bound:.1e} of the largest output"
    )


def _by_attenuation(board: Board, cells: FloatArray) -> _Answer | None:
    """None where line attenuation cannot express the frame, or where an output may saturate."""
    if board.linear is None:
        return None
    known = attenuate(board.cell_conductance(cells), board.linear.wires)
    if known is None:
        return None
    volts, *limits = board.linear.read(known)
    worst, sure = map(float, limits)
    if not board.linear.within_supply(volts, worst):
        return None
    return _Answer(volts, np.zeros(volts.shape, dtype=np.bool_), worst, _share(worst, sure), "attenuation")


def relative_bound(error: FloatArray, volts: FloatArray) -> float:
    """Ratio of the largest error in V to a lower bound on the largest finite output."""
    finite = np.isfinite(volts)
    worst = float(np.max(error, where=finite, initial=0.0))
    return _share(worst, float(np.max(np.abs(volts), where=finite, initial=0.0)) - worst)


def _share(worst: float, sure: float) -> float:
    return worst / sure if sure > 0 else inf if worst else 0.0
