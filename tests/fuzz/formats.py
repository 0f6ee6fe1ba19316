"""The input formats: a valid input of each, and a judge that shares no code with the reader it judges.

A judge returns "accepted" or "refused", and raises AssertionError where the reader breaks its promise: whatever comes,
it is either read as an independent reader reads it, or refused in one :class:`InputError` that names the file.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import random
import re
import struct
import tomllib
import warnings
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from cobs import cobs
from pydantic import BaseModel

from ohmskin.bench._reference import Indeterminate, reference_volts
from ohmskin.cell import Cell
from ohmskin.circuits import AmplifierModel, Design, Shape, scan
from ohmskin.cli import run
from ohmskin.common.config import parse
from ohmskin.common.tables import read_cells, read_columns
from ohmskin.common.text import one_line
from ohmskin.driver import Calibration, ReplayPort, Skin, Tare
from ohmskin.emulator import Recording as Recorded
from ohmskin.emulator import Scene, Truth
from ohmskin.errors import InputError, LinkEnded, LinkError, OhmskinError, ProtocolError, SolverError
from ohmskin.kicad import Imported, differences, import_design, read_netlist, shape_of_layout, to_netlist
from ohmskin.wire import (
    BoardFile,
    FramePacket,
    Order,
    board_protocol,
    host_protocol,
    read_description,
    write_description,
)

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
FileJudge = Callable[[Any, Path, random.Random], None]
"""takes what was read, the file, and what draws; it may write beside the file"""


@dataclass(frozen=True)
class Format:
    """One kind of input."""

    name: str
    valid: Callable[[random.Random], bytes]
    judge: Judge
    text: bool = True
    inside: Callable[[random.Random, bytes], bytes] | None = None
    """mutates what is packed in the input, whose checksums hold afterwards"""

    def case(self, rng: random.Random) -> bytes:
        """A mutated input; now and then a valid one."""
        data = self.valid(rng)
        if rng.random() < 0.05:
            return data
        if self.inside is not None and rng.random() < 0.7:
            return self.inside(rng, data)
        return mutated(rng, data, text=self.text)


def _of_file(name: str, read: Callable[[Path], Any]) -> Callable[[FileJudge], Judge]:
    """A judge of input that is in a file of this name and is not refused by its reader."""

    def decorated(judge: FileJudge) -> Judge:
        def whole(data: bytes, rng: random.Random, folder: Path) -> str:
            path = folder / name
            path.write_bytes(data)
            found = _read(path, read)
            if found is None:
                return REFUSED
            judge(found, path, rng)
            return ACCEPTED

        return whole

    return decorated


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


# --- places of cells --------------------------------------------------------------------------------------------------


def _shape_text(rng: random.Random) -> bytes:
    cells = rng.sample([(row, column) for row in range(5) for column in range(4)], rng.randint(1, 20))
    names = ["row", "column", "x_mm", "y_mm", *(["z_mm"] if rng.random() < 0.5 else []), "area_mm2"]
    lines = [[*cell, *(rng.uniform(1.0, 60.0) for _ in names[2:])] for cell in cells]
    return "".join(",".join(map(str, line)) + "\n" for line in [names, *lines]).encode()


@_of_file("shape.csv", Shape.load)
def _judge_shape(shape: Any, path: Path, rng: random.Random) -> None:
    """The numbers of the lines, each cell once, and neighbours that are mutual, near and no hole."""
    _judge_geometry(shape)


def _judge_geometry(shape: Shape) -> None:
    cells = list(zip(shape.row, shape.column, strict=True))
    assert len(set(cells)) == len(cells)
    array = max(shape.row) + 1, max(shape.column) + 1
    if array[0] * array[1] > 10_000:
        return
    geometry = shape.geometry(array)
    assert {tuple(cell) for cell in np.argwhere(geometry.exists).tolist()} == set(cells)
    assert (geometry.areas_mm2[geometry.exists] > 0).all()
    count = geometry.areas_mm2.size
    lists = [{other for other in row if other < count} for row in geometry.neighbours.near.tolist()]
    for cell, others in enumerate(lists):
        assert cell not in others
        assert all(cell in lists[other] and geometry.exists.flat[other] for other in others)
    if shape.z_mm is None:
        places = {cell: place for cell, *place in zip(cells, shape.x_mm, shape.y_mm, strict=True)}
        for cell, place in places.items():
            assert geometry.places_mm[cell].tolist() == place


def _layout_text(rng: random.Random) -> bytes:
    parts = "".join(
        f'(footprint "comb" (at {9.5 * column} {12.0 * row} {rng.choice([0, 90, 33.5])})'
        f'(pad "1" smd rect (at -2 0) (size 2 6) (net 1 "/ROW{row}"))'
        f'(pad "2" smd rect (at 2 0) (size 2 6) (net 2 "COL{column}")))\n'
        for row in range(rng.randint(1, 4))
        for column in range(rng.randint(1, 4))
    )
    return f"(kicad_pcb (version 20240108)\n{parts})".encode()


@_of_file("skin.kicad_pcb", shape_of_layout)
def _judge_layout(shape: Any, path: Path, rng: random.Random) -> None:
    """A layout gives no more cells than it has footprints, and places as of any other shape."""
    assert len(shape.row) <= path.read_bytes().count(b"footprint")
    _judge_geometry(shape)


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


def _ends_text(rng: random.Random) -> bytes:
    """A design whose lines end in networks."""
    column = rng.choice(
        (
            '"R1 line 0 33k", "R2 line out 1k", "C1 out 0 10n"',
            '"V1 vcc 0 5", "R1 vcc line 10k"',
            '"X1 0 line out opamp", "R1 line out 1k"',
        )
    )
    return f"""[array]
