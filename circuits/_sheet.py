"""The continuous (unsliced) sheet: conduction through the material between the cells (paper, VI and figure 12).

A small three-dimensional resistor model. The sheet is cut into boxes, ``divisions`` along each side of a cell and
``layers`` through its thickness; a box is joined to its six neighbours by its resistivity (half a box each, in
series). Row strips lie on its top, column strips on its bottom, both of ``electrode_width``, and touch the boxes
that they cover; where a strip is, its crosspoint's node is.

Modelled: lateral conduction in the material, also from strip to strip on one face, and fringes beside the strips.
Not modelled: contact resistance between strip and material, current along the strip inside one cell (strips have
their segments between the cells), a resistivity that varies inside a cell or with direction.

A cell's resistance means the same as in the sliced sheet: its own piece, cut free on all four sides. The resistivity
of its part of the sheet follows from that, so that slicing is the only difference between the two.

All cells are the same piece of material but for its resistivity. So one piece is reduced, once and for good, to its two
strips and to the boxes' faces on its sides; a frame then only joins such pieces, each divided by its resistivity.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..arrays import FloatArray, IntArray
from .solvers import Element, Network, Rounded, reduce, siemens

if TYPE_CHECKING:
    from ._design import Sheet


class Sides(NamedTuple):
    """Which sides of a cell go on into a neighbour."""

    left: bool = False
    right: bool = False
    up: bool = False
    down: bool = False


def pieces(
    sheet: Sheet, resistance: FloatArray, row_node: IntArray, column_node: IntArray, first_face: int
) -> tuple[FloatArray, tuple[Element, ...]]:
    """The material as elements: places of the faces between cells (faces, 2), and one element per cell.

    Args:
        sheet: the geometry.
        resistance: (..., rows, columns) ohm of the cells, each cut free; inf is void, 0 metal.
        row_node: (rows, columns) nodes of the crosspoints.
        column_node: the same of the column lines.
        first_face: number of the first face's node; the others follow.

    """
    *_, rows, columns = resistance.shape
    each = sheet.divisions * sheet.layers
    beside = first_face + np.arange(rows * (columns - 1) * each).reshape(rows, columns - 1, each)
    below = first_face + beside.size + np.arange((rows - 1) * columns * each).reshape(rows - 1, columns, each)
    place = np.concatenate([_middles(rows, columns - 1, each, 0.0, 0.5), _middles(rows - 1, columns, each, 0.5, 0.0)])
    scale, free = siemens(resistance / unit_resistance(sheet)), _unit(sheet, Sides())
    elements = []
    for row in range(rows):
        for column in range(columns):
            sides = Sides(column > 0, column < columns - 1, row > 0, row < rows - 1)
            nodes = [np.array([row_node[row, column], column_node[row, column]])]
            nodes += [beside[row, column - 1]] if sides.left else []
            nodes += [beside[row, column]] if sides.right else []
            nodes += [below[row - 1, column]] if sides.up else []
            nodes += [below[row, column]] if sides.down else []
            (unit, rounded), here = _unit(sheet, sides), scale[..., row, column, None, None]
            with np.errstate(invalid="ignore"):
                between = np.where(unit > 0, unit * here, 0.0)
            elements.append(Element(np.concatenate(nodes), between, float(rounded + free.relative)))
    return place, tuple(elements)


@lru_cache(maxsize=16)
def unit_resistance(sheet: Sheet) -> float:
    """Ohm of one free cell of 1 ohm m."""
    return float(1.0 / _unit(sheet, Sides()).value[0, 1])


def _middles(rows: int, columns: int, each: int, down: float, along: float) -> FloatArray:
    row_at, column_at = np.indices((rows, columns)).reshape(2, -1)
    return np.repeat(np.column_stack([row_at + down, column_at + along]), each, axis=0)


@lru_cache(maxsize=64)
def _unit(sheet: Sheet, sides: Sides) -> Rounded:
    """S between the strips of row and column and the open faces, side by side, of one cell of 1 ohm m."""
    cut, layers = sheet.divisions, sheet.layers
    side, height = sheet.pitch / cut, sheet.thickness / layers
    box = 2 + np.arange(layers * cut * cut).reshape(layers, cut, cut)
    row, column = np.zeros((cut, cut), dtype=np.intp), np.ones((cut, cut), dtype=np.intp)
    share = np.broadcast_to(_covered(sheet), (cut, cut))
    joined: list[tuple[IntArray, IntArray, FloatArray | float]] = [
        (box[:-1], box[1:], side * side / height),
        (box[:, :-1], box[:, 1:], height),  # a face of side x height, over one side
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


def _covered(sheet: Sheet) -> FloatArray:
    """Which share of each division along a cell's side lies under a strip."""
    edges = np.linspace(-0.5, 0.5, sheet.divisions + 1) * sheet.pitch
    half = sheet.electrode_width / 2
    overlap = np.minimum(edges[1:], half) - np.maximum(edges[:-1], -half)
    share: FloatArray = np.maximum(overlap, 0.0) / (sheet.pitch / sheet.divisions)
    return share
