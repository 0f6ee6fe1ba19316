"""Frames of boards that state a port law, from volts to a :class:`Measurement` in one kernel.

It calls the kernels of :mod:`._law_kernels` and :mod:`._enclosure`: conductances by the laws, their errors, bounds
beside cells of unknown size, the factors beyond the laws (:mod:`._factors`), and what is known of each cell. A frame
for which the factors do not hold comes again when :class:`._live_law.LawLive` has made them anew.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import BoolArray, FloatArray
from ...common.compiled import Blocks, FlagRows, Reasons, Records, Row, Rows, loop
from ...common.config import MOST_SI
from ...common.measurement import FIELDS, GREATEST, LEAST, Measurement
from ...common.noise import constant_part, select
from ._enclosure import Enclosure, Ways, enclose, work_for
from ._factors import Kept
from ._law import Law
from ._law_kernels import columns_of, couple, errors_of, move, relative_to, rows_of
from ._live_reading import DISTURBED, NO_CURRENT, SATURATED, UNCERTAIN, UNSETTLED, Readings
from ._measured import Constants, state_one
from ._tuning import BEYOND, BY_NOISE, BY_STEPS, DOMINATED, FRESH, MOST_WIRE, ONE, ONE_WITHIN, OPEN, OPEN_SCALE, SIGMAS

ROOT_3 = math.sqrt(3.0)
MEASURED, IMPOSSIBLE, STALE, LOOSE = range(4)
"""what came of a frame: a measurement; readings that no cells give; factors that no longer hold; or cells that the
bounds beside unknown ones leave open, and of which derivatives of all readings may know more
"""

SHORTS, SEGMENTS, BESIDE_END, WIRES, WHOLE_WIRES, SHUNT, SERIES = range(7)
RHO, ADDED, BASE, FACTOR_BEYOND, FOUND, LEFT, HIDDEN, LOW, HIGH, BY_ENDS = range(7, 17)
"""places of what is given for each cell; the first are those of :meth:`.Law.given`, likewise of columns and rows"""
LEAST_LEFT, BEHIND, BESIDE_LAW, COLUMN_SUMS, COUPLING = range(5)
LEAD, MOST, LEAST_ROW_LEFT, ROW_SUMS = range(4)
APART, SHARE, DRIVE, DRIVEN, BY_LAW, OF_DRIVEN, PER_VOLT, BESIDE, OWN, LINEAR, STD, OTHERS = range(12)
LOWER, UPPER, ESTIMATE, CELLS, UNCERTAINTY, CHANGE, OFF, ALLOWED, OFF_BEFORE = range(12, 21)
"""places of what is found for each cell"""
OF_COLUMNS_LEFT, TOTAL, MIDDLE, OF_LEFT, COLUMN_OPEN, BY_COLUMN = range(6)
ROW_LEFT, OF_SUMS, ROW_OPEN = range(3)


@loop
def measure_by_law(
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
    no_reading: Reasons,
    whole: bool,
    renewed: bool,
    settled: bool,
    known: bool,
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
) -> tuple[int, bool]:
    """Measure a frame (N, M) in line coordinates: what came of it, and whether cells may be of unknown size.

    Args:
        volts: readings.
        laws: (3, 2, M) current, potential and drive of the port law.
        of_columns: (5, M); ``of_rows`` (4, N); ``of_cells`` (17, N, M): what is given, by the places above.
        present: cells that take part.
        matters: changed.
        boards: the constants.
        lines_of_columns: and all further arguments up to ``ways``: what :func:`enclose` is given of the board.
        unknown: cells at a limit: ``limited`` and ``under_range`` ones; ``some``: whether there are any.
        no_reading: why no reading is that of its cell; 0 at all others.
        whole: whether the frame is to be measured whatever comes of it, but with factors that hold.
        renewed: whether these were made from this frame; ``settled``: so that cells have settled; ``known``: at all.
        surely: V, noise of the readings that is rarely exceeded; ``usual`` best guess, ``noise`` of each one.
        work: changed, as all further arguments up to ``lines_in_rows``.
        block: written, as ``reason``: in the array's coordinates.
    """
    board, rows, columns = boards[0], volts.shape[0], volts.shape[1]
    apart, share, drive, driven, by_law = work[APART], work[SHARE], work[DRIVE], work[DRIVEN], work[BY_LAW]
    left, total, row_left = in_columns[OF_COLUMNS_LEFT], in_columns[TOTAL], in_rows[ROW_LEFT]
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
    middle = in_columns[MIDDLE]
    for j in range(columns):
        middle[j] = math.nan
        if board.alike > 1.0 and 3.0 * rows > BY_STEPS * BY_STEPS and surely <= board.half:
            for i in range(rows):
                in_rows[OF_SUMS, i] = volts[i, j]
            middle[j] = select(in_rows[OF_SUMS], rows, rows // 2)
    error = board.half + SIGMAS * surely
    by_steps, by_noise = board.random * BY_STEPS / ROOT_3, BY_NOISE * surely
    random = math.hypot(by_steps, by_noise)
    own, linear = work[OWN], work[LINEAR]
    of_left, column_open, row_open = in_columns[OF_LEFT], in_columns[COLUMN_OPEN], in_rows[ROW_OPEN]
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
        work[OF_DRIVEN],
        work[PER_VOLT],
        work[BESIDE],
        own,
        linear,
        work[STD],
        of_left,
        column_open,
        in_rows[OF_SUMS],
        row_open,
        sums,
    )
    enclosed = opens or some
    for j in range(columns):
        by_segments = of_columns[BESIDE_LAW, j] * max(1.0 - left[j], 1.0)
        if not some and not whole and left[j] < -BEYOND * of_left[j] - by_segments:
            return IMPOSSIBLE, enclosed
    others, estimate, cells, uncertainty = work[OTHERS], work[ESTIMATE], work[CELLS], work[UNCERTAINTY]
    unbounded = some and not board.encloses > 0.0
    for i in range(rows):
        for j in range(columns):
            cells[i, j] = by_law[i, j]
            if renewed:
                cells[i, j] = of_cells[FOUND, i, j]
            elif board.factors > 0.0:
                cells[i, j] = of_cells[RHO, i, j] * by_law[i, j] + of_cells[ADDED, i, j]
            estimate[i, j] = max(cells[i, j], OPEN) if board.factors > 0.0 else by_law[i, j]
            others[i, j] = math.inf if unbounded else 0.0
            work[LOWER, i, j], work[UPPER, i, j] = 0.0, math.inf
    if enclosed and not unbounded:
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
            work[OF_DRIVEN],
            linear,
            of_left,
            column_open,
            in_rows[OF_SUMS],
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
            work[LOWER],
            work[UPPER],
        )
    relative_to(cells, by_law, own, linear, column_open, row_open, uncertainty)
    if board.factors > 0.0:
        if not (known or renewed):
            return STALE, enclosed
        if known and not correct(
            of_columns, of_rows, of_cells, board, present, unknown, matters, work, in_columns[BY_COLUMN], renewed
        ):
            return STALE, enclosed
    if board.fits > 0.0 and enclosed and not whole:
        for i in range(rows):
            for j in range(columns):
                read = uncertainty[i, j] <= board.accuracy and not unknown[i, j]
                if read and not uncertainty[i, j] + others[i, j] <= board.accuracy:
                    return LOOSE, enclosed
    half_step = 0.5 * board.step * constant_part(usual / board.step)
    beside_short = False
    for i in range(rows):
        for j in range(columns):
            if board.faulty > 0.0:
                take_faults_out(work, of_cells, i, j)
            beside_short = beside_short or cells[i, j] * of_cells[WIRES, i, j] > MOST_WIRE
    for i in range(rows):
        for j in range(columns):
            stated, lower, upper = uncertainty[i, j] + others[i, j], work[LOWER, i, j], work[UPPER, i, j]
            if board.several > 0.0:
                low, high, middle_one = of_cells[LOW, i, j], of_cells[HIGH, i, j], by_law[i, j]
                if not uncertainty[i, j] * of_cells[BY_ENDS, i, j] <= ONE_WITHIN:
                    stated = max(stated, max(high - middle_one, middle_one - low) / abs(middle_one))
                    stated = stated if high <= ONE * low else math.inf
                lower, upper = max(lower, low), min(upper, high)
            valid = stated <= board.accuracy
            # A cell far below its wires reads like a short, whatever its own error is.
            short = cells[i, j] * of_cells[WIRES, i, j] > MOST_WIRE
            short = short or (not valid and cells[i, j] * of_cells[WHOLE_WIRES, i, j] > MOST_WIRE)
            why = 0 if valid else (DISTURBED if others[i, j] > 0.5 * stated else UNCERTAIN)
            # What others leave open does not wait for the next frames, and a short keeps others from settling.
            if not settled and (valid or beside_short):
                why = DISTURBED if beside_short else UNSETTLED
            if short or limited[i, j]:
                why = SATURATED
            elif under_range[i, j] or own[i, j] >= 1.0 or not cells[i, j] > 0.0:
                why = NO_CURRENT
            if no_reading[i, j] != 0:
                why = no_reading[i, j]
            row, column = (columns - 1 - j, rows - 1 - i) if board.transposed > 0.0 else (i, j)
            reason[row, column] = why
            if not (why == 0 or (why == UNCERTAIN and settled)):
                stated = math.inf
            of_errors = abs(work[PER_VOLT, i, j]), work[BESIDE, i, j], work[STD, i, j]
            values = max(cells[i, j], 0.0), stated, *of_errors, noise[row, column]
            block[LEAST, row, column], block[GREATEST, row, column] = lower, upper
            state_one(block, reason, row, column, *values, usual, half_step, rows, board)
    return MEASURED, enclosed


@loop
def take_faults_out(work: Blocks, of_cells: Blocks, i: int, j: int) -> None:
    """Make cell (i, j) of what was read together with known parts in series and in parallel; its errors grow."""
    together, series = work[CELLS, i, j], of_cells[SERIES, i, j]
    alone = max(together - of_cells[SHUNT, i, j], 0.0)
    if series > 0.0 and alone > 0.0:
        alone = 1.0 / max(1.0 / alone - series, 1.0 / MOST_SI)
    grown = math.inf
    if alone > 0.0:
        grown = together / alone * (1.0 + series * alone) * (1.0 + series * alone)
        grown = max(grown, 1.0) if not math.isnan(grown) else math.inf
    work[CELLS, i, j] = alone
    for place in (UNCERTAINTY, OWN, OTHERS, PER_VOLT, BESIDE, STD):
        if work[place, i, j] != 0.0:
            work[place, i, j] *= grown


@loop
def correct(
    of_columns: Rows,
    of_rows: Rows,
    of_cells: Blocks,
    board: Constants,
    present: FlagRows,
    unknown: FlagRows,
    matters: FlagRows,
    work: Blocks,
    in_columns: Row,
    renewed: bool,
) -> bool:
    """Add to the uncertainty what the cells' factors may be off; False if they are to be made anew."""
    rows, columns = unknown.shape
    cells, uncertainty, others = work[CELLS], work[UNCERTAINTY], work[OTHERS]
    if not renewed:
        couple(cells, of_rows[LEAD], of_columns[BEHIND], board.floating > 0.0, of_columns[COUPLING])
    change, off, allowed, before = work[CHANGE], work[OFF], work[ALLOWED], work[OFF_BEFORE]
    kept = of_cells[BASE], of_cells[FACTOR_BEYOND], of_cells[ADDED]
    sums = of_columns[COUPLING], of_rows[ROW_SUMS], of_columns[COLUMN_SUMS]
    for i in range(rows):
        for j in range(columns):
            before[i, j] = of_cells[LEFT, i, j]
            allowed[i, j] = uncertainty[i, j] + others[i, j]
            matters[i, j] = allowed[i, j] <= board.accuracy and present[i, j] and not unknown[i, j]
            change[i, j] = abs(cells[i, j] - of_cells[BASE, i, j])
    if not renewed:
        move(change, cells, *kept, *sums, matters, in_columns, before)
        for i in range(rows):
            for j in range(columns):
                if matters[i, j] and before[i, j] > FRESH * allowed[i, j]:
                    return False
    for i in range(rows):
        for j in range(columns):
            matters[i, j] = uncertainty[i, j] <= board.accuracy
            change[i, j] = min(uncertainty[i, j], 1.0) * abs(cells[i, j])
    move(change, cells, *kept, *sums, matters, in_columns, off)
    for i in range(rows):
        for j in range(columns):
            uncertainty[i, j] += off[i, j] + before[i, j] + of_cells[HIDDEN, i, j]
    return True