rows = {SHAPE[0]}
columns = {SHAPE[1]}
row_lead = 5.0
[row_end]
selected = ["V1 d 0 5", "D1 d line 1N4148"]
idle = ["R1 line 0 100k"]
tolerance = {{ R1 = 0.01 }}
[column_end]
parts = [{column}]
shared_by = 1
[scan]
row = [{{ wait = 100e-6 }}]
column = [{{ wait = 10e-6 }}, {{ read = 4 }}]
[adc]
bits = 12
range = [0.0, 5.0]
""".encode()


@_of_file("design.toml", Design.load)
def _judge_ends(design: Any, path: Path, rng: random.Random) -> None:
    """Cards are elements with plain names and numbers, however they were written; a scan is finite or refused."""
    for end in (design.row_end, design.column_end):
        for cards in () if end is None else (getattr(end, key) for key in end.NETWORKS):
            for card in cards or ():
                assert re.fullmatch(r"[A-Z][\w.]*( [\w.+\-=]+)+", card), f"a card of another kind: {card!r}"
    if max(design.array.shape) <= 6:
        with contextlib.suppress(InputError, SolverError):
            assert np.isfinite(scan(design, np.full(design.array.shape, 1e4)).volts).all()


@_of_file("design.toml", Design.load)
def _judge_design(design: Any, path: Path, rng: random.Random) -> None:
    _agrees(_tables(path.read_bytes()), design)
    if max(design.array.shape) <= 6 and design.array.sheet == "sliced":
        _agrees_with_reference(design, rng)


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


def _netlist_text(rng: random.Random) -> bytes:
    return to_netlist(tomllib.loads(_design_text(rng).decode())).encode()


def _imported(path: Path) -> Imported:
    netlist = read_netlist(path)
    try:
        found = import_design(netlist)
        found.design()
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return found


@_of_file("board.net", _imported)
def _judge_netlist(found: Any, path: Path, rng: random.Random) -> None:
    """What is read is a design, or says why not; its text reads back as the same design."""
    design = found.design()
    written = path.parent / "design.toml"
    written.write_text(found.toml())
    assert not differences(Design.load(written), design), "the text says another design"


def _cell_text(rng: random.Random) -> bytes:
    return (ROOT / "cell" / "example.toml").read_bytes()


@_of_file("cell.toml", Cell.load)
def _judge_cell(cell: Any, path: Path, rng: random.Random) -> None:
    _agrees(_tables(path.read_bytes()), cell)
    copy = path.parent / "copy.toml"
    cell.save(copy, comment=path.read_bytes().decode("utf-8-sig")[:50])
    assert Cell.load(copy) == cell, "a saved cell reads back differently"


def _scene_text(rng: random.Random) -> bytes:
    text = (ROOT / "examples" / "fingers.toml").read_text()
    return text.replace("../verification/prototype.toml", str(ROOT / "verification" / "prototype.toml")).encode()


@_of_file("scene.toml", Scene.load)
def _judge_scene(scene: Any, path: Path, rng: random.Random) -> None:
    for time_s in (0.0, 1.02, 5.0, 1e6):
        pressure = scene.pressure_kpa(time_s)
        most = sum(max(kpa for _, kpa in contact.load_kpa) for contact in scene.contact)
        assert np.isfinite(pressure).all(), "pressure is not finite"
        assert (pressure >= 0).all(), "pressure is negative"
        assert pressure.max() <= most * (1 + 1e-9), "a cell bears more than all contacts together"


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
        float(field.strip())  # without it, float takes no separators of ASCII (FS to US) for blanks
    except ValueError:
        return False
    return True


def _float(field: str) -> float:
    return float(field.strip()) if _is_number(field) else math.nan


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
    """Frames of one board, as docs/wire.md has them."""
    boot = rng.randrange(2**32)
    packets = []
    for number in range(rng.randrange(1, 8)):
        rows, columns = rng.choice(shapes)
        counts = rng.randbytes(2 * rows * columns) if rng.random() < 0.7 else bytes(2 * rows * columns)
        head = struct.pack("<BBIIQ", 1, 2, boot, number, 20_000 * number)
        body = head + struct.pack("<HHH", rows, columns, 0) + counts
        packets.append(cobs.encode(body + struct.pack("<I", zlib.crc32(body))) + b"\0")
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


def _unstuffed(data: bytes) -> bytes | None:
    """COBS by its definition; None: none."""
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


def _board_text(rng: random.Random) -> bytes:
    """A valid BOARD.toml."""
    frame = rng.choice(
        (
            'format = "text"\nseparator = ","\nprefix = "d:"',
            'format = "text"\nlayout = "row-per-line"\nend = "flag"\nrange = [-2048.0, 2047.0]\norder = "column-major"',
            'format = "json"\nkey = "a.b"\ninvert = true\ninvalid = "drop"',
            'format = "binary"\nword = "uint16be"\nheader = [170, 85]\nbefore = 3\nchecksum = "crc16-modbus"',
            'format = "binary"\nword = "float32le"\nframing = "cobs"\nrange = [0.0, 1.0]\nflip_rows = true',
        )
    )
    start = rng.choice(('send = "go"\ndtr = false', 'poll = "a"', "send = [1, 2, 255]"))
    head = 'name = "mat"\nrows = 4\ncolumns = 5\nbits = 12\nbaudrate = 115200'
    return f"[board]\n{head}\n\n[frame]\n{frame}\n\n[start]\n{start}\n".encode()


def _round_trip(file: BoardFile, rng: random.Random) -> None:
    """What the described board sends, the described host reads, however the file describes it."""
    rows, columns, bits = file.board.rows, file.board.columns, file.board.bits
    if rows * columns > 400:
        return
    again = BoardFile.parse(json.loads(json.dumps(file.tables())), "again")
    shown = [
        np.array([rng.randrange(2**bits) for _ in range(rows * columns)]).reshape(rows, columns) for _ in range(12)
    ]
    for family in (file.family(), again.family()):
        board, host = board_protocol(family), host_protocol(family)
        board.feed(host.request(Order.START))
        found = []
        for number, counts in enumerate(shown):
            data = board.frame(FramePacket.of(counts, sequence=0, time_us=0))
            found += [e.counts for e in host.feed(data, 0.1 * number) if isinstance(e, FramePacket)]
        if _proves(file):
            assert found, "no frame of the described board is read"
            assert all(any(np.array_equal(one, counts) for counts in shown) for one in found), "a frame is read wrongly"


def _proves(file: BoardFile) -> bool:
    """Whether frames of the format cannot be mistaken: lines that end, checksums of some bytes, COBS."""
    frame = file.frame
    if frame.format == "binary":
        return frame.framing == "cobs" or frame.checksum not in ("none", "sum8", "xor8", "crc8")
    return frame.layout == "frame-per-line" or frame.end is not None


@_of_file("board.toml", BoardFile.load)
def _judge_board(file: Any, path: Path, rng: random.Random) -> None:
    """What is accepted has the values of the file, and both ends that it describes understand each other."""
    _agrees(_tables(path.read_bytes()), file)
    _round_trip(file, rng)


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


_DESIGN: dict[str, Any] = {
    "array": {"rows": 2, "columns": 3, "row_lead": 70.0},
    "drive": {"voltage": -1.0},
    "readout": {"circuit": "inverting-amplifier", "reference_resistance": 20e3, "supply": [0.0, 3.3]},
    "adc": {"bits": 16, "range": [0.0, 3.3]},
}


# --- arrays -----------------------------------------------------------------------------------------------------------


def _npz(arrays: Mapping[str, Any]) -> bytes:
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


def _tare(rng: random.Random) -> bytes:
    cells = np.array([rng.uniform(5e3, 2e4) for _ in range(math.prod(SHAPE))]).reshape(SHAPE)
    arrays = {"rest_resistance_ohm": cells, "measured": cells < 1.9e4, "std_ohm": 0.001 * cells, "wall_time": 1.7e9}
    return _npz(
        arrays
        | {"frames": 20, "lost": -1, "serial_number": "A1", "remarks": np.array(["one"][: rng.randrange(2)], str)}
    )


def _truth(rng: random.Random) -> bytes:
    frames = rng.randrange(1, 5)
    cells = np.array([rng.uniform(0, 15) for _ in range(frames * math.prod(SHAPE))]).reshape(frames, *SHAPE)
    times = 0.01 * np.arange(frames)
    arrays = {
        "sequence": np.arange(frames),
        "time_s": times,
        "pressure_kpa": cells,
        "pitch_mm": 4.0,
        "full_scale_kpa": 15.5,
    }
    return _npz(arrays | {"time": times, "pressure": cells, "valid": cells < 14.0})


def _odd(rng: random.Random, array: Any) -> Any:
    """An array that is none of what the reader expects, or hardly any."""
    kinds = (np.float16, ">f8", np.complex128, np.int8, np.uint64, bool, "U3", "M8[s]", "S4", [("a", "<f8")], "O")
    shapes = ((), (0,), (1,), (3,), (4, 3), SHAPE, (1, *SHAPE), (2, 2, 2, 2))
    values = (0, 1, -1, np.nan, np.inf, 1e308, 5e-324, 2**63 - 1, 1e30, 255)
    if rng.random() < 0.5:
        odd = np.array(array)
        if odd.size and odd.dtype.kind == "f":
            odd.flat[rng.randrange(odd.size)] = rng.choice(values)
        return odd
    with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore"):
        try:
            return np.full(rng.choice(shapes), rng.choice(values)).astype(rng.choice(kinds))
        except (TypeError, ValueError, OverflowError):
            return np.zeros(rng.choice(shapes))


def _inside_npz(rng: random.Random, data: bytes) -> bytes:
    """Other arrays, or mutated bytes of one, in an archive that is sound itself."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    for name in rng.sample(list(members), rng.choice((1, 1, 2))):
        content = members.pop(name)
        match rng.randrange(6):
            case 0:
                continue  # it is missing
            case 1:
                members[name.removesuffix(".npy")] = content
                continue
            case 2 | 3:
                out = io.BytesIO()
                np.save(out, _odd(rng, np.load(io.BytesIO(content))))
                content = out.getvalue()
            case _:
                content = mutated(rng, content, text=rng.random() < 0.3)
        members[name] = content
    out = io.BytesIO()
    packing = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2))
    with zipfile.ZipFile(out, "w", packing) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return out.getvalue()


