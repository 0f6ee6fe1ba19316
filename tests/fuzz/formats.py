"""The input formats: a valid input of each, and a judge that shares no code with the reader it judges.

A judge returns "accepted" or "refused", and raises AssertionError where the reader breaks its promise: whatever comes,
it is either read as an independent reader reads it, or refused in one :class:`InputError` that names the file.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import io
import json
import math
import os
import random
import re
import shutil
import struct
import tempfile
import tomllib
import warnings
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
from pydantic import BaseModel

from ohmskin.bench._reference import Indeterminate, reference_volts
from ohmskin.calibration import Plan, Progress, calibrate_cells
from ohmskin.cell import Cell
from ohmskin.circuits import Design, scan
from ohmskin.cli import run
from ohmskin.common.config import parse
from ohmskin.common.tables import read_cells, read_columns
from ohmskin.common.text import one_line
from ohmskin.driver import Calibration, ReplayPort, Skin
from ohmskin.emulator import Scene
from ohmskin.errors import InputError, LinkEnded, LinkError, OhmskinError, SolverError
from ohmskin.verification._record import compare, load_record
from ohmskin.wire import BOARDS, BoardFile, FramePacket, Order, board_protocol, host_protocol

from .described import board_text, judged_stream, round_trip
from .described import stream as described_stream
from .mutations import mutated

ACCEPTED, REFUSED = "accepted", "refused"
SHAPE = (3, 4)
COLUMNS = ("time_s", "resistance_ohm")
LONGEST_MESSAGE = 10_000
"""characters; a path may have 4096 of them"""
ROUNDING = 2.0**-53
"""of the exact reference to a float"""
ROOT = Path(__file__).parent.parent.parent

Judge = Callable[[bytes, random.Random, Path], str]


@dataclass(frozen=True)
class Format:
    """One kind of input."""

    name: str
    valid: Callable[[random.Random], bytes]
    judge: Judge
    text: bool = True

    def case(self, rng: random.Random) -> bytes:
        """A mutated input; now and then a valid one."""
        data = self.valid(rng)
        return data if rng.random() < 0.05 else mutated(rng, data, text=self.text)


def _read(path: Path, read: Callable[[Path], Any]) -> Any:
    """What the reader makes of the file, or None where it refuses it as it should."""
    try:
        return read(path)
    except InputError as error:
        message = str(error)
        assert str(path) in message, f"the message does not name the file: {message!r}"
        assert len(one_line(message)) <= LONGEST_MESSAGE, f"the message has {len(message)} characters"
        assert one_line(message).isprintable()
        return None


# --- TOML -------------------------------------------------------------------------------------------------------------


def _design_text(rng: random.Random) -> bytes:
    circuit = rng.choice(("inverting-amplifier", "voltage-divider", "voltage-feedback", "row-amplifier"))
    idle = "float" if circuit == "voltage-divider" and rng.random() < 0.5 else "ground"
    lines = [
        f"[array]\nrows = {SHAPE[0]}\ncolumns = {SHAPE[1]}\nrow_segment = 2.0\ncolumn_segment = 1.5",
        f"row_lead = {rng.choice(('25.0', '[1.0, 2.0, 3.0]'))}\ncolumn_lead = 30.0\n",
        f'[drive]\nvoltage = {rng.uniform(-2, -0.5):.3f}\nidle_rows = "{idle}"\n',
        f'[readout]\ncircuit = "{circuit}"\nreference_resistance = {rng.choice(("1e3", "2.2e4"))}',
        f"open_loop_gain = {rng.choice(('inf', '1e5'))}\noffset_voltage = 1e-4\nbias_current = 0.0",
        f"supply = {rng.choice(('[-inf, inf]', '[-5.0, 5.0]'))}\n",
        "[adc]\nbits = 12\nrange = [0.0, 3.3]",
    ]
    if rng.random() < 0.5:
        lines.append('\n[[fault]]\nkind = "open-cell"\nplace = [1, 2]\n')
    return "\n".join(lines).encode()


def _judge_design(data: bytes, rng: random.Random, folder: Path) -> str:
    path = folder / "design.toml"
    path.write_bytes(data)
    design = _read(path, Design.load)
    if design is None:
        return REFUSED
    _agrees(_tables(data), design)
    if max(design.array.shape) <= 6 and design.array.sheet == "sliced":
        _agrees_with_reference(design, rng)
    return ACCEPTED


def _agrees_with_reference(design: Design, rng: random.Random) -> None:
    """Volts as modified nodal analysis finds them (bench/_reference.py, exact), within the certified bound."""
    cells = np.array([rng.choice((1e3, 1e4, 1e5, 3.3e4)) for _ in range(math.prod(design.array.shape))])
    frame = cells.reshape(design.array.shape)
    try:
        result = scan(design, frame)
    except SolverError:
        return
    try:
        expected = reference_volts(design, frame)
    except Indeterminate:
        return  # an ideal circuit on the edge, which the solver may have taken either way
    assert np.isfinite(result.volts).all(), "volts are not finite"
    error = np.abs(result.volts - expected).max()
    largest = np.abs(expected).max()
    allowed = (result.error_bound + ROUNDING) * largest if largest else 0.0
    assert error <= allowed, f"volts are off by {error:g} V; the bound is {allowed:g} V"


def _cell_text(rng: random.Random) -> bytes:
    return (ROOT / "cell" / "example.toml").read_bytes()


def _judge_cell(data: bytes, rng: random.Random, folder: Path) -> str:
    path = folder / "cell.toml"
    path.write_bytes(data)
    cell = _read(path, Cell.load)
    if cell is None:
        return REFUSED
    _agrees(_tables(data), cell)
    copy = folder / "copy.toml"
    cell.save(copy, comment=data.decode("utf-8-sig")[:50])
    assert Cell.load(copy) == cell, "a saved cell reads back differently"
    return ACCEPTED


def _scene_text(rng: random.Random) -> bytes:
    text = (ROOT / "examples" / "fingers.toml").read_text()
    return text.replace("prototype.toml", str(ROOT / "examples" / "prototype.toml")).encode()


def _judge_scene(data: bytes, rng: random.Random, folder: Path) -> str:
    path = folder / "scene.toml"
    path.write_bytes(data)
    scene = _read(path, Scene.load)
    if scene is None:
        return REFUSED
    for time_s in (0.0, 1.02, 5.0, 1e6):
        pressure = scene.pressure_kpa(time_s)
        most = sum(max(kpa for _, kpa in contact.load_kpa) for contact in scene.contact)
        assert np.isfinite(pressure).all(), "pressure is not finite"
        assert (pressure >= 0).all(), "pressure is negative"
        assert pressure.max() <= most * (1 + 1e-9), "a cell bears more than all contacts together"
    return ACCEPTED


def _calibration_text(rng: random.Random) -> bytes:
    where = Path(tempfile.mkdtemp()) / "calibration.toml"
    grid = np.reshape([rng.uniform(0.5, 2.0) for _ in range(math.prod(SHAPE))], SHAPE)
    Calibration(
        rest_ohm=1e4 * grid,
        gain=grid,
        gain_std=0.01 * grid,
        rest_std_kpa=0.01 * grid,
        residual_kpa=0.0 * grid,
        calibrated=grid > 0.6,
        loads_kpa=(5.0, 12.0),
        presses=24,
        serial_number="A1",
        design_hash="d",
        cell_hash="c",
        date="2026-01-02T03:04:05+00:00",
        remarks=("one",),
    ).save(where)
    content = where.read_bytes()
    shutil.rmtree(where.parent)
    return content


def _judge_calibration(data: bytes, rng: random.Random, folder: Path) -> str:
    """What is accepted has the hash that it states, as the standard library works it out."""
    path = folder / "calibration.toml"
    if rng.random() < 0.7:
        with contextlib.suppress(Exception):  # whatever the mutation has left of the tables
            data = data.replace(_tables(data)["hash"].encode(), _calibration_hash(data).encode())
    path.write_bytes(data)
    found = _read(path, Calibration.load)
    if found is None:
        return REFUSED
    tables = _tables(data)
    assert _calibration_hash(data) == tables["hash"] == found.hash
    assert found.gain.tolist() == tables["cells"]["gain"]
    return ACCEPTED


def _calibration_hash(data: bytes) -> str:
    tables = _tables(data)
    del tables["format"], tables["hash"]
    for name in ("rest_ohm", "gain", "gain_std", "rest_std_kpa", "residual_kpa"):
        tables["cells"][name] = [[float(value) for value in line] for line in tables["cells"][name]]
    tables["loads_kpa"] = [float(load) for load in tables["loads_kpa"]]
    return hashlib.sha256(json.dumps(tables, sort_keys=True).encode()).hexdigest()


PROGRESS_PLAN = Plan.make(SHAPE, "each", [5.0, 12.0])


def _progress_text(rng: random.Random) -> bytes:
    grid = np.full(SHAPE, 1e4)
    rest = {"time_s": 1.0, "resistance_ohm": grid.ravel().tolist(), "std_ohm": [1.0] * 12, "change": [0.0] * 12}
    presses = [
        {
            "cells": [number],
            "time_s": [10.0 * number + at for at in (5.0, 5.2, 9.0, 9.2)],
            "load_kpa": [0.0, 5.0, 5.0, 0.0],
            "window_s": [10.0 * number + at for at in (4.0, 8.0)],
            "resistance_ohm": [[1e4], [rng.choice((None, 1.3e4))]],
            "std_ohm": [1.0],
            "frames": 10,
            "step": number % 2,
            "felt_kpa": 5.0,
            "fault": "",
        }
        for number in range(rng.randrange(1, 4))
    ]
    content = {"format": 1, "setup": {}, "rest": rest | {"frames": 9}, "presses": presses, "trace": [[1.0, 2.0]]}
    return json.dumps(content).encode()


def _judge_progress(data: bytes, rng: random.Random, folder: Path) -> str:
    """What is accepted can be gone on with."""
    path = folder / "skin.toml.progress"
    path.write_bytes(data)
    found = _read(path, lambda path: Progress.load(path, {}, PROGRESS_PLAN))
    if found is None:
        return REFUSED
    found.save(folder / "copy")
    again = Progress.load(folder / "copy", {}, PROGRESS_PLAN)
    assert [press.time_s.tolist() for press in again.presses] == [press.time_s.tolist() for press in found.presses]
    with np.errstate(all="ignore"):
        calibrate_cells(Cell.example(), found.rest, found.presses)
    return ACCEPTED


def _tables(data: bytes) -> dict[str, Any]:
    """The standard library's reading."""
    return tomllib.loads(data.decode("utf-8-sig"))


