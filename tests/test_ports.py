"""The reduction to ports: against the same without LAPACK, against itself in other orders, and its rounding bound."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ohmskin.circuits.solvers import _banded as banded
from ohmskin.circuits.solvers import _elimination as elimination
from ohmskin.circuits.solvers._dissection_plan import plan
from ohmskin.circuits.solvers._exact import _transfer_error as transfer_error
from ohmskin.circuits.solvers._exact import exact_transfer
from ohmskin.circuits.solvers._ports import Lines, Stream, port_conductances, transfer_conductances

SHAPES = [(1, 1), (1, 7), (6, 1), (4, 5), (5, 5), (3, 11), (8, 8), (13, 18), (20, 17), (33, 9), (36, 40)]


def lines_at_random(shape: tuple[int, int], rng: np.random.Generator, decades: float = 1.0) -> Lines:
    row, column = (10 ** rng.uniform(-decades, decades, shape) for _ in range(2))
    return Lines(row, column, 10 ** rng.uniform(-decades, decades, shape[1]))


def slowly(conductance: np.ndarray, lines: Lines, monkeypatch: pytest.MonkeyPatch) -> np.ndarray:
    """Every block inverted by halves, which never subtracts."""
    with monkeypatch.context() as patch:
        patch.setattr(elimination, "SAFE_SHARE", 2.0)
        return transfer_conductances(conductance, lines)[0]


def exact_by_dissection(conductance: np.ndarray, lines: Lines) -> tuple[np.ndarray, np.ndarray]:
    transfer, relative = transfer_conductances(conductance, lines)
    return transfer, transfer_error(conductance, lines, transfer, relative)


@pytest.mark.parametrize("shape", SHAPES)
def test_transfer_is_the_rows_by_columns_part_of_the_ports(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    lines, cells = lines_at_random(shape, rng), 10 ** rng.uniform(-6, -3, shape)
    whole = port_conductances(cells, lines).value
    np.testing.assert_allclose(transfer_conductances(cells, lines)[0], whole[: shape[0], shape[0] :], rtol=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
def test_exits_are_resistors_behind_the_columns(shape: tuple[int, int]) -> None:
    """Attached to the lines before the reduction, or behind the ports after it, by a dense solve."""
    rng = np.random.default_rng(2)
    n, lines, cells = shape[0], lines_at_random(shape, rng), 10 ** rng.uniform(-4, -2, shape)
    bare = port_conductances(cells, Lines(lines.row, lines.column)).value
    nodal = np.diag(bare.sum(axis=0)) - bare
    nodal[n:, n:] += np.diag(lines.exit)
    expected = np.linalg.solve(nodal[n:, n:], bare[n:, :n]).T * lines.exit
    np.testing.assert_allclose(transfer_conductances(cells, lines)[0], expected, rtol=1e-10)


@pytest.mark.parametrize("decades", [1.0, 6.0])
@pytest.mark.parametrize("shape", SHAPES)
def test_fast_inverses_lose_nothing_cell_by_cell(
    shape: tuple[int, int], decades: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(3)
    lines, cells = lines_at_random(shape, rng, decades), 10 ** rng.uniform(-12, 0, shape)
    fast, relative = transfer_conductances(cells, lines)
    slow = slowly(cells, lines, monkeypatch)
    np.testing.assert_allclose(fast, slow, rtol=1e-12)
    assert 1e-15 < relative < 1e-9


def test_small_grids_by_cholesky_and_by_dissection_agree_within_both_bounds() -> None:
    rng = np.random.default_rng(4)
    for shape in [(1, 1), (2, 3), (4, 4), (8, 8), (5, 13), (16, 16)]:
        lines, cells = lines_at_random(shape, rng, 0.3), 10 ** rng.uniform(-6, -4, shape)
        small = banded.transfer(cells, lines)
        assert small is not None
        found, error = small
        assert (np.abs(found - transfer_conductances(cells, lines)[0]) <= error).all()
        assert (error < 1e-9 * found).all()
        np.testing.assert_allclose(found, transfer_conductances(cells, lines)[0], rtol=1e-12)


@pytest.mark.parametrize("decades", [0.0, 1.0, 3.0])
def test_the_bound_of_cholesky_holds_whatever_the_lines(decades: float) -> None:
    rng = np.random.default_rng(9)
    served = 0
    for _ in range(200):
        shape = tuple(rng.integers(1, 7, 2))
        lines, cells = lines_at_random(shape, rng, decades), 10 ** rng.uniform(-7, -4, shape)
        small = banded.transfer(cells, lines)
        if small is not None:
            served += 1
            found, error = small
            other, also = exact_by_dissection(cells, lines)
            assert (np.abs(found - other) <= error + also).all()
    assert served > 20


def test_small_grids_that_cholesky_would_spoil_are_left_to_dissection(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = Lines(np.full((4, 4), 1e9), np.full((4, 4), 1e9), np.full(4, 1e-9))
    cells = 10 ** np.random.default_rng(5).uniform(-12, 0, (4, 4))
    assert banded.transfer(cells, lines) is None
    found, error = exact_transfer(cells, lines)
    slow = slowly(cells, lines, monkeypatch)
    np.testing.assert_allclose(found, slow, rtol=1e-12)
    assert (np.abs(found - slow) <= error).all()


@pytest.mark.parametrize("shape", [(2, 2), (7, 5), (12, 12)])
def test_frames_together_are_frames_alone(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(6)
    lines, cells = lines_at_random(shape, rng), 10 ** rng.uniform(-6, -3, (17, *shape))
    together = transfer_conductances(cells, lines)[0]
    for frame, alone in zip(together, cells, strict=True):
        np.testing.assert_allclose(frame, transfer_conductances(alone, lines)[0], rtol=1e-13)


def test_scratch_memory_never_leaks_into_results() -> None:
    rng = np.random.default_rng(7)
    lines = lines_at_random((24, 24), rng)
    first_cells, second_cells = 10 ** rng.uniform(-6, -3, (2, 24, 24))
    first = transfer_conductances(first_cells, lines)[0]
    kept = first.copy()
    transfer_conductances(second_cells, lines)
    port_conductances(np.zeros((24, 24)), lines)
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(transfer_conductances(first_cells, lines)[0], kept)


@settings(deadline=None, max_examples=30)
@given(
    hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=14),
    st.integers(0, 2**32 - 1),
    st.lists(st.sampled_from([0.0, 0.01, 0.2, 1.0]), min_size=1, max_size=5),
)
def test_a_tree_follows_its_cells(shape: tuple[int, int], seed: int, shares: list[float]) -> None:
    rng = np.random.default_rng(seed)
    lines, cells = lines_at_random(shape, rng), 10 ** rng.uniform(-6, -3, shape)
    tree = Stream(lines)
    tree.transfer(cells)[0]
    for share in shares:
        change = rng.random(shape) < share
        cells = np.where(change, rng.choice([0.0, 1e-5, 1e-2], shape), cells)
        np.testing.assert_allclose(tree.transfer(cells)[0], transfer_conductances(cells, lines)[0], rtol=1e-12)


def test_a_tree_follows_shorts_that_move_all_ideal_wires() -> None:
    rng = np.random.default_rng(8)
    lines, cells = lines_at_random((9, 10), rng), 10 ** rng.uniform(-6, -3, (9, 10))
    lines.row[2, 3], lines.column[4, 4] = np.inf, 0.0
    tree = Stream(lines)
    for value in (1e-4, np.inf, 0.0, 50.0):
        cells[3, 3] = value
        np.testing.assert_allclose(tree.transfer(cells)[0], transfer_conductances(cells, lines)[0], rtol=1e-12)


@given(st.integers(1, 300), st.integers(1, 300))
def test_plans_cover_each_crosspoint_once_and_little_else(rows: int, columns: int) -> None:
    work = plan(rows, columns)
    for length, leaf, count in [(rows, work.leaf.rows, work.down), (columns, work.leaf.columns, work.along)]:
        assert count & (count - 1) == 0
        assert length <= leaf * count < length + count
    whole = work.merges[-1].whole if work.merges else work.leaf
    assert (whole.rows, whole.columns) == (work.leaf.rows * work.down, work.leaf.columns * work.along)
