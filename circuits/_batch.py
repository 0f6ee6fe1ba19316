"""Many frames of one design in one call: Monte Carlo, recordings, training data."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..errors import InputError, SolverError
from ._board import Board
from ._design import Design
from ._exact import read_exactly
from ._ideal import apparent_resistance
from ._scan import Demand, relative_bound
from .solvers import attenuate

_TOGETHER = 1 << 13  # cells solved in one go: enough to outweigh the calls, few enough for the processor's cache


@dataclass(frozen=True)
class BatchResult:
    """As :class:`._scan.ScanResult`, with the frames along the first axis: (frames, rows, columns)."""

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


def scan_batch(
    design: Design, resistance: ArrayLike, *, tolerance: float | None = None, method: str | None = None
) -> BatchResult:
    """Read frames (frames, rows, columns) of cells in ohm, several times as fast as a loop over :func:`._scan.scan`.

    Arguments and errors are those of :func:`._scan.scan`; messages name the frame.
    """
    demand = Demand.of(design, tolerance, method)
    cells = checked_frames(design, resistance)
    start = time.perf_counter()
    board = design.board
    lines = board.turn(cells)
    volts, saturated = np.empty(lines.shape), np.zeros(lines.shape, dtype=np.bool_)
    bound, methods = np.empty(len(cells)), ["exact"] * len(cells)
    share = max(1, _TOGETHER // design.array.rows // design.array.columns)
    for first in range(0, len(cells), share):
        pending = np.arange(first, min(first + share, len(cells)))
        if method == "attenuation" or demand is not None:
            found, attenuated, error = _attenuated(board, lines[pending])
            for frame, known, off in zip(pending[found], attenuated, error, strict=True):
                share_off = relative_bound(off, known)
                if demand is None or demand.is_met(float(off.max()), share_off):
                    volts[frame], bound[frame], methods[frame] = known, share_off, "attenuation"
            pending = np.array([frame for frame in pending if methods[frame] == "exact"], dtype=np.intp)
        if len(pending):
            reading, error = read_exactly(board, lines[pending])
            volts[pending] = board.circuit.in_the_limit(board, lines[pending], reading.volts)
            saturated[pending] = reading.saturated
            for frame, known, off in zip(pending, volts[pending], error, strict=True):
                bound[frame] = relative_bound(off, known)
        if tolerance is not None and len(coarse := pending[bound[pending] > tolerance]):
            raise SolverError(
                f"frame {coarse[0]}: no method certifies a tolerance of {tolerance:g} here; method 'exact' certifies "
                f"{bound[coarse[0]]:.1e} of the largest output"
            )
    volts = board.turn(volts)
    return BatchResult(
        volts=volts,
        saturated=board.turn(saturated),
        method=tuple(methods),
        error_bound=bound,
        seconds=time.perf_counter() - start,
        design=design,
    )


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


def _attenuated(board: Board, cells: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Indices of the frames that line attenuation can read, their outputs in V, and bounds on their errors in V."""
    nothing = np.empty(0, dtype=np.intp), np.empty((0, *board.shape)), np.empty((0, *board.shape))
    linear = board.linear
    if linear is None:
        return nothing
    conductance = board.cell_conductance(cells)
    found = np.flatnonzero(np.isfinite(conductance).all(axis=(1, 2)))
    known = attenuate(conductance[found], linear.wires) if len(found) else None
    if known is None:
        return nothing
    volts = linear.volts(known.transfer)
    error = linear.error(known.error, known.transfer)
    inside = linear.within_supply(volts, error)
    return found[inside], volts[inside], error[inside]
