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
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray

SPEED_MM_PER_S = 500.0
REACH_PITCHES = 1.5
"""largest distance of a contact from its last position, or from its predicted one; in addition, the speed above times
the time since then"""
REMEMBERED_S = 0.2
"""a contact that returns within this time keeps its id"""
MEMORY_S = 0.05
"""time constant of the g-h filter for position and velocity: fingers turn more slowly, and noise is averaged"""
FORCE_PITCHES = 1.0
"""cost of a pair whose forces differ by a factor of e, in pitches of distance"""
MOST_TOGETHER = 8
"""largest number of tracks that share a patch; the ones with the largest forces are kept"""
LEAST_SHARE = 0.1
"""fraction of a patch's force below which a track has been lifted"""
SURE_SHARE = 0.35
"""fraction below which the fit moves a track only in part: the bell of a finger being lifted slides to its neighbour"""
TOGETHER_S = 1.0
"""two fingers do not stay in one place for longer: the weaker one has been lifted there"""
EM_STEPS = 2
"""EM iterations per frame; each frame starts from the result of the last one"""
WIDTH_GAIN = 0.2
"""gain per frame with which the width of a bell follows the fit, while each bell has its own maximum"""
LEAST_WIDTH_PITCHES = 0.5
"""least standard deviation of a bell: that of a contact on one cell"""


@dataclass(slots=True)
class Patch:
    """Connected touched cells of one frame."""

    centre_mm: tuple[float, ...]
    """centre of force: x, y and maybe z"""
    force_n: float
    force_std_n: float
    peak_kpa: float
    variance_mm2: float
    """of the force about the centre, along one axis of the surface"""
    alone: bool
    """False if another patch touches this one, and thereby cuts off its side"""
    cells: IntArray
    """(n,) numbers in the flattened array"""
    places: IntArray
    """(n, 2) rows and columns"""
    places_mm: FloatArray
    """(n, 2 or 3) of the cells' middles"""
    load_n: FloatArray
    """(n,) force on each cell"""
    area_mm2: float
    pitch_mm: float
    """usual distance of neighbouring cells there"""
    longest_pitch_mm: float
    """longest distance of cells beside each other there"""
    interpolated_n: float = 0.0
    """part of the force on cells that are not read"""


@dataclass(slots=True)
class Track:
    """One finger, alone in its patch or sharing a patch."""

    id: int
    at_mm: tuple[float, ...]
    """last measured position, or the predicted one if nothing told the finger from others"""
    force_n: float
    variance_mm2: float
    cells: IntArray
    """cells of the patch in which the finger was seen last"""
    seen_s: float
    apart_s: float
    """time when the finger could last be told from its neighbours"""
    pitch_mm: float
    longest_pitch_mm: float
    """distances of the cells where it is, as in :class:`Patch`"""
    mm_per_s: tuple[float, ...]
    lag_mm: tuple[float, ...]
    """from the smoothed position, whose change is the velocity, to the position"""
    samples: int = 1
    leads: bool = True
    """the patch has this track's id"""

    def predicted(self, time_s: float) -> tuple[float, ...]:
        """Position in mm at ``time_s``, at constant velocity."""
        elapsed = time_s - self.seen_s
        return tuple([x + v * elapsed for x, v in zip(self.at_mm, self.mm_per_s, strict=True)])

    def move(self, by_mm: Sequence[float], time_s: float, trust: float = 1.0) -> None:
        """Update position and velocity with a position ``by_mm`` from the predicted one (g-h filter).

        Args:
            by_mm: difference from the predicted position.
            time_s: time of the frame.
            trust: 1 if the position was measured, 0 if it follows from the velocity.

        """
        elapsed = time_s - self.seen_s
        self.at_mm = tuple([x + by for x, by in zip(self.predicted(time_s), by_mm, strict=True)])
        self.samples += 1
        n, kept = self.samples, math.exp(-elapsed / MEMORY_S)
        # Gains of a least-squares line while there are few samples, of a fading memory from then on.
        position_gain = max(2 * (2 * n - 1) / (n * (n + 1)), 1 - kept**2)
        velocity_gain = max(6 / (n * (n + 1)), (1 - kept) ** 2)
        far = [by + trust * lag for by, lag in zip(by_mm, self.lag_mm, strict=True)]
        steps = zip(self.lag_mm, by_mm, far, strict=True)
        self.lag_mm = tuple([lag + by - position_gain * off for lag, by, off in steps])
        if elapsed > 0:
            gain = velocity_gain / elapsed
            self.mm_per_s = tuple([v + gain * off for v, off in zip(self.mm_per_s, far, strict=True)])
        self.seen_s = time_s


