"""Kernels of the laws of columns and rows (:mod:`._law`), of their errors, and of factors (:mod:`._factors`).

Each works on one frame of N x M cells. The equations stand in the modules that call the kernels.
"""

from __future__ import annotations

import math

from ...common.compiled import FlagRows, Row, Rows, loop
from ._tuning import LARGEST_LOG, LEAST, NARROWED, NARROWING_ROUNDS, OPEN, OPEN_ROW, OPEN_SCALE

TINY = 2.3e-308


@loop
def columns_of(
    volts: Rows,
    current: Rows,
    potential: Rows,
    driving: Rows,
    present: FlagRows,
    unknown: FlagRows,
    shorts: Rows,
    most: Row,
    least_left: Row,
    apart: Rows,
    share: Rows,
    drive: Rows,
    left: Row,
    total: Row,
    driven: Rows,
) -> None:
    """Port conductances behind ``volts`` (N, M): the law of columns of :mod:`._law`.

    The column's potential counts for no unknown cell, nor does such a cell conduct more than a short does.

    Args:
        volts: readings.
        current: (2, M) A and A/V, ``PortLaw.current``; likewise ``potential`` and ``driving``.
        present: cells that take part.
        unknown: cells whose readings state bounds only.
        shorts: S, D of complete shorts; 0 at other cells.
        most: (N,) S, D of a short behind each row.
        least_left: (M,) least share of a drive left at a column.
        apart: S, written: I / W, the conductance if the column had no potential.
        share: C / W, written.
        drive: V, W, written.
        left: (M,) 1 - sum(C / W), written: share of the drive at a column while all rows are driven.
        total: (M,) S, T, written.
        driven: S, D, written.
    """
    rows, columns = volts.shape
    for j in range(columns):
        left[j] = 1.0
        total[j] = 0.0
    for i in range(rows):
        for j in range(columns):
            w = driving[0, j] + driving[1, j] * volts[i, j]
            own, shared = 0.0, 0.0
            if present[i, j]:
                own = (current[0, j] + current[1, j] * volts[i, j]) / w
                if unknown[i, j]:
                    own = min(max(own, 0.0), most[i])
                else:
                    shared = (potential[0, j] + potential[1, j] * volts[i, j]) / w
            own += shorts[i, j]
            drive[i, j], apart[i, j], share[i, j] = w, own, shared
            left[j] -= shared
            total[j] += own
    for j in range(columns):
        total[j] /= max(left[j], least_left[j])
    for i in range(rows):
        for j in range(columns):
            driven[i, j] = apart[i, j] + share[i, j] * total[j]


@loop
def rows_of(
    driven: Rows,
    drive: Rows,
    lead: Row,
    segments: Rows,
    beside_end: Rows,
    least_row_left: Row,
    floating: bool,
    row_left: Row,
    cells: Rows,
) -> None:
    """Cells (N, M) in S behind their rows: the law of rows of :mod:`._law`.

    Args:
        driven: S, port conductances.
        drive: V, by which the row stands above the idle lines while each cell is read.
        lead: (N,) ohm, mean from a row's driver to its cells.
        segments: ohm, of each row up to the first cell, and from cell to cell.
        beside_end: ohm, wire from a cell to its column's end in excess of the mean, which the potential counts.
        least_row_left: (N,) least share of a drive left at a row.
        floating: whether idle rows float: then columns of one step stand at different potentials, each with its drive.
        row_left: (N,) 1 - r sum(D), written: share of the drive at a row while all columns are at its foot.
        cells: written.
    """
    rows, columns = driven.shape
    for i in range(rows):
        of_row = 0.0
        for j in range(columns):
            of_row += driven[i, j]
        row_left[i] = 1.0 - lead[i] * of_row
        current = 0.0
        for j in range(columns):
            current += driven[i, j] * (drive[i, j] if floating else 1.0)
        lost, beyond = 0.0, current  # of the drive up to a cell, and currents from there to the row's end
        for j in range(columns):
            full = drive[i, j] if floating else 1.0
            lost += segments[i, j] * beyond
            beyond -= driven[i, j] * full
            foot = 1.0 - lost / full - driven[i, j] * beside_end[i, j]
            cells[i, j] = driven[i, j] / max(foot, least_row_left[i])


