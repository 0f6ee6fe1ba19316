"""Line attenuation: every reading in O(N M) and two matrix products, with a proof of how far it can be off.

Take the current from row i into column j as if all other lines stood at ground: along the row p_i(j) of the drive
reaches the cell, and along the column h_j(i) of the cell's current reaches the amplifier,

    T0 = h G p        (elementwise, N x M).

**Profiles.** With K_jk the resistance that places j and k of a line share on the way to its driver or amplifier,
p = 1 - K G p. The loss to first order, D = K G 1, nearly keeps its shape when K G is applied again: (K G D)_j / D_j is
the mean of D with weights K_jk G_k, which lie farther out the farther out j is, as D grows. So it grows along the line,
from no less than a = sum(G D) / sum(G) to b = (K G D) / D at the far end. Put into 1 - p = D - K G (1 - p) that gives

    (1 - b) / (1 - a b) D  <=  1 - p  <=  (1 - a) / (1 - a b) D,

to all orders and closely, since b - a is about a sixth of the largest D. About the middle is taken (:func:`_closed`).
Where lines are so heavy that this is too coarse, or differ much, :mod:`._ladders` solves them.

**What is left out** is current that leaves a line, lifts a crossing one and comes back. With Ur and Uc the nodal
matrices of the row and column lines, the exact answer is the series

    T = h' G (1 + P + P^2 + ...) p,      P = Ur^-1 G Uc^-1 G.

Between square roots of G, P is the product of two symmetric matrices, R = G^1/2 Ur^-1 G^1/2 of the rows and C of the
columns, with eigenvalues from 0 to below 1. Cauchy and Schwarz then bound what follows on the first term:

    0 <= T_ij - T0_ij <= |C G^1/2 p_i| |R G^1/2 h_j| / (1 - |R| |C|).

Each vector in it is confined to one line, and for such (Ur^-1 G Ur^-1)_jj <= (Ur^-1)_jj (1 - p_j), where (Ur^-1)_jj is
no more than the resistance of the wire to the line's end. The eigenvalues of K G are at most b (Collatz, Wielandt), so
|R| <= b / (1 + b). Further terms of the series (:mod:`._series`) bring the rest down as fast as the error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...arrays import FloatArray, SingleArray
from ._elimination import ULP
from ._ladders import Ladders, rounding
from ._ports import Lines

_COARSE = float(np.finfo(np.float32).eps) / 2.0
_TINY = np.finfo(np.float32).tiny
_SINGLE = (
    1e6  # S; what underflows in single precision beside cells up to this is less than _TINY, and as much as nothing
)
_HEAVY = 1e9  # ohm; over n places of lines up to this, what underflows (1e-45 S) moves no loss by more than n 1e-36
_LIGHT = 0.04  # |R| |C| for b = 1/4; above, the profiles' closed form would cost accuracy beside what is left out
SLACK = 1.0 + 1e-6  # for the rounding errors in the bounds themselves


class Attenuated(NamedTuple):
    """Transfer conductances (..., N, M), off by at most ``row[..., :, None] * column[..., None, :]`` and a little."""

    transfer: FloatArray
    """S"""
    row: FloatArray
    """(..., N): sqrt(S), or V that the crossing lines can be lifted by in each step"""
    column: FloatArray
    """(..., M): sqrt(S), or A into each column for 1 V of that lift"""
    rounded: FloatArray
    """further error relative to ``transfer``, that of the profiles and of rounding; broadcasts against it"""

    @property
    def error(self) -> FloatArray:
        """S (..., N, M) by which the transfer conductances can be off."""
        bound: FloatArray = self.row[..., :, None] * self.column[..., None, :]
        bound += self.rounded * self.transfer
        return bound


def attenuate(conductance: FloatArray, wires: Wires | None) -> Attenuated | None:
    """The zeroth term of the series and its certificate.

    Args:
        conductance: (..., N, M) S of the cells.
        wires: of the grid, if none is broken.

    Returns:
        None for shorted cells and broken lines, which profiles cannot express, and where nothing is left of the drive
        at the end of a line.

    """
    if wires is None or not (largest := conductance.max()) < np.inf:
        return None
    if wires.alike is None or largest > _SINGLE:
        *frames, rows, columns = conductance.shape
        parts = by_ladders(conductance.reshape(-1, rows, columns), wires)
        known = Attenuated(*(part.reshape((*frames, *part.shape[1:])) for part in parts))
    else:
        known, returned = _closed(conductance, wires.alike)
        light = returned <= _LIGHT
        if light.all():
            return known
        better = by_ladders(conductance[~light], wires, returned=returned[~light])
        for part, instead in zip(known, better, strict=True):
            part[~light] = instead
    return known if np.isfinite(known.rounded).all() else None


class Alike(NamedTuple):
    """Lines that all have one wire, or each a lead and equal segments of its own.

    The losses that follow from it need not be known to more digits than the closed form has, so it is kept in single
    precision.
    """

    row: SingleArray
    """(M, M) ohm: K of each row, or of segments of 1 ohm"""
    column: SingleArray
    """(N, N) ohm"""
    to_driver: SingleArray
    """(M,) ohm from each place to the row's end, or over segments of 1 ohm to the first place"""
    to_amplifier: SingleArray
    """(N,) ohm from each place to the column's end"""
    own: SingleArray | None
    """(2, N + M) ohm: lead and segment of each row and column; None where they are all in K"""
    reach: SingleArray
    """(N + M,) ohm: from each row to the columns' ends, and from each column to the rows' ends, at most"""
    ones: SingleArray
    """as many as there are places in the longer lines"""

    @classmethod
    def of(cls, row: FloatArray, column: FloatArray, to_driver: FloatArray, to_amplifier: FloatArray) -> Alike | None:
        """Of wires as in :class:`Wires`; None where lines differ too much, are too heavy, or a fault is in one."""
        rows, columns = row.shape
        reach = np.concatenate([to_amplifier.max(axis=1), to_driver.max(axis=0)])
        own = None
        if not reach.max() <= _HEAVY:
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
    """The wires of a grid in ohm, none of them broken."""

    row: FloatArray
    """(N, M) ahead of each crosspoint along its row"""
    column: FloatArray
    """(N, M) behind each crosspoint along its column"""
    to_driver: FloatArray
    """(N, M) from each crosspoint to the row's end"""
    to_amplifier: FloatArray
    """(N, M) from each crosspoint to the column's end"""
    alike: Alike | None
    """for the closed form; None where lines differ too much for it"""

    @classmethod
    def of(cls, lines: Lines) -> Wires | None:
        """None where a line is broken."""
        assert lines.exit is not None
        behind = np.concatenate([lines.column[1:], lines.exit[None]])
        if not (lines.row.all() and behind.all()):
            return None
        row, column = 1.0 / lines.row, 1.0 / behind
        to_driver, to_amplifier = np.cumsum(row, axis=1), np.cumsum(column[::-1], axis=0)[::-1]
        return cls(row, column, to_driver, to_amplifier, Alike.of(row, column, to_driver, to_amplifier))

    def ladders(self, cells: FloatArray) -> tuple[Ladders, Ladders]:
        """Of (frames, N, M) cells: rows and columns, lines counted frame by frame."""
        frames, rows, columns = cells.shape
        along_row = np.ascontiguousarray(cells.transpose(2, 0, 1).reshape(columns, -1))
        along_column = np.ascontiguousarray(cells[:, ::-1].transpose(1, 0, 2).reshape(rows, -1))
        ohms = np.tile(self.row.T, (1, frames)), np.tile(self.column[::-1], (1, frames))
        return Ladders.solve(ohms[0], along_row), Ladders.solve(ohms[1], along_column)


