"""The physics in blocks: independent of who asks and how, equal to the full physics, and all that a scene can hold."""

from __future__ import annotations

import re
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from boards import DESIGN, scene
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import dblquad

from ohmskin.circuits import scan
from ohmskin.cli import run
from ohmskin.common.geometry import Geometry
from ohmskin.emulator import (
    Board,
    Bump,
    Contact,
    Disc,
    EmulatedSkin,
    Hand,
    Image,
    Point,
    Rectangle,
    Scene,
    plan,
    shares,
    spread,
)
from ohmskin.errors import InputError, LinkTimeout

BIG: dict[str, Any] = {
    **DESIGN,
    "array": {"rows": 9, "columns": 7, "row_lead": 70.0, "column_lead": 5.0, "row_segment": 0.5, "column_segment": 0.5},
}
SLIDING = [
    {"bump": {"sigma_mm": 3.0}, "path_mm": [[0.0, 2.0, 1.0], [0.6, 28.0, 22.0]], "load_kpa": [[0.0, 0.0], [0.1, 12.0]]},
    {
        "disc": {"radius_mm": 5.0},
        "path_cells": [[0.0, 6.0, 1.0], [0.5, 1.0, 5.0]],
        "taps": {"load_kpa": 9.0, "every_s": 0.2},
    },
]


def read(what: Scene, frames: int, *, seed: int = 0) -> dict[str, np.ndarray]:
    """The first frames of a scene, one by one, as arrays (frames, ...)."""
    skin = EmulatedSkin(what, seed)
    taken = [skin.read() for _ in range(frames)]
    fields = ("time_us", "pressure_kpa", "resistance_ohm", "volts", "counts")
    return {name: np.array([getattr(block, name)[place] for block, place in taken]) for name in fields}


def sliding(**tables: Any) -> Scene:
    return scene(skin={"design": BIG, "pitch_mm": 4.0}, contact=SLIDING, **tables)


@pytest.mark.parametrize("skin", [{}, {"cover_thickness": 0.002}, {"spread": {"rest_percent": 5.0}}])
def test_blocks_are_the_full_physics_within_a_quarter_step(skin: dict[str, Any]) -> None:
    """Pressure, cells and circuit again, frame by frame and every cell, by the exact method."""
    what = scene(skin={"design": BIG, "pitch_mm": 4.0, **skin}, contact=SLIDING, board={"frame_rate": 200.0})
    found = read(what, 150)
    design, before = what.skin.design, 0.0
    rest, sensitivity = what.skin.spread.draw((9, 7))
    cells = what.skin.cell.forward((9, 7), rest_resistance_ohm=rest * what.skin.cell.rest_resistance_ohm)
    assert design.adc is not None
    for frame, time_us in enumerate(found["time_us"]):
        now = time_us / 1e6
        pressure = what.pressure_kpa(now)
        np.testing.assert_allclose(found["pressure_kpa"][frame], pressure, rtol=1e-12, atol=1e-12)
        ohms = cells.step(now - before, sensitivity * spread(pressure, what.skin.spreading_pitches))
        np.testing.assert_allclose(found["resistance_ohm"][frame], ohms, rtol=2 * 2.0**-18)
        exact = scan(design, ohms, method="exact").volts
        assert np.abs(found["volts"][frame] - exact).max() <= 0.27 * design.adc.step
        before = now


@given(pieces=st.lists(st.integers(1, 700), min_size=1, max_size=4), seed=st.integers(0, 3))
@settings(max_examples=10, deadline=None)
def test_how_frames_are_asked_for_changes_no_bit(pieces: list[int], seed: int) -> None:
    what = sliding(board={"frame_rate": 1000.0, "noise": 1e-3})
    straight = read(what, sum(pieces), seed=seed)
    skin, done = EmulatedSkin(what, seed, ahead=bool(seed % 2)), 0
    for piece in pieces:  # each piece at once, as a host that stops and starts asks for them
        for _ in range(piece):
            block, place = skin.read()
            if done % 97 == 0:
                np.testing.assert_array_equal(block.volts[place], straight["volts"][done])
            done += 1


