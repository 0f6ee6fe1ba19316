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
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .design import Sheet
from .network import Network, reduce
from .parts import siemens

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


def branches(
    sheet: Sheet, resistivity: FloatArray, row_node: IntArray, column_node: IntArray, first_box: int
) -> tuple[FloatArray, IntArray, FloatArray]:
    """The material as branches: places of its boxes (boxes, 2), ends (branches, 2) and S (..., branches).

    Args:
        sheet: the geometry.
        resistivity: (..., rows, columns) ohm m of each cell's part of the sheet; inf is void, 0 metal.
        row_node: (rows, columns) nodes of the crosspoints.
        column_node: the same of the column lines.
        first_box: number of the first box's node; the others follow.

    """
    *_, rows, columns = resistivity.shape
    cut, layers = sheet.divisions, sheet.layers
    per_box = np.repeat(np.repeat(resistivity, cut, axis=-2), cut, axis=-1)[..., None, :, :]
    per_box = np.broadcast_to(per_box, (*per_box.shape[:-3], layers, rows * cut, columns * cut))
    box = first_box + np.arange(layers * rows * cut * columns * cut).reshape(layers, rows * cut, columns * cut)
    side, height = sheet.pitch / cut, sheet.thickness / layers

    ends: list[IntArray] = []
    values: list[FloatArray] = []

    def join(a: IntArray, b: IntArray, ohms: FloatArray) -> None:
        ends.append(np.stack([a.ravel(), b.ravel()], axis=-1))
        values.append(siemens(ohms.reshape(*ohms.shape[: ohms.ndim - a.ndim], a.size)))

    for axis, length, area in ((-3, height, side * side), (-2, side, side * height), (-1, side, side * height)):
        count = box.shape[axis]
        low, high = np.arange(count - 1), np.arange(1, count)
        both = per_box.take(low, axis=axis) + per_box.take(high, axis=axis)
        join(box.take(low, axis=axis), box.take(high, axis=axis), both * (length / area / 2))
    covered = _covered(sheet)
    for nodes, layer, share in (
        (row_node, 0, np.tile(covered, rows)[:, None] * np.ones(columns * cut)),
        (column_node, layers - 1, np.ones(rows * cut)[:, None] * np.tile(covered, columns)),
    ):
        above = np.repeat(np.repeat(nodes, cut, axis=0), cut, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            ohms = per_box[..., layer, :, :] * (height / 2 / side**2) / share
        join(above, box[layer], np.where(share > 0, ohms, np.inf))
    row_at, column_at = np.divmod(np.arange(rows * cut * columns * cut), columns * cut)
    place = np.tile(np.column_stack([row_at, column_at]) / cut - 0.5 + 0.5 / cut, (layers, 1))
    return place, np.concatenate(ends), np.concatenate(values, axis=-1)


@lru_cache(maxsize=16)
def unit_resistance(sheet: Sheet) -> float:
    """Ohm of one free cell of 1 ohm m."""
    row, column = np.array([[0]]), np.array([[1]])
    place, ends, conductance = branches(sheet, np.ones((1, 1)), row, column, 2)
    network = Network(
        place=np.concatenate([np.zeros((2, 2)), place]),
        ends=ends,
        conductance=conductance,
        wire=np.zeros(len(ends), dtype=np.bool_),
        ports=np.array([0, 1]),
    )
    return float(1.0 / reduce(network)[0, 1])


def _covered(sheet: Sheet) -> FloatArray:
    """Which share of each division along a cell's side lies under a strip."""
    edges = np.linspace(-0.5, 0.5, sheet.divisions + 1) * sheet.pitch
    half = sheet.electrode_width / 2
    overlap = np.minimum(edges[1:], half) - np.maximum(edges[:-1], -half)
    share: FloatArray = np.maximum(overlap, 0.0) / (sheet.pitch / sheet.divisions)
    return share
