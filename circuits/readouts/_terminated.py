"""Columns that end in Thevenin equivalents while they are read, at once or in turns: loads, amplifiers, networks."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import BoolArray, FloatArray
from .._parts import Parts, of_columns
from ..solvers import Lines, Wires
from ._adjoint import SensitivityGroup, terminated_groups
from ._circuit import Reading, ReadoutCircuit
from ._ends import Currents, EndParts, Ends, column_currents, currents_in_turns, terminate
from ._linear import LinearReadout
from ._port_law import PortLaw
from ._quick import (
    QuickFields,
    QuickNetwork,
    alone_fields,
    alone_outputs,
    terminated_fields,
    terminated_outputs,
)
from ._rounding import energy_bound

SignArray = NDArray[np.int8]

_STEP = 1e-30  # imaginary, of a part: a complex step gives derivatives to the last digit (Squire and Trapp 1998)
_OWN_PARTS = {
    "reference_resistance": "reference",
    "inverse_gain": "slack",
    "offset_voltage": "offset",
    "bias_current": "bias",
}
"""parts at columns' ends by the names of :class:`.Sensitivity`, and of :class:`._ends.EndParts`"""


class Terminated(ReadoutCircuit):
    """A subclass states the end of each column (:meth:`ends_of`); all of this class follows from it."""

    @abstractmethod
    def ends_of(self, board: Parts, parts: EndParts, state: SignArray | None = None) -> Ends:
        """The end of each column while it is read.

        Args:
            board: supply limits, and ends that the design describes.
            parts: values, of the board or of many.
            state: (M,): 0 linear, -1 at the lower and +1 at the upper supply limit; None: all linear.

        """

    def read_ends(self, board: Parts) -> Ends:
        return self.ends_of(board, EndParts.of(board))

    def end_resistance(self, board: Parts) -> FloatArray:
        own = self.read_ends(board).resistance
        return np.minimum(own, board.idle_resistance) if self.columns_one_by_one(board) else own

    def ideal_inputs(self, board: Parts) -> BoolArray:
        held: BoolArray = (self.read_ends(board).resistance + board.column_lead) == 0
        return held

    def port_law(self, board: Parts, wire: FloatArray) -> PortLaw | None:
        one_by_one = self.columns_one_by_one(board)
        held = self.virtual_ground and not (one_by_one and board.idle_resistance.any())
        if board.floating and not held:
            return None
        return PortLaw.of_ends(self.read_ends(board), wire, board.drive, floating=board.floating)

    def energy_bound(self, board: Parts, ports: FloatArray, relative: float) -> FloatArray:
        ends = self.read_ends(board)
        limits = [float(np.max(np.abs(limit - board.level))) for limit in board.supply if isfinite(limit)]
        limited = max(limits) + np.abs(board.lift) if limits else 0.0  # the source of an output at a limit
        sources = np.maximum(np.maximum(np.abs(ends.source), np.abs(board.idle_source)), limited)
        return energy_bound(board, ports, relative, self.end_resistance(board), sources, np.abs(ends.slope))

    def read(self, board: Parts, ports: FloatArray) -> Reading:
        ends = self.read_ends(board)
        currents = self._currents(board, ports, ends)
        volts = ends.output + ends.slope * currents.value
        magnitude = np.abs(ends.slope) * currents.magnitude
        relative = float(currents.relative.max(initial=0.0))
        return Reading(volts, np.zeros(volts.shape, dtype=np.bool_), magnitude, relative)

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

    def sensitivity_groups(self, board: Parts, ports: FloatArray, reading: Reading) -> Iterator[SensitivityGroup]:
        parts = EndParts.of(board)
        at_high = reading.volts >= board.supply[1]
        state = np.where(reading.saturated, np.where(at_high, 1, -1), 0).astype(np.int8)
        if board.is_stack:  # none of whose boards is saturated
            state = np.zeros_like(state[0])
        patterns, pattern_of = np.unique(state, axis=0, return_inverse=True)
        for number, pattern in enumerate(patterns):

            def slopes(pattern: SignArray = pattern) -> dict[str, Ends]:
                found = {}
                for name, field in _OWN_PARTS.items():
                    moved = self.ends_of(board, parts._replace(**{field: getattr(parts, field) + 1j * _STEP}), pattern)
                    found[name] = Ends(*(np.imag(value) / _STEP for value in moved))
                return found

            ends = self.ends_of(board, parts, pattern)  # one at a limit does not move: its adjoint field is zero
            steps = np.flatnonzero(pattern_of.ravel() == number)
            yield from terminated_groups(board, ports, steps, ends, slopes)

    def linear(self, board: Parts) -> LinearReadout | None:
        """Linear with grounded idle rows and ends that all stand at one potential; None otherwise."""
        ends = None if board.floating or not board.plain else self.ends(board)
        if ends is None:
            return None
        resistance = ends.resistance + board.column_lead
        source = ends.source[..., :1]
        if (ends.source != source).any() or np.isinf(resistance).any():
            return None
        with np.errstate(divide="ignore"):
            ended = Lines(board.lines.row, board.lines.column, 1.0 / of_columns(resistance))
        return LinearReadout(
            output=ends.output,
            slope=ends.slope,
            drive=board.drive,
            source=source if board.is_stack else source.item(),
            supply=board.supply,
            lines=ended,
            wires=None if board.is_stack else Wires.of(ended),
        )


def _in_turns_of_one(board: Parts) -> bool:
    """Whether one column is read at a time, and no idle end has a source."""
    return board.shared_by >= board.shape[1] and not board.idle_source.any()
