"""Calibration per cell: what is recovered, what is refused, and that the driver applies it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from boards import DESIGN, EXAMPLES, Wire, scene
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.calibration import Plan, Press, PressRefused, Progress, Watch, align, calibrate_cells
from ohmskin.cell import Cell
from ohmskin.cli import run
from ohmskin.common.arrays import FloatArray
from ohmskin.common.config import fingerprint, write_toml
from ohmskin.common.tables import write_columns
from ohmskin.driver import Calibration, Skin
from ohmskin.emulator import Board, Scene
from ohmskin.errors import InputError

CELL = Cell.example()
SHAPE = (2, 3)
STEP_S = 0.1
HOLD_S, REST_S = 3.0, 2.0
RESTS = np.array([[9e3, 1e4, 1.1e4], [1.2e4, 8.8e3, 1e4]])
GAINS = np.array([[0.7, 1.0, 1.3], [1.6, 0.9, 1.1]])

Bend = Callable[[FloatArray, FloatArray], FloatArray]
"""changes the resistances (frames, rows, columns), given the times (frames,)"""


def history(loads: Sequence[float] = (5.0, 12.0), *, together: bool = False) -> tuple[FloatArray, FloatArray]:
    """Times (frames,) and true pressures (frames, rows, columns) of a person who follows a plan."""
    corners: list[tuple[float, float]] = []
    presses: list[list[tuple[float, float]]] = []
    at = 3.0
    for load in loads:
        for _ in range(1 if together else RESTS.size):
            corners = [(at, 0.0), (at + 0.3, load), (at + 4.3, load), (at + 4.5, 0.0)]
            presses.append(corners)
            at += 7.0
    time_s = np.arange(0.0, at, STEP_S)
    kpa = np.zeros((len(time_s), RESTS.size))
    for number, corners in enumerate(presses):
        felt = np.interp(time_s, *np.transpose(corners))
        kpa[:, slice(None) if together else [number % RESTS.size]] += felt[:, None]
    return time_s, kpa.reshape(-1, *SHAPE)


def resistances(time_s: FloatArray, kpa: FloatArray, gains: FloatArray = GAINS, cell: Cell = CELL) -> FloatArray:
    """(frames, rows, columns) ohm of cells that feel pressure / gain."""
    forward = cell.forward(SHAPE, rest_resistance_ohm=RESTS)
    return np.asarray(forward.run(np.diff(time_s, prepend=time_s[0]), kpa / gains))


def watched(time_s: FloatArray, ohm: FloatArray, plan: Plan, cell: Cell = CELL) -> Watch:
    watch = Watch(cell, plan, hold_s=HOLD_S, rest_s=REST_S)
    for time, frame in zip(time_s.tolist(), ohm, strict=True):
        watch.feed(time, frame)
    return watch


def plan_of(loads: Sequence[float] = (5.0, 12.0), press: str = "each") -> Plan:
    return Plan.make(SHAPE, press, loads)


@cache
def well_calibrated() -> Watch:
    """A calibration without fault; do not change it."""
    time_s, kpa = history()
    return watched(time_s, resistances(time_s, kpa), plan_of())


# --- what is recovered ------------------------------------------------------------------------------------------------


def test_ideal_cells_give_back_their_gains() -> None:
    watch = well_calibrated()
    assert watch.done
    assert watch.rest is not None
    verdict = calibrate_cells(CELL, watch.rest, watch.presses)
    assert not verdict.reasons
    # Sampling leaves a few ms of doubt about when a press began, which creep turns into a few parts in ten thousand.
    np.testing.assert_allclose(verdict.fit.gain, GAINS, rtol=2e-3)
    np.testing.assert_allclose(verdict.fit.rest_ohm, RESTS, rtol=2e-4)


@settings(max_examples=5, deadline=None)
@given(st.lists(st.floats(0.4, 2.5), min_size=6, max_size=6))
def test_any_believable_gains_are_recovered(gains: list[float]) -> None:
    true = np.reshape(gains, SHAPE)
    time_s, kpa = history(together=True)
    watch = watched(time_s, resistances(time_s, kpa, true), plan_of(press="all"))
    assert watch.rest is not None
    # Beyond full scale the estimate, which tells when a press began, waits for 0.1 s (docs/estimator.md, sparks).
    np.testing.assert_allclose(calibrate_cells(CELL, watch.rest, watch.presses).fit.gain, true, rtol=1e-2)


# --- what is refused --------------------------------------------------------------------------------------------------


def at(place: tuple[int, int], factor: float) -> FloatArray:
    """1 for every cell but one."""
    factors = np.ones(SHAPE)
    factors[place] = factor
    return factors


@pytest.mark.parametrize(
    ("bend", "message"),
    [
        (lambda time_s, ohm: ohm * at((0, 1), 2.5), r"seems to be loaded: cell \(0, 1\) has 2\.4 times"),
        (lambda time_s, ohm: 5.0 * ohm, r"seems to be loaded: the typical resistance is .* times that of the cell's"),
        (
            lambda time_s, ohm: ohm * (1 + 0.1 * np.exp(-time_s / 1.0))[:, None, None],
            "not at rest: the resistance of 6 cells is changing",
        ),
        (
            lambda time_s, ohm: ohm * (1 + 0.1 * (time_s > 40.0))[:, None, None],
            "with a drifting rest resistance",
        ),
        (lambda time_s, ohm: np.where(ohm > at((0, 0), 1.35e-2) * 1e6, np.nan, ohm), "without a valid reading under"),
        (lambda time_s, ohm: np.where(at((1, 2), 0.0) > 0, ohm, RESTS), r"never pressed: \(1, 2\)"),
    ],
)
def test_readings_that_tell_no_calibration_are_refused(bend: Bend, message: str) -> None:
    time_s, kpa = history()
    ohm = bend(time_s, resistances(time_s, kpa))
    with pytest.raises(InputError, match=message):
        calibration_of(time_s, ohm)


def calibration_of(time_s: FloatArray, ohm: FloatArray) -> Calibration:
    watch = watched(time_s, ohm, plan_of())
    assert watch.rest is not None
    return calibrate_cells(CELL, watch.rest, watch.presses).calibration(scene().skin.design, CELL, "")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda number, press: replace(press, fault="left out" if number > 5 else ""),
            "6 cells pressed too seldom: (0, 0)",
        ),
        (lambda number, press: replace(press, std_ohm=np.full(1, 5e4)), "noisier than a load shows"),
        (lambda number, press: replace(press, load_kpa=10 * press.load_kpa), "gain that is not believed"),
        (
            lambda number, press: replace(press, load_kpa=press.load_kpa * (2.4 if press.held_kpa < 10 else 1 / 2.4)),
            "changing less under a larger load: (0, 0), (0, 1), (0, 2), (1, 0), ...",
        ),
        (
            lambda number, press: press if number else replace(press, load_kpa=1.5 * press.load_kpa),
            "1 cell with presses that contradict each other: (0, 0)",
        ),
    ],
)
def test_presses_that_tell_no_gain_are_refused(change: Callable[[int, Press], Press], said: str) -> None:
    watch = well_calibrated()
    assert watch.rest is not None
    presses = [change(number, press) for number, press in enumerate(watch.presses)]
    assert said in calibrate_cells(CELL, watch.rest, presses).text()


def test_two_cells_at_once_are_refused_and_can_be_pressed_again() -> None:
    time_s, kpa = history()
    kpa[:, 0, 1] += kpa[:, 0, 0] * (time_s < 10.0)
    watch = watched(time_s, resistances(time_s, kpa), plan_of())
    assert re.match(r"cell \(0, .\) beside cell \(0, .\) was pressed, too", watch.presses[0].fault)
    assert not watch.done


def test_a_load_that_is_not_held_is_refused() -> None:
    time_s, kpa = history()
    kpa[(time_s > 5.0) & (time_s < 20.0)] = 0.0
    watch = Watch(CELL, plan_of(), hold_s=HOLD_S, rest_s=REST_S)
    events = [
        event
        for time, frame in zip(time_s.tolist(), resistances(time_s, kpa), strict=True)
        for event in watch.feed(time, frame)
    ]
    refused = [event for event in events if isinstance(event, PressRefused)]
    assert "was held for 1." in refused[0].press.fault


# --- the file ---------------------------------------------------------------------------------------------------------


def made(shape: tuple[int, int] = (3, 2), **changes: object) -> Calibration:
    where = scene().skin
    values: dict[str, object] = {
        "rest_ohm": np.linspace(9e3, 1.1e4, 6).reshape(shape),
        "gain": np.linspace(0.8, 1.3, 6).reshape(shape),
        "gain_std": np.full(shape, 0.02),
        "rest_std_kpa": np.full(shape, 0.05),
        "residual_kpa": np.full(shape, 0.1),
        "calibrated": np.ones(shape, dtype=np.bool_),
        "loads_kpa": (5.0, 12.0),
        "presses": 12,
        "serial_number": "EMULATED",
        "design_hash": fingerprint(where.design),
        "cell_hash": fingerprint(where.cell),
        "date": "2026-01-02T03:04:05+00:00",
        **changes,
    }
    return Calibration(**values)  # type: ignore[arg-type]


def test_a_file_reads_back_bit_for_bit(tmp_path: Path) -> None:
    path = tmp_path / "left.toml"
    one = made(gain=np.random.default_rng(1).uniform(0.5, 2, (3, 2)), remarks=("one", "two"))
    one.save(path)
    two = Calibration.load(path)
    assert two.hash == one.hash
    for name in ("rest_ohm", "gain", "gain_std", "rest_std_kpa", "residual_kpa", "calibrated"):
        np.testing.assert_array_equal(getattr(two, name), getattr(one, name))
    assert Calibration.from_toml(one.as_toml(), "recording").hash == one.hash


def test_an_edited_file_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "left.toml"
    made().save(path)
    path.write_text(path.read_text().replace("0.8", "0.9", 1))
    with pytest.raises(InputError, match=r"left\.toml: has been edited") as caught:
        Calibration.load(path)
    assert "\n" not in str(caught.value)
    path.write_text(path.read_text().replace("[0.02, 0.02]", "[0.02]", 1))
    with pytest.raises(InputError, match="is no array of 3 lines with 2 values each"):
        Calibration.load(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"serial_number": "OTHER"}, "a calibration of board OTHER; this is board EMULATED"),
        ({"design_hash": "0" * 64}, "another design of the readout"),
        ({"cell_hash": "0" * 64}, "other data of the cell"),
    ],
)
def test_a_calibration_of_another_board_is_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Skin(Wire(Board(scene())), delivery="lossless", calibration=made(**changes))
    wrong = made(**{name: np.ones((2, 2)) for name in ("rest_ohm", "gain")})
    with pytest.raises(InputError, match="2 x 2 cells; this skin has 3 x 2"):
        Skin(Wire(Board(scene())), delivery="lossless", calibration=wrong)


# --- in the driver ----------------------------------------------------------------------------------------------------


def test_pressures_are_those_of_the_common_cell_times_the_gain() -> None:
    """Taken one by one or together; their deviation has that of the gain and of the rest, too."""
    rest = np.linspace(0.1, 0.6, 6).reshape(3, 2)
    gained = made(rest_std_kpa=rest)
    plain = replace(gained, gain=np.ones((3, 2)), gain_std=np.zeros((3, 2)))
    with Skin(Wire(Board(scene())), delivery="lossless", calibration=plain) as skin:
        expected = list(islice(skin, 100))
    with Skin(Wire(Board(scene())), delivery="lossless", queue=100, calibration=gained) as skin:
        frames = [skin.read() for _ in range(20)]
        while len(frames) < 100:
            frames += skin.read_many(100 - len(frames))
    for frame, other in zip(frames, expected, strict=True):
        np.testing.assert_allclose(frame.pressure, gained.gain * other.pressure, rtol=1e-12)
        read = gained.gain**2 * (other.pressure_std**2 - rest**2) + (gained.gain_std * frame.pressure) ** 2
        np.testing.assert_allclose(frame.pressure_std, np.sqrt(read + rest**2), rtol=1e-9)


def test_a_tare_replaces_the_rest_and_keeps_the_gain() -> None:
    # Cells that differ by 40 % are tared as soon as a calibration says that they do.
    spread = {"design": scene().skin.design.model_dump(), "spread": {"rest_percent": 40.0, "seed": 3}}
    still = scene(skin=spread, contact=[])
    rest = still.skin.cell.rest_resistance_ohm * still.skin.spread.draw((3, 2))[0]
    known = made(rest_ohm=rest, cell_hash=fingerprint(still.skin.cell))
    with Skin(Wire(Board(still)), delivery="lossless") as skin, pytest.raises(InputError, match="differ"):
        skin.tare(5)
    with Skin(Wire(Board(still)), delivery="lossless", calibration=known) as skin:
        tare = skin.tare(5)
        np.testing.assert_allclose(tare.rest_resistance_ohm, rest, rtol=0.02)
        assert skin.undo_tare() is None
        frame = next(skin)
        assert frame.valid.any()
        assert frame.pressure[frame.valid].max() < 0.5


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_calibrates_the_example(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "skin.toml"
    port = f"ohmskin://{EXAMPLES / 'calibration.toml'}?clock=fast"
    words = ["calibrate", port, "--load", "5", "--load", "12", "--yes", "--json", "-o", str(output)]
    assert run(words) == 0
    summary = json.loads(capsys.readouterr().out)
    made = Calibration.load(output)
    assert summary["hash"] == made.hash
    where = Scene.load(EXAMPLES / "calibration.toml").skin
    rest, sensitivity = where.spread.draw((4, 4))
    np.testing.assert_allclose(made.gain, 1 / sensitivity, rtol=5e-3)
    np.testing.assert_allclose(made.rest_ohm, where.cell.rest_resistance_ohm * rest, rtol=5e-3)
    assert not output.with_name("skin.toml.progress").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--load", "-5"], "a calibration needs loads above 0 kPa"),
        (["--mass", "-1", "--area", "1e-4"], "a calibration needs loads above 0 kPa"),
        (["--load", "5", "--mass", "1"], "--mass"),
        (["--mass", "1"], "--area"),
        ([], "--load"),
        (["--load", "5", "--press", "some"], "press 'some'; expected each, all, or a patch"),
        (["--load", "5"] * 101, "101 loads; expected at most 100"),
        (["--load", "12000", "--yes"], "at most 4 times the full scale of the cells, 15.5 kPa: is it in Pa"),
        (["--mass", "200", "--area", "1e-4", "--yes"], "is it in Pa, the weight in g"),
    ],
)
def test_words_that_do_not_fit_are_refused_before_anybody_presses(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In another unit a press would begin at a load that never comes."""
    port = f"ohmskin://{EXAMPLES / 'calibration.toml'}?clock=fast&duration=10"
    assert run(["calibrate", port, "-o", str(tmp_path / "a.toml"), *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert list(tmp_path.iterdir()) == []


def test_one_load_alone_is_pressed_twice() -> None:
    assert Plan.make((2, 3), "each", [5.0]).loads_kpa == (5.0, 5.0)
    assert Plan.make((2, 3), "all", [5.0, 12.0]).loads_kpa == (5.0, 12.0)


# --- interrupted, from a recording, with a reference sensor -----------------------------------------------------------


def test_a_resumed_calibration_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    time_s, kpa = history()
    ohm = resistances(time_s, kpa)
    whole, first, plan = well_calibrated(), Watch(CELL, plan_of(), hold_s=HOLD_S, rest_s=REST_S), plan_of()
    frames = list(zip(time_s.tolist(), ohm, strict=True))
    cut = next(number for number, (at, _) in enumerate(frames) if at > 36.0)  # between two presses
    for at, frame in frames[:cut]:
        first.feed(at, frame)
    assert first.rest is not None
    path = tmp_path / "skin.toml.progress"
    Progress({"hold_s": HOLD_S}, first.rest, tuple(first.presses), ()).save(path)
    saved = Progress.load(path, {"hold_s": HOLD_S}, plan)
    second = Watch(CELL, plan, hold_s=HOLD_S, rest_s=REST_S, rest=saved.rest, presses=saved.presses)
    for at, frame in frames[cut:]:
        second.feed(at, frame)
    assert second.done
    assert whole.rest is not None
    one = calibrate_cells(CELL, whole.rest, whole.presses).fit
    two = calibrate_cells(CELL, saved.rest, second.presses).fit
    # The spans of a press follow from loads, which an estimator that has seen no press before tells otherwise.
    np.testing.assert_allclose(two.gain, one.gain, rtol=2e-3)
    np.testing.assert_allclose(two.rest_ohm, one.rest_ohm, rtol=2e-3)
    with pytest.raises(
        InputError, match=r"is the progress of another calibration: its hold_s is 3\.0, this one's 4\.0"
    ):
        Progress.load(path, {"hold_s": 4.0}, plan)


def plate_scene(folder: Path, later_s: float = 0.0) -> Path:
    """A file of a scene: 3 x 2 cells under a plate that presses twice."""
    tables = {
        "skin": {"design": DESIGN, "spread": {"rest_percent": 5.0, "sensitivity_percent": 15.0, "seed": 2}},
        "board": {"frame_rate": 20.0, "noise": 2e-4},
        "contact": [
            {
                "cells": [[row, column] for row in range(3) for column in range(2)],
                "load_kpa": [[0.0, 0.0], *([later_s + at, load] for at, load in PLATE)],
            }
        ],
    }
    path = folder / "plate.toml"
    write_toml(path, tables)
    return path


PLATE = [(4.0, 0.0), (4.3, 4.8), (8.3, 4.8), (8.5, 0.0), (13.0, 0.0), (13.3, 12.4), (17.3, 12.4), (17.5, 0.0)]


def test_a_stream_that_ends_keeps_what_was_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port, output = f"ohmskin://{plate_scene(tmp_path)}?clock=fast&duration=", tmp_path / "skin.toml"
    words = ["--press", "all", "--load", "4.8", "--load", "12.4", "--hold", "3", "--yes", "-o", str(output)]
    assert run(["calibrate", port + "11", *words]) == 2
    shown = capsys.readouterr().err
    assert "frames ended before all cells had borne 12.4 kPa; what was measured is kept, go on with --resume" in shown
    assert not output.exists()
    assert run(["calibrate", port + "30", *words, "--resume", "--hold", "2"]) == 2
    assert "its hold_s is 3.0, this one's 2.0" in capsys.readouterr().err
    # The emulated board starts anew, at rest: as if the skin had had a minute to recover.
    plate_scene(tmp_path, later_s=60.0)
    assert run(["calibrate", port + "90", *words, "--resume"]) == 0
    assert "Going on after 1 press." in capsys.readouterr().err
    made = Calibration.load(output)
    sensitivity = Scene.load(tmp_path / "plate.toml").skin.spread.draw((3, 2))[1]
    np.testing.assert_allclose(made.gain, 1 / sensitivity, rtol=0.02)


def test_a_reference_sensor_gives_the_loads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording, sensor, output = tmp_path / "plate.mcap", tmp_path / "sensor.csv", tmp_path / "skin.toml"
    described = Scene.load(plate_scene(tmp_path))
    with Skin(Wire(Board(described)), delivery="lossless", record=recording) as skin:
        list(islice(skin, 20 * 22))
    # Its clock began 1000 s earlier and is slow by 500 ppm; it reads 0.3 kPa too much all the time.
    at_s = np.arange(0.0, 22.0, 0.01)
    times, loads = np.transpose(PLATE)
    kpa = np.interp(at_s, times, loads) + 0.3 + 0.02 * np.random.default_rng(1).standard_normal(len(at_s))
    write_columns(sensor, {"time_s": 1000.0 + at_s * (1 - 500e-6), "pressure_kpa": kpa})
    words = ["calibrate", str(recording), "--press", "all", "--load", "5", "--load", "12", "--hold", "3"]
    assert run([*words, "--reference", str(sensor), "-o", str(output)]) == 0
    assert "sensor.csv: the reference's clock is" in capsys.readouterr().err
    made = Calibration.load(output)
    np.testing.assert_allclose(made.loads_kpa, (4.8, 12.4), rtol=5e-3)
    np.testing.assert_allclose(made.gain, 1 / described.skin.spread.draw((3, 2))[1], rtol=0.02)
    write_columns(sensor, {"time_s": at_s, "pressure_kpa": np.random.default_rng(2).uniform(0, 9, len(at_s))})
    assert run([*words, "--reference", str(sensor), "-o", str(output)]) == 2
    assert "does not show the presses that the skin felt" in capsys.readouterr().err


@pytest.mark.parametrize("drift_ppm", [-300.0, 0.0])
def test_two_clocks_are_told_apart(drift_ppm: float) -> None:
    skin_s = np.arange(0.0, 600.0, 0.05)
    rng = np.random.default_rng(4)
    starts = np.cumsum(rng.uniform(5.0, 9.0, 70))
    felt = sum(np.interp(skin_s, [s, s + 0.3, s + 3.0, s + 3.2], [0, 5, 5, 0]) for s in starts)
    reference_s = (skin_s - 42.0) * (1 - 1e-6 * drift_ppm)
    found = align(skin_s, np.asarray(felt), reference_s, np.asarray(felt))
    assert found.drift_ppm == pytest.approx(drift_ppm, abs=10.0)
    np.testing.assert_allclose(found.skin_time_s(reference_s), skin_s, atol=0.01)


def test_pressures_after_a_calibration_are_within_their_deviations() -> None:
    """Presses that no calibration has seen, on cells that differ, with noise in R."""
    rng = np.random.default_rng(5)
    time_s, kpa = history()
    noisy = resistances(time_s, kpa) * (1 + 0.002 * rng.standard_normal(kpa.shape))
    made = calibration_of(time_s, noisy)
    later_s = np.arange(0.0, 60.0, STEP_S)
    swinging = 5 * np.maximum(np.sin(0.7 * later_s[:, None, None] + np.arange(6).reshape(SHAPE)), 0.0)
    later = resistances(later_s, swinging) * (1 + 0.002 * rng.standard_normal(swinging.shape))
    calibrated_cells = CELL.estimator(SHAPE, rest_resistance_ohm=made.rest_ohm)
    plain_cells = CELL.estimator(SHAPE, rest_resistance_ohm=RESTS)
    errors, deviations, plain = [], [], []
    for frame, true in zip(later, swinging, strict=True):
        common = calibrated_cells.step(STEP_S, frame)
        pressure, std = made.applied(common), made.applied_std(common, calibrated_cells.std_kpa)
        errors.append(pressure - true)
        deviations.append(std)
        plain.append(plain_cells.step(STEP_S, frame) - true)
    error, std = np.array(errors), np.array(deviations)
    assert np.mean(np.abs(error) <= 2 * std) > 0.9
    assert np.sqrt(np.mean(error**2)) < 0.3 * np.sqrt(np.mean(np.array(plain) ** 2))