@loop
def errors_of(
    volts: Rows,
    middle: Row,
    current: Rows,
    potential: Rows,
    driving: Rows,
    lead: Row,
    present: FlagRows,
    unknown: FlagRows,
    apart: Rows,
    share: Rows,
    drive: Rows,
    left: Row,
    total: Row,
    driven: Rows,
    row_left: Row,
    error: float,
    random: float,
    by_steps: float,
    by_noise: float,
    rounding: float,
    shifted: float,
    mixes: bool,
    has_leads: bool,
    alike: bool,
    one_by_one: bool,
    of_driven: Rows,
    per_volt: Rows,
    beside: Rows,
    own: Rows,
    linear: Rows,
    std: Rows,
    of_left: Row,
    column_open: Row,
    of_sums: Row,
    row_open: Row,
    sums: Rows,
) -> bool:
    """Errors of the cells by the derivatives of the laws; True: those of a column or a row may change other cells.

    Args:
        volts: readings; all arguments up to ``row_left`` as above.
        middle: (M,) V, median reading of each column, with which others may be rounded alike; NaN: none is.
        error: V, of a reading.
        random: V, what differs from reading to reading.
        by_steps: V, the part of it by ADC steps; ``by_noise`` by noise.
        rounding: V, largest error by rounding.
        shifted: V, error that all readings share.
        mixes: whether columns leave the potential of idle lines.
        has_leads: whether rows have leads.
        alike: whether equal readings of a column add up, as in dividers.
        one_by_one: whether idle columns carry no load.
        of_driven: S, of the port conductances, written.
        per_volt: 1/V, relative change by the cell's own reading, written; ``beside`` by errors of its column, signed.
        own: relative error by the cell's own reading, written; ``linear`` by all readings.
        std: 1/V, relative change by independent errors of all readings, written.
        of_left: (M,) error of ``left``, written; ``column_open`` relative to it.
        of_sums: (N,) S, error of a row's sum, written; ``row_open`` of ``row_left``, relative to it.
        sums: (3, M) changed.
    """
    rows, columns = volts.shape
    below = 0.0
    if mixes and alike and not one_by_one:
        for i in range(rows):
            of_row = 0.0
            for j in range(columns):
                of_row += apart[i, j]
            below = max(below, lead[i] * of_row)
    opens = False
    for j in range(columns):
        i1, c1, w1 = current[1, j], potential[1, j], driving[1, j]
        squares, slopes, shares, all_shares, equal = 0.0, 0.0, 0.0, 0.0, 0
        for i in range(rows):
            slope = 0.0
            if present[i, j]:
                slope = abs((i1 + total[j] * c1 - w1 * driven[i, j]) / drive[i, j])
            of_driven[i, j] = error * slope
            slope = 0.0 if unknown[i, j] else slope
            squares += slope * slope
            slopes += slope
            of_share = abs((c1 - w1 * share[i, j]) / drive[i, j])
            shares += of_share * of_share
            all_shares += of_share
            if volts[i, j] == middle[j]:
                equal += 1
        counted = by_steps * by_steps  # squared error of a reading that counts in its column, by rounding
        if equal:
            together = (3.0 * equal * equal + 3.0 * counted / (rounding * rounding) * (rows - equal)) / rows
            counted = max(counted, together * rounding * rounding / 3.0)
        counted += by_noise * by_noise
        sums[0, j], sums[1, j], sums[2, j] = squares, slopes, counted
        of_left[j] = 0.0
        if mixes:
            of_left[j] = math.sqrt(shares * counted) + all_shares * shifted
            if alike and not one_by_one and left[j] - of_left[j] < below:
                of_left[j] = math.inf
        column_open[j] = of_left[j] / max(left[j], LEAST)
        if math.isinf(of_left[j]) or (has_leads and column_open[j] > OPEN_SCALE):
            opens = True
    for i in range(rows):
        moved, shifts, height = 0.0, 0.0, LEAST
        for j in range(columns):
            slope = 0.0 if unknown[i, j] else of_driven[i, j] / error
            by_column = share[i, j] / max(left[j], LEAST) if mixes else 0.0
            moved += slope * slope * (1.0 + 2.0 * abs(by_column)) + by_column * by_column * sums[0, j]
            shifts += slope * abs(1.0 + by_column)
            height = max(height, share[i, j])
        by_row = lead[i] / max(row_left[i], LEAST)
        of_sums[i] = math.sqrt(moved) * random
        row_open[i] = of_sums[i] * by_row
        known = 1.0
        if has_leads and alike:  # a row stands between the drive and the highest of its columns
            height = min(height, 1.0)
            known = min((1.0 - height) / height / max(row_open[i], LEAST), 1.0)
            row_open[i] *= known
            of_sums[i] *= known
        if row_open[i] > OPEN_ROW:
            opens = True
        for j in range(columns):
            slope = 0.0 if unknown[i, j] else of_driven[i, j] / error
            by_column = share[i, j] / max(left[j], LEAST) if mixes else 0.0
            weight = 1.0 / max(abs(driven[i, j]), TINY) + by_row  # relative change of a cell per change of its own D
            per_volt[i, j] = slope * weight
            by_own = abs(per_volt[i, j] * (1.0 + by_column))
            own[i, j] = error * by_own
            beside[i, j] = by_column * weight
            squared = slope * slope * random * random
            others = max(beside[i, j] * beside[i, j] * (sums[0, j] * sums[2, j] - squared), 0.0)
            here = slope * slope * (1.0 + 2.0 * abs(by_column)) + by_column * by_column * sums[0, j]
            in_row = by_row * known * random
            others += in_row * in_row * max(moved - here, 0.0)
            by_shift = (abs(beside[i, j]) * sums[1, j] + by_row * known * shifts) * shifted
            of_own = by_own * random
            both = math.sqrt(of_own * of_own + others)
            std[i, j] = both / random
            # Two bounds: what the cell's own reading may be off, and what all readings are off together.
            linear[i, j] = min(own[i, j] + math.sqrt(others), max(own[i, j], both)) + by_shift
            beside[i, j] *= math.sqrt(sums[0, j])
    return opens


