"""SCENE.toml: shapes, loads over time, and what is refused."""

from __future__ import annotations

import functools
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from boards import DESIGN, scene

from ohmskin.cell import Cell
from ohmskin.circuits import Design
from ohmskin.emulator import Contact, Scene
from ohmskin.errors import InputError


def test_loads_are_straight_between_points_and_constant_outside() -> None:
    contact = Contact(cells=[(0, 0)], load_kpa=[(1.0, 0.0), (2.0, 10.0), (2.0, 4.0), (3.0, 0.0)])
    assert [contact.load(t) for t in (0.0, 1.0, 1.25, 1.999999, 2.0, 2.5, 9.0)] == pytest.approx(
        [0, 0, 2.5, 10, 4, 2, 0], abs=1e-4
    )


def test_rounding_does_not_delay_a_jump_at_the_end_of_a_period() -> None:
    """0.3 % 0.1 is 0.09999...; yet a tick at 0.3 s is the start of the fourth period."""
    contact = Contact(cells=[(0, 0)], load_kpa=[(0.0, 10.0), (0.05, 10.0), (0.05, 0.0)], period=0.1)
    assert [contact.load(k / 10) for k in range(30)] == [10.0] * 30
    assert [contact.load(k / 10 + 0.075) for k in range(30)] == [0.0] * 30


def test_a_load_with_a_period_comes_again() -> None:
    contact = Contact(cells=[(0, 0)], load_kpa=[(0.0, 0.0), (1.0, 8.0)], period=2.0)
    assert [contact.load(t) for t in (0.5, 2.5, 1001.5)] == pytest.approx([4, 4, 8])


def test_contacts_add_up() -> None:
    both = scene(
        contact=[
            {"cells": [[0, 0], [2, 1]], "load_kpa": [[0.0, 3.0]]},
            {"rectangle": {"center": [0.0, 0.5], "size_cells": [0.5, 2.0]}, "load_kpa": [[0.0, 4.0]]},
        ]
    )
    np.testing.assert_allclose(both.pressure_kpa(0.0), [[5, 2], [0, 0], [0, 3]])


def test_design_and_cell_may_be_files_beside_the_scene(tmp_path: Path) -> None:
    root = Path(__file__).parents[1]
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "design.toml").write_text((root / "verification" / "prototype.toml").read_text())
    (tmp_path / "cell.toml").write_text((root / "cell" / "example.toml").read_text())
    path = tmp_path / "scene.toml"
    path.write_text('[skin]\ndesign = "parts/design.toml"\ncell = "cell.toml"\n')
    loaded = Scene.load(path)
    assert loaded.skin.design == Design.load(root / "verification" / "prototype.toml")
    assert loaded.skin.cell == Cell.example()
    assert not loaded.pressure_kpa(1.0).any()


EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.toml"))
SCENES = [path for path in EXAMPLES if "\n[skin" in path.read_text()]
DESIGNS = [path for path in EXAMPLES if "\n[array]\n" in path.read_text()]


@pytest.mark.parametrize("example", [*SCENES, *DESIGNS], ids=lambda path: path.name)
def test_the_examples_load(example: Path) -> None:
    assert Design.load(example) if example in DESIGNS else Scene.load(example)


LOAD = {"load_kpa": [[0.0, 1.0]]}


