"""The plugin of pytest, as the example suite uses it: in a folder and a process of its own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from ohmskin.cli import run
from ohmskin.errors import InputError
from ohmskin.hil import BoardInService, Press, TargetMissing, serve, write_suite


@pytest.fixture
def suite(tmp_path: Path) -> Path:
    assert run(["new-tests", str(tmp_path / "suite")]) == 0
    return tmp_path / "suite"


def _pytest(folder: Path, *arguments: str, exit_code: int = 0, **environment: str) -> str:
    """Standard output of a pytest run in ``folder``, in the order of its file: faults of a scene are in some frames."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "ohmskin.hil.plugin"]
    command += ["-p", "no:cacheprovider", "-p", "no:randomly", *arguments]
    clean = {key: value for key, value in os.environ.items() if not key.startswith(("OHMSKIN", "PYTEST"))}
    done = subprocess.run(command, cwd=folder, env=clean | environment, capture_output=True, text=True, check=False)
    assert done.returncode == exit_code, done.stdout + done.stderr
    return done.stdout


def test_the_example_suite_passes_at_once_and_says_what_was_not_run(suite: Path) -> None:
    shown = _pytest(suite, "--junit-xml", "report.xml", "--ohmskin-seed", "7", OHMSKIN_REVISION="abc")
    assert "5 passed, 1 skipped" in shown
    assert "NOT RUN test_skin.py::test_the_real_board_says_who_it_is: needs a real board" in shown
    report = ET.parse(suite / "report.xml").getroot()
    head = {item.get("name"): item.get("value") for item in report.findall("./testsuite/properties/property")}
    expected = {
        "ohmskin.target": "emulated",
        "ohmskin.board": "ohmskin",
        "ohmskin.seed": "7",
        "ohmskin.revision": "abc",
    }
    assert head == expected
    for case in report.iter("testcase"):
        said = {item.get("name"): item.get("value") for item in case.findall("./properties/property")}
        if case.find("skipped") is None:
            assert said.items() > expected.items()
            assert said["ohmskin.serial_number"] == "EMULATED"
            assert said["ohmskin.firmware"]
            assert len(said["ohmskin.calibration"] or "") == 16


@pytest.mark.slow
def test_a_strict_run_fails_without_hardware(suite: Path) -> None:
    one = "test_skin.py::test_every_cell_is_measured_at_rest"
    shown = _pytest(suite, one, "--ohmskin-strict", exit_code=1)
    assert "1 passed" in shown
    assert "no test ran on real hardware" in shown


def test_a_board_that_is_named_and_not_there_is_an_error(suite: Path) -> None:
    shown = _pytest(suite, "--ohmskin-target", "/dev/no-such-port", exit_code=1)
    assert "6 errors" in shown
    assert "the board under test is not there: /dev/no-such-port: no such port" in shown


def test_a_failure_names_cells_reasons_and_values_and_every_lost_frame(suite: Path) -> None:
    """A line that loses bytes, and a cell that is open and one that is shorted: each is found, and said."""
    (suite / "scene.toml").write_text(
        (suite / "scene.toml").read_text()
        + """
[[link_fault]]
kind = "dropped-bytes"
probability = 1e-3        # in frames of 55 bytes: 5 % of them
[[event]]
at_s = 0.0
kind = "open-cell"
place = [2, 1]
[[event]]
at_s = 0.0
kind = "shorted-cell"
place = [0, 3]
"""
    )
    shown = _pytest(suite, "-k", "gap or measured", exit_code=1)
    assert "2 failed" in shown
    assert re.search(r"frames lost before these of 200: \{\d+: 1", shown)
    assert re.search(r"cell \(0, 3\): saturated, \d+ counts, nan ohm", shown)
    assert re.search(r"cell \(2, 1\): no current, \d+ counts, nan ohm", shown)


@pytest.mark.slow
def test_a_port_is_hardware_and_loads_need_a_person(suite: Path) -> None:
    """The emulator behind a pty stands in for the real board."""
    with serve("emulated") as board:
        target = ["--ohmskin-target", board.port, "--ohmskin-strict"]
        assert "4 passed, 2 deselected" in _pytest(suite, *target, "-m", "not ohmskin_loads")
        shown = _pytest(suite, *target, "-m", "ohmskin_loads", exit_code=1)
    assert shown.count("not run: nobody is there to press") >= 2


@pytest.mark.slow
def test_a_bad_option_is_refused(suite: Path) -> None:
    _pytest(suite, "--ohmskin-seed=-1", exit_code=4)


@pytest.mark.slow
def test_a_scene_of_ones_own_is_emulated(suite: Path) -> None:
    scene = (suite / "scene.toml").read_text().replace("rows = 4", "rows = 5")
    (suite / "other.toml").write_text(scene)
    (suite / "test_skin.py").write_text("def test_shape(skin): assert skin.design.array.shape == (5, 4)\n")
    assert "1 passed" in _pytest(suite, "--ohmskin-scene", "other.toml")


def test_a_suite_overwrites_nothing(suite: Path) -> None:
    (suite / "test_skin.py").write_text("mine")
    with pytest.raises(InputError, match="is there already"):
        write_suite(suite)
    assert (suite / "test_skin.py").read_text() == "mine"


def test_a_person_is_asked_what_to_press() -> None:
    asked: list[str] = []
    real = BoardInService("/dev/ttyACM0", "/dev/ttyACM0", "ohmskin", None)
    with Press(real, (4, 4), asked.append)(7.5, cells=[(0, 1)]) as load:
        assert load.pressure_kpa[0, 1] == 7.5
        assert load.pressure_kpa.sum() == 7.5
        assert asked == ["Press with 7.5 kPa on each of the cells (row, column) [(0, 1)], and hold"]
    assert asked[1:] == ["Take everything off the skin"]
    with pytest.raises(TargetMissing, match="nobody is there"), Press(real, (4, 4), None)(1.0, cells=[(0, 0)]):
        pass
