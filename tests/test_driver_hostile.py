"""Boards that flood, lie and stall: the driver says what is wrong in the time that it was given, and leaves nothing."""

from __future__ import annotations

import json
import threading
import time
import tomllib
import traceback
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from boards import EXAMPLES, MemoryPort, Script, described, frame, identity, sheet
from mcap.writer import Writer
from pydantic import BaseModel

from ohmskin.cell import Cell
from ohmskin.circuits import Design, Requirement
from ohmskin.common.config import LocalFile, parse
from ohmskin.driver import Calibration, CountReader, Delivery, ReplayPort, Skin
from ohmskin.driver._convert import Converter
from ohmskin.driver._converted import Converted
from ohmskin.driver._stream import RawFrame
from ohmskin.emulator import Scene
from ohmskin.errors import InputError, LinkError, OhmskinError, ProtocolError
from ohmskin.wire import BoardFile, DescriptionPiece, encode

DESIGN = {"array": {"rows": 3, "columns": 2}, "drive": {"voltage": -1.0}}
ESCAPES = "\x1b[2J\n\x9b31m\u202e"
"""clears a terminal, colours it, and turns the direction of what follows"""
BLOCK = 8192
"""bytes that a port gives at once"""


class Flood(MemoryPort):
    """A line on which more noise has always come, as from a board at another baud rate that never pauses."""

    def __init__(self, noise: bytes) -> None:
        super().__init__()
        self._block = (noise * BLOCK)[:BLOCK]

    def ready(self) -> bool:
        return True

    def next_bytes(self) -> bytes:
        return self._block


@pytest.mark.parametrize(("family", "noise"), [("ohmskin", b"\0x"), ("fsr-array", b"a"), ("snowboard", b"\n")])
def test_a_flood_of_noise_ends_with_the_timeout(family: str, noise: bytes) -> None:
    """Some formats take a second to look through what comes in a second: readers and set-up get their share."""
    port = Flood(noise)
    with (
        pytest.raises(ProtocolError, match=f"expected a board of family '{family}'"),
        Skin(port, board=family, timeout=1.0) as skin,
    ):
        skin.read()
    assert port.closed


class Torrent(MemoryPort):
    """A board that sends faster than any host takes; it counts the reads of each turn."""

    def __init__(self) -> None:
        super().__init__()
        self._pieces = [identity(), sheet()]
        self._number = 0
        self.reads: dict[int, list[int]] = defaultdict(lambda: [0])
        """of each thread: reads in each of its turns"""

    def ready(self) -> bool:
        return True

    def wait(self, timeout_s: float) -> bool:
        self.reads[threading.get_ident()].append(0)
        return True

    def next_bytes(self) -> bytes:
        self.reads[threading.get_ident()][-1] += 1
        if self._pieces:
            return self._pieces.pop(0)
        first, self._number = self._number, self._number + 40
        return b"".join(map(frame, range(first, self._number)))


def test_a_flood_of_frames_leaves_turns_of_bounded_work() -> None:
    """The thread reads so many frames in a turn and no more, and so does each call, whose two turns are then short."""
    port = Torrent()
    with Skin(port) as skin:
        mine = port.reads[threading.get_ident()]
        for _ in range(50):
            mine.append(0)
            skin.latest(1e9)
    assert port.closed
    turns = [count for counts in port.reads.values() if counts is not mine for count in counts]
    assert sum(turns) > 0
    assert max(turns) <= 6
    assert max(mine) <= 12


class LateStart(Script):
    """Its first order takes longer than the timeout, as where the thread that reads does not get the processor."""

    def write(self, data: bytes) -> None:
        if not self.written:
            time.sleep(0.6)
        super().write(data)


def test_a_timeout_counts_from_when_the_board_was_asked() -> None:
    with Skin(LateStart(identity(), sheet(), frame(0)), timeout=0.2) as skin:
        assert skin.read(60.0).sequence == 0


