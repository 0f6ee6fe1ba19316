"""Circuits, unequal parts, faults and saturation, against the nodal reference in decimal arithmetic."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from designs import amplifier, divider
from numpy.typing import NDArray
from parts_at_random import real_design

from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import (
    CIRCUITS,
    Design,
    Readings,
    Settling,
    Status,
    adc_codes,
    apparent_resistance,
    live_recovery,
    recover,
    scan,
    volts_of_codes,
)
from ohmskin.common.config import parse
from ohmskin.errors import InputError, SolverError


def assert_reads_as_the_reference(design: Design, cells: np.ndarray) -> None:
    """To 1e-11 of each signal, and to what the reference voltage's own rounding leaves of it."""
    level = design.readout.reference_voltage
    expected = reference_volts(design, cells)
    np.testing.assert_allclose(scan(design, cells).volts - level, expected - level, rtol=1e-11, atol=1e-15)


@pytest.mark.parametrize("design", [amplifier(1, 3), divider(1, 3)], ids=["amplifier", "divider"])
def test_a_signal_too_small_for_a_quotient_is_none(design: Design) -> None:
    ohms = apparent_resistance(design, np.array([[5e-324, -5e-324, 0.0]]))
    np.testing.assert_array_equal(ohms, np.full((1, 3), np.inf))


@pytest.mark.parametrize("circuit", CIRCUITS)
@pytest.mark.parametrize("seed", range(6))
def test_unequal_parts(circuit: str, seed: int) -> None:
    assert_reads_as_the_reference(*real_design(seed, circuit=circuit))


@pytest.mark.parametrize("kind", ["open-cell", "broken-row", "broken-column"])
@pytest.mark.parametrize("second", [50.0, np.inf])
def test_faults_of_one_kind_at_one_place_are_in_series(kind: str, second: float) -> None:
    faults = [{"kind": kind, "place": [1, 0], "resistance": ohms} for ohms in (second, 70.0)]
    design = Design.model_validate(amplifier(2, 2, lead=3.0, segment=1.0).model_dump() | {"fault": faults})
    assert_reads_as_the_reference(design, np.array([[1e3, 2e3], [3e3, 4e3]]))


@pytest.mark.parametrize("seed", range(24))
def test_faults(seed: int) -> None:
    design, cells = real_design(seed, faults=1 + seed % 3)
    assert_reads_as_the_reference(design, cells)


@pytest.mark.parametrize("circuit", CIRCUITS)
def test_readings_lie_between_those_of_an_open_cell_and_a_short(circuit: str) -> None:
    design = amplifier(1, 1, reference_voltage=1.65).with_circuit(circuit)
    low, high = sorted(design.board.circuit.domain(design.board))
    assert 1.65 in (low, high)
    for ohm in (1e-9, 1e3, 1e12):
        assert low - 1e-9 <= float(scan(design, [[ohm]]).volts[0, 0]) <= high + 1e-9
    ideal = design.board.circuit.ideal_volts(design.board, np.array([[np.inf, 1e-12]]))
    assert np.isinf(high - low) or np.ptp(ideal) == pytest.approx(high - low)


def saturating_design(seed: int, circuit: str) -> tuple[Design, np.ndarray]:
    """Narrow rails and large offsets."""
    rng = np.random.default_rng(seed)
    level = float(rng.choice([0.0, 1.65]))
    supply = (level - float(rng.uniform(0.0, 0.3)), level + float(rng.uniform(0.02, 0.5)))
    design, cells = real_design(seed, circuit=circuit, reference_voltage=level, supply=supply)
    offsets = tuple(rng.uniform(-0.2, 0.2, design.array.columns).tolist())
    return design.replace(readout={"offset_voltage": offsets}), cells


