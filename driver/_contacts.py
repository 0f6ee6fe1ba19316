"""Contacts on the skin: connected-component labelling with hysteresis, and tracking by linear assignment.

A pixel-wise threshold flickers with noise. As in Canny's edge detector, cells above a low threshold form a contact only
if one of them is above a high threshold, or if the contact was there a moment ago. Each cell has a hysteresis, too: the
cell between two fingers neither joins nor parts them from frame to frame.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.optimize import linear_sum_assignment

from ..arrays import BoolArray, FloatArray, IntArray
from ._later import Later

START_STDS, JOIN_STDS, STAY_STDS = 5.0, 3.2, 2.5
"""a contact begins, takes in a further cell, and keeps a cell at so many standard deviations of the cell's pressure"""
START_SHARE, JOIN_SHARE, STAY_SHARE = 0.03, 0.0192, 0.015
"""least thresholds, as shares of full scale: slow errors of the cell model are not in its standard deviation"""
NEIGHBOURS = np.ones((3, 3), dtype=int)
"""cells that touch at a corner belong together: a finger rarely covers whole rows"""
SPEED_M_PER_S = 0.5
REACH_PITCHES = 1.5
"""a contact moves at most this far between two frames, plus what the speed above allows in the time between them"""
REMEMBERED_S = 0.2
"""a contact that returns within this time keeps its id"""


@dataclass(frozen=True, slots=True)
class Contact:
    """One connected patch of touched cells. Positions count from the middle of cell (0, 0)."""

    id: int
    """number of the contact, kept while it lasts and moves; from 1"""
    x_mm: float
    """centre of pressure along the rows: column number times pitch"""
    y_mm: float
    """centre of pressure along the columns: row number times pitch"""
    area_mm2: float
    """of the touched cells, each one pitch square"""
    force_n: float
    """sum of pressure times cell area"""
    peak_kpa: float
    """largest pressure of one cell"""
    cells: IntArray
    """(n, 2) row and column of each touched cell"""

    @property
    def position_m(self) -> tuple[float, float]:
        """The position (x, y) in m."""
        return self.x_mm / 1e3, self.y_mm / 1e3