@np.errstate(all="ignore")  # where lines are too heavy for this
def _closed(cells: FloatArray, wires: Alike) -> tuple[Attenuated, FloatArray]:
    """By profiles in closed form; and |R| |C| (...,), which is not above _LIGHT where that is good enough."""
    *frames, rows, columns = cells.shape
    sums = np.empty((4, *frames, rows + columns), np.float32)  # all lines at once: it is the calls that cost
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
    sums[:2] /= sums[2:]  # b and a
    middle = 2.0 / (2.0 + far + near)  # no further than 0.56 (b - a) from both limits, while b is below a quarter
    np.subtract(far, near, out=near)
    np.multiply(near, end, out=total)
    steepest, width, most, off = np.maximum.reduce(sums, axis=-1).astype(np.float64)
    # Rounding, for n places: D is off by (n + 4) ulp, a and b by (4 n + 12), which moves 1 - p by half of that.
    ulp = _COARSE * (4.0 * max(rows, columns) + 24.0)
    off = (0.6 * off + ulp * most) / (1.0 - most)
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
    np.einsum("...ij,...ij->...j", lost, row, out=squares[..., rows:])  # for G h (1 - p) h: p is at least 1 - most
    lost += column
    squares += _TINY * max(rows, columns)  # for what is too small for single precision
    norms = np.multiply(squares, wires.reach, dtype=np.float64)
    np.sqrt(norms, out=norms)
    certain = (1.0 + relative) ** 2 * (1.0 + ulp) * (1.0 + width) * (1.0 - most) ** -0.5 * endlessly(returned)
    norms[..., :rows] *= np.asarray(certain)[..., None]
    return (
        Attenuated(cells - lost, norms[..., :rows], norms[..., rows:], np.asarray(relative)[..., None, None]),
        np.asarray(returned),
    )


