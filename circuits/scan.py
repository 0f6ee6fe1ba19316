"""One frame through the readout: ``scan(design, resistance) -> ScanResult``."""

from __future__ import annotations

import time
from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .design import Design
from .exact import read_exactly
from .readout import apparent_resistance

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class ScanResult:
    """What a scan found, and how far it can be trusted. Arrays are (rows, columns)."""

    volts: FloatArray
    """V at the amplifier outputs, or across the divider's load"""
    resistance: FloatArray
    """ohm that equation (10) makes of ``volts``; inf where no current flows"""
    saturated: NDArray[np.bool_]
    """outputs at a supply limit"""
    method: str
    error_bound: float
    """certified bound on the error of ``volts``, relative to the largest \\|volt\\|"""
    seconds: float
    """wall time of the solve"""


def scan(design: Design, resistance: ArrayLike, *, tolerance: float | None = None) -> ScanResult:
    """Read one frame of cells.

    Args:
        resistance: (rows, columns) ohm; inf is an open cell, 0 a short.
        tolerance: largest acceptable error of any output, relative to the largest one.

    Raises:
        InputError: the array is not of the design's shape, or has NaN or negative entries.

    """
    cells = design.resistance(resistance)
    start = time.perf_counter()
    reading, error = read_exactly(design, cells)
    volts = _infinite_where_shorted(design, cells, reading.volts)
    seconds = time.perf_counter() - start
    return ScanResult(
        volts=volts,
        resistance=apparent_resistance(design, volts),
        saturated=reading.saturated,
        method="exact",
        error_bound=_relative(error, volts),
        seconds=seconds,
    )


def _relative(error: FloatArray, volts: FloatArray) -> float:
    """Largest error relative to the largest finite output."""
    finite = np.isfinite(volts)
    largest = np.max(np.abs(volts), where=finite, initial=0.0)
    worst = np.max(error, where=finite, initial=0.0)
    return float(worst / largest) if largest else inf if worst else 0.0


def _infinite_where_shorted(design: Design, cells: FloatArray, volts: FloatArray) -> FloatArray:
    """The output of an ideal amplifier on a shorted cell with ideal lines has no finite value."""
    if design.readout.circuit != "inverting-amplifier" or (cells > 0).all():
        return volts
    array = design.array
    ohms = np.r_[cells.ravel(), array.row_lead, array.row_segment, array.column_lead, array.column_segment]
    smallest = np.min(ohms, where=ohms > 0, initial=np.finfo(np.float64).max)
    finite = abs(design.drive.voltage) * design.readout.reference_resistance * ohms.size / smallest
    signal = volts - design.readout.reference_voltage
    return np.where(np.abs(signal) > 1e9 * finite, np.copysign(np.inf, signal), volts)
