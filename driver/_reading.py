"""Counts to ohms, by inversion of the board's circuit model, with the uncertainty of each cell."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..circuits import Design, Errors, LiveReading, Reason, adc_error, live_recovery, noise, volts_of_codes
from ..common.arrays import BoolArray, FloatArray
from ..common.compiled import Rows, loop
from ..common.readings import Readings
from ..errors import InputError, ProtocolError, SolverError
from ._scatter import Scatter

_FIRST_GUARD = 12  # codes, guard band at a limit of the swing in the first frame, whose noise is unknown
_FINE_GUARD = 2.0**-14  # of the range, likewise in two frames: the noise of converters of 18 to 24 bits is many codes
_MEASURED = 3  # number of the first frame in which noise of any size may be known
_GUARD = 6.0  # standard deviations of the noise, guard band: within it an output may stand at a limit of its swing
_JUMP = 1.0 / 16.0  # of the converter's codes, from one frame to the next: a larger change of a reading is a jump
_ALIKE = 1.5  # ratio of noises up to which the judgement of a reading stays about the same
_FAINT = 0.05  # ADC steps of noise that are negligible beside the half step
_MOST_NOISE = 0.95  # relative uncertainty, three standard deviations of noise, of a reading that an average can use
_MOST_STEPS = 0.1  # relative uncertainty by ADC steps, likewise; averaging does not reduce it
_LEAST_STEPS = 0.05  # share of the uncertainty by steps that noise does not randomise; less is neglected
_STEP_STD = 1.0 / math.sqrt(12.0)  # ADC steps, standard deviation of an error that is uniform over one step


@dataclass(slots=True, eq=False)  # frozen ones take 2 us more to make; nobody changes one
class Reading:
    """The cells' resistances in one frame of counts. Arrays are (rows, columns)."""

    resistance: FloatArray
    """of the cells, in ohm; NaN where not valid"""
    valid: BoolArray
    """where ``resistance`` is a measurement"""
    reason: NDArray[np.int8]
    """why a cell is not valid: a :class:`ohmskin.circuits.Reason` each, 0 for valid cells"""
    solved: bool
    """False if no cell resistances give such readings: then no cell is valid"""
    all_valid: bool
    _found: LiveReading | None
    _step: float = 1.0
    """V, of the converter"""
    _noise_steps: float = 0.0
    """standard deviation of the readings' noise in ADC steps"""
    _most_noise: float = 0.0
    """relative uncertainty up to which a noisy reading serves for estimation, valid or not; 0: none does"""
    _scales_columns: bool = False
    """whether errors of other readings scale all conductances of a column by one factor"""

    def without(self, cells: BoolArray, reason: Reason = Reason.DISTURBED) -> Reading:
        """The same reading with ``cells`` (rows, columns) marked as not valid; the usual reason is a fault."""
        return replace(
            self,
            resistance=np.where(cells, np.nan, self.resistance),
            valid=self.valid & ~cells,
            reason=np.where(cells & self.valid, np.int8(reason), self.reason),
            all_valid=False,
        )

    @property
    def _systematic(self) -> float:
        """Fraction of the quantisation error that noise does not randomise, so that averaging does not reduce it.

        Noise of half a step or more does (dither): the mean error falls with exp(-2 (pi noise/step)^2) (Widrow and
        Kollar, Quantization Noise, 2008).
        """
        return math.exp(-2.0 * (math.pi * self._noise_steps) ** 2)

    @property
    def _noise(self) -> float:
        """V, standard deviation of a reading by its noise and by the quantisation errors that are random."""
        return self._step * math.hypot(self._noise_steps, math.sqrt(1.0 - self._systematic) * _STEP_STD)

    @property
    def steps_std(self) -> FloatArray:
        """Relative standard deviation of a conductance by quantisation errors that averaging does not reduce."""
        own, _, every, alike = self._errors
        others = alike * np.sqrt(np.maximum(every**2 - own**2, 0.0))
        return self._systematic * _STEP_STD * self._step * np.hypot(own, others)

    @property
    def noise_std(self) -> FloatArray:
        """Relative standard deviation of a conductance by noise, and by the quantisation errors that are random."""
        return self._noise * self._errors.all

    @property
    def others_noise_std(self) -> FloatArray:
        """By how much the noise of the other cells' readings enlarges :attr:`noise_std`.

        An estimator measures the noise that a cell has at rest. In a column of a divider under a hard press, the share
        of the current in each cell follows from all readings together, and their noise then counts many times as much.
        """
        return self._noise * (self._errors.all - self._errors.own)

    @property
    def _errors(self) -> Errors:
        """Relative changes of the conductances by errors of the readings; 0 where nothing is known."""
        none = np.zeros(self.resistance.shape)
        if self._found is None:
            return Errors(none, none, none)
        own, column, every, alike = self._found.errors
        if np.isfinite(every).all():
            return self._found.errors
        own, column, every = (np.where(np.isfinite(every), part, 0.0) for part in (own, column, every))
        return Errors(own, column, every, alike)

    @property
    def for_estimation(self) -> FloatArray:
        """Ohm, NaN where unknown; includes cells that only noise makes invalid, since an estimator averages noise."""
        if self.all_valid or self._found is None or not self._most_noise:
            return self.resistance
        uncertainty = self._found.uncertainty
        noisy = (self.reason == Reason.UNCERTAIN) & (uncertainty <= self._most_noise)
        noisy &= math.sqrt(3.0) * self.steps_std <= _MOST_STEPS
        return np.where(noisy, self._found.resistance, self.resistance)

    @property
    def bounded(self) -> bool:
        """Whether bounds are known on cells that have no value."""
        return self._found is not None and self._found.bounds is not None

    @property
    def readings(self) -> Readings:
        """Conductances with what is known of their errors. Computed on demand."""
        shape = self.resistance.shape
        none, unbounded = np.zeros(shape), np.full(shape, np.inf)
        if self._found is None:
            return Readings(np.full(shape, np.nan), none, none, none, none, unbounded)
        with np.errstate(divide="ignore"):
            conductance = 1.0 / self.for_estimation
        known = np.isfinite(conductance)
        size = np.where(known, conductance, 0.0)
        _, column, every, _ = self._errors
        column = size * column if self._scales_columns else none
        least, greatest = (none, unbounded) if self._found.bounds is None else self._found.bounds
        return Readings(
            conductance=np.where(known, conductance, np.nan),
            noise_variance=np.maximum((size * every) ** 2 - column**2, 0.0) * self._noise**2,
            column_std=column * self._noise,
            half_step=math.sqrt(3.0) * size * self.steps_std,
            least=np.where(known, 0.0, least),
            greatest=np.where(known, np.inf, greatest),
        )

    @property
    def step_std(self) -> FloatArray:
        """Relative standard deviation of a cell's conductance by the ADC steps of its own reading alone."""
        return _STEP_STD * self._step * self._errors.own

    @property
    def all_steps_std(self) -> FloatArray:
        """As :attr:`step_std`, but by the steps of all readings that enter the conductance.

        In a column of a divider a step of one reading changes the conductances of all its cells.
        """
        return _STEP_STD * self._step * self._errors.all

    @property
    def column_steps(self) -> FloatArray | None:
        """(columns,) relative error of all conductances of a column if all other readings err by half a step at once.

        None if errors of other readings do not scale columns, or if noise randomises the rounding.
        """
        if not self._scales_columns or self._found is None or self._systematic < _LEAST_STEPS:
            return None
        # The other readings enter by their sum: all at once they make the root of their number of independent errors.
        rows = len(self.resistance)
        least: FloatArray = np.minimum.reduce(np.abs(self._errors.column), axis=0) * (rows - 1) / math.sqrt(rows)
        return 0.5 * self._step * self._systematic * least

    @property
    def resolution(self) -> tuple[FloatArray, FloatArray, FloatArray, bool]:
        """Arguments of :meth:`ohmskin.cell.Estimator.resolve`, in its order; computed on demand."""
        return self.step_std, self.resistance, self.all_steps_std, self._scales_columns

    @property
    def uncertainty(self) -> FloatArray:
        """Relative uncertainty of a cell's conductance; inf where nothing is known. Computed on demand.

        The uncertainty covers half an ADC step and three standard deviations of the noise of every reading, and the
        influence of cells whose conductance is unknown.
        """
        if self._found is None:
            return np.full(self.resistance.shape, np.inf)
        return self._found.uncertainty


