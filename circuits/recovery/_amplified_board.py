"""A board whose amplifiers hold all columns: model of lines, amplifiers and converter, and first-order bounds.

With T the transfer conductances of the grid, the outputs are

    V_ij = output_j + slope_j (drive T_ij - s_j sum_k T_kj + c_j).

The s_j are the sources behind the columns' ends, and c_j is the current between columns whose sources differ. Arrays
are in line coordinates: N rows that are driven one by one, M columns that end in amplifiers.
"""

from __future__ import annotations

import numpy as np

from ...common.arrays import FloatArray
from .._adc import adc_error
from .._board import Board
from ..solvers import FrameTransfer, Lines
from ._heavy_leads import Propagation

BOUNDLESS = 1e6
"""relative change of a conductance that stands for any larger one"""
FAR = 0.5
"""relative change of a gain beyond which first-order bounds do not hold"""
LEAST_SHARE = 1e-9
"""of the largest conductance: stand-in for an open cell, so that every ratio is defined"""
MARGIN = 2.0
"""factor by which intervals from first-order bounds are widened"""
SIMILAR_MARGIN = 1.25
"""factor by which kept bounds are widened: two conductances have changed by 1.1 against each other"""
ZERO = np.array(0.0)
"""an array, since NumPy makes one of a float in every call"""
_SIMILAR = 0.1  # relative change of conductances up to which bounds are kept
_SHARE_OF_STEP = 0.25  # of an ADC step that the model may leave as its own error
HEAVY = 0.5
"""share of a cell's current that its lines take, above which line attenuation may not converge"""
_LEAD_LIKE = 0.5  # largest resistance of segments over that of leads for which a grid counts as one without segments