def _same_arrays(path: Path, found: Mapping[str, Any]) -> None:
    """What NumPy's own reader makes of the file."""
    with np.load(path, allow_pickle=False) as arrays:
        for name, array in found.items():
            assert array.shape == arrays[name].shape, name
            assert np.array_equal(array, arrays[name], equal_nan=array.dtype.kind == "f"), name


@_of_file("tare.npz", Tare.load)
def _judge_tare(tare: Any, path: Path, rng: random.Random) -> None:
    _same_arrays(path, {name: getattr(tare, name) for name in ("rest_resistance_ohm", "measured", "std_ohm")})
    assert tare.measured.shape == tare.std_ohm.shape == tare.rest.shape
    assert np.isfinite(tare.rest).all(), "a rest that is no number"
    assert not (tare.std_ohm < 0).any()
    assert one_line(repr(tare)).isprintable()
    tare.save(path.parent / "again.npz")
    assert Tare.load(path.parent / "again.npz").remarks == tare.remarks


def _judge_truth(data: bytes, rng: random.Random, folder: Path) -> str:
    path = folder / "truth.npz"
    path.write_bytes(data)
    truth, taken = _read(path, Truth.load), _read(path, Recorded.load)
    design = {"array": {"rows": SHAPE[0], "columns": SHAPE[1]}, "drive": {"voltage": -1.0}, "adc": _DESIGN["adc"]}
    skin = {"design": {**design, "readout": _DESIGN["readout"]}}
    scene = _read(path, lambda path: _shown(skin, path))
    if scene is not None:
        pressure = scene.pressure_kpa(0.013)
        assert pressure.shape == SHAPE
        assert (pressure >= 0).all(), "pressure is negative or NaN"
    if truth is None and taken is None and scene is None:
        return REFUSED
    for found, names in ((truth, ("sequence", "time_s", "pressure_kpa")), (taken, ("sequence", "time", "pressure"))):
        if found is not None:
            _same_arrays(path, {name: getattr(found, name) for name in names})
            assert len({len(getattr(found, name)) for name in names}) == 1
    return ACCEPTED


