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
from .._board import Board
from .._design import Design
from .._population import Boards
from .._tuning import LONG, NEGLIGIBLE, ROUNDING
from ._circuit import Circuit, ColumnNetworks, sampler_delay


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
    taps: tuple[int, ...]
    """of the sampling capacitors, as :meth:`.Circuit.of` has them"""
    waits: bool
    """whether the phase has a share of the waiting time; else it takes an acquisition of a shared capacitor"""
    nodes: IntArray
    """(S,) nodes of the circuit that take part: of capacitors on all outputs the connected one"""
    stored: int
    """the first of them that is a capacitor"""
    read: IntArray
    """columns that are read at the end of the phase"""
    at: IntArray
    """the node whose voltage is then converted, of each of them, among those that take part"""

    @classmethod
    def of_step(cls, board: Board) -> Iterator[SwitchState]:
        """The states in the order of a step."""
        adc, amplified, columns = board.adc, board.circuit.virtual_ground, board.shape[1]
        shared = bool(adc and adc.acquisition_time)
        one_by_one = board.circuit.columns_one_by_one(board)
        loads = 1 if one_by_one else columns
        outputs = columns + (amplified and one_by_one)  # behind the input of an amplifier that goes round
        stored = outputs + (loads if amplified else 0)
        samples = sampler_delay(board) > 0
        if not amplified and adc is not None:  # without a resistance a capacitor of its own joins its column
            samples = bool(adc.sampling_capacitance and (shared or adc.switch_resistance))

        def state(loaded: IntArray, connected: int | None, read: IntArray) -> SwitchState:
            if not samples:
                taps: tuple[int, ...] = ()
            elif shared and connected is None:
                taps = (-1,)
            elif amplified:  # capacitors do not load amplifiers: one circuit with one on each output serves all columns
                taps = tuple(range(columns, columns + loads))
            else:
                taps = tuple(range(columns)) if connected is None else (connected,)
            one = shared and len(taps) > 1 and connected is not None
            capacitors = np.array([connected]) if one else np.arange(len(taps))
            first = stored if len(capacitors) else outputs if amplified else 0
            single = len(capacitors) == 1 or (amplified and loads == 1 and not len(capacitors))
            nodes = np.append(np.arange(stored), stored + capacitors)
            waits = connected is None
            return cls(loaded, taps, waits, nodes, stored, read, first + (np.zeros_like(read) if single else read))

        every = np.arange(columns)
        if not one_by_one:
            yield state(every, None, every[:0] if shared else every)
        for column in (every[::-1] if board.transposed else every).tolist() if one_by_one or shared else ():
            only = every[[column]]
            if one_by_one:
                yield state(only, None, every[:0] if shared else only)
            if shared:
                yield state(only if one_by_one else every, column, only)


