"""The solver against closed forms, published figures and the laws of circuits."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from designs import amplifier, divider
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from parts_at_random import real_design

from ohmskin.circuits import (
    CIRCUITS,
    Adc,
    Boards,
    Design,
    adc_codes,
    adc_error,
    clipped,
    ideal_volts,
    scan,
    scan_population,
    volts_of_codes,
)
from ohmskin.common.arrays import FloatArray
from ohmskin.errors import InputError

ORDINARY = st.floats(1e2, 1e7)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1), (4, 4), (3, 7), (16, 16)])
def test_uniform_floating_divider_reads_the_grid_resistance(shape: tuple[int, int]) -> None:
    n, m = shape
    read = scan(divider(n, m), np.full(shape, 5e3)).resistance
    assert read == pytest.approx(np.full(shape, 5e3 * (n + m - 1) / (n * m)), rel=1e-12)


@given(hnp.arrays(np.float64, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.floats(1.0, 1e12)))
def test_ideal_amplifier_reads_each_cell_alone(cells: np.ndarray) -> None:
    volts = scan(amplifier(*cells.shape), cells).volts
    np.testing.assert_allclose(volts, 1000.0 / cells, rtol=1e-12)


PUBLISHED_CELLS = (100.0, 500.0, 2000.0, 5000.0, 7500.0, 10000.0)
PUBLISHED = {  # switch resistance: |error| in % (Hidalgo-Lopez et al. 2018, table 2a)
    1.0: (2.28, 0.68, 0.37, 0.29, 0.26, 0.24),
    6.0: (13.79, 4.10, 2.27, 1.89, 1.79, 1.73),
    25.0: (58.82, 17.42, 9.61, 7.96, 7.54, 7.29),
}


@pytest.mark.parametrize("columns", [{}, {"columns": "multiplexed", "idle_columns": "ground"}])
@pytest.mark.parametrize("switch", PUBLISHED)
def test_published_switch_resistance_errors(switch: float, columns: dict[str, str]) -> None:
    """The authors have one amplifier; idle columns are at ground, which is where amplifiers of their own hold them."""
    design = amplifier(8, 8, lead=switch).replace(readout=columns)
    for cell, published in zip(PUBLISHED_CELLS, PUBLISHED[switch], strict=True):
        cells = np.full((8, 8), 5e3)
        cells[2, 5] = cell
        error = 100 * abs(scan(design, cells).resistance[2, 5] / cell - 1)
        assert error == pytest.approx(published, abs=0.25)


FOLLOWED = {  # switch resistance: |error| in % of the classical voltage feedback (the same authors, table 4a)
    1.0: (2.31, 0.69, 0.39, 0.34, 0.33, 0.32),
    6.0: (13.81, 4.12, 2.30, 1.94, 1.86, 1.82),
    15.0: (34.88, 10.36, 5.76, 4.82, 4.59, 4.48),
    25.0: (58.85, 17.43, 9.64, 8.02, 7.62, 7.39),
}
FOLLOWED_SIZES = {  # rows and columns: the same with other cells of 2 kohm (table 6a)
    4: (11.60, 3.53, 2.01, 1.71, 1.64, 1.60),
    8: (13.72, 5.56, 4.02, 3.67, 3.57, 3.50),
    16: (18.02, 9.68, 8.02, 7.51, 7.27, 7.07),
}


@pytest.mark.parametrize(
    ("size", "switch", "others", "published"),
    [
        *((8, switch, 5e3, errors) for switch, errors in FOLLOWED.items()),
        *((size, 5.0, 2e3, errors) for size, errors in FOLLOWED_SIZES.items()),
    ],
)
def test_published_voltage_feedback_errors(
    size: int, switch: float, others: float, published: tuple[float, ...]
) -> None:
    """One follower drives all idle lines. The switches of table 6a have the 5 ohm that its 18 figures agree on."""
    design = amplifier(size, size, lead=switch).with_circuit("voltage-feedback")
    for cell, error in zip(PUBLISHED_CELLS, published, strict=True):
        cells = np.full((size, size), others)
        cells[1, 2] = cell
        assert 100 * abs(scan(design, cells).resistance[1, 2] / cell - 1) == pytest.approx(error, abs=0.05)


@pytest.mark.parametrize(("size", "first", "last"), [(8, 0.880, 1.442), (16, 3.047, 5.464), (32, 11.351, 21.457)])
def test_published_distributed_line_errors(size: int, first: float, last: float) -> None:
    read = scan(amplifier(size, size, lead=1.0, segment=1.0), np.full((size, size), 5e3)).resistance
    errors = 100 * (read[0] / 5e3 - 1)
    assert round(errors[0], 3) == first
    assert round(errors[-1], 3) == last


@settings(deadline=None)
@given(hnp.arrays(np.float64, hnp.array_shapes(min_dims=2, max_dims=2, max_side=7), elements=ORDINARY))
def test_reading_the_grid_from_its_other_side(cells: np.ndarray) -> None:
    """Reciprocity: drive the columns and read the rows, and each cell reads the same (ideal amplifiers)."""
    base = scan(amplifier(*cells.shape, lead=30.0, segment=2.0), cells).volts
    # Turned over, the sources sit at the ends where the amplifiers were.
    turned = scan(amplifier(*cells.shape[::-1], lead=30.0, segment=2.0), cells[::-1, ::-1].T).volts
    np.testing.assert_allclose(turned.T[::-1, ::-1], base, rtol=1e-11)


def test_finite_gain_offset_and_bias_follow_the_first_order_law() -> None:
    """Err ~ (1 + Rref sum G) / A; offset Vos (1 + Rref sum G); bias Ib Rref (paper-notes: readout)."""
    cells = np.full((6, 3), 2e3)
    ideal = scan(amplifier(6, 3), cells).volts
    noise_gain = 1 + 1000.0 * 6 / 2e3
    gain = scan(amplifier(6, 3, open_loop_gain=1e5), cells).volts
    np.testing.assert_allclose(1 - gain / ideal, noise_gain / 1e5, rtol=1e-4)
    offset = scan(amplifier(6, 3, offset_voltage=1e-3), cells).volts
    np.testing.assert_allclose(offset - ideal, 1e-3 * noise_gain, rtol=1e-9)
    bias = scan(amplifier(6, 3, bias_current=1e-8), cells).volts
    np.testing.assert_allclose(bias - ideal, 1e-8 * 1000.0, rtol=1e-7)


def test_a_saturated_output_stays_at_the_limit_and_is_flagged() -> None:
    cells = np.full((4, 4), 5e3)
    cells[1, 2] = 100.0
    result = scan(amplifier(4, 4, lead=5.0, supply=(0.0, 3.3)), cells)
    assert result.saturated.tolist() == (cells == 100.0).tolist()
    assert result.volts[1, 2] == 3.3
    # The lost virtual ground lifts column 2 and steals current from the driven row: its neighbours read high.
    free = scan(amplifier(4, 4, lead=5.0), cells)
    others = [0, 1, 3]
    assert (result.volts[1, others] > free.volts[1, others]).all()


def test_a_short_reads_infinite_on_ideal_parts_and_saturates_real_ones() -> None:
    cells = np.full((3, 3), 1e4)
    cells[1, 1] = 0.0
    ideal = scan(amplifier(3, 3), cells)
    assert np.isposinf(ideal.volts[1, 1])
    assert ideal.resistance[1, 1] == 0
    np.testing.assert_allclose(np.delete(ideal.volts.ravel(), 4), 0.1, rtol=1e-12)
    real = scan(amplifier(3, 3, open_loop_gain=1e5, supply=(-5.0, 5.0)), cells)
    assert real.saturated[1, 1]
    assert real.volts[1, 1] == 5.0


def test_divider_with_shorts_and_open_lines_has_no_stray_numbers() -> None:
    cells = np.full((4, 4), 5e3)
    cells[1, 0] = 0.0
    cells[2] = np.inf
    read = scan(divider(4, 4), cells).resistance
    assert read[1, 0] == pytest.approx(0.0, abs=1e-9)
    assert np.isinf(read[2]).all()
    # Row 1 and column 0 are one node; from there to column 1: 5k directly and 5k + 5k || 5k ... over rows 0 and 3.
    assert (read[[0, 1, 3]] >= -1e-9).all()


def test_ideal_volts_is_equation_10() -> None:
    cells = np.array([[500.0, np.inf], [1e3, 2e3]])
    np.testing.assert_allclose(ideal_volts(amplifier(2, 2), cells), [[2.0, 0.0], [1.0, 0.5]])
    np.testing.assert_allclose(ideal_volts(divider(2, 2), cells), [[2 / 3, 0.0], [0.5, 1 / 3]])


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ([[1.0, 2.0]], r"shape \(1, 2\), expected \(2, 2\)"),
        ([[1.0, np.nan], [1.0, 1.0]], "row 0, column 1 is nan"),
        ([[1.0, 1.0], [-3.0, 1.0]], "row 1, column 0 is -3.0"),
        ([["a", 1.0], [1.0, 1.0]], "not numbers"),
    ],
)
def test_bad_cells_are_refused_by_name(cells: list[list[float]], message: str) -> None:
    with pytest.raises(InputError, match=message):
        scan(amplifier(2, 2), cells)


# The converter: ideal codes, and the errors a data sheet names


def converter(**adc: float) -> Design:
    return amplifier(1, 1).replace(adc=Adc(bits=12, range=(-0.5, 3.5), **adc))


@given(st.floats(-0.5, 3.499))
def test_an_ideal_code_is_at_most_half_a_step_off(volts: float) -> None:
    design = converter()
    assert abs(volts_of_codes(design, adc_codes(design, np.array(volts))) - volts) <= 4 / 2**13 + 1e-15


@given(st.floats(-0.4, 3.4), st.floats(-0.02, 0.02), st.floats(-0.01, 0.01), st.floats(-8.0, 8.0))
def test_a_real_code_is_within_the_stated_error(volts: float, offset: float, gain: float, inl: float) -> None:
    design = converter(offset_voltage=offset, gain_error=gain, inl_steps=inl)
    codes = adc_codes(design, np.array(volts))
    if not clipped(design, codes):
        # The bow and the slope act on what the others have moved: second order.
        slack = abs(gain * offset) + abs(inl) * 4 / 2**12 * 4 * (abs(gain) + abs(offset) / 4)
        assert abs(volts_of_codes(design, codes) - volts) <= adc_error(design) + slack + 1e-12


def test_each_error_by_its_definition() -> None:
    volts = np.array([-0.5, 1.5, 3.5]) + 1e-9
    at = adc_codes(converter(), volts).astype(int)
    step = 4 / 2**12
    assert (adc_codes(converter(offset_voltage=10 * step), volts) - at).tolist() == [
        10,
        10,
        0,
    ]  # the last one is clipped
    assert (adc_codes(converter(gain_error=0.01), volts) - at).tolist() == [0, 20, 0]
    assert (adc_codes(converter(inl_steps=5.0), volts) - at).tolist() == [0, 5, 0]
    assert (adc_codes(converter(gain_error=-0.01), volts) - at).tolist()[2] == -41 + 1


def test_what_lies_beyond_the_range_is_clipped_and_known_to_be() -> None:
    design = converter()
    codes = adc_codes(design, np.array([-9.0, 0.0, 9.0]))
    assert codes[[0, 2]].tolist() == [0, 4095]
    assert clipped(design, codes).tolist() == [True, False, True]


def test_without_an_adc_there_are_no_codes() -> None:
    with pytest.raises(InputError, match=r"no \[adc\] section"):
        adc_codes(amplifier(1, 1), np.zeros((1, 1)))


# Many boards of one design: a stack against a loop over the scan of each board


COUNT = 5


def _boards(seed: int, **readout: Any) -> tuple[Design, Boards, FloatArray]:
    """A design at random, some of whose lines are ideal; boards whose every part differs by up to 30 %; their cells."""
    random = np.random.default_rng([seed, 3])
    circuit = CIRCUITS[seed % len(CIRCUITS)]
    design, _ = real_design(seed, circuit=circuit, smallest=2, largest=5, idle_lines=True, faults=seed % 2, **readout)
    lines = ("row_lead", "row_segment", "column_lead", "column_segment")
    faults = [fault.replace(resistance=20.0) for fault in design.fault]
    design = design.replace(array={name: 0.0 for name in lines if random.random() < 0.3}, fault=faults)
    nominal = Boards.of(design)
    values = {name: getattr(nominal, name) for name in Boards.names()}
    drawn = {name: value * random.uniform(0.7, 1.3, (COUNT, value.shape[1])) for name, value in values.items()}
    if design.readout.columns == "multiplexed":  # its lines share one amplifier or load
        for name in ("reference_resistance", "open_loop_gain", "offset_voltage", "bias_current"):
            drawn[name] = np.repeat(drawn[name][:, :1], drawn[name].shape[1], axis=1)
    return design, Boards(**drawn), 10 ** random.uniform(3.0, 4.5, (COUNT, *design.array.shape))


@pytest.mark.parametrize("seed", range(40))
def test_every_board_is_read_as_by_a_scan_of_its_own(seed: int) -> None:
    """Some of them saturate, and open and shorted cells are among theirs."""
    limits: dict[str, Any] = {"supply": (-0.4, 0.4), "reference_voltage": 0.0} if seed % 3 == 0 else {}
    design, boards, cells = _boards(seed, **limits)
    cells[3, 0, -1], cells[4, -1, 0] = np.inf, 0.0 if design.array.row_lead and design.array.column_lead else 1.0
    found = scan_population(design, boards, cells)
    for board in range(COUNT):
        alone = scan(boards.design(design, board), cells[board], method="exact")
        assert found.volts[board] == pytest.approx(alone.volts, rel=1e-9, abs=1e-12)
        assert (found.saturated[board] == alone.saturated).all()


@pytest.mark.parametrize("seed", range(40, 60))
def test_one_driven_line_is_read_as_among_all_lines(seed: int) -> None:
    design, boards, cells = _boards(seed)
    whole, kind = scan_population(design, boards, cells), 1 if design.readout.circuit == "row-amplifier" else 0
    driven = np.random.default_rng(seed).integers(0, design.array.shape[kind], COUNT)
    one = scan_population(design, boards, cells, driven=driven)
    for board, line in enumerate(driven):
        known = np.take(one.volts[board], line, axis=kind)
        assert known == pytest.approx(np.take(whole.volts[board], line, axis=kind), rel=1e-10)
        assert np.isnan(np.delete(one.volts[board], line, axis=kind)).all()


def test_saturated_boards_are_flagged_even_when_they_are_not_solved_again() -> None:
    design = amplifier(3, 3, lead=10.0, supply=(-0.4, 0.4), open_loop_gain=1e4, offset_voltage=4e-3)
    cells = np.full((COUNT, 3, 3), 10e3)
    cells[2] = 500.0
    quick, exact = (
        scan_population(design, Boards.of(design), cells, resolve_saturation=resolved) for resolved in (False, True)
    )
    assert (quick.saturated.any(axis=(1, 2)) == exact.saturated.any(axis=(1, 2))).all()
    assert np.abs(quick.volts).max() <= 0.4


def test_shapes_that_do_not_fit_are_refused() -> None:
    design = amplifier(4, 3, lead=70.0)
    with pytest.raises(InputError, match="expected \\(boards, 4, 3\\)"):
        scan_population(design, Boards.of(design), np.ones((2, 3, 4)))
    many = replace(Boards.of(design), offset_voltage=np.zeros((4, 3)))
    with pytest.raises(InputError, match="4 boards and 2 frames"):
        scan_population(design, many, np.ones((2, 4, 3)))