def _shown(skin: Mapping[str, Any], path: Path) -> Scene:
    """A scene that shows the file as a movie."""
    tables = {"skin": skin, "movie": {"file": path.name}}
    return Scene.from_tables(tables, source=str(path), directory=path.parent)


# --- models of amplifiers ---------------------------------------------------------------------------------------------


def _model_text(rng: random.Random) -> bytes:
    """A maker's model with what makers use."""
    return b"""* an amplifier
.SUBCKT OPA IN+ IN- V+ V- OUT PARAMS: A0=1e5
+ GBW=1e6
.PARAM RX={2*10k}
.FUNC LIM(X,A) {MIN(MAX(X,-A),A)}
.MODEL QUIET RES(T_ABS=-273.15)
RIN IN+ IN- 10Meg
G1 0 P VALUE={LIM(V(IN+,IN-),1)*A0}
R1 P 0 1 ; a comment
C1 P 0 {A0/(6.2832*GBW)}
RN P Q QUIET {RX}
X1 P OUT V+ V- BUF
.ENDS OPA
.SUBCKT BUF IN OUT V+ V-
E1 M 0 IN 0 1
R2 M OUT 50
D1 OUT V+ DX
.MODEL DX D(IS=1e-14)
.ENDS
.END
"""


def _judge_model(data: bytes, rng: random.Random, folder: Path) -> str:
    """No line that is a command, reads a file, or begins one of ngspice's blocks gets into a netlist."""
    path = folder / "opa.lib"
    path.write_bytes(data)
    tables = {"file": "opa.lib", "subcircuit": "OPA"}
    model = _read(path, lambda path: parse(tables, AmplifierModel, source=str(path), folder=folder))
    if model is None:
        return REFUSED
    first = [line.split()[0].lower() for line in model.text.splitlines()]
    assert all(word[0] in "bcdefghijklmqrstvwxz" or word in _MODEL_CARDS for word in first), "another card"
    assert not re.search(r"(?i)\bfile\s*=|`", model.text)
    assert model.text.isascii()
    assert all(line.isprintable() for line in model.text.splitlines())
    assert len(first) <= 20_000
    return ACCEPTED


