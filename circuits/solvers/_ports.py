"""The passive grid reduced to its ports.

Whatever reads the grid sees it only through N row terminals and M column terminals. This module replaces the
grid by the equivalent network between those N + M ports, a symmetric matrix of nonnegative *port conductances*;
drive, amplifiers, dividers and ADC are then a small dense problem (:mod:`._readout`). Where only the current from
each row into each column is wanted (:func:`transfer_conductances`), the rest of the last merge is left out.

All of it is positive arithmetic (:mod:`._elimination`), so an ideal wire can be a very large finite conductance without
loss, and an open cell is a zero. Grids whose lines have resistance are dissected (:mod:`._dissection`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...arrays import FloatArray
from ._dissection import Tree, dissect
from ._elimination import ULP, Rounded, eliminate_leading

IDEAL_WIRE = 1e40  # conductance of 0 ohm, relative to the largest one it must outdo; leaks are below any rounding
LARGEST_PART = 1e14  # S that a part outside the grid (load, lead, Rref/(1 + A)) is taken to have at most
_AS_GOOD_AS_SHORT = 1e200  # S


@dataclass(frozen=True)
class Lines:
    """Series conductances along the lines, in S; ``inf`` is an ideal wire, 0 a break.

    ``row`` (rows, columns): ``row[i, 0]`` is the lead of row i, ``row[i, j]`` its segment from crosspoint j-1 to j.
    ``column`` (rows, columns): ``column[i, j]`` is the segment of column j from row i-1 to i; ``column[0]`` is unused.
    ``exit`` (columns,): between the last crosspoint of each column and its terminal; None is an ideal wire.
    """

    row: FloatArray
    column: FloatArray
    exit: FloatArray | None = None


def port_conductances(conductance: FloatArray, lines: Lines) -> Rounded:
    """Reduce grids to their ports.

    Args:
        conductance: (..., rows, columns) S of the cells, >= 0; inf is a short.
        lines: the wires, common to all grids of the batch.

    Returns:
        (..., N + M, N + M) S between the N row terminals (ahead of their leads) and the M column terminals (behind
        their exits), zero on the diagonal; and the relative error (...,) of each network's conductances.

    """
    *batch, rows, columns = conductance.shape
    ports, relative = _ports(conductance.reshape(-1, rows, columns), lines, transfer_only=False)
    return Rounded(ports.reshape(*batch, rows + columns, rows + columns), relative.reshape(batch))


def transfer_conductances(conductance: FloatArray, lines: Lines) -> Rounded:
    """The block between rows and columns of :func:`port_conductances`, at a fraction of the work.

    Returns:
        (..., N, M) S: the current into each column terminal for 1 V at each row terminal, all other terminals at
        ground; and the relative error (...,) of each network's conductances.

    """
    *batch, rows, columns = conductance.shape
    transfer, relative = _ports(conductance.reshape(-1, rows, columns), lines, transfer_only=True)
    return Rounded(transfer.reshape(*batch, rows, columns), relative.reshape(batch))


class Stream:
    """:func:`transfer_conductances` of one grid whose cells change from frame to frame: only the blocks of the
    dissection on the way from a changed cell to the whole grid are merged again.
    """

    def __init__(self, lines: Lines) -> None:
        self._lines = lines
        self._tree = Tree(*lines.row.shape)

    def transfer(self, conductance: FloatArray) -> Rounded:
        """As :func:`transfer_conductances`, for a frame (N, M) of cells in S."""
        transfer, relative = self._tree.transfer(*_turned(conductance[None], self._lines))
        return Rounded(transfer[0, ::-1, ::-1].copy(), relative[0])


def _ports(conductance: FloatArray, lines: Lines, *, transfer_only: bool) -> Rounded:
    """(frames, N + M, N + M), or (frames, N, M) with ``transfer_only``, and relative rounding errors (frames,)."""
    rows = conductance.shape[1]
    if has_ideal_lines(lines):
        network, relative = _ideal_lines(*_capped(conductance, lines), lines.exit)
        return Rounded(network[:, :rows, rows:] if transfer_only else network, relative)
    network, relative = dissect(*_turned(conductance, lines), transfer_only)
    return Rounded(network[:, ::-1, ::-1], relative)


def _turned(conductance: FloatArray, lines: Lines) -> tuple[FloatArray, FloatArray, FloatArray]:
    """:func:`_capped`, turned over: the columns' terminals at the top."""
    cells, row, column = _capped(conductance, lines)
    return cells[:, ::-1], row[::-1], column


def has_ideal_lines(lines: Lines) -> bool:
    """Whether no line has any resistance between its crosspoints."""
    return bool(np.isinf(lines.row[:, 1:]).all() and np.isinf(lines.column[1:]).all())


def _capped(conductance: FloatArray, lines: Lines) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Cells, row lines and column lines (from the exits backwards) with large numbers in place of infinite ones."""
    exits = np.full(conductance.shape[-1], np.inf) if lines.exit is None else lines.exit
    column = np.concatenate([exits[None], lines.column[:0:-1]])
    parts = conductance, lines.row, column
    largest = [float(part.max(initial=0.0)) for part in parts]
    short = IDEAL_WIRE * max(_largest_finite(part, most) for part, most in zip(parts, largest, strict=True))
    wire = IDEAL_WIRE * short  # an ideal line holds its potential even across a shorted cell
    limits = zip(parts, largest, (short, wire, wire), strict=True)
    cells, row, column = (np.minimum(part, limit) if most > limit else part for part, most, limit in limits)
    return cells, row, column


def _ideal_lines(cells: FloatArray, row: FloatArray, column: FloatArray, exits: FloatArray | None) -> Rounded:
    """Ports of grids without segment resistance: each line is one node, and only leads and exits are eliminated.

    Rows are eliminated in closed form, since a row meets columns only. ``exits`` (columns,) tells which are ideal.
    """
    frames, rows, columns = cells.shape
    lead, ended = row[:, 0], np.zeros(columns, dtype=np.bool_) if exits is None else np.isfinite(exits)
    total = lead + cells.sum(axis=-1)
    total[total == 0] = 1.0
    share = cells / total[..., None]
    near, far = rows + np.flatnonzero(ended), rows + columns + np.arange(ended.sum())
    both = rows + columns + len(far)
    network = np.zeros((frames, both, both))
    middle = slice(rows, rows + columns)
    network[:, :rows, middle] = lead[:, None] * share
    network[:, middle, :rows] = np.swapaxes(network[:, :rows, middle], 1, 2)
    network[:, middle, middle] = np.swapaxes(cells, 1, 2) @ share
    np.einsum("...ii->...i", network)[...] = 0.0
    network[:, far, near] = network[:, near, far] = column[0, ended]
    stay = np.arange(rows + columns)
    stay[near] = far
    order = np.concatenate([near, stay])
    # A row's conductances: a sum over its columns, a quotient and a product; then a sum over the rows.
    relative = np.full(frames, ULP * (rows + columns + 4.0))
    if not len(near):
        return Rounded(network, relative)
    network, eliminated = eliminate_leading(network[:, order[:, None], order], len(near))
    return Rounded(network, relative + eliminated)


def _largest_finite(values: FloatArray, most: float) -> float:
    """At least :data:`LARGEST_PART`; conductances above 1e200 S are as good as shorts."""
    if most < _AS_GOOD_AS_SHORT:
        return max(most, LARGEST_PART)
    return float(np.max(values, where=values < _AS_GOOD_AS_SHORT, initial=LARGEST_PART))
