"""Kron reduction (Schur complement) of the passive grid to its N + M ports.

A readout circuit is connected to the grid only at N row terminals and M column terminals, the *ports*. This module
replaces the grid by the equivalent network between the ports: a symmetric matrix of nonnegative *port conductances*.
The drive, amplifiers, dividers and ADC are then a small dense problem (:mod:`ohmskin.circuits.readouts`).

Most readouts need only the *transfer conductances*, the block of the matrix between rows and columns.
:func:`transfer_conductances` computes this block alone, which makes the last merge of the dissection much cheaper.

Grids whose lines have resistance are reduced by nested dissection (:mod:`._dissection`), grids with ideal lines in
closed form. Both use the positive arithmetic of :mod:`._elimination`, in which no digits cancel. An ideal wire can
therefore be a very large finite conductance, and an open cell is a zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ._dissection import dissect
from ._elimination import ULP, Rounded, eliminate_leading, inverted
from ._tuning import IDEAL_WIRE, LARGEST_PART, LEAST_OHM


@dataclass(frozen=True)
class Lines:
    """Series conductances of the wires along the lines, in S; ``inf`` is an ideal wire, 0 a break.

    ``row`` (rows, columns): ``row[i, 0]`` is the lead of row i, ``row[i, j]`` its segment from crosspoint j-1 to j.
    ``column`` (rows, columns): ``column[i, j]`` is the segment of column j from row i-1 to i; ``column[0]`` is unused.
    ``exit`` (columns,): wire between the last crosspoint of each column and its terminal; None if all are ideal.
    Lines of each grid of a batch of its own have its axis ahead.
    """

    row: FloatArray
    column: FloatArray
    exit: FloatArray | None = None


def port_conductances(conductance: FloatArray, lines: Lines) -> Rounded:
    """Kron reduction of grids to their ports.

    Args:
        conductance: (..., rows, columns) S of the cells, >= 0; inf is a short.
        lines: the wires, common to all grids of the batch, or of each.

    Returns:
        (..., N + M, N + M) S between the ports, zero on the diagonal, and a bound (...,) on the relative error of each
        network's conductances. The N row terminals, ahead of their leads, come first. The M column terminals, behind
        their exits, follow.

    """
    *batch, rows, columns = conductance.shape
    ports, relative = _ports(conductance.reshape(-1, rows, columns), lines, transfer_only=False)
    return Rounded(ports.reshape(*batch, rows + columns, rows + columns), relative.reshape(batch))


def transfer_conductances(conductance: FloatArray, lines: Lines) -> Rounded:
    """Block of :func:`port_conductances` between rows and columns, at a fraction of the cost. Arguments are the same.

    Returns:
        (..., N, M) S: the current into each column terminal for 1 V at each row terminal, all other terminals at
        ground; and a bound (...,) on the relative error of each network's conductances.

    """
    *batch, rows, columns = conductance.shape
    transfer, relative = _ports(conductance.reshape(-1, rows, columns), lines, transfer_only=True)
    return Rounded(transfer.reshape(*batch, rows, columns), relative.reshape(batch))


def _ports(conductance: FloatArray, lines: Lines, *, transfer_only: bool) -> Rounded:
    """Port conductances (frames, N + M, N + M) in S, or if ``transfer_only`` their (frames, N, M) transfer block."""
    if has_ideal_lines(lines):
        return (_ideal_transfer if transfer_only else _ideal_lines)(*capped(conductance, lines), lines.exit)
    network, relative = dissect(*_reversed_rows(conductance, lines), transfer_only)
    return Rounded(network[:, ::-1, ::-1], relative)


def _reversed_rows(conductance: FloatArray, lines: Lines) -> tuple[FloatArray, FloatArray, FloatArray]:
    """As :func:`capped`, rows in reverse order: nested dissection expects the columns' terminals at the top."""
    cells, row, column = capped(conductance, lines)
    return cells[:, ::-1], row[..., ::-1, :], column


def has_ideal_lines(lines: Lines) -> bool:
    """Whether all segments between crosspoints have zero resistance."""
    return bool(np.isinf(lines.row[..., 1:]).all() and np.isinf(lines.column[..., 1:, :]).all())


