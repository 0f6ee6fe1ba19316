"""A stream of frames of one design: what has not changed since the last frame is not solved again."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import banded
from .attenuation import Attenuated, Ladders, Wires, certify
from .design import Design
from .exact import exact_transfer, transfer_error
from .ports import Lines, Stream, has_ideal_lines
from .scan import ScanResult, Tools, check_request, solve

FloatArray = NDArray[np.float64]


class Scanner:
    """Reads frame after frame; each costs what its changed cells cost.

    The methods, their choice and their certificates are those of :func:`.scan.scan`. Of the exact method, the blocks
    without a changed cell are kept; of line attenuation, the ladders of rows and columns without one. A frame that is
    the last one costs nothing.
    """

    def __init__(self, design: Design, *, tolerance: float | None = None, method: str | None = None) -> None:
        """Arguments as for :func:`.scan.scan`. Raises InputError."""
        check_request(tolerance, method)
        self._design = design
        self._tolerance, self._method = tolerance, method
        self._tools = Tools(_LastLadders().attenuate, _LastTree().transfer)
        self._last: tuple[FloatArray, ScanResult] | None = None

    def scan(self, resistance: ArrayLike) -> ScanResult:
        """Read one frame (rows, columns) of cells in ohm. Raises InputError and SolverError as :func:`.scan.scan`."""
        start = time.perf_counter()
        cells = self._design.resistance(resistance)
        if self._last is not None and np.array_equal(self._last[0], cells):
            return replace(self._last[1], seconds=time.perf_counter() - start)
        result = solve(self._design, cells, self._tolerance, self._method, self._tools)
        self._last = cells.copy(), result
        return result


class _LastTree:
    def __init__(self) -> None:
        self._tree: Stream | None = None

    def transfer(self, conductance: FloatArray, lines: Lines) -> tuple[FloatArray, FloatArray]:
        """As :func:`.exact.exact_transfer`, for one frame."""
        if conductance.size <= banded.LARGEST or has_ideal_lines(lines):
            return exact_transfer(conductance, lines)
        self._tree = self._tree or Stream(lines)
        transfer, relative = self._tree.transfer(conductance)
        return transfer, transfer_error(conductance, lines, transfer, relative)


class _LastLadders:
    def __init__(self) -> None:
        self._cells: FloatArray | None = None
        self._ladders: tuple[Ladders, Ladders] | None = None

    def attenuate(self, conductance: FloatArray, wires: Wires | None) -> Attenuated | None:
        """As :func:`.attenuation.attenuate`, for one frame."""
        if wires is None or not np.isfinite(conductance).all():
            return None
        if self._cells is None or self._ladders is None:
            self._ladders = wires.ladders(conductance[None])
        else:
            changed = self._cells != conductance
            turned = conductance[::-1]
            row, column = self._ladders
            self._ladders = (
                _updated(row, conductance.T, changed.any(axis=1)),
                _updated(column, turned, changed.any(axis=0)),
            )
        self._cells = conductance
        known = certify(wires, conductance[None], *self._ladders, ())
        return known if np.isfinite(known.relative) else None


def _updated(ladders: Ladders, shunt: FloatArray, changed: NDArray[np.bool_]) -> Ladders:
    """The ladders with those lines solved again that have changed."""
    if changed.all():
        return Ladders.solve(ladders.series, np.ascontiguousarray(shunt))
    if changed.any():
        some = Ladders.solve(ladders.series[:, changed], shunt[:, changed])
        ladders.shunt[:, changed] = some.shunt
        ladders.admittance[:, changed] = some.admittance
        ladders.profile[:, changed] = some.profile
    return ladders
