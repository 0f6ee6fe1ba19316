"""Multi-object tracking of contacts: fading-memory (g-h) filters, linear assignment, Gaussian mixtures.

A track is one finger. Each frame, its position is predicted from the last position and the velocity. Linear assignment
then gives each patch of touched cells to one track, by distance from the prediction and by force. If the cells of a
track without a patch have become part of another track's patch, the tracks have merged and share the patch. The
pressure of a shared patch is modelled as a mixture of Gaussian bells, one for each track, as wide as its finger was
before. Expectation maximisation (EM) finds the centres. Bells on top of each other cannot be told apart; their tracks
continue with their last velocities. When the patch parts again, each piece is assigned in the usual way, and ids
survive.
"""

from __future__ import annotations

import math

import numpy as np

from ..common.compiled import Places, Records, Row, Rows, loop
from ._assignment import assign
from ._touch import MOST_TOGETHER, Memory, Patch, Progress, Scan, Skin, Spot, Track
from ._tuning import (
    ABSENT_S,
    EM_STEPS,
    LEAST_SHARE,
    LEAST_WIDTH_PITCHES,
    MEMORY_S,
    REACH_PITCHES,
    SPEED_MM_PER_S,
    SURE_SHARE,
    TOGETHER_S,
    WIDTH_GAIN,
)

NONE = -1


@loop
def follow(count: int, skin: Skin, memory: Memory, scan: Scan, time_s: float) -> None:
    """Give the first ``count`` patches, which are those of the next frame, the ids of the fingers in them."""
    progress, tracks = memory.progress[0], memory.tracks
    # However slow the frames are, the frame just before counts.
    oldest_s = min(time_s - ABSENT_S, progress.time_s)
    known, places = 0, np.empty(tracks.size, np.intp)
    for place in range(int(progress.tracks)):
        if tracks[place].id > 0.0 and tracks[place].seen_s >= oldest_s:
            places[known] = place
            known += 1
        else:
            tracks[place].id = 0.0
    places = places[:known]
    shared = np.empty(known, np.intp)
    share(places, count, memory, scan.before, time_s, shared)
    for each in places:
        tracks[each].patch = 0.0
    together = np.empty(MOST_TOGETHER, np.intp)
    for k in range(count):
        fingers = strongest(tracks, places, shared, k, together)
        patch = memory.patches[k]
        if fingers == 0:
            together[0] = free_place(progress, tracks)
            enter(tracks[together[0]], progress, patch, time_s)
            fingers = 1
        elif fingers == 1:
            move_alone(tracks[together[0]], patch, time_s)
        else:
            cells = memory.order[int(patch.first) : int(patch.first) + int(patch.cells)]
            fingers = move_together(tracks, together[:fingers], patch, cells, skin.spots, scan.load, time_s)
        name(tracks, together[:fingers], patch)
        for each in together[:fingers]:
            tracks[each].patch = k + 1.0
    last = 0
    for place in range(int(progress.tracks)):
        track = tracks[place]
        if track.id > 0.0:
            last = place + 1
            track.leads = track.leads if track.patch > 0.0 else 0.0
    progress.tracks = float(last)


@loop
def predicted(track: Track, time_s: float, axis: int) -> float:
    """Position in mm at ``time_s``, at constant velocity."""
    return float(track.at_mm[axis] + track.mm_per_s[axis] * (time_s - track.seen_s))


@loop
def distance(one: Row, other: Row) -> float:
    """Of two places (3,)."""
    x, y, z = one[0] - other[0], one[1] - other[1], one[2] - other[2]
    return math.sqrt(x * x + y * y + z * z)


