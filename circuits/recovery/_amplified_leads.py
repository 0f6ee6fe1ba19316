"""Bases where the leads take much of the voltage: cells by Kirchhoff's laws, checked by an exact evaluation.

Line attenuation does not converge there. Segments, which the laws of :mod:`._heavy_leads` do not have, and currents
that unlike sources drive through the grid are taken out of the readings: exact evaluations say how large they are.
"""

from __future__ import annotations

from math import inf

import numpy as np

from ...arrays import FloatArray
from ._amplified_base import Base, loss_at
from ._amplified_board import FAR, MARGIN, AmplifiedBoard, above_floor, similar
from ._heavy_leads import ROUNDS, LeadFit, Propagation, invert_leads

_FAR_OFF = 8.0  # half steps by which the readings of given cells may be off however small they are


class LeadBases:
    """Makes bases by :func:`.invert_leads`, checked by exact evaluations."""

    def __init__(self, board: AmplifiedBoard) -> None:
        """For one board, before its first frame."""
        self._board = board
        self._by_segments = np.zeros(board.board.shape)  # S, of T, that segments add to what leads would give
        self._propagated_at: FloatArray | None = None  # S (N, M) of the base's propagation

    def __call__(self, volts: FloatArray, before: Base, checks: int) -> Base | None:
        """The base at the cells of a frame, or None where no cells without segments give its readings.

        Args:
            volts: (N, M) V, outputs.
            before: the last base, from which the search starts.
            checks: exact evaluations that the frame has left, at least one; a second one serves the correction for
                segments.

        """
        board = self._board
        current = volts * board.scale + board.constant  # A per volt of drive
        fit = self._fit(current, before.conductance, ROUNDS)
        if fit is None:
            return None
        between, transfer, off = self._checked(current, fit.conductance)
        if board.has_segments and fit.settled and (np.abs(off) > board.tolerance).any():
            self._by_segments = self._by_segments + off
            rounds = ROUNDS - fit.rounds
            corrected = self._fit(current, fit.conductance, rounds) if rounds > 0 and checks > 1 else None
            if corrected is not None:
                fit = corrected
                between, transfer, off = self._checked(current, fit.conductance)
        own = fit.conductance / fit.gain
        off = np.abs(off)
        settled = bool((off <= board.tolerance).all())
        # Of cells that give quite other readings, a bound of first order says nothing.
        astray = not settled and bool((off > np.maximum(FAR * np.abs(transfer), _FAR_OFF * board.half_step)).any())
        propagation, left = self._propagation(fit, before), None
        if astray:
            left = np.full_like(off, inf)
        elif not settled:
            left = MARGIN * board.moved_by(off, propagation, before.conductance) / fit.gain
        return Base(
            conductance=above_floor(fit.conductance),
            gain=fit.gain,
            shift=(own - transfer) * fit.gain,
            loss=loss_at(fit.gain),
            missing=max(float((transfer - own).max()), 0.0),
            off=left,
            model_error=board.tolerance,
            between=between,
            propagation=propagation,
        )

    def _fit(self, current: FloatArray, start: FloatArray, rounds: int) -> LeadFit | None:
        """Cells with these currents (N, M) into the amplifiers in A per volt, from ``start`` (N, M) in S on."""
        board, current = self._board, current + self._by_segments
        potential = current * board.column_lead + board.source_per_volt
        return invert_leads(current, potential, board.row_lead, board.column_lead, start, rounds)

    def _checked(
        self, current: FloatArray, conductance: FloatArray
    ) -> tuple[FloatArray | None, FloatArray, FloatArray]:
        """How far the readings are from the exact ones of given cells.

        Args:
            current: (N, M) A into the amplifiers per volt of drive.
            conductance: (N, M) S.

        Returns:
            S (M,) that currents between columns add to each transfer conductance of a column; transfer conductances
            (N, M) in S by the readings; and these less the cells' exact ones.

        """
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

    def _propagation(self, fit: LeadFit, before: Base) -> Propagation:
        """How errors of the readings come through; kept from frame to frame while no conductance has changed much."""
        at, kept = self._propagated_at, before.propagation
        if kept is not None and at is not None and similar(fit.conductance, at):
            return kept
        self._propagated_at = fit.conductance
        return fit.propagation()
