"""The netlist as text, and what ngspice reads out of it, against the nodal reference."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from math import inf, isfinite
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from designs import amplifier, divider
from needs import need
from parts_at_random import real_design
from worst_boards import random_board_in_time

from ohmskin.bench import search
from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import CIRCUITS, Design, Settling, noise, scan, spice, stability
from ohmskin.circuits.spice import (
    command_available,
    library_available,
    netlist,
    run_command,
    run_control,
    run_library,
    spice_scan,
)
from ohmskin.cli import run
from ohmskin.common.extras import install_command
from ohmskin.errors import InputError, MissingExtra, SolverError
from ohmskin.verification import prototype


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


@pytest.mark.parametrize("ohm", [500.0, inf])
@pytest.mark.parametrize("kind", ["broken-row", "broken-column"])
def test_a_broken_line_without_segments_is_two_nodes(kind: str, ohm: float) -> None:
    fault = {"kind": kind, "place": [1, 2]} | ({"resistance": ohm} if ohm < inf else {})
    design = Design.model_validate(amplifier(3, 4, lead=20.0).model_dump() | {"fault": [fault]})
    cells = 10 ** np.random.default_rng(4).uniform(3, 4, (3, 4))
    np.testing.assert_allclose(read_by_ngspice(design, cells), reference_volts(design, cells), rtol=1e-7)


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


# ngspice as a judge: its readings of a frame against the nodal reference, and the solver against ngspice


Runner = Callable[[str], dict[str, Any]]


@pytest.mark.parametrize("number", range(10))
@pytest.mark.parametrize("family", ["ordinary", "mixed lines", "one line", "faults", "ties"])
def test_a_frame_agrees_with_the_reference_and_with_the_solver(family: str, number: int) -> None:
    """Random small grids of every kind, with open cells and lines that no cell connects."""
    need(library_available() or command_available())
    design, cells = search.sample(family, number)
    read = spice_scan(design, cells, run_command if number % 3 == 0 else run_library)
    np.testing.assert_allclose(read, reference_volts(design, cells), rtol=1e-7, atol=1e-11)
    np.testing.assert_allclose(scan(design, cells).volts, read, rtol=1e-6, atol=1e-11)


def test_a_board_sized_grid() -> None:
    need(library_available())
    cells = 10 ** np.random.default_rng(7).uniform(4, 6, (16, 16))
    design = amplifier(16, 16, lead=25.0, segment=1.0, open_loop_gain=1e5, offset_voltage=1e-3)
    np.testing.assert_allclose(scan(design, cells).volts, spice_scan(design, cells), rtol=1e-9)


@pytest.mark.parametrize("runner", [run_library, run_command, run_control])
@pytest.mark.parametrize(
    "text",
    [
        "* two sources at odds\nV1 a 0 1\nV2 a 0 2\nR1 a 0 1\n.op\n.end\n",
        "* no such part\nY1 a 0 1\n.op\n.end\n",
    ],
)
def test_failures_of_ngspice_are_ours_and_leave_no_trace(
    runner: Runner, text: str, capfd: pytest.CaptureFixture[str]
) -> None:
    need(library_available() or command_available())
    with pytest.raises(SolverError, match="ngspice"):
        runner(text)
    assert spice_scan(amplifier(1, 1), [[1e3]]) == pytest.approx(1.0)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("path", "missing"),
    [
        (None, "libngspice0"),
        ("/nowhere/libngspice.so", "cannot be loaded from /nowhere/libngspice.so"),
        ("libngspice.so.0", install_command("spice")),  # PySpice is missing
    ],
)
def test_without_the_library_the_command_reads_and_without_both_what_is_missing_is_named(
    path: str | None, missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    need(command_available())
    monkeypatch.setattr("ctypes.util.find_library", lambda name: path)
    monkeypatch.setitem(sys.modules, "PySpice.Spice.NgSpice.Shared", None)
    assert missing in str(library_available())
    assert spice_scan(amplifier(1, 1), [[1e3]]) == pytest.approx(1.0)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(MissingExtra) as refused:
        spice_scan(amplifier(1, 1), [[1e3]])
    assert missing in str(refused.value)
    assert "apt install ngspice" in str(refused.value)


def test_no_run_begins_with_commands_of_a_file(tmp_path: Path) -> None:
    """ngspice runs ~/.spiceinit, libngspice that of the working folder, which may be anybody's."""
    need(command_available())
    init = f"* commands\nshell touch {tmp_path}/ran\n"
    for folder in ("home", "work"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / ".spiceinit").write_text(init)
    program = (
        "from ohmskin.circuits import Design, spice\n"
        "design = Design(array={'rows': 2, 'columns': 2}, drive={'voltage': -1.0},\n"
        "    readout={'circuit': 'inverting-amplifier', 'reference_resistance': 1e3})\n"
        "print(spice.spice_scan(design, [[1e4] * 2] * 2)[0, 0],\n"
        "    spice.spice_scan(design, [[1e4] * 2] * 2, spice.run_command)[0, 0])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "HOME": str(tmp_path / "home")},
        cwd=tmp_path / "work",
        capture_output=True,
        text=True,
        check=True,
    )
    assert [float(volts) for volts in done.stdout.split()] == pytest.approx([0.1, 0.1])
    assert not (tmp_path / "ran").exists()


