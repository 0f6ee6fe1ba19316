"""All sets of cells that give a frame's readings, where there may be several.

Idle columns that conduct more than the one that is read tie the rows, behind their leads, to the potential at which
idle lines stand. With idle columns at that potential, column j conducts

    S_j = sum_i D_ij (1 - r_i D_ij) / (1 - r_i sum_l D_il)

to all other lines, and W D = I + S C (:mod:`..readouts._port_law`). D and S increase with each other where C/W is
positive: rounds that begin at the bounds of the cells enclose every answer, and meet if there is only one. Where idle
columns stand behind leads w, the D are larger, and S is bounded by what passes these: while the column is at 1 V, row m
is at r_m D_mj, and the idle columns let out to their ends at most

    min(sum_m r_m D_mj sum_k G_mk / (1 + w_k G_mk), max_m (r_m D_mj) sum_k 1 / w_k).

Where ends hardly differ, this asks too much. With all columns ended as idle ones are, they carry the currents J, of
which one set of cells is the origin at most. The end of the column that is read stands e higher than it would while
idle, so that its current is I = J - Y e, and no end conducts more than its wires w let pass: Y <= 1 / w. So all answers
lie within an error e / w of the readings' currents, and where cells change by little within it, they are one.

A row that floats while it is idle joins its cell to the cells of other columns only: it conducts D_ij (1 - a_ij) /
(1 - r_i sum_l D_il), where a_ij is the cell's share in its row, and D_ij a_ij more while it is selected. Both increase
with every D, too.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._board import Board
from .._parts import LEAST_SHORT_OHM
from ..readouts import PortLaw
from ._known_board import KnownBoard
from ._law_kernels import answers
from ._tuning import CONTACT_OHM, FEW_ROWS, LEAST, ONE, STANDS_OUT


def several_answers(board: Board) -> bool:
    """Whether two sets of cells may give the same readings, however small their errors.

    The determinant of the derivatives of all readings by all cells is positive for all cells where no line conducts
    more to the reference while it is idle than while it is selected or read (``tests/test_answers.py``): then there is
    one answer at most. An idle column that conducts more ties the rows, behind their leads, to the reference; one
    beside which the read column stands at an offset takes a current from it.
    """
    circuit = board.circuit
    if board.line_ends is not None and board.described is None:
        return False  # not linear: the circuit itself refuses what is ambiguous
    more = False
    if circuit.drives_idle_lines:  # to where the read column stands, but for what the amplifiers lack
        more = bool(board.inverse_gain.any() or board.offset.any())
    elif (read := circuit.read_ends(board)) is not None:
        offset = np.isfinite(board.idle_resistance) & (read.source != 0.0)
        more = bool((offset | (board.idle_resistance < read.resistance)).any())
    leads = np.where(np.isfinite(board.row_ohms), board.row_ohms, 0.0)
    return circuit.columns_one_by_one(board) and more and bool(leads.any())


class Answers:
    """Bounds on all answers of one board."""

    def __init__(self, known: KnownBoard, least_ohm: float = 0.0) -> None:
        """For a board with a port law, whose cells have at least so many ohm, shorts apart."""
        board, (to_driver, to_end, column_lead) = known.sliced, known.wires
        wire = column_lead + to_end.mean(axis=0)
        law = board.circuit.port_law(replace(board, floating=False), wire)
        assert law is not None
        self._floating = board.floating
        self._law = PortLaw(*(np.array(np.broadcast_to(part, (2, len(wire))), order="C") for part in law))
        self._lead = to_driver.mean(axis=1)
        self._present = np.ascontiguousarray(~(known.cut_off | np.isinf(board.series_ohms)))
        self._nowhere = np.zeros(board.shape, dtype=np.bool_)
        if board.circuit.drives_idle_lines:
            idle = np.zeros(len(wire))
        else:  # others are read beside it, or none
            alone = board.shared_by >= len(wire)
            idle = np.zeros(len(wire)) + (board.idle_resistance if alone else board.circuit.end_resistance(board))
        self._beyond = column_lead + to_end.min(axis=0) + idle
        out = 1.0 / (self._beyond + LEAST_SHORT_OHM)
        self._out = out.sum() - out
        self._column_most = self._out + (0.0 if board.floating else (1.0 / (self._lead + LEAST_SHORT_OHM)).sum())
        self._least_ohm = max(least_ohm, CONTACT_OHM)
        at_end = board.circuit.port_law(replace(board, floating=False), np.zeros(len(wire)))
        assert at_end is not None
        self._stands = at_end.potential - idle * at_end.current  # V and V/V, above an idle end of the same current

    def __call__(
        self,
        volts: FloatArray,
        error: float,
        limited: BoolArray | None = None,
        under_range: BoolArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Bounds (N, M) in S on the cells behind readings (N, M) in V that are known within an ``error`` in V.

        No cell is taken to conduct more than the least resistance does, but for cells at a limit, cells that seem to
        conduct more, and cells that stand out from their columns; no column, together, more than all other lines' leads
        let pass.

        Args:
            volts: readings.
            error: of each.
            limited: (N, M) cells that conduct at least what their readings say; None: nowhere.
            under_range: likewise at most.

        """
        law, (rows, columns) = self._law, volts.shape
        limited = self._nowhere if limited is None else limited
        under_range = self._nowhere if under_range is None else under_range
        drives = law.drive[0] + law.drive[1] * volts
        own, share = ((part[0] + part[1] * volts) / drives for part in (law.current, law.potential))
        driven = own + share * own.sum(axis=0) / np.maximum(1.0 - share.sum(axis=0), LEAST)
        # Shorts of one row hide each other's currents, and show by what their columns' other cells conduct.
        few = rows < FEW_ROWS  # tell nothing of what is usual in their column
        usual = np.sort(driven.reshape(-1, 1) if few else driven, axis=0)
        low = limited | (driven * (self._least_ohm + self._lead[:, None]) >= 1.0)
        low |= driven > STANDS_OUT * np.maximum(usual[(len(usual) - 1) // 2], 0.0)
        most = np.where(low, 1.0 / LEAST_SHORT_OHM, 1.0 / self._least_ohm)
        column_most = np.minimum(self._column_most, most.sum(axis=0))
        beyond = most / (1.0 + most * self._beyond)
        below, above, least, greatest = np.empty((4, rows, columns))
        flags = self._present, np.ascontiguousarray(limited), under_range
        priors = self._lead, most, beyond, self._out, column_most
        written = below, above, np.empty((4, max(rows, columns))), np.empty((2, rows)), least, greatest
        answers.unchecked(np.ascontiguousarray(volts), *law, *flags, *priors, self._floating, error, *written)
        return least, greatest

    def by_ends(
        self, volts: FloatArray, limited: BoolArray | None = None, under_range: BoolArray | None = None
    ) -> float:
        """Largest error in V of the readings, but for those at a limit, within which all answers lie: e / w.

        Arguments are those of a call.
        """
        counted = self._present
        for unknown in (limited, under_range):
            counted = counted if unknown is None else counted & ~unknown
        apart = np.abs(self._stands[0] + self._stands[1] * volts) / (self._beyond + LEAST_SHORT_OHM)
        apart /= np.abs(self._law.current[1])
        return float(apart[counted].max(initial=0.0))


def are_one(low: FloatArray, high: FloatArray) -> BoolArray:
    """Where bounds on all answers are so near that these differ by their errors only."""
    one: BoolArray = high <= ONE * low
    return one
