"""Line attenuation: certified on anything, tight on ordinary arrays."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ohmskin.circuits.solvers import Lines, Wires, attenuate, exact_transfer

EXACT = 1e-11  # relative error of the exact method, tests/test_ports.py


def uniform(shape: tuple[int, int], segment: float, lead: float) -> Lines:
    row, column = np.full(shape, 1 / segment), np.full(shape, 1 / segment)
    row[:, 0] = 1 / lead
    return Lines(row, column, np.full(shape[1], 1 / lead))


def ordinary(size: int, seed: int = 0) -> np.ndarray:
    return 10 ** -np.random.default_rng(seed).uniform(4, 6, (size, size))


OHMS = st.one_of(st.sampled_from([1e-6, 1.0, 1e6]), st.floats(1e-6, 1e6))
CELLS = st.one_of(st.just(0.0), st.floats(-12.0, 0.0).map(lambda decade: 10**decade))


@settings(deadline=None, max_examples=150)
@given(
    hnp.arrays(np.float64, hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=6), elements=CELLS),
    OHMS,
    OHMS,
    OHMS,
)
@example(np.array([[1.0, 1.0], [0.0, 0.0]]), 1e6, 1e6, 1e6)  # an open row beside lines too heavy for a bound
def test_the_certificate_holds_on_anything(cells: np.ndarray, row: float, column: float, lead: float) -> None:
    lines = Lines(np.full(cells.shape, 1 / row), np.full(cells.shape, 1 / column), np.full(cells.shape[1], 1 / lead))
    lines.row[:, 0] = 1 / lead
    exact = exact_transfer(cells, lines)[0]
    known = attenuate(cells, Wires.of(lines))
    if known is not None:
        assert (np.abs(exact - known.transfer) <= known.error + EXACT * exact).all()


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
