"""A bounded search for wrong readings, the findings of past searches, and what the search itself must notice."""

from __future__ import annotations

import json
import re
from math import inf

import numpy as np
import pytest
from click.testing import CliRunner

from ohmskin.bench import search
from ohmskin.bench._reference import Indeterminate, reference_volts
from ohmskin.circuits import Design, scan, scan_batch
from ohmskin.errors import SolverError


@pytest.mark.parametrize("family", search.FAMILIES)
def test_a_search_of_each_family_finds_nothing(family: str) -> None:
    tally = search.Tally()
    for number in range(25):
        search.check(family, number, tally)
    assert tally.designs == 25
    assert not tally.findings


def feedback(cells: object, *, gain: float = inf, offset: float = 0.0, **array: object) -> Design:
    rows, columns = np.shape(cells)
    return Design.model_validate(
        {
            "array": {"rows": rows, "columns": columns} | array,
            "drive": {"voltage": -1.0},
            "readout": {
                "circuit": "voltage-feedback",
                "reference_resistance": 1000.0,
                "open_loop_gain": gain,
                "offset_voltage": offset,
            },
        }
    )


def test_shorts_among_ideal_and_real_lines_keep_the_bound() -> None:
    """Conductances that stand for shorts tie with each other; LU interchanged rows, and the bound was broken."""
    cells = [[0.0, 0.0, 0.0], [0.0, 0.0, 1e4]]
    design = feedback(cells, gain=1e5, row_lead=17.3, column_lead=[4.29, 20.7, 0.0])
    result = scan(design, cells)
    exact = reference_volts(design, cells)
    assert np.abs(result.volts - exact).max() <= result.error_bound * np.abs(exact).max()
    assert result.error_bound < 1e-10
    assert exact[0, 2] == pytest.approx(-0.98293, abs=1e-5)


@pytest.mark.parametrize(
    ("cells", "parts", "message"),
    [
        ([[0.0, 1e4], [1e4, 1e4]], {"offset": 1e-3}, "the driver of row 0 and the end of column 0"),
        ([[0.0], [1e4]], {"offset": 1e-3}, "the driver of row 0 and the end of column 0"),
        ([[0.0, 0.0]], {"gain": 1e5}, "the driver of row 0 and the end of column 0"),
        ([[0.0, 0.0], [1e4, 1e4]], {"row_lead": 1.0}, "the ends of columns 0 and 1"),
        ([[0.0, 1e4], [0.0, 1e4]], {"column_lead": 1.0}, "the row drivers 0 and 1"),
    ],
)
def test_contradictions_of_a_follower_are_refused(cells: object, parts: dict[str, float], message: str) -> None:
    design = feedback(cells, **parts)
    with pytest.raises(SolverError, match=message):
        scan(design, cells)
    with pytest.raises(Indeterminate):
        reference_volts(design, cells)


def test_a_complete_short_by_a_fault_is_a_contradiction_as_one_by_a_cell_is() -> None:
    base = feedback([[1e4, 1e4]])
    design = base.replace(
        readout={"circuit": "inverting-amplifier"},
        array={"row_lead": 1.0},
        fault=[{"kind": "shorted-cell", "place": [0, column]} for column in range(2)],
    )
    with pytest.raises(SolverError, match="ideal amplifiers of columns 0 and 1"):
        scan(design, [[1e4, 1e4]])


def test_what_an_idle_driver_leaves_open_has_no_bound() -> None:
    """Driver and virtual ground hold the same potential, and nothing says how they share the current."""
    cells = np.array([[0.0, 1e4], [1e4, 1e4]])
    for circuit in ("inverting-amplifier", "row-amplifier"):
        design = feedback(cells).replace(readout={"circuit": circuit, "supply": (-1.0, 3.0)})
        with pytest.raises(Indeterminate):
            reference_volts(design, cells)
        result = scan(design, cells)
        assert result.saturated.tolist() == [[True, False], [False, False]]
        assert result.error_bound == inf
        frames = scan_batch(design, [cells, np.full((2, 2), 1e4)])
        assert frames.error_bound[0] == inf
        assert frames.error_bound[1] < 1e-12


def test_nearly_equal_sources_that_are_joined_keep_their_bound() -> None:
    """Their difference has lost digits before it meets any conductance (a finding in the family of faults)."""
    tally = search.Tally()
    for number in (210000141, 210000478, 210000541):
        search.check("faults", number, tally)
    assert not tally.findings


def test_the_search_notices_wrong_readings(monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(design: Design, cells: object, **options: object) -> object:
        result = scan(design, cells)
        result.volts[0, 0] *= 1.0 + 1e-6
        return result

    monkeypatch.setattr(search, "scan", wrong)
    tally = search.Tally()
    for number in range(20):
        search.check("ordinary", number, tally)
    assert len(tally.findings) > 10
    assert all("broken bound" in finding for finding in tally.findings)


def test_the_command_prints_counts_and_shows_a_design() -> None:
    ran = CliRunner().invoke(search.main, ["--seconds", "0.5", "--family", "ties"])
    assert ran.exit_code == 0, ran.output
    assert "designs" in ran.output
    shown = CliRunner().invoke(search.main, ["--show", "ties:3"])
    assert shown.exit_code == 0
    assert "cells = [[" in shown.output


def test_the_command_shows_the_stream_of_a_live_finding() -> None:
    """It searched instead, until the time was up."""
    shown = CliRunner().invoke(search.main, ["--live", "--show", "inverting:3"])
    assert shown.exit_code == 0
    design, *frames = shown.output.splitlines()
    shape = Design.model_validate(json.loads(design)).array.shape
    assert frames
    for frame in frames:
        values = re.fullmatch(r"cells = (.*), noise_steps = (.*), counts = (.*)", frame)
        assert values is not None
        assert np.shape(json.loads(values[3])) == shape
    for wrong in ("ties:3", "inverting:x", "inverting"):
        refused = CliRunner().invoke(search.main, ["--live", "--show", wrong])
        assert refused.exit_code == 2
        assert "expected FAMILY:NUMBER" in refused.output