@loop
def share(places: Places, count: int, memory: Memory, before: Places, time_s: float, shared: Places) -> None:
    """Write for each of the tracks at ``places`` (m,) the patch in which it continues; :data:`NONE`: in none.

    A track that was absent in the frame before was lifted. It can get a patch of its own, but cannot merge with another
    track.
    """
    known, tracks, patches = places.size, memory.tracks, memory.patches
    shared[:] = NONE
    if known == 0 or count == 0:
        return
    earlier = 0
    for i in range(before.size):
        earlier = max(earlier, before[i])
    overlaps = np.zeros((earlier + 1, count), np.bool_)  # of labels in the last frame with those of this one
    for i in range(before.size):
        if before[i] > 0 and memory.labels[i] > 0:
            overlaps[before[i], memory.labels[i] - 1] = True
    costs, possible = np.empty((known, count)), np.empty((known, count), np.bool_)
    ahead, centres, here = np.empty((known, 3)), np.empty((count, 3)), np.empty(3)
    impossible = 1.0
    for k in range(count):
        for axis in range(3):
            centres[k, axis] = patches[k].at_mm[axis]
    for j in range(known):
        track = tracks[places[j]]
        for axis in range(3):
            ahead[j, axis], here[axis] = predicted(track, time_s, axis), track.at_mm[axis]
        reach = REACH_PITCHES * track.longest_mm + SPEED_MM_PER_S * abs(time_s - track.seen_s)
        for k in range(count):
            far, moved = distance(ahead[j], centres[k]), distance(here, centres[k])
            # Forces that differ by a factor of e cost as much as a distance of a pitch.
            costs[j, k] = far / track.pitch_mm + abs(math.log(patches[k].force_n / track.force_n))
            possible[j, k] = min(moved, far) <= reach or overlaps[int(track.patch), k]
            if possible[j, k]:
                impossible += costs[j, k]
    # An impossible pair costs more than all possible ones together, so it is chosen only if no possible one is left.
    for j in range(known):
        for k in range(count):
            if not possible[j, k]:
                costs[j, k] = impossible
    assign(costs, shared)
    for j in range(known):
        if shared[j] != NONE and not possible[j, shared[j]]:
            shared[j] = NONE
        if shared[j] == NONE:
            nearest = np.inf
            for k in range(count):
                far = distance(ahead[j], centres[k])
                if overlaps[int(tracks[places[j]].patch), k] and far < nearest:
                    nearest, shared[j] = far, k


@loop
def strongest(tracks: Records[Track], places: Places, shared: Places, patch: int, together: Places) -> int:
    """Write the places of the tracks that share a ``patch``, by falling force; returns their number."""
    fingers = 0
    for j in range(places.size):
        if shared[j] != patch:
            continue
        force, at = tracks[places[j]].force_n, fingers
        while at > 0 and tracks[together[at - 1]].force_n < force:
            at -= 1
        if at == MOST_TOGETHER:
            continue
        fingers = min(fingers + 1, MOST_TOGETHER)
        for later in range(fingers - 1, at, -1):
            together[later] = together[later - 1]
        together[at] = places[j]
    return fingers


@loop
def free_place(progress: Progress, tracks: Records[Track]) -> int:
    """The first free place for a track; if there is none, that of the one that was lifted first."""
    place = 0
    while place < progress.tracks and tracks[place].id > 0.0:
        place += 1
    if place == tracks.size:
        place = 0
        for other in range(tracks.size):
            place = other if tracks[other].seen_s < tracks[place].seen_s else place
    progress.tracks = max(progress.tracks, place + 1.0)
    return place


@loop
def enter(track: Track, progress: Progress, patch: Patch, time_s: float) -> None:
    """Begin a track."""
    progress.last_id += 1.0
    track.id = progress.last_id
    for axis in range(3):
        track.at_mm[axis] = patch.at_mm[axis]
        track.mm_per_s[axis] = track.lag_mm[axis] = 0.0
    track.force_n, track.variance_mm2 = patch.force_n, patch.variance_mm2
    track.pitch_mm, track.longest_mm = patch.pitch_mm, patch.longest_mm
    track.seen_s = track.apart_s = time_s
    track.samples = track.leads = 1.0


