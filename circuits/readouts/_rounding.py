"""Bound on the rounding errors of outputs, for circuits whose columns end in resistors and sources.

A relative error e of all conductances changes the current at port i for 1 V at port j by at most e sqrt(Y_ii Y_jj),
where Y_ii is the conductance of port i with all other ports at ground (:mod:`..solvers._elimination`). Bounds on the
Y_ii of all ports therefore bound the error of every output.
"""

from __future__ import annotations

import numpy as np

from ...common.arrays import FloatArray
from .._parts import Parts, of_columns
from ..solvers import series_conductance, siemens
from ._ends import sum_of_others


def energy_bound(
    board: Parts, ports: FloatArray, relative: float, end_resistance: FloatArray, sources: FloatArray, gain: FloatArray
) -> FloatArray:
    """Bound in V (..., N, M) on the errors of outputs by a relative error of all conductances.

    Args:
        board: drive and leads.
        ports: (..., P, P) S between row terminals, the reference if rows have pull-downs, and column terminals.
        relative: bound on the relative error of all conductances.
        end_resistance: (M,) ohm behind the column leads.
        sources: (M,) V, largest magnitude behind each of them.
        gain: (M,) ohm: largest magnitude of output over current.

    """
    behind = of_columns(board.column_lead + end_resistance)
    rows = board.shape[0]
    total = ports.sum(axis=-1)[..., rows + board.pulled :]
    ends = np.insert(behind, 0, 0.0, axis=-1) if board.pulled else behind
    row = np.sqrt(conductance_into_rows(ports, rows, ends))
    column = np.sqrt(series_conductance(total, siemens(behind)))
    with np.errstate(invalid="ignore"):  # inf times 0 where a conductance is infinite
        applied = abs(board.drive) * row[..., :, None] + (of_columns(sources) * column).sum(axis=-1)[..., None, None]
        error: FloatArray = gain * relative * applied * column[..., None, :]
    return error


def conductance_into_rows(ports: FloatArray, rows: int, behind: FloatArray) -> FloatArray:
    """Bounds (..., N) in S on the conductance into each row terminal, with all other terminals at ground.

    By Dirichlet's principle any choice of potentials at the column terminals gives an upper bound. We set each column
    terminal to the potential of the row or to ground, whichever gives the smaller bound. A shorted cell thus counts at
    most as much as the conductance from its column to everything else.

    Args:
        ports: (..., N + M, N + M) S between row terminals and column terminals.
        rows: N.
        behind: (M,) ohm from each column terminal to ground.

    """
    driven = ports[..., :rows, rows:]
    beyond = ports[..., rows:, rows:].sum(axis=-1) + siemens(behind)
    bound: FloatArray = ports[..., :rows, :rows].sum(axis=-1)
    bound += np.minimum(driven, sum_of_others(driven) + beyond[..., None, :]).sum(axis=-1)
    return bound
