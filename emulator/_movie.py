"""Movies: the pressure or the resistance of every cell over time, from a file such as a recording of a real skin."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import PrivateAttr

from ..common.archives import Stored, read_arrays
from ..common.arrays import FloatArray
from ..common.config import LocalFile, Section
from ..common.tables import read_columns
from ..errors import InputError
from ._loads import Seconds, within_period

_MOST_BYTES = 1 << 30
"""size limit of a movie of one quantity in memory"""
_NAMES = {"pressure": ("pressure_kpa", "pressure"), "resistance": ("resistance_ohm", "resistance")}
_TIMES = ("time_s", "time")
_CELLS = ("frames", "rows", "columns")


class Movie(Section):
    """Frames of pressure or resistance, linear in time between them, constant before the first and after the last."""

    file: LocalFile
    """.npz with arrays ``time_s`` (F,) and ``pressure_kpa`` or ``resistance_ohm`` (F, rows, columns), as the emulator's
    truth has them; or .csv with columns ``time_s``, ``r0c0``, ``r0c1`` and so on. Relative to the scene file."""
    quantity: Literal["pressure", "resistance"] = "pressure"
    """pressure: kPa on the surface, added to that of the contacts; resistance: ohm of the cells, whatever presses"""
    period: Seconds | None = None
    """s, after which the movie begins anew; left out: never"""
    _checked: tuple[FloatArray, FloatArray] | None = PrivateAttr(default=None)

    def frames(self, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        """Times (F,) in s from the first frame on, and frames (F, rows, columns). Raises InputError."""
        if self._checked is None:
            self._checked = self._check(shape)
        return self._checked

    def _check(self, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        path = self.file
        match path.suffix.lower():
            case ".npz" | ".npy":
                times, frames = self._from_npz(path)
            case ".csv":
                times, frames = self._from_csv(path, shape)
            case suffix:
                raise InputError(f"{path}: '{suffix}' is no kind of movie; expected .npz or .csv")
        if frames.ndim != 3 or frames.shape[1:] != shape:
            raise InputError(f"{self.file}: has frames of shape {frames.shape[1:]}, expected {shape} (rows, columns)")
        if times.shape != frames.shape[:1] or not len(times):
            raise InputError(f"{self.file}: has {times.size} times for {len(frames)} frames; expected one for each")
        if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise InputError(f"{self.file}: its times must be finite and increase")
        most = np.inf if self.quantity == "resistance" else 1e30
        if not ((frames >= 0) & (frames <= most)).all():
            frame, row, column = np.argwhere(~((frames >= 0) & (frames <= most)))[0]
            raise InputError(
                f"{self.file}: frame {frame}, row {row}, column {column} is {frames[frame, row, column]}; "
                f"expected a {self.quantity} >= 0"
            )
        return times - times[0], frames

    def at(self, time_s: FloatArray, shape: tuple[int, int]) -> FloatArray:
        """(frames, rows, columns) at each of ``time_s``."""
        times, frames = self.frames(shape)
        if len(times) == 1:
            return np.repeat(frames, len(time_s), axis=0)
        time = time_s if self.period is None else within_period(time_s, self.period)
        place = np.interp(time, times, np.arange(len(times), dtype=np.float64))
        before = np.minimum(place.astype(np.intp), len(times) - 2)
        share = (place - before)[:, None, None]
        first, last = frames[before], frames[before + 1]
        with np.errstate(invalid="ignore"):
            between = first + share * (last - first)
        # An open cell has no straight line to a closed one: it stays open until the next frame.
        result: FloatArray = np.where(np.isfinite(between), between, np.where(share < 1.0, first, last))
        return result

    def _from_npz(self, path: Path) -> tuple[FloatArray, FloatArray]:
        wanted = {name: Stored("numbers", ("frames",), optional=True) for name in _TIMES}
        wanted |= {name: Stored("numbers", _CELLS, nan=True, optional=True) for name in _NAMES[self.quantity]}
        arrays = read_arrays(path, wanted, what="movie", most_bytes=2 * _MOST_BYTES)
        return _first(arrays, _TIMES, path), _first(arrays, _NAMES[self.quantity], path)

    def _from_csv(self, path: Path, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        rows, columns = shape
        names = [f"r{row}c{column}" for row in range(rows) for column in range(columns)]
        table = read_columns(path, ["time_s", *names])
        frames = np.stack([table[name] for name in names], axis=1)
        return table["time_s"], frames.reshape(-1, rows, columns)


def _first(arrays: Mapping[str, FloatArray], names: tuple[str, ...], path: Path) -> FloatArray:
    """The first array that is there."""
    for name in names:
        if name in arrays:
            return arrays[name]
    raise InputError(f"{path}: has no array '{names[0]}'")
