"""The plugin of pytest, as the example suite uses it: in a folder and a process of its own."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import threading
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import Design, Requirement
from ohmskin.cli import run
from ohmskin.emulator import BoardSettings, PtyPort, Scene, SkinSettings, Stop, emulate
from ohmskin.errors import InputError
from ohmskin.hil import BoardInService, Press, TargetMissing, serve, write_suite
from ohmskin.verification import Report, prototype, verify


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


# Requirements measured on a board behind a port: a sound board passes, a board with a known fault fails


DESIGN = prototype().replace(adc={"range": (-0.2, 3.1)})
ASKED = [
    Requirement(id="R1", quantity="reading_error", max=5.0),
    Requirement(id="R2", quantity="noise", max=1e-3),
    Requirement(id="R3", quantity="lost_readings", max=0.0),
    Requirement(id="R4", quantity="lost_frames", max=0.0),
    Requirement(id="R5", quantity="adc_headroom", min=0.0),
]


@contextmanager
def _board(design: Design, noise: float = 1e-4) -> Iterator[str]:
    scene = Scene(skin=SkinSettings(design=design), board=BoardSettings(frame_rate=500.0, noise=noise))
    stop = Stop()
    with PtyPort() as port:
        thread = threading.Thread(target=emulate, args=(scene, port), kwargs={"stop": stop})
        thread.start()
        try:
            yield port.name
        finally:
            stop.set()
            thread.join()
            stop.close()


def _rest(design: Design) -> np.ndarray:
    return np.full(design.array.shape, SkinSettings(design=design).cell.rest_resistance_ohm)


def _measured(board: Design, noise: float = 1e-4) -> Report:
    with _board(board, noise) as port:
        only = [f"{requirement.id}-board" for requirement in ASKED]
        return verify(DESIGN, requirements=ASKED, target=port, jig=_rest(DESIGN), only=only)


def _outcomes(report: Report) -> dict[str, str]:
    return {result.requirement.id: str(result.outcome) for result in report.results}


def test_a_sound_board_passes_with_the_same_limits_and_its_simulation_beside_it() -> None:
    report = _measured(DESIGN)
    assert _outcomes(report) == dict.fromkeys(("R1-board", "R2-board", "R3-board", "R4-board", "R5-board"), "pass")
    by_id = {result.requirement.id: result for result in report.results}
    for requirement in ASKED:
        twin = by_id[f"{requirement.id}-board"]
        assert (twin.requirement.min, twin.requirement.max) == (requirement.min, requirement.max)
        assert twin.measurement is not None
        assert "frames of the board at" in twin.measurement.confidence
    error, noise = (by_id[id].measurement for id in ("R1-board", "R2-board"))
    assert error is not None
    assert "Simulated with nominal parts:" in error.text[0]
    assert noise is not None
    assert noise.value > 5e-5
    assert noise.text[0].startswith("Simulated: ")
    headroom = by_id["R5-board"].measurement
    assert headroom is not None
    assert DESIGN.adc is not None
    volts, rest, step = reference_volts(DESIGN, _rest(DESIGN)), _rest(DESIGN), DESIGN.adc.step
    ends = volts.min() - (DESIGN.adc.range[0] + step), DESIGN.adc.range[1] - step - volts.max()
    assert headroom.value == pytest.approx(min(ends), abs=2 * step)
    read = DESIGN.readout.reference_resistance / (volts / DESIGN.drive.voltage)
    assert error.value == pytest.approx(100 * np.abs(np.abs(read) / rest - 1.0).max(), abs=100 * 2 * step / volts.min())


@pytest.mark.parametrize(
    ("fault", "failing"),
    [
        ({"kind": "shorted-cell", "place": [1, 2], "resistance": 500.0}, {"R1-board", "R3-board", "R5-board"}),
        ({"kind": "open-cell", "place": [0, 0]}, {"R1-board"}),
        ({"kind": "broken-row", "place": [3, 0], "resistance": 2000.0}, {"R1-board"}),
    ],
)
def test_a_board_with_a_fault_fails(fault: dict[str, object], failing: set[str]) -> None:
    outcomes = _outcomes(_measured(DESIGN.replace(fault=(fault,))))
    assert failing <= {id for id, outcome in outcomes.items() if outcome == "fail"}, outcomes
    assert outcomes["R4-board"] == "pass"  # its link is sound


def test_a_noisy_board_fails() -> None:
    report = _measured(DESIGN, noise=5e-3)
    assert _outcomes(report)["R2-board"] == "fail"
    noise = next(result.measurement for result in report.results if result.requirement.id == "R2-board")
    assert noise is not None
    assert DESIGN.adc is not None
    expected = np.hypot(5e-3, DESIGN.adc.step / np.sqrt(12.0))  # in the worst of 16 cells
    assert expected < noise.value < expected + 6 * noise.resolution


@pytest.mark.usefixtures("quick_verification")
def test_a_jig_is_taken_without_a_design_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savetxt(tmp_path / "cells.csv", _rest(prototype()), delimiter=",")
    asked = '[[requirement]]\nid = "R1"\nquantity = "reading_error"\nmax = 5.0\n'
    (tmp_path / "asked.toml").write_text(asked)
    arguments = ["verify", "--requirements", str(tmp_path / "asked.toml"), "-o", str(tmp_path / "out")]
    arguments += ["--only", "R1-board", "--jig", str(tmp_path / "cells.csv")]
    with _board(prototype()) as port:
        assert run([*arguments, "--target", port]) == 0
    (row,) = json.loads((tmp_path / "out" / "report.json").read_text())["requirements"]
    assert row["outcome"] == "pass"
    assert run(arguments) == 2
    assert "--jig: there is no board to carry it" in capsys.readouterr().err