def _agrees(tables: Mapping[str, Any], model: BaseModel) -> None:
    """Every value of the file is the value of the model; none is converted, none is dropped."""
    for key, value in tables.items():
        found = getattr(model, key)
        if isinstance(value, Mapping) and "nominal" in value:
            assert _plain(found) == _plain(value["nominal"]), f"{key} is read as {found!r}"
        elif isinstance(value, Mapping) and isinstance(found, BaseModel):
            _agrees(value, found)
        else:
            assert _plain(found) == _plain(value), f"{key} is read as {found!r}"


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        value = value.model_dump(exclude_unset=True)
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, int) and not isinstance(value, bool):
        return float(value)  # a whole number may be written for any number
    assert not isinstance(value, float) or not math.isnan(value), "NaN was accepted"
    return value


# --- CSV --------------------------------------------------------------------------------------------------------------


def _cells_text(rng: random.Random) -> bytes:
    rows = ((f"{10 ** rng.uniform(2, 6):.6g}" for _ in range(SHAPE[1])) for _ in range(SHAPE[0]))
    return "".join(",".join(row) + "\n" for row in rows).encode()


def _judge_cells(data: bytes, rng: random.Random, folder: Path) -> str:
    path = folder / "cells.csv"
    path.write_bytes(data)
    found = _read(path, lambda path: read_cells(path, SHAPE))
    if _unusual(data) or re.search(rb"[kKMG]|ol", data, re.IGNORECASE):
        return REFUSED if found is None else ACCEPTED
    expected = _simple_cells(data.decode("utf-8-sig"))
    assert (found is None) == (expected is None), f"read as {found}, expected {expected}"
    if found is None:
        return REFUSED
    assert found.tolist() == expected
    return ACCEPTED


