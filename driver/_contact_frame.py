"""One frame of contacts as a kernel: patches of touched cells, parted and measured, and the fingers in them."""

from __future__ import annotations

import math

import numpy as np

from ..common.compiled import Flags, PlaceRows, Places, Records, Row, Rows, loop
from ._patches import START_SHARE, WAKE_S, find, find_rim, sort_by_label
from ._touch import Line, Patch, Progress, Spot, Touched, Track, Untouched
from ._tracks import follow
from ._watershed import part

NEWTON = 1e-3
"""of one kPa on one mm^2"""
MISSING_S = 0.2
"""a cell without a reading for longer is missing; until then its last pressure counts"""
NO_ROOM = -1


@loop
def take_frame(
    untouched: Untouched,
    spots: Records[Spot],
    rows: Records[Line],
    columns: Records[Line],
    near: PlaceRows,
    weights: Rows,
    opposite: PlaceRows,
    cells: Records[Touched],
    labels: Places,
    patches: Records[Patch],
    order: Places,
    all_progress: Records[Progress],
    tracks: Records[Track],
    remembered: Places,
    pressure: Row,
    std: Row,
    unread: Flags,
    time_s: float,
) -> int:
    """Find the contacts of the next frame.

    Args:
        untouched: thresholds, and the skin (:class:`._touch.Skin`): ``spots`` to ``opposite``.
        spots: see ``untouched``.
        rows: see ``untouched``.
        columns: see ``untouched``.
        near: see ``untouched``.
        weights: see ``untouched``.
        opposite: see ``untouched``.
        cells: (n,) what is remembered of them.
        labels: (n,) number of the contact of each cell, from 1; 0: none. Those of the last frame; written.
        patches: (n,) the contacts, likewise.
        order: (n,) touched cells in the order of their contacts, written.
        all_progress: (1,)
        tracks: the fingers.
        remembered: cells of the tracks.
        pressure: (n,) kPa; NaN: not known.
        std: (n,) kPa, standard deviations; NaN: not known.
        unread: (n,) cells without a reading in this frame.
        time_s: of the frame.

    Returns:
        The number of contacts; :data:`NO_ROOM`: nothing was taken, as ``tracks`` or ``remembered`` may be too small.

    """
    progress, count = all_progress[0], pressure.size
    if progress.tracks + count > tracks.size or progress.remembered + count > remembered.size:
        return NO_ROOM
    begun = progress.time_s > -math.inf
    elapsed_s = max(time_s - progress.time_s, 0.0) if begun else 0.0
    missing, known_std = np.empty(count, np.bool_), np.empty(count)
    for i in range(count):
        cell, kpa = cells[i], pressure[i]
        if not (unread[i] or math.isnan(kpa)):
            cell.read_s = time_s
        missing[i] = spots[i].exists > 0.0 and time_s - cell.read_s > MISSING_S
        if kpa > START_SHARE * untouched.full_scale_kpa:
            cell.step_kpa = max(cell.step_kpa, kpa - cell.last_kpa)
            # In the first frame: most likely it has been pressed for longer than an intermittent contact lasts.
            cell.pressed_s = min(cell.pressed_s, time_s if begun else -math.inf)
        else:
            cell.step_kpa, cell.pressed_s = 0.0, math.inf
        cell.last_kpa = kpa if math.isfinite(kpa) else 0.0
        cell.wake_kpa *= math.exp(-elapsed_s / WAKE_S)
        known_std[i] = std[i] if std[i] > 0.0 else 0.0  # an unknown deviation counts as 0
    excess, wake, height, load = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    begins, connected = np.empty(count, np.bool_), np.empty(count, np.intp)
    found = find(
        untouched,
        spots,
        near,
        weights,
        rows,
        columns,
        cells,
        labels,
        patches,
        pressure,
        height,
        known_std,
        missing,
        opposite,
        excess,
        wake,
        begins,
        connected,
    )
    touched = 0
    if found == 0:
        for i in range(count):
            labels[i] = 0
    else:
        starts, before = np.empty(count + 2, np.intp), np.empty(count, np.intp)
        for i in range(count):
            before[i] = labels[i]
        sort_by_label(connected, found, starts, order)
        fingers = part(connected, found, starts, order, near, height, known_std, begins, before, labels)
        if fingers > found:
            sort_by_label(labels, fingers, starts, order)
        found, touched = fingers, starts[fingers + 1]
        measure(found, starts, order, connected, spots, height, std, missing, load, patches)
        rim = np.empty(count, np.intp)
        if find_rim(labels, found, order[:touched], near, spots, untouched, excess, wake, height, rim):
            for i in range(count):
                if rim[i] > 0:
                    patch = patches[rim[i] - 1]
                    patch.force_n += NEWTON * spots[i].area_mm2 * height[i]
                    patch.force_std_n += NEWTON * spots[i].area_mm2 * std[i]
    follow(progress, tracks, remembered, patches, found, labels, order[:touched], spots, load, time_s)
    for i in range(count):
        cell, kpa = cells[i], pressure[i]
        if labels[i] > 0:
            cell.wake_kpa = cell.wake_kpa if math.isnan(kpa) else max(cell.wake_kpa, kpa)
        else:  # drift follows the pressure: slowly upwards, at once downwards
            most = min(cell.drift_kpa + untouched.drift_kpa_per_s * elapsed_s, untouched.most_drift_kpa)
            cell.drift_kpa = min(most, 0.0 if math.isnan(kpa) else max(kpa, 0.0))
    progress.time_s, progress.touched = time_s, float(touched)
    return found


