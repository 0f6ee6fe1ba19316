"""Follower boards with high references and leads, pressed hard: two sets of cells may give the same readings."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

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


def cells_between(rest_ohm: float, full_scale_ohm: float) -> dict[str, float]:
    return {"rest_resistance": rest_ohm, "full_scale_resistance": full_scale_ohm}


def test_cells_of_an_ohm_read_like_kiloohms_and_are_called_so_by_their_range_only() -> None:
    """All readings of 6 x 8 cells of 1 ohm are those of some kiloohm, to 0.01 ADC steps."""
    design = board(6, 8, 25.0).replace(
        array={"column_lead": 0.0},
        readout={"reference_resistance": 3e3, "offset_voltage": 0.0, "open_loop_gain": 300.0},
    )
    cells = np.full((6, 8), 1.0)
    counts = adc_codes(design, scan(design, cells).volts)
    reading = CountReader(design)(counts)
    assert not reading.valid.any()
    assert ((reading.least <= 1.0 / cells) & (1.0 / cells <= reading.greatest)).all()
    known = CountReader(design.replace(cells=cells_between(10e3, 1e3)))(counts)
    assert known.valid.all()
    alike = scan(design, known.resistance).volts
    assert (known.resistance > 1e3).all()
    assert (np.abs(adc_codes(design, alike) - counts) <= 1).all()


def test_a_press_to_a_few_ohm_beside_segments_leaves_no_wrong_cell() -> None:
    """Valid cells of 2 ohm were read as some hundred: the wire lessened what the column's other cells take."""
    shape, design = (5, 6), board(5, 6, 50.0)
    readout = {"reference_resistance": 3e3, "open_loop_gain": 1e3, "offset_voltage": 0.0}
    array = {"column_lead": 0.0, "row_segment": 0.5, "column_segment": 0.5}
    design = design.replace(array=array, readout=readout, cells=cells_between(50e3, 20.0))
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


@pytest.mark.parametrize("lead", [20.0, 200.0])
@pytest.mark.parametrize("offset", [0.0, 1e-3])
@pytest.mark.parametrize("reference", [3e3, 29.4e3])
@pytest.mark.parametrize("shape", [(7, 3), (16, 16)])
def test_equal_cells_far_above_their_leads_are_valid(
    shape: tuple[int, int], reference: float, offset: float, lead: float
) -> None:
    """An offset that drives currents from the idle lines into a column cannot hide a pressed skin."""
    readout = {"reference_resistance": reference, "offset_voltage": offset, "open_loop_gain": 1e5}
    design = board(*shape, lead).replace(array={"column_lead": 0.0}, readout=readout, adc={"bits": 12})
    design = design.replace(cells=cells_between(120e3, 10e3))
    for resistance in (10e3, 120e3):
        cells, read = np.full(shape, resistance), CountReader(design)
        for _ in range(3):
            reading = read(adc_codes(design, scan(design, cells).volts))
        assert reading.valid.all()
        assert (np.abs(reading.resistance / cells - 1.0) <= reading.uncertainty).all()


def test_current_from_idle_lines_above_a_poor_conductor_is_enclosed_with_the_others() -> None:
    """By the follower's offset. Cells of 170 to 190 kohm beside hard presses were read as 44 to 62 kohm, and valid."""
    design = board(7, 3, 200.0).replace(
        array={"column_lead": 0.0},
        readout={"reference_resistance": 29.4e3, "offset_voltage": 5e-3, "open_loop_gain": 300.0},
        adc={"bits": 12},
    )
    rest = np.full((7, 3), 120e3)
    pressed = np.array(
        [
            [118e3, 111e3, 82.0],
            [181e3, 192e3, 173e3],
            [148.0, 5.3, 63.0],
            [93.0, 6.0, 43.0],
            [81e3, 300.0, 191e3],
            [173e3, 8.0, 48.5],
            [109e3, 11.7, 188e3],
        ]
    )
    read, valid = CountReader(design), 0
    for cells in [rest] * 2 + [pressed] * 6 + [rest] * 3:
        reading = read(adc_codes(design, scan(design, cells).volts))
        known = reading.valid
        valid += int(known.sum())
        assert (np.abs(reading.resistance / cells - 1.0) <= reading.uncertainty)[known].all()
    assert valid >= 4 * rest.size


@pytest.mark.parametrize("bits", [8, 16])
def test_an_open_cell_behind_heavy_leads_is_not_valid(bits: int) -> None:
    """What passes beside the cell was taken for its own current, of which the cell's own share is far less."""
    shape = (20, 20)
    array = {"column_lead": 60.0, "row_segment": 2.0, "column_segment": 2.0}
    readout = {"reference_resistance": 4.7e3, "offset_voltage": 5e-4, "open_loop_gain": 1e6, "bias_current": 1e-9}
    design = board(*shape, 120.0).replace(array=array, readout=readout, adc={"bits": bits})
    rest = 10 ** np.random.default_rng(77).uniform(3.9, 4.15, shape)
    opened = rest.copy()
    opened[2, 1] = 1e12
    read = CountReader(design)
    for cells in [rest] * 2 + [opened] * 4:
        reading = read(adc_codes(design, scan(design, cells).volts))
        known = reading.valid
        assert (np.abs(reading.resistance / cells - 1.0) <= reading.uncertainty)[known].all()
    assert known.sum() == known.size - 1


def test_current_by_detours_over_pressed_cells_is_enclosed_with_them() -> None:
    """By way of a row and a column of good conductors. A cell of 9 kohm was read as 3.7 kohm within 22 %, and valid."""
    design = board(7, 5, 100.0).replace(
        array={"column_lead": 5.0},
        readout={"reference_resistance": 10.8e3, "offset_voltage": 2e-3, "open_loop_gain": 1e3},
    )
    rest = np.array(
        [
            [6043.0, 4607.0, 4910.0, 4538.0, 6337.0],
            [5930.0, 7393.0, 9021.0, 4308.0, 5943.0],
            [5827.0, 6447.0, 4584.0, 10210.0, 8159.0],
            [6465.0, 5794.0, 8097.0, 8343.0, 9735.0],
            [7610.0, 5109.0, 8662.0, 4450.0, 5011.0],
            [6436.0, 5332.0, 8942.0, 6494.0, 6095.0],
            [6242.0, 6365.0, 6369.0, 9211.0, 4914.0],
        ]
    )
    pressed = rest.copy()
    pressed[:, 1] = 115.3, 355.7, 34.49, 25.84, 4.365, 38.64, 619.7
    pressed[4] = 42.55, 4.365, 17.39, 5.744, 20.90
    read = CountReader(design)
    for cells in [rest] * 2 + [pressed] * 7 + [rest] * 2:
        reading = read(adc_codes(design, scan(design, cells).volts))
        known = reading.valid
        assert (np.abs(reading.resistance / cells - 1.0) <= reading.uncertainty)[known].all()
    assert known.all()