@loop
def move(track: Track, x_mm: float, y_mm: float, z_mm: float, time_s: float, trust: float) -> None:
    """Update position and velocity with a position so far from the predicted one (g-h filter).

    ``trust``: 1 if the position was measured, 0 if it follows from the velocity.
    """
    elapsed = time_s - track.seen_s
    track.samples += 1.0
    n, kept = track.samples, math.exp(-elapsed / MEMORY_S)
    # Gains of a least-squares line while there are few samples, of a fading memory from then on.
    position_gain = max(2.0 * (2.0 * n - 1.0) / (n * (n + 1.0)), 1.0 - kept * kept)
    velocity_gain = max(6.0 / (n * (n + 1.0)), (1.0 - kept) * (1.0 - kept))
    for axis in range(3):
        by = x_mm if axis == 0 else y_mm if axis == 1 else z_mm
        track.at_mm[axis] = predicted(track, time_s, axis) + by
        off = by + trust * track.lag_mm[axis]
        track.lag_mm[axis] += by - position_gain * off
        if elapsed > 0.0:
            track.mm_per_s[axis] += velocity_gain / elapsed * off
    track.seen_s = time_s


@loop
def move_alone(track: Track, patch: Patch, time_s: float) -> None:
    """Continue the only track of a patch."""
    x = patch.at_mm[0] - predicted(track, time_s, 0)
    y = patch.at_mm[1] - predicted(track, time_s, 1)
    z = patch.at_mm[2] - predicted(track, time_s, 2)
    move(track, x, y, z, time_s, 1.0)
    track.force_n = patch.force_n
    track.pitch_mm, track.longest_mm = patch.pitch_mm, patch.longest_mm
    if patch.alone > 0.0 or patch.variance_mm2 > track.variance_mm2:  # else too narrow, cut off by a neighbour
        track.variance_mm2 = patch.variance_mm2
    track.apart_s = time_s


@loop
def move_together(
    tracks: Records[Track],
    together: Places,
    patch: Patch,
    cells: Places,
    spots: Records[Spot],
    load: Row,
    time_s: float,
) -> int:
    """Move the tracks that share a patch of ``cells`` (m,); returns how many still do, which come first."""
    count, total = together.size, 0.0
    at, shares, variances, apart = np.empty((count, 3)), np.empty(count), np.empty(count), np.empty(count)
    least = (LEAST_WIDTH_PITCHES * patch.pitch_mm) * (LEAST_WIDTH_PITCHES * patch.pitch_mm)
    for j in range(count):
        track = tracks[together[j]]
        for axis in range(3):
            at[j, axis] = predicted(track, time_s, axis)
        shares[j], variances[j] = track.force_n, max(track.variance_mm2, least)
        total += track.force_n
    some = False
    for j in range(count):
        shares[j] /= total
        nearest = math.inf
        for k in range(count):
            if k != j:
                nearest = min(nearest, distance(at[j], at[k]) / math.sqrt((variances[j] + variances[k]) / 2.0))
        # Bells closer than their width look like one; from twice the width on each has its own maximum.
        apart[j] = min(max(nearest - 1.0, 0.0), 1.0)
        some = some or apart[j] > 0.0
    # Bells that look like one move with the patch's centre. For bells with separate maxima the centre tells less,
    # since it also moves when their forces change.
    placed = np.empty((count, 3))
    for axis in range(3):
        middle = 0.0
        for j in range(count):
            middle += shares[j] * at[j, axis]
        for j in range(count):
            placed[j, axis] = at[j, axis] + (1.0 - apart[j]) * (patch.at_mm[axis] - middle)
    trust = np.zeros(count)
    if some:
        fitted, masses, widths = np.empty((count, 3)), np.empty(count), np.empty(count)
        fit(placed, shares, variances, cells, spots, load, fitted, masses, widths)
        total = 0.0
        for j in range(count):
            track = tracks[together[j]]
            if apart[j] == 1.0:
                track.variance_mm2 += WIDTH_GAIN * (widths[j] - track.variance_mm2)
            trust[j] = apart[j] * min(max((masses[j] - LEAST_SHARE) / (SURE_SHARE - LEAST_SHARE), 0.0), 1.0)
            for axis in range(3):
                placed[j, axis] += trust[j] * (fitted[j, axis] - placed[j, axis])
            shares[j] += apart[j] * (masses[j] - shares[j])
            total += shares[j]
        for j in range(count):
            shares[j] /= total
    largest, staying = 0.0, 0
    for j in range(count):
        largest = max(largest, shares[j])
    for j in range(count):
        track = tracks[together[j]]
        if apart[j] > 0.0:
            track.apart_s = time_s
        if shares[j] < LEAST_SHARE or (time_s - track.apart_s > TOGETHER_S and shares[j] < largest):
            continue  # lifted
        x, y, z = placed[j, 0] - at[j, 0], placed[j, 1] - at[j, 1], placed[j, 2] - at[j, 2]
        move(track, x, y, z, time_s, trust[j])
        track.force_n = shares[j] * patch.force_n
        together[staying] = together[j]
        staying += 1
    return staying


