"""Contacts on the skin, from the pressures of a frame and their standard deviations alone.

A threshold on each cell flickers with noise. We use two, as in Canny's edge detector: a contact begins where the
pressure is surely that of a load, takes in the cells around that are likely loaded, and lets a cell go when it hardly
is. Where single cells are not sure, neighbours are judged together. Connected cells are one contact; fingers that touch
each other are parted along the valley between them (:mod:`._watershed`), and :mod:`._tracks` gives the contacts their
ids.

Rest resistances drift with temperature and age, and the driver takes a rise of resistance for a load. A contact
therefore begins only where the pressure exceeds the part that drift may have caused. In an untouched cell this part
follows the pressure upwards by at most :data:`DRIFT_PER_S`; in the cells of a contact it stays constant, so that no
held load fades.
"""

from __future__ import annotations

import copy
import math
import threading
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..common.geometry import Geometry
from ._bridging import bridge
from ._proximity import Proximity
from ._tare import KNOWN_DRIFT
from ._tracks import Named, Patch, Tracks
from ._watershed import part

START_STDS, JOIN_STDS, STAY_STDS = 5.0, 2.5, 0.5
"""pressure of a cell, in its standard deviations, that begins a contact, joins one, stays in one"""
START_SHARE, JOIN_SHARE, STAY_SHARE = 0.03, 0.0192, 0.015
"""lower bounds of these thresholds, as fractions of full scale: the standard deviation leaves out slow errors of the
cell model"""
RIM_SHARE = 0.005
"""fraction of full scale, down to which the force of cells around a contact counts as its own"""
NEWTON = 1e-3
"""of one kPa on one mm^2"""
MISSING_S = 0.2
"""a cell without a reading for longer is missing; until then its last pressure counts"""
DRIFT_PER_S = 0.003
"""relative change of a rest resistance per second: warming up takes minutes. A finger presses much faster"""
WAKE_SHARE, WAKE_S = 0.15, 1.0
"""fraction of the largest pressure in a cell and those near it, forgotten with this time constant: what a finger
leaves in the estimates behind it and beside it is less, and is no contact"""
INTERMITTENT_S, STANDS_OUT = 0.1, 8.0
"""a new patch within one row or column may be a disturbance of the converter: it is a contact in its second frame. One
that electrical faults may have made (:meth:`ContactTracker._may_be_fault`) is one after this time, unless it rose over
several frames and exceeds this many standard deviations: a fault comes and goes at once"""
AT_ONCE, ALIKE = 0.5, 0.5
"""share of a pressure that comes with one frame in a jump; least pressure in faulty lines over their largest"""
LONGEST_IN_LINE = 3
"""cells within one line that a stylus covers"""


@dataclass(frozen=True, slots=True)
class Contact:
    """One connected patch of touched cells. Places are those of :attr:`.Skin.geometry`."""

    id: int
    """number of the contact, kept while it lasts and moves; from 1"""
    x_mm: float
    """centre of force; on a rectangle along the rows, from the middle of cell (0, 0)"""
    y_mm: float
    """likewise along the columns"""
    area_mm2: float
    """of the touched cells"""
    force_n: float
    """sum of pressure times cell area, with the rim: loaded cells around the touched ones, down to :data:`RIM_SHARE` of
    full scale. Cells that are not read count with the part :attr:`interpolated_n`"""
    peak_kpa: float
    """largest pressure of one cell"""
    cells: IntArray = field(compare=False)
    """(n, 2) row and column of each touched cell; not part of a comparison of contacts"""
    joined: tuple[int, ...] = ()
    """ids of other contacts that have merged into this one; they get these ids back when they part from it"""
    interpolated_n: float = 0.0
    """part of :attr:`force_n` on cells that are not read but lie between touched ones, interpolated between these. A
    lower bound if the middle of the press lies there. A gap at the rim of a contact is not counted"""
    force_std_n: float = math.nan
    """standard deviation of :attr:`force_n`: that of the pressures times cell area, added up as if neighbours erred
    alike, since they share their history; NaN where the estimator states none"""
    z_mm: float | None = None
    """as x_mm and y_mm, of a skin in space; None: it is flat"""


class Touch(NamedTuple):
    """By what contacts are told from an untouched skin."""

    full_scale_kpa: float = math.inf
    """of the cells"""
    drift_kpa: float = 0.0
    """pressure of an untouched cell whose rest resistance has drifted as far as rest resistances do
    (:data:`._tare.KNOWN_DRIFT`); 0: no drift"""
    faults_press: bool = True
    """True if a bad contact, which adds resistance, looks like a load; False if loads lower the resistance"""


