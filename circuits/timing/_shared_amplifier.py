"""One amplifier behind a switch in time: the columns in turn, each for an equal share of the step.

While column k is selected its end is the inverting input. With the conductances L (M, M) that the column ends see in
the grid (idle loads included), the line capacitance C of each column, and the symbols of :mod:`._dynamics`:

    C u_j' + (L u)_j = i_j                                                      idle columns
    C u_k' + Cf (u_k' - v') + (L u)_k + (u_k - v)/Rref = i_k - Ib               selected column
    v'/w + (v + Vref)/A = Vos - u_k                                             one-pole amplifier
    R C_s p' = v - p                                                            sampling capacitor, while connected

All voltages are relative to the reference. An idle column at the reference has u_j = 0. When the switch turns, the line
of the next column keeps its charge, and so does the feedback capacitor, which was at the previous column's voltage:
the two share their charges at once. The amplifier starts from its last output. Nodes without capacitance follow at once
and are eliminated.
"""

from __future__ import annotations

from math import inf, pi
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from ...common.arrays import ComplexArray, FloatArray, IntArray
from .._board import Board
from ._modes import Modes
from ._switched import SLOWEST, SwitchedScan, SwitchState

_WORST_CONDITION = 1e8
"""largest condition number of the eigenvectors; the modal form then still has eight correct digits"""


class SharedAmplifier(NamedTuple):
    """The circuit while one column is selected, in deviations from the settled state.

    S = M + 3 nodes: the column ends, the inverting input, the output, the sampling capacitor. E = M + 2 equations:
    currents into the column ends, voltages at the non-inverting input and at the sampling capacitor. D states.
    """

    matrix: FloatArray
    """(D, D) 1/s of the states"""
    into: FloatArray
    """(D, S) to the states, from the deviations of all nodes when the switch turns"""
    back: FloatArray
    """(S, D) to the deviations of all nodes"""
    entry: FloatArray
    """(D, E) to the derivatives of the states, from the right sides of the equations"""
    response: FloatArray
    """(S, E) settled voltages by the right sides of the equations"""
    constant: FloatArray
    """(S,) V, settled without drive: offset and bias"""
    rates: ComplexArray
    """(D,) 1/s, at which the states decay"""
    shapes: tuple[ComplexArray, ComplexArray] | None
    """eigenvectors and their inverse; None: ill-conditioned"""

    @classmethod
    def of(cls, board: Board, network: FloatArray, column: int, *, sampling: bool) -> SharedAmplifier:
        """The circuit with ``column`` selected.

        Args:
            board: with one amplifier for all columns.
            network: (M, M) S, the grid as the column ends see it.
            column: k.
            sampling: whether the converter's sampling capacitor is connected.

        """
        part, adc, count = board.readout, board.adc, len(network)
        feedback, slack = 1.0 / float(board.reference[column]), 1.0 / float(board.gain[column])
        delay = adc.switch_resistance * adc.sampling_capacitance if adc else 0.0  # s
        lag = 0.0 if part.gain_bandwidth == inf else 1.0 / (2.0 * pi * part.gain_bandwidth)
        idle = np.delete(np.arange(count), column)
        output, sample = count, count + 1  # numbers of unknowns and equations
        conductance = np.zeros((count + 2, count + 2))
        conductance[:count, :count] = network
        if board.idle_columns == "load":
            conductance[idle, idle] += feedback
        conductance[column, [column, output]] += feedback, -feedback
        conductance[output, [column, output]] = 1.0, slack
        if sampling or not delay:
            conductance[sample, [output, sample]] = -1.0, 1.0
        charge = np.diag([*np.full(count, part.column_capacitance), lag, delay])
        charge[column, [column, output]] += part.feedback_capacitance, -part.feedback_capacitance
        kept = np.zeros((count + 2, count + 3))  # charges that nodes bring along
        kept[np.arange(count), np.arange(count)] = part.column_capacitance
        kept[column, [count, count + 1]] = part.feedback_capacitance, -part.feedback_capacitance
        kept[[output, sample], [count + 1, count + 2]] = lag, delay
        follow = np.eye(count + 2)  # unknowns by those that are free
        unknowns = equations = [*([] if board.idle_columns == "ground" else idle.tolist()), column, output, sample]
        if not lag:  # the amplifier holds u_k = -v/A at once
            follow[column, output], follow[column, column] = -slack, 0.0
            unknowns = [each for each in unknowns if each != column]
            equations = [each for each in equations if each != output]
        follow = follow[:, unknowns]
        charge, static = charge[equations] @ follow, conductance[equations] @ follow
        charged = [number for number in range(len(unknowns)) if charge[number].any()]
        at_once = [number for number in range(len(unknowns)) if not charge[number].any()]
        nodes = follow[[*range(count), column, output, sample]]
        instant = np.linalg.solve(static[np.ix_(at_once, at_once)], np.eye(len(unknowns))[at_once])
        lift = np.eye(len(unknowns))[:, charged]
        lift[at_once] -= instant[:, at_once] @ static[np.ix_(at_once, charged)]
        inverse = np.linalg.inv(charge[np.ix_(charged, charged)])
        reduce = np.eye(len(unknowns))[charged] - static[np.ix_(charged, at_once)] @ instant
        matrix = -inverse @ reduce @ static @ lift
        entry, response = np.zeros((len(charged), count + 2)), np.zeros((count + 3, count + 2))
        entry[:, equations] = inverse @ reduce
        fixed = static.copy()
        if delay and not sampling:  # an idle capacitor keeps its charge; its deviation counts from the reference
            fixed[equations.index(sample), unknowns.index(sample)] = 1.0
        response[:, equations] = nodes @ np.linalg.inv(fixed)
        source = np.zeros(count + 2)
        source[[column, output]] = -board.bias[column], board.offset[column] - slack * board.level
        constant = response @ source
        if not lag:  # u_k = Vos - (v + Vref)/A
            held = np.zeros(count + 2)
            held[column] = source[output]
            constant = nodes @ np.linalg.solve(fixed, source[equations] - (conductance @ held)[equations])
            constant[[column, count]] += source[output]
        rates, vectors = np.linalg.eig(matrix) if charged else (np.zeros(0), np.zeros((0, 0)))
        sound = not charged or np.linalg.cond(vectors) < _WORST_CONDITION
        return cls(
            matrix=matrix,
            into=inverse @ kept[equations][charged],
            back=nodes @ lift,
            entry=entry,
            response=response,
            constant=constant,
            rates=-rates.astype(np.complex128),
            shapes=(vectors.astype(np.complex128), np.linalg.inv(vectors).astype(np.complex128)) if sound else None,
        )

    def carry(self, seconds: float) -> FloatArray:
        """Propagator (S, S) of the deviations over a time in s that begins when the switch turns."""
        if self.shapes is None:
            through = expm(self.matrix * seconds)
        else:
            there, again = self.shapes
            through = (there * np.exp(-self.rates * seconds) @ again).real
        carried: FloatArray = self.back @ through @ self.into
        return carried

    def settled(self, current: FloatArray) -> FloatArray:
        """Settled voltages (S,) with these currents (M,) into the column ends."""
        volts: FloatArray = self.response[:, : len(current)] @ current + self.constant
        return volts


