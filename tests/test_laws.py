"""Laws that every circuit keeps, whatever its parts, and extreme parts against the exact nodal reference."""

from __future__ import annotations

from itertools import product
from math import inf
from typing import Any

import numpy as np
import pytest
from designs import amplifier, divider
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from parts_at_random import real_design

from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import (
    CIRCUITS,
    Design,
    Settling,
    effects,
    noise,
    scan,
    scan_batch,
    sensitivity,
    stability,
)
from ohmskin.circuits.solvers import Lines, exact_transfer, port_conductances
from ohmskin.errors import SolverError

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


# 0 ohm, open lines and infinite gain where nothing else sets a scale: limits by hand, and refusals by name


def with_column_lead(design: Design, ohms: float) -> Design:
    return design.replace(array={"column_lead": ohms})


def read(design: Design, cells: Any) -> np.ndarray:
    return scan(design, cells).volts


@pytest.mark.parametrize("idle_rows", ["float", "ground"])
@pytest.mark.parametrize("idle_columns", ["float", "load"])
def test_nothing_but_shorts_and_opens_on_a_divider(idle_rows: str, idle_columns: str) -> None:
    design = divider(2, 2, idle_rows=idle_rows, idle_columns=idle_columns)
    np.testing.assert_allclose(read(design, [[0, inf], [inf, 0]]), np.eye(2), atol=1e-12)
    halved = with_column_lead(design, 1000.0)
    np.testing.assert_allclose(read(halved, [[0, inf], [inf, 0]]), np.eye(2) / 2, atol=1e-12)


@pytest.mark.parametrize("gain", [2.57, 68.0, 1e5, 1e9, 1e12])
@pytest.mark.parametrize("others", [1e4, 1e6, inf])
def test_a_short_on_a_finite_amplifier_gives_its_open_loop(gain: float, others: float) -> None:
    """The driver holds the inverting input: v = -A Vin, whatever Rref and the other cells."""
    volts = read(amplifier(2, 2, open_loop_gain=gain), [[0, others], [others, others]])
    assert volts[0, 0] == pytest.approx(gain, rel=1e-12)
    assert abs(volts[1, 0]) < 1e-12  # the grounded idle driver holds it then


@pytest.mark.parametrize("others", [1e4, 1e9, 1e15])
@pytest.mark.parametrize("lead", [1.0, 1e-3, 1e-6])
def test_a_short_has_no_resistance_of_its_own(others: float, lead: float) -> None:
    volts = read(with_column_lead(amplifier(2, 2), lead), [[0, others], [others, others]])
    assert volts[0, 0] == pytest.approx(1000.0 / lead, rel=1e-11)


def test_supply_limits_the_infinite() -> None:
    for others in (1e13, inf):
        result = scan(amplifier(2, 2, supply=(-3.0, 3.0)), [[0, others], [others, others]])
        assert result.volts[0, 0] == 3.0
        assert result.saturated.tolist() == [[True, False], [False, False]]


def test_nothing_leaks_over_an_ideal_line() -> None:
    design = amplifier(3, 3, segment=1.0).model_copy()
    array = design.array.replace(row_lead=0.0, column_lead=5.0, row_segment=0.0)
    result = scan(design.replace(array=array), [[1e3, inf, 1e4], [1e3, 1e4, 1e4], [inf, 1e4, 1e4]])
    open_cells = np.array([[False, True, False], [False, False, False], [True, False, False]])
    assert (result.volts[open_cells] == 0).all()
    assert np.isinf(result.resistance[open_cells]).all()
    assert (result.volts[~open_cells] > 1e-2).all()


