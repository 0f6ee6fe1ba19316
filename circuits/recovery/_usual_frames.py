"""Usual frames of boards that state a port law, from volts to a :class:`Measurement` in one kernel.

Usual are frames for which the factors beyond the laws hold, whatever cells stand at a limit. The kernel calls those of
:mod:`._law_kernels` and :mod:`._enclosure` in the order of :class:`._live_law.LawLive`, which takes all other frames,
and those whose unknown cells leave others open where derivatives of all readings may know more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...common.compiled import Blocks, FlagRows, Reasons, Records, Row, Rows, loop, zeros
from ...common.measurement import FIELDS, GREATEST, LEAST, Measurement
from ...common.noise import constant_part, select
from ._answers import MOST_WIRE
from ._enclosure import Enclosure, Ways, enclose, work_for
from ._factors import FRESH, OPEN, Factors
from ._law import Law
from ._law_errors import BY_NOISE, BY_STEPS
from ._law_kernels import columns_of, errors_of, move, relative_to, rows_of
from ._live_reading import DISTURBED, NO_CURRENT, SATURATED, SIGMAS, UNCERTAIN
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
    matters: FlagRows,
    boards: Records[Constants],
    lines_of_columns: Rows,
    pull: Row,
    lines_of_cells: Blocks,
    shared: Blocks,
    pairs: Blocks,
    ways: Records[Ways],
    unknown: FlagRows,
    limited: FlagRows,
    under_range: FlagRows,
    some: bool,
    surely: float,
    usual: float,
    noise: Rows,
    work: Blocks,
    in_columns: Rows,
    in_rows: Rows,
    sums: Rows,
    for_lines: Blocks,
    for_steps: Blocks,
    lines_in_columns: Rows,
    lines_in_rows: Rows,
    block: Blocks,
    reason: Reasons,
) -> bool:
    """Measure a frame (N, M) in line coordinates; False if it is not a usual one.

    Args:
        volts: readings.
        laws: (3, 2, M) current, potential and drive of the port law.
        of_columns: (5, M); ``of_rows`` (4, N); ``of_cells`` (8, N, M): what is given, by the places above.
        present: cells that take part.
        matters: changed.
        boards: the constants.
        lines_of_columns: and all further arguments up to ``ways``: what :func:`enclose` is given of the board.
        unknown: cells at a limit: ``limited`` and ``under_range`` ones; ``some``: whether there are any.
        surely: V, noise of the readings that is rarely exceeded; ``usual`` best guess, ``noise`` of each one.
        work: changed, as all further arguments up to ``lines_in_rows``.
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
        unknown,
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
        unknown,
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
    for j in range(columns):
        by_segments = of_columns[BESIDE_LAW, j] * max(1.0 - left[j], 1.0)
        if not some and left[j] < -BEYOND * of_left[j] - by_segments:
            return False
    others, least, greatest, estimate = work[11], work[12], work[13], work[14]
    for i in range(rows):
        for j in range(columns):
            others[i, j], estimate[i, j] = 0.0, by_law[i, j]
            if board.factors > 0.0:
                estimate[i, j] = max(of_cells[RHO, i, j] * by_law[i, j], OPEN)
    enclosed = opens or some
    if enclosed:
        enclose(
            volts,
            laws[1],
            laws[2],
            limited,
            under_range,
            apart,
            share,
            drive,
            total,
            driven,
            by_law,
            estimate,
            of_driven,
            linear,
            of_left,
            column_open,
            of_sums,
            row_open,
            error,
            lines_of_columns,
            pull,
            lines_of_cells,
            shared,
            pairs,
            ways,
            for_lines,
            for_steps,
            lines_in_columns,
            lines_in_rows,
            others,
            least,
            greatest,
        )
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
            unknown,
            others,
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
            told = uncertainty[i, j] + others[i, j]
            valid = told <= board.accuracy
            if board.fits > 0.0 and enclosed and not (valid or unknown[i, j]) and uncertainty[i, j] <= board.accuracy:
                return False
            # A cell far below its wires reads like a short, whatever its own error is.
            short = cells[i, j] * of_cells[WIRES, i, j] > MOST_WIRE
            short = short or (not valid and cells[i, j] * of_cells[WHOLE_WIRES, i, j] > MOST_WIRE)
            why = 0 if valid else (DISTURBED if others[i, j] > 0.5 * told else UNCERTAIN)
            if short or limited[i, j]:
                why = SATURATED
            elif under_range[i, j] or own[i, j] >= 1.0 or not cells[i, j] > 0.0:
                why = NO_CURRENT
            row, column = (columns - 1 - j, rows - 1 - i) if board.turned > 0.0 else (i, j)
            reason[row, column] = why
            told = told if why in (0, UNCERTAIN) else math.inf
            values = max(cells[i, j], 0.0), told, abs(own_per_volt[i, j]), beside[i, j], std[i, j], noise[row, column]
            block[LEAST, row, column], block[GREATEST, row, column] = 0.0, math.inf
            if enclosed:
                block[LEAST, row, column], block[GREATEST, row, column] = least[i, j], greatest[i, j]
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
    unknown: FlagRows,
    others: Rows,
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
    change, off, allowed, left = work[1], work[2], work[3], work[4]
    base, beyond = of_cells[BASE], of_cells[FACTOR_BEYOND]
    sums = of_rows[ROW_SUMS], of_columns[COLUMN_SUMS]
    for step in range(2):
        for i in range(rows):
            for j in range(columns):
                allowed[i, j] = uncertainty[i, j] + (0.0 if step else others[i, j])
                matters[i, j] = allowed[i, j] <= board.accuracy and (step == 1 or not unknown[i, j])
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
                    if matters[i, j] and left[i, j] > FRESH * allowed[i, j]:
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
        enclosure: Enclosure,
        beside_law: FloatArray,
        wires: tuple[FloatArray, FloatArray],
        constants: Mapping[str, float],
    ) -> None:
        """For a board without faults, whose readings have one answer.

        Args:
            law: of the board.
            factors: what corrects the laws; None: nothing.
            enclosure: bounds beside unknown cells.
            beside_law: (M,) relative change of a column's share of the drive by segments.
            wires: (N, M) ohm of each cell's lines beyond the mean, and in all.
            constants: those of :class:`Constants`, by name.

        """
        rows, columns = law.present.shape
        self._factors, self._made_at = factors, np.zeros(0)
        self._laws = np.ascontiguousarray(law.law)
        self._enclosure, self._nowhere = enclosure, law.nowhere
        self._flags = law.present, np.zeros((rows, columns), dtype=np.bool_)
        given = np.zeros((5, columns)), np.zeros((4, rows)), np.zeros((8, rows, columns))
        for place, known in zip(given, law.given(), strict=True):
            place[: len(known)] = known
        self._of_columns, self._of_rows, self._of_cells = given
        self._of_columns[BESIDE_LAW] = beside_law
        self._of_cells[WIRES], self._of_cells[WHOLE_WIRES] = wires
        self._constants = zeros(Constants, 1)
        for name, value in constants.items():
            self._constants[name] = value
        self._work = (
            np.empty((15, rows, columns)),
            np.empty((6, columns)),
            np.empty((3, rows)),
            np.empty((3, columns)),
            *work_for(rows, columns),
        )
        self._volts, self._turned = np.empty((rows, columns)), bool(constants["turned"])

    def __call__(
        self,
        volts: FloatArray,
        surely: float,
        usual: float,
        noise: FloatArray,
        limited: BoolArray | None = None,
        under_range: BoolArray | None = None,
    ) -> Measurement | None:
        """As :class:`.UsualReading`."""
        if self._factors is not None and not self._take_factors(self._factors):
            return None
        some = limited is not None or under_range is not None
        if some and not self._enclosure.bounds_cells:
            return None
        at_limit = self._nowhere if limited is None else self._in_lines(limited)
        under = self._nowhere if under_range is None else self._in_lines(under_range)
        if self._turned:
            np.copyto(self._volts, volts.T[::-1, ::-1])
            volts = self._volts
        shape = noise.shape
        block, reason = np.empty((FIELDS, *shape)), np.empty(shape, dtype=np.int8)
        given = self._laws, self._of_columns, self._of_rows, self._of_cells, *self._flags, self._constants
        unknown = at_limit | under if some else self._nowhere
        unknowns = unknown, at_limit, under, some
        done = measure_usual.unchecked(
            volts, *given, *self._enclosure.given, *unknowns, surely, usual, noise, *self._work, block, reason
        )
        return Measurement(block, reason) if done else None

    def _in_lines(self, cells: BoolArray) -> BoolArray:
        """Flags (N, M) in line coordinates, contiguous."""
        return np.ascontiguousarray(cells.T[::-1, ::-1] if self._turned else cells)

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