class SharedAmplifierScan(SwitchedScan[SharedAmplifier]):
    """The repeated scan of constant cells by one amplifier for all columns (:class:`._modes.RepeatedScan`)."""

    def _phase(self, network: FloatArray, state: SwitchState) -> SharedAmplifier:
        sampling = not self._acquisition or state.connected is not None
        return SharedAmplifier.of(self._board, network, int(state.loaded[0]), sampling=sampling)

    def _read_at(self, columns: IntArray) -> IntArray:
        return np.full(len(columns), self._board.shape[1] + 2)

    @property
    def _stored(self) -> slice:
        return slice(self._board.shape[1] + 2, None)

    def modes(self) -> Modes:
        """See :meth:`._modes.RepeatedScan.modes`."""
        largest = 2.0 * np.max([np.abs(goal) for _, goals in self._rows for goal in goals], axis=0)  # (S,)
        rates, sizes = [], []
        for phases in {id(phases): phases for phases, _ in self._rows}.values():
            for phase, state in zip(phases, self._states, strict=True):
                vectors = np.eye(len(phase.rates)) if phase.shapes is None else phase.shapes[0]
                again = vectors if phase.shapes is None else phase.shapes[1]
                seen = np.abs((phase.back @ vectors)[self._read_at(state.read)]).sum(axis=0)
                rates.append(phase.rates)
                sizes.append(seen * (np.abs(again @ phase.into) @ largest))
        rate, size = np.concatenate(rates), np.concatenate(sizes)
        alive = rate.real > SLOWEST * rate.real.max(initial=0.0)
        return Modes(-rate[alive] / self._board.shape[1], size[alive])
