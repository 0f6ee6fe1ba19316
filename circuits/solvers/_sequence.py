"""Transfer conductances of a sequence of frames: deferred correction of line attenuation, with a certificate.

Line attenuation (:mod:`._attenuation`) leaves out the current that leaves a line, lifts a crossing line and comes back.
Let T(G) be the exact transfer conductances and A(G) those by attenuation. The part left out is E(G) = T(G) - A(G). From
one frame to the next E changes far less than T, since E depends on sums over whole lines. A sequence is therefore
solved exactly at a few frames only, the *knots*. Between two knots E is interpolated linearly in time, and A(G) + E is
the result.

The intervals between knots are halved until the error of the interpolation is certified. Let G~(t) be the straight line
between the conductances at two knots. Two errors add up:

**Curvature of E along the straight line.** Write G~ = (G_a + G_b)/2 + s (G_b - G_a)/2, with s from -1 to 1. E is
analytic in s. In the disc abs(s) <= R all conductances stay below H = G_high + R abs(G_b - G_a)/2 in magnitude. If the
Neumann series of all lines converge for H, the series with H in place of G bounds E in the disc. Let M be this bound.
Cauchy's integral for the divided difference of E at -1, s and 1 then gives

    abs(error) <= M R / ((R - 1)^2 (R + 1))          for every such R; the smallest value of a few is taken.

**Distance from the straight line.** By Tellegen's theorem the derivative of T by one conductance G_km is a product of
two voltages across that cell. The derivative of E is this product minus the derivative of A. Let W_i bound the volts
of all columns in step i, and U_j the volts of all rows for 1 V at the end of column j. Let r and c be the largest loss
along a row and along a column. The magnitude of the derivative of E is then at most

    U_j (c + W_i) for the cells of row i,   W_i (r + U_j) for those of column j,   W_i U_j for all cells,

where a cell in both lines counts in both. All factors grow with G. The largest conductances of the sequence, G_high,
therefore bound them for every frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, Self

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ._attenuation import SLACK, Wires
from ._elimination import ULP
from ._ladders import Ladders, profile_rounding

Exact = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Function of conductances (frames, N, M) in S; returns exact transfer conductances in S and bounds on their errors"""

_RADII = np.geomspace(1.5, 3000.0, 24)
"""radii R of the discs that are tried"""


class SequenceTransfer(NamedTuple):
    """Transfer conductances of a sequence of frames."""

    transfer: FloatArray
    """(frames, N, M) S"""
    error: FloatArray
    """(frames,) S: bound on the error of any transfer conductance of the frame"""
    solved: BoolArray
    """(frames,) the knots: frames that were solved exactly"""


def sequence_transfer(conductance: FloatArray, wires: Wires, exact: Exact, allowed: float) -> SequenceTransfer:
    """Solve a sequence of frames exactly at as few of them as the error allows.

    Args:
        conductance: (frames, N, M) S, finite.
        wires: of the grid.
        exact: solves single frames.
        allowed: S, largest acceptable error of the transfer conductances between knots.

    """
    frames = len(conductance)
    changing = np.flatnonzero((conductance != conductance[0]).reshape(frames, -1).any(axis=0))
    if not len(changing):
        transfer, error = exact(conductance[:1])
        solved = np.zeros(frames, dtype=np.bool_)
        solved[0] = True
        return SequenceTransfer(np.repeat(transfer, frames, axis=0), np.repeat(error.max(), frames), solved)

    highest = conductance.max(axis=0)
    attenuated, relative = _attenuated(conductance, highest, changing, wires)
    scale = float(relative * attenuated.max())
    limits = _Limits.of(highest, wires, changing)
    knots, between = _knots(conductance.reshape(frames, -1)[:, changing], limits, allowed - 2.0 * scale)

    transfer, error = exact(conductance[knots])
    missing = transfer - attenuated[knots]
    result = attenuated
    off = np.zeros(frames)
    for number, (first, last) in enumerate(pairwise(knots)):
        inside = slice(first + 1, last)
        share = ((np.arange(first + 1, last) - first) / (last - first))[:, None, None]
        result[inside] += missing[number] + share * (missing[number + 1] - missing[number])
        off[inside] = between[number] + 2.0 * scale + error[number : number + 2].max()
    result[knots] = transfer
    off[knots] = error.max(axis=(1, 2))
    solved = np.zeros(frames, dtype=np.bool_)
    solved[knots] = True
    return SequenceTransfer(result, off, solved)


