"""Lines that are not selected: pull-downs on rows, columns behind one switch, against exact nodal analysis."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from parts_at_random import real_design

from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import (
    Design,
    Readings,
    Settling,
    Status,
    adc_codes,
    apparent_resistance,
    live_recovery,
    recover,
    scan,
    sensitivity,
    volts_of_codes,
)
from ohmskin.errors import InputError

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


@pytest.mark.parametrize("circuit", ["inverting-amplifier", "voltage-divider", "row-amplifier"])
@pytest.mark.parametrize("seed", range(4))
def test_derivatives_are_those_of_the_reading(circuit: str, seed: int) -> None:
    """By the adjoint method against finite differences, a line or all parts at a time."""
    design, cells = real_design(seed, circuit=circuit, largest=3, idle_lines=True)
    found, h = sensitivity(design, cells), 1e-5
    one = design.readout.columns == "multiplexed"
    for section, key in (("array", "row_lead"), ("array", "column_lead"), ("readout", "reference_resistance")):
        derivative = getattr(found, key)
        value = np.broadcast_to(getattr(getattr(design, section), key), derivative.shape[-1])
        above, below = (
            design.replace(**{section: {key: float(each[0]) if one and section == "readout" else tuple(each)}})
            for each in (value * (1 + h), value * (1 - h))
        )
        slope = (scan(above, cells).volts - scan(below, cells).volts) / (2 * h)
        np.testing.assert_allclose(slope, (derivative * value).sum(axis=-1), rtol=1e-4, atol=1e-9)


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
