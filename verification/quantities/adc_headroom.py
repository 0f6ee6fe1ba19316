"""Headroom of the converter: how far converted voltages stay from the ends of its range."""

from __future__ import annotations

from ...circuits import Requirement, scan
from .._dut import DesignUnderTest
from .._hardware import Readings, true_cells
from .._judging import Searched, excursion_of, headroom, negative
from .._outcome import Measurement, NotRun
from .._quantity import DOWN, SEARCHED, Quantity, Shipped
from .._readings import Excursion
from .._units import engineering


def _target(dut: DesignUnderTest, requirement: Requirement) -> Excursion:
    if dut.design.adc is None or (excursion := excursion_of(dut, "converter")) is None:
        raise NotRun("missing: adc.bits, adc.range")
    return excursion


def _measured(dut: DesignUnderTest, readings: Readings) -> Measurement:
    adc = dut.design.adc
    assert adc is not None
    lowest, highest = float(readings.volts.min()), float(readings.volts.max())
    nominal = scan(dut.design, true_cells(dut)).volts
    simulated = min(nominal.min() - adc.range[0] - adc.step, adc.range[1] - adc.step - nominal.max())
    return Measurement(
        min(lowest - adc.range[0] - adc.step, adc.range[1] - adc.step - highest),
        "V",
        where=f"readings from {engineering(lowest, 'V')} to {engineering(highest, 'V')}",
        text=[f"Simulated with nominal parts: {engineering(float(simulated), 'V')}."],
    )


QUANTITY = Quantity(
    name="adc_headroom",
    title="Headroom of the converter",
    unit="V",
    says="Smallest distance of a converted voltage from the ends of the converter's range, V.",
    compute=Searched(_target, "V", negative, detail=headroom),
    methods=SEARCHED,
    shipped=(Shipped(5, "No reading leaves the converter's range.", min=0.0),),
    mended_by=(("readout.reference_resistance", DOWN), ("drive.voltage", DOWN)),
    measured=_measured,
)