def _attenuated(
    conductance: FloatArray, highest: FloatArray, changing: IntArray, wires: Wires
) -> tuple[FloatArray, float]:
    """A(G) of all frames (frames, N, M), and its relative rounding error.

    The profile of a line changes only if one of its cells does. The lines without such a cell are solved once.
    """
    frames, rows, columns = conductance.shape
    row, column = (np.unique(part) for part in np.divmod(changing, columns))
    still_row, still_column = (part for part in wires.ladders(conductance[:1]))
    profile, gain = still_row.profile.T, still_column.profile[::-1]

    along = np.ascontiguousarray(conductance[:, row].transpose(2, 0, 1).reshape(columns, -1))
    moving_row = Ladders.solve(np.tile(wires.row[row].T, (1, frames)), along).profile
    across = np.ascontiguousarray(conductance[:, ::-1, column].transpose(1, 0, 2).reshape(rows, -1))
    moving_column = Ladders.solve(np.tile(wires.column[::-1, column], (1, frames)), across).profile

    result: FloatArray = conductance * profile
    result[:, row] = conductance[:, row] * moving_row.reshape(columns, frames, -1).transpose(1, 2, 0)
    into_columns = result[:, :, column] * moving_column.reshape(rows, frames, -1).transpose(1, 0, 2)[:, ::-1]
    result *= gain
    result[:, :, column] = into_columns
    lowest = np.array([min(profile.min(), moving_row.min()), min(gain.min(), moving_column.min())])
    relative = profile_rounding(columns, lowest[:1]) + profile_rounding(rows, lowest[1:]) + 8.0 * ULP
    return result, float(relative[0])


def _knots(values: FloatArray, limits: _Limits, allowed: float) -> tuple[IntArray, FloatArray]:
    """Frames to solve exactly, and the certified error in S between each knot and the next.

    Args:
        values: (frames, k) S of the cells that change.
        limits: of the grid and these cells.
        allowed: S.

    """
    frames = len(values)
    starts, ends = np.array([0]), np.array([frames - 1])
    found: list[tuple[int, int, float]] = []
    while len(starts):
        errors = np.array([limits.error(values[a : b + 1]) for a, b in zip(starts, ends, strict=True)])
        good = (errors <= allowed) | (ends - starts <= 1)
        found += zip(starts[good].tolist(), ends[good].tolist(), errors[good].tolist(), strict=True)
        starts, ends = starts[~good], ends[~good]
        middle = (starts + ends) // 2
        starts, ends = np.concatenate([starts, middle]), np.concatenate([middle, ends])
    found.sort()
    knots = np.array([0] + [last for _, last, _ in found if last > 0], dtype=np.intp)
    return knots, np.array([error for *_, error in found])