@pytest.mark.parametrize("how", ["newest", "every", "lossless"])
def test_a_frame_that_waits_for_its_conversion_is_no_silence(monkeypatch: pytest.MonkeyPatch, how: Delivery) -> None:
    """However long the first conversion takes beside other programs."""
    convert, begun = Converter.convert, threading.Event()

    def late(converter: Converter, raw: RawFrame) -> Converted:
        begun.set()
        time.sleep(0.5)
        return convert(converter, raw)

    monkeypatch.setattr(Converter, "convert", late)
    with Skin(described(frame(0)), delivery=how, timeout=0.1) as skin:
        if how != "lossless":
            assert begun.wait(60.0)  # by the thread that reads
        assert skin.read().sequence == 0


def test_set_ups_that_take_too_long_leave_few_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    over = threading.Event()
    monkeypatch.setattr(CountReader, "__call__", lambda *_: over.wait(60.0))
    try:
        for _ in range(4):
            with pytest.raises(ProtocolError, match=r"was not set up within 0\.02 s"):
                Skin(described(frame(0)), timeout=0.02)
        assert len([thread for thread in threading.enumerate() if thread.name == "ohmskin set-up"]) <= 2
    finally:
        over.set()
    monkeypatch.undo()
    with Skin(described(frame(0))) as skin:  # once they have ended another one begins
        assert skin.read().sequence == 0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (b'{"design": ', "a description is not JSON: Expecting value"),
        (b'{"design": 1}', "a description whose 'design' is no object"),
        (b"\xff" * 40, "a description is not JSON: 'utf-8' codec can't decode"),
    ],
)
def test_a_description_that_cannot_be_read_is_named_though_frames_come(text: bytes, said: str) -> None:
    port = Script(identity(), encode(DescriptionPiece(0, 0, 0, len(text), text, 1)), frame(1), frame(2))
    with pytest.raises(ProtocolError, match=f"the board describes itself wrongly: {said}"):
        Skin(port, timeout=0.3)


@pytest.mark.parametrize(
    "tables",
    [
        DESIGN | {ESCAPES: 1},
        DESIGN | {"drive": {"voltage": ESCAPES}},
        DESIGN | {"array": {ESCAPES: {ESCAPES: 1e200}}},
        DESIGN | {"drive": {"idle_rows": ESCAPES * 500}},
    ],
)
def test_no_traceback_commands_the_terminal(tables: dict[str, object]) -> None:
    text = json.dumps({"design": tables}, ensure_ascii=False).encode()
    piece = encode(DescriptionPiece(0, 0, 0, len(text), text, 1))
    with pytest.raises(OhmskinError) as caught:
        Skin(Script(identity(serial_number=ESCAPES), piece), timeout=0.3)
    assert str(caught.value).isprintable()
    assert "".join(traceback.format_exception(caught.value)).replace("\n", "").isprintable()


def test_no_serial_number_commands_the_terminal() -> None:
    with pytest.raises(OhmskinError, match=r"expected \\x1b\[2J") as caught:
        Skin(Script(identity(serial_number=ESCAPES), identity(serial_number="B2")), timeout=0.3)
    assert str(caught.value).isprintable()
    assert str(LinkError(5, f"a name of a file{ESCAPES}")).isprintable()


# Untrusted input is values only: no board, recording or message names a file, code, or what a check has made


SHELL = ".subckt OPA p n vp vn out\nR1 p n 1e6\nE1 out 0 p n 1e5\n.ends\n.control\nshell touch pwned\n.endc"
OWN_ONLY = [
    ("readout", "amplifier_model", {"file": "opa.lib", "subcircuit": "OPA", "text": SHELL}),
    ("readout", "amplifier_model", {"file": "opa.lib", "subcircuit": "OPA"}),
    ("requirement", None, [{"id": "X", "quantity": "checks.py:f", "max": 1.0}]),
    ("requirement", None, [{"id": "X", "quantity": "crosstalk", "max": 1e9}]),
]
"""tables of a design and what an untrusted sender may not put there: files, their content, code, and the own measure"""


def _tables(table: str, key: str | None, value: Any) -> dict[str, Any]:
    tables: dict[str, Any] = tomllib.loads((EXAMPLES / "board-4x4.toml").read_text())
    if key is None:
        return tables | {table: value}
    tables[table][key] = value
    return tables


