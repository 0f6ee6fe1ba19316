"""Derivatives of all readings by all cells, in instalments: the adjoint method with approximate fields.

A live recovery renews its derivatives while frames come in, and no frame may wait for all of them. The work is
therefore an iterator, of which each frame takes one instalment. The method is that of :mod:`.._sensitivity`, for the
cells alone. Where :class:`.QuickModel` gives the fields by nodal analysis of the ports, no digits are certified, and
the cost is low.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...common.arrays import FloatArray
from .._board import Board
from .._grid import exact_ports
from ._normal_matrix import PER_DERIVATIVE, Meter
from ._quick_model import QuickModel


def derivatives(board: Board, cells: FloatArray, model: QuickModel, meter: Meter, *, out: FloatArray) -> Iterator[None]:
    """Derivatives of the readings by the conductances of the crosspoints' branches.

    Args:
        board: with a sliced sheet and no complete short.
        cells: (N, M) ohm.
        model: of the board; its fast way to the derivatives is taken if there is one.
        meter: of the instalments.
        out: (N M, N M) V/S, written.

    Yields:
        After each instalment of the work but the last.

    """
    by_rows = model.derivatives(cells)
    if by_rows is not None:
        if meter.is_dear(model.branch_price(cells)):
            yield
        try:
            yield from _quick_derivatives(by_rows, meter, out)
        except np.linalg.LinAlgError:  # parts of the grid without a connection
            by_rows = None
    if by_rows is None:
        yield from _exact_derivatives(board, cells, model, meter, out)


def _quick_derivatives(by_rows: Iterator[FloatArray], meter: Meter, out: FloatArray) -> Iterator[None]:
    size, written = len(out), 0
    for some in by_rows:
        if meter.is_full(PER_DERIVATIVE * some.size):
            yield
        out[written : written + len(some)] = some.reshape(len(some), size)
        written += len(some)


def _exact_derivatives(
    board: Board, cells: FloatArray, model: QuickModel, meter: Meter, out: FloatArray
) -> Iterator[None]:
    ports = exact_ports(board, cells).value
    reading = board.circuit.read(board, ports)
    yield
    branches = model.branches(cells)
    rows, columns = board.shape
    result = out.reshape(rows, columns, rows, columns)
    yield
    for group in board.circuit.sensitivity_groups(board, ports, reading):
        if meter.is_full(PER_DERIVATIVE * group.forward[..., 0].size * cells.size):
            yield
        forward, adjoint = (
            branches.across(field.reshape(-1, field.shape[-1])).reshape(*field.shape[:-1], rows, columns)
            for field in (group.forward, group.adjoint)
        )
        result[np.ix_(group.rows, group.columns)] = -forward * adjoint
