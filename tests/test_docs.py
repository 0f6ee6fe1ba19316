"""Every relative link of the documentation leads to a file."""

from __future__ import annotations

import doctest
import re
import tomllib
from itertools import islice
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from boards import scene
from pydantic import BaseModel

from ohmskin.bench.scenarios import maker
from ohmskin.cell import AsymmetricModel, Cell, ContactModel, M10Model, PaperModel
from ohmskin.circuits import Design, Fault, Requirement, Spread
from ohmskin.common.config import parse
from ohmskin.driver import Skin, Tare
from ohmskin.emulator import PtyPort, running

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").rglob("*.md")])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target


# The examples in docs/circuits.md and docs/your-circuit.md print what they say


@pytest.mark.parametrize("name", ["circuits.md", "your-circuit.md"])
def test_examples(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    root = Path(__file__).parent.parent
    monkeypatch.chdir(root)
    failed, attempted = doctest.testfile(str(root / "docs" / name), module_relative=False, encoding="utf-8")
    assert attempted > 12
    assert failed == 0


# The examples of docs/driver.md, run as they are but for the names of ports and the length of loops


TEXT = (Path(__file__).parents[1] / "docs" / "driver.md").read_text(encoding="utf-8")
SNIPPETS = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)
PORT = '"/dev/ttyACM0"'


def test_every_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the order of the page, on boards that are at their end after a while, so that loops end."""
    pytest.importorskip("mcap")
    monkeypatch.chdir(tmp_path)
    assert len(SNIPPETS) == 5
    for number, snippet in enumerate(SNIPPETS):
        board = scene(contact=[], board={"frame_rate": 200.0, "serial_number": "L-07"})
        port, other = PtyPort(), PtyPort()
        second = scene(contact=[], board={"frame_rate": 200.0, "serial_number": "R-02"})
        names = [port.name, other.name]
        monkeypatch.setattr("ohmskin.driver._discover.serial_ports", lambda names=names: names)
        with running(board, port, duration_s=3.0), running(second, other):
            known: dict[str, Any] = {"Skin": Skin, "Tare": Tare}
            if "skin" in snippet and "Skin.open(" not in snippet:
                known["skin"] = Skin.open(port.name)
            try:
                exec(compile(snippet.replace(PORT, repr(port.name)), f"example {number}", "exec"), known)
            finally:
                for name in ("skin", "left", "right"):
                    if name in known:
                        known[name].close()
    with Skin.open("press.mcap") as played:
        assert len(list(islice(played, 10))) == 10


# The CELL.toml of docs/cell.md is a cell, and the table beside it names the keys of every kind


CELL_PAGE = (Path(__file__).parents[1] / "docs" / "cell.md").read_text(encoding="utf-8")


def test_the_cell_of_the_page_can_be_estimated() -> None:
    text = CELL_PAGE.split("```toml\n", 1)[1].split("```", 1)[0]
    cell = Cell.model_validate(tomllib.loads(text))
    assert cell.model.kind == "asymmetric"
    assert cell.estimator((2, 2)).shape == (2, 2)


def test_the_table_names_every_key() -> None:
    table = CELL_PAGE.split("keys of `[model]` |\n", 1)[1].split("\n\n", 1)[0]
    for model in (PaperModel, AsymmetricModel, M10Model, ContactModel):
        (kind,) = get_args(model.model_fields["kind"].annotation)
        (line,) = [line for line in table.splitlines() if line.startswith(f"| `{kind}` |")]
        needed = {name for name, key in model.model_fields.items() if name != "kind" and key.is_required()}
        assert {name for name in needed if f"`{name}`" not in line} == set()


def test_the_estimator_of_the_page_is_found_in_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (code,) = [block for block in CELL_PAGE.split("```python\n") if block.startswith("import numpy")]
    (tmp_path / "mine.py").write_text(code.split("```")[0])
    monkeypatch.chdir(tmp_path)
    cell = Cell.example()
    estimator = maker("mine:make")(cell, (2, 3))
    ohms = np.full((2, 3), 1.4 * cell.rest_resistance_ohm)
    np.testing.assert_allclose(estimator.step(0.01, ohms), 0.5 * cell.full_scale_kpa)
    assert estimator.std_kpa.shape == (2, 3)


# docs/design-file.md names every key, with its default


DESIGN_PAGE = (Path(__file__).parent.parent / "docs" / "design-file.md").read_text()


NETWORKS = {"row_end", "column_end", "reference", "crosspoint", "scan"}
"""tables that say what others say otherwise; the page has a second design with them"""


def test_the_page_is_a_design_with_every_key_at_its_default(tmp_path: Path) -> None:
    blocks = re.findall(r"```toml\n(.*?)```", DESIGN_PAGE, re.S)
    tables, networks = tomllib.loads(blocks[0]), tomllib.loads(blocks[1])
    (tmp_path / "opa.lib").write_text(".subckt OPA333 p n vp vn out\nE1 out 0 p n 1e5\n.ends\n")
    (tmp_path / "shape.csv").write_text("row,column,x_mm,y_mm\n0,0,0,0\n")
    design = parse(tables, Design, source="design-file.md", folder=tmp_path)
    lists = {"fault", "requirement"} | NETWORKS
    named: dict[str, Any] = {name: tables[name] for name in Design.model_fields if name not in lists}
    assert tables.keys() == Design.model_fields.keys() - NETWORKS
    described = Design.model_validate({"array": {"rows": 2, "columns": 4}} | networks)
    for section in NETWORKS:
        assert networks[section].keys() == type(getattr(described, section)).model_fields.keys(), section
    assert named.pop("shape").keys() == {"file"}  # which has the columns
    for section, keys in named.items():
        model = type(getattr(design, section))
        assert keys.keys() == model.model_fields.keys() - {"spread"}, section
        _defaults(getattr(design, section), model)
    assert tables["fault"][0].keys() == Fault.model_fields.keys()
    assert tables["requirement"][0].keys() == Requirement.model_fields.keys() - {"min"}


def test_the_page_names_every_key_of_a_spread() -> None:
    section = DESIGN_PAGE.partition("## Tolerances")[2]
    assert set(re.findall(r"^\| `(\w+)` \|", section, re.M)) == {"nominal", *Spread.model_fields}


def _defaults(part: BaseModel, model: type[BaseModel]) -> None:
    for name, field in model.model_fields.items():
        if not field.is_required() and field.default is not None and name != "spread":
            assert getattr(part, name) == field.default, name
