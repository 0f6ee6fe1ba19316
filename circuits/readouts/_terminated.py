"""Columns that end in Thevenin equivalents while they are read, at once or in turns: loads, amplifiers, networks."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from ...common.arrays import FloatArray
from .._parts import Parts
from ..solvers import Lines, Wires
from ._circuit import Reading, ReadoutCircuit
from ._ends import Currents, Ends, column_currents, currents_in_turns, terminate
from ._linear import LinearReadout
from ._quick import (
    QuickFields,
    QuickNetwork,
    alone_fields,
    alone_outputs,
    terminated_fields,
    terminated_outputs,
)


class Terminated(ReadoutCircuit):
    """A subclass states the end of each column (:meth:`read_ends`); all of this class follows from it."""

    @abstractmethod
    def read_ends(self, board: Parts) -> Ends:
        """The end of each column while it is read, no output at a limit."""

    def ends(self, board: Parts) -> Ends | None:
        return None if self.columns_one_by_one(board) else self.read_ends(board)

    def end_resistance(self, board: Parts) -> FloatArray:
        own = self.read_ends(board).resistance
        return np.minimum(own, board.idle_resistance) if self.columns_one_by_one(board) else own

    def columns_one_by_one(self, board: Parts) -> bool:
        return board.shared_by > 1

    def read(self, board: Parts, ports: FloatArray) -> Reading:
        ends = self.read_ends(board)
        currents = self._currents(board, ports, ends)
        volts = ends.output + ends.slope * currents.value
        magnitude, cancelled = (np.abs(ends.slope) * part for part in (currents.magnitude, currents.cancelled))
        relative = float(currents.relative.max(initial=0.0))
        return Reading(volts, np.zeros(volts.shape, dtype=np.bool_), magnitude, cancelled, relative)

    def _currents(self, board: Parts, ports: FloatArray, ends: Ends) -> Currents:
        if self.columns_one_by_one(board):
            return currents_in_turns(board, ports, ends)
        network = terminate(ports, board.shape[0] + board.pulled, ends.resistance + board.column_lead)
        return column_currents(board, network, ends.source)

    def quick_outputs(self, board: Parts, network: QuickNetwork) -> FloatArray | None:
        ends = self.read_ends(board)
        if self.columns_one_by_one(board):
            return alone_outputs(board, network, ends) if _in_turns_of_one(board) else None
        return terminated_outputs(board, network, ends) if (ends.resistance + board.column_lead).all() else None

    def quick_fields(self, board: Parts, network: QuickNetwork) -> QuickFields | None:
        ends = self.read_ends(board)
        if self.columns_one_by_one(board):
            return alone_fields(board, network, ends) if _in_turns_of_one(board) else None
        return terminated_fields(board, network, ends) if (ends.resistance + board.column_lead).all() else None

    def linear(self, board: Parts) -> LinearReadout | None:
        """Linear with grounded idle rows and ends that all stand at one potential; None otherwise."""
        ends = None if board.floating or not board.plain else self.ends(board)
        if ends is None:
            return None
        resistance = ends.resistance + board.column_lead
        if (ends.source != ends.source[0]).any() or np.isinf(resistance).any():
            return None
        with np.errstate(divide="ignore"):
            ended = Lines(board.lines.row, board.lines.column, 1.0 / resistance)
        return LinearReadout(
            output=ends.output,
            slope=ends.slope,
            drive=board.drive,
            source=float(ends.source[0]),
            supply=board.supply,
            lines=ended,
            wires=Wires.of(ended),
        )


def _in_turns_of_one(board: Parts) -> bool:
    """Whether one column is read at a time, and no idle end has a source."""
    return board.shared_by >= board.shape[1] and not board.idle_source.any()
