"""The stated bound holds and the tolerance is kept, whatever the method; against exact arithmetic on small grids."""

from __future__ import annotations

from itertools import product
from math import inf

import numpy as np
import pytest
from designs import amplifier, divider
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from parts_at_random import real_design

from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import METHODS, Adc, Design, scan
from ohmskin.circuits.solvers import Lines, Wires, attenuate, exact_transfer
from ohmskin.errors import InputError, SolverError

HARD_CELLS = {
    "ordinary": [[1e4, 1e5, 3e5], [1e6, 2e4, 5e5]],
    "1 ohm to 1 Tohm": [[1.0, 1e12, 1e5], [1e3, 10.0, 1e9]],
    "open cells": [[inf, 1e4, inf], [inf, inf, 1e5]],
    "all open": [[inf] * 3] * 2,
    "shorts": [[0.0, 1e4, 1e5], [1e6, 1e-3, 1e5]],
}
HARD_PARTS = [
    {"lead": 1e-6, "segment": 1e-6},
    {"lead": 1e6, "segment": 1.0},
    {"lead": 1.0, "segment": 1e6},
    {"lead": 5.0, "segment": 0.0},
    {"lead": 20.0, "segment": 2.0, "open_loop_gain": 1.0, "offset_voltage": 1e-3, "bias_current": 1e-7},
    {"lead": 20.0, "segment": 2.0, "open_loop_gain": 1e12, "reference_voltage": 1.65, "supply": (0.0, 3.3)},
]


def off(design: Design, cells: object, volts: np.ndarray) -> float:
    """True worst error relative to the largest output."""
    exact = reference_volts(design, cells)
    largest = np.abs(exact).max()
    return float(np.abs(volts - exact).max() / largest) if largest else float(np.abs(volts).max())


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("cells", HARD_CELLS)
@pytest.mark.parametrize("parts", HARD_PARTS, ids=str)
def test_stated_bounds_hold_on_hard_cases(method: str, cells: str, parts: dict[str, float]) -> None:
    design = amplifier(2, 3, **parts)
    result = scan(design, HARD_CELLS[cells], method=method)
    # 2 ulp: the volts themselves are rounded, and so is the reference.
    assert off(design, HARD_CELLS[cells], result.volts) <= result.error_bound + 4.5e-16


@pytest.mark.parametrize("seed", range(25))
@pytest.mark.parametrize("method", METHODS)
def test_stated_bounds_hold_for_unequal_parts_faults_and_every_circuit(seed: int, method: str) -> None:
    design, cells = real_design(seed, faults=seed % 3)
    try:
        result = scan(design, cells, method=method)
    except SolverError:
        return  # contradictory ideal parts, tests/test_readout.py
    assert off(design, cells, result.volts) <= result.error_bound + 4.5e-16
    assert np.isfinite(result.error_bound)


@settings(deadline=None, max_examples=100)
@given(
    hnp.arrays(
        np.float64,
        hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=4),
        elements=st.one_of(st.just(inf), st.floats(0.0, 12.0).map(lambda decade: 10**decade)),
    ),
    st.lists(st.one_of(st.floats(-9.0, 0.0), st.floats(0.0, 6.0)), min_size=4, max_size=4),
    st.sampled_from([1.0, 1e3, 1e9, inf]),
)
@example(np.array([[1.0, 1.0], [inf, inf]]), [6.0] * 4, inf)  # an open row beside lines too heavy for a bound
def test_line_attenuation_keeps_its_bound_on_lines_of_any_weight(
    cells: np.ndarray, weights: list[float], gain: float
) -> None:
    """From nothing up to a million times the lightest cell, each kind of wire of its own."""
    names = ("row_lead", "row_segment", "column_lead", "column_segment")
    wires = {name: float(min(cells.min(), 1e12) * 10**decade) for name, decade in zip(names, weights, strict=True)}
    base = amplifier(*cells.shape, open_loop_gain=gain)
    design = base.replace(array=wires)
    result = scan(design, cells, method="attenuation")
    assert off(design, cells, result.volts) <= result.error_bound + 4.5e-16


@settings(deadline=None, max_examples=60)
@given(
    hnp.arrays(
        np.float64,
        hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=4),
        elements=st.floats(0.0, 12.0).map(lambda decade: 10**decade),
    ),
    st.sampled_from([1e-6, 0.5, 50.0, 1e4]),
    st.sampled_from([1e-2, 1e-4, 1e-7, 1e-10]),
)
def test_tolerances_are_kept_or_refused(cells: np.ndarray, ohms: float, tolerance: float) -> None:
    design = amplifier(*cells.shape, lead=ohms, segment=ohms)
    result = scan(design, cells, tolerance=tolerance)
    assert result.error_bound <= tolerance
    assert off(design, cells, result.volts) <= tolerance


