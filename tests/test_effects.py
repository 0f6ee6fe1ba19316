"""Effects of single parts against the first order of two scans, the converter and the supply by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from designs import amplifier, divider

from ohmskin.circuits import Adc, Design, Fault, effects, scan

CELLS = 10 ** np.random.default_rng(11).uniform(4, 5, (5, 6))
SMALL: list[tuple[str, str, Any]] = [
    ("array", "row_lead", 0.05),
    ("array", "column_lead", (0.01, 0.02, 0.03, 0.04, 0.05, 0.06)),
    ("array", "row_segment", (0.01, 0.03, 0.02, 0.05, 0.04)),
    ("array", "column_segment", 0.01),
    ("readout", "open_loop_gain", 1e6),
    ("readout", "offset_voltage", 1e-6),
    ("readout", "bias_current", (1e-9, -2e-9, 3e-9, 4e-9, 1e-9, 2e-9)),
]


def put_in(design: Design, table: str, key: str, value: Any) -> Design:
    section = getattr(design, table).replace(**{key: value})
    return design.replace(**{table: section})


def named(design: Design, cells: np.ndarray = CELLS) -> dict[str, Any]:
    return {effect.name: effect for effect in effects(design, cells)}


@pytest.mark.parametrize("circuit", ["inverting-amplifier", "voltage-divider", "voltage-feedback"])
@pytest.mark.parametrize(("table", "key", "value"), SMALL)
def test_an_effect_is_the_change_of_the_signal(circuit: str, table: str, key: str, value: Any) -> None:
    bare = amplifier(5, 6, open_loop_gain=1e12 if circuit == "voltage-feedback" else np.inf).with_circuit(circuit)
    if circuit == "voltage-divider" and table == "readout":
        assert key not in named(bare)
        return
    real = put_in(bare, table, key, value)
    before, after = (scan(each, CELLS).volts for each in (bare, real))
    found = named(real)[key]
    assert found.modelled
    largest = np.abs(after / before - 1).max()
    assert found.estimate == pytest.approx(largest, rel=0.02, abs=1e-12)


def test_what_is_not_named_is_listed_with_an_ordinary_part() -> None:
    found = named(amplifier(5, 6))
    assert not any(effect.modelled for effect in found.values())
    assert all(effect.estimate > 0 for name, effect in found.items() if name != "supply")
    real = put_in(amplifier(5, 6), "array", "row_lead", 10.0)
    assert found["row_lead"].estimate == named(real)["row_lead"].estimate
    assert found["row_lead"].basis == "row_lead = 10.0 assumed"
    assert named(real)["row_lead"].basis == "row_lead = 10.0"


def test_supply_converter_faults_and_sheet() -> None:
    design = amplifier(5, 6, supply=(-0.01, 0.05))
    supply = named(design)["supply"]
    assert supply.modelled
    assert supply.estimate == pytest.approx(1 - 0.05 / (1000 / CELLS.min()))
    design = design.replace(adc=Adc(bits=10, range=(0.0, 1.024)))
    assert named(design)["converter"].estimate == pytest.approx(0.5e-3 / (1000 / CELLS.max()))
    broken = amplifier(5, 6).replace(fault=(Fault(kind="open-cell", place=(1, 1)),))
    assert named(broken)["fault"].estimate == pytest.approx(1.0)
    sheet = put_in(amplifier(5, 6), "array", "sheet", "continuous")
    assert 1e-4 < named(sheet)["sheet"].estimate < 1e-1


def test_open_and_shorted_cells_do_not_count() -> None:
    cells = CELLS.copy()
    cells[0] = np.inf
    cells[2, 2] = 0.0
    for design in (amplifier(5, 6), divider(5, 6, row_lead=1.0)):
        for effect in effects(design, cells):
            assert effect.estimate is None or np.isfinite(effect.estimate)
    assert all(not effect.estimate for effect in effects(amplifier(2, 2), np.full((2, 2), np.inf)))