def _simple_cells(text: str) -> list[list[float]] | None:
    lines = [line.split(",") for line in _lines(text)]
    if lines and not any(_is_number(field) or field.lstrip()[:1].isdigit() for field in lines[0]):
        width = len(lines.pop(0))  # a header
        if any(len(line) != width for line in lines):
            return None
    rows = [[_float(field) for field in line] for line in lines]
    if len(rows) != SHAPE[0] or any(len(row) != SHAPE[1] for row in rows):
        return None
    return rows if all(value >= 0 for row in rows for value in row) else None  # NaN fails here, too


def _recording_text(rng: random.Random) -> bytes:
    rows = (f"{0.1 * k:.1f},{rng.uniform(0, 9):.3f},{rng.uniform(1e4, 2e4):.1f}\n" for k in range(8))
    return ("time_s,pressure_kpa,resistance_ohm\n" + "".join(rows)).encode()


def _judge_recording(data: bytes, rng: random.Random, folder: Path) -> str:
    path = folder / "recording.csv"
    path.write_bytes(data)
    found = _read(path, lambda path: read_columns(path, COLUMNS))
    if _unusual(data):
        return REFUSED if found is None else ACCEPTED
    expected = _simple_columns(data.decode("utf-8-sig"))
    assert (found is None) == (expected is None), f"read as {found}, expected {expected}"
    if found is None:
        return REFUSED
    for name, values in expected.items():
        assert np.array_equal(found[name], values, equal_nan=True)
    return ACCEPTED


