"""Cells whose reading is at a limit, behind amplifiers: bounds on their effect on the other cells, to first order.

A cell at the low end of the range may have any conductance up to the present one; the current that its column's source
drives through it is in the column's readings in all steps. A cell at the high end may have any conductance from the
present one up to a short. The effects of all such cells are added up (:meth:`CellsAtLimits._shares_of_shorts`,
:meth:`CellsAtLimits._currents`).
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray, read_only
from .._adc import adc_error
from ._amplified_base import Base
from ._amplified_board import BOUNDLESS, MARGIN, SIMILAR_MARGIN, AmplifiedBoard, floor_of, similar
from ._amplified_prices import AmplifiedPrices
from ._amplified_short_loops import by_shorts
from ._frame_account import Account
from ._joined_columns import currents_between_sources, shared_currents

_GUARD = 6.0  # standard deviations of the noise: an output this close to a limit of its swing may stand at it


class CellsAtLimits:
    """Effect of cells at limits on the others; kept from frame to frame while they hardly change."""

    def __init__(self, board: AmplifiedBoard, prices: AmplifiedPrices) -> None:
        """For one board, before its first frame."""
        circuit_board, adc = board.board, board.board.adc
        assert adc is not None
        self._board, self._prices = board, prices
        self._low, self._high = circuit_board.supply
        self._middle = sum(adc.range) / 2
        self._near = adc_error(circuit_board) + adc.step / 2  # V: an output this close to a limit stands at it
        self._high_is_more = (circuit_board.drive > 0) != circuit_board.circuit.inverts
        limits = [abs(limit - circuit_board.level) for limit in circuit_board.supply if np.isfinite(limit)]
        swing = max(limits, default=inf)
        # S (M,) into a saturated column's end
        self._most_per_ohm = (1.0 + swing / abs(circuit_board.drive)) / circuit_board.reference
        self._offset = np.abs(board.source_per_volt)
        self._shorts = _EveryShort(board)
        self._by_shorts = by_shorts.machine_code()
        self._to_driver, self._to_amplifier = read_only(board.to_driver), read_only(board.to_amplifier)
        self._fixed_most_per_ohm, self._source = read_only(self._most_per_ohm), read_only(board.source_per_volt)
        self._kept: _Disturbance | None = None

    @property
    def is_compiled(self) -> bool:
        """Whether machine code does the work."""
        return self._by_shorts is not None

    def __call__(
        self,
        conductance: FloatArray,
        volts: FloatArray,
        limited: BoolArray,
        noise: float,
        base: Base | None,
        account: Account,
    ) -> FloatArray:
        """Largest relative change (N, M) of each cell over all possible values of the cells at limits.

        Args:
            conductance: (N, M) S.
            volts: (N, M) V, outputs.
            limited: (N, M) where a reading is at a limit.
            noise: V, standard deviation of the readings.
            base: the frame's base; None if gains are known in closed form.
            account: of the frame; if it cannot pay, all changes are inf.

        """
        near = self._near + _GUARD * noise
        at_high, at_low = volts >= self._high - near, volts <= self._low + near
        upper = at_high | ((volts > self._middle) & ~at_low)
        more = limited & (upper == self._high_is_more)
        kept = self._kept
        if kept is None or not kept.holds(conductance, limited, more):
            by_leads = base is not None and base.propagation is not None
            if not account.pay(self._prices.shorts(more) + (self._prices.propagated if by_leads else 0.0)):
                return np.full(more.shape, inf)
            kept = self._worked_out(conductance, limited, more, more & (at_high | at_low), base)
            self._kept = kept
        return kept.relative_change(conductance)

    def _worked_out(
        self, conductance: FloatArray, limited: BoolArray, more: BoolArray, saturated: BoolArray, base: Base | None
    ) -> _Disturbance:
        """Effect of cells at limits on the others.

        Args:
            conductance: (N, M) S.
            limited: (N, M) all cells at limits.
            more: (N, M) those that conduct more than the reading says.
            saturated: (N, M) those of ``more`` whose amplifier, not only the converter, is at a limit.
            base: the frame's base; None if gains are known in closed form.

        """
        board, floor = self._board, floor_of(conductance)
        low, high = bool((limited > more).any()), bool(more.any())
        fixed, added, by_lines = np.zeros(more.shape), np.zeros(more.shape), np.zeros(more.shape)
        if low:
            less = np.where(limited & ~more, conductance, 0.0)
            added += self._offset * less.sum(axis=0)
            if base is None or base.propagation is None:
                by_lines = board.by_lines(less)
                added += self._by_way_of_rows(less, conductance)
            else:
                moved = board.moved_by(less / base.gain, base.propagation, base.conductance)
                by_lines = moved / np.maximum(conductance, floor)
        if high:
            self._add_shorts(_AtHigh(conductance, more, saturated, floor), fixed, added, by_lines)
        return _Disturbance(limited, more, conductance, floor, fixed, added, by_lines)

    def _add_shorts(self, at_high: _AtHigh, fixed: FloatArray, added: FloatArray, by_lines: FloatArray) -> None:
        """Add the effect of cells that may be shorts on the others to the fields (N, M) of a :class:`_Disturbance`."""
        board, conductance = self._board, at_high.conductance
        if self._by_shorts is not None:
            self._by_shorts(
                np.ascontiguousarray(conductance),
                np.ascontiguousarray(at_high.more),
                np.ascontiguousarray(at_high.saturated),
                self._to_driver,
                self._to_amplifier,
                self._shorts.along,
                self._shorts.down,
                self._shorts.conductance,
                self._shorts.share,
                self._fixed_most_per_ohm,
                self._source,
                at_high.floor,
                fixed,
                added,
                by_lines,
            )
            return
        shorts = self._shorts.at(at_high.more, conductance)
        fixed += self._shares_of_shorts(shorts, at_high.saturated, conductance)
        added += self._currents(shorts)
        if board.has_sources:
            added += self._source_currents(shorts, fixed, conductance)
        added *= MARGIN
        # Misjudged cells load their lines differently from the model, which concerns all cells of these lines.
        direct = fixed + added / np.maximum(conductance, at_high.floor)
        by_lines += board.by_lines(np.minimum(direct, BOUNDLESS) * shorts.ordinary)

    def _by_way_of_rows(self, less: FloatArray, conductance: FloatArray) -> FloatArray:
        """S (N, M) of other cells' current that unknown cells at the low end bring into a reading, or keep out of it.

        The driven row i lifts column m, that the idle row k, and that column j: G_im C_m G_km R_k G_kj to first order.
        Each of the three may be a cell whose conductance is anything from 0 to ``less`` (N, M) in S.
        """
        board = self._board
        lifted = conductance * board.to_amplifier
        fed = board.to_driver * conductance
        current = _between_rows(conductance, less * board.to_amplifier) @ fed
        current += _between_rows(conductance, lifted) @ (board.to_driver * less)
        current += _between_rows(less, lifted) @ fed
        return current

    def _shares_of_shorts(self, shorts: _Shorts, saturated: BoolArray, conductance: FloatArray) -> FloatArray:
        """Share (N, M) of each cell's own current that shorts take or add.

        * Along its row, a short takes the drive from all cells: to_driver / to_amplifier, like a divider. If its output
          is at a limit, its column ends in the reference resistor instead, which leaves it little current.
        * Down its column, a short into an idle row takes their current: to_amplifier / to_driver.
        """
        # The cells of a column from which a short takes the current conduct more than they seem to.
        down = shorts.down.sum(axis=0)
        column = conductance.sum(axis=0) * (1.0 + np.minimum(down, BOUNDLESS))
        with np.errstate(invalid="ignore"):
            most = np.fmin(shorts.along, self._board.to_driver * (self._most_per_ohm + column))
        along = np.where(saturated, 0.0, shorts.along)
        held = np.where(saturated, most, 0.0)
        shares: FloatArray = (MARGIN * along.sum(axis=1) + held.sum(axis=1))[:, None] + MARGIN * down
        return shares

    def _currents(self, shorts: _Shorts) -> FloatArray:
        """S (N, M): currents of other cells that shorts bring into a reading."""
        board, more, ordinary, most = self._board, shorts.where, shorts.ordinary, shorts.most
        # A column that the current of row k lifts also lifts the short's row, whose cells then add to row k's readings.
        # The column lifted most is one to which a short in row k itself connects that row.
        current = _between_rows(most, more * board.to_amplifier) @ ordinary
        # The other columns that row k lifts feed the short's row by their cells. The short carries into its column the
        # part of this current that its row's driver does not take.
        current += _between_rows(ordinary, ordinary * board.to_amplifier) @ shorts.share
        # Two shorts on one row join their columns.
        current += shared_currents(board, more, shorts.cells)
        # In its own step, the short lifts its column and thereby the other rows, whose cells add to its row's readings.
        current += _between_rows(more.astype(np.float64), board.to_driver * most) @ most
        return current

    def _source_currents(self, shorts: _Shorts, fixed: FloatArray, conductance: FloatArray) -> FloatArray:
        """S (N, M): currents that the columns' sources drive into a reading by way of shorts."""
        board, more, offset = self._board, shorts.where, self._offset
        # The source of its column drives a current through a short, in all steps alike ...
        with np.errstate(invalid="ignore"):
            by_source = offset * shorts.conductance.sum(axis=0)
        by_source[np.isnan(by_source)] = 0.0  # no source, and no resistance
        # ... as the difference of two columns' sources does where shorts join these columns.
        by_source += currents_between_sources(board, more)
        # The other columns' sources drive currents through the cells of the short's row. These may conduct more than
        # they seem to.
        misjudged = conductance * (1.0 + np.minimum(fixed, BOUNDLESS))
        by_source += offset * (more.any(axis=1) @ misjudged)
        # The source of the short's column lifts that row, whose cells feed the other columns.
        by_source += (more * offset).max(axis=1) @ misjudged
        return np.broadcast_to(by_source, more.shape)


