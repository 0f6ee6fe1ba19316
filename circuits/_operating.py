"""Operating point of a scan: the voltages, currents and powers that its parts bear, read off the solved network.

Many boards of one design are solved together by the block elimination of :mod:`._population`, whose way back gives the
potentials of all columns' nodes. The reference, and the way of all other boards, is the field of one board.

Each scan step has a field (:mod:`._sensitivity`), whose potentials give the voltage across every cell and the current
of every line, with leads, pull-downs, faults and amplifiers at their limits. A current that leaks into a line changes a
reading by that current times the line's potential in the adjoint field of the reading (reciprocity).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import IN_CACHE, BoolArray, FloatArray, IntArray
from ..errors import SolverError
from ._board import Board
from ._design import Design
from ._population import Boards, Rows, read_together, row_ladders, through_segment
from ._sensitivity import solve_fields
from .readouts import Ends
from .solvers import IDEAL_WIRE

_OPEN = 1e-30
"""S of an open cell, so that the voltage across it follows from its current"""


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
    rows, columns = board.shape
    cells = board.transpose(design.resistance(resistance))
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
    backwards = slice(None, None, -1 if board.transposed else None)
    signal = solved.reading.volts - board.level
    across_reference = board.reference * output if board.circuit.virtual_ground else np.abs(signal).max(axis=0)
    return OperatingPoint(
        reference_voltage=across_reference[backwards],
        reference_power=(across_reference**2 / board.reference)[backwards],
        cell_voltage=board.transpose(voltage),
        cell_power=board.transpose(voltage**2 * fields.conductance),
        driver_current=line_current[backwards],
        driver_power=(line_current**2 * board.row_lead)[backwards],
        output_current=output[backwards],
        leakage=board.transpose(leakage),
        signal=board.transpose(signal),
    )


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
    together = read_together(design) and not design.board.circuit.drives_idle_lines
    found = _Together.of(design, boards, cells) if together else None
    if found is None:
        values = [_at_one(design, boards, cells, number) for number in range(len(cells))]
        return OperatingPoint(*(np.stack([getattr(v, name) for v in values]) for name in OperatingPoint.names()))
    point, solved = found
    for number in np.flatnonzero(~solved).tolist():
        one = _at_one(design, boards, cells, number)
        for name in OperatingPoint.names():
            getattr(point, name)[number] = getattr(one, name)
    return point


def _at_one(design: Design, boards: Boards, cells: FloatArray, number: int) -> OperatingPoint:
    """One of several boards."""
    try:
        return operating_point(boards.design(design, number), cells[number])
    except SolverError:
        (rows, columns), (driven, sensed) = design.array.shape, design.board.shape
        lines = {"driver_current": driven, "driver_power": driven}
        lines |= dict.fromkeys(("reference_voltage", "reference_power", "output_current"), sensed)
        shapes = {name: (lines[name],) if name in lines else (rows, columns) for name in OperatingPoint.names()}
        return OperatingPoint(**{name: np.full(shape, np.nan) for name, shape in shapes.items()})


class _Step(NamedTuple):
    """Column nodes and cells of B boards under S sets of sources."""

    column: FloatArray
    """(B, N, M, S) V"""
    out_of_row: FloatArray
    """(B, N, M, S) A from each row into its cells"""
    ends: FloatArray
    """(B, M, S) A into the columns' ends"""