@dataclass(frozen=True, eq=False)
class _Line:
    """The rows of an array, or its columns: which cells a fault in a line moves."""

    number: IntArray
    """(cells,) of each cell's line"""
    along: IntArray
    """(cells,) place of each cell on its line"""
    cells: IntArray
    """(lines,) how many cells there are on each line"""
    first: IntArray
    """(lines,) place of its first cell"""
    last: IntArray

    @classmethod
    def of(cls, geometry: Geometry, axis: int) -> _Line:
        """Rows (axis 0) or columns (1)."""
        number = geometry.lines[:, axis].copy()
        along = np.indices(geometry.shape)[1 - axis].ravel()
        there = geometry.exists.ravel()
        lines = int(number.max()) + 1
        first, last = np.full(lines, along.max() + 1), np.full(lines, -1)
        np.minimum.at(first, number[there], along[there])
        np.maximum.at(last, number[there], along[there])
        return cls(number, along, np.bincount(number[there], minlength=lines), first, last)


class ContactTracker:
    """Finds the contacts of frames and follows them from frame to frame."""

    def __init__(
        self,
        geometry: Geometry,
        full_scale_kpa: float,
        drift_kpa: float = 0.0,
        faults_press: bool = True,
    ) -> None:
        """Begin with an untouched skin; see :class:`Touch`."""
        self.geometry = geometry
        self._proximity = Proximity(geometry)
        self.shape = shape = geometry.shape
        self.full_scale_kpa = full_scale_kpa
        self._faults_press = faults_press
        self._labels: IntArray = np.zeros(shape, dtype=np.intp)
        """(rows, columns) number of the contact of the last frame, from 1; 0: none"""
        self._fingers: list[int] = []
        """number of fingers of each of these contacts"""
        self._pressed_s = np.full(shape, np.inf)
        """(rows, columns) time since which a cell shows a pressure, however uncertain; infinite for the others"""
        self._most_drift_kpa, self._drift_kpa_per_s = drift_kpa, drift_kpa / KNOWN_DRIFT * DRIFT_PER_S
        self._step_kpa = np.zeros(shape)
        """(rows, columns) largest rise from one frame to the next since a cell shows a pressure; 0 for the others"""
        self._last_kpa = np.zeros(shape)
        """(rows, columns) pressures of the last frame"""
        self._drift_kpa = np.zeros(shape)
        """(rows, columns) part of the pressure that drift may have caused"""
        self._wake_kpa = np.zeros(shape)
        """(rows, columns) largest recent pressure while the cell was in a contact, with exponential forgetting"""
        self._time_s = math.inf
        """of the last frame; infinite before the first"""
        self._read_s = np.full(shape, -np.inf)
        """(rows, columns) time of the cell's last reading"""
        self._tracks = Tracks()
        self._places: IntArray = np.indices(shape).reshape(2, -1).T.copy()
        """(cells, 2) row and column of each cell of the flattened array"""
        self._lines = [_Line.of(geometry, axis) for axis in (0, 1)]
        """rows and columns: what faults of wires and converters move together"""
        ends = np.cumsum(geometry.rows_of_boards or shape[:1]).tolist()
        self._boards = [slice(first, last) for first, last in pairwise([0, *ends])]
        """rows of each board"""

    def update(
        self, time_s: float, pressure_kpa: FloatArray, std_kpa: FloatArray, unread: BoolArray | None = None
    ) -> tuple[Contact, ...]:
        """The contacts of the next frame, the one with the largest force first.

        Args:
            time_s: time of the frame, increasing.
            pressure_kpa: (rows, columns); a cell with NaN counts as untouched.
            std_kpa: (rows, columns) standard deviation; NaN where unknown.
            unread: (rows, columns) cells without a reading in this frame; None: none but those with NaN.

        """
        missing = self._missing(time_s, np.isnan(pressure_kpa) if unread is None else unread | np.isnan(pressure_kpa))
        pressed = pressure_kpa > START_SHARE * self.full_scale_kpa
        # In the first frame: most likely these cells have been pressed for longer than an intermittent contact lasts.
        since_s = -math.inf if math.isinf(self._time_s) else time_s
        self._step_kpa = np.where(pressed, np.maximum(self._step_kpa, pressure_kpa - self._last_kpa), 0.0)
        self._last_kpa = np.where(np.isfinite(pressure_kpa), pressure_kpa, 0.0)
        self._pressed_s = np.where(pressed, np.minimum(self._pressed_s, since_s), np.inf)
        elapsed_s = 0.0 if math.isinf(self._time_s) else max(time_s - self._time_s, 0.0)
        self._wake_kpa *= math.exp(-elapsed_s / WAKE_S)
        labels, patches = self._find(time_s, pressure_kpa, std_kpa, missing)
        names = self._tracks.follow(time_s, patches, labels.ravel())
        self._labels, self._time_s = labels, time_s
        self._fingers = [1 + len(name.joined) for name in names]
        self._drift(elapsed_s, pressure_kpa)
        np.fmax(self._wake_kpa, pressure_kpa, out=self._wake_kpa, where=labels > 0)
        return self._contacts(patches, names)

    def _drift(self, elapsed_s: float, pressure_kpa: FloatArray) -> None:
        """Let the drift of untouched cells follow their pressures: slowly upwards, at once downwards."""
        most = np.minimum(self._drift_kpa + self._drift_kpa_per_s * elapsed_s, self._most_drift_kpa)
        np.fmin(most, np.fmax(pressure_kpa, 0.0), out=most)
        self._drift_kpa = np.where(self._labels > 0, self._drift_kpa, most)

    def _missing(self, time_s: float, unread: BoolArray) -> BoolArray | None:
        """(rows, columns) cells without a recent reading; None: no cell."""
        self._read_s[~unread] = time_s
        missing: BoolArray = self.geometry.exists & (time_s - self._read_s > MISSING_S)
        return missing if missing.any() else None

    def _find(
        self, time_s: float, pressure_kpa: FloatArray, std_kpa: FloatArray, missing: BoolArray | None
    ) -> tuple[IntArray, list[Patch]]:
        """(rows, columns) for each cell the number of its patch, from 1 (0: none), and the patches."""
        proximity = self._proximity
        full, touched = self.full_scale_kpa, self._labels > 0
        excess = pressure_kpa - self._drift_kpa
        stated_kpa, std_kpa = std_kpa, np.where(std_kpa > 0, std_kpa, 0.0)  # an unknown deviation counts as 0
        wake = WAKE_SHARE * proximity.largest_around(self._wake_kpa) if self._wake_kpa.any() else 0.0
        pressed = excess > np.maximum(START_SHARE * full, wake)  # False where NaN
        begins = pressed & (excess > START_STDS * std_kpa)
        if pressed.any() and not begins[pressed].all():
            begins |= proximity.together(pressed & ~begins, self._own(excess), std_kpa)
        none = np.zeros(self.shape, dtype=np.intp)
        if not (begins.any() or touched.any()):
            return none, []
        stds, share = np.where(touched, STAY_STDS, JOIN_STDS), np.where(touched, STAY_SHARE, JOIN_SHARE)
        candidates = (excess > np.maximum(stds * std_kpa, share * full)) | begins
        bridged = None
        if missing is not None:
            bridged, pressure_kpa = bridge(pressure_kpa, candidates, missing, proximity.opposite)
            candidates |= bridged
        found, count = proximity.label(candidates)
        kept = np.zeros(count + 1, dtype=np.bool_)
        kept[found[begins]] = True
        self._keep_lasting(found, kept, pressure_kpa)
        above_wake = np.zeros(count + 1, dtype=np.bool_)
        above_wake[found[excess > wake]] = True
        kept &= above_wake
        kept[0] = False
        self._drop_disturbances(found, kept, excess, std_kpa)
        connected = np.where(kept, np.cumsum(kept), 0)[found]
        contacts = int(kept.sum())
        if not contacts:
            return none, []
        labels = part(connected, contacts, pressure_kpa, std_kpa, begins, self._labels, proximity)
        rim = self._rim(labels, excess > np.maximum(RIM_SHARE * full, wake), pressure_kpa)
        return labels, self._measure(labels.ravel(), connected.ravel(), pressure_kpa, stated_kpa, bridged, rim.ravel())

    def _keep_lasting(self, found: IntArray, kept: BoolArray, pressure_kpa: FloatArray) -> None:
        """Keep patches in which contacts of the last frame continue.

        A contact continues in the patch that has most of its force now. If none of its patches begins a contact, it
        continues in as many patches as it has fingers. Hysteresis thus lets contacts last, but makes no new contacts of
        cells that a moving finger leaves behind.

        Args:
            found: (rows, columns) labels of patches, from 1.
            kept: (labels,) patches that make contacts, changed.
            pressure_kpa: (rows, columns).

        """
        lasting = (found > 0) & (self._labels > 0)
        now = found[lasting]
        if kept[now].all():
            return
        before, pressure = self._labels[lasting], pressure_kpa[lasting]
        for contact in np.unique(before[~kept[now]]).tolist():
            own = before == contact
            force = np.bincount(now[own], pressure[own])
            patches = np.flatnonzero(np.bincount(now[own]))
            most = 1 if kept[patches].any() else self._fingers[contact - 1]
            kept[patches[np.argsort(-force[patches])][:most]] = True

    def _drop_disturbances(self, found: IntArray, kept: BoolArray, excess: FloatArray, std_kpa: FloatArray) -> None:
        """Drop new patches that may be electrical faults; ``kept`` (labels,) is changed."""
        fresh = kept.copy()
        fresh[found[self._labels > 0]] = False
        for label in np.flatnonzero(fresh).tolist():
            own = np.flatnonzero(found == label)
            above, std, step = excess.flat[own], std_kpa.flat[own], self._step_kpa.flat[own]
            since_s, read_s = self._pressed_s.flat[own], self._read_s.flat[own]
            lasts_s = math.inf if since_s.min() == -math.inf else float((read_s - since_s).max())
            under_range = not (above > STANDS_OUT * std).any()
            at_once = (step > AT_ONCE * above).any()
            if (under_range or at_once) and self._may_be_fault(own, above):
                kept[label] = lasts_s > INTERMITTENT_S
            elif any((line.number[own] == line.number[own[0]]).all() for line in self._lines):
                kept[label] = lasts_s > 0.0

    def _may_be_fault(self, own: IntArray, excess: FloatArray) -> bool:
        """Whether cells ``own`` (n,) with their ``excess`` (n,) are what electrical faults move together.

        Whole lines move alike by a converter or a connector. What adds resistance moves cells of which no two lie side
        by side, or a line from a crack to its end; that looks like a press only where loads add resistance.
        """
        if excess.min() > ALIKE * excess.max() and any(
            own.size == line.cells[np.unique(line.number[own])].sum() for line in self._lines
        ):
            return True
        if not self._faults_press:
            return False
        if not np.isin(self._proximity.beside[own], own).any():
            return True
        for line in self._lines:
            number, along = line.number[own], line.along[own]
            if (number == number[0]).all():
                ends = along.min() == line.first[number[0]] or along.max() == line.last[number[0]]
                return own.size > LONGEST_IN_LINE or bool(ends)
        return False

    def _own(self, excess: FloatArray) -> FloatArray:
        """(rows, columns) the excess beyond what most cells of a column have in common.

        An error of the sum of a divider's readings moves a whole column.
        """
        own: FloatArray = np.where(np.isfinite(excess), excess, 0.0)
        there = np.where(self.geometry.exists, own, np.inf)
        for board in self._boards:
            ordered = np.sort(there[board], axis=0)
            middle = np.maximum(np.isfinite(ordered).sum(axis=0) - 1, 0) // 2
            usual = np.take_along_axis(ordered, middle[None], axis=0)
            own[board] -= np.where(np.isfinite(usual), np.maximum(usual, 0.0), 0.0)
        return own

    def _rim(self, labels: IntArray, loaded: BoolArray, pressure_kpa: FloatArray) -> IntArray:
        """(rows, columns) number of the contact that untouched ``loaded`` cells belong to; 0: none.

        It is the nearest one that loaded cells connect with; of equally near ones, that with the most pressure. A
        threshold decides which cells are touched. The force of a soft contact goes on beyond it.
        """
        around = loaded & (labels == 0)
        if not around.any():
            return np.zeros_like(labels)
        total = np.bincount(labels.ravel(), np.where(labels > 0, pressure_kpa, 0.0).ravel()).astype(np.float64)
        return self._proximity.nearest(labels, around, total)

    def _measure(
        self,
        labels: IntArray,
        connected: IntArray,
        pressure_kpa: FloatArray,
        std_kpa: FloatArray,
        bridged: BoolArray | None,
        rim: IntArray,
    ) -> list[Patch]:
        """Centre, force, peak and spread of each labelled patch, in one pass over the touched cells.

        ``connected`` (cells,) are the labels before patches that touch each other were separated; ``bridged`` (rows,
        columns) are cells whose pressures are interpolated; ``rim`` (cells,) are labels of untouched cells.
        """
        cells = np.flatnonzero(labels)
        cells = cells[np.argsort(labels[cells], kind="stable")]
        ends = np.cumsum(np.bincount(labels[cells])[1:])
        starts = np.concatenate(([0], ends[:-1]))
        proximity = self._proximity
        pressure, places_mm = pressure_kpa.ravel()[cells], proximity.places_mm[cells]
        areas = proximity.areas_mm2[cells]
        load_n = NEWTON * areas * pressure
        std_n = NEWTON * areas * std_kpa.ravel()[cells]
        guessed = np.zeros(len(cells)) if bridged is None else load_n * bridged.ravel()[cells]
        moments, squares = load_n * places_mm.T, load_n * (places_mm**2).sum(axis=1)
        totals, squares, stds, guesses, area, pitch, *sums = np.add.reduceat(
            [load_n, squares, std_n, guessed, areas, proximity.pitch_mm[cells], *moments], starts, axis=1
        )
        of_rim = np.flatnonzero(rim)
        more, more_std = (
            np.bincount(
                rim[of_rim], NEWTON * proximity.areas_mm2[of_rim] * values.ravel()[of_rim], minlength=len(ends) + 1
            )[1:]
            for values in (pressure_kpa, std_kpa)
        )
        centres = np.array(sums) / totals
        variances = (squares / totals - (centres**2).sum(axis=0)) / 2
        shared = connected[cells[starts]]
        alone = np.bincount(shared)[shared] == 1
        peaks, longest = np.maximum.reduceat([pressure, proximity.longest_mm[cells]], starts, axis=1)
        places = self._places[cells]
        return [
            Patch(
                centre_mm=tuple(centres[:, k].tolist()),
                force_n=float(totals[k] + more[k]),
                force_std_n=float(stds[k] + more_std[k]),
                peak_kpa=float(peaks[k]),
                variance_mm2=float(variances[k]),
                alone=bool(alone[k]),
                cells=cells[start:end],
                places=places[start:end],
                places_mm=places_mm[start:end],
                load_n=load_n[start:end],
                area_mm2=float(area[k]),
                pitch_mm=float(pitch[k]) / (end - start),
                longest_pitch_mm=float(longest[k]),
                interpolated_n=float(guesses[k]),
            )
            for k, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True))
        ]

    def _contacts(self, patches: list[Patch], names: list[Named]) -> tuple[Contact, ...]:
        contacts = [
            Contact(
                id=name.id,
                **dict(zip(self.geometry.axes, patch.centre_mm, strict=True)),
                area_mm2=patch.area_mm2,
                force_n=patch.force_n,
                peak_kpa=patch.peak_kpa,
                cells=patch.places,
                joined=name.joined,
                interpolated_n=patch.interpolated_n,
                force_std_n=patch.force_std_n,
            )
            for patch, name in zip(patches, names, strict=True)
        ]
        return tuple(sorted(contacts, key=lambda contact: -contact.force_n))


