"""3-D resistor network of the continuous (unsliced) sheet by finite volumes (paper, section VI and figure 12).

Discretisation
--------------
The sheet is cut into boxes: ``divisions`` along each side of a cell, and ``layers`` through the thickness. Each box has
one node at its centre. Neighbouring boxes are joined through their common face by the resistance of two half boxes in
series. Row strips lie on the top of the sheet and column strips on its bottom. Both have the width
``electrode_width``. A strip is joined to the boxes that it covers, and it is the node of its crosspoint.

Modelled: lateral conduction in the material, also between strips on the same face, and fringing fields beside the
strips.

Not modelled: contact resistance between strip and material, current along a strip inside a cell (strips have their
segments between the cells), and a resistivity that varies inside a cell or with direction.

Meaning of a cell's resistance
------------------------------
The resistance of a cell is that of its own piece of sheet, cut free on all four sides, as in the sliced sheet. The
resistivity of the piece follows from this resistance. Slicing is thus the only difference between the two sheets.

Substructuring
--------------
All cells have the same geometry and differ only in resistivity. The network of one piece is therefore reduced once to
its ports (static condensation, Kron reduction). The ports are the two strips and the faces towards neighbours. A frame
then joins these reduced pieces, each scaled by the inverse of its resistivity.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..common.arrays import FloatArray, IntArray
from ._sections import Sheet
from .solvers import Element, Network, Rounded, reduce, siemens


class Sides(NamedTuple):
    """True for each side of a cell that borders on another cell."""

    left: bool = False
    right: bool = False
    up: bool = False
    down: bool = False


def pieces(
    sheet: Sheet, resistance: FloatArray, row_node: IntArray, column_node: IntArray, first_face: int
) -> tuple[FloatArray, tuple[Element, ...]]:
    """The material as one network element per cell.

    Args:
        sheet: the geometry.
        resistance: (..., rows, columns) ohm of the cells, each cut free; inf is an insulator, 0 a perfect conductor.
        row_node: (rows, columns) nodes of the crosspoints.
        column_node: (rows, columns) nodes of the crosspoints on the column lines.
        first_face: number of the first face's node; the nodes of the other faces follow.

    Returns:
        Places (faces, 2) of the faces between cells, as row and column; and the elements.

    """
    *_, rows, columns = resistance.shape
    each = sheet.divisions * sheet.layers
    beside = first_face + np.arange(rows * (columns - 1) * each).reshape(rows, columns - 1, each)
    below = first_face + beside.size + np.arange((rows - 1) * columns * each).reshape(rows - 1, columns, each)
    place = np.concatenate(
        [_face_places(rows, columns - 1, each, 0.0, 0.5), _face_places(rows - 1, columns, each, 0.5, 0.0)]
    )
    scale, free = siemens(resistance / unit_resistance(sheet)), _reduced_piece(sheet, Sides())
    elements = []
    for row in range(rows):
        for column in range(columns):
            sides = Sides(column > 0, column < columns - 1, row > 0, row < rows - 1)
            nodes = [np.array([row_node[row, column], column_node[row, column]])]
            nodes += [beside[row, column - 1]] if sides.left else []
            nodes += [beside[row, column]] if sides.right else []
            nodes += [below[row - 1, column]] if sides.up else []
            nodes += [below[row, column]] if sides.down else []
            (unit, rounded), here = _reduced_piece(sheet, sides), scale[..., row, column, None, None]
            with np.errstate(invalid="ignore"):
                between = np.where(unit > 0, unit * here, 0.0)
            elements.append(Element(np.concatenate(nodes), between, float(rounded + free.relative)))
    return place, tuple(elements)


@lru_cache(maxsize=16)
def unit_resistance(sheet: Sheet) -> float:
    """Resistance in ohm of one free cell whose material has 1 ohm m."""
    return float(1.0 / _reduced_piece(sheet, Sides()).value[0, 1])


def _face_places(rows: int, columns: int, each: int, down: float, along: float) -> FloatArray:
    """Places (faces, 2) of the faces: ``each`` times the cell's row + ``down`` and column + ``along``."""
    row_at, column_at = np.indices((rows, columns)).reshape(2, -1)
    return np.repeat(np.column_stack([row_at + down, column_at + along]), each, axis=0)


@lru_cache(maxsize=64)
def _reduced_piece(sheet: Sheet, sides: Sides) -> Rounded:
    """Conductance matrix in S of one cell of 1 ohm m, reduced to its ports.

    The ports are the row strip, the column strip, and the faces of each side in ``sides``, in this order.
    """
    cut, layers = sheet.divisions, sheet.layers
    side, height = sheet.pitch / cut, sheet.thickness / layers
    box = 2 + np.arange(layers * cut * cut).reshape(layers, cut, cut)
    row, column = np.zeros((cut, cut), dtype=np.intp), np.ones((cut, cut), dtype=np.intp)
    share = np.broadcast_to(_covered_fraction(sheet), (cut, cut))
    joined: list[tuple[IntArray, IntArray, FloatArray | float]] = [
        (box[:-1], box[1:], side * side / height),
        (box[:, :-1], box[:, 1:], height),  # area side x height, distance side
        (box[..., :-1], box[..., 1:], height),
        (row, box[0], share.T * 2 * side * side / height),
        (column, box[-1], share * 2 * side * side / height),
    ]
    ports = [np.array([0, 1])]
    count = 2 + box.size
    for wanted, rim in zip(sides, (box[..., 0], box[..., -1], box[:, 0], box[:, -1]), strict=True):
        if wanted:
            face = count + np.arange(rim.size)
            joined.append((face, rim.ravel(), 2 * height))
            ports.append(face)
            count += rim.size
    ends = [np.column_stack([a.ravel(), b.ravel()]) for a, b, _ in joined]
    values = [np.broadcast_to(value, a.shape).ravel() for a, _, value in joined]
    layer_at, row_at, column_at = np.indices(box.shape).reshape(3, -1)
    place = np.zeros((count, 3))
    place[box.ravel()] = np.column_stack([layer_at, row_at, column_at])
    for a, b, _ in joined[5:]:
        place[a] = place[b]
    conductance = np.concatenate(values)
    network = Network(
        place=place,
        ends=np.concatenate(ends),
        conductance=conductance,
        wire=np.zeros(len(conductance), dtype=np.bool_),
        ports=np.concatenate(ports),
    )
    unit = reduce(network)
    unit.value.flags.writeable = False
    return unit


def _covered_fraction(sheet: Sheet) -> FloatArray:
    """Fraction (divisions,) of each division along a cell's side that a strip covers."""
    edges = np.linspace(-0.5, 0.5, sheet.divisions + 1) * sheet.pitch
    half = sheet.electrode_width / 2
    overlap = np.minimum(edges[1:], half) - np.maximum(edges[:-1], -half)
    share: FloatArray = np.maximum(overlap, 0.0) / (sheet.pitch / sheet.divisions)
    return share
