"""Many frames of one design in one call: Monte Carlo, recordings, training data."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import BoolArray, FloatArray, IntArray
from ..errors import InputError
from ._design import Design
from ._exact import read_exactly
from ._linear import LinearReadout
from ._parts import cell_conductance
from ._readout import apparent_resistance
from ._scan import Demand, check_request, ideal_limits, relative, scan
from .solvers._attenuation import attenuate

_TOGETHER = 1 << 13  # cells solved in one go: enough to outweigh the calls, few enough for the processor's cache


@dataclass(frozen=True)
class BatchResult:
    """As :class:`._scan.ScanResult`, with the frames along the first axis: (frames, rows, columns)."""

    volts: FloatArray
    resistance: FloatArray
    saturated: BoolArray
    method: tuple[str, ...]
    """of each frame"""
    error_bound: FloatArray
    """(frames,), relative to the largest \\|volt\\| of the frame"""
    seconds: float
    """wall time of all frames together"""


def scan_batch(
    design: Design, resistance: ArrayLike, *, tolerance: float | None = None, method: str | None = None
) -> BatchResult:
    """Read frames (frames, rows, columns) of cells in ohm, several times as fast as a loop over :func:`._scan.scan`.

    Arguments and errors are those of :func:`._scan.scan`; messages name the frame.
    """
    check_request(tolerance, method)
    cells = checked_frames(design, resistance)
    start = time.perf_counter()
    volts, saturated = np.empty(cells.shape), np.zeros(cells.shape, dtype=np.bool_)
    bound, methods = np.empty(len(cells)), ["exact"] * len(cells)
    demand = Demand.of(design, tolerance, method)
    share = max(1, _TOGETHER // design.array.rows // design.array.columns)
    for first in range(0, len(cells), share):
        pending = np.arange(first, min(first + share, len(cells)))
        if method == "attenuation" or demand is not None:
            found, attenuated, error = _attenuated(design, cells[pending])
            for frame, known, off in zip(pending[found], attenuated, error, strict=True):
                share_off = relative(off, known)
                if demand is None or demand.kept(float(off.max()), share_off):
                    volts[frame], bound[frame], methods[frame] = known, share_off, "attenuation"
            pending = np.array([frame for frame in pending if methods[frame] == "exact"], dtype=np.intp)
        if method != "series" and len(pending):
            reading, error = read_exactly(design, cells[pending])
            for frame, known, flags, off in zip(pending, reading.volts, reading.saturated, error, strict=True):
                volts[frame], saturated[frame], bound[frame] = known, flags, relative(off, known)
        for frame in pending:  # one by one: what is left to the series
            if method == "series" or (tolerance is not None and bound[frame] > tolerance):
                one = scan(design, cells[frame], tolerance=tolerance, method=method)
                volts[frame], saturated[frame] = one.volts, one.saturated
                bound[frame], methods[frame] = one.error_bound, one.method
    volts = ideal_limits(design, cells, volts)
    return BatchResult(
        volts=volts,
        resistance=apparent_resistance(design, volts),
        saturated=saturated,
        method=tuple(methods),
        error_bound=bound,
        seconds=time.perf_counter() - start,
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


def _attenuated(design: Design, cells: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Which of the frames line attenuation can read, their outputs and the errors of these, in V."""
    nothing = np.empty(0, dtype=np.intp), np.empty((0, *design.array.shape)), np.empty((0, *design.array.shape))
    linear = LinearReadout.of(design)
    if linear is None:
        return nothing
    conductance = cell_conductance(design, cells)
    found = np.flatnonzero(np.isfinite(conductance).all(axis=(1, 2)))
    known = attenuate(conductance[found], linear.wires) if len(found) else None
    if known is None:
        return nothing
    volts = linear.volts(known.transfer)
    error = linear.error(known.error, known.transfer)
    inside = linear.within_supply(volts, error)
    return found[inside], volts[inside], error[inside]