class RepeatedScan:
    """Prepared once for B boards, then evaluated for any row period."""

    def __init__(self, design: Design, boards: Boards, cells: FloatArray) -> None:
        """For boards with cells (B, rows, columns) in ohm: amplifiers that hold their columns, or loads."""
        self._board = board = design.board
        adc, columns = board.adc, board.shape[1]
        self._acquisition = adc.acquisition_time if adc else 0.0
        self.briefest = self._acquisition * columns
        """shortest row period in s: the acquisitions of all columns, if one sampling capacitor serves them"""
        self._share = columns if board.circuit.columns_one_by_one(board) else 1
        """parts of a step's waiting time that columns have in turn"""
        self._states = list(SwitchState.of_step(board))
        networks = ColumnNetworks.of(design, boards, cells)
        self._groups = [self._phases(networks, group) for group in range(networks.conductance.shape[1])]
        """phases of each row's step, or those that all rows share"""
        # A scan goes by the array's line numbers.
        self._order = np.arange(board.shape[0])[:: -1 if board.transposed else 1].tolist()
        current = networks.current.swapaxes(1, 2)
        shared = len(self._groups) == 1
        of_group = [current if shared else current[..., [row]] for row in range(len(self._groups))]
        goals = [
            [each[n].settled(applied)[:, state.nodes] for each, applied in zip(self._groups, of_group, strict=True)]
            for n, state in enumerate(self._states)
        ]
        self._goals = np.stack([np.concatenate(parts, axis=-1) for parts in goals])
        """(phases, B, S, N) V, settled"""

    @property
    def settled(self) -> FloatArray:
        """(B, N, M) V at the converter after a long time, against the reference."""
        found = np.empty((self._goals.shape[1], *self._board.shape))
        for number, state in enumerate(self._states):
            if len(state.read):
                found[:, :, state.read] = self._goals[number][:, state.at].swapaxes(1, 2)
        return found

    def _group(self, row: int) -> int:
        return row if len(self._groups) > 1 else 0

    def deviations(self, period: FloatArray | float) -> Deviations:
        """Deviations of the samples if each row is selected for ``period`` s (B,), at least :attr:`briefest`."""
        waiting = (np.asarray(period, dtype=np.float64) - self.briefest) / self._share
        seconds = [waiting if state.waits else self._acquisition for state in self._states]
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
            *_, (_, ended) = self._run(propagators, rows, before[..., rows])
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
            at_rest = np.broadcast_to(
                self._groups[g][0].rest[:, self._states[0].nodes, None], (batch, nodes, len(rows))
            )
            both = np.concatenate([start[..., rows], at_rest], axis=-1)
            for state, ended in self._run(carried[g], [*rows, *rows], both, resting=len(rows)):
                for scan, part in zip((repeated, from_rest), np.split(ended, 2, axis=-1), strict=True):
                    scan[:, np.array(rows)[:, None], state.read] = part[:, state.at].swapaxes(1, 2)
        return Deviations(repeated, from_rest)

    def _propagators(self, phases: list[Circuit], seconds: list[FloatArray | float]) -> list[FloatArray]:
        """Propagator (B, S, S) of the deviations through each phase of a step."""
        known: dict[tuple[int, bool], FloatArray] = {}
        for phase, state, duration in zip(phases, self._states, seconds, strict=True):
            if (key := (id(phase), state.waits)) not in known:
                known[key] = phase.after(np.eye(phase.into.shape[-1])[None], duration)
        return [
            known[id(phase), state.waits][:, state.nodes[:, None], state.nodes]
            for phase, state in zip(phases, self._states, strict=True)
        ]

    def _run(
        self, propagators: list[FloatArray], rows: list[int], volts: FloatArray, resting: int = 0
    ) -> Iterator[tuple[SwitchState, FloatArray]]:
        """Carry node voltages (B, S, R) at the beginning of some rows' steps through the phases.

        A shared capacitor starts each conversion of the last ``resting`` of them at the reference.

        Yields:
            For each phase its state, and the deviations (B, S, R) at its end.

        """
        for number, (state, propagator) in enumerate(zip(self._states, propagators, strict=True)):
            goals = self._goals[number][..., rows]
            if not state.waits and resting:
                volts[:, state.stored :, -resting:] = 0.0
            deviation = propagator @ (volts - goals)
            yield state, deviation
            volts = goals + deviation

    @cached_property
    def unhurried(self) -> Deviations:
        """Deviations that remain at any row period: a shared capacitor's memory of the last conversion."""
        modes = self.modes()
        if not self._acquisition or not modes.rate.shape[-1]:
            nothing = np.zeros((self._goals.shape[1], *self._board.shape))
            return Deviations(nothing, nothing)
        return self.deviations(self.briefest + LONG / modes.slowest)

    def modes(self) -> Modes:
        """Modes of :meth:`deviations` after the waiting time, which is the row period less :attr:`briefest`."""
        largest = 2.0 * np.abs(self._goals).max(axis=(0, 3))  # (B, S)
        found: dict[int, tuple[ComplexArray, FloatArray]] = {}
        for phases in self._groups:
            for phase, state in zip(phases, self._states, strict=True):
                read = np.abs(phase.left[:, state.nodes[state.at]]).max(axis=1, initial=0.0)
                size = read * (np.abs(phase.right[:, :, state.nodes]) @ largest[..., None])[..., 0]
                found[id(phase)] = phase.rates, np.maximum(size, found.get(id(phase), (size, size))[1])
        rate, size = (np.concatenate(part, axis=-1) for part in zip(*found.values(), strict=True))
        # Slower modes are those of nodes that keep their charge.
        alive = (rate.real > ROUNDING * rate.real.max(axis=-1, keepdims=True, initial=0.0)) & (size > 0.0)
        return Modes(np.where(alive, -rate / self._share, -np.inf), np.where(alive, size, 0.0))

    def _phases(self, networks: ColumnNetworks, group: int) -> list[Circuit]:
        """The circuits in each state of the switches."""
        known: dict[tuple[tuple[int, ...], tuple[int, ...]], Circuit] = {}
        keys = [(tuple(state.loaded.tolist()), state.taps) for state in self._states]
        for key, state in zip(keys, self._states, strict=True):
            if key not in known:
                known[key] = Circuit.of(networks, group, state.loaded, state.taps)
        return [known[key] for key in keys]


def _fixed_point(through: FloatArray, added: FloatArray) -> FloatArray:
    """(B, S, 1) the deviation d = through d + added; that of nodes that nothing is connected to is 0."""
    nodes = through.shape[-1]
    kept = np.abs(np.diagonal(through, axis1=1, axis2=2)).max(axis=-1, initial=0.0) > 1.0 - ROUNDING
    found = np.empty_like(added)
    found[~kept] = np.linalg.solve(np.eye(nodes) - through[~kept], added[~kept])
    found[kept] = np.linalg.pinv(np.eye(nodes) - through[kept]) @ added[kept]
    return found
