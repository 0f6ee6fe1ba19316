"""Contacts on the skin, from the pressures of a frame and their standard deviations alone.

A threshold on each cell flickers with noise. We use two, as in Canny's edge detector: a contact begins where the
pressure is surely that of a load, takes in the cells around that are likely loaded, and lets a cell go when it hardly
is. Where single cells are not sure, neighbours are judged together. Connected cells are one contact; fingers that touch
each other are parted along the valley between them (:mod:`._watershed`), and :mod:`._tracks` gives the contacts their
ids. All this is one kernel per frame; a :class:`Contact` is made of what it finds when somebody asks.

Rest resistances drift with temperature and age, and the driver takes a rise of resistance for a load. A contact
therefore begins only where the pressure exceeds the part that drift may have caused. In an untouched cell this part
follows the pressure upwards by at most :data:`DRIFT_PER_S`; in the cells of a contact it stays constant, so that no
held load fades.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple
from weakref import ref

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..common.compiled import Records, record
from ..common.geometry import Geometry
from ._contact_frame import take_frame
from ._touch import Memory, Patch, Scan, Skin, Untouched
from ._tuning import DRIFT_PER_S, KNOWN_DRIFT, QUEUE


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
    """sum of pressure times cell area, with the rim: loaded cells around the touched ones, down to 0.5 % of
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


class Found(NamedTuple):
    """The contacts of a frame, as the kernel found them."""

    patches: Records[Patch]
    cells: IntArray
    """(m,) touched cells in the order of their patches"""


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
        untouched = record(
            Untouched,
            full_scale_kpa=full_scale_kpa,
            most_drift_kpa=drift_kpa,
            drift_kpa_per_s=drift_kpa / KNOWN_DRIFT * DRIFT_PER_S,
            faults_press=float(faults_press),
            columns=geometry.shape[1],
        )
        count = geometry.areas_mm2.size
        self._skin, self._memory, self._scan = (
            Skin.of(geometry, untouched),
            Memory.of_nothing(count),
            Scan.of_size(count),
        )
        self._given = [each.reshape(geometry.shape) for each in self._scan[:3]]

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
        return self.contacts(self.take(time_s, pressure_kpa, std_kpa, unread))

    def take(
        self, time_s: float, pressure_kpa: FloatArray, std_kpa: FloatArray, unread: BoolArray | None = None
    ) -> Found:
        """The same as records, of which :meth:`contacts` makes contacts."""
        for array, values in zip(self._given, (pressure_kpa, std_kpa, unread is not None and unread), strict=True):
            array[...] = values
        count = take_frame.unchecked(self._skin, self._memory, self._scan, time_s)
        touched = int(self._memory.progress["touched"].item())
        return Found(self._memory.patches[:count].copy(), self._memory.order[:touched].copy())

    def contacts(self, found: Found) -> tuple[Contact, ...]:
        """The contacts of a frame, the one with the largest force first."""
        axes, columns = self.geometry.axes, self.geometry.shape[1]
        places, fields = np.stack(np.divmod(found.cells, columns), axis=1), Patch.dtype().names or ()
        contacts = []
        for patch in (dict(zip(fields, each, strict=True)) for each in found.patches.tolist()):
            first, others = int(patch["first"]), int(patch["others"])
            contacts.append(
                Contact(
                    id=int(patch["id"]),
                    **dict(zip(axes, patch["at_mm"].tolist(), strict=False)),
                    area_mm2=patch["area_mm2"],
                    force_n=patch["force_n"],
                    peak_kpa=patch["peak_kpa"],
                    cells=places[first : first + int(patch["cells"])],
                    joined=tuple(map(int, patch["joined"][:others])),
                    interpolated_n=patch["interpolated_n"],
                    force_std_n=patch["force_std_n"],
                )
            )
        return tuple(sorted(contacts, key=lambda contact: -contact.force_n))


@dataclass(slots=True, eq=False, weakref_slot=True)
class PressureView:
    """Input of the tracker for one frame, and its answer."""

    time_s: float
    pressure_kpa: FloatArray
    std_kpa: FloatArray
    unread: BoolArray
    """(rows, columns) cells without a reading in this frame"""
    found: Found | None = None
    """None: not computed yet"""
    contacts: tuple[Contact, ...] | None = None
    """None: nobody has asked yet"""


class ContactsOfFrames:
    """Contacts on demand: nothing is computed before the first request.

    Ids and hysteresis depend on earlier frames. On the first request all frames that anybody still holds are therefore
    taken in their order, and every later one when it comes. A tare, whose own frames nobody holds after it, has them
    taken.
    """

    def __init__(self, tracker: ContactTracker) -> None:
        self._tracker = tracker
        self._lock = threading.Lock()
        self._asked = False
        self._waiting: deque[ref[PressureView]] = deque()
        """frames that were not taken yet, in their order, as long as anybody holds them"""
        self._most_waiting = QUEUE

    def of(self, view: PressureView) -> tuple[Contact, ...]:
        """The contacts of a frame that has passed by."""
        with self._lock:
            self._asked = True
            self._take_waiting()
            if view.contacts is None:
                assert view.found is not None
                view.contacts = self._tracker.contacts(view.found)
            return view.contacts

    def pass_by(self, view: PressureView) -> Callable[[], tuple[Contact, ...]]:
        """Take a new frame, or keep it until contacts are asked for. Returns a function that asks for its contacts."""
        self._waiting.append(ref(view))
        if self._asked:
            with self._lock:
                self._take_waiting()
        elif len(self._waiting) > self._most_waiting:
            with self._lock:
                self._forget_dead()
        return partial(self.of, view)

    def catch_up(self) -> None:
        """Take the frames that wait, as on a request."""
        with self._lock:
            self._take_waiting()

    def _take_waiting(self) -> None:
        while self._waiting:
            view = self._waiting.popleft()()
            if view is not None:
                view.found = self._tracker.take(view.time_s, view.pressure_kpa, view.std_kpa, view.unread)

    def _forget_dead(self) -> None:
        self._waiting = deque(each for each in self._waiting if each() is not None)
        self._most_waiting = 2 * len(self._waiting) + QUEUE
