"""Designs that must not pass, and requirements of a user's own."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import marshal
import signal
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from verified import AMPLIFIED, complete, outcomes_of

from ohmskin.cell import Cell
from ohmskin.circuits import Adc, Array, Design, Requirement
from ohmskin.cli import run
from ohmskin.common.config import parse
from ohmskin.common.text import markdown_code
from ohmskin.errors import InputError
from ohmskin.verification import Outcome, default_requirements, load_requirements, verify

pytestmark = pytest.mark.usefixtures("quick_verification")


def _design(tmp_path: Path, text: str) -> Design:
    file = tmp_path / "design.toml"
    file.write_text(text)
    return Design.load(file)


def _asked(*quantities: str, **keys: object) -> list[Requirement]:
    limits = {"max": 1e9} | keys
    return [Requirement.model_validate({"id": f"R-{name}", "quantity": name} | limits) for name in quantities]


def test_cells_within_their_tolerance_must_not_saturate_an_output(tmp_path: Path) -> None:
    """32.4 kohm on a 3.3 V rail: 3.17 V at rest, but cells of -10 % ask for 3.6 V."""
    text = complete(AMPLIFIED.replace("20000.0", "32400.0"))
    wanted = _asked("output_headroom", "adc_headroom", max=None, min=0.0) + _asked("lost_readings", max=0.0)
    nominal = verify(_design(tmp_path, text), requirements=_asked("output_headroom", max=None, min=0.0))
    assert nominal.outcome is Outcome.PASS
    cells = "\n[cells]\nrest_resistance = { nominal = 10e3, tolerance = 0.1 }\n"
    cells += "full_scale_resistance = 17750.0\nfull_scale_kpa = 15.5\n"
    report = verify(_design(tmp_path, text + cells), requirements=wanted)
    assert outcomes_of(report) == {"output_headroom": "fail", "adc_headroom": "fail", "lost_readings": "fail"}


def test_a_board_for_other_cells_is_judged_with_those(tmp_path: Path) -> None:
    design = _design(tmp_path, complete(AMPLIFIED.replace("20000.0", "200000.0")))
    large = Cell.example().replace(rest_resistance_ohm=100e3)
    wanted = _asked("output_headroom", max=None, min=0.0) + _asked("reading_error", max=10.0)
    assert verify(design, requirements=wanted).outcome is Outcome.FAIL
    assert verify(design, cell=large, requirements=wanted).outcome is Outcome.PASS


def test_too_few_boards_are_not_a_failure_and_how_many_would_do_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All of 100 boards keep the limit, which proves 96.4 %: the value alone would look like a pass."""
    (tmp_path / "design.toml").write_text(complete(AMPLIFIED))
    arguments = ["verify", str(tmp_path / "design.toml"), "-o", str(tmp_path / "out"), "--only", "D18"]
    assert run([*arguments, "--samples", "100"]) == 3
    said = capsys.readouterr().out
    assert "100 of 100 boards keep the limit, too few to prove a yield of 99 %: --samples 368 would" in said
    for name in ("report.html", "junit.xml", "summary.md", "report.json"):
        assert "--samples 368 would" in (tmp_path / "out" / name).read_text()
    assert run([*arguments, "--samples", "367"]) == 3
    assert run([*arguments, "--samples", "368"]) == 0


def test_text_of_a_file_is_text_in_every_report(tmp_path: Path) -> None:
    """Neither HTML nor a link nor a cell of a table, wherever a pull request or a browser shows it."""
    hostile = "<img/src=x>|[a](http://b)`*www.c.d"
    asked = [Requirement(id="A|<b>", quantity="checks.py:f", unit=hostile, max=1.0)]
    (tmp_path / "checks.py").write_text(f"def f(design, cell):\n    return 2.0, {hostile!r}\n")
    report = verify(requirements=asked, folder=tmp_path, allow_code=True, title=f"<script>{hostile}")
    summary = report.markdown()
    shown = r"\<img/src=x\>\|\[a\](http\://b)\`\*www\.c.d"
    assert f"# \\<script\\>{shown}: fail" in summary
    assert r"| A\|\<b\> checks.py:f | fail |" in summary
    assert summary.count(shown) == summary.count("img/src") >= 4  # title, limit, what was found, where
    assert "<img" not in report.html()
    assert markdown_code("a`<b>``") == "``` a`<b>`` ```"


