"""Exact reading of frames by Kron reduction of the whole grid, with a bound on the rounding errors.

Frames whose outputs are linear in the grid's transfer conductances need only these conductances
(:func:`.solvers.exact_transfer`). All other frames need the network between all ports.
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import numpy as np

from ..common.arrays import BoolArray, FloatArray
from ._board import Board
from ._grid import exact_ports, refuse_contradictions
from .readouts import LinearReadout, output_rounding
from .solvers import entrywise, exact_transfer


class Outputs(NamedTuple):
    """Outputs of frames."""

    volts: FloatArray
    """(..., N, M) V"""
    saturated: BoolArray
    """(..., N, M) outputs that stand at a supply limit"""


def read_exactly(board: Board, cells: FloatArray) -> tuple[Outputs, FloatArray]:
    """Outputs of frames of cells, and a bound on the rounding error of each.

    Args:
        board: lines, readout circuit and faults.
        cells: (..., N, M) ohm, in line coordinates.

    Returns:
        Outputs, and bounds (..., N, M) in V on their errors; inf for outputs that ideal parts leave undetermined.

    Raises:
        SolverError: parts of no resistance join sources that contradict each other.

    """
    undetermined = refuse_contradictions(board, cells)
    outputs, error = _read_linearly(board, board.linear, cells) if board.linear else _read_ports(board, cells)
    return outputs, error if undetermined is None else np.where(undetermined, inf, error)


def _read_linearly(board: Board, linear: LinearReadout, cells: FloatArray) -> tuple[Outputs, FloatArray]:
    """Read by the transfer conductances alone; frames with outputs that may reach a limit go to :func:`_read_ports`."""
    transfer, off = exact_transfer(board.cell_conductance(cells), linear.lines)
    volts = linear.volts(transfer)
    error = linear.error(off, transfer)
    saturated = np.zeros(volts.shape, dtype=np.bool_)
    limited = ~linear.within_supply(volts, error)
    if limited.any():
        some, error[limited] = _read_ports(board.some(limited), cells[limited])
        volts[limited], saturated[limited] = some.volts, some.saturated
    return Outputs(volts, saturated), error


def _read_ports(board: Board, cells: FloatArray) -> tuple[Outputs, FloatArray]:
    """Read by the whole network between the ports, for any circuit."""
    ports, relative = exact_ports(board, cells)
    reading = board.circuit.read(board, ports)
    few = output_rounding(reading.volts.shape)
    without_current = abs(board.level) + np.abs(board.offset) + np.abs(board.lift)
    moved = float(relative.max(initial=0.0)) + reading.relative + few
    # Two bounds hold; the second is coarse, but finite where a port has an infinite conductance to the others.
    by_energy = board.circuit.energy_bound(board, ports, moved)
    by_entry = entrywise(np.asarray(moved), _nodes(board)) * reading.magnitude
    error = np.fmin(by_energy, by_entry) + few * (np.abs(reading.volts) + without_current + reading.magnitude)
    return Outputs(reading.volts, reading.saturated), error + reading.error


def _nodes(board: Board) -> int:
    """Upper bound on the number of nodes, those behind the columns included."""
    rows, columns = board.shape
    faces = 2 * board.sheet.divisions * board.sheet.layers if board.continuous else 0
    return rows * columns * (2 + faces) + 2 * (rows + columns)
