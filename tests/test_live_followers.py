"""Follower boards with high references and leads, pressed hard: two sets of cells may give the same readings."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ohmskin.bench import _live_hunt
from ohmskin.circuits import Design, adc_codes, scan
from ohmskin.common.arrays import FloatArray
from ohmskin.driver import CountReader


def board(rows: int, columns: int, lead: float) -> Design:
    return Design.model_validate(
        {
            "array": {"rows": rows, "columns": columns, "row_lead": lead, "column_lead": lead},
            "drive": {"voltage": 3.3},
            "readout": {"circuit": "voltage-feedback", "reference_resistance": 300e3, "offset_voltage": -2e-3},
            "adc": {"bits": 16, "range": [0.0, 3.3]},
        }
    )


def test_a_press_to_a_few_ohm_beside_segments_leaves_no_wrong_cell() -> None:
    """Valid cells of 2 ohm were read as some hundred: the wire lessened what the column's other cells take."""
    shape, design = (5, 6), board(5, 6, 50.0)
    readout = {"reference_resistance": 3e3, "open_loop_gain": 1e3, "offset_voltage": 0.0}
    design = design.replace(array={"column_lead": 0.0, "row_segment": 0.5, "column_segment": 0.5}, readout=readout)
    random = np.random.default_rng(1)
    rest, pressed = 10 ** random.uniform(4.6, 5.0, shape), random.uniform(2.0, 2.5, shape)
    read, valid = CountReader(design), 0
    for cells in [rest] * 2 + [pressed] * 6 + [rest] * 2:
        reading = read(adc_codes(design, scan(design, cells).volts))
        known = reading.valid
        valid += int(known.sum())
        assert (np.abs(reading.resistance / cells - 1.0) <= reading.uncertainty)[known].all()
    assert valid > 0


@pytest.mark.parametrize("seed", range(6))
def test_a_skin_that_is_pressed_at_once_leaves_no_wrong_cell(seed: int) -> None:
    random = np.random.default_rng(seed)
    design = board(5, 5, 50.0)
    rest = 10 ** random.uniform(5.0, 5.5, (5, 5))
    pressed = 10 ** random.uniform(1.0, 4.0, (5, 5))

    def counts(cells: FloatArray) -> NDArray[np.integer]:
        return adc_codes(design, scan(design, cells).volts)

    read, valid = CountReader(design), 0
    for cells in [rest] * 3 + [pressed] * 5 + [rest] * 3:
        reading = read(counts(cells))
        known = reading.valid
        valid += int(known.sum())
        assert (np.abs(reading.resistance / cells - 1.0) <= reading.uncertainty)[known].all()
    assert valid > 0


@pytest.mark.parametrize("number", [47110000031, 47110000048, 47110000055])
def test_streams_of_hard_presses_that_once_had_wrong_cells(number: int) -> None:
    """Valid cells were off by factors of 27 to 2400."""
    tally = _live_hunt.LiveTally()
    _live_hunt.check("feedback pressed", number, tally)
    assert tally.findings == []
    assert tally.valid
