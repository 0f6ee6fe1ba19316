"""Forward and adjoint port potentials, from which :mod:`.._sensitivity` computes the derivatives of readings.

A *group* is a set of readings that share their scan steps. For each reading the group holds the port potentials of two
fields. The forward field has the sources of the scan step. The adjoint field has these sources off and a unit source
where the reading is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from ...common.arrays import FloatArray, IntArray
from .._parts import Parts
from ..solvers import IDEAL_WIRE, inverted, siemens
from ._ends import Ends


class SensitivityGroup(NamedTuple):
    """Readings ``np.ix_(rows, columns)`` that share their fields, as potentials of the N + M ports.

    A field has one entry per reading, or one for all readings of a row or of a column: axes (rows, columns, ports).
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
    own_parts: dict[str, FloatArray]
    """(rows, columns, M) derivatives by the circuit's own parts, by the names of :class:`.Sensitivity`"""


class TiedPorts(NamedTuple):
    """The ports' potentials as a function of the sources that they are tied to."""

    ports: FloatArray
    """(N + M, N + M) S"""
    tie: FloatArray
    """(N + M,) S"""
    inner: FloatArray
    """(N + M, N + M) ohm"""

    @classmethod
    def of(cls, ports: FloatArray, tie: FloatArray) -> TiedPorts:
        """Ports of a grid, and the conductance (N + M,) in S that ties each to its source; inf is an ideal wire."""
        largest = max(float(ports.max(initial=0.0)), float(np.max(tie, where=np.isfinite(tie), initial=1e-300)))
        tie = np.minimum(tie, IDEAL_WIRE * largest)
        return cls(ports, tie, inverted(ports, tie).value)

    def potentials(self, source: FloatArray) -> FloatArray:
        """(..., N + M) V at the ports for sources (..., N + M) behind their ties."""
        result: FloatArray = (source * self.tie) @ self.inner
        return result

    def currents(self, potential: FloatArray, source: FloatArray) -> FloatArray:
        """(..., N + M) A out of the ports into their ties; by the grid's currents where the tie conducts better."""
        stiff = self.tie > self.ports.sum(axis=-1)
        through_tie = np.where(stiff, 0.0, self.tie) * (potential - source)
        through_grid = potential @ self.ports - potential * self.ports.sum(axis=-1)
        result: FloatArray = np.where(stiff, through_grid, through_tie)
        return result


class TerminatedColumns(NamedTuple):
    """Scan steps in which every column ends in a Thevenin equivalent."""

    rows: IntArray
    """rows that are selected in turn"""
    columns: IntArray
    """columns that are read"""
    one_by_one: bool
    """whether each column is read on its own, while the others end as idle columns do"""
    ends: Ends
    own_parts: Callable[[IntArray, FloatArray, FloatArray], dict[str, FloatArray]]
    """function of columns, currents (rows, 1, M) and adjoint currents (1, columns, M) in A; returns
    :attr:`SensitivityGroup.own_parts`"""


def terminated_groups(board: Parts, ports: FloatArray, steps: TerminatedColumns) -> Iterator[SensitivityGroup]:
    """Groups of readings of such steps: one for each row if idle rows float, one for each column if columns are read
    one by one.
    """
    rows, columns = board.shape
    fixed_ports = rows + board.pulled  # the ports ahead of the columns
    ends = steps.ends
    for some_rows in np.split(steps.rows, len(steps.rows)) if board.floating else [steps.rows]:
        for read in board.turns if steps.one_by_one else [np.ones(columns, dtype=np.bool_)]:
            some = steps.columns[read[steps.columns]]
            if not len(some):
                continue
            tie = np.zeros(fixed_ports + columns)
            tie[some_rows if board.floating else slice(rows)] = np.inf
            tie[rows:fixed_ports] = np.inf
            tie[fixed_ports:] = siemens(np.where(read, ends.resistance, board.idle_resistance) + board.column_lead)
            ties = TiedPorts.of(ports, tie)
            behind = np.zeros((len(some_rows), fixed_ports + columns))
            behind[:, fixed_ports:] = np.where(read, ends.source, board.idle_source)
            behind[np.arange(len(some_rows)), some_rows] = board.drive
            forward = ties.potentials(behind)
            unit = np.zeros((len(some), fixed_ports + columns))
            unit[np.arange(len(some)), fixed_ports + some] = ends.slope[some]
            adjoint = ties.potentials(unit)
            current = ties.currents(forward, behind)[:, None, fixed_ports:]
            adjoint_current = ties.currents(adjoint, unit)[None, :, fixed_ports:]
            yield SensitivityGroup(
                rows=some_rows,
                columns=some,
                forward=forward[:, None],
                adjoint=adjoint[None],
                lead_current=current,
                adjoint_lead_current=adjoint_current,
                own_parts=steps.own_parts(some, current, adjoint_current),
            )
