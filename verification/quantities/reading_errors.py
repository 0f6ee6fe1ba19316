"""Errors of settled readings: crosstalk, reading error and gain error, of resistance or as shares of full scale."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ...circuits import Design, Requirement, apparent_resistance, scan
from ...common.arrays import FloatArray
from .._box import Box
from .._dut import DesignUnderTest
from .._hardware import Readings
from .._judging import Searched, contributions, in_both_units, maps, percent, worst_cell
from .._outcome import DoesNotApply, Measurement, NotRun
from .._quantity import DOWN, SAMPLED, SEARCHED, SHARE_UNITS, UP, Quantity, Shipped
from .._readings import FREE, Frames, ReadingErrorTarget
from .._search import WorstCase
from .._units import engineering

_BEFORE_AND_AFTER = Frames(own=(0.0, 0.0), others=(0.0, FREE), around=(0.0, FREE))
_FROM_REST_TO_FULL = Frames(own=(0.0, 1.0), others=(FREE, FREE), around=(0.0, 1.0))
_LOST = "a reading at or beyond an end of the circuit's law or of the converter, or an output at its limit"
_PARTS = (
    *((f"array.{key}", DOWN) for key in ("row_lead", "row_segment", "column_lead", "column_segment")),
    ("readout.open_loop_gain", UP),
    *((f"readout.{key}", DOWN) for key in ("offset_voltage", "bias_current")),
    *((key, UP) for key in ("readout.reference_resistance", "drive.voltage")),
    *((f"adc.{key}", DOWN) for key in ("offset_voltage", "gain_error")),
    ("adc.bits", UP),
)
"""that errors of readings come from"""


@dataclass(frozen=True)
class Crosstalk(ReadingErrorTarget):
    """Change of an untouched cell's reading when other cells are pressed."""

    name: str = "crosstalk"
    frames: Frames = _BEFORE_AND_AFTER

    def error(self, box: Box, read: Sequence[FloatArray], true: Sequence[FloatArray]) -> FloatArray:
        return box.scale.difference(read[1], read[0])


@dataclass(frozen=True)
class ReadingError(ReadingErrorTarget):
    """Error of what the host makes of an uncalibrated reading."""

    name: str = "reading error"

    def error(self, box: Box, read: Sequence[FloatArray], true: Sequence[FloatArray]) -> FloatArray:
        return box.scale.difference(read[0], true[0])


@dataclass(frozen=True)
class GainError(ReadingErrorTarget):
    """Error of the change that the host sees when the cell alone is pressed from rest to full scale."""

    name: str = "gain error"
    frames: Frames = _FROM_REST_TO_FULL

    def error(self, box: Box, read: Sequence[FloatArray], true: Sequence[FloatArray]) -> FloatArray:
        return box.scale.gain_error(read[1] - read[0], true[1] - true[0])


def _target(target: ReadingErrorTarget, dut: DesignUnderTest, requirement: Requirement) -> ReadingErrorTarget:
    if isinstance(target, Crosstalk) and dut.design.array.rows * dut.design.array.columns == 1:
        raise DoesNotApply("a single cell has no neighbours")
    return target


def _detail(dut: DesignUnderTest, requirement: Requirement, found: WorstCase, measurement: Measurement) -> Measurement:
    if not np.isfinite(found.value):
        return replace(measurement, where=f"{measurement.where}: {_LOST}")
    if not dut.compares:
        return measurement
    return replace(
        measurement,
        text=[in_both_units(dut, found)],
        contributions=contributions(found, 100.0),
        figures=maps(found, measurement.unit, requirement.max),
    )


def _measured(dut: DesignUnderTest, readings: Readings) -> Measurement:
    jig = dut.jig
    if jig is None:
        raise NotRun("no known resistors on the board: --jig CELLS.csv says what they are")
    mean = readings.volts.mean(axis=0)
    ohms = apparent_resistance(dut.design, mean)
    error, place, where = worst_cell(np.abs(ohms / jig - 1.0))
    nominal = apparent_resistance(dut.design, scan(dut.design, jig).volts)
    simulated = 100 * float(np.abs(nominal / jig - 1.0)[place])
    half_step = dut.design.adc.step / 2 if dut.design.adc is not None else 0.0
    ends = [apparent_resistance(dut.design, mean + sign * half_step)[place] for sign in (-1.0, 1.0)]
    return Measurement(
        100 * error,
        "%",
        where=f"{where}: {engineering(float(ohms[place]), 'ohm')} read",
        resolution=50 * float(abs(ends[1] - ends[0]) / jig[place]),
        text=[f"Simulated with nominal parts: {engineering(simulated, '%')} at that cell."],
    )


def _crosstalk_limit(design: Design) -> float:
    return design.requirements.crosstalk_percent


def _limit(design: Design) -> float:
    return design.requirements.reading_error_percent


def _error(
    target: ReadingErrorTarget,
    says: str,
    *shipped: Shipped,
    measured: Callable[[DesignUnderTest, Readings], Measurement] | None = None,
) -> Quantity:
    return Quantity(
        name=target.name.replace(" ", "_"),
        title=target.name.capitalize(),
        unit="%",
        says=says,
        compute=Searched(partial(_target, target), show=percent, detail=_detail),
        methods=SEARCHED,
        units=SHARE_UNITS,
        shipped=shipped,
        mended_by=_PARTS,
        rewired=True,
        measured=measured,
    )


QUANTITIES = (
    _error(
        Crosstalk(),
        "Largest change of an untouched cell's reading, of that reading or of full scale, whatever else is pressed.",
        Shipped(1, "A press does not show on untouched cells.", max=_crosstalk_limit),
    ),
    _error(
        ReadingError(),
        "Largest error, of the resistance or of full scale, that the ideal circuit's law makes of a reading.",
        Shipped(2, "Readings are right without calibration.", max=_limit),
        Shipped(18, "99 % of all boards keep the error.", max=_limit, method=SAMPLED),
        measured=_measured,
    ),
    _error(
        GainError(),
        "Largest error of the change that is read when a cell alone goes from rest to full scale.",
        Shipped(3, "A press is read at its true size.", max=_limit),
    ),
)
