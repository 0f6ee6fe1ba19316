"""Measurement chain: counts to ohms (inverse circuit model) to kPa (causal estimator), each frame once, in order."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..cell import Cell, Estimator
from ..circuits import Design, Reason, ValidityRule
from ..common.arrays import FloatArray
from ..common.measurement import CONDUCTANCE, Measurement
from ..errors import InputError
from ..wire import Layout
from ._calibration import Calibration
from ._column_steps import ColumnSteps
from ._contacts import ContactsOfFrames, ContactTracker, PressureView
from ._converted import Converted
from ._lazy import Lazy
from ._line_faults import Creep, LineFaults
from ._pitch import Pitch
from ._plain import PlainReader
from ._reading import CountReader
from ._statistics import Counters
from ._stream import RawFrame
from ._systematic import SystematicError
from ._tare import DRIFT as TARE_DRIFT
from ._tare import KNOWN_DRIFT, RestChange, far_from_sheet

KNOWN_FRAMES = 20
"""frames before new rest resistances that the estimator sees again with them: as many as a usual tare has. They tell it
that the skin is at rest, or what lies on it"""
KEEP_STATE_S = 60.0
"""after a longer gap the estimator restarts: the loads during the gap are unknown"""

CLOCK_DIGITS = 6
"""decimals of the seconds between frames: boards count microseconds. The estimator caches its work per length of step:
that work takes a small skin as long as ten frames; sums of seconds would differ in their last digits"""

SOON = 50
"""number of first frames on which the driver judges board and skin"""
UNSETTLED_FRAMES = 10
"""first of these frames that are left out, since the noise is hardly known in them"""
FEW = 0.02
"""fraction of valid cells in those frames below which the driver reports the reason"""
CLEAR_SPREAD = 0.01
"""fraction of full scale: pressure error by unknown rest resistances from which on the driver reports them"""
_NO_CURRENT, _UNSOLVED = int(Reason.NO_CURRENT), int(Reason.UNSOLVED)
_NO_CELL = (
    "the data of the cells are not known, so there are no pressures (NaN): the board does not send them; give them, "
    'Skin.open(..., cell="cell.toml"), as `ohmskin fit` writes them'
)
_WHY_NONE = {
    Reason.NO_CURRENT: "their readings show no current; the drive's voltage, the converter's range and the reference "
    "resistor of the design may not fit each other, or the skin is not connected",
    Reason.SATURATED: "their readings stand at a limit of the converter or the output; a smaller reference resistor, "
    "or a smaller drive voltage, lowers them",
    Reason.DISTURBED: "other cells, which stand at a limit or behind a fault, may shift their readings by more than "
    "was asked for; look for shorted cells, or take a circuit that reads each cell alone",
    Reason.UNSOLVED: "no cells give such readings; the design is not that of this board",
}


class Converter:
    """Turns frames into measurements: each frame once, in the order of arrival, as :class:`._frames.Frames` asks."""

    def __init__(
        self,
        design: Design | Layout,
        cell: Cell | None,
        estimator: str | None,
        pitch: Pitch,
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
        self.pitch = pitch
        self._estimator_name = estimator
        self._calibration = calibration
        self._counters = counters
        self._accuracy = accuracy
        self._read = self._new_reader()
        self._present: NDArray[np.uint16] | None = None
        """last counts that the board has sent of each cell"""
        self._judged: int | None = 0  # first frames counted so far; None: judgement done
        self._reasons = np.zeros(len(Reason), dtype=np.int64)  # cells of those frames by reason
        self._surest = np.inf  # least uncertainty of their cells
        self._sheet: str | None = None
        """why the data sheet seems to be another skin's, judged by the first frames"""
        self._systematic = None if cell is None else SystematicError(cell)
        self._rest_ohm: FloatArray | None = None  # counts where the circuit is not known
        self._no_rest = np.zeros(self.shape)
        self._no_rest.setflags(write=False)
        for ohm in (change.rest for change in rest_changes):
            if ohm is not None and ohm.size != math.prod(self.shape):
                raise InputError("a tare of {} cells; this skin has {} x {}".format(ohm.size, *self.shape))
        self._rest_changes = deque(rest_changes)
        self.on_rest: list[Callable[[FloatArray | None, int], None]] = []
        """called with new rest resistances and the number of the last frame before them: for recorders"""
        self._starts = 0
        self._creep: Creep | None = None
        self._line_faults: LineFaults | None = None
        self._column_steps: ColumnSteps | None = None
        self._estimator = self._new_estimator()
        full_scale_kpa = np.inf if cell is None else cell.full_scale_kpa
        drift_kpa = 0.0 if self._systematic is None else self._systematic.kpa_of_rest(KNOWN_DRIFT)
        faults_press = self._estimator is None or self._estimator.side > 0
        tracker = ContactTracker(self.shape, pitch, full_scale_kpa, drift_kpa=drift_kpa, faults_press=faults_press)
        self.contacts = ContactsOfFrames(tracker)
        self._counters.untared = self._why_to_tare()
        self._last: RawFrame | None = None
        self._last_s: float | None = None
        """of the last frame, on the estimator's time scale"""
        self._recent: deque[tuple[float, Measurement]] = deque(maxlen=KNOWN_FRAMES)
        """times and readings of the last frames"""
        self.notices = counters.notices

    @property
    def last_index(self) -> int:
        """Number of the newest converted frame; 0 before the first."""
        return 0 if self._last is None else self._last.index

    @property
    def rest(self) -> FloatArray | None:
        """(rows, columns) rest resistances in use, or counts; None: those of the data sheet or the calibration."""
        return self._rest_ohm

    @property
    def starts(self) -> int:
        """Number of times that the estimator has started without memory."""
        return self._starts

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
        measured = self._read(counts)
        if self.cell is not None:
            self._fresh_estimator().step_readings(1.0, measured)
        self._read = self._new_reader()

    def _new_reader(self) -> CountReader | PlainReader:
        return PlainReader(self.shape) if self.design is None else CountReader(self.design, accuracy=self._accuracy)

    def use_rest(self, rest_ohm: FloatArray | None) -> None:
        """Use these rest resistances (rows, columns) from now on (None: those without a tare).

        The estimator begins anew with the last :data:`KNOWN_FRAMES` frames.
        """
        self._rest_ohm = rest_ohm
        self._estimator = self._new_estimator()
        before_s: float | None = None
        for time_s, measured in self._recent:
            gap_s = 0.0 if before_s is None else round(time_s - before_s, CLOCK_DIGITS)
            self._estimate(gap_s, self._without_faulty_lines(time_s, measured))
            before_s = time_s
        if self._judged is None:
            self._counters.untared = self._why_to_tare()
        for tell in tuple(self.on_rest):
            tell(rest_ohm, self.last_index)

    def convert(self, frame: RawFrame) -> Converted:
        """The measurement of the next frame. Raises ProtocolError if its counts do not fit the design."""
        due = None
        while self._rest_changes and frame.index > self._rest_changes[0].after_frame:
            due = self._rest_changes.popleft()
        if due is not None:  # of several between two frames the last one counts
            self.use_rest(None if due.rest is None else due.rest.reshape(self.shape))
        gap_s = 0.0 if self._last_s is None else round(frame.time_s - self._last_s, CLOCK_DIGITS)
        self._last, self._last_s = frame, frame.time_s if self._last_s is None else self._last_s + gap_s
        measured = self._read_present(frame)
        counters = self._counters
        if measured.reason.flat[0] == _UNSOLVED:
            counters.unsolved += 1
        if self._judged is not None:
            self._judge(measured)
        if gap_s > KEEP_STATE_S:
            self._estimator = self._new_estimator()
            self._recent.clear()
        self._recent.append((frame.time_s, measured))
        measured = self._without_faulty_lines(frame.time_s, measured)
        reason = counters.reasons = measured.reason
        valid, resistance = reason == 0, measured.resistance
        for array in (valid, reason, resistance):
            array.setflags(write=False)  # half of the time that array.flags takes
        pressure, std = self._estimate(gap_s, measured)
        pressure.setflags(write=False)
        unread = (reason != int(Reason.VALID)) & (reason != int(Reason.UNCERTAIN))
        view = PressureView(frame.index, frame.time_s, pressure, std, unread)
        self.contacts.pass_by(view)
        return Converted(
            valid,
            reason,
            resistance,
            pressure,
            std,
            view,
            self._rest_ohm if self.design is None and self._rest_ohm is not None else self._no_rest,
            self._starts,
        )

    def _read_present(self, frame: RawFrame) -> Measurement:
        """The reading of a frame. A cell without a count keeps its last one, as others depend on it, and is marked."""
        before, self._present = self._present, frame.counts
        if not frame.absent:
            return self._read(frame.counts)
        missing = np.zeros(frame.counts.shape, dtype=np.bool_)
        missing.flat[list(frame.absent)] = True
        self._present = np.where(missing, frame.counts if before is None else before, frame.counts)
        return self._read(self._present).without(missing, Reason.MISSING)

    def _estimate(self, gap_s: float, measured: Measurement) -> tuple[FloatArray, Lazy]:
        """Pressures (rows, columns) in kPa and their standard deviations."""
        estimator, calibration = self._estimator, self._calibration
        if estimator is None or self._systematic is None:
            unknown = np.full(measured.reason.shape, np.nan)
            return unknown, Lazy(unknown.copy)
        if not estimator.resolved and isinstance(self._read, CountReader):
            estimator.resolve(*self._read.resolution)
        assert self._column_steps is not None, "it is made with the estimator"
        conductance, taken_out = self._column_steps.without(measured)
        if self.cell is not None and self.cell.open_at_rest:
            conductance = np.where(measured.reason == _NO_CURRENT, 0.0, conductance)
        seen = measured
        if conductance.base is not measured.block:
            seen = Measurement(measured.block.copy(), measured.reason)
            seen.block[CONDUCTANCE] = conductance
        common = estimator.step_readings(gap_s, seen)
        systematic = self._systematic.take(measured, taken_out, rest_known=self._rest_known)
        std = Lazy(partial(_std, estimator.variance_of_last_step(), systematic, common, calibration))
        return common if calibration is None else calibration.applied(common), std

    def _without_faulty_lines(self, time_s: float, measured: Measurement) -> Measurement:
        """The measurement, with the cells of faulty lines marked as not valid (:mod:`._line_faults`)."""
        if self._line_faults is None or self._systematic is None:
            return measured
        cells = self._line_faults.take(time_s, measured, self._systematic.rest_spread)
        self._counters.faulty = None if cells is None else self._line_faults.remark
        return measured if cells is None else measured.without(cells, Reason.DISTURBED)

    @property
    def _rest_known(self) -> bool:
        return self._rest_ohm is not None or self._calibration is not None

    def _judge(self, measured: Measurement) -> None:
        """After the first frames, report once why cells are not valid, or that rest resistances are not known."""
        assert self._judged is not None
        self._judged += 1
        if self._judged <= UNSETTLED_FRAMES:
            return
        told = np.bincount(measured.reason.ravel(), minlength=len(Reason))
        if self.cell is not None and self.cell.open_at_rest:  # a cell without current bears no load: no fault
            told[Reason.VALID] += told[Reason.NO_CURRENT]
            told[Reason.NO_CURRENT] = 0
        self._reasons += told
        uncertain = measured.reason == int(Reason.UNCERTAIN)
        self._surest = min(self._surest, float(measured.uncertainty.min(initial=np.inf, where=uncertain)))
        if self._judged < SOON:
            return
        self._judged = None
        if self._reasons[Reason.VALID] <= FEW * self._reasons.sum():
            self._counters.remark = self._why_none_valid()
            if self._counters.remark:
                self.notices.append(self._counters.remark)
        else:
            self._sheet = self._unlike_sheet(measured)
            self._counters.untared = self._why_to_tare()
            if self._counters.untared and self._sheet:
                self.notices.append(self._counters.untared)

    def _why_none_valid(self) -> str | None:
        cells, valid = self._reasons.sum(), self._reasons[Reason.VALID]
        found, others = "no cell was", "the best one"
        if valid:
            found, others = f"{100 * valid / cells:.1g} % of the cells were", "the best of the others"
        start = f"{found} valid in the first {SOON} frames: "
        reasons = self._reasons.copy()
        reasons[Reason.VALID] = 0
        why = Reason(int(reasons.argmax()))
        if why in _WHY_NONE:
            return start + _WHY_NONE[why]
        best = self._surest
        if best >= 1.0:
            return None
        asked = f"{100 * ValidityRule.of(self._accuracy).limit:g} %"
        return (
            f"{start}{others} is known to {100 * best:.2g} %, and {asked} was asked for; "
            f"Skin.open(..., accuracy={min(1.5 * best, 0.99):.2g}) takes cells known so well; a converter of more "
            "bits, or another reference resistor, tells more"
        )

    def _unlike_sheet(self, measured: Measurement) -> str | None:
        """A remark if the resistance of the typical cell is far from the data sheet's value at rest."""
        if not measured.valid.any():
            return None
        far = far_from_sheet(float(np.median(measured.resistance[measured.valid])), self.cell)
        if not far:
            return None
        return (
            f"{far}: the cell or the design is another skin's or in another unit, or the whole skin is loaded; "
            "correct them, or tare() the unloaded skin"
        )

    def _why_to_tare(self) -> str | None:
        """A remark if rest resistances that nobody measured leave a notable error of the pressures."""
        if self.cell is None:
            return _NO_CELL if self.design is not None else None
        if self._systematic is None or self._rest_known:
            return None
        if self._sheet:
            return self._sheet
        spread = self._systematic.rest_spread or 0.0
        kpa = self._systematic.kpa_of_rest(spread)
        if kpa < CLEAR_SPREAD * self.cell.full_scale_kpa:
            return None
        return (
            f"without a tare pressures are known to {kpa:.2g} kPa at best: the cells differ from the rest resistance "
            f"of the data sheet by {100 * spread:.2g} %, or the skin was loaded; tare() the unloaded skin"
        )

    def _new_estimator(self) -> Estimator | None:
        self._starts += 1
        if self.cell is None:
            return None
        estimator = self._fresh_estimator()
        self._begin_beside(estimator)
        return estimator

    def _fresh_estimator(self) -> Estimator:
        assert self.cell is not None
        rest_ohm, rest_error = self._rest_ohm, None
        if rest_ohm is not None and self.cell.estimators is not None:
            rest_error = TARE_DRIFT
        if rest_ohm is None and self._calibration is not None:
            rest_ohm = self._calibration.rest_ohm
        return self.cell.estimator(
            self.shape, self._estimator_name, rest_resistance_ohm=rest_ohm, rest_error=rest_error
        )

    def _begin_beside(self, estimator: Estimator) -> None:
        """Start the models of column steps and of line faults with the ``estimator``, for the same rest resistances."""
        assert self.cell is not None
        side = estimator.side
        self._column_steps = ColumnSteps(estimator.rest_ohm, side, rest_known=self._rest_known)
        if side < 0.0:
            return  # where loads lower the resistance, bridged lines look like a load
        if self._creep is None:
            self._creep = Creep(self.cell)
        self._line_faults = LineFaults(estimator.rest_ohm, self._creep, rest_known=self._rest_known)


def _std(
    of_estimate: Callable[[], FloatArray],
    systematic: Callable[[FloatArray, FloatArray], FloatArray],
    pressure_kpa: FloatArray,
    calibration: Calibration | None,
) -> FloatArray:
    """The estimator's standard deviation, with errors it cannot see: unknown rest resistances and ADC steps."""
    std = systematic(pressure_kpa, of_estimate())
    return std if calibration is None else calibration.applied_std(pressure_kpa, std)