# The netlist in time: ngspice's settling and noise against the project's own, and what is refused


DYNAMIC_CELLS = np.array([[17e3, 10e3, 12e3, 9e3]] * 2 + [[10e3, 17e3, 10e3, 14e3]] * 2)


def _linear(**readout: object) -> Design:
    return prototype().replace(readout={"offset_voltage": 0.0, "bias_current": 0.0, "supply": (-5.0, 5.0)} | readout)


@pytest.mark.parametrize(
    "design",
    [
        _linear(),
        _linear(reference_voltage=1.65, feedback_capacitance=0.0),
        _linear(open_loop_gain=float("inf"), reference_resistance=(15e3, 18e3, 20e3, 22e3)),
    ],
    ids=["prototype", "mid-supply", "unequal"],
)
def test_settling_and_noise_agree(design: Design) -> None:
    need(spice.command_available())
    settling = Settling(design, DYNAMIC_CELLS)
    period = 0.3 * settling.shortest_period(0.01)
    found = spice.dynamic_reading(design, DYNAMIC_CELLS, 2, column=1, period=period)
    scale = np.abs(settling.settled[2] - design.readout.reference_voltage).max()
    ours = settling.sampled_from_rest(period)[2]
    assert np.abs(ours - settling.settled[2]).max() > 0.01 * scale  # still on its way
    np.testing.assert_allclose(found.sampled, ours, atol=2e-4 * scale)
    np.testing.assert_allclose(found.settled, settling.settled[2], atol=2e-5 * scale)
    assert found.noise == pytest.approx(noise(design, DYNAMIC_CELLS).before_adc[2, 1], rel=2e-3)


@pytest.mark.parametrize("cells", [DYNAMIC_CELLS, DYNAMIC_CELLS / 3])
@pytest.mark.parametrize("feedback_capacitance", [0.0, 10e-12])
def test_the_loop_gain_agrees(cells: np.ndarray, feedback_capacitance: float) -> None:
    need(spice.command_available())
    no_limit = (-float("inf"), float("inf"))  # an amplifier at a limit does not hold its column
    design = _linear(feedback_capacitance=feedback_capacitance, column_capacitance=300e-12, supply=no_limit)
    found = spice.dynamic_reading(design, cells, 0, column=2)
    expected = stability(design, cells)
    assert found.phase_margin == pytest.approx(expected.phase_margin[0, 2], abs=1e-3)
    assert found.crossover == pytest.approx(expected.crossover[0, 2], rel=2e-5)


