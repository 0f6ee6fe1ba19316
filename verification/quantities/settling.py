"""Readings in time: settling error at the declared rate, fastest scan, and phase margin of the amplifiers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ...circuits import Boards, BoardsInTime, Design, EventScan, Requirement, Settling, ideal_volts, scan_batch
from ...common import plots
from ...errors import InputError, SolverError
from .._dut import DesignUnderTest, once
from .._hardware import Readings
from .._judging import Searched, negative, percent, worst_of
from .._outcome import DoesNotApply, Figure, Measurement, NotRun
from .._pictures import picture
from .._quantity import DOWN, SEARCHED, SPICE, UP, Quantity, Shipped
from .._search import WorstCase
from .._units import engineering
from .._whole_board import (
    FrameTimeTarget,
    PhaseMarginTarget,
    SettlingTarget,
    goes_by_events,
    scan_in_time,
    sensed_line,
)

CLOCK_TICK_S = 1e-6
"""of the device times in frames"""
_QUICK = (
    ("readout.gain_bandwidth", UP),
    ("readout.feedback_capacitance", DOWN),
    ("readout.column_capacitance", DOWN),
    ("readout.reference_resistance", DOWN),
    ("adc.bits", DOWN),
    ("adc.switch_resistance", DOWN),
    ("adc.sampling_capacitance", DOWN),
    ("adc.acquisition_time", DOWN),
)
"""parts that let readings settle sooner"""


def rate_of(dut: DesignUnderTest, requirement: Requirement | None = None) -> float:
    """The frame rate in Hz that is asked for. Raises NotRun where none is stated."""
    stated = requirement.conditions.frame_rate if requirement is not None else None
    rate = stated or dut.design.operation.frame_rate
    if rate is None:
        raise NotRun("missing: operation.frame_rate")
    return rate


@once
def largest_signal(dut: DesignUnderTest) -> float:
    """V: the largest difference of a reading from the reference by the circuit's law, with nominal parts.

    Raises:
        NotRun: the circuit in time is not modelled, or nothing in it takes time.
    """
    design = dut.design
    cells = np.stack(list(dut.uniform.values()))
    try:
        if goes_by_events(design):
            scan_in_time(design, cells[0], 1.0)
            takes_time = True
        else:
            takes_time = BoardsInTime(design, Boards.of(design), cells).takes_time
    except (InputError, SolverError) as error:
        raise NotRun(str(error)) from error
    if not takes_time:
        first = "readout.gain_bandwidth" if design.board.circuit.has_amplifiers else "readout.column_capacitance"
        raise NotRun(f"missing: {first}, or adc.switch_resistance with adc.sampling_capacitance: nothing takes time")
    return float(np.abs(ideal_volts(design, cells) - design.readout.reference_voltage).max())


def nominal_settling(dut: DesignUnderTest, rate: float) -> WorstCase:
    """The worst settling error of nominal parts, of 1. Raises NotRun, or InputError for a period that is too short."""
    period = 1.0 / (rate * dut.design.board.shape[0])
    return worst_of(dut, SettlingTarget(period, largest_signal(dut)), "nominal")


def require_linear(dut: DesignUnderTest) -> None:
    """Raise NotRun where the circuit in time is not modelled or not linear, or where nothing in it takes time."""
    largest_signal(dut)
    if scan_batch(dut.design, np.stack(list(dut.uniform.values())), method="exact").saturated.any():
        raise NotRun("settling is linear: an output saturates with nominal parts")


def frame_time(design: Design) -> float:
    """s of a frame by its events. Raises NotRun where the circuit has no model in time."""
    try:
        seconds = EventScan(design, np.full(design.array.shape, 1e4)).frame_time
    except (InputError, SolverError) as error:
        raise NotRun(str(error)) from error
    if not seconds:
        raise NotRun("the events of [scan] take no time; missing: adc.acquisition_time or scan.conversion_time")
    return seconds


def _settling(dut: DesignUnderTest, requirement: Requirement) -> SettlingTarget | Measurement:
    rate = rate_of(dut, requirement)
    require_linear(dut)
    if dut.design.scan is not None and (seconds := frame_time(dut.design)) * rate > 1.0 + 1e-9:
        where = f"the events of a frame take {engineering(seconds, 's')}: at {engineering(rate, 'Hz')} it is too short"
        return Measurement(np.inf, "%", where=where)
    lines, adc = dut.design.board.shape, dut.design.adc
    period = 1.0 / (rate * lines[0])
    if adc is not None and period < adc.acquisition_time * lines[1]:
        where = f"row period {engineering(period, 's')}: shorter than adc.acquisition_time for each column"
        return Measurement(np.inf, "%", where=where)
    return SettlingTarget(period, largest_signal(dut))


def _say_rate(
    dut: DesignUnderTest, requirement: Requirement, found: WorstCase, measurement: Measurement
) -> Measurement:
    rate = rate_of(dut, requirement)
    period = engineering(1.0 / (rate * dut.design.board.shape[0]), "s")
    said = f"At {engineering(rate, 'Hz')} each {dut.design.board.line_kinds[0]} has {period}."
    draws = np.isfinite(found.value) and not goes_by_events(dut.design)
    return replace(measurement, text=[said], figures=_figure(dut, rate, found) if draws else [])


def settling_share(dut: DesignUnderTest, rate: float) -> float:
    """Share of the preceding row's reading that is left in a reading with nominal parts; 0 where nothing takes time."""
    try:
        return float(np.clip(nominal_settling(dut, rate).value, 0.0, 1.0))
    except NotRun:
        return 0.0
    except InputError:
        return 1.0


