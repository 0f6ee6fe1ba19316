"""Replay of a recording: a port that returns the board's bytes at the times at which they came."""

from __future__ import annotations

import base64
import io
import json
import math
import operator
import os
import struct
import threading
import time
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from ..cell import Cell
from ..circuits import Design, Shape
from ..common.checks import number
from ..common.config import LEAST_SI, MOST_SI, parse
from ..common.events import SignalSafeEvent
from ..common.extras import install_command
from ..common.files import size as size_text
from ..common.progress import Progress, silent
from ..common.text import shortened, shown
from ..errors import InputError, LinkEnded, LinkError, MissingExtra, OhmskinError, ProtocolError
from ..wire import BoardFile, Family, known_family, read_description, write_description
from ._calibration import Calibration
from ._port import Arrival
from ._recording import BYTES_TOPIC, EVENTS_TOPIC, FORMAT, METADATA, STAMP
from ._tare import RestChange

if TYPE_CHECKING:
    from mcap.records import Chunk

MOST_S = 1e12
"""30,000 years: no time of arrival is later"""
LARGEST_RECORD = 32 * 2**20
"""bytes of a record, and of the content of a chunk"""
LONGEST_ARRIVAL = 16 * 2**20
"""bytes that come at once, after a host was kept from reading for seconds"""
MOST_RECORDS, BYTES_PER_RECORD = 10_000, 4
"""limit on the number of records: so many, and one for so many bytes of the file. The times of an arrival alone take
more, compressed"""
MOST_CONTENT, MOST_EXPANSION = 2**29, 4000
"""limit on decompressed bytes: so many, and so many for each byte of the file. Without noise, 256 x 256 equal cells
compress to a 2500th; an eighth of this is the limit on what the board sent, the rest is for viewers"""
_HEAD = struct.Struct("<BQ")
"""before each record: its kind, and how many bytes it has"""
MOST_VALUES = 100_000
"""limit on the numbers, texts and lists of an event"""


@dataclass(frozen=True)
class RecordedSettings:
    """Settings with which the skin of a recording was opened."""

    board: str
    """family"""
    design: Design | None
    """None: as the board describes it"""
    cell: Cell | None
    estimator: str | None
    pitch: tuple[float, float] | None
    """None: the pitch of the design"""
    accuracy: float | None = None
    """relative uncertainty up to which cells are valid; None: the default"""
    calibration: Calibration | None = None
    board_file: Mapping[str, Any] | None = None
    """tables of the BOARD.toml; None: the family is known by its name"""
    simulated: bool = False
    """the board's time was a simulation's"""
    introduction: bytes = b""
    """packets in which the board has identified and described itself before the recording began"""
    shape: Shape | None = None
    """None: as the design says"""

    def as_metadata(self) -> dict[str, str]:
        """Texts for the metadata of the file."""
        tables = write_description(
            None if self.design is None else self.design.model_dump(),
            None if self.cell is None else self.cell.model_dump(exclude_none=True),
        ).decode()
        numbers = {"pitch": _distinct(self.pitch), "accuracy": () if self.accuracy is None else (self.accuracy,)}
        known = {
            "estimator": self.estimator,
            "calibration": None if self.calibration is None else self.calibration.as_toml(),
            "board_file": None if self.board_file is None else json.dumps(self.board_file),
            "shape": None if self.shape is None else self.shape.model_dump_json(exclude_none=True),
            "simulated": "yes" if self.simulated else None,
            "introduction": base64.b64encode(self.introduction).decode(),
        }
        known |= {name: " ".join(float(value).hex() for value in values) for name, values in numbers.items()}
        return {"board": self.board, "given": tables} | {key: value for key, value in known.items() if value}

    @classmethod
    def of(cls, metadata: dict[str, str], path: Path) -> RecordedSettings:
        """The settings in a file's metadata; InputError if they are invalid."""
        if metadata.get("format") != FORMAT:
            raise InputError(f"{path}: a recording of format {metadata.get('format')}; expected {FORMAT}")
        for name in ("board", "given"):
            if name not in metadata:
                raise InputError(f"{path}: the metadata '{METADATA}' lacks '{name}'")
        try:
            design, cell = read_description(metadata["given"].encode())
        except ProtocolError as error:
            raise InputError(f"{path}: given: {error}") from error
        calibration, board_file = metadata.get("calibration"), _tables(metadata, "board_file", path)
        if board_file is not None:
            BoardFile.parse(board_file, f"{path}: board_file")
        pitch, shape = _hexadecimals(metadata, "pitch", path, most=2), _tables(metadata, "shape", path)
        accuracy = _hexadecimals(metadata, "accuracy", path)
        return cls(
            board=metadata["board"],
            design=None if design is None else parse(design, Design, source=f"{path}: design"),
            cell=None if cell is None else parse(cell, Cell, source=f"{path}: cell"),
            estimator=metadata.get("estimator"),
            pitch=(pitch[0], pitch[-1]) if pitch else None,
            accuracy=accuracy[0] if accuracy else None,
            calibration=None if calibration is None else Calibration.from_toml(calibration, f"{path}: calibration"),
            board_file=board_file,
            simulated=metadata.get("simulated") == "yes",
            introduction=_introduction(metadata, path),
            shape=None if shape is None else parse(shape, Shape, source=f"{path}: shape"),
        )

    def family(self, path: str) -> Family:
        """The family of the recorded board. InputError if only the user's own program knows it."""
        if self.board_file is not None:
            return BoardFile.parse(self.board_file, f"{path}: board_file").family()
        try:
            return known_family(self.board)
        except InputError as error:
            raise InputError(
                f"{path}: a recording of the board {shown(self.board)}, which is no known family; give it (board=)"
            ) from error