@loop
def measure(
    count: int,
    starts: Places,
    order: Places,
    connected: Places,
    spots: Records[Spot],
    height: Row,
    std: Row,
    bridged: Flags,
    load: Row,
    patches: Records[Patch],
) -> None:
    """Centre, force, peak and spread of ``count`` labelled patches.

    Args:
        count: of the patches.
        starts: with ``order``, the cells of each patch (:func:`._patches.sort_by_label`).
        order: see ``starts``.
        connected: (n,) labels before patches that touch each other were separated.
        spots: (n,)
        height: (n,) kPa.
        std: (n,) kPa, NaN where unknown.
        bridged: (n,) cells whose pressures are interpolated.
        load: (n,) written: N on touched cells.
        patches: written, but for their ids.

    """
    together = np.zeros(count + 1, np.intp)
    for k in range(count):
        patch, first, last = patches[k], starts[k + 1], starts[k + 2]
        patch.first, patch.cells = first, last - first
        together[connected[order[first]]] += 1
        force = squares = force_std = guessed = area = pitch = longest = x = y = z = 0.0
        peak = -math.inf
        for cell in order[first:last]:
            spot = spots[cell]
            load[cell] = newton = NEWTON * spot.area_mm2 * height[cell]
            at_x, at_y, at_z = spot.at_mm[0], spot.at_mm[1], spot.at_mm[2]
            force += newton
            x, y, z = x + newton * at_x, y + newton * at_y, z + newton * at_z
            squares += newton * (at_x * at_x + at_y * at_y + at_z * at_z)
            force_std += NEWTON * spot.area_mm2 * std[cell]
            guessed += newton if bridged[cell] else 0.0
            area, pitch = area + spot.area_mm2, pitch + spot.pitch_mm
            peak, longest = max(peak, height[cell]), max(longest, spot.longest_mm)
        x, y, z = x / force, y / force, z / force
        patch.at_mm[0], patch.at_mm[1], patch.at_mm[2] = x, y, z
        patch.force_n, patch.force_std_n, patch.interpolated_n = force, force_std, guessed
        patch.variance_mm2 = (squares / force - (x * x + y * y + z * z)) / 2.0
        patch.peak_kpa, patch.area_mm2 = peak, area
        patch.pitch_mm, patch.longest_mm = pitch / (last - first), longest
    for k in range(count):
        patches[k].alone = 1.0 if together[connected[order[starts[k + 1]]]] == 1 else 0.0
