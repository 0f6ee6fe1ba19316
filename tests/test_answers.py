"""One answer, or bounds on all of them: readings of boards whose cells other cells may imitate, and lost neighbours."""

from __future__ import annotations

import numpy as np
import pytest
from designs import digitised
from live import counts_of, follow

from ohmskin.circuits import Design, Reason, Status, recover, scan
from ohmskin.common.arrays import FloatArray

TURNS = {"columns": "multiplexed", "idle_columns": "ground"}
"""columns read one by one while idle ones are grounded"""
CELLS = np.random.default_rng(0).uniform(5e3, 9e3, (8, 8))


def log_derivatives(design: Design, cells: FloatArray) -> FloatArray:
    """Of the readings' logarithms by those of the conductances, by central differences."""
    columns = []
    for k in range(cells.size):
        ends = []
        for sign in (1.0, -1.0):
            moved = cells.copy()
            moved.flat[k] *= np.exp(-1e-4 * sign)
            ends.append(np.log(np.abs(scan(design, moved, tolerance=1e-11).volts)).ravel())
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
        readout = {"reference_resistance": load, "idle_columns": columns}
        design = digitised("divider", *shape, 12, array={"row_lead": lead}, drive=drive, readout=readout)
        assert np.linalg.det(log_derivatives(design, 10 ** draw.uniform(2.0, 5.0, shape))) > 0.0


def test_grounded_idle_columns_give_two_boards_the_same_readings() -> None:
    design = digitised("divider", 4, 4, 12, array={"row_lead": 100.0}, readout={"reference_resistance": 1e4} | TURNS)
    for ohm in (300.0, 1000.0, 3000.0):
        cells = np.full((4, 4), ohm)
        reading = follow(design, [cells])[0]
        assert (reading.reason == Reason.UNCERTAIN).all()
        assert (reading.least <= 1.0 / ohm).all()
        assert (reading.greatest >= 1.0 / ohm).all()
        assert (recover(design, scan(design, cells).volts).status == Status.DISTURBED).all()
    few, other = np.full((4, 4), 300.0), np.full((4, 4), 40014.0)
    assert (counts_of(design, few) == counts_of(design, other)).all()
    assert follow(design.replace(array={"row_lead": 0.0}), [few])[0].valid.all()


@pytest.mark.parametrize("odd", [3e4, 1.0, 0.01, np.inf])
def test_a_range_of_the_cells_leaves_one_answer_where_idle_columns_are_grounded(odd: float) -> None:
    """Also beside a short or an open cell, which are outside of every range."""
    design = digitised("divider", 6, 5, 12, array={"row_lead": 25.0}, readout={"reference_resistance": 1e4} | TURNS)
    cells = np.random.default_rng(2).uniform(2e4, 4e4, (6, 5))
    assert not follow(design, [cells])[0].valid.any()
    known = design.replace(cells={"rest_resistance": 4e4, "full_scale_resistance": 1e4})
    assert follow(known, [cells])[0].valid.all()
    cells[2, 3] = odd
    follow(known, [cells])
    cells[:] = 300.0  # its counts are also those of a board of about 40 kohm
    assert not follow(design, [cells])[0].valid.any()


@pytest.mark.parametrize("shape", [(1, 3), (3, 1), (2, 2), (3, 3)])
def test_derivatives_behind_an_ideal_follower_have_one_sign(shape: tuple[int, int]) -> None:
    """A line with an error of the follower stands elsewhere than the others, and two boards may read alike."""
    draw = np.random.default_rng(shape)
    for _ in range(12):
        array = {"row_lead": float(10 ** draw.uniform(0, 3)), "column_lead": float(draw.choice([0.0, 1.0, 100.0]))}
        design = digitised("feedback", *shape, 12, array=array)
        assert np.linalg.det(log_derivatives(design, 10 ** draw.uniform(1.0, 5.0, shape))) > 0.0


@pytest.mark.parametrize("rows", ["ground", "float"])
def test_a_column_carries_what_it_would_while_idle_but_for_what_its_end_lacks_over_its_wires(rows: str) -> None:
    draw = np.random.default_rng(len(rows))
    for _ in range(20):
        gain, load, lead = (float(10 ** draw.uniform(*decades)) for decades in ((2, 5), (3, 5), (0, 2.5)))
        array = {"row_lead": float(10 ** draw.uniform(0, 3)), "column_lead": lead}
        readout = {"reference_resistance": load, "open_loop_gain": gain} | TURNS
        read = digitised("grounded", 4, 5, 12, array=array, drive={"idle_rows": rows}, readout=readout)
        held = read.replace(readout={"columns": "parallel", "open_loop_gain": np.inf, "idle_columns": "float"})
        cells = 10 ** draw.uniform(0.0, 5.0, (4, 5))
        currents, idle = (scan(each, cells, method="exact").volts for each in (read, held))
        currents = currents * (1.0 + 1.0 / gain)  # of a finite output
        assert (idle >= currents * (1.0 - 1e-9)).all()
        assert (idle <= currents * (1.0 + load / (1.0 + gain) / lead + 1e-9)).all()


