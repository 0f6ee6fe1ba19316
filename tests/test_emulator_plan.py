"""Plans of scenes, the examples' own plans, and the benchmark of the emulator."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from boards import DESIGN, scene

from ohmskin import bench
from ohmskin.bench import _emulator as of_boards
from ohmskin.bench import harness
from ohmskin.cli import run
from ohmskin.emulator import Scene, plan

EXAMPLES = sorted(
    path for path in (Path(__file__).parents[1] / "examples").glob("*.toml") if "\n[skin" in path.read_text()
)


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ohmskin.emulator._plan._BUDGET_S", 0.05)
    monkeypatch.setattr(of_boards, "_BUDGET_S", 0.05)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_the_examples_can_be_planned(example: Path) -> None:
    made = plan(Scene.load(example))
    assert made.frames_per_second > 0
    assert made.error_steps <= 0.25
    assert sum(made.methods.values()) == made.frames > 0
    assert {effect.name for effect in made.effects} >= {"row_lead", "converter", "settling", "noise at the ADC"}


def test_a_plan_names_the_method_and_the_cells() -> None:
    by_interpolation = plan(scene(board={"frame_rate": 500.0}))
    assert by_interpolation.methods["interpolation"] > by_interpolation.methods["exact"]
    assert by_interpolation.most_cells == 1
    divider = {**DESIGN, "readout": {"circuit": "voltage-divider", "reference_resistance": 20e3}}
    solved = plan(scene(skin={"design": divider}))
    assert "interpolation" not in solved.methods


def test_the_command_prints_a_plan_and_opens_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["emulate", str(EXAMPLES[0]), "--plan", "--link", str(tmp_path / "link")]) == 0
    text = capsys.readouterr().out
    assert "frames per processor second" in text
    assert "not modelled at all" in text
    assert not list(tmp_path.iterdir())


def test_the_benchmark_measures_what_it_says(capsys: pytest.CaptureFixture[str]) -> None:
    (row,) = of_boards.emulator([6], contacts=[2], rates_hz=[500.0])
    assert (row.size, row.contacts, row.frame_rate_hz) == (6, 2, 500.0)
    assert 0 < row.touched_cells <= 36
    assert row.difference_steps <= row.certified_steps + 1e-6 <= 0.25 + 1e-6
    assert row.frames_per_second > 0 < row.full_frames_per_second
    assert run(["bench", "--emulator", "--size", "4", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {entry["contacts"] for entry in found} == set(of_boards.CONTACTS)
    assert "6 x 6" in "".join(harness.table([row], of_boards.HEAD))
    assert bench.__doc__