def capped(conductance: FloatArray, lines: Lines) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Replace infinite conductances by large finite ones.

    Returns:
        Conductances in S of the cells, of the rows' wires, and of the columns' wires in order from the exits.

    """
    exits = np.full_like(lines.column[..., 0, :], np.inf) if lines.exit is None else lines.exit
    column = np.concatenate([exits[..., None, :], lines.column[..., :0:-1, :]], axis=-2)
    parts = conductance, lines.row, column
    largest = [float(part.max(initial=0.0)) for part in parts]
    short = IDEAL_WIRE * max(_largest_finite(part, peak) for part, peak in zip(parts, largest, strict=True))
    wire = IDEAL_WIRE * short  # an ideal line holds its potential even across a shorted cell
    limits = zip(parts, largest, (short, wire, wire), strict=True)
    cells, row, column = (np.minimum(part, limit) if peak > limit else part for part, peak, limit in limits)
    return cells, row, column


def _ideal_lines(cells: FloatArray, row: FloatArray, column: FloatArray, exits: FloatArray | None) -> Rounded:
    """Port conductances of grids with ideal lines, each of which is one node.

    The nodes of rows are eliminated in closed form, because a row connects to its lead and to columns only. The nodes
    of columns with resistive exits are then eliminated by :func:`._elimination.eliminate_leading`. An infinite entry of
    ``exits`` (columns,) is an ideal wire.
    """
    frames, rows, columns = cells.shape
    to_rows, across, relative = _without_rows(cells, row)
    ended = _ended(exits, columns)
    near, far = rows + np.flatnonzero(ended), rows + columns + np.arange(ended.sum())
    both = rows + columns + len(far)
    network = np.zeros((frames, both, both))
    middle = slice(rows, rows + columns)
    network[:, :rows, middle] = to_rows
    network[:, middle, :rows] = np.swapaxes(to_rows, 1, 2)
    network[:, middle, middle] = across
    network[:, far, near] = network[:, near, far] = column[..., 0, :][..., ended]
    stay = np.arange(rows + columns)
    stay[near] = far
    order = np.concatenate([near, stay])
    if not len(near):
        return Rounded(network, relative)
    network, eliminated = eliminate_leading(network[:, order[:, None], order], len(near))
    return Rounded(network, relative + eliminated)


def _ideal_transfer(cells: FloatArray, row: FloatArray, column: FloatArray, exits: FloatArray | None) -> Rounded:
    """The block of :func:`_ideal_lines` between rows and columns alone, in half the time."""
    _, rows, columns = cells.shape
    to_rows, across, relative = _without_rows(cells, row)
    ended = _ended(exits, columns)
    if not ended.any():
        return Rounded(to_rows, relative)
    to_columns = np.where(ended, 0.0, across[:, ended])
    to_columns[:, np.arange(ended.sum()), np.flatnonzero(ended)] = column[..., 0, :][..., ended]
    near_to_rows = to_rows[..., ended]
    outside = near_to_rows.sum(axis=1) + to_columns.sum(axis=-1)
    inverse, eliminated = inverted(across[:, ended][..., ended], outside, rows + columns)
    transfer = near_to_rows @ (inverse @ to_columns)
    transfer += np.where(ended, 0.0, to_rows)
    return Rounded(transfer, relative + eliminated)


def _without_rows(cells: FloatArray, row: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Eliminate the nodes of rows with ideal lines, behind their leads.

    Returns:
        S from the rows' terminals to the columns (frames, N, M), between columns (frames, M, M), and a bound (frames,)
        on the relative rounding error of both: a sum over the columns of a row, a quotient, a product and a sum over
        the rows.

    """
    frames, rows, columns = cells.shape
    lead = row[..., 0]
    total = lead + cells.sum(axis=-1)
    total[total == 0] = 1.0
    share = cells / total[..., None]
    across = np.swapaxes(cells, 1, 2) @ share
    np.einsum("...ii->...i", across)[...] = 0.0
    return lead[..., None] * share, across, np.full(frames, ULP * (rows + columns + 4.0))


def _ended(exits: FloatArray | None, columns: int) -> BoolArray:
    """(columns,) whether a column has a resistive exit, in any grid."""
    exits = np.full((1, columns), np.inf) if exits is None else exits.reshape(-1, columns)
    return np.asarray(np.isfinite(exits).any(axis=0))


def _largest_finite(values: FloatArray, largest: float) -> float:
    """Largest conductance in S apart from shorts, at least :data:`LARGEST_PART`; ``largest`` is the largest value."""
    if largest < 1.0 / LEAST_OHM:
        return max(largest, LARGEST_PART)
    return float(np.max(values, where=values < 1.0 / LEAST_OHM, initial=LARGEST_PART))
