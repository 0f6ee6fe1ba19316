"""Contacts on the skin: connected-component labelling with hysteresis, and tracking from frame to frame.

A pixel-wise threshold flickers with noise. We use two thresholds, as in Canny's edge detector: cells above the low one
form a contact only if one of them is above the high one, or if the contact was there a moment ago. Each cell
has a hysteresis, too, so that the cell between two fingers does not join and part them from frame to frame. Fingers
that touch each other are separated along the valley between them (:mod:`._watershed`). :mod:`._tracks` gives the
contacts their ids.

On boards with few ADC steps a touch hardly ever exceeds five standard deviations of one cell's pressure. There a joint
rise of neighbouring readings, sudden or within seconds, also makes a contact (:mod:`._rises`). This contact lasts as
long as the pressures do.

Rest resistances drift with temperature and age, and the driver takes a rise of resistance for a load. A contact
therefore begins only where the pressure exceeds the part that drift may have caused. In an untouched cell this part
follows the pressure upwards by at most :data:`DRIFT_PER_S`. In the cells of a contact it stays constant, so that no
held load fades.

A disturbance of the converter changes readings that are converted one after another, for one frame. A new patch within
one row or column is therefore a contact only in its second frame; a new patch over several rows and columns is one at
once.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from ..common.arrays import BoolArray, FloatArray, IntArray
from ._around import highest_around, sums_around, with_all_neighbours
from ._bridging import bridge
from ._later import Later
from ._pitch import Pitch
from ._rises import Rises
from ._tare import KNOWN_DRIFT
from ._tracks import Named, Patch, Tracks
from ._trails import Trails
from ._watershed import Segments

START_STDS, JOIN_STDS, STAY_STDS = 5.0, 3.2, 2.5
"""thresholds in standard deviations of a cell's pressure: to begin a contact, to join one, to stay in one"""
START_SHARE, JOIN_SHARE, STAY_SHARE = 0.03, 0.0192, 0.015
"""lower bounds of these thresholds, as fractions of full scale: the standard deviation leaves out slow errors of the
cell model"""
LEFT_SHARE, FALLEN_SHARE = 0.4, 0.7
"""fractions of the largest pressure of a cell since it rose jointly with others. Below the first, its touch is over;
below the second, if the cell has just fallen jointly with others"""
TOGETHER_STDS, HELD_S, HELD_SHARE = 2.0, 0.5, 0.9
"""a touch begins where the weighted sum of the pressures of neighbouring cells has exceeded this many times the sum of
their standard deviations for this time, and has not fallen below this fraction of its largest value. A press grows or
is steady; the estimates after a tap fade. Errors of neighbours have the same history, so their standard deviations are
added as if the errors were common"""
MISSING_S = 0.2
"""a cell without a reading for longer is missing; until then its last pressure counts"""
DRIFT_PER_S = 0.003
"""relative change of a rest resistance per second: warming up takes minutes. A finger presses much faster"""
WAKE_SHARE, WAKE_S = 0.15, 1.0
"""fraction of the largest pressure in the 3 x 3 cells around a cell, forgotten with this time constant: what a finger
leaves in the estimates behind and beside it is less, and begins no contact"""
SPARK_S, STANDS_OUT = 0.1, 15.0
"""a patch that may be a bad contact (a lone cell, or part of a line as a bad line moves it) is a contact only after
this time, but in its second frame if a reading has risen by this many standard deviations of its noise, since the
estimator judges such jumps itself"""
LONGEST_IN_LINE = 3
"""cells within one line that a stylus covers"""
EVEN_LINE = 0.3
"""fraction of the rise of some cells of a line: if the median of its other cells rises by more, the line is bad"""


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
    """of the touched cells, each one pitch by one pitch"""
    force_n: float
    """sum of pressure times cell area; cells that are not read count with the part :attr:`interpolated_n`"""
    peak_kpa: float
    """largest pressure of one cell"""
    cells: IntArray = field(compare=False)
    """(n, 2) row and column of each touched cell; not part of a comparison of contacts"""
    joined: tuple[int, ...] = ()
    """ids of other contacts that have merged into this one; they get these ids back when they part from it"""
    interpolated_n: float = 0.0
    """part of :attr:`force_n` on cells that are not read but lie between touched ones, interpolated between these. A
    lower bound if the middle of the press lies there. A gap at the rim of a contact is not counted"""

    @property
    def position_m(self) -> tuple[float, float]:
        """The position (x, y) in m."""
        return self.x_mm / 1e3, self.y_mm / 1e3


