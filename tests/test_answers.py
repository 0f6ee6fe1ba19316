"""One answer, or bounds on all of them: readings of boards whose cells other cells may imitate, and lost neighbours."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from nodal import nodal_volts
from option_product import Tally, check, drawn

from ohmskin.circuits import Design, Reason, Status, adc_codes, recover, scan
from ohmskin.common.arrays import FloatArray
from ohmskin.common.measurement import Measurement
from ohmskin.driver import CountReader

SEEDS = (
    *(5, 11, 28, 29, 47, 66, 145, 166, 194, 3198, 100772, 100992, 101070, 101344),
    *(200172, 200281, 201020, 201170, 300876, 300971, 500254, 500438, 500123),
    *(500102, 700676, 701876, 920025, 8100364),
)
"""streams whose cells were once called valid though they were wrong"""


def divider(rows: int, columns: int, lead: float, *, load: float = 1e4, **more: Any) -> Design:
    tables = {
        "array": {"rows": rows, "columns": columns, "row_lead": lead, "column_lead": more.pop("column_lead", 0.0)},
        "drive": {"voltage": 3.3, **more.pop("drive", {})},
        "readout": {"circuit": "voltage-divider", "reference_resistance": load, **more.pop("readout", {})},
        "adc": {"bits": more.pop("bits", 12), "range": [0.0, 3.3]},
    }
    return Design.model_validate(tables | more)


def read(design: Design, cells: FloatArray, frames: int = 1) -> Measurement:
    reader, counts = CountReader(design), adc_codes(design, nodal_volts(design, cells))
    return [reader(counts) for _ in range(frames)][-1]


def log_derivatives(design: Design, cells: FloatArray) -> FloatArray:
    """Of the readings' logarithms by those of the conductances, by central differences of the independent solver."""
    columns = []
    for k in range(cells.size):
        ends = []
        for sign in (1.0, -1.0):
            moved = cells.copy()
            moved.flat[k] *= np.exp(-1e-4 * sign)
            ends.append(np.log(np.abs(nodal_volts(design, moved))).ravel())
        columns.append((ends[0] - ends[1]) / 2e-4)
    return np.array(columns).T


ENDS = [("float", "ground"), ("load", "ground"), ("float", "float"), ("load", "float"), ("float", "pull")]


@pytest.mark.parametrize(("columns", "rows"), ENDS)
@pytest.mark.parametrize("shape", [(1, 3), (3, 1), (2, 2), (3, 3)])
def test_derivatives_have_one_sign_where_no_idle_end_conducts_more(
    columns: str, rows: str, shape: tuple[int, int]
) -> None:
    draw = np.random.default_rng([*shape, len(columns), len(rows)])
    for _ in range(12):
        drive = {"idle_rows": rows} | (
            {"idle_row_resistance": float(10 ** draw.uniform(2, 5))} if rows == "pull" else {}
        )
        lead, load = (float(10 ** draw.uniform(*decades)) for decades in ((0, 3), (2, 4)))
        design = divider(*shape, lead, load=load, drive=drive, readout={"idle_columns": columns})
        derivatives = log_derivatives(design, 10 ** draw.uniform(2.0, 5.0, shape))
        assert np.linalg.det(derivatives) > 0.0


def test_grounded_idle_columns_give_two_boards_the_same_readings() -> None:
    design = divider(4, 4, 100.0, readout={"columns": "multiplexed", "idle_columns": "ground"})
    for ohm in (300.0, 1000.0, 3000.0):
        cells = np.full((4, 4), ohm)
        reading = read(design, cells)
        assert not reading.valid.any()
        assert (reading.reason == Reason.UNCERTAIN).all()
        assert (reading.least <= 1.0 / ohm).all()
        assert (reading.greatest >= 1.0 / ohm).all()
        assert (recover(design, nodal_volts(design, cells)).status == Status.DISTURBED).all()
    other = np.full((4, 4), 40014.0)  # the other board of 300 ohm
    assert (
        adc_codes(design, nodal_volts(design, other)) == adc_codes(design, nodal_volts(design, other * 0 + 300))
    ).all()
    ideal = design.replace(array={"row_lead": 0.0})
    assert read(ideal, np.full((4, 4), 300.0)).valid.all()


@pytest.mark.parametrize("columns", ["float", "load"])
def test_pulled_rows_of_more_than_a_hundred_cells_are_read(columns: str) -> None:
    drive = {"idle_rows": "pull", "idle_row_resistance": 1e4}
    design = divider(11, 10, 0.0, drive=drive, readout={"idle_columns": columns})
    reading = read(design, np.full((11, 10), 2e4))
    assert reading.valid.all()
    assert np.abs(reading.resistance / 2e4 - 1.0).max() < 0.005


@pytest.mark.parametrize("columns", ["float", "load"])
@pytest.mark.parametrize("lead", [0.3, 1.0, 5.0])
@pytest.mark.parametrize("short", [0.01, 5.0])
def test_a_shorted_cell_of_a_divider_costs_its_column_at_most(lead: float, short: float, columns: str) -> None:
    design = divider(8, 8, lead, load=2e3, column_lead=lead, readout={"idle_columns": columns})
    cells = np.random.default_rng(0).uniform(5e3, 9e3, (8, 8))
    cells[2, 5] = short
    reading = read(design, cells, frames=6)
    assert np.delete(reading.valid, 5, axis=1).all()
    error = np.abs(reading.resistance / cells - 1.0)[reading.valid]
    assert (error <= reading.uncertainty[reading.valid]).all()