@pytest.mark.parametrize(("table", "key", "value"), OWN_ONLY)
def test_a_board_describes_values_only(table: str, key: str | None, value: Any, tmp_path: Path) -> None:
    tables = _tables(table, key, value)
    text = json.dumps({"design": tables}).encode()
    said = encode(DescriptionPiece(0, 0, 0, len(text), text, 1))
    with pytest.raises(ProtocolError, match=rf"describes itself wrongly: design: .*{table}.*(of your own|text')"):
        Skin(Script(identity(), said, frame(1), frame(2)), timeout=5.0)
    with pytest.raises(InputError, match=f"design: .*{table}"):
        ReplayPort(_recording(tmp_path, board="ohmskin", given=json.dumps({"design": tables})))


@pytest.mark.parametrize("table", ["requirement", "document", "parts"])
@pytest.mark.parametrize("value", [3, "x", {"a": 1}, [3], None, True])
def test_values_of_another_kind_in_the_users_own_tables_are_bad_input(table: str, value: Any) -> None:
    for folder in (None, EXAMPLES):
        with pytest.raises(InputError, match=f"design: .*{table}"):
            parse(_tables(table, None, value), Design, source="design", folder=folder)


def _recording(folder: Path, **metadata: str) -> Path:
    path = folder / "press.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata("ohmskin", {"format": "1", "given": "{}", **metadata})
        writer.finish()
    return path


def test_a_recording_names_no_board_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    board = {"board": {"name": "mat", "rows": 2, "columns": 2}, "frame": {"format": "text"}}
    Path("mat.toml").write_text('[board]\nname = "mat"\nrows = 2\ncolumns = 2\n[frame]\nformat = "text"\n')
    with pytest.raises(InputError, match="no known family"):
        Skin.open(str(_recording(tmp_path, board="mat.toml")))
    for key in ("design", "cell"):
        named = {"board": {**board["board"], key: "design.toml"}, "frame": board["frame"]}
        with pytest.raises(InputError, match=f"board_file: board.{key}: names a file"):
            Skin.open(str(_recording(tmp_path, board="mat", board_file=json.dumps(named))))


def _models(kind: type[BaseModel], seen: set[type[BaseModel]]) -> Iterator[type[BaseModel]]:
    """A model and those of its keys."""
    if kind in seen:
        return
    seen.add(kind)
    yield kind
    for field in kind.model_fields.values():
        for inner in _inner(field.annotation):
            yield from _models(inner, seen)


def _inner(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in getattr(annotation, "__args__", ()):
        yield from _inner(part)


@pytest.mark.parametrize("root", [Design, Cell, BoardFile, Scene])
def test_a_key_that_names_a_file_is_of_the_type_that_refuses_untrusted_senders(root: type[BaseModel]) -> None:
    (refuse,) = LocalFile.__metadata__
    for model in _models(root, set()):
        for name, field in model.model_fields.items():
            if name.endswith(("file", "path")) or Path in (
                field.annotation,
                *getattr(field.annotation, "__args__", ()),
            ):
                in_options = [
                    mark
                    for part in getattr(field.annotation, "__args__", ())
                    for mark in getattr(part, "__metadata__", ())
                ]
                assert refuse in [*field.metadata, *in_options], f"{model.__name__}.{name}"


def test_a_file_of_the_user_starts_at_the_file_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "opa.lib").write_text(SHELL.partition("\n.control")[0])
    tables = _tables("readout", "amplifier_model", {"file": "opa.lib", "subcircuit": "OPA"})
    design = parse(tables, Design, source="design", folder=tmp_path)
    assert design.readout.amplifier_model is not None
    assert design.readout.amplifier_model.text.startswith(".subckt OPA")
    changed = design.replace(readout={"reference_resistance": 1e3}, array={"row_lead": 1.0})
    assert changed.readout.amplifier_model == design.readout.amplifier_model
    own = Requirement(id="X", quantity="crosstalk", max=1.0)
    assert changed.replace(requirement=(own,)).requirement == (own,)


def test_a_calibration_of_a_recording_names_nothing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="calibration"):
        Calibration.from_toml('format = 1\nfile = "x"\n', "calibration")
