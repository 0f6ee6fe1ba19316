"""Largest power in the reference resistor of an amplifier, or the load of a divider, W."""

from __future__ import annotations

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._judging import Searched
from .._quantity import DOWN, SEARCHED, Quantity
from .._whole_board import OperatingTarget, reference_target, sensed_line


def _target(dut: DesignUnderTest, requirement: Requirement) -> OperatingTarget:
    return reference_target(dut, "reference_power", "reference resistor's power")


QUANTITY = Quantity(
    name="reference_power",
    title="Power in a reference resistor",
    unit="W",
    says="Largest power in the resistor of a sensed line: Rref, or the load of a divider, W.",
    compute=Searched(_target, "W", line=sensed_line),
    methods=SEARCHED,
    mended_by=(("drive.voltage", DOWN),),
    rates=("reference_resistor", "power"),
)
