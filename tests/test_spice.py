"""ngspice as a judge: its readings of a frame against the nodal reference, and the solver against ngspice."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from designs import amplifier
from needs import need

from ohmskin.bench import search
from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import scan
from ohmskin.circuits.spice import (
    command_available,
    library_available,
    run_command,
    run_control,
    run_library,
    spice_scan,
)
from ohmskin.common.extras import install_command
from ohmskin.errors import MissingExtra, SolverError

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
