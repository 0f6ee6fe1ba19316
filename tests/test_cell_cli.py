"""The commands fit and estimate, end to end on files."""

import json
from pathlib import Path

import numpy as np
import pytest

from ohmskin.cell import Cell, ContactModel
from ohmskin.cell.identification import _protocol as protocol
from ohmskin.cli import run
from ohmskin.common.tables import read_columns, write_columns

FULL = 15.5


@pytest.fixture(scope="module")
def steps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A contact cell through the protocol: the kind that is calibrated quickest."""
    model = ContactModel(exponent=0.9, full_scale_resistance_ohm=500)
    time, load = protocol.protocol_load(0.1)
    forward = Cell.example().replace(model=model).forward(())
    read = [float(forward.step(0.1, FULL * s)) for s in load]
    path = tmp_path_factory.mktemp("contact") / "steps.csv"
    write_columns(path, {"time_s": time, "pressure_kpa": FULL * load, "resistance_ohm": np.array(read)})
    return path


def test_fit_then_estimate(steps: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cell, out, plot = tmp_path / "cell.toml", tmp_path / "out.csv", tmp_path / "fit.png"
    assert run(["fit", str(steps), "-o", str(cell), "--protocol", "--full-scale", "15.5", "--plot", str(plot)]) == 0
    text = capsys.readouterr().out
    assert "cell of kind contact" in text
    assert "full scale 15.5 kPa (2.25 psi, 0.155 bar)" in text
    assert "exponent" in text
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert run(["estimate", str(steps), "--cell", str(cell), "-o", str(out)]) == 0
    truth = read_columns(steps, ("time_s", "pressure_kpa"))
    found = read_columns(out, ("time_s", "pressure_kpa", "std_kpa"))
    assert (found["time_s"] == truth["time_s"]).all()
    assert np.sqrt(np.mean((found["pressure_kpa"] - truth["pressure_kpa"]) ** 2)) < 0.02 * FULL
    assert (found["std_kpa"] > 0).all()


def test_what_was_found_can_be_read_by_a_program(steps: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["fit", str(steps), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["kind"] == "contact"
    assert found["full_scale_kpa"] == pytest.approx(FULL)
    (exponent,) = [item for item in found["parameters"] if item["name"] == "exponent"]
    assert exponent["value"] == pytest.approx(0.9, abs=0.05)
    assert found["estimator"] == "static"
    folds = found["fold_percent"]["static"]
    assert len(folds) == len(found["folds_s"]) > 1
    assert min(folds) <= found["held_out_percent"]["static"] < 1.5 * max(folds)
    assert run(["fit", str(steps)]) == 0
    printed = next(line for line in capsys.readouterr().out.splitlines() if line.split()[:1] == ["static"])
    assert [float(word) for word in printed.split()[1 : 1 + len(folds)]] == pytest.approx(folds, abs=0.051)


def test_a_place_that_cannot_be_written_is_refused_before_the_fit(
    steps: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ohmskin.cli.fit.calibrate", lambda *args, **kwargs: 1 / 0)
    assert run(["fit", str(steps), "-o", str(tmp_path / "no" / "cell.toml")]) == 2
    assert "cell.toml: cannot be written" in capsys.readouterr().err


def test_the_protocol_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["fit", "--protocol"]) == 0
    assert "conditioned" in capsys.readouterr().out


def test_faults_are_one_line(steps: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flat = tmp_path / "flat.csv"
    time = np.arange(0, 60, 0.1)
    write_columns(flat, {"time_s": time, "pressure_kpa": 0 * time, "resistance_ohm": 0 * time + 1e4})
    cell = tmp_path / "cell.toml"
    Cell.example().save(cell)
    out = tmp_path / "out.csv"
    for arguments, message in (
        (["fit"], "expected STEPS.csv"),
        (["fit", str(flat), "-o", str(tmp_path / "none.toml")], "pressure_kpa stays at 0"),
        (["estimate", str(steps), "--cell", str(tmp_path / "no.toml"), "-o", str(out)], "no.toml"),
        (["estimate", str(steps), "--cell", str(cell), "-o", str(out), "--estimator", "magic"], "no estimator 'magic'"),
        (["estimate", str(steps), "--cell", str(cell), "-o", str(out), "--estimator", "distilled"], "run ohmskin fit"),
    ):
        assert run(arguments) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert not out.exists()
    assert not (tmp_path / "none.toml").exists()


@pytest.mark.parametrize("times", ["0\n0", "2\n1", "0\nnan", "0\ninf"])
def test_estimate_names_the_line_whose_time_does_not_follow(
    times: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell, read, out = tmp_path / "cell.toml", tmp_path / "read.csv", tmp_path / "out.csv"
    Cell.example().save(cell)
    read.write_text("time_s,resistance_ohm\n" + "".join(f"{time},10000\n" for time in times.split()))
    assert run(["estimate", str(read), "--cell", str(cell), "-o", str(out)]) == 2
    assert f"{read}: time_s must increase and be finite, but line 3 is at" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    ("ohms", "message"),
    [
        ("10 12 11", "no load of this cell explains resistance_ohm, which is about 11; the cell at rest has 1e+04 ohm"),
        ("10000 -12000 11000", "resistance_ohm of sample 2 is -12000, expected more than 0"),
        ("nan nan nan", "resistance_ohm has no reading"),
    ],
)
def test_estimate_refuses_readings_that_give_no_pressure(
    ohms: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell, read, out = tmp_path / "cell.toml", tmp_path / "read.csv", tmp_path / "out.csv"
    Cell.example().save(cell)
    read.write_text("time_s,resistance_ohm\n" + "".join(f"{n},{ohm}\n" for n, ohm in enumerate(ohms.split())))
    assert run(["estimate", str(read), "--cell", str(cell), "-o", str(out)]) == 2
    assert f"{read}: {message}" in capsys.readouterr().err
    assert not out.exists()


def test_a_repeated_time_costs_one_row_and_a_note(
    steps: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Clocks of coarse steps repeat a time now and then; times that go back, or repeat often, are refused by line."""
    head, *rows = steps.read_text().splitlines()[:200]
    Cell.example().save(tmp_path / "cell.toml")
    run_csv, out = tmp_path / "run.csv", tmp_path / "out.csv"
    command = ["estimate", str(run_csv), "--cell", str(tmp_path / "cell.toml"), "-o", str(out)]
    repeated = [*rows[:50], rows[49], *rows[50:]]
    run_csv.write_text("\n".join([head, *repeated]) + "\n")
    assert run(command) == 0
    assert (
        capsys.readouterr().err == f"ohmskin: {run_csv}: line 52 repeats the time of the line before, and is left out\n"
    )
    assert len(read_columns(out, ("time_s",))["time_s"]) == len(rows)
    for wrong, line in (([*rows[:50], rows[3], *rows[50:]], 52), ([row for row in rows for _ in "ab"], 3)):
        run_csv.write_text("# by hand\n" + "\n".join([head, *wrong]) + "\n")
        assert run(command) == 2
        assert f"line {line + 1} is at" in capsys.readouterr().err
