"""The report: what passes, what fails, and what was not run can never be confused."""

from __future__ import annotations

import json
import math
import sys
import threading
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from designs import divider

from ohmskin.cell import Cell
from ohmskin.circuits import Design
from ohmskin.circuits.spice import _ngspice as spice
from ohmskin.cli import run
from ohmskin.emulator import PtyPort, Scene, Stop, emulate
from ohmskin.emulator._scene import BoardSettings, SkinSettings
from ohmskin.errors import MissingExtra
from ohmskin.verification import prototype, verify
from ohmskin.verification._claims import APPENDICES, STATEMENTS
from ohmskin.verification._material import recovery_times
from ohmskin.verification._outcome import Check, Finding, Outcome, not_run, worst
from ohmskin.verification._subject import Subject
from ohmskin.verification._variants import change, replaced, worst_reading_error


@pytest.mark.parametrize(
    ("measured", "at_least", "outcome"),
    [
        (0.5, False, "pass"),
        (1.0, False, "pass"),
        (1.5, False, "fail"),
        (0.5, True, "fail"),
        (1.5, True, "pass"),
        (math.nan, False, "fail"),
        (math.nan, True, "fail"),
        (math.inf, True, "fail"),
        (-math.inf, False, "fail"),
        (None, False, "not run"),
    ],
)
def test_a_check_passes_only_on_a_finite_number_within_its_limit(
    measured: float | None, at_least: bool, outcome: str
) -> None:
    assert Check("x", measured, 1.0, at_least=at_least).outcome == outcome


def test_a_check_that_cannot_fail_is_refused() -> None:
    with pytest.raises(ValueError, match="could not fail"):
        Check("x", 1.0, math.inf)


def test_nothing_checked_is_not_a_pass() -> None:
    assert Finding(checks=[]).outcome is Outcome.NOT_RUN
    assert worst([Outcome.PASS, Outcome.NOT_RUN]) is Outcome.NOT_RUN
    assert worst([Outcome.PASS, Outcome.NOT_RUN, Outcome.FAIL]) is Outcome.FAIL
    assert not_run("x", "why").outcome is Outcome.NOT_RUN


def test_every_claim_of_the_paper_has_a_row() -> None:
    assert [statement.id for statement in STATEMENTS] == [f"P{k}" for k in range(1, 15)]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    assert run(["verify", "-o", str(folder)]) in (0, 3)
    return folder


def test_no_requirement_of_the_prototype_fails(written: Path) -> None:
    report = json.loads((written / "report.json").read_text())
    assert [claim["id"] for claim in report["claims"]] == [f"P{k}" for k in range(1, 15)]
    assert [claim["id"] for claim in report["appendices"]] == ["S1", "S2"]
    for claim in report["claims"] + report["appendices"]:
        assert claim["outcome"] != "fail", claim
        for check in claim["checks"]:
            assert (check["measured"] is None) == (check["outcome"] == "not run")
            assert check["reason"] or check["outcome"] != "not run"
        assert claim["outcome"] == "pass" or spice.available(), claim


def test_the_three_files_tell_the_same(written: Path) -> None:
    report = json.loads((written / "report.json").read_text())
    page = (written / "report.html").read_text()
    suites = ET.parse(written / "junit.xml").getroot().findall("testsuite")
    sections = report["claims"] + report["appendices"]
    for suite, claim in zip(suites, sections, strict=True):
        assert suite.get("name") == f"{claim['id']} {claim['title']}"
        cases = suite.findall("testcase")
        for case, check in zip(cases, claim["checks"], strict=True):
            assert case.get("name") == check["name"]
            kind = {child.tag for child in case}
            assert kind == {"pass": set(), "fail": {"failure"}, "not run": {"skipped"}}[check["outcome"]]
        assert f'id="{claim["id"]}"' in page


def test_the_page_needs_nothing_from_elsewhere(written: Path) -> None:
    page = (written / "report.html").read_text()
    assert "<svg" in page
    for outside in ("<script src", "<link ", "@import", '<img src="http', "url(http"):
        assert outside not in page