class ContactTracker:
    """Finds the contacts of frames and follows them from frame to frame."""

    def __init__(
        self,
        shape: tuple[int, int],
        pitch_m: float | tuple[float, float],
        full_scale_kpa: float,
        *,
        drift_kpa: float = 0.0,
        faults_press: bool = True,
    ) -> None:
        """Begin with an untouched skin.

        Args:
            shape: rows and columns.
            pitch_m: distance of neighbouring cells; (x, y) if cells are not square, along a row and along a column.
            full_scale_kpa: of the cells.
            drift_kpa: pressure of an untouched cell whose rest resistance has drifted as far as rest resistances do
                (:data:`._tare.KNOWN_DRIFT`); 0: no drift.
            faults_press: True if a bad contact, which adds resistance, looks like a load; False if loads lower the
                resistance.

        """
        self.shape = shape
        self.pitch = Pitch.of(pitch_m)
        self.full_scale_kpa = full_scale_kpa
        self._faults_press = faults_press
        self._labels: IntArray = np.zeros(shape, dtype=int)
        self._pressed: BoolArray = np.zeros(shape, dtype=np.bool_)
        """(rows, columns) cells of the last frame with enough pressure for a contact, however uncertain"""
        self._pressed_s = np.full(shape, np.inf)
        """(rows, columns) time since which they have been pressed; infinite for the others"""
        self._rise: tuple[FloatArray, FloatArray] | None = None
        """readings and their noise, as for :meth:`update`"""
        self._fingers: list[int] = []
        """number of fingers for each label"""
        self._were_parted = False
        self._segments = Segments(shape)
        self._rises = Rises(shape, loads_raise=faults_press)
        self._trails = Trails(shape)
        self._risen_kpa = np.zeros(shape)
        """(rows, columns) largest pressure since the cell rose jointly with its neighbours; 0: no such rise"""
        self._risen_s = np.full(shape, np.inf)
        """(rows, columns) time of that rise; infinite for the others"""
        self._rising: BoolArray = np.zeros(shape, dtype=np.bool_)
        """(rows, columns) middles of the joint rises in this frame"""
        self._together_s = np.full(shape, np.inf)
        """(rows, columns) time since which untouched cells jointly show a steady load; infinite for others"""
        self._together_kpa = np.zeros(shape)
        """(rows, columns) largest weighted sum of pressures since then"""
        self._most_drift_kpa, self._drift_kpa_per_s = drift_kpa, drift_kpa / KNOWN_DRIFT * DRIFT_PER_S
        self._drift_kpa = np.zeros(shape)
        """(rows, columns) part of the pressure that drift may have caused"""
        self._wake_kpa = np.zeros(shape)
        """(rows, columns) largest recent pressure while the cell was in a contact, with exponential forgetting"""
        self._time_s = math.inf
        self._read_s = np.full(shape, -np.inf)
        """(rows, columns) time of the cell's last reading; only used if readings are given"""
        self._missing: BoolArray | None = None
        """(rows, columns) cells that are not read; None: only those with a pressure of NaN"""
        self._tracks = Tracks(1e3 * self.pitch.mean_m, 1e3 * max(self.pitch))
        self._places: IntArray = np.indices(shape).reshape(2, -1).T.copy()
        """(cells, 2) row and column of each cell of the flattened array"""
        self._places_mm = 1e3 * np.array(self.pitch) * self._places[:, ::-1]
        """(cells, 2) x and y of each cell's middle"""

    def update(
        self,
        time_s: float,
        pressure_kpa: FloatArray,
        std_kpa: FloatArray,
        rise: tuple[FloatArray, FloatArray] | None = None,
    ) -> tuple[Contact, ...]:
        """The contacts of the next frame, the one with the largest force first.

        Args:
            time_s: time of the frame, increasing.
            pressure_kpa: (rows, columns); a cell with NaN counts as untouched.
            std_kpa: (rows, columns) standard deviation; NaN where unknown.
            rise: readings and their noise, as :meth:`ohmskin.cell.Estimator.rise_of_last_step` gives them; None: joint
                rises are not looked for.

        """
        self._follow_joint_rises(time_s, pressure_kpa, std_kpa, rise)
        if rise is not None:
            self._trails.look(*rise, self._labels > 0)
            self._find_missing(time_s, np.isnan(rise[0]))
        self._rise = rise
        if math.isinf(self._time_s):
            # In the first frame: most likely these cells have been pressed for longer than sparks last.
            self._pressed_s[pressure_kpa > START_SHARE * self.full_scale_kpa] = -np.inf
        labels, patches = self._find(time_s, pressure_kpa, std_kpa)
        self._pressed = pressure_kpa > START_SHARE * self.full_scale_kpa
        self._pressed_s = np.where(self._pressed, np.minimum(self._pressed_s, time_s), np.inf)
        names = self._tracks.follow(time_s, patches, labels)
        self._labels = labels.reshape(self.shape)
        self._fingers = [1 + len(name.joined) for name in names]
        # Cells from which the touch that raised them has gone are forgotten.
        self._risen_kpa[(self._labels == 0) & ~self._rising] = 0.0
        self._risen_s = np.where(self._risen_kpa > 0, np.minimum(self._risen_s, time_s), np.inf)
        elapsed_s, self._time_s = max(time_s - self._time_s, 0.0), time_s
        self._drift(elapsed_s, pressure_kpa)
        self._remember(elapsed_s, pressure_kpa)
        self._were_parted = not all(patch.alone for patch in patches)
        return self._contacts(patches, names)

    def look_back(self, time_s: float, pressure_kpa: FloatArray, std_kpa: FloatArray) -> tuple[Contact, ...]:
        """The contacts of a frame at ``time_s``, before the last one; tracks and hysteresis do not change."""
        labels, patches = self._find(time_s, pressure_kpa, std_kpa)
        return self._contacts(patches, self._tracks.look_back(time_s, patches, labels))

    def forget_readings(self) -> None:
        """Compare no reading with an earlier one: rest resistances have changed."""
        self._rises.forget()
        self._trails.forget()

    def _remember(self, elapsed_s: float, pressure_kpa: FloatArray) -> None:
        """Remember the pressures of contacts for the places that the contacts leave."""
        self._wake_kpa *= math.exp(-elapsed_s / WAKE_S)
        np.fmax(self._wake_kpa, pressure_kpa, out=self._wake_kpa, where=self._labels > 0)

    def _drift(self, elapsed_s: float, pressure_kpa: FloatArray) -> None:
        """Let the drift of untouched cells follow their pressures: slowly upwards, at once downwards."""
        if not self._most_drift_kpa:
            return
        most = np.minimum(self._drift_kpa + self._drift_kpa_per_s * elapsed_s, self._most_drift_kpa)
        np.fmin(most, np.fmax(pressure_kpa, 0.0), out=most)
        self._drift_kpa = np.where(self._labels > 0, self._drift_kpa, most)

    def _find_missing(self, time_s: float, unread: BoolArray) -> None:
        """Update the cells without a recent reading; ``unread`` (rows, columns) were not read in this frame."""
        if not unread.any():
            self._missing = None
            self._read_s.fill(time_s)
            return
        self._read_s[~unread] = time_s
        self._missing = time_s - self._read_s > MISSING_S

    def _follow_joint_rises(
        self,
        time_s: float,
        pressure_kpa: FloatArray,
        std_kpa: FloatArray,
        rise: tuple[FloatArray, FloatArray] | None,
    ) -> None:
        """Find cells that have risen jointly, and cells whose touch is over."""
        found = None if rise is None else self._rises.look(time_s, *rise)
        risen_kpa = self._risen_kpa
        held = self._held_together(time_s, pressure_kpa, std_kpa)
        self._rising = np.zeros(self.shape, dtype=np.bool_) if found is None else found.middle
        if found is None and held is None:
            of_touch = risen_kpa > 0
            if (pressure_kpa[of_touch] >= FALLEN_SHARE * risen_kpa[of_touch]).all():
                return  # there is no touch, or it is held
        full = self.full_scale_kpa
        least = np.maximum(LEFT_SHARE * risen_kpa, STAY_SHARE * full)
        lasts = (pressure_kpa > least) & (risen_kpa > 0)
        lasts &= self._touch_lasts(time_s, pressure_kpa, None if found is None else found.fallen)
        if found is not None:
            lasts |= found.risen & (pressure_kpa > START_SHARE * full)
        if held is not None:
            lasts |= held
        self._risen_kpa = np.where(lasts, np.maximum(risen_kpa, pressure_kpa), 0.0)
        # These cells stay in their contact only by their own pressures, and only if these exceed what a touch that has
        # moved on leaves behind.
        alone = pressure_kpa > np.fmax(JOIN_STDS * std_kpa, np.maximum(JOIN_SHARE * full, LEFT_SHARE * risen_kpa))
        self._labels = np.where((risen_kpa > 0) & ~lasts & ~alone, 0, self._labels)

    def _held_together(self, time_s: float, pressure_kpa: FloatArray, std_kpa: FloatArray) -> BoolArray | None:
        """(rows, columns) untouched cells that neighbours jointly show to be under a steady load; None: no cell."""
        excess = pressure_kpa - self._drift_kpa
        known = np.isfinite(excess) & np.isfinite(std_kpa)
        pressed = known & (excess > START_SHARE * self.full_scale_kpa)
        free = pressed & (self._labels == 0)
        if not free.any():
            self._together_s.fill(np.inf)
            return None
        sums, stds = sums_around(np.where(known, excess, 0.0)), sums_around(np.where(known, std_kpa, 0.0))
        # The sums without the cell's row and without its column must suffice, too: wiring faults move one line.
        for total, std in zip(sums, stds, strict=True):
            free &= total > TOGETHER_STDS * std
        largest = np.where(np.isfinite(self._together_s), np.maximum(self._together_kpa, sums.whole), sums.whole)
        steady = free & (sums.whole >= HELD_SHARE * largest)
        self._together_s = np.where(steady, np.minimum(self._together_s, time_s), np.inf)
        self._together_kpa = largest
        middle = time_s - self._together_s > HELD_S
        return with_all_neighbours(middle) & pressed if middle.any() else None

    def _touch_lasts(self, time_s: float, pressure_kpa: FloatArray, fallen: BoolArray | None) -> BoolArray:
        """(rows, columns) cells of joint rises whose touch goes on as a whole: its rim does not outlast its middle.

        If one of several merged touches is released, the whole falls. Cells that keep their pressure then go on.
        """
        numbers, risen_kpa = self._labels.ravel(), self._risen_kpa.ravel()
        now = np.bincount(numbers, np.where(risen_kpa > 0, np.fmax(pressure_kpa.ravel(), 0.0), 0.0))
        least = LEFT_SHARE * np.bincount(numbers, risen_kpa)
        if fallen is not None:
            least[numbers[fallen.ravel() & (risen_kpa > 0)]] *= FALLEN_SHARE / LEFT_SHARE
        goes_on: BoolArray = now > least
        goes_on[0] = True  # cells in no contact yet
        lasts = goes_on[self._labels]
        if fallen is not None and not goes_on.all():
            lasts |= self._held_in_a_fall(time_s, ~lasts & (pressure_kpa > FALLEN_SHARE * self._risen_kpa), fallen)
        return lasts

    def _held_in_a_fall(self, time_s: float, bears: BoolArray, fallen: BoolArray) -> BoolArray:
        """(rows, columns) cells with unchanged load, connected with a held cell whose surroundings have not fallen.

        All cells of a finger that is lifted have falling cells around them. A rim that is wider than these bears less
        than :data:`WAKE_SHARE` of the middle. After taps and moving fingers the estimates stay higher for a moment, so
        a cell counts as held only if it rose more than :data:`WAKE_S` ago.

        Args:
            time_s: of the frame.
            bears: (rows, columns) cells that have not fallen themselves, in contacts that have fallen as a whole.
            fallen: (rows, columns) cells that have fallen jointly with their neighbours.

        """
        most_kpa = np.zeros(self._labels.max() + 1)
        np.maximum.at(most_kpa, self._labels, self._risen_kpa)
        held = bears & ~fallen & (self._risen_kpa > WAKE_SHARE * most_kpa[self._labels])
        held &= time_s - self._risen_s > WAKE_S
        parts, count = self._segments.label(bears)
        lasting = np.zeros(count + 1, dtype=np.bool_)
        lasting[parts[held]] = True
        of_lasting: BoolArray = lasting[parts]
        return of_lasting

    def _find(self, time_s: float, pressure_kpa: FloatArray, std_kpa: FloatArray) -> tuple[IntArray, list[Patch]]:
        """For each cell of the flattened array the number of its patch, from 1 (0: none), and the patches."""
        full = self.full_scale_kpa
        start = np.fmax(START_STDS * std_kpa, START_SHARE * full)  # fmax: a deviation of NaN is ignored
        risen, excess = self._risen_kpa > 0, pressure_kpa - self._drift_kpa
        begins = (excess > start) | risen  # False where NaN
        if begins.any():
            begins &= self._rising | (excess > WAKE_SHARE * highest_around(self._wake_kpa))
        touched = self._labels > 0
        if not (begins.any() or touched.any()):
            return np.zeros(pressure_kpa.size, dtype=int), []
        stay = np.fmax(STAY_STDS * std_kpa, STAY_SHARE * full)
        join = np.fmax(JOIN_STDS * std_kpa, JOIN_SHARE * full)
        candidates = (excess > np.where(touched, stay, join)) | risen
        pressure_kpa, bridged = self._bridge(pressure_kpa, candidates)
        if bridged is not None:
            candidates |= bridged
        if self._trails.any_left:
            candidates &= ~self._trails.left
            begins &= candidates
        found, count = self._segments.label(candidates)
        kept = np.zeros(count + 1, dtype=bool)
        kept[found[begins]] = True
        kept[0] = False
        self._keep_lasting(found, kept, pressure_kpa)
        self._drop_disturbances(time_s, found, kept)
        if not kept.any():
            return np.zeros(pressure_kpa.size, dtype=int), []
        labels = np.where(kept, np.cumsum(kept), 0)[found]
        fingers = self._segments.part(
            labels, pressure_kpa, std_kpa, begins & (labels > 0), self._labels, were_parted=self._were_parted
        )
        return fingers.ravel(), self._measure(fingers.ravel(), labels.ravel(), pressure_kpa, bridged)

    def _bridge(self, pressure_kpa: FloatArray, touched: BoolArray) -> tuple[FloatArray, BoolArray | None]:
        """Pressures interpolated at missing cells between touched ones, and these cells; None: no cell."""
        missing = np.isnan(pressure_kpa)
        if self._missing is not None:
            missing |= self._missing
        if not missing.any():
            return pressure_kpa, None
        bridged, pressure_kpa = bridge(pressure_kpa, touched, missing)
        return pressure_kpa, bridged if bridged.any() else None

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

    def _drop_disturbances(self, time_s: float, found: IntArray, kept: BoolArray) -> None:
        """Drop new patches within one row or column that may be electrical faults.

        Patches that were not there in the last frame may be disturbances of the converter. If their readings hardly
        rise above the noise, two kinds of patches may be faults for longer: lone cells may be sparks; patches that are
        long or reach an end of their line may be bad lines, of which the other cells cannot be seen.

        Args:
            time_s: of the frame.
            found: (rows, columns) labels of patches, from 1.
            kept: (labels,) patches that make contacts, changed.

        """
        fresh = kept.copy()
        fresh[found[self._labels > 0]] = False
        if not fresh.any():
            return
        boxes = ndimage.find_objects(found)
        for label in np.flatnonzero(fresh).tolist():
            box = boxes[label - 1]
            if min(span.stop - span.start for span in box) > 1:
                continue
            lasts_s = time_s - float(self._pressed_s[box][found[box] == label].min())
            kept[label] = lasts_s > (SPARK_S if self._may_be_a_fault(np.argwhere(found == label)) else 0.0)

    def _may_be_a_fault(self, cells: IntArray) -> bool:
        """Whether cells (n, 2) of one row or column may have risen by a bad contact that the estimator cannot see."""
        if self._rise is None or not self._faults_press:
            return False
        reading, noise = self._rise
        rows, columns = cells.T
        risen = reading[rows, columns]
        if (risen > STANDS_OUT * noise[rows, columns]).any():
            return False
        if len(cells) == 1 or len(cells) > LONGEST_IN_LINE:
            return True
        line, places = (reading[rows[0]], columns) if rows[0] == rows[-1] else (reading[:, columns[0]], rows)
        if places.min() == 0 or places.max() == line.size - 1:
            return True
        others = np.delete(line, places)
        return bool(np.nanmedian(others) > EVEN_LINE * risen.mean()) if not np.isnan(others).all() else False

    def _measure(
        self, labels: IntArray, connected: IntArray, pressure_kpa: FloatArray, bridged: BoolArray | None
    ) -> list[Patch]:
        """Centre, force, peak and spread of each labelled patch, in one pass over the touched cells.

        ``connected`` (cells,) are the labels before patches that touch each other were separated; ``bridged`` (rows,
        columns) are cells whose pressures are interpolated.
        """
        cells = np.flatnonzero(labels)
        if not len(cells):
            return []
        cells = cells[np.argsort(labels[cells], kind="stable")]
        ends = np.cumsum(np.bincount(labels[cells])[1:])
        starts = np.concatenate(([0], ends[:-1]))
        pressure, places, places_mm = pressure_kpa.ravel()[cells], self._places[cells], self._places_mm[cells]
        x, y = places_mm.T
        totals, x_sums, y_sums, squares = np.add.reduceat(
            [pressure, pressure * x, pressure * y, pressure * (x * x + y * y)], starts, axis=1
        )
        x_mean, y_mean = x_sums / totals, y_sums / totals
        variances = (squares / totals - x_mean**2 - y_mean**2) / 2
        forces = 1e3 * self.pitch.area_m2 * totals
        peaks = np.maximum.reduceat(pressure, starts)
        shared = connected[cells[starts]]
        alone = np.bincount(shared)[shared] == 1
        interpolated = np.zeros(len(starts))
        if bridged is not None:
            interpolated = 1e3 * self.pitch.area_m2 * np.add.reduceat(pressure * bridged.ravel()[cells], starts)
        measures = (x_mean, y_mean, forces, peaks, variances, alone, interpolated, starts, ends)
        return [
            Patch(
                x_mm=x,
                y_mm=y,
                force_n=force,
                peak_kpa=peak,
                variance_mm2=variance,
                alone=one,
                cells=cells[start:end],
                places=places[start:end],
                places_mm=places_mm[start:end],
                pressure_kpa=pressure[start:end],
                interpolated_n=guessed,
            )
            for x, y, force, peak, variance, one, guessed, start, end in zip(
                *(measure.tolist() for measure in measures), strict=True
            )
        ]

    def _contacts(self, patches: list[Patch], names: list[Named]) -> tuple[Contact, ...]:
        cell_mm2 = 1e6 * self.pitch.area_m2
        contacts = [
            Contact(
                id=name.id,
                x_mm=patch.x_mm,
                y_mm=patch.y_mm,
                area_mm2=len(patch.cells) * cell_mm2,
                force_n=patch.force_n,
                peak_kpa=patch.peak_kpa,
                cells=patch.places,
                joined=name.joined,
                interpolated_n=patch.interpolated_n,
            )
            for patch, name in zip(patches, names, strict=True)
        ]
        return tuple(sorted(contacts, key=lambda contact: -contact.force_n))


