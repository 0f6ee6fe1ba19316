"""Scan of frames that follow each other in time, by certified interpolation between frames that are solved exactly."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import BoolArray, FloatArray
from ..errors import InputError
from ._board import Board
from ._design import Design
from ._scan import BatchResult, checked_frames, scan_batch
from .readouts import output_rounding
from .solvers import SequenceTransfer, exact_transfer, sequence_transfer


def scan_sequence(design: Design, resistance: ArrayLike, *, error_volts: float | None = None) -> BatchResult:
    """Read a sequence of frames, most of them by interpolation between frames that are solved exactly.

    Only the error of line attenuation is interpolated, with a certificate: :mod:`.solvers._sequence`. Sequences to
    which this method does not apply (dividers, floating idle rows, bridges, shorted cells ...), and frames whose
    outputs may saturate, are read as by :func:`scan_batch`.

    Args:
        design: the board that reads the cells.
        resistance: (frames, rows, columns) ohm, one frame after the other in time at equal intervals.
        error_volts: V, largest acceptable error of any output; None: a quarter of an ADC step.

    Returns:
        As :func:`scan_batch`. ``method`` says "interpolation" for the frames that were not solved.

    Raises:
        InputError: the frames do not fit the design, or the error is not given and the design has no ADC.

    """
    cells = checked_frames(design, resistance)
    if error_volts is None:
        if design.adc is None:
            raise InputError("the design has no [adc] section; expected error_volts")
        error_volts = design.adc.step / 4.0
    if not error_volts > 0:
        raise InputError(f"error_volts is {error_volts}; expected more than 0")
    start = time.perf_counter()
    board = design.board
    found = _interpolated(board, board.turn(cells), error_volts) if len(cells) > 2 else None
    if found is None:
        return scan_batch(design, cells)
    lines, bound, solved, inside = found
    volts = board.turn(lines)
    methods = np.where(solved, "exact", "interpolation")
    saturated = np.zeros(volts.shape, dtype=np.bool_)
    if not inside.all():
        others = np.flatnonzero(~inside)
        read = scan_batch(design, cells[others])
        volts[others], saturated[others], bound[others] = read.volts, read.saturated, read.error_bound
        methods[others] = read.method
    return BatchResult(
        volts=volts,
        saturated=saturated,
        method=tuple(methods.tolist()),
        error_bound=bound,
        seconds=time.perf_counter() - start,
        design=design,
    )


def interpolates(design: Design) -> bool:
    """Whether :func:`scan_sequence` can interpolate frames of this design; of other designs it solves every frame."""
    linear = design.board.linear
    return linear is not None and linear.wires is not None


def _interpolated(
    board: Board, cells: FloatArray, error_volts: float
) -> tuple[FloatArray, FloatArray, BoolArray, BoolArray] | None:
    """Interpolated outputs of frames, in line coordinates; None if the method does not apply.

    Returns:
        Volts (frames, N, M), relative error bounds, whether each frame is a knot (solved exactly), and whether its
        outputs certainly stay within the supply; the last three are (frames,).

    """
    linear = board.linear
    if linear is None or linear.wires is None:
        return None
    conductance = board.cell_conductance(cells)
    if not np.isfinite(conductance.max()):
        return None
    lines = linear.lines
    volts_per_siemens = linear.largest_volts_per_siemens(board.shape[0])
    known: SequenceTransfer = sequence_transfer(
        conductance, linear.wires, lambda frames: exact_transfer(frames, lines), error_volts / volts_per_siemens
    )
    volts = linear.volts(known.transfer)
    largest = np.abs(volts).max(axis=(1, 2))
    error = volts_per_siemens * known.error + output_rounding(volts.shape) * largest
    inside = linear.within_supply(volts, error[:, None, None])
    for frame in np.flatnonzero(~inside):
        inside[frame] = linear.cannot_saturate(known.transfer[frame], float(known.error[frame]))
    with np.errstate(divide="ignore", invalid="ignore"):
        bound = np.where(error > 0, error / np.maximum(largest - error, 0.0), 0.0)
    return volts, bound, known.solved, inside
