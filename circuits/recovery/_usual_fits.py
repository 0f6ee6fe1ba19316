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
from ._law_kernels import BY_NOISE, BY_STEPS, LARGEST
from ._live_reading import DISTURBED, HIDDEN, NO_CURRENT, SATURATED, SIGMAS, UNCERTAIN, Readings
from ._measured import Constants, state_one

FAR = 0.5
"""change of a logarithm for which derivatives no longer serve"""
PER_ERROR = 4.0
"""of it, per standard deviation of the logarithm"""
NO_FIT = 1.5
"""half steps of readings from those of the cells: no fit yet. As many cells as readings fit closely, or it is another
minimum
"""
HARDLY_KNOWN = 0.15
"""standard deviation of a logarithm beyond which a step does not matter"""
PER_SHARE = 5.0
"""change of a logarithm that counts as one of the share by which a cell ties its lines to each other"""
SETTLED, SMALL = 0.3, 1e-6
"""standard deviations, and change of a logarithm: step that does not matter"""
STRIDE = 1.5
"""largest step of a logarithm"""
SHORT_SHARE = 0.98
"""of the reading of a short, from which on a cell may be one"""
STEPS = 3  # evaluations of the model in a frame

IDLE, ROW_LEAD = range(2)
"""places of what is given for each row: S of its pull-down, and ohm of the lead before it; likewise of columns"""
END, COLUMN_IDLE, SOURCE, OUTPUT, PER_AMPERE, GAIN, SPAN, REST = range(8)
LOG, MODEL, MADE_AT, BEHIND, SHORT, LOWEST, HIGHEST, MOST_READ, WIDE = range(9)
"""of cells: logarithms and the model's volts there, logarithms at which the matrix was made, and ohm of the lines that
each sees, V of a short, bounds, V that no cells give, and V from which on the structure of lines says no more
"""