@pytest.fixture
def only(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Leave the named experiments, to keep a test short."""

    def choose(*ids: str) -> None:
        for name, statements in (("STATEMENTS", STATEMENTS), ("APPENDICES", APPENDICES)):
            kept = tuple(statement for statement in statements if statement.id in ids)
            monkeypatch.setattr(f"ohmskin.verification._run.{name}", kept)

    return choose


def test_a_divider_does_not_pass(tmp_path: Path, only: Callable[..., None]) -> None:
    only("P11", "P13")
    file = tmp_path / "divider.toml"
    file.write_text(
        '[array]\nrows = 3\ncolumns = 3\n[drive]\nvoltage = 1.0\nidle_rows = "float"\n'
        '[readout]\ncircuit = "voltage-divider"\nreference_resistance = 1e4\n'
    )
    assert run(["verify", str(file), "-o", str(tmp_path / "out")]) == 1
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["outcome"] == "fail"
    crosstalk = next(claim for claim in report["claims"] if claim["id"] == "P13")
    failed = {check["name"] for check in crosstalk["checks"] if check["outcome"] == "fail"}
    assert "crosstalk as designed, worst untouched cell" in failed


@pytest.mark.parametrize("shape", [(1, 1), (1, 3), (2, 1)])
def test_the_smallest_arrays_are_verified_too(shape: tuple[int, int], only: Callable[..., None]) -> None:
    only("P10", "P11", "P12", "P13", "P14")
    design = prototype()
    array = design.array.replace(rows=shape[0], columns=shape[1])
    report = verify(design.replace(array=array))
    assert report.outcome is not Outcome.FAIL
    assert all("defect" not in check.reason for claim in report.claims for check in claim.finding.checks)


def test_without_ngspice_its_check_is_not_run_and_the_rest_is(
    monkeypatch: pytest.MonkeyPatch, only: Callable[..., None]
) -> None:
    only("P13")

    def missing(*_: object) -> None:
        raise MissingExtra("no ngspice here")

    monkeypatch.setattr(spice, "spice_scan", missing)
    report = verify()
    claim = next(claim for claim in report.claims if claim.id == "P13")
    assert claim.outcome is Outcome.NOT_RUN
    assert {check.outcome for check in claim.finding.checks} == {Outcome.PASS, Outcome.NOT_RUN}
    assert report.exit_code == 3


def test_without_the_extra_the_numbers_are_written_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, only: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    only("P3")
    monkeypatch.setitem(sys.modules, "jinja2", None)
    assert run(["verify", "-o", str(tmp_path / "out")]) == 0
    assert json.loads((tmp_path / "out" / "report.json").read_text())["outcome"] == "pass"
    assert not (tmp_path / "out" / "report.html").exists()
    assert "ohmskin[report]" in capsys.readouterr().err


def test_a_defect_in_one_experiment_costs_only_that_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: object) -> Finding:
        raise ZeroDivisionError("boom")

    statements = tuple(
        s._replace(experiment=broken if s.id == "P12" else s.experiment) for s in STATEMENTS if s.id in ("P11", "P12")
    )
    monkeypatch.setattr("ohmskin.verification._run.STATEMENTS", statements)
    monkeypatch.setattr("ohmskin.verification._run.APPENDICES", ())
    other, claim = verify(divider(2, 2)).claims
    assert other.outcome is Outcome.PASS
    assert claim.outcome is Outcome.NOT_RUN
    assert "boom" in claim.finding.checks[0].reason


def test_the_sign_of_an_offset_does_not_decide(only: Callable[..., None]) -> None:
    """An amplifier's offset is a magnitude with either sign: both boards get the same verdict."""
    only("P13")
    design = prototype()
    turned = replaced(design, "readout", offset_voltage=-1.7e-3)
    limits = [
        {check.name: check.measured for check in verify(d).claims[0].finding.checks if "as designed" in check.name}
        for d in (design, turned)
    ]
    assert limits[0] == pytest.approx(limits[1], rel=1e-9)
    alone = change(turned, *_all_but_one(design))
    assert limits[0]["crosstalk as designed, worst untouched cell"] >= np.abs(alone[1, 2]) * 0.999


def _all_but_one(design: Design) -> tuple[np.ndarray, np.ndarray]:
    rest = np.full(design.array.shape, 10e3)
    pressed = np.full(design.array.shape, 17.75e3)
    pressed[1, 2] = 10e3
    return rest, pressed


@pytest.mark.parametrize("fault", [{"offset_voltage": 0.2}, {"gain_error": 0.2}, {"inl_steps": 300.0}])
def test_the_converters_own_errors_count(fault: dict[str, float]) -> None:
    design = prototype()
    cells = np.full(design.array.shape, 10e3)
    assert worst_reading_error(design, cells) < 5.0
    assert worst_reading_error(replaced(design, "adc", **fault), cells) > 7.0
    assert worst_reading_error(replaced(design, "adc", range=(0.0, 1.0)), cells) == math.inf


def test_recovery_times_do_not_depend_on_the_unit_of_load() -> None:
    one, other = (
        recovery_times(Subject(prototype(), Cell.example().replace(full_scale_kpa=full))) for full in (15.5, 62.0)
    )
    assert [check.measured for check in one.checks] == pytest.approx([check.measured for check in other.checks])


def test_what_does_not_concern_the_divider_does_not_change_its_claim(only: Callable[..., None]) -> None:
    only("P11")
    assert verify(replaced(prototype(), "readout", idle_columns="load")).outcome is Outcome.PASS


def test_a_shared_sampling_capacitor_is_timed(only: Callable[..., None]) -> None:
    only("P14")
    (claim,) = verify(replaced(prototype(), "adc", acquisition_time=2e-6)).claims
    checks = {check.name: check for check in claim.finding.checks}
    fastest = checks["fastest scan settled to 1/4 ADC step"]
    assert fastest.measured is not None
    assert fastest.measured <= 1 / (4 * 4 * 2e-6)


def test_a_port_without_a_board_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nowhere = str(tmp_path / "ttyNOPE")
    assert run(["verify", "--target", nowhere, "-o", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert nowhere in message
    assert not (tmp_path / "out").exists()


def test_a_board_behind_a_port_is_verified_by_what_it_sends(tmp_path: Path, only: Callable[..., None]) -> None:
    only("P14")
    scene = Scene(skin=SkinSettings(design=prototype()), board=BoardSettings(frame_rate=500.0))
    stop = Stop()
    with PtyPort() as port:
        board = threading.Thread(target=emulate, args=(scene, port), kwargs={"stop": stop})
        board.start()
        try:
            (claim,) = verify(target=port.name).claims
        finally:
            stop.set()
            board.join()
            stop.close()
    outcomes = {check.name: check.outcome for check in claim.finding.checks}
    assert outcomes.pop("applied pressures") is Outcome.NOT_RUN
    assert set(outcomes.values()) == {Outcome.PASS}


def test_bad_designs_write_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "design.toml"
    file.write_text("[array]\nrows = 2\ncolums = 2\n")
    assert run(["verify", str(file), "-o", str(tmp_path / "out")]) == 2
    assert not (tmp_path / "out").exists()
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "array.colums" in message
    assert "'columns'" in message
