"""Exact transfer conductances of a grid, and a bound on their rounding errors."""

from __future__ import annotations

from math import inf

import numpy as np

from ...common.arrays import FloatArray
from ._ports import Lines, has_ideal_lines, transfer_conductances


def exact_transfer(conductance: FloatArray, grid: Lines) -> tuple[FloatArray, FloatArray]:
    """Transfer conductances (..., N, M) in S, and a bound in S on the rounding error of each.

    Args:
        conductance: (..., N, M) S of the cells.
        grid: the lines; their exits are the conductances that the columns end in.

    """
    transfer, relative = transfer_conductances(conductance, grid)
    return transfer, _transfer_error(conductance, grid, transfer, relative)


def _transfer_error(conductance: FloatArray, grid: Lines, transfer: FloatArray, relative: FloatArray) -> FloatArray:
    """Bound in S on the errors of transfer conductances, for a relative error (...,) of all conductances.

    This is the smaller one of two bounds: by the energies of the ports (:mod:`._elimination`), and entry by entry
    (:func:`entrywise`). The second bound is coarse, but finite where a port has an infinite conductance to the others.
    """
    rows, columns = transfer.shape[-2:]
    eliminated = rows + columns if has_ideal_lines(grid) else 2 * rows * columns
    relative = relative[..., None, None]
    row, column = port_roots(conductance, grid)
    row, column = (np.where(root > 0, root, np.nan) for root in (row, column))
    error = np.fmin(relative * row[..., :, None] * column[..., None, :], entrywise(relative, eliminated) * transfer)
    return np.where(np.isnan(row)[..., :, None] | np.isnan(column)[..., None, :], 0.0, error)  # open line: zero


def entrywise(relative: FloatArray, eliminated: int) -> FloatArray:
    """Bound on the relative error of each single port conductance, after relative errors of all conductances.

    A port conductance is a quotient of two polynomials in the branch conductances, with coefficients that are not
    negative (the all-minors matrix tree theorem, Chaiken 1982). Each monomial is a product of as many conductances as
    nodes are eliminated, and one more in the numerator.
    """
    bound: FloatArray = (2.0 * eliminated + 1.0) * relative
    return bound


def port_roots(conductance: FloatArray, grid: Lines) -> tuple[FloatArray, FloatArray]:
    """Bounds on sqrt(Y_ii) of each row terminal (..., N) and each column terminal (..., M), in sqrt(S).

    Y_ii is the conductance of a port with all others at ground. By Rayleigh's monotonicity law Y_ii grows when nodes
    are grounded. We ground the lines that cross port i's line. Where some cells conduct better than the wires, we leave
    the crosspoints with port i's line ungrounded. The remaining network is a ladder of cells to ground. In the second
    case each cell is in series with the crossing line's wires to the neighbouring crosspoints.
    """
    exits = np.full_like(grid.column[..., 0, :], inf) if grid.exit is None else grid.exit
    into_row = into_column = conductance
    below = np.concatenate([grid.column[..., 1:, :], exits[..., None, :]], axis=-2)
    stiff = conductance.max(initial=0.0) > min(below.min(initial=inf), grid.row.min(initial=inf))
    if stiff:
        along_column, along_row = below.copy(), grid.row.copy()
        along_column[..., 1:, :] += below[..., :-1, :]
        along_row[..., :-1] += grid.row[..., 1:]
        into_row = series_conductance(conductance, along_column)
        into_column = series_conductance(conductance, along_row)
    transposed = np.swapaxes(into_column, -1, -2)[..., ::-1]
    along = np.swapaxes(below, -1, -2)[..., ::-1]
    return np.sqrt(_chain(into_row, grid.row, stiff)), np.sqrt(_chain(transposed, along, stiff))


def _chain(shunt: FloatArray, series: FloatArray, stiff: bool) -> FloatArray:
    """Bound in S on the conductance into ladders (..., lines, places) of cells to ground, ``series`` ahead of each.

    Unless ``stiff`` (some cells conduct better than the wires), all wires but the first are taken as ideal. The bound
    is then larger, and cheaper to compute.
    """
    if not stiff:
        lumped = series_conductance(series[..., 0], shunt.sum(axis=-1))
        if np.isfinite(lumped).all():
            return lumped
    admittance = np.zeros(shunt.shape[:-1])
    for place in reversed(range(shunt.shape[-1])):
        admittance = series_conductance(series[..., place], admittance + shunt[..., place])
    return admittance


def series_conductance(one: FloatArray, other: FloatArray) -> FloatArray:
    """S of two conductances in series; inf is a wire and 0 a break."""
    with np.errstate(divide="ignore"):
        ohms: FloatArray = 1.0 / one + 1.0 / other
        return 1.0 / ohms
