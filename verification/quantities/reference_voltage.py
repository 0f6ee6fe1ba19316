"""Largest voltage across the reference resistor of an amplifier, or the load of a divider, V."""

from __future__ import annotations

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._judging import Searched
from .._quantity import DOWN, SEARCHED, Quantity
from .._whole_board import OperatingTarget, reference_target, sensed_line


def _target(dut: DesignUnderTest, requirement: Requirement) -> OperatingTarget:
    return reference_target(dut, "reference_voltage", "reference resistor's voltage")


QUANTITY = Quantity(
    name="reference_voltage",
    title="Voltage across a reference resistor",
    unit="V",
    says="Largest voltage across the resistor of a sensed line: Rref, or the load of a divider, V.",
    compute=Searched(_target, "V", line=sensed_line),
    methods=SEARCHED,
    mended_by=(("drive.voltage", DOWN),),
    rates=("reference_resistor", "voltage"),
)
