"""One frame through the readout: ``scan(design, resistance) -> ScanResult``."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import BoolArray, FloatArray
from ..errors import InputError, SolverError
from ._design import Design
from ._effects import Effect, effects
from ._exact import Transfer, exact_transfer, read_exactly
from ._linear import LinearReadout
from ._parts import Parts, cell_conductance
from ._readout import apparent_resistance
from .solvers._attenuation import Attenuated, Wires, attenuate
from .solvers._ports import IDEAL_WIRE, LARGEST_PART
from .solvers._series import terms

_FEW = 64  # cells up to which the exact method takes less than two tries: 85 us against 45 us at 8 x 8

METHODS = ("attenuation", "series", "exact")
"""From the cheapest to the most accurate."""


@dataclass(frozen=True)
class ScanResult:
    """What a scan found, and how far it can be trusted. Arrays are (rows, columns)."""

    volts: FloatArray
    """V at the amplifier outputs, or across the divider's load"""
    saturated: BoolArray
    """outputs at a supply limit"""
    method: str
    error_bound: float
    """certified bound on the error of ``volts``, relative to the largest \\|volt\\|"""
    seconds: float
    """wall time of the solve"""
    design: Design = field(repr=False)
    cells: FloatArray = field(repr=False)
    """(rows, columns) ohm that were read"""

    @cached_property
    def resistance(self) -> FloatArray:
        """(rows, columns) ohm that equation (10) makes of ``volts``; inf where no current flows."""
        return apparent_resistance(self.design, self.volts)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """What was modelled, and what was left out, each with its size to first order; worked out when asked for."""
        return effects(self.design, self.cells)


def scan(
    design: Design, resistance: ArrayLike, *, tolerance: float | None = None, method: str | None = None
) -> ScanResult:
    """Read one frame of cells.

    Args:
        design: what reads them.
        resistance: (rows, columns) ohm; inf is an open cell, 0 a short.
        tolerance: largest acceptable error of any output, relative to the largest one: the cheapest method is taken
            that certifies it. None: a quarter of an ADC step where the design has an ADC, else the exact method.
        method: one of :data:`METHODS`, whatever it costs and whatever its error. Frames that a fast method cannot
            express (dividers, shorted cells, saturated outputs ...) are read exactly all the same.

    Raises:
        InputError: the array is not of the design's shape, or has NaN or negative entries; an unknown method; a
            tolerance that is not positive, or given together with a method.
        SolverError: no method can certify the tolerance.

    """
    check_request(tolerance, method)
    cells = design.resistance(resistance)
    return solve(design, cells, tolerance, method)


def solve(
    design: Design, cells: FloatArray, tolerance: float | None, method: str | None, transfer: Transfer = exact_transfer
) -> ScanResult:
    """:func:`scan`, with everything checked; ``transfer`` solves the exact method's linear frames."""
    start = time.perf_counter()
    answer = _cheapest(design, cells, tolerance, method, transfer)
    seconds = time.perf_counter() - start
    return ScanResult(
        volts=answer.volts,
        saturated=answer.saturated,
        method=answer.method,
        error_bound=answer.bound,
        seconds=seconds,
        design=design,
        cells=cells,
    )


def check_request(tolerance: float | None, method: str | None) -> None:
    """Raises InputError."""
    if method is not None and method not in METHODS:
        raise InputError(f"unknown method '{method}'; expected one of {', '.join(METHODS)}")
    if tolerance is not None and not tolerance > 0:
        raise InputError(f"tolerance is {tolerance}; expected a number above 0")
    if tolerance is not None and method is not None:
        raise InputError("give a tolerance or a method, not both")


class _Answer(NamedTuple):
    volts: FloatArray
    saturated: BoolArray
    worst: float
    """V that no output is off by more than"""
    bound: float
    """the same relative to the largest output"""
    method: str


