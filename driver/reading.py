"""Counts to ohms, through the design of the board that counted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..circuits import Design, apparent_resistance, clipped, volts_of_codes
from ..errors import ProtocolError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Reading:
    """What one frame of counts says about the cells. Arrays are (rows, columns)."""

    volts: FloatArray
    resistance: FloatArray
    """apparent, in ohm, equation (10); NaN where not valid"""
    valid: NDArray[np.bool_]


def read_counts(design: Design, counts: NDArray[np.integer]) -> Reading:
    """The apparent resistances behind ``counts`` (rows, columns).

    A cell is not valid where the converter is at either end of its range or the output at a limit of its swing,
    since the volts may then lie anywhere beyond, and where no resistance would give such an output.

    Raises:
        ProtocolError: the counts are not of this design: another shape, or beyond its ADC.

    """
    if counts.shape != design.array.shape:
        sent, expected = "{} x {}".format(*counts.shape), "{} x {}".format(*design.array.shape)
        raise ProtocolError(f"the board sends {sent} cells; its design has {expected}")
    adc = design.adc
    if adc is None:
        raise ProtocolError("the board's design has no [adc]; counts mean nothing without one")
    if counts.max() >= 2**adc.bits:
        raise ProtocolError(f"the board sends a count of {counts.max()}; its ADC has {adc.bits} bits")
    volts = volts_of_codes(design, counts)
    resistance = apparent_resistance(design, volts)
    low, high = design.readout.supply
    within = (volts - adc.step / 2 > low) & (volts + adc.step / 2 <= high)
    valid = within & ~clipped(design, counts) & np.isfinite(resistance) & (resistance > 0)
    return Reading(volts, np.where(valid, resistance, np.nan), valid)
