"""The continuous sheet: its limits, its symmetries, and how far its cells couple."""

from __future__ import annotations

import numpy as np
import pytest
from designs import amplifier

from ohmskin.circuits import Design, Sheet, scan


def in_one_piece(design: Design, **sheet: float) -> Design:
    array = design.array.replace(sheet="continuous")
    return design.replace(array=array, sheet=Sheet(**sheet))


def boxes_one_by_one(sheet: Sheet, resistivity: np.ndarray) -> np.ndarray:
    """Port conductances for ohm m of each cell, by the nodal matrix of all boxes, each branch by Ohm's law."""
    rows, columns = resistivity.shape
    cut, layers, side = sheet.divisions, sheet.layers, sheet.pitch / sheet.divisions
    height = sheet.thickness / layers
    count = rows + columns
    laplacian = np.zeros((count + layers * rows * cut * columns * cut,) * 2)

    def node(layer: int, y: int, x: int) -> int:
        return count + (layer * rows * cut + y) * columns * cut + x

    def join(a: int, b: int, ohms: float) -> None:
        laplacian[[a, b], [a, b]] += 1 / ohms
        laplacian[[a, b], [b, a]] -= 1 / ohms

    margin = (sheet.pitch - sheet.electrode_width) / 2
    for layer, y, x in np.ndindex(layers, rows * cut, columns * cut):
        here = resistivity[y // cut, x // cut]
        for to, length, area in (
            ((layer + 1, y, x), height, side**2),
            ((layer, y + 1, x), side, side * height),
            ((layer, y, x + 1), side, side * height),
        ):
            if to[0] < layers and to[1] < rows * cut and to[2] < columns * cut:
                there = resistivity[to[1] // cut, to[2] // cut]
                join(node(layer, y, x), node(*to), (here + there) / 2 * length / area)
        for strip, at, line in ((0, y, y // cut), (1, x, rows + x // cut)):
            covered = margin <= (at % cut) * side + 1e-12 and (at % cut + 1) * side <= sheet.pitch - margin + 1e-12
            if covered and layer == (0, layers - 1)[strip]:
                join(node(layer, y, x), line, here * height / 2 / side**2)
    inner = np.linalg.solve(laplacian[count:, count:], laplacian[count:, :count])
    expected = laplacian[:count, count:] @ inner - laplacian[:count, :count]
    np.fill_diagonal(expected, 0.0)
    return expected


@pytest.mark.parametrize(("shape", "layers"), [((1, 1), 2), ((1, 3), 1), ((3, 2), 2)])
def test_pieces_joined_by_their_faces_are_the_whole_sheet(shape: tuple[int, int], layers: int) -> None:
    design = in_one_piece(amplifier(*shape), divisions=4, layers=layers, electrode_width=0.0127)
    cells = 10 ** np.random.default_rng(7).uniform(3, 5, shape)
    free = boxes_one_by_one(design.sheet, np.ones((1, 1)))[0, 1]  # S of a cell of 1 ohm m, cut free
    expected = boxes_one_by_one(design.sheet, cells * free)[: shape[0], shape[0] :]
    np.testing.assert_allclose(scan(design, cells).volts / 1000.0, expected, rtol=1e-9)


def test_a_pitch_alone_that_is_below_the_usual_strip_asks_for_the_strip() -> None:
    with pytest.raises(
        ValueError, match=r"electrode_width 0.01905 m \(left out; name it as well\) exceeds the pitch 0.006 m"
    ):
        Sheet(pitch=0.006)
    with pytest.raises(ValueError, match=r"electrode_width 0.007 m exceeds the pitch 0.006 m"):
        Sheet(pitch=0.006, electrode_width=0.007)


def test_a_uniform_sheet_reads_the_same_sliced_or_not() -> None:
    """Of two neighbouring rows' potentials the even part drives nothing sideways, and the odd part drives as much into
    a column as out of it; so with ideal lines every cell reads its own.
    """
    cells = np.full((3, 4), 8e3)
    np.testing.assert_allclose(scan(in_one_piece(amplifier(3, 4)), cells).resistance, cells, rtol=1e-12)


def test_slicing_isolates_and_the_continuous_sheet_couples_the_nearest_cells_most() -> None:
    cells = np.full((5, 5), 1e4)
    pressed = cells.copy()
    pressed[2, 2] = 2e4
    sliced = amplifier(5, 5)
    change = scan(in_one_piece(sliced), pressed).resistance / cells - 1
    np.testing.assert_allclose(scan(sliced, pressed).resistance, pressed, rtol=1e-12)
    beside, across, far = change[2, 3], change[3, 3], change[2, 4]
    assert 1e-4 < beside < 1e-2
    assert abs(across) < beside
    assert abs(far) < 1e-3 * beside
    np.testing.assert_allclose(change, change.T, atol=1e-12)
    np.testing.assert_allclose(change, change[::-1, ::-1], atol=1e-12)


def test_finer_boxes_change_little() -> None:
    """Order one at the strips' edges, where the field is singular: stated in the docs as 10 %."""
    pressed = np.full((2, 3), 1e4)
    pressed[0, 1] = 3e4
    beside = [
        scan(in_one_piece(amplifier(2, 3), divisions=cut, layers=cut // 4), pressed).resistance[0, 0] / 1e4 - 1
        for cut in (8, 16)
    ]
    assert beside[0] == pytest.approx(beside[1], rel=0.1)


def test_holes_and_metal_in_the_sheet_leave_no_stray_numbers() -> None:
    cells = np.full((3, 3), 1e4)
    cells[0, 0], cells[2, 1] = np.inf, 0.0
    cells[1] = np.inf
    design = in_one_piece(amplifier(3, 3, lead=5.0, segment=1.0, open_loop_gain=1e5))
    volts = scan(design, cells).volts
    assert np.isfinite(volts).all()
    assert (volts >= 0).all()
    assert volts[2, 1] > 50 * volts[2, 0]
    assert volts[0, 0] < 0.1 * volts[0, 1]
