"""Fastest scan: the frame rate at which every reading still settles to a quarter of a converter's step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._hardware import Readings
from .._judging import Searched
from .._outcome import Measurement, NotRun
from .._quantity import SEARCHED, Quantity, Shipped
from .._search import WorstCase
from .._whole_board import FrameTimeTarget, goes_by_events
from .settling_error import QUICK, frame_time, require_linear

CLOCK_TICK_S = 1e-6
"""of the device times in frames"""


def _target(dut: DesignUnderTest, requirement: Requirement) -> FrameTimeTarget | Measurement:
    design = dut.design
    if design.adc is None:
        raise NotRun("missing: adc.bits, adc.range")
    if requirement.min is None and requirement.max is None:
        raise NotRun("no limit is given; missing: operation.frame_rate")
    if design.scan is not None:
        return Measurement(1.0 / frame_time(design), "Hz", where="by the events of [scan]")
    require_linear(dut)
    if goes_by_events(design):
        raise NotRun("missing: [scan], the events of a frame")
    return FrameTimeTarget(design.adc.step / 4)


def _rate(seconds: float) -> float:
    return 1.0 / seconds if seconds > 0.0 else np.inf


def _detail(dut: DesignUnderTest, requirement: Requirement, found: WorstCase, measurement: Measurement) -> Measurement:
    if found.value <= 0.0:
        raise NotRun("nothing limits the scan")
    if np.isfinite(found.value):
        return measurement
    pressed = found.box.in_words(found.target.pattern(found.box, found.corner))
    where = f"{pressed}: the sampling capacitor cannot follow within adc.acquisition_time"
    return replace(measurement, where=where)


def _measured(dut: DesignUnderTest, readings: Readings) -> Measurement:
    if not readings.device_seconds:
        raise NotRun("the board states no time")
    rate = (len(readings.volts) + readings.lost - 1) / readings.device_seconds
    tick = 2.0 * CLOCK_TICK_S / readings.device_seconds  # at both ends
    text = ["The rate at which this board scans."]
    return Measurement(rate, "Hz", where="by the board's clock", text=text, resolution=rate * tick)


QUANTITY = Quantity(
    name="fastest_scan",
    title="Fastest scan",
    unit="Hz",
    says="Frames per second at which every reading still settles to a quarter of an ADC step, Hz.",
    compute=Searched(_target, "Hz", _rate, detail=_detail),
    methods=SEARCHED,
    shipped=(
        Shipped(
            9,
            "The declared frame rate can be had to a quarter of an ADC step.",
            min=lambda design: design.operation.frame_rate,
        ),
    ),
    mended_by=QUICK,
    measured=_measured,
)
