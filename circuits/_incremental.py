"""A stream of frames of one design: what has not changed since the last frame is not solved again."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import FloatArray
from ._design import Design
from ._exact import exact_transfer, transfer_error
from ._scan import ScanResult, check_request, solve
from .solvers import _banded as banded
from .solvers._ports import Lines, Stream, has_ideal_lines


class Scanner:
    """Reads frame after frame; each costs what its changed cells cost.

    The methods, their choice and their certificates are those of :func:`._scan.scan`. Of the exact method, the blocks
    without a changed cell are kept; line attenuation costs less than finding out what changed. A frame that is the last
    one costs nothing. Results are the caller's own, whatever comes after them.
    """

    def __init__(self, design: Design, *, tolerance: float | None = None, method: str | None = None) -> None:
        """Arguments as for :func:`._scan.scan`. Raises InputError."""
        check_request(tolerance, method)
        self._design = design
        self._tolerance, self._method = tolerance, method
        self._tree = _LastTree()
        self._last: ScanResult | None = None

    def scan(self, resistance: ArrayLike) -> ScanResult:
        """Read one frame (rows, columns) of cells in ohm. Raises InputError and SolverError as :func:`._scan.scan`."""
        start = time.perf_counter()
        cells = self._design.resistance(resistance)
        last = self._last
        if last is not None and np.array_equal(last.cells, cells):
            last = replace(last, seconds=time.perf_counter() - start)
        else:
            last = self._last = solve(self._design, cells, self._tolerance, self._method, self._tree.transfer)
        return replace(last, volts=last.volts.copy(), saturated=last.saturated.copy(), cells=last.cells.copy())


class _LastTree:
    def __init__(self) -> None:
        self._tree: Stream | None = None

    def transfer(self, conductance: FloatArray, lines: Lines) -> tuple[FloatArray, FloatArray]:
        """As :func:`._exact.exact_transfer`, for one frame."""
        if conductance.size <= banded.LARGEST or has_ideal_lines(lines):
            return exact_transfer(conductance, lines)
        self._tree = self._tree or Stream(lines)
        transfer, relative = self._tree.transfer(conductance)
        return transfer, transfer_error(conductance, lines, transfer, relative)
