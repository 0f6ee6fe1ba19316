"""The exact method: one elimination for a whole frame, and a bound on what rounding did to it."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, isfinite

import numpy as np

from ..arrays import FloatArray
from ._design import Design
from ._grid import exact_ports, refuse_contradictions
from ._linear import LinearReadout, few_ulp
from ._parts import Parts, cell_conductance
from ._readout import Reading, amplifier_ends, read
from .solvers import _banded as banded
from .solvers._ports import Lines, has_ideal_lines, transfer_conductances

Transfer = Callable[[FloatArray, Lines], tuple[FloatArray, FloatArray]]
"""Cells (..., N, M) in S and their lines to transfer conductances in S, and by how much each may be off."""


def read_exactly(
    design: Design, resistance: FloatArray, transfer_of: Transfer | None = None
) -> tuple[Reading, FloatArray]:
    """Outputs of frames of cells, and how far rounding can have moved each, in V.

    Args:
        design: what reads them.
        resistance: (..., rows, columns) ohm.
        transfer_of: what to use in place of :func:`exact_transfer`.

    """
    linear = LinearReadout.of(design)
    if linear is None:
        return _read_ports(design, resistance)
    if (resistance == 0).any():
        refuse_contradictions(design, resistance)
    transfer, off = (transfer_of or exact_transfer)(cell_conductance(design, resistance), linear.lines)
    volts = linear.volts(transfer)
    error = linear.error(off, transfer)
    saturated = np.zeros(volts.shape, dtype=np.bool_)
    limited = ~linear.within_supply(volts, error)
    if limited.any():
        some, error[limited] = _read_ports(design, resistance[limited])
        volts[limited], saturated[limited] = some.volts, some.saturated
    return Reading(volts, saturated), error


def _read_ports(design: Design, resistance: FloatArray) -> tuple[Reading, FloatArray]:
    """By the whole network between the ports, for any circuit."""
    ports, relative = exact_ports(design, resistance)
    reading = read(design, ports)
    few = few_ulp(reading.volts.shape)
    parts = Parts.of(design)
    without = abs(design.readout.reference_voltage) + np.abs(parts.offset) + np.abs(parts.reference * parts.bias)
    moved = float(relative.max(initial=0.0)) + reading.relative + few
    return reading, _error(design, ports, moved) + few * (np.abs(reading.volts) + without)


def exact_transfer(conductance: FloatArray, grid: Lines) -> tuple[FloatArray, FloatArray]:
    """Transfer conductances (..., N, M) in S, and by how much each may be off, see :mod:`._elimination`."""
    if conductance.size <= banded.LARGEST and conductance.ndim == 2 and not has_ideal_lines(grid):
        small = banded.transfer(conductance, grid)
        if small is not None:
            return small
    transfer, relative = transfer_conductances(conductance, grid)
    return transfer, transfer_error(conductance, grid, transfer, relative)


def transfer_error(conductance: FloatArray, grid: Lines, transfer: FloatArray, relative: FloatArray) -> FloatArray:
    """S by which transfer conductances may be off after a relative error (...,) in every stage."""
    relative = relative[..., None, None]
    if has_ideal_lines(grid):
        return relative * transfer  # one elimination: each entry has that relative error
    row, column = port_roots(conductance, grid)
    row, column = (np.where(root > 0, root, np.nan) for root in (row, column))
    error = relative * row[..., :, None] * column[..., None, :]
    return np.where(np.isnan(error), 0.0, error)  # nothing flows from a row or into a column that is open


def port_roots(conductance: FloatArray, grid: Lines) -> tuple[FloatArray, FloatArray]:
    """Bounds on sqrt(Y_ii) of each row terminal (..., N) and each column terminal (..., M), in sqrt(S).

    Y_ii is the conductance of a port with all others at ground. By Rayleigh's law it grows when the lines that cross
    port i's are grounded all along: what is left is a chain of its cells.
    """
    exits = np.full(conductance.shape[-1], inf) if grid.exit is None else grid.exit
    column = np.concatenate([exits[None], grid.column[:0:-1]])
    turned = np.swapaxes(conductance, -1, -2)[..., ::-1]
    return np.sqrt(_chain(conductance, grid.row)), np.sqrt(_chain(turned, column.T))


def _chain(shunt: FloatArray, series: FloatArray) -> FloatArray:
    """S into chains (..., lines, places) of cells to ground, ``series`` ahead of each cell."""
    lumped = _in_series(series[:, 0], shunt.sum(axis=-1))  # all other wires ideal: more, and cheaper
    if np.isfinite(lumped).all():
        return lumped
    admittance = np.zeros(shunt.shape[:-1])
    for place in reversed(range(shunt.shape[-1])):
        admittance = _in_series(series[:, place], admittance + shunt[..., place])
    return admittance


def _in_series(one: FloatArray, other: FloatArray) -> FloatArray:
    with np.errstate(divide="ignore"):
        ohms: FloatArray = 1.0 / one + 1.0 / other
        return 1.0 / ohms


def _into_rows(ports: FloatArray, rows: int, behind: FloatArray) -> FloatArray:
    """Bounds (..., N) in S on the conductance of each row terminal, all others at ground, the columns behind so many
    ohm.

    By Dirichlet's principle any potentials of the column terminals give an upper bound; each stands at that of the row
    or at ground, whichever costs less. So a short does not count more than what it leads to.
    """
    driven = ports[..., :rows, rows:]
    others = np.zeros_like(driven)  # of all other rows: from above and from below, since subtracting would cost digits
    np.cumsum(driven[..., :-1, :], axis=-2, out=others[..., 1:, :])
    others[..., :-1, :] += np.cumsum(driven[..., :0:-1, :], axis=-2)[..., ::-1, :]
    with np.errstate(divide="ignore"):
        beyond = ports[..., rows:, rows:].sum(axis=-1) + 1.0 / behind
    bound: FloatArray = ports[..., :rows, :rows].sum(axis=-1)
    bound += np.minimum(driven, others + beyond[..., None, :]).sum(axis=-1)
    return bound


def _error(design: Design, ports: FloatArray, relative: float) -> FloatArray:
    """V by which rounding can have moved the outputs of any circuit: every port's voltage takes part."""
    part, parts = design.readout, Parts.of(design)
    behind = parts.column_lead
    behind = behind + (amplifier_ends(design).resistance if part.circuit == "inverting-amplifier" else parts.reference)
    rows = design.array.rows
    total = ports.sum(axis=-1)[..., rows:]
    row = np.sqrt(_into_rows(ports, rows, behind))
    with np.errstate(divide="ignore"):
        column = np.sqrt(_in_series(total, 1.0 / behind))
    level = part.reference_voltage
    limits = [abs(limit - level) for limit in part.supply if isfinite(limit)]
    others = np.maximum(np.abs(parts.offset) + abs(level) / (1.0 + parts.gain), max(limits, default=0.0))
    others += np.abs(parts.reference * parts.bias)
    applied = abs(design.drive.voltage) * row[..., :, None] + (others * column).sum(axis=-1)[..., None, None]
    error: FloatArray = parts.reference * relative * applied * column[..., None, :]
    return error
