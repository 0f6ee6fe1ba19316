"""Largest voltage across a cell, V."""

from __future__ import annotations

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._judging import measured, worst_of
from .._outcome import Measurement
from .._quantity import DOWN, Quantity
from .._whole_board import OperatingTarget


def _compute(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    found = worst_of(dut, OperatingTarget("cell_voltage", "cell voltage"))
    return measured(found, found.value, "V")


QUANTITY = Quantity(
    name="cell_voltage",
    title="Voltage across a cell",
    unit="V",
    says="Largest voltage across a cell, V.",
    compute=_compute,
    mended_by=(("drive.voltage", DOWN),),
)