@pytest.mark.parametrize("size", [8, 20, 40])
def test_from_1e_2_to_1e_10_every_tolerance_is_served_by_the_cheapest_method(size: int) -> None:
    cells = 10 ** np.random.default_rng(0).uniform(4, 6, (size, size))
    design = amplifier(size, size, lead=1.0, segment=1.0)
    finest = scan(design, cells, method="exact")
    methods = []
    for decade in range(2, 11):
        result = scan(design, cells, tolerance=10.0**-decade)
        assert result.error_bound <= 10.0**-decade
        error = np.abs(result.volts - finest.volts).max() / np.abs(finest.volts).max()
        assert error <= result.error_bound + finest.error_bound
        methods.append(result.method)
    assert methods[0] == ("exact" if size == 8 else "attenuation")  # which costs no less on few cells
    assert methods[-1] != "attenuation"
    assert scan(design, cells, method="exact").error_bound < 2e-11


@pytest.mark.parametrize(("row", "column", "most"), [(1.0, 1.0, 2e-10), (5e4, 5e4, 2e-10), (5e4, 1e-6, 1e-8)])
@pytest.mark.parametrize("lead", [0.0, 1.0, 5e4])
def test_bounds_stay_small_on_lines_and_cells_of_any_weight(
    row: float, column: float, most: float, lead: float
) -> None:
    """As docs/notes/solvers.md says of 64 x 64."""
    rng = np.random.default_rng(5)
    design = amplifier(64, 64, lead=lead).replace(array={"row_segment": row, "column_segment": column})
    for cells in (10 ** rng.uniform(0, 12, (64, 64)), rng.choice([1.0, 1e12], (64, 64))):
        assert 1e-15 < scan(design, cells, method="exact").error_bound < 1e-8


@pytest.mark.parametrize("method", [None, "attenuation"])
@pytest.mark.parametrize("parts", [{}, {"row_lead": 3.0}, {"row_lead": 3.0, "row_segment": 0.1, "column_lead": 1.0}])
@pytest.mark.parametrize("offset", [0.0, (0.0, 1e-12)], ids=["equal", "unequal"])
def test_outputs_whose_parts_cancel_do_not_make_their_errors_small(
    method: str | None, parts: dict[str, float], offset: float | tuple[float, ...]
) -> None:
    """All of a frame's outputs next to 0 V: what is left of a reference of 1.65 V, and rounded as that is."""
    readout = {"reference_resistance": 1000.0, "reference_voltage": 1.65, "offset_voltage": offset}
    tables = {
        "array": {"rows": 3, "columns": 2} | parts,
        "drive": {"voltage": 1.65},
        "readout": readout | {"circuit": "inverting-amplifier"},
    }
    design = Design.model_validate(tables)
    for above in (1e-8, 3e-11, 7e-13):
        cells = np.full((3, 2), (1000.0 - parts.get("row_lead", 0.0)) * (1.0 + above))
        result = scan(design, cells, method=method)
        assert off(design, cells, result.volts) <= result.error_bound


def test_through_an_adc_a_quarter_of_a_step_is_kept_and_no_more_is_computed() -> None:
    cells = 10 ** np.random.default_rng(0).uniform(4, 6, (32, 32))
    exact = amplifier(32, 32, lead=1.0, segment=1.0, reference_resistance=3e4)
    methods = []
    for bits in (4, 8, 12, 16, 24, 32):
        adc = Adc(bits=bits, range=(0.0, 3.3))
        result = scan(exact.replace(adc=adc), cells)
        assert np.abs(result.volts - scan(exact, cells).volts).max() <= adc.step / 4
        assert result.error_bound * np.abs(result.volts).max() <= adc.step / 4 * (1 + 1e-9)
        methods.append(result.method)
    assert methods[0] == "attenuation"
    assert methods[-1] == "exact"
    assert methods == sorted(methods)  # once exact, always exact
    assert scan(exact, cells).method == "exact"


@pytest.mark.parametrize("method", METHODS)
def test_what_a_fast_method_cannot_express_is_read_exactly(method: str) -> None:
    cells = np.full((4, 4), 5e3)
    shorted = cells.copy()
    shorted[1, 2] = 0.0
    saturating = amplifier(4, 4, lead=5.0, supply=(0.0, 0.15))
    for design, frame in (
        (divider(4, 4), cells),
        (amplifier(4, 4, lead=5.0, open_loop_gain=1e4), shorted),
        (saturating, cells),
    ):
        result = scan(design, frame, method=method)
        assert result.method == "exact"
        np.testing.assert_array_equal(result.volts, scan(design, frame).volts)
    assert scan(saturating, cells, method=method).saturated.all()


