"""Measurement chain: counts to ohms (inverse circuit model) to kPa (causal estimator), each frame once, in order."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..cell import Cell
from ..circuits import Design, Reason
from ..common.arrays import FloatArray
from ..common.geometry import Geometry
from ..common.measurement import Measurement
from ..errors import InputError, ProtocolError
from ..wire import Layout
from ._advice import Advice
from ._calibration import Calibration
from ._contacts import ContactsOfFrames, ContactTracker, PressureView, Touch
from ._converted import Converted
from ._estimate import Estimate
from ._line_faults import Creep, LineFaults
from ._plain import PlainReader
from ._reading import CountReader
from ._rest import Rest
from ._statistics import Counters
from ._stream import RawFrame
from ._tare import RestChange
from ._tuning import KEEP_STATE_S, KNOWN_DRIFT, TARE_FRAMES

CLOCK_DIGITS = 6
"""decimals of the seconds between frames: boards count microseconds. The estimator caches its work per length of step:
that work takes a small skin as long as ten frames; sums of seconds would differ in their last digits"""

_UNSOLVED, _BEYOND_MODEL = int(Reason.UNSOLVED), int(Reason.BEYOND_MODEL)


_Read = tuple[RawFrame, float, Measurement]
"""a frame whose pressures are not estimated yet, s since the frame before, and what it measures"""


class Converter:
    """Turns frames into measurements: each frame once, in the order of arrival, as :class:`._frames.Frames` asks."""

    def __init__(
        self,
        design: Design | Layout,
        cell: Cell | None,
        estimator: str | None,
        geometry: Geometry,
        counters: Counters,
        *,
        rest_changes: Sequence[RestChange] = (),
        accuracy: float | None = None,
        calibration: Calibration | None = None,
    ) -> None:
        """Set up the circuit's inverse and the estimator; without ``cell`` pressures are NaN.

        ``design`` is the array alone where the circuit is not known. Frames then have counts, and a tare takes those.
        ``rest_changes`` come from a recording.
        ``accuracy`` is the relative uncertainty up to which cells are valid, see :class:`CountReader`.
        ``calibration`` gives each cell its gain, and its rest resistance as long as no tare replaces that.

        Raises:
            ProtocolError: the design has no ADC.
            InputError: there is no such estimator for this cell, or the accuracy is not between 0 and 1.

        """
        self.design = design if isinstance(design, Design) else None
        """None: the circuit is not known"""
        self.shape = design.array.shape if isinstance(design, Design) else (design.rows, design.columns)
        self.cell = cell
        self.geometry = geometry
        self._holes = None if geometry.is_whole else ~geometry.exists
        """(rows, columns) crossings without a cell; None: there are none"""
        self._estimator_name = estimator
        self._calibration = calibration
        self._counters = counters
        self._accuracy = accuracy
        self._read = self._new_reader()
        self._present: NDArray[np.uint16] | None = None
        """last counts that the board has sent of each cell"""
        self._rest = None if cell is None else Rest(cell, calibration)
        self.rest: FloatArray | None = None
        """(rows, columns) rest resistances by a tare, or counts where the circuit is not known; None: no tare"""
        self._advice = Advice(cell, self._rest, accuracy, counters, knows_circuit=self.design is not None)
        self._no_rest = np.zeros(self.shape)
        self._no_rest.setflags(write=False)
        for ohm in (change.rest for change in rest_changes):
            if ohm is not None and ohm.size != math.prod(self.shape):
                raise InputError("a tare of {} cells; this skin has {} x {}".format(ohm.size, *self.shape))
        self._rest_changes = deque(rest_changes)
        self.on_rest: list[Callable[[FloatArray | None, int], None]] = []
        """called with new rest resistances and the number of the last frame before them: for recorders"""
        self.starts = 0
        """number of times that the estimator has started without memory"""
        self._creep: Creep | None = None
        self._line_faults: LineFaults | None = None
        self._estimate = self._new_estimate()
        full_scale_kpa = np.inf if cell is None else cell.full_scale_kpa
        drift_kpa = 0.0 if self._rest is None else self._rest.kpa_of(KNOWN_DRIFT)
        faults_press = self._estimate is None or self._estimate.estimator.side > 0
        self.touch = Touch(full_scale_kpa, drift_kpa, faults_press)
        self.contacts = ContactsOfFrames(ContactTracker(geometry, *self.touch))
        self._last: RawFrame | None = None
        self._last_s: float | None = None
        """of the last frame, on the estimator's time scale"""
        self._recent: deque[tuple[float, Measurement]] = deque(maxlen=TARE_FRAMES)
        """times and readings of the last frames"""
        self.notices = counters.notices

    @property
    def last_index(self) -> int:
        """Number of the newest converted frame; 0 before the first."""
        return 0 if self._last is None else self._last.index

    def try_out(self) -> None:
        """Convert a frame of mid-scale counts, to reveal absurd values and to pay the cost of setting up.

        The results are dropped: an inversion that starts far from the skin's own readings takes many frames to
        converge, and some of its cells may not converge at all.
        """
        if self.design is None:
            return
        adc = self.design.adc
        assert adc is not None, "CountReader refuses designs without an ADC"
        counts = np.full(self.shape, 2 ** (adc.bits - 1), dtype=np.uint16)
        measured, trial = self._read(counts), self._fresh_estimate()
        if trial is not None:
            trial.estimator.update(1.0, measured)
        self._read = self._new_reader()

    def _new_reader(self) -> CountReader | PlainReader:
        if self.design is None:
            return PlainReader(self.shape)
        lowest_ohm = None if self.cell is None else float(self.cell.equilibrium_ohm([0.0, 1.0]).min())
        return CountReader(self.design, accuracy=self._accuracy, lowest_ohm=lowest_ohm)

    def use_rest(self, rest_ohm: FloatArray | None) -> None:
        """Use these rest resistances (rows, columns) from now on (None: those without a tare).

        The estimator begins anew with the last :data:`TARE_FRAMES` frames.
        """
        self.rest = rest_ohm
        if self._rest is not None:
            self._rest.tared_ohm = rest_ohm
        self._estimate = self._new_estimate()
        before_s: float | None = None
        known = []
        for time_s, measured in self._recent:
            gap_s = 0.0 if before_s is None else round(time_s - before_s, CLOCK_DIGITS)
            known.append((gap_s, self._without_faulty_lines(time_s, measured)))
            before_s = time_s
        if self._estimate is not None and known:
            self._estimate.take(*zip(*known, strict=True))
        self._advice.renew()
        for tell in tuple(self.on_rest):
            tell(rest_ohm, self.last_index)

    def convert(self, frames: Sequence[RawFrame]) -> list[Converted | ProtocolError]:
        """What the next frames are converted to, up to the first whose counts do not fit the design, and why not.

        Bit for bit the same however a stream is divided among calls, but quicker for many frames at once.
        """
        found: list[Converted | ProtocolError] = []
        read: list[_Read] = []
        for frame in frames:
            due = None
            while self._rest_changes and frame.index > self._rest_changes[0].after_frame:
                due = self._rest_changes.popleft()
            if due is not None:  # of several between two frames the last one counts
                self._estimated(read, found)
                self.use_rest(None if due.rest is None else due.rest.reshape(self.shape))
            gap_s = 0.0 if self._last_s is None else round(frame.time_s - self._last_s, CLOCK_DIGITS)
            self._last, self._last_s = frame, frame.time_s if self._last_s is None else self._last_s + gap_s
            try:
                as_read = self._read_present(frame)
            except ProtocolError as error:
                self._estimated(read, found)
                return [*found, error]
            if gap_s > KEEP_STATE_S:
                self._estimated(read, found)
                self._estimate = self._new_estimate()
                self._recent.clear()
            self._recent.append((frame.time_s, as_read))
            measured = self._without_faulty_lines(frame.time_s, as_read)
            if self._rest is not None and self._estimate is not None and not self._rest.known:
                spread = self._rest.spread
                self._rest.take(measured)
                if self._rest.spread != spread:
                    self._estimated(read, found)
                    self._estimate.doubt_rest()
            if self._advice.frames is not None:
                self._advice.take(as_read)
            read.append((frame, gap_s, measured))
        self._estimated(read, found)
        return found

    def _estimated(self, read: list[_Read], found: list[Converted | ProtocolError]) -> None:
        """Estimate the pressures of all that was ``read``, which is empty then, and append to ``found``."""
        if not read:
            return
        if self._estimate is None:
            pressures, stds = np.full((2, len(read), *self.shape), np.nan)
        else:
            _, gaps_s, measurements = zip(*read, strict=True)
            pressures, stds = self._estimate.take(gaps_s, measurements)
        pressures.setflags(write=False)
        stds.setflags(write=False)
        rest_counts = self.rest if self.design is None and self.rest is not None else self._no_rest
        for (frame, _, measured), pressure, std in zip(read, pressures, stds, strict=True):
            reason, (valid, resistance, unread, beyond_model) = measured.reason, measured.shown(pressure)
            if beyond_model and self._estimate is not None:
                beyond = valid & np.isnan(pressure)
                valid, reason = valid & ~beyond, np.where(beyond, np.int8(_BEYOND_MODEL), reason)
                for array in (valid, reason):
                    array.setflags(write=False)
            self._counters.reasons = reason
            view = PressureView(frame.time_s, pressure, std, unread)
            contacts = self.contacts.pass_by(view)
            found.append(
                Converted(valid, reason, resistance, pressure, std, rest_counts, self.geometry, contacts, self.starts)
            )
        read.clear()

    def _read_present(self, frame: RawFrame) -> Measurement:
        """The reading of a frame. A cell without a count keeps its last one, as others depend on it, and is marked."""
        before, self._present = self._present, frame.counts
        if frame.absent:
            missing = np.zeros(frame.counts.shape, dtype=np.bool_)
            missing.flat[list(frame.absent)] = True
            self._present = np.where(missing, frame.counts if before is None else before, frame.counts)
            measured = self._read(self._present).without(missing, Reason.MISSING)
        else:
            measured = self._read(frame.counts)
        if measured.reason.flat[0] == _UNSOLVED:
            self._counters.unsolved += 1
        if self._holes is not None:
            measured = measured.without(self._holes, Reason.NO_CELL)
            measured.reason[self._holes] = Reason.NO_CELL
        return measured

    def _without_faulty_lines(self, time_s: float, measured: Measurement) -> Measurement:
        """The measurement, with the cells of faulty lines marked as not valid (:mod:`._line_faults`)."""
        if self._line_faults is None or self._rest is None:
            return measured
        cells = self._line_faults.take(time_s, measured, self._rest.measured_spread)
        self._counters.faulty = None if cells is None else self._line_faults.remark
        return measured if cells is None else measured.without(cells, Reason.DISTURBED)

    @property
    def estimator_name(self) -> str:
        """Name of the estimator in use; empty where there is none."""
        return "" if self.cell is None else self._estimator_name or self.cell.default_estimator

    def _fresh_estimate(self) -> Estimate | None:
        if self.cell is None or self._rest is None:
            return None
        beside = self.geometry.neighbours.beside
        return Estimate(self.cell, self.shape, self._estimator_name, self._rest, self._calibration, beside)

    def _new_estimate(self) -> Estimate | None:
        """Start the estimator and the model of line faults, for the rest resistances in use."""
        self.starts += 1
        made = self._fresh_estimate()
        # Where loads lower the resistance, bridged lines look like a load.
        if made is not None and self._rest is not None and self.cell is not None and made.estimator.side > 0.0:
            if self._creep is None:
                self._creep = Creep(self.cell)
            self._line_faults = LineFaults(made.estimator.rest_ohm, self._creep, rest_known=self._rest.known)
        return made
