"""The reduction to ports: by Cholesky factorisation, by dissection and by a dense solve, and the rounding bounds."""

from __future__ import annotations

import numpy as np
import pytest

from ohmskin.circuits.solvers import Lines, exact_transfer, port_conductances

SHAPES = [(1, 1), (1, 7), (6, 1), (4, 5), (5, 5), (3, 11), (8, 8), (13, 18), (20, 17), (33, 9), (36, 40)]


def lines_at_random(shape: tuple[int, int], rng: np.random.Generator, decades: float = 1.0) -> Lines:
    row, column = (10 ** rng.uniform(-decades, decades, shape) for _ in range(2))
    return Lines(row, column, 10 ** rng.uniform(-decades, decades, shape[1]))


@pytest.mark.parametrize("decades", [1.0, 6.0])
@pytest.mark.parametrize("shape", SHAPES)
def test_transfer_is_the_rows_by_columns_part_of_the_ports(shape: tuple[int, int], decades: float) -> None:
    rng = np.random.default_rng(1)
    lines, cells = lines_at_random(shape, rng, decades), 10 ** rng.uniform(-12, 0, shape)
    whole, relative = port_conductances(cells, lines)
    transfer, error = exact_transfer(cells, lines)
    np.testing.assert_allclose(transfer, whole[: shape[0], shape[0] :], rtol=1e-12, atol=error.max())
    assert 1e-15 < relative < 1e-9


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


@pytest.mark.parametrize("decades", [0.0, 1.0, 3.0])
def test_a_small_frame_alone_and_in_a_batch_agree_within_both_bounds(decades: float) -> None:
    """Alone by Cholesky factorisation where its bound allows, in a batch by dissection."""
    rng = np.random.default_rng(9)
    for _ in range(100):
        shape = tuple(rng.integers(1, 14, 2))
        lines, cells = lines_at_random(shape, rng, decades), 10 ** rng.uniform(-7, -4, shape)
        (alone, error), (batch, also) = exact_transfer(cells, lines), exact_transfer(cells[None], lines)
        assert (np.abs(alone - batch[0]) <= error + also[0]).all()
        assert (error < 1e-9 * alone.max()).all()


@pytest.mark.parametrize("shape", [(2, 2), (7, 5), (24, 24)])
def test_frames_together_are_frames_alone_and_scratch_memory_never_leaks(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(6)
    lines, cells = lines_at_random(shape, rng), 10 ** rng.uniform(-6, -3, (7, *shape))
    together = exact_transfer(cells, lines)[0]
    kept = together.copy()
    port_conductances(np.zeros(shape), lines)
    for frame, alone in zip(together, cells, strict=True):
        np.testing.assert_allclose(frame, exact_transfer(alone[None], lines)[0][0], rtol=1e-13)
    np.testing.assert_array_equal(together, kept)
