"""Cells beside others whose readings do not determine them: bounds by intervals of Kirchhoff's laws.

A reading at a limit leaves its cell anywhere between the value at the limit and a short. The same holds for the cells
of a column or a row of whose drive nothing is left beyond the readings' error. Such a cell changes others

* of its own column, whose sum T becomes an interval;
* of its own row, which it loads while the row is driven;
* of all columns, as it ties its own column to an idle row (:func:`added_between`). An idle row m stands at
  u_m = sum_j p_mj C_kj with p_mj = r_m D_mj, and feeds G_ml (u_m - C_kl) to column l while row k is driven.

The potentials C are known from the readings, whatever the unknown cells are. The bounds are those of
:mod:`._law` with intervals in place of numbers.
"""

from __future__ import annotations

import math
from math import isfinite

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...common.compiled import Blocks, FlagRows, Record, Records, Row, Rows, loop, zeros
from .._board import Board, broken_off
from .._parts import LEAST_SHORT_OHM
from ._law import Law
from ._law_kernels import TINY
from ._tuning import (
    COLUMN_ROUNDS,
    ENCLOSURE_MARGIN,
    LEAST,
    LEAST_DRIVE_LEFT,
    MOST_CHANGE,
    MOST_CORRECTED,
    OPEN_ROW,
    OPEN_SCALE,
    TIES_ROW,
    UNCLEAR,
    UNUSUAL,
)


class Ways(Record):
    """What a board's lines do; 1 where it is so, else 0."""

    drive: float
    """V"""
    floating: float
    follows: float
    """whether idle lines follow the column that is read"""
    one_by_one: float
    divides: float
    """whether columns are loads, without amplifiers"""
    holds: float
    """whether amplifiers hold the columns"""
    saturates: float
    """whether their outputs have a limit towards more current"""
    cancels: float
    mixes: float
    joins: float
    """whether cells pass currents from column to column"""
    breaks: float
    """whether cells are behind breaks"""
    least_idle: float
    """S, least conductance behind an idle column"""


BEHIND, WIRE, IDLE = range(3)
TO_DRIVER, SHORT, BEHIND_CELL, ADRIFT, INTO_END, IN_OWN_STEP = range(6)
PASSES_ON, DRIVEN_APART, BESIDE = range(3)
"""places of what is given for each column, cell, and pair of columns"""


@loop
def lost_along(shared: Blocks, conductance: Rows, i: int, j: int) -> float:
    """Share of a row's drive lost on the way to cell (i, j), while the cells of the row conduct so many S."""
    lost = 0.0
    for k in range(conductance.shape[1]):
        if shared[i, j, k] != 0.0:
            lost += shared[i, j, k] * conductance[i, k]
    return lost


@loop
def left_along(shared: Blocks, row: Rows, more: Rows, limited: FlagRows, i: int, j: int) -> float:
    """Least share of a row's drive ``row`` that cells leave at (i, j) which draw so many S more.

    Those at a limit do so each alone, and together less: a load of conductance g at k divides what is left at j by at
    most 1 + R_jk g, where R_jk is their wire in common, and alone draws g of what it leaves of the drive there. What
    others draw is bounded beside all, and adds up.
    """
    left: float = row[i, j]
    for k in range(more.shape[1]):
        if shared[i, j, k] != 0.0 and not limited[i, k]:
            left -= shared[i, j, k] * more[i, k]
    for k in range(more.shape[1]):
        if shared[i, j, k] != 0.0 and limited[i, k] and more[i, k] > 0.0:
            alone = row[i, k] - shared[i, k, k] * more[i, k]
            left = left / (1.0 + shared[i, j, k] * more[i, k] / alone) if alone > 0.0 else 0.0
    return left


@loop
def product(low: float, high: float, least: float, most: float) -> tuple[float, float]:
    """Ends of an interval times another one of positive numbers."""
    return low * (most if low < 0.0 else least), high * (most if high > 0.0 else least)


@loop
def usual_conductance(by_law: Rows, estimate: Rows, above: Rows, under_range: FlagRows, i: int, j: int) -> float:
    """S that cell (i, j) conducts, or conducts at most."""
    usual: float = above[i, j] if under_range[i, j] else max(min(by_law[i, j], MOST_CORRECTED * estimate[i, j]), 0.0)
    return usual


