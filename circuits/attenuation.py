"""Line attenuation: every reading in O(N M), with a proof of how far it can be off.

Take the current from row i into column j as if all other lines stood at ground: a ladder along the row brings
p_i(j) of the drive to the cell, and a ladder along the column brings h_j(i) of the cell's current to the amplifier,

    T0 = h G p        (elementwise, N x M).

What is left out is current that leaves a line, lifts a crossing one and comes back. With Ur and Uc the nodal matrices
of the row and column ladders, the exact answer is the series

    T = h' G (1 + P + P^2 + ...) p,      P = Ur^-1 G Uc^-1 G.

All factors are nonnegative (M-matrices), so each term of the series that is left out could only have added: T0 is
always low, and a bound on what follows is a bound on the error. It comes from two facts about ladders:

* crossing lines that stand at W volts at most lift row a by no more than W (1 - p_a), since all of them at 1 V and the
  source at ground is 1 V everywhere less the profile p_a; the same holds for columns with 1 - h_j;
* the current G p of a cell lifts its own column by no more than over the column's wire alone, G R / (1 + G R) p, R the
  resistance from the cell to the amplifier.

So with W_i the largest lift in step i, W_i <= max_j [G R / (1 + G R) p]_ij + kappa W_i, kappa = max(1 - p) max(1 - h),
and T - T0 <= W_i D_j with D_j = sum_a h_j(a) G_aj (1 - p_a(j)). Further terms of the series (:mod:`.series`) replace
the first summand by the lift that is still unaccounted for, by which the bound shrinks as fast as the error.

The ladders are solved by continued fractions in positive numbers, so rounding is bounded as well (:func:`rounding`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .ports import Lines

FloatArray = NDArray[np.float64]

_ULP = float(np.finfo(np.float64).eps) / 2.0
_SLACK = 1.0 + 1e-6  # for the rounding errors in the bounds themselves


@dataclass(frozen=True)
class Ladders:
    """Lines with the cells along them, in their order from the driven end (rows) or the amplifier (columns).

    Arrays are (places, lines): a step along all lines at once is then one contiguous slice.
    """

    series: FloatArray
    """ohm ahead of each place"""
    shunt: FloatArray
    """S to ground at each place"""
    admittance: FloatArray
    """S into the rest of the line, from each place on"""
    profile: FloatArray
    """volts at each place for 1 V at the end"""

    @classmethod
    def solve(cls, series: FloatArray, shunt: FloatArray) -> Ladders:
        """Both (places, lines)."""
        admittance, drop = np.empty_like(shunt), np.empty_like(shunt)
        rest = np.zeros(shunt.shape[1:])
        ohms, branches, sums, drops = list(series), list(shunt), list(admittance), list(drop)
        for place in range(len(shunt) - 1, -1, -1):  # in place: at 64 x 64 the calls cost more than the arithmetic
            np.add(rest, branches[place], out=sums[place])
            np.multiply(ohms[place], sums[place], out=drops[place])
            np.add(drops[place], 1.0, out=drops[place])
            np.divide(sums[place], drops[place], out=rest)
        np.divide(1.0, drop, out=drop)
        return cls(series, shunt, admittance, np.multiply.accumulate(drop, axis=0, out=drop))

    def part(self, lines: slice) -> Ladders:
        """Some of the lines."""
        return Ladders(self.series[:, lines], self.shunt[:, lines], self.admittance[:, lines], self.profile[:, lines])


@dataclass(frozen=True)
class Attenuated:
    """Transfer conductances (..., N, M) that are at most too low, by ``row[..., :, None] * column[..., None, :]``."""

    transfer: FloatArray
    """S"""
    row: FloatArray
    """(..., N): volts that the crossing lines can be lifted by in each step"""
    column: FloatArray
    """(..., M): A into each column for 1 V of that lift"""
    rounded: FloatArray
    """S (..., N, M) of rounding error in ``transfer``, either way"""
    relative: FloatArray
    """(...,) rounding error of the ladders' profiles, relative to each"""
    returned: FloatArray
    """(...,) largest part of a lift that can come back: at least so fast do the terms of the series shrink"""

    @property
    def error(self) -> FloatArray:
        """S (..., N, M) by which the transfer conductances can be off."""
        with np.errstate(invalid="ignore"):  # no bound on nothing is not a number, and so never good enough
            bound: FloatArray = self.row[..., :, None] * self.column[..., None, :]
        bound += self.rounded
        return bound