BESIDE = "does not reach the 3 x 2 array"
ONE_OF = "a contact has one of cells, point, disc, rectangle, bump, image; got"
KNOWN = "unknown key '{}'; the nearest known key is '{}'"
ADC = "an [adc] of at most 16 bits"
REFUSED: list[tuple[str, str]] = [
    ("skin = {}", "scene: missing key 'skin.design'"),
    ("skin.design = 'nowhere.toml'", "nowhere.toml: cannot be read: No such file or directory"),
    ("board.frame_rat = 5.0", "scene: " + KNOWN.format("board.frame_rat", "frame_rate")),
    ("board.frame_rate = 0.0", "scene: board.frame_rate: input should be greater than or equal to 0.001 (got 0.0)"),
    ("board.frame_rate = 1e-320", "board.frame_rate"),
    ("board.contact = []", "unknown key 'board.contact'; the key belongs at the head of a table, [[contact]]"),
    ("line.packet_loss = 1.0", "scene: line.packet_loss: input should be less than 1 (got 1.0)"),
    ("contact = [{LOAD}]", f"scene: contact[0]: {ONE_OF} none"),
    ("contact = [{LOAD, cells = [[0, 0]], disc = {center = [0, 0], radius_cells = 1}}]", f"{ONE_OF} cells and disc"),
    ("contact = [{LOAD, cells = [[0, 2]]}]", "contact[0].cells: [0, 2] lies outside the 3 x 2 array"),
    ("contact = [{LOAD, cells = [[-1, 0]]}]", "contact[0].cells[0][0]: input should be greater than or equal to 0"),
    ("contact = [{LOAD, cells = [[0, 0]], path_mm = [[0, 0, 0]]}]", "stay where they are"),
    ("contact = [{LOAD, disc = {center = [1, 4], radius_cells = 1.5}}]", f"its shape around row 1, column 4 {BESIDE}"),
    ("contact = [{LOAD, disc = {center = [0, 0], radius_cells = 1e308}}]", "radius_cells"),
    ("contact = [{LOAD, disc = {radius_cells = 1.0}}]", "needs center or center_mm"),
    ("contact = [{LOAD, disc = {center = [0, 0], radius = 1}}]", KNOWN.format("contact[0].disc.radius", "radius_mm")),
    ("contact = [{LOAD, point = {center = [0, 0]}, path_mm = [[0, 0, 0]]}]", "not both"),
    (
        "contact = [{LOAD, point = {}, path_cells = [[0, -2, 0], [1, -2, 1]]}]",
        f"its shape around row -2, column 0 {BESIDE}, nor does its path",
    ),
    (
        "contact = [{LOAD, bump = {center = [0, 0], sigma_cells = 1, path_cells = [[0, 0, 0]]}}]",
        "unknown key 'contact[0].bump.path_cells'; the key belongs into [[contact]]",
    ),
    ("contact = [{LOAD, sigma_cells = 1}]", "key 'contact[0].sigma_cells'; the key belongs into [contact.bump]"),
    ("contact = [{LOAD, image = {file = 'no.gif', center = [0, 0], size_mm = [1, 1]}}]", "'.gif'"),
    ("contact = [{point = {center = [0, 0]}}]", "one load of load_kpa, force_n, sine, taps, recorded; got none"),
    ("contact = [{cells = [[0, 0]], recorded = {file = 'no.csv'}}]", "no.csv: cannot be read"),
    (
        "contact = [{cells = [[0, 0]], load_kpa = [[1.0, 0.0], [0.5, 2.0]]}]",
        "contact[0]: the times of load_kpa must not decrease; 0.5 s follows 1.0 s",
    ),
    ("contact = [{cells = [[0, 0]], load_kpa = [[0.0, -1.0]]}]", "load_kpa[0][1]: input should be greater"),
    ("contact = [{cells = [[0, 0]], load_kpa = [[0.0, nan]]}]", "load_kpa[0][1]: input should be"),
    ("contact = [{cells = [[0, 0]], load_kpa = []}]", "contact[0].load_kpa: list should have at least 1 item"),
    ("event = [{at_s = 1.0, kind = 'open-cell'}]", "needs a place"),
    ("event = [{at_s = 1.0, kind = 'open-cell', place = [3, 0]}]", "event[0].place: [3, 0] lies outside"),
    ("event = [{at_s = 1.0, kind = 'open-cel', place = [1, 0]}]", "event[0].kind"),
    ("event = [{at_s = 1.0, until_s = 0.5, kind = 'open-cell', place = [1, 0]}]", "is not after"),
    ("event = [{at_s = 1.0, kind = 'supply-sag', place = [1, 0], share = 0.5}]", "has no key 'place'"),
    ("event = [{at_s = 1.0, kind = 'bridged-rows', place = [2, 0]}]", "event[0]"),
    ("movie.file = 'no.npz'", "no.npz: cannot be read: No such file"),
]
REFUSED_SKINS: list[tuple[dict[str, Any], str]] = [
    ({"design": DESIGN | {"adc": None}}, f"scene: skin.design needs {ADC}"),
    ({"design": DESIGN | {"adc": {"bits": 24, "range": [0.0, 1.0]}}}, ADC),
    ({"design": DESIGN | {"array": {"row": 3, "columns": 3}}}, KNOWN.format("skin.design.array.row", "rows")),
    ({"design": DESIGN, "drift": {"temperature_change_c": 1e3}}, "a million times"),
    ({"design": DESIGN, "drift": {"temperature_change_c": [[0, 0], [9, 1e3]]}}, "a million times"),
]


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        *((tomllib.loads(text.replace("LOAD", "load_kpa = [[0.0, 1.0]]")), message) for text, message in REFUSED),
        *(({"skin": skin}, message) for skin, message in REFUSED_SKINS),
        ({"contact": [functools.reduce(lambda inner, _: {"a": inner}, range(3000), {})]}, "nested too deeply"),
    ],
)
def test_a_scene_that_makes_no_sense_is_refused_in_one_located_line(tables: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        scene(**tables)
    assert "\n" not in str(caught.value)


def test_a_contact_may_come_from_beside_the_array_and_leave_it() -> None:
    """Its path reaches the array, though neither end of the path does."""
    path = [[0.0, 1.0, -9.0], [1.0, 1.0, 9.0]]
    coming = scene(contact=[LOAD | {"disc": {"radius_cells": 1.0}, "path_cells": path}])
    assert not coming.pressure_kpa(0.0).any()
    assert coming.pressure_kpa(0.5).any()
    assert scene(contact=[LOAD | {"disc": {"center": [1.0, 2.4], "radius_cells": 1.0}}]).pressure_kpa(0.5).any()


def test_the_document_shows_a_scene_that_loads(tmp_path: Path) -> None:
    root = Path(__file__).parents[1]
    page = (root / "docs" / "scene.md").read_text(encoding="utf-8")
    (tmp_path / "prototype.toml").write_text((root / "verification" / "prototype.toml").read_text())
    (tmp_path / "cell.toml").write_text((root / "cell" / "example.toml").read_text())
    block, *others = re.findall(r"```toml\n(.*?)```", page, flags=re.DOTALL)
    other_shapes = re.findall(r"^# ((?:point|disc|rectangle|bump) = \{.*?\})", block, flags=re.MULTILINE)
    assert len(other_shapes) == 4
    shape = re.search(r"^cells = .*?\]\]", block, flags=re.MULTILINE)
    assert shape is not None
    for other in [shape.group(), *other_shapes]:
        path = tmp_path / "scene.toml"
        path.write_text(block.replace(shape.group(), other))
        assert Scene.load(path).pressure_kpa(2.0).max() > 1.0
    np.savez(tmp_path / "truth.npz", time_s=[0.0, 1.0], pressure_kpa=np.zeros((2, 4, 4)))
    path.write_text("\n".join([block, *others]))
    whole = Scene.load(path)
    assert (len(whole.event), whole.movie is not None) == (1, True)
    assert whole.skin.drift.percent_per_degree == 7.0
    (tmp_path / "press.csv").write_text("time_s,pressure_kpa\n0,1\n")
    loads = re.findall(r"^\| `((?:load_kpa|force_n|sine|taps|recorded) = .*?)` \|", page, flags=re.MULTILINE)
    assert len(loads) == 5
    for load in loads:
        path.write_text(f'[skin]\ndesign = "prototype.toml"\n[[contact]]\ncells = [[0, 0]]\n{load}\n')
        assert Scene.load(path).pressure_kpa(0.01).max() >= 0.0
