"""The circuit that senses rows, against the independent reference and against the same board turned by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from parts_at_random import real_design

from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import (
    Design,
    Settling,
    effects,
    noise,
    scan,
    scan_batch,
    sensitivity,
    stability,
)
from ohmskin.errors import SolverError

REAL_PARTS: dict[str, Any] = {
    "gain_bandwidth": 1e6,
    "open_loop_gain": 1e5,
    "column_capacitance": 1e-10,
    "voltage_noise": 1e-8,
    "temperature": 300.0,
}


def turn(values: np.ndarray) -> np.ndarray:
    """Rows of the turned board are the array's columns, counted from the last, and the other way round."""
    return values[..., ::-1, ::-1].swapaxes(-1, -2)


def turned_by_hand(design: Design) -> Design:
    """The board that a design with amplifiers on its rows is, written as one with amplifiers on its columns."""
    array, readout = design.array, design.readout

    def back(value: object) -> object:
        return value[::-1] if isinstance(value, tuple) else value

    lines = {
        f"{to}_{part}": back(getattr(array, f"{of}_{part}"))
        for to, of in (("row", "column"), ("column", "row"))
        for part in ("lead", "segment")
    }
    keys = ("reference_resistance", "open_loop_gain", "offset_voltage", "bias_current")
    return design.replace(
        array={"rows": array.columns, "columns": array.rows, **lines},
        readout={"circuit": "inverting-amplifier"} | {key: back(getattr(readout, key)) for key in keys},
    )


@pytest.mark.parametrize("seed", range(12))
def test_faults_saturation_and_unequal_parts_read_as_the_reference(seed: int) -> None:
    limits = {"supply": (-0.2, 3.3)} if seed % 2 else {}
    design, cells = real_design(seed, circuit="row-amplifier", faults=seed % 4, **limits)
    expected = reference_volts(design, cells)
    result = scan(design, cells, method="exact")
    finest = np.abs(expected).max()
    np.testing.assert_allclose(result.volts, expected, rtol=1e-9, atol=1e-11 * finest)
    assert np.abs(result.volts - expected).max() <= result.error_bound * finest * (1 + 1e-9)


@pytest.mark.parametrize("seed", range(8))
def test_every_analysis_is_that_of_the_board_turned_by_hand(seed: int) -> None:
    design, cells = real_design(seed, circuit="row-amplifier", largest=5, idle_columns="float", **REAL_PARTS)
    design = design.replace(readout={"offset_voltage": 1e-4, "bias_current": 0.0})
    cells = np.clip(cells, 1e3, 1e5)
    other, its_cells = turned_by_hand(design), turn(cells)
    one, two = scan(design, cells), scan(other, its_cells)
    np.testing.assert_array_equal(one.volts, turn(two.volts))
    assert one.error_bound == two.error_bound
    np.testing.assert_array_equal(
        scan_batch(design, cells[None]).volts[0], turn(scan_batch(other, its_cells[None]).volts[0])
    )
    for kind in ("volts", "before_adc"):
        np.testing.assert_array_equal(getattr(noise(design, cells), kind), turn(getattr(noise(other, its_cells), kind)))
    np.testing.assert_array_equal(stability(design, cells).phase_margin, turn(stability(other, its_cells).phase_margin))
    settling, its_settling = Settling(design, cells), Settling(other, its_cells)
    # Lines are scanned by their own numbers, the turned board's in the other order; from rest the order does not count.
    np.testing.assert_array_equal(settling.sampled_from_rest(2e-5), turn(its_settling.sampled_from_rest(2e-5)))
    np.testing.assert_array_equal(settling.settled, one.volts)
    mine, theirs = sensitivity(design, cells), sensitivity(other, its_cells)
    for i, j in np.ndindex(cells.shape):
        a, b = cells.shape[1] - 1 - j, cells.shape[0] - 1 - i
        np.testing.assert_array_equal(mine.cell_conductance[i, j], turn(theirs.cell_conductance[a, b]))
        np.testing.assert_array_equal(mine.column_segment[i, j], turn(theirs.row_segment[a, b]))
        np.testing.assert_array_equal(mine.row_lead[i, j], theirs.column_lead[a, b][::-1])
        np.testing.assert_array_equal(mine.offset_voltage[i, j], theirs.offset_voltage[a, b][::-1])
    by_name = {effect.name: effect.estimate for effect in effects(other, its_cells)}
    for effect in effects(design, cells):
        name = effect.name.replace("row", "?").replace("column", "row").replace("?", "column")
        assert effect.estimate == by_name[name], effect.name


def test_contradictions_are_told_in_the_arrays_own_words() -> None:
    design = Design.model_validate(
        {
            "array": {"rows": 2, "columns": 3, "row_lead": 10.0},
            "drive": {"voltage": -1.0},
            "readout": {"circuit": "row-amplifier", "reference_resistance": 1e3},
            "fault": [{"kind": "bridged-columns", "place": [1, 0]}],
        }
    )
    with pytest.raises(SolverError, match="the column drivers 0 and 1 are joined"):
        scan(design, np.full((2, 3), 1e4))
