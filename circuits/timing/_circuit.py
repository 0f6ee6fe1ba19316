"""The linear circuit behind the column leads while no switch moves: nodal equations ``C x' + G x = b`` (a descriptor
system), reduced to their states.

One formulation covers amplifiers on all columns, one amplifier behind a switch, and loads without amplifiers. All
voltages are relative to the reference. With the conductances L (M, M) that the column ends see in the grid, the line
capacitance C of each column, the feedback capacitance Cf, and w = 2 pi GBW (in 1/s):

    C u' + L u + u/Rref = i                                          column end u with a load; idle ends without
    C u' + Cf (u' - v') + L u + (u - v)/Rref = i - Ib                column end u at an amplifier with the output v
    v'/w + u + v/A = Vos - Vref/A                                    one-pole amplifier
    R Cs p' = v - p                                                  sampling capacitor behind an amplifier
    Cs p' = (u - p)/R                                                sampling capacitor at a column end, which it loads

A part without delay makes its equation algebraic. Its unknown follows the others at once and is eliminated. When a
switch turns, every line and capacitor keeps its charge. Parts that a switch joins share their charges at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import inf, pi
from typing import NamedTuple

import numpy as np

from ...common.arrays import ComplexArray, FloatArray, IntArray
from ...errors import InputError
from .._board import Board
from .._grid import exact_ports
from ..readouts import CIRCUITS, one_driven, terminate

_WORST_CONDITION = 1e8
"""largest condition number of the eigenvectors; the modal form then still has eight correct digits"""
_LEAK = 1e-18
"""of the largest conductance: gives a settled voltage to nodes that nothing is connected to"""


class Circuit(NamedTuple):
    """One state of the switches, with D states and S nodes.

    The nodes are the M column ends, the inverting input if one amplifier goes from column to column, the outputs of the
    A amplifiers, and the K sampling capacitors. The E right sides are the currents into the M column ends, the voltages
    at the A non-inverting inputs, and K zeros.
    """

    matrix: FloatArray
    """(D, D) 1/s of the states"""
    entry: FloatArray
    """(D, E) to the derivatives of the states, from the right sides"""
    into: FloatArray
    """(D, S) to the states, from the voltages of all nodes when a switch turns"""
    back: FloatArray
    """(S, D) from the states to all nodes"""
    feedthrough: FloatArray
    """(S, E) immediate effect of the right sides on the nodes"""
    response: FloatArray
    """(S, E) settled voltages by the right sides"""
    constant: FloatArray
    """(S,) V, settled without drive: offset and bias"""
    rest: FloatArray
    """(S,) V with amplifiers whose outputs are at the reference"""
    rates: ComplexArray
    """(D,) 1/s, at which the modes decay"""
    left: ComplexArray
    """(S, D) to the nodes from the modes"""
    right: ComplexArray
    """(D, S) to the modes from the nodes"""
    is_modal: bool
    """whether ``left`` and ``right`` are accurate; if not, they are those of the states"""

    @classmethod
    def of(cls, board: Board, network: FloatArray, loaded: IntArray, taps: Sequence[int]) -> Circuit:
        """The circuit of one state of the switches.

        Args:
            board: with amplifiers that hold their columns, or with loads.
            network: (M, M) S, the grid as the column ends see it.
            loaded: columns at an amplifier, or of a divider at their loads.
            taps: (K,) for each sampling capacitor the unknown that it is connected to (a column end, or M plus the
                number of an amplifier); -1: none.

        """
        part, adc, columns = board.readout, board.adc, len(network)
        amplified = loaded if board.circuit.virtual_ground else loaded[:0]
        idle = np.setdiff1d(np.arange(columns), loaded)
        at_loads = loaded if not len(amplified) else idle if board.idle_columns == "load" else idle[:0]
        grounded_ends = idle if board.idle_columns == "ground" else idle[:0]
        count, size = len(amplified), columns + len(amplified) + len(taps)
        outputs, samples = np.arange(columns, columns + count), np.arange(columns + count, size)
        slack, feedback = 1.0 / board.gain[amplified], 1.0 / board.reference[amplified]
        lag = 0.0 if part.gain_bandwidth == inf else 1.0 / (2.0 * pi * part.gain_bandwidth)
        ohms, farads = (adc.switch_resistance, adc.sampling_capacitance) if adc else (0.0, 0.0)
        line = part.column_capacitance
        if not count and not ohms and not (adc and adc.acquisition_time):
            line += farads  # each column has a capacitor of its own, without a resistance between
        static, charge = np.zeros((size, size)), np.zeros((size, size))
        static[:columns, :columns] = network
        static[at_loads, at_loads] += 1.0 / board.reference[at_loads]
        static[amplified, amplified] += feedback
        static[amplified, outputs] -= feedback
        static[outputs, amplified], static[outputs, outputs] = 1.0, slack
        ends, sampler = np.arange(columns), ohms * farads if count else farads
        charge[ends, ends], charge[outputs, outputs], charge[samples, samples] = line, lag, sampler
        charge[amplified, amplified] += part.feedback_capacitance
        charge[amplified, outputs] -= part.feedback_capacitance
        inputs = amplified if count < columns else amplified[:0]
        nodes = np.concatenate([ends, inputs, outputs, samples])
        kept = np.zeros((size, len(nodes)))  # charges that nodes bring along
        lengths = [columns, len(inputs), count, len(samples)]
        kept[nodes, np.arange(len(nodes))] = np.repeat([line, 0.0, lag, sampler], lengths)
        first_output = columns + len(inputs)
        kept[amplified, columns if len(inputs) else ends[:count]] += part.feedback_capacitance
        kept[amplified, first_output + np.arange(count)] -= part.feedback_capacitance
        follow, gather, shift = np.eye(size), np.eye(size), np.zeros((size, size))
        given, standing, joined = np.zeros(size), np.zeros(columns), []
        given[amplified] = -board.bias[amplified]
        given[outputs] = standing[amplified] = board.offset[amplified] - slack * board.level
        for sample, tap in zip(samples.tolist(), taps, strict=True):
            if tap >= 0 and count:
                static[sample, [sample, tap]] = 1.0, -1.0
            elif tap >= 0 and ohms:
                static[[sample, tap], [sample, tap]] += 1.0 / ohms
                static[[sample, tap], [tap, sample]] -= 1.0 / ohms
            elif tap >= 0:
                follow[sample, tap] = gather[tap, sample] = 1.0
                joined.append(sample)
        if not lag:  # u = Vos - (v + Vref)/A at once
            follow[amplified, outputs], follow[amplified, amplified] = -slack, 0.0
            shift[amplified, outputs] = 1.0
        others = np.setdiff1d(ends, grounded_ends if lag else np.union1d(grounded_ends, amplified))
        alone = np.setdiff1d(samples, joined)
        follow = follow[:, np.concatenate([others, outputs, alone]).astype(np.intp)]
        gather = gather[np.concatenate([others, outputs if lag else amplified, alone]).astype(np.intp)]
        return cls._reduced(
            static=gather @ static @ follow,
            charge=gather @ charge @ follow,
            source=gather @ (np.eye(size) - static @ shift),
            jump=gather @ charge @ shift,
            kept=gather @ kept,
            follow=follow[nodes],
            shift=shift[nodes],
            given=given,
            rest=np.concatenate([standing, standing[inputs], np.zeros(count + len(samples))]),
        )

    @classmethod
    def _reduced(
        cls,
        *,
        static: FloatArray,
        charge: FloatArray,
        source: FloatArray,
        jump: FloatArray,
        kept: FloatArray,
        follow: FloatArray,
        shift: FloatArray,
        given: FloatArray,
        rest: FloatArray,
    ) -> Circuit:
        """Eliminate the algebraic equations of ``charge y' + static y = source b - jump b'``.

        The nodes are ``follow y + shift b``. The states are ``y + charge^-1 jump b`` of the other equations, so that no
        derivative of b appears.
        """
        one = np.eye(len(static))
        moving, at_once = np.flatnonzero(charge.any(axis=1)), np.flatnonzero(~charge.any(axis=1))
        instant = np.linalg.solve(static[np.ix_(at_once, at_once)], one[at_once])
        lift = one[:, moving]
        lift[at_once] -= instant[:, at_once] @ static[np.ix_(at_once, moving)]
        inverse = np.linalg.inv(charge[np.ix_(moving, moving)])
        reduce = one[moving] - static[np.ix_(moving, at_once)] @ instant
        matrix = -inverse @ reduce @ static @ lift
        leap, feed, back = inverse @ jump[moving], np.zeros((len(static), source.shape[1])), follow @ lift
        feed[at_once] = instant @ source
        fixed = static.copy()  # a capacitor that nothing is connected to counts from the reference
        fixed[np.diag_indices(len(fixed))] += ~static.any(axis=1)
        response = follow @ np.linalg.solve(fixed, source) + shift
        into = inverse @ kept[moving]
        rates, vectors = np.linalg.eig(matrix) if len(moving) else (np.zeros(0), np.zeros((0, 0)))
        is_modal = not len(moving) or bool(np.linalg.cond(vectors) < _WORST_CONDITION)
        left, right = (back @ vectors, np.linalg.solve(vectors, into)) if is_modal else (back, into)
        return cls(
            matrix=matrix,
            entry=inverse @ reduce @ source - matrix @ leap,
            into=into,
            back=back,
            feedthrough=follow @ feed + shift - back @ leap,
            response=response,
            constant=response @ given,
            rest=rest,
            rates=(np.maximum(-rates.real, 0.0) - 1j * rates.imag).astype(np.complex128),
            left=left.astype(np.complex128),
            right=right.astype(np.complex128),
            is_modal=is_modal,
        )

    def after(self, deviation: FloatArray, seconds: float) -> FloatArray:
        """Deviations (S, ...) of the nodes from their settled voltages, some time after a switch has turned."""
        from scipy.linalg import expm

        if not self.is_modal:
            left: FloatArray = self.back @ expm(self.matrix * seconds) @ (self.into @ deviation)
            return left
        there: FloatArray = ((self.left * np.exp(-self.rates * seconds)) @ (self.right @ deviation)).real
        return there

    def settled(self, current: FloatArray) -> FloatArray:
        """Settled voltages (S,) with these currents (M,) into the column ends."""
        volts: FloatArray = self.response[:, : len(current)] @ current + self.constant
        return volts


def column_networks(board: Board, cells: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """The grid as the column ends see it while each row is selected, leads included and loads not.

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
            yield grounded, board.drive * network[row, rows:]
        return
    for alone, _ in one_driven(network, rows):
        grounded_ends = len(alone) - columns  # the selected row, and the reference behind pull-downs
        yield (
            conductance(alone[grounded_ends:, grounded_ends:], alone[:grounded_ends, grounded_ends:].sum(axis=0)),
            board.drive * alone[0, grounded_ends:],
        )


def sampler_delay(board: Board) -> float:
    """Time constant in s of a sampling capacitor and its switch."""
    return board.adc.switch_resistance * board.adc.sampling_capacitance if board.adc else 0.0


def require_amplifiers(board: Board) -> None:
    """Raise InputError for circuits other than an amplifier on each line."""
    if not board.virtual_grounds:
        modelled = " and ".join(f'"{circuit.name}"' for circuit in CIRCUITS.values() if circuit.virtual_ground)
        here = " with multiplexed columns" if board.circuit.virtual_ground else ""
        raise InputError(
            f'readout.circuit = "{board.circuit.name}"{here}: settling and noise are modelled for {modelled} with an '
            "amplifier on each line"
        )
