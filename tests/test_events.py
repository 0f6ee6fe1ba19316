"""A scan as a list of events, against closed forms and against the settling and noise of named circuits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ohmskin.circuits import Design, Event, EventScan, Scan, Settling, noise, scan
from ohmskin.errors import InputError, SolverError
from ohmskin.verification import verify

CELLS = np.round(10 ** np.random.default_rng(52).uniform(3, 4.7, (4, 4)))
AMPLIFIER = {
    "circuit": "inverting-amplifier",
    "reference_resistance": 1e3,
    "reference_voltage": 1.65,
    "open_loop_gain": 1e5,
    "gain_bandwidth": 1e6,
    "offset_voltage": 1e-3,
    "column_capacitance": 1e-10,
    "feedback_capacitance": 1e-10,
    "voltage_noise": 2e-8,
    "current_noise": 1e-12,
    "temperature": 300.0,
}


def named(readout: dict[str, Any], drive: dict[str, Any]) -> Design:
    array = {"rows": 4, "columns": 4, "row_lead": 25.0, "column_lead": 25.0}
    return Design.model_validate({"array": array, "drive": drive, "readout": readout})


def one_by_one(row_period: float) -> Scan:
    return Scan(column=(Event(wait=row_period / 4), Event(read=1)), conversion_time=0.0)


@pytest.mark.parametrize("drive", [{}, {"idle_rows": "float"}, {"idle_rows": "pull", "idle_row_resistance": 1e4}])
@pytest.mark.parametrize(
    "columns", [{}, {"columns": "multiplexed"}, {"columns": "multiplexed", "idle_columns": "ground"}]
)
def test_amplifiers_settle_and_are_as_noisy_as_the_named_circuit(
    columns: dict[str, str], drive: dict[str, Any]
) -> None:
    design = named(AMPLIFIER | columns, {"voltage": -1.0} | drive)
    period = 8e-6 if columns else 4e-6
    events = one_by_one(period) if columns else Scan(row=(Event(wait=period),), conversion_time=0.0)
    timed, settling = EventScan(design, CELLS, events), Settling(design, CELLS)
    assert settling.error(period) > 1e-4
    np.testing.assert_allclose(timed.settled, settling.settled, rtol=1e-12)
    np.testing.assert_allclose(timed.sampled, settling.sampled(period), atol=1e-7)
    np.testing.assert_allclose(timed.noise, noise(design, CELLS).volts, rtol=1e-3)
    assert timed.frame_time == pytest.approx(4 * period)


@pytest.mark.parametrize("idle", ["load", "float"])
def test_each_column_of_a_divider_has_its_own_load(idle: str) -> None:
    loads = [1e3, 1.0, 3e4, 200.0]
    divider = {"circuit": "voltage-divider", "reference_resistance": loads, "idle_columns": idle}
    design = named(divider, {"voltage": 3.3, "idle_rows": "float"})
    settled = EventScan(design, CELLS, one_by_one(1e-3)).settled
    np.testing.assert_allclose(settled, scan(design, CELLS).volts, rtol=1e-9)


@pytest.mark.parametrize("idle", ["load", "float"])
def test_dividers_settle_as_the_named_circuit(idle: str) -> None:
    load = {"circuit": "voltage-divider", "reference_resistance": 1e3, "column_capacitance": 1e-9}
    design = named(load | {"idle_columns": idle}, {"voltage": 3.3})
    events = Scan(row=(Event(wait=4e-6),), conversion_time=0.0) if idle == "load" else one_by_one(4e-6)
    expected = Settling(design, CELLS).sampled(4e-6)
    np.testing.assert_allclose(EventScan(design, CELLS, events).sampled, expected, atol=1e-6)


def described(columns: int, parts: list[str], **sections: Any) -> Design:
    ends = {"row_end": {"selected": ["V1 line 0 1"], "idle": []}, "column_end": {"parts": parts}}
    ends["column_end"] |= sections.pop("column_end", {})  # sections are a copy
    return Design.model_validate({"array": {"rows": 1, "columns": columns}} | ends | sections)


@pytest.mark.parametrize("wait", [1e-4, 1e-3])
def test_a_node_that_was_discharged_charges_again(wait: float) -> None:
    design = described(1, ["R1 line 0 1k", "C1 line 0 1u"])
    events = Scan(column=(Event(discharge=1e-5), Event(wait=wait), Event(read=1)), conversion_time=0.0)
    timed = EventScan(design, [[1e3]], events)
    assert timed.sampled[0, 0] == pytest.approx(0.5 * (1 - np.exp(-wait / 5e-4)), rel=5e-5)
    assert timed.frame_time == pytest.approx(1e-5 + wait)


def test_a_shared_end_carries_its_charge_to_the_next_column() -> None:
    """Two columns at one load of 1 kohm and 1 uF, cells of 1 and 9 kohm: exponentials towards 1/2 and 1/10 in turn."""
    design = described(2, ["R1 line 0 1k", "C1 line 0 1u"], column_end={"shared_by": 2})
    wait = 3e-4
    timed = EventScan(design, [[1e3, 9e3]], Scan(column=(Event(wait=wait), Event(read=1)), conversion_time=0.0))
    kept = np.exp(-wait / np.array([5e-4, 9e-4]))
    goal = np.array([0.5, 0.1])
    first = (goal[0] * (1 - kept[0]) + kept[0] * goal[1] * (1 - kept[1])) / (1 - kept.prod())
    second = goal[1] + kept[1] * (first - goal[1])
    np.testing.assert_allclose(timed.sampled, [[first, second]], rtol=1e-5)
    discharged = Scan(column=(Event(discharge=1e-5), Event(wait=wait), Event(read=1)), conversion_time=0.0)
    np.testing.assert_allclose(EventScan(design, [[1e3, 9e3]], discharged).sampled, [goal * (1 - kept)], rtol=1e-5)


def test_a_sampling_capacitor_remembers_and_a_discarded_conversion_helps() -> None:
    adc = {"bits": 16, "range": (0.0, 1.0), "sampling_capacitance": 1e-9, "switch_resistance": 1e3}
    design = described(2, ["R1 line 0 1k"], adc=adc)
    cells = [[1e3, 9e3]]
    errors = []
    for discard in (0, 1, 2):
        events = (Event(discard=discard),) if discard else ()
        timed = EventScan(design, cells, Scan(column=(*events, Event(read=1)), conversion_time=3e-6))
        errors.append(timed.error)
        assert timed.frame_time == pytest.approx(2 * (1 + discard) * 3e-6)
    kept = np.exp(-3e-6 / (1e-9 * (1e3 + np.array([500.0, 900.0]))))
    first = 0.5 + kept[0] * (0.1 - 0.5) * (1 - kept[1]) / (1 - kept.prod())
    assert errors[0] == pytest.approx(max(0.5 - first, kept[1] * (first - 0.1)) / 0.4, rel=1e-5)
    assert errors[0] > 4 * errors[1] > 16 * errors[2]


def test_averages_of_far_conversions_are_quieter_and_those_of_close_ones_hardly() -> None:
    adc = {"bits": 32, "range": (0.0, 1.0), "sampling_capacitance": 1e-12, "switch_resistance": 1e3}
    readout = {"circuit": "voltage-divider", "reference_resistance": 1e3, "temperature": 300.0}
    design = described(1, ["R1 line 0 1k"], adc=adc, readout=readout)

    def deviation(count: int, seconds: float) -> float:
        return float(EventScan(design, [[1e3]], Scan(column=(Event(read=count),), conversion_time=seconds)).noise[0, 0])

    once = np.sqrt(1.380649e-23 * 300.0 / 1e-12)
    assert deviation(1, 1e-6) == pytest.approx(once, rel=1e-6)
    assert deviation(4, 1e-6) == pytest.approx(once / 2, rel=1e-6)
    lag = np.exp(-1e-10 / 1.5e-9)  # 1 kohm and 500 ohm at 1 pF
    assert deviation(2, 1e-10) == pytest.approx(once * np.sqrt((1 + lag) / 2), rel=1e-5)
    with pytest.raises(InputError, match="no bandwidth limit"):
        _ = EventScan(design.replace(adc=None), [[1e3]], Scan()).noise


def test_what_has_no_linear_dynamics_is_refused() -> None:
    design = described(1, ["R1 line 0 1k", "D1 line 0"])
    assert scan(design, [[1e3]]).volts[0, 0] < 0.5
    with pytest.raises(SolverError, match="no diodes"):
        EventScan(design, [[1e3]], Scan())
    with pytest.raises(InputError, match=r"no \[scan\] section"):
        EventScan(design, [[1e3]])
    feedback = design.with_circuit("voltage-feedback")
    with pytest.raises(InputError, match="no scan by events"):
        EventScan(feedback, [[1e3]], Scan())


def test_requirements_in_time_follow_the_events() -> None:
    adc = {"bits": 12, "range": (0.0, 1.0), "sampling_capacitance": 1e-11, "switch_resistance": 1e3}
    sections = {
        "adc": adc,
        "readout": {"temperature": 300.0, "circuit": "voltage-divider", "reference_resistance": 1.0},
    }
    sections |= {"operation": {"frame_rate": 100.0}, "column_end": {"shared_by": 2}}
    parts = ["R1 line 0 10k", "C1 line 0 1n"]
    slow, fast = (
        described(2, parts, scan={"column": [{"wait": wait}, {"read": 2}], "conversion_time": 1e-6}, **sections)
        for wait in (2e-6, 2e-4)
    )
    for design, passes in ((slow, False), (fast, True)):
        found = {each.requirement.id: each for each in verify(design, only=("D7", "D8", "D9"), samples=20).results}
        assert (str(found["D8"].outcome) == "pass") is passes
        assert found["D9"].measurement is not None
        assert found["D9"].measurement.value == pytest.approx(1.0 / EventScan(design, [[1e4, 1e4]]).frame_time)
        assert found["D7"].measurement is not None
    bent = described(2, [*parts, "D1 line 0"], **sections)
    found = {each.requirement.id: each for each in verify(bent, only=("D7", "D8")).results}
    assert {str(each.outcome) for each in found.values()} == {"not run"}
    with pytest.raises(InputError, match=r"expected \[scan\] and EventScan"):
        Settling(slow, [[1e4, 1e4]])


@pytest.mark.parametrize(
    "table",
    [
        {"column": [{"wait": 1e-6}]},
        {"column": [{"read": 1}, {"read": 2}]},
        {"row": [{"read": 1}]},
        {"column": [{"read": 1, "wait": 1e-6}]},
        {"column": [{"read": 0}]},
        {"row": [{"wait": -1.0}]},
    ],
)
def test_events_that_are_none(table: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"read|wait"):
        described(1, ["R1 line 0 1k"], scan=table)