def attenuate(conductance: FloatArray, wires: Wires | None) -> Attenuated | None:
    """The zeroth term of the series and its certificate.

    Args:
        conductance: (..., N, M) S of the cells.
        wires: of the grid, if none is broken.

    Returns:
        None for shorted cells and broken lines, which ladders cannot express, and where nothing is left of the drive
        at the end of a line.

    """
    if wires is None or not np.isfinite(conductance).all():
        return None
    *batch, rows, columns = conductance.shape
    cells = conductance.reshape(-1, rows, columns)
    row, column = wires.ladders(cells)
    known = certify(wires, cells, row, column, tuple(batch))
    return known if np.isfinite(known.relative).all() else None


@dataclass(frozen=True)
class Wires:
    """The wires of a grid in ohm."""

    row: FloatArray
    """(M, N): place along the row, row"""
    column: FloatArray
    """(N, M): place along the column from the amplifier, column"""
    path: FloatArray
    """(N, M) from each crosspoint to the amplifier"""

    @classmethod
    def of(cls, lines: Lines) -> Wires | None:
        """None where a line is broken."""
        assert lines.exit is not None
        column = np.concatenate([lines.exit[None], lines.column[:0:-1]])
        if not (lines.row.all() and column.all()):
            return None
        ohms = 1.0 / column
        return cls(np.ascontiguousarray(1.0 / lines.row.T), ohms, np.cumsum(ohms, axis=0)[::-1])

    def ladders(self, cells: FloatArray) -> tuple[Ladders, Ladders]:
        """Row and column ladders of (frames, N, M) cells, lines counted frame by frame."""
        frames, rows, columns = cells.shape
        along_row = np.ascontiguousarray(cells.transpose(2, 0, 1).reshape(columns, -1))
        along_column = np.ascontiguousarray(cells[:, ::-1].transpose(1, 0, 2).reshape(rows, -1))
        ohms = [np.tile(part, (1, frames)) if frames > 1 else part for part in (self.row, self.column)]
        if rows == columns:  # one pass for both
            both = Ladders.solve(np.hstack(ohms), np.hstack([along_row, along_column]))
            half = along_row.shape[1]
            return both.part(slice(None, half)), both.part(slice(half, None))
        return Ladders.solve(ohms[0], along_row), Ladders.solve(ohms[1], along_column)


def certify(wires: Wires, cells: FloatArray, row: Ladders, column: Ladders, batch: tuple[int, ...]) -> Attenuated:
    """Put the ladders of (frames, N, M) cells together."""
    frames, rows, columns = cells.shape
    profile = row.profile.reshape(columns, frames, rows).transpose(1, 2, 0)
    gain = column.profile.reshape(rows, frames, columns).transpose(1, 0, 2)[:, ::-1]
    lowest, least = profile.min(axis=(1, 2)), gain.min(axis=(1, 2))
    relative = rounding(columns, lowest) + rounding(rows, least) + 4.0 * _ULP
    each = relative[:, None, None]
    reaching = cells * gain
    transfer = reaching * profile
    lost = (1.0 + each) - profile  # at least 1 - p, rounding included
    over_wire = cells * wires.path
    over_wire /= 1.0 + over_wire
    over_wire *= profile
    returned = (1.0 + relative - lowest) * (1.0 + relative - least)
    lift = over_wire.max(axis=-1)
    slack = (1.0 + relative) * _SLACK
    factor = (slack * endlessly(returned))[:, None]
    lift = np.multiply(lift, factor, out=lift, where=lift > 0)  # a row without cells lifts nothing, however often
    reaching *= lost
    return Attenuated(
        transfer=transfer.reshape(*batch, rows, columns),
        row=lift.reshape(*batch, rows),
        column=(reaching.sum(axis=-2) * slack[:, None]).reshape(*batch, columns),
        rounded=(each * transfer).reshape(*batch, rows, columns),
        relative=relative.reshape(batch),
        returned=returned.reshape(batch),
    )


def endlessly(returned: FloatArray) -> FloatArray:
    """Sum of 1 + returned + returned^2 + ..."""
    with np.errstate(divide="ignore"):
        return np.where(returned < 1.0, 1.0 / (1.0 - returned), np.inf)


def rounding(places: int, smallest: FloatArray) -> FloatArray:
    """Relative error of profiles that go down to ``smallest`` along ladders of so many places.

    Each step back along a ladder adds 4 ulp to the relative error of its admittance Y, at most 4 n in all. A step of
    the profile is 1 / (1 + r Y): 3 ulp of its own, and of Y's error the part r Y / (1 + r Y), which summed over the
    steps is at most -ln of the whole profile.
    """
    with np.errstate(divide="ignore"):
        lost: FloatArray = _ULP * places * (4.0 - 5.0 * np.log(smallest))
    return lost
