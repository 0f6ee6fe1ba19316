"""Linear state-space model of the column amplifiers, shared by settling and noise.

In a scan step every column j is a virtual ground with the noise gain 1 + Rref Y_jj. The matrix Y (M, M) contains the
port conductances that the columns see in the grid, with all driven rows at ground. Line resistance couples the columns
through their common rows. Y then has off-diagonal entries, which the model keeps: the columns settle together.

The equations of each column hold for deviations from the settled state. The unknowns are the inverting input u and the
output v. The disturbances are a voltage e at the non-inverting input and a current i into the inverting input. With
w = 2 pi GBW (in 1/s), the column capacitance C and the feedback capacitance Cf (both in F):

    v'/w + v/A = e - u                                      one-pole amplifier
    C u' + Cf (u' - v') + Y u + (u - v)/Rref = i            current balance (KCL) at the inverting input
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, pi

import numpy as np
from scipy.linalg import inv

from ...common.arrays import FloatArray
from ...errors import InputError
from .._board import Board
from .._grid import exact_ports
from ..readouts import CIRCUITS, one_driven

_BROKEN_LEAD = 1e30  # ohm: replaces an infinite lead, which would give NaN


@dataclass(frozen=True)
class Dynamics:
    """``x' = matrix x + voltage e + current i``, ``v = output x + feedthrough e + current_feedthrough i``.

    S is the number of states and M the number of columns. A circuit without capacitance and with infinite bandwidth has
    no states; only the two feedthrough terms remain.
    """

    matrix: FloatArray
    """(S, S) 1/s"""
    voltage: FloatArray
    """(S, M): input matrix of e, the voltages at the non-inverting inputs"""
    current: FloatArray
    """(S, M): input matrix of i, the currents into the inverting inputs"""
    output: FloatArray
    """(M, S): output matrix"""
    feedthrough: FloatArray
    """(M, M): immediate effect of e on v"""
    current_feedthrough: FloatArray
    """(M, M) ohm: immediate effect of i on v"""
    lift: FloatArray
    """(S, M): derivative of the settled state by the settled outputs"""


def column_conductances(board: Board, cells: FloatArray) -> FloatArray:
    """Port conductance matrix Y in S that the amplifiers see, leads included.

    The shape is (1, M, M) with grounded idle rows. With floating idle rows Y depends on the selected row, and the shape
    is (N, M, M) with the selected row as first axis.
    """
    rows, columns = board.shape
    ports = exact_ports(board, cells).value
    if not board.floating:
        between, to_ground = ports[None, rows:, rows:], ports[None, rows:, :rows].sum(axis=-1)
    else:
        between, to_ground = np.empty((rows, columns, columns)), np.empty((rows, columns))
        for row, (alone, _) in enumerate(one_driven(ports, rows)):
            held = len(alone) - columns  # the selected row, and the reference behind pull-downs
            between[row], to_ground[row] = alone[held:, held:], alone[:held, held:].sum(axis=0)
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
    part = board.readout
    columns = len(conductance)
    one, none = np.eye(columns), np.zeros((columns, columns))
    feedback, slack = 1 / board.reference, 1 / board.gain  # (M,): multiplying a matrix scales its columns
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
        inner = inv(loaded)  # states v; u follows without delay
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
    if (held > 0).all():  # states v - (C + Cf)/held e; u = e - v/A without delay
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
    if not board.virtual_grounds:
        modelled = " and ".join(f'"{circuit.name}"' for circuit in CIRCUITS.values() if circuit.virtual_ground)
        here = " with multiplexed columns" if board.circuit.virtual_ground else ""
        raise InputError(
            f'readout.circuit = "{board.circuit.name}"{here}: settling and noise are modelled for {modelled} with an '
            "amplifier on each line"
        )