@loop
def along_column(
    limited: FlagRows,
    apart: Rows,
    of_driven: Rows,
    of_cells: Blocks,
    j: int,
    toward: Rows,
    away: Rows,
    most: Rows,
    above: Rows,
) -> None:
    """Raise the upper bounds ``above`` (N, M) of the cells of a column with segments, of which some are at a limit.

    A current passes by all cells on its way to the column's end, and part of it leaves by each of them: what is read
    of a cell far from the end is less than its share the better the others conduct. Rounds that begin with shorts
    narrow the bounds of cells whose readings are within the limits; they hold in every round.

    Args:
        limited: and further arguments: as of :func:`enclose`.
        j: the column.
        toward: changed, as ``away`` and ``most``.
        above: changed.
    """
    rows = apart.shape[0]
    wire, short = of_cells[BEHIND_CELL], of_cells[SHORT]
    first, one = (0, 1) if wire[0, j] <= wire[rows - 1, j] else (rows - 1, -1)
    last = rows - 1 - first
    if not wire[last, j] > wire[first, j]:
        return
    some = False
    for i in range(rows):
        some = some or limited[i, j]
        most[i, j] = short[i, j]
    for _ in range(COLUMN_ROUNDS if some else 0):
        away[last, j] = 0.0
        for number in range(rows - 1):
            i = last - one * number
            beyond = most[i, j] + away[i, j]
            away[i - one, j] = 1.0 / (abs(wire[i, j] - wire[i - one, j]) + 1.0 / max(beyond, TINY))
        toward[first, j], passes = 1.0 / (wire[first, j] + LEAST_SHORT_OHM), 1.0
        for number in range(rows):
            i = first + one * number
            if number > 0:
                before = toward[i - one, j] + most[i - one, j]
                passes *= toward[i - one, j] / before
                toward[i, j] = 1.0 / (abs(wire[i, j] - wire[i - one, j]) + 1.0 / before)
            out = toward[i, j] + away[i, j]
            into = (max(apart[i, j], 0.0) + of_driven[i, j]) * out / (passes * toward[i, j])
            away[i, j] = into / (1.0 - into / out) if into < out else math.inf
        for i in range(rows):
            if not limited[i, j]:
                most[i, j] = min(most[i, j], away[i, j])
    if some:
        for i in range(rows):
            above[i, j] = max(above[i, j], most[i, j])


