"""The truth file: every frame as the emulator knows it, in bounded memory however long the run."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from ..errors import InputError
from ..files import whole_file
from ._skin import Sample


class TruthFile:
    """Collects samples in a spool beside ``path`` and becomes the .npz file on a regular exit.

    Arrays: ``sequence`` (F,), ``time_s`` (F,), ``pressure_kpa``, ``resistance_ohm``, ``volts`` (F, rows, columns).
    An exit by exception leaves nothing behind.

    Raises:
        InputError: the file cannot be written there; known before the first frame.

    """

    def __init__(self, path: Path, shape: tuple[int, int]) -> None:
        self._path = path
        self._record = np.dtype(
            [
                ("sequence", np.int64),
                ("time_s", np.float64),
                ("pressure_kpa", np.float64, shape),
                ("resistance_ohm", np.float64, shape),
                ("volts", np.float64, shape),
            ]
        )

    def __enter__(self) -> Self:
        if self._path.is_dir():
            raise InputError(f"{self._path}: cannot be written: is a directory")
        try:
            self._spool = tempfile.TemporaryFile(dir=self._path.parent)
        except OSError as error:
            raise InputError(f"{self._path}: cannot be written: {error.strerror}") from error
        return self

    def append(self, sample: Sample) -> None:
        """Keep one frame."""
        row = np.empty((), dtype=self._record)
        for name in self._record.names or ():
            row[name] = getattr(sample, name)
        try:
            self._spool.write(row.tobytes())
        except OSError as error:
            raise InputError(f"{self._path}: cannot be written: {error.strerror}") from error

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._spool:
            if kind is None:
                self._write()

    def _write(self) -> None:
        try:
            self._spool.flush()
            empty = not os.fstat(self._spool.fileno()).st_size
            frames = np.empty(0, self._record) if empty else np.memmap(self._spool, self._record, mode="r")
        except OSError as error:
            raise InputError(f"{self._path}: cannot be written: {error.strerror}") from error
        with whole_file(self._path) as file:
            np.savez(file, allow_pickle=False, **{name: frames[name] for name in self._record.names or ()})
