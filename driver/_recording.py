"""Recording of a skin to an MCAP file: every byte with its time of arrival, and decoded frames for viewers.

:mod:`._replay` plays the bytes through the same driver. The decoded frames are JSON in schemas that Foxglove shows
without plugins. Chunks are closed every second, so that a recording that is cut short loses at most its last second.
"""

from __future__ import annotations

import base64
import contextlib
import json
import struct
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, BinaryIO

from .. import __version__
from ..common.arrays import FloatArray
from ..common.checks import path_text
from ..common.extras import install_command
from ..common.files import Output, check_writable, claim, forget, is_claimed, one_at_a_time
from ..errors import InputError, MissingExtra
from ._frame import Frame
from ._messages import MESSAGE_SCHEMAS, messages_of
from ._port import Arrival
from ._tuning import CHUNK_BYTES, FLUSH_S, RECENT_FRAMES

if TYPE_CHECKING:
    from mcap.writer import Writer

BYTES_TOPIC, EVENTS_TOPIC = "/ohmskin/bytes", "/ohmskin/events"
METADATA = "ohmskin"
FORMAT = "1"
STAMP = struct.Struct("<dd")
"""before the bytes of each arrival: monotonic time and time since the epoch in s, bit for bit as the driver had them"""


class Recording:
    """Writes one recording, for ``Skin.open(port, record=...)`` or for a :class:`Recorder`.

    The recording begins in a partial file, which :meth:`keep` moves to its place once there is something to record: a
    board that cannot be opened must leave no file, and replace none.

    If the file cannot be written any more (a full disk), the recording ends, but not the skin: see :attr:`error`.
    """

    def __init__(self, path: str | Path, settings: Mapping[str, str], *, overwrite: bool = False) -> None:
        """Begin a recording.

        Args:
            path: of the file.
            settings: settings that a replay needs, see :class:`._replay.RecordedSettings`.
            overwrite: replace an existing file that is not empty.

        Raises:
            InputError: the file cannot be written, or exists already.
            MissingExtra: mcap is not installed.

        """
        writer = _mcap_writer()
        self.path = Path(path_text("name of the recording", path))
        _refuse_present(self.path, overwrite)
        self.error: InputError | None = None
        """why the recording ended before it was closed"""
        self.frames = 0
        """decoded frames written"""
        self._earlier_frames = 0
        self.leave: Callable[[], None] | None = None
        """ends the bytes and frames that come from a skin; None: none come"""
        self._output = Output(self.path)
        with self._output.errors():
            self._output.open()
        self._file: BinaryIO = self._output.file
        claim(self._file)
        self._overwrite = overwrite
        self._lock = threading.Lock()
        self._writer: Writer | None = writer(self._file, chunk_size=CHUNK_BYTES)
        self._channels: dict[str, int] = {}
        self._guarded(lambda: self._begin(settings))
        self._guarded(self._writer.flush)
        self._flush_at = time.monotonic() + FLUSH_S
        self._waiting: SimpleQueue[Frame | None] = SimpleQueue()
        """frames to write; None: the end. A signal cannot interrupt such a queue halfway"""
        self._thread = threading.Thread(target=self._write_frames, name=f"ohmskin recorder {path}", daemon=True)
        self._thread.start()

    def _begin(self, settings: Mapping[str, str]) -> None:
        """Write the head of the file. OSError if that fails."""
        writer = self._writer
        assert writer is not None
        writer.start(profile="", library=f"ohmskin {__version__}")
        writer.add_metadata(METADATA, {"format": FORMAT, **settings})
        self._channels |= {
            BYTES_TOPIC: writer.register_channel(BYTES_TOPIC, "application/octet-stream", 0),
            EVENTS_TOPIC: writer.register_channel(EVENTS_TOPIC, "json", 0),
        }
        for topic, schema in MESSAGE_SCHEMAS.items():
            self._channels[topic] = writer.register_channel(topic, "json", self._schema(schema))

    @classmethod
    def check(cls, path: str | Path, *, overwrite: bool = False) -> None:
        """Check beforehand whether a recording can begin at ``path``; raises the errors of ``__init__``."""
        _mcap_writer()
        file = Path(path_text("name of the recording", path))
        _refuse_present(file, overwrite)
        check_writable(file)

    def keep(self) -> None:
        """Move the file to its place, where it grows from now on.

        Raises:
            InputError: that fails, another recording has come there first, or the disk was full so far: no file
                without a beginning is left.

        """
        if self.error is not None and self._output.is_new:
            raise self.error
        with one_at_a_time(self.path.parent):
            _refuse_present(self.path, self._overwrite)
            self._output.replace()

    def disown(self) -> None:
        """In a forked process: leave the file to the parent process, with what the buffer holds."""
        self._lock, self._writer = threading.Lock(), None
        forget(self._file)

    def discard(self) -> None:
        """End a recording that was not kept, without a file."""
        with contextlib.suppress(InputError):
            self.close()
        self._output.discard()

    def begin_after(self, frames: int, rest: FloatArray | None) -> None:
        """Begin in the middle of a stream: after so many frames, with these rest resistances (rows, columns)."""
        self._earlier_frames = frames
        if rest is not None:
            self.rest_changed(rest, frames)

    def arrived(self, arrival: Arrival) -> None:
        """Write bytes of the board."""
        stamp = STAMP.pack(arrival.received_at, arrival.wall_time)
        self._write(BYTES_TOPIC, arrival.wall_time, stamp + arrival.data)

    def port_gone(self) -> None:
        """Write that the port was lost: the bytes after this came over another connection."""
        self._event({"event": "port gone"})

    def rest_changed(self, rest: FloatArray | None, after_frame: int) -> None:
        """Note new rest resistances (rows, columns), for the frames after the one with this number."""
        values = None if rest is None else base64.b64encode(rest.astype("<f8").tobytes()).decode()
        self._event({"event": "rest", "rest_ohm": values, "after_frame": max(after_frame - self._earlier_frames, 0)})

    def frame(self, frame: Frame) -> None:
        """Queue a decoded frame for writing, for viewers. Does not wait: dropped if the disk is far behind."""
        if self._waiting.qsize() < RECENT_FRAMES:
            self._waiting.put(frame)

    def _write_frames(self) -> None:
        while (frame := self._waiting.get()) is not None:
            self._write_frame(frame)

    def _write_frame(self, frame: Frame) -> None:
        for topic, message in messages_of(frame).items():
            self._write(topic, frame.host_time, json.dumps(message).encode())
        self.frames += 1

    def close(self) -> None:
        """End the recording; the skin stays open if somebody holds it. A second call does nothing.

        Raises:
            InputError: the file could not be written to the end. The part written before can be read.

        """
        leave, self.leave = self.leave, None
        if leave is not None:
            leave()
        if self._thread.is_alive():
            self._waiting.put(None)
            self._thread.join()
        with self._lock:
            writer, self._writer = self._writer, None
            if writer is not None:
                self._guarded(writer.finish)
                self._guarded(self._file.close)
        if self.error is not None:
            raise self.error

    def _event(self, event: dict[str, Any]) -> None:
        self._write(EVENTS_TOPIC, time.time(), json.dumps(event).encode())

    def _write(self, topic: str, wall_time: float, data: bytes) -> None:
        with self._lock:
            writer = self._writer
            if writer is None or self.error is not None:
                return
            moment = max(round(wall_time * 1e9), 0)
            self._guarded(lambda: writer.add_message(self._channels[topic], moment, data, moment))
            if time.monotonic() >= self._flush_at:
                self._guarded(writer.flush)
                self._flush_at = time.monotonic() + FLUSH_S

    def _guarded(self, write: Any) -> None:
        try:
            write()
        except OSError as error:
            self.error = self.error or _not_written(self.path, error)

    def _schema(self, schema: Mapping[str, Any]) -> int:
        assert self._writer is not None
        return int(self._writer.register_schema(schema["title"], "jsonschema", json.dumps(schema).encode()))


def _mcap_writer() -> type[Writer]:
    """The class that writes MCAP files; MissingExtra if it is not installed."""
    try:
        from mcap.writer import Writer
    except ImportError as error:
        raise MissingExtra(f"recordings need mcap: {install_command('record')}") from error
    return Writer


def _refuse_present(path: Path, overwrite: bool) -> None:
    """Raise InputError if there is a file with content that must not be replaced, or one that is being recorded."""
    if is_claimed(path):
        raise InputError(f"{path}: is being recorded at present; choose another name")
    if not overwrite and path.is_file() and path.stat().st_size:
        raise InputError(f"{path}: is there already; choose another name, or replace it (overwrite=True, --overwrite)")


def _not_written(path: Path, error: OSError) -> InputError:
    return InputError(f"{path}: cannot be written: {error.strerror or error}")
