"""Variations of a design: the Pareto front, and remedies that really mend."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from verified import AMPLIFIED, complete

from ohmskin.cell import Percolation
from ohmskin.circuits import Design, Requirement
from ohmskin.cli import run
from ohmskin.verification import Subject, Variation, best_carbon_black, explore, prototype, remedies, verify
from ohmskin.verification._explore import (
    AVERAGING,
    KNOWN_FRACTION,
    MOST_BITS,
    _combinations,
    _judge,
    _Judged,
    _judged,
    _more_bits,
    _scaled,
    pareto,
)

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
    subject = Subject(prototype())
    own, switch, coarse, saturated = (
        _judged(subject, changes)
        for changes in ({}, {"row switch": 0.1}, {"ADC bits": -4.0}, {"reference resistor": 4.0})
    )
    assert switch.reading_error_percent < 0.6 * own.reading_error_percent
    assert coarse.resolution_kpa > 2 * own.resolution_kpa
    assert not np.isfinite(saturated.reading_error_percent)


@pytest.mark.slow
def test_a_remedy_keeps_the_requirement_and_half_of_it_does_not() -> None:
    asked = (Requirement(id="R", quantity="crosstalk", max=0.3),)
    subject = Subject(prototype().replace(array={"rows": 2, "columns": 2}))
    found = {remedy.part: remedy for remedy in remedies(subject, asked)}
    lead = found["array.row_lead"]
    assert lead.after <= 0.3 < lead.before
    assert lead.after == pytest.approx(0.3, rel=0.1)
    mended = _scaled(subject.design, "array.row_lead", lead.factor)
    assert verify(mended, requirements=asked).outcome == "pass"
    assert "readout.bias_current" not in found  # not even without it
    assert "array.row_lead times" in lead.line


FAST = prototype().replace(operation={"frame_rate": 30e3, "baudrate": 5e7})


def test_a_frame_rate_costs_settling_until_the_line_is_full() -> None:
    found = [_judged(Subject(FAST), {"frame rate": factor}) for factor in (0.5, 1.0, 2.0, 30.0)]
    assert [variation.frame_rate_hz for variation in found] == [15e3, 30e3, 60e3, 9e5]
    slow, own, fast, beyond = (variation.settling_error_percent for variation in found)
    assert slow < 0.1 * own < 0.01 * fast < np.inf
    assert beyond == np.inf
    assert "frame rate" not in dict(_combinations_of(prototype().replace(operation={"frame_rate": None})))


def _combinations_of(design: Design) -> list[tuple[str, float]]:
    return [item for changes in _combinations(Subject(design), 40) for item in changes.items()]


def test_no_combination_is_judged_twice() -> None:
    tried = list(_combinations(Subject(FAST), 60))
    assert len(tried) == 60
    assert len({frozenset(changes.items()) for changes in tried}) == 60


def test_settling_that_nobody_can_see_decides_nothing_and_prints_as_little() -> None:
    one, other = (Variation({"row switch": share}, 1.0, 1.0, 1.0, share * 1e-85) for share in (0.1, 3.0))
    assert one.figures == other.figures
    assert "< 1·10⁻⁹ %" in one.line
    assert "0.25 %" in Variation({}, 1.0, 1.0, 1.0, 0.25).line


def test_cells_that_touch_have_no_percolation() -> None:
    cells = {"rest_resistance": 10e3, "full_scale_resistance": 2e3, "full_scale_kpa": 40.0}
    axes = {axis for axis, _ in _combinations_of(prototype().replace(cells=cells))}
    assert "carbon black" not in axes
    assert "carbon black" in {axis for axis, _ in _combinations_of(prototype())}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("quantity", "limits", "design", "parts"),
    [
        ("pressure_resolution", {"max": 5.0, "unit": "Pa"}, prototype(), {"adc.bits", "drive.voltage", AVERAGING}),
        ("resolution", {"max": 2.0}, prototype(), {"adc.bits"}),
        ("phase_margin", {"min": 85.0}, prototype(), {"readout.feedback_capacitance", "readout.column_capacitance"}),
        ("settling_error", {"max": 0.1}, FAST, {"operation.frame_rate", "readout.gain_bandwidth"}),
        ("lost_frames", {"max": 0.0}, FAST.replace(operation={"baudrate": 1e6}), {"operation.frame_rate"}),
        (
            "output_headroom",
            {"min": 0.2},
            prototype().replace(readout={"reference_resistance": 40e3}),
            {"drive.voltage", "readout.reference_resistance"},
        ),
    ],
)
def test_remedies_of_other_quantities_mend_and_not_by_more_than_needed(
    quantity: str, limits: dict[str, Any], design: Design, parts: set[str]
) -> None:
    asked = (Requirement.model_validate({"id": "R", "quantity": quantity} | limits),)
    assert verify(design, requirements=asked).outcome == "fail"
    found = {remedy.part: remedy for remedy in remedies(Subject(design), asked)}
    assert parts <= set(found)
    for part, remedy in found.items():
        if part == AVERAGING:
            assert remedy.factor == np.ceil((remedy.before / 0.005) ** 2)
            continue
        if part == "adc.bits":
            mended, nearly = (design.replace(adc={"bits": int(remedy.factor) - less}) for less in (0, 1))
        else:
            short = 1 + 0.9 * (remedy.factor - 1)
            mended, nearly = (_scaled(design, part, factor) for factor in (remedy.factor, short))
        assert verify(mended, requirements=asked).outcome == "pass"
        assert verify(nearly, requirements=asked).outcome == "fail"
        assert remedy.line.startswith("R: ")


@pytest.mark.slow
def test_bits_mend_a_reading_as_far_as_steps_spoil_it() -> None:
    subject = Subject(prototype().replace(array={"rows": 2, "columns": 2}, adc={"bits": 7}))
    for limit, bits in ((0.8, 9), (0.35, None)):  # leads and offsets leave 0.38 % of crosstalk
        asked = Requirement(id="R", quantity="crosstalk", max=limit)
        missed = _judge(subject, asked)
        assert missed is not None
        found = _more_bits(subject, asked, missed)
        assert (found and found.factor) == bits
        for fewer in range(8, bits or 8):
            coarse = subject.design.replace(adc={"bits": fewer})
            assert verify(coarse, requirements=(asked,)).outcome == "fail"


def test_no_converter_is_judged_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    subject, looks = Subject(prototype()), list[int]()

    def judge(subject: Subject, requirement: Requirement) -> _Judged:
        assert subject.design.adc is not None
        looks.append(subject.design.adc.bits)
        return _Judged(1.0, "%", looks[-1] == MOST_BITS)

    monkeypatch.setattr("ohmskin.verification._explore._judge", judge)
    found = _more_bits(subject, Requirement(id="R", quantity="crosstalk", max=1.0), _Judged(2.0, "%", False))
    assert found is not None
    assert found.factor == MOST_BITS
    assert sorted(looks) == list(range(looks[1], MOST_BITS + 1))


def test_mixtures_whose_last_path_breaks_are_no_candidates() -> None:
    cells = {"rest_resistance": 10e3, "full_scale_resistance": 30e3, "full_scale_kpa": 100.0}
    subject = Subject(prototype().replace(cells=cells))
    law = Percolation(KNOWN_FRACTION, subject.rest, subject.pressed / subject.rest - 1)
    assert np.isinf(law.sensitivities(np.array([0.009]))).all()
    best = best_carbon_black(subject)
    assert best is not None
    assert np.isfinite(best.resolution_kpa)


def test_the_fraction_of_the_best_resolution_is_that_of_this_readout() -> None:
    """P1: the law's own trade-off, found again by judging each mixture through the whole design."""
    subject = Subject(prototype())
    fractions = (0.0125, 0.015, 0.02, 0.05)
    kpa = {f: _judged(subject, {"carbon black": f}).resolution_kpa for f in fractions}
    assert kpa[0.015] == pytest.approx(_judged(subject, {}).resolution_kpa, rel=1e-6)  # the cell's own fraction
    law = Percolation(KNOWN_FRACTION, subject.rest, subject.pressed / subject.rest - 1)
    for fraction in (0.02, 0.05):
        # Less sensitive and more conductive mixtures give larger outputs: noise over the slope dV/dp of V = Rref/R.
        rest = float(law.rest_resistance(fraction))
        change = float(np.asarray(law.sensitivities(np.array([fraction])))[0])
        design = subject.design.replace(
            cells={"rest_resistance": rest, "full_scale_resistance": rest * (1 + change), "full_scale_kpa": 15.5}
        )
        asked = [Requirement(id="R", quantity="pressure_resolution", max=1e9)]
        (result,) = verify(design, requirements=asked).results
        assert result.measurement is not None
        assert kpa[fraction] == pytest.approx(result.measurement.value, rel=1e-6)


