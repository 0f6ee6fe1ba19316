"""Multi-object tracking of contacts: fading-memory (g-h) filters, linear assignment, Gaussian mixtures.

A track is one finger. Each frame its position is predicted from the last one and its velocity. Linear assignment then
gives each patch of touched cells to one track, by distance from the prediction and by force. A track left over whose
cells have become part of a patch has merged: several tracks then share the patch. The pressure of a shared patch is
taken for a mixture of Gaussian bells, one for each track, as wide as its finger was before. Expectation maximisation
(EM) finds the centres. Bells that lie upon each other cannot be told apart; their tracks go on with the velocities that
they had. When the patch parts again, each piece is given to a track in the usual way, so ids survive.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

from ..arrays import BoolArray, FloatArray, IntArray

SPEED_MM_PER_S = 500.0
REACH_PITCHES = 1.5
"""a contact is at most this far from where it was, or from where it must be by its velocity, plus what the speed above
allows in the time since then"""
REMEMBERED_S = 0.2
"""a contact that returns within this time keeps its id"""
MEMORY_S = 0.05
"""time constant of positions and velocities: fingers turn more slowly, and noise is averaged"""
FORCE_PITCHES = 1.0
"""a force that differs by a factor of e speaks against a pair as much as so many pitches of distance do"""
MOST_TOGETHER = 8
"""tracks that share a patch; of more, those with the largest forces"""
LEAST_SHARE = 0.1
"""of a patch's force: a track with less has been lifted"""
SURE_SHARE = 0.35
"""a track with less is moved by the fit in part only: that of a finger which is being lifted slides to its neighbour"""
TOGETHER_S = 1.0
"""two fingers are not in one place for longer: the weaker one has been lifted there"""
EM_STEPS = 2
"""per frame; a frame begins where the last one ended"""
WIDTH_GAIN = 0.2
"""per frame, with which the width of a bell follows the fit while each bell has a top of its own"""
LEAST_WIDTH_PITCHES = 0.5
"""standard deviation of the bell of a contact on one cell"""


@dataclass(slots=True)
class Patch:
    """Connected touched cells of one frame."""

    x_mm: float
    y_mm: float
    """centre of pressure"""
    force_n: float
    peak_kpa: float
    variance_mm2: float
    """of the pressure about the centre, along one axis"""
    alone: bool
    """no other patch touches this one, which would cut off its side"""
    cells: IntArray
    """(n,) numbers in the flattened array"""
    places: IntArray
    """(n, 2) rows and columns"""
    places_mm: FloatArray
    """(n, 2) x and y of the cells' middles"""
    pressure_kpa: FloatArray
    """(n,)"""
    interpolated_n: float = 0.0
    """part of the force on cells that are not read"""


@dataclass(slots=True)
class Track:
    """One finger, alone in its patch or sharing it."""

    id: int
    x_mm: float
    y_mm: float
    """where it was seen last, or where it must have been if nothing told it from others"""
    force_n: float
    variance_mm2: float
    cells: IntArray
    """of the patch in which it was seen last"""
    seen_s: float
    apart_s: float
    """when something told it from its neighbours last"""
    vx: float = 0.0
    """mm/s"""
    vy: float = 0.0
    lag_x: float = 0.0
    """mm from the smoothed position, whose change is the velocity, to the position"""
    lag_y: float = 0.0
    samples: int = 1
    leads: bool = True
    """its id is that of its patch"""

    def predicted(self, time_s: float) -> tuple[float, float]:
        """Where the finger is at ``time_s``, in mm, if it went on as before."""
        elapsed = time_s - self.seen_s
        return self.x_mm + self.vx * elapsed, self.y_mm + self.vy * elapsed

    def move(self, by: tuple[float, float], time_s: float, trust: float = 1.0) -> None:
        """Move to a position ``by`` mm from the predicted one.

        Args:
            by: difference from the predicted position, in mm.
            time_s: time of the frame.
            trust: 1 where the position was measured, 0 where it follows from the velocity.

        """
        elapsed = time_s - self.seen_s
        self.x_mm, self.y_mm = self.x_mm + self.vx * elapsed + by[0], self.y_mm + self.vy * elapsed + by[1]
        self.samples += 1
        n, kept = self.samples, math.exp(-elapsed / MEMORY_S)
        # A least-squares line while there are few samples, fading memory from then on.
        position_gain = max(2 * (2 * n - 1) / (n * (n + 1)), 1 - kept**2)
        velocity_gain = max(6 / (n * (n + 1)), (1 - kept) ** 2)
        far_x, far_y = by[0] + trust * self.lag_x, by[1] + trust * self.lag_y
        self.lag_x += by[0] - position_gain * far_x
        self.lag_y += by[1] - position_gain * far_y
        if elapsed > 0:
            self.vx += velocity_gain * far_x / elapsed
            self.vy += velocity_gain * far_y / elapsed
        self.seen_s = time_s


