"""Largest power in a cell while its row is selected, W."""

from __future__ import annotations

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._judging import measured, worst_of
from .._outcome import Measurement
from .._quantity import DOWN, Quantity, Shipped
from .._whole_board import OperatingTarget


def _compute(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    found = worst_of(dut, OperatingTarget("cell_power", "cell power"))
    return measured(found, found.value, "W")


QUANTITY = Quantity(
    name="cell_power",
    title="Power in a cell",
    unit="W",
    says="Largest power in a cell while its row is selected, W.",
    compute=_compute,
    shipped=(Shipped(11, "Cells do not heat themselves.", max=0.01),),
    mended_by=(("drive.voltage", DOWN),),
)