@pytest.mark.parametrize("vref", [0.0, 1.65])
@pytest.mark.parametrize("lead", [1.0, 1e-3, 1e-6])
@pytest.mark.parametrize("parts", [{}, {"offset_voltage": 5e-3}, {"open_loop_gain": 1e9}])
def test_a_reference_voltage_costs_no_digits(vref: float, lead: float, parts: dict[str, float]) -> None:
    """Three shorts in a row tie the columns together, far more strongly than the signal drives them."""
    cells = np.full((3, 3), 1e4)
    cells[0] = 0.0
    design = with_column_lead(amplifier(3, 3, reference_resistance=1e4, **parts), lead)
    design = design.replace(array={"row_lead": 100.0})
    base = read(design, cells)
    lifted = design.replace(readout={"reference_voltage": vref})
    share = design.readout.open_loop_gain
    droop = 0.0 if np.isinf(share) else vref / share  # of the level itself, at a finite gain: tested elsewhere
    np.testing.assert_allclose(read(lifted, cells) - vref, base, atol=np.abs(base).max() * 1e-12 + 1e5 * droop)


@pytest.mark.parametrize(
    ("design", "cells", "who"),
    [
        (divider(2, 1, idle_rows="ground"), [[0], [0]], "row drivers 0 and 1"),
        (amplifier(2, 1, open_loop_gain=1e5), [[0], [0]], "row drivers 0 and 1"),
        (amplifier(1, 3), [[0, 1e4, 0]], "ideal amplifiers of columns 0 and 2"),
    ],
)
def test_contradictions_are_refused_by_name(design: Design, cells: Any, who: str) -> None:
    with pytest.raises(SolverError, match=f"the {who} are joined by parts of 0 ohm"):
        read(design, cells)


# The circuit that senses rows, against the independent reference and against the same board turned by hand


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


# The reduction of a grid to its ports: against a dense nodal solve, and frames together against frames alone


SHAPES = [(1, 1), (1, 7), (6, 1), (4, 5), (5, 5), (3, 11), (8, 8), (13, 18), (33, 9)]


def lines_at_random(shape: tuple[int, int], rng: np.random.Generator, decades: float = 1.0) -> Lines:
    row, column = (10 ** rng.uniform(-decades, decades, shape) for _ in range(2))
    return Lines(row, column, 10 ** rng.uniform(-decades, decades, shape[1]))


@pytest.mark.parametrize("decades", [1.0, 6.0])
@pytest.mark.parametrize("shape", SHAPES)
def test_transfer_is_the_rows_by_columns_part_of_the_ports(shape: tuple[int, int], decades: float) -> None:
    """Two ways through the grid, which agree within the certified error."""
    rng = np.random.default_rng(1)
    lines, cells = lines_at_random(shape, rng, decades), 10 ** rng.uniform(-12, 0, shape)
    whole = port_conductances(cells, lines).value[: shape[0], shape[0] :]
    found, error = exact_transfer(cells, lines)
    assert (np.abs(found - whole) <= error + 1e-12 * whole).all()
    np.testing.assert_allclose(found, whole, rtol=1e-10)


@pytest.mark.parametrize("shape", SHAPES)
def test_exits_are_resistors_behind_the_columns(shape: tuple[int, int]) -> None:
    """Attached to the lines before the reduction, or behind the ports after it, by a dense solve."""
    rng = np.random.default_rng(2)
    n, lines, cells = shape[0], lines_at_random(shape, rng), 10 ** rng.uniform(-4, -2, shape)
    bare = port_conductances(cells, Lines(lines.row, lines.column)).value
    nodal = np.diag(bare.sum(axis=0)) - bare
    nodal[n:, n:] += np.diag(lines.exit)
    expected = np.linalg.solve(nodal[n:, n:], bare[n:, :n]).T * lines.exit
    np.testing.assert_allclose(exact_transfer(cells, lines)[0], expected, rtol=1e-10)


@pytest.mark.parametrize("shape", [(2, 2), (7, 5), (12, 12), (24, 24)])
def test_frames_together_are_frames_alone(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(6)
    lines, cells = lines_at_random(shape, rng), 10 ** rng.uniform(-6, -3, (5, *shape))
    together = exact_transfer(cells, lines)[0]
    for frame, alone in zip(together, cells, strict=True):
        np.testing.assert_allclose(frame, exact_transfer(alone, lines)[0], rtol=1e-12)