class CountReader:
    """Converts the counts of one board, frame by frame, to the resistances of its cells.

    The whole circuit model is inverted (:func:`ohmskin.circuits.live_recovery`). This corrects the readings for leads,
    switches, lines, finite gain, offset and bias current, to a fraction of an ADC step and at a bounded cost per frame.
    """

    def __init__(self, design: Design, *, accuracy: float | None = None) -> None:
        """Prepare the recovery.

        Args:
            design: the board.
            accuracy: relative uncertainty of a conductance up to which a cell is valid; None: 0.5
                (:class:`ohmskin.circuits.ValidityRule`).

        Raises:
            ProtocolError: the design has no ADC.
            InputError: the accuracy is not between 0 and 1.

        """
        adc = design.adc
        if adc is None:
            raise ProtocolError("the board's design has no [adc]; counts mean nothing without one")
        self._design, self._accuracy = design, accuracy
        self._shape = design.array.shape
        self._codes = 2**adc.bits
        self._most_noise = _MOST_NOISE if accuracy is None else 0.0
        self._recover = live_recovery(design, accuracy=accuracy)
        self._step, self._lowest_volts = adc.step, float(volts_of_codes(design, np.zeros(1, dtype=np.int64))[0])
        # As arrays: NumPy converts a float to an array in every call, which takes as long as a small operation.
        low, high = design.readout.supply
        beyond_half_step = adc_error(design) - adc.step / 2  # V, by which a limited output may read inside it
        self._first, self._last = self._codes_within(low + beyond_half_step, high - beyond_half_step)
        self._rising = (design.drive.voltage > 0) != design.board.circuit.inverts  # whether current raises the outputs
        self._level = design.readout.reference_voltage
        self._design_noise = _noise_of(design)  # V
        self._scatter = Scatter(adc.step, assumed=not self._design_noise)
        self._guard, self._usual_codes = 0, self._usual_within(0)  # of the last frame, and the codes within its limits
        self._silent = 0  # cells whose readings stood at a limit in the last frame, and could not change
        self._limited: BoolArray | None = None  # cells that counted as limited in the last frame
        self._in_doubt = False  # some of them may have left the limit; one more frame decides
        self._counts = b""
        self._reading: Reading | None = None
        self._judged_with = 0.0  # V, noise in the uncertainties of the last reading

    def _codes_within(self, low: float, high: float) -> tuple[float, float]:
        """The first code for outputs within a swing in V, and the first code beyond; they may lie outside the ADC.

        The middle of a code may be half a step away from the voltage. A limit on an edge belongs to both codes.
        """
        half = 0.5 + 1e-9
        first, beyond = (low - self._lowest_volts) / self._step, (high - self._lowest_volts) / self._step
        return np.floor(first + half) + 1.0, np.ceil(beyond - half)

    @property
    def noise_volts(self) -> float:
        """Standard deviation of the readings in V: the larger one of the design's noise and the measured noise."""
        return max(self._design_noise, self._scatter.std)

    @property
    def _alike_noise(self) -> float:
        """V: a reading judged with up to this noise needs no new judgement with the present noise."""
        return max(_ALIKE * self.noise_volts, _FAINT * self._step)

    def memory(self) -> tuple[float, NDArray[np.integer] | None]:
        """State of the noise measurement: standard deviation so far in ADC steps, and the last frame's counts."""
        noise_steps, before = self._scatter.std / self._step, self._scatter.before
        if before is None:
            return noise_steps, None
        return noise_steps, np.rint((before - self._lowest_volts) / self._step).astype(np.int64)

    def remember(self, noise_steps: float, counts: NDArray[np.integer] | None) -> None:
        """Continue with the :meth:`memory` of another reader of the same design. The inversion begins anew."""
        self._scatter.resume(noise_steps * self._step, None if counts is None else self._volts(counts))

    def __reduce__(self) -> tuple[Callable[..., CountReader], tuple[object, ...]]:
        """For copy and pickle: keeps the design and the :meth:`memory`; the inversion begins anew."""
        return _resumed, (self._design, self._accuracy, *self.memory())

    def _volts(self, counts: NDArray[np.integer]) -> FloatArray:
        """The middle of each code, in V."""
        volts: FloatArray = counts.astype(np.float64, order="C") * self._step + self._lowest_volts
        return volts

    def _volts_and_extremes(self, counts: NDArray[np.integer]) -> tuple[FloatArray, float, float]:
        """The middle of each code in V, the least count and the largest one."""
        volts = counts.astype(np.float64, order="C")
        least, most = _middle_of_codes.unchecked(volts, self._step, self._lowest_volts)
        return volts, least, most

    def __call__(self, counts: NDArray[np.integer]) -> Reading:
        """The resistances behind ``counts`` (rows, columns).

        A cell is not valid in three cases: the converter is at an end of its range; the output is at a limit of its
        swing, so that the volts may lie anywhere beyond; or the cell gives no current. A cell at a limit may have any
        conductance from the one that just reaches the limit to a short. The ``uncertainty`` of the other cells covers
        this interval, half an ADC step, and the noise of all readings.

        Raises:
            ProtocolError: the counts are not of this design: another shape, or beyond its ADC.

        """
        same = counts.tobytes()
        if self._reading is not None and same == self._counts and self._judged_with <= self._alike_noise:
            self._scatter.still(self._silent)
            return self._reading
        if counts.shape != self._shape:
            sent, expected = "{} x {}".format(*counts.shape), "{} x {}".format(*self._shape)
            raise ProtocolError(f"the board sends {sent} cells; its design has {expected}")
        reading = self._read(counts)
        # Cells that are unsettled, or judged before the noise was measured, may change with another frame like this.
        settled = reading.all_valid or not (reading.reason == Reason.UNSETTLED).any()
        final = self._scatter.frames > 1 and settled and not self._in_doubt
        self._counts, self._reading = same, reading if final else None
        return reading

    def _within_limits(self, guard: int) -> tuple[float, float]:
        """The first code within the limits and the first one beyond, with a guard band of ``guard`` codes."""
        lowest = max(self._first + (0 if self._rising else guard), 1)
        return lowest, min(self._last - (guard if self._rising else 0), self._codes - 1)

    def _usual_within(self, guard: int) -> tuple[float, float]:
        """The same, with the guard at both limits: an output without a current may stand at the other one."""
        lowest, highest = self._within_limits(guard)
        return (
            (max(lowest, self._first + guard), highest) if self._rising else (lowest, min(highest, self._last - guard))
        )

    def _without_current(self, counts: NDArray[np.integer], guard: int) -> BoolArray:
        """Readings (rows, columns) of outputs that may stand at the limit away from which a current moves them.

        An offset holds the output of an open cell there, and noise moves the reading as a current would.
        """
        return counts < self._first + guard if self._rising else counts >= self._last - guard

    def _jumped_to_limit(self, least: float, most: float) -> bool:
        """Whether a reading may have jumped, and by more than its distance from a limit of the swing."""
        room = self._last - most if self._rising else least - self._first  # codes
        if room >= 0.5 * self._codes:
            return False
        return bool(self._scatter.largest_change > max(room, _JUMP * self._codes) * self._step)

    def _limited_and_faint(
        self, counts: NDArray[np.integer], volts: FloatArray, guard: int, *, jumped: bool
    ) -> tuple[BoolArray | None, BoolArray]:
        """Readings at a limit, and those among them with hardly any current.

        Args:
            counts: (rows, columns) of the frame.
            volts: (rows, columns) V, the same.
            guard: guard band in codes, by which noise may keep a reading from a limit.
            jumped: whether a reading may have jumped to a limit.

        Returns:
            (rows, columns) each; the first is None if no reading is at a limit.

        """
        limited = _outside(counts, *self._within_limits(guard))
        # A reading at a limit does not change with the noise. A reading beside the limit, in a wide guard band, does.
        at_limit = limited if guard <= _FIRST_GUARD else _outside(counts, *self._within_limits(0))
        self._silent = int(np.count_nonzero(at_limit))
        if jumped or (self._limited is not None and (self._limited > limited).any()):
            doubtful = self._beside_limit(counts) & ~limited
            self._in_doubt = bool(doubtful.any())
            limited |= doubtful
        # At the end towards less current a cell conducts no more than its reading says. It is no short, which would
        # disturb many others.
        lowest, highest = self._within_limits(guard)
        faint = limited & (np.abs(volts - self._level) < 1.5 * self._step)
        faint |= (counts < lowest) if self._rising else (counts >= highest)
        faint |= self._without_current(counts, guard)
        limited &= ~faint
        self._limited = limited if limited.any() else None
        return self._limited, faint

    def _beside_limit(self, counts: NDArray[np.integer]) -> BoolArray:
        """Readings (rows, columns) that noise may keep from the limit at which their outputs stand.

        A single change does not show whether noise has begun. Within a guard band for such a noise beside a limit, a
        reading is therefore believed only if it was there before. A reading that has just left the limit, or has jumped
        there by more than such a noise, counts as limited until the next frame.
        """
        guard = math.ceil(_GUARD * self._scatter.possible / self._step)
        came: BoolArray = np.abs(self._scatter.change) > guard * self._step
        if self._limited is not None:
            came = came | self._limited
        return came & _outside(counts, *self._within_limits(guard))

    def _read(self, counts: NDArray[np.integer]) -> Reading:
        volts, least, most = self._volts_and_extremes(counts)
        self._scatter.update(volts, self._silent)
        noise = self._judged_with = self.noise_volts
        guard = math.ceil(_GUARD * noise / self._step)  # codes
        if self._scatter.frames < _MEASURED and not self._design_noise:
            first = _FIRST_GUARD if self._scatter.frames == 1 else 0
            guard = max(guard, first, math.ceil(_FINE_GUARD * self._codes))
        if guard != self._guard:
            self._guard, self._usual_codes = guard, self._usual_within(guard)
        lowest, highest = self._usual_codes
        limited = faint = None
        self._silent, self._in_doubt, jumped = 0, False, self._jumped_to_limit(least, most)
        if jumped or most >= highest or least < lowest or self._limited is not None:
            if most >= self._codes:
                bits = self._codes.bit_length() - 1
                raise ProtocolError(f"the board sends a count of {most:.0f}; its ADC has {bits} bits")
            limited, faint = self._limited_and_faint(counts, volts, guard, jumped=jumped)
        try:
            found = self._recover(volts, limited, noise, faint=faint)
        except SolverError:
            nothing = np.full(counts.shape, np.nan)
            reason = np.full(counts.shape, Reason.UNSOLVED, dtype=np.int8)
            return Reading(nothing, counts < 0, reason, solved=False, all_valid=False, _found=None)
        valid, reason = found.valid, found.reason
        every = faint is None and found.every
        if faint is not None:
            valid = valid & ~faint
            reason = np.where(faint, np.int8(Reason.NO_CURRENT), reason)
        return Reading(
            found.resistance if every else np.where(valid, found.resistance, np.nan),
            valid,
            reason,
            True,  # solved; by position, since keywords take half as long again
            every,
            found,
            self._step,
            noise / self._step,
            self._most_noise,
            self._recover.scales_columns,
        )


