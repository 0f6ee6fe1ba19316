"""Usual frames of boards with floating or pulled rows, from volts to a :class:`Measurement` in one kernel.

A step of :mod:`._live_fit` is a product of a kept matrix and the residuals (chord method). Usual are frames in which no
reading states a bound only, and one or two such steps lead to cells whose remaining error, by the next step, is a
fraction of their uncertainty. :class:`._live_fit.FitLive` takes all other frames and makes the matrix.

The model is that of a grid with ideal lines behind leads. Rows are eliminated in closed form, and the columns' nodal
matrix is inverted once: with A = 1/a the inverse of the rows' sums and Z that of the columns, T = A G Z is the transfer
from columns to rows, and z = A + A diag(T G') the rows' own. A selected row and a read column change one branch each,
which are updates of rank one (Sherman and Morrison 1950).
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...common.compiled import Blocks, FixedRow, FlagRows, Reasons, Records, Row, Rows, is_aside, loop
from ...common.measurement import GREATEST, LEAST, Measurement
from ...common.noise import constant_part
from .._board import Board
from ..readouts import columns_impedance
from ._live_reading import DISTURBED, HIDDEN, NO_CURRENT, SATURATED, UNCERTAIN, Readings
from ._measured import Constants, state_one
from ._tuning import (
    BY_NOISE,
    BY_STEPS,
    FAR,
    FAR_BELOW,
    FAR_ERRORS,
    FIRST_HALF,
    HELD,
    LARGE,
    LEAST_BELOW,
    LEAST_CELL,
    LEAST_FAR,
    MOST_BELOW,
    NEARER,
    NO_FIT,
    SETTLED,
    SHORT_SHARE,
    SIGMAS,
    USUAL_STEPS,
)

IDLE, ROW_LEAD = range(2)
"""places of what is given for each row: S of its pull-down, and ohm of the lead before it; likewise of columns"""
END, COLUMN_IDLE, SOURCE, OUTPUT, PER_AMPERE, GAIN, SPAN, REST = range(8)
CELLS, MODEL, MADE_AT, BEHIND, BEYOND, SHORT, HIGHEST, MOST_READ, WIDE = range(9)
"""of cells: S and the model's volts there, shares at which the matrix was made, ohm of the lines that each sees,
changes of shares by what derivatives leave out, V of a short, S of the largest cell, V that no cells give, and V from
which on the structure of lines says no more
"""


@loop
def fitted_volts(
    conductance: Rows,
    of_rows: Rows,
    of_columns: Rows,
    drive: float,
    alone: bool,
    grid: Blocks,
    square: Blocks,
    ends: Row,
    sums: Row,
    volts: Rows,
) -> bool:
    """Write the outputs (N, M) in V of cells (N, M) in S; False if parts of the grid have no connection.

    Args:
        conductance: of the cells.
        of_rows: (2, N) and ``of_columns`` (8, M): what is given, by the places above.
        drive: V.
        alone: whether columns are read one by one.
        grid: (2, N, M), changed, as ``square`` (2, M, M), ``ends`` (M,) and ``sums`` (N,).
        volts: written.
    """
    rows, columns = conductance.shape
    held = 0.0
    driven, to_ends, across, impedance = grid[0], grid[1], square[0], square[1]
    across[:] = 0.0
    for i in range(rows):
        held += of_rows[IDLE, i]
        total = of_rows[IDLE, i]
        for j in range(columns):
            total += conductance[i, j]
        if not total > 0.0:
            return False
        sums[i] = total
        for j in range(columns):
            share = conductance[i, j] / total
            to_ends[i, j] = share * of_rows[IDLE, i]
            for k in range(columns):
                across[k, j] += share * conductance[i, k]
    for j in range(columns):
        across[j, j] = 0.0
        ends[j] = of_columns[COLUMN_IDLE, j] if alone else 1.0 / of_columns[END, j]
        held += ends[j]
    adrift = held == 0.0  # the selected row and the read column alone hold the array: any node may be ground
    if adrift:
        ends[0] = conductance[0, 0]
    if not columns_impedance(to_ends, across, ends, impedance):
        return False
    for i in range(rows):
        own_row = 1.0
        for j in range(columns):
            transfer = 0.0
            for k in range(columns):
                transfer += conductance[i, k] * impedance[k, j]
            driven[i, j] = transfer / sums[i]
            own_row += driven[i, j] * conductance[i, j]
        own_row /= sums[i]
        lead = of_rows[ROW_LEAD, i]
        loaded = 1.0 / (lead + own_row)
        for j in range(columns):
            transfer, source, end = driven[i, j], of_columns[SOURCE, j], of_columns[END, j]
            if adrift:
                current = (drive - source) / (lead + own_row + impedance[j, j] - 2.0 * transfer + end)
            elif alone:
                own = impedance[j, j] - transfer * transfer * loaded
                behind = 1.0 - own * of_columns[COLUMN_IDLE, j]
                current = (drive * transfer * loaded - source * behind) / (own + end * behind)
            else:
                current = drive * transfer * loaded / end
            volts[i, j] = of_columns[OUTPUT, j] + of_columns[PER_AMPERE, j] * current
    return True


@loop
def share_of(conductance: float, behind: float) -> float:
    """The share of a cell."""
    tie = conductance * behind
    return tie / (1.0 + tie)


@loop
def moved(conductance: float, step: float, behind: float, std: float, most: float) -> float:
    """S of a cell whose share changes by a ``step``, as far as it leads neither to a short nor far below nothing.

    A share of nothing is read with the standard deviation ``std``.
    """
    share = share_of(conductance, behind)
    greatest = FIRST_HALF if share <= 0.5 else share + NEARER * (1.0 - share)
    share = min(max(share + step, -min(max(FAR_BELOW * std, LEAST_BELOW), MOST_BELOW)), greatest)
    there = min(share / ((1.0 - share) * behind), most)
    return there if abs(there) > LEAST_CELL else LEAST_CELL


@loop
def hold_lines(conductance: Rows) -> None:
    """Raise cells (N, M) below nothing on lines whose cells together hardly conduct: such a line has no potential."""
    rows, columns = conductance.shape
    for i in range(rows):
        total, size = 0.0, 0.0
        for j in range(columns):
            total, size = total + conductance[i, j], size + abs(conductance[i, j])
        if total < HELD * size:
            for j in range(columns):
                conductance[i, j] = max(conductance[i, j], LEAST_CELL)
    for j in range(columns):
        total, size = 0.0, 0.0
        for i in range(rows):
            total, size = total + conductance[i, j], size + abs(conductance[i, j])
        if total < HELD * size:
            for i in range(rows):
                conductance[i, j] = max(conductance[i, j], LEAST_CELL)


@loop
def change_of(conductance: float, made_at: float, behind: float, std: float) -> float:
    """Change of a share since derivatives were made, over the largest one for which they serve."""
    share = share_of(conductance, behind)
    return abs(share - made_at) / max(max(FAR * made_at, LEAST_FAR) * (1.0 - made_at), FAR_ERRORS * std)


@loop
def shares_of(conductance: FixedRow, behind: FixedRow, shares: Row) -> None:
    """Write the shares of cells (n,)."""
    for place in range(len(shares)):
        shares[place] = share_of(conductance[place], behind[place])


@loop
def moved_by(
    conductance: FixedRow, steps: FixedRow, behind: FixedRow, std: FixedRow, most: FixedRow, there: Row
) -> None:
    """Write :func:`moved` of each cell (n,)."""
    for place in range(len(there)):
        there[place] = moved(conductance[place], steps[place], behind[place], std[place], most[place])


@loop
def changes_of(conductance: FixedRow, made_at: FixedRow, behind: FixedRow, std: FixedRow, by: Row) -> None:
    """Write :func:`change_of` of each cell (n,)."""
    for place in range(len(by)):
        by[place] = change_of(conductance[place], made_at[place], behind[place], std[place])


@loop
def measure_fitted(
    volts: Rows,
    solver: Rows,
    spread: FixedRow,
    of_rows: Rows,
    of_columns: Rows,
    of_cells: Blocks,
    drive: float,
    level: float,
    converter: float,
    boards: Records[Constants],
    begun: bool,
    nowhere: FlagRows,
    surely: float,
    usual: float,
    noise: Rows,
    grid: Blocks,
    square: Blocks,
    ends: Row,
    sums: Row,
    cells: Rows,
    model: Rows,
    step: Row,
    block: Blocks,
    reason: Reasons,
) -> bool:
    """Measure a frame (N, M) in line coordinates; False if it is not a usual one.

    Args:
        volts: readings.
        solver: (N M, N M) 1/V, changes by each reading of all shares.
        spread: (N M,) standard deviations of the shares.
        of_rows: and ``of_columns`` as of :func:`fitted_volts`; ``of_cells`` (9, N, M) by the places above, of which
            those of the last frame are changed.
        drive: V; ``level`` of the reference.
        converter: V, standard deviation of a reading by the converter's steps.
        boards: the constants.
        begun: whether the model's volts of the last frame are known.
        nowhere: no cells.
        surely: V, noise of the readings that is rarely exceeded; ``usual`` best guess, ``noise`` of each one.
        grid: changed, as ``square``, ``ends``, ``sums``, ``cells``, ``model`` and ``step``.
        block: written, as ``reason``: in the array's coordinates.
    """
    board, rows, columns = boards[0], volts.shape[0], volts.shape[1]
    alone, work = board.one_by_one > 0.0, (grid, square, ends, sums)
    if not begun and not fitted_volts(of_cells[CELLS], of_rows, of_columns, drive, alone, *work, of_cells[MODEL]):
        return False
    coarser, count, error = math.hypot(1.0, surely / converter), rows * columns, board.half + SIGMAS * surely
    for i in range(rows):
        for j in range(columns):
            signal = abs(volts[i, j] - level)
            if signal > of_cells[MOST_READ, i, j] + error or signal >= of_cells[WIDE, i, j]:
                return False
            cells[i, j], model[i, j] = of_cells[CELLS, i, j], of_cells[MODEL, i, j]
    behind, highest = of_cells[BEHIND], of_cells[HIGHEST]
    settled = False
    squares, most = 0.0, 0.0
    for number in range(USUAL_STEPS + 1):
        squares, most, settled = 0.0, 0.0, True
        step[:] = 0.0
        for i in range(rows):
            for j in range(columns):
                apart, place = volts[i, j] - model[i, j], i * columns + j
                squares += apart * apart
                most = max(most, abs(apart))
                for other in range(count):
                    step[other] += solver[place, other] * apart
        for place in range(count):
            if abs(step[place]) > min(SETTLED * spread[place], LARGE):
                settled = False
        if settled and number > 0:
            break
        if number == USUAL_STEPS:
            return False
        for i in range(rows):
            for j in range(columns):
                place = i * columns + j
                cells[i, j] = moved(cells[i, j], step[place], behind[i, j], spread[place], highest[i, j])
        hold_lines(cells)
        if not fitted_volts(cells, of_rows, of_columns, drive, alone, *work, model):
            return False
    misfit = max(math.sqrt(squares / count), 0.5 * most) / board.half / coarser
    if not misfit <= NO_FIT:
        return False
    std, per_volt = grid[0], grid[1]
    for i in range(rows):
        for j in range(columns):
            std[i, j] = spread[i * columns + j]
            if not change_of(cells[i, j], of_cells[MADE_AT, i, j], behind[i, j], std[i, j]) <= 1.0:
                return False
    for i in range(rows):
        for j in range(columns):
            of_cells[CELLS, i, j], of_cells[MODEL, i, j] = cells[i, j], model[i, j]
            above = volts[i, j] - level - of_columns[REST, j]
            slope = above * (1.0 - above / of_columns[GAIN, j] * of_columns[SPAN, j])
            per_volt[i, j] = abs(1.0 / slope) if slope != 0.0 else math.inf
            cells[i, j] = moved(cells[i, j], step[i * columns + j], behind[i, j], std[i, j], highest[i, j])
    found = cells, of_cells[MADE_AT], behind, std, of_cells[BEYOND], per_volt, misfit
    flags = nowhere, nowhere, nowhere
    state_fitted(volts, level, *found, of_cells[SHORT], *flags, converter, boards, surely, usual, noise, block, reason)
    return True


@loop
def state_fitted(
    volts: Rows,
    level: float,
    conductance: Rows,
    made_at: Rows,
    behind: Rows,
    std: Rows,
    more: Rows,
    per_volt: Rows,
    misfit: float,
    shorts: Rows,
    unread: FlagRows,
    under_range: FlagRows,
    gone: FlagRows,
    converter: float,
    boards: Records[Constants],
    surely: float,
    usual: float,
    noise: Rows,
    block: Blocks,
    reason: Reasons,
) -> None:
    """Write what is known of all cells (N, M) that give the readings.

    Args:
        volts: readings; ``level`` of the reference.
        conductance: S.
        made_at: shares at which derivatives were made; ``behind`` ohm that each cell sees of its lines.
        std: standard deviation of the share, by errors of ``coarser`` readings.
        more: change of the share by what derivatives leave out.
        per_volt: 1/V, of each cell by its own reading if it were alone.
        misfit: half steps and noise that the readings are off.
        shorts: V, reading of a short of each cell.
        unread: cells whose readings state bounds only; ``under_range`` upper ones.
        gone: cells that a fault hides.
        converter: V, standard deviation of a reading by the converter's steps.
        boards: the constants.
        surely: V, noise of the readings that is rarely exceeded; ``usual`` best guess, ``noise`` of each one.
        block: written, as ``reason``: in the array's coordinates.
    """
    board, rows, columns = boards[0], volts.shape[0], volts.shape[1]
    coarser, error = math.hypot(1.0, surely / converter), board.half + SIGMAS * surely
    half_step = 0.5 * board.step * constant_part(usual / board.step)
    sigmas = math.hypot(BY_STEPS, BY_NOISE * surely / converter) / coarser * max(misfit, 1.0)
    disturbs = False
    for i in range(rows):
        for j in range(columns):
            disturbs = disturbs or unread[i, j] or abs(volts[i, j] - level) >= SHORT_SHARE * shorts[i, j]
    for i in range(rows):
        for j in range(columns):
            signal, own = abs(volts[i, j] - level), 1.0
            if per_volt[i, j] < math.inf:
                own = error * per_volt[i, j]
            tie = conductance[i, j] * behind[i, j]
            share = tie / (1.0 + tie)
            moved_on = 1.0 + abs(share - made_at[i, j]) / max(made_at[i, j] * (1.0 - made_at[i, j]), LEAST_FAR)
            off = sigmas * moved_on * std[i, j] + more[i, j]
            stated, relative = math.inf, math.inf
            if share > 0.0:
                relative = moved_on * std[i, j] / (share * (1.0 - share))
                if share + off < 1.0:
                    stated = max(own, off / (share * (1.0 - share - off)))
            why = DISTURBED if disturbs and own < board.accuracy else UNCERTAIN
            if signal <= error:
                why = NO_CURRENT
            elif stated <= board.accuracy and not unread[i, j]:
                why = 0
            elif unread[i, j] or signal >= SHORT_SHARE * shorts[i, j]:
                why = SATURATED
            if under_range[i, j] and why != 0:
                why = NO_CURRENT
            if gone[i, j]:
                why = HIDDEN
            row, column = (columns - 1 - j, rows - 1 - i) if board.transposed > 0.0 else (i, j)
            reason[row, column] = why
            stated = stated if why in (0, UNCERTAIN) else math.inf
            every = max(relative / (coarser * converter), per_volt[i, j])
            values = conductance[i, j], stated, per_volt[i, j], 0.0, every, noise[row, column]
            block[LEAST, row, column], block[GREATEST, row, column] = 0.0, math.inf
            state_one(block, reason, row, column, *values, usual, half_step, rows, board)


class Fit(Protocol):
    """What :class:`._live_fit.FitLive` keeps from frame to frame."""

    def bounds(self) -> tuple[FloatArray, ...]:
        """V of a short at each cell, S of the largest cell, V that no cells give, and V beyond usual ones; (N, M)."""
        ...

    def unread(self, frame: Readings) -> BoolArray:
        """Cells (N, M) of a frame in line coordinates whose readings state bounds only."""
        ...

    def kept(self, noise: float) -> tuple[FloatArray, ...] | None:
        """What a stream goes on with, for V of noise; None where the last frame left nothing.

        S (n,) of the cells of the last frame; shares (n,) at which the derivatives were made, and ohm (n,) of the lines
        that each cell sees there; the regularised inverse of the derivatives (readings, shares) in 1/V; the standard
        deviations (n,) of the shares, and their changes (n,) by what derivatives leave out.
        """
        ...

    def follow(self, conductance: FloatArray) -> FloatArray:
        """Go on from cells (n,) in S of a usual frame, which are returned."""
        ...


class UsualFits:
    """Measures the usual frames of one board, beginning where the last frame left off."""

    def __init__(self, board: Board, fit: Fit, constants: Records[Constants], converter: float) -> None:
        """For a board that :meth:`serves`; ``converter``: V, standard error of a reading by its steps."""
        rows, columns = self._shape = board.shape
        ends, alone = board.circuit.read_ends(board), board.circuit.alone(board)
        assert ends is not None
        self._fit, self._turn, self._constants = fit, board.transpose, constants
        self._of_rows, self._of_columns = np.empty((2, rows)), np.empty((8, columns))
        self._of_rows[IDLE], self._of_rows[ROW_LEAD] = 1.0 / board.pull, board.row_ohms[:, 0]
        with np.errstate(divide="ignore"):
            idle = 1.0 / (board.idle_resistance + board.column_lead)
        for place, given in zip(
            self._of_columns,
            (ends.resistance + board.column_lead, idle, ends.source, ends.output, ends.slope, *alone),
            strict=True,
        ):
            place[:] = given
        self._numbers = board.drive, board.level, converter
        self._of_cells = np.empty((9, rows, columns))
        self._of_cells[SHORT:] = fit.bounds()
        self._nowhere = np.zeros(board.shape, dtype=np.bool_)
        lines = np.empty((2, rows, columns)), np.empty((2, columns, columns)), np.empty(columns), np.empty(rows)
        self._work = *lines, np.empty((rows, columns)), np.empty((rows, columns)), np.empty(rows * columns)
        self._solver, self._spread = np.empty((0, 0)), np.empty(0)
        self._cells: FloatArray | None = None

    @staticmethod
    def serves(board: Board) -> bool:
        """Whether the kernel's model is that of the board: sound, ideal lines, linear ends read at once or in turns."""
        if board.line_ends is not None:
            return False
        ends = board.circuit.read_ends(board)
        if ends is None or not board.plain or board.faults or not board.floating:
            return False
        behind = ends.resistance + board.column_lead
        if board.circuit.columns_one_by_one(board):
            idle = board.idle_resistance + board.column_lead
            fits = board.shared_by >= board.shape[1] and not board.idle_source.any() and bool(idle.all())
        else:
            fits = bool(behind.all()) and not ends.source.any()
        ideal = not (board.row_ohms[:, 1:].any() or board.column_ohms[1:].any())
        if board.pulled:
            ideal = ideal and bool((board.row_lead == board.row_ohms[:, 0]).all())
        return fits and ideal and bool(np.isfinite(behind).all() and np.isfinite(board.row_ohms).all())

    def volts(self, cells: FloatArray) -> FloatArray:
        """Outputs (N, M) in V of cells in ohm, in line coordinates, by the kernel's model."""
        conductance, volts = np.ascontiguousarray(1.0 / cells), np.empty(self._shape)
        alone = bool(self._constants["one_by_one"][0])
        given = self._of_rows, self._of_columns, self._numbers[0], alone
        if not fitted_volts(conductance, *given, *self._work[:4], volts):
            raise np.linalg.LinAlgError("parts of the grid have no connection")
        return volts

    def __call__(self, frame: Readings) -> Measurement | None:
        """As :attr:`.LiveRecovery.usual`."""
        kept = None if is_aside() else self._fit.kept(frame.noise)  # arrays are quicker than a kernel in plain Python
        if kept is None:
            return None
        some = frame.limited is not None or frame.under_range is not None
        if some or self._constants["transposed"][0]:
            frame = frame.in_lines(self._turn)
        if some and self._fit.unread(frame).any():
            return None
        conductance, made_at, behind, solver, spread, beyond = kept
        begun = conductance is self._cells
        if not begun:
            self._of_cells[CELLS] = conductance.reshape(self._shape)
        if solver is not self._solver:
            self._of_cells[MADE_AT], self._of_cells[BEHIND] = made_at.reshape(self._shape), behind.reshape(self._shape)
            self._solver = solver
        if spread is not self._spread:
            self._spread, self._of_cells[BEYOND] = spread, beyond.reshape(self._shape)
        measured = Measurement.unknown(frame.each.shape)
        given = solver, spread, self._of_rows, self._of_columns, self._of_cells, *self._numbers, self._constants
        done = measure_fitted.unchecked(
            *(frame.volts, *given, begun, self._nowhere, frame.noise, frame.usual, frame.each),
            *(*self._work, measured.block, measured.reason),
        )
        if not done:
            self._cells = None
            return None
        self._cells = self._fit.follow(self._of_cells[CELLS].reshape(-1))
        return measured
