"""Higher terms of the Neumann series whose zeroth term is line attenuation (:mod:`._attenuation`).

The k-th term is the current that leaves its line and comes back k times. It is computed from the *lift*: the volts that
a crossing line is raised by, at every crosspoint and in every scan step. These are N x N M numbers. A term takes two
products of the lift with the ladders' impedance matrices, which cost O(N^2 M^2).

The exact method (:mod:`._dissection`) is cheaper. The series is used for its smaller certified rounding error, because
fewer operations lie between the cells and a reading.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import inf

import numpy as np

from ...common.arrays import FloatArray
from ._attenuation import SLACK, Attenuated, Wires, by_ladders, geometric_sum
from ._elimination import ULP
from ._ladders import Ladders

LARGEST = 1 << 22  # numbers N x N M in the lift; beyond, the memory is not worth the gain


def terms(conductance: FloatArray, wires: Wires | None) -> Iterator[Attenuated]:
    """Partial sums of the Neumann series for one frame, each with its certificate.

    Args:
        conductance: (N, M) S of the cells.
        wires: of the grid; None if a line is broken.

    Yields:
        Transfer conductances with 1, 2, 3, ... terms. Nothing for shorted cells and broken lines, which ladders cannot
        express, and nothing where a profile underflows. Only the zeroth term where the series is not certain to
        converge, or where the lift would need too much memory.

    """
    if wires is None or not np.isfinite(conductance).all():
        return
    rows, columns = conductance.shape
    row, column = wires.ladders(conductance[None])
    known = Attenuated(*(part[0] for part in by_ladders(conductance[None], wires, ladders=(row, column))))
    profile, gain = row.profile.T, column.profile[::-1]
    relative = float(known.rounded[0, 0])
    if not relative < inf:
        return  # a profile underflows, so that its error has no bound
    yield known
    returned = (1.0 + relative - profile.min()) * (1.0 + relative - gain.min())
    if rows * conductance.size > LARGEST or returned >= 1.0:
        return
    along_row = _impedance(row)  # (N, M, M)
    along_column = _impedance(column)[:, ::-1, ::-1]  # (M, N, N), places reversed so that they count from row 0
    back = conductance * gain
    reaching = (back * (1.0 + relative - profile)).sum(axis=0) * (1.0 + relative) * SLACK
    # The impedance of a ladder has the errors of two profiles and of 4 operations per place in each direction. The
    # matrix product adds a sum over the places. A term has two of these products.
    step = 4.0 * relative + ULP * (17.0 * (rows + columns) + 30.0)
    transfer, rounded = known.transfer, relative * known.transfer
    # Lift of column j at row a in step i, as (j, a, i). The first lift is due to the current of cell (i, j) alone.
    lift = along_column * (conductance * profile).T[:, None, :]
    while True:
        current = conductance[:, None, :] * lift.transpose(1, 2, 0)  # (a, i, j) A into row a at column j, step i
        lifted = current @ along_row
        term = np.einsum("aj,aij->ij", back, lifted)
        relative = relative + step
        returning = np.ascontiguousarray((conductance[:, None, :] * lifted).transpose(2, 0, 1))
        lift = along_column @ returning
        rounded = rounded + relative * term + ULP * transfer
        transfer = transfer + term
        yield Attenuated(
            transfer=transfer,
            # Columns at no more than W volts lift a row by at most W (1 - p). The row in turn lifts a column by at most
            # (1 - h) times as much. Each further term therefore shrinks by the factor ``returned``.
            row=lift.max(axis=(0, 1)) * (SLACK * geometric_sum(returned)),
            column=reaching,
            rounded=np.divide(rounded, transfer, out=np.zeros_like(transfer), where=transfer > 0.0),
        )


def _impedance(ladders: Ladders) -> FloatArray:
    """Impedance matrices (lines, places, places) of ladders: volts at each place for 1 A into each place, in ohm."""
    series, shunt, profile = ladders.series, ladders.shunt, ladders.profile
    own = np.empty_like(series)
    before = np.zeros(series.shape[1:])
    for place in range(len(series)):  # Thevenin resistance towards the grounded end
        before = series[place] + before
        own[place] = before / (1.0 + before * ladders.admittance[place])
        before = before / (1.0 + before * shunt[place])
    # Behind the place of injection the volts fall in proportion to the profile.
    at = (own / profile).T
    near = np.tril(np.broadcast_to(at[:, None, :], (*at.shape, at.shape[1])))
    lower = near * profile.T[:, :, None]
    return lower + np.swapaxes(np.tril(lower, -1), -1, -2)
