"""Derivatives by the adjoint against re-solves by the exact nodal reference: central differences."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from designs import amplifier, divider
from parts_at_random import real_design

from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import CIRCUITS, Adc, Design, Fault, Sensitivity, effects, scan, sensitivity
from ohmskin.errors import InputError

Change = Callable[[float], tuple[Design, np.ndarray]]
STEP = 1e-4  # of a part's natural size: leaves 1e-8 of curvature and 1e-12 of rounding


def changes(design: Design, cells: np.ndarray, found: Sensitivity) -> Iterator[tuple[str, np.ndarray, Change, float]]:
    """Each part: its name, the derivatives by it, how to change it, and its natural size."""
    rows, columns = cells.shape
    for row, column in np.argwhere(np.isfinite(cells) & (cells > 0)):

        def cell(by: float, row: int = row, column: int = column) -> tuple[Design, np.ndarray]:
            changed = cells.copy()
            changed[row, column] += by
            return design, changed

        yield f"cell {row}, {column}", found.cells[:, :, row, column], cell, float(cells[row, column])
    keys: list[tuple[str, str, np.ndarray, float | None]] = [
        ("array", "row_lead", found.row_lead, None),
        ("array", "row_segment", found.row_segment.sum(axis=-1), None),
        ("array", "column_lead", found.column_lead, None),
        ("array", "column_segment", found.column_segment.sum(axis=-2), None),
        ("readout", "reference_resistance", found.reference_resistance, None),
    ]
    if design.readout.circuit != "voltage-divider":
        keys += [
            ("readout", "offset_voltage", found.offset_voltage, 0.1),
            ("readout", "bias_current", found.bias_current, 1e-5),
            ("readout", "open_loop_gain", found.inverse_gain, 1e-3),
        ]
    for table, key, by_line, size in keys:
        section = getattr(design, table)
        on_rows = design.readout.circuit == "row-amplifier" and table == "readout"
        lines = rows if key.startswith("row") or on_rows else columns
        shared = design.readout.columns == "multiplexed" and table == "readout"  # one part for all lines
        lines, derivatives = (1, by_line.sum(axis=-1, keepdims=True)) if shared else (lines, by_line)
        values = np.broadcast_to(getattr(section, key), lines).astype(float)
        for line in range(lines):

            def part(
                by: float, key: str = key, line: int = line, table: str = table, values: np.ndarray = values
            ) -> tuple[Design, np.ndarray]:
                changed = values.copy()
                if key == "open_loop_gain":
                    by += 1.0 / changed[line]
                    changed[line] = 1.0 / by if by else np.inf
                else:
                    changed[line] += by
                value = tuple(changed.tolist()) if len(changed) > 1 else float(changed[0])
                section = getattr(design, table).replace(**{key: value})
                return design.replace(**{table: section}), cells

            yield f"{key} {line}", derivatives[..., line], part, size or float(values[line])


def check(design: Design, cells: np.ndarray, rtol: float = 1e-6) -> None:
    found = sensitivity(design, cells)
    np.testing.assert_allclose(found.volts, scan(design, cells).volts, rtol=1e-12)
    scale = np.abs(found.volts - design.readout.reference_voltage).max()
    for name, derivative, change, size in changes(design, cells, found):
        if name.startswith("open_loop_gain"):  # no gain is above that of an ideal amplifier: from one side only
            here, once, twice = (reference_volts(*change(steps * STEP * size)) for steps in (0, 1, 2))
            expected = (4 * once - 3 * here - twice) / (2 * STEP)
        else:
            up, down = (reference_volts(*change(sign * STEP * size)) for sign in (1, -1))
            expected = (up - down) / (2 * STEP)
        np.testing.assert_allclose(derivative * size, expected, rtol=rtol, atol=1e-9 * scale, err_msg=name)


@pytest.mark.parametrize("circuit", CIRCUITS)
@pytest.mark.parametrize("seed", range(6))
def test_every_part_of_every_circuit(circuit: str, seed: int) -> None:
    """Whatever idle lines end in."""
    check(*real_design(seed, circuit=circuit, largest=3, idle_lines=seed > 2))


def test_while_outputs_are_saturated() -> None:
    cells = np.array([[3e2, 4e3, 9e3], [5e3, 2e3, 8e2], [1e4, 6e2, 3e3]])
    design = amplifier(3, 3, lead=40.0, segment=3.0, open_loop_gain=1e3, offset_voltage=2e-3, supply=(-0.1, 1.0))
    assert scan(design, cells).saturated.sum() == 3
    check(design, cells)


def test_open_cells_and_broken_lines() -> None:
    cells = np.array([[3e3, np.inf, 9e3], [np.inf, np.inf, np.inf], [1e4, 6e3, 3e3]])
    faults = (Fault(kind="broken-row", place=(2, 1)), Fault(kind="broken-column", place=(0, 2)))
    for circuit in ("inverting-amplifier", "voltage-divider"):
        design = amplifier(3, 3, lead=40.0, segment=3.0).replace(fault=faults)
        check(design.with_circuit(circuit), cells)


@pytest.mark.parametrize("circuit", ["inverting-amplifier", "voltage-divider", "voltage-feedback"])
@pytest.mark.parametrize("kind", ["bridged-rows", "bridged-columns"])
def test_bridged_lines(circuit: str, kind: str) -> None:
    cells = 10 ** np.random.default_rng(2).uniform(3, 4, (3, 3))
    design = amplifier(3, 3, lead=40.0, segment=3.0, open_loop_gain=1e4).with_circuit(circuit)
    fault = Fault.model_validate({"kind": kind, "place": [2, 0] if kind == "bridged-columns" else [0, 1], "to": 2})
    for ohms in (30.0, 0.0):
        bridged = fault.replace(resistance=ohms)
        check(design.replace(fault=(bridged,)), cells)


@pytest.mark.parametrize("circuit", ["inverting-amplifier", "voltage-divider", "voltage-feedback"])
def test_lines_without_resistance_have_sensitivities_too(circuit: str) -> None:
    """One-sided: from 0 to a very small resistance."""
    rng = np.random.default_rng(3)
    cells = 10 ** rng.uniform(3, 4, (3, 4))
    design = amplifier(3, 4, open_loop_gain=1e6).with_circuit(circuit)
    found = sensitivity(design, cells)
    for key, derivative in {
        "row_lead": found.row_lead.sum(axis=-1),
        "row_segment": found.row_segment.sum(axis=(-2, -1)),
        "column_lead": found.column_lead.sum(axis=-1),
        "column_segment": found.column_segment.sum(axis=(-2, -1)),
    }.items():
        changed = design.replace(array={key: 1e-4})
        moved = reference_volts(changed, cells) - reference_volts(design, cells)
        np.testing.assert_allclose(moved, 1e-4 * derivative, rtol=1e-5, atol=1e-15)


@pytest.mark.parametrize("circuit", CIRCUITS)
@pytest.mark.parametrize("ohms", [0.0, 50.0, 1e5])
def test_a_fault_across_a_cell_is_no_part_of_it(circuit: str, ohms: float) -> None:
    cells = 10 ** np.random.default_rng(4).uniform(3, 4, (3, 3))
    fault = Fault(kind="shorted-cell", place=(1, 2), resistance=ohms)
    opened = Fault(kind="open-cell", place=(0, 1), resistance=500.0)
    design = amplifier(3, 3, lead=40.0, segment=3.0, open_loop_gain=1e4).with_circuit(circuit)
    check(design.replace(fault=(fault, opened)), cells, rtol=1e-6 if ohms else 1e-4)  # fewer digits of a short's drop


@pytest.mark.parametrize("circuit", CIRCUITS)
@pytest.mark.parametrize("lead", [0.0, 5.0])
def test_lines_to_a_shorted_cell_have_their_sensitivities(circuit: str, lead: float) -> None:
    """One-sided: from 0 to a very small resistance, the current through the short being what its lines carry."""
    cells = 10 ** np.random.default_rng(5).uniform(3, 4, (2, 3))
    cells[1, 1] = 0.0
    design = amplifier(2, 3, lead=lead, open_loop_gain=10.0).with_circuit(circuit)
    if circuit == "voltage-feedback" and not lead:  # the follower must not meet the driver
        design = design.replace(array={"column_lead": 3.0})
    found, volts = sensitivity(design, cells), reference_volts(design, cells)
    for key, derivative in (("row_lead", found.row_lead), ("column_lead", found.column_lead)):
        for line in range(derivative.shape[-1]):
            ohms = np.broadcast_to(getattr(design.array, key), derivative.shape[-1]).astype(float)
            ohms[line] += 1e-5
            moved = reference_volts(design.replace(array={key: tuple(ohms.tolist())}), cells) - volts
            np.testing.assert_allclose(1e-5 * derivative[..., line], moved, rtol=1e-4, atol=1e-12, err_msg=key)


def test_what_has_no_sensitivities_is_refused() -> None:
    sheet = amplifier(2, 2).replace(array={"sheet": "continuous"})
    with pytest.raises(InputError, match=r'for array\.sheet = "sliced"'):
        sensitivity(sheet, np.ones((2, 2)))
    with pytest.raises(InputError, match="at most 4096 cells, the design has 4225"):
        sensitivity(amplifier(65, 65), np.ones((65, 65)))


# Effects of single parts against the first order of two scans, the converter and the supply by hand


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