def _simple_columns(text: str) -> dict[str, list[float]] | None:
    lines = [line.split(",") for line in _lines(text)]
    if lines and not text.endswith(("\n", "\r")) and len(lines[-1]) < len(lines[0]):
        lines.pop()  # cut off
    if len(lines) < 2 or any(len(line) != len(lines[0]) for line in lines):
        return None
    header = [name.strip() for name in lines[0]]
    if not set(COLUMNS) <= set(header):
        return None
    places = {name: header.index(name) for name in COLUMNS}
    columns = {name: [line[k] for line in lines[1:]] for name, k in places.items()}
    if any(field.strip() and not _is_number(field) for column in columns.values() for field in column):
        return None
    return {name: [_float(field) for field in column] for name, column in columns.items()}


def _lines(text: str) -> list[str]:
    return [line for line in re.split(r"\r\n|\n|\r", text) if any(field.strip() for field in line.split(","))]


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _float(field: str) -> float:
    return float(field) if _is_number(field) else math.nan


def _unusual(data: bytes) -> bool:
    """Quotes, lone carriage returns, broken UTF-8, and the forms of spreadsheets: not for the simple reader."""
    try:
        data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return True
    return bool(re.search(rb'[";\t#:]|sep=', data, re.IGNORECASE)) or b"\r" in data.replace(b"\r\n", b"")


# --- the protocol of the board ----------------------------------------------------------------------------------------


_SHAPES = ((1, 1), (2, 3), (4, 4), (16, 16))


def _stream(rng: random.Random, shapes: Sequence[tuple[int, int]] = _SHAPES) -> bytes:
    """Frames of one board, as docs/wire.md has them, stuffed by this module's own encoder."""
    boot = rng.randrange(2**32)
    packets = []
    for number in range(rng.randrange(1, 8)):
        rows, columns = rng.choice(shapes)
        counts = rng.randbytes(2 * rows * columns) if rng.random() < 0.7 else bytes(2 * rows * columns)
        head = struct.pack("<BBIIQ", 1, 2, boot, number, 20_000 * number)
        body = head + struct.pack("<HHH", rows, columns, 0) + counts
        packets.append(_stuffed(body + struct.pack("<I", zlib.crc32(body))) + b"\0")
    return b"".join(packets)


