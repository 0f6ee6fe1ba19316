"""Derivatives by the adjoint against re-solves by the exact nodal reference: central differences."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from designs import amplifier, divider
from parts_at_random import real_design

from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import CIRCUITS, Design, Fault, Sensitivity, scan, sensitivity
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
    for table, key, derivatives, size in keys:
        section = getattr(design, table)
        on_rows = design.readout.circuit == "row-amplifier" and table == "readout"
        lines = rows if key.startswith("row") or on_rows else columns
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
                section = getattr(design, table).replace(**{key: tuple(changed.tolist())})
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
    check(*real_design(seed, circuit=circuit, largest=3))


@pytest.mark.parametrize("idle_rows", ["ground", "float"])
@pytest.mark.parametrize("idle_columns", ["float", "load"])
def test_dividers_of_all_kinds(idle_rows: str, idle_columns: str) -> None:
    rng = np.random.default_rng(1)
    ohms = {"row_lead": 30.0, "column_lead": 20.0, "row_segment": 5.0, "column_segment": 7.0}
    check(
        divider(3, 2, idle_rows=idle_rows, idle_columns=idle_columns, **ohms),
        10 ** rng.uniform(2, 4, (3, 2)),
    )


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
