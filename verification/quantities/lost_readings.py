"""Readings that are lost to a limit of a converter or an output while the skin is pressed."""

from __future__ import annotations

import numpy as np

from ...circuits import Requirement, adc_codes, clipped, scan
from .._dut import DesignUnderTest
from .._hardware import Readings, true_cells
from .._outcome import Measurement
from .._pressures import runs
from .._quantity import Quantity, Shipped
from .._units import engineering


def _compute(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    found = [(100 * float(run.lost.mean()), run) for run in runs(dut)]
    share, run = max(found, key=lambda item: item[0])
    cells = np.argwhere(run.lost.any(axis=0))
    places = ", ".join(f"({i}, {j})" for i, j in cells[:6].tolist())
    return Measurement(share, "%", where=f"{len(cells)} cells of {run.board}: {places}" if len(cells) else "none")


def _measured(dut: DesignUnderTest, readings: Readings) -> Measurement:
    nominal = clipped(dut.design, adc_codes(dut.design, scan(dut.design, true_cells(dut)).volts))
    return Measurement(
        100 * float(readings.clipped.mean()),
        "%",
        where=f"{int(readings.clipped.any(axis=0).sum())} cells",
        text=[f"Simulated with nominal parts: {engineering(100 * float(nominal.mean()), '%')}."],
    )


QUANTITY = Quantity(
    name="lost_readings",
    title="Readings lost to a limit",
    unit="%",
    says="Share of readings beyond the converter's range or of outputs at a limit during the presses, %.",
    compute=_compute,
    shipped=(Shipped(15, "No press drives a reading beyond a limit.", max=0.0),),
    measured=_measured,
)
