"""What an engineer who signs a design asks of its verification: corners to solve alone, reasons, commands to type."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from worst_boards import asked, by_hand, stated

from ohmskin.circuits import Design, Requirement
from ohmskin.verification import Report, verify

WRITTEN = """
[array]
rows = 5
columns = 3
row_segment = 0.4
row_lead = { nominal = 12.0, tolerance = 0.4, matching = 0.05, package = 2, temperature_coefficient = 0.003 }
[drive]
voltage = { nominal = -0.6, tolerance = 0.005 }
[readout]
circuit = "inverting-amplifier"
reference_voltage = 0.7
reference_resistance = { nominal = 33e3, tolerance = 0.01, temperature_coefficient = 50e-6 }
offset_voltage = 0.5e-3
bias_current = 1e-9
supply = [0.02, 3.28]
[adc]
bits = 10
range = [0.0, 3.3]
offset_voltage = 2e-3
gain_error = 0.002
inl_steps = 1.0
[cells]
rest_resistance = { nominal = 15000.0, tolerance = 0.08 }
full_scale_resistance = 24000.0
full_scale_kpa = 40.0
[operation]
frame_rate = 100.0
baudrate = 921600
temperature_range = [263.15, 333.15]
"""


@pytest.fixture
def design(tmp_path: Path) -> Design:
    path = tmp_path / "design.toml"
    path.write_text(WRITTEN)
    return Design.load(path)


def _verified(design: Design, **asked: Any) -> Report:
    return verify(design, requirements=[Requirement(id="R", **asked)])


def test_named_corners_solved_alone_give_the_stated_errors(design: Design) -> None:
    report = verify(design, requirements=asked(design), samples=200)
    for quantity, value in stated(report).items():
        assert by_hand(design, quantity, report) == pytest.approx(value, rel=1e-6), quantity


def test_pressure_is_not_judged_without_noise_and_speed(design: Design) -> None:
    for quantity in ("pressure_rmse", "pressure_peak_error"):
        result = _verified(design, quantity=quantity, max=5.0, unit="%").results[0]
        assert result.outcome == "not run"
        assert "readout.gain_bandwidth" in result.reason


def test_failed_requirement_says_the_command_to_type(design: Design) -> None:
    report = replace(
        _verified(design, quantity="reading_error", max=0.1, unit="%"), explore_command="ohmskin explore design.toml"
    )
    assert report.to_mend(report.results[0]) == "ohmskin explore design.toml"
    assert "ohmskin explore design.toml" in report.markdown()
    kept = _verified(design, quantity="reading_error", max=50.0, unit="%")
    assert not replace(kept, explore_command="x").to_mend(kept.results[0])


def test_many_requirements_with_one_reason_take_one_line(design: Design) -> None:
    asked = [Requirement(id=f"R{k}", quantity="phase_margin", min=45.0) for k in range(5)]
    report = verify(design, requirements=asked)
    ((what, why),) = report.left_out_by_reason
    assert what == "R0, R1, R2, R3, R4"
    assert "readout.gain_bandwidth" in why


def test_what_is_left_out_follows_from_the_design(design: Design) -> None:
    """Nothing that is modelled for a circuit is listed, and no key that is given or has no effect."""
    asked = (Requirement(id="R", quantity="cell_voltage", max=10.0),)
    passive = design.with_circuit("voltage-divider")
    drifting = design.replace(
        cells={
            "rest_resistance": 10e3,
            "full_scale_resistance": 17.75e3,
            "spread": {"rest_resistance": {"temperature_coefficient": 1e-3}},
        }
    )
    amplified, divided, drifts = (verify(each, requirements=asked).record() for each in (design, passive, drifting))
    assert {"slewing", "1/f noise", "further amplifier poles", "cell temperature"} <= set(amplified.not_modelled)
    assert not {"slewing", "supply rejection", "output impedance"} & set(divided.not_modelled)
    assert "cell temperature" not in drifts.not_modelled
    assert amplified.not_given["readout.gain_bandwidth"] == "infinite"
    assert "readout.gain_bandwidth" not in divided.not_given
    assert "readout.column_capacitance" in divided.not_given
    given = verify(design.replace(readout={"column_capacitance": 1e-10}), requirements=asked).record()
    assert "readout.column_capacitance" not in given.not_given
    assert "readout.column_capacitance" in given.exact


def test_page_one_says_what_is_left_out(design: Design) -> None:
    report = _verified(design, quantity="cell_voltage", max=10.0)
    page = report.html()
    front = page[: page.index("The readout")]
    assert "slewing" in front
    assert "readout.gain_bandwidth" in front
    assert 'id="assumed"' in page
    assert "slewing" in report.markdown()


def test_error_in_own_quantity_names_its_line(design: Design, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        "def crash(design, cell):\n    return 1 / 0\n\ndef words(design, cell):\n    return 'a'\n"
    )
    asked = [Requirement(id=name, quantity=f"own.py:{name}", max=1.0) for name in ("crash", "words")]
    crash, words = verify(design, requirements=asked, folder=tmp_path, allow_code=True).results
    assert crash.outcome == words.outcome == "not run"
    assert crash.reason == "own.py, line 2: ZeroDivisionError: division by zero"
    assert words.reason.startswith("function(design, cell), or the number that it returns: ValueError")