class AmplifiedBoard:
    """Constants of a board whose amplifiers hold all columns, for its live recovery."""

    def __init__(self, board: Board) -> None:
        """For a board whose circuit has ends (:meth:`.ReadoutCircuit.ends`) and whose design has a converter."""
        adc, ends = board.adc, board.circuit.ends(board)
        assert adc is not None
        assert ends is not None
        self.board = board
        resistance = ends.resistance + board.column_lead
        with np.errstate(divide="ignore"):
            self.lines = Lines(board.lines.row, board.lines.column, 1.0 / resistance)
        self.models = FrameTransfer(self.lines)

        self.to_driver = np.cumsum(board.row_ohms, axis=1)
        """(N, M) ohm of wire between a crosspoint and its row's driver"""
        self.behind = np.concatenate([board.column_ohms[1:], resistance[None]])
        """(N, M) ohm of wire between a crosspoint and the next one towards the amplifier, or the amplifier"""
        self.to_amplifier = np.cumsum(self.behind[::-1], axis=0)[::-1]
        """(N, M) ohm of wire between a crosspoint and its column's amplifier"""
        self.farthest_driver = self.to_driver.max(axis=0)
        """(M,) ohm"""
        self.farthest_amplifier = self.to_amplifier.max(axis=1)
        """(N,) ohm"""
        self.row_lead, self.column_lead = self.to_driver.mean(axis=1), self.to_amplifier.mean(axis=0)
        """(N,) and (M,) ohm, leads of the most similar grid without segments"""
        along_rows, along_columns = np.ptp(self.to_driver, axis=1), np.ptp(self.to_amplifier, axis=0)
        leads = float(self.row_lead.mean() + self.column_lead.mean())
        self.lead_like = float(along_rows.max() + along_columns.max()) <= _LEAD_LIKE * leads
        """whether the segments are small against the leads"""
        self.has_segments = bool(along_rows.any() or along_columns.any())
        self.independent_columns = not (self.to_driver.any() or board.column_ohms.any())
        """whether only the columns' ends have resistance"""
        self._along_row = _shared_wire(self.to_driver)
        self._along_column = _shared_wire(self.to_amplifier.T)

        rows = board.shape[0]
        self.source = ends.source
        """(M,) V behind the columns' ends"""
        self.source_per_volt = ends.source / board.drive
        """(M,) the same per volt of drive"""
        self.has_sources = bool(ends.source.any())
        self.sources_differ = bool((ends.source != ends.source[0]).any())
        self.source_spread = float(np.ptp(ends.source)) / abs(board.drive)
        """largest difference between the sources of two columns, in V per volt of drive"""
        # T = t + per_sum (sum of t over the rows) with t = scale V + constant, without currents between columns
        self.scale = 1.0 / ends.slope / board.drive
        """(M,) S of T per volt of output"""
        self.constant = -ends.output * self.scale
        """(M,) S"""
        # The same for all cells: operations on arrays of one shape take a third of the time.
        self._scale_of_all = self.for_all(self.scale)
        self._constant_of_all = self.for_all(self.constant)
        self.per_sum = ends.source / (board.drive - rows * ends.source)
        """(M,) rise of T per sum of a column's t, see above"""
        self._ones = np.ones(rows)

        self.half_step = adc_error(board) * np.abs(self.scale)
        """(M,) S, error of T by the converter"""
        self.tolerance = _SHARE_OF_STEP * adc.step * np.abs(self.scale)
        """(M,) S, tolerated error of T by a model"""
        self.least_tolerance = float(self.tolerance.min())
        """S"""

    def asks_for_leads(self, loss: float) -> bool:
        """Whether Kirchhoff's laws of grids without segments are more accurate than line attenuation.

        Args:
            loss: largest share of a cell's current that its lines take.

        """
        return self.lead_like and loss > HEAVY

    def for_all(self, values: FloatArray) -> FloatArray:
        """Values that broadcast to (N, M), as a contiguous array (N, M)."""
        return np.ascontiguousarray(np.broadcast_to(values, self.board.shape))

    def transfer(self, volts: FloatArray, between: FloatArray | None) -> FloatArray:
        """S (N, M): transfer conductances from outputs; 0 where the current has the wrong sign.

        Args:
            volts: (N, M) V, outputs.
            between: (M,) S that currents between columns add to each T of a column; None: zero.

        """
        transfer: FloatArray = volts * self._scale_of_all
        transfer += self._constant_of_all
        if self.has_sources:
            if between is not None:
                transfer -= between
            transfer += self.per_sum * (self._ones @ transfer)
        np.maximum(transfer, ZERO, out=transfer)
        return transfer

    def of_independent_columns(self, transfer: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Conductances (N, M) in S and gains (M,) where only the columns' ends have resistance, in closed form.

        T = G / (1 + R sum G), R the resistance of a column's end.
        """
        gain = 1.0 / np.maximum(1.0 - self.to_amplifier[0] * (self._ones @ transfer), LEAST_SHARE)
        return transfer * gain, gain

    def between_columns(self, transfer: FloatArray, loss: float) -> tuple[FloatArray, FloatArray]:
        """S (M,) that currents between columns of different sources add to each T of a column, and its error bound.

        The columns' sources drive these currents through the rows that the columns share, which lifts the rows. The
        result is of first order in the resistance of the rows. The terms left out are smaller by the losses in the
        lines, but need not cancel where sources of both signs do.

        Args:
            transfer: (N, M) S, transfer conductances.
            loss: largest share of a cell's current that its lines take.

        """
        source, drive = self.source, self.board.drive
        taken_per_volt = (self.drop_along_rows(transfer) * transfer).sum(axis=0) / drive
        given = (self.drop_along_rows(transfer * source) * transfer).sum(axis=0) / drive
        most_given = (self.drop_along_rows(transfer * np.abs(source)) * transfer).sum(axis=0) / drive
        taken = source * taken_per_volt
        higher = loss / max(1.0 - loss, LEAST_SHARE) * (np.abs(most_given) + np.abs(taken))
        left: FloatArray = 2.0 * (np.abs(given) + np.abs(taken) + higher)
        return given - taken, left

    def drop_along_rows(self, current: FloatArray) -> FloatArray:
        """V (N, M) along the rows for currents (N, M) in A that leave them at the crosspoints."""
        if self._along_row is not None:
            drop: FloatArray = current.dot(self._along_row)
            return drop
        flow = np.cumsum(current[:, ::-1], axis=1)[:, ::-1]
        return np.cumsum(self.board.row_ohms * flow, axis=1)

    def drop_along_columns(self, current: FloatArray) -> FloatArray:
        """V (N, M) along the columns for currents (N, M) in A into them at the crosspoints."""
        if self._along_column is not None:
            drop: FloatArray = self._along_column.dot(current)
            return drop
        flow = np.cumsum(current, axis=0)
        return np.cumsum((self.behind * flow)[::-1], axis=0)[::-1]

    def by_lines(self, change: FloatArray) -> FloatArray:
        """Bound on the relative change of each T_ij, to first order, by the line losses of changed conductances."""
        change = np.broadcast_to(change, self.board.shape)
        row: FloatArray = np.einsum("ij,ij->i", self.to_driver, change)
        column: FloatArray = np.einsum("ij,ij->j", self.to_amplifier, change)
        return row[:, None] + column

    def within_linear_range(self, change: FloatArray, conductance: FloatArray) -> FloatArray:
        """First-order bounds (N, M) in S on changes of conductances; inf if they move gains beyond the linear range.

        The allowed change of a gain grows with the gain itself, which is about one plus the resistance of the lines
        over that of their cells, whose conductances (N, M) in S are given.
        """
        allowed = FAR * (1.0 + self.by_lines(conductance))
        return change if (self.by_lines(change) <= allowed).all() else np.full_like(change, np.inf)

    def moved_by(self, readings: FloatArray, propagation: Propagation, conductance: FloatArray) -> FloatArray:
        """S (N, M), error of conductances (N, M) in S if the readings have errors of these S (N, M)."""
        return self.within_linear_range(SIMILAR_MARGIN * propagation(readings), conductance)


def above_floor(conductance: FloatArray) -> FloatArray:
    """Conductances (N, M) in S with stand-ins for open cells."""
    return np.maximum(conductance, floor_of(conductance))


def floor_of(conductance: FloatArray) -> float:
    """S, the stand-in for an open cell among these conductances."""
    return LEAST_SHARE * max(float(conductance.max()), 1e-12)


def similar(conductance: FloatArray, before: FloatArray) -> bool:
    """Whether conductances (N, M) in S have changed so little that bounds on them hold within a small margin."""
    change = np.abs(conductance - before)
    return bool((change <= _SIMILAR * (before + float(before.mean()))).all())


def _shared_wire(ohms: FloatArray) -> FloatArray | None:
    """The matrix K of a line: resistance of the wire that two places share on the way to the line's end.

    Args:
        ohms: (lines, places) from each place to the line's end.

    Returns:
        (places, places) ohm, or None if the lines are not alike.

    """
    return np.minimum.outer(ohms[0], ohms[0]) if (ohms == ohms[0]).all() else None