def test_an_amplifier_that_never_reaches_gain_1_has_no_margin() -> None:
    need(spice.command_available())
    found = spice.dynamic_reading(_linear(open_loop_gain=2.0), DYNAMIC_CELLS / 20, 0)
    assert np.isnan([found.phase_margin, found.crossover]).all()


def test_rows_that_are_sensed_have_the_same_dynamics() -> None:
    need(spice.command_available())
    design = _linear(reference_resistance=(15e3, 18e3, 20e3, 22e3)).with_circuit("row-amplifier")
    settling = Settling(design, DYNAMIC_CELLS)
    period = 0.3 * settling.shortest_period(0.01)
    found = spice.dynamic_reading(
        design, DYNAMIC_CELLS, 1, column=3, period=period
    )  # column 1 is driven, row 3 is judged
    signal = np.abs(settling.settled).max()
    np.testing.assert_allclose(found.sampled, settling.sampled_from_rest(period)[:, 1], atol=2e-4 * signal)
    assert found.noise == pytest.approx(noise(design, DYNAMIC_CELLS).before_adc[3, 1], rel=2e-3)
    assert found.phase_margin == pytest.approx(stability(design, DYNAMIC_CELLS).phase_margin[3, 1], abs=0.01)


@pytest.mark.parametrize("seed", [*range(2), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 14))])
def test_random_boards_in_time_agree(seed: int) -> None:
    """Early samples, settled readings and phase margins within 2 % of an independent simulator."""
    need(spice.command_available())
    design = random_board_in_time(seed)
    readout: dict[str, object] = {"columns": "parallel", "idle_columns": "float"}
    if not design.board.circuit.has_amplifiers:
        readout |= {"circuit": "inverting-amplifier", "gain_bandwidth": 1e6}
    design = design.replace(readout=readout, adc={"acquisition_time": 0.0})
    cells = 10 ** np.random.default_rng(seed).uniform(3.7, 5.0, design.array.shape)
    settling, turned = Settling(design, cells), design.board.transposed
    line = design.board.shape[0] - 1
    period = 0.3 * settling.shortest_period(0.01)
    found = spice.dynamic_reading(design, cells, line, period=period)

    def of_line(values: np.ndarray) -> np.ndarray:
        return values[:, line] if turned else values[line]

    settled = of_line(settling.settled)
    signal = np.abs(settled).max()
    np.testing.assert_allclose(found.settled, settled, atol=0.02 * signal)
    np.testing.assert_allclose(found.sampled, of_line(settling.sampled_from_rest(period)), atol=0.02 * signal)
    margin = float(of_line(stability(design, cells).phase_margin)[0])
    if np.isfinite(margin) or np.isfinite(found.phase_margin):
        assert found.phase_margin == pytest.approx(margin, abs=0.01)


def test_a_swing_limits_the_output() -> None:
    need(spice.command_available())
    design = _linear(supply=(-5.0, 1.5))
    found = spice.dynamic_reading(design, DYNAMIC_CELLS, 2)
    assert found.settled.max() == pytest.approx(1.5, abs=1e-3)


def test_other_simulators_take_the_commands_for_comments() -> None:
    text = spice.dynamic_netlist(prototype(), DYNAMIC_CELLS, 0)
    cards = [line for line in text.splitlines()[1:] if not line.startswith("*")]
    assert not any("control" in card for card in cards)
    assert sum(card.split()[0] in (".op", ".tran", ".noise") for card in cards) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"readout": {"gain_bandwidth": float("inf")}}, "nothing takes time"),
        ({"array": {"sheet": "continuous"}}, "sliced sheet"),
        ({"readout": {"circuit": "voltage-divider"}}, "dynamics are modelled for amplifiers"),
    ],
)
def test_what_has_no_dynamics_is_refused(change: dict[str, dict[str, object]], message: str) -> None:
    with pytest.raises(InputError, match=message):
        spice.dynamic_netlist(prototype().replace(**change), DYNAMIC_CELLS, 0)