@loop
def relative_to(
    cells: Rows, by_law: Rows, own: Rows, linear: Rows, column_open: Row, row_open: Row, uncertainty: Rows
) -> None:
    """Write the relative uncertainty (N, M) of ``cells`` in S, which the laws gave before they were corrected.

    Errors of other readings are errors of a factor, and count as an exponential.
    """
    rows, columns = cells.shape
    for i in range(rows):
        for j in range(columns):
            uncertainty[i, j] = math.inf
            if cells[i, j] > 0.0 and column_open[j] + row_open[i] < OPEN_SCALE:
                beyond = math.expm1(min(linear[i, j] - own[i, j], LARGEST_LOG))
                uncertainty[i, j] = (own[i, j] + beyond) * max(abs(by_law[i, j]) / cells[i, j], 1.0)


@loop
def couple(cells: Rows, lead: Row, behind: Row, floating: bool, coupling: Row) -> None:
    """Raise to its value at ``cells`` (N, M) in S the share (M,) of a column's current that may pass to other columns.

    It passes by way of the rows, behind leads of ``lead`` (N,) ohm, from a column that ends in ``behind`` (M,) ohm.
    """
    rows, columns = cells.shape
    loss = 0.0
    for i in range(rows):
        of_row = 0.0
        for j in range(columns):
            of_row += max(cells[i, j], 0.0)
        loss = max(loss, lead[i] * of_row)
    for j in range(columns):
        passed = 0.0
        for i in range(rows):
            passed += max(cells[i, j], 0.0)
        passed *= behind[j]
        coupling[j] = max(coupling[j], passed if floating else loss * passed / (1.0 + passed))