def _between_rows(fed: FloatArray, taken: FloatArray) -> FloatArray:
    """Sum over the columns (N, N) of what one row feeds and another takes; 0 between a row and itself."""
    between: FloatArray = fed @ taken.T
    between.reshape(-1)[:: len(between) + 1] = 0.0
    return between


class _AtHigh(NamedTuple):
    """Cells at the high end of the range. Arrays are (N, M)."""

    conductance: FloatArray
    """S of all cells"""
    more: BoolArray
    """where cells conduct more than their readings say"""
    saturated: BoolArray
    """those of ``more`` whose amplifier, not only the converter, is at a limit"""
    floor: float
    """S, least conductance that a relative change refers to"""


class _Shorts(NamedTuple):
    """Cells that may be shorts. Arrays are (N, M), 0 at all other cells unless stated."""

    where: BoolArray
    along: FloatArray
    """relative change of the row's other cells, as each short takes the row's drive"""
    down: FloatArray
    """relative change of the column's other cells, as each short takes their currents"""
    conductance: FloatArray
    """S of each short in series with its lines; inf on lines without resistance"""
    share: FloatArray
    """share of a current into the row that a short takes, if the current does not go to the row's driver"""
    cells: FloatArray
    """S of all cells, as they seem to be"""
    ordinary: FloatArray
    """S of all other cells, 0 at shorts"""
    most: FloatArray
    """S of all cells, with shorts in series with their lines, at most a large number"""


