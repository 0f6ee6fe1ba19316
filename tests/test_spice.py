"""ngspice as a judge: its sweep of a frame against the nodal reference, and the solver against ngspice."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from designs import amplifier
from needs import need
from variety import any_design

from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import scan
from ohmskin.circuits.spice import command_available, command_scan, run_command, run_control
from ohmskin.errors import MissingExtra, SolverError


@pytest.mark.parametrize("seed", range(60))
def test_the_sweep_agrees_with_the_reference_and_with_the_solver(seed: int) -> None:
    """Random small grids of every kind."""
    need(command_available())
    design, cells = any_design(seed)
    read = command_scan(design, cells)
    np.testing.assert_allclose(read, reference_volts(design, cells), rtol=1e-7, atol=1e-11)
    np.testing.assert_allclose(scan(design, cells).volts, read, rtol=1e-6, atol=1e-11)


def test_a_board_sized_grid() -> None:
    need(command_available())
    cells = 10 ** np.random.default_rng(7).uniform(4, 6, (16, 16))
    design = amplifier(16, 16, lead=25.0, segment=1.0, open_loop_gain=1e5, offset_voltage=1e-3)
    np.testing.assert_allclose(scan(design, cells).volts, command_scan(design, cells), rtol=1e-9)


def test_a_circuit_without_a_sweep_is_read_row_by_row() -> None:
    need(command_available())
    design = amplifier(2, 1, supply=(-0.5, 3.3), offset_voltage=1e-3)
    assert command_scan(design, [[0.0], [1e3]]) == pytest.approx(3.3)


@pytest.mark.parametrize("runner", [run_command, run_control])
@pytest.mark.parametrize(
    "text",
    [
        "* two sources at odds\nV1 a 0 1\nV2 a 0 2\nR1 a 0 1\n.op\n.end\n",
        "* no such part\nY1 a 0 1\n.op\n.end\n",
    ],
)
def test_failures_of_the_command_are_ours(runner: Callable[[str], object], text: str) -> None:
    need(command_available())
    with pytest.raises(SolverError, match="ngspice"):
        runner(text)


def test_a_missing_command_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert "apt install ngspice" in str(command_available())
    with pytest.raises(MissingExtra, match="ngspice"):
        command_scan(amplifier(1, 1), [[1e3]])
