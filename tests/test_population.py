"""Many boards of one design: the block elimination against a loop over the scan of each board."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from designs import amplifier, divider

from ohmskin.circuits import Boards, Design, scan, scan_population
from ohmskin.errors import InputError

COUNT = 5


def _boards(design: Design, seed: int) -> Boards:
    """Boards whose every part differs by up to 30 % from line to line."""
    random = np.random.default_rng(seed)
    nominal = Boards.of(design)
    values = {name: getattr(nominal, name) for name in Boards.names()}
    if design.readout.columns == "multiplexed":  # its lines share one amplifier or load
        shared = ("reference_resistance", "open_loop_gain", "offset_voltage", "bias_current")
        values |= {name: values[name][:, :1] for name in shared}
    drawn = {name: value * random.uniform(0.7, 1.3, (COUNT, value.shape[1])) for name, value in values.items()}
    sizes = {name: getattr(nominal, name).shape[1] for name in Boards.names()}
    return Boards(**{name: np.broadcast_to(value, (COUNT, sizes[name])) for name, value in drawn.items()})


AMPLIFIED = {"open_loop_gain": 1e4, "offset_voltage": 4e-3, "bias_current": 1e-8, "reference_voltage": 1.65}
PULL = {"idle_rows": "pull", "idle_row_resistance": 2e3}
GROUNDED = {"columns": "multiplexed", "idle_columns": "ground"}
ONE = amplifier(4, 3, lead=30.0, segment=2.0, **AMPLIFIED)
DESIGNS = {
    "ideal wires": amplifier(3, 4, **AMPLIFIED),
    "leads": amplifier(4, 3, lead=70.0, **AMPLIFIED),
    "segments": amplifier(5, 4, lead=70.0, segment=3.0, **AMPLIFIED),
    "ideal amplifiers": amplifier(3, 3, segment=3.0),
    "floating rows": amplifier(4, 3, lead=30.0, segment=2.0, **AMPLIFIED).replace(drive={"idle_rows": "float"}),
    "floating rows, ideal lines": amplifier(3, 4, **AMPLIFIED).replace(drive={"idle_rows": "float"}),
    "divider": divider(4, 3, row_lead=20.0, column_segment=3.0),
    "divider, ideal lines": divider(3, 4),
    "divider, grounded rows": divider(4, 3, idle_rows="ground", row_lead=20.0, row_segment=1.0),
    "divider, loaded columns": divider(3, 4, idle_columns="load", row_lead=20.0, column_lead=5.0),
    "divider, loaded columns, grounded rows": divider(
        3, 4, idle_rows="ground", idle_columns="load", column_segment=5.0
    ),
    "one row": amplifier(1, 3, lead=10.0, segment=1.0, **AMPLIFIED),
    "one column": amplifier(3, 1, lead=10.0, segment=1.0, **AMPLIFIED),
    "follower": amplifier(3, 3, lead=10.0, circuit="voltage-feedback", open_loop_gain=1e3),
    "follower, segments": amplifier(4, 3, lead=10.0, segment=2.0, **AMPLIFIED).with_circuit("voltage-feedback"),
    "follower, ideal lines": amplifier(3, 4, **AMPLIFIED).with_circuit("voltage-feedback"),
    "sensed rows": amplifier(3, 4, lead=10.0, segment=2.0, **AMPLIFIED).with_circuit("row-amplifier"),
    "sensed rows, floating columns": amplifier(4, 3, lead=10.0, segment=2.0, **AMPLIFIED)
    .replace(drive={"idle_rows": "float"})
    .with_circuit("row-amplifier"),
    "pull-downs": amplifier(3, 4, lead=30.0, segment=2.0, **AMPLIFIED).replace(drive=PULL),
    "divider, pull-downs": divider(3, 4, row_lead=30.0, column_lead=5.0, row_segment=2.0).replace(drive=PULL),
    "divider, pull-downs, grounded columns": divider(3, 4, row_lead=30.0).replace(drive=PULL, readout=GROUNDED),
    "divider, grounded columns": divider(4, 3, column_lead=5.0, column_segment=2.0).replace(readout=GROUNDED),
    "one amplifier, open columns": ONE.replace(readout={"columns": "multiplexed"}),
    "one amplifier, grounded columns": ONE.replace(readout=GROUNDED),
    "one amplifier, loaded columns": ONE.replace(readout={"columns": "multiplexed", "idle_columns": "load"}),
    "saturating": amplifier(3, 3, lead=10.0, supply=(-0.4, 0.4), **{**AMPLIFIED, "reference_voltage": 0.0}),
}


@pytest.mark.parametrize("name", DESIGNS)
def test_every_board_is_read_as_by_a_scan_of_its_own(name: str) -> None:
    design = DESIGNS[name]
    random = np.random.default_rng(1)
    cells = 10 ** random.uniform(3.0, 4.5, (COUNT, *design.array.shape))
    boards = _boards(design, 2)
    found = scan_population(design, boards, cells)
    for board in range(COUNT):
        alone = scan(boards.design(design, board), cells[board], method="exact")
        assert found.volts[board] == pytest.approx(alone.volts, rel=1e-9, abs=1e-12)
        assert (found.saturated[board] == alone.saturated).all()


@pytest.mark.parametrize("name", DESIGNS)
def test_one_driven_line_is_read_as_among_all_lines(name: str) -> None:
    design = DESIGNS[name]
    random = np.random.default_rng(8)
    cells = 10 ** random.uniform(3.0, 4.5, (COUNT, *design.array.shape))
    boards = _boards(design, 9)
    whole = scan_population(design, boards, cells)
    kind = 1 if design.readout.circuit == "row-amplifier" else 0
    driven = random.integers(0, design.array.shape[kind], COUNT)
    one = scan_population(design, boards, cells, driven=driven)
    for board, line in enumerate(driven):
        known = np.take(one.volts[board], line, axis=kind)
        assert known == pytest.approx(np.take(whole.volts[board], line, axis=kind), rel=1e-10)
        assert np.isnan(np.delete(one.volts[board], line, axis=kind)).all()


@pytest.mark.parametrize("fault", [0.0, np.inf])
def test_open_and_shorted_cells_are_read_too(fault: float) -> None:
    design = DESIGNS["segments"]
    cells = np.full((COUNT, *design.array.shape), 5e3)
    cells[:, 1, 2] = fault
    boards = _boards(design, 3)
    found = scan_population(design, boards, cells)
    alone = scan(boards.design(design, 4), cells[4], method="exact")
    assert found.volts[4] == pytest.approx(alone.volts, rel=1e-9)


def test_saturated_boards_are_flagged_even_when_they_are_not_solved_again() -> None:
    design = DESIGNS["saturating"]
    cells = np.full((COUNT, 3, 3), 10e3)
    cells[2] = 500.0
    boards = _boards(design, 6)
    quick = scan_population(design, boards, cells, resolve_saturation=False)
    exact = scan_population(design, boards, cells)
    assert (quick.saturated.any(axis=(1, 2)) == exact.saturated.any(axis=(1, 2))).all()
    assert np.abs(quick.volts).max() <= 0.4


def test_shapes_that_do_not_fit_are_refused() -> None:
    design = DESIGNS["leads"]
    with pytest.raises(InputError, match="expected \\(boards, 4, 3\\)"):
        scan_population(design, Boards.of(design), np.ones((2, 3, 4)))
    many = replace(Boards.of(design), offset_voltage=np.zeros((4, 3)))
    with pytest.raises(InputError, match="4 boards and 2 frames"):
        scan_population(design, many, np.ones((2, 4, 3)))
