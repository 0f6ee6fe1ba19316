"""Columns that end in a Thevenin equivalent: the common model of amplifiers and loads.

Each column of a scan step ends in a resistance and a source (:class:`Ends`). Kron reduction joins the grid's port
network with these ends. The currents into the ends then follow for all scan steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import FloatArray, IntArray
from .._parts import Parts, of_columns
from ..solvers import IDEAL_WIRE, Rounded, eliminate_leading, inverted, siemens

Values = NDArray[Any]
"""(M,) values of a board's columns, (S, M) of S boards; complex for derivatives by a complex step"""


class EndParts(NamedTuple):
    """Parts at the end of each column."""

    reference: Values
    """ohm"""
    slack: Values
    """reciprocal of the open-loop gain"""
    offset: Values
    """V"""
    bias: Values
    """A"""
    level: Values
    """V, the reference voltage"""

    @classmethod
    def of(cls, board: Parts) -> Self:
        return cls(board.reference, 1.0 / board.gain, board.offset, board.bias, np.atleast_1d(board.level))


class Ends(NamedTuple):
    """Thevenin equivalent at the end of each column (M,) in one scan step, and the output as a function of the current.

    Sources are relative to the reference voltage, so that a mid-supply reference costs no digits.
    """

    resistance: FloatArray
    """ohm"""
    source: FloatArray
    """V against the reference"""
    output: FloatArray
    """V at zero current"""
    slope: FloatArray
    """V/A"""


def terminate(ports: FloatArray, rows: int, resistance: FloatArray) -> Rounded:
    """The network in S between the first ``rows`` ports and the far ends of ``resistance`` (M,) in ohm.

    ``ports`` is the network between row terminals and column terminals. Each resistance is connected behind a column
    terminal, and the column terminals are then eliminated.
    """
    if not resistance.any():
        return Rounded(ports, np.zeros(ports.shape[:-2]))
    behind = siemens(of_columns(resistance))
    columns = behind.shape[-1]
    largest = np.max(behind, where=np.isfinite(behind), initial=ports.max(initial=0.0))
    behind = np.minimum(behind, IDEAL_WIRE * largest)
    network = np.zeros((*ports.shape[:-2], rows + 2 * columns, rows + 2 * columns))
    near, row = slice(0, columns), slice(columns, columns + rows)
    far = np.arange(columns + rows, rows + 2 * columns)
    network[..., near, near] = ports[..., rows:, rows:]
    network[..., near, row] = ports[..., rows:, :rows]
    network[..., row, near] = ports[..., :rows, rows:]
    network[..., row, row] = ports[..., :rows, :rows]
    network[..., np.arange(columns), far] = network[..., far, np.arange(columns)] = behind
    return eliminate_leading(network, columns)


class Currents(NamedTuple):
    """Currents into the columns' sources, in every scan step."""

    value: FloatArray
    """(..., N, M) A"""
    magnitude: FloatArray
    """(..., N, M) A: sum of the magnitudes of the terms of the current, of a difference of sources both"""
    relative: FloatArray
    """(...,) bound on the relative error of the network's conductances, all further eliminations included"""


def column_currents(board: Parts, terminated: Rounded, source: FloatArray) -> Currents:
    """Currents into the columns' sources (M,) in V, in every scan step.

    Args:
        board: drive and idle rows.
        terminated: (..., P, P) S between the row terminals, the reference if rows have pull-downs, and the sources.
        source: V against the reference.

    """
    network, relative = terminated
    rows, columns = board.shape
    source = of_columns(source)
    here, there = source[..., None, :], source[..., None]
    difference = here - there  # exactly zero for equal sources, so that no large terms cancel
    both = np.where(difference != 0, np.abs(here) + np.abs(there), 0.0)
    if not board.floating:
        transfer, between = network[..., :rows, rows:], network[..., rows:, rows:]
        idle = (between * difference).sum(axis=-1) - transfer.sum(axis=-2) * source
        idle_size = (between * both).sum(axis=-1) + transfer.sum(axis=-2) * np.abs(source)
        value = board.drive * transfer + idle[..., None, :]
        return Currents(value, abs(board.drive) * transfer + idle_size[..., None, :], relative)
    currents, sizes = np.full((2, *network.shape[:-2], rows, columns), np.nan)
    worst = np.zeros(relative.shape)  # each step is solved on its own
    drive = np.atleast_2d(board.drive)
    applied = np.concatenate([drive, np.zeros_like(drive)][: 1 + board.pulled], axis=-2)
    fixed = applied.shape[-2]
    for row, alone, step in one_driven(network, rows, board.steps):
        worst = np.maximum(worst, step)
        to_fixed, between = alone[..., :fixed, fixed:], alone[..., fixed:, fixed:]
        currents[..., row, :] = (to_fixed * (applied - here)).sum(axis=-2) + (between * difference).sum(axis=-1)
        sizes[..., row, :] = (to_fixed * (np.abs(applied) + np.abs(here))).sum(axis=-2) + (between * both).sum(axis=-1)
    return Currents(currents, sizes, relative + worst)


