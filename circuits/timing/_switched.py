"""Loads or one amplifier behind switches in time: what their repeated scans have in common.

A step consists of phases, in each of which the network does not change:

=========================  =======================================================================================
idle columns at loads      The columns settle together. With ``adc.acquisition_time``, one sampling capacitor is
                           connected to each column in turn at the end of the step.
idle columns open, or at   The columns have equal shares of the step, in which they alone have the load or the
the reference; any idle    amplifier, in the order of their numbers in the array. With ``adc.acquisition_time`` the
columns of one amplifier   sampling capacitor is connected at the end of a share.
=========================  =======================================================================================
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from functools import cached_property, reduce
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from ...common.arrays import FloatArray, IntArray
from .._board import Board
from .._grid import exact_ports
from ..readouts import one_driven, terminate
from ._modes import Deviations, Modes

SLOWEST = 1e-9
"""of the fastest rate: slower modes are those of nodes that keep their charge"""
_LEAK = 1e-18
"""of the largest conductance: gives a settled voltage to nodes that nothing is connected to"""
_LONG = 60.0
"""time constants after which a deviation is below rounding"""


class SwitchState(NamedTuple):
    """Switches of the columns during one phase of a step."""

    loaded: IntArray
    """columns that end in their loads, or in the amplifier"""
    connected: int | None
    """column that a shared sampling capacitor is connected to"""
    read: IntArray
    """columns that are read at the end of the phase"""


class Phase(Protocol):
    """A linear network of S nodes, column ends first, that does not change for some time."""

    def carry(self, seconds: float) -> FloatArray:
        """Propagator (S, S) of the deviations from the settled voltages over a time in s."""

    def settled(self, current: FloatArray) -> FloatArray:
        """Settled voltages (S,) with these currents (M,) into the column ends."""


P = TypeVar("P", bound=Phase)


class SwitchedScan(ABC, Generic[P]):
    """The repeated scan of constant cells through switches (:class:`._modes.RepeatedScan`)."""

    def __init__(self, board: Board, cells: FloatArray, settled: FloatArray) -> None:
        """Reduce the grid to its terminals.

        Args:
            board: with a divider, or with one amplifier for all columns.
            cells: (N, M) ohm.
            settled: (N, M) V, the settled readings.

        """
        self._board = board
        self._signal = float(np.abs(settled - board.level).max())
        adc, columns = board.adc, board.shape[1]
        self._acquisition = adc.acquisition_time if adc else 0.0
        self.briefest = self._acquisition * columns
        self._one_by_one = board.circuit.columns_one_by_one(board)
        self._states = list(self._possible_states())
        phases: dict[int, list[P]] = {}
        self._rows: list[tuple[list[P], list[FloatArray]]] = []
        """phases of each row and their settled voltages (S,); rows with the same network share their phases"""
        seen = list(column_networks(board, cells))  # all alive, so that their identities differ
        for network, current in seen:
            if id(network) not in phases:
                phases[id(network)] = [self._phase(network, state) for state in self._states]
            own = phases[id(network)]
            self._rows.append((own, [phase.settled(current) for phase in own]))
        if board.turned:  # a scan selects lines by their numbers in the array
            self._rows.reverse()

    def deviations(self, period: float) -> Deviations:
        """See :meth:`._modes.RepeatedScan.deviations`."""
        waiting = (period - self.briefest) / (self._board.shape[1] if self._one_by_one else 1)
        seconds = [waiting if state.connected is None else self._acquisition for state in self._states]
        carried: dict[int, tuple[list[FloatArray], FloatArray]] = {}
        for phases, _ in self._rows:
            if id(phases) not in carried:
                each = [phase.carry(duration) for phase, duration in zip(phases, seconds, strict=True)]
                carried[id(phases)] = each, reduce(lambda before, next: next @ before, each)
        nodes = len(self._rows[0][1][0])
        state: FloatArray
        through: FloatArray
        # The state at the end of a frame that starts from zero; then the fixed point of a frame.
        through, state = np.eye(nodes), np.zeros(nodes)
        for phases, goals in self._rows:
            propagators, product = carried[id(phases)]
            through = product @ through
            for goal, propagator in zip(goals, propagators, strict=True):
                state = goal + propagator @ (state - goal)
        # Nodes that nothing is connected to stay at 0.
        state = np.asarray(np.linalg.lstsq(np.eye(nodes) - through, state, rcond=None)[0], dtype=np.float64)
        repeated, from_rest = np.empty((2, *self._board.shape))
        order = range(len(self._rows))[:: -1 if self._board.turned else 1]
        for row, (phases, goals) in zip(order, self._rows, strict=True):
            rested = np.zeros(nodes)
            for goal, propagator, reads in zip(goals, carried[id(phases)][0], self._states, strict=True):
                if reads.connected is not None:
                    rested[self._stored] = 0.0  # a shared capacitor starts each conversion at the reference
                state, rested = (goal + propagator @ (before - goal) for before in (state, rested))
                at = self._read_at(reads.read)
                repeated[row, reads.read], from_rest[row, reads.read] = (state - goal)[at], (rested - goal)[at]
        return Deviations(repeated, from_rest)

    @cached_property
    def unhurried(self) -> float:
        """See :meth:`._modes.RepeatedScan.unhurried`."""
        modes = self.modes()
        if not self._acquisition or not len(modes.rate):
            return 0.0
        return self.deviations(self.briefest + _LONG / float(-modes.rate.real.max())).largest

    def _possible_states(self) -> Iterator[SwitchState]:
        """The states of the switches in the order of a step."""
        every = np.arange(self._board.shape[1])
        none = every[:0]
        if not self._one_by_one:
            yield SwitchState(every, None, none if self._acquisition else every)
        turn = every[::-1] if self._board.turned else every
        for column in turn.tolist() if self._one_by_one or self._acquisition else ():
            only = every[[column]]
            loaded = only if self._one_by_one else every
            if self._one_by_one:
                yield SwitchState(loaded, None, none if self._acquisition else only)
            if self._acquisition:
                yield SwitchState(loaded, column, only)

    @abstractmethod
    def modes(self) -> Modes:
        """See :meth:`._modes.RepeatedScan.modes`."""

    @abstractmethod
    def _phase(self, network: FloatArray, state: SwitchState) -> P:
        """The circuit in one state of its switches, with the grid (M, M) in S as the column ends see it."""

    @abstractmethod
    def _read_at(self, columns: IntArray) -> IntArray:
        """Nodes whose voltages are converted when these columns are read."""

    @property
    @abstractmethod
    def _stored(self) -> slice:
        """Nodes of the sampling capacitors."""


def column_networks(board: Board, cells: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """The grid as the column ends see it while each row is selected, without loads.

    Yields:
        Conductance matrix (M, M) in S, the same object for rows that see the same; and the Norton currents (M,) in A of
        the drive.

    """
    rows, columns = board.shape
    network = terminate(exact_ports(board, cells).value, rows + board.pulled, board.column_lead).value
    every = np.arange(columns)

    def conductance(between: FloatArray, to_rows: FloatArray) -> FloatArray:
        matrix = -between
        matrix[every, every] = to_rows + between.sum(axis=1) - between[every, every]
        matrix[every, every] += _LEAK * max(float(matrix.max()), 1.0 / float(board.reference.max()))
        return matrix

    if not board.floating:
        grounded = conductance(network[rows:, rows:], network[rows:, :rows].sum(axis=1))
    if not board.floating:
        for row in range(rows):
            yield grounded, board.drive * network[row, rows:]
        return
    for alone, _ in one_driven(network, rows):
        held = len(alone) - columns  # the selected row, and the reference behind pull-downs
        yield conductance(alone[held:, held:], alone[:held, held:].sum(axis=0)), board.drive * alone[0, held:]
