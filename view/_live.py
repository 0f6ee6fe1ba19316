"""A live skin as a source: a thread takes the frames, and browsers get the newest one when they are ready for it."""

from __future__ import annotations

import asyncio
import contextlib
import math
import threading
import time
from dataclasses import dataclass

from ..common.files import of_board
from ..common.text import printable
from ..driver import Frame, Recorder, Skin
from ..errors import InputError, LinkEnded, LinkError, LinkTimeout, OhmskinError, ProtocolError
from ._frame_message import pack_frame
from ._orders import FrameOrder, NextFrame
from ._source import Source, TimeAxis, Told, statistics

SILENT_S = 1.0
"""a board whose last frame is older is said to be silent"""
TARE_FRAMES = 20


@dataclass(slots=True)
class _Taken:
    """A frame, and its message once a browser has asked for it."""

    number: int
    frame: Frame
    time_s: float
    message: bytes | None = None


class LiveSource(Source):
    """The frames of an open skin. Nothing is queued: a slow browser skips frames and holds nobody up."""

    live = True

    def __init__(self, skin: Skin, *, name: str = "") -> None:
        super().__init__(skin, name=name)
        self._lock = threading.Lock()
        self._newest: _Taken | None = None
        self._waiting: list[asyncio.Future[None]] = []
        self._ended: LinkError | None = None
        """why no frame will come any more"""
        self._problem = ""
        """the last fault of the stream, which went on afterwards"""
        self._tares = 0
        """that can be undone"""
        self._taring = False
        self._recorders: list[Recorder] = []
        """one for each board"""
        self._recorded = ""
        """name of the recording under way, or of the last one"""

    def _take_frames(self) -> None:
        number, axis = -1, TimeAxis()
        with contextlib.suppress(OhmskinError):
            # What came before the page was served; a board that pauses since then would show nothing.
            frame = self.skin.latest(math.inf)
            self._announce(_Taken(0, frame, axis.of(frame)))
            number = 0
        while self._ended is None:
            try:
                for frame in self.skin.frames():
                    number += 1
                    self._announce(_Taken(number, frame, axis.of(frame)))
                self._end(LinkEnded(f"{self.skin.port_name}: the board has come to the end of its frames"))
            except (LinkTimeout, OhmskinError, ProtocolError) as error:
                self._problem = str(error)
            except LinkError as error:
                self._end(error)

    def _announce(self, taken: _Taken) -> None:
        with self._lock:
            self._newest = taken
            waiting, self._waiting = self._waiting, []
        _wake(waiting)

    def _end(self, error: LinkError) -> None:
        with self._lock:
            self._ended = error
            waiting, self._waiting = self._waiting, []
        _wake(waiting)

    def status(self) -> Told:
        """State of the link, statistics, tare."""
        state, reason = self._state()
        tare = self.skin.tared
        return {
            "kind": "status",
            "state": state,
            "reason": reason,
            "statistics": statistics(self.skin),
            "tare": None if tare is None else {"frames": tare.frames, "remarks": list(tare.remarks)},
            "undoable": self._tares > 0,
            "recorded": printable(self._recorded),
            "records": bool(self._recorders),
        }

    def _state(self) -> tuple[str, str]:
        if isinstance(self._ended, LinkEnded):
            return "ended", str(self._ended)
        if self._ended is not None:
            return "lost", str(self._ended)
        if self.skin.away is not None:
            return "away", self.skin.away
        newest = self._newest
        if newest is None or time.monotonic() - newest.frame.monotonic_time > SILENT_S:
            return "silent", self._problem
        return "running", ""

    async def frame(self, order: FrameOrder) -> bytes:
        """The newest frame beyond the one that the browser has."""
        if not isinstance(order, NextFrame):
            raise InputError("a live skin has no frames of the past")
        loop = asyncio.get_running_loop()
        while True:
            with self._lock:
                newest = self._newest
                if newest is not None and newest.number > order.after:
                    break
                if self._ended is not None:
                    raise LinkEnded(str(self._ended))
                woken: asyncio.Future[None] = loop.create_future()
                self._waiting.append(woken)
            await woken
        if newest.message is None:
            frame = newest.frame
            newest.message = pack_frame(frame, number=newest.number, time_s=newest.time_s, age_s=frame.age)
        return newest.message

    async def make_tare(self, *, force: bool) -> Told:
        """Take the skin for unloaded now; InputError where it seems to be loaded, or while another tare is made."""
        if self._taring:
            raise InputError("a tare is being made already")
        self._taring = True
        try:
            tare = await asyncio.to_thread(self.skin.tare, TARE_FRAMES, force=force)
        finally:
            self._taring = False
        self._tares += 1
        text = f"tared over {tare.frames} frames" + ("" if tare.measured.all() else f": {tare.covers}")
        return {"kind": "tared", "text": text, "remarks": list(tare.remarks)}

    async def record(self, *, on: bool) -> None:
        """Begin a recording in the folder in which the page is served, or end it."""
        if on == bool(self._recorders):
            return
        if on:
            name, boards = time.strftime("skin-%Y%m%d-%H%M%S.mcap"), self.skin.boards
            for k, board in enumerate(boards):
                file = name if len(boards) == 1 else of_board(name, k)
                self._recorders.append(await asyncio.to_thread(Recorder, board, file))
            self._recorded = name
        else:
            recorders, self._recorders = self._recorders, []
            for recorder in recorders:
                await asyncio.to_thread(recorder.close)

    def close(self) -> None:
        """End a recording that is under way, and give back the port."""
        for recorder in self._recorders:
            with contextlib.suppress(InputError):  # what was written can be read
                recorder.close()
        super().close()

    async def undo_tare(self) -> Told:
        """Go back to the tare that was in use before the last one made here."""
        if not self._tares:
            raise InputError("no tare was made here that could be undone")
        self._tares -= 1
        tare = await asyncio.to_thread(self.skin.undo_tare)
        untared = "the data sheet's rest resistances" if self.skin.knows_circuit else "the counts as they come"
        before = untared if tare is None else f"the tare over {tare.frames} frames before"
        return {"kind": "tared", "text": f"back to {before}", "remarks": []}


def _wake(waiting: list[asyncio.Future[None]]) -> None:
    for future in waiting:
        # The loop may be over while frames still come.
        with contextlib.suppress(RuntimeError):
            future.get_loop().call_soon_threadsafe(_done, future)


def _done(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)