def coverage(shape: Disc | Rectangle | Bump | Point | Image, array: tuple[int, int]) -> np.ndarray:
    """Pressure on each cell under a load of 1 kPa."""
    return Contact.model_validate({type(shape).__name__.lower(): shape, "load_kpa": [(0.0, 1.0)]}).coverage(
        Geometry.rectangle(array, 0.0254)
    )


def brute(shape: Disc | Rectangle | Bump, array: tuple[int, int]) -> np.ndarray:
    """Coverage by counting points of a fine grid."""
    fine = 60
    places = (np.arange(fine) + 0.5) / fine - 0.5
    middle = shape.center
    assert middle is not None
    down = (np.arange(array[0])[:, None] + places).ravel()[:, None] - middle[0]
    along = (np.arange(array[1])[:, None] + places).ravel()[None, :] - middle[1]
    match shape:
        case Disc(radius_cells=float(radius)):
            share = (down**2 + along**2 < radius**2).astype(float)
        case Bump(sigma_cells=float(sigma)):
            share = np.exp(-(down**2 + along**2) / (2 * sigma**2))
        case Rectangle(size_cells=(float(height), float(width))):
            share = ((np.abs(down) < height / 2) & (np.abs(along) < width / 2)).astype(float)
        case _:
            raise AssertionError
    return share.reshape(array[0], fine, array[1], fine).mean(axis=(1, 3))


middles = st.tuples(st.floats(-2, 8), st.floats(-2, 9))


@given(center=middles, size=st.floats(0.05, 4.0))
@settings(max_examples=30, deadline=None)
def test_coverage_is_the_area_that_counting_finds(center: tuple[float, float], size: float) -> None:
    for shape in (
        Disc(center=center, radius_cells=size),
        Rectangle(center=center, size_cells=(size, 2 * size)),
        Bump(center=center, sigma_cells=size),
    ):
        np.testing.assert_allclose(coverage(shape, (6, 7)), brute(shape, (6, 7)), atol=0.03)
        assert coverage(shape, (60, 60)).sum() <= shape.area(25.4) * (1 + 1e-9) + 1e-9


def test_a_sliding_shape_is_at_each_time_the_shape_at_that_place() -> None:
    path = [(0.0, 1.0, 0.5), (2.0, 5.0, 4.5)]
    for name, size in (("disc", {"radius_cells": 1.2}), ("bump", {"sigma_cells": 0.7}), ("point", {})):
        moving = Contact.model_validate({name: size, "path_cells": path, "load_kpa": [(0.0, 2.0)]})
        times = np.linspace(0, 2, 9)
        cells, pressure = moving.pressure_on(times, Geometry.rectangle((7, 6), 0.0254))
        for at_s, frame in zip(times, pressure, strict=True):
            center = (1.0 + 2.0 * at_s, 0.5 + 2.0 * at_s)
            at_rest = Contact.model_validate({name: {**size, "center": center}, "load_kpa": [(0.0, 2.0)]})
            expected = 2.0 * at_rest.coverage(Geometry.rectangle((7, 6), 0.0254))
            np.testing.assert_allclose(frame, expected.flat[cells], atol=1e-12)
            assert frame.sum() == pytest.approx(expected.sum())


def test_a_point_is_shared_by_the_cells_around_it() -> None:
    covered = coverage(Point(center=(1.25, 2.0)), (4, 4))
    assert covered[1, 2] == pytest.approx(0.75)
    assert covered[2, 2] == pytest.approx(0.25)
    assert covered.sum() == pytest.approx(1.0)


