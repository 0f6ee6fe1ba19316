"""Counts to ohms, through the circuit model of the board that counted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray
from ..circuits import Design, Status, live_recovery, volts_of_codes
from ..errors import ProtocolError, SolverError

TOLERANCE = 0.02
"""relative uncertainty of a conductance up to which a cell is valid in any case; the project's own choice"""
STEPS = 2.0
"""ADC steps of its own reading that a valid cell may be uncertain by, where that is more"""
_MOST = 0.6  # relative uncertainty from which on a cell is not valid, however coarse its own steps are
_GUARD = 6.0  # standard deviations of the noise within which an output may stand at a limit of its swing
_LARGEST_NOISE = 8  # ADC steps between frames that may be noise; more is a press
_MEAN_CHANGE = 2.0 / np.sqrt(np.pi)  # mean change between two readings of a normal distribution, in its deviations


@dataclass(frozen=True, slots=True)
class Reading:
    """What one frame of counts says about the cells. Arrays are (rows, columns)."""

    resistance: FloatArray
    """of the cells, in ohm; NaN where not valid"""
    uncertainty: FloatArray
    """relative, of a cell's conductance: half an ADC step of every reading, and what cells that are not known can make
    of this one; inf where nothing is known"""
    valid: BoolArray
    """where ``resistance`` is a measurement"""
    status: NDArray[np.int8]
    """a :class:`ohmskin.circuits.Status` each, which says why a cell is not valid: open, at a limit, disturbed by
    others or by a change that the frame's time did not suffice for, or hidden behind a known fault"""
    solved: bool
    """False where no cell resistances give such readings: then no cell is valid"""


class CountReader:
    """Counts of one board, frame by frame, to the resistances of its cells.

    The whole circuit is inverted: what leads, switches, lines, finite gain, offset and bias current add to the
    readings is taken out of them (:func:`ohmskin.circuits.live_recovery`), to a fraction of an ADC step and at a
    bounded cost per frame.
    """

    def __init__(self, design: Design) -> None:
        """Raises ProtocolError if the design has no ADC."""
        adc = design.adc
        if adc is None:
            raise ProtocolError("the board's design has no [adc]; counts mean nothing without one")
        self._shape = design.array.shape
        self._codes = 2**adc.bits
        self._recover = live_recovery(design)
        self._design, self._step = design, adc.step
        # The middle of a code is half a step away from what may have been read; a limit on an edge belongs to both.
        half = adc.step / 2 * (1 + 1e-9)
        low, high = design.readout.supply
        volts = volts_of_codes(design, np.arange(self._codes)) if adc.bits <= 16 else None
        self._first = 0 if volts is None else max(1, int(np.searchsorted(volts - half, low, side="right")))
        self._last = (
            self._codes - 1 if volts is None else min(self._codes - 1, int(np.searchsorted(volts + half, high)))
        )
        self._level = design.readout.reference_voltage
        rising = (design.drive.voltage > 0) != design.board.circuit.inverts  # whether more current raises the output
        self._guards_low, self._guards_high = not rising and low >= adc.range[0], rising and high <= adc.range[1]
        self._noise = 0.0  # ADC steps, standard deviation of the readings
        self._before: NDArray[np.integer] | None = None
        self._counts = b""
        self._reading: Reading | None = None

    def memory(self) -> tuple[float, NDArray[np.integer] | None]:
        """What the noise is measured from: its standard deviation so far in ADC steps, and the last frame's counts."""
        return self._noise, self._before

    def remember(self, noise_steps: float, counts: NDArray[np.integer] | None) -> None:
        """Go on with the :meth:`memory` of another reader of the same design. The inversion begins anew."""
        self._noise, self._before = noise_steps, counts

    def __call__(self, counts: NDArray[np.integer]) -> Reading:
        """The resistances behind ``counts`` (rows, columns).

        A cell is not valid where the converter is at either end of its range or the output at a limit of its swing,
        since the volts may then lie anywhere beyond, and where it gives no current. Such a cell may be anything from
        what just reaches the limit to a short, and what that makes of the others is their ``uncertainty``, together
        with half an ADC step of all readings. Cells are valid as long as it stays below :data:`TOLERANCE`, or below
        :data:`STEPS` of their own.

        Raises:
            ProtocolError: the counts are not of this design: another shape, or beyond its ADC.

        """
        same = counts.tobytes()
        if self._reading is not None and same == self._counts:
            return self._reading
        if counts.shape != self._shape:
            sent, expected = "{} x {}".format(*counts.shape), "{} x {}".format(*self._shape)
            raise ProtocolError(f"the board sends {sent} cells; its design has {expected}")
        if counts.max() >= self._codes:
            bits = self._codes.bit_length() - 1
            raise ProtocolError(f"the board sends a count of {counts.max()}; its ADC has {bits} bits")
        reading = self._read(counts)
        # What is not settled yet may be so after another frame of the same counts.
        self._counts, self._reading = same, None if (reading.status == Status.DISTURBED).any() else reading
        return reading

    def _measured_noise(self, counts: NDArray[np.integer]) -> float:
        """Standard deviation of the readings in ADC steps, from how they differ from frame to frame.

        Pressing changes readings as well, so the estimate is rather too large. It forgets within a hundred frames.
        """
        if self._before is not None:
            change = np.abs(np.subtract(counts, self._before, dtype=np.int64))
            fresh = float(np.minimum(change, _LARGEST_NOISE).mean()) / _MEAN_CHANGE
            self._noise = max(0.98 * self._noise, fresh)
        self._before = counts
        return self._noise

    def _read(self, counts: NDArray[np.integer]) -> Reading:
        volts = volts_of_codes(self._design, counts)
        # Noise takes an output that stands at a limit of its swing to codes on either side of it.
        guard = np.ceil(_GUARD * self._measured_noise(counts))
        lowest = self._first + (guard if self._guards_low else 0.0)
        highest = self._last - (guard if self._guards_high else 0.0)
        limited = (counts < lowest) | (counts >= highest)
        faint = None
        if limited.any():
            # At the end of the range where hardly a current flows, not knowing a cell disturbs no other.
            faint = limited & (np.abs(volts - self._level) < 1.5 * self._step)
            limited = limited & ~faint
        try:
            found = self._recover(volts, limited)
        except SolverError:
            nothing = np.full(counts.shape, np.nan)
            status = np.full(counts.shape, Status.DISTURBED, dtype=np.int8)
            return Reading(nothing, np.full(counts.shape, np.inf), counts < 0, status, solved=False)
        valid = found.uncertainty <= np.maximum(2.0 * STEPS * found.own_step, TOLERANCE)
        valid &= (found.status == Status.READ) & (found.uncertainty < _MOST)
        if faint is not None:
            valid &= ~faint
        resistance = found.resistance if valid.all() else np.where(valid, found.resistance, np.nan)
        return Reading(resistance, found.uncertainty, valid, found.status, solved=True)
