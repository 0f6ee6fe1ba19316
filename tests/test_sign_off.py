"""What a reviewer signs: bounds beside each other, parts at the end of their lives, ratings, and the papers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import worst_boards
from hypothesis import given, settings
from hypothesis import strategies as st

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


def test_a_stranger_sends_neither_papers_nor_ratings() -> None:
    design = small(parts=RATED, document={"number": "DVR-7"})
    assert not {"document", "parts"} & design.model_dump().keys()
    with pytest.raises(InputError, match="only a file of your own"):
        config.parse(design.model_dump(exclude_none=True) | {"parts": RATED}, Design, source="a board")


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), in_time=st.booleans())
def test_boards_bear_together_what_each_bears_alone(seed: int, in_time: bool) -> None:
    """The block elimination of many boards against the adjoint method of one, saturated outputs and open cells too."""
    design = worst_boards.random_board_in_time(seed) if in_time else worst_boards.random_board(seed, largest=5)
    random = np.random.default_rng(seed)
    if seed % 3 == 0 and design.readout.circuit != "voltage-feedback":
        design = design.replace(drive={"idle_rows": "pull", "idle_row_resistance": 1e4})
    cells = 10 ** random.uniform(3.0, 5.0, (3, *design.array.shape))
    cells[0, 0, 0] = np.inf
    boards = Boards.of(design)
    together = operating_points(design, boards, cells)
    for number, frame in enumerate(cells):
        alone = operating_point(design, frame)
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