def test_millimetres_are_cells_times_the_pitch() -> None:
    in_mm = Contact.model_validate({"disc": {"center_mm": [8.0, 12.0], "radius_mm": 5.0}, "force_n": [[0.0, 3.0]]})
    in_cells = Contact.model_validate({"disc": {"center": [2.0, 3.0], "radius_cells": 1.25}, "load_kpa": [[0.0, 1.0]]})
    skin = Geometry.rectangle((9, 7), 0.004)
    np.testing.assert_allclose(in_mm.coverage(skin), in_cells.coverage(skin))
    _, pressure = in_mm.pressure_on(np.zeros(1), skin)
    newtons = pressure.sum() * 1000.0 * 0.004**2
    assert newtons == pytest.approx(3.0)


@pytest.mark.parametrize(
    "shape",
    [{"point": {}}, {"disc": {"radius_mm": 5.0}}, {"bump": {"sigma_mm": 3.0}}, {"rectangle": {"size_mm": [9, 5]}}],
)
def test_cells_anywhere_are_pressed_as_those_of_an_array_are(shape: dict[str, Any]) -> None:
    """By a shape whose path begins and ends beyond the skin and crosses it: this was refused."""
    array = Geometry.rectangle((9, 7), 0.004)
    placed = Geometry(array.places_mm.copy(), array.areas_mm2.copy())
    path = [[0.0, -40.0, 3.0], [1.0, 70.0, 21.0]]
    contact = Contact.model_validate({**shape, "path_mm": path, "load_kpa": [[0.0, 2.0]]})
    pressed = []
    for geometry in (array, placed):
        contact.check(geometry)
        cells, pressure = contact.pressure_on(np.linspace(0.0, 1.0, 23), geometry)
        pressed.append(np.zeros((23, 63)))
        pressed[-1][:, cells] = pressure
    np.testing.assert_allclose(*pressed, atol=1e-12)
    assert pressed[0].max() > 0.5
    away = Contact.model_validate(
        {**shape, "path_mm": [[0.0, -40.0, 3.0], [1.0, -40.0, 70.0]], "load_kpa": [[0.0, 2.0]]}
    )
    for geometry in (array, placed):
        with pytest.raises(InputError, match="does not reach"):
            away.check(geometry)


def test_a_picture_presses_with_its_pixels(tmp_path: Path) -> None:
    (tmp_path / "foot.csv").write_text("1,0\n0,0.5\n")
    image = Image(file=tmp_path / "foot.csv", center=(2.0, 3.0), size_cells=(4.0, 2.0))
    expected = np.zeros((6, 6))
    # Rows 0 ... 4 of edges, columns 2 ... 4: pixels of 2 x 1 cells around the middle.
    expected[0:3, 2:5] = [[0.25, 0.25, 0], [0.5, 0.5, 0], [0.25, 0.375, 0.125]]
    expected[3:5, 2:5] = [[0, 0.25, 0.25], [0, 0.125, 0.125]]
    np.testing.assert_allclose(coverage(image, (6, 6)), expected, atol=1e-12)
    assert image.area(1.0) == pytest.approx(expected.sum())


def test_taps_and_sines_repeat_and_end() -> None:
    taps = Contact.model_validate(
        {"cells": [[0, 0]], "taps": {"load_kpa": 8.0, "every_s": 0.5, "hold_s": 0.1, "rise_s": 0.1, "count": 2}}
    )
    times = np.array([0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.45, 0.5, 0.6, 1.0, 1.1])
    np.testing.assert_allclose(taps.load(times), [0, 4, 8, 8, 8, 4, 0, 0, 0, 8, 0, 0], atol=1e-7)
    sine = Contact.model_validate(
        {"cells": [[0, 0]], "sine": {"mean_kpa": 2.0, "amplitude_kpa": 3.0, "frequency_hz": 0.25, "stop_s": 5.0}}
    )
    np.testing.assert_allclose(sine.load([0.0, 1.0, 3.0, 4.0, 5.0]), [2, 5, 0, 2, 0], atol=1e-9)