SMALL = AMPLIFIED.replace("rows = 3", "rows = 2").replace("columns = 3", "columns = 2")


def test_the_command_writes_a_table_and_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "design.toml"
    file.write_text(complete(SMALL) + '[[requirement]]\nid = "R"\nquantity = "crosstalk"\nmax = 0.3\n')
    assert run(["explore", str(file), "-o", str(tmp_path / "out"), "--points", "3"]) == 0
    with (tmp_path / "out" / "explore.csv").open() as table:
        rows = list(csv.DictReader(table))
    assert [row["best_carbon_black"] for row in rows] == ["0", "0", "0", "1"]  # it follows the three points
    assert "1" in {row["pareto_front"] for row in rows}
    assert "<svg" in (tmp_path / "out" / "explore.svg").read_text()
    said = capsys.readouterr().out
    assert "the design itself" in said
    assert "R: array.row_lead times" in said


def test_what_is_not_known_is_neither_zero_nor_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A divider without capacitances and without a full scale in kPa, at a stated frame rate."""
    file = tmp_path / "design.toml"
    file.write_text(
        "[array]\nrows = 2\ncolumns = 2\nrow_lead = 50.0\n[drive]\nvoltage = 3.3\n"
        '[readout]\ncircuit = "voltage-divider"\nreference_resistance = 1e4\nidle_columns = "load"\n'
        "[cells]\nrest_resistance = 1e5\nfull_scale_resistance = 1e4\n[operation]\nframe_rate = 100.0\n"
        '[[requirement]]\nid = "R"\nquantity = "latency"\nmax = 1.0\n'
    )
    assert run(["explore", str(file), "-o", str(tmp_path / "out"), "--points", "3"]) == 0
    said = capsys.readouterr().out
    assert "nan" not in said
    assert " 0 %" not in said
    assert "settling: not known, missing: readout.column_capacitance" in said
    assert "resolution: not known, missing: cells.full_scale_kpa" in said
    with (tmp_path / "out" / "explore.csv").open() as table:
        rows = list(csv.DictReader(table))
    assert {row["settling_error_percent"] for row in rows} == {row["resolution_kpa"] for row in rows} == {""}
    assert "1" in {row["pareto_front"] for row in rows}


def test_other_idle_lines_and_circuits_come_first() -> None:
    """A matrix as makers build it: rows on pull-downs, one load behind a switch."""
    tables = {
        "array": {"rows": 2, "columns": 2, "row_lead": 5.0},
        "drive": {"voltage": 5.0, "idle_rows": "pull", "idle_row_resistance": 10e3},
        "readout": {"circuit": "voltage-divider", "reference_resistance": 10e3},
        "adc": {"bits": 12, "range": [0.0, 5.0]},
        "cells": {"rest_resistance": 1e5, "full_scale_resistance": 5e3},
    }
    subject = Subject(Design.model_validate(tables))
    crosstalk = Requirement(id="D1", quantity="crosstalk", max=2.0, unit="%")
    found = [remedy for remedy in remedies(subject, (crosstalk,)) if not remedy.factor]
    assert [remedy.part.split()[0] for remedy in found if remedy.kept] == ["a", "inverting"]
    for remedy in found:
        assert remedy.after < remedy.before
    named = [variation.name for variation in explore(subject, points=4)]
    assert named[0] == "the design itself"
    assert {remedy.part for remedy in found} <= set(named)
