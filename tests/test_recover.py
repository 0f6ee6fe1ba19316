"""Readings back to resistances: round trips from the nodal reference, published cases, marks and limits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from designs import amplifier, divider
from hypothesis import given, settings
from hypothesis import strategies as st
from parts_at_random import real_design

from ohmskin.bench._reference import Indeterminate, reference_volts
from ohmskin.circuits import (
    CIRCUITS,
    Adc,
    Design,
    Fault,
    Recoverer,
    Recovery,
    Status,
    apparent_resistance,
    conditioning,
    recover,
    scan,
)
from ohmskin.errors import InputError, SolverError


def round_trip(design: Design, cells: np.ndarray, **options: Any) -> Recovery:
    """Every cell back, as well as its conditioning lets it."""
    recovery = recover(design, reference_volts(design, cells), **options)
    assert (recovery.status == Status.READ).all()
    error = np.abs(recovery.resistance / cells - 1)
    level = abs(design.readout.reference_voltage) + np.abs(conditioning(design, cells).resistance_std(1e-16) / cells)
    assert (error <= 1e-9 + 10 * level * conditioning(design, cells).amplification * 1e-12).all()
    return recovery


@pytest.mark.parametrize(("switch", "raw", "evaluations"), [(1.0, 0.022, 7), (6.0, 0.137, 6), (25.0, 0.588, 7)])
def test_published_cases_to_1e_9_in_a_few_iterations(switch: float, raw: float, evaluations: int) -> None:
    """Hidalgo-Lopez et al. 2018, 100 ohm among 5 kohm: two-step corrections leave 2 to 9 % of a raw error of 59 %."""
    design, cells = amplifier(8, 8, lead=switch), np.full((8, 8), 5e3)
    cells[2, 5] = 100.0
    volts = scan(design, cells).volts
    assert abs(apparent_resistance(design, volts)[2, 5] / 100.0 - 1) == pytest.approx(raw, abs=1e-3)
    recovery = recover(design, volts)
    np.testing.assert_allclose(recovery.resistance, cells, rtol=1e-9)
    assert recovery.iterations <= evaluations


@pytest.mark.parametrize("circuit", ["inverting-amplifier", "voltage-divider", "voltage-feedback"])
@pytest.mark.parametrize("seed", range(6))
def test_round_trip_through_unequal_parts(circuit: str, seed: int) -> None:
    gains = {} if circuit == "voltage-divider" else {"open_loop_gain": 1e5}
    design, cells = real_design(seed, circuit=circuit, idle_columns="load", **gains)
    cells = 1e3 * (cells / 1e3) ** 0.5  # a decade and a half to each side
    drive = design.drive.replace(idle_rows="ground")
    recovery = recover(design.replace(drive=drive), scan(design.replace(drive=drive), cells).volts)
    np.testing.assert_allclose(recovery.resistance, cells, rtol=1e-8)


@pytest.mark.parametrize("idle_rows", ["ground", "float"])
@pytest.mark.parametrize("idle_columns", ["float", "load"])
def test_software_compensation_of_a_divider(idle_rows: str, idle_columns: str) -> None:
    cells = 10 ** np.random.default_rng(8).uniform(3.5, 4.5, (4, 4))
    design = divider(4, 4, idle_rows=idle_rows, idle_columns=idle_columns, row_lead=20.0, column_segment=2.0)
    assert np.abs(apparent_resistance(design, scan(design, cells).volts) / cells - 1).max() > 0.05
    round_trip(design, cells)


def test_the_limit_of_divider_compensation_is_its_conditioning() -> None:
    """A floating divider averages over the grid: what an error of the readings becomes grows with its size, while an
    amplifier keeps every cell's error its own.
    """
    worst = []
    for size in (4, 8, 16):
        cells = np.full((size, size), 5e3)
        worst.append(conditioning(divider(size, size), cells).amplification.max())
        assert conditioning(amplifier(size, size, lead=5.0), cells).amplification.max() < 1.2
    assert worst[0] > 1.5
    assert worst[1] > 2 * worst[0]
    assert worst[2] > 2 * worst[1]


@pytest.mark.parametrize("circuit", ["inverting-amplifier", "voltage-divider"])
def test_conditioning_foretells_what_noise_does(circuit: str) -> None:
    rng = np.random.default_rng(5)
    design = amplifier(4, 4, lead=50.0).with_circuit(circuit)
    cells = 10 ** rng.uniform(3.3, 4, (4, 4))
    volts, recoverer = scan(design, cells).volts, Recoverer(design, accuracy=1e-9)
    noisy = [recoverer(volts + 1e-7 * rng.standard_normal((4, 4))).resistance for _ in range(300)]
    expected = conditioning(design, cells).resistance_std(1e-7)
    np.testing.assert_allclose(np.std(noisy, axis=0), expected, rtol=0.2)


def test_columns_that_are_independent_have_a_closed_form() -> None:
    """Against the iteration, which a row lead of 1e-9 ohm forces."""
    rng = np.random.default_rng(6)
    cells = 10 ** rng.uniform(3, 5, (5, 4))
    parts = {
        "open_loop_gain": [1e3, 1e4, np.inf, 1e5],
        "offset_voltage": [1e-3, 0.0, -2e-3, 1e-4],
        "bias_current": 1e-8,
    }
    design = amplifier(5, 4, reference_voltage=1.65, **parts)
    array = design.array.replace(column_lead=(5.0, 50.0, 10.0, 0.0))
    design = design.replace(array=array)
    closed = round_trip(design, cells)
    assert closed.iterations == 0
    almost = design.replace(array=array.replace(row_lead=1e-9))
    iterated = recover(almost, scan(almost, cells).volts)
    assert iterated.iterations > 0
    np.testing.assert_allclose(iterated.resistance, closed.resistance, rtol=1e-8)


def test_a_stream_goes_on_from_where_it_was() -> None:
    rng = np.random.default_rng(7)
    design, cells = amplifier(8, 8, lead=25.0, segment=1.0), 10 ** rng.uniform(3, 4, (8, 8))
    stream, first = Recoverer(design), 0
    for frame in range(5):
        cells = cells * (1 + 1e-3 * rng.standard_normal(cells.shape))
        recovery = stream(scan(design, cells).volts)
        np.testing.assert_allclose(recovery.resistance, cells, rtol=1e-9)
        if frame == 0:
            first = recovery.iterations
        else:
            assert recovery.iterations <= 2 * first


def test_open_cells_and_lines_are_marked() -> None:
    cells = np.full((4, 4), 4e3)
    cells[1, 2] = cells[3, 0] = np.inf
    cells[2] = np.inf
    for design in (
        amplifier(4, 4),
        amplifier(4, 4, lead=20.0, segment=1.0),
        divider(4, 4, idle_rows="ground", idle_columns="load", row_lead=20.0),
    ):
        recovery = recover(design, scan(design, cells).volts)
        assert np.array_equal(recovery.status == Status.OPEN, np.isinf(cells))
        np.testing.assert_allclose(recovery.resistance, cells, rtol=1e-9)


def test_a_cell_that_adds_little_to_its_own_reading_is_still_read() -> None:
    """1 % of the current at its place is its own, the rest is crosstalk; only then does accuracy decide."""
    cells = np.full((6, 6), 1e3)
    cells[2, 3] = 1e7
    design = amplifier(6, 6, lead=25.0)
    volts = scan(design, cells).volts
    assert apparent_resistance(design, volts)[2, 3] < 0.02 * cells[2, 3]
    for accuracy in (1e-11, 1e-6):
        recovery = recover(design, volts, accuracy=accuracy)
        assert (recovery.status == Status.READ).all()
        np.testing.assert_allclose(recovery.resistance, cells, rtol=1e4 * accuracy)


def holds(recovery: Recovery, cells: np.ndarray) -> np.ndarray:
    """Where a cell lies in the interval that it is said to lie in."""
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.abs(recovery.resistance / cells - 1)
        said = (off <= recovery.uncertainty + 1e-9) | np.isinf(recovery.uncertainty)
    return said | ((recovery.status == Status.OPEN) & np.isinf(cells))


def test_a_saturated_cell_is_not_invented_and_costs_no_other_where_lines_are_ideal() -> None:
    cells = np.full((4, 4), 5e3)
    cells[1, 2] = 100.0
    design = amplifier(4, 4, supply=(-0.1, 3.3))
    recovery = recover(design, scan(design, cells).volts)
    status = np.full((4, 4), Status.READ)
    status[1, 2] = Status.SATURATED
    assert recovery.status.tolist() == status.tolist()
    assert np.isnan(recovery.resistance[1, 2])
    np.testing.assert_allclose(recovery.resistance[status == Status.READ], 5e3, rtol=1e-9)


def test_with_a_finite_gain_nothing_is_known_of_a_column_that_may_be_shorted() -> None:
    """The input of its amplifier would then not move, whatever the others conduct."""
    cells = np.full((4, 4), 5e3)
    cells[1, 2] = 100.0
    design = amplifier(4, 4, supply=(-0.1, 3.3), open_loop_gain=1e6)
    volts = scan(design, cells).volts
    recovery = recover(design, volts)
    assert (recovery.status[[0, 2, 3], 2] == Status.DISTURBED).all()
    assert (recovery.uncertainty[[0, 2, 3], 2] > 0.5).all()
    assert (recovery.status[:, [0, 1, 3]] == Status.READ).all()
    known = recover(design, volts, least_ohm=50.0)
    assert (known.uncertainty[[0, 2, 3], 2] < 1e-3).all()
    assert holds(known, cells).all()


def test_lines_carry_what_is_not_known_of_one_cell_to_the_others() -> None:
    """Most to its own column, less to its row, and least to the cells that share no line with it."""
    cells = np.full((6, 6), 5e3)
    cells[1, 2] = 50.0
    for lead in (1.0, 5.0, 25.0):
        design = amplifier(6, 6, lead=lead, supply=(-0.1, 3.3))
        recovery = recover(design, scan(design, cells).volts)
        others = np.delete(np.arange(6), 1), np.delete(np.arange(6), 2)
        column, row = recovery.uncertainty[others[0], 2], recovery.uncertainty[1, others[1]]
        assert column.min() > 0.1
        assert row.min() > 1e-4
        assert row.max() < 1e-2 * lead
        apart = recovery.uncertainty[np.ix_(*others)]
        assert apart.max() < row.max()
        assert holds(recovery, cells).all()


def test_a_reading_is_not_called_read_where_saturation_makes_it_wrong() -> None:
    """Heavy lines: the same readings come from quite other cells, if the saturated one is another."""
    base = amplifier(4, 4, lead=100.0, segment=50.0, supply=(-0.1, 3.3), reference_resistance=5e3)
    cells = np.full((4, 4), 2e4)
    cells[1, 1] = 100.0
    recovery = recover(base, scan(base, cells).volts)
    assert np.nanmax(np.abs(recovery.resistance / cells - 1)) > 1e-3
    assert (recovery.status != Status.READ).all()
    assert holds(recovery, cells).all()


@pytest.mark.parametrize("unknown", [1, 2, 3])
def test_cells_lie_within_their_intervals_whatever_the_unknown_ones_are(unknown: int) -> None:
    rng = np.random.default_rng(unknown)
    disturbed = 0
    for lead in (0.0, 0.5, 5.0, 50.0) * 3:
        rows, columns = (int(n) for n in rng.integers(3, 7, 2))
        offsets = rng.uniform(-1e-3, 1e-3, columns).tolist()
        design = amplifier(
            rows, columns, lead=lead, segment=float(rng.choice([0.0, 0.5])), supply=(-0.1, 3.3), offset_voltage=offsets
        )
        cells = 10 ** rng.uniform(3.3, 4.5, (rows, columns))
        for place in rng.choice(cells.size, unknown, replace=False):
            cells.ravel()[place] = 10 ** rng.uniform(-2, 2.3)
        recovery = recover(design, scan(design, cells).volts)
        disturbed += int((recovery.status == Status.DISTURBED).sum())
        assert holds(recovery, cells)[recovery.status != Status.SATURATED].all()
    assert disturbed > 50


@pytest.mark.parametrize("upper", [True, False])
def test_readings_clipped_by_the_converter_are_unknown_on_the_side_of_the_limit(upper: bool) -> None:
    """Beyond the upper end a cell may be a short, beyond the lower one it may be open, which costs the others less."""
    cells = np.full((3, 3), 5e3)
    clipped = np.zeros((3, 3), dtype=bool)
    clipped[0, 0] = True
    adc = Adc(bits=16, range=(0.0, 0.3) if upper else (0.1, 3.3))  # the others read 0.2 V
    for lead in (0.0, 10.0):
        design = amplifier(3, 3, lead=lead).replace(adc=adc)
        cells[0, 0] = 5e2 if upper else 5e4
        volts = np.clip(scan(design, cells, method="exact").volts, *adc.range)
        recovery = recover(design, volts, clipped=clipped)
        assert recovery.status[0, 0] == Status.SATURATED
        status = Status.DISTURBED if lead else Status.READ
        assert (recovery.status[0, 1:] == status).all()
        assert (recovery.status[1:, 0] == status).all()
        assert holds(recovery, cells).ravel()[1:].all()
        if lead:
            assert (recovery.uncertainty[1:, 0] > 0.1).all() == upper
            assert (recovery.uncertainty[1:, 0] < 0.01).all() == (not upper)


def test_an_ill_conditioned_frame_is_not_called_read() -> None:
    """A weak cell between strong ones hardly matters to any reading of a floating divider: rounding is all it is."""
    design = divider(3, 3, row_lead=1.0, row_segment=1.0, column_segment=1.0)
    cells = np.full((3, 3), 10.0)
    cells[1, 1] = 1e9
    assert np.nanmax(conditioning(design, cells).amplification) > 1e7
    recovery = recover(design, scan(design, cells).volts)
    assert recovery.status[1, 1] == Status.DISTURBED
    assert holds(recovery, cells).all()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(CIRCUITS), st.integers(0, 2), st.booleans())
def test_what_is_called_read_is_right(seed: int, circuit: str, faults: int, limited: bool) -> None:
    """Random designs with heavy lines, finite gains, offsets, faults, shorted, open and saturated cells; readings from
    the nodal reference. Amplified errors of 1e-11 are promised to stay below 1e-7 of a cell that counts as read.
    """
    rng = np.random.default_rng(seed)
    gain = {"open_loop_gain": float(rng.choice([np.inf, 1e6, 1e3]))}
    supply = {"supply": (-2.0, 4.0)} if limited else {}
    design, cells = real_design(seed, circuit=circuit, faults=faults, largest=3, **gain, **supply)
    for _ in range(rng.integers(3)):
        cells.ravel()[rng.integers(cells.size)] = rng.choice([np.inf, 0.0, 10.0, 1e8])
    try:
        recovery = recover(design, reference_volts(design, cells))
    except (SolverError, Indeterminate):
        return
    read = recovery.status == Status.READ
    np.testing.assert_allclose(recovery.resistance[read], cells[read], rtol=1e-7)


def test_known_faults_are_taken_out() -> None:
    cells = np.full((3, 3), 5e3)
    faults = (
        Fault(kind="open-cell", place=(0, 0), resistance=700.0),
        Fault(kind="shorted-cell", place=(1, 1), resistance=2e3),
        Fault(kind="open-cell", place=(2, 2)),
        Fault(kind="broken-row", place=(1, 1), resistance=90.0),
    )
    design = amplifier(3, 3, lead=10.0, segment=1.0).replace(fault=faults)
    recovery = recover(design, scan(design, cells).volts)
    assert recovery.status[2, 2] == Status.HIDDEN
    recovery.resistance[2, 2] = 5e3
    np.testing.assert_allclose(recovery.resistance, cells, rtol=1e-9)


def test_a_cell_behind_a_complete_short_is_not_invented() -> None:
    design = amplifier(3, 3, lead=10.0, segment=1.0)
    design = design.replace(fault=(Fault(kind="shorted-cell", place=(1, 1)),))
    cells = 10 ** np.random.default_rng(4).uniform(3.5, 4, (3, 3))
    recovery = recover(design, scan(design, cells).volts)
    assert recovery.status[1, 1] == Status.HIDDEN
    apart = np.ix_([0, 2], [0, 2])  # of its lines, of which the short takes the drive
    np.testing.assert_allclose(recovery.resistance[apart], cells[apart], rtol=1e-6)
    assert (recovery.status[[0, 1, 1, 2], [1, 0, 2, 1]] == Status.DISTURBED).all()


def test_a_short_in_a_continuous_sheet_is_beside_the_cell_and_not_part_of_it() -> None:
    cells = 10 ** np.random.default_rng(2).uniform(3.5, 4, (3, 3))
    design = amplifier(3, 3, lead=5.0)
    array = design.array.replace(sheet="continuous")
    fault = Fault(kind="shorted-cell", place=(1, 1), resistance=300.0)
    sheet = design.replace(array=array, fault=(fault,))
    recovery = recover(sheet, scan(sheet, cells).volts)
    np.testing.assert_allclose(recovery.resistance, cells, rtol=1e-8)
    assert holds(recovery, cells).all()


@pytest.mark.parametrize("idle_rows", ["ground", "float"])
def test_cells_beyond_a_break_are_hidden_and_disturb_others(idle_rows: str) -> None:
    """They still conduct from line to line, and how well is not known."""
    cells = 10 ** np.random.default_rng(3).uniform(3, 4, (4, 4))
    design = amplifier(4, 4, lead=20.0, segment=1.0).replace(
        fault=(Fault(kind="broken-row", place=(1, 2)), Fault(kind="broken-column", place=(0, 0)))
    )
    design = design.replace(drive={"idle_rows": idle_rows})
    recovery = recover(design, scan(design, cells).volts)
    hidden = np.zeros((4, 4), dtype=bool)
    hidden[1, 2:] = hidden[0, 0] = True
    assert np.array_equal(recovery.status == Status.HIDDEN, hidden)
    assert np.isnan(recovery.resistance[hidden]).all()
    others = np.array([0, 2, 3])
    assert (recovery.status[others, 2:] == Status.DISTURBED).all()
    assert (recovery.uncertainty[others, 2:] > 0.01).all()  # the row's loose end may join these two columns
    if idle_rows == "ground":
        assert (recovery.uncertainty[others, 1] < 0.01).all()
    assert holds(recovery, cells)[~hidden].all()


@pytest.mark.parametrize("kind", ["bridged-rows", "bridged-columns"])
@pytest.mark.parametrize("ohms", [5.0, 200.0])
def test_over_a_bridge_of_some_resistance(kind: str, ohms: float) -> None:
    """With leads of 50 ohm a bridge of 5 makes two lines nearly one; the conditioning says what that costs."""
    cells = 10 ** np.random.default_rng(2).uniform(3.5, 4, (4, 4))
    fault = Fault.model_validate({"kind": kind, "place": [1, 1], "resistance": ohms})
    design = amplifier(4, 4, lead=50.0).replace(fault=(fault,))
    volts = scan(design, cells).volts
    assert np.abs(apparent_resistance(design, volts) / cells - 1).max() > 0.1
    np.testing.assert_allclose(recover(design, volts).resistance, cells, rtol=1e-9)
    worst = conditioning(design, cells).amplification.max()
    assert worst > 5 if ohms == 5.0 else 1 < worst < 5


@pytest.mark.parametrize("size", [24, 64])
def test_large_grids_with_heavy_lines(size: int) -> None:
    rng = np.random.default_rng(size)
    design, cells = amplifier(size, size, lead=5.0, segment=1.0), 10 ** rng.uniform(4, 6, (size, size))
    volts = scan(design, cells).volts
    assert np.abs(apparent_resistance(design, volts) / cells - 1).max() > 0.02
    recovery = recover(design, volts)
    np.testing.assert_allclose(recovery.resistance, cells, rtol=1e-9)
    assert recovery.iterations <= 10


@pytest.mark.parametrize(("circuit", "seed"), [("inverting-amplifier", 32), ("voltage-divider", 112)])
def test_strongly_coupled_cells_are_found_along_a_path_of_readings(circuit: str, seed: int) -> None:
    """From the readings taken at their word Newton's method alone does not come to these."""
    gains = {} if circuit == "voltage-divider" else {"open_loop_gain": 1e5}
    design, cells = real_design(seed, circuit=circuit, faults=seed % 3, largest=6, **gains)
    cells = 1e3 * (cells / 1e3) ** 0.5
    recovery = recover(design, scan(design, cells).volts)
    read = recovery.status == Status.READ
    assert read.sum() >= cells.size - 1
    np.testing.assert_allclose(recovery.resistance[read], cells[read], rtol=1e-9)


