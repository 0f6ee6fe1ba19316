"""Line attenuation: the zeroth term of a Neumann series for the transfer conductances, with a certified error bound.

**The approximation.** We compute the current from row i into column j as if all other lines were at ground. Along the
row, the fraction p_i(j) of the drive voltage reaches the cell. Along the column, the fraction h_j(i) of the cell's
current reaches the amplifier. Hence

    T0 = h G p        (elementwise, N x M).

All readings together cost O(N M) operations and two matrix products.

**Profiles.** We call p and h the *profiles* of the lines. Let K_jk be the resistance of the wire that places j and k of
a line share on the way to the line's driver or amplifier. Then p = 1 - K G p. To first order the loss 1 - p is
D = K G 1. The ratio (K G D)_j / D_j is the mean of D with the weights K_jk G_k. Since D grows along the line, and the
weights move outwards with j, the ratio grows along the line as well. The ratio is at least a = sum(G D) / sum(G), and
at most b, its value at the far end. Substitution into 1 - p = D - K G (1 - p) gives limits that hold to all orders:

    (1 - b) / (1 - a b) D  <=  1 - p  <=  (1 - a) / (1 - a b) D.

The limits are close together, since b - a is about a sixth of the largest D. :func:`closed_form` takes a value near
the middle. Where the limits are too far apart because lines are heavy, and where lines differ much from each other, the
profiles come from the continued fractions of :mod:`._ladders`.

**The error.** The approximation leaves out the current that leaves a line, lifts a crossing line and comes back. Let Ur
and Uc be the nodal matrices of the row lines and the column lines. The exact answer is the Neumann series

    T = h' G (1 + P + P^2 + ...) p,      P = Ur^-1 G Uc^-1 G.

G^1/2 P G^-1/2 is the product of two symmetric matrices: R = G^1/2 Ur^-1 G^1/2 of the rows, and C, defined in the same
way from Uc, of the columns. The eigenvalues of both lie in [0, 1). All terms are nonnegative, and the Cauchy-Schwarz
inequality bounds the sum of all terms after the zeroth:

    0 <= T_ij - T0_ij <= |C G^1/2 p_i| |R G^1/2 h_j| / (1 - |R| |C|).

Each of the two vectors is zero outside one line. Therefore their norms follow from
(Ur^-1 G Ur^-1)_jj <= (Ur^-1)_jj (1 - p_j), where (Ur^-1)_jj is at most the resistance of the wire to the end of the
line. By the Collatz-Wielandt bound no eigenvalue of K G exceeds b, so that |R| <= b / (1 + b).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...common.arrays import FloatArray, SingleArray
from ._elimination import ULP
from ._ladders import Ladders, profile_rounding
from ._ports import Lines

_SINGLE_ULP = float(np.finfo(np.float32).eps) / 2.0
_TINY = np.finfo(np.float32).tiny
# S; with cells up to this, products that underflow in single precision are below _TINY, hence negligible
LARGEST_IN_SINGLE = 1e6
# ohm; with lines up to this, conductances that underflow (1e-45 S) change a loss over n places by at most n 1e-36
_HEAVIEST_LINE = 1e9
# |R| |C| for b = 1/4; above, the error of the closed form would be significant next to the truncated terms
CLOSED_FORM_LIMIT = 0.04
SLACK = 1.0 + 1e-6  # covers the rounding errors of the bounds themselves


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
    if wires is None or not (largest := conductance.max()) < np.inf:
        return None
    if wires.uniform is None or largest > LARGEST_IN_SINGLE:
        *frames, rows, columns = conductance.shape
        parts = by_ladders(conductance.reshape(-1, rows, columns), wires)
        known = Attenuated(*(part.reshape((*frames, *part.shape[1:])) for part in parts))
    else:
        known, returned = closed_form(conductance, wires.uniform)
        light = returned <= CLOSED_FORM_LIMIT
        if light.all():
            return known
        better = by_ladders(conductance[~light], wires, returned=returned[~light])
        for part, instead in zip(known, better, strict=True):
            part[~light] = instead
    return known if np.isfinite(known.rounded).all() else None


class UniformWires(NamedTuple):
    """Resistances of uniform lines, for the closed form of the profiles.

    Either all rows have the same wire, and so have all columns; or each line has a lead of its own and equal segments
    of its own. In the first case ``own`` is None and the matrices hold the resistances themselves. In the second case
    they hold resistances for segments of 1 ohm without a lead.

    Single precision is enough, since the closed form of the losses is less accurate than that.
    """

    row: SingleArray
    """(M, M) ohm: the matrix K of the rows"""
    column: SingleArray
    """(N, N) ohm: the matrix K of the columns"""
    to_driver: SingleArray
    """(M,) ohm from each place to the driven end of a row, or to the first place if leads are in ``own``"""
    to_amplifier: SingleArray
    """(N,) ohm from each place to the amplifier's end of a column, or to the last place if leads are in ``own``"""
    own: SingleArray | None
    """(2, N + M) ohm: lead and segment of each row, then of each column; None where K contains them"""
    reach: SingleArray
    """(N + M,) ohm: largest resistance from each row to the columns' ends, and from each column to the rows' ends"""
    ones: SingleArray
    """(max(N, M),) ones, to sum by matrix products"""

    @classmethod
    def of(
        cls, row: FloatArray, column: FloatArray, to_driver: FloatArray, to_amplifier: FloatArray
    ) -> UniformWires | None:
        """Build from the arrays of :class:`Wires`; None where lines are not uniform or too heavy."""
        rows, columns = row.shape
        reach = np.concatenate([to_amplifier.max(axis=1), to_driver.max(axis=0)])
        own = None
        if not reach.max() <= _HEAVIEST_LINE:
            return None
        if (row == row[0]).all() and (column == column[:, :1]).all():
            ahead, behind = to_driver[0], to_amplifier[:, 0]
        elif (
            (row[:, 1:] == row[:, 1:2]).all()
            and (column[:-1] == column[:1]).all()
            and (reach <= 4.0 * np.concatenate([to_amplifier.min(axis=1), to_driver.min(axis=0)])).all()
        ):
            ahead, behind = np.arange(float(columns)), np.arange(float(rows))[::-1]
            own = np.stack([np.concatenate([row[:, 0], column[-1]]), np.concatenate([row[:, -1], column[0]])])
        else:
            return None
        along, down = ahead.astype(np.float32), behind.astype(np.float32)
        return cls(
            row=np.minimum.outer(along, along),
            column=np.minimum.outer(down, down),
            to_driver=along,
            to_amplifier=down,
            own=None if own is None else own.astype(np.float32),
            reach=reach.astype(np.float32),
            ones=np.ones(max(rows, columns), dtype=np.float32),
        )


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
    uniform: UniformWires | None
    """for the closed form; None where the lines are not uniform enough"""

    @classmethod
    def of(cls, lines: Lines) -> Wires | None:
        """Resistances of ``lines``, which must have exits; None where a line is broken."""
        assert lines.exit is not None
        behind = np.concatenate([lines.column[1:], lines.exit[None]])
        if not (lines.row.all() and behind.all()):
            return None
        row, column = 1.0 / lines.row, 1.0 / behind
        to_driver, to_amplifier = np.cumsum(row, axis=1), np.cumsum(column[::-1], axis=0)[::-1]
        return cls(row, column, to_driver, to_amplifier, UniformWires.of(row, column, to_driver, to_amplifier))

    def ladders(self, cells: FloatArray) -> tuple[Ladders, Ladders]:
        """Ladders of all rows and of all columns for (frames, N, M) cells in S, the lines counted frame by frame."""
        frames, rows, columns = cells.shape
        along_row = np.ascontiguousarray(cells.transpose(2, 0, 1).reshape(columns, -1))
        along_column = np.ascontiguousarray(cells[:, ::-1].transpose(1, 0, 2).reshape(rows, -1))
        ohms = np.tile(self.row.T, (1, frames)), np.tile(self.column[::-1], (1, frames))
        return Ladders.solve(ohms[0], along_row), Ladders.solve(ohms[1], along_column)