def test_a_yield_that_is_missed_fails_whatever_the_number_of_boards(tmp_path: Path) -> None:
    design = _design(tmp_path, complete(AMPLIFIED))
    nominal = verify(design, requirements=_asked("reading_error"), samples=200).results[0].measurement
    assert nominal is not None
    asked = [Requirement(id="R", quantity="reading_error", max=0.5 * nominal.value, method="monte-carlo")]
    (result,) = verify(design, requirements=asked, samples=200).results
    assert str(result.outcome) == "fail"
    assert "boards keep the limit: yield" in result.why


def test_a_board_that_senses_rows_is_judged_as_the_same_board_turned_by_hand(tmp_path: Path) -> None:
    text = complete(
        AMPLIFIED.replace("columns = 3", "columns = 5").replace("rows = 3\n", "rows = 3\ncolumn_lead = 20.0\n")
    )
    design = _design(tmp_path, text).replace(
        array={"row_lead": (70.0, 60.0, 50.0), "row_segment": 2.0}, operation={"frame_rate": 9e3}
    )
    design = design.replace(readout={"circuit": "row-amplifier", "reference_resistance": (15e3, 18e3, 20e3)})
    lines = {"row_lead": 20.0, "row_segment": 0.0, "column_lead": (50.0, 60.0, 70.0), "column_segment": 2.0}
    by_hand = design.replace(
        array={"rows": 5, "columns": 3, **lines},
        readout={"circuit": "inverting-amplifier", "reference_resistance": (20e3, 18e3, 15e3)},
    )
    asked = _asked("crosstalk", "reading_error", "output_headroom", "adc_headroom", "settling_error", "fastest_scan")
    asked += _asked("phase_margin", "noise", "switch_current", "switch_power", "valid_cells", "fault_coverage")
    values = [
        [r.measurement.value if r.measurement else r.reason for r in verify(board, requirements=asked).results]
        for board in (design, by_hand)
    ]
    assert all(isinstance(value, float) for value in values[0]), values[0]
    assert values[0] == pytest.approx(values[1], rel=1e-9)


def test_an_overloaded_converter_hides_faults_and_cells(tmp_path: Path) -> None:
    """5 V through a divider into a converter of 3.3 V: readings at rest are the last code, and stay so with faults."""
    text = complete(
        AMPLIFIED.replace("20000.0", "40000.0").replace("supply = [0.0, 3.3]", ""), adc="bits = 10\nrange = [0.0, 3.3]"
    )
    design = (
        _design(tmp_path, text).replace(drive={"voltage": 5.0, "idle_rows": "float"}).with_circuit("voltage-divider")
    )
    report = verify(design, requirements=_asked("valid_cells", "fault_coverage", max=None, min=60.0))
    assert outcomes_of(report) == {"valid_cells": "fail", "fault_coverage": "fail"}


def test_a_divider_whose_cells_cannot_be_told_apart_says_so(tmp_path: Path) -> None:
    """8 bits over floating lines: the readings determine cells to several per cent only."""
    design = _design(tmp_path, complete(AMPLIFIED, adc="bits = 8\nrange = [-3.3, 0.0]"))
    design = design.replace(array={"rows": 8, "columns": 8}, drive={"idle_rows": "float"}).with_circuit(
        "voltage-divider"
    )
    (result,) = verify(design, requirements=_asked("valid_cells", max=None, min=100.0)).results
    assert str(result.outcome) == "fail"
    assert "not valid, all cells" in result.why


