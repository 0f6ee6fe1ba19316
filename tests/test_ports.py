"""The reduction of a grid to its ports: against a dense nodal solve, and frames together against frames alone."""

from __future__ import annotations

import numpy as np
import pytest

from ohmskin.circuits.solvers import Lines, exact_transfer, port_conductances

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
