"""Gauss-Newton steps in closed form where columns hardly load each other: a diagonal and one product per column.

With grounded idle rows, ideal column lines and light row leads, a reading depends only on the conductance D_ij between
its row driver and its column, and on the sum T_j of its column (:meth:`.ReadoutCircuit.column_slopes`). The derivatives
by the logarithms of D within one column are therefore

    J = diag(a) + b d',      a_i = D_ij dV_ij/dD_ij,    b_i = dV_ij/dT_j,    d_k = D_kj,

and the normal matrix of a regularised step is diagonal but for two products:

    J'J + 1/s^2 = diag(a^2 + 1/s^2) + Q K Q',    Q = (d, a b),    K = (b'b, 1; 1, 0).

Its inverse follows from a 2 x 2 matrix per column (Woodbury). A step and the posterior variances of all cells thus cost
a few operations per cell, and nothing needs to be kept from frame to frame.

Row leads r are eliminated by D_ij = g_ij / (1 + r_i S_i), with the sum S_i of a row's conductances. The current that
returns from the leads of the rows into other columns is neglected. It makes steps converge linearly, at a rate of about
the largest share :meth:`ColumnBlocks.loss` of a voltage that the leads take.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._board import Board

_MOST_TAKEN = 0.8  # largest share of a voltage that a row's lead takes in a first guess
_KNOWN = 0.2  # standard deviation of a logarithm up to which the linear law suffices
_LARGEST_SIEMENS = 1e100  # so that no product with a wire of 0 ohm is undefined
_DEVIATIONS = 1.5  # assumed error of a hardly known cell, in standard deviations, where its effect is computed


def beyond_linear(std: FloatArray) -> FloatArray:
    """Variance of a conductance, known within ``std`` of its logarithm, in excess of the linear law; relative to it.

    An error of a logarithm multiplies the conductance by an exponential, not by a linear factor. A hardly known cell
    may therefore add more to the current of its lines than the derivatives say. Errors of better known cells have both
    signs, and their second order averages out.
    """
    std = np.minimum(np.maximum(_DEVIATIONS * (std - _KNOWN), 1e-3), 4.0)
    more: FloatArray = (np.expm1(std) / std) ** 2 - 1.0
    return more


class Step(NamedTuple):
    """The regularised inverse of the derivatives at one point. Arrays are (N, M), logarithms those of the cells."""

    own: FloatArray
    """standard deviations of a reading per unit of its cell's logarithm, at a constant sum of the column"""
    by_sum: FloatArray
    """standard deviations of a reading per S of its column's sum"""
    second_vector: FloatArray
    """product of ``own`` and ``by_sum``"""
    driven: FloatArray
    """S, change of D per unit of its cell's logarithm"""
    free: FloatArray
    """inverse of the normal matrix' diagonal part"""
    mixed: tuple[FloatArray, FloatArray, FloatArray]
    """(M,) entries 11, 12 and 22 of the inverse of the 2 x 2 matrix"""
    through_lead: FloatArray
    """relative change of the crosspoints of a row per unit of each logarithm, by the row's lead"""
    share: FloatArray
    """logarithm of a cell per relative change of its crosspoint"""
    std: FloatArray
    """posterior standard deviation of the logarithms"""
    others: FloatArray
    """change of the logarithms if all hidden cells go to their ends"""
    floor: FloatArray
    """logarithm of the conductance below which a cell counts linearly, see :class:`ColumnBlocks`"""
    noise: float
    """V, standard deviation of a reading"""

    def solve(self, volts: FloatArray) -> FloatArray:
        """Change (n,) of the logarithms for a difference (n,) of the readings in V."""
        apart = volts.reshape(self.driven.shape) / self.noise
        normal = self.own * apart + self.driven * np.einsum("ij,ij->j", self.by_sum, apart)
        free = self.free * normal
        along_first = np.einsum("ij,ij->j", self.driven, free)
        along_second = np.einsum("ij,ij->j", self.second_vector, free)
        first, both, second = self.mixed
        change = free - self.free * (
            self.driven * (first * along_first + both * along_second)
            + self.second_vector * (both * along_first + second * along_second)
        )
        change += self.share * np.einsum("ij,ij->i", self.through_lead, change)[:, None]
        flat: FloatArray = change.ravel()
        return flat