def test_a_recorded_load_is_read_from_its_file(tmp_path: Path) -> None:
    (tmp_path / "press.csv").write_text("time_s,pressure_kpa\n0,0\n1,10\n2,4\n")
    tables = {"cells": [[0, 0]], "recorded": {"file": "press.csv", "scale": 2.0}, "period": 2.0}
    what = Scene.from_tables({"skin": {"design": DESIGN}, "contact": [tables]}, source="s", directory=tmp_path)
    assert [what.pressure_kpa(t)[0, 0] for t in (0.5, 1.5, 2.5)] == pytest.approx([10, 14, 10])


def volts(**tables: Any) -> np.ndarray:
    uneven = {"design": DESIGN, "spread": {"rest_percent": 20.0}}
    return read(scene(skin=uneven, contact=[], board={"frame_rate": 10.0}, **tables), 30)["volts"]


def test_events_come_and_go() -> None:
    quiet = volts()
    window = slice(10, 20)

    def with_event(**event: Any) -> np.ndarray:
        found = volts(event=[{"at_s": 1.0, "until_s": 2.0, **event}])
        outside = np.r_[0:10, 20:30]
        np.testing.assert_allclose(found[outside], quiet[outside], rtol=1e-5)
        return found[window]

    opened = with_event(kind="open-cell", place=[1, 0])
    assert (opened[:, 1, 0] < 1e-3).all()
    np.testing.assert_allclose(opened[:, 2, 1], quiet[window, 2, 1], rtol=1e-2)
    shorted = with_event(kind="shorted-cell", place=[1, 0], resistance=100e3)
    np.testing.assert_allclose(shorted[:, 1, 0] - quiet[window, 1, 0], 20e3 / 100e3, rtol=2e-2)
    sparking = with_event(kind="sparking-cell", place=[1, 0], rate_hz=10.0)[:, 1, 0]
    assert {round(float(v), 4) for v in sparking} == {0.0, round(float(quiet[0, 1, 0]), 4)}
    assert (with_event(kind="broken-row", place=[2, 0])[:, 2] < 1e-3).all()
    bridged = with_event(kind="bridged-rows", place=[0, 1], resistance=10.0)
    apart, together = np.abs(quiet[0, 0] - quiet[0, 1]).max(), np.abs(bridged[:, 0] - bridged[:, 1]).max()
    assert together < 0.1 * apart
    sagging = with_event(kind="supply-sag", share=0.5)
    np.testing.assert_allclose(sagging, quiet[window] / 2, rtol=1e-5)


def test_spread_and_drift_change_all_cells() -> None:
    def ohms(**skin: Any) -> np.ndarray:
        what = scene(contact=[], skin={"design": DESIGN, **skin}, board={"frame_rate": 10.0})
        return read(what, 20)["resistance_ohm"]

    spread_out = ohms(spread={"rest_percent": 10.0, "seed": 4})
    assert spread_out[0].std() > 100
    np.testing.assert_array_equal(spread_out, ohms(spread={"rest_percent": 10.0, "seed": 4}))
    assert (spread_out != ohms(spread={"rest_percent": 10.0, "seed": 5})).any()
    warmed = ohms(drift={"temperature_change_c": [[0.0, 0.0], [1.0, 10.0]], "percent_per_degree": 7.0})
    np.testing.assert_allclose(warmed[[0, 5, 10, 19], 0, 0], 1e4 * 1.07 ** np.array([0, 5, 10, 10]))
    np.testing.assert_allclose(ohms(drift={"age_hours": 99.0, "percent_per_decade": -3.0}), 1e4 * 0.94, rtol=1e-12)


def test_a_truth_is_a_movie(tmp_path: Path) -> None:
    first = read(scene(board={"frame_rate": 20.0}), 80)
    np.savez(
        tmp_path / "truth.npz",
        time_s=first["time_us"] / 1e6,
        **{k: first[k] for k in ("pressure_kpa", "resistance_ohm")},
    )
    for quantity in ("pressure", "resistance"):
        tables = {
            "skin": {"design": DESIGN},
            "board": {"frame_rate": 20.0},
            "movie": {"file": "truth.npz", "quantity": quantity},
        }
        again = read(Scene.from_tables(tables, source="s", directory=tmp_path), 80)
        np.testing.assert_allclose(again["resistance_ohm"], first["resistance_ohm"], rtol=1e-9)
        np.testing.assert_allclose(again["volts"], first["volts"], rtol=1e-9)


