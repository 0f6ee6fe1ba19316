"""Line attenuation: the zeroth term of a Neumann series for the transfer conductances, with a certified error bound.

**The approximation.** We compute the current from row i into column j as if all other lines were at ground. Along the
row, the fraction p_i(j) of the drive voltage reaches the cell. Along the column, the fraction h_j(i) of the cell's
current reaches the amplifier. Hence

    T0 = h G p        (elementwise, N x M).

All readings together cost O(N M) operations and two matrix products.

**Profiles.** We call p and h the *profiles* of the lines. A line is a ladder: wire resistance in series, cells as
shunts to ground. Its admittance is the continued fraction (Cauer form) Y_k = g_k + 1 / (r_k+1 + 1 / Y_k+1), evaluated
from the far end. All terms are nonnegative, so no digits cancel.

**The error.** The approximation leaves out the current that leaves a line, lifts a crossing line and comes back. Let Ur
and Uc be the nodal matrices of the row lines and the column lines. The exact answer is the Neumann series

    T = h' G (1 + P + P^2 + ...) p,      P = Ur^-1 G Uc^-1 G.

G^1/2 P G^-1/2 is the product of two symmetric matrices: R = G^1/2 Ur^-1 G^1/2 of the rows, and C, defined in the same
way from Uc, of the columns. The eigenvalues of both lie in [0, 1). All terms are nonnegative, and the Cauchy-Schwarz
inequality bounds the sum of all terms after the zeroth:

    0 <= T_ij - T0_ij <= |C G^1/2 p_i| |R G^1/2 h_j| / (1 - |R| |C|).

Each of the two vectors is zero outside one line. Therefore their norms follow from
(Ur^-1 G Ur^-1)_jj <= (Ur^-1)_jj (1 - p_j), where (Ur^-1)_jj is at most the resistance of the wire to the end of the
line. By the Collatz-Wielandt bound with the positive vector 1, |R| is at most the largest entry of Ur^-1 G 1, the
loss 1 - p at the end of a line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...common.arrays import FloatArray
from ._elimination import ULP
from ._ports import Lines


class Ladders(NamedTuple):
    """Many ladders of equal length, solved together.

    Places count from the driven end of a row, or from the amplifier's end of a column. Arrays are (places, lines), so
    that one step along all lines is one contiguous slice.
    """

    admittance: FloatArray
    """S to ground of the cell at each place and of everything behind it"""
    profile: FloatArray
    """volts at each place for 1 V at the end where counting starts"""

    @classmethod
    def solve(cls, series: FloatArray, shunt: FloatArray) -> Ladders:
        """Solve ladders.

        Args:
            series: (places, lines) ohm of the wire between each place and the place before it.
            shunt: (places, lines) S of the cell at each place, from the line to ground.

        """
        admittance, drop = np.empty_like(shunt), np.empty_like(shunt)
        rest = np.zeros(shunt.shape[1:])
        for place in reversed(range(len(shunt))):
            np.add(rest, shunt[place], out=admittance[place])
            drop[place] = 1.0 / (1.0 + series[place] * admittance[place])
            rest = admittance[place] * drop[place]
        return cls(admittance, np.multiply.accumulate(drop, axis=0, out=drop))


def profile_rounding(places: int, smallest: FloatArray) -> FloatArray:
    """Bound on the relative rounding error of the profiles of ladders.

    Each step back along a ladder adds 4 ulp to the relative error of the admittance Y, hence at most 4 n ulp over n
    places. A step of the profile multiplies by 1 / (1 + r Y). This step adds 3 ulp of its own. It also passes on the
    fraction r Y / (1 + r Y) of the error of Y. Summed over the steps these fractions are at most -ln(smallest).

    Args:
        places: number of places along each ladder.
        smallest: (...,) lowest value of the profiles.

    """
    with np.errstate(divide="ignore"):
        lost: FloatArray = ULP * places * (4.0 - 5.0 * np.log(smallest))
    return lost


class Attenuated(NamedTuple):
    """Approximate transfer conductances and their certificate.

    The truncation error is at most ``row[..., :, None] * column[..., None, :]``. Rounding and the error of the profiles
    add at most ``rounded * transfer``.
    """

    transfer: FloatArray
    """(..., N, M) S"""
    row: FloatArray
    """(..., N): factor of each row in sqrt(S), or the highest lift of the crossing lines in each scan step, in V"""
    column: FloatArray
    """(..., M): factor of each column in sqrt(S), or the current into each column for 1 V of lift, in A"""
    rounded: FloatArray
    """error of the profiles and of rounding, relative to ``transfer``; the two arrays broadcast"""

    @property
    def error(self) -> FloatArray:
        """Bound (..., N, M) in S on the error of the transfer conductances."""
        bound: FloatArray = self.row[..., :, None] * self.column[..., None, :]
        bound += self.rounded * self.transfer
        return bound


def attenuate(conductance: FloatArray, wires: Wires | None) -> Attenuated | None:
    """Line attenuation of frames: the zeroth term of the Neumann series and its certificate.

    Args:
        conductance: (..., N, M) S of the cells.
        wires: of the grid; None if a line is broken.

    Returns:
        None for shorted cells and broken lines, which profiles cannot express. None also where the drive underflows
        before the end of a line.

    """
    if wires is None or not conductance.max() < np.inf:
        return None
    *frames, rows, columns = conductance.shape
    parts = _by_ladders(conductance.reshape(-1, rows, columns), wires)
    known = Attenuated(*(part.reshape((*frames, *part.shape[1:])) for part in parts))
    return known if np.isfinite(known.rounded).all() else None


@dataclass(frozen=True)
class Wires:
    """Wire resistances of a grid without broken lines."""

    row: FloatArray
    """(N, M) ohm of the wire ahead of each crosspoint, towards the row's driver"""
    column: FloatArray
    """(N, M) ohm of the wire behind each crosspoint, towards the column's amplifier"""
    to_driver: FloatArray
    """(N, M) ohm from each crosspoint to the row's driver"""
    to_amplifier: FloatArray
    """(N, M) ohm from each crosspoint to the column's amplifier"""

    @classmethod
    def of(cls, lines: Lines) -> Wires | None:
        """Resistances of ``lines``, which must have exits; None where a line is broken."""
        assert lines.exit is not None
        behind = np.concatenate([lines.column[1:], lines.exit[None]])
        if not (lines.row.all() and behind.all()):
            return None
        row, column = 1.0 / lines.row, 1.0 / behind
        return cls(row, column, np.cumsum(row, axis=1), np.cumsum(column[::-1], axis=0)[::-1])

    def ladders(self, cells: FloatArray) -> tuple[Ladders, Ladders]:
        """Ladders of all rows and of all columns for (frames, N, M) cells in S, the lines counted frame by frame."""
        frames, rows, columns = cells.shape
        along_row = np.ascontiguousarray(cells.transpose(2, 0, 1).reshape(columns, -1))
        along_column = np.ascontiguousarray(cells[:, ::-1].transpose(1, 0, 2).reshape(rows, -1))
        ohms = np.tile(self.row.T, (1, frames)), np.tile(self.column[::-1], (1, frames))
        return Ladders.solve(ohms[0], along_row), Ladders.solve(ohms[1], along_column)


