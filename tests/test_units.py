"""Verdicts by dimensional analysis, exact tests of proportions, packets and closed forms."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from ohmskin.circuits import Design, Requirement
from ohmskin.verification import CATALOGUE, Result, verify
from ohmskin.verification._units import engineering
from ohmskin.wire import FramePacket, encode

UNITS = {
    "array": dict.fromkeys(("row_segment", "column_segment", "row_lead", "column_lead"), "ohm"),
    "drive": {"voltage": "V", "idle_leakage": "A"},
    "readout": {
        **{"reference_resistance": "ohm", "offset_voltage": "V", "bias_current": "A", "supply": "V"},
        **{"gain_bandwidth": "Hz", "column_capacitance": "F", "feedback_capacitance": "F"},
        **{"voltage_noise": "V/sqrt(Hz)", "current_noise": "A/sqrt(Hz)", "temperature": "J"},
    },
    "adc": {"range": "V", "sampling_capacitance": "F", "switch_resistance": "ohm", "offset_voltage": "V"},
    "cells": {"rest_resistance": "ohm", "full_scale_resistance": "ohm", "full_scale_kpa": "kPa"},
    "operation": {"frame_rate": "Hz", "baudrate": "Hz"},
}
"""of what has one; a temperature counts as the energy kT of its noise"""
SPICE = "spice_agreement"
"""whose tolerances are absolute"""
SIMULATED = ("pressure_rmse", "pressure_peak_error")
"""of cells whose material has its own times"""


def times(volt: float, ampere: float, second: float, kpa: float) -> dict[str, float]:
    """How many new units of each kind an old one is; all are powers of two, so that numbers stay exact."""
    root = second**0.5
    return {
        **{"V": volt, "A": ampere, "s": second, "kPa": kpa, "Hz": 1 / second, "W": volt * ampere},
        **{"ohm": volt / ampere, "F": ampere * second / volt, "J": volt * ampere * second},
        **{"V/sqrt(Hz)": volt * root, "A/sqrt(Hz)": ampere * root},
    }


def board(circuit: str) -> dict[str, dict[str, Any]]:
    """2 x 2 cells with every kind of part and error."""
    amplified = circuit == "inverting-amplifier"
    return {
        "array": {"rows": 2, "columns": 2, "row_lead": {"nominal": 70.0, "tolerance": 0.2}, "row_segment": 0.5}
        | {"column_lead": 12.0},
        "drive": {"voltage": {"nominal": -1.0 if amplified else 2.5, "tolerance": 0.01}, "idle_leakage": 1e-8},
        "readout": {
            **{"circuit": circuit, "open_loop_gain": 1e5, "offset_voltage": 1e-3, "bias_current": 1e-8},
            **{"reference_resistance": {"nominal": 9e3, "tolerance": 0.01, "end_of_life": 0.02}, "supply": [0.0, 3.3]},
            **{"gain_bandwidth": {"nominal": 1e6, "tolerance": 0.3}, "column_capacitance": 2e-10, "temperature": 300.0},
            **{"feedback_capacitance": 1e-11 * amplified, "voltage_noise": 4e-8, "current_noise": 2e-13},
        },
        "adc": {
            **{"bits": 12, "range": [0.0, 3.3], "sampling_capacitance": 5e-12, "switch_resistance": 1e3},
            **{"offset_voltage": 1e-4, "gain_error": 1e-3, "inl_steps": 1.0},
        },
        "cells": {"rest_resistance": {"nominal": 1e4, "tolerance": 0.05}, "full_scale_resistance": 1.8e4}
        | {"full_scale_kpa": 20.0},
        "operation": {"frame_rate": 16e3, "baudrate": 4e6},
    }


def in_units(tables: dict[str, dict[str, Any]], by: dict[str, float]) -> Design:
    def scaled(value: Any, factor: float) -> Any:
        if isinstance(value, dict):
            return value | {"nominal": factor * value["nominal"]}
        return [factor * part for part in value] if isinstance(value, list) else factor * value

    return Design.model_validate(
        {
            section: {
                key: scaled(value, by[UNITS[section][key]]) if key in UNITS[section] else value
                for key, value in table.items()
            }
            for section, table in tables.items()
        }
    )


def numbers(result: Result, by: dict[str, float]) -> dict[str, Any]:
    """All numbers of a result in the old units, or the reason why there is none."""
    found = result.measurement
    if found is None:
        return {result.reason: 0.0}
    bounds = {} if found.bounds is None else vars(found.bounds)
    values = bounds | dict(found.contributions) | {"value": found.value, "samples": found.samples}
    return {
        name: np.asarray(value) / (1.0 if name == "boards" else by.get(found.unit, 1.0))
        for name, value in values.items()
        if value is not None
    }


@given(st.floats(1e-14, 1e14), st.sampled_from(["V", "ohm", "s", "W", "%", "kPa"]))
def test_a_number_with_a_prefix_reads_back(value: float, unit: str) -> None:
    """To four digits; and with a minus sign for its negative, which an infinity has, too."""
    number, _, word = engineering(value, unit).partition(" ")
    shown = word.removesuffix("Ω" if unit == "ohm" else unit)
    exponents = dict(zip("fpnµmkMGT", (*range(-15, 0, 3), 3, 6, 9, 12), strict=True))
    if unit not in ("%", "kPa"):
        assert float(number) * 10.0 ** exponents.get(shown, 0) == pytest.approx(value, rel=1e-3)
    for each in (value, np.inf):
        if unit not in ("%", "kPa") or value > 1e-8:
            assert engineering(-each, unit) == f"−{engineering(each, unit)}"


OLD = times(1.0, 1.0, 1.0, 1.0)


@pytest.mark.parametrize(
    ("circuit", "new", "left_out"),
    [
        ("inverting-amplifier", times(4.0, 0.25, 16.0, 8.0), {*SIMULATED, "fastest_scan"}),
        ("voltage-divider", times(4.0, 0.25, 16.0, 8.0), {*SIMULATED, "crosstalk"}),
        ("voltage-divider", times(0.25, 8.0, 1.0, 4.0), set(CATALOGUE) - {*SIMULATED, "pressure_resolution"}),
    ],
    ids=["amplifier", "divider", "pressure"],
)
def test_results_follow_the_units_of_the_design(circuit: str, new: dict[str, float], left_out: set[str]) -> None:
    """The same board in units of another size has the same errors, and voltages, times and powers of that size."""
    asked = [Requirement(id=name, quantity=name, max=1e9) for name in CATALOGUE if name not in left_out | {SPICE}]
    if "reading_error" not in left_out:
        yields = {"method": "monte-carlo", "max": 5.0, "conditions": {"yield_percent": 90.0}}
        asked.append(Requirement.model_validate({"id": "yield", "quantity": "reading_error", **yields}))
    old, other = (verify(in_units(board(circuit), by), requirements=asked, samples=60).results for by in (OLD, new))
    for one, another in zip(old, other, strict=True):
        before, after = numbers(one, OLD), numbers(another, new)
        assert before.keys() == after.keys(), one.requirement.id
        for name, value in before.items():
            np.testing.assert_allclose(after[name], value, rtol=1e-6, atol=1e-9, err_msg=f"{one.requirement.id} {name}")


def judged(asked: dict[str, Any], samples: int = 200, **changes: Any) -> Result:
    tables = board("inverting-amplifier")
    design = in_units({name: table | changes.get(name, {}) for name, table in tables.items()}, OLD)
    requirement = Requirement.model_validate({"id": "R", **asked})
    (result,) = verify(design, requirements=[requirement], samples=samples).results
    return result


@pytest.mark.parametrize(("percent", "within"), [(80.0, 0.84), (90.0, 0.93), (99.0, 0.5), (70.0, 1.0)])
def test_a_yield_is_the_share_of_the_boards_that_were_drawn(percent: float, within: float) -> None:
    """Bounds and the number of boards that would do are those of SciPy's exact test of a proportion."""
    asked = {"quantity": "reading_error", "method": "monte-carlo", "conditions": {"yield_percent": percent}}
    boards = judged(asked | {"max": 1e9}).measurement
    assert boards is not None
    limit = float(np.quantile(boards.samples, within))
    found = judged(asked | {"max": limit}).measurement
    assert found is not None
    kept, count = int(np.sum(np.array(found.samples) <= limit)), len(found.samples)
    assert count == 200

    def lowest(kept: int, count: int) -> float:
        return float(binomtest(kept, count).proportion_ci(0.95, method="exact").low)

    bounds = binomtest(kept, count).proportion_ci(0.95, method="exact")
    said = [float(number) for number in re.findall(r"[\d.]+", found.confidence)]
    assert said[:2] == [kept, count]
    np.testing.assert_allclose(said[2:5], [100 * kept / count, 100 * bounds.low, 100 * bounds.high], rtol=1e-3)
    assert np.mean(np.array(found.samples) <= found.value) >= percent / 100
    assert np.mean(np.array(found.samples) < found.value) < percent / 100
    assert found.proven is (bounds.low >= percent / 100)
    if bounds.low < percent / 100 < kept / count:
        (needed,) = (int(number) for number in re.findall(r"--samples (\d+)", found.undecided))
        reached = [lowest(int(kept / count * n + 1e-9), n) >= percent / 100 for n in (needed - 1, needed)]
        assert reached == [False, True]
    else:
        assert not found.undecided or "no number of boards" in found.undecided


