"""Cells that the driver can tell: of nominal parts without offsets, which is as well as it can know a board."""

from __future__ import annotations

import numpy as np

from ...circuits import Requirement, adc_codes, scan
from ...driver import CountReader
from .._dut import DesignUnderTest
from .._outcome import Measurement
from .._pressures import host_design
from .._quantity import DOWN, NOMINAL, UP, Quantity, Shipped

FRAMES_TO_SETTLE = 8
"""equal frames within which the driver's live inversion settles"""


def _compute(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    dut.converter()
    design = host_design(dut.design)
    second = np.indices(design.array.shape).sum(axis=0) % 2 == 1
    found = []
    for state, pressed in (("at rest", 0.0 * second), ("every second one pressed", 1.0 * second), ("pressed", 1.0)):
        cells = np.broadcast_to(dut.rest + (dut.pressed - dut.rest) * pressed, second.shape)
        counts = adc_codes(design, scan(design, cells, method="exact").volts)
        reader = CountReader(design)
        for _ in range(FRAMES_TO_SETTLE):
            valid = reader(counts).valid
            if valid.all():
                break
        found.append((100 * float(valid.mean()), state, np.argwhere(~valid)[:4].tolist()))
    share, state, missing = min(found)
    places = ", ".join(f"({i}, {j})" for i, j in missing)
    return Measurement(
        share,
        "%",
        where=f"not valid, all cells {state}: {places}" if missing else "all cells are valid",
        confidence=f"{len(found)} frames, nominal parts, without noise",
        text=[
            "A cell is valid if its conductance is known to 1 % or to a step of its own reading, whatever half a step "
            "of the other readings and the cells beyond a limit make of it."
        ],
    )


QUANTITIES = (
    Quantity(
        name="valid_cells",
        title="Cells that the driver can tell",
        unit="%",
        says="Share of cells that the driver takes for measured, at rest, pressed, and every second one pressed, %.",
        compute=_compute,
        methods=(NOMINAL,),
        shipped=(Shipped(20, "The driver can tell every cell.", min=100.0),),
        mended_by=(("adc.bits", UP), ("readout.reference_resistance", UP), ("readout.reference_resistance", DOWN)),
    ),
)