def _resumed(
    design: Design, accuracy: float | None, noise_steps: float, counts: NDArray[np.integer] | None
) -> CountReader:
    """A reader that continues with the :meth:`CountReader.memory` of another one."""
    reader = CountReader(design, accuracy=accuracy)
    reader.remember(noise_steps, counts)
    return reader


@loop
def _middle_of_codes(codes: Rows, step: float, lowest: float) -> tuple[float, float]:
    """Replace codes (N, M) by the middle of each in V; returns the least and the largest code."""
    rows, columns = codes.shape
    least = most = codes[0, 0]
    for i in range(rows):
        for j in range(columns):
            code = codes[i, j]
            least, most = min(least, code), max(most, code)
            codes[i, j] = code * step + lowest
    return least, most


def _outside(counts: NDArray[np.integer], lowest: float, highest: float) -> BoolArray:
    """Counts below the first code of a range, or at or above the first code beyond."""
    outside: BoolArray = (counts < lowest) | (counts >= highest)
    return outside


def _noise_of(design: Design) -> float:
    """V, standard deviation of the readings before the converter by the noise sources that the design names; else 0.

    One sensed line represents all. Its cells have the parallel conductance at which a reading is about in the middle
    of the converter's range.
    """
    readout, array, adc = design.readout, design.array, design.adc
    if not (readout.voltage_noise or readout.current_noise or readout.temperature):
        return 0.0
    assert adc is not None

    def first(value: float | tuple[float, ...]) -> float:
        return value[0] if isinstance(value, tuple) else value

    alone = design.replace(
        array={"rows": 1, "columns": 1, "row_lead": 0.0, "column_lead": 0.0, "row_segment": 0.0, "column_segment": 0.0},
        readout={
            name: first(getattr(readout, name))
            for name in ("reference_resistance", "open_loop_gain", "offset_voltage", "bias_current")
        },
        fault=(),
    )
    cells = array.columns if design.board.turned else array.rows
    middle = max((abs(limit - readout.reference_voltage) for limit in adc.range), default=0.0) / 2
    ohms = first(readout.reference_resistance) * abs(design.drive.voltage) / middle
    try:
        return float(noise(alone, [[ohms / cells]]).before_adc.max())
    except InputError:  # the design names noise of parts that have none in this circuit, or nothing limits its band
        return 0.0
