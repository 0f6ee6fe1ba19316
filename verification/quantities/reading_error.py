"""Reading error: how far the host's resistance, or its share of full scale, is from the cell's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...circuits import apparent_resistance, scan
from ...common.arrays import FloatArray, IntArray
from .._box import Box
from .._dut import DesignUnderTest
from .._hardware import Readings
from .._outcome import Measurement, NotRun
from .._quantity import READING_PARTS, SAMPLED, SEARCHED, SHARE_UNITS, Quantity, Shipped
from .._reading_errors import error_of
from .._readings import ReadingErrorTarget
from .._units import engineering


@dataclass(frozen=True)
class ReadingError(ReadingErrorTarget):
    """Error of what the host makes of an uncalibrated reading."""

    name: str = "reading error"

    def pressed(self, pattern: FloatArray, row: IntArray, column: IntArray) -> list[FloatArray]:
        return [pattern]

    def error(self, box: Box, read: Sequence[FloatArray], true: Sequence[FloatArray]) -> FloatArray:
        return box.scale.difference(read[0], true[0])


def _measured(dut: DesignUnderTest, readings: Readings) -> Measurement:
    jig = dut.jig
    if jig is None:
        raise NotRun("no known resistors on the board: --jig CELLS.csv says what they are")
    mean = readings.volts.mean(axis=0)
    ohms = apparent_resistance(dut.design, mean)
    error = np.abs(ohms / jig - 1.0)
    nominal = apparent_resistance(dut.design, scan(dut.design, jig).volts)
    place = np.unravel_index(int(np.argmax(error)), error.shape)
    simulated = 100 * float(np.abs(nominal / jig - 1.0)[place])
    half_step = dut.design.adc.step / 2 if dut.design.adc is not None else 0.0
    ends = [apparent_resistance(dut.design, mean + sign * half_step)[place] for sign in (-1.0, 1.0)]
    return Measurement(
        100 * float(error[place]),
        "%",
        where=f"cell {tuple(map(int, place))}: {engineering(float(ohms[place]), 'ohm')} read",
        resolution=50 * float(abs(ends[1] - ends[0]) / jig[place]),
        text=[f"Simulated with nominal parts: {engineering(simulated, '%')} at that cell."],
    )


QUANTITY = Quantity(
    name="reading_error",
    title="Reading error",
    unit="%",
    says="Largest error, of the resistance or of full scale, that the ideal circuit's law makes of a reading.",
    compute=error_of(ReadingError()),
    methods=SEARCHED,
    units=SHARE_UNITS,
    shipped=(
        Shipped(
            2, "Readings are right without calibration.", max=lambda design: design.requirements.reading_error_percent
        ),
        Shipped(
            18,
            "99 % of all boards keep the error.",
            max=lambda design: design.requirements.reading_error_percent,
            method=SAMPLED,
        ),
    ),
    mended_by=READING_PARTS,
    rewired=True,
    measured=_measured,
)