def test_a_movie_of_resistance_may_be_a_table(tmp_path: Path) -> None:
    head = "time_s," + ",".join(f"r{row}c{column}" for row in range(3) for column in range(2))
    (tmp_path / "m.csv").write_text(f"{head}\n5,1e3,2e3,3e3,4e3,5e3,6e3\n6,3e3,2e3,inf,4e3,5e3,6e3\n")
    tables = {
        "skin": {"design": DESIGN},
        "board": {"frame_rate": 2.0},
        "movie": {"file": "m.csv", "quantity": "resistance"},
    }
    ohms = read(Scene.from_tables(tables, source="s", directory=tmp_path), 4)["resistance_ohm"]
    np.testing.assert_allclose(ohms[:, 0, 0], [1e3, 2e3, 3e3, 3e3])
    np.testing.assert_allclose(ohms[:, 1, 0], [3e3, 3e3, np.inf, np.inf])
    np.testing.assert_allclose(ohms[:, 2, 1], 6e3)


def test_a_picture_that_is_none_is_refused_in_one_line(tmp_path: Path) -> None:
    for name, content, message in (
        ("p.npy", b"nonsense", "is no picture (.npy): the file is no array"),
        ("p.png", b"nonsense", "is no .png file"),
        ("p.csv", b"0,2\n", "outside 0 ... 1"),
        ("p.csv", b"0,a\n", "is not a number"),
    ):
        (tmp_path / name).write_bytes(content)
        image = {"file": name, "center": [0, 0], "size_mm": [1, 1]}
        tables = {"skin": {"design": DESIGN}, "contact": [{"image": image, "load_kpa": [[0, 1]]}]}
        with pytest.raises(InputError, match=re.escape(message)) as caught:
            Scene.from_tables(tables, source="s", directory=tmp_path)
        assert "\n" not in str(caught.value)


# Plans of scenes, and the examples' own plans


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


# The layer above the cells: equilibrium, limits and the half-space solution integrated numerically


MIDDLES = (np.arange(6) + 0.5) / 6 - 0.5


@pytest.mark.parametrize("depth", [0.01, 0.1, 0.5, 2.0])
def test_force_is_conserved_and_symmetric(depth: float) -> None:
    share = shares(depth)
    # What is missing has gone beyond the kernel: at most what a point load puts outside a circle of 4.5 pitches.
    outside = 1 - (1 - 1 / (1 + (4.5 / depth) ** 2) ** 1.5)
    assert 1 - 1.3 * outside - 1e-3 < share.sum() <= 1 + 1e-3
    np.testing.assert_allclose(share, share.T, atol=1e-14)
    np.testing.assert_allclose(share, share[::-1], atol=1e-14)
    assert (share > 0).all()


def test_against_boussinesq_integrated_over_the_loaded_cell() -> None:
    """Stress at the middle of a cell and of its neighbour, from the point-load solution 3 z^3 / (2 pi R^5)."""
    depth = 0.7

    def below(x: float, y: float) -> float:
        return dblquad(
            lambda v, u: 3 * depth**3 / (2 * np.pi * ((x - u) ** 2 + (y - v) ** 2 + depth**2) ** 2.5),
            *(-0.5, 0.5, -0.5, 0.5),
        )[0]

    # Midpoint rule over the cell, good to 4e-3 here.
    fine = np.mean([[below(a, b) for a in MIDDLES] for b in MIDDLES])
    side = np.mean([[below(1 + a, b) for a in MIDDLES] for b in MIDDLES])
    assert shares(depth)[4, 4] == pytest.approx(fine, rel=1e-2)
    assert shares(depth)[4, 5] == pytest.approx(side, rel=1e-2)


