"""Variations of a design: the Pareto front, and remedies that really mend."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from verified import AMPLIFIED, complete

from ohmskin.circuits import Requirement
from ohmskin.cli import run
from ohmskin.verification import Subject, explore, prototype, remedies, verify
from ohmskin.verification._explore import _scaled, pareto

FIGURES = st.lists(st.tuples(*[st.floats(0, 10, allow_nan=False)] * 3), min_size=1, max_size=12)


@given(FIGURES)
def test_no_point_beats_the_front_and_every_other_is_beaten(points: list[tuple[float, float, float]]) -> None:
    figures = np.array(points)
    front = pareto(figures)
    assert front.any()
    for index, point in enumerate(figures):
        beaten = ((figures <= point).all(axis=1) & (figures < point).any(axis=1)).any()
        assert front[index] == (not beaten)


def test_a_point_without_a_figure_is_not_on_the_front() -> None:
    assert pareto(np.array([[1.0, np.nan, 1.0], [np.inf, 1.0, 1.0], [5.0, 5.0, 5.0]])).tolist() == [False, False, True]


def test_what_each_axis_buys() -> None:
    found = {variation.name: variation for variation in explore(Subject(prototype()), points=17)}
    own = found["the design itself"]
    assert found["row switch × 0.1"].reading_error_percent < 0.6 * own.reading_error_percent
    assert found["ADC bits -4"].resolution_kpa > 2 * own.resolution_kpa
    assert not np.isfinite(found["reference resistor × 4"].reading_error_percent)
    assert not found["reference resistor × 4"].front
    assert len(found) == 17


def test_a_remedy_keeps_the_requirement_and_half_of_it_does_not() -> None:
    asked = (Requirement(id="R", quantity="crosstalk", max=0.8),)
    subject = Subject(prototype())
    found = {remedy.part: remedy for remedy in remedies(subject, asked)}
    lead = found["array.row_lead"]
    assert lead.after <= 0.8 < lead.before
    assert lead.after == pytest.approx(0.8, rel=0.1)
    mended = _scaled(subject.design, "array.row_lead", lead.factor)
    assert verify(mended, requirements=asked).outcome == "pass"
    assert "readout.bias_current" not in found  # not even without it
    assert "array.row_lead times" in lead.line


def test_the_command_writes_a_table_and_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "design.toml"
    file.write_text(complete(AMPLIFIED) + '[[requirement]]\nid = "R"\nquantity = "crosstalk"\nmax = 0.5\n')
    assert run(["explore", str(file), "-o", str(tmp_path / "out"), "--points", "3"]) == 0
    with (tmp_path / "out" / "explore.csv").open() as table:
        rows = list(csv.DictReader(table))
    assert len(rows) == 3
    assert "1" in {row["pareto_front"] for row in rows}
    assert "<svg" in (tmp_path / "out" / "explore.svg").read_text()
    said = capsys.readouterr().out
    assert "the design itself" in said
    assert "R: array.row_lead times" in said