def _judge_stream(data: bytes, rng: random.Random, folder: Path) -> str:
    host, events, place = host_protocol("ohmskin"), [], 0
    while place < len(data):
        end = place + rng.choice((1, 3, 64, 4096))
        events += host.feed(data[place:end], 0.0)
        place = end
    found = [
        (event.boot_id, event.sequence, event.time_us, event.rows, event.columns, event.payload)
        for event in events
        if isinstance(event, FramePacket)
    ]
    expected = _simple_frames(data)
    assert found == expected, f"{len(found)} frames found, expected {len(expected)}"
    return ACCEPTED if found else REFUSED


def _simple_frames(data: bytes) -> list[tuple[Any, ...]]:
    """The intact frames of a stream, as docs/wire.md says."""
    frames = []
    for stretch in data.split(b"\0")[:-1]:
        body = _unstuffed(stretch)
        if body is None or len(body) < 28 or zlib.crc32(body[:-4]) != struct.unpack("<I", body[-4:])[0]:
            continue
        kind, version, boot, sequence, time_us, rows, columns, _ = struct.unpack("<BBIIQHHH", body[:24])
        counts = body[24:-4]
        if (kind, version) == (1, 2) and len(counts) == 2 * rows * columns > 0:
            frames.append((boot, sequence, time_us, rows, columns, counts))
    return frames


def _stuffed(data: bytes) -> bytes:
    """COBS by its definition."""
    out = bytearray()
    for part in data.split(b"\0"):
        rest = part
        while len(rest) >= 254:
            out += b"\xff" + rest[:254]
            rest = rest[254:]
        out += bytes([len(rest) + 1]) + rest
    return bytes(out)


def _unstuffed(data: bytes) -> bytes | None:
    out, place = bytearray(), 0
    while place < len(data):
        code = data[place]
        block = data[place + 1 : place + code]
        if len(block) != code - 1:
            return None
        out += block
        place += code
        if code < 255 and place < len(data):
            out.append(0)
    return bytes(out)


def _family_stream(rng: random.Random) -> bytes:
    """A few frames of any family of boards, after the number of the family."""
    number = rng.randrange(len(BOARDS))
    family = list(BOARDS.values())[number]
    board, layout = board_protocol(family.name), family.layout
    stream = bytes([number])
    for sequence in range(3):
        most = 2**layout.adc_bits
        counts = [[rng.randrange(most) for _ in range(layout.columns)] for _ in range(layout.rows)]
        stream += board.frame(FramePacket.of(np.array(counts), sequence=sequence, time_us=20_000 * sequence))
    return stream


def _judge_families(data: bytes, rng: random.Random, folder: Path) -> str:
    """Nothing is raised, and no more frames come than bytes can hold, however the stream is cut."""
    family = list(BOARDS.values())[(data[0] if data else 0) % len(BOARDS)]
    host, frames, place = host_protocol(family.name), 0, 0
    while place < len(data):
        end = place + rng.choice((1, 64, 4096))
        for event in host.feed(data[place:end], 0.0):
            if isinstance(event, FramePacket):
                frames += 1
                assert event.counts.max() < 2**16
        place = end
    assert frames <= len(data)
    return ACCEPTED if frames else REFUSED


def _judge_board(data: bytes, rng: random.Random, folder: Path) -> str:
    """What is accepted has the values of the file, and both ends that it describes understand each other."""
    path = folder / "board.toml"
    path.write_bytes(data)
    file = _read(path, BoardFile.load)
    if file is None:
        return REFUSED
    _agrees(_tables(data), file)
    round_trip(path, rng)
    return ACCEPTED


def _judge_described(data: bytes, rng: random.Random, folder: Path) -> str:
    return ACCEPTED if judged_stream(data, rng) else REFUSED


def _commands(rng: random.Random) -> bytes:
    host = host_protocol("ohmskin")
    return b"".join(host.request(rng.choice(list(Order)), period_us=rng.randrange(2**32)) for _ in range(5))


