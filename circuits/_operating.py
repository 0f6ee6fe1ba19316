"""Operating point of a scan: the voltages, currents and powers that its parts bear, read off the solved network.

Each scan step has a field (:mod:`._sensitivity`), whose potentials give the voltage across every cell and the current
of every line, with leads, pull-downs, faults and amplifiers at their limits. A current that leaks into a line changes a
reading by that current times the line's potential in the adjoint field of the reading (reciprocity).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import IN_CACHE, BoolArray, FloatArray
from ..errors import SolverError
from ._board import Board
from ._design import Design
from ._parts import of_columns
from ._population import Boards, read_together
from ._sensitivity import of_readings, solve_fields


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
    reference_voltage: FloatArray
    """(sensed lines,) V across the reference resistor of each amplifier, or the load of a divider"""
    reference_power: FloatArray
    """(sensed lines,) W in it"""
    output_current: FloatArray
    """(sensed lines,) A that each amplifier's output delivers into the array; 0 of a circuit without amplifiers"""
    leakage: FloatArray
    """(rows, columns) V/A, by which each reading changes if all idle driven lines leak, each with its worst sign"""
    signal: FloatArray
    """(rows, columns) V, readings against the reference"""

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Of the fields."""
        return tuple(field.name for field in fields(cls))


def operating_point(design: Design, resistance: ArrayLike) -> OperatingPoint:
    """Solve one frame of cells (rows, columns) in ohm for what its parts bear.

    Raises:
        InputError: the cells do not fit, the sheet is continuous or the array larger than 64 x 64.
        SolverError: the parts' values span too many decades, or parts of 0 ohm contradict each other.

    """
    board = design.board
    return _point(board, board.transpose(design.resistance(resistance)))[0]


def _point(board: Board, cells: FloatArray) -> tuple[OperatingPoint, BoolArray]:
    """The operating point of cells (N, M) in line coordinates, or of those (S, N, M) of a stack; outputs at a limit.

    Boards of a stack that have such outputs have to be solved alone.
    """
    solved = solve_fields(board, cells)
    fields = solved.fields
    rows, columns = board.shape
    batch = cells.shape[:-2]
    of_row = fields.leaving_row.sum(axis=-1)[..., None]  # (..., ports, N, 1) A through the leads
    voltage, leakage = np.zeros((2, *batch, rows, columns))
    line_current, output = np.zeros((*batch, rows)), np.zeros((*batch, columns))
    for group in solved.groups():
        across = of_readings(group.forward, fields.drops)
        voltage = np.maximum(voltage, np.abs(across).max(axis=(-4, -3)))
        through = of_readings(group.forward, of_row)[..., 0]  # (..., R, C, N)
        line_current = np.maximum(line_current, np.abs(through).max(axis=(-3, -2)))
        delivered = np.abs(board.circuit.delivered(board, group, through)).max(axis=-2)
        output[..., group.columns] = np.maximum(output[..., group.columns], delivered)
        lead = np.expand_dims(board.row_lead, (-3, -2))
        lifted = group.adjoint[..., :rows] - lead * of_readings(group.adjoint, of_row)[..., 0]
        lifted = np.abs(np.broadcast_to(lifted, (*batch, len(group.rows), len(group.columns), rows))).copy()
        lifted[..., np.arange(len(group.rows)), :, group.rows] = 0.0  # the selected line is driven
        leakage[..., group.rows[:, None], group.columns] = lifted.sum(axis=-1)
    backwards = slice(None, None, -1 if board.transposed else None)
    signal = solved.reading.volts - board.level
    reference = of_columns(board.reference)
    across_reference = reference * output if board.circuit.virtual_ground else np.abs(signal).max(axis=-2)
    point = OperatingPoint(
        reference_voltage=across_reference[..., backwards],
        reference_power=(across_reference**2 / reference)[..., backwards],
        cell_voltage=board.transpose(voltage),
        cell_power=board.transpose(voltage**2 * fields.conductance),
        driver_current=line_current[..., backwards],
        driver_power=(line_current**2 * board.row_lead)[..., backwards],
        output_current=output[..., backwards],
        leakage=board.transpose(leakage),
        signal=board.transpose(signal),
    )
    return point, solved.reading.saturated


def operating_points(design: Design, boards: Boards, cells: FloatArray) -> OperatingPoint:
    """:func:`operating_point` of B boards, one after the other along the first axis of all fields.

    Args:
        design: which parts there are.
        boards: their values.
        cells: (B, rows, columns) ohm.

    Returns:
        NaN for boards whose ideal parts contradict each other.

    Raises:
        InputError: as :func:`operating_point`.

    """
    board, count = design.board, len(cells)
    alone = np.ones(count, dtype=np.bool_)
    found = {name: np.full((count, *shape), np.nan) for name, shape in _shapes(board).items()}
    if read_together(design) and not board.circuit.drives_idle_lines and not board.continuous:
        size = max(1, IN_CACHE // (board.shape[0] * cells[0].size))
        for first in range(0, count, size):
            some = slice(first, first + size)
            with suppress(SolverError):
                point, limited = _point(boards.part(some).board(design), board.transpose(cells[some]))
                for name, values in found.items():
                    values[some] = getattr(point, name)
                alone[some] = limited.any(axis=(1, 2)) | ~np.isfinite(point.leakage).all(axis=(1, 2))
    for values in found.values():
        values[alone] = np.nan
    for number in np.flatnonzero(alone).tolist():
        with suppress(SolverError):
            one = operating_point(boards.design(design, number), cells[number])
            for name, values in found.items():
                values[number] = getattr(one, name)
    return OperatingPoint(**found)


def _shapes(board: Board) -> dict[str, tuple[int, ...]]:
    """Of the fields."""
    driven, sensed = board.shape
    lines = {"driver_current": driven, "driver_power": driven}
    lines |= dict.fromkeys(("reference_voltage", "reference_power", "output_current"), sensed)
    return {name: (lines[name],) if name in lines else board.array_shape for name in OperatingPoint.names()}
