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
from functools import cache, cached_property, reduce
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
    def _taps(self) -> list[tuple[int, ...]]:
        """What the sampling capacitors are connected to in each state of the switches, as :meth:`.Circuit.of` has it.

        Capacitors do not load amplifiers, so that one circuit with a capacitor on each output serves all columns.
        """
        board, adc, columns = self._board, self._board.adc, self._board.shape[1]
        amplifiers = board.circuit.virtual_ground
        samples = sampler_delay(board) > 0
        if not amplifiers and adc is not None:  # without a resistance a capacitor of its own joins its column
            samples = bool(adc.sampling_capacitance and (self._acquisition or adc.switch_resistance))

        def of(state: SwitchState) -> tuple[int, ...]:
            if not samples:
                return ()
            if self._acquisition and state.connected is None:
                return (-1,)
            if amplifiers:
                return tuple(range(columns, columns + len(state.loaded)))
            return tuple(range(columns)) if state.connected is None else (state.connected,)

        return [of(state) for state in self._states]

    @cached_property
    def _nodes(self) -> list[IntArray]:
        """Nodes (S,) of each phase's circuit that take part: of capacitors on all outputs the connected one."""
        found = []
        for state, taps in zip(self._states, self._taps, strict=True):
            one = self._acquisition and len(taps) > 1 and state.connected is not None
            capacitors = np.array([state.connected]) if one else np.arange(len(taps))
            found.append(np.append(np.arange(self._stored), self._stored + capacitors))
        return found

    def _read_at(self, columns: IntArray) -> IntArray:
        """Nodes whose voltages are converted when these columns are read."""
        capacitors = len(self._nodes[0]) - self._stored
        if capacitors:
            return self._stored + (columns if capacitors > 1 else np.zeros_like(columns))
        if not self._board.circuit.virtual_ground:
            return columns
        return self._first_output + (columns if len(self._states[0].loaded) > 1 else np.zeros_like(columns))

    def _phases(self, network: FloatArray) -> list[Circuit]:
        """The circuit in each state of its switches, with the grid (M, M) in S as the column ends see it."""

        @cache
        def of(loaded: tuple[int, ...], taps: tuple[int, ...]) -> Circuit:
            return Circuit.of(self._board, network, np.array(loaded, dtype=np.intp), taps)

        return [of(tuple(state.loaded.tolist()), taps) for state, taps in zip(self._states, self._taps, strict=True)]
