"""Largest current through the switch of a driven line, A."""

from __future__ import annotations

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._judging import measured, worst_of
from .._outcome import Measurement
from .._quantity import DOWN, Quantity, Shipped
from .._whole_board import OperatingTarget, driven_line


def _compute(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    found = worst_of(dut, OperatingTarget("driver_current", "switch current"))
    return measured(found, found.value, "A", where=f"{driven_line(found.box, found.cell)}; {found.where}")


QUANTITY = Quantity(
    name="switch_current",
    title="Current in a row switch",
    unit="A",
    says="Largest current through the switch of a driven line, A.",
    compute=_compute,
    shipped=(
        Shipped(
            24, "A driver can deliver the current of its line.", max=lambda design: design.requirements.driver_current
        ),
    ),
    mended_by=(("drive.voltage", DOWN),),
)