class ColumnBlocks:
    """Makes a :class:`Step` for a board at any cells."""

    def __init__(
        self, board: Board, to_driver: FloatArray, to_end: FloatArray, noise: float, tells: BoolArray | None = None
    ) -> None:
        """For a board.

        Args:
            board: the board.
            to_driver: (N, M) ohm of wire from each crosspoint to the row driver.
            to_end: (N, M) ohm of wire from each crosspoint to its column's end.
            noise: V, standard deviation of a reading.
            tells: (N, M) where a reading depends on its cell; None: everywhere.

        """
        self._board, self._noise = board, noise
        # Cells beyond a complete break take no part. A line with segments counts as one lead.
        self._reached = np.isfinite(to_driver + to_end + board.column_lead)
        self._to_driver, self._to_end = (np.where(self._reached, ohms, 0.0) for ohms in (to_driver, to_end))
        self._lead = self._to_driver.sum(axis=1) / np.maximum(self._reached.sum(axis=1), 1)
        self._series = self._to_driver + self._to_end + board.column_lead + board.series_ohms
        self._tells = np.ones(board.shape, dtype=np.bool_) if tells is None else tells
        self.applies = board.plain and not board.floating
        """whether the board's readings have this form"""
        if self.applies:
            some = np.full(board.shape, 1e-4)
            self.applies = board.circuit.column_slopes(board, some, some.sum(axis=0)) is not None

        self.has_law = False
        """whether :meth:`crosspoints` takes all readings of a column together"""
        if self.applies:
            found = board.circuit.column_conductance(board, np.zeros(board.shape), noise)
            self.has_law = found is not None

    def loss(self, conductance: FloatArray) -> float:
        """Largest share of a voltage lost in lines that the form neglects, at crosspoints (N, M) in S."""
        conductance = np.minimum(conductance, _LARGEST_SIEMENS)  # it is infinite for a cell whose fit ran away
        along = (self._to_driver * conductance).sum(axis=1).max(initial=0.0)
        return float(along + (self._to_end * conductance).sum(axis=0).max(initial=0.0))

    def _lifted(self, crosspoint: FloatArray, conductance: FloatArray, std: FloatArray) -> FloatArray:
        """Standard deviation (N, M) of the logarithms by columns that lift idle rows, whose cells feed other columns.

        A column at its share of the drive lifts an idle row by the part of this share that the row's lead takes. An
        error of the column's scale changes all these lifts together, an error of a single cell only that of its row.

        Args:
            crosspoint: (N, M) S between the rows' drivers and the columns.
            conductance: (N, M) S between the rows and the columns.
            std: (N, M) standard deviation of the logarithms by other causes.

        """
        least = np.finfo(np.float64).tiny
        share = crosspoint / np.maximum(crosspoint.sum(axis=0), least)
        scale_std = std[crosspoint.argmax(axis=0), np.arange(std.shape[1])]
        between = (self._lead[:, None] * crosspoint).T @ conductance  # S (M, M), from column to column
        between.flat[:: len(between) + 1] = 0.0
        variance = (share * scale_std) ** 2 @ between**2
        by_cells = share**2 @ ((self._lead[:, None] * crosspoint * std) ** 2).T  # (N, N), of a row by another one
        by_cells.flat[:: len(by_cells) + 1] = 0.0
        variance += by_cells @ conductance**2
        lifted: FloatArray = np.sqrt(variance) / np.maximum(conductance, least)
        return lifted

    def crosspoints(self, signal: FloatArray) -> FloatArray:
        """S (N, M) of the crosspoints whose readings are ``signal`` (N, M), in V above the reference voltage."""
        driven = self._board.circuit.column_conductance(self._board, signal, self._noise)
        if driven is None:
            return self._board.circuit.apparent_conductance(self._board, signal)
        taken = np.minimum(self._lead * driven.sum(axis=1), _MOST_TAKEN)
        conductance: FloatArray = driven / (1.0 - taken)[:, None]
        return conductance

    def at(self, cells: FloatArray, spread: FloatArray, hidden: BoolArray) -> Step:
        """The step at cells (N, M) in ohm.

        Args:
            cells: the point of linearisation.
            spread: (N, M) standard deviation of the logarithms before anything is read.
            hidden: (N, M) cells whose conductance no reading tells.

        """
        board, lead = self._board, self._lead[:, None]
        conductance = np.where(self._reached, board.cell_conductance(cells), 0.0)
        along_row = 1.0 + lead * conductance.sum(axis=1, keepdims=True)
        crosspoint = conductance / along_row
        driven = crosspoint
        if board.faults:
            driven = np.where(self._reached, cells / (cells + board.series_ohms) ** 2, 0.0) / along_row
        with np.errstate(invalid="ignore"):  # an infinite resistance behind a column without conductance
            slopes = board.circuit.column_slopes(board, crosspoint, crosspoint.sum(axis=0))
        assert slopes is not None
        by_own, by_sum = slopes[0] / self._noise, slopes[1] / self._noise
        if not (np.isfinite(by_own).all() and np.isfinite(by_sum).all()):
            by_own, by_sum = np.nan_to_num(by_own), np.nan_to_num(by_sum)
        # S, least conductance of a crosspoint that its own reading tells from zero
        tells = self._tells & (by_own != 0.0)
        least = np.divide(1.0, np.abs(by_own), out=np.zeros(board.shape), where=tells)
        floor = np.log(np.maximum(least * along_row, np.finfo(np.float64).tiny))
        driven = np.where((driven < least) & (cells > self._series), least, driven)
        own = driven * by_own
        free = 1.0 / (own**2 + spread**-2.0)
        second_vector = own * by_sum
        squares = np.einsum("ij,ij->j", by_sum, by_sum)
        # K^-1 + Q' diag(free) Q, inverted
        at_first = np.einsum("ij,ij,ij->j", driven, free, driven)
        at_both = 1.0 + np.einsum("ij,ij,ij->j", driven, free, second_vector)
        at_second = np.einsum("ij,ij,ij->j", second_vector, free, second_vector) - squares
        determinant = at_first * at_second - at_both**2
        first, both, second = at_second / determinant, -at_both / determinant, at_first / determinant
        lessened = first * driven**2 + 2.0 * both * driven * second_vector + second * second_vector**2
        information = 1.0 / free + squares * driven**2 + 2.0 * driven * second_vector
        # No cell is known better than if all others were known. Rounding must not give less.
        variance = np.maximum(free - free**2 * lessened, 1.0 / information)
        # Effect of hardly known cells on the others, see beyond_linear().
        weight = free**2 * beyond_linear(np.sqrt(variance)) / variance
        by_first = np.einsum("ij,ij,ij->j", driven, weight, driven)
        by_both = np.einsum("ij,ij,ij->j", driven, weight, second_vector)
        by_second = np.einsum("ij,ij,ij->j", second_vector, weight, second_vector)
        along_driven = first * driven + both * second_vector
        along_other = both * driven + second * second_vector
        variance = variance + free**2 * (
            by_first * along_driven**2 + 2.0 * by_both * along_driven * along_other + by_second * along_other**2
        )
        share = np.divide(crosspoint, driven, out=np.zeros(board.shape), where=driven > 0)
        through_lead = lead * along_row * driven
        along = np.einsum("ij,ij,ij->i", through_lead, through_lead, variance)[:, None]
        std = np.sqrt(variance * (1.0 + 2.0 * lead * conductance) + along * share**2)
        std *= 1.0 + 2.0 * self.loss(conductance)
        if lead.any():
            std = np.hypot(std, self._lifted(crosspoint, conductance, std))
        others = np.zeros(board.shape)
        for i, j in np.argwhere(hidden) if np.count_nonzero(hidden) else ():
            weight = np.array([[first[j], both[j]], [both[j], second[j]]])
            vectors = np.stack([driven[:, j], second_vector[:, j]])
            shared = -free[:, j] * (vectors.T @ weight @ vectors[:, i]) * free[i, j]
            shared[i] = variance[i, j]
            others[:, j] += np.abs(shared) / variance[i, j] * spread[i, j]
        return Step(
            own=own,
            by_sum=by_sum,
            second_vector=second_vector,
            driven=driven,
            free=free,
            mixed=(first, both, second),
            through_lead=through_lead,
            share=share,
            std=std,
            others=others,
            floor=floor,
            noise=self._noise,
        )
