"""Untrusted input is values only: no board, recording or message names a file, code, or what a check has made."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from boards import EXAMPLES, Script, frame, identity
from mcap.writer import Writer
from pydantic import BaseModel

from ohmskin.cell import Cell
from ohmskin.circuits import Design, Requirement
from ohmskin.common.config import LocalFile, parse
from ohmskin.driver import Calibration, ReplayPort, Skin
from ohmskin.emulator import Scene
from ohmskin.errors import InputError, ProtocolError
from ohmskin.wire import BoardFile, DescriptionPiece, encode

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