@np.errstate(all="ignore")  # where nothing is left of the drive, and nothing can be said
def by_ladders(
    cells: FloatArray,
    wires: Wires,
    *,
    returned: FloatArray | None = None,
    ladders: tuple[Ladders, Ladders] | None = None,
) -> Attenuated:
    """By the ladders of (frames, N, M) cells: to rounding, however heavy the lines.

    Args:
        cells: S.
        wires: of the grid.
        returned: (frames,) |R| |C|, where more is known of it than the ladders tell.
        ladders: of the rows and of the columns, where they are there already.

    Returns:
        ``rounded`` is inf for frames in which nothing is left of the drive at the end of a line.

    """
    frames, rows, columns = cells.shape
    row, column = ladders or wires.ladders(cells)
    profile, beyond = (_framed(part, frames).transpose(1, 2, 0) for part in (row.profile, row.admittance))
    gain, above = (_framed(part, frames).swapaxes(0, 1)[:, ::-1] for part in (column.profile, column.admittance))
    lowest, least = profile.min(axis=(1, 2)), gain.min(axis=(1, 2))
    relative = rounding(columns, lowest) + rounding(rows, least) + 4.0 * ULP
    into, out = cells * profile, cells * gain
    transfer = into * gain
    most = 1.0 + relative[:, None, None]
    reach = wires.to_amplifier / (1.0 + wires.to_amplifier * above)  # at least (Uc^-1)_jj
    row_square = np.einsum("...ij,...ij,...ij->...i", into, into * most - transfer, reach)
    reach = wires.to_driver / (1.0 + wires.to_driver * beyond)
    column_square = np.einsum("...ij,...ij,...ij->...j", out, out * most - transfer, reach)
    seen: FloatArray = (1.0 + relative - lowest) * (1.0 + relative - least)
    returned = seen if returned is None else np.fmin(seen, returned)
    certain = SLACK * (1.0 + relative) ** 2 * endlessly(returned)
    return Attenuated(transfer, certain[:, None] * np.sqrt(row_square), np.sqrt(column_square), most - 1.0)


def _framed(part: FloatArray, frames: int) -> FloatArray:
    """From (places, lines), all frames' together, to (places, frames, lines)."""
    return part.reshape(len(part), frames, -1)


def endlessly(returned: FloatArray) -> FloatArray:
    """Sum of 1 + returned + returned^2 + ..."""
    return 1.0 / np.maximum(1.0 - returned, 1e-60)  # what has no end is no less than that, and bounds nothing