@loop
def enclose(
    volts: Rows,
    potential_law: Rows,
    driving: Rows,
    limited: FlagRows,
    under_range: FlagRows,
    apart: Rows,
    share: Rows,
    drives: Rows,
    total: Row,
    driven: Rows,
    by_law: Rows,
    estimate: Rows,
    of_driven: Rows,
    linear: Rows,
    of_left: Row,
    column_open: Row,
    of_sums: Row,
    row_open: Row,
    error: float,
    of_columns: Rows,
    pull: Row,
    of_cells: Blocks,
    shared: Blocks,
    pairs: Blocks,
    boards: Records[Ways],
    work: Blocks,
    by_steps: Blocks,
    in_columns: Rows,
    in_rows: Rows,
    change: Rows,
    least: Rows,
    greatest: Rows,
) -> None:
    """Write the largest relative change of all cells (N, M) over all values of unknown ones, and bounds on these.

    Args:
        volts: readings.
        potential_law: (2, M) of the port law, as ``driving``.
        limited: cells that conduct at least what their readings say; ``under_range`` at most.
        apart: and all further arguments up to ``by_law``: as :func:`columns_of` and :func:`rows_of` write them.
        estimate: S, of the cells.
        of_driven: and all further arguments up to ``row_open``: as :func:`errors_of` writes them.
        error: V, of a reading.
        of_columns: (3, M), ``pull`` (N,) ohm, ``of_cells`` (6, N, M) and ``pairs`` (3, M, M): what is given of a board.
        shared: (N, M, M) ohm of wire that two cells of a row share on the way to its driver.
        boards: one board.
        work: (10, N, M), changed, as ``by_steps`` (5, N, N), ``in_columns`` (5, M) and ``in_rows`` (3, N).
        change: written, as ``least`` and ``greatest`` in S: 0 and infinite at cells that are not unknown.
    """
    board, rows, columns = boards[0], volts.shape[0], volts.shape[1]
    per_sum, below, above, potential, row = work[0], work[1], work[2], work[3], work[4]
    low, high, added, ordinary, along = work[5], work[6], work[7], work[8], work[9]
    width, rough, low_sum = in_columns[0], in_columns[1], in_columns[2]
    floating = board.floating > 0.0
    some, usual = False, 0.0
    for j in range(columns):
        for i in range(rows):
            some = some or limited[i, j] or under_range[i, j]
            usual = max(usual, driven[i, j])
    for j in range(columns):
        scale_open, here = column_open[j] > OPEN_SCALE, False
        of_scale = of_left[j] if scale_open else 0.0
        least_sum, least_left, most_sum, most_left = 0.0, 1.0, 0.0, 1.0
        bound, loose, behind = math.inf, 0.0, 0.0
        for i in range(rows):
            unknown, full = limited[i, j] or under_range[i, j], abs(drives[i, j])
            short = of_cells[SHORT, i, j]
            below[i, j] = max(driven[i, j] - of_driven[i, j], 0.0) if limited[i, j] else 0.0
            # What the column's potential drives into an under-range cell is no part of its reading.
            offset = abs(potential_law[0, j] + potential_law[1, j] * volts[i, j]) / full * max(total[j], 0.0)
            above[i, j] = short if limited[i, j] else max(driven[i, j], 0.0) + of_driven[i, j] + offset
            if unknown:
                here = True
                loose += above[i, j]
                behind += above[i, j] * of_cells[BEHIND_CELL, i, j]
                least_sum += below[i, j]
                most_sum += above[i, j]
            else:
                least_sum += apart[i, j]
                most_sum += apart[i, j]
                least_left -= share[i, j]
            if not limited[i, j]:
                most_left -= share[i, j]
            # No D exceeds that of a short behind its row; C / W itself may be off.
            off = error * abs((potential_law[1, j] - driving[1, j] * share[i, j]) / drives[i, j])
            surely = 0.0 if unknown else share[i, j] - off
            if surely > LEAST:
                # An offset that drives a current through a short is not cancelled by as large cells.
                if board.cancels > 0.0 and usual > 0.0:
                    short = min(short, UNUSUAL * usual)
                bound = min(bound, (short - apart[i, j]) / surely)
            per_sum[i, j] = abs(share[i, j])
            added[i, j] = off
        least_left += of_scale
        least_sum = least_sum / least_left if least_left != 0.0 else total[j]
        least_sum = total[j] if math.isnan(least_sum) else min(least_sum, total[j])
        if most_left > of_scale:
            bound = min(most_sum / (most_left - of_scale), bound)
        most_sum = max(bound, total[j])
        low_sum[j] = least_sum
        rough[j] = 1.0 if scale_open or here else 0.0
        width[j] = most_sum - least_sum if here or math.isinf(of_left[j]) else 0.0
        # A current into an unknown cell leaves the column at that cell, not at a mean one.
        at_cell = behind / loose if loose > 0.0 else of_columns[BEHIND, j]
        for i in range(rows):
            unknown = limited[i, j] or under_range[i, j]
            per = per_sum[i, j]
            if board.mixes > 0.0 and some:
                per = abs(share[i, j] - apart[i, j] * of_columns[BEHIND, j]) + abs(apart[i, j]) * at_cell
            if scale_open:
                per += added[i, j]
            per_sum[i, j] = per
            wider = per * (most_sum - total[j]) if per != 0.0 else 0.0
            if not unknown:
                below[i, j] = driven[i, j] - (per * (total[j] - least_sum) if per != 0.0 else 0.0)
                above[i, j] = driven[i, j] + wider
            elif under_range[i, j]:
                above[i, j] += wider
        if here and not floating:
            along_column(limited, apart, of_driven, of_cells, j, row, low, high, above)
    # V, of the columns above the idle lines while each row is driven.
    for i in range(rows):
        for j in range(columns):
            full = abs(drives[i, j])
            if floating:
                potential[i, j] = abs(board.drive - drives[i, j])
                continue
            volt = abs(potential_law[0, j] + potential_law[1, j] * volts[i, j])
            if board.follows > 0.0:  # what the selected row drives through the leads of the idle columns
                potential[i, j] = max(volt, of_columns[WIRE, j] * max(driven[i, j], 0.0) * full)
                continue
            if board.one_by_one > 0.0:  # idle columns stand where their idle ends leave them
                volt += abs(apart[i, j]) / (max(low_sum[j], board.least_idle) + of_columns[IDLE, j]) * full
            potential[i, j] = min(volt, full)
    # Potential of a driven row at its cells over the drive, and its bounds.
    for j in range(columns):
        in_columns[3, j] = 0.0
        for i in range(rows):
            in_columns[3, j] += above[i, j] if limited[i, j] else max(driven[i, j], 0.0)
    more, less = change, least
    for i in range(rows):
        highest, fed = 0.0, 0.0
        for j in range(columns):
            if not limited[i, j]:
                fed += max(-driven[i, j], 0.0)
        for j in range(columns):
            full = abs(board.drive) if floating else abs(drives[i, j])
            highest = max(highest, potential[i, j] / full)
            ordinary[i, j] = driven[i, j] - max(driven[i, j], 0.0) * potential[i, j] / full
            more[i, j], less[i, j] = max(above[i, j] - driven[i, j], 0.0), max(driven[i, j] - below[i, j], 0.0)
            if board.holds > 0.0 and limited[i, j]:
                into_end = of_cells[INTO_END, i, j]
                if board.saturates > 0.0:  # currents leave by the idle rows of the column's other cells, too
                    beside, short = max(in_columns[3, j] - above[i, j], 0.0), of_cells[SHORT, i, j]
                    into_end = min(into_end + beside / (1.0 + beside / short), short)
                if floating:  # what columns at other potentials feed into the row leaves by this cell, too
                    into_end = into_end * (1.0 + potential[i, j] / full) + fed
                more[i, j] = max(into_end - apart[i, j] * (abs(drives[i, j]) / full), 0.0)
        for j in range(columns):
            row[i, j] = min(max(1.0 - lost_along(shared, ordinary, i, j), LEAST_DRIVE_LEFT), 1.0)
        for j in range(columns):
            slack = of_cells[TO_DRIVER, i, j] * of_sums[i] if row_open[i] > OPEN_ROW else 0.0
            lowest = row[i, j] - lost_along(shared, more, i, j)
            if board.holds > 0.0:
                lowest = max(lowest, left_along(shared, row, more, limited, i, j))
            lowest -= slack
            high[i, j] = min(row[i, j] + lost_along(shared, less, i, j) + slack, 1.0)
            if board.divides > 0.0:  # a row stands above all columns that it feeds
                lowest = max(lowest, min(highest, row[i, j]))
            low[i, j] = min(max(lowest, 0.0), row[i, j])
    for i in range(rows):
        for j in range(columns):
            added[i, j], along[i, j] = 0.0, 0.0
    if board.joins > 0.0:
        added_between(
            limited,
            under_range,
            apart,
            drives,
            driven,
            of_driven,
            by_law,
            estimate,
            linear,
            below,
            above,
            potential,
            row,
            low,
            pull,
            of_cells,
            pairs,
            board.floating > 0.0,
            board.breaks > 0.0,
            by_steps,
            in_columns,
            in_rows,
            ordinary,
            change,
            least,
            greatest,
            added,
            along,
        )
    for j in range(columns):
        # The laws with the rows' bounds: `fine` where the column's scale is known, else by its sum.
        left, left_high, left_low, sum_usual, sum_high, sum_low = 1.0, 1.0, 1.0, 0.0, 0.0, 0.0
        for i in range(rows):
            added[i, j] /= abs(drives[i, j])
            along[i, j] = along[i, j] / abs(drives[i, j]) + added[i, j]
            up, down = row[i, j] / low[i, j] if low[i, j] > 0.0 else math.inf, row[i, j] / high[i, j]
            own, of_column, more_here = apart[i, j] / row[i, j], share[i, j] / row[i, j], added[i, j]
            left -= of_column
            # A row that may have lost its drive makes more of a reading's error, whose sign may be either.
            of_low, of_high = product(of_column, of_column, down, up)
            own_low, own_high = product(own, own, down, up)
            left_high -= of_high
            left_low -= of_low
            sum_usual += own
            sum_high += own_high
            sum_high += of_driven[i, j] / row[i, j] * (up - 1.0) if up > 1.0 else 0.0
            sum_high += more_here / low[i, j] if more_here != 0.0 and low[i, j] > 0.0 else 0.0
            if more_here != 0.0 and not low[i, j] > 0.0:
                sum_high = math.inf
            sum_low += own_low - along[i, j] / row[i, j]
        total_usual = sum_usual / left if left != 0.0 else math.inf
        total_high = sum_high / left_high if left_high > 0.0 and left > 0.0 else math.inf
        total_low = sum_low / left_low if left_low != 0.0 else -math.inf
        if sum_low < 0.0:
            total_low = sum_low / left_high if left_high > 0.0 else -math.inf
        for i in range(rows):
            up, down = row[i, j] / low[i, j] if low[i, j] > 0.0 else math.inf, row[i, j] / high[i, j]
            own, of_column = apart[i, j] / row[i, j], share[i, j] / row[i, j]
            # A current along the drive is part of the reading, and leaves less of it to the cell.
            more_here, less_here = added[i, j], along[i, j]
            nominal = max(abs(driven[i, j]), TINY)
            if rough[j] > 0.0:
                by_sum = per_sum[i, j] * width[j] / nominal if per_sum[i, j] != 0.0 and width[j] != 0.0 else 0.0
                changed = up * (1.0 + by_sum + more_here / nominal) - 1.0
                changed = max(changed, 1.0 - down * (1.0 - by_sum - less_here / nominal))
                changed = max(changed, up * (above[i, j] + more_here) / nominal - 1.0)
            else:
                middle = own + (of_column * total_usual if of_column != 0.0 else 0.0)
                lowest, highest = product(own - less_here / row[i, j], own + more_here / row[i, j], down, up)
                if of_column != 0.0:
                    of_low, of_high = product(total_low, total_high, down, up)
                    lowest += of_column * (of_low if of_column > 0.0 else of_high)
                    highest += of_column * (of_high if of_column > 0.0 else of_low)
                changed = max(highest - middle, middle - lowest) / max(abs(middle), TINY)
                if math.isinf(up) or math.isnan(highest) or math.isnan(lowest):
                    changed = math.inf
            changed = math.inf if math.isnan(changed) else max(changed, 0.0)
            change[i, j] = ENCLOSURE_MARGIN * changed * max(abs(by_law[i, j]) / max(estimate[i, j], TINY), 1.0)
            least[i, j] = max(below[i, j] - less_here, 0.0) if limited[i, j] else 0.0
            greatest[i, j] = math.inf
            if under_range[i, j] and low[i, j] > 0.0:
                greatest[i, j] = (above[i, j] + more_here) / low[i, j]


