"""Compiled loops for the usual frame behind amplifiers: outputs to cells in one pass, with the extra ``fast``.

A frame is usual if no reading is at a limit, the base and the levels of the last frame still hold, and every cell is
valid. For such a frame the loops compute the same as :mod:`._amplified` by array operations. A loop that finds the
frame unusual changes nothing, and the array operations begin anew.

Sums over cells have another order than in array operations, so results differ by a relative 1e-15 or so.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, NamedTuple

import numpy as np

from ...common.arrays import AnyArray, FloatArray
from ...common.compiled import Row, Rows, loop
from ._amplified_base import SECOND_ORDER, Base, lost_along_lines
from ._amplified_board import FAR, LEAST_SHARE, AmplifiedBoard
from ._amplified_errors import SIMILAR_GAINS, Levels

_Blocks = Annotated[AnyArray, "float64[:, :, ::1]"]
UsualFrame = tuple[FloatArray, Callable[[], tuple[FloatArray, FloatArray]]]
"""resistances (N, M) in ohm, and a function for the relative uncertainties and their parts by a cell's own reading"""
_SCALE, _CONSTANT, _PER_SUM, _FARTHEST_DRIVER, _RESISTANCE = range(5)  # rows of the board's constants
_GAIN, _SHIFT, _CONDUCTANCE = range(3)  # blocks of a base
_BETWEEN, _SUM, _MODEL_ERROR = range(3)  # rows of a base's columns
_LEAST, _OWN, _BY_LEADS, _OTHERS = range(4)  # blocks of levels