_MODEL_CARDS = {".subckt", ".ends", ".model", ".param", ".params", ".func", ".if", ".elseif", ".else", ".endif"}


# --- calibrations and descriptions ------------------------------------------------------------------------------------


def _calibration_text(rng: random.Random) -> bytes:
    shape = (2, 3)
    calibration = Calibration(
        rest_ohm=np.full(shape, 1e4),
        gain=np.full(shape, 1.1),
        gain_std=np.full(shape, 0.01),
        rest_std_kpa=np.full(shape, 0.02),
        residual_kpa=np.full(shape, 0.1),
        calibrated=np.ones(shape, bool),
        loads_kpa=(5.0, 10.0),
        presses=12,
        serial_number="A1",
        design_hash="0",
        cell_hash="1",
        date="2026-01-01T00:00:00+00:00",
    )
    return calibration.as_toml().encode()


@_of_file("skin.toml", Calibration.load)
def _judge_calibration(found: Any, path: Path, rng: random.Random) -> None:
    cells = _tables(path.read_bytes())["cells"]
    for name in ("rest_ohm", "gain", "gain_std"):
        assert getattr(found, name).tolist() == cells[name], name
    assert one_line(repr(found)).isprintable()


def _described(rng: random.Random) -> bytes:
    return write_description(tomllib.loads(_design_text(rng).decode()), _cell(rng))