@dataclass(slots=True)
class Named:
    """The ids of one patch."""

    id: int
    joined: tuple[int, ...] = ()
    """ids of the other tracks that share the patch"""


@dataclass
class Tracks:
    """All fingers on one skin, including those lifted a moment ago."""

    _tracks: list[Track] = field(default_factory=list)
    _last_id: int = 0
    _time_s: float = -math.inf

    def follow(self, time_s: float, patches: Sequence[Patch], labels: IntArray) -> list[Named]:
        """The ids of the next frame's patches.

        Args:
            time_s: time of the frame, increasing.
            patches: touched cells, no cell in two patches.
            labels: (cells,) number of the patch in which a cell lies, from 1; 0 for the others.

        """
        # However slow the frames are, the frame just before counts.
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

    def _begin(self, patch: Patch, time_s: float) -> Track:
        self._last_id += 1
        still = (0.0,) * len(patch.centre_mm)
        return Track(
            id=self._last_id,
            at_mm=patch.centre_mm,
            force_n=patch.force_n,
            variance_mm2=patch.variance_mm2,
            cells=patch.cells,
            seen_s=time_s,
            apart_s=time_s,
            pitch_mm=patch.pitch_mm,
            longest_pitch_mm=patch.longest_pitch_mm,
            mm_per_s=still,
            lag_mm=still,
        )

    def _assign(
        self, known: list[Track], patches: Sequence[Patch], labels: IntArray, time_s: float
    ) -> list[list[Track]]:
        """For each patch the tracks that continue in it.

        A track that was absent in the frame before was lifted. It can get a patch of its own, but cannot merge with
        another track.
        """
        shared: list[list[Track]] = [[] for _ in patches]
        if not known or not patches:
            return shared
        overlaps = [set(labels[track.cells].tolist()) - {0} for track in known]
        costs, possible = np.empty((len(known), len(patches))), np.empty((len(known), len(patches)), dtype=bool)
        for j, (track, overlap) in enumerate(zip(known, overlaps, strict=True)):
            predicted = track.predicted(time_s)
            reach = REACH_PITCHES * track.longest_pitch_mm + SPEED_MM_PER_S * abs(time_s - track.seen_s)
            for k, patch in enumerate(patches):
                far = math.dist(predicted, patch.centre_mm)
                costs[j, k] = far / track.pitch_mm + FORCE_PITCHES * abs(math.log(patch.force_n / track.force_n))
                moved = math.dist(track.at_mm, patch.centre_mm)
                possible[j, k] = min(moved, far) <= reach or k + 1 in overlap
        pairs = _pairs(costs, possible)
        for j, k in pairs.items():
            shared[k].append(known[j])
        for j, track in enumerate(known):
            if j not in pairs and overlaps[j] and track.seen_s == self._time_s:
                shared[_nearest(track.predicted(time_s), overlaps[j], patches)].append(track)
        return [sorted(tracks, key=lambda track: -track.force_n)[:MOST_TOGETHER] for tracks in shared]

    def _move(self, tracks: list[Track], patch: Patch, time_s: float) -> list[Track]:
        """Continue tracks in a patch; returns the tracks in it, which may be a new one."""
        match tracks:
            case []:
                return [self._begin(patch, time_s)]
            case [track]:
                at = zip(patch.centre_mm, track.predicted(time_s), strict=True)
                track.move([new - expected for new, expected in at], time_s)
                track.force_n, track.cells = patch.force_n, patch.cells
                track.pitch_mm, track.longest_pitch_mm = patch.pitch_mm, patch.longest_pitch_mm
                if patch.alone or patch.variance_mm2 > track.variance_mm2:  # else too narrow, cut off by a neighbour
                    track.variance_mm2 = patch.variance_mm2
                track.apart_s = time_s
                return tracks
        return self._move_together(tracks, patch, time_s)

    def _move_together(self, tracks: list[Track], patch: Patch, time_s: float) -> list[Track]:
        """Move the tracks that share a patch; returns those still in it."""
        predicted = np.array([track.predicted(time_s) for track in tracks])
        shares = np.array([track.force_n for track in tracks])
        shares /= shares.sum()
        least = (LEAST_WIDTH_PITCHES * patch.pitch_mm) ** 2
        variances = np.array([max(track.variance_mm2, least) for track in tracks])
        gaps = np.linalg.norm(predicted[:, None] - predicted, axis=-1) / np.sqrt((variances[:, None] + variances) / 2)
        np.fill_diagonal(gaps, np.inf)
        # Bells closer than their width look like one; from twice the width on each has its own maximum.
        apart = np.clip(gaps.min(axis=1) - 1.0, 0.0, 1.0)
        # Bells that look like one move with the patch's centre. For bells with separate maxima the centre tells less,
        # since it also moves when their forces change.
        places = predicted + (1.0 - apart)[:, None] * (np.array(patch.centre_mm) - shares @ predicted)
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
        for j, by_mm in enumerate((places - predicted).tolist()):
            track = tracks[j]
            if apart[j]:
                track.apart_s = time_s
            lifted = shares[j] < LEAST_SHARE or (time_s - track.apart_s > TOGETHER_S and shares[j] < shares.max())
            if not lifted:
                track.move(by_mm, time_s, float(trust[j]))
                track.force_n, track.cells = float(shares[j]) * patch.force_n, patch.cells
                staying.append(track)
        return staying

    def _fit(
        self, patch: Patch, places: FloatArray, shares: FloatArray, variances: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A few steps of expectation maximisation (EM) for the bells of a patch.

        Returns:
            Centres (n, 2 or 3) in mm, shares (n,) of the force, variances (n,) in mm^2.

        Args:
            patch: the patch whose load is the mixture.
            places: (n, 2 or 3) mm, initial centres.
            shares: (n,) initial shares of the patch's force.
            variances: (n,) mm^2 of the bells as known so far, with which the centres are found.

        """
        weights = patch.load_n / patch.load_n.sum()
        for _ in range(EM_STEPS):
            squares = ((patch.places_mm - places[:, None]) ** 2).sum(axis=-1) / variances[:, None]
            bells = (shares / variances)[:, None] * np.exp(-0.5 * (squares - squares.min(axis=0)))
            parts = weights * bells / np.maximum(bells.sum(axis=0), 1e-300)
            shares = parts.sum(axis=1)
            places = parts @ patch.places_mm / np.maximum(shares, 1e-9)[:, None]
        squares = ((patch.places_mm - places[:, None]) ** 2).sum(axis=-1)
        return places, shares, (parts * squares).sum(axis=1) / (2.0 * np.maximum(shares, 1e-9))


def _names(tracks: list[Track]) -> Named:
    """The ids of a patch: the patch keeps its id, and two merged patches get that of the stronger one."""
    leader = max(tracks, key=lambda track: (track.leads, track.force_n))
    return Named(leader.id, tuple(sorted(track.id for track in tracks if track is not leader)))


def _nearest(place_mm: tuple[float, ...], numbers: set[int], patches: Sequence[Patch]) -> int:
    """Index of the patch nearest to a place, among the patches with these numbers (from 1)."""
    indices = sorted(number - 1 for number in numbers)
    return min(indices, key=lambda k: math.dist(place_mm, patches[k].centre_mm))


def _pairs(costs: FloatArray, possible: BoolArray) -> dict[int, int]:
    """Linear assignment: as many possible pairs as there can be, at the least total cost; row -> column."""
    from scipy.optimize import linear_sum_assignment

    if costs.size == 1:
        return {0: 0} if possible[0, 0] else {}
    # An impossible pair costs more than all possible ones together, so it is chosen only if no possible one is left.
    impossible = 1.0 + costs[possible].sum()
    rows, columns = linear_sum_assignment(np.where(possible, costs, impossible))
    return {j: k for j, k in zip(rows.tolist(), columns.tolist(), strict=True) if possible[j, k]}
