"""The amplifiers on their columns as one linear system: what settling and noise have in common.

In each scan step every column j is a virtual ground with the noise gain 1 + Rref Y_jj, where Y (M, M) is what the
columns see of the grid: their port conductances with all driven rows at ground. With line resistance the columns
share rows, Y has entries off its diagonal, and they settle together; nothing here assumes that they do not.

Per column, for deviations from the settled state (u the inverting input, v the output, w = 2 pi GBW, and the
disturbances e, a voltage at the non-inverting input, and i, a current into the inverting one):

    v'/w + v/A = e - u                                      the amplifier, one pole
    C u' + Cf (u' - v') + Y u + (u - v)/Rref = i            its input node
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, pi

import numpy as np
from scipy.linalg import inv

from ...arrays import FloatArray
from ...errors import InputError
from .._board import Board
from .._grid import exact_ports
from ..readouts import CIRCUITS
from ..solvers import eliminate_leading

_BROKEN_LEAD = 1e30  # ohm: stands for the infinite one, which would make NaN of an open column


@dataclass(frozen=True)
class Dynamics:
    """``x' = matrix x + voltage e + current i``, ``v = output x + feedthrough e + current_feedthrough i``.

    S states, M columns. A circuit that nothing slows down has no states, and then only the last two terms.
    """

    matrix: FloatArray
    """(S, S) 1/s"""
    voltage: FloatArray
    """(S, M), of the disturbances at the non-inverting inputs"""
    current: FloatArray
    """(S, M), of those at the inverting inputs"""
    output: FloatArray
    """(M, S)"""
    feedthrough: FloatArray
    """(M, M) of e into v: what reaches the outputs at once"""
    current_feedthrough: FloatArray
    """(M, M) ohm, of i into v"""
    lift: FloatArray
    """(S, M): the change of the settled state with the settled outputs"""


def column_conductances(board: Board, cells: FloatArray) -> FloatArray:
    """What the amplifiers see of the grid: Y in S, (1, M, M) with grounded idle rows, (N, M, M) with floating ones.

    With floating idle rows Y depends on the selected row, which is the first axis.
    """
    rows, columns = board.shape
    ports = exact_ports(board, cells).value
    if not board.floating:
        between, to_ground = ports[None, rows:, rows:], ports[None, rows:, :rows].sum(axis=-1)
    else:
        between, to_ground = np.empty((rows, columns, columns)), np.empty((rows, columns))
        for row in range(rows):
            order = np.r_[np.delete(np.arange(rows), row), row, rows : rows + columns]
            alone = eliminate_leading(ports[np.ix_(order, order)], rows - 1).value
            between[row], to_ground[row] = alone[1:, 1:], alone[0, 1:]
    conductances = -between
    diagonal = np.arange(columns)
    conductances[:, diagonal, diagonal] = to_ground + between.sum(axis=-1) - between[:, diagonal, diagonal]
    lead = np.minimum(board.column_lead, _BROKEN_LEAD)
    behind_leads = np.linalg.solve(np.eye(columns) + conductances * lead, conductances)
    symmetric: FloatArray = (behind_leads + behind_leads.swapaxes(-1, -2)) / 2
    return symmetric


def column_dynamics(board: Board, conductance: FloatArray) -> Dynamics:
    """The linear system of one scan step, given Y (M, M) from :func:`column_conductances`.

    Raises:
        InputError: the readout has no amplifiers.

    """
    require_amplifiers(board)
    part = board.design.readout
    columns = len(conductance)
    one, none = np.eye(columns), np.zeros((columns, columns))
    feedback, slack = 1 / board.reference, 1 / board.gain  # (M,): times a matrix, they scale its columns
    total = part.column_capacitance + part.feedback_capacitance
    loaded = conductance + feedback * one
    if part.gain_bandwidth < inf:
        speed = 2 * pi * part.gain_bandwidth
        if total > 0:  # states u, v
            follow = part.feedback_capacitance / total
            amplifier = np.hstack([-speed * one, -speed * slack * one])
            node = np.hstack([-loaded, feedback * one]) / total + follow * amplifier
            return Dynamics(
                matrix=np.vstack([node, amplifier]),
                voltage=np.vstack([follow * speed * one, speed * one]),
                current=np.vstack([one / total, none]),
                output=np.hstack([none, one]),
                feedthrough=none,
                current_feedthrough=none,
                lift=np.vstack([-slack * one, one]),
            )
        inner = inv(loaded)  # states v; u follows at once
        return Dynamics(
            matrix=-speed * (slack * one + feedback * inner),
            voltage=speed * one,
            current=-speed * inner,
            output=one,
            feedthrough=none,
            current_feedthrough=none,
            lift=one,
        )
    held = slack * total + part.feedback_capacitance
    if (held > 0).any() and not (held > 0).all():
        raise InputError(
            "readout.open_loop_gain: finite for some columns and infinite for others, with an infinite "
            "gain_bandwidth and a column_capacitance; name a gain_bandwidth"
        )
    if (held > 0).all():  # states v - (C + Cf)/held e: the input is where the amplifier puts it
        jump = total / held
        matrix = -(slack * loaded + feedback * one) / held[:, None]
        return Dynamics(
            matrix=matrix,
            voltage=loaded / held[:, None] + jump * matrix,
            current=-one / held,
            output=one,
            feedthrough=jump * one,
            current_feedthrough=none,
            lift=one,
        )
    at_once = inv(slack * loaded + feedback * one)
    return Dynamics(
        matrix=np.zeros((0, 0)),
        voltage=np.zeros((0, columns)),
        current=np.zeros((0, columns)),
        output=np.zeros((columns, 0)),
        feedthrough=at_once @ loaded,
        current_feedthrough=-at_once,
        lift=np.zeros((0, columns)),
    )


def require_amplifiers(board: Board) -> None:
    """Raise InputError for circuits whose dynamics are not modelled."""
    if not board.circuit.virtual_ground:
        modelled = " and ".join(f'"{circuit.name}"' for circuit in CIRCUITS.values() if circuit.virtual_ground)
        raise InputError(f'readout.circuit = "{board.circuit.name}": settling and noise are modelled for {modelled}')