class _EveryShort:
    """Effect of a short at each place of one board, from which frames select the actual shorts."""

    def __init__(self, board: AmplifiedBoard) -> None:
        driver, amplifier = board.to_driver, board.to_amplifier
        with np.errstate(divide="ignore", invalid="ignore"):
            conductance = 1.0 / (driver + amplifier)
            self.along = read_only(np.nan_to_num(driver / amplifier, nan=0.0, posinf=inf))
            self.down = read_only(np.nan_to_num(amplifier / driver, nan=0.0, posinf=inf))
            self.share = read_only(np.minimum(np.nan_to_num(driver * conductance, nan=1.0), 1.0))
        self.conductance, self.most = read_only(conductance), np.minimum(conductance, BOUNDLESS)

    def at(self, where: BoolArray, conductance: FloatArray) -> _Shorts:
        """The shorts at these places (N, M) among cells (N, M) in S."""
        return _Shorts(
            where,
            along=np.where(where, self.along, 0.0),
            down=np.where(where, self.down, 0.0),
            conductance=np.where(where, self.conductance, 0.0),
            share=np.where(where, self.share, 0.0),
            cells=conductance,
            ordinary=np.where(where, 0.0, conductance),
            most=np.where(where, self.most, conductance),
        )


class _Disturbance(NamedTuple):
    """Effect of cells at limits on the others. Arrays are (N, M)."""

    limited: BoolArray
    more: BoolArray
    """at the high end: the cell conducts more than the reading says"""
    conductance: FloatArray
    """S, cells for which the effect was computed"""
    floor: float
    """S, least conductance that a relative change refers to"""
    fixed: FloatArray
    """relative change that does not depend on the conductances"""
    added: FloatArray
    """S, current of other cells that may appear in a reading, per volt"""
    by_lines: FloatArray
    """relative change because the load of the lines changes"""

    def holds(self, conductance: FloatArray, limited: BoolArray, more: BoolArray) -> bool:
        """Whether the same cells are at the same limits and the other cells have changed little."""
        if not (np.array_equal(limited, self.limited) and np.array_equal(more, self.more)):
            return False
        return similar(np.where(limited, self.conductance, conductance), self.conductance)

    def relative_change(self, conductance: FloatArray) -> FloatArray:
        """Relative change of cells (N, M) in S that are similar to those for which the effect was computed."""
        return self.fixed + SIMILAR_MARGIN * (self.added / np.maximum(conductance, self.floor) + self.by_lines)
