"""Cells whose reading is at a limit, behind amplifiers: how far they can shift the other cells, to first order.

A cell at the low end of the range takes any conductance up to the present one; what its column's source drives through
it is in the column's readings in all steps. A cell at the high end takes any conductance from the present one up to a
short. All effects of these are added up (:meth:`CellsAtLimits._shares_of_shorts`, :meth:`CellsAtLimits._currents`).
"""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from typing import NamedTuple

import numpy as np

from ...arrays import BoolArray, FloatArray
from .._adc import adc_error
from ._amplified_base import Base
from ._amplified_board import BOUNDLESS, MARGIN, SIMILAR_MARGIN, AmplifiedBoard, floor_of, similar
from ._joined_columns import currents_between_sources, shared_currents

_GUARD = 6.0  # standard deviations of the noise within which an output may stand at a limit of its swing


class CellsAtLimits:
    """What cells at limits make of the others; kept from frame to frame while they hardly change."""

    def __init__(self, board: AmplifiedBoard) -> None:
        """For one board, before its first frame."""
        circuit_board, adc = board.board, board.board.adc
        assert adc is not None
        self._board = board
        self._low, self._high = circuit_board.supply
        self._middle = sum(adc.range) / 2
        self._near = adc_error(circuit_board) + adc.step / 2  # V within which an output stands at a limit of its swing
        self._high_is_more = (circuit_board.drive > 0) != circuit_board.circuit.inverts
        limits = [abs(limit - circuit_board.level) for limit in circuit_board.supply if np.isfinite(limit)]
        swing = max(limits, default=inf)
        # S (M,) into a saturated column's end
        self._most_per_ohm = (1.0 + swing / abs(circuit_board.drive)) / circuit_board.reference
        self._offset = np.abs(board.source_per_volt)
        self._kept: _Disturbance | None = None

    def __call__(
        self, conductance: FloatArray, volts: FloatArray, limited: BoolArray, noise: float, base: Base | None
    ) -> FloatArray:
        """Relative change (N, M) of each cell while those at limits take any value they can have.

        Args:
            conductance: (N, M) S.
            volts: (N, M) V, outputs.
            limited: (N, M) where a reading is at a limit.
            noise: V, standard deviation of the readings.
            base: the frame's base; None where gains are known in closed form.

        """
        near = self._near + _GUARD * noise
        at_high, at_low = volts >= self._high - near, volts <= self._low + near
        upper = at_high | ((volts > self._middle) & ~at_low)
        more = limited & (upper == self._high_is_more)
        kept = self._kept
        if kept is None or not kept.holds(conductance, limited, more):
            kept = self._worked_out(conductance, limited, more, more & (at_high | at_low), base)
            self._kept = kept
        return kept.relative_change(conductance)

    def _worked_out(
        self, conductance: FloatArray, limited: BoolArray, more: BoolArray, saturated: BoolArray, base: Base | None
    ) -> _Disturbance:
        """What cells at limits make of the others.

        Args:
            conductance: (N, M) S.
            limited: (N, M) all cells at limits.
            more: (N, M) those that conduct more than the reading says.
            saturated: (N, M) those of them whose amplifier, not only the converter, is at a limit.
            base: the frame's base; None where gains are known in closed form.

        """
        board, floor = self._board, floor_of(conductance)
        less = np.where(limited & ~more, conductance, 0.0)
        if base is None or base.propagation is None:
            by_lines = board.by_lines(less)
        else:
            moved = board.moved_by(less / base.gain, base.propagation, base.conductance)
            by_lines = moved / np.maximum(conductance, floor)
        fixed, added = np.zeros(more.shape), board.for_all(self._offset * less.sum(axis=0)).copy()
        if base is None or base.propagation is None:
            added += self._by_way_of_rows(less, conductance)
        if more.any():
            shorts = _Shorts.at(more, board)
            fixed = self._shares_of_shorts(shorts, saturated, conductance)
            for current in self._currents(shorts, fixed, conductance):
                added += current
            added *= MARGIN
            # Misjudged cells load their lines otherwise than the model has it, and that concerns all cells there.
            direct = fixed + added / np.maximum(conductance, floor)
            by_lines += board.by_lines(np.where(more, 0.0, np.minimum(direct, BOUNDLESS) * conductance))
        return _Disturbance(limited, more, conductance, floor, fixed, added, by_lines)

    def _by_way_of_rows(self, less: FloatArray, conductance: FloatArray) -> FloatArray:
        """S (N, M) of other cells' current that unknown cells at the low end bring into a reading, or keep from it.

        The driven row i lifts column m, that the idle row k, and that column j: G_im C_m G_km R_k G_kj to first order.
        Each of the three may be a cell whose conductance is anything from 0 to ``less`` (N, M) in S.
        """
        board = self._board
        lifted = conductance * board.to_amplifier
        fed = board.to_driver * conductance
        current = np.zeros(less.shape)
        for first, second, third in (
            (conductance, less * board.to_amplifier, fed),
            (conductance, lifted, board.to_driver * less),
            (less, lifted, fed),
        ):
            rows = first @ second.T
            np.fill_diagonal(rows, 0.0)
            current += rows @ third
        return current

    def _shares_of_shorts(self, shorts: _Shorts, saturated: BoolArray, conductance: FloatArray) -> FloatArray:
        """Share (N, M) of each cell's own current that shorts take or add.

        * Along its row, a short takes the drive from all cells: to_driver / to_amplifier, like a divider. Where its
          output is at a limit, its column ends in the reference resistor instead, which leaves it little current.
        * Down its column, a short into an idle row takes their current: to_amplifier / to_driver.
        """
        # The cells of a column that a short takes the current from conduct more than they seem to.
        column = (conductance * (1.0 + np.minimum(shorts.down.sum(axis=0), BOUNDLESS))).sum(axis=0)
        with np.errstate(invalid="ignore"):
            most = np.fmin(shorts.along, self._board.to_driver * (self._most_per_ohm + column))
            held = np.where(saturated, most, 0.0)
        along = np.where(saturated, 0.0, shorts.along)
        shares: FloatArray = MARGIN * (along.sum(axis=1)[:, None] + shorts.down.sum(axis=0))
        shares += held.sum(axis=1)[:, None]
        return shares

    def _currents(self, shorts: _Shorts, fixed: FloatArray, conductance: FloatArray) -> Iterator[FloatArray]:
        """S, broadcast to (N, M): currents of other cells that shorts bring into a reading, one effect at a time."""
        board, more, offset = self._board, shorts.where, self._offset
        most = np.where(more, np.minimum(shorts.conductance, BOUNDLESS), conductance)
        # A column that the current of row k lifts also lifts the short's row, whose cells then add to row k's
        # readings, and above all the column that a short of its own joins that row to.
        lifts = most @ np.where(more, board.to_amplifier, 0.0).T
        np.fill_diagonal(lifts, 0.0)
        yield lifts @ np.where(more, 0.0, conductance)
        # The other columns that it lifts feed the short's row by their cells, and the short brings into its column
        # what its row's driver does not take.
        ordinary = np.where(more, 0.0, conductance)
        fed = ordinary @ (ordinary * board.to_amplifier).T
        np.fill_diagonal(fed, 0.0)
        with np.errstate(invalid="ignore"):
            share = np.minimum(np.nan_to_num(board.to_driver * shorts.conductance, nan=1.0), 1.0)
        yield fed @ share
        # Two shorts on one row join their columns.
        yield shared_currents(board, more, conductance)
        # In its own step, the short lifts its column, and that the other rows, whose cells add to its row's readings.
        takes = more @ (board.to_driver * most).T
        np.fill_diagonal(takes, 0.0)
        yield takes @ most
        # The source of its column drives a current through it, in all steps alike ...
        with np.errstate(invalid="ignore"):
            by_source = np.nan_to_num(offset * shorts.conductance.sum(axis=0), nan=0.0, posinf=inf)
        yield by_source
        # ... as the difference of two columns' sources does where shorts join these columns.
        yield currents_between_sources(board, more)
        # The other columns' sources drive currents through the cells of the short's row. These may conduct more than
        # they seem to.
        misjudged = conductance * (1.0 + np.minimum(fixed, BOUNDLESS))
        yield offset * (more.any(axis=1) @ misjudged)
        # The source of the short's column lifts that row, whose cells feed the other columns.
        yield np.where(more, offset, 0.0).max(axis=1) @ misjudged


