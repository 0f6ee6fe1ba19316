"""Skins that are no rectangles: laws of places, neighbours, contacts and holes."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from boards import DESIGN, scene
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.circuits import Design, Reason, Shape
from ohmskin.common.arrays import FloatArray
from ohmskin.common.config import parse
from ohmskin.common.geometry import Geometry
from ohmskin.driver import Contact, ContactTracker, Skin, messages_of, points_of
from ohmskin.emulator import PtyPort, Scene, running
from ohmskin.errors import InputError

FULL_KPA = 20.0
FOOT = (9, 5)


def insole(seed: int = 0, *, space: bool = False) -> Geometry:
    """Cells of uneven distances and areas, some of them missing; in space on a cylinder."""
    rng = np.random.default_rng(seed)
    rows, columns = np.indices(FOOT)
    places = np.stack([7.0 * columns, 9.0 * rows], axis=-1) + rng.uniform(-1.0, 1.0, (*FOOT, 2))
    if space:
        angle = places[..., 0] / 15.0
        places = np.stack([15.0 * np.sin(angle), places[..., 1], 15.0 * np.cos(angle)], axis=-1)
    there = np.ones(FOOT, dtype=bool)
    there[0, 0] = there[0, 4] = there[5, 0] = there[4, 2] = False
    return Geometry.of(FOOT, np.argwhere(there), places[there], rng.uniform(40.0, 60.0, int(there.sum())))


def walk(geometry: Geometry, seed: int) -> list[tuple[float, FloatArray]]:
    """Two fingers that move over the skin, and noise; NaN in holes."""
    rng = np.random.default_rng(seed)
    places = geometry.places_mm
    there = places[geometry.exists]
    ways = there[rng.integers(0, len(there), (2, 2))]
    frames = []
    for k in range(12):
        total = rng.normal(0.0, 0.05, geometry.shape)
        for (start, end), peak in zip(ways, (12.0, 8.0), strict=True):
            middle = start + (end - start) * k / 12
            total = total + peak * np.exp(-((places - middle) ** 2).sum(axis=-1) / (2 * 6.0**2))
        frames.append((0.02 * k, total))
    return frames


def contacts_of(geometry: Geometry, frames: list[tuple[float, FloatArray]]) -> list[tuple[Contact, ...]]:
    tracker = ContactTracker(geometry, FULL_KPA, faults_press=False)
    return [tracker.update(time_s, kpa, np.full(geometry.shape, 0.1)) for time_s, kpa in frames]


def places_of(contact: Contact) -> tuple[float, ...]:
    flat = (contact.x_mm, contact.y_mm)
    return flat if contact.z_mm is None else (*flat, contact.z_mm)


@given(st.integers(1, 9), st.integers(1, 9), st.floats(0.002, 0.03), st.floats(0.34, 3.0))
def test_neighbours_on_a_rectangle_are_four_and_eight(rows: int, columns: int, pitch: float, oblong: float) -> None:
    neighbours = Geometry.rectangle((rows, columns), (pitch, oblong * pitch)).neighbours
    count = rows * columns
    for cell, (row, column) in enumerate(itertools.product(range(rows), range(columns))):
        around = {
            (r - row, c - column): r * columns + c
            for r, c in itertools.product(range(rows), range(columns))
            if (r, c) != (row, column) and max(abs(r - row), abs(c - column)) == 1
        }
        assert {k for k in neighbours.near[cell].tolist() if k < count} == set(around.values())
        beside = {k for step, k in around.items() if 0 in step}
        assert {k for k in neighbours.beside[cell].tolist() if k < count} == beside
    inner = max(rows - 2, 0) * columns + rows * max(columns - 2, 0)
    assert len(neighbours.opposite) == inner


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("space", [False, True])
def test_neighbours_are_mutual_whatever_the_places(seed: int, space: bool) -> None:
    neighbours, count = insole(seed, space=space).neighbours, FOOT[0] * FOOT[1]
    for lists in (neighbours.beside, neighbours.near):
        pairs = {(cell, other) for cell in range(count) for other in lists[cell].tolist() if other < count}
        assert pairs == {(other, cell) for cell, other in pairs}
    holes = np.flatnonzero(~insole(seed).exists)
    assert (neighbours.near[holes] == count).all()
    assert not np.isin(neighbours.near, holes).any()
    assert 3.0 < np.mean([(row < count).sum() for row in neighbours.beside[insole(seed).exists.ravel()]]) < 5.0


def test_a_gap_parts_neighbours() -> None:
    """Two fingers of two lines each, with a line's distance between them; a sleeve that does not close."""
    rows, columns = np.indices((6, 5))
    there = columns != 2
    places = np.stack([5.0 * columns, 5.0 * rows], axis=-1)[there]
    near = Geometry.of((6, 5), np.argwhere(there), places, None).neighbours.near
    right = [5 * row + column for row in range(6) for column in (3, 4)]
    assert not np.isin(near[[5 * row + column for row in range(6) for column in (0, 1)]], right).any()


