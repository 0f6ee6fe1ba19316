"""Largest voltage across a cell, V."""

from __future__ import annotations

from .._judging import Searched
from .._quantity import DOWN, SEARCHED, Quantity
from .._whole_board import OperatingTarget

QUANTITY = Quantity(
    name="cell_voltage",
    title="Voltage across a cell",
    unit="V",
    says="Largest voltage across a cell, V.",
    compute=Searched(lambda dut, requirement: OperatingTarget("cell_voltage", "cell voltage"), "V"),
    methods=SEARCHED,
    mended_by=(("drive.voltage", DOWN),),
    rates=("cell", "voltage"),
)
