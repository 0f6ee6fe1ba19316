"""Patches of touched cells: hysteresis thresholds, connected components, and faults told from presses, as kernels.

Cells are those of the flattened array. ``near`` (cells, most) are the neighbours of each one, as
:attr:`ohmskin.common.geometry.Neighbours.near`; the number of cells stands for none.
"""

from __future__ import annotations

import math

import numpy as np

from ..common.compiled import Flags, PlaceRows, Places, Records, Row, loop
from ..common.noise import select
from ._touch import Line, Memory, Patch, Scan, Skin, Spot, Touched
from ._tuning import (
    ALIKE,
    AT_ONCE,
    HELD_STDS,
    INTERMITTENT_S,
    JOIN_SHARE,
    LONGEST_IN_LINE,
    RIM_SHARE,
    STANDS_OUT_STDS,
    START_SHARE,
    SURE_STDS,
    TOGETHER_STDS,
    WAKE_SHARE,
)

TIE = 1e-6
"""relative difference of distances that are equal but for rounding"""
ROW, COLUMN = 0, 1
"""kinds of lines"""


@loop
def find(skin: Skin, memory: Memory, scan: Scan) -> int:
    """Find the patches of a frame: connected cells that may be touched, and are a contact's.

    Written are ``height``, ``missing``, ``excess``, ``wake``, ``begins`` and ``connected`` of the scan.

    Returns:
        The number of patches.

    """
    cells, before, connected = memory.cells, scan.before, scan.connected
    pressure, std, excess, wake, begins = scan.pressure, scan.known_std, scan.excess, scan.wake, scan.begins
    count, full = pressure.size, skin.untouched.full_scale_kpa
    wakes = False
    for i in range(count):
        wakes = wakes or cells[i].wake_kpa > 0.0
    some, unsure = False, False
    loaded = np.empty(count, np.bool_)
    for i in range(count):
        excess[i], wake[i], scan.height[i] = pressure[i] - cells[i].drift_kpa, 0.0, pressure[i]
        if wakes:
            largest = cells[i].wake_kpa
            for other in skin.near[i]:
                if other == count:
                    break
                largest = max(largest, cells[other].wake_kpa)
            wake[i] = WAKE_SHARE * largest
        pressed = excess[i] > max(START_SHARE * full, wake[i])  # False where NaN
        begins[i] = pressed and excess[i] > SURE_STDS * std[i]
        loaded[i] = pressed and not begins[i]
        some = some or begins[i] or before[i] > 0
        unsure = unsure or loaded[i]
    if unsure:
        own = beyond_columns(skin, excess)
        for i in range(count):
            if loaded[i] and together(i, own, std, skin):
                begins[i] = some = True
    if not some:
        connected[:] = 0
        return 0
    wanted = np.empty(count, np.bool_)
    for i in range(count):
        stds, share = (HELD_STDS, START_SHARE / 2.0) if before[i] > 0 else (SURE_STDS / 2.0, JOIN_SHARE)
        wanted[i] = begins[i] or excess[i] > max(stds * std[i], share * full)
    bridge(wanted, skin.opposite, scan)
    found = label(wanted, skin.near, connected)
    kept = np.zeros(found + 1, np.bool_)
    for i in range(count):
        if begins[i]:
            kept[connected[i]] = True
    starts, order = np.empty(found + 2, np.intp), np.empty(count, np.intp)
    sort_by_label(connected, found, starts, order)
    keep_lasting(kept, memory.patches, scan)
    for k in range(1, found + 1):
        own_cells = order[starts[k] : starts[k + 1]]
        behind, fresh = True, True
        for cell in own_cells:
            behind = behind and not excess[cell] > wake[cell]
            fresh = fresh and before[cell] == 0
        kept[k] = kept[k] and not behind
        if kept[k] and fresh:
            kept[k] = is_no_disturbance(own_cells, skin, cells, scan)
    numbers, contacts = np.zeros(found + 1, np.intp), 0
    for k in range(1, found + 1):
        if kept[k]:
            contacts += 1
            numbers[k] = contacts
    for i in range(count):
        connected[i] = numbers[connected[i]]
    return contacts


