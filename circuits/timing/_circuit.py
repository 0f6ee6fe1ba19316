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

from collections.abc import Sequence
from math import pi
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from ...errors import InputError
from .._board import Board
from .._design import Design
from .._grid import exact_ports
from .._parts import of_columns
from .._population import Boards
from .._tuning import LEAK, WORST_CONDITION
from ..readouts import CIRCUITS, one_driven, terminate


class Circuit(NamedTuple):
    """One state of the switches of B boards, with D states and S nodes.

    The nodes are the M column ends, the inverting input if one amplifier goes from column to column, the outputs of the
    A amplifiers, and the K sampling capacitors. The E right sides are the currents into the M column ends, the voltages
    at the A non-inverting inputs, and K zeros.
    """

    matrix: FloatArray
    """(B, D, D) 1/s of the states"""
    entry: FloatArray
    """(B, D, E) to the derivatives of the states, from the right sides"""
    into: FloatArray
    """(B, D, S) to the states, from the voltages of all nodes when a switch turns"""
    back: FloatArray
    """(B, S, D) from the states to all nodes"""
    feedthrough: FloatArray
    """(B, S, E) immediate effect of the right sides on the nodes"""
    response: FloatArray
    """(B, S, E) settled voltages by the right sides"""
    constant: FloatArray
    """(B, S) V, settled without drive: offset and bias"""
    rest: FloatArray
    """(B, S) V with amplifiers whose outputs are at the reference"""
    rates: ComplexArray
    """(B, D) 1/s, at which the modes decay"""
    left: ComplexArray
    """(B, S, D) to the nodes from the modes"""
    right: ComplexArray
    """(B, D, S) to the modes from the nodes"""
    is_modal: BoolArray
    """(B,) whether ``left`` and ``right`` are accurate; if not, they are those of the states"""

    @classmethod
    def of(cls, networks: ColumnNetworks, group: int, loaded: IntArray, taps: Sequence[int]) -> Circuit:
        """The circuits of one state of the switches.

        Args:
            networks: boards with amplifiers that hold their columns, or with loads.
            group: number of the grid that the column ends see.
            loaded: columns at an amplifier, or of a divider at their loads.
            taps: (K,) for each sampling capacitor the unknown that it is connected to (a column end, or M plus the
                number of an amplifier); -1: none.

        """
        boards, board, network = networks.boards, networks.board, networks.conductance[:, group]
        adc, columns = board.adc, network.shape[-1]
        amplified = loaded if board.circuit.virtual_ground else loaded[:0]
        idle = np.setdiff1d(np.arange(columns), loaded)
        at_loads = loaded if not len(amplified) else idle if board.idle_columns == "load" else idle[:0]
        grounded_ends = idle if board.idle_columns == "ground" else idle[:0]
        count, size, batch = len(amplified), columns + len(amplified) + len(taps), len(network)
        outputs, samples = np.arange(columns, columns + count), np.arange(columns + count, size)
        slack, conductance = 1.0 / of_columns(board.gain)[:, amplified], 1.0 / of_columns(board.reference)
        offset, bias = (of_columns(part)[:, amplified] for part in (board.offset, board.bias))
        lag = 1.0 / (2.0 * pi * boards.gain_bandwidth)  # 0: the amplifier follows at once
        ohms, farads = (adc.switch_resistance, adc.sampling_capacitance) if adc else (0.0, 0.0)
        line, across = boards.column_capacitance, boards.feedback_capacitance
        if not count and not ohms and not (adc and adc.acquisition_time):
            line = line + farads  # each column has a capacitor of its own, without a resistance between
        static, charge = np.zeros((2, batch, size, size))
        static[:, :columns, :columns] = network
        static[:, at_loads, at_loads] += conductance[:, at_loads]
        static[:, amplified, amplified] += conductance[:, amplified]
        static[:, amplified, outputs] -= conductance[:, amplified]
        static[:, outputs, amplified], static[:, outputs, outputs] = 1.0, slack
        ends, sampler = np.arange(columns), ohms * farads if count else farads
        charge[:, ends, ends], charge[:, outputs, outputs], charge[:, samples, samples] = line, lag, sampler
        charge[:, amplified, amplified] += across
        charge[:, amplified, outputs] -= across
        inputs = amplified if count < columns else amplified[:0]
        nodes = np.concatenate([ends, inputs, outputs, samples])
        kept = np.zeros((batch, size, len(nodes)))  # charges that nodes bring along
        first_output = columns + len(inputs)
        kept[:, ends, ends], kept[:, outputs, first_output + np.arange(count)] = line, lag
        kept[:, samples, len(nodes) - len(samples) + np.arange(len(samples))] = sampler
        kept[:, amplified, columns if len(inputs) else ends[:count]] += across
        kept[:, amplified, first_output + np.arange(count)] -= across
        follow, gather = np.broadcast_to(np.eye(size), (2, batch, size, size)).copy()
        shift = np.zeros((size, size))
        given, standing, joined = np.zeros((batch, size)), np.zeros((batch, columns)), []
        given[:, amplified] = -bias
        given[:, outputs] = standing[:, amplified] = offset - slack * boards.reference_voltage
        for sample, tap in zip(samples.tolist(), taps, strict=True):
            if tap >= 0 and count:
                static[:, sample, [sample, tap]] = 1.0, -1.0
            elif tap >= 0 and ohms:
                static[:, [sample, tap], [sample, tap]] += 1.0 / ohms
                static[:, [sample, tap], [tap, sample]] -= 1.0 / ohms
            elif tap >= 0:
                follow[:, sample, tap] = gather[:, tap, sample] = 1.0
                joined.append(sample)
        lags = bool(lag.any())
        if not lags:  # u = Vos - (v + Vref)/A at once
            follow[:, amplified, outputs], follow[:, amplified, amplified] = -slack, 0.0
            shift[amplified, outputs] = 1.0
        others = np.setdiff1d(ends, grounded_ends if lags else np.union1d(grounded_ends, amplified))
        alone = np.setdiff1d(samples, joined)
        follow = follow[:, :, np.concatenate([others, outputs, alone]).astype(np.intp)]
        gather = gather[:, np.concatenate([others, outputs if lags else amplified, alone]).astype(np.intp)]
        at_rest = np.zeros((batch, count + len(samples)))
        return cls._reduced(
            static=gather @ static @ follow,
            charge=gather @ charge @ follow,
            source=gather @ (np.eye(size) - static @ shift),
            jump=gather @ charge @ shift,
            kept=gather @ kept,
            follow=follow[:, nodes],
            shift=shift[nodes],
            given=given,
            rest=np.concatenate([standing, standing[:, inputs], at_rest], axis=1),
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
        batch, size = static.shape[:2]
        one, stores = np.eye(size), charge.any(axis=(0, 2))
        moving, at_once = np.flatnonzero(stores), np.flatnonzero(~stores)
        instant = np.linalg.solve(_block(static, at_once, at_once), one[None, at_once])
        lift = np.broadcast_to(one[:, moving], (batch, size, len(moving))).copy()
        lift[:, at_once] -= instant[:, :, at_once] @ _block(static, at_once, moving)
        inverse = np.linalg.inv(_block(charge, moving, moving))
        reduce = one[moving] - _block(static, moving, at_once) @ instant
        matrix = -inverse @ reduce @ static @ lift
        leap, back = inverse @ jump[:, moving], follow @ lift
        feed = np.zeros((batch, size, source.shape[-1]))
        feed[:, at_once] = instant @ source
        fixed = static.copy()  # a capacitor that nothing is connected to counts from the reference
        diagonal = np.arange(size)
        fixed[:, diagonal, diagonal] += ~static.any(axis=2)
        response = follow @ np.linalg.solve(fixed, source) + shift
        into = inverse @ kept[:, moving]
        rates, left, right, is_modal = _modes(matrix, back, into)
        return cls(
            matrix=matrix,
            entry=inverse @ reduce @ source - matrix @ leap,
            into=into,
            back=back,
            feedthrough=follow @ feed + shift - back @ leap,
            response=response,
            constant=(response @ given[..., None])[..., 0],
            rest=rest,
            rates=(np.maximum(-rates.real, 0.0) - 1j * rates.imag).astype(np.complex128),
            left=left,
            right=right,
            is_modal=is_modal,
        )

    def after(self, deviation: FloatArray, seconds: FloatArray | float) -> FloatArray:
        """Deviations (B, S, ...) of the nodes from their settled voltages, some time (B,) after a switch has turned.

        Args:
            deviation: (B or 1, S, K) V when the switch turns.
            seconds: (B,) s, or one time for all boards.
        """
        from scipy.linalg import expm

        passed = np.broadcast_to(np.asarray(seconds, dtype=np.float64), len(self.matrix))
        decayed = np.exp(-self.rates * passed[:, None])
        there: FloatArray = ((self.left * decayed[:, None]) @ (self.right @ deviation)).real
        slow = np.flatnonzero(~self.is_modal)
        if len(slow):
            given = np.broadcast_to(deviation, (len(self.matrix), *deviation.shape[1:]))[slow]
            moved = expm(self.matrix[slow] * passed[slow, None, None])
            there[slow] = self.back[slow] @ moved @ (self.into[slow] @ given)
        return there

    def settled(self, current: FloatArray) -> FloatArray:
        """Settled voltages (B, S, ...) with these currents (B, M, ...) into the column ends."""
        volts: FloatArray = self.response[..., : current.shape[1]] @ current + self.constant[..., None]
        return volts


def _block(matrix: FloatArray, rows: IntArray, columns: IntArray) -> FloatArray:
    """(B, R, C) of matrices (B, ...)."""
    return matrix[:, rows[:, None], columns]


def _modes(
    matrix: FloatArray, back: FloatArray, into: FloatArray
) -> tuple[ComplexArray, ComplexArray, ComplexArray, BoolArray]:
    """Eigenvalues (B, D), and the modal forms of ``back`` and ``into`` where they are accurate."""
    if not matrix.shape[-1]:
        nothing = np.zeros(matrix.shape[:2], dtype=np.complex128)
        return nothing, back.astype(np.complex128), into.astype(np.complex128), np.ones(len(matrix), dtype=np.bool_)
    rates, vectors = np.linalg.eig(matrix)
    is_modal = np.linalg.cond(vectors) < WORST_CONDITION
    left, right = back.astype(np.complex128), into.astype(np.complex128)
    left[is_modal] = back[is_modal] @ vectors[is_modal]
    right[is_modal] = np.linalg.solve(vectors[is_modal], into[is_modal])
    return rates, left, right, is_modal


class ColumnNetworks(NamedTuple):
    """The grids of B boards as the column ends see them while each row is selected, leads included and loads not."""

    boards: Boards
    board: Board
    """the stack that they make"""
    conductance: FloatArray
    """(B, G, M, M) S; G is 1 where all rows see the same network, else N"""
    current: FloatArray
    """(B, N, M) A, Norton currents of the drive"""

    @classmethod
    def of(cls, design: Design, boards: Boards, cells: FloatArray) -> ColumnNetworks:
        """Networks of boards with cells (B, rows, columns) in ohm."""
        board = boards.board(design)
        rows, columns = board.shape
        network = terminate(
            exact_ports(board, board.transpose(cells)).value, rows + board.pulled, board.column_lead
        ).value
        # Where rows float, the selected row and the reference behind pull-downs are ahead of the columns.
        steps = [alone for _, alone, _ in one_driven(network, rows)] if board.floating else [network]
        ends = slice(-columns, None)
        found = np.stack([-alone[..., ends, ends] for alone in steps], axis=1)
        totals = np.stack([alone[..., ends, :].sum(axis=-1) for alone in steps], axis=1)
        drivers = [alone[..., : 1 if board.floating else rows, ends] for alone in steps]
        every = np.arange(columns)
        leak = np.maximum(totals.max(axis=(1, 2)), 1.0 / board.reference.max(axis=(1, 2)))
        found[..., every, every] += totals + LEAK * leak[:, None, None]
        return cls(boards, board, found, board.drive * np.concatenate(drivers, axis=1))


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