NOTHING_RECORDED = RecordedSettings("", None, None, None, None)
"""for a live board"""


def _tables(metadata: Mapping[str, str], name: str, path: Path) -> Mapping[str, Any] | None:
    """Tables in a file's metadata as JSON; None: the metadata has none. InputError if they are no tables."""
    text = metadata.get(name)
    if text is None:
        return None
    try:
        tables = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: {name}: is no JSON: {shortened(str(error))}") from error
    if not isinstance(tables, dict):
        raise InputError(f"{path}: {name}: expected a JSON object")
    return tables


class ReplayPort:
    """Plays a recording: at ``speed`` times real time, or without ``speed`` as fast as it is read.

    Raises:
        InputError: the file cannot be read, or is no recording of ohmskin.
        MissingExtra: mcap is not installed.

    """

    def __init__(self, path: str | Path, speed: float | None = None, progress: Progress = silent) -> None:
        """Look through the recording, and check it.

        Args:
            path: of the file.
            speed: relative to real time; None: as fast as it is read.
            progress: told how many bytes of the file have been looked through.

        """
        if speed is not None and not 0 < number("speed", speed) < math.inf:
            raise InputError(f"speed {speed}; expected a positive number")
        self.path = Path(path)
        self.name = str(path)
        self.settings, self.rest_changes, self.arrivals, self.seconds = _survey(self.path, progress)
        """settings of the skin; its tares; number of arrivals; duration in s"""
        self.is_simulated = self.settings.simulated
        self._speed = speed
        self._items = _items(self.path)
        self._next: Arrival | LinkError | None = None
        self._latest = 0.0
        self._start: tuple[float, float] | None = None
        self._interrupted = SignalSafeEvent()
        self._lock = threading.Lock()
        """one thread may wait while another reads"""

    def wait(self, timeout_s: float) -> bool:
        """Wait until the next bytes are due."""
        with self._lock:
            due_s = self._remaining_s()
        if due_s > 0 and self._interrupted.wait(max(min(due_s, timeout_s), 0.0)):
            self._interrupted.clear()
            return False
        return due_s <= timeout_s

    def read(self) -> Arrival:
        """The next recorded bytes, if they are due; LinkEnded at the end, LinkError where the port was lost."""
        with self._lock:
            if self._remaining_s() > 0:
                return Arrival(b"", self.now(), time.time())
            item, self._next = self._peek(), None
            if isinstance(item, LinkEnded):
                self._next = item
            if isinstance(item, LinkError):
                raise item
            self._latest = item.received_at
            return item

    def write(self, data: bytes) -> None:
        """Does nothing: a recording takes no orders."""

    def interrupt(self) -> None:
        """End a :meth:`wait` that another thread is in."""
        self._interrupted.set()

    def now(self) -> float:
        """Present time of the recording, on the clock of the recording host."""
        if self._speed is None or self._start is None:
            return self._latest
        real_s, recorded_s = self._start
        return recorded_s + (time.monotonic() - real_s) * self._speed

    def close(self) -> None:
        """Does nothing: the file is closed when the recording has been read to its end."""

    def reopen(self) -> ReplayPort:
        """The port after a recorded loss: this one."""
        return self

    def _peek(self) -> Arrival | LinkError:
        if self._next is None:
            self._next = next(self._items, LinkEnded(f"{self.name}: the recording is over"))
        return self._next

    def _remaining_s(self) -> float:
        """Seconds until the next bytes; 0 or less: now."""
        item = self._peek()
        if self._speed is None or isinstance(item, LinkError):
            return 0.0
        if self._start is None:
            self._start = (time.monotonic(), item.received_at)
        return (item.received_at - self.now()) / self._speed


