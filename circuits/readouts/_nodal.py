"""Readings and derivatives where ends are no Thevenin equivalents: :mod:`..ends._nodal` solves each scan step."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._parts import Parts
from .._tuning import MOST_SIEMENS
from ..ends import Solution, System, solve, step_system
from ._adjoint import SensitivityGroup
from ._circuit import Reading


def read_nodes(board: Parts, ports: FloatArray) -> Reading:
    """Outputs of frames (..., N, M), each scan step solved node by node. Arguments as for :meth:`.ReadoutCircuit.read`.

    Raises:
        SolverError: as :func:`solve`.

    """
    batch, (rows, columns) = ports.shape[:-2], board.shape
    frames = ports.reshape(-1, *ports.shape[-2:])
    volts, magnitude, error = np.zeros((3, len(frames), rows, columns))
    saturated = np.zeros(volts.shape, dtype=np.bool_)
    for frame, network in enumerate(frames):
        for row, read, system, found in _steps(board, network):
            some, places = np.flatnonzero(read), system.outputs[read]
            volts[frame, row, some] = found.unknowns[places]
            error[frame, row, some] = found.error[places]
            saturated[frame, row, some] = np.isin(places, found.limited)
            size = len(network)
            forward, adjoint = found.unknowns[:size], found.inverse[places, :size]
            drop = np.abs(forward[:, None] - forward) * np.minimum(network, MOST_SIEMENS)
            for place, field in zip(some, adjoint, strict=True):
                magnitude[frame, row, place] = 0.5 * float((drop * np.abs(field[:, None] - field)).sum())
    shape = (*batch, rows, columns)
    volts, saturated, magnitude, error = (part.reshape(shape) for part in (volts, saturated, magnitude, error))
    return Reading(volts, saturated, magnitude, 0.0, error)


def node_groups(board: Parts, ports: FloatArray) -> Iterator[SensitivityGroup]:
    """Fields of all readings of one frame at their operating points: :meth:`.ReadoutCircuit.sensitivity_groups`."""
    rows, columns = board.shape
    size = rows + columns
    for row, read, system, found in _steps(board, ports):
        some = np.flatnonzero(read)
        forward, adjoint = found.unknowns[None, :size], found.inverse[system.outputs[some], :size]
        into, into_adjoint = (
            field @ ports[:, rows:] - field[:, rows:] * ports[rows:].sum(axis=1) for field in (forward, adjoint)
        )
        yield SensitivityGroup(
            rows=np.array([row]),
            columns=some,
            forward=forward[:, None],
            adjoint=adjoint[None],
            lead_current=into[:, None],
            adjoint_lead_current=into_adjoint[None],
            own_parts=dict,
        )


def _steps(board: Parts, ports: FloatArray) -> Iterator[tuple[int, BoolArray, System, Solution]]:
    start: dict[int, FloatArray] = {}
    ends = board.line_ends
    assert ends is not None
    for row in range(board.shape[0]):
        for turn, read in enumerate(board.turns):
            system = step_system(ends, board.column_lead, ports, ends.of_step(row, read), read)
            found = solve(system, start.get(turn))
            start[turn] = found.unknowns
            yield row, read, system, found
