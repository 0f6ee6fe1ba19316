"""Records of contacts: cells and lines of a skin, what is remembered of each cell, patches of a frame, and fingers."""

from __future__ import annotations

from typing import Annotated, NamedTuple, get_type_hints

import numpy as np

from ..common.arrays import BoolArray, FloatArray
from ..common.compiled import Flags, PlaceRows, Places, Record, Records, Row, Rows, zeros
from ..common.geometry import Geometry
from ._tuning import BESIDE

PLACE = Annotated[FloatArray, 3]
MOST_TOGETHER = 8
"""largest number of fingers that share a patch; the ones with the largest forces are kept"""
OTHERS = Annotated[FloatArray, MOST_TOGETHER - 1]


class Untouched(Record):
    """By what contacts are told from an untouched skin."""

    full_scale_kpa: float
    most_drift_kpa: float
    """pressure of an untouched cell whose rest resistance has drifted as far as it does"""
    drift_kpa_per_s: float
    faults_press: float
    """1: a bad contact looks like a load"""
    columns: float
    """of the array"""


class Spot(Record):
    """A cell of the skin. Numbers of lines are those of :attr:`ohmskin.common.geometry.Geometry.lines`."""

    exists: float
    at_mm: PLACE
    area_mm2: float
    longest_mm: float
    """to the furthest cell beside"""
    pitch_mm: float
    """usual distance of the cells beside"""
    line: Annotated[FloatArray, 2]
    """numbers of its row and its column"""
    along: Annotated[FloatArray, 2]
    """place on these"""


class Line(Record):
    """A row or a column: which cells a fault in a line moves."""

    cells: float
    """how many there are on the line"""
    first: float
    """place of its first cell; and of the last one"""
    last: float


class Touched(Record):
    """What is remembered of a cell."""

    pressed_s: float
    """time since which it shows a pressure, however uncertain; infinite if it does not"""
    step_kpa: float
    """largest rise from one frame to the next since then; else 0"""
    last_kpa: float
    """in the last frame"""
    drift_kpa: float
    """part of the pressure that drift may have caused"""
    wake_kpa: float
    """largest recent pressure while the cell was in a contact, with exponential forgetting"""
    read_s: float
    """time of its last reading"""


class Patch(Record):
    """Connected touched cells of one frame: a contact."""

    first: float
    """place of its first cell among the touched cells in the order of their patches"""
    cells: float
    at_mm: PLACE
    """centre of force"""
    force_n: float
    force_std_n: float
    peak_kpa: float
    variance_mm2: float
    """of the force about the centre, along one axis of the surface"""
    alone: float
    """0 if another patch touches this one, and thereby cuts off its side"""
    area_mm2: float
    pitch_mm: float
    """usual distance of neighbouring cells there"""
    longest_mm: float
    """longest distance of cells beside each other there"""
    interpolated_n: float
    """part of the force on cells that are not read"""
    id: float
    others: float
    """number of other fingers in the patch, whose ids are ``joined``"""
    joined: OTHERS


class Track(Record):
    """One finger, alone in its patch or sharing a patch, or lifted a moment ago."""

    id: float
    """0: the place is free"""
    at_mm: PLACE
    """last measured position, or the predicted one if nothing told the finger from others"""
    mm_per_s: PLACE
    lag_mm: PLACE
    """from the smoothed position, whose change is the velocity, to the position"""
    force_n: float
    variance_mm2: float
    patch: float
    """label of the patch in which the finger was seen in the last frame; 0: it was not"""
    seen_s: float
    apart_s: float
    """time when the finger could last be told from its neighbours"""
    pitch_mm: float
    """distances of the cells where it is, as in :class:`Patch`"""
    longest_mm: float
    samples: float
    leads: float
    """1: the patch has this track's id"""


class Progress(Record):
    """Of the frames up to now."""

    time_s: float
    """of the last frame; minus infinity before the first"""
    last_id: float
    tracks: float
    """places of tracks in use"""
    touched: float
    """cells of the last frame's patches"""


