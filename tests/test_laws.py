"""Laws that every circuit keeps, whatever its parts, and extreme parts against the exact nodal reference."""

from __future__ import annotations

from itertools import product
from math import inf
from typing import Any

import numpy as np
import pytest
from designs import amplifier
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from parts_at_random import real_design

from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import CIRCUITS, Design, scan

SEEDS = st.integers(0, 10**6)
ORDINARY = st.floats(1e2, 1e7)
LINE_KEYS = ("row_lead", "row_segment", "column_lead", "column_segment")
COLUMN_KEYS = ("reference_resistance", "open_loop_gain", "offset_voltage", "bias_current")


def changed(design: Design, table: str, **keys: Any) -> Design:
    return design.replace(**{table: getattr(design, table).replace(**keys)})


def per_line(value: float | tuple[float, ...], lines: int) -> np.ndarray:
    return np.broadcast_to(value, lines).astype(float)


def signal(design: Design, cells: np.ndarray) -> np.ndarray:
    return scan(design, cells).volts - design.readout.reference_voltage


def assert_same(found: np.ndarray, expected: np.ndarray, rtol: float = 1e-10) -> None:
    """Relative to each signal, but for what a reference voltage of 1.65 V leaves of it in double precision."""
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=2e-15)


@settings(deadline=None)
@given(SEEDS, st.floats(1e-3, 1e3))
def test_scaling_all_resistances_and_dividing_the_bias_changes_nothing(seed: int, k: float) -> None:
    design, cells = real_design(seed)
    rows, columns = design.array.shape
    ohms = {key: k * per_line(getattr(design.array, key), rows if "row" in key else columns) for key in LINE_KEYS}
    scaled = changed(design, "array", **{key: tuple(value.tolist()) for key, value in ohms.items()})
    scaled = changed(
        scaled,
        "readout",
        reference_resistance=tuple((k * per_line(design.readout.reference_resistance, columns)).tolist()),
        bias_current=tuple((per_line(design.readout.bias_current, columns) / k).tolist()),
    )
    assert_same(signal(scaled, k * cells), signal(design, cells))


@settings(deadline=None)
@given(SEEDS, st.permutations(range(4)))
def test_rows_may_be_in_any_order_where_columns_have_no_segments(seed: int, shuffled: list[int]) -> None:
    design, cells = real_design(seed)
    order = [i for i in shuffled if i < design.array.rows]
    design = changed(design, "array", column_segment=0.0)
    parts = {
        key: tuple(per_line(getattr(design.array, key), design.array.rows)[order].tolist())
        for key in ("row_lead", "row_segment")
    }
    assert_same(signal(changed(design, "array", **parts), cells[order]), signal(design, cells)[order])


@settings(deadline=None)
@given(SEEDS, st.permutations(range(4)))
def test_columns_may_be_in_any_order_where_rows_have_no_segments(seed: int, shuffled: list[int]) -> None:
    design, cells = real_design(seed)
    columns = design.array.columns
    order = [j for j in shuffled if j < columns]
    design = changed(design, "array", row_segment=0.0)
    moved = design
    for table, keys in (("array", ("column_lead", "column_segment")), ("readout", COLUMN_KEYS)):
        parts = {key: tuple(per_line(getattr(getattr(design, table), key), columns)[order].tolist()) for key in keys}
        moved = changed(moved, table, **parts)
    assert_same(signal(moved, cells[:, order]), signal(design, cells)[:, order])


SEGMENT = st.one_of(st.just(0.0), st.floats(1e-30, 100.0))


@settings(deadline=None)
@given(
    hnp.arrays(np.float64, hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=6), elements=ORDINARY),
    SEGMENT,
    SEGMENT,
)
def test_a_floating_divider_reads_the_same_from_its_other_side(cells: np.ndarray, row: float, column: float) -> None:
    """What lies between two terminals does not know which one is driven."""
    base = amplifier(*cells.shape).with_circuit("voltage-divider")
    base = changed(base, "drive", idle_rows="float")
    lines = {"row_lead": 7.0, "column_lead": 7.0}
    design = changed(base, "array", row_segment=row, column_segment=column, **lines)
    turned = changed(
        design, "array", rows=cells.shape[1], columns=cells.shape[0], row_segment=column, column_segment=row
    )
    # Turned over, row i is driven where column i ended.
    read = signal(turned, cells[::-1, ::-1].T)[::-1, ::-1].T
    np.testing.assert_allclose(read, signal(design, cells), rtol=1e-11)


@settings(deadline=None)
@given(SEEDS, st.integers(0, 4))
def test_an_open_row_changes_nothing_where_columns_have_no_segments(seed: int, place: int) -> None:
    design, cells = real_design(seed)
    rows = design.array.rows
    place = min(place, rows)
    design = changed(design, "array", column_segment=0.0)
    wider = {
        key: tuple(np.insert(per_line(getattr(design.array, key), rows), place, 3.0).tolist())
        for key in ("row_lead", "row_segment")
    }
    read = signal(changed(design, "array", rows=rows + 1, **wider), np.insert(cells, place, inf, axis=0))
    assert_same(np.delete(read, place, axis=0), signal(design, cells))


