"""The netlist as text, and what ngspice reads out of it, against the nodal reference."""

from __future__ import annotations

import subprocess
from math import inf, isfinite
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from designs import amplifier, divider
from needs import need
from parts_at_random import real_design

from ohmskin.bench import search
from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import CIRCUITS, Design, scan
from ohmskin.circuits.spice import command_available, netlist, run_control
from ohmskin.cli import run
from ohmskin.errors import InputError, SolverError


def read_by_ngspice(design: Design, cells: np.ndarray) -> np.ndarray:
    need(command_available())
    rows, columns = design.array.shape
    frame = [run_control(netlist(design, cells, row)) for row in range(rows)]
    return np.array([[step[f"volts_{j}"] for j in range(columns)] for step in frame])


@pytest.mark.parametrize("circuit", CIRCUITS)
@pytest.mark.parametrize("shape", [(1, 1), (3, 1), (1, 3)])
def test_ngspice_reads_arrays_of_one_line(circuit: str, shape: tuple[int, int]) -> None:
    cells = 10 ** np.random.default_rng(0).uniform(3, 5, shape)
    design = amplifier(*shape, lead=20.0, segment=3.0, open_loop_gain=1e4, offset_voltage=1e-3).with_circuit(circuit)
    np.testing.assert_allclose(read_by_ngspice(design, cells), reference_volts(design, cells), rtol=1e-7)


@pytest.mark.parametrize("circuit", CIRCUITS)
@pytest.mark.parametrize("seed", range(4))
def test_ngspice_reads_unequal_parts_faults_and_limits(circuit: str, seed: int) -> None:
    limits: dict[str, Any] = {"reference_voltage": 0.0, "supply": (-0.05, 0.2)} if seed == 3 else {"faults": seed}
    design, cells = real_design(seed, circuit=circuit, **limits)
    np.testing.assert_allclose(read_by_ngspice(design, cells), scan(design, cells).volts, rtol=1e-6, atol=1e-9)


def test_feedback_without_leads() -> None:
    cells = 10 ** np.random.default_rng(3).uniform(3, 5, (3, 4))
    design = amplifier(3, 4, open_loop_gain=1e5).with_circuit("voltage-feedback")
    np.testing.assert_allclose(read_by_ngspice(design, cells), scan(design, cells).volts, rtol=1e-7)


def test_the_text_names_the_faults() -> None:
    fault = {"kind": "bridged-columns", "place": [1, 0], "resistance": 12.5}
    design = Design.model_validate(amplifier(2, 2, lead=3.0, segment=1.0).model_dump() | {"fault": [fault]})
    assert "Rfault_0 col_1_0 col_1_1 12.5" in netlist(design, np.full((2, 2), 1e3), 0).splitlines()


@pytest.mark.parametrize("number", range(8))
@pytest.mark.parametrize("family", ["mixed lines", "faults", "one line"])
def test_every_part_has_a_resistance(family: str, number: int) -> None:
    """ngspice takes 1 mohm for 0 and cannot read inf, so neither may be written; nor may a part bridge itself."""
    design, cells = search.sample(family, number)
    cells.flat[number % cells.size] = inf
    text = netlist(design, cells, 0).partition(".control")[0]
    parts = [line.split() for line in text.splitlines() if line.startswith("R")]
    assert all(isfinite(float(ohm)) and float(ohm) > 0 and a != b for _, a, b, ohm in parts)
    names = [line.split()[0].lower() for line in text.splitlines() if line[:1].isalpha()]
    assert len(names) == len(set(names))


def test_the_text_shows_the_board() -> None:
    design = amplifier(2, 2, lead=70.0, segment=0.5, open_loop_gain=1e5, reference_voltage=1.65)
    text = netlist(design, [[1e3, 2e3], [np.inf, 0.0]], 1)
    for card in (
        "* Row 1 is selected; read are columns 0, 1.",
        "VDRIVE_r1 row_end_1 ref DC -1.0",
        "Rlead_row_0 ref row_0_0 70.0",
        "Rseg_row_0_1 row_0_0 row_0_1 0.5",
        "R_0_1 row_0_1 col_0_1 2000.0",
        "* R_1_0 is open",
        "* R_1_1 is 0 ohm: row_1_1 and col_1_1 are one node, col_1_1",
        "Rlead_col_0 col_1_0 line_0 70.0",
        "EX1_c0 out_c0 0 plus_X1_c0 line_0 100000.0",
    ):
        assert card in text.splitlines()


@pytest.mark.parametrize(
    ("design", "cells", "why"),
    [
        (amplifier(2, 1, lead=0.0), [[0.0], [0.0]], "the row drivers 0 and 1 are joined"),
        (amplifier(2, 1), [[0.0], [1e3]], "not determined"),
        (
            amplifier(1, 2).replace(array=divider(1, 2, row_lead=5.0).array),
            [[0.0, 0.0]],
            "the ideal amplifiers of columns 0 and 1",
        ),
        (divider(2, 2, idle_rows="ground"), [[0.0, 1e3], [0.0, 1e3]], "the row drivers 0 and 1 are joined"),
    ],
)
def test_contradictory_ideal_parts_are_refused(design: Design, cells: list[list[float]], why: str) -> None:
    with pytest.raises(SolverError, match=why):
        netlist(design, cells, 0)


def test_rows_are_checked() -> None:
    for row in (-1, 2):
        with pytest.raises(InputError, match=f"row {row}: the design has rows 0 to 1"):
            netlist(amplifier(2, 2), np.full((2, 2), 1e3), row)


DESIGN = """
[array]
rows = 2
columns = 3
row_lead = 70.0
[drive]
voltage = -1.0
[readout]
circuit = "inverting-amplifier"
reference_resistance = 1000.0
open_loop_gain = 1e5
"""
CELLS = "1000,2000,inf\n5000,100,0\n"


@pytest.fixture
def files(tmp_path: Path) -> Path:
    (tmp_path / "design.toml").write_text(DESIGN)
    (tmp_path / "cells.csv").write_text(CELLS)
    return tmp_path


def test_command_writes_what_ngspice_runs(files: Path) -> None:
    need(command_available())
    out = files / "step.cir"
    command = ["netlist", str(files / "design.toml"), "--cells", str(files / "cells.csv"), "--row", "1"]
    assert run([*command, "-o", str(out)]) == 0
    done = subprocess.run(["ngspice", "-b", str(out)], capture_output=True, text=True, check=True)
    printed = dict(line.split(" = ") for line in done.stdout.splitlines() if line.startswith("volts_"))
    cells = np.array([[1e3, 2e3, np.inf], [5e3, 1e2, 0.0]])
    expected = reference_volts(Design.load(files / "design.toml"), cells)[1]
    assert [float(printed[f"volts_{j}"]) for j in range(3)] == pytest.approx(expected.tolist(), rel=1e-12)


def test_command_prints_to_standard_output(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["netlist", str(files / "design.toml"), "--cells", str(files / "cells.csv"), "--row", "0"]) == 0
    assert capsys.readouterr().out.endswith(".end\n")


@pytest.mark.parametrize(("row", "sheet", "message"), [("2", "sliced", "row 2"), ("0", "continuous", "array.sheet")])
def test_command_refuses(files: Path, capsys: pytest.CaptureFixture[str], row: str, sheet: str, message: str) -> None:
    (files / "design.toml").write_text(DESIGN.replace("[drive]", f'sheet = "{sheet}"\n[drive]'))
    out = files / "step.cir"
    command = ["netlist", str(files / "design.toml"), "--cells", str(files / "cells.csv"), "--row", row, "-o", str(out)]
    assert run(command) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert not out.exists()