def test_cells_that_pressed_ones_beside_them_hide_are_told() -> None:
    """All are valid where all are alike; of a chequered press those at rest are not."""
    array, cells = {"rows": 4, "columns": 4, "row_lead": 50.0, "column_lead": 50.0}, {"rest_resistance": 1e4}
    tables = {"array": array, "drive": {"voltage": 3.3, "idle_rows": "float"}, "adc": {"bits": 8, "range": (0.0, 3.3)}}
    tables |= {"readout": {"circuit": "voltage-divider", "reference_resistance": 1e3}}
    design = Design.model_validate(tables | {"cells": cells | {"full_scale_resistance": 1e3}})
    (result,) = verify(design, requirements=_asked("valid_cells", max=None, min=100.0)).results
    assert result.measurement is not None
    assert result.measurement.value == 50.0
    assert "every second one pressed: (0, 0), (0, 2), (1, 1), (1, 3)" in result.measurement.where


def test_what_the_design_does_not_name_is_not_run_and_named(tmp_path: Path) -> None:
    text = "\n".join(
        line
        for line in complete(AMPLIFIED, operation="").splitlines()
        if not any(word in line for word in ("bandwidth", "capacitance", "noise", "temperature", "baudrate"))
    )
    design = _design(tmp_path, text)
    report = verify(design)
    reasons = {r.requirement.quantity: r.reason for r in report.results if r.outcome is Outcome.NOT_RUN}
    assert reasons["phase_margin"] == "missing: readout.gain_bandwidth"
    assert reasons["settling_error"] == "missing: operation.frame_rate"
    assert "readout.voltage_noise" in reasons["pressure_resolution"]
    assert reasons["latency"] == "missing: operation.frame_rate"
    assert "operation.frame_rate" in reasons["fastest_scan"]
    assert report.exit_code == 3
    assert report.count("not run") == len(reasons)
    assert {id for id, _, why in report.left_out if "not run" in why} == {
        r.requirement.id for r in report.results if r.outcome is Outcome.NOT_RUN
    }
    assert verify(design, require_all=True).exit_code == 1


@pytest.fixture(scope="module")
def sound() -> dict[str, float]:
    """Errors of the pressure of the complete design, by quantity."""
    design = parse(tomllib.loads(complete(AMPLIFIED)), Design, source="complete")
    report = verify(design, requirements=_asked("pressure_rmse", "pressure_peak_error"))
    return {r.requirement.quantity: r.measurement.value for r in report.results if r.measurement}


@pytest.mark.usefixtures("presses_at_full_rate")
def test_the_skin_is_untouched_while_it_is_tared(sound: dict[str, float]) -> None:
    """However long a tare takes, or however slowly an array is followed, no press gets into the rest resistance."""
    design = parse(tomllib.loads(complete(AMPLIFIED)), Design, source="complete")
    slow = design.replace(operation={"readings_per_calibration": 400})  # 8 s; the first press comes after 2 s
    found = verify(slow, requirements=_asked("pressure_rmse")).results[0].measurement
    assert found is not None
    assert 0.0 < sound["pressure_rmse"] <= sound["pressure_peak_error"]
    assert found.value < 2.0 * sound["pressure_rmse"]  # other noise, and so other moments at which a press is told


def test_a_saturating_board_fails_at_once(tmp_path: Path) -> None:
    design = _design(tmp_path, complete(AMPLIFIED.replace("20000.0", "60000.0")))
    failing = ("D2", "D4", "D5", "D13", "D14", "D15", "D18")
    report = verify(design, samples=100, only=failing)
    assert {r.requirement.id: str(r.outcome) for r in report.results} == dict.fromkeys(failing, "fail")
    assert not any("gone" in r.reason for r in report.results)


