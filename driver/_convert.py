"""Measurement chain: counts to ohms (circuit model inverted) to kPa (causal estimator), frame by frame in order."""

from __future__ import annotations

import math
import threading
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray
from ..cell import Cell, Estimator
from ..circuits import Design, Reason
from ..errors import InputError
from ._calibration import Calibration
from ._contacts import ContactsOfFrames, ContactTracker, PressureView
from ._mailbox import Mailbox
from ._past import Block, MeasurementPast
from ._reading import CountReader, Reading
from ._statistics import Counters
from ._stream import RawFrame

T = TypeVar("T", bound=np.generic)

KEEP_STATE_S = 60.0
"""after a longer gap the estimator starts anew: what the skin bore meanwhile is not to be guessed"""

SOON = 50
"""frames without any valid cell after which the driver says why"""


@dataclass(frozen=True, slots=True)
class Measurement:
    """What one frame says about the cells. Arrays are (rows, columns) and read-only."""

    valid: BoolArray
    reason: NDArray[np.int8]
    """why a cell is not valid: a :class:`ohmskin.circuits.Reason` each"""
    resistance: FloatArray
    """ohm"""
    pressure: FloatArray
    """kPa"""
    pressure_std: FloatArray
    """kPa"""
    view: PressureView
    estimator_starts: int
    """times that the estimator has begun without memory, up to this frame"""