def one_driven(
    network: FloatArray, rows: int, steps: IntArray | None = None
) -> Iterator[tuple[int, FloatArray, FloatArray]]:
    """For each selected row, the network between its terminal and all ports that are no rows, the other rows open.

    Yields:
        The row, the network in S, and a bound on its relative error.

    """
    others = np.arange(rows, network.shape[-1])
    for row in range(rows) if steps is None else steps.tolist():
        order = np.r_[np.delete(np.arange(rows), row), row, others]
        yield row, *eliminate_leading(network[..., order[:, None], order], rows - 1)


def currents_in_turns(board: Parts, ports: FloatArray, ends: Ends) -> Currents:
    """Currents into the columns' ends where columns take turns, and the others end as idle columns do.

    Args:
        board: drive, idle rows and idle columns.
        ports: (..., P, P) S between the row terminals, the reference if rows have pull-downs, and the column terminals.
        ends: the end of each column while it is read.

    """
    rows, columns = board.shape
    if not board.pulled and reads_alone(board, ends):
        return _currents_alone(board, ports, ends.resistance + board.column_lead)
    value, magnitude = np.empty((2, *ports.shape[:-2], rows, columns))
    relative = np.zeros(ports.shape[:-2])
    for read in board.turns:
        behind = np.where(read, ends.resistance, board.idle_resistance) + board.column_lead
        terminated = terminate(ports, rows + board.pulled, behind)
        part = column_currents(board, terminated, np.where(read, ends.source, board.idle_source))
        for whole, own in zip((value, magnitude), part[:2], strict=True):
            whole[..., read] = own[..., read]
        relative = np.maximum(relative, part.relative)
    return Currents(value, magnitude, relative)


def reads_alone(board: Parts, ends: Ends) -> bool:
    """Whether each column is read with all others open, behind nothing but a resistance."""
    is_alone = board.shared_by >= board.shape[1] and np.isinf(board.idle_resistance).all()
    return bool(is_alone and not ends.source.any())


def _currents_alone(board: Parts, ports: FloatArray, behind: FloatArray) -> Currents:
    """As :func:`currents_in_turns` with ``behind`` (M,) ohm to the reference at one column at a time, the others open.

    By the Thevenin equivalents of the grid at its columns.
    """
    rows = board.shape[0]
    if board.floating:
        between, relative = effective_resistance(ports, rows, board.steps)
        current = board.drive / (behind + between)
    else:
        inner, relative = inverted(ports[..., rows:, rows:], ports[..., :rows, rows:].sum(axis=-2), rows)
        open_circuit = board.drive * ports[..., :rows, rows:] @ inner
        current = open_circuit / (behind + np.einsum("...jj->...j", inner)[..., None, :])
    return Currents(current, np.abs(current), relative)  # a quotient of sums of one sign


def effective_resistance(ports: FloatArray, rows: int, steps: IntArray | None = None) -> Rounded:
    """Ohm (..., N, M) between each row terminal and each column terminal with all other terminals open.

    The selected row is grounded in each step. Grounding one node for all pairs would cancel digits of nearby pairs.
    """
    size = ports.shape[-1]
    result = np.full((*ports.shape[:-2], rows, size - rows), np.nan)
    relative = np.zeros(ports.shape[:-2])  # each row is solved on its own
    for row in range(rows) if steps is None else steps.tolist():
        others = np.delete(np.arange(size), row)
        to_row = ports[..., row, others]
        inner, error = inverted(ports[..., others[:, None], others], to_row)
        relative = np.maximum(relative, error)
        follows = (inner @ to_row[..., None])[..., 0] > 0.5  # the row's potential; islands without it stay at 0
        ohms = np.where(follows, np.einsum("...jj->...j", inner), inf)
        result[..., row, :] = ohms[..., rows - 1 :]
    return Rounded(result, relative)


def sum_of_others(values: FloatArray) -> FloatArray:
    """For each entry of values (..., n, any), the sum of all other entries along the second last axis.

    We add partial sums from above and from below. Subtracting the entry from the whole sum would cost digits.
    """
    others = np.zeros_like(values)
    np.cumsum(values[..., :-1, :], axis=-2, out=others[..., 1:, :])
    others[..., :-1, :] += np.cumsum(values[..., :0:-1, :], axis=-2)[..., ::-1, :]
    return others