class UsualFrames:
    """The loops for one board, with its bases in the form that they take."""

    def __init__(self, board: AmplifiedBoard) -> None:
        """For one board, before its first frame."""
        self._board = board
        self._about_base = _about_base.machine_code(unchecked=True)
        self._independent = _independent_columns.machine_code(unchecked=True)
        self._uncertainties = _uncertainties.machine_code(unchecked=True)
        self.compiled = None not in (self._about_base, self._independent, self._uncertainties)
        """whether there is machine code"""
        constants = (board.scale, board.constant, board.per_sum, board.farthest_driver, board.to_amplifier[0])
        # Own copies, since a loop takes twice as long to unpack write-protected arrays.
        self._constants = np.array([np.broadcast_to(values, board.board.shape[1:]) for values in constants])
        self._farthest_amplifier = np.array(board.farthest_amplifier)
        self._row_ohms = np.array(np.broadcast_to(board.board.row_ohms, board.board.shape), order="C")
        self._behind = np.array(board.behind, order="C")
        self._change_and_lost, self._sums = np.empty((2, *board.board.shape)), np.empty((2, board.board.shape[1]))
        """(2, N, M) and (2, M) for intermediate results"""
        self._base: Base | None = None
        self._of_base = _OfBase.none()
        self._levels: Levels | None = None
        self._of_levels = _OfLevels.none()

    def about(self, base: Base, levels: Levels, volts: FloatArray) -> UsualFrame | None:
        """The frame, or None if it is not usual.

        Args:
            base: a base whose own error is below the tolerance, on lines that are not heavy.
            levels: of that base.
            volts: (N, M) V, outputs, contiguous.

        """
        if self._base is not base:
            self._base, self._of_base = base, _OfBase.of(base, self._board)
        of_levels = self._of(levels)
        transfer, resistance = np.empty(volts.shape), np.empty(volts.shape)
        of_base, board = self._of_base, self._board
        assert self._about_base is not None
        usual = self._about_base(
            volts,
            self._constants,
            self._farthest_amplifier,
            self._row_ohms,
            self._behind,
            of_base.blocks,
            of_base.columns,
            of_levels.blocks,
            board.has_sources,
            board.source_spread,
            board.least_tolerance,
            base.loss,
            of_base.missing_per_moved,
            self._change_and_lost,
            self._sums,
            transfer,
            resistance,
        )
        return (resistance, partial(self._uncertain, of_levels, transfer)) if usual else None

    def independent(self, levels: Levels, volts: FloatArray) -> UsualFrame | None:
        """As :meth:`about`, if only the columns' ends have resistance and gains are known in closed form."""
        of_levels = self._of(levels)
        transfer, resistance = np.empty(volts.shape), np.empty(volts.shape)
        assert self._independent is not None
        usual = self._independent(
            volts,
            self._constants,
            of_levels.gain,
            of_levels.blocks,
            self._board.has_sources,
            self._sums,
            transfer,
            resistance,
        )
        return (resistance, partial(self._uncertain, of_levels, transfer)) if usual else None

    def _uncertain(self, levels: _OfLevels, transfer: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Relative uncertainties (N, M) and the part by a cell's own reading: :meth:`.Levels.uncertainties`."""
        uncertainty, own = np.empty(transfer.shape), np.empty(transfer.shape)
        assert self._uncertainties is not None
        self._uncertainties(transfer, levels.blocks, uncertainty, own)
        return uncertainty, own

    def _of(self, levels: Levels) -> _OfLevels:
        if self._levels is not levels:
            self._levels, self._of_levels = levels, _OfLevels.of(levels, self._board.board.shape)
        return self._of_levels


class _OfBase(NamedTuple):
    """A base in the form that the loop takes."""

    blocks: AnyArray
    """(3, N, M) gain, shift in S, conductance in S"""
    columns: AnyArray
    """(3, M) S that currents between columns add to each T of a column, sum of the conductances, error of T"""
    missing_per_moved: float
    """S, change of other cells' current per relative change of the gains"""

    @classmethod
    def none(cls) -> _OfBase:
        return cls(np.zeros((3, 0, 0)), np.zeros((3, 0)), 0.0)

    @classmethod
    def of(cls, base: Base, board: AmplifiedBoard) -> _OfBase:
        none = np.zeros(board.board.shape)
        shift = none if base.shift is None else base.shift
        between = none[0] if base.between is None else base.between
        blocks = np.array([base.gain, shift, base.conductance])
        columns = np.array([between, base.conductance.sum(axis=0), base.model_error])
        return cls(blocks, columns, base.missing_per_moved)


class _OfLevels(NamedTuple):
    """Levels in the form that the loops take."""

    gain: FloatArray
    """gain, in its own shape"""
    blocks: AnyArray
    """(4, N, M) S, least transfer conductance of a valid cell; and the three parts of its uncertainty"""

    @classmethod
    def none(cls) -> _OfLevels:
        return cls(np.zeros(0), np.zeros((4, 0, 0)))

    @classmethod
    def of(cls, levels: Levels, shape: tuple[int, int]) -> _OfLevels:
        blocks = np.empty((4, *shape))
        for block, field in zip(blocks, (levels.least, levels.own, levels.by_leads, levels.others), strict=True):
            block[...] = field
        return cls(np.array(levels.gain, order="C"), blocks)


@loop
def _transfer(volts: Rows, constants: Rows, between: Row, has_sources: bool, transfer: Rows) -> None:
    """Write the transfer conductances (N, M) in S: :meth:`.AmplifiedBoard.transfer`."""
    rows, columns = volts.shape
    scale, constant = constants[_SCALE], constants[_CONSTANT]
    for i in range(rows):
        for j in range(columns):
            transfer[i, j] = volts[i, j] * scale[j] + constant[j] - between[j]
    if has_sources:
        for j in range(columns):
            total = 0.0
            for i in range(rows):
                total += transfer[i, j]
            added = constants[_PER_SUM, j] * total
            for i in range(rows):
                transfer[i, j] += added
    for i in range(rows):
        for j in range(columns):
            transfer[i, j] = max(transfer[i, j], 0.0)


@loop
def _about_base(
    volts: Rows,
    constants: Rows,
    farthest_amplifier: Row,
    row_ohms: Rows,
    behind: Rows,
    base: _Blocks,
    base_columns: Rows,
    levels: _Blocks,
    has_sources: bool,
    source_spread: float,
    least_tolerance: float,
    loss: float,
    missing_per_moved: float,
    change_and_lost: _Blocks,
    sums: Rows,
    transfer: Rows,
    resistance: Rows,
) -> bool:
    """Write the cells' own transfer conductances and resistances (N, M), unless the frame is not usual.

    As :class:`.Relinearisation`, for a frame in which the coarsest bound of the certificate suffices.
    """
    rows, columns = volts.shape
    farthest_driver = constants[_FARTHEST_DRIVER]
    _transfer(volts, constants, base_columns[_BETWEEN], has_sources, transfer)
    conductance, change, lost = resistance, change_and_lost[0], change_and_lost[1]
    by_column = sums[0]
    by_column[:] = 0.0
    most_by_row = most_by_column = most_transfer = 0.0
    for i in range(rows):
        by_row = 0.0
        for j in range(columns):
            conductance[i, j] = max(base[_GAIN, i, j] * transfer[i, j] + base[_SHIFT, i, j], 0.0)
            change[i, j] = conductance[i, j] - base[_CONDUCTANCE, i, j]
            size = abs(change[i, j])
            by_row += size * farthest_driver[j]
            by_column[j] += size * farthest_amplifier[i]
            most_transfer = max(most_transfer, transfer[i, j])
        most_by_row = max(most_by_row, by_row)
    for j in range(columns):
        most_by_column = max(most_by_column, by_column[j])
    moved = most_by_row + most_by_column
    left_out = most_transfer * moved * (SECOND_ORDER * (loss + moved)) + moved * missing_per_moved
    if not (moved <= FAR and left_out <= least_tolerance):
        return False
    if source_spread > 0.0:
        for j in range(columns):
            changed = 0.0
            for i in range(rows):
                changed += abs(change[i, j])
            drift = source_spread * (loss * changed + moved * (base_columns[_SUM, j] + changed))
            if not drift <= base_columns[_MODEL_ERROR, j]:
                return False
    lost_along_lines(change, row_ohms, behind, sums, lost)
    for i in range(rows):
        for j in range(columns):
            transfer[i, j] = max(transfer[i, j] + base[_SHIFT, i, j] / base[_GAIN, i, j], 0.0)
            if not transfer[i, j] >= levels[_LEAST, i, j]:
                return False
            resistance[i, j] = 1.0 / (lost[i, j] * conductance[i, j] + conductance[i, j])
    return True


@loop
def _independent_columns(
    volts: Rows,
    constants: Rows,
    level_gain: Row,
    levels: _Blocks,
    has_sources: bool,
    sums: Rows,
    transfer: Rows,
    resistance: Rows,
) -> bool:
    """As :func:`_about_base`, by :meth:`.AmplifiedBoard.of_independent_columns`."""
    rows, columns = volts.shape
    between = sums[0]
    between[:] = 0.0
    _transfer(volts, constants, between, has_sources, transfer)
    for j in range(columns):
        total = 0.0
        for i in range(rows):
            total += transfer[i, j]
        gain = 1.0 / max(1.0 - constants[_RESISTANCE, j] * total, LEAST_SHARE)
        if not abs(gain - level_gain[j]) <= SIMILAR_GAINS * level_gain[j]:
            return False
        for i in range(rows):
            if not transfer[i, j] >= levels[_LEAST, i, j]:
                return False
            resistance[i, j] = 1.0 / (transfer[i, j] * gain)
    return True


@loop
def _uncertainties(transfer: Rows, levels: _Blocks, uncertainty: Rows, own_share: Rows) -> None:
    """Write relative uncertainties (N, M) and their parts by the cells' own readings: :meth:`.Levels.uncertainties`."""
    rows, columns = transfer.shape
    for i in range(rows):
        for j in range(columns):
            reading = max(transfer[i, j], levels[_OWN, i, j])
            own_share[i, j] = levels[_OWN, i, j] / reading
            uncertainty[i, j] = own_share[i, j] + levels[_BY_LEADS, i, j] / reading + levels[_OTHERS, i, j]
