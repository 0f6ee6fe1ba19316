"""Largest power in a cell while its row is selected, W."""

from __future__ import annotations

from .._judging import Searched
from .._quantity import DOWN, SEARCHED, Quantity, Shipped
from .._whole_board import OperatingTarget

QUANTITY = Quantity(
    name="cell_power",
    title="Power in a cell",
    unit="W",
    says="Largest power in a cell while its row is selected, W.",
    compute=Searched(lambda dut, requirement: OperatingTarget("cell_power", "cell power"), "W"),
    methods=SEARCHED,
    shipped=(Shipped(11, "Cells do not heat themselves.", max=0.01),),
    mended_by=(("drive.voltage", DOWN),),
    rates=("cell", "power"),
)
