"""What a reviewer signs: bounds beside each other, parts at the end of their lives, ratings, and the papers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import worst_boards
from hypothesis import given, settings
from hypothesis import strategies as st
from worst_boards import asked, by_hand, stated

from ohmskin.circuits import Boards, Design, Requirement, operating_point, operating_points
from ohmskin.common import config
from ohmskin.errors import InputError
from ohmskin.verification import Report, verify

SEARCHED = ("crosstalk", "reading_error", "output_headroom", "cell_power", "switch_current", "reference_voltage")
"""quantities that are right when they are small, but for the headroom"""


def small(**changes: Any) -> Design:
    tables: dict[str, Any] = {
        "array": {"rows": 2, "columns": 2, "row_lead": {"nominal": 70.0, "tolerance": 0.1}, "column_lead": 1.0},
        "drive": {"voltage": {"nominal": -1.0, "tolerance": 0.01, "end_of_life": 0.02}},
        "readout": {
            "circuit": "inverting-amplifier",
            "reference_resistance": {"nominal": 20e3, "tolerance": 0.01, "end_of_life": 0.03},
            "open_loop_gain": 1e5,
            "offset_voltage": 1e-3,
            "supply": (-0.2, 3.3),
        },
        "cells": {"rest_resistance": 10e3, "full_scale_resistance": 18e3},
    }
    for section, table in changes.items():
        tables[section] = {**tables.get(section, {}), **table}
    return config.parse(tables, Design, source="small.toml", folder=Path())


def judged(design: Design, *quantities: str, samples: int = 200, **limits: float) -> Report:
    wanted = [Requirement(id=name, quantity=name, max=limits.get(name, 1e9)) for name in quantities]
    return verify(design, requirements=wanted, samples=samples)


def test_no_other_bound_is_beyond_the_worst_case_and_new_parts_are_better() -> None:
    for result in judged(small(), *SEARCHED).results:
        assert result.measurement is not None
        bounds, worst = result.measurement.bounds, result.measurement.value
        assert bounds is not None
        assert bounds.initial is not None
        side = -1.0 if result.requirement.quantity.endswith("headroom") else 1.0
        ordered = [bounds.nominal, bounds.quantile_99, bounds.sampled, worst]
        assert (np.diff(side * np.array(ordered)) >= -1e-9 * abs(worst)).all(), result.requirement.id
        assert side * bounds.nominal < side * bounds.root_sum_square <= side * worst * (1 + 1e-2)
        assert side * bounds.initial < side * worst


def test_the_root_sum_of_squares_is_that_of_the_parts() -> None:
    """A cell alone under an ideal amplifier: its current through Rref, whose tolerance and drive's are relative."""
    design = small(
        array={"rows": 1, "columns": 1, "row_lead": 0.0, "column_lead": 0.0},
        readout={"open_loop_gain": np.inf, "offset_voltage": 0.0},
    )
    (result,) = judged(design, "reference_voltage").results
    assert result.measurement is not None
    assert result.measurement.bounds is not None
    nominal = 20e3 / 10e3
    assert result.measurement.bounds.nominal == pytest.approx(nominal)
    assert result.measurement.bounds.root_sum_square == pytest.approx(nominal * (1 + np.hypot(0.03, 0.02)))
    assert result.measurement.value == pytest.approx(nominal * 1.03 * 1.02)
    assert result.measurement.bounds.initial == pytest.approx(nominal * 1.01 * 1.01)


def test_monte_carlo_beside_a_worst_case_has_the_boards_and_the_judge_of_the_yield() -> None:
    wanted = [
        Requirement(id="worst", quantity="switch_current", max=1.0),
        Requirement(id="yield", quantity="switch_current", max=1.0, method="monte-carlo"),
    ]
    worst, drawn = (result.measurement for result in verify(small(), requirements=wanted, samples=300).results)
    assert worst is not None
    assert drawn is not None
    assert worst.bounds is not None
    assert worst.bounds.boards == len(drawn.samples) == 300
    assert worst.bounds.sampled == max(drawn.samples)
    assert worst.bounds.quantile_99 == drawn.value


