"""Usual frames of boards that state a port law, from volts to a :class:`Measurement` in one kernel.

Usual are frames in which no reading stands at a limit, errors move no other cell beyond the linear range, the factors
beyond the laws hold, and no cell reads like a short. The kernel calls those of :mod:`._law_kernels` in the order of
:class:`._live_law.LawLive`, which takes all other frames.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from ...common.arrays import FloatArray
from ...common.compiled import Blocks, FlagRows, Reasons, Records, Row, Rows, loop, zeros
from ...common.measurement import FIELDS, GREATEST, LEAST, Measurement
from ...common.noise import constant_part, select
from ._answers import MOST_WIRE
from ._factors import FRESH, OPEN, Factors
from ._law import Law
from ._law_errors import BY_NOISE, BY_STEPS
from ._law_kernels import columns_of, errors_of, move, relative_to, rows_of
from ._live_reading import NO_CURRENT, SIGMAS, UNCERTAIN
from ._measured import Constants, state_one

BEYOND = 3.0
"""errors by which a column may seem to leave less than nothing of its drive"""
ROOT_3 = math.sqrt(3.0)

SHORTS, SEGMENTS, BESIDE_END, WIRES, WHOLE_WIRES, RHO, BASE, FACTOR_BEYOND = range(8)
"""places of what is given for each cell; the first are those of :meth:`.Law.given`, likewise of columns and rows"""
LEAST_LEFT, BEHIND, BESIDE_LAW, COLUMN_SUMS, COUPLING = range(5)
LEAD, MOST, LEAST_ROW_LEFT, ROW_SUMS = range(4)


@loop
def measure_usual(
    volts: Rows,
    laws: Blocks,
    of_columns: Rows,
    of_rows: Rows,
    of_cells: Blocks,
    present: FlagRows,
    nowhere: FlagRows,
    matters: FlagRows,
    boards: Records[Constants],
    surely: float,
    usual: float,
    noise: Rows,
    work: Blocks,
    in_columns: Rows,
    in_rows: Rows,
    sums: Rows,
    block: Blocks,
    reason: Reasons,
) -> bool:
    """Measure a frame (N, M) in line coordinates; False if it is not a usual one.

    Args:
        volts: readings.
        laws: (3, 2, M) current, potential and drive of the port law.
        of_columns: (5, M); ``of_rows`` (4, N); ``of_cells`` (8, N, M): what is given, by the places above.
        present: cells that take part; ``nowhere``: none.
        matters: changed.
        boards: the constants.
        surely: V, noise of the readings that is rarely exceeded; ``usual`` best guess, ``noise`` of each one.
        work: changed, as ``in_columns``, ``in_rows`` and ``sums``.
        block: written, as ``reason``: in the array's coordinates.
    """
    board, rows, columns = boards[0], volts.shape[0], volts.shape[1]
    apart, share, drive, driven, by_law = work[0], work[1], work[2], work[3], work[4]
    left, total, row_left = in_columns[0], in_columns[1], in_rows[0]
    present_law = laws[0], laws[1], laws[2]
    columns_of(
        volts,
        *present_law,
        present,
        nowhere,
        of_cells[SHORTS],
        of_rows[MOST],
        of_columns[LEAST_LEFT],
        apart,
        share,
        drive,
        left,
        total,
        driven,
    )
    lines = of_rows[LEAD], of_cells[SEGMENTS], of_cells[BESIDE_END], of_rows[LEAST_ROW_LEFT]
    rows_of(driven, drive, *lines, board.floating > 0.0, row_left, by_law)
    middle = in_columns[2]
    for j in range(columns):
        middle[j] = math.nan
        if board.alike > 1.0 and 3.0 * rows > BY_STEPS * BY_STEPS and surely <= board.half:
            for i in range(rows):
                in_rows[1, i] = volts[i, j]
            middle[j] = select(in_rows[1], rows, rows // 2)
    error = board.half + SIGMAS * surely
    by_steps, by_noise = board.random * BY_STEPS / ROOT_3, BY_NOISE * surely
    random = math.hypot(by_steps, by_noise)
    of_driven, own_per_volt, beside, own, linear, std = work[5], work[6], work[7], work[8], work[9], work[10]
    of_left, column_open, of_sums, row_open = in_columns[3], in_columns[4], in_rows[1], in_rows[2]
    opens = errors_of(
        volts,
        middle,
        *present_law,
        of_rows[LEAD],
        present,
        nowhere,
        apart,
        share,
        drive,
        left,
        total,
        driven,
        row_left,
        error,
        random,
        by_steps,
        by_noise,
        board.random,
        board.shared,
        board.mixes > 0.0,
        board.has_leads > 0.0,
        board.alike > 1.0,
        board.one_by_one > 0.0,
        of_driven,
        own_per_volt,
        beside,
        own,
        linear,
        std,
        of_left,
        column_open,
        of_sums,
        row_open,
        sums,
    )
    if opens:
        return False
    for j in range(columns):
        if left[j] < -BEYOND * of_left[j] - of_columns[BESIDE_LAW, j]:
            return False
    cells, uncertainty = by_law, work[5]
    if board.factors > 0.0:
        cells = work[0]
        if not corrected(
            by_law,
            own,
            linear,
            column_open,
            row_open,
            of_columns,
            of_rows,
            of_cells,
            board,
            matters,
            work,
            in_columns[5],
            cells,
            uncertainty,
        ):
            return False
    else:
        relative_to(cells, by_law, own, linear, column_open, row_open, uncertainty)
    half_step = 0.5 * board.step * constant_part(usual / board.step)
    for i in range(rows):
        for j in range(columns):
            if not present[i, j] or cells[i, j] * of_cells[WIRES, i, j] > MOST_WIRE:
                return False
            valid = uncertainty[i, j] <= board.accuracy
            if not valid and cells[i, j] * of_cells[WHOLE_WIRES, i, j] > MOST_WIRE:
                return False
            row, column = (columns - 1 - j, rows - 1 - i) if board.turned > 0.0 else (i, j)
            told = uncertainty[i, j]
            reason[row, column] = 0 if valid else UNCERTAIN
            if own[i, j] >= 1.0 or not cells[i, j] > 0.0:
                reason[row, column], told = NO_CURRENT, math.inf
            values = max(cells[i, j], 0.0), told, abs(own_per_volt[i, j]), beside[i, j], std[i, j], noise[row, column]
            block[LEAST, row, column], block[GREATEST, row, column] = 0.0, math.inf
            state_one(block, reason, row, column, *values, usual, half_step, rows, board)
    return True


@loop
def corrected(
    by_law: Rows,
    own: Rows,
    linear: Rows,
    column_open: Row,
    row_open: Row,
    of_columns: Rows,
    of_rows: Rows,
    of_cells: Blocks,
    board: Constants,
    matters: FlagRows,
    work: Blocks,
    in_columns: Row,
    cells: Rows,
    uncertainty: Rows,
) -> bool:
    """Write the ``cells`` by their factors, and their uncertainty; False if the factors are to be made anew."""
    rows, columns = by_law.shape
    loss = 0.0
    for i in range(rows):
        of_row = 0.0
        for j in range(columns):
            cells[i, j] = of_cells[RHO, i, j] * by_law[i, j]
            of_row += max(cells[i, j], 0.0)
        loss = max(loss, of_rows[LEAD, i] * of_row)
    for j in range(columns):
        behind = 0.0
        for i in range(rows):
            behind += max(cells[i, j], 0.0)
        behind *= of_columns[BEHIND, j]
        passed = behind if board.floating > 0.0 else loss * behind / (1.0 + behind)
        of_columns[COUPLING, j] = max(of_columns[COUPLING, j], passed)
    relative_to(cells, by_law, own, linear, column_open, row_open, uncertainty)
    change, off, left = work[1], work[2], work[4]
    base, beyond = of_cells[BASE], of_cells[FACTOR_BEYOND]
    sums = of_rows[ROW_SUMS], of_columns[COLUMN_SUMS]
    for step in range(2):
        for i in range(rows):
            for j in range(columns):
                matters[i, j] = uncertainty[i, j] <= board.accuracy
                change[i, j] = abs(cells[i, j] - base[i, j])
                if step:
                    change[i, j] = min(uncertainty[i, j], 1.0) * abs(cells[i, j])
        move(change, base, beyond, of_columns[COUPLING], *sums, matters, in_columns, off)
        for i in range(rows):
            for j in range(columns):
                # What passes beside a cell does not fall with it.
                further = max(1.0 / max(cells[i, j], OPEN) - 1.0 / base[i, j], 0.0)
                off[i, j] += beyond[i, j] * change[i, j] * further
                if not step:
                    left[i, j] = off[i, j]
                    if matters[i, j] and left[i, j] > FRESH * uncertainty[i, j]:
                        return False
    for i in range(rows):
        for j in range(columns):
            uncertainty[i, j] += off[i, j] + left[i, j]
    return True


class UsualFrames:
    """Measures the usual frames of one board."""

    def __init__(
        self,
        law: Law,
        factors: Factors | None,
        beside_law: FloatArray,
        wires: tuple[FloatArray, FloatArray],
        constants: Mapping[str, float],
    ) -> None:
        """For a board without faults, whose readings have one answer.

        Args:
            law: of the board.
            factors: what corrects the laws; None: nothing.
            beside_law: (M,) share of the drive by which segments may change what is left at a column.
            wires: (N, M) ohm of each cell's lines beyond the mean, and in all.
            constants: those of :class:`Constants`, by name.

        """
        rows, columns = law.present.shape
        self._factors, self._made_at = factors, np.zeros(0)
        self._laws = np.ascontiguousarray(law.law)
        self._flags = law.present, law.nowhere, np.zeros((rows, columns), dtype=np.bool_)
        given = np.zeros((5, columns)), np.zeros((4, rows)), np.zeros((8, rows, columns))
        for place, known in zip(given, law.given(), strict=True):
            place[: len(known)] = known
        self._of_columns, self._of_rows, self._of_cells = given
        self._of_columns[BESIDE_LAW] = beside_law
        self._of_cells[WIRES], self._of_cells[WHOLE_WIRES] = wires
        self._constants = zeros(Constants, 1)
        for name, value in constants.items():
            self._constants[name] = value
        self._work = np.empty((11, rows, columns)), np.empty((6, columns)), np.empty((3, rows)), np.empty((3, columns))
        self._volts, self._turned = np.empty((rows, columns)), bool(constants["turned"])

    def __call__(self, volts: FloatArray, surely: float, usual: float, noise: FloatArray) -> Measurement | None:
        """Measure a frame; None if it is not a usual one.

        Args:
            volts: (rows, columns) V, contiguous.
            surely: V, standard deviation of noise that is rarely exceeded.
            usual: V, the best guess.
            noise: (rows, columns) V, the best guess of each reading, contiguous.

        """
        if self._factors is not None and not self._take_factors(self._factors):
            return None
        if self._turned:
            np.copyto(self._volts, volts.T[::-1, ::-1])
            volts = self._volts
        shape = noise.shape
        block, reason = np.empty((FIELDS, *shape)), np.empty(shape, dtype=np.int8)
        given = self._laws, self._of_columns, self._of_rows, self._of_cells, *self._flags, self._constants
        done = measure_usual.unchecked(volts, *given, surely, usual, noise, *self._work, block, reason)
        return Measurement(block, reason) if done else None

    def _take_factors(self, factors: Factors) -> bool:
        """Copy factors that were made anew; False if there are none that hold."""
        if factors.base is None or factors.astray or factors.any_added:
            return False
        if factors.base is not self._made_at:
            self._made_at = factors.base
            self._of_cells[RHO], self._of_cells[BASE] = factors.rho, factors.base
            self._of_cells[FACTOR_BEYOND] = factors.beyond
            self._of_rows[ROW_SUMS], self._of_columns[COLUMN_SUMS] = factors.row_sums, factors.column_sums
        if factors.coupling.base is not self._of_columns:
            self._of_columns[COUPLING] = factors.coupling
            factors.coupling = self._of_columns[COUPLING]
        return True