class ContactsOfFrames:
    """Contacts on demand: nothing is computed before the first request.

    Ids and hysteresis depend on earlier frames. From the first request on, every frame is therefore processed.
    """

    def __init__(self, tracker: ContactTracker) -> None:
        self._tracker = tracker
        self._lock = threading.Lock()
        self._asked = False
        self._time_s = -np.inf
        self._starts = -1

    @property
    def asked(self) -> bool:
        """Whether every frame is to be processed."""
        return self._asked

    def of(self, view: PressureView) -> tuple[Contact, ...]:
        """The contacts of one frame."""
        with self._lock:
            self._asked = True
            return self._look(view)

    def pass_by(self, view: PressureView) -> None:
        """Process a new frame, if contacts were ever asked for."""
        if self._asked:
            with self._lock:
                self._look(view)

    def _look(self, view: PressureView) -> tuple[Contact, ...]:
        if view.contacts is None:
            if view.time_s < self._time_s:
                # The frame is from before the first request. Its contacts get their ids from the present contacts,
                # which do not change.
                view.contacts = self._tracker.look_back(view.time_s, view.pressure_kpa, view.std_kpa())
            else:
                if view.starts != self._starts:
                    self._starts = view.starts
                    self._tracker.forget_readings()
                view.contacts = self._tracker.update(view.time_s, view.pressure_kpa, view.std_kpa(), view.rise)
                self._time_s = view.time_s
        return view.contacts


@dataclass(slots=True)
class PressureView:
    """Input of the tracker for one frame, and its contacts."""

    time_s: float
    pressure_kpa: FloatArray
    std_kpa: Later
    rise: tuple[FloatArray, FloatArray] | None = None
    """readings and their noise; None where nobody has asked for contacts yet"""
    starts: int = 0
    """number of times that the estimator has started without memory"""
    contacts: tuple[Contact, ...] | None = None