def _judge_commands(data: bytes, rng: random.Random, folder: Path) -> str:
    """The board takes each command once, whatever the line adds."""
    whole = board_protocol("ohmskin").feed(data)
    board, single = board_protocol("ohmskin"), []
    for place in range(len(data)):
        single += board.feed(data[place : place + 1])
    assert single == whole, "commands depend on how the bytes are cut"
    return ACCEPTED if whole else REFUSED


# --- recordings -------------------------------------------------------------------------------------------------------

MAGIC = b"\x89MCAP0\r\n"
TOPICS = ("/ohmskin/bytes", "/ohmskin/events")


def _mcap(metadata: Mapping[str, str], messages: Sequence[tuple[int, bytes]]) -> bytes:
    """An MCAP file without chunks, by its specification; ``messages`` are numbers of topics, and data."""
    records = [(1, _text("") + _text(""))]
    for number, topic in enumerate(TOPICS, 1):
        records.append((4, struct.pack("<HH", number, 0) + _text(topic) + _text("json") + struct.pack("<I", 0)))
    pairs = b"".join(_text(key) + _text(value) for key, value in metadata.items())
    records.append((12, _text("ohmskin") + struct.pack("<I", len(pairs)) + pairs))
    records += [(5, struct.pack("<HIQQ", number, 0, 0, 0) + data) for number, data in messages]
    records += [(15, bytes(4)), (2, bytes(20))]
    return MAGIC + b"".join(struct.pack("<BQ", code, len(body)) + body for code, body in records) + MAGIC


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()


def _simple_arrivals(data: bytes) -> list[bytes]:
    """The bytes of the board in an MCAP file without chunks, up to where it is cut off."""
    topics: dict[int, bytes] = {}
    found, place = [], len(MAGIC)
    while place + 9 <= len(data):
        code, size = struct.unpack_from("<BQ", data, place)
        body, place = data[place + 9 : place + 9 + size], place + 9 + size
        if len(body) < size:
            break
        if code == 4 and len(body) >= 8:
            number, _, length = struct.unpack_from("<HHI", body)
            topics[number] = body[8 : 8 + length]
        if code == 5 and len(body) >= 38 and topics.get(struct.unpack_from("<H", body)[0]) == TOPICS[0].encode():
            found.append(body[38:])
    return found


def _cell(rng: random.Random) -> dict[str, Any]:
    return tomllib.loads(_cell_text(rng).decode())


def _arrivals(rng: random.Random) -> list[bytes]:
    return [struct.pack("<dd", 5.0 + 0.01 * k, 1e9 + 0.01 * k) + _stream(rng, [(2, 3)]) for k in range(3)]


def _recorded(rng: random.Random) -> bytes:
    given = {"design": _DESIGN, "cell": _cell(rng)}
    metadata = {"format": "1", "board": "ohmskin", "given": json.dumps(given), "pitch": (0.004).hex()}
    gone = (2, b'{"event": "port gone"}')
    return _mcap(metadata, [(1, data) for data in _arrivals(rng)] + [gone])


def _judge_recorded(data: bytes, rng: random.Random, folder: Path) -> str:
    """What the port plays is what the file has, up to where either finds it cut off; then the driver takes it."""
    path = folder / "press.mcap"
    path.write_bytes(data)
    port = _read(path, ReplayPort)
    if port is None:
        return REFUSED
    expected, played = _simple_arrivals(data), []
    with contextlib.suppress(LinkEnded):
        while True:
            try:
                played.append(port.read().data)
            except InputError:
                break
            except LinkEnded:
                raise
            except LinkError:
                continue
    assert played == expected[: len(played)], "other bytes are played than the file has"
    return _drive(path)


def _drive(path: Path) -> str:
    """Frames or an error of ours, in bounded time; never anything else."""
    try:
        quiet = warnings.catch_warnings(action="ignore", category=RuntimeWarning)
        with quiet, Skin.open(str(path), timeout=20) as skin:
            for frame in islice(skin, 100):
                assert frame.pressure.shape == skin.design.array.shape
    except OhmskinError as error:
        message = one_line(str(error))
    else:
        return ACCEPTED
    assert message.isprintable()
    assert "set up within" not in message, "opening takes for ever"
    return REFUSED