def _distinct(pitch: tuple[float, float] | None) -> tuple[float, ...]:
    """One number for square cells, two for others."""
    if pitch is None:
        return ()
    return pitch[:1] if pitch[0] == pitch[1] else pitch


def _hexadecimals(metadata: Mapping[str, str], name: str, path: Path, *, most: int = 1) -> list[float]:
    """Positive numbers in C's hexadecimal notation, at most ``most``; empty if the metadata has none."""
    text = metadata.get(name)
    if text is None:
        return []
    try:
        values = [float.fromhex(one) for one in text.split(" ", most - 1)]
    except (ValueError, OverflowError):
        values = []
    if not values or not all(LEAST_SI <= value <= MOST_SI for value in values):
        raise InputError(f"{path}: {name}: expected a positive number in hexadecimal (got {shortened(text)})")
    return values


def _introduction(metadata: Mapping[str, str], path: Path) -> bytes:
    """Packets in which the board has introduced itself; InputError if they are no base64."""
    try:
        return base64.b64decode(metadata.get("introduction", ""), validate=True)
    except ValueError as error:
        raise InputError(f"{path}: introduction: is no base64: {error}") from error


def _survey(path: Path, progress: Progress) -> tuple[RecordedSettings, list[RestChange], int, float]:
    settings: RecordedSettings | None = None
    rest_changes: list[RestChange] = []
    given: dict[str, str] | None = None
    arrivals, first, last = 0, None, 0.0
    for topic, data in _records(path, progress):
        if topic == METADATA:
            if given not in (None, data):
                raise InputError(f"{path}: the metadata '{METADATA}' twice; expected the settings of one skin")
            if given is None:
                given, settings = data, RecordedSettings.of(data, path)
        elif topic == BYTES_TOPIC:
            arrivals += 1
            last = _arrival(data, path).received_at
            first = last if first is None else first
        elif topic == EVENTS_TOPIC:
            event = _event(data, path)
            if event["event"] == "rest":
                rest_changes.append(_rest_change(event, path))
    if settings is None:
        raise InputError(f"{path}: is no recording of ohmskin; expected the metadata '{METADATA}'")
    return settings, rest_changes, arrivals, 0.0 if first is None else last - first


def _items(path: Path) -> Iterator[Arrival | LinkError]:
    for topic, data in _records(path):
        if topic == BYTES_TOPIC:
            yield _arrival(data, path)
        elif topic == EVENTS_TOPIC and _event(data, path)["event"] == "port gone":
            yield LinkError(f"{path}: the board has gone away (as it did then)")


def _arrival(data: bytes, path: Path) -> Arrival:
    """Bytes and times of an arrival; InputError if the message is none."""
    if len(data) < STAMP.size:
        raise InputError(f"{path}: an arrival of {len(data)} bytes; expected at least {STAMP.size}, its times")
    if len(data) > LONGEST_ARRIVAL:
        raise InputError(f"{path}: an arrival of {size_text(len(data))}; no port holds so many bytes")
    received_at, wall_time = STAMP.unpack_from(data)
    if not (abs(received_at) <= MOST_S and abs(wall_time) <= MOST_S):
        raise InputError(f"{path}: an arrival at {received_at:g} s, {wall_time:g} s since the epoch; expected times")
    return Arrival(data[STAMP.size :], received_at, wall_time)


def _event(data: bytes, path: Path) -> dict[str, Any]:
    """A message of the events' topic; InputError if it is invalid."""
    if sum(data.count(mark) for mark in (b",", b"[", b"{")) > MOST_VALUES:
        raise InputError(f"{path}: an event of more than {MOST_VALUES} values; expected numbers of arrays as base64")
    try:
        event = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: an event that is no JSON: {shortened(str(error))}") from error
    if not isinstance(event, dict) or not isinstance(event.get("event"), str):
        raise InputError(f"{path}: an event without the key 'event'; expected a JSON object")
    return event


