"""Follower boards with high references and leads, pressed hard: two sets of cells may give the same readings."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ohmskin.arrays import FloatArray
from ohmskin.bench import _live_hunt, _live_streams
from ohmskin.circuits import Design, adc_codes, scan
from ohmskin.circuits.recovery import _quick_model
from ohmskin.circuits.recovery._follower_solutions import _Law
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


def law_of_alike(conductance: float, *, lead: float, per_siemens: float) -> _Law:
    """Readings of 4 x 4 cells that are all alike, with leads at the rows only."""
    row, all_cells = np.full((4, 4), lead), np.ones((4, 4))
    return _Law(
        row, np.zeros((4, 4)), conductance * all_cells, per_siemens * all_cells, 1e-6 * all_cells, all_cells > 0
    )


def demanded(conductance: float, *, lead: float, per_siemens: float) -> float:
    """S of each reading alone for cells that are all alike: Y with the current to idle lines taken out."""
    rows = columns = 4
    others = (columns - 1) * conductance
    attenuation = 1.0 + lead * (others + conductance)
    behind = lead / (1.0 + lead * others)
    idle = rows * conductance / (1.0 + conductance * behind)
    return conductance / attenuation / (1.0 + per_siemens * idle)


def test_the_enclosure_holds_the_second_solution_of_cells_that_are_alike() -> None:
    """Found by bisection of what one cell's reading demands, which rises and falls again."""
    found, lead, per_siemens = 1.0 / 400.0, 50.0, 100.0
    reading = demanded(found, lead=lead, per_siemens=per_siemens)
    low, high = 2.0 * found, 1.0
    assert demanded(low, lead=lead, per_siemens=per_siemens) > reading
    assert demanded(high, lead=lead, per_siemens=per_siemens) < reading
    for _ in range(60):
        middle = 0.5 * (low + high)
        above = demanded(middle, lead=lead, per_siemens=per_siemens) > reading
        low, high = (middle, high) if above else (low, middle)
    for here, there in ((found, low), (low, found)):
        (change,) = law_of_alike(here, lead=lead, per_siemens=per_siemens).changes()
        assert change is not None
        assert (change >= 0.99 * abs(there / here - 1.0)).all()


@pytest.mark.parametrize(("lead", "per_siemens"), [(50.0, 0.0), (0.0, 100.0), (5.0, 1.0)])
def test_cells_that_are_alike_have_one_solution_with_light_leads_or_good_followers(
    lead: float, per_siemens: float
) -> None:
    assert law_of_alike(1.0 / 3e3, lead=lead, per_siemens=per_siemens).changes() == [None]


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


def test_a_frame_is_checked_for_other_solutions_at_a_bounded_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Boards whose slowest frames once took 10 to 12 usual ones: each side enclosed apart, sparse solutions."""
    demands, counted = [0], _Law._demand

    def counting(self: _Law, cells: FloatArray) -> FloatArray:
        demands[0] += 1
        return counted(self, cells)

    def refused(*_: object) -> FloatArray:
        raise AssertionError("ideal lines need no sparse matrix")

    monkeypatch.setattr(_Law, "_demand", counting)
    monkeypatch.setattr(_quick_model, "basis_drops", refused)
    most = 0
    for number in (47120000070, 47120000099):
        found = _live_streams.stream("feedback pressed", number)
        assert found is not None
        read = CountReader(found.design)
        for counts in found.counts:
            demands[0] = 0
            read(counts)
            most = max(most, demands[0])
    assert 0 < most <= 40