@pytest.mark.parametrize("closed", [False, True])
def test_a_sleeve_goes_around(closed: bool) -> None:
    rows, columns = np.indices((4, 12))
    angle = 2 * np.pi * columns / (12 if closed else 16)
    places = np.stack([20 * np.cos(angle), 10.0 * rows, 20 * np.sin(angle)], axis=-1).reshape(-1, 3)
    sleeve = Geometry.of((4, 12), np.argwhere(np.ones((4, 12))), places, None)
    assert (11 in sleeve.neighbours.beside[0]) is closed
    np.testing.assert_array_equal(
        np.sum(sleeve.neighbours.near[12:36] < 48, axis=1) == 8, closed | (columns[1:3] % 11 > 0).ravel()
    )


@settings(max_examples=20)
@given(st.integers(0, 2**32), st.floats(0, 6.28), st.tuples(*[st.floats(-500, 500)] * 3), st.booleans())
def test_a_rigid_motion_moves_the_contacts_and_leaves_their_forces(
    seed: int, angle: float, shift: tuple[float, ...], space: bool
) -> None:
    geometry = insole(seed % 7, space=space)
    frames = walk(geometry, seed)
    axes = len(geometry.axes)
    turn = np.eye(axes)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    if space:
        turn = turn @ np.roll(np.roll(turn, 1, axis=0), 1, axis=1)
    moved = Geometry(geometry.places_mm @ turn.T + shift[:axes], geometry.areas_mm2)
    for before, after in zip(contacts_of(geometry, frames), contacts_of(moved, frames), strict=True):
        assert [one.id for one in before] == [one.id for one in after]
        for one, other in zip(before, after, strict=True):
            assert other.force_n == pytest.approx(one.force_n)
            assert other.area_mm2 == pytest.approx(one.area_mm2)
            np.testing.assert_array_equal(other.cells, one.cells)
            np.testing.assert_allclose(places_of(other), turn @ places_of(one) + shift[:axes], atol=1e-6)


@settings(max_examples=20)
@given(st.integers(0, 2**32))
def test_contacts_do_not_depend_on_the_numbers_of_rows_and_columns(seed: int) -> None:
    geometry = insole(seed % 7)
    frames = walk(geometry, seed)
    rng = np.random.default_rng(seed)
    order = np.ix_(rng.permutation(FOOT[0]), rng.permutation(FOOT[1]))
    other = Geometry(geometry.places_mm[order], geometry.areas_mm2[order])
    names: dict[int, int] = {}  # fingers that begin in one frame are numbered in the order of their cells
    for before, after in zip(
        contacts_of(geometry, frames), contacts_of(other, [(t, kpa[order]) for t, kpa in frames]), strict=True
    ):
        names = {one.id: names.get(one.id, other.id) for one, other in zip(before, after, strict=True)} | names
        assert [names[one.id] for one in before] == [other.id for other in after]
        np.testing.assert_allclose([one.force_n for one in before], [one.force_n for one in after])
        np.testing.assert_allclose([places_of(one) for one in before], [places_of(one) for one in after])


def test_force_is_pressure_times_the_cells_own_areas() -> None:
    geometry = insole()
    pressure = np.where(geometry.exists, 0.0, np.nan)
    own = [(7, 1), (7, 2), (8, 2), (8, 3)]
    for place in own:
        pressure[place] = 10.0
    (contact,) = ContactTracker(geometry, FULL_KPA, faults_press=False).update(0.0, pressure, np.zeros(FOOT))
    areas = np.array([geometry.areas_mm2[place] for place in own])
    assert contact.force_n == pytest.approx(10e3 * 1e-6 * areas.sum())
    assert contact.area_mm2 == pytest.approx(areas.sum())
    assert places_of(contact) == pytest.approx(areas @ [geometry.places_mm[place] for place in own] / areas.sum())


def test_a_rectangle_in_a_file_is_the_rectangle_bit_for_bit(tmp_path: Path) -> None:
    plain = Design.load(Path(__file__).parents[1] / "examples/board-16x16.toml")
    Shape.of(plain.geometry).save(tmp_path / "shape.csv")
    again = parse(plain.model_dump() | {"shape": {"file": "shape.csv"}}, Design, source="design", folder=tmp_path)
    for name in ("places_mm", "areas_mm2", "exists"):
        np.testing.assert_array_equal(getattr(again.geometry, name), getattr(plain.geometry, name))
    rng = np.random.default_rng(0)
    frames = [(0.01 * k, 8.0 * rng.random((16, 16)) ** 8) for k in range(20)]
    for one, other in zip(contacts_of(plain.geometry, frames), contacts_of(again.geometry, frames), strict=True):
        assert one == other


def shaped(shape: dict[str, Any], **more: Any) -> Scene:
    press = {"bump": {"sigma_mm": 6.0, "center_mm": [9.0, 9.0]}, "load_kpa": [[0.0, 0.0], [1.0, 0.0], [1.2, 12.0]]}
    return scene(skin={"design": DESIGN | {"shape": shape}}, contact=[press], **more)


