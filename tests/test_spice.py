"""ngspice as a judge: both ways of running it against the nodal reference, and the solver against ngspice."""

from __future__ import annotations

import resource
import sys

import numpy as np
import pytest
from designs import amplifier, divider
from needs import need
from variety import any_design

from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import scan
from ohmskin.circuits.spice import _ngspice as spice
from ohmskin.common.extras import install_command
from ohmskin.errors import MissingExtra, SolverError


@pytest.fixture
def library() -> None:
    need(spice.available())


@pytest.fixture
def command() -> None:
    need(spice.command_available())


@pytest.mark.usefixtures("library")
@pytest.mark.parametrize("seed", range(150))
def test_scan_agrees_with_ngspice(seed: int) -> None:
    """Random small grids of every kind, to 1e-6 of each reading."""
    design, cells = any_design(seed)
    signal = spice.spice_scan(design, cells)
    np.testing.assert_allclose(scan(design, cells).volts, signal, rtol=1e-6, atol=1e-12)


@pytest.mark.usefixtures("command")
@pytest.mark.parametrize("seed", range(150))
def test_the_sweep_agrees_with_the_reference(seed: int) -> None:
    design, cells = any_design(seed)
    np.testing.assert_allclose(spice.command_scan(design, cells), reference_volts(design, cells), rtol=1e-7, atol=1e-11)


@pytest.mark.usefixtures("library")
def test_a_board_sized_grid() -> None:
    cells = 10 ** np.random.default_rng(7).uniform(4, 6, (16, 16))
    design = amplifier(16, 16, lead=25.0, segment=1.0, open_loop_gain=1e5, offset_voltage=1e-3)
    np.testing.assert_allclose(scan(design, cells).volts, spice.spice_scan(design, cells), rtol=1e-9)


@pytest.mark.usefixtures("library")
def test_results_are_released() -> None:
    """PySpice left alone keeps every circuit and every result."""
    cells = np.full((12, 12), 1e4)
    design = divider(12, 12, idle_columns="load", row_segment=1.0, column_segment=1.0)
    spice.spice_scan(design, cells)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(10):
        spice.spice_scan(design, cells)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < 20_000  # KiB, over 120 operating points


@pytest.mark.usefixtures("library")
def test_ngspice_is_quiet(capfd: pytest.CaptureFixture[str]) -> None:
    spice.spice_scan(amplifier(2, 2, supply=(0.0, 1.0)), np.full((2, 2), 100.0))
    assert capfd.readouterr() == ("", "")


@pytest.mark.usefixtures("library")
def test_complex_results() -> None:
    """A pole at 1 kHz: half the power there."""
    text = "* low pass\nV1 in 0 AC 1\nR1 in out 1k\nC1 out 0 159.15494309189535n\n.ac lin 1 1k 1k\n.end\n"
    assert abs(spice.run_library(text)["out"][0]) == pytest.approx(np.sqrt(0.5), rel=1e-9)


IMPOSSIBLE = "* two sources at odds\nV1 a 0 1\nV2 a 0 2\nR1 a 0 1\n.op\n.end\n"
NONSENSE = "* no such part\nY1 a 0 1\n.op\n.end\n"


@pytest.mark.usefixtures("library")
@pytest.mark.parametrize("text", [IMPOSSIBLE, NONSENSE])
def test_library_failures_are_ours_and_leave_no_trace(text: str) -> None:
    with pytest.raises(SolverError, match="ngspice"):
        spice.run_library(text)
    assert spice.spice_scan(amplifier(1, 1), [[1e3]]) == pytest.approx(1.0)


@pytest.mark.usefixtures("command")
@pytest.mark.parametrize("runner", [spice.run_command, spice.run_control])
@pytest.mark.parametrize("text", [IMPOSSIBLE, NONSENSE])
def test_command_failures_are_ours(runner: object, text: str) -> None:
    assert callable(runner)
    with pytest.raises(SolverError, match="ngspice"):
        runner(text)


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NGSPICE_LIBRARY_PATH", raising=False)
    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    assert "libngspice0" in str(spice.available())
    with pytest.raises(MissingExtra, match="libngspice0"):
        spice.spice_scan(amplifier(1, 1), [[1e3]])


def test_a_library_that_cannot_be_loaded_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NGSPICE_LIBRARY_PATH", "/nowhere/libngspice.so")
    for _ in range(2):  # PySpice alone fails differently the second time
        assert "cannot be loaded from /nowhere/libngspice.so" in str(spice.available())


def test_a_missing_pyspice_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NGSPICE_LIBRARY_PATH", "libngspice.so.0")
    monkeypatch.setitem(sys.modules, "PySpice.Spice.NgSpice.Shared", None)
    assert install_command("spice") in str(spice.available())


def test_a_missing_command_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert "apt install ngspice" in str(spice.command_available())
    with pytest.raises(MissingExtra, match="ngspice"):
        spice.command_scan(amplifier(1, 1), [[1e3]])
