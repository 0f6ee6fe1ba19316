"""Compiled loop for the effect of shorts behind amplifiers on other cells: the terms of :class:`.CellsAtLimits`.

:mod:`._amplified_limits` has the same terms as array operations, and explains them. The loop visits only the rows with
a short.
"""

from __future__ import annotations

import numpy as np

from ...common.compiled import FixedRow, FixedRows, FlagRows, Row, Rows, loop
from ._amplified_board import BOUNDLESS, MARGIN


@loop
def by_shorts(
    cells: Rows,
    shorts: FlagRows,
    saturated: FlagRows,
    to_driver: FixedRows,
    to_amplifier: FixedRows,
    short_along: FixedRows,
    short_down: FixedRows,
    short_conductance: FixedRows,
    short_share: FixedRows,
    most_per_ohm: FixedRow,
    source: FixedRow,
    floor: float,
    fixed: Rows,
    added: Rows,
    by_lines: Rows,
) -> None:
    """Add the effect of shorts on other cells to three arrays (N, M), the fields of a disturbance.

    Args:
        cells: (N, M) S.
        shorts: (N, M) where cells may be shorts.
        saturated: (N, M) those whose amplifier is at a limit.
        to_driver: (N, M) ohm from each crosspoint to the row's driver.
        to_amplifier: (N, M) ohm from each crosspoint to the column's amplifier.
        short_along: (N, M) relative change along the row by a short at each place.
        short_down: (N, M) relative change down the column by a short at each place.
        short_conductance: (N, M) S of a short at each place in series with its lines.
        short_share: (N, M) share of a current into the row that a short takes.
        most_per_ohm: (M,) S into a saturated column's end.
        source: (M,) V behind the columns' ends per volt of drive.
        floor: S, least conductance that a relative change refers to.
        fixed: (N, M) 0, relative change that does not depend on the conductances.
        added: (N, M) S, current of other cells.
        by_lines: (N, M) relative change because the load of the lines changes.

    """
    rows, columns = cells.shape
    in_row = np.zeros(rows)  # shorts
    down, column, by_source = np.zeros(columns), np.zeros(columns), np.zeros(columns)
    ordinary, most = np.empty((rows, columns)), np.empty((rows, columns))
    for i in range(rows):
        for j in range(columns):
            column[j] += cells[i, j]
            if shorts[i, j]:
                in_row[i] += 1.0
                down[j] += short_down[i, j]
                by_source[j] += short_conductance[i, j]
                ordinary[i, j], most[i, j] = 0.0, min(short_conductance[i, j], BOUNDLESS)
            else:
                ordinary[i, j], most[i, j] = cells[i, j], cells[i, j]
    for j in range(columns):
        column[j] *= 1.0 + min(down[j], BOUNDLESS)
        by_source[j] = abs(source[j]) * by_source[j] if source[j] != 0.0 else 0.0
    for i in range(rows):
        along = 0.0
        for j in range(columns):
            if saturated[i, j]:
                held = to_driver[i, j] * (most_per_ohm[j] + column[j])
                along += held if held < short_along[i, j] else short_along[i, j]
            elif shorts[i, j]:
                along += MARGIN * short_along[i, j]
        for j in range(columns):
            fixed[i, j] = along + MARGIN * down[j]
    for k in range(rows):
        if in_row[k] == 0.0:
            continue
        for i in range(rows):
            if i == k:
                continue
            lifts = fed = takes = 0.0
            for j in range(columns):
                if shorts[k, j]:
                    lifts += most[i, j] * to_amplifier[k, j]
                    takes += to_driver[i, j] * most[i, j]
                fed += ordinary[i, j] * ordinary[k, j] * to_amplifier[k, j]
            for j in range(columns):
                added[i, j] += lifts * ordinary[k, j]
                if shorts[k, j]:
                    added[i, j] += fed * short_share[k, j]
                added[k, j] += takes * most[i, j]
        if in_row[k] > 1.0:
            _joined(k, cells, shorts, to_driver, to_amplifier, source, added, by_source)
    for i in range(rows):
        if in_row[i] == 0.0:
            continue
        largest = 0.0
        for j in range(columns):
            if shorts[i, j]:
                largest = max(largest, abs(source[j]))
        for j in range(columns):
            by_source[j] += (abs(source[j]) + largest) * (cells[i, j] * (1.0 + min(fixed[i, j], BOUNDLESS)))
    on_column = np.zeros(columns)
    for i in range(rows):
        on_row = 0.0
        for j in range(columns):
            added[i, j] = MARGIN * (added[i, j] + by_source[j])
            direct = fixed[i, j] + added[i, j] / max(cells[i, j], floor)
            misjudged = min(direct, BOUNDLESS) * ordinary[i, j]
            on_row += to_driver[i, j] * misjudged
            on_column[j] += to_amplifier[i, j] * misjudged
        for j in range(columns):
            by_lines[i, j] += on_row
    for i in range(rows):
        for j in range(columns):
            by_lines[i, j] += on_column[j]


@loop
def _joined(
    row: int,
    cells: Rows,
    shorts: FlagRows,
    to_driver: FixedRows,
    to_amplifier: FixedRows,
    source: FixedRow,
    added: Rows,
    by_source: Row,
) -> None:
    """Add the currents between columns that one row's shorts join: :mod:`._joined_columns`."""
    rows, columns = cells.shape
    for one in range(columns):
        if not shorts[row, one]:
            continue
        into, driver = to_amplifier[row, one], to_driver[row, one]
        for other in range(columns):
            if other == one or not shorts[row, other]:
                continue
            there, out = min(driver, to_driver[row, other]), to_amplifier[row, other]
            whole = there * into + into * out + there * out
            share = there * into / whole if whole > 0.0 else 0.0
            for i in range(rows):
                if i != row:
                    added[i, other] += cells[i, one] * share
            apart = abs(source[one] - source[other])
            if apart > 0.0:
                by_source[one] += apart / (into + out + abs(driver - to_driver[row, other]))