@loop
def beside(beyond: float) -> float:
    """What passes beside a cell, or what is lost of its drive, over the cell, whose factor is 1 + ``beyond``."""
    return beyond if beyond >= 0.0 else -beyond / max(1.0 + beyond, TINY)


@loop
def move(
    change: Rows,
    cells: Rows,
    base: Rows,
    beyond: Rows,
    added: Rows,
    coupling: Row,
    row_sums: Row,
    column_sums: Row,
    matters: FlagRows,
    in_columns: Row,
    off: Rows,
) -> None:
    """Write the relative change of ``cells`` by their factors, to first order, by a ``change`` in S of the cells.

    Args:
        change: S (N, M).
        cells: S, now.
        base: S, cells at which the factors were made.
        beyond: factors less 1 there.
        added: S, differences that take the place of factors; 0 at all other cells.
        coupling: (M,) factors by which columns may differ though they do not where cells are equal.
        row_sums: (N,) S of the base; ``column_sums`` (M,) likewise.
        matters: cells that count.
        in_columns: (M,) changed.
        off: written.
    """
    rows, columns = change.shape
    passed = 0.0
    for j in range(columns):
        passed = max(passed, coupling[j])
        most, moved = coupling[j], 0.0
        for i in range(rows):
            moved += change[i, j]
            if matters[i, j] and added[i, j] == 0.0:
                most = max(most, beside(beyond[i, j]))
        in_columns[j] = most * moved / column_sums[j]
    for i in range(rows):
        most, moved = 0.0, 0.0
        for j in range(columns):
            moved += change[i, j]
            if matters[i, j] and added[i, j] == 0.0:
                most = max(most, abs(beyond[i, j]))
        by_row = most * moved / row_sums[i]
        for j in range(columns):
            # What its column lets out follows a cell, and what passes beside it does not fall with it, though nothing
            # may be left of both where cells are equal.
            least, passes = max(cells[i, j], OPEN), beside(beyond[i, j])
            fallen = change[i, j] * max(1.0 / least - 1.0 / base[i, j], 0.0)
            off[i, j] = by_row + in_columns[j] + min(change[i, j] / base[i, j], 1.0) * max(passes, coupling[j])
            off[i, j] += fallen * max(passes, passed)
            if added[i, j] != 0.0:
                off[i, j] *= max(max(base[i, j], abs(added[i, j])) / least, 1.0)


