"""Loaded dividers whose readings two sets of cells give: a column of good conductors, and a row behind a lead."""

from __future__ import annotations

import numpy as np
import pytest

from ohmskin.circuits import Design, adc_codes, scan
from ohmskin.common.arrays import FloatArray
from ohmskin.driver import CountReader, Measurement


def board(row_lead: list[float], columns: int, *, bits: int = 20, column_lead: float = 0.0) -> Design:
    lines = {"rows": len(row_lead), "columns": columns, "row_lead": row_lead, "column_lead": column_lead}
    return Design.model_validate(
        {
            "array": lines,
            "drive": {"voltage": 3.3, "idle_rows": "ground"},
            "readout": {"circuit": "voltage-divider", "reference_resistance": 4.7e3, "idle_columns": "load"},
            "adc": {"bits": bits, "range": [0.0, 3.3]},
        }
    )


def known_well(reading: Measurement, cells: FloatArray) -> bool:
    """Whether no valid cell is off by more than its uncertainty."""
    off = np.abs(reading.resistance / cells - 1.0)[reading.valid]
    return bool((off <= reading.uncertainty[reading.valid] * (1.0 + 1e-9)).all())


def read_after_rest(design: Design, rest: FloatArray, pressed: FloatArray) -> list[Measurement]:
    """A reader's frames at rest and after all cells have changed at once."""
    read = CountReader(design)
    return [read(adc_codes(design, scan(design, cells).volts)) for cells in [rest] * 3 + [pressed] * 8]


@pytest.mark.parametrize("seed", [2, 3, 5, 10, 14, 17, 23, 28])
def test_a_column_of_shorts_beside_a_row_with_a_lead_leaves_no_wrong_cell(seed: int) -> None:
    """Boards at random, each of which once had valid cells that were wrong, most of them by a factor of two."""
    random = np.random.default_rng(seed)
    rows, columns = (int(count) for count in random.integers((3, 3), (7, 9)))
    lead = np.full(rows, float(random.choice([0.0, 5.0])))
    lead[random.integers(rows)] = 10 ** random.uniform(1.0, 3.0)
    bits, column_lead = int(random.choice([12, 16, 20])), float(random.choice([0.0, 20.0]))
    design = board(lead.tolist(), columns, bits=bits, column_lead=column_lead)
    rest = 1e4 * 10 ** random.uniform(-0.5, 0.5, (rows, columns))
    pressed = rest.copy()
    pressed[:, random.integers(columns)] = random.choice([0.3, 1.0, 5.0]) * 10 ** random.uniform(-0.5, 0.5, rows)
    readings = read_after_rest(design, rest, pressed)
    assert readings[0].valid.all()
    assert all(known_well(reading, rest) for reading in readings[:3])
    assert all(known_well(reading, pressed) for reading in readings[3:])


def test_a_hard_press_on_light_leads_has_one_scale() -> None:
    design = board([5.0] * 6, 6, bits=16)
    rest = 1e4 * 10 ** np.random.default_rng(3).uniform(-0.2, 0.2, (6, 6))
    pressed = rest.copy()
    pressed[1:4, 2] = 300.0
    readings = read_after_rest(design, rest, pressed)
    assert readings[-1].valid.all()
    assert known_well(readings[-1], pressed)


@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("lead", [15.0, 120.0])
def test_a_divider_that_grounds_idle_columns_behind_leads_states_all_of_its_answers(lead: float, bits: int) -> None:
    """Other cells, far away, give the same readings: no cell is valid, and each lies within its bounds."""
    design = board([lead] * 3, 11, bits=bits, column_lead=lead / 2.0)
    readout = {"idle_columns": "ground", "columns": "multiplexed", "reference_resistance": 1.5e3}
    design = design.replace(readout=readout)
    rest = 10 ** np.random.default_rng(77).uniform(3.9, 4.15, (3, 11))
    pressed = rest.copy()
    pressed[1, 4] = 0.5
    for reading, cells in zip(read_after_rest(design, rest, pressed), [rest] * 3 + [pressed] * 8, strict=True):
        assert not reading.valid.any()
        assert (reading.least <= 1.0 / cells).all()
        assert (1.0 / cells <= reading.greatest).all()
