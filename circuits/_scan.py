"""Frames through the readout: ``scan(design, resistance)`` reads one, ``scan_batch`` many in one call."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import IN_CACHE, BoolArray, FloatArray, IntArray
from ..errors import InputError, SolverError
from ._board import Board
from ._design import Design
from ._exact import read_exactly
from ._ideal import apparent_resistance
from ._tuning import SMALL
from .solvers import attenuate

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


@dataclass(frozen=True)
class BatchResult:
    """As :class:`ScanResult`, with the frames along the first axis: (frames, rows, columns)."""

    volts: FloatArray
    saturated: BoolArray
    method: tuple[str, ...]
    """of each frame"""
    error_bound: FloatArray
    """(frames,), relative to the largest \\|volt\\| of the frame"""
    seconds: float
    """wall time of all frames together"""
    design: Design = field(repr=False)

    @cached_property
    def resistance(self) -> FloatArray:
        """Apparent resistances in ohm of ``volts`` by equation (10); computed on first access."""
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
    demand = _Demand.of(design, tolerance, method)
    cells = design.resistance(resistance)
    start = time.perf_counter()
    board = design.board
    found = _read(board, board.transpose(cells)[None], demand)
    return ScanResult(
        volts=board.transpose(found.volts[0]),
        saturated=board.transpose(found.saturated[0]),
        method=METHODS[int(found.exact[0])],
        error_bound=float(_certified(found, tolerance)[0]),
        seconds=time.perf_counter() - start,
        design=design,
        cells=cells,
    )


def scan_batch(
    design: Design, resistance: ArrayLike, *, tolerance: float | None = None, method: str | None = None
) -> BatchResult:
    """Read frames (frames, rows, columns) of cells in ohm, several times as fast as a loop over :func:`scan`.

    Arguments and errors are those of :func:`scan`; messages name the frame.
    """
    demand = _Demand.of(design, tolerance, method)
    cells = checked_frames(design, resistance)
    start = time.perf_counter()
    board = design.board
    lines = board.transpose(cells)
    share = max(1, IN_CACHE // 8 // design.array.rows // design.array.columns)
    parts = [_read(board, lines[first : first + share], demand) for first in range(0, len(lines), share)]
    found = _Answers(*(np.concatenate(part) for part in zip(*parts, strict=True))) if parts else _nothing(lines.shape)
    return BatchResult(
        volts=board.transpose(found.volts),
        saturated=board.transpose(found.saturated),
        method=tuple(METHODS[exact] for exact in found.exact.astype(int)),
        error_bound=_certified(found, tolerance, frames=True),
        seconds=time.perf_counter() - start,
        design=design,
    )


class _Demand(NamedTuple):
    """Largest acceptable errors of a frame's outputs."""

    relative: float
    """relative to the largest output"""
    volts: float
    """V"""

    @classmethod
    def of(cls, design: Design, tolerance: float | None, method: str | None) -> _Demand | None:
        """Largest errors by the arguments of :func:`scan`; None: the exact method."""
        if method is not None and method not in METHODS:
            raise InputError(f"unknown method '{method}'; expected one of {', '.join(METHODS)}")
        if tolerance is not None and not tolerance > 0:
            raise InputError(f"tolerance is {tolerance}; expected a number above 0")
        if tolerance is not None and method is not None:
            raise InputError("give a tolerance or a method, not both")
        if tolerance is not None:
            return cls(tolerance, inf)
        if method is not None:
            return cls(inf, inf) if method == "attenuation" else None
        return None if design.adc is None else cls(inf, design.adc.step / 4.0)

    @property
    def is_any(self) -> bool:
        """Whether any error is acceptable."""
        return self.relative == self.volts == inf


class _Answers(NamedTuple):
    """Frames (F, N, M) in line coordinates."""

    volts: FloatArray
    saturated: BoolArray
    bound: FloatArray
    """(F,) relative to the largest output"""
    exact: BoolArray
    """(F,) whether the method is "exact" """


def _nothing(shape: tuple[int, ...]) -> _Answers:
    frames = shape[:1]
    return _Answers(np.empty(shape), np.zeros(shape, np.bool_), np.empty(frames), np.ones(frames, np.bool_))


def _read(board: Board, cells: FloatArray, demand: _Demand | None) -> _Answers:
    """Read frames, each by the cheapest method that meets the demand; none may."""
    found = _nothing(cells.shape)
    if demand is not None and (demand.is_any or cells.size > SMALL):
        _by_attenuation(board, cells, demand, found)
    pending = np.flatnonzero(found.exact)
    if len(pending):
        some = cells[pending]
        outputs, error = read_exactly(board, some)
        volts = board.circuit.in_the_limit(board, some, outputs.volts)
        found.volts[pending], found.saturated[pending] = volts, outputs.saturated
        finite = np.isfinite(volts)
        worst = np.max(error, axis=(-2, -1), where=finite, initial=0.0)
        largest = np.max(np.abs(volts), axis=(-2, -1), where=finite, initial=0.0)
        found.bound[pending] = _share(worst, largest - worst)
    return found


def _by_attenuation(board: Board, cells: FloatArray, demand: _Demand, found: _Answers) -> None:
    """Write the frames that line attenuation reads well enough; outputs that may saturate are none of these."""
    linear = board.linear
    if linear is None:
        return
    alone = len(cells) == 1  # most operations cost less on one frame than on a stack of one
    conductance = board.cell_conductance(cells[0] if alone else cells)
    places: slice | IntArray = slice(None)
    if not conductance.max() < inf:
        places = np.flatnonzero(np.isfinite(conductance).all(axis=(-2, -1)))
        if not len(places):
            return
    known = attenuate(conductance[places], linear.wires)
    if known is None:
        return
    volts, worst, sure = linear.read(known)
    bound = _share(worst, sure)
    good = linear.within_supply(volts, worst[..., None, None])
    good &= (worst <= demand.volts) & (bound <= demand.relative)
    if not good.all():
        if alone:
            return
        places = np.arange(len(cells))[places][good]
        volts, bound = volts[good], bound[good]
    found.volts[places], found.bound[places], found.exact[places] = volts, bound, False


def _share(worst: FloatArray, sure: FloatArray) -> FloatArray:
    """Ratio of errors to lower bounds on the largest output."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(worst > 0, worst / np.maximum(sure, 0.0), 0.0)


def _certified(found: _Answers, tolerance: float | None, *, frames: bool = False) -> FloatArray:
    """The bounds (F,); SolverError where one exceeds the tolerance, which names the frame if there are ``frames``."""
    if tolerance is not None and (coarse := found.bound > tolerance).any():
        first = int(coarse.argmax())
        raise SolverError(
            f"{f'frame {first}: ' if frames else ''}no method certifies a tolerance of {tolerance:g} here; method "
            f"'exact' certifies {found.bound[first]:.1e} of the largest output"
        )
    return found.bound


def checked_frames(design: Design, resistance: ArrayLike) -> FloatArray:
    """``resistance`` as (frames, rows, columns) in ohm; InputError names the first frame that does not fit."""
    try:
        cells = np.asarray(resistance, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"cell resistances are not numbers: {error}") from error
    if cells.ndim != 3 or cells.shape[1:] != design.array.shape:
        rows, columns = design.array.shape
        raise InputError(f"cell resistances have shape {cells.shape}, expected (frames, {rows}, {columns})")
    bad = np.flatnonzero(~(cells >= 0).all(axis=(1, 2)))
    if len(bad):
        try:
            design.resistance(cells[bad[0]])
        except InputError as error:
            raise InputError(f"frame {bad[0]}: {error}") from error
    return cells
