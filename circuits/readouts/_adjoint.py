"""Forward and adjoint port potentials, from which :mod:`.._sensitivity` computes the derivatives of readings.

A *group* is a set of readings that share their scan steps. For each reading the group holds the port potentials of two
fields. The forward field has the sources of the scan step. The adjoint field has these sources off and a unit source
where the reading is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from .._parts import Parts, of_columns
from ..solvers import IDEAL_WIRE, inverted, siemens
from ._ends import Ends


class SensitivityGroup(NamedTuple):
    """Readings ``np.ix_(rows, columns)`` that share their fields, as potentials of the N + M ports.

    A field has one entry per reading, or one for all readings of a row or of a column: axes (rows, columns, ports), and
    ahead of them that of a stack.
    """

    rows: IntArray
    columns: IntArray
    forward: FloatArray
    """V at the ports"""
    adjoint: FloatArray
    """V at the ports per unit of the reading"""
    lead_current: FloatArray
    """(rows, columns, M) A of the forward field into the columns' ends"""
    adjoint_lead_current: FloatArray
    own_parts: Callable[[], dict[str, FloatArray]]
    """(rows, columns, M) derivatives by the circuit's own parts, by the names of :class:`.Sensitivity`"""


class TiedPorts(NamedTuple):
    """The ports' potentials as a function of the sources that they are tied to."""

    ports: FloatArray
    """(..., N + M, N + M) S"""
    tie: FloatArray
    """(..., N + M) S"""
    inner: FloatArray
    """(..., N + M, N + M) ohm"""

    @classmethod
    def of(cls, ports: FloatArray, tie: FloatArray) -> TiedPorts:
        """Ports of a grid, and the conductance (..., N + M) in S that ties each to its source; inf is an ideal wire."""
        largest = max(float(ports.max(initial=0.0)), float(np.max(tie, where=np.isfinite(tie), initial=1e-300)))
        tie = np.minimum(tie, IDEAL_WIRE * largest)
        return cls(ports, tie, inverted(ports, tie).value)

    def potentials(self, source: FloatArray) -> FloatArray:
        """(..., N + M) V at the ports for sources (..., N + M) behind their ties."""
        result: FloatArray = (source * self.tie[..., None, :]) @ self.inner
        return result

    def currents(self, potential: FloatArray, source: FloatArray) -> FloatArray:
        """(..., N + M) A out of the ports into their ties; by the grid's currents where the tie conducts better."""
        total = self.ports.sum(axis=-1)
        stiff = self.tie > total
        through_tie = np.where(stiff, 0.0, self.tie)[..., None, :] * (potential - source)
        through_grid = potential @ self.ports - potential * total[..., None, :]
        result: FloatArray = np.where(stiff[..., None, :], through_grid, through_tie)
        return result


def terminated_groups(
    board: Parts, ports: FloatArray, steps: IntArray, ends: Ends, slopes: Callable[[], dict[str, Ends]]
) -> Iterator[SensitivityGroup]:
    """Groups of readings of columns that end in Thevenin equivalents: one for each row if idle rows float, one for each
    turn if columns take turns.

    Args:
        board: drive, leads, idle rows and idle columns.
        ports: (..., P, P) S between the row terminals, the reference if rows have pull-downs, and the column terminals.
        steps: rows that are selected in turn.
        ends: the end of each column while it is read.
        slopes: gives derivatives of ``ends`` by each kind of part of the same column.

    """
    rows, columns = board.shape
    fixed_ports = rows + board.pulled  # the ports ahead of the columns
    for some_rows in np.split(steps, len(steps)) if board.floating else [steps]:
        for read in board.turns:
            some = np.flatnonzero(read)
            batch, every = ports.shape[:-2], fixed_ports + columns
            tie = np.zeros((*batch, every))
            tie[..., some_rows if board.floating else slice(rows)] = np.inf
            tie[..., rows:fixed_ports] = np.inf
            resistance = np.where(read, ends.resistance, board.idle_resistance) + board.column_lead
            tie[..., fixed_ports:] = siemens(of_columns(resistance))
            ties = TiedPorts.of(ports, tie)
            behind = np.zeros((*batch, len(some_rows), every))
            behind[..., fixed_ports:] = np.where(read, ends.source, board.idle_source)
            behind[..., np.arange(len(some_rows)), some_rows] = np.atleast_2d(board.drive)[..., 0]
            forward = ties.potentials(behind)
            unit = np.zeros((*batch, len(some), every))
            unit[..., np.arange(len(some)), fixed_ports + some] = of_columns(ends.slope)[..., some]
            adjoint = ties.potentials(unit)
            current = ties.currents(forward, behind)[..., None, fixed_ports:]
            adjoint_current = ties.currents(adjoint, unit)[..., None, :, fixed_ports:]

            def by_parts(
                read: BoolArray = read, current: FloatArray = current, adjoint: FloatArray = adjoint_current
            ) -> dict[str, FloatArray]:
                return {name: _by_part(slope, name, board, read, current, adjoint) for name, slope in slopes().items()}

            yield SensitivityGroup(
                rows=some_rows,
                columns=some,
                forward=forward[..., None, :],
                adjoint=adjoint[..., None, :, :],
                lead_current=current,
                adjoint_lead_current=adjoint_current,
                own_parts=by_parts,
            )


def _by_part(
    slope: Ends, name: str, board: Parts, read: BoolArray, current: FloatArray, adjoint: FloatArray
) -> FloatArray:
    """Derivatives (rows, columns read, M) of readings by one kind of part.

    A part acts through the end of its column (the product of both currents by its resistance, the adjoint current by
    its source), and directly on the reading of its own column.
    """
    idle = float(name == "reference_resistance" and board.idle_columns == "load")  # the part that idle ends have
    found: FloatArray = current * adjoint * np.where(read, slope.resistance, idle)
    found += adjoint * np.where(read, slope.source, 0.0)
    some = np.flatnonzero(read)
    found[:, np.arange(len(some)), some] += (slope.output + slope.slope * current[:, 0])[:, some]
    return found