def _rest_change(event: Mapping[str, Any], path: Path) -> RestChange:
    """Rest resistances, and the frame after which they hold; InputError."""
    try:
        after, values = operator.index(event["after_frame"]), event["rest_ohm"]
        if values is None:
            return RestChange(after, None)
        ohm = np.frombuffer(base64.b64decode(values, validate=True), dtype="<f8").astype(np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: an event 'rest' that cannot be read: {shortened(str(error))}") from error
    if not ((ohm >= LEAST_SI) & (ohm <= MOST_SI) | (ohm == 0)).all():  # counts at rest may be 0
        raise InputError(f"{path}: an event 'rest': expected positive resistances")
    return RestChange(after, ohm)


class _Allowance:
    """What may still come of a file: its size limits the work that reading it takes."""

    def __init__(self, path: Path, size: int) -> None:
        self._path, self._size = path, size
        self._records = MOST_RECORDS + size // BYTES_PER_RECORD
        self._content = MOST_CONTENT + MOST_EXPANSION * size
        self._messages = self._content // 8

    def record(self) -> None:
        """Another record, of whatever kind."""
        self._records -= 1
        if self._records < 0:
            raise self._refusal("more records")

    def content(self, count: int) -> None:
        """Decompressed bytes of a chunk."""
        self._content -= count
        if count > LARGEST_RECORD or self._content < 0:
            raise self._refusal("more bytes, decompressed,")

    def message(self, count: int) -> None:
        """Bytes that the driver has to read."""
        self._messages -= count
        if self._messages < 0:
            raise self._refusal("more bytes of the board")

    def _refusal(self, what: str) -> InputError:
        return InputError(f"{self._path}: {what} than a recording of {size_text(self._size)} has; is it damaged?")


def _records(path: Path, progress: Progress = silent) -> Iterator[tuple[str, Any]]:
    """Topic and data of each message in the order of writing, and the metadata; up to where the file is cut off.

    Raises:
        InputError: the file cannot be read, or holds more than a recording of its size.
        MissingExtra: mcap is not installed.

    """
    try:
        from mcap.records import Channel, Message, Metadata
    except ImportError as error:
        raise MissingExtra(f"recordings need mcap: {install_command('record')}") from error
    topics: dict[int, str] = {}
    found = False
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            allowed = _Allowance(path, size)
            for record in _opened(file, allowed):
                found = True
                match record:
                    case Message():
                        topic = topics[record.channel_id]
                        if topic in (BYTES_TOPIC, EVENTS_TOPIC):
                            allowed.message(len(record.data))
                            yield topic, record.data
                    case Metadata() if record.name == METADATA:
                        yield METADATA, record.metadata
                    case Channel():
                        topics[record.id] = record.topic
                    case None:
                        progress(file.tell(), size, "")
    except OhmskinError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:
        # A killed process or a full disk ends a file anywhere: mcap, its decompressors and struct then raise errors of
        # many kinds. The part written before is whole, as its checksums show.
        if not found:
            raise InputError(f"{path}: is no MCAP file; expected a recording of `ohmskin record`") from error


def _opened(file: BinaryIO, allowed: _Allowance) -> Iterator[Any]:
    """The records of a file, and those within its chunks one at a time; None after each chunk and for other records.

    mcap's own reader makes all records of a chunk at once, decompresses as much as the compressed data say, and reads
    on behind the end of a record where a length within says so.
    """
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Channel, Chunk, Message, Metadata
    from mcap.stream_reader import MAGIC_SIZE, read_magic

    def records(stream: BinaryIO) -> Iterator[Any]:
        """Each made of its own bytes only, whatever lengths stand within."""
        while head := stream.read(_HEAD.size):
            opcode, length = _HEAD.unpack(head)
            allowed.record()
            if length > LARGEST_RECORD or len(body := stream.read(length)) < length:
                raise EOFError("a record that is cut off")
            content = ReadDataStream(io.BytesIO(body))
            match opcode:
                case Opcode.MESSAGE:
                    yield Message.read(content, length)
                case Opcode.CHANNEL:
                    yield Channel.read(content)
                case Opcode.METADATA:
                    yield Metadata.read(content)
                case Opcode.CHUNK:
                    yield Chunk.read(content)
                case Opcode.FOOTER:
                    return
                case _:
                    yield None

    read_magic(ReadDataStream(io.BytesIO(file.read(MAGIC_SIZE))))
    for record in records(file):
        if not isinstance(record, Chunk):
            yield record
            continue
        allowed.content(record.uncompressed_size)
        yield from (one for one in records(io.BytesIO(_decompressed(record))) if isinstance(one, Message | Channel))
        yield None


def _decompressed(chunk: Chunk) -> bytes:
    """The content of a chunk, never longer than the chunk says; ValueError if it is damaged."""
    size, data = chunk.uncompressed_size, chunk.data
    match chunk.compression:
        case "zstd":
            import zstandard

            with zstandard.ZstdDecompressor().stream_reader(data) as reader:
                content = reader.read(size + 1)
        case "lz4":
            from lz4.frame import LZ4FrameDecompressor

            content = LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        case _:
            content = data
    if len(content) != size or chunk.uncompressed_crc not in (0, zlib.crc32(content)):
        raise ValueError("a damaged chunk")
    return content