def _told(rng: random.Random) -> bytes:
    """Metadata and events of a recording, a JSON text on each line."""
    shape = _DESIGN["array"]["rows"], _DESIGN["array"]["columns"]
    rest = base64.b64encode(np.full(shape, 2e4).tobytes()).decode()
    block = {"shape": list(shape), "data": rest}
    clock = {"steps": 0, "origin": [1.0, 5.0], "buckets": [[0.0, 0.0]], "bucket_ends": 0.5, "least": [0.0, 0.0]}
    stream = {"begun": True, "expected": 0, "boot_id": None, "latest_us": None, "latest_monotonic": 5.0, "time_s": 0.0}
    stream |= {"recent": [[1, 2, 3]], "numbered": True}
    stream |= {"clock": clock | {"drift": 0.0, "anchor": [0.0, 0.0]}}
    measured = {"time_s": None, "rest_ohm": block, "noise_steps": 0.5, "counts": None, "restarted": False}
    cell = _cell(rng)
    memory = parse(cell, Cell, source="cell").estimator(shape, "static").state()
    kept = {
        name: {"shape": list(array.shape), "data": base64.b64encode(array.tobytes()).decode()}
        for name, array in memory.items()
    }
    past = {"heard": "AAEC", "stream": stream, "measurement": measured | {"estimator": kept}}
    given = json.dumps({"design": _DESIGN, "cell": cell})
    lines = [
        {"format": "1", "board": "ohmskin", "given": given, "pitch": (0.004).hex(), "estimator": "static"},
        {"event": "joined", "past": past},
        {"event": "rest", "rest_ohm": rest, "after_s": (5.0).hex()},
        {"event": "rest", "rest_ohm": None, "after_s": None},
        {"event": "port gone"},
    ]
    return "\n".join(map(json.dumps, lines)).encode()


def _judge_told(data: bytes, rng: random.Random, folder: Path) -> str:
    head, *events = data.split(b"\n")
    try:
        metadata = {str(key): str(value) for key, value in json.loads(head).items()}
        _mcap(metadata, [])
    except (ValueError, AttributeError, RecursionError):
        return REFUSED
    path = folder / "told.mcap"
    path.write_bytes(_mcap(metadata, [(2, event) for event in events] + [(1, data) for data in _arrivals(rng)]))
    if _read(path, ReplayPort) is None:
        return REFUSED
    return _drive(path)


_DESIGN: dict[str, Any] = {
    "array": {"rows": 2, "columns": 3, "row_lead": 70.0},
    "drive": {"voltage": -1.0},
    "readout": {"circuit": "inverting-amplifier", "reference_resistance": 20e3, "supply": [0.0, 3.3]},
    "adc": {"bits": 16, "range": [0.0, 3.3]},
}

# --- report.json ------------------------------------------------------------------------------------------------------


def _report(rng: random.Random) -> bytes:
    """A report of one requirement and one claim."""
    outcome = rng.choice(("pass", "fail", "not run"))
    check = {"name": "droop", "outcome": outcome, "measured": 0.5, "limit": 1.0, "relation": "<=", "unit": "%"}
    requirement: dict[str, Any] = dict.fromkeys(
        ("text", "source", "quantity", "title", "method", "unit", "where", "confidence", "reason"), "words"
    )
    requirement |= {"id": "D1", "min": None, "max": 2.5, "outcome": outcome, "margin": 1.5, "seconds": 0.25}
    requirement |= {
        "measured": rng.choice((1.0, None, "inf")),
        "contributions": {"switch": 0.5},
        "samples": [1.0, "nan"],
    }
    claim = {"id": "P1", "title": "crosstalk", "where": "III", "outcome": outcome, "seconds": 1.0}
    claim |= {"checks": [check | {"reason": ""}]}
    report: dict[str, Any] = dict.fromkeys(
        ("title", "finished", "command", "target", "design_sha256", "cell_sha256", "run_sha256", "cell_source"), "words"
    )
    report |= {"schema_version": 1, "outcome": outcome, "exit_code": 0, "seconds": 2.0, "seed": 0, "samples": 1000}
    report |= {"design": _DESIGN, "cell": {}, "environment": {"numpy": "2.0"}, "not_judged": ["noise"], "changes": []}
    report |= {"requirements": [requirement], "claims": [claim]}
    return json.dumps(report, indent=1).encode()


