"""CELL.toml: what is accepted, and one clear line for what is not."""

from pathlib import Path

import pytest

from ohmskin.cell import Cell
from ohmskin.emulator import LinkFault
from ohmskin.errors import InputError

GOOD = """
rest_resistance_ohm = 1e4
full_scale_kpa = 15.5
[model]
kind = "asymmetric"
e1_kpa = 32
e2_kpa = 60
e3_kpa = 480
eta2_kpa_s = 510
eta3_kpa_s = 48000
"""


def load(tmp_path: Path, text: str) -> Cell:
    path = tmp_path / "cell.toml"
    path.write_text(text, encoding="utf-8")
    return Cell.load(path)


def test_a_good_cell_loads(tmp_path: Path) -> None:
    assert load(tmp_path, GOOD).model.kind == "asymmetric"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "[model]",
            "full_scal = 1\n[model]",
            "unknown key 'full_scal'; the nearest known key, 'full_scale_kpa', is there already",
        ),
        (
            "[model]",
            "[model]\neta2 = 510",
            "unknown key 'model.asymmetric.eta2'; the nearest known key, 'eta2_kpa_s', is there already",
        ),
        (
            "eta2_kpa_s = 510",
            "eta2 = 510",
            "unknown key 'model.asymmetric.eta2'; the nearest known key is 'eta2_kpa_s'",
        ),
        ("rest_resistance_ohm = 1e4", "rest_resistance_ohm = -1", "rest_resistance_ohm"),
        ("eta2_kpa_s = 510", "", "missing key 'model.asymmetric.eta2_kpa_s'"),
        (
            '"asymmetric"',
            '"burgers"',
            "cell.toml: model.kind: input should be 'paper', 'asymmetric', 'm10' or 'contact' (got 'burgers')",
        ),
        ('"asymmetric"', "3", "model.kind: input should be 'paper', 'asymmetric', 'm10' or 'contact' (got '3')"),
        ('kind = "asymmetric"', "", "cell.toml: missing key 'model.kind'"),
        ("eta2_kpa_s = 510", "eta2_kpa_s = nan", "model.asymmetric.eta2_kpa_s"),
        ("eta2_kpa_s = 510", "eta2_kpa_s = 5100000", "the third branch must be the slower"),
    ],
)
def test_a_bad_cell_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        load(tmp_path, GOOD.replace(old, new))
    assert "cell.toml" in str(caught.value)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_model_of_something_else_is_refused() -> None:
    with pytest.raises(InputError, match=r"model\.kind: input should be .* \(got 'stall'\)"):
        Cell.example().replace(model=LinkFault(kind="stall", at_s=1.0))


def test_phases_that_disagree_at_equilibrium_are_refused() -> None:
    cell = Cell.example()
    tables = cell.model_dump()
    tables["model"]["eu1_kpa"] = 25.0
    with pytest.raises(ValueError, match="1/Eu1"):
        Cell.model_validate(tables)