@pytest.mark.parametrize("seed", range(24))
def test_saturated_outputs(seed: int) -> None:
    design, cells = saturating_design(seed, "inverting-amplifier" if seed % 4 else "voltage-feedback")
    assert_reads_as_the_reference(design, cells)
    result = scan(design, cells)
    low, high = supply = design.readout.supply
    assert ((result.volts >= low) & (result.volts <= high)).all()
    assert np.isin(result.volts[result.saturated], supply).all()


def test_feedback_of_finite_gain_leaks_through_the_idle_lines() -> None:
    """The idle lines stand 1/(1+A) off the sensed one: R = Rij alone, and S/(1+A) to where they end."""
    gain, cells = 1e3, np.full((4, 4), 2e3)
    design = divider(4, 4).with_circuit("voltage-feedback")
    design = design.replace(readout={"open_loop_gain": gain})
    leak = 3 / 2e3 / (1 + gain)
    column = (1 / 2e3) / (1 / 2e3 + 1 / 1e3 + leak)
    assert scan(design, cells).volts == pytest.approx(np.full((4, 4), column * gain / (1 + gain)), rel=1e-12)


def test_ideal_drivers_joined_by_a_bridge_are_refused() -> None:
    cells = np.full((3, 3), 1e3)
    rows = amplifier(3, 3).model_validate(
        amplifier(3, 3).model_dump() | {"fault": [{"kind": "bridged-rows", "place": [0, 1], "to": 2}]}
    )
    with pytest.raises(SolverError, match=r"row drivers 0 and 2 .* array\.row_lead"):
        scan(rows, cells)
    columns = {"fault": [{"kind": "bridged-columns", "place": [0, 1]}]}
    with pytest.raises(SolverError, match="ideal amplifiers of columns 1 and 2"):
        scan(Design.model_validate(amplifier(3, 3).model_dump() | columns), cells)
    real = Design.model_validate(amplifier(3, 3, open_loop_gain=1e5).model_dump() | columns)
    assert_reads_as_the_reference(real, cells)


BASE: dict[str, Any] = {
    "array": {"rows": 2, "columns": 3},
    "drive": {"voltage": -1.0},
    "readout": {"circuit": "inverting-amplifier", "reference_resistance": 1000.0},
}