@pytest.mark.parametrize("lead", [1.0, 20.0, 200.0])
def test_ends_that_differ_by_less_than_their_wires_leave_one_answer(lead: float) -> None:
    array, readout = {"row_lead": 200.0, "column_lead": lead}, {"open_loop_gain": 1e5} | TURNS
    design = digitised("grounded", 8, 8, 12, array=array, drive={"idle_rows": "float"}, readout=readout)
    assert follow(design, [CELLS, CELLS])[-1].valid.all()
    poor = design.replace(readout={"open_loop_gain": 100.0})
    assert not follow(poor, [CELLS, CELLS])[-1].valid.any()


@pytest.mark.parametrize("columns", ["float", "load"])
def test_pulled_rows_of_more_than_a_hundred_cells_are_read(columns: str) -> None:
    drive = {"idle_rows": "pull", "idle_row_resistance": 1e4}
    readout = {"reference_resistance": 1e4, "idle_columns": columns}
    reading = follow(digitised("divider", 11, 10, 12, drive=drive, readout=readout), [np.full((11, 10), 2e4)])[0]
    assert reading.valid.all()
    assert np.abs(reading.resistance / 2e4 - 1.0).max() < 0.005


@pytest.mark.parametrize("lead", [0.0, 1.0, 25.0])
def test_a_saturated_cell_costs_multiplexed_amplifiers_no_more_than_parallel_ones(lead: float) -> None:
    cells = CELLS.copy()
    cells[2, 5] = 300.0
    boards = [digitised("grounded", 8, 8, 12, lead=lead, readout=readout) for readout in ({}, TURNS)]
    parallel, in_turns = (follow(board, [cells])[0].valid.mean() for board in boards)
    assert in_turns >= parallel - 0.02


@pytest.mark.parametrize("ohm", [300.0, 10.0, 0.1])
@pytest.mark.parametrize("offset", [3e-3, -3e-3])
def test_an_offset_leaves_by_a_saturated_cell_and_its_pull_down(ohm: float, offset: float) -> None:
    readout = {"open_loop_gain": 1e5, "offset_voltage": offset}
    drive = {"idle_rows": "pull", "idle_row_resistance": 100.0}
    design = digitised("grounded", 2, 1, 12, lead=2.0, drive=drive, readout=readout, adc={"range": [-0.1, 3.3]})
    follow(design, [np.array([[1e4], [ohm]])])


@pytest.mark.parametrize("hidden", [1e5, 1e4, 1e3])
def test_cells_behind_a_break_pass_on_what_a_saturated_output_no_longer_holds(hidden: float) -> None:
    fault = [{"kind": "broken-row", "place": [1, 0]}]
    sections = {"readout": {"supply": [-0.2, 3.6]}, "adc": {"range": [-0.1, 3.3]}}
    follow(digitised("grounded", 2, 2, 12, lead=5.0, fault=fault, **sections), [np.array([[1.0, 1e4], [hidden] * 2])])


def test_bridged_columns_of_loaded_dividers_are_followed_to_their_error() -> None:
    fault = [{"kind": "bridged-columns", "place": [0, 0], "resistance": 100.0}]
    design = digitised("loaded", 2, 2, 16, fault=fault, readout={"reference_resistance": 4e3})
    rest, change = np.array([[3e4, 4.5e4], [4e4, 3e4]]), np.array([[1.0, -1.0], [0.5, -0.3]])
    readings = follow(design, [rest * (1.0 + 0.1 * np.sin(k / 6) * change) for k in range(20)])
    assert sum(int(reading.valid.sum()) for reading in readings) > 40


@pytest.mark.parametrize("ohm", [0.0, 1e-6])
def test_shorts_join_columns_of_one_amplifier_that_reads_them_in_turns(ohm: float) -> None:
    design = digitised("grounded", 2, 2, 12, array={"row_lead": 1.0}, drive={"voltage": 1.0},
                       readout={"columns": "multiplexed", "reference_resistance": 1e4})  # fmt: skip
    volts = scan(design, [[ohm, ohm], [1e4, 1e4]]).volts
    np.testing.assert_allclose(volts, [[-1e4, -1e4], [-1.9996, -1.9996]], rtol=1e-5)