@loop
def beyond_columns(skin: Skin, excess: Row) -> Row:
    """The excess (n,) beyond what most cells of a column have in common.

    An error of the sum of a divider's readings moves a whole column.
    """
    own, there = np.empty(excess.size), np.empty(excess.size)
    for i in range(excess.size):
        own[i] = excess[i] if math.isfinite(excess[i]) else 0.0
    across = int(skin.untouched.columns)
    for k in range(skin.columns.size):
        line, known = skin.columns[k], 0
        for along in range(int(line.first), int(line.last) + 1):
            cell = along * across + k % across
            if skin.spots[cell].exists > 0.0:
                there[known] = own[cell]
                known += 1
        if known:
            usual = max(select(there, known, (known - 1) // 2), 0.0)
            for along in range(int(line.first), int(line.last) + 1):
                own[along * across + k % across] -= usual
    return own


@loop
def together(cell: int, own: Row, std: Row, skin: Skin) -> bool:
    """Whether a cell is loaded by what its neighbours say together."""
    near, weights, spots = skin.near, skin.weights, skin.spots
    load, spread = own[cell], std[cell]
    load_beyond_row, spread_beyond_row, load_beyond_column, spread_beyond_column = 0.0, 0.0, 0.0, 0.0
    row, column = spots[cell].line[ROW], spots[cell].line[COLUMN]
    for k in range(near.shape[1]):
        other = near[cell, k]
        if other == own.size:
            break
        more, more_spread = weights[cell, k] * own[other], weights[cell, k] * std[other]
        load, spread = load + more, spread + more_spread
        if spots[other].line[ROW] != row:
            load_beyond_row += more
            spread_beyond_row += more_spread
        if spots[other].line[COLUMN] != column:
            load_beyond_column += more
            spread_beyond_column += more_spread
    return bool(
        load > TOGETHER_STDS * spread
        and load_beyond_row > TOGETHER_STDS * spread_beyond_row
        and load_beyond_column > TOGETHER_STDS * spread_beyond_column
    )


@loop
def bridge(wanted: Flags, opposite: PlaceRows, scan: Scan) -> None:
    """Find the missing cells within contacts: linear interpolation over gaps of one cell.

    A dead line, or the column of a shorted cell, would cut a finger into two contacts. A missing cell therefore belongs
    to a contact if two of its neighbours on opposite sides do. Its pressure is the mean of these, but not less than its
    own last one; if the middle of a finger lies on the gap, its force is a lower bound. Gaps of two cells and more are
    not bridged, since there may be two fingers, nor is a gap at the rim of the skin, which has one side only.

    ``wanted`` (n,) and the scan's ``height`` are completed; of its ``missing`` the bridged cells remain.
    """
    pressure, missing = scan.pressure, scan.missing
    count, some = pressure.size, False
    for i in range(count):
        some = some or missing[i]
    if not some:
        return
    sums, ways = np.zeros(count), np.zeros(count)
    for k in range(opposite.shape[0]):
        cell, one, other = opposite[k, 0], opposite[k, 1], opposite[k, 2]
        if missing[cell] and wanted[one] and wanted[other] and not missing[one] and not missing[other]:
            sums[cell] += (pressure[one] + pressure[other]) / 2
            ways[cell] += 1.0
    for i in range(count):
        missing[i] = ways[i] > 0.0
        if missing[i]:
            between = sums[i] / ways[i]
            wanted[i], scan.height[i] = True, between if math.isnan(pressure[i]) else max(pressure[i], between)


@loop
def label(wanted: Flags, near: PlaceRows, labels: Places) -> int:
    """Number connected patches of ``wanted`` cells (n,) in the order of their first cells, from 1; 0 elsewhere."""
    count, none = 0, wanted.size
    waiting = np.empty(none, np.intp)
    labels[:] = 0
    for first in range(none):
        if not wanted[first] or labels[first] > 0:
            continue
        count += 1
        labels[first] = count
        waiting[0] = first
        left = 1
        while left > 0:
            left -= 1
            cell = waiting[left]
            for k in range(near.shape[1]):
                other = near[cell, k]
                if other == none:
                    break
                if wanted[other] and labels[other] == 0:
                    labels[other] = count
                    waiting[left] = other
                    left += 1
    return count


@loop
def sort_by_label(labels: Places, count: int, starts: Places, order: Places) -> None:
    """Sort the labelled cells by their labels (counting sort).

    Args:
        labels: (n,) from 1 to ``count``; 0: none.
        count: of labels.
        starts: (count + 2,) written: the cells with label k are ``order[starts[k]:starts[k + 1]]``.
        order: (n,) written.

    """
    starts[:] = 0
    for i in range(labels.size):
        if labels[i] > 0:
            starts[labels[i]] += 1
    total = 0
    for k in range(count + 2):
        starts[k], total = total, total + starts[k]
    for i in range(labels.size):
        if labels[i] > 0:
            order[starts[labels[i]]] = i
            starts[labels[i]] += 1
    for k in range(count + 1, 0, -1):
        starts[k] = starts[k - 1]
    starts[1] = 0


@loop
def keep_lasting(kept: Flags, patches: Records[Patch], scan: Scan) -> None:
    """Keep patches in which contacts of the last frame, ``patches``, continue.

    A contact continues in the patch that has most of its force now. If none of its patches begins a contact, it
    continues in as many patches as it has fingers. Hysteresis thus lets contacts last, but makes no new contacts of
    cells that a moving finger leaves behind.

    ``kept`` (labels,) are the patches of this frame that make contacts, changed.
    """
    found, before = scan.connected, scan.before
    last = 0
    for i in range(found.size):
        if found[i] > 0 and before[i] > 0 and not kept[found[i]]:
            last = max(last, before[i])
    if last == 0:
        return
    loses, force, has = np.zeros(last + 1, np.bool_), np.empty(kept.size), np.empty(kept.size, np.bool_)
    for i in range(found.size):
        if found[i] > 0 and before[i] > 0 and not kept[found[i]]:
            loses[before[i]] = True
    for contact in range(1, last + 1):
        if not loses[contact]:
            continue
        force[:] = 0.0
        has[:] = False
        begun = False
        for i in range(found.size):
            if before[i] == contact and found[i] > 0:
                has[found[i]] = True
                force[found[i]] += scan.height[i]
                begun = begun or kept[found[i]]
        most = 1 if begun else 1 + int(patches[contact - 1].others)
        for _ in range(most):
            strongest = 0
            for k in range(1, kept.size):
                if has[k] and (strongest == 0 or force[k] > force[strongest]):
                    strongest = k
            if strongest == 0:
                break
            kept[strongest], has[strongest] = True, False


@loop
def is_no_disturbance(own: Places, skin: Skin, cells: Records[Touched], scan: Scan) -> bool:
    """Whether a new patch of cells ``own`` (m,) is a contact rather than an electrical fault."""
    since, lasts = math.inf, -math.inf
    under_range, at_once = True, False
    for i in own:
        cell, above = cells[i], scan.excess[i]
        since, lasts = min(since, cell.pressed_s), max(lasts, cell.read_s - cell.pressed_s)
        under_range = under_range and not above > STANDS_OUT_STDS * scan.known_std[i]
        at_once = at_once or cell.step_kpa > AT_ONCE * above
    if since == -math.inf:
        lasts = math.inf
    if (under_range or at_once) and may_be_fault(own, skin, scan.excess):
        return lasts > INTERMITTENT_S
    return lasts > 0.0 or not (within_line(own, skin.spots, ROW) or within_line(own, skin.spots, COLUMN))


@loop
def may_be_fault(own: Places, skin: Skin, excess: Row) -> bool:
    """Whether cells ``own`` (m,) are what electrical faults move together.

    Whole lines move alike by a converter or a connector. What adds resistance moves a line from a crack to its end, and
    looks like a press only where loads add resistance. The estimator looks after single cells.
    """
    spots, least, most = skin.spots, math.inf, -math.inf
    for i in own:
        least = min(least, excess[i]) if not math.isnan(excess[i]) else -math.inf
        most = max(most, excess[i])
    if least > ALIKE * most and (
        whole_lines(own, spots, skin.rows, ROW) or whole_lines(own, spots, skin.columns, COLUMN)
    ):
        return True
    if skin.untouched.faults_press == 0.0:
        return False
    if within_line(own, spots, ROW):
        return to_end(own, spots, skin.rows, ROW)
    return within_line(own, spots, COLUMN) and to_end(own, spots, skin.columns, COLUMN)


@loop
def within_line(own: Places, spots: Records[Spot], kind: int) -> bool:
    """Whether all cells lie on one row, or one column."""
    within = True
    for i in own:
        within = within and spots[i].line[kind] == spots[own[0]].line[kind]
    return within


@loop
def whole_lines(own: Places, spots: Records[Spot], lines: Records[Line], kind: int) -> bool:
    """Whether the cells are whole rows, or whole columns."""
    counted, total = np.zeros(lines.size, np.bool_), 0.0
    for i in own:
        number = int(spots[i].line[kind])
        if not counted[number]:
            counted[number] = True
            total += lines[number].cells
    return own.size == total


@loop
def to_end(own: Places, spots: Records[Spot], lines: Records[Line], kind: int) -> bool:
    """Whether cells of one line reach an end of it, or are more than a stylus covers."""
    line = lines[int(spots[own[0]].line[kind])]
    for i in own:
        if spots[i].along[kind] in (line.first, line.last):
            return True
    return own.size > LONGEST_IN_LINE


@loop
def find_rim(count: int, touched: int, skin: Skin, memory: Memory, scan: Scan, rim: Places) -> bool:
    """Write the number of the contact (n,) that untouched loaded cells belong to; 0: none. Returns whether any does.

    It is the nearest one that loaded cells connect with; of equally near ones, that with the most pressure. A threshold
    decides which cells are touched. The force of a soft contact goes on beyond it. There are ``count`` contacts, of
    ``touched`` cells.
    """
    labels, spots, excess, height = memory.labels, skin.spots, scan.excess, scan.height
    loaded, force, some = np.empty(labels.size, np.bool_), np.zeros(count + 1), False
    for i in range(labels.size):
        around = labels[i] == 0 and excess[i] > max(RIM_SHARE * skin.untouched.full_scale_kpa, scan.wake[i])
        loaded[i] = around or labels[i] > 0
        some = some or around
        force[labels[i]] += height[i] if labels[i] > 0 else 0.0
    rim[:] = 0
    if not some:
        return False
    regions = np.empty(labels.size, np.intp)
    label(loaded, skin.near, regions)
    for cell in range(labels.size):
        if not loaded[cell] or labels[cell] > 0:
            continue
        least = np.inf
        for other in memory.order[:touched]:
            if regions[other] != regions[cell]:
                continue
            square = 0.0
            for axis in range(3):
                square += (spots[cell].at_mm[axis] - spots[other].at_mm[axis]) ** 2
            nearer = square < (1.0 - TIE) * least
            if nearer or (square <= (1.0 + TIE) * least and force[labels[other]] > force[rim[cell]]):
                least = square if nearer else least
                rim[cell] = labels[other]
    return True