@loop
def added_between(
    limited: FlagRows,
    under_range: FlagRows,
    apart: Rows,
    drives: Rows,
    driven: Rows,
    of_driven: Rows,
    by_law: Rows,
    estimate: Rows,
    linear: Rows,
    below: Rows,
    above: Rows,
    potential: Rows,
    row: Rows,
    low: Rows,
    pull: Row,
    of_cells: Blocks,
    pairs: Blocks,
    floating: bool,
    breaks: bool,
    by_steps: Blocks,
    in_columns: Rows,
    in_rows: Rows,
    conducting: Rows,
    loose: Rows,
    share: Rows,
    in_own_step: Rows,
    added: Rows,
    along: Rows,
) -> None:
    """Add the A (N, M) into each column in each step that unknown cells may add, or keep away.

    Args:
        limited: and all further arguments up to ``breaks``: as of :func:`enclose`, and what it has found.
        by_steps: (5, N, N), changed, as ``in_columns``, ``in_rows`` and all further arguments up to ``in_own_step``.
        added: written, where they flow either way; ``along`` where they flow as the drive would.
    """
    rows, columns = apart.shape
    leak, lifted, change, out = in_columns[4], by_steps[0], by_steps[1], by_steps[2]
    raised, passed_on = by_steps[3], by_steps[4]  # the same of columns that stand between their source and the drive
    loose_sum, share_sum, conducting_sum = in_rows[0], in_rows[1], in_rows[2]
    own_steps, doubt, ties = False, False, False
    for j in range(columns):
        leak[j] = 0.0
    for i in range(rows):
        others, some, tied = 0.0, False, 0
        for j in range(columns):
            conducting[i, j] = 0.0
            if not limited[i, j]:
                conducting[i, j] = usual_conductance(by_law, estimate, above, under_range, i, j)
            others += conducting[i, j]
            some = some or limited[i, j] or under_range[i, j]
        others = max(others, TINY)
        loose_sum[i], share_sum[i], conducting_sum[i] = 0.0, 0.0, 0.0
        for j in range(columns):
            unknown = limited[i, j] or under_range[i, j]
            if floating:
                share[i, j] = conducting[i, j] / others
                loose[i, j] = share[i, j] if some else 0.0
                if unknown:
                    loose[i, j] = 1.0
                    if not limited[i, j] and above[i, j] < math.inf:
                        loose[i, j] = above[i, j] / (above[i, j] + others)
                if limited[i, j]:
                    leak[j] += 1.0 / (pull[i] + 1.0 / max(above[i, j], TINY))
            else:
                share[i, j] = min(of_cells[TO_DRIVER, i, j] * max(driven[i, j], 0.0), 1.0)
                width, loose[i, j] = above[i, j] - below[i, j], 0.0
                if width > LEAST_DRIVE_LEFT * abs(above[i, j]) and of_cells[TO_DRIVER, i, j] > 0.0:
                    loose[i, j] = min(of_cells[TO_DRIVER, i, j] * width, 1.0)
            # V, of the column in its cell's own step, in which an output at a limit does not hold it.
            in_own_step[i, j] = 0.0
            if limited[i, j]:
                in_own_step[i, j] = of_cells[IN_OWN_STEP, i, j]
            elif under_range[i, j]:
                in_own_step[i, j] = of_cells[ADRIFT, i, j]
            own_steps = own_steps or in_own_step[i, j] > 0.0
            doubt = doubt or linear[i, j] > UNCLEAR
            if unknown and loose[i, j] > TIES_ROW:
                tied += 1
            # A row that floats drives its cells by what it stands above their columns; else they say nothing.
            stands = low[i, j] - (potential[i, j] / abs(drives[i, j]) if floating else 0.0)
            if not limited[i, j] and stands > 0.0:  # what little is left of the drive hides what its reading errs by
                hidden = of_driven[i, j] * max(1.0 / stands - 1.0 / row[i, j], 0.0)
                conducting[i, j] = min(conducting[i, j] * row[i, j] / stands + hidden, MOST_CHANGE)
            elif not limited[i, j] and (some or conducting[i, j] > 0.0):
                conducting[i, j] = MOST_CHANGE
            loose_sum[i] += loose[i, j]
            share_sum[i] += share[i, j]
            conducting_sum[i] += conducting[i, j]
        ties = ties or tied > 1
    # Potentials (steps, rows) of the idle rows that the unknown cells may change, and what the rows then feed; and
    # currents of an unknown cell's own column that it lets out to others, and in from them.
    for step in range(rows):
        for i in range(rows):
            lifted[step, i], change[step, i], out[step, i] = 0.0, 0.0, 0.0
            raised[step, i], passed_on[step, i] = 0.0, 0.0
            if i == step:
                continue
            up, by_loose, passed = 0.0, 0.0, 0.0
            for j in range(columns):
                up += potential[step, j] * share[i, j]
                by_loose += potential[step, j] * loose[i, j]
                passed += potential[step, j] * conducting[i, j]
                own, own_passed = (
                    in_own_step[step, j] * (loose[i, j] + share[i, j]),
                    in_own_step[step, j] * conducting[i, j],
                )
                if limited[step, j]:
                    raised[step, i] += own
                    passed_on[step, i] += own_passed
                else:
                    by_loose += own
                    passed += own_passed
            lifted[step, i], out[step, i] = up, passed
            change[step, i] = by_loose + up * loose_sum[i]
    for step in range(rows):
        for i in range(rows):
            for j in range(columns):
                # What a row that follows such a cell takes, or does not.
                by_row = loose_sum[i] * conducting[i, j] + conducting_sum[i] * loose[i, j]
                added[step, j] += change[step, i] * conducting[i, j] + out[step, i] * loose[i, j]
                along[step, j] += raised[step, i] * conducting[i, j] + passed_on[step, i] * loose[i, j]
                added[step, j] += potential[step, j] * by_row
                if doubt and linear[i, j] > UNCLEAR and not limited[i, j]:
                    unsure = min(linear[i, j], MOST_CHANGE) * usual_conductance(
                        by_law, estimate, above, under_range, i, j
                    )
                    added[step, j] += (lifted[step, i] + potential[step, j] * share_sum[i]) * unsure
        for j in range(columns):
            if floating:  # a cell at a limit lets its column's potential out by its row's pull-down
                added[step, j] += potential[step, j] * leak[j]
    if ties:
        # Two unknown cells of one row may join their columns: these share their currents, and what drives them apart.
        for j in range(columns):
            for k in range(columns):
                joined = False
                for i in range(rows):
                    here = (limited[i, j] or under_range[i, j]) and loose[i, j] > TIES_ROW
                    there = (limited[i, k] or under_range[i, k]) and loose[i, k] > TIES_ROW
                    joined = joined or (here and there and j != k)
                if not joined:
                    continue
                for step in range(rows):
                    current = (abs(apart[step, j]) + of_driven[step, j]) * abs(drives[step, j])
                    added[step, k] += current * pairs[PASSES_ON, j, k] + pairs[DRIVEN_APART, j, k]
                    added[step, j] += current * pairs[PASSES_ON, j, k]
                    if limited[step, j]:  # nothing holds the column in that step
                        added[step, k] += current
    if breaks and own_steps:
        # So may cells behind a break. An output at its supply no longer holds its column, which feeds the others.
        for step in range(rows):
            for j in range(columns):
                if in_own_step[step, j] > 0.0:
                    for k in range(columns):
                        added[step, k] += in_own_step[step, j] * pairs[BESIDE, j, k]
    for step in range(rows):
        for j in range(columns):
            if math.isnan(added[step, j]):
                added[step, j] = 0.0
            if math.isnan(along[step, j]):
                along[step, j] = 0.0


