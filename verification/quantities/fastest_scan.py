"""Fastest scan: the frame rate at which every reading still settles to a quarter of a converter's step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._hardware import Readings
from .._judging import box_of, measured, worst_of
from .._outcome import Measurement, NotRun
from .._quantity import Quantity, Shipped
from .._whole_board import SettlingTarget, goes_by_events, shortest_periods
from .settling_error import QUICK, frame_time, require_linear

MOST_SEARCHES = 4
NEAR = 1e-3
"""relative: a period that is longer by less is the same"""
CLOCK_TICK_S = 1e-6
"""of the device times in frames"""


def _compute(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    """The longest of the shortest row periods, by searches for boards that have not settled at the longest so far."""
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
    allowed, box = design.adc.step / 4, box_of(dut)
    starts = SettlingTarget(1.0, allowed).starts(box)
    periods = shortest_periods(box, starts, allowed)
    period, corner = float(periods.max()), starts.some(np.array([int(periods.argmax())]))
    found = None
    for _ in range(MOST_SEARCHES):
        if np.isinf(period):
            break
        found = worst_of(dut, SettlingTarget(period, allowed))
        longer = float(shortest_periods(box, found.corner, allowed)[0])
        if longer <= period * (1.0 + NEAR):
            break
        period, corner = longer, found.corner
    if np.isposinf(period):
        pressed = box.in_words(box.split(corner.x)[1][0] > 0)
        where = f"{pressed}: the sampling capacitor cannot follow within adc.acquisition_time"
        return Measurement(0.0, "Hz", where=where)
    if period <= 0 or found is None:
        raise NotRun("nothing limits the scan")
    return measured(replace(found, corner=corner), 1.0 / (period * design.board.shape[0]), "Hz")


def _measured(dut: DesignUnderTest, readings: Readings) -> Measurement:
    if not readings.device_seconds:
        raise NotRun("the board tells no time")
    rate = (len(readings.volts) + readings.lost - 1) / readings.device_seconds
    tick = 2.0 * CLOCK_TICK_S / readings.device_seconds  # at both ends
    text = ["The rate at which this board scans."]
    return Measurement(rate, "Hz", where="by the board's clock", text=text, resolution=rate * tick)


QUANTITY = Quantity(
    name="fastest_scan",
    title="Fastest scan",
    unit="Hz",
    says="Frames per second at which every reading still settles to a quarter of an ADC step, Hz.",
    compute=_compute,
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