def test_readings_that_no_cells_give_are_refused() -> None:
    """Of four cells in a floating divider one cannot read more than the other three in series."""
    ohms = np.array([[1e3, 1e3], [1e3, 1e5]])
    with pytest.raises(SolverError, match=r"no cell resistances|do not determine"):
        recover(divider(2, 2), 1e3 / (1e3 + ohms))


def test_lines_bridged_by_nothing_do_not_determine_their_cells() -> None:
    """Two columns that are one: their readings are each other's."""
    design = amplifier(3, 3, lead=5.0, open_loop_gain=1e5).replace(fault=(Fault(kind="bridged-columns", place=(2, 0)),))
    volts = scan(design, np.full((3, 3), 5e3)).volts.copy()
    volts[0, 0] *= 3
    with pytest.raises(SolverError, match="no cell resistances"):
        recover(design, volts)


@pytest.mark.parametrize(
    ("volts", "message"),
    [
        (np.zeros((2, 3)), r"shape \(2, 3\), expected \(2, 2\)"),
        ([[0.1, np.nan], [0.1, 0.1]], "row 0, column 1 is nan"),
        ([["x", 1.0], [1.0, 1.0]], "not numbers"),
    ],
)
def test_bad_readings_are_refused_by_name(volts: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        recover(amplifier(2, 2), volts)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"accuracy": np.nan}, "accuracy is nan; expected"),
        ({"accuracy": 0.0}, "accuracy is 0.0; expected"),
        ({"least_ohm": np.inf}, "least_ohm is inf; expected"),
        ({"clipped": np.zeros((2, 3))}, r"clipped has shape \(2, 3\), expected \(2, 2\)"),
    ],
)
def test_bad_arguments_of_a_recovery_are_refused_by_name(given: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        recover(amplifier(2, 2), np.full((2, 2), 0.1), **given)


def test_a_supply_that_a_divider_has_not_limits_none_of_its_readings() -> None:
    limited = amplifier(3, 2, supply=(0.0, 0.3)).with_circuit("voltage-divider").replace(drive={"voltage": 1.0})
    cells = np.full((3, 2), 1e3)
    np.testing.assert_allclose(recover(limited, scan(limited, cells).volts).resistance, cells, rtol=1e-9)


@pytest.mark.parametrize("cell", [18523.900393732307, 1e4, 2.2e4])
@pytest.mark.parametrize("offset", [1e-3, -1e-3, 1.7e-4])
@pytest.mark.parametrize("drive", [1.0, -1.0])
def test_an_open_cell_does_not_hide_its_neighbour(cell: float, offset: float, drive: float) -> None:
    """What the offset leaves of an open cell's reading is rounding, of either sign."""
    base = amplifier(2, 1, lead=1.0, offset_voltage=offset)
    design = base.replace(drive={"voltage": drive})
    cells = np.array([[cell], [np.inf]])
    found = recover(design, scan(design, cells).volts)
    np.testing.assert_allclose(found.resistance, cells, rtol=1e-9)
    assert found.status.ravel().tolist() == [Status.READ, Status.OPEN]


# Cells that a fault hides: others must not be called read for readings that the hidden ones share


def design(rows: int, columns: int, fault: dict[str, Any], *, circuit: str, **tables: dict[str, Any]) -> Design:
    return Design.model_validate(
        {
            "array": {"rows": rows, "columns": columns} | tables.get("array", {}),
            "drive": {"voltage": 1.0} | tables.get("drive", {}),
            "readout": {"circuit": circuit, "reference_resistance": 5000.0} | tables.get("readout", {}),
            "fault": [fault],
        }
    )


def is_honest(found: Recovery, cells: np.ndarray) -> np.ndarray:
    """(rows, columns): whether the cell lies within what is claimed for it."""
    claimed = np.isin(found.status, (Status.READ, Status.DISTURBED, Status.OPEN))
    with np.errstate(invalid="ignore"):
        off = np.abs(found.resistance / cells - 1)
        within = off <= found.uncertainty / np.maximum(1 - found.uncertainty, 1e-300) + 1e-6
    opened = (found.status == Status.OPEN) & np.isinf(cells)
    return ~claimed | within | opened | ~np.isfinite(found.uncertainty)


@pytest.mark.parametrize("kind", ["broken-row", "broken-column"])
@pytest.mark.parametrize("idle_rows", ["ground", "float"])
@pytest.mark.parametrize("idle_columns", ["float", "load"])
def test_dividers_with_a_broken_line_claim_no_cell_that_the_loose_ones_shift(
    kind: str, idle_rows: str, idle_columns: str
) -> None:
    rng = np.random.default_rng(5)
    for _ in range(12):
        rows, columns = (int(n) for n in rng.integers(2, 4, 2))
        place = [int(rng.integers(rows)), int(rng.integers(columns))]
        board = design(
            rows,
            columns,
            {"kind": kind, "place": place},
            circuit="voltage-divider",
            array={"row_lead": 10.0, "column_lead": 10.0},
            drive={"idle_rows": idle_rows},
            readout={"idle_columns": idle_columns},
        )
        cells = 10 ** rng.uniform(3.3, 4.2, (rows, columns))
        try:
            found = recover(board, reference_volts(board, cells))
        except SolverError:
            continue  # nothing is claimed
        assert is_honest(found, cells).all(), (place, cells, found)


@pytest.mark.parametrize("idle_rows", ["ground", "float"])
def test_a_row_that_a_wire_ties_to_an_ideal_driver_is_hidden_not_open(idle_rows: str) -> None:
    board = design(
        2,
        2,
        {"kind": "bridged-rows", "place": [1, 1], "to": 0},
        circuit="voltage-divider",
        array={"row_lead": [0.0, 10.0]},
        drive={"idle_rows": idle_rows},
    )
    cells = np.array([[1e4, 2e4], [3e4, 4e4]])
    try:
        found = recover(board, reference_volts(board, cells))
    except SolverError:
        assert idle_rows == "float"
        return
    assert not np.isin(found.status, (Status.READ, Status.OPEN)).any()


@pytest.mark.parametrize("circuit", ["voltage-divider", "inverting-amplifier"])
def test_cells_beside_a_complete_short_at_an_ideal_driver_are_not_open(circuit: str) -> None:
    board = design(
        3,
        3,
        {"kind": "shorted-cell", "place": [0, 0]},
        circuit=circuit,
        array={"column_lead": 5.0},
        readout={"open_loop_gain": 1e5, "supply": [-3.0, 3.0]},
    )
    cells = np.array([[1e4, 2e4, 1e4], [9e3, 1.2e4, 1e4], [1.1e4, 2e4, 2e4]])
    found = recover(board, reference_volts(board, cells))
    assert not np.isin(found.status[:, 0], (Status.READ, Status.OPEN)).any()
    assert (found.status[1:, 1:] == Status.READ).all()
    np.testing.assert_allclose(found.resistance[1:, 1:], cells[1:, 1:], rtol=1e-4)


def test_a_short_on_ideal_lines_without_a_supply_limit_leaves_nothing_to_read() -> None:
    board = Design.model_validate(
        {
            "array": {"rows": 2, "columns": 2},
            "drive": {"voltage": -1.0},
            "readout": {"circuit": "inverting-amplifier", "reference_resistance": 1e3, "open_loop_gain": 1e5},
        }
    )
    cells = np.array([[0.0, 2e3], [3e3, 4e3]])
    found = recover(board, reference_volts(board, cells))
    assert not np.isin(found.status, (Status.OPEN, Status.READ)).any()