@pytest.mark.parametrize("baudrate", [1e6, 2e5])
def test_frames_and_their_latency_are_those_of_the_packets(baudrate: float) -> None:
    """Bytes of ten bits: a scan waits for the one before it, then goes over the line; what it cannot carry is lost."""
    counts = np.ones((2, 2), dtype=np.uint16)
    sent_s = 10 * len(encode(FramePacket.of(counts, sequence=1, time_us=1))) / baudrate
    for rate_hz in (0.5 / sent_s, 2.0 / sent_s):
        operation = {"operation": {"frame_rate": rate_hz, "baudrate": baudrate}}
        late, lost = (judged({"quantity": name, "max": 1e9}, **operation) for name in ("latency", "lost_frames"))
        assert late.measurement is not None
        assert lost.measurement is not None
        assert lost.measurement.value == pytest.approx(max(0.0, 100 * (1 - 1 / (rate_hz * sent_s))), abs=1e-9)
        expected = 2 / rate_hz + sent_s if rate_hz * sent_s < 1 else np.inf
        assert late.measurement.value == pytest.approx(expected)


def test_a_step_of_the_converter_is_a_step_of_the_resistance() -> None:
    """Of an ideal amplifier V = Vref Rref / R, hence dR = R^2 / (Vref Rref) dV; worst at the largest R."""
    ideal = {"open_loop_gain": np.inf, "offset_voltage": 0.0, "bias_current": 0.0, "reference_resistance": 9e3}
    array = {"row_lead": 0.0, "row_segment": 0.0, "column_lead": 0.0}
    result = judged({"quantity": "resolution", "max": 1e9}, readout=ideal, array=array, drive={"voltage": -1.0})
    assert result.measurement is not None
    assert result.measurement.value == pytest.approx(1.8e4**2 / 9e3 * 3.3 / 2**12, rel=1e-3)