class Converter:
    """Turns frames into measurements, each at most once, and in the order in which they came.

    The estimator sees the frames that are taken, with the time between them. Frames that nobody takes cost nothing.
    """

    def __init__(
        self,
        design: Design,
        cell: Cell | None,
        estimator: str | None,
        pitch_m: float,
        counters: Counters,
        rest_changes: Sequence[tuple[float, FloatArray | None]] = (),
        accuracy: float | None = None,
        calibration: Calibration | None = None,
    ) -> None:
        """Set up the circuit's inverse and the estimator; without ``cell`` pressures are NaN.

        ``rest_changes`` are those of a recording: times, and the (cells,) rest resistances for frames after them.
        ``accuracy`` is the relative uncertainty up to which cells are valid, see :class:`CountReader`.
        ``calibration`` gives each cell its rest resistance, as long as no tare gives another one, and its gain.

        Raises:
            ProtocolError: the design has no ADC.
            InputError: there is no such estimator for this cell, or the accuracy is not between 0 and 1.

        """
        self.design = design
        self.cell = cell
        self.pitch_m = pitch_m
        self._estimator_name = estimator
        self._calibration = calibration
        self._counters = counters
        self._accuracy = accuracy
        self._read = CountReader(design, accuracy=accuracy)
        self._never_valid: int | None = 0  # frames so far, all without a valid cell; None: said, or not so
        self._lock = threading.RLock()
        self.on_converted: list[Callable[[RawFrame, Measurement], None]] = []
        """told of every measurement: for recorders"""
        self._rest_ohm: FloatArray | None = None
        for _, ohm in rest_changes:
            if ohm is not None and ohm.size != math.prod(design.array.shape):
                raise InputError("a tare of {} cells; this skin has {} x {}".format(ohm.size, *design.array.shape))
        self._rest_changes = deque(rest_changes)
        self.on_rest: list[Callable[[FloatArray | None, float | None], None]] = []
        """told of new rest resistances and of the time of the last frame before them: for recorders"""
        self._starts = self._starts_told = 0
        """times that the estimator has begun without memory, and as many as the last frame knew of"""
        self._estimator = self._new_estimator()
        full_scale_kpa = np.inf if cell is None else cell.full_scale_kpa
        self.contacts = ContactsOfFrames(ContactTracker(design.array.shape, pitch_m, full_scale_kpa))
        self._last: RawFrame | None = None
        self._last_s: float | None = None
        """of the last frame, on the time scale of the estimator; also of a frame before the recording that is played"""
        self._measured: dict[int, Measurement] = {}

    @property
    def starts(self) -> int:
        """Times that the estimator has begun without memory."""
        return self._starts

    def try_out(self) -> None:
        """Convert a frame of mid-scale counts, for what shows only then: absurd values, and the cost of setting up."""
        adc = self.design.adc
        assert adc is not None, "CountReader refuses designs without an ADC"
        counts = np.full(self.design.array.shape, 2 ** (adc.bits - 1), dtype=np.uint16)
        reading = self._read(counts)
        if self.cell is not None:
            self._fresh_estimator().step(1.0, reading.resistance)
        self._read.forget()

    def use_rest(self, rest_ohm: FloatArray | None) -> None:
        """Take these rest resistances (rows, columns) from now on, None those without a tare; memory is dropped."""
        with self._lock:
            self._rest_ohm = rest_ohm
            self._estimator = self._new_estimator()
            for tell in tuple(self.on_rest):
                tell(rest_ohm, None if self._last is None else self._last.monotonic_time)

    def hand_over(self) -> MeasurementPast:
        """What is remembered of frames so far, for a recording that begins with the next frame.

        What cannot be written down is dropped here as well, so that a replay goes on from the same state: the inversion
        of the circuit begins anew, and a jump of the last 0.1 s is no longer taken back as a spark.
        """
        with self._lock:
            noise_steps, counts = self._read.memory()
            estimator = None
            if self._estimator is not None:
                estimator = {name: Block.of(array) for name, array in self._estimator.state().items()}
            past = MeasurementPast(
                time_s=self._last_s,
                rest_ohm=None if self._rest_ohm is None else Block.of(self._rest_ohm),
                noise_steps=noise_steps,
                counts=None if counts is None else Block.of(counts.astype(np.float64)),
                estimator=estimator,
                restarted=self._starts > self._starts_told,
            )
            self._go_on(past)
            return past

    def resume(self, past: MeasurementPast) -> None:
        """Begin with what :meth:`hand_over` returned.

        Raises:
            InputError: it is of another cell, or of an array of another shape.

        """
        with self._lock:
            self._go_on(past)
            self._starts = int(past.restarted)

    def _go_on(self, past: MeasurementPast) -> None:
        shape = self.design.array.shape
        rest_ohm = None if past.rest_ohm is None else past.rest_ohm.array()
        counts = None if past.counts is None else past.counts.array()
        for name, array in (("rest_ohm", rest_ohm), ("counts", counts)):
            if array is not None and array.shape != shape:
                raise InputError(f"{name} of {array.shape}; expected those of {shape[0]} x {shape[1]} cells")
        if rest_ohm is not None and not (np.isfinite(rest_ohm) & (rest_ohm > 0)).all():
            raise InputError("rest_ohm: expected positive resistances")
        if counts is not None and not ((counts >= 0) & (counts < 2**16)).all():
            raise InputError("counts: expected those of 16 bits")
        self._last_s, self._rest_ohm = past.time_s, rest_ohm
        self._read = CountReader(self.design, accuracy=self._accuracy)
        self._read.remember(past.noise_steps, None if counts is None else counts.astype(np.uint16))
        if self.cell is not None:
            self._estimator = self._fresh_estimator()
            self._estimator.restore(past.estimator_state())

    def measure(self, frame: RawFrame, mailbox: Mailbox) -> Measurement | None:
        """The measurement of ``frame``, and of those before it that are still queued.

        Returns:
            None where a later frame has been converted already and this one was not.

        Raises:
            ProtocolError: the counts do not fit the design.

        """
        with self._lock:
            done = 0 if self._last is None else self._last.index
            if frame.index > done:
                for queued in [*mailbox.between(done, frame.index), frame]:
                    measurement = self._convert(queued)
                    self._measured[queued.index] = measurement
                    for tell in tuple(self.on_converted):
                        tell(queued, measurement)
                passed = mailbox.passed()
                self._measured = {k: value for k, value in self._measured.items() if k > passed or k == frame.index}
            return self._measured.get(frame.index)

    def _convert(self, frame: RawFrame) -> Measurement:
        gap_s = 0.0 if self._last_s is None else frame.time_s - self._last_s
        self._last, self._last_s = frame, frame.time_s
        reading = self._read(frame.counts)
        self._counters.converted += 1
        self._counters.unsolved += not reading.solved
        self._counters.reasons = reading.reason
        if self._never_valid is not None:
            self._look_for_valid_cells(reading)
        while self._rest_changes and frame.monotonic_time > self._rest_changes[0][0]:
            rest = self._rest_changes.popleft()[1]
            self.use_rest(None if rest is None else rest.reshape(self.design.array.shape))
        if gap_s > KEEP_STATE_S:
            self._estimator = self._new_estimator()
        pressure = std = np.full(frame.counts.shape, np.nan)
        if self._estimator is not None:
            if not self._estimator.resolved:
                self._estimator.resolve(reading.step_std, reading.resistance)
            pressure = self._estimator.step(gap_s, reading.resistance)
            std = self._estimator.std_kpa
            if self._calibration is not None:
                pressure, std = self._calibration.applied(pressure, std)
        view = PressureView(frame.time_s, _read_only(pressure), _read_only(std))
        self.contacts.pass_by(view)
        self._starts_told = self._starts
        return Measurement(
            _read_only(reading.valid),
            _read_only(reading.reason),
            _read_only(reading.resistance),
            pressure,
            std,
            view,
            self._starts,
        )

    def _look_for_valid_cells(self, reading: Reading) -> None:
        """Say once what keeps all cells of a board from being valid, where that is the accuracy asked for."""
        assert self._never_valid is not None
        if reading.valid.any():
            self._never_valid = None
            return
        self._never_valid += 1
        if self._never_valid < SOON:
            return
        self._never_valid = None
        best = float(reading.uncertainty[reading.reason == Reason.UNCERTAIN].min(initial=np.inf))
        if best < 1.0:
            asked = "2 % or what the converter allows" if self._accuracy is None else f"{100 * self._accuracy:g} %"
            self._counters.remark = (
                f"no cell was valid in the first {SOON} frames: the best one is known to {100 * best:.2g} %, "
                f"and {asked} was asked for; Skin.open(..., accuracy={min(1.5 * best, 0.99):.2g}) takes cells known so "
                "well; a converter of more bits, or another reference resistor, tells more"
            )
            warnings.warn(self._counters.remark, RuntimeWarning, stacklevel=2)

    def _new_estimator(self) -> Estimator | None:
        self._starts += 1
        return None if self.cell is None else self._fresh_estimator()

    def _fresh_estimator(self) -> Estimator:
        assert self.cell is not None
        rest_ohm = self._rest_ohm
        if rest_ohm is None and self._calibration is not None:
            rest_ohm = self._calibration.rest_ohm
        return self.cell.estimator(self.design.array.shape, self._estimator_name, rest_resistance_ohm=rest_ohm)


def _read_only(array: NDArray[T]) -> NDArray[T]:
    array.flags.writeable = False
    return array
