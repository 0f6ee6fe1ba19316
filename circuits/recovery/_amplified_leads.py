"""Bases where the leads take much of the voltage: cells by Kirchhoff's laws, checked by an exact evaluation.

Line attenuation does not converge there. Segments, which the laws of :mod:`._heavy_leads` do not have, and currents
that unlike sources drive through the grid are taken out of the readings: exact evaluations say how large they are.
"""

from __future__ import annotations

from math import inf

import numpy as np

from ...arrays import FloatArray
from ..solvers import exact_transfer, port_conductances
from ._amplified_base import Base, loss_at
from ._amplified_board import FAR, MARGIN, AmplifiedBoard, above_floor, similar
from ._heavy_leads import LeadFit, Propagation, invert_leads

_FAR_OFF = 8.0  # half steps by which the readings of given cells may be off however small they are


class LeadBases:
    """Makes bases by :func:`.invert_leads`, checked by an exact evaluation; both at most twice."""

    def __init__(self, board: AmplifiedBoard) -> None:
        """For one board, before its first frame."""
        self._board = board
        self._by_segments = np.zeros(board.board.shape)  # S, of T, that segments add to what leads would give
        self._propagated_at: FloatArray | None = None  # S (N, M) of the base's propagation

    def __call__(self, volts: FloatArray, before: Base) -> Base | None:
        """The base at the cells of a frame, or None where no cells without segments give its readings.

        Args:
            volts: (N, M) V, outputs.
            before: the last base, from which the search starts.

        """
        board = self._board
        current = volts * board.scale + board.constant  # A per volt of drive
        fit = self._fit(current, before.conductance)
        if fit is None:
            return None
        between, transfer, off = self._checked(current, fit.conductance)
        if board.has_segments and fit.settled and (np.abs(off) > board.tolerance).any():
            self._by_segments = self._by_segments + off
            corrected = self._fit(current, fit.conductance)
            if corrected is not None:
                fit = corrected
                between, transfer, off = self._checked(current, fit.conductance)
        propagation = self._propagation(fit, before)
        own = fit.conductance / fit.gain
        off = np.abs(off)
        settled = bool((off <= board.tolerance).all())
        # Of cells that give quite other readings, a bound of first order says nothing.
        astray = not settled and bool((off > np.maximum(FAR * np.abs(transfer), _FAR_OFF * board.half_step)).any())
        if settled:
            left = None
        elif astray:
            left = np.full_like(off, inf)
        else:
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

    def _fit(self, current: FloatArray, start: FloatArray) -> LeadFit | None:
        """Cells with these currents (N, M) into the amplifiers in A per volt, from ``start`` (N, M) in S on."""
        board, current = self._board, current + self._by_segments
        potential = current * board.column_lead + board.source_per_volt
        return invert_leads(current, potential, board.row_lead, board.column_lead, start)

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
        board = self._board
        exact, _ = exact_transfer(above_floor(conductance), board.lines)
        if not board.has_sources:
            return None, current, current - exact
        by_sources = self._source_currents(conductance)
        between = by_sources + board.source_per_volt * exact.sum(axis=0)
        transfer = current - by_sources
        return between, transfer, transfer - exact

    def _source_currents(self, conductance: FloatArray) -> FloatArray:
        """A (M,) per volt that the columns' sources drive into their amplifiers through cells (N, M) in S."""
        board = self._board
        if board.has_segments:
            rows = len(conductance)
            ports, _ = port_conductances(above_floor(conductance), board.board.lines)
            among = np.diag(ports.sum(axis=1))[rows:, rows:] - ports[rows:, rows:]
        else:
            idle = board.row_lead / (1.0 + board.row_lead * conductance.sum(axis=1))
            among = np.diag(conductance.sum(axis=0)) - (conductance.T * idle) @ conductance
        lines = np.eye(len(among)) + among * board.behind[-1]
        current: FloatArray = -np.linalg.solve(lines, among @ board.source_per_volt)
        return current

    def _propagation(self, fit: LeadFit, before: Base) -> Propagation:
        """How errors of the readings come through; kept from frame to frame while no conductance has changed much."""
        at, kept = self._propagated_at, before.propagation
        if kept is not None and at is not None and similar(fit.conductance, at):
            return kept
        self._propagated_at = fit.conductance
        return fit.propagation()
