"""Converter range used: the share of it that the cells' readings move over."""

from __future__ import annotations

import numpy as np

from ...circuits import Boards, Requirement, scan_population
from .._dut import DesignUnderTest
from .._outcome import Measurement, NotRun
from .._quantity import NOMINAL, UP, Quantity, Shipped


def _compute(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    design = dut.design
    if design.adc is None:
        raise NotRun("missing: adc.bits, adc.range")
    shape = design.array.shape
    frames = np.stack([np.full(shape, dut.rest), np.full(shape, dut.pressed)])
    volts = np.clip(scan_population(design, Boards.of(design), frames).volts, *design.adc.range)
    moved = np.abs(volts[1] - volts[0])
    place = np.unravel_index(np.argmin(moved), shape)
    span = design.adc.range[1] - design.adc.range[0]
    return Measurement(
        float(100 * moved[place] / span),
        "%",
        where=f"cell {tuple(map(int, place))}",
        confidence="nominal parts; all cells at rest, then all pressed",
    )


QUANTITY = Quantity(
    name="adc_range_used",
    title="Converter range used",
    unit="%",
    says="Share of the converter's range that the cells' readings move over, from rest to full scale, %.",
    compute=_compute,
    methods=(NOMINAL,),
    shipped=(Shipped(6, "Presses move over a good part of the converter's range.", min=10.0),),
    mended_by=(("readout.reference_resistance", UP), ("drive.voltage", UP)),
)