def test_a_thin_layer_spreads_little_and_none_nothing() -> None:
    pressure = np.zeros((4, 5))
    pressure[1, 2] = 10.0
    assert spread(pressure, 0.0) is pressure
    thin, thick = spread(pressure, 0.02), spread(pressure, 0.5)
    assert thin[1, 2] > thick[1, 2]
    assert thin[1, 3] < thick[1, 3]
    np.testing.assert_allclose(thin, pressure, atol=0.5)


def test_a_cover_and_an_uncut_sheet_spread_what_presses_on_the_skin() -> None:
    def felt(design: dict[str, Any], **skin: float) -> np.ndarray:
        emulated = EmulatedSkin(scene(skin={"design": design, **skin}, board={"frame_rate": 0.5}))
        emulated.read()
        block, second = emulated.read()
        return block.resistance_ohm[second]

    uncut = {**DESIGN, "array": {**DESIGN["array"], "sheet": "continuous"}}
    pressed, beside = (1, 1), (1, 0)
    sliced, covered, continuous = felt(DESIGN), felt(DESIGN, cover_thickness=0.003), felt(uncut)
    assert sliced[beside] == 10e3
    for shared in (covered, continuous):
        assert shared[beside] > 10e3
        assert shared[pressed] < sliced[pressed]


# Loads set by hand are loads like those of a scene


CELL, KPA = (1, 1), 9.0


def _scene(*contacts: dict[str, object]) -> Scene:
    return scene(board={"frame_rate": 100.0, "noise": 1e-4}, contact=list(contacts))


def _pressed_at_tick(board: Board, hand: Hand, tick: int, pressure: np.ndarray) -> list[list[bytes]]:
    """Packets of 60 ticks; another thread presses just before ``tick``."""
    packets = [board.tick() for _ in range(tick)]
    since: list[float] = []
    presser = threading.Thread(target=lambda: since.append(hand.press(pressure)))
    presser.start()
    while not hand.wanted:
        time.sleep(0.001)
    packets.append(board.tick())
    presser.join()
    assert since == [tick / 100.0]
    return packets + [board.tick() for _ in range(59 - tick)]


@pytest.mark.parametrize("tick", [0, 17])
def test_the_hand_presses_as_a_contact_does(tick: int) -> None:
    """Bit for bit, though the frames after the press had been computed without it."""
    shape = _scene().skin.design.array.shape
    pressure = np.zeros(shape)
    pressure[CELL] = KPA
    at = tick / 100.0
    load = [[0.0, KPA]] if tick == 0 else [[0.0, 0.0], [at - 0.005, 0.0], [at - 0.005, KPA]]
    contact = {"cells": [list(CELL)], "load_kpa": load}
    hand = Hand(shape)
    by_hand = _pressed_at_tick(Board(_scene(), hand=hand), hand, tick, pressure)
    written = Board(_scene(contact))
    assert by_hand == [written.tick() for _ in range(60)]


def test_a_released_skin_recovers() -> None:
    hand = Hand(_scene().skin.design.array.shape)
    samples: list[float] = []
    board = Board(_scene(), hand=hand, record=lambda sample: samples.append(sample.pressure_kpa[CELL]))
    pressure = np.zeros(hand.shape)
    pressure[CELL] = KPA
    for load in (pressure, 0.0):
        presser = threading.Thread(target=hand.press, args=(load,))
        presser.start()
        while presser.is_alive():
            board.tick()
    pressed = samples.index(KPA)
    released = samples.index(0.0, pressed)
    assert set(samples[pressed:released]) == {KPA}
    assert set(samples[released:]) == {0.0}


def test_a_load_that_makes_no_sense_is_refused() -> None:
    hand = Hand((4, 4))
    for load in (-1.0, np.nan, np.inf, np.zeros((3, 3))):
        with pytest.raises(InputError, match="pressure_kpa"):
            hand.press(load)
    with pytest.raises(LinkTimeout, match="no board took the load"):
        hand.press(1.0, timeout_s=0.01)
