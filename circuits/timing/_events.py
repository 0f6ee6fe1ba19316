"""A scan as a list of events: settling, memory from column to column, noise of averages and frame time.

A row is selected and ``[scan] row`` happens; then each column in turn has ``[scan] column``. While no switch moves, the
circuit is linear. Its states s are the voltages of capacitors, the currents of inductors, and the outputs of amplifiers
of finite bandwidth. With these as sources, the nodes x follow from ``M x = b + S s``, and the states from ``s' = P s +
p``. Matrix exponentials solve this exactly, however stiff it is. States belong to parts, so that a capacitor keeps its
charge when a switch turns: that of a column's line, of the end that a group shares, of the converter. A capacitor has
:data:`CONTACT_OHM` in series, through which capacitors that a switch joins share their charges at once.

The scan repeats endlessly over the same cells; its steady state is the fixed point of a frame. Noise is that of the
state equations driven by white noise (a Lyapunov equation, as in :mod:`._noise`), with its correlation from conversion
to conversion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from math import isfinite, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import FloatArray, IntArray
from ...common.constants import BOLTZMANN
from ...errors import InputError, SolverError
from .._design import Design
from .._exact import read_exactly
from .._grid import exact_ports
from .._parts import LEAST_SHORT_OHM
from .._tuning import NEGLIGIBLE, SLOWEST, WIDEST_HZ
from ..ends import GROUND, LINE, Card, Event, Network, Scan, inverted_nodes, step_system

CONTACT_OHM = LEAST_SHORT_OHM
"""in series with each capacitor, and of the switch that discharges the sampled node: far below any part of a board"""
State = tuple[str, str]
"""name of an end and of a part; a column's line has the end ``line J``, the converter the end ``adc``"""


class _Phase(NamedTuple):
    """The circuit in one state of its switches, for the K states that take part."""

    states: IntArray
    """(K,) numbers of the states"""
    rate: FloatArray
    """(K, K) 1/s"""
    drift: FloatArray
    """(K,)"""
    weights: FloatArray
    """(K,) V of the sampled voltage by the states"""
    constant: float
    """V of it without states"""
    noise: FloatArray
    """(K, K) two-sided intensity of the noise that drives the states"""
    white: float
    """V^2 s of white noise at the sampled voltage, which no part limits"""

    def over(self, seconds: float, size: int) -> FloatArray:
        """(size + 1, size + 1) map of all states and 1 over some time; other states keep their values."""
        from scipy.linalg import expm

        own = len(self.states)
        extended = np.zeros((own + 1, own + 1))
        extended[:own, :own], extended[:own, own] = self.rate, self.drift
        whole = np.eye(size + 1)
        places = np.append(self.states, size)
        whole[np.ix_(places, places)] = expm(extended * seconds)
        return whole


