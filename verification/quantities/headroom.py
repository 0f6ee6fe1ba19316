"""Headroom: how far outputs stay from their supply limits, and converted voltages from the ends of the converter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...circuits import Requirement, scan
from .._dut import DesignUnderTest
from .._hardware import Readings, true_cells
from .._judging import Searched, excursion_of, negative
from .._outcome import DoesNotApply, Measurement, NotRun
from .._quantity import DOWN, SEARCHED, Quantity, Shipped
from .._readings import Excursion
from .._search import WorstCase
from .._units import engineering


def _of_outputs(dut: DesignUnderTest, requirement: Requirement) -> Excursion:
    board = dut.design.board
    if not board.circuit.has_amplifiers and not np.isfinite(board.supply).any():
        raise DoesNotApply(f"'{dut.design.readout.circuit}' has no amplifier that could saturate")
    if (excursion := excursion_of(dut, "output")) is None:
        raise NotRun("missing: readout.supply")
    return excursion


def _of_converter(dut: DesignUnderTest, requirement: Requirement) -> Excursion:
    dut.converter()
    excursion = excursion_of(dut, "converter")
    assert excursion is not None
    return excursion


def _detail(dut: DesignUnderTest, requirement: Requirement, found: WorstCase, measurement: Measurement) -> Measurement:
    """With the lowest and the highest voltage, and the limits that they keep a distance from."""
    assert isinstance(found.target, Excursion)
    limits, signs = np.array(found.target.limits), np.array([-1.0, 1.0])
    reached = limits + signs * np.nan_to_num(found.by_sign.max(axis=(1, 2)))[::-1]
    known = np.isfinite(limits)
    ends = [engineering(v, "V") if there else "not limited" for v, there in zip(reached.tolist(), known, strict=True)]
    shown = [engineering(v, "V") if there else "any" for v, there in zip(limits.tolist(), known, strict=True)]
    nearer = int(found.corner.sign[0] > 0)
    volts = float(limits[nearer] + signs[nearer] * found.value)
    cell, _, rest = found.where.partition("; ")
    text = f"From {ends[0]} to {ends[1]}; the limits of the {found.target.name} are {shown[0]} and {shown[1]}."
    return replace(measurement, where=f"{cell}: {engineering(volts, 'V')}; {rest}", text=[text])


def _measured(dut: DesignUnderTest, readings: Readings) -> Measurement:
    adc = dut.converter()
    low, high = adc.range[0] + adc.step, adc.range[1] - adc.step
    least, most = float(readings.volts.min()), float(readings.volts.max())
    nominal = scan(dut.design, true_cells(dut)).volts
    simulated = float(min(nominal.min() - low, high - nominal.max()))
    return Measurement(
        min(least - low, high - most),
        "V",
        where=f"readings from {engineering(least, 'V')} to {engineering(most, 'V')}",
        text=[f"Simulated with nominal parts: {engineering(simulated, 'V')}."],
    )


_SMALLER = (("readout.reference_resistance", DOWN), ("drive.voltage", DOWN))
QUANTITIES = (
    Quantity(
        name="output_headroom",
        title="Headroom of the outputs",
        unit="V",
        says="Smallest distance of an output from its supply limits, V; negative: it would go beyond.",
        compute=Searched(_of_outputs, "V", negative, detail=_detail),
        methods=SEARCHED,
        shipped=(Shipped(4, "No output reaches its supply.", min=0.0),),
        mended_by=_SMALLER,
    ),
    Quantity(
        name="adc_headroom",
        title="Headroom of the converter",
        unit="V",
        says="Smallest distance of a converted voltage from the ends of the converter's range, V.",
        compute=Searched(_of_converter, "V", negative, detail=_detail),
        methods=SEARCHED,
        shipped=(Shipped(5, "No reading leaves the converter's range.", min=0.0),),
        mended_by=_SMALLER,
        measured=_measured,
    ),
)