class ContactTracker:
    """Finds the contacts of frames and follows them from frame to frame."""

    def __init__(self, shape: tuple[int, int], pitch_m: float, full_scale_kpa: float) -> None:
        self.shape = shape
        self.pitch_m = pitch_m
        self.full_scale_kpa = full_scale_kpa
        self._touched: BoolArray = np.zeros(shape, dtype=bool)
        self._known: list[tuple[Contact, float]] = []
        self._last_id = 0
        self._time_s = -np.inf

    def update(self, time_s: float, pressure_kpa: FloatArray, std_kpa: FloatArray) -> tuple[Contact, ...]:
        """The contacts of the next frame, the one with the largest force first.

        Args:
            time_s: time of the frame, increasing.
            pressure_kpa: (rows, columns); a cell with NaN counts as untouched.
            std_kpa: (rows, columns) standard deviation; NaN where unknown.

        """
        found = self._find(pressure_kpa, std_kpa)
        # However slow the frames, the one just before counts.
        oldest_s = min(time_s - REMEMBERED_S, self._time_s)
        known = [(contact, seen_s) for contact, seen_s in self._known if seen_s >= oldest_s]
        self._time_s = time_s
        contacts = self._name(found, known, time_s)
        names = {contact.id for contact in contacts}
        missing = [(contact, seen_s) for contact, seen_s in known if contact.id not in names]
        self._known = [(contact, time_s) for contact in contacts] + missing
        self._touched = np.zeros(self.shape, dtype=bool)
        for contact in contacts:
            self._touched[contact.cells[:, 0], contact.cells[:, 1]] = True
        return contacts

    def look_back(self, pressure_kpa: FloatArray, std_kpa: FloatArray, before_s: float) -> tuple[Contact, ...]:
        """The contacts of a frame that came ``before_s`` before the last one; what is known stays as it is."""
        known = [(contact, 0.0) for contact, _ in self._known]
        return self._name(self._find(pressure_kpa, std_kpa), known, before_s)

    def _find(self, pressure_kpa: FloatArray, std_kpa: FloatArray) -> list[Contact]:
        std = np.nan_to_num(std_kpa, nan=0.0, posinf=np.inf)
        start = np.maximum(START_STDS * std, START_SHARE * self.full_scale_kpa)
        stay = np.maximum(STAY_STDS * std, STAY_SHARE * self.full_scale_kpa)
        begins = pressure_kpa > start  # False where NaN
        if not (begins.any() or self._touched.any()):
            return []
        join = np.maximum(JOIN_STDS * std, JOIN_SHARE * self.full_scale_kpa)
        candidates = pressure_kpa > np.where(self._touched, stay, join)
        labels, count = ndimage.label(candidates, structure=NEIGHBOURS)
        good = np.zeros(count + 1, dtype=bool)
        good[labels[begins | (self._touched & candidates)]] = True
        good[0] = False
        return [self._measure(labels == label, pressure_kpa) for label in np.flatnonzero(good)]

    def _measure(self, mask: BoolArray, pressure_kpa: FloatArray) -> Contact:
        cells = np.argwhere(mask)
        pressures = pressure_kpa[mask]
        total = float(pressures.sum())
        row, column = pressures @ cells / total
        pitch_mm = 1e3 * self.pitch_m
        return Contact(
            id=0,
            x_mm=float(column) * pitch_mm,
            y_mm=float(row) * pitch_mm,
            area_mm2=len(cells) * pitch_mm**2,
            force_n=1e3 * total * self.pitch_m**2,
            peak_kpa=float(pressures.max()),
            cells=cells,
        )

    def _name(self, found: list[Contact], known: list[tuple[Contact, float]], time_s: float) -> tuple[Contact, ...]:
        """Give each contact the id of the known contact that it continues, or a new one."""
        ids = dict.fromkeys(range(len(found)), 0)
        if found and known:
            places = np.array([contact.position_m for contact in found])
            before = np.array([contact.position_m for contact, _ in known])
            elapsed = np.array([max(time_s - seen_s, 0.0) for _, seen_s in known])
            distance = np.linalg.norm(places[:, None] - before, axis=-1)
            reach = REACH_PITCHES * self.pitch_m + SPEED_M_PER_S * elapsed
            overlap = np.array([[_share_cells(new, old) for old, _ in known] for new in found])
            possible = (distance <= reach) | overlap
            # An impossible pair costs more than all possible ones together: it is chosen only for want of others.
            impossible = 1.0 + distance[possible].sum()
            rows, columns = linear_sum_assignment(np.where(possible, distance, impossible))
            for k, j in zip(rows.tolist(), columns.tolist(), strict=True):
                if possible[k, j]:
                    ids[k] = known[j][0].id
        for number, name in ids.items():
            if not name:
                self._last_id += 1
                ids[number] = self._last_id
        named = [_with_id(contact, ids[k]) for k, contact in enumerate(found)]
        return tuple(sorted(named, key=lambda contact: -contact.force_n))


class ContactsOfFrames:
    """Contacts when they are asked for: nothing is computed before the first question.

    Ids and hysteresis depend on the frames before. So from the first question on, every frame is looked at.
    """

    def __init__(self, tracker: ContactTracker) -> None:
        self._tracker = tracker
        self._lock = threading.Lock()
        self._asked = False
        self._time_s = -np.inf

    def of(self, view: PressureView) -> tuple[Contact, ...]:
        """The contacts of one frame."""
        with self._lock:
            self._asked = True
            return self._look(view)

    def pass_by(self, view: PressureView) -> None:
        """Let a new frame be looked at, if contacts were ever asked for."""
        if self._asked:
            with self._lock:
                self._look(view)

    def _look(self, view: PressureView) -> tuple[Contact, ...]:
        if view.contacts is None:
            if view.time_s < self._time_s:
                # Older than frames looked at already, hence from before the first question: its contacts are
                # named after those of now, which it does not change.
                view.contacts = self._tracker.look_back(view.pressure_kpa, view.std_kpa(), self._time_s - view.time_s)
            else:
                view.contacts = self._tracker.update(view.time_s, view.pressure_kpa, view.std_kpa())
                self._time_s = view.time_s
        return view.contacts


@dataclass(slots=True)
class PressureView:
    """What the tracker needs of one frame, and its answer."""

    time_s: float
    pressure_kpa: FloatArray
    std_kpa: Later
    contacts: tuple[Contact, ...] | None = None


def _share_cells(one: Contact, other: Contact) -> bool:
    return not {*map(tuple, one.cells.tolist())}.isdisjoint(map(tuple, other.cells.tolist()))


def _with_id(contact: Contact, name: int) -> Contact:
    return Contact(name, contact.x_mm, contact.y_mm, contact.area_mm2, contact.force_n, contact.peak_kpa, contact.cells)
