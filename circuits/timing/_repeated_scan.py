"""The repeated scan of constant cells in time, for every circuit of :mod:`._circuit`.

A step consists of phases, in each of which no switch moves:

=========================  =======================================================================================
an amplifier on each       The columns settle together. With ``adc.acquisition_time``, one sampling capacitor is
column; idle columns at    connected to each column in turn at the end of the step, in the order of their numbers in
loads                      the array.
one amplifier; idle        The columns have equal shares of the step, in which they alone have the load or the
columns open, or at the    amplifier, in the order of their numbers in the array. With ``adc.acquisition_time`` the
reference                  sampling capacitor is connected at the end of a share.
=========================  =======================================================================================

The phases are linear, so that their propagators are exact, however stiff the circuit. The steady state of a repeated
scan is the fixed point of a whole frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property, reduce
from typing import NamedTuple

import numpy as np

from ...common.arrays import ComplexArray, FloatArray, IntArray
from .._board import Board
from ._circuit import Circuit, column_networks, sampler_delay

_SLOWEST = 1e-9
"""of the fastest rate: slower modes are those of nodes that keep their charge"""
_LONG = 60.0
"""time constants after which a deviation is below rounding"""
_NEGLIGIBLE = 1e-3  # of the limit: sum of all modes that are neglected


class Deviations(NamedTuple):
    """Deviations in V from the settled readings, (N, M) in line coordinates."""

    repeated: FloatArray
    """of a scan that repeats endlessly over the same cells"""
    from_rest: FloatArray
    """of rows that each follow a row without signal"""

    @property
    def largest(self) -> float:
        """V, of both scans."""
        return float(max(np.abs(self.repeated).max(), np.abs(self.from_rest).max()))


class Modes(NamedTuple):
    """Exponential modes whose sum is the deviation of a sample."""

    rate: ComplexArray
    """1/s, eigenvalues"""
    size: FloatArray
    """V, largest amplitude at the start of a step"""

    def envelope(self, waiting: float) -> FloatArray:
        """Bound in V on each mode in a sample taken ``waiting`` s after a row switch, earlier steps included."""
        decay = self.rate.real * waiting
        envelope: FloatArray = self.size * np.exp(decay) / np.maximum(-np.expm1(decay), 1e-300)
        return envelope

    def settled_after(self, allowed: float) -> float:
        """Seconds after which the sum of all modes stays within ``allowed`` V."""
        least = 1.0 / float(np.abs(self.rate).max())
        while self.envelope(least).sum() > allowed:
            least *= 1.2
        return least

    def step(self, waiting: float, allowed: float) -> float:
        """Step in s of the search, short enough that the sum of the modes that still matter is nearly straight."""
        matter = self.envelope(waiting) > _NEGLIGIBLE * allowed / len(self.rate)
        fastest = float(np.abs(self.rate[matter]).max(initial=0.0))
        return min(0.1 * waiting, 0.25 / fastest) if fastest else 0.1 * waiting


class SwitchState(NamedTuple):
    """Switches of the columns during one phase of a step."""

    loaded: IntArray
    """columns that end in their loads, or in an amplifier"""
    connected: int | None
    """column that a shared sampling capacitor is connected to"""
    read: IntArray
    """columns that are read at the end of the phase"""


class RepeatedScan:
    """Prepared once, then evaluated for any row period."""

    def __init__(self, board: Board, cells: FloatArray) -> None:
        """For cells (N, M) in ohm, on a board with amplifiers that hold their columns, or with loads."""
        self._board = board
        adc, columns = board.adc, board.shape[1]
        self._acquisition = adc.acquisition_time if adc else 0.0
        self.briefest = self._acquisition * columns
        """shortest row period in s: the acquisitions of all columns, if one sampling capacitor serves them"""
        self._one_by_one = board.circuit.columns_one_by_one(board)
        self._states = list(self._possible_states())
        phases: dict[int, list[Circuit]] = {}
        self._rows: list[tuple[list[Circuit], list[FloatArray]]] = []
        """phases of each row and their settled voltages (S,); rows with the same network share their phases"""
        for network, current in list(column_networks(board, cells)):  # all alive: their identities differ
            if id(network) not in phases:
                phases[id(network)] = self._phases(network)
            own = phases[id(network)]
            goals = [phase.settled(current)[nodes] for phase, nodes in zip(own, self._nodes, strict=True)]
            self._rows.append((own, goals))
        if board.turned:  # a scan selects lines by their numbers in the array
            self._rows.reverse()

    def deviations(self, period: float) -> Deviations:
        """Deviations of the samples if each row is selected for ``period`` s, which is at least :attr:`briefest`."""
        waiting = (period - self.briefest) / self._share
        seconds = [waiting if state.connected is None else self._acquisition for state in self._states]
        last = [goals[-1] for _, goals in self._rows]
        count, nodes = len(last), len(last[0])
        before = np.stack([last[row - 1] for row in range(count)], axis=1)  # (S, N)
        groups = {id(phases): phases for phases, _ in self._rows}
        members = {key: [row for row in range(count) if id(self._rows[row][0]) == key] for key in groups}
        carried = {key: self._propagators(phases, seconds) for key, phases in groups.items()}
        # How far a row that begins at the goal of the row before ends from its own goal; the propagators of earlier
        # deviations through a row; and the fixed point of a whole frame.
        added = np.empty((nodes, count))
        for key, rows in members.items():
            *_, (_, _, ended) = self._run(carried[key], rows, before[:, rows])
            added[:, rows] = ended
        products = {key: reduce(lambda before, next: next @ before, each) for key, each in carried.items()}
        through, deviation = np.eye(nodes), np.zeros(nodes)
        for row, (phases, _) in enumerate(self._rows):
            through, deviation = products[id(phases)] @ through, products[id(phases)] @ deviation + added[:, row]
        # Nodes that nothing is connected to do not move.
        deviation = np.asarray(np.linalg.lstsq(np.eye(nodes) - through, deviation, rcond=None)[0], dtype=np.float64)
        start = before.copy()
        for row, (phases, _) in enumerate(self._rows):
            start[:, row] += deviation
            deviation = products[id(phases)] @ deviation + added[:, row]
        repeated, from_rest = np.empty((2, *self._board.shape))
        for key, rows in members.items():
            places = np.array([count - 1 - row for row in rows] if self._board.turned else rows)
            at_rest = groups[key][0].rest[self._nodes[0]]
            both = np.concatenate([start[:, rows], np.repeat(at_rest[:, None], len(rows), axis=1)], axis=1)
            for state, at, ended in self._run(carried[key], [*rows, *rows], both, resting=len(rows)):
                repeated[np.ix_(places, state.read)], from_rest[np.ix_(places, state.read)] = (
                    part[at].T for part in np.split(ended, 2, axis=1)
                )
        return Deviations(repeated, from_rest)

    def _propagators(self, phases: list[Circuit], seconds: list[float]) -> list[FloatArray]:
        """Propagator (S, S) of the deviations through each phase of a step."""
        known = {(id(phase), duration): phase for phase, duration in zip(phases, seconds, strict=True)}
        whole = {key: phase.after(np.eye(phase.into.shape[1]), key[1]) for key, phase in known.items()}
        keys = zip(map(id, phases), seconds, strict=True)
        return [whole[key][np.ix_(nodes, nodes)] for key, nodes in zip(keys, self._nodes, strict=True)]

    def _run(
        self, propagators: list[FloatArray], rows: list[int], volts: FloatArray, resting: int = 0
    ) -> Iterator[tuple[SwitchState, IntArray, FloatArray]]:
        """Carry node voltages (S, R) at the beginning of some rows' steps through the phases.

        A shared capacitor starts each conversion of the last ``resting`` of them at the reference.

        Yields:
            For each phase its state, the nodes that are read, and the deviations (S, R) at its end.

        """
        for number, (state, propagator) in enumerate(zip(self._states, propagators, strict=True)):
            goals = np.stack([self._rows[row][1][number] for row in rows], axis=1)
            if state.connected is not None and resting:
                volts[self._stored :, -resting:] = 0.0
            deviation = propagator @ (volts - goals)
            yield state, self._read_at(state.read), deviation
            volts = goals + deviation

    @cached_property
    def unhurried(self) -> float:
        """V of deviation that remains at any row period: a shared capacitor's memory of the previous conversion."""
        modes = self.modes()
        if not self._acquisition or not len(modes.rate):
            return 0.0
        return self.deviations(self.briefest + _LONG / float(-modes.rate.real.max())).largest

    def modes(self) -> Modes:
        """Modes of :meth:`deviations` after the waiting time, which is the row period less :attr:`briefest`."""
        largest = 2.0 * np.max([np.abs(goal) for _, goals in self._rows for goal in goals], axis=0)  # (S,)
        found: dict[int, tuple[ComplexArray, FloatArray]] = {}
        for phases, _ in self._rows:
            for phase, state, nodes in zip(phases, self._states, self._nodes, strict=True):
                read = np.abs(phase.left[nodes[self._read_at(state.read)]]).max(axis=0, initial=0.0)
                size = read * (np.abs(phase.right[:, nodes]) @ largest)
                found[id(phase)] = phase.rates, np.maximum(size, found.get(id(phase), (size, size))[1])
        rate, size = (np.concatenate(part) for part in zip(*found.values(), strict=True))
        alive = (rate.real > _SLOWEST * rate.real.max(initial=0.0)) & (size > 0.0)
        return Modes(-rate[alive] / self._share, size[alive])

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

    @property
    def _share(self) -> int:
        """Parts of a step's waiting time that columns have in turn."""
        return self._board.shape[1] if self._one_by_one else 1

    @cached_property
    def _stored(self) -> int:
        """First node of a sampling capacitor."""
        return self._first_output + (len(self._states[0].loaded) if self._board.circuit.virtual_ground else 0)

    @property
    def _first_output(self) -> int:
        """First node of an amplifier's output."""
        columns = self._board.shape[1]
        goes_round = self._board.circuit.virtual_ground and len(self._states[0].loaded) < columns
        return columns + goes_round

    @cached_property
    def _samples(self) -> bool:
        """Whether sampling capacitors are nodes of their own."""
        adc = self._board.adc
        if self._board.circuit.virtual_ground or adc is None:
            return sampler_delay(self._board) > 0
        return bool(adc.sampling_capacitance and (self._acquisition or adc.switch_resistance))

    def _read_at(self, columns: IntArray) -> IntArray:
        """Nodes whose voltages are converted when these columns are read."""
        alone = self._board.circuit.virtual_ground and self._one_by_one  # one amplifier, one capacitor
        place = np.zeros_like(columns) if alone or (self._samples and self._acquisition) else columns
        outputs = self._first_output if self._board.circuit.virtual_ground else 0
        return (self._stored if self._samples else outputs) + place

    def _phases(self, network: FloatArray) -> list[Circuit]:
        """The circuit in each state of its switches, with the grid (M, M) in S as the column ends see it."""
        board, columns = self._board, self._board.shape[1]
        if not self._samples:
            known = {state.loaded.tobytes(): Circuit.of(board, network, state.loaded, ()) for state in self._states}
            return [known[state.loaded.tobytes()] for state in self._states]
        if not board.circuit.virtual_ground:
            each = np.arange(columns).tolist()
            return [
                Circuit.of(board, network, state.loaded, [_tap(state)] if self._acquisition else each)
                for state in self._states
            ]
        if self._one_by_one:
            taps = [-1 if self._acquisition and state.connected is None else columns for state in self._states]
            return [Circuit.of(board, network, s.loaded, [tap]) for s, tap in zip(self._states, taps, strict=True)]
        # Capacitors do not load the amplifiers, so that one circuit with a capacitor on each output serves all states.
        every = Circuit.of(board, network, self._states[0].loaded, range(columns, 2 * columns))
        if not self._acquisition:
            return [every]
        idle = Circuit.of(board, network, self._states[0].loaded, [-1])
        return [idle if state.connected is None else every for state in self._states]

    @cached_property
    def _nodes(self) -> list[IntArray]:
        """Nodes (S,) of each phase's circuit that take part: of capacitors on all outputs the connected one."""
        columns = self._board.shape[1]
        one = self._acquisition or (self._board.circuit.virtual_ground and self._one_by_one)
        chosen = np.zeros(len(self._states), dtype=np.intp)
        if self._acquisition and self._board.virtual_grounds:
            chosen = np.array([state.connected or 0 for state in self._states])
        capacitors = 0 if not self._samples else 1 if one else columns
        return [np.append(np.arange(self._stored), self._stored + each + np.arange(capacitors)) for each in chosen]


def _tap(state: SwitchState) -> int:
    return -1 if state.connected is None else state.connected