@np.errstate(all="ignore")  # heavy lines overflow; the caller discards them
def closed_form(cells: FloatArray, wires: UniformWires) -> tuple[Attenuated, FloatArray]:
    """Line attenuation with the profiles in closed form.

    Returns:
        The result, and a bound (...,) on |R| |C|. The result is good enough where this bound is at most
        :data:`CLOSED_FORM_LIMIT`; elsewhere, and where the bound is NaN, the result must not be used.

    """
    *frames, rows, columns = cells.shape
    sums = np.empty((4, *frames, rows + columns), np.float32)  # rows and columns together: call overhead dominates
    # Per line: K G D at the far end, sum(G D), D at the far end, and sum(G). Then b = far / end and a = near / total.
    far, near, end, total = sums
    rough = cells.astype(np.float32)
    row, column = rough @ wires.row, wires.column @ rough  # D
    along, across = wires.ones[:columns], wires.ones[:rows]
    np.matmul(rough, along, out=total[..., :rows])
    np.matmul(across, rough, out=total[..., rows:])
    if wires.own is not None:
        lead, segment = wires.own
        row *= segment[:rows, None]
        row += (lead * total)[..., :rows, None]
        column *= segment[rows:]
        column += (lead * total)[..., None, rows:]
    lost = rough * row
    np.matmul(lost, wires.to_driver, out=far[..., :rows])
    np.matmul(lost, along, out=near[..., :rows])
    np.multiply(rough, column, out=lost)
    np.matmul(wires.to_amplifier, lost, out=far[..., rows:])
    np.matmul(across, lost, out=near[..., rows:])
    end[..., :rows], end[..., rows:] = row[..., -1], column[..., 0, :]
    if wires.own is not None:
        far *= segment
        far += lead * near
    sums[2:] += _TINY
    sums[:2] /= sums[2:]  # from here on, far is b and near is a
    middle = 2.0 / (2.0 + far + near)  # within 0.56 (b - a) of both limits while b < 1/4
    np.subtract(far, near, out=near)
    np.multiply(near, end, out=total)
    steepest, width, largest_loss, off = np.maximum.reduce(sums, axis=-1).astype(np.float64)
    # Rounding for n places: D is off by (n + 4) ulp, a and b by (4 n + 12) ulp; half of the latter passes to 1 - p.
    ulp = _SINGLE_ULP * (4.0 * max(rows, columns) + 24.0)
    off = (0.6 * off + ulp * largest_loss) / (1.0 - largest_loss)
    relative = off * (2.0 + off) + 8.0 * ULP
    returned = (steepest * (1.0 + ulp) / (1.0 + steepest)) ** 2
    row *= middle[..., :rows, None]  # 1 - p
    column *= middle[..., None, rows:]  # 1 - h
    np.multiply(rough, row, out=lost)
    np.subtract(rough, lost, out=row)  # G p
    column *= row
    squares = sums[0]
    np.einsum("...ij,...ij->...i", row, column, out=squares[..., :rows])
    np.subtract(row, column, out=row)  # G h p
    # The bound needs (G h)^2 (1 - p). Since h <= 1 and p >= 1 - largest_loss, this is at most
    # G (1 - p) G h p / (1 - largest_loss).
    np.einsum("...ij,...ij->...j", lost, row, out=squares[..., rows:])
    lost += column
    squares += _TINY * max(rows, columns)  # covers terms that underflow in single precision
    norms = np.multiply(squares, wires.reach, dtype=np.float64)
    np.sqrt(norms, out=norms)
    certain = (
        (1.0 + relative) ** 2 * (1.0 + ulp) * (1.0 + width) * (1.0 - largest_loss) ** -0.5 * geometric_sum(returned)
    )
    norms[..., :rows] *= np.asarray(certain)[..., None]
    return (
        Attenuated(cells - lost, norms[..., :rows], norms[..., rows:], np.asarray(relative)[..., None, None]),
        np.asarray(returned),
    )