def work_for(rows: int, columns: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """What :func:`enclose` changes, for a board of N x M cells."""
    return (
        np.empty((10, rows, columns)),
        np.empty((5, rows, rows)),
        np.empty((5, columns)),
        np.empty((3, rows)),
    )


class Enclosure:
    """Bounds of one board's cells beside unknown ones."""

    def __init__(
        self,
        board: Board,
        law: Law,
        shared: FloatArray,
        to_driver: FloatArray,
        to_end: FloatArray,
        least_short: float = LEAST_SHORT_OHM,
    ) -> None:
        """For a board and its laws.

        Args:
            board: the board.
            law: its laws.
            shared: (N, M, M) ohm of wire that two cells of a row share on the way to its driver.
            to_driver: (N, M) ohm of wire between each cell and its row's driver.
            to_end: (N, M) ohm of wire between each cell and its column's end.
            least_short: ohm, of the cells at a limit.

        """
        circuit, drive, (rows, columns) = board.circuit, abs(board.drive), board.shape
        follows, hidden = circuit.drives_idle_lines, broken_off(board)
        ends = circuit.read_ends(board) if circuit.has_amplifiers and not follows else None
        one_by_one = circuit.columns_one_by_one(board)
        self._divides = not circuit.has_amplifiers
        at_end = 0.0 if follows else circuit.end_resistance(board)
        own_wire = law.wire - to_end.mean(axis=0) + to_end  # ohm (N, M) from each cell to its column's end
        of_columns, of_cells, pairs = (
            np.zeros((3, columns)),
            np.zeros((6, rows, columns)),
            np.zeros((3, columns, columns)),
        )
        of_columns[BEHIND], of_columns[WIRE] = at_end + law.wire, law.wire
        of_columns[IDLE] = 1.0 / np.maximum(board.idle_resistance + law.wire, LEAST_SHORT_OHM)
        short = 1.0 / (to_driver + least_short)
        of_cells[TO_DRIVER], of_cells[SHORT], of_cells[BEHIND_CELL] = to_driver, short, at_end + own_wire
        # A short while its own row is driven: S into the column's end, per volt of drive, and V of the column.
        saturates, into_end, in_own_step = False, short, np.full(board.shape, drive)
        source, behind = np.zeros(columns), board.reference + law.wire
        if ends is not None:
            source, behind = ends.source + source, ends.resistance + law.wire
            low, high = board.supply if (board.drive > 0) != circuit.inverts else board.supply[::-1]
            saturates = isfinite(high)
            if isfinite(low):  # an output at this limit leaves its column between the offset and the other lines
                of_cells[ADRIFT] = 2.0 * np.abs(board.offset)
            if saturates:
                beyond = np.abs(high - board.level) + np.abs(board.offset)
                into_end = (1.0 + beyond / drive) / (to_driver + board.reference + own_wire)
            else:
                to_source = ends.resistance + own_wire
                into_end = 1.0 / (to_driver + to_source + LEAST_SHORT_OHM)
                in_own_step = into_end * to_source * drive + np.abs(source)
            if one_by_one:  # others are read while its column ends as idle ones do
                into_idle = 1.0 / (to_driver + board.idle_resistance + own_wire + LEAST_SHORT_OHM)
                whole = board.shared_by >= columns
                into_end = into_idle if whole else np.maximum(into_end, into_idle)
        of_cells[INTO_END], of_cells[IN_OWN_STEP] = into_end, in_own_step
        # The other one of two joined columns ends as idle columns do, where columns are read one by one.
        in_turns = one_by_one and not follows
        idle, idle_source = (board.idle_resistance + law.wire, 0.0 * source) if in_turns else (behind, source)
        idle = np.minimum(idle, 1.0 / TINY)[:, None]
        apart, apart_idle = behind + 2.0 * LEAST_SHORT_OHM, idle.T + 2.0 * LEAST_SHORT_OHM
        into, away = idle / (idle + apart), behind[:, None] / (behind[:, None] + apart_idle)
        # A over what is read of a current: how much of it a joined column takes.
        pairs[PASSES_ON] = np.maximum(into, away) / (1.0 - away)
        pairs[DRIVEN_APART] = np.abs(idle_source[:, None] - source) / (idle + apart)  # A between joined columns
        most_beside = 1.0 / (law.wire[:, None] + law.wire + 2.0 * LEAST_SHORT_OHM)  # S, from column to column
        pairs[BESIDE] = (hidden.T.astype(np.float64) @ hidden) * most_beside
        pairs[:, np.arange(columns), np.arange(columns)] = 0.0
        ways = zeros(Ways, 1)
        for name, value in {
            "drive": board.drive,
            "floating": board.floating,
            "follows": follows,
            "one_by_one": one_by_one,
            "divides": self._divides,
            "holds": ends is not None,
            "saturates": saturates,
            "cancels": law.cancels,
            "mixes": law.has_potential,
            "joins": law.has_leads or board.floating or bool(hidden.any()),
            "breaks": bool(hidden.any()),
            "least_idle": LEAST * float(short.max()),
        }.items():
            ways[name] = value
        pull = np.array(np.broadcast_to(board.pull, rows), dtype=np.float64)
        self.given = of_columns, pull, of_cells, np.array(shared, order="C"), pairs, ways
        """what :func:`enclose` is given of the board"""
        self.bounds_cells = board.plain
        """whether all ways of currents are counted: bridges and sheets have others"""
        self._adrift = bool(of_cells[ADRIFT].any())

    def unheld(self, limited: BoolArray, under_range: BoolArray) -> bool:
        """Whether an amplifier's output may stand at a limit, so that it does not hold its column."""
        return not self._divides and bool(limited.any() or (under_range.any() and self._adrift))