HOLED = {"row": [0, 0, 1, 2, 2], "column": [0, 1, 1, 0, 1], "x_mm": [0, 9, 9, 1, 9], "y_mm": [0, 0, 9, 18, 17]}


def test_a_hole_never_shows_a_pressure_and_is_no_fault() -> None:
    hole = np.zeros((3, 2), dtype=bool)
    hole[1, 0] = True
    port = PtyPort()
    with running(shaped(HOLED), port, clock="fast", duration_s=2.0), Skin.open(port.name, delivery="lossless") as skin:
        frames = list(skin)
        remark = skin.stats().remark
        assert skin.geometry.shape == (3, 2)
        with pytest.raises(InputError, match="use geometry"):
            _ = skin.pitch_m
    assert len(frames) > 90
    for frame in frames:
        assert np.isnan(frame.pressure[hole]).all()
        assert np.isnan(frame.resistance[hole]).all()
        assert (frame.reason[hole] == Reason.NO_CELL).all()
        assert (frame.reason[~hole] != Reason.NO_CELL).all()
        assert not any([1, 0] in contact.cells.tolist() for contact in frame.contacts)
    assert frames[-1].valid[~hole].all()
    (contact,) = frames[-1].contacts
    assert contact.x_mm == pytest.approx(9.0, abs=2.0)
    assert remark is None or "valid" not in remark
    points = points_of(frames[-1], frames[-1].pressure)
    assert points.shape == (5, 4)
    np.testing.assert_allclose(points[2, :3], [0.009, 0.009, 0.0])
    assert "/ohmskin/cells" in messages_of(frames[-1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"row": [0, 0, 1, 2, 3]}, r"cell \(3, 1\) lies outside the array of 3 x 2"),
        ({"row": [0, 0, 1, 2, 2.5]}, "integer"),
        ({"x_mm": [0, 9, 9, 1]}, "x_mm has 4 entries; expected 5"),
        ({"row": [1, 0, 1, 2, 0], "column": [0, 0, 1, 0, 0]}, r"cell \(0, 0\) is there twice"),
        ({"y_mm": [0, 0, 0, 18, 17]}, "are at one place"),
        ({"area_mm2": [1, 1, 1, 1, 0]}, "area_mm2"),
        ({"file": "shape.csv"}, "'file' has all columns"),
    ],
)
def test_a_shape_that_cannot_be_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse(DESIGN | {"shape": HOLED | change}, Design, source="a board")


def test_a_board_names_no_file() -> None:
    with pytest.raises(InputError, match="names a file; only a file of your own may do so"):
        parse(DESIGN | {"shape": {"file": "shape.csv"}}, Design, source="a board")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("row,column,x_mm\n0,0,1\n", "line 1: no column 'y_mm'"),
        ("row,column,x_mm,y_mm,zmm\n0,0,1,2,3\n", "line 1: column 'zmm'"),
        ("row,column,x_mm,y_mm\n0,0.5,1,2\n", "line 2: column is '0.5'; expected a whole number"),
        ("row,column,x_mm,y_mm\n0,0,1,2\n0,1,,2\n", "line 3: x_mm is ''; expected a number"),
        ("row,column,x_mm,y_mm\n0,0,1,x\n", "line 2"),
    ],
)
def test_a_shape_file_that_is_none_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "shape.csv").write_text(text)
    with pytest.raises(InputError, match=f"shape.csv: {message}"):
        Shape.load(tmp_path / "shape.csv")


def test_a_tare_and_the_statistics_do_not_miss_holes() -> None:
    port = PtyPort()
    with running(shaped(HOLED), port, clock="fast"), Skin.open(port.name, delivery="lossless") as skin:
        assert skin.tare().covers == "6 of 6 cells measured"
        assert skin.stats().not_valid == {}


def test_a_recording_keeps_the_shape_that_was_given(tmp_path: Path) -> None:
    Shape.of(insole()).save(tmp_path / "shape.csv")
    small = parse({k: [v[i] for i in (0, 2, 4)] for k, v in HOLED.items()}, Shape, source="shape")
    file = tmp_path / "press.mcap"
    with running(scene(), port := PtyPort(), clock="real"):
        with pytest.raises(InputError, match="lies outside the array of 3 x 2"):
            Skin.open(port.name, shape=tmp_path / "shape.csv")
        with pytest.raises(InputError, match="a pitch and a shape"):
            Skin.open(port.name, shape=small, pitch=0.01)
        with Skin.open(port.name, shape=small, record=file) as skin:
            skin.read()
    with Skin.open(file) as skin:
        np.testing.assert_array_equal(skin.geometry.places_mm, small.geometry((3, 2)).places_mm)
        assert (skin.read().reason == Reason.NO_CELL).sum() == 3
    with Skin.open(file, pitch=0.01) as skin:
        assert skin.pitch_m == 0.01
