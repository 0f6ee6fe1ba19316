"""What the converter's range and step make of nominal readings: the share of the range used, and the resolution."""

from __future__ import annotations

import numpy as np

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._judging import worst_cell
from .._outcome import Measurement
from .._quantity import NOMINAL, UP, Quantity, Shipped
from .noise import ohms_per_volt


def _range_used(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    low, high = dut.converter().range
    volts = np.clip(np.stack(list(dut.nominal.values())), low, high)
    fewest, _, where = worst_cell(-np.abs(volts[1] - volts[0]))
    said = "nominal parts; all cells at rest, then all pressed"
    return Measurement(-100 * fewest / (high - low), "%", where=where, confidence=said)


def _resolution(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    step = dut.converter().step
    found = {state: step * ohms_per_volt(dut.design, volts, step / 8) for state, volts in dut.nominal.items()}
    ohms, _, where = worst_cell(found)
    return Measurement(ohms, "ohm", where=where, confidence="nominal parts; one code of the converter")


_MORE = (("readout.reference_resistance", UP), ("drive.voltage", UP))
QUANTITIES = (
    Quantity(
        name="adc_range_used",
        title="Converter range used",
        unit="%",
        says="Share of the converter's range that the cells' readings move over, from rest to full scale, %.",
        compute=_range_used,
        methods=(NOMINAL,),
        shipped=(Shipped(6, "Presses move over a good part of the converter's range.", min=10.0),),
        mended_by=_MORE,
    ),
    Quantity(
        name="resolution",
        title="Resolution",
        unit="ohm",
        says="Change of a cell's resistance that one step of the converter stands for, at the least favourable load, "
        "ohm.",
        compute=_resolution,
        methods=(NOMINAL,),
        mended_by=(*_MORE, ("adc.bits", UP)),
    ),
)