RATED = {"driver": {"number": "SW-1", "current": 0.4e-3, "derating": 0.5}, "cell": {"voltage": 5.0}}


def test_a_rating_is_a_requirement_with_its_derating(tmp_path: Path) -> None:
    papers = {"number": "DVR-7", "revision": "C", "date": "2026-05-31"}
    report = judged(small(parts=RATED, document=papers), "crosstalk")
    by_id = {result.requirement.id: result for result in report.results}
    assert by_id["driver.current"].requirement.max == 0.2e-3
    assert by_id["driver.current"].outcome == "fail"  # two cells of 10 kohm at 1 V
    assert by_id["cell.voltage"].outcome == "pass"
    assert report.exit_code == 1
    report.write(tmp_path)
    for name in ("report.html", "summary.md"):
        text = (tmp_path / name).read_text()
        for words in ("DVR-7", "2026-05-31", "SW-1", "200 µA (50 %)", "root sum of squares", "end of life"):
            assert words in text, (name, words)
    record = json.loads((tmp_path / "report.json").read_text())
    assert record["document"] == {"document": "DVR-7", "revision": "C", "date": "2026-05-31"}
    assert record["parts"]["driver"]["current"] == 0.4e-3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"parts": {"driver": {"voltage": 3.0}}}, "parts.driver.voltage"),
        ({"parts": {"driver": {"current": 0.1, "derating": 50}}}, "parts.driver.derating"),
        ({"document": {"date": "31.5.2026"}}, "expected a date as 2026-05-31"),
        ({"document": {"number": "a\nb"}}, "document.number"),
        ({"drive": {"voltage": {"nominal": -1.0, "tolerance": 0.02, "end_of_life": 0.01}}}, "less than the initial"),
    ],
)
def test_papers_that_say_nothing_are_bad_input(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        small(**changes)


def test_a_board_sends_neither_papers_nor_ratings() -> None:
    design = small(parts=RATED, document={"number": "DVR-7"})
    assert not {"document", "parts"} & design.model_dump().keys()
    with pytest.raises(InputError, match="only a file of your own"):
        config.parse(design.model_dump(exclude_none=True) | {"parts": RATED}, Design, source="a board")


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), in_time=st.booleans())
def test_boards_bear_together_what_each_bears_alone(seed: int, in_time: bool) -> None:
    """A stack of boards with values of their own against each board, saturated outputs and open cells too."""
    design = worst_boards.random_board_in_time(seed) if in_time else worst_boards.random_board(seed, largest=5)
    random = np.random.default_rng(seed)
    if seed % 3 == 0 and design.readout.circuit != "voltage-feedback":
        design = design.replace(drive={"idle_rows": "pull", "idle_row_resistance": 1e4})
    cells = 10 ** random.uniform(3.0, 5.0, (3, *design.array.shape))
    cells[0, 0, 0] = np.inf
    nominal = Boards.of(design)
    varied = sorted(Boards.names().keys() - {"reference_voltage", "open_loop_gain"})
    boards = replace(nominal, **{name: getattr(nominal, name) * random.uniform(0.8, 1.2, (3, 1)) for name in varied})
    together = operating_points(design, boards, cells)
    for number, frame in enumerate(cells):
        alone = operating_point(boards.design(design, number), frame)
        for name in type(alone).names():
            expected = getattr(alone, name)
            least = 1e-9 * np.abs(expected).max() + 1e-24
            np.testing.assert_allclose(getattr(together, name)[number], expected, rtol=1e-6, atol=least)


def test_an_output_at_its_limit_bears_current_too() -> None:
    """All outputs saturate: the driver still feeds its row, by the loads that the amplifiers then are."""
    design = small(readout={"supply": (-0.2, 0.5), "offset_voltage": 0.0})
    point = operating_point(design, np.full((2, 2), 10e3))
    ohms = 10e3 + 20e3 + 1.0  # two columns in parallel, at which another grounded row hangs
    least = 2 * (1.0 - 0.5) / ohms
    assert (point.driver_current > least).all()
    assert (point.output_current > 0.0).all()


# What an engineer who signs a design asks of its verification: corners to solve alone, reasons, commands to type


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