class LawFrames:
    """Measures the frames of one board."""

    def __init__(
        self,
        law: Law,
        enclosure: Enclosure,
        constants: Records[Constants],
        beside_law: FloatArray,
        no_reading: NDArray[np.int8],
        **parts: FloatArray,
    ) -> None:
        """For a board.

        Args:
            law: of the board.
            enclosure: bounds beside unknown cells.
            constants: of the board.
            beside_law: (M,) relative change of a column's share of the drive by segments.
            no_reading: (N, M) why no reading is that of its cell; 0 at all others.
            parts: (N, M) ohm ``wires`` of each cell's lines beyond the mean and ``whole_wires`` in all; known parts:
                S of ``shunt``, ohm of ``series``.

        """
        rows, columns = law.present.shape
        self._laws = np.ascontiguousarray(law.law)
        self._enclosure, self._nowhere, self._present = enclosure, law.nowhere, law.present
        self._constants, self._no_reading = constants, no_reading
        self._matters = np.zeros((rows, columns), dtype=np.bool_)
        given = np.zeros((5, columns)), np.zeros((4, rows)), np.zeros((BY_ENDS + 1, rows, columns))
        for places, known in zip(given, law.given(), strict=True):
            places[: len(known)] = known
        self._of_columns, self._of_rows, self._of_cells = of_columns, _, of_cells = given
        of_columns[BESIDE_LAW] = beside_law
        for place, name in (WIRES, "wires"), (WHOLE_WIRES, "whole_wires"), (SHUNT, "shunt"), (SERIES, "series"):
            of_cells[place] = parts[name]
        self.kept = Kept(
            *(of_cells[RHO], of_cells[ADDED], of_cells[BASE], of_cells[FACTOR_BEYOND]),
            *(self._of_rows[ROW_SUMS], of_columns[COLUMN_SUMS], of_columns[COUPLING]),
        )
        self.found, self.left, self.by_hidden = of_cells[FOUND], of_cells[LEFT], of_cells[HIDDEN]
        self.low, self.high, self.by_ends = of_cells[LOW], of_cells[HIGH], of_cells[BY_ENDS]
        """S, bounds on all answers, and error of the readings, over their own, within which these lie; ``found`` and
        ``left`` are what the iteration of the factors finds, S, and what it leaves, relative; ``by_hidden`` what cells
        behind a break may change, relative
        """
        self._work = np.empty((OFF_BEFORE + 1, rows, columns))
        self.by_law, self.linear, self.others = (self._work[place] for place in (BY_LAW, LINEAR, OTHERS))
        self._in_columns, self._in_rows = np.empty((6, columns)), np.empty((3, rows))
        self._work_beside = np.empty((3, columns)), *work_for(rows, columns)

    def __call__(
        self, frame: Readings, *, known: bool, whole: bool = False, renewed: bool = False, settled: bool = True
    ) -> tuple[Measurement, int, bool]:
        """Measure a frame in line coordinates: :data:`MEASURED` or why not, and whether cells may be of unknown size.

        Args:
            frame: its readings.
            known: whether there are factors that hold.
            whole: whether the frame is to be measured whatever comes of it.
            renewed: whether the factors were made from this frame; ``settled``: so that cells have settled.

        """
        volts, surely, usual, each, at_limit, under = frame
        some = at_limit is not None or under is not None
        limited = self._nowhere if at_limit is None else at_limit
        under_range = self._nowhere if under is None else under
        unknown: BoolArray = limited | under_range if some else self._nowhere
        measured = Measurement(np.empty((FIELDS, *each.shape)), np.empty(each.shape, dtype=np.int8))
        given = self._laws, self._of_columns, self._of_rows, self._of_cells, self._present, self._matters
        unknowns = unknown, limited, under_range, some, self._no_reading
        work = self._work, self._in_columns, self._in_rows, *self._work_beside
        came, opens = measure_by_law.unchecked(
            *(volts, *given, self._constants, *self._enclosure.given, *unknowns),
            *(whole, renewed, settled, known, surely, usual, each, *work, measured.block, measured.reason),
        )
        return measured, came, opens

    def relative(self, cells: FloatArray) -> FloatArray:
        """Relative uncertainty (N, M) of ``cells`` in S behind the last frame, by its readings and unknown cells."""
        uncertainty = np.empty(cells.shape)
        lines = self._in_columns[COLUMN_OPEN], self._in_rows[ROW_OPEN]
        relative_to.unchecked(cells, self.by_law, self._work[OWN], self.linear, *lines, uncertainty)
        uncertainty += self.others
        return uncertainty

    def lone(self) -> bool:
        """Whether in each column of open scale of the last frame a single cell takes nearly all of the current.

        Else derivatives do not tell what the cells of the column change together, since their scale is anywhere.
        """
        share = self._work[SHARE]
        if share.shape[0] == 1:
            return True
        among = np.partition(share[:, self._in_columns[COLUMN_OPEN] > OPEN_SCALE], -2, axis=0)
        return bool((among[-2] <= DOMINATED * among[-1]).all())
