"""Line attenuation, relinearised about a base frame: cells from transfer conductances, with a certificate.

A transfer conductance T is the conductance of its cell times an attenuation by its two lines, which changes little from
frame to frame:

    G = gain(G) T + shift,      gain(G) = gain_base (1 + (G - G_base) K_row + K_column (G - G_base) + ...).

K are the resistances of shared wire of :mod:`..solvers._attenuation`; the sum in brackets is the derivative of the
attenuation for light lines. A *base* (:class:`Base`) is one evaluation of line attenuation, corrected by its difference
from an exact solution nearby (:class:`AttenuationBases`). The certificate bounds the terms left out
(:class:`Relinearisation`).

The loops compute the same as the array operations beside them, on which a frame that moves its base would otherwise
spend most of its time. Their sums over cells have another order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np

from ...common.arrays import FloatArray, read_only
from ...common.compiled import FixedRow, FixedRows, Rows, loop
from ..solvers import AttenuatedFrame
from ._amplified_board import FAR, LEAST_SHARE, ZERO, AmplifiedBoard, above_floor
from ._amplified_prices import AmplifiedPrices
from ._frame_account import Account
from ._heavy_leads import Propagation

T = TypeVar("T", float, FloatArray)

SECOND_ORDER = 2.0
"""terms beyond the first order over the first order times the loss; 1 to 1.5 on boards tried"""


class Base(NamedTuple):
    """The base with which frames are compared. Arrays are (N, M) in line coordinates unless stated."""

    conductance: FloatArray
    """S"""
    gain: FloatArray
    """conductance per transfer conductance: effect of the lines on the cell's own current"""
    shift: FloatArray | None
    """S, apparent conductance by the current of other cells; None if far below an ADC step"""
    loss: float
    """largest share of a cell's own current that its lines take"""
    missing: float
    """S, largest part of a transfer conductance that is other cells' current"""
    off: FloatArray | None
    """S, error of the model; None if below the tolerance"""
    model_error: FloatArray
    """S (M,), error of T by the model in any case"""
    between: FloatArray | None = None
    """S (M,) that currents between columns add to each T of a column; None: zero"""
    propagation: Propagation | None = None
    """propagation of errors of the readings if the leads are heavy; else :meth:`.AmplifiedBoard.by_lines` suffices"""

    @property
    def missing_per_moved(self) -> float:
        """S, change of other cells' current per relative change of gains."""
        return 0.0 if self.shift is None else 2.0 * self.missing / self.loss

    def own_part(self, transfer: FloatArray) -> FloatArray:
        """S (N, M), the cells' own currents in the transfer conductances: an ADC step is a share of these."""
        return transfer if self.shift is None else np.maximum(transfer + self.shift / self.gain, 0.0)


def loss_at(gain: FloatArray) -> float:
    """The largest share of a cell's own current that its lines take at these gains (N, M)."""
    return max(1.0 - 1.0 / float(gain.max()), 1e-9)