@settings(deadline=None)
@given(SEEDS, st.floats(1.01, 100.0), st.integers(0, 15))
def test_every_reading_falls_when_its_own_resistance_rises(seed: int, by: float, which: int) -> None:
    design, cells = real_design(seed)
    row, column = np.unravel_index(which % cells.size, cells.shape)
    # Offsets may turn the field over a cell round, and then the law does not hold.
    design = changed(design, "readout", offset_voltage=0.0, bias_current=0.0, reference_voltage=0.0)
    raised = cells.copy()
    raised[row, column] *= by
    before, after = (np.abs(signal(design, each)[row, column]) for each in (cells, raised))
    assume(before > 0)
    assert after <= before * (1 + 1e-12)
    assert after < before or cells[row, column] > 1e3


@settings(deadline=None)
@given(SEEDS)
def test_readings_are_linear_in_the_drive(seed: int) -> None:
    design, cells = real_design(seed)
    one, two, three = (signal(changed(design, "drive", voltage=v), cells) for v in (1.0, 2.0, 3.0))
    np.testing.assert_allclose(one + three, 2 * two, rtol=1e-10, atol=1e-14)


@settings(deadline=None)
@given(SEEDS)
def test_a_divider_stays_between_drive_and_reference(seed: int) -> None:
    design, cells = real_design(seed, circuit="voltage-divider")
    share = signal(design, cells) / design.drive.voltage
    assert (share >= -1e-12).all()
    assert (share <= 1 + 1e-12).all()


EXTREME_CELLS = {
    "1 ohm to 1 Tohm": lambda random: 10 ** random.uniform(0, 12, (3, 3)),
    "a short": lambda random: np.where(np.eye(3) * [1, 0, 0], 0.0, 10 ** random.uniform(3, 6, (3, 3))),
    "nearly shorts": lambda random: np.where(np.eye(3), [[1e-3], [1e4], [1e-9]], 10 ** random.uniform(3, 6, (3, 3))),
    "all open": lambda random: np.full((3, 3), inf),
    "an open line": lambda random: np.where([[0], [1], [0]], inf, 10 ** random.uniform(3, 6, (3, 3))),
}


AMPLIFIERS = ["inverting-amplifier", "row-amplifier"]
IDLE_LINES = [
    ("voltage-feedback", "ground", "parallel", "float"),
    *((circuit, rows, "parallel", "float") for circuit in AMPLIFIERS for rows in ("ground", "float", "pull")),
    *product(
        [*AMPLIFIERS, "voltage-divider"], ["ground", "float", "pull"], ["multiplexed"], ["float", "ground", "load"]
    ),
]
"""circuit, idle rows, columns, idle columns: every kind of idle lines that a circuit can have"""


@pytest.mark.parametrize("kind", EXTREME_CELLS)
@pytest.mark.parametrize("idle", IDLE_LINES, ids="-".join)
def test_extreme_parts_keep_eleven_digits(idle: tuple[str, str, str, str], kind: str) -> None:
    circuit, idle_rows, columns, idle_columns = idle
    random = np.random.default_rng(9)
    cells = EXTREME_CELLS[kind](random)
    for ohms in [(1e-6, 1e-6, 1e-6), (1e6, 1e6, 1e6), (1e-6, 1e6, 0.0), (100.0, 0.0, 1e6)]:
        lead, row, column = ohms
        parts: dict[str, Any] = {"open_loop_gain": [1.0, 1e6, 1e12], "offset_voltage": [1e-3, 0.0, -1e-3]}
        if columns == "multiplexed":
            parts = {"open_loop_gain": 1e6, "offset_voltage": 1e-3}
        pull = {"idle_row_resistance": 1e4} if idle_rows == "pull" else {}
        design = amplifier(3, 3, lead=lead, **parts).with_circuit(circuit)
        design = design.replace(
            array={"row_segment": row, "column_segment": column},
            drive={"idle_rows": idle_rows, **pull},
            readout={"columns": columns, "idle_columns": idle_columns},
        )
        expected = reference_volts(design, cells)
        np.testing.assert_allclose(scan(design, cells).volts, expected, rtol=1e-11, atol=1e-18)


@pytest.mark.parametrize("ohms", [0.0, 1e-9, 1e-3, 1e12, inf])
@pytest.mark.parametrize("circuit", CIRCUITS)
@pytest.mark.parametrize(
    "kind", ["open-cell", "shorted-cell", "broken-row", "broken-column", "bridged-rows", "bridged-columns"]
)
def test_extreme_faults_keep_eleven_digits(circuit: str, kind: str, ohms: float) -> None:
    """Among leads of 10 ohm, and segments on one side only."""
    cells = 10 ** np.random.default_rng(10).uniform(3, 6, (3, 3))
    fault = {"kind": kind, "place": [1, 1], "resistance": ohms}
    for segments in ({"row_segment": 1.0}, {"column_segment": 1e-6}):
        design = amplifier(3, 3, lead=10.0, open_loop_gain=1e5, reference_voltage=0.0).with_circuit(circuit)
        design = Design.model_validate(design.model_dump() | {"fault": [fault]})
        design = changed(design, "array", **segments)
        expected = reference_volts(design, cells)
        np.testing.assert_allclose(scan(design, cells).volts, expected, rtol=1e-11, atol=1e-18)
