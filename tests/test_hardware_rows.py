"""Requirements measured on a board behind a port: a sound board passes, a board with a known fault fails."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import Design, Requirement
from ohmskin.cli import run
from ohmskin.emulator import BoardSettings, PtyPort, Scene, SkinSettings, Stop, emulate
from ohmskin.verification import Report, prototype, verify

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