class Relinearisation:
    """The cells of a frame by a base, to first order in their change."""

    def __init__(self, board: AmplifiedBoard) -> None:
        """For the bases of one board."""
        self._board = board
        self._relinearise = _relinearise.machine_code()
        self._none = read_only(np.zeros(board.board.shape))
        """no shift, and no error of a base"""
        self._resistances = (
            read_only(board.farthest_driver),
            read_only(board.farthest_amplifier),
            read_only(np.broadcast_to(board.board.row_ohms, board.board.shape)),
            read_only(board.behind),
        )
        self._tolerance = read_only(board.tolerance)

    def __call__(self, base: Base, transfer: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """Conductances (N, M) in S, and the certificate.

        The certificate is the S (N, M) by which T may be off for these conductances; None if that is below the
        tolerance.
        """
        board = self._board
        if self._relinearise is not None:
            return self._by_loop(self._relinearise, base, transfer)
        conductance = base.gain * transfer
        if base.shift is not None:
            conductance += base.shift
            np.maximum(conductance, ZERO, out=conductance)
        change = conductance - base.conductance
        size = np.abs(change)
        by_row, by_column = size.dot(board.farthest_driver), board.farthest_amplifier.dot(size)
        most = by_row.item(by_row.argmax()) + by_column.item(by_column.argmax())
        drift = self._drift_between_columns(base, size, most)
        if base.off is None and most <= FAR and drift is None:
            # A bound for all cells: the largest reading, on the lines that have changed most.
            left_out = self._left_out(base, most, transfer.item(transfer.argmax()))
            if left_out <= board.least_tolerance:
                return self._first_order(conductance, change), None
        by_lines = by_row[:, None] + by_column
        if most <= FAR:
            conductance = self._first_order(conductance, change)
            off = self._left_out(base, by_lines, transfer)
        else:
            off = transfer * by_lines
        if base.off is not None:
            off = off + base.off
        if drift is not None:
            off = off + drift
        return conductance, None if (off <= board.tolerance).all() else off

    def _by_loop(
        self, relinearise: Callable[..., bool], base: Base, transfer: FloatArray
    ) -> tuple[FloatArray, FloatArray | None]:
        """As :meth:`__call__`, by machine code."""
        board, none = self._board, self._none
        conductance, off = np.empty(transfer.shape), np.empty(transfer.shape)
        certain = relinearise(
            np.ascontiguousarray(transfer),
            np.ascontiguousarray(base.gain),
            none if base.shift is None else np.ascontiguousarray(base.shift),
            np.ascontiguousarray(base.conductance),
            none if base.off is None else np.ascontiguousarray(base.off),
            base.model_error,
            *self._resistances,
            self._tolerance,
            base.off is None,
            board.source_spread,
            board.least_tolerance,
            base.loss,
            base.missing_per_moved,
            conductance,
            off,
        )
        return conductance, None if certain else off

    def _first_order(self, conductance: FloatArray, change: FloatArray) -> FloatArray:
        """Conductances (N, M) in S with the gains after a ``change`` (N, M) in S from the base."""
        gain = self._board.drop_along_rows(change)
        gain += self._board.drop_along_columns(change)
        gain *= conductance
        gain += conductance
        return gain

    def _left_out(self, base: Base, moved: T, transfer: T) -> T:
        """S that the relinearised model leaves out of T, for a relative change ``moved`` of gains.

        These are the terms beyond the first order of the attenuation, and the change of other cells' current, which is
        about proportional to the change of its lines' losses.
        """
        left_out = transfer * moved * (SECOND_ORDER * (base.loss + moved))
        if base.shift is not None:
            left_out = left_out + moved * base.missing_per_moved
        return left_out

    def _drift_between_columns(self, base: Base, size: FloatArray, moved: float) -> FloatArray | None:
        """S (M,), change of currents between columns since the base; None if within the base's own error.

        Cell kj of the idle row k brings G_kj R_k sum_l G_kl (s_l - s_j) into all readings of column j. A change in any
        row therefore concerns all of them.

        Args:
            base: the present base.
            size: (N, M) S by which the conductances have changed.
            moved: largest relative change of a gain by that.

        """
        if not self._board.sources_differ:
            return None
        changed = size.sum(axis=0)
        drift: FloatArray = base.loss * changed + moved * (base.conductance.sum(axis=0) + changed)
        drift *= self._board.source_spread
        return None if (drift <= base.model_error).all() else drift


class AttenuationBases:
    """Makes bases by line attenuation, and by exact solutions if the frame's budget allows."""

    def __init__(self, board: AmplifiedBoard, prices: AmplifiedPrices) -> None:
        """For one board, before its first frame."""
        self._board, self._prices = board, prices
        self._anchor: _Anchor | None = None

    def __call__(self, conductance: FloatArray, account: Account) -> Base | None:
        """The base at these conductances (N, M) in S, by line attenuation; None if the frame cannot pay for it."""
        if not account.pay(self._prices.attenuation):
            return None
        board, conductance = self._board, above_floor(conductance)
        known = board.models.attenuated(conductance)
        if known is None:  # the lines are so heavy that the drive underflows before their end
            if not account.pay(self._prices.exact):
                return None
            own = board.models.exact(conductance)
        else:
            own = known.transfer
        gain = conductance / np.maximum(own, LEAST_SHARE * conductance)
        between, model_error, loss = None, board.tolerance, loss_at(gain)
        missing, off = None, None
        if known is not None:
            exactly = None if board.asks_for_leads(loss) else account
            missing, off = self._missing(conductance, known, exactly)
        if board.sources_differ:
            between, left = board.between_columns(own, loss)
            model_error = board.tolerance + left
        return Base(
            conductance=conductance,
            gain=gain,
            shift=None if missing is None else -gain * missing,
            loss=loss,
            missing=0.0 if missing is None else float(missing.max()),
            off=off,
            model_error=model_error,
            between=between,
        )

    def _missing(
        self, conductance: FloatArray, known: AttenuatedFrame, exactly: Account | None
    ) -> tuple[FloatArray | None, FloatArray | None]:
        """S (N, M) that attenuation misses: other cells' current; None if below the tolerance.

        Without an exact evaluation, which is paid from ``exactly``, also the error bound in S (N, M).
        """
        bound, tolerance = known.error, self._board.tolerance
        if (bound <= tolerance).all():
            return None, None
        scaled, off = (None, bound) if self._anchor is None else self._anchor.scaled(bound)
        if (off <= tolerance).all():
            return scaled, None
        if exactly is None or not exactly.pay(self._prices.exact):
            return scaled, off
        transfer = self._board.models.exact(conductance)
        self._anchor = _Anchor(transfer - known.transfer, bound)
        return self._anchor.missing, None


class _Anchor(NamedTuple):
    """An exact solution: the error of attenuation there, and its certified bound. Arrays are (N, M) in S."""

    missing: FloatArray
    bound: FloatArray

    def scaled(self, bound: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The error of attenuation scaled to another ``bound``, and the approximate error of this estimate.

        The bound is proportional to the error within a factor that depends little on the conductances (1.1 to 3 on
        ordinary boards). Half of the change is allowed for the rest.
        """
        missing = bound / self.bound
        missing *= self.missing
        off = missing - self.missing
        np.abs(off, out=off)
        off *= 0.5
        return missing, off


@loop
def lost_along_lines(change: Rows, row_ohms: FixedRows, behind: FixedRows, sums: Rows, lost: Rows) -> None:
    """Write the changes (N, M) of gains to first order in a ``change`` (N, M) in S, which is overwritten.

    As :meth:`.AmplifiedBoard.drop_along_rows` and :meth:`.AmplifiedBoard.drop_along_columns` together. ``sums`` (2, M)
    may hold anything.
    """
    rows, columns = change.shape
    flow, below = sums[0], sums[1]
    sums[:] = 0.0
    for i in range(rows):
        for j in range(columns):
            flow[j] += change[i, j]
            lost[i, j] = behind[i, j] * flow[j]
    for i in range(rows - 1, -1, -1):
        current = 0.0
        for j in range(columns - 1, -1, -1):
            current += change[i, j]
            change[i, j] = current
        along = 0.0
        for j in range(columns):
            below[j] += lost[i, j]
            along += row_ohms[i, j] * change[i, j]
            lost[i, j] = along + below[j]


@loop
def _relinearise(
    transfer: FixedRows,
    gain: FixedRows,
    shift: FixedRows,
    base_conductance: FixedRows,
    base_off: FixedRows,
    model_error: FixedRow,
    farthest_driver: FixedRow,
    farthest_amplifier: FixedRow,
    row_ohms: FixedRows,
    behind: FixedRows,
    tolerance: FixedRow,
    base_is_certain: bool,
    source_spread: float,
    least_tolerance: float,
    loss: float,
    missing_per_moved: float,
    conductance: Rows,
    off: Rows,
) -> bool:
    """Write conductances (N, M) and errors of T in S (N, M); True, and no errors, if these are below the tolerance.

    As :class:`Relinearisation`.
    """
    rows, columns = transfer.shape
    change, by_row, by_column = np.empty((rows, columns)), np.zeros(rows), np.zeros(columns)
    drift, changed, standing = np.zeros(columns), np.zeros(columns), np.zeros(columns)
    most_transfer = 0.0
    for i in range(rows):
        for j in range(columns):
            conductance[i, j] = max(gain[i, j] * transfer[i, j] + shift[i, j], 0.0)
            change[i, j] = conductance[i, j] - base_conductance[i, j]
            size = abs(change[i, j])
            by_row[i] += size * farthest_driver[j]
            by_column[j] += size * farthest_amplifier[i]
            most_transfer = max(most_transfer, transfer[i, j])
    moved = by_row.max() + by_column.max()
    drifts = False
    if source_spread > 0.0:
        for i in range(rows):
            for j in range(columns):
                changed[j] += abs(change[i, j])
                standing[j] += base_conductance[i, j]
        for j in range(columns):
            drift[j] = source_spread * (loss * changed[j] + moved * (standing[j] + changed[j]))
            drifts |= not drift[j] <= model_error[j]
        if not drifts:
            drift[:] = 0.0
    near = moved <= FAR
    if near:
        lost = off
        lost_along_lines(change, row_ohms, behind, np.empty((2, columns)), lost)
        for i in range(rows):
            for j in range(columns):
                conductance[i, j] = lost[i, j] * conductance[i, j] + conductance[i, j]
        if base_is_certain and not drifts:
            left_out = most_transfer * moved * (SECOND_ORDER * (loss + moved)) + moved * missing_per_moved
            if left_out <= least_tolerance:
                return True
    certain = True
    for i in range(rows):
        for j in range(columns):
            by_lines = by_row[i] + by_column[j]
            left_out = transfer[i, j] * by_lines
            if near:
                left_out = left_out * (SECOND_ORDER * (loss + by_lines)) + by_lines * missing_per_moved
            off[i, j] = left_out + base_off[i, j] + drift[j]
            certain &= off[i, j] <= tolerance[j]
    return certain