def test_requirements_come_from_the_design_or_from_a_file_beside_it(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text("def cells(design, cell):\n    return design.array.rows * 3.0, 'everywhere'\n")
    (tmp_path / "beside.toml").write_text(
        '[[requirement]]\nid = "X1"\nquantity = "own.py:cells"\nunit = "cells"\nmax = 8.0\n'
        '[[requirement]]\nid = "X2"\nquantity = "cell_voltage"\nmax = 1100.0\nunit = "mV"\n'
    )
    text = (
        complete(AMPLIFIED) + '[[requirement]]\nid = "R1"\nquantity = "phase_margin"\nmin = 45.0\nsource = "spec 7"\n'
    )
    (tmp_path / "design.toml").write_text(text)
    out = tmp_path / "out"
    arguments = ["verify", str(tmp_path / "design.toml"), "-o", str(out)]
    assert run(arguments) == 0
    assert run([*arguments, "--requirements", str(tmp_path / "beside.toml"), "--allow-code"]) == 1
    found = {item["id"]: item for item in json.loads((out / "report.json").read_text())["requirements"]}
    assert list(found) == ["R1", "X1", "X2"]
    assert found["X1"]["measured"] == 9.0
    assert found["X1"]["where"] == "everywhere"
    assert found["X2"]["max"] == pytest.approx(1.1)
    assert found["X2"]["outcome"] == "pass"
    assert found["R1"]["source"] == "spec 7"


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ('id = "A"\nquantity = "crostalk"\nmax = 1.0', "no quantity 'crostalk'; the nearest is 'crosstalk'"),
        ('id = "A"\nquantity = "crosstalk"\nmax = 1.0\nunit = "V"', "unit 'V' does not fit; expected '%'"),
        ('id = "A"\nquantity = "latency"\nmax = 1.0\nmethod = "monte-carlo"', "'latency' is not verified by"),
        ('id = "A"\nquantity = "nowhere.py:f"\nmax = 1.0', "there is no such file"),
        ('id = "A B"\nquantity = "latency"', "requirement[0].id"),
        ('id = "A"\nquantity = "latency"\nmin = 2.0\nmax = 1.0', "no value could keep both"),
        ('id = "A"\nquantity = "latency"\nmax = nan', "expected a finite limit"),
        ('id = "A"\nquantity = "latency"\nmaximum = 1.0', "the nearest known key is 'max'"),
    ],
)
def test_bad_requirements_are_one_line_of_bad_input(
    table: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "requirements.toml"
    file.write_text(f"[[requirement]]\n{table}\n")
    assert run(["verify", "-o", str(tmp_path / "out"), "--requirements", str(file)]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


def test_a_divider_that_has_no_time_to_settle_fails() -> None:
    """10 nF per column, 10 kohm, cells of 7 kohm to 1 Mohm: ngspice shows 4.7 % for one column alone at 2 kHz."""
    design = Design.model_validate(
        {
            "array": {"rows": 4, "columns": 4, "row_lead": 100.0},
            "drive": {"voltage": 5.0},
            "readout": {
                **{"circuit": "voltage-divider", "reference_resistance": 1e4},
                **{"idle_columns": "load", "column_capacitance": 1e-8},
            },
            "adc": {"bits": 10, "range": (0.0, 5.0), "sampling_capacitance": 14e-12},
            "cells": {"rest_resistance": 1e6, "full_scale_resistance": 7e3},
            "operation": {"frame_rate": 2000.0},
        }
    )
    fast = verify(design, only=["D8", "D9"])
    assert outcomes_of(fast) == {"settling_error": "fail", "fastest_scan": "fail"}
    settling, scan_rate = (result.measurement for result in fast.results)
    assert settling is not None
    assert scan_rate is not None
    assert 5.0 < settling.value < 10.0  # rows that alternate leave 5 %; the worst frame is not among such
    slow = verify(design.replace(operation={"frame_rate": 0.99 * scan_rate.value}), only=["D8", "D9"])
    assert outcomes_of(slow) == {"settling_error": "pass", "fastest_scan": "pass"}


def test_a_designs_code_is_loaded_from_its_folder_only_if_it_is_selected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outside, folder = tmp_path / "outside.py", tmp_path / "board"
    outside.write_text(
        "from pathlib import Path\nPath(__file__).with_suffix('.ran').touch()\ndef f(design, cell): return 1\n"
    )
    folder.mkdir()
    (folder / "link.py").symlink_to(outside)
    (folder / "beside.py").write_text("def f(design, cell): return 1\n")
    names = {"A": "../outside.py", "B": str(outside), "C": "link.py", "D": "beside.py"}
    tables = "".join(f'[[requirement]]\nid = "{id}"\nquantity = "{name}:f"\nmax = 1.0\n' for id, name in names.items())
    (folder / "design.toml").write_text(AMPLIFIED + tables)
    command = ["verify", str(folder / "design.toml"), "-o", str(tmp_path / "out"), "--only"]
    for id in "ABC":
        assert run([*command, id]) == 2
        assert f"requirement {id}: " in capsys.readouterr().err
    assert run([*command, "D"]) == 3
    sha256 = hashlib.sha256((folder / "beside.py").read_bytes()).hexdigest()
    assert f"beside.py (SHA-256 {sha256}) is the design's own code" in capsys.readouterr().out
    assert run([*command, "D", "--allow-code"]) == 0
    said = capsys.readouterr().out.splitlines()[0]
    assert said == f"the design's own code is run: {folder / 'beside.py'}, SHA-256 {sha256}"
    assert sha256 in (tmp_path / "out" / "report.json").read_text()
    assert not outside.with_suffix(".ran").exists()


def test_an_id_of_a_requirement_is_not_taken_for_a_shipped_one() -> None:
    asked = (Requirement(id="P3", quantity="cell_voltage", max=10.0), Requirement(id="P2", quantity="latency", max=9.0))
    report = verify(requirements=asked, only=["P3", "P2"])
    assert [result.requirement.id for result in report.results] == ["P3", "P2"]
    assert not report.claims


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("nominal = -1.0", "nominal = -1.0, tolerance = 5"), "5 % is 0.05"),
        (("300.0", "25.0"), "25 °C is 298.15 K"),
        (("[operation]", "[operation]\ntemperature_range = [-10.0, 40.0]"), "-10 °C is 263.15 K"),
    ],
)
def test_a_number_in_another_unit_is_told_so(change: tuple[str, str], message: str, tmp_path: Path) -> None:
    text = complete(AMPLIFIED).replace("voltage = -1.0", "voltage = { nominal = -1.0 }")
    assert change[0] in text
    with pytest.raises(InputError, match=message):
        _design(tmp_path, text.replace(*change))


