"""Operating point of a scan: the voltages, currents and powers that its parts bear, read off the solved network.

Each scan step has a field (:mod:`._sensitivity`), whose potentials give the voltage across every cell and the current
of every line, with leads, pull-downs, faults and amplifiers at their limits. A current that leaks into a line changes a
reading by that current times the line's potential in the adjoint field of the reading (reciprocity).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import FloatArray
from ._design import Design
from ._sensitivity import solve_fields


@dataclass(frozen=True)
class OperatingPoint:
    """The largest magnitudes of one frame, over all its scan steps."""

    cell_voltage: FloatArray
    """(rows, columns) V across each cell"""
    cell_power: FloatArray
    """(rows, columns) W in each cell, while the step lasts"""
    driver_current: FloatArray
    """(driven lines,) A through each driven line's switch and lead, by the line's number in the array"""
    driver_power: FloatArray
    """(driven lines,) W in each driven line's switch and lead"""
    output_current: FloatArray
    """(sensed lines,) A that each amplifier's output delivers into the array; 0 of a circuit without amplifiers"""
    leakage: FloatArray
    """(rows, columns) V/A, by which each reading changes if all idle driven lines leak, each with its worst sign"""
    signal: FloatArray
    """(rows, columns) V, readings against the reference"""


def operating_point(design: Design, resistance: ArrayLike) -> OperatingPoint:
    """Solve one frame of cells (rows, columns) in ohm for what its parts bear.

    Raises:
        InputError: the cells do not fit, the sheet is continuous or the array larger than 64 x 64.
        SolverError: the parts' values span too many decades, or parts of 0 ohm contradict each other.

    """
    board = design.board
    rows, columns = board.shape
    cells = board.turn(design.resistance(resistance))
    solved = solve_fields(board, cells)
    fields = solved.fields
    of_row = fields.leaving_row.sum(axis=-1)  # (ports, N) A through the leads
    voltage, leakage = np.zeros((2, rows, columns))
    line_current, output = np.zeros(rows), np.zeros(columns)
    for group in solved.groups():
        across = np.tensordot(group.forward, fields.drops, axes=1)
        voltage = np.maximum(voltage, np.abs(across).max(axis=(0, 1)))
        through = np.tensordot(group.forward, of_row, axes=1)  # (R, C, N)
        line_current = np.maximum(line_current, np.abs(through).max(axis=(0, 1)))
        delivered = np.abs(board.circuit.delivered(board, group, through)).max(axis=0)
        output[group.columns] = np.maximum(output[group.columns], delivered)
        lifted = group.adjoint[..., :rows] - board.row_lead * np.tensordot(group.adjoint, of_row, axes=1)
        lifted = np.abs(np.broadcast_to(lifted, (len(group.rows), len(group.columns), rows))).copy()
        lifted[np.arange(len(group.rows)), :, group.rows] = 0.0  # the selected line is driven
        leakage[np.ix_(group.rows, group.columns)] = lifted.sum(axis=-1)
    turned = slice(None, None, -1 if board.turned else None)
    return OperatingPoint(
        cell_voltage=board.turn(voltage),
        cell_power=board.turn(voltage**2 * fields.conductance),
        driver_current=line_current[turned],
        driver_power=(line_current**2 * board.row_lead)[turned],
        output_current=output[turned],
        leakage=board.turn(leakage),
        signal=board.turn(solved.reading.volts - board.level),
    )