@np.errstate(all="ignore")  # divisions by zero occur where a profile underflows
def by_ladders(cells: FloatArray, wires: Wires, *, returned: FloatArray | None = None) -> Attenuated:
    """Line attenuation with the profiles of ladders, exact up to rounding for lines of any resistance.

    Args:
        cells: (frames, N, M) S.
        wires: of the grid.
        returned: (frames,) known bounds on |R| |C|; the ladders may give sharper ones.

    Returns:
        The result, with an infinite ``rounded`` for frames in which the drive underflows before the end of a line.

    """
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
    seen: FloatArray = (1.0 + relative - lowest) * (1.0 + relative - least)
    returned = seen if returned is None else np.fmin(seen, returned)
    certain = SLACK * (1.0 + relative) ** 2 * geometric_sum(returned)
    return Attenuated(transfer, certain[:, None] * np.sqrt(row_square), np.sqrt(column_square), upper_factor - 1.0)


def _split_frames(part: FloatArray, frames: int) -> FloatArray:
    """Reshape (places, frames * lines) to (places, frames, lines)."""
    return part.reshape(len(part), frames, -1)


def geometric_sum(returned: FloatArray) -> FloatArray:
    """Sum 1 + q + q^2 + ... for the ratio q = ``returned``; 1e60, a bound without use, for q >= 1."""
    return 1.0 / np.maximum(1.0 - returned, 1e-60)
