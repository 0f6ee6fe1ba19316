"""Bases on heavy leads: cells by Kirchhoff's laws, checked by an exact evaluation of the circuit.

Line attenuation does not converge if the leads take much of the voltage. The laws of :mod:`._heavy_leads` neglect
segments, and currents that different sources drive through the grid. Exact evaluations give these two effects, and the
readings are corrected for them.
"""

from __future__ import annotations

from math import inf

import numpy as np

from ...common.arrays import FloatArray
from ._amplified_base import Base, loss_at
from ._amplified_board import FAR, MARGIN, AmplifiedBoard, above_floor, similar
from ._amplified_prices import AmplifiedPrices
from ._frame_account import Account
from ._heavy_leads import ROUNDS, LeadFit, Propagation, invert_leads

_FAR_OFF = 8.0  # half steps by which readings of given cells may be off, however small these readings are

_Checked = tuple[FloatArray | None, FloatArray, FloatArray]
"""result of :meth:`LeadBases._checked`"""


class LeadBases:
    """Makes bases by :func:`.invert_leads`, checked by exact evaluations."""

    def __init__(self, board: AmplifiedBoard, prices: AmplifiedPrices) -> None:
        """For one board, before its first frame."""
        self._board, self._prices = board, prices
        self._by_segments = np.zeros(board.board.shape)  # S, part of T by segments, beyond that by leads
        self._propagated_at: FloatArray | None = None  # S (N, M), cells of the base's propagation

    def __call__(self, volts: FloatArray, before: Base, account: Account) -> Base | None:
        """The base at the cells of a frame, or None if no cells without segments give its readings.

        If the frame cannot pay for all of it, no cell is valid, and the next frame continues from these cells.

        Args:
            volts: (N, M) V, outputs.
            before: the last base, from which the search starts.
            account: of the frame.

        """
        board, prices = self._board, self._prices
        if not account.can_pay(prices.leads + prices.round):
            return before._replace(off=np.full_like(before.conductance, inf))
        current = volts * board.scale + board.constant  # A per volt of drive
        fit = self._fit(current, before.conductance, ROUNDS, account)
        if fit is None:
            return None
        propagation = self._kept_propagation(fit, before)
        if propagation is None and not account.can_pay(prices.bounds + prices.exact):
            # Not both in one frame. The propagation of errors serves for many frames, and therefore comes first.
            propagation = self._propagation(fit, account)
        owed = prices.bounds if propagation is None else 0.0
        fit, checked = self._corrected(current, fit, account, owed)
        if checked is None:
            return self._unchecked(fit, propagation, before)
        between, transfer, off = checked
        off = np.abs(off)
        settled = bool((off <= board.tolerance).all())
        # If the cells give quite different readings, a first-order bound does not hold.
        astray = not settled and bool((off > np.maximum(FAR * np.abs(transfer), _FAR_OFF * board.half_step)).any())
        if propagation is None:
            propagation = self._propagation(fit, account)
        left: FloatArray | None = None
        if astray or propagation is None or not (settled or account.pay(prices.propagated)):
            left = np.full_like(off, inf)
        elif not settled:
            left = MARGIN * board.moved_by(off, propagation, before.conductance) / fit.gain
        return _base(fit, board.tolerance, left, transfer, between, propagation)

    def _corrected(
        self, current: FloatArray, fit: LeadFit, account: Account, owed: float
    ) -> tuple[LeadFit, _Checked | None]:
        """A fit corrected for the effect of segments on the readings, as far as the frame can pay, and its check.

        Args:
            current: (N, M) A into the amplifiers per volt of drive.
            fit: to the readings, without the correction.
            account: of the frame.
            owed: price of the work that the frame must do afterwards.

        """
        board, prices = self._board, self._prices
        checked = self._checked(current, fit.conductance, account)
        if checked is None or not (board.has_segments and fit.settled):
            return fit, checked
        off = checked[-1]
        if (np.abs(off) <= board.tolerance).all():
            return fit, checked
        self._by_segments = self._by_segments + off
        rounds = ROUNDS - fit.rounds
        if rounds > 0 and account.can_pay(prices.leads + prices.round + prices.exact + owed):
            corrected = self._fit(current, fit.conductance, rounds, account)
            again = None if corrected is None else self._checked(current, corrected.conductance, account)
            if corrected is not None and again is not None:
                return corrected, again
        return fit, checked

    def _unchecked(self, fit: LeadFit, propagation: Propagation | None, before: Base) -> Base:
        """The base of cells that no exact evaluation has checked."""
        left = np.full_like(fit.conductance, inf)
        transfer = fit.conductance / fit.gain
        return _base(fit, self._board.tolerance, left, transfer, before.between, propagation)

    def _fit(self, current: FloatArray, start: FloatArray, most_rounds: int, account: Account) -> LeadFit | None:
        """Cells with these currents (N, M) into the amplifiers in A per volt, from ``start`` (N, M) in S on."""
        board, current = self._board, current + self._by_segments
        potential = current * board.column_lead + board.source_per_volt
        account.pay(self._prices.leads)
        rounds = account.times(self._prices.round, most_rounds)
        fit = invert_leads(current, potential, board.row_lead, board.column_lead, start, max(rounds, 1))
        account.pay(self._prices.round * (rounds if fit is None else fit.rounds))
        return fit

    def _checked(self, current: FloatArray, conductance: FloatArray, account: Account) -> _Checked | None:
        """Difference between the readings and the exact ones of given cells.

        Args:
            current: (N, M) A into the amplifiers per volt of drive.
            conductance: (N, M) S.
            account: of the frame.

        Returns:
            S (M,) that currents between columns add to each transfer conductance of a column; transfer conductances
            (N, M) in S by the readings; and these less the cells' exact ones. None if the frame cannot pay.

        """
        if not account.pay(self._prices.exact):
            return None
        board, cells = self._board, above_floor(conductance)
        if not board.has_sources:
            exact = board.models.exact(cells)
            return None, current, current - exact
        rows, source = len(cells), board.source_per_volt
        ports = board.models.ports(cells)
        exact, among_columns = ports[:rows, rows:], ports[rows:, rows:]
        between = (among_columns * (source - source[:, None])).sum(axis=1)
        transfer = current - between + source * exact.sum(axis=0)
        return between, transfer, transfer - exact

    def _kept_propagation(self, fit: LeadFit, before: Base) -> Propagation | None:
        """Error propagation of an earlier frame, if no conductance has changed much since."""
        at, kept = self._propagated_at, before.propagation
        return kept if kept is not None and at is not None and similar(fit.conductance, at) else None

    def _propagation(self, fit: LeadFit, account: Account) -> Propagation | None:
        """New error propagation: by all derivatives if the frame can pay for them, else by bounds, else None."""
        prices = self._prices
        exactly = account.can_pay(prices.derivatives)
        if not account.pay(prices.derivatives if exactly else prices.bounds):
            return None
        self._propagated_at = fit.conductance
        return fit.propagation(exactly=exactly)


def _base(
    fit: LeadFit,
    tolerance: FloatArray,
    left: FloatArray | None,
    transfer: FloatArray,
    between: FloatArray | None,
    propagation: Propagation | None,
) -> Base:
    """The base of a fit.

    Args:
        fit: the cells.
        tolerance: (M,) S, tolerated error of a transfer conductance by the model.
        left: (N, M) S, error of transfer conductances; None: within the tolerance.
        transfer: (N, M) S, transfer conductances by the readings.
        between: (M,) S that currents between columns add to these.
        propagation: error propagation; None: not known, and then no cell is valid.

    """
    own = fit.conductance / fit.gain
    return Base(
        conductance=above_floor(fit.conductance),
        gain=fit.gain,
        shift=(own - transfer) * fit.gain,
        loss=loss_at(fit.gain),
        missing=max(float((transfer - own).max()), 0.0),
        off=left,
        model_error=tolerance,
        between=between,
        propagation=propagation,
    )
