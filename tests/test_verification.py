"""The report: what passes, fails, was not run or does not apply can never be confused."""

from __future__ import annotations

import json
import math
import sys
import threading
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest
from designs import divider
from verified import AMPLIFIED, complete, ids_of

from ohmskin.cell import Cell
from ohmskin.circuits import Design, Requirement, spice
from ohmskin.cli import run
from ohmskin.common.extras import install_command
from ohmskin.emulator import PtyPort, Scene, Stop, emulate
from ohmskin.emulator._scene import BoardSettings, SkinSettings
from ohmskin.errors import InputError, MissingExtra
from ohmskin.verification import CATALOGUE, ReportRecord, load_record, prototype, schema, verify
from ohmskin.verification._claims import STATEMENTS
from ohmskin.verification._material import recovery_times
from ohmskin.verification._outcome import Check, Finding, Measurement, Outcome, Result, not_run, worst
from ohmskin.verification._schematic import schematic
from ohmskin.verification._subject import Subject

pytestmark = pytest.mark.usefixtures("quick_verification")

ROOT = Path(__file__).parent.parent


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
    limits: dict[str, Any] = {"min": 1.0} if at_least else {"max": 1.0}
    asked = Requirement(id="R", quantity="crosstalk", **limits)
    found = None if measured is None else Measurement(measured, "%")
    assert Result(asked, "x", "nominal", "%", found).outcome == outcome


def test_a_check_that_cannot_fail_is_refused() -> None:
    with pytest.raises(ValueError, match="could not fail"):
        Check("x", 1.0, math.inf)


def test_a_requirement_without_a_limit_never_passes() -> None:
    asked = Requirement(id="R", quantity="crosstalk")
    assert Result(asked, "x", "nominal", "%", Measurement(0.0, "%")).outcome is Outcome.NOT_RUN


def test_nothing_checked_is_not_a_pass() -> None:
    assert Finding(checks=[]).outcome is Outcome.NOT_RUN
    assert worst([Outcome.PASS, Outcome.NOT_RUN]) is Outcome.NOT_RUN
    assert worst([Outcome.PASS, Outcome.NOT_RUN, Outcome.FAIL]) is Outcome.FAIL
    assert worst([Outcome.PASS, Outcome.NOT_APPLICABLE]) is Outcome.PASS
    assert worst([Outcome.NOT_APPLICABLE]) is Outcome.NOT_APPLICABLE
    assert worst([]) is Outcome.NOT_RUN
    assert not_run("x", "why").outcome is Outcome.NOT_RUN


