"""A recording as a source: decoded once from start to end, since the estimator is causal; then any frame at once.

The messages of the frames go to a temporary file without a name, which the operating system removes when the page
ends. Memory holds 16 bytes per frame: its time, and its place in the file.
"""

from __future__ import annotations

import asyncio
import math
import mmap
import os
import tempfile
from array import array

import numpy as np

from ..common.arrays import FloatArray, IntArray
from ..common.events import SignalSafeEvent
from ..driver import Frame, Skin
from ..errors import InputError, LinkEnded, LinkError, LinkTimeout, ProtocolError
from ._frame_message import HEADER, TOTAL_FORCE_AT, pack_frame
from ._orders import FrameOrder, NextFrame, ShowTime, TraceCells
from ._source import Report, Source, TimeAxis, statistics

SAME_TIME_S = 1e-6
"""a slider of a browser rounds its value a little"""
FRAMES_AT_ONCE = 65536
"""read from the file at a time, for a trace"""


class RecordedSource(Source):
    """The frames of a recording, opened as a skin that delivers every frame.

    The page can be used while a thread still decodes: it then shows what there is so far.
    """

    live = False

    def __init__(self, skin: Skin, *, name: str = "") -> None:
        """Prepare the temporary file; InputError where none can be made."""
        super().__init__(skin, name=name)
        try:
            self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115  # closed by close()
        except OSError as error:
            skin.close()
            raise InputError(
                f"{tempfile.gettempdir()}: cannot hold decoded frames: {error.strerror or error}"
            ) from error
        self._times_s = array("d")
        """of the frames since the first one, never decreasing"""
        self._ends = array("q", [0])
        """frame k is in the file from ``_ends[k]`` to ``_ends[k + 1]``"""
        self._shows = SignalSafeEvent()
        """there is a frame, or there will be none"""
        self._complete = False
        self._problem = ""

    def close(self) -> None:
        """Stop decoding, and give the temporary file up."""
        super().close()
        self._file.close()

    def _take_frames(self) -> None:
        axis = TimeAxis()
        while True:
            try:
                for frame in self.skin.read_many():
                    self._append(frame, axis.of(frame))
            except LinkEnded:
                break
            except (LinkTimeout, ProtocolError) as error:
                self._problem = str(error)
            except LinkError as error:
                self._problem = str(error)
                break
            except OSError as error:
                self._problem = f"{tempfile.gettempdir()}: no room for more decoded frames: {error.strerror or error}"
                break
        self._complete = True
        self._shows.set()

    def _append(self, frame: Frame, time_s: float) -> None:
        number, place = len(self._times_s), self._ends[-1]
        message = pack_frame(frame, number=number, time_s=time_s)
        os.pwrite(self._file.fileno(), message, place)
        self._ends.append(place + len(message))
        self._times_s.append(time_s)  # last: readers take the number of times for that of the frames
        if not number:
            self._shows.set()

    def status(self) -> Report:
        """How far the recording is decoded, and its statistics."""
        count = len(self._times_s)
        return {
            "kind": "status",
            "state": "recording" if self._complete else "decoding",
            "reason": self._problem,
            "frames": count,
            "seconds": self._times_s[count - 1] if count else 0.0,
            "statistics": statistics(self.skin),
        }

    async def frame(self, order: FrameOrder) -> bytes:
        """The frame of a time or number; the first or the last one where there is none so early or so late.

        Raises:
            InputError: the order is for a live skin, or the recording has no frames.

        """
        if isinstance(order, NextFrame):
            raise InputError("a recording has no newest frame; expected a time or a number")
        if not self._times_s:
            await asyncio.to_thread(self._shows.wait, math.inf)
        count = len(self._times_s)
        if not count:
            raise InputError(f"{self.skin.port_name}: no frames")
        if isinstance(order, ShowTime):
            number = int(np.searchsorted(self._times_s[:count], order.time_s + SAME_TIME_S, side="right")) - 1
        else:
            number = order.number
        number = min(max(number, 0), count - 1)
        start, end = self._ends[number], self._ends[number + 1]
        return os.pread(self._file.fileno(), end - start, start)

    async def trace(self, order: TraceCells) -> Report:
        """Pressure of some cells, or the total force, over all that is decoded; null where a cell was not valid."""
        rows, columns = self.skin.shape
        for row, column in order.cells:
            if row >= rows or column >= columns:
                raise InputError(f"cell ({row}, {column}); this skin has {rows} x {columns} cells")
        traces = [await asyncio.to_thread(self._trace, r, c, order.points) for r, c in order.cells]
        if order.total:
            traces.append(await asyncio.to_thread(self._trace_of_force, order.points))
        return {"kind": "trace", "traces": traces}

    def _trace_of_force(self, points: int) -> Report:
        count = len(self._times_s)
        times, starts = np.array(self._times_s[:count]), np.array(self._ends[:count], dtype=np.int64)
        force = self._bytes(starts + TOTAL_FORCE_AT, 8).copy().view("<f8")[:, 0]
        kept = extremes(force, points)
        return {"cell": None, "time_s": times[kept].tolist(), "force_n": force[kept].tolist()}

    def _trace(self, row: int, column: int, points: int) -> Report:
        rows, columns = self.skin.shape
        cells, cell = rows * columns, row * columns + column
        shown = 0 if self.skin.knows_circuit else 3
        count = len(self._times_s)
        times, ends = np.array(self._times_s[:count]), np.array(self._ends[: count + 1], dtype=np.int64)
        pressure = self._numbers(ends[:-1] + HEADER.size + 4 * (shown * cells + cell))
        std = self._numbers(ends[:-1] + HEADER.size + 4 * (cells + cell))
        reason = self._bytes(ends[:-1] + HEADER.size + 18 * cells + cell, 1)[:, 0]
        pressure[reason != 0] = np.nan
        kept = extremes(pressure, points)
        return {
            "cell": [row, column],
            "time_s": times[kept].tolist(),
            "pressure_kpa": pressure[kept].tolist(),
            "std_kpa": std[kept].tolist(),
        }

    def _numbers(self, places: IntArray) -> FloatArray:
        """float32 numbers at some places of the file, as float64."""
        return self._bytes(places, 4).copy().view("<f4")[:, 0].astype(np.float64)

    def _bytes(self, places: IntArray, width: int) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
        """(places, width) bytes of the file."""
        found = np.empty((len(places), width), dtype=np.uint8)
        if not len(places):
            return found
        with mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
            content = np.frombuffer(mapped, dtype=np.uint8)
            for start in range(0, len(places), FRAMES_AT_ONCE):
                some = slice(start, start + FRAMES_AT_ONCE)
                found[some] = content[places[some, None] + np.arange(width)]
            del content  # a mapping that is looked at cannot be closed
        return found


def extremes(values: FloatArray, points: int) -> IntArray:
    """Indices of about ``points`` values that keep every peak: least, largest and missing one of equal stretches."""
    count = len(values)
    if count <= points:
        return np.arange(count)
    stretches = max(points // 3, 1)
    kept = {0, count - 1}
    for stretch in np.array_split(np.arange(count), stretches):
        some = values[stretch]
        missing = np.isnan(some)
        if missing.any():
            kept.add(int(stretch[missing.argmax()]))
        if not missing.all():
            kept |= {int(stretch[np.nanargmin(some)]), int(stretch[np.nanargmax(some)])}
    return np.array(sorted(kept))