@np.errstate(all="ignore")  # divisions by zero occur where a profile underflows
def _by_ladders(cells: FloatArray, wires: Wires) -> Attenuated:
    """Line attenuation of frames (frames, N, M) in S, with an infinite ``rounded`` where the drive underflows."""
    frames, rows, columns = cells.shape
    row, column = wires.ladders(cells)
    profile, beyond = (_split_frames(part, frames).transpose(1, 2, 0) for part in (row.profile, row.admittance))
    gain, above = (_split_frames(part, frames).swapaxes(0, 1)[:, ::-1] for part in (column.profile, column.admittance))
    lowest, least = profile.min(axis=(1, 2)), gain.min(axis=(1, 2))
    relative = profile_rounding(columns, lowest) + profile_rounding(rows, least) + 4.0 * ULP
    into, out = cells * profile, cells * gain
    transfer = into * gain
    upper_factor = 1.0 + relative[:, None, None]
    reach = wires.to_amplifier / (1.0 + wires.to_amplifier * above)  # an upper bound on (Uc^-1)_jj
    row_square = np.einsum("...ij,...ij,...ij->...i", into, into * upper_factor - transfer, reach)
    reach = wires.to_driver / (1.0 + wires.to_driver * beyond)
    column_square = np.einsum("...ij,...ij,...ij->...j", out, out * upper_factor - transfer, reach)
    returned = (1.0 + relative - lowest) * (1.0 + relative - least)
    # The square root of an ulp covers the rounding errors of the bounds themselves.
    certain = (1.0 + ULP**0.5) * (1.0 + relative) ** 2 / np.maximum(1.0 - returned, 1e-60)
    return Attenuated(transfer, certain[:, None] * np.sqrt(row_square), np.sqrt(column_square), upper_factor - 1.0)


def _split_frames(part: FloatArray, frames: int) -> FloatArray:
    """Reshape (places, frames * lines) to (places, frames, lines)."""
    return part.reshape(len(part), frames, -1)
