"""Dividers in time: propagators of the RC network of columns, loads and sampling capacitors over a repeated scan.

The nodes are the M column ends and, where a switch resistance separates them, the sampling capacitors. Each column end
has the capacitance of its line. The grid, reduced to its terminals, and the loads are the source resistances that
charge the capacitors. With the conductance matrix L and the diagonal matrix C of capacitances, the deviation d of the
node voltages from their settled values obeys ``C d' = -L d``. The matrix ``C^(-1/2) L C^(-1/2)`` is symmetric, so its
eigenvalues give the propagator for any stiffness (modal analysis of RC networks; Vlach and Singhal, "Computer Methods
for Circuit Analysis and Design"). Nodes without capacitance follow at once and are eliminated. A switch without
resistance joins its two nodes, which then share their charges.

A step consists of phases, in each of which the network does not change:

=========================  =======================================================================================
idle columns at loads      The columns settle together. With ``adc.acquisition_time``, one sampling capacitor is
                           connected to each column in turn at the end of the step.
idle columns open, or at   The columns have equal shares of the step, in which they alone have a load. With
the reference              ``adc.acquisition_time`` the sampling capacitor is connected at the end of a share.
=========================  =======================================================================================
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property, reduce
from typing import NamedTuple

import numpy as np

from ...common.arrays import FloatArray, IntArray
from .._board import Board
from .._grid import exact_ports
from ..readouts import terminate
from ..solvers import eliminate_leading
from ._modes import Deviations, Modes

_LEAK = 1e-18
"""of the largest conductance: gives a settled voltage to nodes that nothing is connected to"""
_SLOWEST = 1e-9
"""of the fastest rate: slower modes are those of nodes that keep their charge"""
_GROUNDED = 1e8
"""of the largest conductance: stands for the switch that keeps an idle column at the reference"""
_LONG = 60.0
"""time constants after which a deviation is below rounding"""


class DividerScan:
    """The repeated scan of constant cells by loads without amplifiers (:class:`._modes.RepeatedScan`)."""

    def __init__(self, board: Board, cells: FloatArray, settled: FloatArray) -> None:
        """Reduce the grid to its terminals.

        Args:
            board: with a divider.
            cells: (N, M) ohm.
            settled: (N, M) V, the settled readings.

        """
        self._board = board
        self._signal = float(np.abs(settled - board.level).max())
        adc, columns = board.adc, board.shape[1]
        self._acquisition = adc.acquisition_time if adc else 0.0
        self.briefest = self._acquisition * columns
        self._capacitors = _Capacitors(
            columns=np.full(columns, board.readout.column_capacitance),
            sampling=adc.sampling_capacitance if adc else 0.0,
            switch=adc.switch_resistance if adc else 0.0,
            shared=self._acquisition > 0,
        )
        self._one_by_one = board.circuit.columns_one_by_one(board)
        self._states = list(self._possible_states())
        phases: dict[int, list[_Phase]] = {}
        self._rows: list[tuple[list[_Phase], list[FloatArray]]] = []
        """phases of each row and their settled voltages (S,); rows with the same network share their phases"""
        seen = list(_rows(board, cells))  # all alive, so that their identities differ
        for network, current in seen:
            if id(network) not in phases:
                phases[id(network)] = [self._phase(network, state) for state in self._states]
            own = phases[id(network)]
            self._rows.append((own, [phase.settled(current) for phase in own]))

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
        for row, (phases, goals) in enumerate(self._rows):
            rested = np.zeros(nodes)
            for goal, propagator, reads in zip(goals, carried[id(phases)][0], self._states, strict=True):
                if reads.connected is not None:
                    rested[self._board.shape[1] :] = 0.0  # a shared capacitor starts each conversion at the reference
                state, rested = (goal + propagator @ (before - goal) for before in (state, rested))
                at = self._capacitors.read_at(reads.read)
                repeated[row, reads.read], from_rest[row, reads.read] = (state - goal)[at], (rested - goal)[at]
        return Deviations(repeated, from_rest)

    def modes(self) -> Modes:
        """See :meth:`._modes.RepeatedScan.modes`."""
        rates = np.concatenate([phase.rates for phases, _ in self._rows for phase in phases])
        rates = np.unique(rates[rates > _SLOWEST * rates.max(initial=0.0)])
        share = self._board.shape[1] if self._one_by_one else 1  # of the waiting time
        return Modes(-rates.astype(np.complex128) / share, np.full(len(rates), 2.0 * self._signal))

    @cached_property
    def unhurried(self) -> float:
        """See :meth:`._modes.RepeatedScan.unhurried`."""
        modes = self.modes()
        if not self._acquisition or not len(modes.rate):
            return 0.0
        return self.deviations(self.briefest + _LONG / float(-modes.rate.real.max())).largest

    def _possible_states(self) -> Iterator[_State]:
        """The states of the switches in the order of a step."""
        every = np.arange(self._board.shape[1])
        none = every[:0]
        if not self._one_by_one:
            yield _State(every, None, none if self._acquisition else every)
        for column in every.tolist() if self._one_by_one or self._acquisition else ():
            only = every[[column]]
            loaded = only if self._one_by_one else every
            if self._one_by_one:
                yield _State(loaded, None, none if self._acquisition else only)
            if self._acquisition:
                yield _State(loaded, column, only)

    def _phase(self, network: FloatArray, state: _State) -> _Phase:
        conductance = network.copy()
        conductance[state.loaded, state.loaded] += 1.0 / self._board.reference[state.loaded]
        if self._board.idle_columns == "ground":
            idle = np.delete(np.arange(len(network)), state.loaded)
            np.add.at(conductance, (idle, idle), _GROUNDED * conductance.max())
        return _Phase.of(*self._capacitors.joined(conductance, state.connected))


class _State(NamedTuple):
    """Switches of the columns during one phase of a step."""

    loaded: IntArray
    """columns that end in their loads"""
    connected: int | None
    """column that a shared sampling capacitor is connected to"""
    read: IntArray
    """columns that are read at the end of the phase"""


def _rows(board: Board, cells: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
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
    for row in range(rows):
        if not board.floating:
            yield grounded, board.drive * network[row, rows:]
            continue
        order = np.r_[np.delete(np.arange(rows), row), row, rows : len(network)]
        alone = eliminate_leading(network[np.ix_(order, order)], rows - 1).value
        held = len(alone) - columns  # the selected row, and the reference behind pull-downs
        yield conductance(alone[held:, held:], alone[:held, held:].sum(axis=0)), board.drive * alone[0, held:]


class _Capacitors(NamedTuple):
    """The capacitors of columns and converter, and the switches between them."""

    columns: FloatArray
    """(M,) F"""
    sampling: float
    """F"""
    switch: float
    """ohm"""
    shared: bool
    """whether one sampling capacitor serves all columns"""

    def read_at(self, columns: IntArray) -> IntArray:
        """Nodes whose voltages are converted when these columns are read."""
        if not self.sampling or (not self.shared and not self.switch):
            return columns
        count = len(self.columns)
        return np.full(len(columns), count) if self.shared else count + columns

    def joined(self, conductance: FloatArray, connected: int | None) -> tuple[FloatArray, FloatArray, IntArray]:
        """The network (S, S) of all nodes, their capacitances (S,), and the node (S,) that each one is part of."""
        count = len(self.columns)
        if not self.sampling or (not self.shared and not self.switch):
            return conductance, self.columns + (0.0 if self.shared else self.sampling), np.arange(count)
        extra = 1 if self.shared else count
        network = np.zeros((count + extra, count + extra))
        network[:count, :count] = conductance
        capacitance = np.concatenate([self.columns, np.full(extra, self.sampling)])
        part_of = np.arange(count + extra)
        if not self.shared:
            pairs = [(column, count + column) for column in range(count)]
        else:
            pairs = [] if connected is None else [(connected, count)]
        for column, sample in pairs:
            if self.switch:
                through = 1.0 / self.switch
                network[[column, sample], [column, sample]] += through
                network[[column, sample], [sample, column]] -= through
            else:
                part_of[sample] = column
        return network, capacitance, part_of


class _Phase(NamedTuple):
    """A network that does not change for some time, by its modes: ``d(t) = back exp(-rates t) into d(0)``."""

    rates: FloatArray
    """(D,) 1/s"""
    into: FloatArray
    """(D, S) from the deviations of all nodes"""
    back: FloatArray
    """(S, D) to the deviations of all nodes"""
    response: FloatArray
    """(S, S) ohm: settled voltages by currents into the nodes"""

    @classmethod
    def of(cls, network: FloatArray, capacitance: FloatArray, part_of: IntArray) -> _Phase:
        """Args: conductance matrix (S, S), capacitances (S,), and the node (S,) that each node is part of."""
        own = np.unique(part_of)
        expand = (part_of[:, None] == own).astype(float)  # (S, own nodes): voltages of all nodes
        joint, charge = expand.T @ network @ expand, capacitance @ expand
        moving, at_once = np.flatnonzero(charge > 0), np.flatnonzero(charge <= 0)
        held = np.flatnonzero(np.diagonal(joint) > 0)
        response = np.zeros(joint.shape)
        response[np.ix_(held, held)] = np.linalg.inv(joint[np.ix_(held, held)])
        follow = np.zeros((len(own), len(moving)))
        follow[moving, np.arange(len(moving))] = 1.0
        if len(at_once):
            follow[at_once] = -np.linalg.solve(joint[np.ix_(at_once, at_once)], joint[np.ix_(at_once, moving)])
        root = np.sqrt(charge[moving])
        rates, shapes = np.linalg.eigh(follow.T @ joint @ follow / root / root[:, None])
        share = expand.T[moving] * capacitance / charge[moving, None]
        return cls(
            rates=np.maximum(rates, 0.0),
            into=shapes.T @ (root[:, None] * share),
            back=expand @ follow @ (shapes / root[:, None]),
            response=expand @ response @ expand.T,
        )

    def carry(self, seconds: float) -> FloatArray:
        """Propagator (S, S) of the deviations over a time in s."""
        return self.back @ (np.exp(-self.rates * seconds)[:, None] * self.into)

    def settled(self, current: FloatArray) -> FloatArray:
        """Settled voltages (S,) with these currents (M,) into the column ends."""
        return self.response[:, : len(current)] @ current