@dataclass(slots=True, eq=False)
class PressureView:
    """Input of the tracker for one frame, and its answer."""

    number: int
    """of the frame"""
    time_s: float
    pressure_kpa: FloatArray
    std_kpa: FloatArray
    unread: BoolArray
    """(rows, columns) cells without a reading in this frame"""
    contacts: tuple[Contact, ...] | None = None
    """None: not computed yet"""


class ContactsOfFrames:
    """Contacts on demand: nothing is computed before the first request.

    Ids and hysteresis depend on earlier frames. From the first request on, every frame is therefore processed.
    """

    def __init__(self, tracker: ContactTracker) -> None:
        self._tracker = tracker
        self._lock = threading.Lock()
        self._asked = False
        self._newest = 0

    def of(self, view: PressureView) -> tuple[Contact, ...]:
        """The contacts of one frame."""
        with self._lock:
            self._asked = True
            return self._contacts_of(view)

    def pass_by(self, view: PressureView) -> None:
        """Process a new frame, if contacts were ever asked for."""
        if self._asked:
            with self._lock:
                self._contacts_of(view)

    def _contacts_of(self, view: PressureView) -> tuple[Contact, ...]:
        if view.contacts is not None:
            return view.contacts
        # A frame from before the first request gets its ids from the present contacts, which do not change.
        is_next = view.number > self._newest
        tracker = self._tracker if is_next else copy.deepcopy(self._tracker)
        if is_next:
            self._newest = view.number
        view.contacts = tracker.update(view.time_s, view.pressure_kpa, view.std_kpa, view.unread)
        return view.contacts
