"""Line attenuation, relinearised about a base frame: cells from transfer conductances, with a certificate.

A transfer conductance T is the conductance of its cell times an attenuation by its two lines, which changes little from
frame to frame:

    G = gain(G) T + shift,      gain(G) = gain_base (1 + (G - G_base) K_row + K_column (G - G_base) + ...).

K are the resistances of shared wire of :mod:`..solvers._attenuation`; the sum in brackets is the derivative of the
attenuation for light lines. A *base* (:class:`Base`) is one evaluation of line attenuation, corrected by what it misses
of an exact solution nearby (:class:`AttenuationBases`). The certificate bounds the terms left out
(:class:`Relinearisation`).
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np

from ...arrays import FloatArray
from ..solvers import AttenuatedFrame
from ._amplified_board import FAR, LEAST_SHARE, ZERO, AmplifiedBoard, above_floor
from ._heavy_leads import Propagation

T = TypeVar("T", float, FloatArray)

SECOND_ORDER = 2.0
"""terms beyond the first order over the first order times the loss; 1 to 1.5 on boards tried"""


class Base(NamedTuple):
    """What frames are compared with. Arrays are (N, M) in line coordinates unless stated."""

    conductance: FloatArray
    """S"""
    gain: FloatArray
    """conductance per transfer conductance, as far as the lines take the cell's own current"""
    shift: FloatArray | None
    """S, conductance that the current of other cells feigns; None where it is far below an ADC step"""
    loss: float
    """largest share of a cell's own current that its lines take"""
    missing: float
    """S, largest part of a transfer conductance that is other cells' current"""
    off: FloatArray | None
    """S by which the model may be wrong; None where that is below the tolerance"""
    model_error: FloatArray
    """S (M,) by which T may be off for the model in any case"""
    between: FloatArray | None = None
    """S (M,) that currents between columns add to each T of a column; None: nothing"""
    propagation: Propagation | None = None
    """of errors of the readings, where the leads are heavy; else :meth:`.AmplifiedBoard.by_lines` says enough"""

    def own_part(self, transfer: FloatArray) -> FloatArray:
        """S (N, M) of transfer conductances that is the cells' own current: an ADC step is a share of that."""
        return transfer if self.shift is None else np.maximum(transfer + self.shift / self.gain, 0.0)


def loss_at(gain: FloatArray) -> float:
    """The largest share of a cell's own current that its lines take at these gains (N, M)."""
    return max(1.0 - 1.0 / float(gain.max()), 1e-9)


class Relinearisation:
    """The cells of a frame by a base, to first order in their change."""

    def __init__(self, board: AmplifiedBoard) -> None:
        """For the bases of one board."""
        self._board = board

    def __call__(self, base: Base, transfer: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """Conductances (N, M) in S, and the certificate.

        The certificate is the S (N, M) by which T may be off for these conductances; None where that is below the
        tolerance.
        """
        board = self._board
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
            # No cell is off by more than one with the largest reading would be on the lines that have changed most.
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

    def _first_order(self, conductance: FloatArray, change: FloatArray) -> FloatArray:
        """Conductances (N, M) in S with the gains after a ``change`` (N, M) in S from the base."""
        gain = self._board.drop_along_rows(change)
        gain += self._board.drop_along_columns(change)
        gain *= conductance
        gain += conductance
        return gain

    def _left_out(self, base: Base, moved: T, transfer: T) -> T:
        """S that the relinearised model leaves out of T, where changed conductances move gains by the share ``moved``.

        The terms beyond the first order of the attenuation, and other cells' current, which changes about as the losses
        of its lines do.
        """
        left_out = transfer * moved * (SECOND_ORDER * (base.loss + moved))
        if base.shift is not None:
            left_out = left_out + moved * (2.0 * base.missing / base.loss)
        return left_out

    def _drift_between_columns(self, base: Base, size: FloatArray, moved: float) -> FloatArray | None:
        """S (M,) by which currents between columns may differ from the base's; None within the base's own error.

        Cell kj of the idle row k brings G_kj R_k sum_l G_kl (s_l - s_j) into all readings of column j, so what changes
        in any row concerns them all.

        Args:
            base: in force.
            size: (N, M) S by which the conductances have changed.
            moved: the largest share by which that moves a gain.

        """
        if not self._board.sources_differ:
            return None
        changed = size.sum(axis=0)
        drift: FloatArray = base.loss * changed + moved * (base.conductance.sum(axis=0) + changed)
        drift *= self._board.source_spread
        return None if (drift <= base.model_error).all() else drift


class AttenuationBases:
    """Makes bases by line attenuation, and by exact solutions as long as the frame's budget has some left."""

    def __init__(self, board: AmplifiedBoard) -> None:
        """For one board, before its first frame."""
        self._board = board
        self._anchor: _Anchor | None = None
        self.exact_left = 0
        """exact evaluations that the present frame has left"""

    def __call__(self, conductance: FloatArray) -> Base:
        """The base at these conductances (N, M) in S, by one evaluation of line attenuation."""
        board, conductance = self._board, above_floor(conductance)
        known = board.models.attenuated(conductance)
        # Without attenuation the lines are so heavy that the drive underflows before their end.
        own = board.models.exact(conductance) if known is None else known.transfer
        gain = conductance / np.maximum(own, LEAST_SHARE * conductance)
        between, model_error, loss = None, board.tolerance, loss_at(gain)
        missing, off = None, None
        if known is not None:
            missing, off = self._missing(conductance, known, exactly=not board.asks_for_leads(loss))
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
        self, conductance: FloatArray, known: AttenuatedFrame, *, exactly: bool
    ) -> tuple[FloatArray | None, FloatArray | None]:
        """S (N, M) that attenuation misses, other cells' current; None where that is below the tolerance.

        Without ``exactly``, or where the frame has no exact evaluation left, also the S (N, M) by which this may be
        off.
        """
        bound, tolerance = known.error, self._board.tolerance
        if (bound <= tolerance).all():
            return None, None
        scaled, off = (None, bound) if self._anchor is None else self._anchor.scaled(bound)
        if (off <= tolerance).all():
            return scaled, None
        if not exactly or self.exact_left == 0:
            return scaled, off
        self.exact_left -= 1
        transfer = self._board.models.exact(conductance)
        self._anchor = _Anchor(transfer - known.transfer, bound)
        return self._anchor.missing, None


class _Anchor(NamedTuple):
    """An exact solution: what attenuation misses there, and the certified bound on it. Arrays are (N, M) in S."""

    missing: FloatArray
    bound: FloatArray

    def scaled(self, bound: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What attenuation misses where the bound on it is another one, and about how far that can be off.

        The bound follows what is missed within a factor that depends little on the conductances (1.1 to 3 on ordinary
        boards); half of the change is allowed for what it does not follow.
        """
        missing = self.missing * (bound / self.bound)
        return missing, 0.5 * np.abs(missing - self.missing)
