"""Models of one grid as machine code: star-mesh transforms and line attenuation agree with the array operations."""

from __future__ import annotations

import numpy as np
import pytest

from ohmskin.circuits.solvers import FrameTransfer, Lines, Wires, exact_transfer, port_conductances
from ohmskin.common import compiled
from ohmskin.common.arrays import FloatArray

CLOSE = 1e-11
SHAPES = ((1, 1), (1, 9), (9, 1), (8, 3), (3, 8), (5, 5), (12, 10))
LINES = ("ordinary", "no segments", "ideal rows", "ideal exits", "a broken row", "a broken column")

pytestmark = pytest.mark.skipif(compiled.why_not() is not None, reason="kernels are switched off")


def lines_of(kind: str, shape: tuple[int, int], draw: np.random.Generator) -> Lines:
    """Lines of 1 mohm to 1 kohm, each wire another resistance."""
    wire = 10.0 ** draw.uniform(-3, 3) * draw.uniform(0.1, 1.0, (2, *shape))
    row, column = 1.0 / wire
    exits: FloatArray = 1.0 / (10.0 ** draw.uniform(-3, 3, shape[1]))
    if kind == "no segments":
        row[:, 1:], column[1:] = np.inf, np.inf
    elif kind == "ideal rows":
        row[:] = np.inf
    elif kind == "ideal exits":
        exits[:] = np.inf
    elif kind == "a broken row":
        row[-1, shape[1] // 2] = 0.0
    elif kind == "a broken column":
        exits[shape[1] // 2] = 0.0
    return Lines(row, column, exits)


@pytest.mark.parametrize("kind", LINES)
@pytest.mark.parametrize("shape", SHAPES)
def test_star_mesh_transforms_give_the_exact_port_conductances(kind: str, shape: tuple[int, int]) -> None:
    draw = np.random.default_rng([*shape, len(kind)])
    for _ in range(4):
        lines = lines_of(kind, shape, draw)
        cells = 10.0 ** draw.uniform(-8, -1, shape)
        cells[draw.random(shape) < 0.1] = 0.0
        cells.flat[draw.integers(cells.size)] = draw.choice([np.inf, 1e-3])
        models = FrameTransfer(lines)
        assert models.is_compiled
        expected, _ = exact_transfer(cells, lines)
        np.testing.assert_allclose(models.exact(cells), expected, rtol=CLOSE, atol=1e-15 * expected.max())
        ports, _ = port_conductances(cells, lines)
        others = ~np.eye(len(ports), dtype=np.bool_)
        found = models.ports(cells)[others]
        np.testing.assert_allclose(found, ports[others], rtol=CLOSE, atol=1e-15 * ports[others].max(initial=0.0))


@pytest.mark.parametrize("kind", LINES)
@pytest.mark.parametrize("shape", SHAPES)
def test_attenuation_of_one_frame_is_that_of_ladders(kind: str, shape: tuple[int, int]) -> None:
    draw = np.random.default_rng([*shape, len(kind), 1])
    for _ in range(4):
        lines = lines_of(kind, shape, draw)
        cells = 10.0 ** draw.uniform(-8, -1, shape)
        wires, known = Wires.of(lines), FrameTransfer(lines).attenuated(cells)
        if wires is None:
            assert known is None
            continue
        assert known is not None
        with compiled.switched_off():
            expected = FrameTransfer(lines).attenuated(cells)
        assert expected is not None
        np.testing.assert_allclose(known.transfer, expected.transfer, rtol=CLOSE)
        np.testing.assert_allclose(known.error, expected.error, rtol=CLOSE)
        exact, rounding = exact_transfer(cells, lines)
        assert (np.abs(exact - known.transfer) <= known.error + rounding).all()


def test_a_drive_that_underflows_before_the_end_of_a_line_is_unknown() -> None:
    wire = np.full((2, 400), 1e-3)
    lines = Lines(wire, np.full((2, 400), 1.0), np.ones(400))
    assert FrameTransfer(lines).attenuated(np.full((2, 400), 1e3)) is None


def test_array_operations_do_the_same_without_machine_code() -> None:
    draw = np.random.default_rng(7)
    lines, cells = lines_of("ordinary", (4, 6), draw), 10.0 ** draw.uniform(-8, -2, (4, 6))
    quick = FrameTransfer(lines)
    with compiled.switched_off():
        slow = FrameTransfer(lines)
    assert quick.is_compiled
    assert not slow.is_compiled
    np.testing.assert_allclose(quick.exact(cells), slow.exact(cells), rtol=CLOSE)
    by_loop, by_arrays = quick.attenuated(cells), slow.attenuated(cells)
    assert by_loop is not None
    assert by_arrays is not None
    np.testing.assert_allclose(by_loop.transfer, by_arrays.transfer, rtol=CLOSE)
    np.testing.assert_allclose(by_loop.error, by_arrays.error, rtol=CLOSE)