class EventScan:
    """Readings of constant cells by the events of ``[scan]``.

    Example::

        timed = EventScan(design, resistance)
        timed.frame_time  # s
        timed.sampled     # V (rows, columns)
        timed.noise       # V (rows, columns)
    """

    def __init__(self, design: Design, resistance: ArrayLike, events: Scan | None = None) -> None:
        """Solve the settled frame.

        Args:
            design: with named ends, or with networks.
            resistance: (rows, columns) ohm.
            events: in place of ``[scan]``.

        Raises:
            InputError: no events; cells that do not fit; a circuit whose dynamics are not modelled.
            SolverError: a diode or a limited amplifier, which are not linear.

        """
        scan = events or design.scan
        if scan is None:
            raise InputError("the design has no [scan] section; expected the events of a scan")
        self._events, self._adc, self._temperature = scan, design.adc, design.readout.temperature
        if design.board.transposed or design.board.circuit.drives_idle_lines:
            raise InputError(f'readout.circuit = "{design.readout.circuit}" has no scan by events')
        self._board = board = design.board_by_nodes
        assert board.line_ends is not None
        self._ends = board.line_ends
        if not self._ends.is_linear:
            raise SolverError("settling is a linear model: it has no diodes, and no amplifiers with limits")
        cells = design.resistance(resistance)
        self._ports = exact_ports(board, cells).value
        self.settled: FloatArray = read_exactly(board, cells)[0].volts
        """V (rows, columns) after a long time"""
        self._number: dict[State, int] = {}
        self._phases: dict[tuple[object, ...], _Phase] = {}
        self._line_farad = design.readout.column_capacitance
        adc = design.adc
        own = scan.conversion_time
        self.conversion_time = own if own is not None else adc.acquisition_time if adc else 0.0
        """s of one conversion"""
        self._samples = bool(adc and adc.sampling_capacitance)

    @property
    def frame_time(self) -> float:
        """s of a frame by its events."""
        rows, columns = self._board.shape
        per_row, per_column = (sum(map(self._seconds, events)) for events in (self._events.row, self._events.column))
        return rows * (per_row + columns * per_column)

    @cached_property
    def sampled(self) -> FloatArray:
        """V (rows, columns): the mean of each reading's conversions in a scan that repeats endlessly."""
        rows, columns = self._board.shape
        plan = list(self._plan())
        size = len(self._number)
        frame = np.eye(size + 1)
        known: dict[tuple[int, float], FloatArray] = {}
        for phase, seconds, *_ in plan:
            key = id(phase), seconds
            if key not in known:
                known[key] = phase.over(seconds, size)
            frame = known[key] @ frame
        held, drift = frame[:size, :size], frame[:size, size]
        state = np.append(np.linalg.lstsq(np.eye(size) - held, drift, rcond=None)[0], 1.0)
        volts = np.zeros((rows, columns))
        for phase, seconds, row, column, counts in plan:
            state = known[id(phase), seconds] @ state
            if counts:
                volts[row, column] += phase.weights @ state[phase.states] + phase.constant
        return volts / self._events.averages

    @property
    def error(self) -> float:
        """Largest deviation of a reading from its settled value, over the range of the settled readings."""
        span = float(np.ptp(self.settled)) or float(np.abs(self.settled).max()) or 1.0
        return float(np.abs(self.sampled - self.settled).max()) / span

    @property
    def noise(self) -> FloatArray:
        """V (rows, columns): standard deviation of each reading by its parts, and by the converter's steps.

        Raises:
            InputError: nothing limits the bandwidth of a noise, so that its variance is infinite.

        """
        return np.hypot(self.circuit_noise, self.quantisation)

    @property
    def quantisation(self) -> FloatArray:
        """V (rows, columns) of the mean of a reading's conversions by the converter's steps."""
        step = self._adc.step if self._adc else 0.0
        return np.full(self._board.shape, step / np.sqrt(12.0 * self._events.averages))

    @cached_property
    def circuit_noise(self) -> FloatArray:
        """V (rows, columns) of it by the parts of the circuit. Raises InputError as :attr:`noise`."""
        variance = np.zeros(self._board.shape)
        known: dict[int, float] = {}
        for phase, _, row, column, counts in self._plan():
            if counts:
                if id(phase) not in known:
                    known[id(phase)] = self._variance(phase, self._events.averages)
                variance[row, column] = known[id(phase)]
        return np.sqrt(variance)

    def _variance(self, phase: _Phase, count: int) -> float:
        """V^2 of the mean of ``count`` conversions, by noise."""
        from scipy.linalg import expm, solve_continuous_lyapunov

        rate = phase.rate - SLOWEST * np.eye(len(phase.rate))
        covariance = solve_continuous_lyapunov(rate, -phase.noise)
        later, carried = expm(rate * self.conversion_time), np.eye(len(rate))
        total = 0.0
        for lag in range(count):
            share = (count - lag) * (2 if lag else 1) / count**2
            total += share * float(phase.weights @ carried @ covariance @ phase.weights)
            carried = later @ carried
        if phase.white * WIDEST_HZ > NEGLIGIBLE * total:
            raise InputError(
                "noise of the resistors has no bandwidth limit and so no finite size; give adc.sampling_capacitance"
            )
        return max(total, 0.0)

    def _seconds(self, event: Event) -> float:
        conversions = (event.discard or 0) + (event.read or 0)
        return (event.wait or 0.0) + (event.discharge or 0.0) + conversions * self.conversion_time

    def _plan(self) -> Iterator[tuple[_Phase, float, int, int, bool]]:
        """The phases of a frame with duration, row and column, and whether a conversion that counts ends the phase."""
        for row in range(self._board.shape[0]):
            for event in self._events.row:
                yield self._phase(row, 0, "discharge" if event.discharge else ""), self._seconds(event), row, 0, False
            for column in range(self._board.shape[1]):
                for event in self._events.column:
                    conversions = (event.discard or 0) + (event.read or 0)
                    kind = "discharge" if event.discharge else "sample" if conversions else ""
                    phase = self._phase(row, column, kind)
                    for _ in range(conversions):
                        yield phase, self.conversion_time, row, column, event.read is not None
                    if not conversions:
                        yield phase, self._seconds(event), row, column, False

    def _phase(self, row: int, column: int, kind: str) -> _Phase:
        """The circuit while a row is selected and a column has its turn, and is discharged or sampled."""
        turn = column % self._ends.shared_by
        key = row, column if kind else turn, kind, not kind
        if key not in self._phases:
            self._phases[key] = self._made(row, column, kind)
        return self._phases[key]

    def _made(self, row: int, column: int, kind: str) -> _Phase:
        read = self._board.turns[column % self._ends.shared_by]
        networks, moving = self._without_states(row, column, kind)
        system = step_system(self._ends, self._board.column_lead, self._ports, networks, read)
        size, count = len(system.source), len(moving)
        _, inverse = inverted_nodes(system.static)

        def at(end: str, name: str) -> FloatArray:
            """(U,) that picks one unknown or equation; nothing of ground."""
            picked = np.zeros(size)
            if name != GROUND:
                picked[system.places[end, name]] = 1.0
            return picked

        # Equations by the states, derivatives of the states by the unknowns, and by nothing.
        into, by_nodes, drift = np.zeros((size, count)), np.zeros((count, size)), np.zeros(count)
        speed = np.zeros(count)  # of amplifiers, 1/s
        for number, (end, card, _) in enumerate(moving):
            nodes = [at(end, node) for node in card.nodes]
            if card.kind == "l":
                into[:, number], by_nodes[number] = nodes[1] - nodes[0], (nodes[0] - nodes[1]) / card.value
                continue
            into[:, number] = at(end, f"branch V.{card.name}")
            if card.kind == "c":
                by_nodes[number] = into[:, number] / card.value
            else:
                speed[number] = 2.0 * pi * card["gain_bandwidth"]
                by_nodes[number] = speed[number] * (nodes[0] - nodes[1] - nodes[2] / card["open_loop_gain"])
                drift[number] = speed[number] * card["offset_voltage"]
        sampled, weights = np.zeros(size), np.zeros(count)
        if kind == "sample" and self._samples:
            weights = np.array([float(part.owner == _CONVERTER) for part in moving])
        else:
            sampled = at(f"c{column // self._ends.shared_by}", self._ends.out)
            weights = sampled @ inverse @ into
        # White noise: (U, K) equations and (K, K) states that each source drives, and its two-sided intensity.
        entries = list(self._noise_sources(networks, moving, at))
        driven = np.array([nodes for nodes, _, _ in entries]).reshape(len(entries), size).T
        direct = np.array([speed * own for _, own, _ in entries]).reshape(len(entries), count).T
        intensity = np.array([power for _, _, power in entries])
        ports = len(self._ports)
        grid = np.diag(self._ports.sum(axis=1)) - self._ports  # Nyquist's theorem for multiports
        grid *= 2.0 * BOLTZMANN * self._temperature
        moved, moved_by_grid = by_nodes @ inverse @ driven + direct, (by_nodes @ inverse)[:, :ports]
        seen, seen_by_grid = sampled @ inverse @ driven, (sampled @ inverse)[:ports]
        return _Phase(
            states=np.array([self._number.setdefault(part.owner, len(self._number)) for part in moving], dtype=np.intp),
            rate=by_nodes @ inverse @ into,
            drift=by_nodes @ inverse @ system.source + drift,
            weights=weights,
            constant=float(sampled @ inverse @ system.source),
            noise=(moved * intensity) @ moved.T + moved_by_grid @ grid @ moved_by_grid.T,
            white=float((seen**2 * intensity).sum() + seen_by_grid @ grid @ seen_by_grid),
        )

    def _without_states(self, row: int, column: int, kind: str) -> tuple[list[tuple[str, int, Network]], list[_Moving]]:
        """Networks with a source in place of each state, and the parts that have the states."""
        rows, columns = self._board.shape
        networks: list[tuple[str, int, Network]] = []
        moving: list[_Moving] = []
        for end, line, network in self._ends.of_step(row, self._board.turns[column % self._ends.shared_by]):
            parts = [(card, (end, card.name)) for card in network]
            if rows <= line < rows + columns and self._line_farad:
                parts.append((Card("C.LINE", (LINE, GROUND), self._line_farad), ("line", str(line))))
            if line == rows + column:
                parts += [(card, _CONVERTER) for card in self._at_the_output(kind)]
            fixed: list[Card] = []
            for card, owner in parts:
                replaced = _without_state(card)
                if replaced is None:
                    fixed.append(card)
                else:
                    fixed += replaced
                    moving.append(_Moving(end, card, owner))
            networks.append((end, line, tuple(fixed)))
        return networks, moving

    def _at_the_output(self, kind: str) -> list[Card]:
        """What is at the sampled node: a switch to ground, or the converter."""
        out, adc = self._ends.out, self._adc
        if kind == "discharge":
            return [Card("R.DISCHARGE", (out, GROUND), CONTACT_OHM)]
        if kind == "sample" and adc and adc.sampling_capacitance:
            switch = Card("R.ADC", (out, "adc"), adc.switch_resistance)
            return [switch, Card("C.ADC", ("adc", GROUND), adc.sampling_capacitance)]
        return []

    def _noise_sources(
        self, networks: list[tuple[str, int, Network]], moving: list[_Moving], at: Callable[[str, str], FloatArray]
    ) -> Iterator[tuple[FloatArray, FloatArray, float]]:
        """For each source what it adds to the equations (U,) and to the amplifiers' inputs (K,), and its intensity."""
        none = np.zeros(len(moving))
        thermal = 2.0 * BOLTZMANN * self._temperature
        for end, _, network in networks:
            for card in network:
                if card.kind == "r" and card.value and thermal:
                    a, b = (at(end, node) for node in card.nodes)
                    yield a - b, none, thermal / card.value
                elif card.kind == "x" and card["voltage_noise"]:
                    yield at(end, f"branch {card.name}"), none, card["voltage_noise"] ** 2 / 2.0
                if card.kind == "x" and card["current_noise"]:
                    yield at(end, card.nodes[1]), none, card["current_noise"] ** 2 / 2.0
        for number, (end, card, _) in enumerate(moving):
            if card.kind == "x":
                zero = np.zeros_like(at(end, GROUND))
                if card["voltage_noise"]:
                    yield zero, np.eye(len(moving))[number], card["voltage_noise"] ** 2 / 2.0
                if card["current_noise"]:
                    yield at(end, card.nodes[1]), none, card["current_noise"] ** 2 / 2.0


_CONVERTER: State = ("adc", "")


class _Moving(NamedTuple):
    """A part with a state."""

    end: str
    card: Card
    owner: State


def _without_state(card: Card) -> list[Card] | None:
    """What stands for a part with a state: its state is a source ``V.NAME``, or a current that has no card."""
    source = f"V.{card.name}"
    match card.kind:
        case "c" if card.value:
            inner = f"{card.name}.c".lower()
            return [Card(f"R.{card.name}", (card.nodes[0], inner), CONTACT_OHM), Card(source, (inner, card.nodes[1]))]
        case "l" if card.value:
            return []
        case "x" if isfinite(card["gain_bandwidth"]):
            bias = Card(f"I.{card.name}", (card.nodes[1], GROUND), card["bias_current"])
            return [Card(source, (card.nodes[2], GROUND)), bias]
    return None
