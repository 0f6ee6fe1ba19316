"""Further terms of the series in :mod:`._attenuation`: what lies between line attenuation and the exact answer.

The k-th term follows current that leaves its line and comes back k times. It needs the lift of every crosspoint in
every step, N x N M numbers, and two products with the ladders' impedances, so it costs O(N^2 M^2) in matrix products.
That is more than the exact method takes, but its rounding errors are certified to be smaller, since few operations lie
between the cells and a reading.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import inf

import numpy as np

from ...arrays import FloatArray
from ._attenuation import SLACK, Attenuated, Wires, by_ladders, endlessly
from ._elimination import ULP
from ._ladders import Ladders

LARGEST = 1 << 22  # rows times crosspoints that are worth their memory


def terms(conductance: FloatArray, wires: Wires | None) -> Iterator[Attenuated]:
    """Transfer conductances of one frame (N, M) in S with 1, 2, 3, ... terms, each with its certificate; nothing where
    ladders cannot express the grid (shorted cells, broken lines).
    """
    if wires is None or not np.isfinite(conductance).all():
        return
    rows, columns = conductance.shape
    row, column = wires.ladders(conductance[None])
    known = Attenuated(*(part[0] for part in by_ladders(conductance[None], wires, ladders=(row, column))))
    profile, gain = row.profile.T, column.profile[::-1]
    relative = float(known.rounded[0, 0])
    if not relative < inf:
        return  # nothing is left of the drive somewhere: ladders say no more about these lines
    yield known
    returned = (1.0 + relative - profile.min()) * (1.0 + relative - gain.min())
    if rows * conductance.size > LARGEST or returned >= 1.0:
        return
    along_row = _impedance(row)  # (N, M, M)
    along_column = _impedance(column)[:, ::-1, ::-1]  # (M, N, N), now from row 0 on
    back = conductance * gain
    reaching = (back * (1.0 + relative - profile)).sum(axis=0) * (1.0 + relative) * SLACK
    # A ladder's impedance carries the errors of two profiles, of 4 operations per place in each direction, and of the
    # sum over the places in the matrix product; twice that is a whole term.
    step = 4.0 * relative + ULP * (17.0 * (rows + columns) + 30.0)
    transfer, rounded = known.transfer, relative * known.transfer
    # Lift of column j at row a in step i, as (j, a, i): at first by the current of cell (i, j) alone.
    lift = along_column * (conductance * profile).T[:, None, :]
    while True:
        current = conductance[:, None, :] * lift.transpose(1, 2, 0)  # into row a at column j in step i, (a, i, j)
        lifted = current @ along_row
        term = np.einsum("aj,aij->ij", back, lifted)
        relative = relative + step
        returning = np.ascontiguousarray((conductance[:, None, :] * lifted).transpose(2, 0, 1))
        lift = along_column @ returning
        rounded = rounded + relative * term + ULP * transfer
        transfer = transfer + term
        yield Attenuated(
            transfer=transfer,
            # Crossing lines that stand at W volts at most lift a row by no more than W (1 - p), and it a column by no
            # more than that times (1 - h).
            row=lift.max(axis=(0, 1)) * (SLACK * endlessly(returned)),
            column=reaching,
            rounded=np.divide(rounded, transfer, out=np.zeros_like(transfer), where=transfer > 0.0),
        )


def _impedance(ladders: Ladders) -> FloatArray:
    """Volts at each place for 1 A into each other one, (lines, places, places)."""
    series, shunt, profile = ladders.series, ladders.shunt, ladders.profile
    own = np.empty_like(series)
    before = np.zeros(series.shape[1:])
    for place in range(len(series)):  # resistance back to the grounded end
        before = series[place] + before
        own[place] = before / (1.0 + before * ladders.admittance[place])
        before = before / (1.0 + before * shunt[place])
    # Away from the end, volts fall as the profile does.
    at = (own / profile).T
    near = np.tril(np.broadcast_to(at[:, None, :], (*at.shape, at.shape[1])))
    lower = near * profile.T[:, :, None]
    return lower + np.swapaxes(np.tril(lower, -1), -1, -2)