@pytest.mark.parametrize("lead", [0.0, 1.0, 25.0])
def test_a_saturated_cell_costs_multiplexed_amplifiers_no_more_than_parallel_ones(lead: float) -> None:
    cells = np.random.default_rng(0).uniform(5e3, 9e3, (8, 8))
    cells[2, 5] = 300.0
    valid = []
    for readout in ({}, {"columns": "multiplexed", "idle_columns": "ground"}):
        design = divider(8, 8, lead, column_lead=lead, drive={"voltage": -1.0}).replace(
            readout={"circuit": "inverting-amplifier", "reference_resistance": 2e3, **readout}
        )
        valid.append(read(design, cells).valid.mean())
    assert valid[1] >= valid[0] - 0.02


def bounded(reading: Measurement, cells: FloatArray) -> bool:
    error = np.abs(reading.resistance / cells - 1.0)[reading.valid]
    return bool((error <= reading.uncertainty[reading.valid]).all())


@pytest.mark.parametrize("odd", [3e4, 1.0, 0.01, np.inf])
def test_a_range_of_the_cells_leaves_one_answer_where_idle_columns_are_grounded(odd: float) -> None:
    """Also beside a short or an open cell, which are outside of every range."""
    random = np.random.default_rng(2)
    design = divider(6, 5, 25.0, readout={"columns": "multiplexed", "idle_columns": "ground"})
    cells = random.uniform(2e4, 4e4, (6, 5))
    assert not read(design, cells).valid.any()
    known = design.replace(cells={"rest_resistance": 4e4, "full_scale_resistance": 1e4})
    assert bounded(read(known, cells), cells)
    assert read(known, cells).valid.all()
    cells[2, 3] = odd
    assert bounded(read(known, cells), cells)
    cells[:] = 300.0  # its counts are also those of a board of about 40 kohm
    assert not read(design, cells).valid.any()


@pytest.mark.parametrize("ohm", [300.0, 10.0, 0.1])
@pytest.mark.parametrize("offset", [3e-3, -3e-3])
def test_an_offset_leaves_by_a_saturated_cell_and_its_pull_down(ohm: float, offset: float) -> None:
    design = divider(
        2, 1, 2.0, column_lead=2.0, drive={"idle_rows": "pull", "idle_row_resistance": 100.0, "voltage": -1.0}
    )
    readout = {"circuit": "inverting-amplifier", "reference_resistance": 2e3, "open_loop_gain": 1e5}
    design = design.replace(readout={**readout, "offset_voltage": offset}, adc={"range": [-0.1, 3.3]})
    cells = np.array([[1e4], [ohm]])
    assert bounded(read(design, cells), cells)


@pytest.mark.parametrize("hidden", [1e5, 1e4, 1e3])
def test_cells_behind_a_break_pass_on_what_a_saturated_output_no_longer_holds(hidden: float) -> None:
    design = divider(2, 2, 5.0, column_lead=5.0, drive={"voltage": -1.0}).replace(
        readout={"circuit": "inverting-amplifier", "reference_resistance": 2e3, "supply": [-0.2, 3.6]},
        adc={"range": [-0.1, 3.3]},
        fault=({"kind": "broken-row", "place": [1, 0]},),
    )
    cells = np.array([[1.0, 1e4], [hidden, hidden]])
    assert bounded(read(design, cells), cells)


def test_bridged_columns_of_loaded_dividers_are_followed_to_their_error() -> None:
    fault = [{"kind": "bridged-columns", "place": [0, 0], "resistance": 100.0}]
    design = divider(2, 2, 0.0, load=4e3, bits=16, readout={"idle_columns": "load"}, fault=fault)
    rest, reader, valid = np.array([[3e4, 4.5e4], [4e4, 3e4]]), CountReader(design), 0
    for k in range(20):
        cells = rest * (1.0 + 0.1 * np.sin(k / 6) * np.array([[1.0, -1.0], [0.5, -0.3]]))
        reading = reader(adc_codes(design, nodal_volts(design, cells)))
        valid += int(reading.valid.sum())
        assert bounded(reading, cells)
    assert valid > 40


@pytest.mark.parametrize("seed", SEEDS)
def test_boards_of_all_options_have_no_wrong_cell(seed: int) -> None:
    """``python tests/option_product.py`` reads many more of them."""
    tallies = {drawn(seed)[0]: Tally()}
    check(seed, tallies, derivatives=False)
    (tally,) = tallies.values()
    assert tally.wrong == tally.failed == []


@pytest.mark.parametrize("ohm", [0.0, 1e-6])
def test_shorts_join_columns_of_one_amplifier_that_reads_them_in_turns(ohm: float) -> None:
    design = divider(2, 2, 1.0, drive={"voltage": 1.0}).replace(
        readout={"circuit": "inverting-amplifier", "columns": "multiplexed"}
    )
    volts = scan(design, [[ohm, ohm], [1e4, 1e4]]).volts
    np.testing.assert_allclose(volts, [[-1e4, -1e4], [-1.9996, -1.9996]], rtol=1e-5)


def test_the_judge_is_the_scan() -> None:
    design = divider(3, 4, 20.0, column_lead=10.0, readout={"idle_columns": "load"})
    cells = 10 ** np.random.default_rng(1).uniform(2.0, 4.0, (3, 4))
    np.testing.assert_allclose(nodal_volts(design, cells), scan(design, cells).volts, rtol=1e-9)