def test_every_claim_of_the_paper_has_a_row() -> None:
    assert [statement.id for statement in STATEMENTS] == [f"P{k}" for k in range(1, 15)]


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `make demo` makes: a report of the shipped prototype, with all of its requirements and claims."""
    folder = tmp_path_factory.mktemp("report")
    assert run(["verify", "-o", str(folder), "--samples", "400"]) in (0, 3)
    return folder


@pytest.fixture(scope="session")
def record(written: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((written / "report.json").read_text())
    return found


def test_the_prototype_keeps_every_requirement(record: dict[str, Any]) -> None:
    assert [item["id"] for item in record["requirements"]] == [f"D{k}" for k in (*range(1, 21), 23, 24)]
    assert {item["outcome"] for item in record["requirements"]} == {"pass"}
    assert [claim["id"] for claim in record["claims"]] == [f"P{k}" for k in range(1, 15)]
    for claim in record["claims"]:
        assert claim["outcome"] != "fail", claim
        for check in claim["checks"]:
            assert (check["measured"] is None) == (check["outcome"] == "not run")
            assert check["reason"] or check["outcome"] != "not run"
        assert claim["outcome"] == "pass" or spice.command_available(), claim


def test_no_claim_is_judged_by_the_speed_of_this_machine(record: dict[str, Any]) -> None:
    names = [check["name"] for check in record["claims"][-1]["checks"]]
    assert "counts that differ from what the board sent" in names
    assert not any("real time" in name or "speed" in name for name in names)


def test_every_number_comes_with_its_place_and_its_certainty(record: dict[str, Any]) -> None:
    for item in record["requirements"]:
        assert item["where"], item
        assert item["confidence"] or item["quantity"] == "lost_readings", item
        assert math.isfinite(item["measured"])
        assert math.isfinite(item["margin"])


def test_report_json_keeps_the_published_schema(written: Path) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    assert (ROOT / "docs" / "report.schema.json").read_text() == schema()
    jsonschema.validate(json.loads((written / "report.json").read_text()), json.loads(schema()))
    assert isinstance(load_record(written / "report.json"), ReportRecord)


def test_the_files_tell_the_same(written: Path, record: dict[str, Any]) -> None:
    page = (written / "report.html").read_text()
    summary = (written / "summary.md").read_text()
    suites = ET.parse(written / "junit.xml").getroot().findall("testsuite")
    cases = {case.get("name"): case for suite in suites for case in suite.findall("testcase")}
    for item in record["requirements"]:
        case = cases[f"{item['id']} {item['title']}"]
        kind = {child.tag for child in case} - {"properties"}
        assert kind == {"pass": set(), "fail": {"failure"}}.get(item["outcome"], {"skipped"})
        assert f'id="{item["id"]}"' in page
        assert f"| {item['id']} {item['title']} | {item['outcome']} |" in summary
        values = {p.get("name"): p.get("value") for p in case.iter("property")}
        assert float(values["value"] or "nan") == item["measured"]
        assert float(case.get("time") or "nan") >= 0
    for claim in record["claims"]:
        assert f'id="{claim["id"]}"' in page
        for check in claim["checks"]:
            assert check["name"] in cases


def test_the_page_needs_nothing_from_elsewhere(written: Path) -> None:
    page = (written / "report.html").read_text()
    assert page.count("<svg") > 5
    for outside in ("<script", "<link ", "@import", '<img src="http', "url(http"):
        assert outside not in page


def test_the_page_shows_the_parts_with_units_and_who_signs(written: Path) -> None:
    page = (written / "report.html").read_text()
    for words in ("20 kΩ", "data-sheet maximum of either sign", "released by", "SHA-256", "39 nV/√Hz"):
        assert words in page
    assert "<details" not in page  # a closed fold is not printed


def test_the_netlist_is_attached_and_runs(written: Path) -> None:
    text = (written / "netlist.cir").read_text()
    if reason := spice.command_available():
        pytest.skip(reason)
    assert spice.run_control(text)


def test_a_report_is_compared_with_an_older_one(
    written: Path, tmp_path: Path, record: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    old = dict(record, requirements=[dict(item) for item in record["requirements"]])
    first, second, third = old["requirements"][:3]
    first["margin"] += 1.0  # it was better
    second["outcome"] = "fail"
    third["id"] = "D99"
    (tmp_path / "old.json").write_text(json.dumps(old))
    only = ["--only", "D1,D2", "--only", "D3"]
    run(["verify", "-o", str(tmp_path / "out"), "--against", str(tmp_path / "old.json"), *only])
    changes = {
        change["id"]: change["change"] for change in json.loads((tmp_path / "out/report.json").read_text())["changes"]
    }
    assert changes["D1"] == "worse"
    assert changes["D2"] == "better"
    assert changes["D3"] == "new"
    assert changes["D99"] == "gone"
    assert "worse" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{}", "old.json: not a report.json of this version: missing key 'schema_version'"),
        ('{"schema_version": "2"}', "old.json: not a report.json of this version: schema_version: input should be"),
        ("[1]", "old.json: not a report.json of this version: expected a table (got [1])"),
        ("a,b\n1,2\n", "old.json: not valid JSON: expected value at line 1 column 1; expected a report.json"),
        ("", "old.json: not valid JSON: EOF while parsing a value at line 1 column 0; expected a report.json"),
    ],
)
def test_an_old_report_that_is_none_is_bad_input(
    content: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "old.json").write_text(content)
    assert run(["verify", "-o", str(tmp_path / "out"), "--against", str(tmp_path / "old.json")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_p9_fails_with_a_converter_range_that_its_presses_leave() -> None:
    """[1.05, 3.3] V: the prototype's own pressed readings fall to 1.1 V, less the tolerances of its parts.

    Here and not with other designs that must not pass: the cell has been calibrated for the report above.
    """
    (claim,) = verify(prototype().replace(adc={"range": (1.05, 3.3)}), only=["P9"]).claims
    assert str(claim.outcome) == "fail"
    lost = [check for check in claim.finding.checks if "lost" in check.name]
    assert any(check.measured for check in lost)


def test_a_divider_does_not_pass(tmp_path: Path) -> None:
    file = tmp_path / "divider.toml"
    file.write_text(
        '[array]\nrows = 3\ncolumns = 3\n[drive]\nvoltage = 1.0\nidle_rows = "float"\n'
        '[readout]\ncircuit = "voltage-divider"\nreference_resistance = 1e4\n'
    )
    only = [word for id in ("D1", "D10", "P11", "P12", "P13") for word in ("--only", id)]
    assert run(["verify", str(file), "-o", str(tmp_path / "out"), *only]) == 1
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    outcomes = {item["id"]: item["outcome"] for item in report["requirements"] + report["claims"]}
    assert outcomes == {
        "D1": "fail",
        "D10": "does not apply",
        "P11": "pass",
        "P12": "does not apply",
        "P13": "fail",
    }


@pytest.mark.parametrize("shape", [(1, 1), (1, 3), (2, 1)])
def test_the_smallest_arrays_are_verified_too(shape: tuple[int, int]) -> None:
    design = prototype()
    report = verify(design.replace(array={"rows": shape[0], "columns": shape[1]}), samples=400)
    # Contacts that overlap on one cell are partial releases, which the paper's estimator takes badly.
    kept = [r for r in report.results if r.requirement.quantity != "pressure_rmse"]
    assert Outcome.FAIL not in {result.outcome for result in kept}
    assert all("defect" not in result.reason for result in report.results)
    claims = verify(design.replace(array={"rows": shape[0], "columns": shape[1]}), only=["P10", "P11", "P12", "P13"])
    assert claims.outcome is not Outcome.FAIL
    assert all("defect" not in check.reason for claim in claims.claims for check in claim.finding.checks)


def test_without_ngspice_its_check_is_not_run_and_the_rest_is(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: object) -> None:
        raise MissingExtra("no ngspice here")

    monkeypatch.setattr(spice, "command_scan", missing)
    report = verify(only=["P13"])
    (claim,) = report.claims
    assert claim.outcome is Outcome.NOT_RUN
    assert {check.outcome for check in claim.finding.checks} == {Outcome.PASS, Outcome.NOT_RUN}
    assert report.exit_code == 3


def test_without_the_extra_the_numbers_are_written_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "report.html").write_text("of another design")
    assert run(["verify", "-o", str(tmp_path / "out"), "--only", "P3"]) == 0
    assert json.loads((tmp_path / "out" / "report.json").read_text())["outcome"] == "pass"
    assert not (tmp_path / "out" / "report.html").exists()
    assert install_command("report") in capsys.readouterr().err


def test_a_defect_in_one_experiment_costs_only_that_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: object) -> Finding:
        raise ZeroDivisionError("boom")

    statements = tuple(s._replace(experiment=broken if s.id == "P12" else s.experiment) for s in STATEMENTS)
    monkeypatch.setattr("ohmskin.verification._run.STATEMENTS", statements)
    other, claim = verify(divider(2, 2), only=["P11", "P12"]).claims
    assert other.outcome is Outcome.PASS
    assert claim.outcome is Outcome.NOT_RUN
    assert "boom" in claim.finding.checks[0].reason


def test_a_defect_in_one_quantity_costs_only_that_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> Measurement:
        raise ZeroDivisionError("boom")

    monkeypatch.setattr("ohmskin.verification._catalogue.CATALOGUE", CATALOGUE)
    quantity = CATALOGUE["resolution"]
    monkeypatch.setitem(CATALOGUE, "resolution", type(quantity)("resolution", "Resolution", "ohm", broken))
    asked = [
        Requirement(id="R1", quantity="resolution", max=1e9),
        Requirement(id="R2", quantity="cell_voltage", max=1e9),
    ]
    one, other = verify(prototype(), requirements=asked).results
    assert one.outcome is Outcome.NOT_RUN
    assert "boom" in one.reason
    assert other.outcome is Outcome.PASS


def test_recovery_times_do_not_depend_on_the_unit_of_load(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ohmskin.verification._material.side_by_side", lambda *_: {})  # that would calibrate
    one, other = (
        recovery_times(Subject(prototype(), Cell.example().replace(full_scale_kpa=full))) for full in (15.5, 62.0)
    )
    assert [check.measured for check in one.checks] == pytest.approx([check.measured for check in other.checks])


def test_what_does_not_concern_the_divider_does_not_change_its_claim() -> None:
    design = prototype().replace(readout={"open_loop_gain": 1e3})  # of the amplifiers
    assert verify(design, only=["P11"]).outcome is Outcome.PASS


def test_a_shared_sampling_capacitor_is_timed() -> None:
    design = prototype().replace(adc={"acquisition_time": 2e-6})
    (result,) = verify(design, only=["D9"]).results
    assert result.measurement is not None
    assert result.measurement.value <= 1 / (4 * 4 * 2e-6)


def test_a_port_without_a_board_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nowhere = str(tmp_path / "ttyNOPE")
    assert run(["verify", "--target", nowhere, "-o", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert nowhere in message
    assert not (tmp_path / "out" / "report.json").exists()


def test_a_board_behind_a_port_is_verified_by_what_it_sends() -> None:
    scene = Scene(skin=SkinSettings(design=prototype()), board=BoardSettings(frame_rate=500.0))
    stop = Stop()
    with PtyPort() as port:
        board = threading.Thread(target=emulate, args=(scene, port), kwargs={"stop": stop})
        board.start()
        try:
            (claim,) = verify(target=port.name, only=["P14"]).claims
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


def test_an_output_that_cannot_be_written_is_found_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("ohmskin.cli.verify.verify", lambda *_, **__: pytest.fail("it was run before"))
    assert run(["verify", "-o", str(tmp_path / "file")]) == 2
    assert run(["verify", "-o", str(tmp_path / "out"), "--export", str(tmp_path / "samples.xlsx")]) == 2
    assert "expected a file name" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["a\x1b[31m.toml", "<b>&.toml"])
def test_names_of_files_cannot_command_a_terminal_or_a_page(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / name
    file.write_text(complete(AMPLIFIED))
    assert run(["verify", str(file), "-o", str(tmp_path / "out"), "--only", "D11"]) == 0
    for text in (
        capsys.readouterr().out,
        *((tmp_path / "out" / f).read_text() for f in ("report.html", "report.json")),
    ):
        assert "\x1b" not in text
        assert "<b>&.toml" not in text or text.startswith("{")


@pytest.mark.parametrize("circuit", ["inverting-amplifier", "voltage-divider", "voltage-feedback"])
@pytest.mark.parametrize("shape", [(1, 1), (4, 6)])
def test_the_schematic_shows_the_values(circuit: str, shape: tuple[int, int]) -> None:
    design = prototype().replace(array={"rows": shape[0], "columns": shape[1]}).with_circuit(circuit)
    drawn = schematic(design)
    ET.fromstring(drawn)
    assert "20 kΩ" in drawn
    assert "12 bit" in drawn


@pytest.mark.parametrize("circuit", ["inverting-amplifier", "voltage-divider"])
def test_the_schematic_shows_idle_lines(circuit: str) -> None:
    drive = {"idle_rows": "pull", "idle_row_resistance": 4700.0}
    readout = {"columns": "multiplexed", "idle_columns": "ground"}
    drawn = schematic(prototype().with_circuit(circuit).replace(drive=drive, readout=readout))
    ET.fromstring(drawn)
    assert "4.7 kΩ" in drawn
    assert "behind a switch" in drawn
    assert "idle columns at the reference" in drawn


def test_the_schematic_of_sensed_rows_has_the_leads_where_they_are() -> None:
    design = prototype().replace(array={"rows": 3, "columns": 5, "row_lead": 12.0, "column_lead": 35.0})
    drawn = schematic(design.with_circuit("row-amplifier"))
    assert "column 4" in drawn
    assert "R2,4" in drawn  # the crosspoint next to driver and amplifier
    driven, sensed = drawn.index("lead 35 Ω"), drawn.index("lead 12 Ω")
    assert driven < sensed  # driven lines are drawn first


def test_only_names_what_there_is() -> None:
    with pytest.raises(InputError, match="no such requirement; expected one of D1"):
        verify(only=["D1000"])
    assert ids_of(verify(only=["D11"])) == ["D11"]


def test_the_list_of_quantities_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["verify", "--quantities"]) == 0
    printed = capsys.readouterr().out
    for name, quantity in CATALOGUE.items():
        assert name in printed
        assert quantity.says.endswith(".")


def test_the_design_of_the_report_reads_back(record: dict[str, Any]) -> None:
    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items()}
        if isinstance(value, list):
            return [plain(item) for item in value]
        return float(value) if value in ("inf", "-inf") else value

    assert Design.model_validate(plain(record["design"])) == prototype()