@loop
def fit(
    placed: Rows,
    shares: Row,
    variances: Row,
    cells: Places,
    spots: Records[Spot],
    load: Row,
    fitted: Rows,
    masses: Row,
    widths: Row,
) -> None:
    """A few steps of expectation maximisation (EM) for the bells of a patch.

    Args:
        placed: (n, 3) mm, initial centres.
        shares: (n,) initial shares of the patch's force.
        variances: (n,) mm^2 of the bells as known so far, with which the centres are found.
        cells: (m,) of the patch, whose load is the mixture.
        spots: places of all cells.
        load: N on all cells.
        fitted: (n, 3) written: centres in mm.
        masses: (n,) written: shares of the force.
        widths: (n,) written: variances in mm^2.

    """
    count, total = masses.size, 0.0
    parts, squares, places = np.empty((count, cells.size)), np.empty(count), np.empty((cells.size, 3))
    for c in range(cells.size):
        total += load[cells[c]]
        for axis in range(3):
            places[c, axis] = spots[cells[c]].at_mm[axis]
    for j in range(count):
        masses[j] = shares[j]
        for axis in range(3):
            fitted[j, axis] = placed[j, axis]
    for _ in range(EM_STEPS):
        for c in range(cells.size):
            nearest, bells = math.inf, 0.0
            for j in range(count):
                far = distance(places[c], fitted[j])
                squares[j] = far * far / variances[j]
                nearest = min(nearest, squares[j])
            for j in range(count):
                parts[j, c] = masses[j] / variances[j] * math.exp(-0.5 * (squares[j] - nearest))
                bells += parts[j, c]
            for j in range(count):
                parts[j, c] *= load[cells[c]] / total / max(bells, 1e-300)
        for j in range(count):
            masses[j] = 0.0
            for axis in range(3):
                fitted[j, axis] = 0.0
            for c in range(cells.size):
                masses[j] += parts[j, c]
                for axis in range(3):
                    fitted[j, axis] += parts[j, c] * places[c, axis]
            for axis in range(3):
                fitted[j, axis] /= max(masses[j], 1e-9)
    for j in range(count):
        widths[j] = 0.0
        for c in range(cells.size):
            far = distance(places[c], fitted[j])
            widths[j] += parts[j, c] * far * far
        widths[j] /= 2.0 * max(masses[j], 1e-9)


@loop
def name(tracks: Records[Track], together: Places, patch: Patch) -> None:
    """Write the ids of a patch: it keeps its id, and two merged patches get that of the stronger one."""
    leader = together[0]
    for place in together[1:]:
        one, best = tracks[place], tracks[leader]
        if one.leads > best.leads or (one.leads == best.leads and one.force_n > best.force_n):
            leader = place
    patch.id, patch.others = tracks[leader].id, 0.0
    for place in together:
        track, at = tracks[place], int(patch.others)
        track.leads = 1.0 if place == leader else 0.0
        if place == leader:
            continue
        while at > 0 and patch.joined[at - 1] > track.id:
            patch.joined[at] = patch.joined[at - 1]
            at -= 1
        patch.joined[at] = track.id
        patch.others += 1.0