class Skin(NamedTuple):
    """The n cells of a skin. Nothing in it changes."""

    untouched: Untouched
    spots: Records[Spot]
    rows: Records[Line]
    columns: Records[Line]
    near: PlaceRows
    """(n, most) cells near each one, :attr:`ohmskin.common.geometry.Neighbours.near`; n stands for none"""
    weights: Rows
    """(n, most) of the near ones under a fingertip"""
    opposite: PlaceRows
    """(m, 3) cells with two neighbours on opposite sides"""

    @classmethod
    def of(cls, geometry: Geometry, untouched: Untouched) -> Skin:
        """The cells at their places."""
        count = geometry.areas_mm2.size
        neighbours, exists = geometry.neighbours, geometry.exists.ravel()
        near = neighbours.near
        weights = np.where(near < count, BESIDE**2, 0.0)
        is_beside = (near[:, :, None] == neighbours.beside[:, None, :]).any(axis=-1)
        weights[is_beside & (near < count)] = BESIDE
        spots = zeros(Spot, count)
        alone_mm = np.sqrt(geometry.areas_mm2.ravel())
        longest = np.where(neighbours.longest_mm > 0, neighbours.longest_mm, alone_mm)
        shortest = np.where(neighbours.shortest_mm > 0, neighbours.shortest_mm, alone_mm)
        spots["exists"], spots["area_mm2"] = exists, geometry.areas_mm2.ravel()
        spots["at_mm"][:, : geometry.places_mm.shape[-1]] = geometry.places_mm.reshape(count, -1)
        spots["longest_mm"], spots["pitch_mm"] = longest, (shortest + longest) / 2
        spots["line"], spots["along"] = geometry.lines, np.indices(geometry.shape)[::-1].reshape(2, -1).T
        rows, columns = (_lines(spots, axis, exists) for axis in (0, 1))
        return cls(untouched, spots, rows, columns, near, weights, neighbours.opposite)


def _lines(spots: Records[Spot], axis: int, exists: BoolArray) -> Records[Line]:
    number, along = (spots[name][:, axis].astype(np.intp) for name in ("line", "along"))
    lines = zeros(Line, int(number.max()) + 1)
    lines["first"], lines["last"] = along.max() + 1, -1
    np.minimum.at(lines["first"], number[exists], along[exists])
    np.maximum.at(lines["last"], number[exists], along[exists])
    lines["cells"] = np.bincount(number[exists], minlength=lines.size)
    return lines


class Memory(NamedTuple):
    """What is remembered of the frames up to now, and found in the last one."""

    cells: Records[Touched]
    labels: Places
    """(n,) number of the contact of each cell, from 1; 0: none"""
    order: Places
    """(n,) touched cells in the order of their contacts"""
    patches: Records[Patch]
    """(n,) the contacts"""
    tracks: Records[Track]
    """the fingers on the skin, those lifted a moment ago included"""
    progress: Records[Progress]
    """(1,)"""

    @classmethod
    def of_nothing(cls, count: int) -> Memory:
        """Before the first frame of ``count`` cells."""
        cells, progress = zeros(Touched, count), zeros(Progress, 1)
        cells["pressed_s"], cells["read_s"], progress["time_s"] = np.inf, -np.inf, -np.inf
        labels, order = np.zeros(count, dtype=np.intp), np.empty(count, dtype=np.intp)
        return cls(cells, labels, order, zeros(Patch, count), zeros(Track, count + MOST_TOGETHER), progress)


class Scan(NamedTuple):
    """The cells (n,) in the frame that is being taken."""

    pressure: Row
    """kPa; NaN: not known"""
    std: Row
    """kPa, standard deviations; NaN: not known"""
    unread: Flags
    """without a reading in this frame"""
    known_std: Row
    """kPa, standard deviations, unknown ones as 0"""
    height: Row
    """kPa: the pressure, interpolated where a cell is missing within a contact"""
    missing: Flags
    """without a recent reading; in the end those that are interpolated"""
    excess: Row
    """kPa beyond drift"""
    wake: Row
    """kPa that a finger leaves behind it"""
    begins: Flags
    """pressed for sure"""
    connected: Places
    """number of the cell's connected patch, from 1; 0: none"""
    before: Places
    """number of its contact in the last frame"""
    load: Row
    """N on touched cells"""

    @classmethod
    def of_size(cls, count: int) -> Scan:
        """Room for ``count`` cells."""
        kinds = {Row: np.float64, Flags: np.bool_, Places: np.intp}
        hints = get_type_hints(cls, include_extras=True)
        return cls(**{name: np.zeros(count, dtype=kinds[hints[name]]) for name in cls._fields})
