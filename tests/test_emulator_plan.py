"""Plans of scenes, and the examples' own plans."""

from __future__ import annotations

from pathlib import Path

import pytest
from boards import DESIGN, scene

from ohmskin.cli import run
from ohmskin.emulator import Scene, plan

EXAMPLES = sorted(
    path for path in (Path(__file__).parents[1] / "examples").glob("*.toml") if "\n[skin" in path.read_text()
)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_the_examples_can_be_planned(example: Path) -> None:
    made = plan(Scene.load(example), budget_s=0.05)
    assert made.frames_per_second > 0
    assert made.error_steps <= 0.25
    assert sum(made.methods.values()) == made.frames > 0
    assert {effect.name for effect in made.effects} >= {"row_lead", "converter", "settling", "noise at the ADC"}


def test_a_plan_names_the_method_and_the_cells() -> None:
    light = plan(scene(board={"frame_rate": 500.0}), budget_s=0.05)
    assert light.methods["attenuation"] > light.methods.get("exact", 0)
    assert light.most_cells == 1
    divider = {**DESIGN, "readout": {"circuit": "voltage-divider", "reference_resistance": 20e3}}
    assert set(plan(scene(skin={"design": divider}), budget_s=0.05).methods) == {"exact"}


def test_the_command_prints_a_plan_and_opens_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["emulate", str(EXAMPLES[0]), "--plan", "--link", str(tmp_path / "link")]) == 0
    text = capsys.readouterr().out
    assert "frames per processor second" in text
    assert "not modelled at all" in text
    assert not list(tmp_path.iterdir())
