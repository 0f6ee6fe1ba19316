"""docs/design-file.md names every key, with its default."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from ohmskin.circuits import Design, Fault, Requirement, Spread
from ohmskin.common.config import parse

PAGE = (Path(__file__).parent.parent / "docs" / "design-file.md").read_text()


NETWORKS = {"row_end", "column_end", "reference", "crosspoint", "scan"}
"""tables that say what others say otherwise; the page has a second design with them"""


def test_the_page_is_a_design_with_every_key_at_its_default(tmp_path: Path) -> None:
    blocks = re.findall(r"```toml\n(.*?)```", PAGE, re.S)
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
    section = PAGE.partition("## Tolerances")[2]
    assert set(re.findall(r"^\| `(\w+)` \|", section, re.M)) == {"nominal", *Spread.model_fields}


def _defaults(part: BaseModel, model: type[BaseModel]) -> None:
    for name, field in model.model_fields.items():
        if not field.is_required() and field.default is not None and name != "spread":
            assert getattr(part, name) == field.default, name