def _judge_described(data: bytes, rng: random.Random, folder: Path) -> str:
    """A board's description is a design and a cell of values only, or an error of ours."""
    try:
        tables, cell = read_description(data)
        design = None if tables is None else parse(tables, Design, source="design")
        _ = None if cell is None else parse(cell, Cell, source="cell")
    except (InputError, ProtocolError) as refusal:
        message = one_line(str(refusal))
        return REFUSED if message.isprintable() else message
    assert design is None or (design.readout.amplifier_model is None and not design.requirement)
    return ACCEPTED


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
        Format("ends", _ends_text, _judge_ends),
        Format("netlist", _netlist_text, _judge_netlist),
        Format("shape", _shape_text, _judge_shape),
        Format("layout", _layout_text, _judge_layout),
        Format("cell", _cell_text, _judge_cell),
        Format("scene", _scene_text, _judge_scene),
        Format("cells", _cells_text, _judge_cells),
        Format("recording", _recording_text, _judge_recording),
        Format("frames", _stream, _judge_stream, text=False),
        Format("board", _board_text, _judge_board),
        Format("mcap", _recorded, _judge_recorded, text=False),
        Format("tare", _tare, _judge_tare, text=False, inside=_inside_npz),
        Format("truth", _truth, _judge_truth, text=False, inside=_inside_npz),
        Format("model", _model_text, _judge_model),
        Format("calibration", _calibration_text, _judge_calibration),
        Format("described", _described, _judge_described),
        Format("call", _call, _judge_call),
    )
}