def test_an_output_near_its_limit_is_not_left_to_a_guess() -> None:
    """Where the readings leave it open whether an output reaches its limit, the answer is not left to them."""
    cells, unlimited = np.full((16, 16), 2e3), amplifier(16, 16, lead=1.0, segment=1.0)
    true, guess = scan(unlimited, cells), scan(unlimited, cells, method="attenuation")
    off = guess.error_bound * guess.volts.max()
    assert abs(guess.volts.max() - true.volts.max()) < off
    for limit, saturated in ((true.volts.max() - off / 2, True), (true.volts.max() + off / 2, False)):
        result = scan(amplifier(16, 16, lead=1.0, segment=1.0, supply=(-1.0, limit)), cells, tolerance=0.1)
        assert result.method == "exact"
        assert result.saturated.any() == saturated


def test_requests_that_make_no_sense_are_refused() -> None:
    design, cells = amplifier(2, 2, lead=1.0, segment=1.0), np.full((2, 2), 1e4)
    for arguments, message in (
        ({"tolerance": 0.0}, "tolerance is 0.0; expected a number above 0"),
        ({"tolerance": float("nan")}, "tolerance is nan"),
        ({"method": "magic"}, "unknown method 'magic'; expected one of attenuation, exact"),
        ({"method": "exact", "tolerance": 1e-3}, "a tolerance or a method, not both"),
    ):
        with pytest.raises(InputError, match=message):
            scan(design, cells, **arguments)
    with pytest.raises(SolverError, match=r"no method certifies a tolerance of 1e-17 here; method 'exact' certifies"):
        scan(design, cells, tolerance=1e-17)


# Line attenuation: certified on anything, tight on ordinary arrays


def uniform(shape: tuple[int, int], segment: float, lead: float) -> Lines:
    row, column = np.full(shape, 1 / segment), np.full(shape, 1 / segment)
    row[:, 0] = 1 / lead
    return Lines(row, column, np.full(shape[1], 1 / lead))


def ordinary(size: int, seed: int = 0) -> np.ndarray:
    return 10 ** -np.random.default_rng(seed).uniform(4, 6, (size, size))


@pytest.mark.parametrize(("size", "segment"), [*product([4, 16, 64], [0.1, 10.0]), (128, 1.0)])
def test_the_certificate_is_tight_on_ordinary_arrays(size: int, segment: float) -> None:
    lines = uniform((size, size), segment, segment)
    for seed in range(2):
        cells = ordinary(size, seed)
        known = attenuate(cells, Wires.of(lines))
        assert known is not None
        error = np.abs(exact_transfer(cells, lines)[0] - known.transfer).max()
        assert error <= known.error.max() <= 30 * error


@pytest.mark.parametrize(("size", "segment", "published"), [(32, 0.1, 5e-7), (64, 1.0, 7e-4), (128, 1.0, 6e-3)])
def test_full_scale_errors_are_of_the_expected_size(size: int, segment: float, published: float) -> None:
    lines, cells = uniform((size, size), segment, segment), ordinary(size)
    known, exact = attenuate(cells, Wires.of(lines)), exact_transfer(cells, lines)[0]
    assert known is not None
    assert published / 3 < (exact - known.transfer).max() / exact.max() < 3 * published


def test_ideal_lines_attenuate_nothing() -> None:
    cells = ordinary(6)
    wires = Wires.of(Lines(np.full((6, 6), np.inf), np.full((6, 6), np.inf), np.full(6, np.inf)))
    known = attenuate(cells, wires)
    assert known is not None
    np.testing.assert_array_equal(known.transfer, cells)
    assert (known.error <= 1e-12 * cells).all()


def test_what_ladders_cannot_express_is_refused() -> None:
    cells, lines = ordinary(4), uniform((4, 4), 1.0, 1.0)
    shorted = np.where(np.eye(4) > 0, np.inf, cells)
    assert attenuate(shorted, Wires.of(lines)) is None
    broken = Lines(lines.row.copy(), lines.column, lines.exit)
    broken.row[1, 2] = 0.0
    assert Wires.of(broken) is None
    assert attenuate(cells, None) is None


def test_where_nothing_is_left_of_the_drive_nothing_is_said() -> None:
    lines, cells = uniform((60, 60), 1e6, 1e6), np.full((60, 60), 1.0)
    assert attenuate(cells, Wires.of(lines)) is None


def test_one_frame_without_a_bound_spoils_no_other() -> None:
    lines, light = uniform((5, 5), 1.0, 1.0), ordinary(5)
    heavy = np.full((5, 5), 1e6)
    wires = Wires.of(lines)
    together, alone = attenuate(np.stack([heavy, light]), wires), attenuate(light, wires)
    assert together is not None
    assert alone is not None
    np.testing.assert_allclose(together.error[1], alone.error, rtol=1e-12)
    np.testing.assert_array_equal(together.transfer[1], alone.transfer)
