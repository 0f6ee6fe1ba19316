"""Counts to ohms, through the circuit model of the board that counted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray
from ..circuits import Design, Recoverer, Status, clipped, volts_of_codes
from ..errors import ProtocolError, SolverError

TOLERANCE = 0.01
"""relative uncertainty of a conductance up to which a cell is valid in any case; the project's own choice"""
_ACCURACY = 1e-6  # of an apparent conductance: far below the step of any converter


@dataclass(frozen=True, slots=True)
class Reading:
    """What one frame of counts says about the cells. Arrays are (rows, columns)."""

    volts: FloatArray
    resistance: FloatArray
    """of the cells, in ohm; NaN where not valid"""
    uncertainty: FloatArray
    """relative, of a cell's conductance: what cells that are not known can make of it; inf where nothing is known"""
    valid: BoolArray
    solved: bool
    """False where no cell resistances give such readings: then no cell is valid"""


class CountReader:
    """Counts of one board, frame by frame, to the resistances of its cells.

    The whole circuit is inverted: what leads, switches, lines, finite gain, offset and bias current add to the
    readings is taken out of them (:mod:`ohmskin.circuits.recovery`).
    """

    def __init__(self, design: Design) -> None:
        """Raises ProtocolError if the design has no ADC."""
        if design.adc is None:
            raise ProtocolError("the board's design has no [adc]; counts mean nothing without one")
        self._design, self._adc = design, design.adc
        self._recover = Recoverer(design, accuracy=_ACCURACY)

    def __call__(self, counts: NDArray[np.integer]) -> Reading:
        """The resistances behind ``counts`` (rows, columns).

        A cell is not valid where the converter is at either end of its range or the output at a limit of its swing,
        since the volts may then lie anywhere beyond, and where it gives no current. Such a cell may be anything from
        what just reaches the limit to a short, and what that makes of the others is their ``uncertainty``: they are
        valid as long as it stays below :data:`TOLERANCE`, or below what one step of the converter makes of them.

        Raises:
            ProtocolError: the counts are not of this design: another shape, or beyond its ADC.

        """
        design, adc = self._design, self._adc
        if counts.shape != design.array.shape:
            sent, expected = "{} x {}".format(*counts.shape), "{} x {}".format(*design.array.shape)
            raise ProtocolError(f"the board sends {sent} cells; its design has {expected}")
        if counts.max() >= 2**adc.bits:
            raise ProtocolError(f"the board sends a count of {counts.max()}; its ADC has {adc.bits} bits")
        volts = volts_of_codes(design, counts)
        low, high = design.readout.supply
        half = adc.step / 2 * (1 + 1e-9)  # a limit on the very edge of a code belongs to both
        within = (volts - half > low) & (volts + half < high)
        limited = clipped(design, counts) | ~within
        # At the end of the range where hardly a current flows, not knowing it disturbs no other cell.
        faint = limited & (np.abs(volts - design.readout.reference_voltage) < 1.5 * adc.step)
        try:
            found = self._recover(volts, clipped=limited & ~faint)
        except SolverError:
            nothing = np.full(counts.shape, np.nan)
            return Reading(volts, nothing, np.full(counts.shape, np.inf), counts < 0, solved=False)
        step = adc.step / np.maximum(np.abs(volts - design.readout.reference_voltage), adc.step)
        known = np.isin(found.status, (Status.READ, Status.DISTURBED)) & (
            found.uncertainty <= np.maximum(step, TOLERANCE)
        )
        valid = known & ~faint & (found.resistance > 0)
        return Reading(volts, np.where(valid, found.resistance, np.nan), found.uncertainty, valid, solved=True)
