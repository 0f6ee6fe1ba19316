"""Uncertainties of cells behind amplifiers: quantisation and noise of all readings, and the model's own error."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...common.arrays import FloatArray, read_only
from ...common.compiled import FixedRow, FixedRows, Rows, loop
from ._amplified_base import Base
from ._amplified_board import SIMILAR_MARGIN, ZERO, AmplifiedBoard
from ._heavy_leads import Propagation
from ._live_reading import SIGMAS, ValidityRule

_LEAST_OF_NOISE = 0.6  # least noise for which a level serves, over the noise of the level
_NOISE_MARGIN = 1.2  # so that a fluctuating noise estimate does not require new levels in every frame
SIMILAR_GAINS = 0.05
"""relative change of gains in closed form up to which levels are kept"""


class Levels(NamedTuple):
    """Errors of readings with a certain noise. Arrays broadcast to (N, M) in line coordinates."""

    noise: float
    """V, standard deviation of the readings"""
    gain: FloatArray
    """conductance per transfer conductance, for which the levels hold"""
    own: FloatArray
    """S, error of a cell's own transfer conductance: half a step, noise, and the error of the model"""
    others: FloatArray
    """relative uncertainty by the readings of other cells on light lines"""
    by_leads: FloatArray
    """S, error of a transfer conductance by the readings of other cells if leads are heavy; else 0"""
    least: FloatArray
    """S, least transfer conductance of a valid cell"""
    propagation: Propagation | None
    """error propagation of the base for which the levels were computed"""

    def uncertainties(self, transfer: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Relative uncertainties (N, M) of cells, and the part by their own readings.

        Args:
            transfer: (N, M) S, the cells' own transfer conductances.

        """
        reading = np.maximum(transfer, self.own)
        own = self.own / reading
        return own + self.by_leads / reading + self.others, own


class ReadingErrors:
    """Computes :class:`Levels`, and keeps them while they hold."""

    def __init__(self, board: AmplifiedBoard, rule: ValidityRule) -> None:
        """For one board, before its first frame."""
        self._board, self._rule = board, rule
        self._of_light_lines = _of_light_lines.machine_code()
        self._wire = read_only(board.to_driver), read_only(board.to_amplifier)
        self._half_step = read_only(board.half_step)
        self._kept: Levels | None = None

    def __call__(self, gain: FloatArray, noise: float, base: Base | None) -> Levels:
        """Errors of the readings.

        Args:
            gain: conductance per transfer conductance; broadcasts to (N, M).
            noise: V, standard deviation of the readings.
            base: the base of these gains; None if they are known in closed form.

        """
        if base is not None and base.propagation is not None:
            if self._kept is not None and self.holds(base.propagation, noise):
                return self._kept
        else:
            kept = self.kept_for(noise)
            if kept is not None and (kept.gain is gain or (base is None and _similar_gains(kept.gain, gain))):
                return kept
        self._kept = self._worked_out(gain, _NOISE_MARGIN * noise, base)
        return self._kept

    def holds(self, propagation: Propagation | None, noise: float) -> bool:
        """Whether the last levels serve for this propagation of errors and a noise in V."""
        kept = self.kept_for(noise)
        return kept is not None and kept.propagation is propagation

    def kept_for(self, noise: float) -> Levels | None:
        """The last levels, if they serve for a noise in V; only for gains like theirs."""
        kept = self._kept
        return kept if kept is not None and _LEAST_OF_NOISE * kept.noise <= noise <= kept.noise else None

    def _worked_out(self, gain: FloatArray, noise: float, base: Base | None) -> Levels:
        board = self._board
        own_noise = SIGMAS * noise * np.abs(board.scale)
        own = board.half_step + own_noise + (board.tolerance if base is None else base.model_error)
        propagation = None if base is None else base.propagation
        others, by_leads = ZERO, ZERO
        if base is None or propagation is None:
            others = self._others_of_light_lines(gain, own_noise)
        else:
            by_leads = self._others_of_heavy_leads(propagation, base, own, own_noise)
        least = self._rule.least_reading(own + by_leads, others)
        return Levels(noise, gain, board.for_all(own), others, by_leads, least, propagation)

    def _others_of_light_lines(self, gain: FloatArray, own_noise: FloatArray) -> FloatArray:
        """Relative uncertainty (N, M) by other readings, whose noise is ``own_noise`` (M,) in S."""
        board = self._board
        if self._of_light_lines is not None:
            by_loop = np.empty(board.board.shape)
            self._of_light_lines(board.for_all(gain), self._half_step, own_noise, *self._wire, by_loop)
            return by_loop
        # Quantisation errors of neighbours may all have the same sign; noise adds up by its squares.
        others = board.by_lines(board.half_step * gain)
        if own_noise.any():
            squares = np.broadcast_to((own_noise * gain) ** 2, board.board.shape)
            others = others + np.sqrt(
                np.einsum("ij,ij->i", board.to_driver**2, squares)[:, None]
                + np.einsum("ij,ij->j", board.to_amplifier**2, squares)
            )
        return others

    def _others_of_heavy_leads(
        self, propagation: Propagation, base: Base, own: FloatArray, own_noise: FloatArray
    ) -> FloatArray:
        """S (N, M), apparent error of a transfer conductance by other readings.

        Args:
            propagation: of errors at the base.
            base: the base.
            own: (M,) S, error of a reading, noise included.
            own_noise: (M,) S, the noise in ``own``.

        """
        board = self._board
        spread = propagation(board.for_all(own - own_noise))
        if own_noise.any():
            spread = spread + np.sqrt(propagation.squared()(board.for_all(own_noise**2)))
        spread = board.within_linear_range(SIMILAR_MARGIN * spread, base.conductance)
        by_leads: FloatArray = np.maximum(spread / base.gain - own, 0.0)
        return by_leads


def _similar_gains(before: FloatArray, gain: FloatArray) -> bool:
    return bool((np.abs(gain - before) <= SIMILAR_GAINS * before).all())


@loop
def _of_light_lines(
    gain: FixedRows,
    half_step: FixedRow,
    own_noise: FixedRow,
    to_driver: FixedRows,
    to_amplifier: FixedRows,
    others: Rows,
) -> None:
    """Write the relative uncertainties (N, M) by other readings, as :meth:`ReadingErrors._others_of_light_lines`."""
    rows, columns = gain.shape
    by_row, by_column = np.zeros(rows), np.zeros(columns)
    noise_by_row, noise_by_column = np.zeros(rows), np.zeros(columns)
    for i in range(rows):
        for j in range(columns):
            step, noise = half_step[j] * gain[i, j], own_noise[j] * gain[i, j]
            by_row[i] += to_driver[i, j] * step
            by_column[j] += to_amplifier[i, j] * step
            along, down = to_driver[i, j] * noise, to_amplifier[i, j] * noise
            noise_by_row[i] += along * along
            noise_by_column[j] += down * down
    for i in range(rows):
        for j in range(columns):
            others[i, j] = by_row[i] + by_column[j] + np.sqrt(noise_by_row[i] + noise_by_column[j])
