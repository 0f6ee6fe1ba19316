"""Resolution: the change of a cell's resistance that one step of the converter stands for."""

from __future__ import annotations

import numpy as np

from ...circuits import Boards, Requirement, apparent_resistance, scan_population
from .._dut import DesignUnderTest
from .._outcome import Measurement, NotRun
from .._quantity import NOMINAL, UP, Quantity


def _compute(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    design = dut.design
    if design.adc is None:
        raise NotRun("missing: adc.bits, adc.range")
    worst, where, small = 0.0, "", design.adc.step / 8
    for ohms, state in ((dut.rest, "at rest"), (dut.pressed, "at full scale")):
        volts = scan_population(design, Boards.of(design), np.full((1, *design.array.shape), ohms)).volts[0]
        change = apparent_resistance(design, volts + small) - apparent_resistance(design, volts - small)
        slope = np.abs(change) / (2 * small)
        place = np.unravel_index(np.argmax(slope), slope.shape)
        if slope[place] * design.adc.step > worst:
            worst, where = float(slope[place] * design.adc.step), f"cell {tuple(map(int, place))}, {state}"
    return Measurement(worst, "ohm", where=where, confidence="nominal parts; one code of the converter")


QUANTITY = Quantity(
    name="resolution",
    title="Resolution",
    unit="ohm",
    says="Change of a cell's resistance that one step of the converter stands for, at the least favourable load, ohm.",
    compute=_compute,
    methods=(NOMINAL,),
    mended_by=(("readout.reference_resistance", UP), ("drive.voltage", UP), ("adc.bits", UP)),
)