def _judge_report(data: bytes, rng: random.Random, folder: Path) -> str:
    """What is accepted has the shape of docs/report.schema.json, as jsonschema reads it, and keeps its values."""
    path = folder / "report.json"
    path.write_bytes(data)
    record = _read(path, load_record)
    if record is None:
        return REFUSED
    tables = json.loads(data.decode("utf-8-sig"))
    jsonschema.validate(tables, json.loads((ROOT / "docs" / "report.schema.json").read_text()))
    kept = record.model_dump(mode="python", exclude_unset=True)
    assert _same(kept, tables), "a value was converted or dropped"
    compare(record, record)
    return ACCEPTED


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_same(one[key], other[key]) for key in one)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_same, one, other))
    if isinstance(one, float) and isinstance(other, float) and math.isnan(one):
        return math.isnan(other)
    if isinstance(one, float) and type(other) is int:
        return abs(other) > 2**53 or one == other  # a whole number is rounded to a float, or is infinite
    return bool(one == other) and isinstance(one, bool) == isinstance(other, bool)


# --- the command line -------------------------------------------------------------------------------------------------

CALLS = (
    "scan design.toml --cells cells.csv -o out.csv --tolerance 1e-6",
    "scan design.toml --cells cells.csv --method exact --json",
    "scan design.toml --cells cells.csv --readout voltage-divider --effects",
    "netlist design.toml --cells cells.csv --row 1 -o out.cir",
    "estimate recording.csv --cell cell.toml -o out.csv --estimator static",
    "fit --protocol --full-scale 15.5",
)


def _call(rng: random.Random) -> bytes:
    return rng.choice(CALLS).replace(" ", "\n").encode()


def _judge_call(data: bytes, rng: random.Random, folder: Path) -> str:
    """One word on a line. Nothing but 0 and 2 is returned, 2 with one line on standard error."""
    words = [os.fsdecode(word) for word in data.split(b"\n")]
    if any("/" in word or "\0" in word for word in words):
        return REFUSED  # no paths out of the folder; and no system passes NUL
    (folder / "design.toml").write_bytes(_design_text(rng))
    (folder / "cells.csv").write_bytes(_cells_text(rng))
    (folder / "cell.toml").write_bytes(_cell_text(rng))
    (folder / "recording.csv").write_bytes(_recording_text(rng))
    out, said = io.StringIO(), io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(said):
        code = run(words)
    message = said.getvalue()
    assert code in (0, 2), f"exit code {code}: {message}"
    if code == 0:
        return ACCEPTED
    assert message.count("\n") <= 1, f"more than one line: {message}"
    assert message.replace("\n", "").isprintable(), f"control characters: {message!r}"
    assert message or "Usage" in out.getvalue(), "nothing was said"
    return REFUSED


FORMATS = {
    entry.name: entry
    for entry in (
        Format("design", _design_text, _judge_design),
        Format("cell", _cell_text, _judge_cell),
        Format("scene", _scene_text, _judge_scene),
        Format("calibration", _calibration_text, _judge_calibration),
        Format("progress", _progress_text, _judge_progress),
        Format("cells", _cells_text, _judge_cells),
        Format("recording", _recording_text, _judge_recording),
        Format("frames", _stream, _judge_stream, text=False),
        Format("families", _family_stream, _judge_families, text=False),
        Format("board", board_text, _judge_board),
        Format("described", described_stream, _judge_described, text=False),
        Format("commands", _commands, _judge_commands, text=False),
        Format("mcap", _recorded, _judge_recorded, text=False),
        Format("events", _told, _judge_told),
        Format("report", _report, _judge_report),
        Format("call", _call, _judge_call),
    )
}