def _figure(dut: DesignUnderTest, rate: float, found: WorstCase) -> list[Figure]:
    design = found.box.board(found.corner.x[0])
    settling, adc = Settling(design, found.frames[0]), design.adc
    lines, period = design.board.shape, 1.0 / (rate * design.board.shape[0])
    shortest = max(min(0.5 * settling.shortest_period(0.5), period / 2), adc.acquisition_time * lines[1] if adc else 0)
    periods = np.geomspace(max(shortest, 1e-9), 2 * period, 60)
    share = 100 * settling.signal / largest_signal(dut)

    def draw(panels: Any) -> None:
        panel = panels[0, 0]
        panel.loglog(1e6 * periods, [share * max(settling.error(p), 1e-12) for p in periods])
        panel.axvline(1e6 * period, color=plots.INK, lw=1, ls=":")
        panel.text(1e6 * period, panel.get_ylim()[1], " declared", va="top", fontsize=8)
        if adc:
            panel.axhline(100 * adc.step / 4 / largest_signal(dut), color=plots.RED, lw=1, ls="--")
        panel.set(title="Settling", xlabel="row period / µs", ylabel="error / % of largest signal")

    return picture("The worst frame on the worst board. Dashed: a quarter of an ADC step.", draw)


def _shortest_frame(dut: DesignUnderTest, requirement: Requirement) -> FrameTimeTarget | Measurement:
    design = dut.design
    step = dut.converter().step
    if requirement.min is None and requirement.max is None:
        raise NotRun("no limit is given; missing: operation.frame_rate")
    if design.scan is not None:
        return Measurement(1.0 / frame_time(design), "Hz", where="by the events of [scan]")
    require_linear(dut)
    if goes_by_events(design):
        raise NotRun("missing: [scan], the events of a frame")
    return FrameTimeTarget(step / 4)


def _rate(seconds: float) -> float:
    return 1.0 / seconds if seconds > 0.0 else np.inf


def _limits_scan(
    dut: DesignUnderTest, requirement: Requirement, found: WorstCase, measurement: Measurement
) -> Measurement:
    if found.value <= 0.0:
        raise NotRun("nothing limits the scan")
    if np.isfinite(found.value):
        return measurement
    pressed = found.box.in_words(found.target.pattern(found.box, found.corner))
    where = f"{pressed}: the sampling capacitor cannot follow within adc.acquisition_time"
    return replace(measurement, where=where)


def _measured(dut: DesignUnderTest, readings: Readings) -> Measurement:
    seconds = float(readings.device_steps.sum())
    if not seconds:
        raise NotRun("the board states no time")
    rate = (len(readings.volts) + readings.lost - 1) / seconds
    tick = 2.0 * CLOCK_TICK_S / seconds  # at both ends
    text = ["The rate at which this board scans."]
    return Measurement(rate, "Hz", where="by the board's clock", text=text, resolution=rate * tick)


def _loops(dut: DesignUnderTest, requirement: Requirement) -> PhaseMarginTarget:
    design = dut.design
    if not design.board.circuit.has_amplifiers:
        raise DoesNotApply(f"'{design.readout.circuit}' has no feedback loop")
    if not design.board.virtual_grounds:
        here = f'"{design.readout.circuit}"'
        here += ' with readout.columns = "multiplexed"' if design.board.multiplexed else ""
        raise NotRun(f"stability is modelled for an amplifier on each line, not for {here}")
    if np.isinf(design.readout.gain_bandwidth):
        raise NotRun("missing: readout.gain_bandwidth")
    return PhaseMarginTarget()


def _crosses(dut: DesignUnderTest, requirement: Requirement, found: WorstCase, measurement: Measurement) -> Measurement:
    if not np.isfinite(found.value):
        raise NotRun("the loop gain is below 1 throughout: there is no crossover")
    return measurement


def _declared(design: Design) -> float | None:
    return design.operation.frame_rate


def _names_model(design: Design) -> bool:
    return design.readout.amplifier_model is not None


QUANTITIES = (
    Quantity(
        name="settling_error",
        title="Settling error",
        unit="%",
        says="Largest deviation of a sampled reading from the settled one at the declared rate, % of the "
        "largest signal.",
        compute=Searched(_settling, "%", percent, detail=_say_rate),
        methods=(*SEARCHED, SPICE),
        shipped=(
            Shipped(8, "Readings settle at the declared frame rate.", max=1.0),
            Shipped(22, "The maker's model settles at the declared rate.", max=1.0, method=SPICE, applies=_names_model),
        ),
        mended_by=(("operation.frame_rate", DOWN), *_QUICK),
        analysis="transient",
    ),
    Quantity(
        name="fastest_scan",
        title="Fastest scan",
        unit="Hz",
        says="Frames per second at which every reading still settles to a quarter of an ADC step, Hz.",
        compute=Searched(_shortest_frame, "Hz", _rate, detail=_limits_scan),
        methods=SEARCHED,
        shipped=(Shipped(9, "The declared frame rate can be had to a quarter of an ADC step.", min=_declared),),
        mended_by=_QUICK,
        measured=_measured,
    ),
    Quantity(
        name="phase_margin",
        title="Phase margin",
        unit="°",
        says="Smallest phase margin of an amplifier on its column, degrees; further poles take some of it away.",
        compute=Searched(_loops, "°", negative, sensed_line, _crosses),
        methods=(*SEARCHED, SPICE),
        shipped=(
            Shipped(10, "Amplifiers are stable on their columns.", min=45.0),
            Shipped(21, "The maker's model is stable on its column.", min=45.0, method=SPICE, applies=_names_model),
        ),
        mended_by=(
            ("readout.feedback_capacitance", UP),
            ("readout.column_capacitance", DOWN),
            ("readout.reference_resistance", DOWN),
            ("readout.gain_bandwidth", DOWN),
        ),
        analysis="loop gain",
    ),
)