@loop
def fitted_volts(
    log: Rows,
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
    """Write the outputs (N, M) in V of cells ``log`` (N, M) ln S; False if parts of the grid have no connection.

    Args:
        log: logarithms of the conductances.
        of_rows: (2, N) and ``of_columns`` (8, M): what is given, by the places above.
        drive: V.
        alone: whether columns are read one by one.
        grid: (3, N, M), changed, as ``square`` (2, M, M), ``ends`` (M,) and ``sums`` (N,).
        volts: written.
    """
    rows, columns = log.shape
    held = 0.0
    conductance, driven, to_ends, across, impedance = grid[0], grid[1], grid[2], square[0], square[1]
    across[:] = 0.0
    for i in range(rows):
        held += of_rows[IDLE, i]
        for j in range(columns):
            conductance[i, j] = math.exp(log[i, j])
    for i in range(rows):
        total = of_rows[IDLE, i]
        for j in range(columns):
            total += conductance[i, j]
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
def tying_share(log: float, behind: float) -> float:
    """G Z / (1 + G Z), by which a cell G changes the potentials of its lines; others see these by Z ``behind``, ohm."""
    return 1.0 / (1.0 + math.exp(-log) / behind)


@loop
def tied(log: float, other: float, behind: float) -> float:
    """By how much a cell ties its lines at an ``other`` logarithm: shares, in units of a change of a logarithm."""
    return PER_SHARE * abs(tying_share(log, behind) - tying_share(other, behind))


@loop
def distance(log: float, made_at: float, std: float, behind: float) -> float:
    """Change of a logarithm since derivatives were made, of which its own error counts only as it ties lines."""
    change = abs(log - made_at)
    return max(change / max(PER_ERROR / FAR * std, 1.0), min(change, tied(log, made_at, behind)))


@loop
def each_tied(logs: FixedRow, others: FixedRow, behind: FixedRow, by: Row) -> None:
    """Write :func:`tied` of each cell (n,)."""
    for place in range(len(logs)):
        by[place] = tied(logs[place], others[place], behind[place])


@loop
def each_distance(logs: FixedRow, made_at: FixedRow, std: FixedRow, behind: FixedRow, by: Row) -> None:
    """Write :func:`distance` of each cell (n,)."""
    for place in range(len(logs)):
        by[place] = distance(logs[place], made_at[place], std[place], behind[place])


@loop
def measure_fitted(
    volts: Rows,
    solver: Rows,
    spread: FixedRow,
    follow: Rows,
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
    log: Rows,
    model: Rows,
    step: Row,
    block: Blocks,
    reason: Reasons,
) -> bool:
    """Measure a frame (N, M) in line coordinates; False if it is not a usual one.

    Args:
        volts: readings.
        solver: (N M, N M) 1/V, changes by each reading of all logarithms.
        spread: (N M,) standard deviations of the logarithms.
        follow: like the solver, if hardly known cells may have any size; (0, 0): there are none.
        of_rows: and ``of_columns`` as of :func:`fitted_volts`; ``of_cells`` (9, N, M) by the places above, of which
            those of the last frame are changed.
        drive: V; ``level`` of the reference.
        converter: V, standard deviation of a reading by the converter's steps.
        boards: the constants.
        begun: whether the model's volts of the last frame are known.
        nowhere: no cells.
        surely: V, noise of the readings that is rarely exceeded; ``usual`` best guess, ``noise`` of each one.
        grid: changed, as ``square``, ``ends``, ``sums``, ``log``, ``model`` and ``step``.
        block: written, as ``reason``: in the array's coordinates.
    """
    board, rows, columns = boards[0], volts.shape[0], volts.shape[1]
    alone, work = board.one_by_one > 0.0, (grid, square, ends, sums)
    if not begun and not fitted_volts(of_cells[LOG], of_rows, of_columns, drive, alone, *work, of_cells[MODEL]):
        return False
    coarser, count, error = math.hypot(1.0, surely / converter), rows * columns, board.half + SIGMAS * surely
    for i in range(rows):
        for j in range(columns):
            signal = abs(volts[i, j] - level)
            if signal > of_cells[MOST_READ, i, j] + error or signal >= of_cells[WIDE, i, j]:
                return False
            log[i, j], model[i, j] = of_cells[LOG, i, j], of_cells[MODEL, i, j]
    settled = False
    squares, most = 0.0, 0.0
    for number in range(STEPS + 1):
        squares, most, settled = 0.0, 0.0, True
        step[:] = 0.0
        for i in range(rows):
            for j in range(columns):
                apart, place = volts[i, j] - model[i, j], i * columns + j
                squares += apart * apart
                most = max(most, abs(apart))
                for other in range(count):
                    step[other] += solver[place, other] * apart
        for i in range(rows):
            for j in range(columns):
                place = i * columns + j
                there = min(max(log[i, j] + step[place], of_cells[LOWEST, i, j]), of_cells[HIGHEST, i, j])
                if abs(there - log[i, j]) > max(SETTLED * spread[place], SMALL) and (
                    spread[place] <= HARDLY_KNOWN or tied(log[i, j], there, of_cells[BEHIND, i, j]) > FAR
                ):
                    settled = False
        if settled and number > 0:
            break
        if number == STEPS:
            return False
        for i in range(rows):
            for j in range(columns):
                change = min(max(step[i * columns + j], -STRIDE), STRIDE)
                log[i, j] = min(max(log[i, j] + change, of_cells[LOWEST, i, j]), of_cells[HIGHEST, i, j])
        if not fitted_volts(log, of_rows, of_columns, drive, alone, *work, model):
            return False
    misfit = max(math.sqrt(squares / count), 0.5 * most) / board.half / coarser
    if not misfit <= NO_FIT:
        return False
    for i in range(rows):
        for j in range(columns):
            made_at, behind = of_cells[MADE_AT, i, j], of_cells[BEHIND, i, j]
            if not distance(log[i, j], made_at, spread[i * columns + j], behind) <= FAR:
                return False
    conductance, std, per_volt, more = log, grid[0], grid[1], grid[2]
    for i in range(rows):
        for j in range(columns):
            place, left = i * columns + j, 0.0
            of_cells[LOG, i, j], of_cells[MODEL, i, j] = log[i, j], model[i, j]
            if len(follow):  # what hardly known cells have left to go belongs to the others
                for one in range(rows):
                    for other in range(columns):
                        left += follow[one * columns + other, place] * (volts[one, other] - model[one, other])
            more[i, j] = math.expm1(min(abs(left), LARGEST))
            std[i, j] = spread[place] * math.exp(min(abs(log[i, j] - of_cells[MADE_AT, i, j]), 1.0))
            above = volts[i, j] - level - of_columns[REST, j]
            slope = above * (1.0 - above / of_columns[GAIN, j] * of_columns[SPAN, j])
            per_volt[i, j] = abs(1.0 / slope) if slope != 0.0 else math.inf
            conductance[i, j] = math.exp(log[i, j] + step[place])
    found = conductance, std, per_volt, more, misfit
    flags = nowhere, nowhere, nowhere
    state_fitted(volts, level, *found, of_cells[SHORT], *flags, converter, boards, surely, usual, noise, block, reason)
    return True


@loop
def state_fitted(
    volts: Rows,
    level: float,
    conductance: Rows,
    std: Rows,
    per_volt: Rows,
    more: Rows,
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
        std: standard deviation of its logarithm, by errors of ``coarser`` readings.
        per_volt: 1/V, of each cell by its own reading if it were alone.
        more: relative uncertainty by what derivatives leave out.
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
            told = own + math.expm1(min(max(sigmas * std[i, j] - own, 0.0), LARGEST)) + more[i, j]
            why = DISTURBED if disturbs and own < board.accuracy else UNCERTAIN
            if signal <= error:
                why = NO_CURRENT
            elif told <= board.accuracy and not unread[i, j]:
                why = 0
            elif unread[i, j] or signal >= SHORT_SHARE * shorts[i, j]:
                why = SATURATED
            if under_range[i, j] and why != 0:
                why = NO_CURRENT
            if gone[i, j]:
                why = HIDDEN
            row, column = (columns - 1 - j, rows - 1 - i) if board.turned > 0.0 else (i, j)
            reason[row, column] = why
            told = told if why in (0, UNCERTAIN) else math.inf
            every = max(std[i, j] / (coarser * converter), per_volt[i, j])
            values = conductance[i, j], told, per_volt[i, j], 0.0, every, noise[row, column]
            block[LEAST, row, column], block[GREATEST, row, column] = 0.0, math.inf
            state_one(block, reason, row, column, *values, usual, half_step, rows, board)


class Fit(Protocol):
    """What :class:`._live_fit.FitLive` keeps from frame to frame; logarithms are those of the conductances in S."""

    def bounds(self) -> tuple[FloatArray, ...]:
        """V of a short at each cell, least and greatest logarithms, V that no cells give, and V beyond usual ones.

        (N, M) each.
        """
        ...

    def unread(self, frame: Readings) -> BoolArray:
        """Cells (N, M) of a frame in line coordinates whose readings state bounds only."""
        ...

    def kept(self, noise: float) -> tuple[FloatArray, ...] | None:
        """What a stream goes on with, for V of noise; None where the last frame left nothing.

        Logarithms (n,) of the last frame, and those at which the derivatives were made; ohm (n,) of the lines that each
        cell sees there; the regularised inverse of the derivatives (readings, logarithms) in 1/V; the standard
        deviations (n,) of the logarithms; and, where some are hardly known, the inverse by which these follow the
        readings, else an empty one.
        """
        ...

    def follow(self, log: FloatArray) -> FloatArray:
        """Go on from logarithms (n,) of a usual frame, which are returned."""
        ...


class UsualFits:
    """Measures the usual frames of one board, beginning where the last frame left off."""

    def __init__(self, board: Board, fit: Fit, constants: Records[Constants], converter: float) -> None:
        """For a board that :meth:`serves`; ``converter``: V, standard error of a reading by its steps."""
        rows, columns = self._shape = board.shape
        ends, alone = board.circuit.read_ends(board), board.circuit.alone(board)
        assert ends is not None
        self._fit, self._turn, self._constants = fit, board.turn, constants
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
        lines = np.empty((3, rows, columns)), np.empty((2, columns, columns)), np.empty(columns), np.empty(rows)
        self._work = *lines, np.empty((rows, columns)), np.empty((rows, columns)), np.empty(rows * columns)
        self._solver = np.empty((0, 0))
        self._log: FloatArray | None = None

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
        log, volts = np.ascontiguousarray(np.log(1.0 / cells)), np.empty(self._shape)
        alone = bool(self._constants["one_by_one"][0])
        given = self._of_rows, self._of_columns, self._numbers[0], alone
        if not fitted_volts(log, *given, *self._work[:4], volts):
            raise np.linalg.LinAlgError("parts of the grid have no connection")
        return volts

    def __call__(self, frame: Readings) -> Measurement | None:
        """As :attr:`.LiveRecovery.usual`."""
        kept = None if is_aside() else self._fit.kept(frame.noise)  # arrays are quicker than a kernel in plain Python
        if kept is None:
            return None
        some = frame.limited is not None or frame.under_range is not None
        if some or self._constants["turned"][0]:
            frame = frame.in_lines(self._turn)
        if some and self._fit.unread(frame).any():
            return None
        log, made_at, behind, solver, spread, follow = kept
        begun = log is self._log
        if not begun:
            self._of_cells[LOG] = log.reshape(self._shape)
        if solver is not self._solver:
            self._of_cells[MADE_AT], self._of_cells[BEHIND] = made_at.reshape(self._shape), behind.reshape(self._shape)
            self._solver = solver
        measured = Measurement.unknown(frame.each.shape)
        given = solver, spread, follow, self._of_rows, self._of_columns, self._of_cells, *self._numbers, self._constants
        done = measure_fitted.unchecked(
            *(frame.volts, *given, begun, self._nowhere, frame.noise, frame.usual, frame.each),
            *(*self._work, measured.block, measured.reason),
        )
        if not done:
            self._log = None
            return None
        self._log = self._fit.follow(self._of_cells[LOG].reshape(-1))
        return measured