def test_an_id_is_given_once() -> None:
    with pytest.raises(InputError, match="requirement R-latency: the id is given twice"):
        verify(requirements=_asked("latency", "latency"))


def test_a_quantity_of_ones_own_that_fails_is_not_run(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text("def f(design, cell):\n    raise RuntimeError('no')\n")
    report = verify(requirements=_asked("own.py:f"), folder=tmp_path, allow_code=True)
    assert report.results[0].outcome is Outcome.NOT_RUN
    assert "own.py, line 2: RuntimeError: no" in report.results[0].reason


def _own(folder: Path, text: str, **options: Any) -> Any:
    (folder / "checks.py").write_text(text)
    asked = [Requirement(id="R1", quantity="checks.py:f", max=1.0)]
    (result,) = verify(requirements=asked, folder=folder, **options).results
    return result


def test_code_of_a_design_runs_only_where_it_is_allowed(tmp_path: Path) -> None:
    text = "from pathlib import Path\nPath(__file__).with_suffix('.ran').touch()\ndef f(design, cell): return 0.5\n"
    asked: list[tuple[Path, str]] = []

    def deny(path: Path, sha256: str) -> bool:
        asked.append((path, sha256))
        return False

    for options in ({}, {"allow_code": False}, {"allow_code": deny}):
        result = _own(tmp_path, text, **options)
        assert result.outcome is Outcome.NOT_RUN
        assert "--allow-code" in result.reason
        assert not (tmp_path / "checks.ran").exists()
    sha256 = hashlib.sha256(text.encode()).hexdigest()
    assert asked == [(tmp_path / "checks.py", sha256)]
    result = _own(tmp_path, text, allow_code=True)
    assert result.outcome is Outcome.PASS
    assert result.measurement is not None
    assert sha256 in result.measurement.confidence
    assert (tmp_path / "checks.ran").exists()


def test_a_function_of_ones_own_is_asked_once_whatever_the_method(tmp_path: Path) -> None:
    """Random boards are drawn for what the catalogue has."""
    (tmp_path / "own.py").write_text("def f(design, cell): return 0.5\n")
    asked = [Requirement(id="R1", quantity="own.py:f", max=1.0, method="monte-carlo")]
    (result,) = verify(requirements=asked, folder=tmp_path, allow_code=True).results
    assert result.outcome is Outcome.PASS


def test_the_text_that_was_read_is_what_runs(tmp_path: Path) -> None:
    """Not bytecode that lies beside it, nor a module of the folder in place of Python's own."""
    forged = compile("def f(design, cell): return 0.5", "checks.py", "exec")
    head = importlib.util.MAGIC_NUMBER + (1).to_bytes(4, "little") + importlib.util.source_hash(b"")
    cached = Path(importlib.util.cache_from_source(tmp_path / "checks.py"))
    cached.parent.mkdir()
    cached.write_bytes(head + marshal.dumps(forged))
    assert _own(tmp_path, "def f(design, cell): return 99.0\n", allow_code=True).outcome is Outcome.FAIL


@pytest.mark.parametrize(
    ("way", "said"),
    [
        ("raise SystemExit(0)", "SystemExit: 0"),
        ("raise KeyboardInterrupt", "KeyboardInterrupt"),
        ("import os; os._exit(0)", "exit code 0"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "exit code -9"),
        ("import sys; sys.stdout.close(); return 'many'", "could not convert"),
        ("import os; os.write(1, b'{\"value\": 0.5}\\n'); raise SystemExit(0)", "SystemExit: 0"),
    ],
)
def test_no_way_out_of_a_function_is_a_verdict(way: str, said: str, tmp_path: Path) -> None:
    result = _own(tmp_path, f"def f(design, cell):\n    {way}\n", allow_code=True)
    assert result.outcome is Outcome.NOT_RUN
    assert said in result.reason


def test_hardware_that_is_missing_is_not_run() -> None:
    (result,) = verify(requirements=_asked("noise", method="hardware")).results
    assert result.outcome is Outcome.NOT_RUN
    assert "no board" in result.reason


def test_every_default_requirement_has_a_limit_and_a_sentence() -> None:
    design = Design(
        array=Array(rows=2, columns=2),
        drive={"voltage": 1.0},  # type: ignore[arg-type]  # as from a file
        readout={"circuit": "voltage-divider", "reference_resistance": 1e3},  # type: ignore[arg-type]
        adc=Adc(bits=8, range=(0.0, 1.0)),
        operation={"frame_rate": 10.0},  # type: ignore[arg-type]
    )
    for requirement in default_requirements(design):
        assert requirement.min is not None or requirement.max is not None
        assert requirement.text.endswith(".")


def test_example_requirements_are_valid() -> None:
    folder = Path(__file__).parent.parent / "examples"
    (file,) = folder.glob("requirements*.toml")
    assert load_requirements(file)
    Design.load(folder / "toleranced.toml")


DROPS_ERRORS = """
import time
from ohmskin import cli
from ohmskin.cli import verify
class Destroyed:
    def __del__(self):
        print("waiting", flush=True)
        time.sleep(1.0)
def destructor(*given, **options):
    Destroyed()
    time.sleep(600.0)
verify.verify = destructor
cli.main(["verify"])
"""


def test_a_signal_ends_the_run_even_where_python_drops_exceptions(tmp_path: Path) -> None:
    command = [sys.executable, "-c", DROPS_ERRORS]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        while process.stdout.readline() != b"waiting\n":
            pass
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate()
    assert (process.returncode, said) == (128 + signal.SIGTERM, b"ohmskin: terminated\n")