@dataclass(slots=True)
class Named:
    """The ids of one patch."""

    id: int
    joined: tuple[int, ...] = ()
    """ids of the other tracks that share the patch"""


@dataclass
class Tracks:
    """All fingers on one skin, and those that were lifted a moment ago."""

    pitch_mm: float
    """of square cells; of others the side of a square of the same area"""
    longest_pitch_mm: float
    """along a row or a column, whichever is longer"""
    _tracks: list[Track] = field(default_factory=list)
    _last_id: int = 0
    _time_s: float = -math.inf

    def follow(self, time_s: float, patches: Sequence[Patch], labels: IntArray) -> list[Named]:
        """The ids of the next frame's patches.

        Args:
            time_s: time of the frame, increasing.
            patches: touched cells, none twice.
            labels: (cells,) number of the patch in which a cell lies, from 1; 0 for the others.

        """
        # However slow the frames, the one just before counts.
        oldest_s = min(time_s - REMEMBERED_S, self._time_s)
        known = [track for track in self._tracks if track.seen_s >= oldest_s]
        shared = self._assign(known, patches, labels, time_s)
        self._time_s = time_s
        moved = [self._move(tracks, patch, time_s) for tracks, patch in zip(shared, patches, strict=True)]
        present = [track for tracks in moved for track in tracks]
        seen = {track.id for track in present}
        self._tracks = present + [track for track in known if track.id not in seen]
        names = [_names(tracks) for tracks in moved]
        leaders = {name.id for name in names}
        for track in self._tracks:
            track.leads = track.id in leaders
        return names

    def look_back(self, time_s: float, patches: Sequence[Patch], labels: IntArray) -> list[Named]:
        """The ids of the patches of an earlier frame; tracks do not move, and unknown patches get new ids."""
        assigned = self._assign(self._tracks, patches, labels, time_s, remembered=True)
        return [_names(tracks or [self._begin(patch, time_s)]) for tracks, patch in zip(assigned, patches, strict=True)]

    def _begin(self, patch: Patch, time_s: float) -> Track:
        self._last_id += 1
        return Track(
            self._last_id, patch.x_mm, patch.y_mm, patch.force_n, patch.variance_mm2, patch.cells, time_s, time_s
        )

    def _assign(
        self, known: list[Track], patches: Sequence[Patch], labels: IntArray, time_s: float, *, remembered: bool = False
    ) -> list[list[Track]]:
        """For each patch the tracks that continue in it.

        A track that was not there in the frame before was lifted: it can be given a patch of its own, but cannot merge
        with another track. With ``remembered``, it can.
        """
        shared: list[list[Track]] = [[] for _ in patches]
        if not known or not patches:
            return shared
        overlaps = [set(labels[track.cells].tolist()) - {0} for track in known]
        costs, possible = np.empty((len(known), len(patches))), np.empty((len(known), len(patches)), dtype=bool)
        for j, (track, overlap) in enumerate(zip(known, overlaps, strict=True)):
            x, y = track.predicted(time_s)
            reach = REACH_PITCHES * self.longest_pitch_mm + SPEED_MM_PER_S * abs(time_s - track.seen_s)
            for k, patch in enumerate(patches):
                far = math.hypot(x - patch.x_mm, y - patch.y_mm) / self.pitch_mm
                costs[j, k] = far + FORCE_PITCHES * abs(math.log(patch.force_n / track.force_n))
                moved = math.hypot(track.x_mm - patch.x_mm, track.y_mm - patch.y_mm)
                possible[j, k] = min(moved, far * self.pitch_mm) <= reach or k + 1 in overlap
        pairs = _pairs(costs, possible)
        for j, k in pairs.items():
            shared[k].append(known[j])
        for j, track in enumerate(known):
            if j not in pairs and overlaps[j] and (remembered or track.seen_s == self._time_s):
                x, y = track.predicted(time_s)
                shared[_nearest(x, y, overlaps[j], patches)].append(track)
        return [sorted(tracks, key=lambda track: -track.force_n)[:MOST_TOGETHER] for tracks in shared]

    def _move(self, tracks: list[Track], patch: Patch, time_s: float) -> list[Track]:
        """Let tracks go on in a patch; returns those that are in it, which may be a new one."""
        match tracks:
            case []:
                return [self._begin(patch, time_s)]
            case [track]:
                x, y = track.predicted(time_s)
                track.move((patch.x_mm - x, patch.y_mm - y), time_s)
                track.force_n, track.cells = patch.force_n, patch.cells
                if patch.alone or patch.variance_mm2 > track.variance_mm2:  # cut off by a neighbour, it is too narrow
                    track.variance_mm2 = patch.variance_mm2
                track.apart_s = time_s
                return tracks
        return self._move_together(tracks, patch, time_s)

    def _move_together(self, tracks: list[Track], patch: Patch, time_s: float) -> list[Track]:
        """Move the tracks that share a patch; returns those that are still in it."""
        predicted = np.array([track.predicted(time_s) for track in tracks])
        shares = np.array([track.force_n for track in tracks])
        shares /= shares.sum()
        least = (LEAST_WIDTH_PITCHES * self.pitch_mm) ** 2
        variances = np.array([max(track.variance_mm2, least) for track in tracks])
        gaps = np.linalg.norm(predicted[:, None] - predicted, axis=-1) / np.sqrt((variances[:, None] + variances) / 2)
        np.fill_diagonal(gaps, np.inf)
        # Bells closer than their width look like one; at twice the width each has a top of its own.
        apart = np.clip(gaps.min(axis=1) - 1.0, 0.0, 1.0)
        # Bells that look like one move with the patch's centre. Of bells with a top each, the centre says less: it
        # also moves when their forces change.
        places = predicted + (1.0 - apart)[:, None] * (np.array([patch.x_mm, patch.y_mm]) - shares @ predicted)
        trust = np.zeros(len(tracks))
        if apart.any():
            fitted, masses, widths = self._fit(patch, places, shares, variances)
            for track, variance, far in zip(tracks, widths.tolist(), apart.tolist(), strict=True):
                if far == 1.0:
                    track.variance_mm2 += WIDTH_GAIN * (variance - track.variance_mm2)
            trust = apart * np.clip((masses - LEAST_SHARE) / (SURE_SHARE - LEAST_SHARE), 0.0, 1.0)
            places += trust[:, None] * (fitted - places)
            shares += apart * (masses - shares)
            shares /= shares.sum()
        staying = []
        for j, (by_x, by_y) in enumerate((places - predicted).tolist()):
            track = tracks[j]
            if apart[j]:
                track.apart_s = time_s
            lifted = shares[j] < LEAST_SHARE or (time_s - track.apart_s > TOGETHER_S and shares[j] < shares.max())
            if not lifted:
                track.move((by_x, by_y), time_s, float(trust[j]))
                track.force_n, track.cells = float(shares[j]) * patch.force_n, patch.cells
                staying.append(track)
        return staying

    def _fit(
        self, patch: Patch, places: FloatArray, shares: FloatArray, variances: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Some steps of expectation maximisation: centres (n, 2) in mm, shares (n,) and mm^2 (n,) of a patch's bells.

        Args:
            patch: whose pressure is the mixture.
            places: (n, 2) mm, centres (x, y) to begin with.
            shares: (n,) of the patch's force, to begin with.
            variances: (n,) mm^2 of the bells as far as they are known; the centres are found with them.

        """
        weights = patch.pressure_kpa / patch.pressure_kpa.sum()
        for _ in range(EM_STEPS):
            squares = ((patch.places_mm - places[:, None]) ** 2).sum(axis=-1) / variances[:, None]
            bells = (shares / variances)[:, None] * np.exp(-0.5 * (squares - squares.min(axis=0)))
            parts = weights * bells / np.maximum(bells.sum(axis=0), 1e-300)
            shares = parts.sum(axis=1)
            places = parts @ patch.places_mm / np.maximum(shares, 1e-9)[:, None]
        squares = ((patch.places_mm - places[:, None]) ** 2).sum(axis=-1)
        return places, shares, (parts * squares).sum(axis=1) / (2.0 * np.maximum(shares, 1e-9))


def _names(tracks: list[Track]) -> Named:
    """The ids of a patch: it keeps the one that it had, and of two patches that merged the stronger one's."""
    leader = max(tracks, key=lambda track: (track.leads, track.force_n))
    return Named(leader.id, tuple(sorted(track.id for track in tracks if track is not leader)))


def _nearest(x: float, y: float, numbers: set[int], patches: Sequence[Patch]) -> int:
    """Of the patches with these numbers, from 1, the index of the one nearest to (x, y) in mm."""
    indices = sorted(number - 1 for number in numbers)
    return min(indices, key=lambda k: math.hypot(x - patches[k].x_mm, y - patches[k].y_mm))


def _pairs(costs: FloatArray, possible: BoolArray) -> dict[int, int]:
    """Linear assignment: as many possible pairs as there can be, with the least sum of costs; row -> column."""
    if costs.size == 1:
        return {0: 0} if possible[0, 0] else {}
    # An impossible pair costs more than all possible ones together: it is chosen only for want of others.
    impossible = 1.0 + costs[possible].sum()
    rows, columns = linear_sum_assignment(np.where(possible, costs, impossible))
    return {j: k for j, k in zip(rows.tolist(), columns.tolist(), strict=True) if possible[j, k]}
