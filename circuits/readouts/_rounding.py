"""How far rounding can have moved the outputs of a circuit whose columns end in resistors and sources.

A relative error e of all conductances changes the current at port i for 1 V at port j by at most e sqrt(Y_ii Y_jj),
where Y_ii is the conductance of port i with all other ports at ground (:mod:`..solvers._elimination`). Bounds on the
Y_ii of all ports therefore bound the error of every output.
"""

from __future__ import annotations

from math import isfinite

import numpy as np

from ...arrays import FloatArray
from .._parts import Parts
from ..solvers import series_conductance, siemens
from ._ends import sum_of_others


def energy_bound(board: Parts, ports: FloatArray, relative: float, end_resistance: FloatArray) -> FloatArray:
    """V (..., N, M) by which a relative error of all conductances can have moved the outputs.

    Args:
        board: sources, leads and reference resistors.
        ports: (..., N + M, N + M) S between row terminals and column terminals.
        relative: of all conductances.
        end_resistance: (M,) ohm behind the column leads.

    """
    behind = board.column_lead + end_resistance
    rows = board.shape[0]
    total = ports.sum(axis=-1)[..., rows:]
    row = np.sqrt(conductance_into_rows(ports, rows, behind))
    column = np.sqrt(series_conductance(total, siemens(behind)))
    limits = [abs(limit - board.level) for limit in board.supply if isfinite(limit)]
    others = np.maximum(np.abs(board.offset) + abs(board.level) * board.inverse_gain, max(limits, default=0.0))
    others += np.abs(board.lift)
    with np.errstate(invalid="ignore"):  # no volts behind an infinite conductance
        applied = abs(board.drive) * row[..., :, None] + (others * column).sum(axis=-1)[..., None, None]
        error: FloatArray = board.reference * relative * applied * column[..., None, :]
    return error


def conductance_into_rows(ports: FloatArray, rows: int, behind: FloatArray) -> FloatArray:
    """Bounds (..., N) in S on the conductance of each row terminal, all others at ground, the columns behind so many
    ohm.

    By Dirichlet's principle any potentials of the column terminals give an upper bound. Each column terminal stands at
    the potential of the row or at ground, whichever costs less. So a short does not count more than what it leads to.
    """
    driven = ports[..., :rows, rows:]
    beyond = ports[..., rows:, rows:].sum(axis=-1) + siemens(behind)
    bound: FloatArray = ports[..., :rows, :rows].sum(axis=-1)
    bound += np.minimum(driven, sum_of_others(driven) + beyond[..., None, :]).sum(axis=-1)
    return bound
