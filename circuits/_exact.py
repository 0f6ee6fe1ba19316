"""The exact reading of frames: Kron reduction of the whole grid at once, and a bound on what rounding did to it.

Frames whose outputs are linear in the grid's transfer conductances need no more of the grid than those
(:func:`.solvers.exact_transfer`). All others need the network between all ports.
"""

from __future__ import annotations

from math import isfinite

import numpy as np

from ..arrays import FloatArray
from ._board import Board
from ._grid import exact_ports, refuse_contradictions
from .readouts import Reading, few_ulp, sum_of_others
from .solvers import exact_transfer, series_conductance


def read_exactly(board: Board, cells: FloatArray) -> tuple[Reading, FloatArray]:
    """Outputs of frames of cells, and how far rounding can have moved each, in V.

    Args:
        board: what reads them.
        cells: (..., N, M) ohm, in line coordinates.

    """
    linear = board.linear
    if linear is None:
        return _read_ports(board, cells)
    if (cells == 0).any():
        refuse_contradictions(board, cells)
    transfer, off = exact_transfer(board.cell_conductance(cells), linear.lines)
    volts = linear.volts(transfer)
    error = linear.error(off, transfer)
    saturated = np.zeros(volts.shape, dtype=np.bool_)
    limited = ~linear.within_supply(volts, error)
    if limited.any():
        some, error[limited] = _read_ports(board, cells[limited])
        volts[limited], saturated[limited] = some.volts, some.saturated
    return Reading(volts, saturated), error


def _read_ports(board: Board, cells: FloatArray) -> tuple[Reading, FloatArray]:
    """By the whole network between the ports, for any circuit."""
    ports, relative = exact_ports(board, cells)
    reading = board.circuit.read(board, ports)
    few = few_ulp(reading.volts.shape)
    without_current = abs(board.level) + np.abs(board.offset) + np.abs(board.lift)
    moved = float(relative.max(initial=0.0)) + reading.relative + few
    return reading, _error(board, ports, moved) + few * (np.abs(reading.volts) + without_current)


def _error(board: Board, ports: FloatArray, relative: float) -> FloatArray:
    """V (..., N, M) by which a relative error of all conductances can have moved the outputs of any circuit.

    Every port's voltage takes part: a change e of all conductances changes the current at port i for 1 V at port j by
    at most e sqrt(Y_ii Y_jj) (:mod:`.solvers._elimination`).
    """
    behind = board.column_lead + board.circuit.end_resistance(board)
    rows = board.shape[0]
    total = ports.sum(axis=-1)[..., rows:]
    row = np.sqrt(_into_rows(ports, rows, behind))
    with np.errstate(divide="ignore"):
        column = np.sqrt(series_conductance(total, 1.0 / behind))
    limits = [abs(limit - board.level) for limit in board.supply if isfinite(limit)]
    others = np.maximum(np.abs(board.offset) + abs(board.level) * board.inverse_gain, max(limits, default=0.0))
    others += np.abs(board.lift)
    applied = abs(board.drive) * row[..., :, None] + (others * column).sum(axis=-1)[..., None, None]
    error: FloatArray = board.reference * relative * applied * column[..., None, :]
    return error


def _into_rows(ports: FloatArray, rows: int, behind: FloatArray) -> FloatArray:
    """Bounds (..., N) in S on the conductance of each row terminal, all others at ground, the columns behind so many
    ohm.

    By Dirichlet's principle any potentials of the column terminals give an upper bound. Each column terminal stands at
    the potential of the row or at ground, whichever costs less. So a short does not count more than what it leads to.
    """
    driven = ports[..., :rows, rows:]
    with np.errstate(divide="ignore"):
        beyond = ports[..., rows:, rows:].sum(axis=-1) + 1.0 / behind
    bound: FloatArray = ports[..., :rows, :rows].sum(axis=-1)
    bound += np.minimum(driven, sum_of_others(driven) + beyond[..., None, :]).sum(axis=-1)
    return bound