@pytest.mark.parametrize(
    ("table", "key", "value", "message"),
    [
        (
            "array",
            "row_lead",
            [1.0, 2.0, 3.0],
            r"array.row_lead has 3 entries, expected one number or 2 \(one per row\)",
        ),
        ("array", "column_segment", [1.0], "array.column_segment has 1 entries, expected one number or 3"),
        ("readout", "offset_voltage", [0.0, 0.0], r"expected one number or 3 \(one per column\)"),
        (
            "array",
            "row_lead",
            -1.0,
            r"array.row_lead: must be a number of ohm, 0 or at least 1e-30, or a list .* \(got -1.0\)",
        ),
        ("array", "row_lead", [1.0, float("inf")], "array.row_lead: must be a number of ohm, 0 or at least 1e-30"),
        ("array", "row_lead", "3", "array.row_lead: must be a number of ohm, 0 or at least 1e-30"),
        ("readout", "reference_resistance", [1.0, 0.0, 1.0], "must be a number of ohm > 0"),
        ("readout", "open_loop_gain", 0.5, "must be a number >= 1"),
        ("readout", "bias_current", True, "must be a finite number"),
    ],
)
def test_bad_parts_are_refused_by_name(table: str, key: str, value: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse(BASE | {table: BASE[table] | {key: value}}, Design, source="design.toml")


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ({"kind": "bridged-rows", "place": [1, 0]}, r"fault\[0\] \(bridged-rows\) reaches row 2, column 0"),
        ({"kind": "open-cell", "place": [0, 3]}, r"reaches row 0, column 3; the array has rows 0 to 1"),
        ({"kind": "bridged-rows", "place": [0, 0], "to": 0}, "joins a line to itself"),
        ({"kind": "open-cell", "place": [0, 0], "to": 1}, "no key 'to'"),
        ({"kind": "broken", "place": [0, 0]}, r"fault\[0\].kind: input should be 'open-cell'"),
        ({"kind": "open-cell", "place": [0, 0], "resistance": -1.0}, r"fault\[0\].resistance: input should be greater"),
    ],
)
def test_bad_faults_are_refused_by_name(fault: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse(BASE | {"fault": [fault]}, Design, source="design.toml")


@pytest.mark.parametrize("circuit", ["inverting-amplifier", "voltage-divider", "voltage-feedback"])
def test_a_cell_too_small_to_invert_is_a_short(circuit: str) -> None:
    """1 / 5e-324 overflows."""
    cells = np.array([[1e3, 5e3], [2e3, 5e-324]])
    design = amplifier(2, 2, open_loop_gain=1e5).with_circuit(circuit).replace(array={"column_lead": 1.0})
    short = cells.copy()
    short[1, 1] = 0.0
    np.testing.assert_array_equal(scan(design, cells).volts, scan(design, short).volts)


def test_a_line_too_small_to_invert_is_refused() -> None:
    with pytest.raises(InputError, match=r"array\.row_segment: must be a number of ohm, 0 or at least 1e-30"):
        amplifier(2, 2).replace(array={"row_segment": 1e-300})


# Lines that are not selected: pull-downs on rows, columns behind one switch, against exact nodal analysis


Floats = NDArray[np.float64]


def board(circuit: str, rows: int, columns: int, *, drive: dict[str, Any], readout: dict[str, Any]) -> Design:
    tables = {
        "array": {"rows": rows, "columns": columns, "row_lead": 70.0, "column_lead": 70.0},
        "drive": drive,
        "readout": {"circuit": circuit, **readout},
    }
    return Design.model_validate(tables)


def test_a_ghost_cell_behind_pull_downs() -> None:
    """An open cell beside three pressed ones; checked with ngspice, too: 663 counts of 1023."""
    cells = np.array([[1e3, 1e6], [1e3, 1e3]])
    design = board(
        "voltage-divider",
        2,
        2,
        drive={"voltage": 5.0, "idle_rows": "pull", "idle_row_resistance": 10e3},
        readout={"reference_resistance": 10e3},
    ).replace(array={"column_lead": 0.0})
    counts = scan(design, cells).volts / 5.0 * 1023.0
    np.testing.assert_allclose(counts, reference_volts(design, cells) / 5.0 * 1023.0, rtol=1e-12)
    assert counts.round().tolist() == [[844, 663], [844, 912]]


@pytest.mark.parametrize("idle", ["float", "ground", "load"])
def test_one_amplifier_behind_a_switch(idle: str) -> None:
    cells = np.array(
        [[1e3, 500.0, 2e3, 800.0], [1.5e3, 100.0, 3e3, 700.0], [900.0, 4e3, 600.0, 1.2e3], [250.0, 2e3, 5e3, 350.0]]
    )
    readout = {"reference_resistance": 1e3, "columns": "multiplexed", "idle_columns": idle}
    design = board("inverting-amplifier", 4, 4, drive={"voltage": -1.0}, readout=readout)
    np.testing.assert_allclose(scan(design, cells).volts, reference_volts(design, cells), rtol=1e-12)
    apparent = apparent_resistance(design, scan(design, cells).volts)[3, 1]  # of a cell of 2 kohm
    parallel = design.replace(readout={"columns": "parallel", "idle_columns": "float"})
    if idle == "float":
        assert round(apparent) == 1866
    if idle == "ground":  # at the reference behind their leads: what virtual grounds do
        np.testing.assert_allclose(scan(design, cells).volts, scan(parallel, cells).volts, rtol=1e-12)
        assert round(apparent) == 3482


@pytest.mark.parametrize("rows", ["ground", "pull"])
def test_a_grounded_column_charges_from_the_reference_with_one_time_constant(rows: str) -> None:
    """Idle columns are at the reference, so that the column that is read is the only node with a charge."""
    cells, load, farad, period = np.array([[7e3, 1e5, 1e6], [2e5, 7e3, 5e4]]), 10e3, 10e-9, 200e-6
    drive = {"voltage": 5.0, "idle_rows": rows} | ({"idle_row_resistance": 20e3} if rows == "pull" else {})
    readout = {
        "reference_resistance": load,
        "columns": "multiplexed",
        "idle_columns": "ground",
        "column_capacitance": farad,
    }
    design = board("voltage-divider", 2, 3, drive=drive, readout=readout).replace(array={"column_lead": 0.0})

    def settled(ohm: float) -> Floats:
        return reference_volts(design.replace(readout={"reference_resistance": ohm}), cells)

    one, half = settled(load), settled(load / 2)
    source_ohm = load * (one - half) / (2 * half - one)  # of the divider: V = Voc load / (load + source)
    seconds = farad / (1 / load + 1 / source_ohm)
    expected = one * -np.expm1(-period / 3 / seconds)
    np.testing.assert_allclose(Settling(design, cells).sampled(period), expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("circuit", "drive", "readout", "message"),
    [
        ("inverting-amplifier", {}, {"idle_columns": "load"}, 'idle_columns = "load" has no effect'),
        ("row-amplifier", {}, {"idle_columns": "ground"}, 'idle_columns = "ground" has no effect'),
        ("voltage-divider", {}, {"idle_columns": "ground"}, 'needs readout.columns = "multiplexed"'),
        ("voltage-feedback", {"idle_rows": "float"}, {}, 'drive.idle_rows = "float" has no effect'),
        ("voltage-feedback", {}, {"columns": "multiplexed"}, 'readout.columns = "multiplexed" has no effect'),
        ("voltage-divider", {"idle_rows": "pull"}, {}, "needs idle_row_resistance in ohm"),
        ("voltage-divider", {"idle_row_resistance": 1e4}, {}, 'no effect with idle_rows = "ground"'),
        ("inverting-amplifier", {}, {"columns": "multiplexed", "offset_voltage": [0.0, 1e-3]}, "expected one number"),
    ],
)
def test_a_key_without_effect_is_an_error(
    circuit: str, drive: dict[str, Any], readout: dict[str, Any], message: str
) -> None:
    plain = board(circuit, 2, 2, drive={"voltage": 1.0}, readout={"reference_resistance": 1e3})
    with pytest.raises(InputError, match=message):
        plain.replace(drive=drive, readout=readout)


@pytest.mark.parametrize("rows", ["ground", "pull", "float"])
@pytest.mark.parametrize("columns", ["parallel", "float", "ground", "load"])
@pytest.mark.parametrize("circuit", ["inverting-amplifier", "row-amplifier", "voltage-divider"])
def test_cells_are_recovered_from_one_frame_and_from_a_stream(circuit: str, columns: str, rows: str) -> None:
    cells = 10 ** np.random.default_rng(7).uniform(3.0, 4.5, (3, 4))
    idle = {} if columns == "parallel" else {"columns": "multiplexed", "idle_columns": columns}
    drive = {"voltage": -1.0, "idle_rows": rows} | ({"idle_row_resistance": 1e4} if rows == "pull" else {})
    design = board(circuit, 3, 4, drive=drive, readout={"reference_resistance": 1e3, **idle})
    design = design.replace(adc={"bits": 14, "range": [-1.2, 1.2]})
    volts = scan(design, cells).volts
    found = recover(design, volts)
    one = (found.status == Status.READ) | ((circuit, columns) != ("voltage-divider", "ground"))
    np.testing.assert_allclose(found.resistance[one], cells[one], rtol=1e-8)
    live, read = live_recovery(design), volts_of_codes(design, adc_codes(design, volts))
    for _ in range(4):
        found = live(Readings.of(read))
    if (circuit, columns) != ("voltage-divider", "ground"):  # there, other cells may give the same readings
        assert found.valid.all()
    assert (np.abs(found.resistance / cells - 1) <= found.uncertainty)[found.valid].all()
