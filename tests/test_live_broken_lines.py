"""Lines that break while a board is read: other cells keep their resistances, within what is uncertain."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ohmskin.circuits import Design, Reason, adc_codes, scan
from ohmskin.circuits._exact import read_exactly
from ohmskin.circuits.recovery._coupled_board import CoupledBoard
from ohmskin.common.arrays import FloatArray
from ohmskin.driver import CountReader, Reading

BOARDS = {
    "divider": ({"circuit": "voltage-divider"}, "ground"),
    "floating amplifiers": ({"circuit": "inverting-amplifier", "supply": [-0.1, 3.3]}, "float"),
    "floating row amplifiers": ({"circuit": "row-amplifier", "supply": [-0.1, 3.3]}, "float"),
}
BEFORE, DURING, AFTER = range(6), range(6, 18), range(18, 24)  # frames
ROW, COLUMN = {"kind": "broken-row", "place": [2, 1]}, {"kind": "broken-column", "place": [6, 2]}


def board(name: str) -> Design:
    """8 x 8 cells, 12 bits."""
    readout, idle = BOARDS[name]
    amplified = name != "divider"
    return Design.model_validate(
        {
            "array": {"rows": 8, "columns": 8, "row_lead": 25.0, "column_lead": 5.0, "row_segment": 0.1},
            "drive": {"voltage": -1.0 if amplified else 3.3, "idle_rows": idle},
            "readout": readout | {"reference_resistance": 30e3 if amplified else 4.7e3},
            "adc": {"bits": 12, "range": [0.0, 3.3]},
        }
    )


def read(design: Design, cells: FloatArray, fault: dict[str, Any] | None, opened: FloatArray) -> list[Reading]:
    """The readings while a line breaks and returns, or cells (8, 8) in ohm become those of ``opened``."""
    draw, reader, readings = np.random.default_rng(1), CountReader(design), []
    broken = design.replace(fault=[fault]) if fault else design
    volts = scan(design, cells).volts, scan(broken, opened).volts
    for frame in (*BEFORE, *DURING, *AFTER):
        noisy = volts[frame in DURING] + draw.normal(scale=0.5 * 3.3 / 4096, size=cells.shape)
        readings.append(reader(adc_codes(design, noisy)))
    return readings


def largest_error(reading: Reading, cells: FloatArray) -> float:
    """Of the valid cells, relative."""
    return float(np.abs(reading.resistance / cells - 1.0)[reading.valid].max())


@pytest.fixture
def cells() -> FloatArray:
    """8 x 8 cells that differ by 3 %, two of them pressed."""
    ohms = 18e3 * np.exp(0.03 * np.random.default_rng(2).standard_normal((8, 8)))
    ohms[4, 3:5] *= 1.8
    return ohms


@pytest.mark.parametrize(
    ("name", "fault"),
    [("divider", ROW), ("floating amplifiers", COLUMN), ("floating row amplifiers", ROW)],
)
def test_a_broken_line_leaves_the_other_cells(name: str, fault: dict[str, Any], cells: FloatArray) -> None:
    # The cells behind the break tie floating lines: without them the others would read 0.88 of what they are.
    readings = read(board(name), cells, fault, cells)
    for frame in (*DURING[4:], *AFTER[4:]):  # some boards take a few frames to settle
        assert readings[frame].valid.any()
        assert largest_error(readings[frame], cells) < 0.03
    during = readings[DURING[-1]]
    behind = np.isin(during.reason, (Reason.NO_CURRENT, Reason.DISTURBED))
    assert behind[2, 1:].all() if fault is ROW else behind[:7, 2].all()
    assert during.uncertainty[during.valid].min() < 0.2, "cells that share no line with the break are known as before"
    assert (readings[AFTER[-1]].uncertainty < 0.05).all()


@pytest.mark.parametrize("segment", [0.0, 0.5])
@pytest.mark.parametrize("place", [0, 3])
@pytest.mark.parametrize("name", ["divider", "floating amplifiers"])
def test_a_model_with_a_broken_line_is_that_of_a_board_with_one(name: str, place: int, segment: float) -> None:
    """Against the exact solver with an open wire: at the driver or the end, and between crosspoints."""
    array = {"rows": 8, "columns": 8, "row_lead": 25.0, "column_lead": 5.0}
    array |= {"row_segment": segment, "column_segment": segment}
    parts = CoupledBoard(board(name).replace(array=array).board)
    row_ohms, column_ohms, column_lead = (
        ohms.copy() for ohms in (parts.board.row_ohms, parts.board.column_ohms, parts.board.column_lead)
    )
    beyond = np.zeros((8, 8), dtype=np.bool_)
    if name == "divider":
        row_ohms[1, place], beyond[1, place:] = np.inf, True
    elif place:
        column_ohms[place, 1], beyond[:place, 1] = np.inf, True
    else:
        column_lead[1], beyond[:, 1] = np.inf, True
    resistance = 10 ** np.random.default_rng(1).uniform(3.5, 5.5, (8, 8))
    model = parts.quick.broken(row_ohms, column_ohms, column_lead)
    broken = replace(parts.board, row_ohms=row_ohms, column_ohms=column_ohms, column_lead=column_lead)
    exact = read_exactly(broken, resistance)[0].volts
    np.testing.assert_allclose(model(resistance)[~beyond], exact[~beyond], rtol=1e-4)
    sound = np.abs(parts.quick(resistance)[~beyond] / exact[~beyond] - 1.0)
    assert sound.max() > 1e-2, "the break changes other readings"


@pytest.mark.parametrize("name", list(BOARDS))
def test_contacts_that_open_are_no_broken_line(name: str, cells: FloatArray) -> None:
    opened = cells.copy()
    opened[2, 1:] = np.inf
    opened[:7, 2] = np.inf
    readings = read(board(name), cells, None, opened)
    for frame in DURING[4:]:
        assert readings[frame].valid.any()
        assert largest_error(readings[frame], opened) < 0.03
        assert not readings[frame].valid[np.isinf(opened)].any()


def test_a_break_with_a_resistance_hides_its_cells(cells: FloatArray) -> None:
    # 100 kohm let through what would be cells of 40 times the resistance.
    readings = read(board("divider"), cells, ROW | {"resistance": 1e5}, cells)
    for frame in DURING:
        assert (readings[frame].reason[2, 1:] != Reason.VALID).all()
        assert largest_error(readings[frame], cells) < 0.03