class _Shorts(NamedTuple):
    """Cells that may be shorts. Arrays are (N, M), 0 at all other cells."""

    where: BoolArray
    along: FloatArray
    """relative change of the row's other cells, as each short takes the row's drive"""
    down: FloatArray
    """relative change of the column's other cells, as each short takes their currents"""
    conductance: FloatArray
    """S that its lines leave of each short; inf on lines without resistance"""

    @classmethod
    def at(cls, where: BoolArray, board: AmplifiedBoard) -> _Shorts:
        driver, amplifier = board.to_driver, board.to_amplifier
        with np.errstate(divide="ignore", invalid="ignore"):
            return cls(
                where,
                along=np.where(where, np.nan_to_num(driver / amplifier, nan=0.0, posinf=inf), 0.0),
                down=np.where(where, np.nan_to_num(amplifier / driver, nan=0.0, posinf=inf), 0.0),
                conductance=np.where(where, 1.0 / (driver + amplifier), 0.0),
            )


class _Disturbance(NamedTuple):
    """What cells at limits make of the others. Arrays are (N, M)."""

    limited: BoolArray
    more: BoolArray
    """at the high end: the cell conducts more than the reading says"""
    conductance: FloatArray
    """S, for which this was worked out"""
    floor: float
    """S, least conductance that a relative change refers to"""
    fixed: FloatArray
    """relative change whatever the conductances"""
    added: FloatArray
    """S, current of other cells that may appear in a reading, per volt"""
    by_lines: FloatArray
    """relative change because lines are loaded otherwise"""

    def holds(self, conductance: FloatArray, limited: BoolArray, more: BoolArray) -> bool:
        """Whether the same cells are at the same limits and the lines' other cells have not changed by much."""
        if not (np.array_equal(limited, self.limited) and np.array_equal(more, self.more)):
            return False
        return similar(np.where(limited, self.conductance, conductance), self.conductance)

    def relative_change(self, conductance: FloatArray) -> FloatArray:
        """For cells (N, M) in S that are like those for which this was worked out."""
        return self.fixed + SIMILAR_MARGIN * (self.added / np.maximum(conductance, self.floor) + self.by_lines)