@loop
def answers(
    volts: Rows,
    current: Rows,
    potential: Rows,
    driving: Rows,
    present: FlagRows,
    unknown: FlagRows,
    under_range: FlagRows,
    lead: Row,
    cell_most: Rows,
    beyond: Rows,
    out: Row,
    column_most: Row,
    floating: bool,
    error: float,
    below: Rows,
    above: Rows,
    sums: Rows,
    alone: Rows,
    low: Rows,
    high: Rows,
) -> None:
    """Bounds on all cells (N, M) in S that give readings within their error, where idle columns conduct.

    See :class:`Law`, method ``answers``. Each round narrows the bounds; they hold in every round.

    Args:
        volts: readings; ``current``, ``potential``, ``driving``, ``present``: as in :func:`columns_of`.
        unknown: cells whose readings state lower bounds only, and ``under_range`` ones that state upper bounds.
        lead: (N,) ohm of the rows.
        cell_most: S, bounds on the cells before anything is read; ``beyond`` on what they conduct to the ends of idle
            columns, ``out`` (M,) on what all other columns do together, ``column_most`` on all of a column's cells.
        floating: whether idle rows conduct to other columns only.
        error: V, of a reading.
        below: S, bounds of the port conductances; changed, as ``above``, ``sums`` (4, max(N, M)), ``alone`` (2, N).
        low: written, and ``high``.
    """
    rows, columns = volts.shape
    for i in range(rows):
        sums[2, i] = 0.0
        for j in range(columns):
            below[i, j] = 0.0
            above[i, j] = cell_most[i, j] / (1.0 + lead[i] * cell_most[i, j]) if present[i, j] else 0.0
            most = above[i, j]
            for side in range(2):
                y = volts[i, j] + (2 * side - 1) * error
                w = driving[0, j] + driving[1, j] * y
                if w * driving[0, j] <= 0.0 or unknown[i, j]:
                    most = math.inf
                else:
                    by_sum = max((potential[0, j] + potential[1, j] * y) / w, 0.0) * column_most[j]
                    most = max(most if side else 0.0, (current[0, j] + current[1, j] * y) / w + by_sum)
            low[i, j] = min(max(most, 0.0), above[i, j])
            sums[2, i] += low[i, j]
    for j in range(columns):
        sums[0, j], sums[1, j] = 0.0, column_most[j]
        for i in range(rows):  # two cells of a row join their columns
            left = 1.0 - lead[i] * low[i, j]
            passed = 1.0 - lead[i] * (sums[2, i] - low[i, j]) / left if left > LEAST else 0.0
            sums[1, j] += low[i, j] * (1.0 / max(passed, LEAST) - 1.0)
    for _ in range(NARROWING_ROUNDS):
        moved = 0.0
        for i in range(rows):
            sums[2, i], sums[3, i] = 0.0, 0.0
            for j in range(columns):
                sums[2, i] += above[i, j]
                sums[3, i] += below[i, j]
        for j in range(columns):
            least, least_share, most, most_share = 0.0, 0.0, 0.0, 0.0
            # What drivers take, and the row that stands highest: idle columns take no more of it than ``out``.
            direct, direct_share, top, top_share = 0.0, 0.0, 0.0, 0.0
            for i in range(rows):
                if not present[i, j]:
                    continue
                r = lead[i]
                # What the column's cell conducts to ground by way of its row and the other idle columns.
                of_others = 1.0
                for other in range(columns):
                    if other != j:
                        of_others += r * beyond[i, other]
                others_least, others_most = sums[3, i] - below[i, j], sums[2, i] - above[i, j]
                left = 1.0 - r * above[i, j]
                if not floating:
                    most_passed = 1.0 - r * others_most / left if left > LEAST else 0.0
                    least_passed, most_passed = 1.0, min(1.0 / max(most_passed, LEAST), of_others)
                    least_alone, most_alone = 0.0, 0.0
                else:
                    least_alone = below[i, j] / max(below[i, j] + others_most, LEAST)
                    most_alone = min(above[i, j] / max(above[i, j] + others_least, LEAST), 1.0)
                    least_passed = (1.0 - most_alone) / max(1.0 - r * sums[3, i], LEAST)
                    of_all = min(1.0 / max(1.0 - r * sums[2, i], LEAST), of_others / max(left, LEAST))
                    most_passed = (1.0 - least_alone) * of_all
                if unknown[i, j]:
                    least += least_passed * below[i, j]
                    alone[0, i], alone[1, i] = 1.0, 1.0
                    most += most_passed * above[i, j]
                    direct += above[i, j]
                    top = max(top, r * above[i, j])
                    continue
                own, own_most = math.inf, -math.inf
                share, share_most = math.inf, -math.inf
                positive = True
                for side in range(2):
                    y = volts[i, j] + (2 * side - 1) * error
                    w = driving[0, j] + driving[1, j] * y
                    if w * driving[0, j] <= 0.0:
                        positive = False
                    else:
                        own = min(own, (current[0, j] + current[1, j] * y) / w)
                        own_most = max(own_most, (current[0, j] + current[1, j] * y) / w)
                        share = min(share, (potential[0, j] + potential[1, j] * y) / w)
                        share_most = max(share_most, (potential[0, j] + potential[1, j] * y) / w)
                if not positive:
                    own_most, share_most = math.inf, math.inf
                if math.isinf(own):
                    own, share = 0.0, 0.0
                # Selected, the row holds its cell better than while it floats: D (1 - a C/W) = I/W + U C/W, where
                # U is what all of the column's cells conduct while their rows float, and a their share in their rows.
                alone[0, i] = 1.0 / max(1.0 - min(share * least_alone, share * most_alone), LEAST)
                alone[1, i] = 1.0 / max(1.0 - max(share_most * least_alone, share_most * most_alone), LEAST)
                least_passed, most_passed = least_passed * alone[0, i], most_passed * alone[1, i]
                if not under_range[i, j]:
                    least += own * (least_passed if own > 0.0 else most_passed)
                    least_share += share * (least_passed if share > 0.0 else most_passed)
                if own_most > 0.0:
                    most += own_most * most_passed
                    direct += own_most
                    top = max(top, r * own_most)
                direct_share += share_most
                top_share = max(top_share, r * share_most)
                most_share += share_most * (most_passed if share_most > 0.0 else least_passed)
                if share > 0.0 and not under_range[i, j]:
                    sums[1, j] = min(sums[1, j], max(cell_most[i, j] / (1.0 + r * cell_most[i, j]) - own, 0.0) / share)
            if most_share < 1.0 and most < math.inf:
                sums[1, j] = min(sums[1, j], most / (1.0 - most_share))
            direct_share += out[j] * top_share
            if direct_share < 1.0 and direct + out[j] * top < math.inf and not floating:
                sums[1, j] = min(sums[1, j], (direct + out[j] * top) / (1.0 - direct_share))
            if least_share < 1.0:
                sums[0, j] = max(sums[0, j], least / (1.0 - least_share))
            for i in range(rows):
                if not present[i, j]:
                    continue
                lowest, highest = math.inf, -math.inf
                for side in range(2):
                    y = volts[i, j] + (2 * side - 1) * error
                    w = driving[0, j] + driving[1, j] * y
                    if w * driving[0, j] <= 0.0:
                        highest = math.inf
                        continue
                    own, share = (current[0, j] + current[1, j] * y) / w, (potential[0, j] + potential[1, j] * y) / w
                    lowest = min(lowest, own + share * (sums[0, j] if share > 0.0 else sums[1, j]))
                    highest = max(highest, own + share * (sums[1, j] if share > 0.0 else sums[0, j]))
                lowest *= alone[0 if lowest > 0.0 else 1, i]
                highest *= alone[1 if highest > 0.0 else 0, i]
                if below[i, j] < lowest < math.inf and not under_range[i, j]:
                    moved = max(moved, 1.0 - below[i, j] / lowest)
                    below[i, j] = min(lowest, above[i, j])
                if highest < above[i, j] and not unknown[i, j]:
                    moved = max(moved, 1.0 - max(highest, 0.0) / above[i, j])
                    above[i, j] = max(highest, below[i, j])
        if moved < NARROWED:
            break
    for i in range(rows):
        least, most, whole = 0.0, 0.0, 1.0
        for j in range(columns):
            least += below[i, j]
            most += above[i, j]
            whole += lead[i] * beyond[i, j]
        for j in range(columns):
            low[i, j] = below[i, j] / max(1.0 - lead[i] * least, LEAST)
            of_all = (whole - lead[i] * beyond[i, j]) / max(1.0 - lead[i] * above[i, j], LEAST)
            high[i, j] = min(above[i, j] * min(1.0 / max(1.0 - lead[i] * most, LEAST), of_all), cell_most[i, j])
