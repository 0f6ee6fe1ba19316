"""The truth file: every frame as the emulator knows it, on disk as it goes, in bounded memory however long the run.

While the emulator runs, frames go to a spool beside the truth file: ``FILE.npz.spool.npy``, a structured array in
NumPy's own format. After each block the array's length in the header is brought up to date. So a spool that a killed
emulator leaves behind is a valid file that lacks the last block at most. At the end the spool becomes ``FILE.npz``.
"""

from __future__ import annotations

import contextlib
import io
import os
import time
from pathlib import Path
from types import TracebackType
from typing import IO, Self

import numpy as np

from ..common.arrays import AnyArray
from ..common.files import whole_file
from ..errors import InputError
from ._skin import Sample
from ._tuning import WRITTEN_BYTES, WRITTEN_S

SPOOL_SUFFIX = ".spool.npy"


class TruthFile:
    """Collects samples and becomes ``path`` at the end of the run, whatever ends it.

    Arrays: ``sequence`` (F,), ``time_s`` (F,), ``pressure_kpa``, ``resistance_ohm``, ``volts`` (F, rows, columns), and
    the numbers ``pitch_mm`` and ``full_scale_kpa`` for :func:`ohmskin.emulator.score`. A run that fails before its
    first frame leaves an old file alone.

    Raises:
        InputError: the file cannot be written: before the first frame where that can be known by then. Later the
            message names the spool that holds what was written.

    """

    def __init__(
        self, path: Path, shape: tuple[int, int], *, pitch_mm: float = np.nan, full_scale_kpa: float = np.nan
    ) -> None:
        """``shape`` is that of the array; the numbers are kept beside the frames."""
        self._path = path
        self._numbers = {"pitch_mm": pitch_mm, "full_scale_kpa": full_scale_kpa}
        self._record = np.dtype(
            [
                ("sequence", np.int64),
                ("time_s", np.float64),
                ("pressure_kpa", np.float64, shape),
                ("resistance_ohm", np.float64, shape),
                ("volts", np.float64, shape),
            ]
        )
        self._block = np.empty(max(1, WRITTEN_BYTES // self._record.itemsize), self._record)
        self._waiting = 0
        self._frames = 0
        self._written_at = 0.0
        self._disk_failed = False

    def __enter__(self) -> Self:
        if os.path.lexists(self._path) and not self._path.is_file():
            kind = "is a directory" if self._path.is_dir() else "is no regular file"
            raise InputError(f"{self._path}: cannot be written: {kind}; expected the name of an .npz file")
        try:
            self._spool_path, self._spool = _new_spool(self._path)
            self._spool.write(self._header(0))
            self._spool.flush()
        except OSError as error:
            raise InputError(f"{self._path}: cannot be written: {error.strerror}") from error
        self._written_at = time.monotonic()
        return self

    def append(self, sample: Sample) -> None:
        """Keep one frame. Raises InputError when the disk is full."""
        row = self._block[self._waiting]
        row["sequence"] = sample.sequence
        row["time_s"] = sample.time_s
        row["pressure_kpa"] = sample.pressure_kpa
        row["resistance_ohm"] = sample.resistance_ohm
        row["volts"] = sample.volts
        self._waiting += 1
        if self._waiting == len(self._block) or time.monotonic() > self._written_at + WRITTEN_S:
            self._write_block()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._disk_failed:
            self._spool.close()
            return  # the error has been raised, and names the spool
        try:
            if self._waiting:
                self._write_block()
            self._spool.close()
            if self._frames or kind is None:
                self._finish()
        except InputError:
            if kind is None:
                raise
            return  # the first error is the one to show; the spool stays
        finally:
            self._spool.close()
        with contextlib.suppress(OSError):
            self._spool_path.unlink()

    def _write_block(self) -> None:
        """Put the waiting frames behind the others, then bring the header up to date."""
        try:
            self._spool.seek(0, os.SEEK_END)
            self._spool.write(self._block[: self._waiting].view(np.uint8).data)
            self._spool.flush()
            self._frames += self._waiting
            self._waiting = 0
            self._spool.seek(0)
            self._spool.write(self._header(self._frames))
            self._spool.flush()
        except OSError as error:
            self._disk_failed = True
            raise InputError(
                f"{self._path}: cannot be written: {error.strerror}; {self._spool_path} holds {self._frames} frames"
            ) from error
        self._written_at = time.monotonic()

    def _header(self, frames: int) -> bytes:
        """NumPy's header, of the same length whatever the number of frames."""
        text = io.BytesIO()
        description = {"descr": np.lib.format.dtype_to_descr(self._record), "fortran_order": False, "shape": (frames,)}
        np.lib.format.write_array_header_1_0(text, description)
        return text.getvalue()

    def _finish(self) -> None:
        try:
            frames: AnyArray = np.empty(0, self._record)
            if self._frames:
                start = len(self._header(self._frames))
                frames = np.memmap(self._spool_path, self._record, "r", offset=start, shape=(self._frames,))
            with whole_file(self._path) as file:
                np.savez(
                    file,
                    allow_pickle=False,
                    **{name: frames[name] for name in self._record.names or ()},
                    **self._numbers,
                )
        except (OSError, InputError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            kept = f"; {self._spool_path} holds its {self._frames} frames" if self._frames else ""
            raise InputError(f"{self._path}: cannot be written: {reason}{kept}") from error


def _new_spool(path: Path) -> tuple[Path, IO[bytes]]:
    """A spool that did not exist: what a killed emulator left behind is not overwritten."""
    number = 1
    while True:
        spool = path.with_name(f"{path.name}{'' if number == 1 else f'.{number}'}{SPOOL_SUFFIX}")
        try:
            return spool, spool.open("x+b")
        except FileExistsError:
            number += 1