def _cheapest(
    design: Design, cells: FloatArray, tolerance: float | None, method: str | None, transfer: Transfer
) -> _Answer:
    """In the order of what the methods cost, the first that does what is asked for."""
    demand = Demand.of(design, tolerance, method)
    first: Series | None = None
    if method == "series":
        first = terms
    elif method == "attenuation" or (demand is not None and cells.size > _FEW):
        first = _alone
    if first is not None:
        *_, fast = None, *_answers(design, cells, first)
        if fast is not None and (demand is None or demand.kept(fast.worst, fast.bound)):
            return fast
    reading, error = read_exactly(design, cells, transfer)
    volts = ideal_limits(design, cells, reading.volts)
    exact = _Answer(volts, reading.saturated, float(error.max()), relative(error, volts), "exact")
    if tolerance is None or demand is None or demand.kept(exact.worst, exact.bound):
        return exact
    for better in _answers(design, cells, terms):
        if demand.kept(better.worst, better.bound):
            return better
    raise SolverError(
        f"no method certifies a tolerance of {tolerance:g} here; method 'exact' certifies "
        f"{exact.bound:.1e} of the largest output"
    )


class Demand(NamedTuple):
    """How good a reading must at least be."""

    relative: float
    """error relative to the largest output"""
    volts: float
    """error of any output"""

    @classmethod
    def of(cls, design: Design, tolerance: float | None, method: str | None) -> Demand | None:
        """None where nothing but the method is asked for."""
        if tolerance is not None:
            return cls(tolerance, inf)
        return cls(inf, design.adc.step / 4.0) if method is None and design.adc is not None else None

    def kept(self, worst: float, bound: float) -> bool:
        """By outputs of which none is off by more than ``worst`` in V, ``bound`` relative to the largest."""
        return worst <= self.volts and bound <= self.relative


Series = Callable[[FloatArray, Wires | None], Iterable[Attenuated]]
"""Cells (N, M) in S and their wires to better and better transfer conductances, or none."""


def _alone(conductance: FloatArray, wires: Wires | None) -> Iterable[Attenuated]:
    known = attenuate(conductance, wires)
    return () if known is None else (known,)


def _answers(design: Design, cells: FloatArray, series: Series) -> Iterator[_Answer]:
    """Better and better readings; none where the series does not apply, or where an output may saturate."""
    linear, last = LinearReadout.of(design), inf
    if linear is None:
        return
    for number, known in enumerate(series(cell_conductance(design, cells), linear.wires)):
        volts, *limits = linear.read(known)
        worst, sure = map(float, limits)
        if number and not worst < 0.7 * last:  # rounding is all that is left, or the lines are too heavy for this
            return
        last = worst
        if linear.within_supply(volts, worst):
            flags = np.zeros(volts.shape, dtype=np.bool_)
            yield _Answer(volts, flags, worst, _share(worst, sure), "series" if number else "attenuation")


def relative(error: FloatArray, volts: FloatArray) -> float:
    """Largest error relative to the largest finite output that is sure to be there."""
    finite = np.isfinite(volts)
    worst = float(np.max(error, where=finite, initial=0.0))
    return _share(worst, float(np.max(np.abs(volts), where=finite, initial=0.0)) - worst)


def _share(worst: float, sure: float) -> float:
    return worst / sure if sure > 0 else inf if worst else 0.0


def ideal_limits(design: Design, cells: FloatArray, volts: FloatArray) -> FloatArray:
    """What the large conductances that stand for ideal wires and shorts mean in the limit (amplifiers only).

    The output of an ideal amplifier on a shorted cell with ideal lines has no finite value: a current far above what
    LARGEST_PART could carry comes through nothing else. And no current leaks over an ideal line: what is smaller than
    the largest signal by the square of IDEAL_WIRE came that way.
    """
    if design.readout.circuit != "inverting-amplifier":
        return volts
    level, reference = design.readout.reference_voltage, Parts.of(design).reference
    signal = volts - level
    most = 1e3 * LARGEST_PART * cells.size * abs(design.drive.voltage) * reference
    finite = np.abs(signal) <= most
    least = IDEAL_WIRE**-2 * np.max(np.abs(signal), where=finite, initial=0.0)
    return np.where(finite, np.where(np.abs(signal) < least, level, volts), np.copysign(np.inf, signal))
