"""One frame of contacts as a kernel: patches of touched cells, parted and measured, and the fingers in them."""

from __future__ import annotations

import math

import numpy as np

from ..common.compiled import Places, loop
from ._patches import find, find_rim, sort_by_label
from ._touch import Memory, Scan, Skin
from ._tracks import follow
from ._tuning import ABSENT_S, START_SHARE, WAKE_S
from ._watershed import part

NEWTON = 1e-3
"""of one kPa on one mm^2"""


@loop
def take_frame(skin: Skin, memory: Memory, scan: Scan, time_s: float) -> int:
    """Find the contacts of the next frame, whose time, pressures, deviations and unread cells are given.

    Returns:
        Their number.

    """
    progress, count = memory.progress[0], scan.pressure.size
    full_scale_kpa = skin.untouched.full_scale_kpa
    begun = progress.time_s > -math.inf
    elapsed_s = max(time_s - progress.time_s, 0.0) if begun else 0.0
    for i in range(count):
        cell, kpa = memory.cells[i], scan.pressure[i]
        if not (scan.unread[i] or math.isnan(kpa)):
            cell.read_s = time_s
        scan.missing[i] = skin.spots[i].exists > 0.0 and time_s - cell.read_s > ABSENT_S
        if kpa > START_SHARE * full_scale_kpa:
            cell.step_kpa = max(cell.step_kpa, kpa - cell.last_kpa)
            # In the first frame: most likely it has been pressed for longer than an intermittent contact lasts.
            cell.pressed_s = min(cell.pressed_s, time_s if begun else -math.inf)
        else:
            cell.step_kpa, cell.pressed_s = 0.0, math.inf
        cell.last_kpa = kpa if math.isfinite(kpa) else 0.0
        cell.wake_kpa *= math.exp(-elapsed_s / WAKE_S)
        scan.known_std[i] = scan.std[i] if scan.std[i] > 0.0 else 0.0
        scan.before[i] = memory.labels[i]
    found, touched = find(skin, memory, scan), 0
    if found == 0:
        memory.labels[:] = 0
    else:
        starts = np.empty(count + 2, np.intp)
        sort_by_label(scan.connected, found, starts, memory.order)
        fingers = part(found, starts, skin, memory, scan)
        if fingers > found:
            sort_by_label(memory.labels, fingers, starts, memory.order)
        found, touched = fingers, starts[fingers + 1]
        measure(found, starts, skin, memory, scan)
        rim = np.empty(count, np.intp)
        if find_rim(found, touched, skin, memory, scan, rim):
            for i in range(count):
                if rim[i] > 0:
                    patch, area_mm2 = memory.patches[rim[i] - 1], skin.spots[i].area_mm2
                    patch.force_n += NEWTON * area_mm2 * scan.height[i]
                    patch.force_std_n += NEWTON * area_mm2 * scan.std[i]
    follow(found, skin, memory, scan, time_s)
    for i in range(count):
        cell, kpa = memory.cells[i], scan.pressure[i]
        if memory.labels[i] > 0:
            cell.wake_kpa = cell.wake_kpa if math.isnan(kpa) else max(cell.wake_kpa, kpa)
        else:  # drift follows the pressure: slowly upwards, at once downwards
            most = min(cell.drift_kpa + skin.untouched.drift_kpa_per_s * elapsed_s, skin.untouched.most_drift_kpa)
            cell.drift_kpa = min(most, 0.0 if math.isnan(kpa) else max(kpa, 0.0))
    progress.time_s, progress.touched = time_s, float(touched)
    return found


@loop
def measure(count: int, starts: Places, skin: Skin, memory: Memory, scan: Scan) -> None:
    """Write centre, force, peak and spread of ``count`` patches, whose cells are given by ``starts`` and the order."""
    order, connected = memory.order, scan.connected
    together = np.zeros(count + 1, np.intp)
    for k in range(count):
        patch, first, last = memory.patches[k], starts[k + 1], starts[k + 2]
        patch.first, patch.cells = first, last - first
        together[connected[order[first]]] += 1
        force = squares = force_std = guessed = area = pitch = longest = x = y = z = 0.0
        peak = -math.inf
        for cell in order[first:last]:
            spot = skin.spots[cell]
            scan.load[cell] = newton = NEWTON * spot.area_mm2 * scan.height[cell]
            at_x, at_y, at_z = spot.at_mm[0], spot.at_mm[1], spot.at_mm[2]
            force += newton
            x, y, z = x + newton * at_x, y + newton * at_y, z + newton * at_z
            squares += newton * (at_x * at_x + at_y * at_y + at_z * at_z)
            force_std += NEWTON * spot.area_mm2 * scan.std[cell]
            guessed += newton if scan.missing[cell] else 0.0
            area, pitch = area + spot.area_mm2, pitch + spot.pitch_mm
            peak, longest = max(peak, scan.height[cell]), max(longest, spot.longest_mm)
        x, y, z = x / force, y / force, z / force
        patch.at_mm[0], patch.at_mm[1], patch.at_mm[2] = x, y, z
        patch.force_n, patch.force_std_n, patch.interpolated_n = force, force_std, guessed
        patch.variance_mm2 = (squares / force - (x * x + y * y + z * z)) / 2.0
        patch.peak_kpa, patch.area_mm2 = peak, area
        patch.pitch_mm, patch.longest_mm = pitch / (last - first), longest
    for k in range(count):
        memory.patches[k].alone = 1.0 if together[connected[order[starts[k + 1]]]] == 1 else 0.0