@dataclass(frozen=True)
class _Limits:
    """Bounds on E and its derivatives for one grid, for conductances up to G_high."""

    rows: FloatArray
    """(k, N) 1 where a changing cell lies in a row"""
    columns: FloatArray
    """(k, M)"""
    changing: IntArray
    """(k,) indices of the changing cells in the flattened array"""
    to_driver: FloatArray
    """(k,) ohm from each changing cell along its row to the driver"""
    to_amplifier: FloatArray
    """(k,) ohm"""
    row_losses: FloatArray
    """(N, M) products G R for G = G_high, with R the resistance to the driver"""
    column_losses: FloatArray
    """(N, M) the same with R the resistance to the amplifier"""
    row_loss: float
    """largest sum_m R G of any row, with R the resistance to the driver: bounds the norm of K G of a row"""
    column_loss: float
    pair_loss: float
    """largest product of a row of ``row_losses`` and one of ``column_losses``: see :meth:`_curvature`"""
    column_sum: float
    lift: float
    """largest G R of any cell, with R the resistance to the amplifier: bounds the volts that a column is lifted by"""
    back_lift: float
    """the same for the rows, lifted from the columns' ends"""
    row_drop: float
    """r: largest loss along a row, as a fraction"""
    column_drop: float
    """c"""

    @classmethod
    def of(cls, highest: FloatArray, wires: Wires, changing: IntArray) -> Self:
        """``highest`` is G_high (N, M) in S; ``changing`` are indices into it, flattened."""
        n_rows, n_columns = highest.shape
        row, column = wires.ladders(highest[None])
        row_of, column_of = np.divmod(changing, n_columns)
        row_losses, column_losses = wires.to_driver * highest, wires.to_amplifier * highest
        return cls(
            changing=changing,
            row_losses=row_losses,
            column_losses=column_losses,
            pair_loss=float((row_losses @ column_losses.T).max()),
            rows=np.eye(n_rows)[row_of],
            columns=np.eye(n_columns)[column_of],
            to_driver=wires.to_driver.flat[changing],
            to_amplifier=wires.to_amplifier.flat[changing],
            row_loss=float(row_losses.sum(axis=1).max()),
            column_loss=float(column_losses.sum(axis=0).max()),
            column_sum=float(highest.sum(axis=0).max()),
            lift=float(column_losses.max()),
            back_lift=float(row_losses.max()),
            row_drop=float(1.0 - row.profile.min()),
            column_drop=float(1.0 - column.profile.min()),
        )

    def error(self, values: FloatArray) -> float:
        """Bound in S on the error of E by linear interpolation from the first to the last of ``values`` (frames, k)."""
        if len(values) <= 2:
            return 0.0
        share = np.linspace(0.0, 1.0, len(values))[1:-1, None]
        straight = values[0] + share * (values[-1] - values[0])
        apart = np.abs(values[1:-1] - straight)
        return SLACK * (self._curvature(0.5 * np.abs(values[-1] - values[0])) + self._distance(apart))

    def _distance(self, apart: FloatArray) -> float:
        """Bound in S on the change of E by conductances that are ``apart`` (frames, k) S from the straight line."""
        returned = 1.0 - self.row_drop * self.column_drop
        if returned <= 0.0:
            return np.inf
        lift, back = self.lift / returned, self.back_lift / returned  # W and U
        of_row, of_column = (apart @ self.rows).max(), (apart @ self.columns).max()
        in_all = apart.sum(axis=1).max()
        return float(
            back * (self.column_drop + lift) * of_row + lift * (self.row_drop + back) * of_column + lift * back * in_all
        )

    def _curvature(self, half: FloatArray) -> float:
        """Bound in S by the curvature of E, for conductances that move by ``half`` (k,) S to both sides of the middle.

        With H = G_high + R ``half`` the leading term of E is at most sum_k H_kj sum_m (H_km R_km) (H_im R'_im), where R
        and R' are the resistances to driver and amplifier. The inner sum is a product of a row of one matrix and a row
        of another, which is bounded power by power of the radius. All further terms are a geometric series.
        """
        row_half, column_half = np.zeros_like(self.row_losses), np.zeros_like(self.column_losses)
        row_half.flat[self.changing] = half * self.to_driver
        column_half.flat[self.changing] = half * self.to_amplifier
        once = (row_half @ self.column_losses.T + self.row_losses @ column_half.T).max()
        twice = (row_half @ column_half.T).max()
        pair_loss = self.pair_loss + _RADII * once + _RADII**2 * twice

        row_loss = self.row_loss + _RADII * row_half.sum(axis=1).max()
        column_loss = self.column_loss + _RADII * column_half.sum(axis=0).max()
        column_sum = self.column_sum + _RADII * (half @ self.columns).max()
        inside = (row_loss < 1.0) & (column_loss < 1.0)
        row_kept, column_kept = np.where(inside, 1.0 - row_loss, 1.0), np.where(inside, 1.0 - column_loss, 1.0)
        returned = row_loss * column_loss / (row_kept * column_kept)
        inside &= returned < 1.0
        endless = 1.0 / np.where(inside, 1.0 - returned, 1.0)
        bound = column_sum * pair_loss / (row_kept * column_kept) ** 2 * endless
        error = bound * _RADII / ((_RADII - 1.0) ** 2 * (_RADII + 1.0))
        return float(np.min(error, where=inside, initial=np.inf))
