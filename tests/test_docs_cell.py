"""The CELL.toml of docs/cell.md is a cell, and the table beside it names the keys of every kind."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from ohmskin.bench.scenarios import maker
from ohmskin.cell import AsymmetricModel, Cell, ContactModel, M10Model, PaperModel

PAGE = (Path(__file__).parents[1] / "docs" / "cell.md").read_text(encoding="utf-8")


def test_the_cell_of_the_page_can_be_estimated() -> None:
    text = PAGE.split("```toml\n", 1)[1].split("```", 1)[0]
    cell = Cell.model_validate(tomllib.loads(text))
    assert cell.model.kind == "asymmetric"
    assert cell.estimator((2, 2)).shape == (2, 2)


def test_the_table_names_every_key() -> None:
    table = PAGE.split("keys of `[model]` |\n", 1)[1].split("\n\n", 1)[0]
    for model in (PaperModel, AsymmetricModel, M10Model, ContactModel):
        (kind,) = get_args(model.model_fields["kind"].annotation)
        (line,) = [line for line in table.splitlines() if line.startswith(f"| `{kind}` |")]
        needed = {name for name, key in model.model_fields.items() if name != "kind" and key.is_required()}
        assert {name for name in needed if f"`{name}`" not in line} == set()


def test_the_estimator_of_the_page_is_found_in_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (code,) = [block for block in PAGE.split("```python\n") if block.startswith("import numpy")]
    (tmp_path / "mine.py").write_text(code.split("```")[0])
    monkeypatch.chdir(tmp_path)
    cell = Cell.example()
    estimator = maker("mine:make")(cell, (2, 3))
    ohms = np.full((2, 3), 1.4 * cell.rest_resistance_ohm)
    np.testing.assert_allclose(estimator.step(0.01, ohms), 0.5 * cell.full_scale_kpa)
    assert estimator.std_kpa.shape == (2, 3)
