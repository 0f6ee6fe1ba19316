"""docs/design-file.md names every key, with its default."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from ohmskin.circuits import Design, Fault

PAGE = (Path(__file__).parent.parent / "docs" / "design-file.md").read_text()


def test_the_page_is_a_design_with_every_key_at_its_default() -> None:
    block = re.search(r"```toml\n(.*?)```", PAGE, re.S)
    assert block is not None
    tables = tomllib.loads(block[1])
    design = Design.model_validate(tables)
    named: dict[str, Any] = {name: tables[name] for name in Design.model_fields if name != "fault"}
    assert tables.keys() == Design.model_fields.keys()
    for section, keys in named.items():
        model = type(getattr(design, section))
        assert keys.keys() == model.model_fields.keys(), section
        _defaults(getattr(design, section), model)
    assert tables["fault"][0].keys() == Fault.model_fields.keys()


def _defaults(part: BaseModel, model: type[BaseModel]) -> None:
    for name, field in model.model_fields.items():
        if not field.is_required():
            assert getattr(part, name) == field.default, name
