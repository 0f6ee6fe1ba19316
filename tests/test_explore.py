"""Variations of a design: the Pareto front, and remedies that really mend."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from verified import AMPLIFIED, complete

from ohmskin.circuits import Design, Requirement
from ohmskin.cli import run
from ohmskin.verification import DesignUnderTest, Variation, explore, prototype, remedies, verify
from ohmskin.verification._explore import wirings


def _scaled(design: Design, key: str, factor: float) -> Design:
    section, name = key.split(".")
    return design.replace(**{section: {name: factor * getattr(getattr(design, section), name)}})


FAST = prototype().replace(operation={"frame_rate": 30e3, "baudrate": 5e7})


def test_settling_that_nobody_can_see_decides_nothing_and_prints_as_little() -> None:
    one, other = (Variation({"row switch": share}, 1.0, 1.0, 1.0, share * 1e-85) for share in (0.1, 3.0))
    assert one.figures == other.figures
    assert "< 1·10⁻⁹ %" in one.line
    assert "0.25 %" in Variation({}, 1.0, 1.0, 1.0, 0.25).line


@pytest.mark.slow
@pytest.mark.parametrize(
    ("quantity", "limits", "design", "parts"),
    [
        (
            "pressure_resolution",
            {"max": 5.0, "unit": "Pa"},
            prototype(),
            {"adc.bits", "drive.voltage", "frames averaged"},
        ),
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
    found = {remedy.part: remedy for remedy in remedies(DesignUnderTest(design), asked)}
    assert parts <= set(found)
    for part, remedy in found.items():
        if part == "frames averaged":
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


SMALL = AMPLIFIED.replace("rows = 3", "rows = 2").replace("columns = 3", "columns = 2")


def test_the_command_writes_a_table_and_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "design.toml"
    file.write_text(complete(SMALL) + '[[requirement]]\nid = "R"\nquantity = "crosstalk"\nmax = 0.3\n')
    assert run(["explore", str(file), "-o", str(tmp_path / "out"), "--points", "3"]) == 0
    with (tmp_path / "out" / "explore.csv").open() as table:
        rows = list(csv.DictReader(table))
    assert [row["best_carbon_black"] for row in rows] == ["0", "0", "0", "1"]  # it follows the three points
    names = ("reading_error_percent", "crosstalk_percent", "resolution_kpa")  # settling and rate are all alike
    figures = np.array([[float(row[name]) for name in names] for row in rows[:3]])
    for row, point in zip(rows, figures, strict=False):  # the best carbon black is another cell
        beaten = ((figures <= point).all(axis=1) & (figures < point).any(axis=1)).any()
        assert row["pareto_front"] == str(int(not beaten))
    assert {row["pareto_front"] for row in rows} == {"0", "1"}
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


def test_a_load_beyond_its_best_value_is_made_smaller_and_dominated_rows_are_not_on_the_front(tmp_path: Path) -> None:
    """Cells of 500 to 200 ohm: at a load of 10 kohm the array uses 0.7 % of the converter, at sqrt(500 * 200) 10 %.

    The design states no capacitance, so that settling errors are not known of any variation but the fastest.
    """
    file = tmp_path / "design.toml"
    file.write_text(
        "[array]\nrows = 2\ncolumns = 2\n[drive]\nvoltage = 3.3\n"
        '[readout]\ncircuit = "voltage-divider"\nreference_resistance = 1e4\nidle_columns = "load"\n'
        "[adc]\nbits = 12\nrange = [0.0, 3.3]\n"
        "[cells]\nrest_resistance = 500.0\nfull_scale_resistance = 200.0\n[operation]\nframe_rate = 100.0\n"
        '[[requirement]]\nid = "D6"\nquantity = "adc_range_used"\nmin = 8.0\nunit = "%"\n'
    )
    dut = DesignUnderTest(Design.load(file))
    told: list[tuple[int, int]] = []
    mended = list(remedies(dut, 3 * dut.design.requirement, progress=lambda done, total, _: told.append((done, total))))
    assert told == [(0, 3), (1, 3), (2, 3)]
    (remedy,) = [one for one in mended[: len(mended) // 3] if one.part == "readout.reference_resistance"]
    assert remedy.factor < 1.0
    found = explore(dut, points=14)
    best = next(one for one in found if one.changes.get("reference resistor") == pytest.approx(316 / 1e4, rel=0.01))
    own = found[0]
    assert best.reading_error_percent < own.reading_error_percent
    assert best.crosstalk_percent < own.crosstalk_percent
    assert not own.front
    assert any(one.front for one in found)


@pytest.mark.slow
def test_processes_side_by_side_find_the_same() -> None:
    dut = DesignUnderTest(prototype())
    alone, side_by_side = (sorted(v.line for v in explore(dut, points=4, jobs=jobs)) for jobs in (1, 2))
    assert alone == side_by_side


def test_what_was_found_until_a_stop_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ohmskin.cli import explore as command

    def stopped(*_: object, tell: Callable[..., None], **more: object) -> list[Variation]:
        for number, one in enumerate(explore(DesignUnderTest(prototype()), points=2), 1):
            tell(number, 9, one)
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "explore", stopped)
    file = Path(__file__).parents[1] / "verification" / "prototype.toml"
    assert run(["explore", str(file), "-o", str(tmp_path / "out")]) == 130
    with (tmp_path / "out" / "explore.csv").open() as table:
        assert len(list(csv.DictReader(table))) == 2


def test_other_idle_lines_and_circuits_come_first() -> None:
    """A matrix as makers build it: rows on pull-downs, one load behind a switch."""
    tables = {
        "array": {"rows": 2, "columns": 2, "row_lead": 5.0},
        "drive": {"voltage": 5.0, "idle_rows": "pull", "idle_row_resistance": 10e3},
        "readout": {"circuit": "voltage-divider", "reference_resistance": 10e3},
        "adc": {"bits": 12, "range": [0.0, 5.0]},
        "cells": {"rest_resistance": 1e5, "full_scale_resistance": 5e3},
    }
    dut = DesignUnderTest(Design.model_validate(tables))
    crosstalk = Requirement(id="D1", quantity="crosstalk", max=2.0, unit="%")
    found = [remedy for remedy in remedies(dut, (crosstalk,)) if not remedy.factor]
    assert [remedy.part.split()[0] for remedy in found if remedy.kept] == ["a", "inverting"]
    for remedy in found:
        assert remedy.after < remedy.before
    named = [variation.name for variation in explore(dut, points=4)]
    assert named[0] == "the design itself"
    assert {remedy.part for remedy in found} <= set(named)
    assert "idle rows at the reference" in named
    grounded = dut.with_design(dut.design.replace(drive={"idle_rows": "ground", "idle_row_resistance": np.inf}))
    assert set(wirings(dut)) - set(wirings(grounded)) == {"idle rows at the reference"}
