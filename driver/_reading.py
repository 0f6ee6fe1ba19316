"""Counts to conductances, by inversion of the board's circuit model, with the errors of each cell."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..circuits import Design, Readings, Reason, adc_error, live_recovery, noise, volts_of_codes
from ..common.arrays import BoolArray, FloatArray
from ..common.compiled import Rows, loop
from ..common.measurement import Measurement
from ..common.noise import NoiseEstimate
from ..errors import InputError, ProtocolError, SolverError
from ._tuning import ALIKE_NOISE, ASSUMED, FINE_GUARD, FIRST_GUARD, GUARD_STDS, JUMP, MEASURED, NEGLIGIBLE

_UNSETTLED = int(Reason.UNSETTLED)


class CountReader:
    """Converts the counts of one board, frame by frame, to the conductances of its cells.

    The whole circuit model is inverted (:func:`ohmskin.circuits.live_recovery`). This corrects the readings for leads,
    switches, lines, finite gain, offset and bias current, to a fraction of an ADC step and at a bounded cost per frame.
    """

    def __init__(self, design: Design, *, accuracy: float | None = None, lowest_ohm: float | None = None) -> None:
        """Prepare the recovery.

        Args:
            design: the board.
            accuracy: relative uncertainty of a conductance up to which a cell is valid; None: 0.5
                (:class:`ohmskin.circuits.ValidityRule`).
            lowest_ohm: the lowest resistance in the cells' range of loads; None: that of ``[cells]`` in the design
                (:func:`ohmskin.circuits.live_recovery`).

        Raises:
            ProtocolError: the design has no ADC.
            InputError: the accuracy is not between 0 and 1.

        """
        adc = design.adc
        if adc is None:
            raise ProtocolError("the board's design has no [adc]; counts mean nothing without one")
        self._design, self._accuracy, self._lowest_ohm = design, accuracy, lowest_ohm
        self._shape = design.array.shape
        self._codes = 2**adc.bits
        self._recover = live_recovery(design, accuracy=accuracy, lowest_ohm=lowest_ohm)
        self._step, self._lowest_volts = adc.step, float(volts_of_codes(design, np.zeros(1, dtype=np.int64))[0])
        # As arrays: NumPy converts a float to an array in every call, which takes as long as a small operation.
        low, high = design.board.supply
        beyond_half_step = adc_error(design) - adc.step / 2  # V, by which a limited output may read inside it
        self._first, self._last = self._codes_within(low + beyond_half_step, high - beyond_half_step)
        self._rising = (design.board.drive > 0) != design.board.circuit.inverts  # whether current raises the outputs
        self._level = design.board.level
        self._design_noise = _noise_of(design)  # V
        assumed = 0.0 if self._design_noise else ASSUMED * adc.step
        self._noise = NoiseEstimate(math.prod(self._shape), quantum=adc.step, assumed=assumed)
        self._buffer, self._each = np.empty(self._shape), self._noise.each.reshape(self._shape)
        self._flat = self._buffer.reshape(-1)  # a view
        self._guard, self._usual_codes = 0, self._usual_within(0)  # of the last frame, and the codes within its limits
        self._silent = 0  # cells whose readings stood at a limit in the last frame, and could not change
        self._limited: BoolArray | None = None  # cells that counted as limited in the last frame
        self._in_doubt = False  # some of them may have left the limit; one more frame decides
        self._counts = b""
        self._kept: Measurement | None = None
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
        return max(self._design_noise, self._noise.std)

    @property
    def _alike_noise(self) -> float:
        """V: a reading judged with up to this noise needs no new judgement with the present noise."""
        return max(ALIKE_NOISE * self.noise_volts, NEGLIGIBLE * self._step)

    def memory(self) -> tuple[float, NDArray[np.integer] | None]:
        """State of the noise measurement: standard deviation so far in ADC steps, and the last frame's counts."""
        noise_steps, before = self._noise.std / self._step, self._noise.last
        if before is None:
            return noise_steps, None
        return noise_steps, np.rint((before - self._lowest_volts) / self._step).astype(np.int64).reshape(self._shape)

    def remember(self, noise_steps: float, counts: NDArray[np.integer] | None) -> None:
        """Continue with the :meth:`memory` of another reader of the same design. The inversion begins anew."""
        self._noise.resume(noise_steps * self._step, None if counts is None else self._volts(counts).ravel())

    def __reduce__(self) -> tuple[Callable[..., CountReader], tuple[object, ...]]:
        """For copy and pickle: keeps the design and the :meth:`memory`; the inversion begins anew."""
        return _resumed, (self._design, self._accuracy, self._lowest_ohm, *self.memory())

    def _volts(self, counts: NDArray[np.integer]) -> FloatArray:
        """The middle of each code, in V."""
        volts: FloatArray = counts.astype(np.float64, order="C") * self._step + self._lowest_volts
        return volts

    def __call__(self, counts: NDArray[np.integer]) -> Measurement:
        """The conductances behind ``counts`` (rows, columns).

        A cell is not valid in three cases: the converter is at an end of its range; the output is at a limit of its
        swing, so that the volts may lie anywhere beyond; or the cell gives no current. A cell at a limit may have any
        conductance from the one that just reaches the limit to a short. The ``uncertainty`` of the other cells covers
        this interval, half an ADC step, and the noise of all readings.

        Raises:
            ProtocolError: the counts are not of this design: another shape, or beyond its ADC.

        """
        if counts.shape != self._shape:
            sent, expected = "{} x {}".format(*counts.shape), "{} x {}".format(*self._shape)
            raise ProtocolError(f"the board sends {sent} cells; its design has {expected}")
        volts = self._buffer
        volts[...] = counts
        least, most = _middle_of_codes.unchecked(volts, self._step, self._lowest_volts)
        noise = self._noise.update(self._flat, self._silent)
        noise = noise if noise > self._design_noise else self._design_noise
        guard = math.ceil(GUARD_STDS * noise / self._step)  # codes
        if self._noise.frames < MEASURED and not self._design_noise:
            first = FIRST_GUARD if self._noise.frames == 1 else 0
            guard = max(guard, first, math.ceil(FINE_GUARD * self._codes))
        if guard != self._guard:
            self._guard, self._usual_codes = guard, self._usual_within(guard)
        lowest, highest = self._usual_codes
        room = self._last - most if self._rising else least - self._first  # codes, to a limit of the swing
        # Whether a reading may have jumped, and by more than this.
        jumped = room < 0.5 * self._codes and self._noise.largest_change > max(room, JUMP * self._codes) * self._step
        self._silent, self._in_doubt = 0, False
        if jumped or most >= highest or least < lowest or self._limited is not None:
            return self._read_limited(counts, most, noise, jumped=jumped)
        return self._measurement(counts, noise, None, None)

    def _read_limited(self, counts: NDArray[np.integer], most: float, noise: float, *, jumped: bool) -> Measurement:
        """The conductances of a frame with readings that are or may be at a limit; ``most`` is its largest count."""
        if most >= self._codes:
            bits = self._codes.bit_length() - 1
            raise ProtocolError(f"the board sends a count of {most:.0f}; its ADC has {bits} bits")
        limited, under_range = self._limited_and_under_range(counts, self._buffer, self._guard, jumped=jumped)
        return self._measurement(counts, noise, limited, under_range if under_range.any() else None)

    def _measurement(
        self, counts: NDArray[np.integer], noise: float, limited: BoolArray | None, under_range: BoolArray | None
    ) -> Measurement:
        """The conductances of a frame, by the short way if it serves."""
        frame = Readings(self._buffer, noise, *self._noise_of_each, limited, under_range)
        usual = self._recover.usual if self._noise.frames > 1 else None
        found = None if usual is None else usual(frame)
        return self._recovered(counts, frame) if found is None else found

    def _recovered(self, counts: NDArray[np.integer], frame: Readings) -> Measurement:
        """The conductances of any frame, by the whole circuit.

        The last result holds while the same counts come, until the noise is another.
        """
        same = counts.tobytes()
        if self._kept is not None and same == self._counts and self._judged_with <= self._alike_noise:
            return self._kept
        self._judged_with = frame.noise
        try:
            found = self._recover(frame)
        except SolverError:
            return Measurement.unknown(counts.shape, Reason.UNSOLVED)
        # Cells that are unsettled, or judged before the noise was measured, may change with another frame like this;
        # so may all cells where none is known.
        settled = not (found.reason == _UNSETTLED).any() and not np.isnan(found.conductance).all()
        final = self._noise.frames > 1 and settled and not self._in_doubt
        self._counts, self._kept = same, found if final else None
        return found

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

    def _limited_and_under_range(
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
        at_limit = limited if guard <= FIRST_GUARD else _outside(counts, *self._within_limits(0))
        self._silent = int(np.count_nonzero(at_limit))
        if jumped or (self._limited is not None and (self._limited > limited).any()):
            doubtful = self._beside_limit(counts) & ~limited
            self._in_doubt = bool(doubtful.any())
            limited |= doubtful
        # At the end towards less current a cell conducts no more than its reading says. It is no short, which would
        # disturb many others.
        lowest, highest = self._within_limits(guard)
        under_range = limited & (np.abs(volts - self._level) < 1.5 * self._step)
        under_range |= (counts < lowest) if self._rising else (counts >= highest)
        under_range |= self._without_current(counts, guard)
        limited &= ~under_range
        self._limited = limited if limited.any() else None
        return self._limited, under_range

    def _beside_limit(self, counts: NDArray[np.integer]) -> BoolArray:
        """Readings (rows, columns) that noise may keep from the limit at which their outputs stand.

        A single change does not show whether noise has begun. Within a guard band for such a noise beside a limit, a
        reading is therefore believed only if it was there before. A reading that has just left the limit, or has jumped
        there by more than such a noise, counts as limited until the next frame.
        """
        guard = math.ceil(GUARD_STDS * self._noise.if_all_noise / self._step)
        came: BoolArray = np.abs(self._noise.change.reshape(counts.shape)) > guard * self._step
        if self._limited is not None:
            came = came | self._limited
        return came & _outside(counts, *self._within_limits(guard))

    @property
    def _noise_of_each(self) -> tuple[float, FloatArray]:
        """V, standard deviation of the usual reading, best guess, and of each one (rows, columns)."""
        if not self._design_noise:
            return self._noise.usual, self._each
        return max(self._noise.usual, self._design_noise), np.maximum(self._each, self._design_noise)


def _resumed(
    design: Design,
    accuracy: float | None,
    lowest_ohm: float | None,
    noise_steps: float,
    counts: NDArray[np.integer] | None,
) -> CountReader:
    """A reader that continues with the :meth:`CountReader.memory` of another one."""
    reader = CountReader(design, accuracy=accuracy, lowest_ohm=lowest_ohm)
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
    cells = array.columns if design.board.transposed else array.rows
    middle = max((abs(limit - readout.reference_voltage) for limit in adc.range), default=0.0) / 2
    ohms = first(readout.reference_resistance) * abs(design.drive.voltage) / middle
    try:
        return float(noise(alone, [[ohms / cells]]).before_adc.max())
    except InputError:  # the design names noise of parts that have none in this circuit, or nothing limits its band
        return 0.0
