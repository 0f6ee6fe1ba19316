"""The repeated scan of constant cells in time, of many boards at once, for every circuit of :mod:`._circuit`.

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
from .._design import Design
from .._population import Boards
from ._circuit import NEGLIGIBLE, ROUNDING, Circuit, ColumnNetworks, sampler_delay

_LONG = 60.0
"""time constants after which a deviation is below rounding"""


class Deviations(NamedTuple):
    """Deviations in V from the settled readings, (B, N, M) in line coordinates."""

    repeated: FloatArray
    """of a scan that repeats endlessly over the same cells"""
    from_rest: FloatArray
    """of rows that each follow a row without signal"""

    @property
    def larger(self) -> FloatArray:
        """(B, N, M) V: the magnitude of the larger one of both scans."""
        larger: FloatArray = np.maximum(np.abs(self.repeated), np.abs(self.from_rest))
        return larger


class Modes(NamedTuple):
    """Exponential modes of B boards whose sum is the deviation of a sample; modes that do not count are of size 0."""

    rate: ComplexArray
    """(B, D) 1/s, eigenvalues"""
    size: FloatArray
    """(B, D) V, largest amplitude at the start of a step"""

    @property
    def slowest(self) -> FloatArray:
        """(B,) 1/s, rate of the slowest mode; inf where there is none."""
        slowest: FloatArray = -self.rate.real.max(axis=-1, initial=-np.inf)
        return slowest

    def envelope(self, waiting: FloatArray) -> FloatArray:
        """Bound (B, D) in V on each mode in a sample taken ``waiting`` s (B,) after a row switch, earlier steps
        included."""
        decay = np.where(self.size > 0.0, self.rate.real, -1.0) * waiting[:, None]
        envelope: FloatArray = self.size * np.exp(decay) / np.maximum(-np.expm1(decay), 1e-300)
        return envelope

    def settled_after(self, allowed: FloatArray) -> FloatArray:
        """(B,) seconds after which the sum of all modes stays within ``allowed`` V (B,)."""
        fastest = np.abs(np.where(self.size > 0.0, self.rate, 0.0)).max(axis=-1, initial=0.0)
        least: FloatArray = np.divide(1.0, fastest, out=np.zeros_like(fastest), where=fastest > 0)
        while (late := (self.envelope(least).sum(axis=-1) > allowed) & (fastest > 0)).any():
            least[late] *= 1.2
        return least

    def step(self, waiting: FloatArray, allowed: FloatArray) -> FloatArray:
        """Step (B,) in s of the search, short enough that the sum of the modes that still matter is nearly straight."""
        matter = self.envelope(waiting) > NEGLIGIBLE * allowed[:, None] / max(self.rate.shape[-1], 1)
        fastest = np.abs(np.where(matter, self.rate, 0.0)).max(axis=-1, initial=0.0)
        straight = np.divide(0.25, fastest, out=np.full_like(fastest, np.inf), where=fastest > 0)
        step: FloatArray = np.minimum(0.1 * waiting, straight)
        return step


class SwitchState(NamedTuple):
    """Switches of the columns during one phase of a step."""

    loaded: IntArray
    """columns that end in their loads, or in an amplifier"""
    connected: int | None
    """column that a shared sampling capacitor is connected to"""
    read: IntArray
    """columns that are read at the end of the phase"""


class RepeatedScan:
    """Prepared once for B boards, then evaluated for any row period."""

    def __init__(self, design: Design, boards: Boards, cells: FloatArray) -> None:
        """For boards in line coordinates with cells (B, N, M) in ohm: amplifiers that hold their columns, or loads."""
        self._board = board = design.board
        adc, columns = board.adc, board.shape[1]
        self._acquisition = adc.acquisition_time if adc else 0.0
        self.briefest = self._acquisition * columns
        """shortest row period in s: the acquisitions of all columns, if one sampling capacitor serves them"""
        self._one_by_one = board.circuit.columns_one_by_one(board)
        self._states = list(self._possible_states())
        networks = ColumnNetworks.of(design, boards, cells)
        self._groups = [self._phases(boards, networks.conductance[:, g]) for g in range(networks.conductance.shape[1])]
        """phases of each row's step, or those that all rows share"""
        rows = range(board.shape[0])
        self._order = (
            list(reversed(rows)) if board.transposed else list(rows)
        )  # a scan goes by the array's line numbers
        current = networks.current.swapaxes(1, 2)
        shared = len(self._groups) == 1
        of_group = [current if shared else current[..., [row]] for row in range(len(self._groups))]
        goals = [
            [phases[number].settled(applied)[:, nodes] for phases, applied in zip(self._groups, of_group, strict=True)]
            for number, nodes in enumerate(self._nodes)
        ]
        self._goals = np.stack([np.concatenate(parts, axis=-1) for parts in goals])
        """(phases, B, S, N) V, settled"""

    @property
    def settled(self) -> FloatArray:
        """(B, N, M) V at the converter after a long time, against the reference."""
        found = np.empty((self._goals.shape[1], *self._board.shape))
        for number, state in enumerate(self._states):
            if len(state.read):
                found[:, :, state.read] = self._goals[number][:, self._read_at(state.read)].swapaxes(1, 2)
        return found

    def _group(self, row: int) -> int:
        return row if len(self._groups) > 1 else 0

    def deviations(self, period: FloatArray | float) -> Deviations:
        """Deviations of the samples if each row is selected for ``period`` s (B,), at least :attr:`briefest`."""
        waiting = (np.asarray(period, dtype=np.float64) - self.briefest) / self._share
        seconds = [waiting if state.connected is None else self._acquisition for state in self._states]
        order, last = self._order, self._goals[-1]
        carried = [self._propagators(phases, seconds) for phases in self._groups]
        members = [[row for row in order if self._group(row) == g] for g in range(len(carried))]
        batch, nodes, _ = last.shape
        before = np.empty_like(last)
        before[..., order] = last[..., np.roll(order, 1)]
        # How far a row that begins at the goal of the row before ends from its own goal; the propagators of earlier
        # deviations through a row; and the fixed point of a whole frame.
        added = np.empty_like(last)
        for propagators, rows in zip(carried, members, strict=True):
            *_, (_, _, ended) = self._run(propagators, rows, before[..., rows])
            added[..., rows] = ended
        products = [reduce(lambda before, next: next @ before, each) for each in carried]
        through = np.broadcast_to(np.eye(nodes), (batch, nodes, nodes))
        deviation = np.zeros((batch, nodes, 1))
        for row in order:
            product = products[self._group(row)]
            through, deviation = product @ through, product @ deviation + added[..., [row]]
        deviation = _fixed_point(through, deviation)
        start = before.copy()
        for row in order:
            start[..., [row]] += deviation
            deviation = products[self._group(row)] @ deviation + added[..., [row]]
        repeated, from_rest = np.empty((2, batch, *self._board.shape))
        for g, rows in enumerate(members):
            at_rest = np.broadcast_to(self._groups[g][0].rest[:, self._nodes[0], None], (batch, nodes, len(rows)))
            both = np.concatenate([start[..., rows], at_rest], axis=-1)
            for state, at, ended in self._run(carried[g], [*rows, *rows], both, resting=len(rows)):
                for scan, part in zip((repeated, from_rest), np.split(ended, 2, axis=-1), strict=True):
                    scan[:, np.array(rows)[:, None], state.read] = part[:, at].swapaxes(1, 2)
        return Deviations(repeated, from_rest)

    def _propagators(self, phases: list[Circuit], seconds: list[FloatArray | float]) -> list[FloatArray]:
        """Propagator (B, S, S) of the deviations through each phase of a step."""
        known: dict[tuple[int, bool], FloatArray] = {}
        for phase, state, duration in zip(phases, self._states, seconds, strict=True):
            if (key := (id(phase), state.connected is None)) not in known:
                known[key] = phase.after(np.eye(phase.into.shape[-1])[None], duration)
        return [
            known[id(phase), state.connected is None][:, nodes[:, None], nodes]
            for phase, state, nodes in zip(phases, self._states, self._nodes, strict=True)
        ]

    def _run(
        self, propagators: list[FloatArray], rows: list[int], volts: FloatArray, resting: int = 0
    ) -> Iterator[tuple[SwitchState, IntArray, FloatArray]]:
        """Carry node voltages (B, S, R) at the beginning of some rows' steps through the phases.

        A shared capacitor starts each conversion of the last ``resting`` of them at the reference.

        Yields:
            For each phase its state, the nodes that are read, and the deviations (B, S, R) at its end.

        """
        for number, (state, propagator) in enumerate(zip(self._states, propagators, strict=True)):
            goals = self._goals[number][..., rows]
            if state.connected is not None and resting:
                volts[:, self._stored :, -resting:] = 0.0
            deviation = propagator @ (volts - goals)
            yield state, self._read_at(state.read), deviation
            volts = goals + deviation

    @cached_property
    def unhurried(self) -> Deviations:
        """Deviations that remain at any row period: a shared capacitor's memory of the last conversion."""
        modes = self.modes()
        if not self._acquisition or not modes.rate.shape[-1]:
            nothing = np.zeros((self._goals.shape[1], *self._board.shape))
            return Deviations(nothing, nothing)
        return self.deviations(self.briefest + _LONG / modes.slowest)

    def modes(self) -> Modes:
        """Modes of :meth:`deviations` after the waiting time, which is the row period less :attr:`briefest`."""
        largest = 2.0 * np.abs(self._goals).max(axis=(0, 3))  # (B, S)
        found: dict[int, tuple[ComplexArray, FloatArray]] = {}
        for phases in self._groups:
            for phase, state, nodes in zip(phases, self._states, self._nodes, strict=True):
                read = np.abs(phase.left[:, nodes[self._read_at(state.read)]]).max(axis=1, initial=0.0)
                size = read * (np.abs(phase.right[:, :, nodes]) @ largest[..., None])[..., 0]
                found[id(phase)] = phase.rates, np.maximum(size, found.get(id(phase), (size, size))[1])
        rate, size = (np.concatenate(part, axis=-1) for part in zip(*found.values(), strict=True))
        # Slower modes are those of nodes that keep their charge.
        alive = (rate.real > ROUNDING * rate.real.max(axis=-1, keepdims=True, initial=0.0)) & (size > 0.0)
        return Modes(np.where(alive, -rate / self._share, -np.inf), np.where(alive, size, 0.0))

    def _possible_states(self) -> Iterator[SwitchState]:
        """The states of the switches in the order of a step."""
        every = np.arange(self._board.shape[1])
        none = every[:0]
        if not self._one_by_one:
            yield SwitchState(every, None, none if self._acquisition else every)
        turn = every[::-1] if self._board.transposed else every
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

    def _phases(self, boards: Boards, network: FloatArray) -> list[Circuit]:
        """The circuits in each state of the switches, with the grids (B, M, M) in S as the column ends see them."""
        known: dict[tuple[tuple[int, ...], tuple[int, ...]], Circuit] = {}
        for state, taps in zip(self._states, self._taps, strict=True):
            if (key := (tuple(state.loaded.tolist()), taps)) not in known:
                known[key] = Circuit.of(boards, self._board, network, state.loaded, taps)
        keys = zip((tuple(state.loaded.tolist()) for state in self._states), self._taps, strict=True)
        return [known[key] for key in keys]


def _fixed_point(through: FloatArray, added: FloatArray) -> FloatArray:
    """(B, S, 1) the deviation d = through d + added; that of nodes that nothing is connected to is 0."""
    nodes = through.shape[-1]
    kept = np.abs(np.diagonal(through, axis1=1, axis2=2)).max(axis=-1, initial=0.0) > 1.0 - ROUNDING
    found = np.empty_like(added)
    found[~kept] = np.linalg.solve(np.eye(nodes) - through[~kept], added[~kept])
    found[kept] = np.linalg.pinv(np.eye(nodes) - through[kept]) @ added[kept]
    return found
