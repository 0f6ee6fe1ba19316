"""Verdicts with values that independent solutions give: currents, leakage, settling, yields, cells open at rest."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from designs import amplifier

from ohmskin.circuits import Design, Requirement, scan
from ohmskin.errors import MissingExtra
from ohmskin.verification import DesignUnderTest, Outcome, default_requirements, verify
from ohmskin.verification._outcome import Measurement
from ohmskin.verification._pressures import _sampled


def _design(array: dict[str, Any], readout: dict[str, Any], ohms: tuple[float, float], **sections: Any) -> Design:
    drive = {"voltage": -1.0} | sections.pop("drive", {})
    ends = {"rest_resistance": ohms[0], "full_scale_resistance": ohms[1]}
    return Design.model_validate(
        {"array": array, "readout": readout, "drive": drive, "cells": ends | sections.pop("cells", {}), **sections}
    )


def _found(design: Design, quantity: str, **asked: Any) -> Measurement:
    requirement = Requirement(id="R", quantity=quantity, **({"max": 1e9} | asked))
    (result,) = verify(design, requirements=[requirement], samples=400).results
    assert result.measurement is not None, result.reason
    return result.measurement


AMPLIFIER = {"circuit": "inverting-amplifier", "reference_resistance": 1000.0}
PULLED = _design(
    {"rows": 2, "columns": 2, "row_lead": 5.0},
    {"circuit": "voltage-divider", "reference_resistance": 10e3},
    (10e3, 20e3),
    drive={"voltage": 3.3, "idle_rows": "pull", "idle_row_resistance": 100.0},
)
SHORTED = _design(
    {"rows": 2, "columns": 2, "row_lead": 5.0},
    AMPLIFIER,
    (10e3, 20e3),
    fault=[{"kind": "shorted-cell", "place": [0, 0], "resistance": 10.0}],
)
LEAKING = _design(
    {"rows": 4, "columns": 4, "row_lead": 2000.0},
    AMPLIFIER,
    (1000.0, 2000.0),
    drive={"idle_rows": "float", "idle_leakage": 1e-6},
)


@pytest.mark.parametrize(
    ("design", "quantity", "expected"),
    [
        (PULLED, "switch_current", 31.78e-3),
        (PULLED, "switch_power", 5.048e-3),
        (SHORTED, "switch_current", 66.76e-3),
        (SHORTED, "output_current", 66.70e-3),
        (LEAKING, "leakage_error", 1.920),
    ],
)
def test_what_parts_bear_counts_pull_downs_faults_and_leads(design: Design, quantity: str, expected: float) -> None:
    assert _found(design, quantity).value == pytest.approx(expected, rel=1e-3)


def test_columns_cut_off_pass_their_currents_on_to_others() -> None:
    faults = [{"kind": "broken-column", "place": [3, column]} for column in range(2)]
    cut = _design(
        {"rows": 4, "columns": 4, "row_lead": 5.0, "column_lead": 5.0},
        AMPLIFIER,
        (1000.0, 2000.0),
        drive={"idle_rows": "float"},
        fault=faults,
    )
    assert _found(cut, "output_current").value > 1.2 / 1000.0


@pytest.mark.parametrize("line", [1e-12, 0.0])
def test_a_press_shows_in_the_channel_after_it(line: float) -> None:
    """Channels that take turns at a capacitor of 10 nF: 2.428 V are read of 3.195 beside a press."""
    design = _design(
        {"rows": 1, "columns": 8, "column_lead": 70.0},
        {"circuit": "voltage-divider", "reference_resistance": 33e3, "reference_voltage": 3.3}
        | {"columns": "multiplexed", "column_capacitance": line},
        (1e6, 3000.0),
        drive={"voltage": -3.3},
        adc={"bits": 12, "range": (0.0, 3.6), "sampling_capacitance": 10e-9, "switch_resistance": 1000.0}
        | {"acquisition_time": 440e-6},
        operation={"frame_rate": 100.0},
    )
    largest = 3.3 * 33.0 / 36.0
    assert _found(design, "settling_error").value == pytest.approx(100 * (3.195 - 2.428) / largest, rel=0.02)


def test_ringing_is_worst_between_the_ends_of_a_bandwidth() -> None:
    design = _design(
        {"rows": 2, "columns": 1},
        {"circuit": "inverting-amplifier", "reference_resistance": 20e3, "open_loop_gain": 1e5}
        | {"gain_bandwidth": {"nominal": 1e6, "tolerance": 0.4}, "column_capacitance": 1e-9},
        (20e3, 20.001e3),
        adc={"bits": 12, "range": (0.0, 3.3), "sampling_capacitance": 1e-12, "switch_resistance": 100.0},
        operation={"frame_rate": 18898.985791892304},
    )
    assert _found(design, "settling_error").value == pytest.approx(13.9, rel=0.01)


def test_drift_and_leads_slow_a_scan() -> None:
    design = _design(
        {"rows": 2, "columns": 2, "column_lead": {"nominal": 20e3, "tolerance": 0.5}},
        {"circuit": "voltage-divider", "idle_columns": "load"}
        | {"reference_resistance": {"nominal": 20e3, "temperature_coefficient": 2e-3}}
        | {"column_capacitance": {"nominal": 1e-9, "temperature_coefficient": 5e-3}},
        (10e3, 20e3),
        drive={"voltage": 3.3},
        adc={"bits": 12, "range": (-0.1, 3.4), "sampling_capacitance": 1e-12},
        operation={"frame_rate": 4000.0, "temperature_range": (248.15, 358.15)},
    )
    assert _found(design, "fastest_scan", min=4000.0).value == pytest.approx(3342.0, rel=2e-3)


def test_a_host_that_reads_no_resistance_has_lost_the_cell() -> None:
    """A drive 3 % high stands beyond the reading of a short."""
    design = _design(
        {"rows": 2, "columns": 2, "row_lead": 3.0},
        {"circuit": "voltage-feedback", "reference_resistance": 45e3},
        (1100.0, 400.0),
        drive={"voltage": {"nominal": 2.5, "tolerance": 0.03}},
    )
    assert _found(design, "crosstalk").value == np.inf


def test_a_yield_judges_every_column() -> None:
    """Eight resistors of 1 %, each within 0.99 % less what the segments take."""
    design = _design(
        {"rows": 8, "columns": 8, "row_segment": 0.1},
        {"circuit": "inverting-amplifier", "reference_resistance": {"nominal": 20e3, "tolerance": 0.01}},
        (10e3, 20e3),
    )
    found = _found(design, "gain_error", max=0.99, method="monte-carlo")
    kept = np.mean(np.array(found.samples) <= 0.99)
    assert abs(kept - 0.866) < 4.0 * np.sqrt(0.866 * 0.134 / 400)
    assert "95 % confidence" in found.confidence


IDEAL_FSR = _design(
    {"rows": 3, "columns": 3},
    {"circuit": "inverting-amplifier", "reference_resistance": 4000.0},
    (1e9, 5e3),
    drive={"voltage": -3.0},
    adc={"bits": 12, "range": (0.0, 3.3)},
    cells={"full_scale_kpa": 100.0},
)


def test_an_ideal_matrix_of_cells_that_are_open_at_rest_passes() -> None:
    asked = [r for r in default_requirements(IDEAL_FSR) if r.quantity.endswith(("error", "crosstalk", "headroom"))]
    static = [r for r in asked if r.quantity not in ("settling_error", "pressure_peak_error", "output_headroom")]
    report = verify(IDEAL_FSR, requirements=static, samples=400)
    assert {r.requirement.quantity for r in report.results} >= {"crosstalk", "reading_error", "gain_error"}
    for result in report.results:
        assert result.outcome is Outcome.PASS, result.why
        assert result.unit in ("% FS", "V")


def test_a_limit_in_kilopascals_asks_for_shares_of_full_scale() -> None:
    found = [_found(IDEAL_FSR, "reading_error", max=limit, unit=unit) for limit, unit in ((1.0, "kPa"), (1.0, "% FS"))]
    assert found[0].value == found[1].value
    rising = _design({"rows": 2, "columns": 2, "row_lead": 50.0}, AMPLIFIER, (10e3, 15e3), cells={"full_scale_kpa": 20})
    relative, share = _found(rising, "reading_error"), _found(rising, "reading_error", unit="% FS")
    assert (relative.unit, share.unit) == ("%", "% FS")
    assert share.value == pytest.approx(relative.value * 15.0 / 5.0, rel=0.35)


@pytest.mark.parametrize("shape", [(33, 32), (32, 32)])
def test_no_count_of_coordinates_is_special(shape: tuple[int, int]) -> None:
    lead = {"nominal": 70.0, "tolerance": 0.1} if shape == (32, 32) else 70.0
    design = _design(
        {"rows": shape[0], "columns": shape[1], "row_lead": lead},
        {"circuit": "inverting-amplifier", "reference_resistance": 20e3},
        (10e3, 17750.0),
    )
    assert 7.0 < _found(design, "crosstalk").value < 9.0


def test_without_matplotlib_only_pictures_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    design = SHORTED.replace(fault=[])
    before = verify(design, only=["D1", "D2"]).results
    assert all(r.measurement is not None and r.measurement.figures for r in before)

    def missing(*args: object, **options: object) -> None:
        raise MissingExtra("plots need matplotlib")

    monkeypatch.setattr("ohmskin.common.plots.drawing", missing)
    after = verify(design, only=["D1", "D2"])
    assert [r.found for r in after.results] == [r.found for r in before]
    assert after.html()
    assert all(r.measurement is not None and not r.measurement.figures for r in after.results)


def test_each_verdict_is_reported_when_it_is_known() -> None:
    reported: list[str] = []

    def tell(found: object) -> None:
        reported.append(str(getattr(found, "requirement", found)))
        if len(reported) == 2:
            raise KeyboardInterrupt

    report = verify(SHORTED, only=["D4", "D5", "D6", "D11"], tell=tell)
    assert len(reported) == 2
    assert isinstance(report.interruption, KeyboardInterrupt)
    assert [r.reason for r in report.results][2:] == ["the run was stopped before"] * 2
    assert report.exit_code != 0


UNLIKE_ROWS = {
    "selected": ["V1 drive 0 -1", "R1 drive line 35"],
    "idle": ["R1 line 0 35"],
    "values": {"selected.R1": [35.0, 2000.0]},
}
HELD = {"parts": ["X1 0 line out opamp", "R1 line out 2.2k"]}
LOADED = {"parts": ["R1 line 0 10k"]}
DIODES = {"parts": ["D1 row cell 1N4148"]}


@pytest.mark.parametrize(
    "ends",
    [
        {"row_end": UNLIKE_ROWS, "column_end": HELD},
        {"row_end": {"selected": ["V1 line 0 3.3"], "idle": []}, "column_end": LOADED, "crosspoint": DIODES},
    ],
    ids=["row ends that differ", "a diode at each cell"],
)
def test_readings_are_judged_by_the_law_of_their_own_crosspoint(ends: dict[str, Any]) -> None:
    """By all presses of two cells, and what a scan makes of their readings; presses in between are hardly worse."""
    size = {"rows": 2, "columns": 1}
    design = Design.model_validate(
        {"array": size, "cells": {"rest_resistance": 10e3, "full_scale_resistance": 6e3}, **ends}
    )
    worst = 0.0
    for pressed in product((10e3, 6e3), repeat=2):
        cells = np.array(pressed)[:, None]
        worst = max(worst, float(np.abs(scan(design, cells).resistance / cells - 1.0).max()))
    assert _found(design, "reading_error", method="nominal").value == pytest.approx(100 * worst, abs=0.3)


@pytest.mark.parametrize(("circuit", "axis"), [("inverting-amplifier", 0), ("row-amplifier", 1)])
def test_a_reading_that_has_not_settled_is_on_its_way_from_that_of_the_line_before(circuit: str, axis: int) -> None:
    design = amplifier(3, 3, lead=20.0, supply=(-5.0, 5.0)).with_circuit(circuit)
    dut = DesignUnderTest(design.replace(cells={"rest_resistance": 1e4, "full_scale_resistance": 2e3}))
    cells, random = 10 ** np.random.default_rng(0).uniform(3.5, 4.0, (1, 3, 3)), np.random.default_rng(1)
    parts = np.zeros(len(dut.factors))
    settled, half = (_sampled(dut, dut.factors, parts, cells, share, random)[0][0] for share in (0.0, 0.5))
    np.testing.assert_allclose(half, (settled + np.roll(settled, 1, axis)) / 2.0, rtol=1e-12)