@dataclass(frozen=True)
class _Together:
    """Linear boards in line coordinates, and what their columns end in."""

    board: Board
    boards: Boards
    conductance: FloatArray
    """(B, N, M) S; an open cell has next to none"""
    held: Rows
    """rows at their drivers"""
    idle: Rows
    ends: Ends

    @classmethod
    def of(cls, design: Design, boards: Boards, cells: FloatArray) -> tuple[OperatingPoint, BoolArray] | None:
        """All boards, and which of them were solved: neither at a limit of an output nor with contradicting parts."""
        board, count = design.board, len(cells)
        ours = boards.transposed if board.transposed else boards
        rows, columns = board.shape
        size = max(1, IN_CACHE // (rows * rows * columns))
        parts = []
        with np.errstate(all="ignore"):  # what comes of it is solved again
            for first in range(0, count, size):
                some = slice(first, first + size)
                conductance = np.maximum(1.0 / board.transpose(cells[some]), _OPEN)
                part = ours.part(some)
                held, idle = row_ladders(design, part, conductance)
                parts.append(cls(board, part, conductance, held, idle, part.read_ends(design))._point())
        joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        low, high = design.readout.supply if board.circuit.has_amplifiers else (-np.inf, np.inf)
        volts = joined.pop("volts")
        solved: BoolArray = np.asarray(((volts >= low) & (volts <= high)).all(axis=(1, 2)))
        for name, value in joined.items():
            solved = solved & np.isfinite(value).all(axis=tuple(range(1, value.ndim)))
            joined[name] = board.transpose(value) if value.ndim == 3 else value[:, :: -1 if board.transposed else 1]
        return OperatingPoint(**joined), solved

    def _point(self) -> dict[str, FloatArray]:
        """The fields of an operating point, and the outputs in V, in line coordinates."""
        board, boards = self.board, self.boards
        count, rows, columns = self.conductance.shape
        cell_voltage, volts, leakage = np.zeros((3, count, rows, columns))
        driver, reference, output = np.zeros((count, rows)), *np.zeros((2, count, columns))
        amplified = board.circuit.virtual_ground
        ohms, level = boards.reference_resistance, boards.reference_voltage
        resistance, source, at_rest, slope = self.ends
        of_idle = ohms if board.idle_columns == "load" else np.inf if board.idle_columns == "float" else 0.0
        for read in board.turns if board.circuit.columns_one_by_one(board) else [np.ones(columns, dtype=np.bool_)]:
            tie = 1.0 / (np.where(read, resistance, of_idle) + boards.column_lead)
            behind = np.where(read, source, 0.0)
            for steps in np.arange(rows)[:, None] if board.floating else [np.arange(rows)]:
                here = self._solved(steps, tie, behind[..., None], boards.voltage)
                across = np.abs(here.out_of_row) / self.conductance[..., None]
                cell_voltage = np.maximum(cell_voltage, across.max(axis=-1))
                through = self._through_leads(here, steps, boards.voltage)
                driver = np.maximum(driver, np.abs(through).max(axis=-1))
                into = here.ends - boards.bias_current[..., None] if amplified else here.ends
                loaded = read | (board.idle_columns == "load")
                largest = np.where(loaded, np.abs(into).max(axis=-1), 0.0)
                reference = np.maximum(reference, ohms * largest)
                output = np.maximum(output, largest) if amplified else output
                shown = (at_rest[..., None] + slope[..., None] * here.ends).swapaxes(1, 2)
                volts[:, steps] = np.where(read, shown, volts[:, steps])
                unit = np.where(read, slope, 0.0)[..., None] * np.eye(columns)
                back = self._solved(steps, tie, unit, None)
                lifted = np.abs(self._lead_ends(back, steps)).swapaxes(1, 2)  # (B, M, N)
                for step in steps.tolist():
                    others = np.delete(lifted, step, axis=2).sum(axis=2)
                    leakage[:, step] = np.where(read, others, leakage[:, step])
        ones = np.ones((count, 1))
        return {
            "cell_voltage": cell_voltage,
            "cell_power": cell_voltage**2 * self.conductance,
            "driver_current": driver,
            "driver_power": driver**2 * boards.row_lead,
            "reference_voltage": reference,
            "reference_power": reference**2 / ohms,
            "output_current": output,
            "leakage": leakage,
            "signal": volts - ones[..., None] * level[..., None],
            "volts": volts,
        }

    def _solved(self, steps: IntArray, tie: FloatArray, behind: FloatArray, voltage: FloatArray | None) -> _Step:
        """Rows ``steps`` in turn at ``voltage`` (None: at 0 V), the ends at ``behind`` (B, M, 1 or S) V.

        ``tie`` (B, M) is in S, between the last node of each column and its end.
        """
        rows = self.conductance.shape[1]
        row = np.arange(rows)
        driven = row[:, None] == steps
        matrix, per_volt = self.held.admittance, self.held.current
        if self.board.floating:
            idle = ~driven[:, 0]
            matrix = np.where(idle[:, None, None], self.idle.admittance, matrix)
        if voltage is None:
            inject = np.zeros((*per_volt.shape, behind.shape[-1]))
        else:
            inject = (per_volt * voltage[..., None])[..., None] * driven[:, None]
        segment = self.boards.column_segment
        above, into = matrix[:, 0], inject[:, 0]
        kept = []
        for place in range(1, rows):
            kept.append((above, into))
            both = np.concatenate([above, into], axis=-1)
            if segment.any():
                both = through_segment(above, segment, both)
            columns = above.shape[-1]
            above, into = both[..., :columns] + matrix[:, place], both[..., columns:] + inject[:, place]
        largest = np.abs(above).max(axis=(1, 2))[:, None]
        tie = np.minimum(tie, IDEAL_WIRE * largest)
        ended = above + tie[..., None] * np.eye(above.shape[-1])
        column = np.empty(inject.shape)
        column[:, -1] = np.linalg.solve(ended, into + tie[..., None] * behind)
        ends = into - above @ column[:, -1]
        for place in range(rows - 2, -1, -1):
            column[:, place] = column[:, place + 1]
            if segment.any():
                here, arrives = kept[place]
                passing = np.eye(here.shape[-1]) + segment[..., None] * here
                column[:, place] = np.linalg.solve(passing, column[:, place] + segment[..., None] * arrives)
        return _Step(column, inject - matrix @ column, ends)

    def _through_leads(self, here: _Step, steps: IntArray, voltage: FloatArray) -> FloatArray:
        """(B, N, S) A through the lead of each row; none through that of a row that floats."""
        pull, lead = self.board.pull, self.boards.row_lead[..., None]
        driven = np.arange(here.column.shape[1])[:, None] == steps
        through = (here.out_of_row.sum(axis=2) + voltage[..., None] * driven / pull) / (1.0 + lead / pull)
        return through if not self.board.floating else np.where(driven, through, 0.0)

    def _lead_ends(self, here: _Step, steps: IntArray) -> FloatArray:
        """(B, N, S) V where the lead of each row ends, of sources of 0 V."""
        if not self.board.floating:
            return np.asarray(-self.boards.row_lead[..., None] * here.out_of_row.sum(axis=2))
        first = here.column[:, :, 0] + here.out_of_row[:, :, 0] / self.conductance[:, :, 0, None]
        driven = np.isin(np.arange(here.column.shape[1]), steps)[:, None]
        return np.where(driven, 0.0, first)
